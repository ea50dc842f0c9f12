"""What a run predicts of a view."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np

from spacesim import backend
from spacesim.backend.memory import check_memory
from spacesim.data.records import Camera, Sun

A_PIXEL = {"cuda": 80, "llvm": 225}
"""Bytes of main memory that a predicted pixel takes at most, until it is written: 160 and then 65 were seen on LLVM."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """A rendered view, float32."""

    rgb: np.ndarray  #: [H, W, 3] sRGB values over black, beyond 1 where what bounces makes them brighter than white
    alpha: np.ndarray  #: [H, W]
    depth: np.ndarray  #: [H, W] expected depth in metres, 0 where alpha is 0
    visibility: np.ndarray | None  #: [H, W], or None from a method without
    #: [H, W, 3] unit vectors in world axes, 0 where there is no surface, or None where not asked for
    normal: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class ComposedPrediction(Prediction):
    """A view of a scene. visibility: of models without shadows of their own 1 where no other model is before the
    Sun."""

    #: [H, W] int32, number of the object with the largest share of the pixel, counted from 1 in the order of the
    #: models; 0 where less than half of the pixel is covered
    id: np.ndarray | None = None


class Predicts(Protocol):
    """What predicts views: a run of any method."""

    def predict(
        self, camera: Camera, sun: Sun | None = None, normals: bool = False, exposure: float | None = None
    ) -> Prediction:
        """Render one view; see `spacesim.splat.run.Predictor`."""


class Rendering:
    """A view of a run, drawn when an array of it is asked for first. See `Run.render`."""

    def __init__(self, run: Predicts, camera: Camera, sun: Sun | None, exposure: float | None = None) -> None:
        self.run, self.camera, self.sun, self.exposure = run, camera, sun, exposure

    @cached_property
    def _drawn(self) -> "Prediction":
        return self.run.predict(self.camera, self.sun, exposure=self.exposure)

    @property
    def rgb(self) -> np.ndarray:
        """[H, W, 3] float32, sRGB values over black, beyond 1 where what bounces makes them brighter than white."""
        return self._drawn.rgb

    @property
    def alpha(self) -> np.ndarray:
        """[H, W] float32 in [0, 1]."""
        return self._drawn.alpha

    @property
    def depth(self) -> np.ndarray:
        """[H, W] float32: expected depth along the optical axis, metres; 0 where alpha is 0."""
        return self._drawn.depth

    @property
    def visibility(self) -> np.ndarray | None:
        """[H, W] float32: the share of the Sun that the surface sees, 0 to 1; None of a method without shadows."""
        return self._drawn.visibility

    @cached_property
    def normal(self) -> np.ndarray:
        """[H, W, 3] float32: unit vectors in world axes; 0 where there is no surface."""
        drawn = self.run.predict(self.camera, self.sun, normals=True, exposure=self.exposure)
        assert drawn.normal is not None
        return drawn.normal

    def save(self, path: str | Path, kind: str = "rgb") -> Path:
        """Write a PNG to look at or an EXR to compute with; returns its path.

        kind: "rgb", "alpha", "depth", "normal" or "shadow". Raises InputError for another suffix, and for shadows of a
        method without.
        """
        from spacesim.learning.pictures import write_picture

        drawn = replace(self._drawn, normal=self.normal) if kind == "normal" else self._drawn
        write_picture(drawn, kind, Path(path))
        return Path(path)


def check_picture(camera: Camera) -> None:
    """Raise MemoryError, before it is drawn, where a camera's picture does not fit into memory."""
    needed = A_PIXEL[backend.select()] * camera.width * camera.height
    check_memory(needed, f"a picture of {camera.width} x {camera.height} pixels")
