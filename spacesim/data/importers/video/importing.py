"""`import video` and `import images`: pictures without poses as a dataset."""

import io
import logging
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy import ndimage

from spacesim.data.errors import InputError, expect
from spacesim.data.files import JsonValue, json_bytes
from spacesim.data.images import read_png, write_png
from spacesim.data.importers.importer import Importer, Option
from spacesim.data.importers.masks import (
    AUTO,
    MASKED,
    NO_MASKS,
    MaskFolder,
    as_color,
    check_shown,
    mask_options,
    over_black,
    read_mask,
)
from spacesim.data.importers.video.chart import draw_cameras
from spacesim.data.importers.video.frames import choose, read_frames, survey
from spacesim.data.importers.video.model import (
    SfmModel,
    arc_of,
    focal_length,
    hull_length,
    placed,
    report_of,
    without_floating,
)
from spacesim.data.importers.video.segmentation import segment_sequence
from spacesim.data.importers.video.sfm import check_focal, reconstruct
from spacesim.data.importers.writing import (
    ImportedFrame,
    Progress,
    StageProgress,
    check_free,
    frame_names,
    write_dataset,
)
from spacesim.data.records import Camera, Dataset

FRAMES = 120  #: taken of a video, at most
LEAST = 3  #: pictures that poses can be found of
REGISTERED = 0.9  #: share of pictures with a pose below which a warning is logged
ARC = 20.0  #: degrees that cameras go around the object below which a warning is logged
_RIM = 2  # pixels along the outline in which no features are taken: they are of what is behind, too
_STAGES = ("cut out", "features", "matches", "poses", "write")
_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp"}

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ImportOptions:
    """What both importers are asked for. Raises InputError for a value out of range."""

    masks: str | Path | None = None  #: a folder; "none": the background stays; None, "auto": by `segment_sequence`
    masked: str = "empty"  #: what black in a mask means, see `masks.MASKED`
    fov: float | None = None  #: degrees of the pictures' width; None: estimated
    length: float | None = None  #: metres of the object along its longest axis
    distance: float | None = None  #: metres from the cameras to the object, the median
    height: int | None = None  #: pixels that pictures are scaled down to

    def __post_init__(self) -> None:
        expect(self.masked in MASKED, "masked", f"one of {', '.join(MASKED)}", self.masked)
        expect(self.fov is None or 0.7 <= self.fov <= 136, "fov", "degrees from 0.7 to 136", self.fov)
        for name in ("length", "distance"):
            metres = getattr(self, name)
            expect(metres is None or 1e-6 <= metres <= 1e12, name, "metres from 1e-06 to 1e+12", metres)
        if self.length is not None and self.distance is not None:
            raise InputError("length, distance: expected one of them, found both")
        expect(self.height is None or self.height >= 16, "height", "at least 16 pixels", self.height)


def import_video(
    src: Path, out: Path, *, frames: int = FRAMES, progress: Progress | None = None, **options: Any
) -> Dataset:
    """Import a video of one object. frames: taken at most, see `frames.choose`; options: fields of `ImportOptions`.

    The dataset has structure.json, which says how the poses were found, and cameras.png. Its unit is the median
    distance of the cameras where neither `length` nor `distance` is known. Raises InputError as `read_frames` and
    `reconstruct` do, and where `out` is not free.
    """
    settings = ImportOptions(**options)
    expect(LEAST <= frames <= 5000, "frames", f"{LEAST} to 5000", frames)
    source = _source("video", src, settings, frames=frames)
    check_free(out, source)
    with _workspace() as folder:
        tell = StageProgress(progress, ("look", *_STAGES))
        seen = survey((frame.picture for frame in read_frames(src)), lambda count: tell("look", 0, 1, f"frame {count}"))
        chosen = choose(seen, frames)
        if len(chosen) < LEAST:
            raise InputError(
                f"{src}: expected at least {LEAST} frames that differ, found {len(chosen)} of {len(seen.motion)}: "
                "nothing moves"
            )
        keys: dict[str, dict[str, float]] = {}
        size: tuple[int, ...] | None = None
        for number, frame in enumerate(read_frames(src, again=True)):
            if number in set(chosen.tolist()):
                size = size or frame.picture.shape
                if frame.picture.shape != size:
                    raise InputError(f"{src}: expected pictures of one size, found another from frame {number} on")
                name = f"frame_{number:06d}.png"
                write_png(folder / "pictures" / name, _scaled(frame.picture, settings.height), durable=False)
                keys[name] = {"source_index": number} | ({} if frame.time is None else {"time": frame.time})
        facts: dict[str, JsonValue] = {"frames_of_video": len(seen.motion)}
        return _import(src, out, folder, keys, _times(list(keys.values())), settings, source, tell, facts)


