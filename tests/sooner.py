"""Less work for the same answers: what tests of other things need not wait for."""

import hashlib
import os
from collections.abc import Callable
from dataclasses import fields
from functools import wraps
from typing import TypeVar

import numpy as np

from spacesim.data import density
from spacesim.data.exporters import keypoints
from spacesim.eval.metrics.geometry import GeometryConfig
from spacesim.scenes.config import QualityConfig

R = TypeVar("R")
SAMPLES, VOXELS = 4_000, 48
POINTS = 2_000


def spare_work() -> None:
    """From now on, in this process: shapes are compared by fewer points, and datasets have fewer to start from, where
    nobody says how many; keypoints and symmetries of a mesh and maps of the same cameras, most of the time that a tiny
    dataset takes, are made once; and files are not waited for until they are on the disk, which only a power cut could
    tell."""
    os.fsync = lambda _descriptor: None
    os.sync = lambda: None
    _, share, _, *rest = GeometryConfig.__init__.__defaults__  # type: ignore[misc]
    GeometryConfig.__init__.__defaults__ = (SAMPLES, share, VOXELS, *rest)
    QualityConfig.__init__.__defaults__ = tuple(
        POINTS if field.name == "points" else default
        for field, default in zip(fields(QualityConfig), QualityConfig.__init__.__defaults__, strict=True)
    )
    for name in ("find_keypoints", "find_symmetries"):
        setattr(keypoints, name, _remembered(getattr(keypoints, name)))
    density.camera_density = _remembered(density.camera_density)


def _remembered(function: Callable[..., R]) -> Callable[..., R]:
    """By all bytes of its arrays."""
    known: dict[object, R] = {}

    @wraps(function)
    def recalled(*arguments: object) -> R:
        key = tuple(map(_key, arguments))
        if key not in known:
            known[key] = function(*arguments)
        return known[key]

    return recalled


def _key(value: object) -> object:
    if not isinstance(value, np.ndarray):
        return value
    return value.shape, value.dtype.str, hashlib.sha256(np.ascontiguousarray(value)).digest()
