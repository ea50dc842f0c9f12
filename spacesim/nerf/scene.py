"""What a scene with radiance fields is asked for, whether Gaussians stand beside them or not."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from spacesim import backend
from spacesim.data.errors import InputError
from spacesim.data.records import Camera, Sun
from spacesim.learning.prediction import ComposedPrediction, MaterialView, check_picture

COVERED = 0.5  #: alpha from which on a pixel shows a model


@dataclass(frozen=True, eq=False)
class DrawnScene:
    """Planes of a picture, float32."""

    rgb: np.ndarray  #: [H, W, 3] sRGB values over black
    alpha: np.ndarray  #: [H, W]
    depth: np.ndarray  #: [H, W] expected depth along the optical axis, metres
    median_depth: np.ndarray | None  #: [H, W] where half of the light is gone, metres; None where not asked for
    visibility: np.ndarray | None  #: [H, W] of the Sun, blended over 0; None of a scene without shadows
    normal: np.ndarray | None  #: [H, W, 3] unit vectors in world axes; None where not asked for
    shares: np.ndarray  #: [H, W, models] of each in the alpha


class FieldScene(ABC):
    """Posed runs under one Sun, radiance fields among them; in scene files what
    `splat.compose.GaussianComposition` is to Gaussians.

    models: at least one
    config: how they shade each other, see `splat.compose.scene.ComposeConfig`
    """

    def __init__(self, models: Sequence[Any], config: Any, path: Path | None = None) -> None:
        self.models, self.config, self.path = tuple(models), config, path

    @property
    @abstractmethod
    def relightable(self) -> bool:
        """Whether the Sun's direction changes what is predicted."""

    @property
    def knows_earth(self) -> bool:
        """Whether the light of a Sun's Earth changes what is predicted."""
        return any(model.run.knows_earth for model in self.models)

    @property
    @abstractmethod
    def has_shadows(self) -> bool:
        """Whether there is anything that casts them: one model on another, or on itself."""

    @abstractmethod
    def _draw(
        self, camera: Camera, sun: Sun | None, normals: bool, median: bool, on_chunk: Callable[[], None] | None
    ) -> DrawnScene:
        """Without a look at what is asked for."""

    @property
    def backend(self) -> str:
        """The backend that renders now."""
        return backend.select()

    def stops(self, exposure: float | None) -> float:
        """0: colours are sRGB values. Raises InputError for an exposure."""
        if exposure is not None:
            model = f"a radiance field in {self.path or 'the scene'}"
            raise InputError(f"exposure: expected runs trained in linear light (light.linear) alone, found {model}")
        return 0.0

    def predict(
        self,
        camera: Camera,
        sun: Sun | None = None,
        normals: bool = False,
        exposure: float | None = None,
        on_chunk: Callable[[], None] | None = None,
    ) -> ComposedPrediction:
        """Render one view. on_chunk: see `nerf.draw.chunks`. Raises InputError where the Sun matters and none is given,
        and for an exposure."""
        self.stops(exposure)
        if sun is None and self.relightable:
            source = self.path or "scene"
            raise InputError(f"{source}: expected the Sun's direction for a scene that it changes, found none")
        check_picture(camera)
        drawn = self._draw(camera, sun, normals, False, on_chunk)
        visibility, alpha = drawn.visibility, drawn.alpha
        if visibility is not None:
            visibility = np.divide(visibility, alpha, out=np.zeros_like(alpha), where=alpha > 0)
        number = np.where(alpha >= COVERED, drawn.shares.argmax(axis=-1) + 1, 0).astype(np.int32)
        return ComposedPrediction(drawn.rgb, alpha, drawn.depth, visibility, drawn.normal, number)

    def draw_material(self, camera: Camera) -> MaterialView:
        """Raises InputError: a field of colours has none."""
        raise InputError(f"{self.path or 'scene'}: expected Gaussians alone, to read materials, found a radiance field")

    def surface_depth(self, camera: Camera) -> np.ndarray:
        """[H, W] float32: depth in metres along the optical axis at which half of the light is gone, 0 where it is
        not, whatever the Sun."""
        drawn = self._unshaded._draw(camera, Sun(np.array([0.0, 0.0, 1.0])), False, True, None)
        assert drawn.median_depth is not None
        return np.where(drawn.alpha >= COVERED, drawn.median_depth, np.float32(0))

    @cached_property
    def _unshaded(self) -> "FieldScene":
        return type(self)(self.models, replace(self.config, shadows="none"), self.path)
