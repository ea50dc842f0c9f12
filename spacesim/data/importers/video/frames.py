"""Which frames of a video are worth taking: sharp ones, evenly spread over what moves."""

import importlib
import logging
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from PIL import Image
from scipy import ndimage

from spacesim.data.errors import InputError
from spacesim.data.files import open_regular
from spacesim.data.records import check_size

INSTALL = "pip install 'spacesim[video]'"
THUMBNAIL = 160  #: pixels of the longer side at which motion is measured
STILL = 0.2 / 255  #: mean change of pixels, sRGB values, below which a frame repeats the one before

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Survey:
    """What was seen of a video's frames."""

    sharpness: np.ndarray  #: [N] variance of the Laplacian near the middle of the picture, over that of its grey values
    motion: np.ndarray  #: [N] mean change of pixels since the frame before, sRGB values, 0 of the first


@dataclass(frozen=True, eq=False)
class FilmFrame:
    """A decoded frame of a video."""

    picture: np.ndarray  #: [H, W, 3] uint8
    time: float | None  #: seconds at which the file shows it, None where it does not say


def read_frames(path: Path, again: bool = False) -> Iterator[FilmFrame]:
    """The frames of a video in order. again: read before, so that missing frames have been reported

    Raises InputError where PyAV is missing, where the file is no video or has none that can be decoded. Where it breaks
    off, the frames until there are given, and a warning is logged.
    """
    library = _decoder()
    with open_regular(path, "a video file"):
        pass
    try:
        container = library.open(str(path))
    except (OSError, ValueError) as error:
        found = "an MP4 file that is cut off before its index" if _lacks_index(path) else _reason(error)
        raise InputError(f"{path}: expected a video that FFmpeg reads, found {found}") from None
    with container:
        if not container.streams.video:
            raise InputError(f"{path}: expected a video, found a file without pictures")
        stream = container.streams.video[0]
        if stream.codec_context is None:
            raise InputError(f"{path}: expected a video of a codec that FFmpeg decodes, found another")
        check_size(stream.width or 1, stream.height or 1, str(path))
        stream.thread_type = "AUTO"
        count, broken, end = 0, None, None
        try:
            for frame in container.decode(stream):
                count += 1
                time = None if frame.time is None else float(frame.time)
                end = None if time is None else time + float((frame.duration or 0) * (frame.time_base or 0))
                yield FilmFrame(frame.to_ndarray(format="rgb24"), time)
        except (OSError, ValueError) as error:
            broken = _reason(error)
        declared = int(stream.frames or 0)
        if count == 0:
            raise InputError(
                f"{path}: expected a video, found no frame that can be decoded ({broken or 'it is empty'})"
            )
        seconds = _lost_seconds(container, end)
        if (broken or count < declared or seconds) and not again:
            whole = f" of {declared}" if declared else ""
            lost = f"{seconds:.3g} seconds are missing" if seconds else "the rest cannot be decoded"
            _log.warning("%s: breaks off after %d%s frames (%s)", path, count, whole, broken or lost)


def _lacks_index(path: Path) -> bool:
    """Whether a file is of ISO 14496-12's boxes (MP4, MOV), but none of them is a whole `moov`."""
    size, start, kinds = path.stat().st_size, 0, []
    with open_regular(path, "a video file") as file:
        while start + 8 <= size:
            file.seek(start)
            length, kind, longer = struct.unpack(">I4sQ", file.read(16).ljust(16, b"\0"))
            start += longer if length == 1 else length or size - start
            if length in range(2, 8) or (length == 1 and longer < 16):
                break
            if start <= size:
                kinds.append(kind)
    return kinds[:1] == [b"ftyp"] and b"moov" not in kinds


def _lost_seconds(container: Any, end: float | None) -> float:
    """How much earlier the pictures end than the file declares, 0 where it does not say or that may well be: by two
    frames and a hundredth of it, beside sound by a second and a tenth."""
    if end is None or not container.duration:
        return 0.0
    alone = len(container.streams) == 1
    whole = float(container.duration) * 1e-6  # AV_TIME_BASE
    lost = whole + float(container.start_time or 0) * 1e-6 - end
    rate = float(container.streams.video[0].average_rate or 1)
    return lost if lost > (2 / rate + 0.01 * whole if alone else 1 + 0.1 * whole) else 0.0


def survey(frames: Iterator[np.ndarray], progress: Callable[[int], None] | None = None) -> Survey:
    """Sharpness and motion of frames of one size. progress: called with how many were seen."""
    sharpness, motion, before = [], [], None
    for picture in frames:
        small = _thumbnail(picture)
        sharpness.append(_sharpness(picture))
        same = before is not None and before.shape == small.shape
        motion.append(float(np.abs(small - before).mean()) if before is not None and same else 0.0)
        before = small
        if progress is not None:
            progress(len(sharpness))
    return Survey(np.array(sharpness), np.array(motion))


def choose(seen: Survey, most: int) -> np.ndarray:
    """Numbers of at most `most` frames, rising: the sharpest of each of as many stretches of equal motion. Frames that
    repeat the one before are left out."""
    moving = np.flatnonzero((seen.motion > STILL) | (np.arange(len(seen.motion)) == 0))
    if len(moving) <= most:
        return moving
    way = np.cumsum(np.minimum(seen.motion[moving], 4 * np.median(seen.motion[moving])))  # a cut is no long way
    stretch = np.minimum((way / way[-1] * most).astype(int), most - 1)
    best = [group[np.argmax(seen.sharpness[group])] for k in range(most) if len(group := moving[stretch == k])]
    return np.array(best)


def _decoder() -> ModuleType:
    try:
        return importlib.import_module("av")
    except (ImportError, OSError):
        raise InputError(f"video: expected PyAV to read it, found none; type: {INSTALL}") from None


def _reason(error: BaseException) -> str:
    return str(getattr(error, "strerror", None) or error)


def _thumbnail(picture: np.ndarray) -> np.ndarray:
    image = Image.fromarray(picture)
    image.thumbnail((THUMBNAIL, THUMBNAIL), Image.Resampling.BOX)
    return np.asarray(image, np.float32) / 255


def _sharpness(picture: np.ndarray) -> float:
    """Of the middle half of the picture, where the object is."""
    height, width = picture.shape[:2]
    middle = picture[height // 4 : height - height // 4, width // 4 : width - width // 4, 1].astype(np.float32)
    return float(ndimage.laplace(middle).var() / (middle.var() + 1))
