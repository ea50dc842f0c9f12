"""All that is learned of training pictures beside the model: one object for the loop, which does nothing without."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from spacesim.backend.arrays import Float
from spacesim.backend.upload import upload_numbers
from spacesim.data.files import JsonValue
from spacesim.data.geometry import Array
from spacesim.data.records import Dataset
from spacesim.data.store import intrinsics_of
from spacesim.splat.light.model import LightModel
from spacesim.splat.raster.adjoint import SplatGradients
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.train.config import TrainConfig
from spacesim.splat.train.pictures.exposure import Exposures, known_gains
from spacesim.splat.train.pictures.poses import PoseRefinement
from spacesim.splat.train.pictures.suns import FirstSuns, SunEstimation
from spacesim.splat.train.start import starts_on_surface
from spacesim.splat.train.view_pass import RenderedView, ViewLoss
from spacesim.splat.train.views import TrainingView, TrainingViews


class LearnedPictures:
    """poses, exposures, suns: of the training pictures, None where the configuration does not ask for them"""

    def __init__(
        self, dataset: Dataset, config: TrainConfig, first_suns: FirstSuns | None = None, poses: Array | None = None
    ) -> None:
        """first_suns: where Suns start that are unknown;  poses: [V, 6] numbers of `PoseRefinement` that stay, where
        poses are refined; none are learned"""
        rates, steps = config.rates, config.iterations
        self.frames = dataset.train
        self.poses: PoseRefinement | None = None
        if config.refine_poses:
            anchor = starts_on_surface(dataset, config.init, config.warm_start is not None)
            self.poses = PoseRefinement(
                dataset,
                rate=rates.poses,
                iterations=steps,
                antialiased=config.antialiased,
                anchor=anchor,
                views=config.views_per_step,
            )
            if poses is not None:
                self.poses.stay(poses)
        gains = known_gains(dataset, config.light)
        self.exposures = Exposures(gains, rates.gains, steps) if config.exposure_per_picture else None
        self._known_gains = gains if (gains != 1).any() else None
        self.suns, self._antialiased = None, config.antialiased
        if config.sun == "unknown":
            assert first_suns is not None, "Suns that are unknown start somewhere"
            learns_poses = config.refine_poses and poses is None  # of all pictures
            self.suns = SunEstimation(dataset, first_suns, rates.suns, steps, holds_out=not learns_poses)

    def shown(self, view: TrainingView) -> TrainingView:
        """A view from where its camera is thought to stand, under the Sun that is thought to shine."""
        if self.suns:
            view = replace(view, sun=self.suns.direction(view.index))
        return replace(view, camera=self.poses.camera(view.index)) if self.poses else view

    def taught(self, views: TrainingViews, number: int, step: int) -> TrainingView:
        """The view that is drawn as `number` of the training in a step, in place of one that is held out the next."""
        view = views.at_step(number)
        held_out = self.suns is not None and self.suns.waits(view.index, step)
        return views[(view.index + 1) % len(views)] if held_out else view

    def gains(self, view: TrainingView) -> Float | None:
        """Float [3] that the colours of a view are multiplied by."""
        if self.exposures:
            return self.exposures.gains(view.index)
        return None if self._known_gains is None else upload_numbers([float(self._known_gains[view.index])] * 3)

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

    def learn_sun(self, step: int, view: TrainingView, gradient: Float | None) -> None:
        """gradient: Float [3] by the direction of the view's Sun, of Suns that are unknown"""
        if self.suns and gradient is not None:
            self.suns.learn(view.index, step, gradient)

    def find_suns(self, steps: int, gaussians: Gaussians, light: LightModel) -> None:
        """After so many steps: look for better Suns of all pictures, if it is time to."""
        if self.suns:
            self.suns.search(steps, gaussians, light, self._antialiased)

    def model_stays(self, step: int) -> bool:
        """Whether the Gaussians' centres wait in a step, the first of which is 0, while cameras find their places."""
        return self.poses is not None and step < self.poses.anchored

    def hold(self, steps: int) -> None:
        """After so many steps: what pictures do not determine stays as it is given."""
        if self.poses:
            self.poses.hold(steps)
        if self.exposures:
            self.exposures.hold(steps)

    def tensors(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        numbers = {name: learned.numbers for name, learned in self._learned().items()}
        tensors = {key: array for name, one in numbers.items() for key, array in one.tensors(name).items()}
        tensors |= {"pictures.poses.common": self.poses.common} if self.poses else {}
        return tensors | (self.suns.tensors() if self.suns else {})

    def restore(self, tensors: Mapping[str, np.ndarray]) -> None:
        """The inverse of `tensors`. Raises KeyError, or ValueError for another number of pictures."""
        for name, learned in self._learned().items():
            learned.numbers.restore(name, tensors)
        if self.poses:
            self.poses.common = np.array(tensors["pictures.poses.common"], np.float64)
        if self.suns:
            self.suns.restore(tensors)

    def cameras(self) -> dict[str, JsonValue] | None:
        """For RUN/cameras.json: the training pictures' cameras and gains, in the form of transforms.json; None where
        none were learned."""
        if not self._learned():
            return None
        gains = self.exposures.all_gains() if self.exposures else None
        suns = self.suns.described() if self.suns else None
        frames: list[dict[str, JsonValue]] = []
        for picture, frame in enumerate(self.frames):
            camera = self.poses.camera(picture) if self.poses else frame.camera
            frames.append({"file_path": frame.file_path, "transform_matrix": camera.opengl.tolist()})
            frames[-1] |= intrinsics_of(camera)
            if gains is not None:
                frames[-1]["gain"] = gains[picture].tolist()
            if suns is not None:
                frames[-1] |= suns[picture]
        return {"camera_model": "PINHOLE", "frames": frames}

    def summary(self) -> dict[str, dict[str, float]]:
        """For training.json: medians of how far poses moved, the range of gains, how sure Suns are."""
        summary: dict[str, dict[str, float]] = {}
        if self.poses:
            degrees, share = np.median(self.poses.moves(), axis=0).tolist()
            summary["poses"] = {"degrees": degrees, "share_of_distance": share}
        if self.exposures:
            gains = self.exposures.all_gains().mean(axis=1)
            summary["gains"] = {"least": float(gains.min()), "most": float(gains.max())}
        if self.suns:
            summary["suns"] = {"sigma_deg": float(np.median(self.suns.told()))}
        return summary

    def sentences(self) -> list[str]:
        """What the log says at the end."""
        summary, sentences = self.summary(), []
        if "poses" in summary:
            degrees, share = summary["poses"].values()
            sentences.append(f"poses moved by {degrees:.2g} degrees, {100 * share:.2g} % of the distance (median)")
        if "gains" in summary:
            least, most = summary["gains"].values()
            sentences.append(f"pictures' gains are from {least:.2f} to {most:.2f}")
        if self.suns and self.suns.held_out:
            sentences.append(self.suns.sentence())
        return sentences

    def _learned(self) -> dict[str, PoseRefinement | Exposures | SunEstimation]:
        every = {"pictures.poses": self.poses, "pictures.exposures": self.exposures, "pictures.suns": self.suns}
        return {name: learned for name, learned in every.items() if learned is not None}
