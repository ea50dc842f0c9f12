"""Less work for the same answers: what tests of other things need not wait for."""

import hashlib
import os
from collections.abc import Callable
from dataclasses import fields
from functools import wraps
from typing import TypeVar

import numpy as np

R = TypeVar("R")
SAMPLES, VOXELS = 4_000, 48
POINTS = 2_000
SIZE = 120, 90  #: of pictures of shapes, pixels


def spare_work() -> None:
    """Both, from now on, in this process."""
    spare_datasets()
    spare_shapes()


def spare_datasets() -> None:
    """They have fewer points to start from where nobody says how many; keypoints and symmetries of a mesh and maps of
    the same cameras, most of the time that a tiny dataset takes, are made once; and files are not waited for until they
    are on the disk, which only a power cut could tell."""
    from spacesim.data import density
    from spacesim.data.exporters import keypoints
    from spacesim.scenes.config import QualityConfig

    os.fsync = lambda _descriptor: None
    os.sync = lambda: None
    defaults = zip(fields(QualityConfig), QualityConfig.__init__.__defaults__, strict=True)
    QualityConfig.__init__.__defaults__ = tuple(
        POINTS if field.name == "points" else default for field, default in defaults
    )
    for module, name in (
        (keypoints, "find_keypoints"),
        (keypoints, "find_symmetries"),
        (density, "camera_density"),
    ):
        setattr(module, name, _remembered(getattr(module, name)))


def spare_shapes() -> None:
    """They are compared by fewer points where nobody says by how many, and drawn smaller."""
    from spacesim.eval import shape
    from spacesim.eval.metrics.geometry import GeometryConfig

    _, share, _, *rest = GeometryConfig.__init__.__defaults__
    GeometryConfig.__init__.__defaults__ = (SAMPLES, share, VOXELS, *rest)
    shape.WIDTH, shape.HEIGHT = SIZE


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
