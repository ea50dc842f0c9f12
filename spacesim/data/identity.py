"""What data are known by: training data wherever they lie, so that evaluating notices others in their place, and frames
by names of which no two are the same."""

import hashlib
import math
import os
import re
from collections.abc import Sequence
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
    digests = _content_digests(root, [p for f in frames for p in (f.file_path, f.silhouette_path, f.mask_path) if p])
    contents = [
        [
            digests[f.file_path] or digest_of(root / f.file_path),
            *(path and digests[path] for path in (f.silhouette_path, f.mask_path)),
        ]
        for f in frames
    ]
    return "-".join(hashlib.sha256(repr(part).encode()).hexdigest()[:16] for part in (heads, contents))


def same_digest(one: str, other: str) -> bool:
    """Whether two of `frames_digest` may be of the same frames, by the parts that both have."""
    return all(a == b for a, b in zip(one.split("-"), other.split("-"), strict=False))


def _content_digests(root: Path, paths: Sequence[str]) -> dict[str, str | None]:
    """SHA-256 of files, None of one that cannot be read: what SHA256SUMS says, of files that are not newer than it."""
    try:
        manifest = read_manifest(root)
        written = (root / MANIFEST).stat().st_mtime_ns if manifest else 0
    except (InputError, OSError):  # a broken one: files are hashed themselves
        manifest, written = {}, 0
    known = {path: manifest[path] for path in paths if path in manifest and _changed(root / path) <= written}
    others = [path for path in dict.fromkeys(paths) if path not in known]
    with ThreadPoolExecutor(_THREADS) as pool:
        return {**known, **dict(zip(others, pool.map(lambda path: _digest_of(root / path), others), strict=True))}


def _changed(path: Path) -> float:
    """Nanoseconds."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return math.inf


def _digest_of(path: Path) -> str | None:
    try:
        return digest_of(path)
    except InputError:
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
        while name.lower() in taken:  # some file systems ignore case
            count += 1
            name = f"{stem}_{count}"
        taken.add(name.lower())
        names.append(name)
    return names
