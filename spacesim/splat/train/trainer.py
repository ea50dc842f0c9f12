"""The one training loop.

A step is five stages. Those of fixed shape (project, loss, update) are recorded once and replayed without tracing;
binning and blending, whose lists change length from step to step, stand between them.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad, recorded
from spacesim.data.errors import InputError, WorkError
from spacesim.data.records import Dataset
from spacesim.splat.gaussians import Gaussians
from spacesim.splat.project import Footprints, Pinhole, Splats, project
from spacesim.splat.rasterize import SplatGradients, backward, forward
from spacesim.splat.render import view_colours
from spacesim.splat.tiles import bin_splats
from spacesim.splat.train.checkpoint import read_tensors, write_tensors
from spacesim.splat.train.config import TrainConfig
from spacesim.splat.train.initialise import initial_gaussians, scene_scale
from spacesim.splat.train.losses import photometric_loss
from spacesim.splat.train.optimizer import Adam, adam_step
from spacesim.splat.train.strategies.default import DefaultStrategy
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
    """Gaussians, their optimizer and their strategy, one step after another.

    The same dataset, configuration and backend give bitwise the same model, also across `save` and `restore`.
    """

    def __init__(self, dataset: Dataset, config: TrainConfig) -> None:
        self.config, self.iteration = config, 0
        self.views = TrainingViews(dataset, config.seed)
        self.scene_scale = scene_scale(dataset)
        count, degree = config.init_count, config.sh_degree
        self.gaussians = initial_gaussians(dataset, config.init, count, degree, config.seed)
        self.optimizer = Adam(self.gaussians.rows())
        self.strategy = DefaultStrategy(config.refinement, self.scene_scale, self.gaussians.count)
        self.history: list[dict[str, float]] = []
        self._project = recorded(_project, RECORDINGS)
        self._loss = recorded(_loss, RECORDINGS)
        self._update = recorded(_update, RECORDINGS)

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
        moments = self.optimizer.first, self.optimizer.second
        factors = ad.Float([*self.optimizer.corrections(), *self.rates(index)])
        gradients = [(camera, by_splat.splats, by_splat.features) for camera, by_splat, _ in looks]
        rows, first, second = self._update(rows, moments, degree, gradients, factors)
        self.gaussians = Gaussians.from_rows(rows)
        self.optimizer.first, self.optimizer.second = first, second

        self.iteration += 1
        rng = np.random.default_rng([config.seed, 2, self.iteration])
        self.strategy.refine(self.iteration, self.gaussians, self.optimizer, rng)
        losses = [loss for _, _, loss in looks]
        return losses[0] if count == 1 else sum(losses, ad.Float(0)) / count

    def _look(self, rows: list[Any], degree: int, number: int) -> tuple[Pinhole, SplatGradients, Any]:
        """Blend view `number` of the training, compare, and go back: (camera, gradients of its splats, loss)."""
        view = self.views.at_step(number)
        camera = Pinhole.of(view.camera)
        size = width, height = camera.width, camera.height
        splats, footprints, colour = self._project(rows, camera, degree)
        lists = bin_splats(splats, footprints, width, height)
        blended = forward(splats, colour, lists, width, height)
        rgba, valid = self.views.pixels(view)
        target = rgba, ad.Float(self.background(number, view)), valid
        loss, by_colour, by_transmittance = self._loss(
            blended.features, blended.transmittance, target, size, self.config.ssim_weight
        )
        by_splat = backward(splats, blended, lists, size, by_colour, by_transmittance)
        gradient = dr.sqrt(
            dr.square(by_splat.absolute_x * (0.5 * width)) + dr.square(by_splat.absolute_y * (0.5 * height))
        )
        radius = dr.maximum(footprints.half_width, footprints.half_height) / max(width, height)
        self.strategy.observe(gradient, radius, footprints.visible)
        return camera, by_splat, loss

    def save(self, path: Path) -> None:
        """Write everything that the next step depends on."""
        tensors = dict(self.gaussians.to_numpy())
        for name, rows in (("first", self.optimizer.first), ("second", self.optimizer.second)):
            tensors[f"adam.{name}"] = np.stack([np.array(row) for row in rows])
        tensors |= {f"strategy.{name}": np.array(value) for name, value in self.strategy.state.items()}
        header = {"iteration": self.iteration, "adam_steps": self.optimizer.steps, "history": self.history}
        write_tensors(path, tensors, header)

    def restore(self, path: Path) -> None:
        """Continue from what `save` wrote. Raises InputError where the file does not fit."""
        tensors, header = read_tensors(path)
        try:
            gaussians = Gaussians.from_numpy(tensors)
            first, second = ([ad.Float(row) for row in tensors[f"adam.{name}"]] for name in ("first", "second"))
            state = {name: ad.Float(tensors[f"strategy.{name}"]) for name in self.strategy.state}
            iteration, steps, history = int(header["iteration"]), int(header["adam_steps"]), list(header["history"])
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(f"{path}: expected a checkpoint of training, found one that lacks {error}") from None
        lengths = {dr.width(row) for row in (*first, *second, *state.values())}
        if lengths != {gaussians.count} or not len(first) == len(second) == len(gaussians.rows()):
            raise InputError(f"{path}: expected moments and statistics of {gaussians.count} Gaussians, found others")
        if not 0 <= iteration <= self.config.iterations:
            raise InputError(f"{path}: expected an iteration up to {self.config.iterations}, found {iteration}")
        self.gaussians, self.strategy.state = gaussians, state
        self.optimizer.first, self.optimizer.second, self.optimizer.steps = first, second, steps
        self.iteration, self.history = iteration, history

    def background(self, index: int, view: View) -> np.ndarray:
        """[3] float32: the colour that a step's picture and its truth are laid over; black below opaque pictures."""
        if view.opaque or not self.config.random_background:
            return np.zeros(3, np.float32)
        return np.random.default_rng([self.config.seed, 3, index]).uniform(size=3).astype(np.float32)

    def rates(self, index: int) -> Iterator[float]:
        """The step size of each row; that of the means falls exponentially over the whole training."""
        rates, done = self.config.rates, index / self.config.iterations
        means = self.scene_scale * rates.means ** (1 - done) * rates.means_final**done
        yield from [means] * 3 + [rates.log_scales] * 3 + [rates.quaternions] * 4 + [rates.logit_opacities]
        yield from [rates.sh_constant] * 3 + [rates.sh_rest] * (len(self.gaussians.sh) - 3)

    def _note(self, loss: float) -> None:
        if not np.isfinite(loss):
            raise WorkError(f"training: the loss is {loss} at iteration {self.iteration}; the last checkpoint is kept")
        self.history.append({"iteration": self.iteration, "loss": loss, "gaussians": self.gaussians.count})


