"""What data are known by: training data wherever they lie, so that evaluating notices others in their place, and frames
by names of which no two are the same."""

import hashlib
import os
import re
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from spacesim.data.errors import InputError
from spacesim.data.integrity.manifest import NAME as MANIFEST
from spacesim.data.integrity.manifest import digest_of, read_manifest
from spacesim.data.records import Dataset, Frame

MAX_NAME_LENGTH = 100  #: characters of a frame's name; file systems take 255 bytes
_THREADS = min(8, os.cpu_count() or 1)


def training_digest(dataset: Dataset) -> str:
    """`frames_digest` of the training frames."""
    return frames_digest(dataset.root, dataset.train)


def frames_digest(root: Path, frames: Sequence[Frame]) -> str:
    """Of frames, "HEAD-CONTENT": of names and sizes of the files, poses, intrinsics, lenses, Suns; and of the content
    of pictures, silhouettes and masks. Older versions wrote the head alone (see `same_digest`).

    root: their dataset's. Raises OSError where a picture is missing, InputError where it cannot be read.
    """
    heads = [(f.file_path, (root / f.file_path).stat().st_size, _numbers(f), f.sun and f.sun.angles) for f in frames]
    manifest = _read_manifest(root)
    written = (root / MANIFEST).stat().st_mtime_ns if manifest else 0

    def content(frame: Frame) -> list[str | None]:
        parts = frame.silhouette_path, frame.mask_path
        picture = _content(root, frame.file_path, manifest, written)
        return [picture, *(_part_content(root, path, manifest, written) for path in parts)]

    with ThreadPoolExecutor(_THREADS) as pool:
        contents = list(pool.map(content, frames))
    return "-".join(hashlib.sha256(repr(part).encode()).hexdigest()[:16] for part in (heads, contents))


def same_digest(one: str, other: str) -> bool:
    """Whether two of `frames_digest` may be of the same frames, by what both of them tell."""
    return all(a == b for a, b in zip(one.split("-"), other.split("-"), strict=False))


def _read_manifest(root: Path) -> dict[str, str]:
    try:
        return read_manifest(root)
    except InputError:  # a broken one: files tell themselves
        return {}


def _content(root: Path, path: str, manifest: Mapping[str, str], written: int) -> str:
    """SHA-256 of a file: what SHA256SUMS says of one that has not changed since that was `written` (nanoseconds)."""
    if path in manifest and (root / path).stat().st_mtime_ns <= written:
        return manifest[path]
    return digest_of(root / path)


def _part_content(root: Path, path: str | None, manifest: Mapping[str, str], written: int) -> str | None:
    """None where there is none: what does not need it does not ask."""
    try:
        return None if path is None else _content(root, path, manifest, written)
    except (OSError, InputError):
        return None


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
