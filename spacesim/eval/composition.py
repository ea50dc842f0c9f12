"""A composed scene in the place of a run: what judging asks of one (tables 4.6 and 4.7)."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spacesim.data.records import Camera, Sun

if TYPE_CHECKING:
    from spacesim.splat.compose import ComposedPrediction, Composition
    from spacesim.splat.raster.gaussians import Gaussians


@dataclass(frozen=True, eq=False)
class ComposedRun:
    """Models that were trained apart, judged as one. path: the scene file's;  training: nothing, as no training has
    seen the scene"""

    composition: "Composition"
    path: Path
    training: dict[str, Any] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """Of the models, in their order, which is that of the dataset's objects."""
        return [model.name for model in self.composition.models]

    @property
    def places(self) -> list[np.ndarray]:
        """Where the middle of each model is, [3] metres."""
        return self.composition.places

    @property
    def gaussians(self) -> int:
        """Of all models."""
        return self.composition.gaussians

    @property
    def bytes(self) -> int:
        """Of the models' files, each counted once."""
        return self.composition.bytes

    @property
    def backend(self) -> str:
        """The backend that renders now."""
        return self.composition.backend

    @property
    def relightable(self) -> bool:
        """Whether the Sun's direction changes what is predicted."""
        return self.composition.relightable

    @property
    def model(self) -> "Gaussians":
        """All models' Gaussians where they stand, colours left out."""
        return self.composition.in_world()

    @property
    def antialiased(self) -> Any:
        """Whether they are drawn with the anti-aliasing filter: one for all, or of each."""
        return self.composition.antialiased

    @cached_property
    def config(self) -> dict[str, Any]:
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

    def predict(self, camera: Camera, sun: Sun | None = None, normals: bool = False) -> "ComposedPrediction":
        """Render one view of the scene under a Sun."""
        return self.composition.predict(camera, sun, normals)
