"""The one training loop.

A step is five stages. Those of fixed shape (project, loss, update) are recorded once and replayed without tracing;
binning and blending, whose lists change length from step to step, stand between them.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad, recorded
from spacesim.data.errors import InputError, WorkError
from spacesim.data.records import Dataset
from spacesim.splat.gaussians import Gaussians
from spacesim.splat.light import LightModel, TrainingFrame
from spacesim.splat.project import Footprints, Pinhole, Splats, project
from spacesim.splat.rasterize import backward, forward
from spacesim.splat.render import view_colours
from spacesim.splat.tiles import bin_splats
from spacesim.splat.tone import decoded, encoded
from spacesim.splat.train.checkpoint import read_tensors, write_tensors
from spacesim.splat.train.config import TrainConfig
from spacesim.splat.train.initialise import farthest_camera, initial_gaussians, scene_scale, surface_normals
from spacesim.splat.train.losses import penalty, photometric_loss, visibility_loss
from spacesim.splat.train.optimizer import Adam, adam_step
from spacesim.splat.train.strategies.choose import strategy_of
from spacesim.splat.train.views import TrainingViews, View

HISTORY_EVERY = 50  #: iterations between two entries of the history
RECORDINGS = 64  #: of a stage that are kept: one for each size of picture and degree of harmonics


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
        self.config, self.iteration = config, 0
        self.views = TrainingViews(dataset, config.seed, config.light is not None, config.visibility_weight > 0)
        self.scene_scale = scene_scale(dataset)
        features = config.light.features if config.light else 0
        start = config.init_count, config.sh_degree, config.seed, features
        self.gaussians = initial_gaussians(dataset, config.init, *start)
        self.optimizer = Adam(self.gaussians.rows())
        self.light = self._initial_light(dataset)
        self.light_optimizer = Adam(self.light.weights if self.light else [])
        self.strategy = strategy_of(config, dataset, self.scene_scale, self.gaussians.count)
        self.history: list[dict[str, float]] = []
        self._project = recorded(_project, RECORDINGS)
        self._loss = recorded(_loss, RECORDINGS)
        self._update = recorded(_update, RECORDINGS)
        self._update_light = recorded(_update_light, RECORDINGS)

    def run(self, on_progress: Callable[[Progress], None], on_checkpoint: Callable[[], None]) -> None:
        """Train from `self.iteration` to the end."""
        config = self.config
        while self.iteration < config.iterations:
            loss = self.step()
            last = self.iteration == config.iterations
            if self.iteration % HISTORY_EVERY == 0 or last:
                self._note(float(loss[0]))
                on_progress(Progress(self.iteration, config.iterations, float(loss[0]), self.gaussians.count))
            if self.iteration % config.checkpoint_every == 0 and not last:
                on_checkpoint()

    def step(self) -> Any:
        """One update from one view or several, refinement if it is time. Returns the mean loss, Float of width 1."""
        config, index, count = self.config, self.iteration, self.config.views_per_step
        degree = min(config.sh_degree, index // config.sh_every)
        rows = self.gaussians.rows()
        looks = [self._look(rows, degree, index * count + i) for i in range(count)]
        self._move_gaussians(rows, degree, looks)
        if self.light:
            self._move_light(self.light, looks)

        self.iteration += 1
        self.strategy.disturb(self.iteration, self.gaussians, self.means_rate(index), config.seed)
        rng = np.random.default_rng([config.seed, 2, self.iteration])
        self.strategy.refine(self.iteration, self.gaussians, self.optimizer, rng)
        losses = [look.loss for look in looks]
        return losses[0] if count == 1 else sum(losses, ad.Float(0)) / count

    def _look(self, rows: list[Any], degree: int, number: int) -> "_Look":
        """Blend view `number` of the training, compare, and go back."""
        view = self.views.at_step(number)
        camera = Pinhole.of(view.camera)
        size = width, height = camera.width, camera.height
        splats, footprints, colour = self._project(rows, camera, degree, self.config.antialiased)
        shading = self.light.shade(self.gaussians, camera, view.sun) if self.light and view.sun is not None else None
        supervised = shading is not None and self.config.visibility_weight > 0
        if shading:
            colour = [*shading.colours, shading.visibility] if supervised else shading.colours
        lists = bin_splats(splats, footprints, width, height)
        blended = forward(splats, colour, lists, width, height, adjoint=True)
        rgba, valid, visibility = self.views.pixels(view)
        target = rgba, ad.Float(self.background(number, view)), valid, visibility
        linear = self.config.light is not None and self.config.light.linear
        how = self.config.ssim_weight, self.config.visibility_weight, linear
        loss, by_colour, by_transmittance = self._loss(blended.features, blended.transmittance, target, size, *how)
        watched = self.strategy.watches(self.iteration + 1)
        by_splat = backward(splats, blended, lists, size, by_colour, by_transmittance, absolute=watched)
        if watched:
            gradient = dr.sqrt(
                dr.square(by_splat.absolute_x * (0.5 * width)) + dr.square(by_splat.absolute_y * (0.5 * height))
            )
            radius = dr.maximum(footprints.half_width, footprints.half_height) / max(width, height)
            self.strategy.observe(gradient, radius, footprints.visible)
        if not shading or not self.light:
            return _Look(camera, by_splat.splats, by_splat.features, loss)
        of_visibility = by_splat.features[3] if supervised else None
        by_light = self.light.adjoint(shading, by_splat.features[:3], of_visibility)
        return _Look(camera, by_splat.splats, [], loss, by_light.features, by_light.geometry, by_light.weights)

    def _move_gaussians(self, rows: list[Any], degree: int, looks: list["_Look"]) -> None:
        moments = self.optimizer.first, self.optimizer.second
        factors = ad.Float([*self.optimizer.corrections(), *self.rates(self.iteration)])
        gradients = [(look.camera, look.by_splats, look.by_colour, look.by_features, look.by_rows) for look in looks]
        more = self._penalties(), self.config.antialiased
        rows, first, second = self._update(rows, moments, degree, gradients, factors, *more)
        self.gaussians = Gaussians.from_rows(rows)
        self.optimizer.first, self.optimizer.second = first, second

    def _penalties(self) -> dict[str, Any]:
        """{name: weight of each Gaussian's share} of the penalties on Gaussians that the configuration has."""
        config, count = self.config, self.gaussians.count
        of_lengths = {
            "isotropy": config.isotropy_weight,
            "scale": config.scale_weight,
            "flatten": config.flatten_weight,
        }
        weights = {name: weight / self.scene_scale for name, weight in of_lengths.items()}
        weights["opacity"] = config.opacity_weight
        return {name: ad.Float(weight / count) for name, weight in weights.items() if weight > 0}

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
            for order in ("first", "second"):
                moments = getattr(optimizer, order)
                tensors |= {f"{name}.{order}.{i:02d}": np.array(moment) for i, moment in enumerate(moments)}
        tensors |= {f"strategy.{name}": np.array(value) for name, value in self.strategy.state.items()}
        header = {"iteration": self.iteration, "adam_steps": self.optimizer.steps, "history": self.history}
        write_tensors(path, tensors, header)

    def model_tensors(self) -> dict[str, np.ndarray]:
        """The trained model by name: the Gaussians, and the networks where there are any."""
        return {**self.gaussians.to_numpy(), **(self.light.tensors() if self.light else {})}

    def restore(self, path: Path) -> None:
        """Continue from what `save` wrote. Raises InputError where the file does not fit."""
        tensors, header = read_tensors(path)
        try:
            gaussians = Gaussians.from_numpy(tensors)
            light = LightModel.from_tensors(self.config.light, tensors) if self.config.light else None
            optimizer, light_optimizer = Adam(gaussians.rows()), Adam(light.weights if light else [])
            _restore_moments(optimizer, tensors, "adam")
            _restore_moments(light_optimizer, tensors, "adam.light")
            state = {name: ad.Float(tensors[f"strategy.{name}"]) for name in self.strategy.state}
            iteration, steps, history = int(header["iteration"]), int(header["adam_steps"]), list(header["history"])
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(f"{path}: expected a checkpoint of training, found one that lacks {error}") from None
        if not {dr.width(row) for row in state.values()} <= {gaussians.count}:
            raise InputError(f"{path}: expected statistics of {gaussians.count} Gaussians, found others")
        if not 0 <= iteration <= self.config.iterations:
            raise InputError(f"{path}: expected an iteration up to {self.config.iterations}, found {iteration}")
        self.gaussians, self.light, self.strategy.state = gaussians, light, state
        self.optimizer, self.light_optimizer = optimizer, light_optimizer
        optimizer.steps = light_optimizer.steps = steps
        self.iteration, self.history = iteration, history

    def background(self, index: int, view: View) -> np.ndarray:
        """[3] float32: the colour that a step's picture and its truth are laid over; black below opaque pictures."""
        if view.opaque or not self.config.random_background:
            return np.zeros(3, np.float32)
        return np.random.default_rng([self.config.seed, 3, index]).uniform(size=3).astype(np.float32)

    def rates(self, index: int) -> Iterator[float]:
        """The step size of each row."""
        rates = self.config.rates
        yield from (
            [self.means_rate(index)] * 3 + [rates.log_scales] * 3 + [rates.quaternions] * 4 + [rates.logit_opacities]
        )
        if self.gaussians.features is not None:
            yield rates.features
        else:
            yield from [rates.sh_constant] * 3 + [rates.sh_rest] * (len(self.gaussians.sh) - 3)

    def means_rate(self, index: int) -> float:
        """Metres; falls exponentially over the whole training."""
        rates, done = self.config.rates, index / self.config.iterations
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
            features = self.gaussians.to_numpy()["features"]
            features[:, field.features : field.stored] = surface_normals(means)
            self.gaussians.features = ad.Float(np.ascontiguousarray(features.T).ravel())
        frame = TrainingFrame(centre, self.scene_scale, farthest_camera(dataset, centre), radius)
        return LightModel.initial(self.config.light, frame, self.config.seed)

    def _note(self, loss: float) -> None:
        if not np.isfinite(loss):
            raise WorkError(f"training: the loss is {loss} at iteration {self.iteration}; the last checkpoint is kept")
        self.history.append({"iteration": self.iteration, "loss": loss, "gaussians": self.gaussians.count})


@dataclass
class _Look:
    """What a step has learned from one view: gradients of its splats and of the colours (3 arrays [N]), or, of a method
    of light, of features [F * N] and weights, and of the first rows where shadows move the Gaussians."""

    camera: Pinhole
    by_splats: Splats
    by_colour: list[Any]
    loss: Any
    by_features: Any = None
    by_rows: list[Any] = field(default_factory=list)
    by_weights: Any = None


def _restore_moments(optimizer: Adam, tensors: Mapping[str, np.ndarray], name: str) -> None:
    """Put moments from a checkpoint in place of fresh ones. Raises KeyError, or ValueError for another size."""
    for order in ("first", "second"):
        moments = getattr(optimizer, order)
        for i, fresh in enumerate(moments):
            key = f"{name}.{order}.{i:02d}"
            if tensors[key].shape != (dr.width(fresh),):
                raise ValueError(f"{key}: expected {dr.width(fresh)} numbers, found {tensors[key].shape}")
            moments[i] = ad.Float(tensors[key])


def _project(
    rows: list[Any], camera: Pinhole, degree: int, antialiased: bool = False
) -> tuple[Splats, Footprints, list[Any]]:
    """Splats, footprints and colours (3 x [N], or none where they come from a field), without gradients."""
    gaussians = Gaussians.from_rows(rows)
    splats, footprints = project(gaussians, camera, antialiased)
    return splats, footprints, [] if gaussians.features is not None else list(view_colours(gaussians, camera, degree))


def _loss(
    planes: list[Any],
    transmittance: Any,
    target: tuple[Any, Any, Any, list[Any]],
    size: tuple[int, int],
    ssim_weight: float,
    visibility_weight: float = 0.0,
    linear: bool = False,
) -> tuple[Any, list[Any], Any]:
    """Loss of a picture over the target's background, and its gradients by its planes (colour, and visibility where it
    is supervised) and transmittance. linear: colours and background are blended in linear light."""
    rgba, background, valid, visibility = target
    channels = [ad.Float((rgba >> shift) & 0xFF) / 255 for shift in (0, 8, 16, 24)]
    below = ad.Array3f([dr.gather(ad.Float, background, ad.UInt32(c)) for c in range(3)])
    straight = ad.Array3f(channels[:3])
    if linear:
        straight, below = decoded(straight), decoded(below)
    truth = straight * channels[3] + (1 - channels[3]) * below
    planes, transmittance = [ad.Float(plane) for plane in planes], ad.Float(transmittance)
    dr.enable_grad(planes, transmittance)
    picture = dr.select(valid, ad.Array3f(planes[:3]) + transmittance * below, truth)
    if linear:
        picture, truth = encoded(picture), encoded(truth)
    loss = photometric_loss(picture, truth, *size, ssim_weight=ssim_weight)
    if visibility:
        loss += visibility_weight * visibility_loss(planes[3], visibility[0], valid)
    dr.backward(loss)
    return dr.detach(loss), [dr.grad(plane) for plane in planes], dr.grad(transmittance)


def _update(
    rows: list[Any],
    moments: tuple[list[Any], list[Any]],
    degree: int,
    gradients: list[tuple[Pinhole, Splats, list[Any], Any, list[Any]]],
    factors: Any,
    penalties: Mapping[str, Any],
    antialiased: bool = False,
) -> tuple[list[Any], list[Any], list[Any]]:
    """Gradients of the splats, and of the colours or features, in each view to the mean gradient of the parameters, and
    an Adam step.

    factors: Float [2 + R], Adam's two corrections and the step size of each row;  penalties: weights by name.
    """
    rows = [ad.Float(row) for row in rows]
    dr.enable_grad(rows)
    gaussians = Gaussians.from_rows(rows)
    along: Any = ad.Float(0)
    for camera, by_splat, by_colour, by_features, by_rows in gradients:
        splats, _ = project(gaussians, camera, antialiased)
        for name in ("opacity", "x", "y", "a", "b", "c"):
            along += getattr(splats, name) * getattr(by_splat, name)
        for row, gradient in zip(rows, by_rows, strict=False):
            along += row * gradient
        if by_features is None:
            for value, gradient in zip(view_colours(gaussians, camera, degree), by_colour, strict=True):
                along += value * gradient
    for name, weight in penalties.items():
        along += len(gradients) * weight * penalty(name, gaussians)
    dr.backward(along if len(gradients) == 1 else along / len(gradients))
    numbers = [dr.gather(ad.Float, factors, ad.UInt32(i)) for i in range(2 + len(rows))]
    by_row = [dr.grad(row) for row in rows]
    if gaussians.features is not None:
        by_row[-1] = _mean([by_features for *_, by_features, _ in gradients])
    return adam_step(dr.detach(rows), by_row, moments, numbers[2:], (numbers[0], numbers[1]))


def _update_light(
    weights: list[Any], moments: tuple[list[Any], list[Any]], gradients: list[list[Any]], factors: Any
) -> tuple[list[Any], list[Any], list[Any]]:
    """An Adam step of the networks by their mean gradient. factors: Float [3], two corrections and the step size."""
    numbers = [dr.gather(ad.Float, factors, ad.UInt32(i)) for i in range(3)]
    means = [_mean(list(of_views)) for of_views in zip(*gradients, strict=True)]
    return adam_step(weights, means, moments, [numbers[2]] * len(weights), (numbers[0], numbers[1]))


def _mean(values: list[Any]) -> Any:
    return values[0] if len(values) == 1 else sum(values[1:], values[0]) / len(values)
