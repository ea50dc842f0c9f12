"""The one training loop.

A step is five stages. Those of fixed shape (project, loss, update) are recorded once and replayed without tracing;
binning and blending, whose lists change length from step to step, stand between them.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad, recorded
from spacesim.data.errors import InputError, WorkError
from spacesim.data.records import Dataset
from spacesim.data.structure import Rules, structure
from spacesim.data.toml import Document
from spacesim.splat.light.bounce import ALBEDO
from spacesim.splat.light.model import LightModel, TrainingFrame
from spacesim.splat.raster.adjoint import SplatGradients
from spacesim.splat.raster.bin import RECORDINGS, bin_splats
from spacesim.splat.raster.blend import backward, forward
from spacesim.splat.raster.gaussians import Gaussians, uploaded
from spacesim.splat.raster.project import Footprints, Pinhole
from spacesim.splat.raster.supersample import finer
from spacesim.splat.train.checkpoint import CheckpointHeader, read_tensors, write_tensors
from spacesim.splat.train.config import TrainConfig
from spacesim.splat.train.optimizer import Adam, NetworkAdam
from spacesim.splat.train.prior import MeshPrior
from spacesim.splat.train.stages import LossConfig, Target, on_screen, picture_loss, project_views, update_light
from spacesim.splat.train.start import (
    farthest_camera,
    focus_point,
    initial_gaussians,
    nearest_camera,
    scene_scale,
    surface_normals,
)
from spacesim.splat.train.strategies.choose import strategy_of
from spacesim.splat.train.update import Update, ViewGradients
from spacesim.splat.train.views import TrainingViews, View
from spacesim.splat.train.warm_start import Attraction, WarmStart

HISTORY_EVERY = 50  #: iterations between two entries of the history


@dataclass(frozen=True)
class Progress:
    """What a training loop tells of itself now and then."""

    iteration: int
    iterations: int
    loss: float
    gaussians: int


class Trainer:
    """Gaussians, their optimizer and their strategy, and the networks of light where the method has some, one step
    after another.

    The same dataset, configuration and backend give bitwise the same model, also across `save` and `restore`.
    """

    def __init__(self, dataset: Dataset, config: TrainConfig) -> None:
        self.config, self.iteration, self.refinement_seconds = config, 0, 0.0
        self.views = _views(dataset, config)
        self.scene_scale = scene_scale(dataset)
        features = config.light.features if config.light else 0
        start = config.init_count, config.sh_degree, config.seed, features, config.init_box
        self.gaussians = initial_gaussians(dataset, config.init, *start)
        self.optimizer = Adam(self.gaussians.rows())
        self.light = self._initial_light(dataset)
        self.light_optimizer = NetworkAdam(self.light.weights if self.light else [])
        self.strategy = strategy_of(config, dataset, self.scene_scale, self.gaussians.count)
        self.warm_start: WarmStart | None = None
        if config.warm_start is not None:
            centre = focus_point(dataset)
            nearest = nearest_camera(dataset, centre)
            self.warm_start = WarmStart(config.warm_start, self.views, centre, nearest, self.gaussians.count)
            offsets = self.gaussians.to_numpy()["means"] - centre
            self._start_radius = float(np.linalg.norm(offsets, axis=1).max())
        self._terms = LossConfig(
            config.ssim_weight,
            config.visibility_weight,
            config.depth_weight,
            config.normal_weight,
            self.scene_scale,
            config.light.curve[0] if config.light and config.light.curve else None,
            config.supersample,
        )
        self.history: list[dict[str, float]] = []
        self._project = recorded(project_views, RECORDINGS)
        self._loss = recorded(picture_loss, RECORDINGS)
        self._update = Update(config.antialiased, self.scene_scale)
        self._on_screen = recorded(on_screen, RECORDINGS)
        self._update_light = recorded(update_light, RECORDINGS)

    def run(
        self,
        on_progress: Callable[[Progress], None],
        on_checkpoint: Callable[[], None],
        asked_to_stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """Train from `self.iteration` to the end. Raises KeyboardInterrupt after a step and its checkpoint where it is
        asked to stop, WorkError where the loss is not finite."""
        config = self.config
        while self.iteration < config.iterations:
            loss = self.step()
            last = self.iteration == config.iterations
            if self.iteration % HISTORY_EVERY == 0 or last:
                self._note(float(loss[0]))
                on_progress(Progress(self.iteration, config.iterations, float(loss[0]), self.gaussians.count))
            stop = asked_to_stop()
            if stop:
                self._check(float(loss[0]))
            if stop or (self.iteration % config.checkpoint_every == 0 and not last):
                on_checkpoint()
            if stop:
                raise KeyboardInterrupt

    def step(self) -> Any:
        """One update from one view or several, refinement if it is time. Returns the mean loss, Float of width 1."""
        config, index, count = self.config, self.iteration, self.config.views_per_step
        degree = min(config.sh_degree, index // config.sh_every)
        rows = self.gaussians.rows()
        looks = [self._look(rows, degree, index * count + i) for i in range(count)]
        del rows  # so that old ones go as new ones come
        self._move_gaussians(degree, looks)
        if self.light:
            self._move_light(self.light, looks)

        self.iteration += 1
        self.strategy.disturb(self.iteration, self.gaussians, self.means_rate(index), config.seed)
        self._refine()
        losses = [look.loss for look in looks]
        return losses[0] if count == 1 else sum(losses, ad.Float(0)) / count

    def _refine(self) -> None:
        """After a step: what the strategy does, or in the time of the warm start the rescue."""
        warm, done = self.warm_start, self.iteration
        if warm is not None and warm.active(done - 1):
            warm.after_step(done, self.gaussians, self.optimizer)
            return
        timed = done % self.config.refinement.refine_every == 0
        if timed:
            dr.sync_thread()  # what the steps before have left to compute is not refinement's
        start = time.perf_counter()
        rng = np.random.default_rng([self.config.seed, 2, done])
        leniency = 1.0 if warm is None else warm.config.leniency(done)
        self.strategy.refine(done, self.gaussians, self.optimizer, rng, leniency)
        if timed:
            dr.sync_thread()
            self.refinement_seconds += time.perf_counter() - start

    def _look(self, rows: list[Any], degree: int, number: int) -> "_Look":
        """Blend view `number` of the training, compare, and go back."""
        config, view, index = self.config, self.views.at_step(number), self.iteration
        camera = Pinhole.of(finer(view.camera, config.supersample))
        size = width, height = camera.width, camera.height
        splats, footprints, values = self._project(
            rows, camera, degree, config.antialiased, config.shape_terms, self.scene_scale
        )
        shading = self.light.shade(self.gaussians, camera, view.sun) if self.light and view.sun is not None else None
        if shading:
            values["colour"] = shading.colours
            if config.visibility_weight > 0:
                values["visibility"] = [shading.visibility]
        lists = bin_splats(splats, footprints, width, height, training=True)
        blended = forward(splats, [v for group in values.values() for v in group], lists, width, height, adjoint=True)
        channels = {name: len(group) for name, group in values.items()}
        del values  # all arrays go as soon as they have been read: memory is shortest here
        attraction = self._attraction(view)
        by_name = _named(blended.features, channels)
        target = self._target(number, view, attraction)
        picture = view.camera.width, view.camera.height
        loss, by_plane, by_transmittance = self._loss(by_name, blended.transmittance, target, picture, self._terms)
        watched = self.strategy.watches(index + 1) and not self._warming(index)
        by_planes = [plane for group in by_plane.values() for plane in group]
        by_splat = backward(splats, blended, lists, size, by_planes, by_transmittance, absolute=watched)
        del splats, lists, blended, by_name
        by_value = _named(by_splat.features, channels)
        if watched:
            self._observe(by_splat, footprints, size)
        by_rows = self._pull(rows, view, attraction) if attraction else []
        if not shading or not self.light:
            return _Look(ViewGradients(camera, by_splat.splats, by_value, by_rows=by_rows), loss)
        of_visibility = by_value.pop("visibility", [None])[0]
        by_light = self.light.adjoint(shading, by_value.pop("colour"), of_visibility)
        by_rows = _added(by_light.geometry, by_rows)
        gradients = ViewGradients(camera, by_splat.splats, by_value, by_light.features, by_rows)
        return _Look(gradients, loss, by_light.weights)

    def _observe(self, by_splat: SplatGradients, footprints: Footprints, size: tuple[int, int]) -> None:
        """Tell the strategy what refinement watches. size: the picture's, pixels"""
        sizes = ad.Float([0.5 * size[0], 0.5 * size[1], max(size)])
        absolute, half = (by_splat.absolute_x, by_splat.absolute_y), (footprints.half_width, footprints.half_height)
        gradient, radius = self._on_screen(absolute, half, sizes)
        self.strategy.observe(gradient, radius, footprints.visible)

    def _warming(self, index: int) -> bool:
        """Whether the warm start keeps refinement off in step number `index`, the first of which is 0."""
        return self.warm_start is not None and self.warm_start.active(index)

    def _attraction(self, view: View) -> Attraction | None:
        """What the warm start pulls with in this step, if it still does or counts who is in the picture."""
        warm, index = self.warm_start, self.iteration
        pulls = warm is not None and (warm.active(index) or warm.config.strength(index) > 0)
        return warm.attraction(view) if warm and pulls else None

    def _pull(self, rows: list[Any], view: View, attraction: Attraction) -> list[Any]:
        """What the warm start adds to the gradients of the rows."""
        assert self.warm_start is not None
        return self.warm_start.pull(rows, Pinhole.of(view.camera), attraction, self.iteration)

    def _target(self, number: int, view: View, attraction: Attraction | None) -> Target:
        rgba, valid, truth = self.views.pixels(view)
        if self.warm_start and attraction:
            truth = {
                **truth,
                "foreground": [attraction.mask, dr.opaque(ad.Float, self.warm_start.config.strength(self.iteration))],
            }
        return Target(rgba, ad.Float(self.background(number, view).tolist()), valid, truth)

    def _move_gaussians(self, degree: int, looks: list["_Look"]) -> None:
        factors = ad.Float([*self.optimizer.corrections(), *self.rates(self.iteration)])
        views = [look.taken() for look in looks]
        self._update(self.gaussians, self.optimizer, degree, views, factors, self._penalties())

    def _penalties(self) -> dict[str, Any]:
        """{name: weight of each Gaussian's share} of the penalties on Gaussians that the configuration has."""
        config, count, unit = self.config, self.gaussians.count, self.scene_scale
        weights = {
            "isotropy": config.isotropy_weight / unit,
            "scale": config.scale_weight / unit,
            "flatten": config.flatten_weight / unit,
            "opacity": config.opacity_weight,
        }
        return {name: dr.opaque(ad.Float, weight / count) for name, weight in weights.items() if weight > 0}

    def _move_light(self, light: LightModel, looks: list["_Look"]) -> None:
        optimizer, rates, done = self.light_optimizer, self.config.rates, self.iteration / self.config.iterations
        rate = rates.networks ** (1 - done) * rates.networks_final**done
        factors = ad.Float([*optimizer.corrections(), rate])
        gradients = [look.by_weights for look in looks]
        moments = optimizer.first, optimizer.second
        light.weights, optimizer.first, optimizer.second = self._update_light(
            light.weights, moments, gradients, factors
        )

    def save(self, path: Path) -> None:
        """Write everything that the next step depends on."""
        tensors = self.model_tensors()
        for name, optimizer in (("adam", self.optimizer), ("adam.light", self.light_optimizer)):
            for order, moments in zip(("first", "second"), optimizer.moments(), strict=True):
                tensors |= {f"{name}.{order}.{i:02d}": moment for i, moment in enumerate(moments)}
        tensors |= {f"strategy.{name}": np.array(value) for name, value in self.strategy.state.items()}
        if self.warm_start and self._warming(self.iteration):
            tensors |= {f"warm_start.{name}": np.array(value) for name, value in self.warm_start.state.items()}
        header = {"iteration": self.iteration, "adam_steps": self.optimizer.steps, "history": self.history}
        write_tensors(path, tensors, header)

    def model_tensors(self) -> dict[str, np.ndarray]:
        """The trained model by name: the Gaussians, and the networks where there are any."""
        return {**self.gaussians.to_numpy(), **(self.light.tensors() if self.light else {})}

    def restore(self, path: Path) -> None:
        """Continue from what `save` wrote. Raises InputError where the file does not fit."""
        tensors, header = read_tensors(path)
        told = structure(CheckpointHeader, Document(f"{path}: header", header, {}), Rules())
        if told.iteration > self.config.iterations:
            raise InputError(f"{path}: expected an iteration up to {self.config.iterations}, found {told.iteration}")
        try:
            gaussians = Gaussians.from_numpy(tensors)
            if gaussians.count == 0:
                raise ValueError("Gaussians")
            light = LightModel.from_tensors(self.config.light, tensors) if self.config.light else None
            optimizer, light_optimizer = Adam(gaussians.rows()), NetworkAdam(light.weights if light else [])
            _restore_moments(optimizer, tensors, "adam")
            _restore_moments(light_optimizer, tensors, "adam.light")
            state = _restored_state(self.strategy.state, tensors, "strategy", gaussians.count)
            warming = self.warm_start is not None and self._warming(told.iteration)
            names = self.warm_start.state if self.warm_start and warming else {}
            warm = _restored_state(names, tensors, "warm_start", gaussians.count)
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(f"{path}: expected a checkpoint of training, found one that lacks {error}") from None
        looks, expected = ((g.sh_degree, g.feature_count) for g in (gaussians, self.gaussians))
        if looks != expected:
            raise InputError(f"{path}: expected Gaussians with the colours of this method, found others")
        self.gaussians, self.light, self.strategy.state = gaussians, light, state
        self.optimizer, self.light_optimizer = optimizer, light_optimizer
        optimizer.steps = light_optimizer.steps = told.adam_steps
        self.iteration, self.history = told.iteration, [asdict(entry) for entry in told.history]
        if self.warm_start and warm:
            self.warm_start.state = warm

    def background(self, index: int, view: View) -> np.ndarray:
        """[3] float32: the colour that a step's picture and its truth are laid over; black below opaque pictures."""
        if view.opaque or not self.config.random_background:
            return np.zeros(3, np.float32)
        return np.random.default_rng([self.config.seed, 3, index]).uniform(size=3).astype(np.float32)

    def rates(self, index: int) -> Iterator[float]:
        """The step size of each row."""
        rates, means = self.config.rates, self.means_rate(index)
        if self.config.warm_start is not None:
            means = self.config.warm_start.means_rate(index, means, self._start_radius)
        yield from ([means] * 3 + [rates.log_scales] * 3 + [rates.quaternions] * 4 + [rates.logit_opacities])
        if self.gaussians.features is not None:
            yield rates.features
        else:
            yield from [rates.sh_constant] * 3 + [rates.sh_rest] * (len(self.gaussians.sh) - 3)

    def means_rate(self, index: int) -> float:
        """Metres; falls exponentially over the whole training, or over what follows the warm start."""
        rates, waits = self.config.rates, self.config.warm_start.steps if self.config.warm_start else 0
        done = max(index - waits, 0) / max(self.config.iterations - waits, 1)
        return float(self.scene_scale * rates.means ** (1 - done) * rates.means_final**done)

    def _initial_light(self, dataset: Dataset) -> LightModel | None:
        """Networks in the frame of the Gaussians that training starts from."""
        if self.config.light is None:
            return None
        means = self.gaussians.to_numpy()["means"].astype(np.float64)
        centre = means.mean(axis=0)
        radius = max(float(np.linalg.norm(means - centre, axis=1).max()), 1e-6)
        field = self.config.light.field
        if field.surface:
            features, light = self.gaussians.to_numpy()["features"], self.config.light
            features[:, field.features : field.stored] = surface_normals(means)
            features[:, light.albedos :] = ALBEDO
            self.gaussians.features = uploaded(features.T.ravel())
        frame = TrainingFrame(centre, self.scene_scale, farthest_camera(dataset, centre), radius)
        return LightModel.initial(self.config.light, frame, self.config.seed)

    def _check(self, loss: float) -> None:
        if not np.isfinite(loss):
            raise WorkError(f"training: the loss is {loss} at iteration {self.iteration}; the last checkpoint is kept")

    def _note(self, loss: float) -> None:
        self._check(loss)
        self.history.append({"iteration": self.iteration, "loss": loss, "gaussians": self.gaussians.count})


