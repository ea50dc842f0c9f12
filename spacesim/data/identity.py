"""What training data is known by again, wherever it lies: a run names it, and judging looks whether it is the same."""

import hashlib

from spacesim.data.records import Dataset, Frame


def training_digest(dataset: Dataset) -> str:
    """Of the training frames: names and sizes of the files, poses, intrinsics, lenses, Suns. Raises OSError where a
    picture is missing."""
    told = [
        (f.file_path, (dataset.root / f.file_path).stat().st_size, _numbers(f), f.sun and f.sun.angles)
        for f in dataset.train
    ]
    return hashlib.sha256(repr(told).encode()).hexdigest()[:16]


def _numbers(frame: Frame) -> list[float]:
    camera = frame.camera
    intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
    return [*camera.opengl.ravel().tolist(), *intrinsics, *frame.distortion]