def _times(keys: Sequence[Mapping[str, float]]) -> list[float]:
    """Of a film's frames: seconds, or frame numbers where seconds are missing or do not rise."""
    seconds = [one["time"] for one in keys if "time" in one]
    rise = len(seconds) == len(keys) and (np.diff(seconds) > 0).all()
    return seconds if rise else [one["source_index"] for one in keys]


def import_images(src: Path, out: Path, *, progress: Progress | None = None, **options: Any) -> Dataset:
    """Import a folder of pictures of one object by one camera; of their names' order, in time where there are many.

    options: fields of `ImportOptions`. Raises InputError as `import_video` does, and for pictures of several sizes.
    """
    settings = ImportOptions(**options)
    if not src.is_dir():
        raise InputError(f"{src}: expected a folder of pictures, found {'a file' if src.exists() else 'nothing'}")
    source = _source("images", src, settings)
    check_free(out, source)
    paths = sorted(p for p in src.rglob("*") if p.suffix.lower() in _SUFFIXES and not p.name.startswith("."))
    if len(paths) < LEAST:
        raise InputError(f"{src}: expected at least {LEAST} pictures, found {len(paths)}")
    names = [f"{name}.png" for name in frame_names([path.relative_to(src).as_posix() for path in paths])]
    with _workspace() as folder:
        tell = StageProgress(progress, ("look", *_STAGES))
        size = None
        for k, (path, name) in enumerate(zip(paths, names, strict=True)):
            tell("look", k, len(paths), name)
            pixels = as_color(read_png(path))
            size = size or pixels.shape[:2]
            if pixels.shape[:2] != size:
                expected = f"{size[1]}x{size[0]} pixels as the first picture has"
                raise InputError(f"{path}: expected {expected}, found {pixels.shape[1]}x{pixels.shape[0]}")
            write_png(folder / "pictures" / name, _scaled(pixels, settings.height), durable=False)
        return _import(src, out, folder, {name: {} for name in names}, None, settings, source, tell, {})


def _import(
    src: Path,
    out: Path,
    folder: Path,
    keys: Mapping[str, Mapping[str, JsonValue]],
    times: Sequence[float] | None,
    settings: ImportOptions,
    source: dict[str, JsonValue],
    tell: StageProgress,
    facts: dict[str, JsonValue],
) -> Dataset:
    """Of pictures in folder/pictures, all of one size. keys: of each picture by its name, what transforms.json has of
    it besides; times: of a film's, see `reconstruct`"""
    names = list(keys)
    width, height = Image.open(folder / "pictures" / names[0]).size
    focal = None if settings.fov is None else focal_length(width, settings.fov)
    if focal is not None:
        check_focal(focal, (width, height), "fov")
    has_masks = _find_masks(folder, names, settings, tell)
    features = _hide_background(folder, names) if has_masks else None
    shown = folder / ("features" if has_masks else "pictures")
    work = folder / "work"
    work.mkdir()
    try:
        reconstruction = reconstruct(shown, names, (width, height), work, features, focal, times, tell)
    except InputError as error:
        raise InputError(str(error).replace(f"{shown.name}: ", f"{src}: ", 1)) from None
    extent, scale_from = None, None if settings.distance is None else "distance"
    if settings.length is not None:
        if has_masks:
            masks = [read_png(folder / "masks" / name) > 0 for name in reconstruction.names]
            extent = hull_length(reconstruction, masks)
        scale_from = "points" if extent is None else "silhouettes"
        if extent is not None:
            _log.info("length: taken of what the silhouettes enclose")
        else:
            _log.warning(
                "length: taken of the points, which may cover a part of the object: %s; name distance if it is known",
                "its silhouettes show no longest axis from the side" if has_masks else "there are no silhouettes",
            )
    model = placed(without_floating(reconstruction), settings.length, settings.distance, extent)
    if len(model.names) < REGISTERED * len(names):
        apart = [size for size in model.sizes[1:] if size >= LEAST]
        _log.warning(
            "%s: %d of %d pictures have a pose; the others are left out (structure.json names them)%s",
            src, len(model.names), len(names),
            f": {' and '.join(map(str, apart))} fit together, but not to these; import them apart" if apart else "",
        )  # fmt: skip
    if (arc := arc_of(model)) < ARC:
        _log.warning(
            "%s: expected cameras that go around the object by %g degrees or more, found %.2g: shape, scale and lens "
            "are uncertain", src, ARC, arc,
        )  # fmt: skip
    stream = io.BytesIO()
    Image.fromarray(draw_cameras(model)).save(stream, format="PNG")
    unit = "metres" if settings.length or settings.distance else "median distance of the cameras"
    report = {**facts, "unit": unit, "scale_from": scale_from, **report_of(model, names)}
    files = {"structure.json": json_bytes(report), "cameras.png": stream.getvalue()}
    frames = list(_frames(folder, model, has_masks, settings.masked, keys))
    points = (model.points, model.colors)
    return write_dataset(
        out, frames, None, source, points, files, lambda done, total, name: tell("write", done, total, name)
    )


