"""A composed scene in the place of a run (tables 4.6 and 4.7)."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from spacesim.backend.arrays import Bool
from spacesim.data.files import JsonDict
from spacesim.data.records import Camera, Sun
from spacesim.splat.compose.scene import ComposedPrediction, Composition
from spacesim.splat.compose.scenefile import load_scene
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.run import Predictor, load_run


@dataclass(frozen=True, eq=False)
class PlacedPart:
    """Model number `index` of a composition, see `Part`."""

    composition: Composition
    index: int

    @property
    def name(self) -> str:
        """As the scene calls it."""
        return self.composition.models[self.index].name

    @property
    def centre(self) -> np.ndarray:
        """[3] metres, world: the middle of its Gaussians."""
        return self.composition.places[self.index]

    @property
    def gaussians(self) -> Gaussians:
        """Its Gaussians where they stand, colours left out."""
        return self.composition.alone(self.index)

    @property
    def antialiased(self) -> bool:
        """Whether it is drawn with the anti-aliasing filter."""
        return self.composition.models[self.index].run.antialiased


@dataclass(frozen=True, eq=False)
class ComposedRun:
    """Models that were trained apart, evaluated as one."""

    composition: Composition
    path: Path  #: the scene file's
    training: JsonDict = field(default_factory=dict)  #: nothing, as no training has seen the scene

    @property
    def parts(self) -> tuple[PlacedPart, ...]:
        """The models in their order, which is that of the dataset's objects."""
        return tuple(PlacedPart(self.composition, index) for index in range(len(self.composition.models)))

    @property
    def gaussian_count(self) -> int:
        """Of all models."""
        return self.composition.gaussian_count

    @property
    def model_bytes(self) -> int:
        """Of the models' files, each counted once."""
        return self.composition.model_bytes

    @property
    def backend(self) -> str:
        """The backend that renders now."""
        return self.composition.backend

    @property
    def relightable(self) -> bool:
        """Whether the Sun's direction changes what is predicted."""
        return self.composition.relightable

    @property
    def gaussians(self) -> Gaussians:
        """All models' Gaussians where they stand, colours left out."""
        return self.composition.in_world()

    @property
    def antialiased(self) -> Bool | bool:
        """Whether they are drawn with the anti-aliasing filter: one for all, or of each."""
        return self.composition.antialiased

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

    def predict(
        self, camera: Camera, sun: Sun | None = None, normals: bool = False, exposure: float | None = None
    ) -> ComposedPrediction:
        """See `Composition.predict`."""
        return self.composition.predict(camera, sun, normals, exposure)


def load_predictor(path: Path) -> Predictor:
    """The run in a folder, or the scene of a TOML file at its beginning. Raises InputError where there is neither."""
    if path.suffix != ".toml":
        return load_run(path)
    return ComposedRun(load_scene(path).posed_at(0.0), path)