def _project(rows: list[Any], camera: Pinhole, degree: int) -> tuple[Splats, Footprints, list[Any]]:
    """Splats, footprints and colours (3 x [N]), without gradients."""
    gaussians = Gaussians.from_rows(rows)
    splats, footprints = project(gaussians, camera)
    return splats, footprints, list(view_colours(gaussians, camera, degree))


def _loss(
    colour: list[Any],
    transmittance: Any,
    target: tuple[Any, Any, Any],
    size: tuple[int, int],
    ssim_weight: float,
) -> tuple[Any, list[Any], Any]:
    """Loss of a picture over the target's background, and its gradients by colour (3 planes) and transmittance."""
    rgba, background, valid = target
    channels = [ad.Float((rgba >> shift) & 0xFF) / 255 for shift in (0, 8, 16, 24)]
    below = ad.Array3f([dr.gather(ad.Float, background, ad.UInt32(c)) for c in range(3)])
    truth = ad.Array3f(channels[:3]) * channels[3] + (1 - channels[3]) * below
    colour, transmittance = ad.Array3f(colour), ad.Float(transmittance)
    dr.enable_grad(colour, transmittance)
    picture = dr.select(valid, colour + transmittance * below, truth)
    loss = photometric_loss(picture, truth, *size, ssim_weight=ssim_weight)
    dr.backward(loss)
    return dr.detach(loss), list(dr.grad(colour)), dr.grad(transmittance)


def _update(
    rows: list[Any],
    moments: tuple[list[Any], list[Any]],
    degree: int,
    gradients: list[tuple[Pinhole, Splats, list[Any]]],
    factors: Any,
) -> tuple[list[Any], list[Any], list[Any]]:
    """Gradients of the splats and colours in each view to the mean gradient of the parameters, and an Adam step.

    factors: Float [2 + R], Adam's two corrections and the step size of each row.
    """
    rows = [ad.Float(row) for row in rows]
    dr.enable_grad(rows)
    gaussians = Gaussians.from_rows(rows)
    along: Any = ad.Float(0)
    for camera, by_splat, by_colour in gradients:
        splats, _ = project(gaussians, camera)
        colour = view_colours(gaussians, camera, degree)
        for name in ("opacity", "x", "y", "a", "b", "c"):
            along += getattr(splats, name) * getattr(by_splat, name)
        for value, gradient in zip(colour, by_colour, strict=True):
            along += value * gradient
    dr.backward(along if len(gradients) == 1 else along / len(gradients))
    numbers = [dr.gather(ad.Float, factors, ad.UInt32(i)) for i in range(2 + len(rows))]
    by_row = [dr.grad(row) for row in rows]
    return adam_step(dr.detach(rows), by_row, moments, numbers[2:], (numbers[0], numbers[1]))