@dataclass
class _Look:
    """What a step has learned from one view: for the Gaussians, and for the weights of networks."""

    gradients: ViewGradients | None
    loss: Any
    by_weights: Any = None

    def taken(self) -> ViewGradients:
        """The gradients, which are not held any longer."""
        assert self.gradients is not None
        gradients, self.gradients = self.gradients, None
        return gradients


def _named(values: list[Any], counts: dict[str, int]) -> dict[str, list[Any]]:
    """So many of the values, one after another, under each name."""
    rest = iter(values)
    return {name: [next(rest) for _ in range(count)] for name, count in counts.items()}


def _added(one: list[Any], other: list[Any]) -> list[Any]:
    """Rows added up, those that only one has as they are."""
    longer, shorter = (one, other) if len(one) >= len(other) else (other, one)
    return [row + more for row, more in zip(longer, shorter, strict=False)] + longer[len(shorter) :]


def _views(dataset: Dataset, config: TrainConfig) -> TrainingViews:
    """The training pictures with the truth that the loss asks for."""
    truth = config.shape_terms + (("visibility",) if config.visibility_weight > 0 else ())
    prior = MeshPrior.of(dataset) if config.shape_terms and config.prior == "mesh" else None
    return TrainingViews(dataset, config.seed, config.light is not None, truth, prior)


def _restored_state(names: Iterable[str], tensors: Mapping[str, np.ndarray], owner: str, count: int) -> dict[str, Any]:
    """{name: Float [count]} of a checkpoint's statistics. Raises KeyError, or ValueError for another size."""
    found = {name: tensors[f"{owner}.{name}"] for name in names}
    for name, values in found.items():
        if values.shape != (count,):
            raise ValueError(f"{owner}.{name}: expected {count} numbers, found {values.shape}")
    return {name: uploaded(values) for name, values in found.items()}


def _restore_moments(optimizer: Adam | NetworkAdam, tensors: Mapping[str, np.ndarray], name: str) -> None:
    """Put moments from a checkpoint in place of fresh ones. Raises KeyError, or ValueError for another size."""
    found: list[list[np.ndarray]] = []
    for order, moments in zip(("first", "second"), optimizer.moments(), strict=True):
        found.append([tensors[f"{name}.{order}.{i:02d}"] for i in range(len(moments))])
        for i, (fresh, stored) in enumerate(zip(moments, found[-1], strict=True)):
            if stored.shape != fresh.shape:
                raise ValueError(f"{name}.{order}.{i:02d}: expected {len(fresh)} numbers, found {stored.shape}")
    optimizer.put(*found)
