"""A view of a run as numpy arrays, for who asks `Run.render`."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.files import as_path
from spacesim.data.records import Camera, Sun, check_camera
from spacesim.learning.lights import CanPredict, Light, check_light, predict_light
from spacesim.learning.pictures import write_material, write_picture
from spacesim.learning.prediction import KINDS, MATERIAL_KINDS, MaterialView, Prediction


def checked_sun(sun: Sun | Sequence[float] | None, needed: bool, whose: str) -> Sun | None:
    """The Sun that is given, as `Sun.of` takes it. needed: by what is drawn, which `whose` names. Raises InputError
    where it is needed and none is given."""
    direction = Sun.of(sun)
    if direction is None and needed:
        raise InputError(f"sun: expected its direction for {whose}, found none")
    return direction


class Rendering:
    """A view of a run, drawn when an array of it is asked for first. See `Run.render`."""

    def __init__(
        self, run: CanPredict, camera: Camera, sun: Sun | None, exposure: float | None = None, light: Light = "all"
    ) -> None:
        check_camera(camera)
        check_light(run, sun, light)
        self.run, self.camera, self.sun, self.exposure, self.light = run, camera, sun, exposure, light

    @cached_property
    def _drawn(self) -> "Prediction":
        return predict_light(self.run, self.camera, self.sun, self.light, exposure=self.exposure)

    @property
    def rgb(self) -> np.ndarray:
        """[H, W, 3] float32, sRGB values over black, beyond 1 where what bounces makes them brighter than white."""
        return self._drawn.rgb

    @property
    def linear(self) -> np.ndarray | None:
        """[H, W, 3] float32, linear display values over black, 1 white, not clipped, of a run in linear light
        (`light.linear`); None of others."""
        return self._drawn.linear

    @property
    def alpha(self) -> np.ndarray:
        """[H, W] float32 in [0, 1]."""
        return self._drawn.alpha

    @property
    def depth(self) -> np.ndarray:
        """[H, W] float32: expected depth along the optical axis, metres; 0 where alpha is 0."""
        return self._drawn.depth

    @cached_property
    def visibility(self) -> np.ndarray | None:
        """[H, W] float32: the share of the Sun that the surface sees, 0 to 1; None of a method without shadows."""
        seen = self._drawn.visibility
        return None if seen is None else np.clip(seen, 0, 1)  # a sum of weights over their sum is rounded

    @cached_property
    def normal(self) -> np.ndarray:
        """[H, W, 3] float32: unit vectors in world axes; 0 where there is no surface."""
        drawn = self.run.predict(self.camera, self.sun, normals=True, exposure=self.exposure)
        assert drawn.normal is not None
        return drawn.normal

    @property
    def albedo(self) -> np.ndarray:
        """[H, W, 3] float32: linear reflectance, of metals specular, of a run that `Run.draw_material` takes."""
        return self._material.albedo

    @property
    def specular(self) -> np.ndarray:
        """[H, W, 3] float32: linear reflectance of facets at normal incidence, 0 where none are seen, of a run that
        `Run.draw_material` takes."""
        return self._material.specular

    @property
    def roughness(self) -> np.ndarray:
        """[H, W] float32: alpha of GGX, 1 where no gloss is seen, of a run that `Run.draw_material` takes."""
        return self._material.roughness

    @property
    def metallic(self) -> np.ndarray:
        """[H, W] float32 in [0, 1]: share of metals, of a run that `Run.draw_material` takes."""
        return self._material.metallic

    @cached_property
    def _material(self) -> MaterialView:
        return self.run.draw_material(self.camera)

    def save(self, path: str | Path, kind: str = "rgb") -> Path:
        """Write a PNG to look at or an EXR to compute with; returns its path.

        kind: "rgb", "alpha", "depth", "normal", "shadow", "albedo", "specular", "roughness" or "metallic". Raises
        InputError for another, for another suffix, and for what a method is without.
        """
        path = as_path(path, "path")
        if kind not in (*KINDS, *MATERIAL_KINDS):
            raise InputError(f"kind: expected one of {', '.join((*KINDS, *MATERIAL_KINDS))}, found {kind!r}")
        if kind in MATERIAL_KINDS:
            write_material(self._material, kind, path)
            return path
        drawn = replace(self._drawn, normal=self.normal) if kind == "normal" else self._drawn
        write_picture(drawn, kind, path)
        return path
