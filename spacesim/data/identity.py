"""What data are known by: training data wherever they lie, so that evaluating notices others in their place, and frames
by names of which no two are the same."""

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path

from spacesim.data.records import Dataset, Frame

MAX_NAME_LENGTH = 100  #: characters of a frame's name; file systems take 255 bytes


def training_digest(dataset: Dataset) -> str:
    """`frames_digest` of the training frames."""
    return frames_digest(dataset.root, dataset.train)


def frames_digest(root: Path, frames: Sequence[Frame]) -> str:
    """Of frames: names and sizes of the files, poses, intrinsics, lenses, Suns. root: their dataset's. Raises OSError
    where a picture is missing."""
    identity = [(f.file_path, (root / f.file_path).stat().st_size, _numbers(f), f.sun and f.sun.angles) for f in frames]
    return hashlib.sha256(repr(identity).encode()).hexdigest()[:16]


def _numbers(frame: Frame) -> list[float]:
    camera = frame.camera
    intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
    return [*camera.opengl.ravel().tolist(), *intrinsics, *frame.distortion]


def frame_names(frames: Sequence[Frame]) -> list[str]:
    """A unique file name for each frame, without suffix, from its image's path below the dataset (a folder "images" in
    front is left out): letters, digits, dots, dashes and underscores."""
    names: list[str] = []
    taken: set[str] = set()
    for frame in frames:
        stem = str(Path(frame.file_path).with_suffix("")).removeprefix("./").removeprefix("images/")
        stem = re.sub(r"[^A-Za-z0-9._-]+", "_", stem)[-MAX_NAME_LENGTH:].lstrip("._") or "frame"
        name, count = stem, 1
        while name.lower() in taken:  # some file systems do not tell cases apart
            count += 1
            name = f"{stem}_{count}"
        taken.add(name.lower())
        names.append(name)
    return names