def _find_masks(folder: Path, names: Sequence[str], settings: ImportOptions, tell: StageProgress) -> bool:
    """Write folder/masks/NAME, 255 the object; False where the background stays."""
    if settings.masks is not None and str(settings.masks) == NO_MASKS:
        return False
    if settings.masks is not None and str(settings.masks) != AUTO:
        given = MaskFolder(Path(settings.masks)).find_all(names)
        masks = []
        for k, name in enumerate(names):
            tell("cut out", k, len(names), name)
            height, width = read_png(folder / "pictures" / name).shape[:2]
            whole = np.ones((height, width), bool)
            masks.append(read_mask(given[name], width, height) if name in given else whole)
    else:
        loads: list[Callable[[], np.ndarray]] = [
            lambda name=name: over_black(read_png(folder / "pictures" / name))  # type: ignore[misc]
            for name in names
        ]
        masks = segment_sequence(loads, lambda count: tell("cut out", count, len(names), ""))
    empty = [name for name, mask in zip(names, masks, strict=True) if not mask.any()]
    check_shown(empty, len(names))
    for name, mask in zip(names, masks, strict=True):
        write_png(folder / "masks" / name, np.where(mask, 255, 0).astype(np.uint8), durable=False)
    return True


def _hide_background(folder: Path, names: Sequence[str]) -> Path:
    """Write folder/features/NAME, the object over black, and return the folder of where features may be."""
    for name in names:
        pixels = over_black(read_png(folder / "pictures" / name))
        mask = read_png(folder / "masks" / name) > 0
        write_png(folder / "features" / name, np.where(mask[..., None], pixels, 0).astype(np.uint8), durable=False)
        inner = ndimage.binary_erosion(mask, iterations=_RIM)
        write_png(folder / "feature_masks" / f"{name}.png", np.where(inner, 255, 0).astype(np.uint8), durable=False)
    return folder / "feature_masks"


def _frames(
    folder: Path, model: SfmModel, has_masks: bool, masked: str, keys: Mapping[str, Mapping[str, JsonValue]]
) -> Iterator[ImportedFrame]:
    distortion = (model.k1, 0.0, 0.0, 0.0, 0.0)
    for name, pose in zip(model.names, model.world_from_camera, strict=True):
        picture, mask = folder / "pictures" / name, folder / "masks" / name
        cut_out = has_masks and masked == "empty"

        def with_alpha(picture: Path = picture, mask: Path = mask) -> np.ndarray:
            pixels = as_color(read_png(picture))
            alpha = read_png(mask) if pixels.shape[2] == 3 else np.minimum(pixels[..., 3], read_png(mask))
            return np.dstack([pixels[..., :3], alpha])

        yield ImportedFrame(
            name=name.removesuffix(".png"),
            picture=with_alpha if cut_out else picture,
            camera=Camera(pose, model.width, model.height, model.focal, model.focal, *model.centre),
            distortion=distortion,
            mask=mask if has_masks and masked == "unknown" else None,
            keys=keys[name],
        )


def _source(kind: str, src: Path, settings: ImportOptions, **more: JsonValue) -> dict[str, JsonValue]:
    options = {key: str(value) if isinstance(value, Path) else value for key, value in vars(settings).items()}
    return {"kind": kind, "source": str(src), **more, **options}


class _workspace:  # noqa: N801
    """A temporary folder, gone afterwards whatever happens."""

    def __enter__(self) -> Path:
        self.folder = Path(tempfile.mkdtemp(prefix="spacesim-"))
        return self.folder

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)


def _scaled(pixels: np.ndarray, height: int | None) -> np.ndarray:
    if height is None or height >= pixels.shape[0]:
        return pixels
    width = max(1, round(pixels.shape[1] * height / pixels.shape[0]))
    return np.asarray(Image.fromarray(pixels).resize((width, height), Image.Resampling.LANCZOS))


_OPTIONS = (
    *mask_options("auto"),
    Option("fov", float, "DEG", "angle that a picture's width covers, where it is known (estimated)"),
    Option("length", float, "M", "metres of the object along its longest axis (unit: median distance of the cameras)"),
    Option("distance", float, "M", "metres from the cameras to the object, the median, instead of a length"),
    Option("height", int, "PX", "scale pictures down to this height"),
)
VIDEO = Importer(
    import_video,
    "a video of one object, without poses (needs the extras video and sfm)",
    "video file",
    (Option("frames", int, "N", f"frames to take, at most ({FRAMES})"), *_OPTIONS),
)
IMAGES = Importer(
    import_images, "pictures of one object by one camera, without poses (needs the extra sfm)", "folder", _OPTIONS
)
