"""A composed scene in the place of a run (tables 4.6 and 4.7): of Gaussians, or of whatever has the words of their
`GaussianComposition` (radiance fields, both)."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from spacesim.backend.arrays import Bool
from spacesim.data.errors import InputError
from spacesim.data.files import JsonDict
from spacesim.data.records import Camera, Sun
from spacesim.learning.prediction import MaterialView
from spacesim.splat.compose.scene import ComposedPrediction, GaussianComposition
from spacesim.splat.raster.gaussians import Gaussians


@dataclass(frozen=True, eq=False)
class PlacedModel:
    """Model number `index` of a composition, see `ComposedModel`."""

    composition: Any  #: see `ComposedRun`
    index: int

    @property
    def name(self) -> str:
        """As the scene calls it."""
        return str(self.composition.models[self.index].name)

    @property
    def centre(self) -> np.ndarray:
        """[3] metres, world: the middle of its Gaussians, or of its box."""
        return np.asarray(self.composition.places[self.index])

    @property
    def gaussians(self) -> Gaussians | None:
        """Its Gaussians where they stand, colours left out; None of a radiance field."""
        placed = self.composition.models[self.index]
        return GaussianComposition([placed]).in_world() if placed.run.gaussians is not None else None

    @property
    def antialiased(self) -> bool:
        """Whether it is drawn with the anti-aliasing filter."""
        return bool(self.composition.models[self.index].run.antialiased)

    @property
    def sphere(self) -> tuple[np.ndarray, float]:
        """(centre [3], radius) metres, world: around a radiance field."""
        centre, radius = self._alone.spheres[0]
        return np.asarray(centre), float(radius)

    def surface_depth(self, camera: Camera) -> np.ndarray:
        """[H, W] of a radiance field where it stands, see `NerfRun.surface_depth`."""
        return np.asarray(self._alone.surface_depth(camera))

    @cached_property
    def _alone(self) -> Any:
        composition = self.composition
        return composition.field_alone(self.index)


@dataclass(frozen=True, eq=False)
class ComposedRun:
    """Models that were trained apart, evaluated as one."""

    composition: Any  #: a `GaussianComposition`, or what has its words
    path: Path  #: the scene file's
    training: JsonDict = field(default_factory=dict)  #: nothing, as no training has seen the scene

    @property
    def parts(self) -> tuple[PlacedModel, ...]:
        """The models in their order, which is that of the dataset's objects."""
        return tuple(PlacedModel(self.composition, index) for index in range(len(self.composition.models)))

    @property
    def gaussian_count(self) -> int | None:
        """Of all models; None where all are radiance fields."""
        count: int | None = self.composition.gaussian_count
        return count

    @property
    def model_bytes(self) -> int:
        """Of the models' files, each counted once."""
        return int(self.composition.model_bytes)

    @property
    def backend(self) -> str:
        """The backend that renders now."""
        return str(self.composition.backend)

    @property
    def relightable(self) -> bool:
        """Whether the Sun's direction changes what is predicted."""
        return bool(self.composition.relightable)

    @property
    def knows_earth(self) -> bool:
        """Whether the light of a Sun's Earth changes what is predicted."""
        return bool(self.composition.knows_earth)

    @property
    def has_shadows(self) -> bool:
        """Whether there is anything that casts them: one model on another, or on itself."""
        return bool(self.composition.has_shadows)

    @property
    def gaussians(self) -> Gaussians | None:
        """All models' Gaussians where they stand, colours left out; None where some are none."""
        return self.composition.in_world() if isinstance(self.composition, GaussianComposition) else None

    @property
    def antialiased(self) -> Bool | bool:
        """Whether they are drawn with the anti-aliasing filter: one for all, or of each."""
        return self.composition.antialiased if isinstance(self.composition, GaussianComposition) else False

    @property
    def sphere(self) -> tuple[np.ndarray, float]:
        """(centre [3], radius) metres, world: around a scene with radiance fields."""
        spheres = self.composition.spheres
        low = np.min([centre - radius for centre, radius in spheres], axis=0)
        high = np.max([centre + radius for centre, radius in spheres], axis=0)
        return 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))

    def surface_depth(self, camera: Camera) -> np.ndarray:
        """[H, W] float32 of a scene with radiance fields: depth in metres along the optical axis at which half of the
        light is gone, 0 where it is not."""
        return np.asarray(self.composition.surface_depth(camera))

    @cached_property
    def config(self) -> JsonDict:
        """The methods, the shadows between models, and each model's run and pose."""
        models = self.composition.models
        methods = list(dict.fromkeys(str(model.run.config.get("method")) for model in models))
        return {
            "method": " and ".join(methods),
            "shadows": self.composition.config.shadows,
            "models": {
                model.name: {
                    "run": str(model.run.path),
                    "method": model.run.config.get("method"),
                    "position": model.pose.translation.tolist(),
                    "rotation_wxyz": model.pose.quaternion.tolist(),
                    "scale": model.pose.scale,
                }
                for model in models
            },
        }

    @property
    def gaussian_run(self) -> None:
        """None: it has several."""

    def with_embedding(self, embedding: np.ndarray) -> "ComposedRun":
        """Raises InputError: each of its models has its own."""
        raise InputError(f"embedding: expected a run, found {self.path}, a scene")

    def predict(
        self, camera: Camera, sun: Sun | None = None, normals: bool = False, exposure: float | None = None
    ) -> ComposedPrediction:
        """See `GaussianComposition.predict`."""
        prediction: ComposedPrediction = self.composition.predict(camera, sun, normals, exposure)
        return prediction

    def draw_material(self, camera: Camera) -> MaterialView:
        """See `GaussianComposition.draw_material`."""
        view: MaterialView = self.composition.draw_material(camera)
        return view
