"""All that is learned of training pictures beside the model: one object for the loop, which does nothing without."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from spacesim.backend.arrays import Float
from spacesim.data.records import Dataset
from spacesim.data.store import intrinsics_of
from spacesim.splat.raster.adjoint import SplatGradients
from spacesim.splat.train.config import TrainConfig
from spacesim.splat.train.pictures.exposure import Exposures
from spacesim.splat.train.pictures.poses import PoseRefinement
from spacesim.splat.train.view_pass import RenderedView, ViewLoss
from spacesim.splat.train.views import TrainingView


class LearnedPictures:
    """poses, exposures: of the training pictures, None where the configuration does not ask for them"""

    def __init__(self, dataset: Dataset, config: TrainConfig) -> None:
        rates, steps = config.rates, config.iterations
        self.frames = dataset.train
        self.poses: PoseRefinement | None = None
        if config.refine_poses:
            known = config.init in ("points", "mesh") or bool(dataset.ply_file_path or dataset.mesh_path)
            anchor = known and config.init != "random" and config.warm_start is None
            how = rates.poses, steps, config.antialiased, anchor, config.views_per_step
            self.poses = PoseRefinement(dataset, *how)
        self.exposures = Exposures(len(dataset.train), rates.gains, steps) if config.exposure_per_picture else None

    def shown(self, view: TrainingView) -> TrainingView:
        """A view from where its camera is thought to stand."""
        return replace(view, camera=self.poses.camera(view.index)) if self.poses else view

    def gains(self, view: TrainingView) -> Float | None:
        """Float [3] that the colours of a view are multiplied by."""
        return self.exposures.gains(view.index) if self.exposures else None

    def learn(
        self,
        step: int,
        view: TrainingView,
        rows: list[Float],
        drawn: RenderedView,
        loss: ViewLoss,
        grad_splats: SplatGradients,
        scale: float,
    ) -> None:
        """What a view has taught in a step. rows: of the Gaussians that were drawn;  scale: metres, unit of depth"""
        if self.poses:
            grad_depth = [gradient / scale for gradient in drawn.group(grad_splats.features, "depth")]
            self.poses.learn(view.index, step, rows, drawn.camera, grad_splats.splats, grad_depth)
        if self.exposures and loss.grad_gains is not None:
            self.exposures.learn(view.index, step, loss.grad_gains)

    def model_stays(self, step: int) -> bool:
        """Whether the Gaussians' centres wait in a step, the first of which is 0, while cameras find their places."""
        return self.poses is not None and step < self.poses.anchored

    def hold(self, steps: int) -> None:
        """After so many steps: what pictures cannot tell stays as it is given."""
        for learned in self._learned().values():
            learned.hold(steps)

    def tensors(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        numbers = {name: learned.numbers for name, learned in self._learned().items()}
        tensors = {key: array for name, one in numbers.items() for key, array in one.tensors(name).items()}
        return tensors | ({"pictures.poses.common": self.poses.common} if self.poses else {})

    def restore(self, tensors: Mapping[str, np.ndarray]) -> None:
        """The inverse of `tensors`. Raises KeyError, or ValueError for another number of pictures."""
        for name, learned in self._learned().items():
            learned.numbers.restore(name, tensors)
        if self.poses:
            self.poses.common = np.array(tensors["pictures.poses.common"], np.float64)

    def cameras(self) -> dict[str, Any] | None:
        """For RUN/cameras.json: the training pictures' cameras and gains, in the form of transforms.json; None where
        none were learned."""
        if not self._learned():
            return None
        gains = self.exposures.all_gains() if self.exposures else None
        frames: list[dict[str, Any]] = []
        for picture, frame in enumerate(self.frames):
            camera = self.poses.camera(picture) if self.poses else frame.camera
            frames.append({"file_path": frame.file_path, "transform_matrix": camera.opengl.tolist()})
            frames[-1] |= intrinsics_of(camera)
            if gains is not None:
                frames[-1]["gain"] = gains[picture].tolist()
        return {"camera_model": "PINHOLE", "frames": frames}

    def summary(self) -> dict[str, dict[str, float]]:
        """For training.json: medians of how far poses moved, and the range of gains."""
        told = {}
        if self.poses:
            degrees, share = np.median(self.poses.moves(), axis=0).tolist()
            told["poses"] = {"degrees": degrees, "share_of_distance": share}
        if self.exposures:
            gains = self.exposures.all_gains().mean(axis=1)
            told["gains"] = {"least": float(gains.min()), "most": float(gains.max())}
        return told

    def sentences(self) -> list[str]:
        """What the log says at the end."""
        told, sentences = self.summary(), []
        if "poses" in told:
            degrees, share = told["poses"].values()
            sentences.append(f"poses moved by {degrees:.2g} degrees, {100 * share:.2g} % of the distance (median)")
        if "gains" in told:
            least, most = told["gains"].values()
            sentences.append(f"pictures' gains are from {least:.2f} to {most:.2f}")
        return sentences

    def _learned(self) -> dict[str, PoseRefinement | Exposures]:
        both = {"pictures.poses": self.poses, "pictures.exposures": self.exposures}
        return {name: learned for name, learned in both.items() if learned is not None}
