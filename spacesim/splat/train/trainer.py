"""The one training loop.

A step takes one view or several forward and backward (`view_pass`), moves all parameters by what they teach
(`optimizer.update`), and refines the set of Gaussians if it is time to.
"""

import logging
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Float
from spacesim.backend.upload import upload, upload_numbers
from spacesim.data.errors import InputError
from spacesim.data.files import JsonDict
from spacesim.data.geometry import Array, is_near, robust_radius
from spacesim.data.records import Dataset
from spacesim.learning.adam import NetworkAdam
from spacesim.learning.cameras import farthest_camera, focus_point, nearest_camera
from spacesim.learning.folder import TrainingProgress
from spacesim.learning.forecast import Growth, TimeLeft
from spacesim.learning.loop import TrainingLoop
from spacesim.splat.light.bounce import ALBEDO, SPECULAR
from spacesim.splat.light.model import LightModel, TrainingFrame
from spacesim.splat.light.surroundings import RECOVERY, HeldSurroundings, are_due
from spacesim.splat.raster.adjoint import SplatGradients
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.project import Pinhole
from spacesim.splat.train.checkpoint import FORMAT, GaussianCheckpointHeader
from spacesim.splat.train.config import TrainConfig
from spacesim.splat.train.discs import EVERY, turn_discs, turns_normals
from spacesim.splat.train.optimizer.adam import Adam
from spacesim.splat.train.optimizer.update import Update
from spacesim.splat.train.pictures.learned import LearnedPictures
from spacesim.splat.train.pictures.suns import FirstSuns
from spacesim.splat.train.prior import MeshPrior
from spacesim.splat.train.stages import NetworkStep, TargetImage
from spacesim.splat.train.start import (
    initial_gaussians,
    largest_scale,
    lay_flat,
    scene_scale,
    starts_on_surface,
    surface_normals,
)
from spacesim.splat.train.strategies.factory import make_strategy
from spacesim.splat.train.view_pass import RenderedView, ViewLoss, ViewPass, ViewResult
from spacesim.splat.train.views import TrainingView, TrainingViews
from spacesim.splat.train.warm_start import Attraction, WarmStart

log = logging.getLogger(__name__)

BACKGROUNDS = 1024  #: colours that are drawn at once
MAX_GAUSSIANS = 10**8  #: training so many takes some 150 GB; an array of 42 numbers of each has no more than 2^32


class Trainer(TrainingLoop):
    """Gaussians, their optimizer and their strategy, and the networks of light where the method has some, one step
    after another."""

    form, header = FORMAT, GaussianCheckpointHeader

    def __init__(
        self, dataset: Dataset, config: TrainConfig, first_suns: FirstSuns | None = None, poses: Array | None = None
    ) -> None:
        """first_suns: where the Suns of pictures that name none start, of a configuration that estimates them
        poses: [V, 6] what an earlier training learned of them and stays, of a configuration that refines poses"""
        self.config, self.iteration = config, 0
        _check_sizes(dataset, config)
        self.views = _views(dataset, config)
        self.pictures = LearnedPictures(dataset, config, first_suns, poses)
        self.scene_scale = scene_scale(dataset)
        features = config.light.features if config.light else 0
        count = min(config.init_count, config.refinement.max_gaussians)
        self.gaussians = initial_gaussians(
            dataset,
            config.init,
            count=count,
            sh_degree=config.sh_degree,
            seed=config.seed,
            features=features,
            box=config.init_box,
            like_splatfacto=config.splatfacto_start,
        )
        placed = starts_on_surface(dataset, config.init, config.warm_start is not None)
        placed &= not config.refine_poses and config.sun == "given"
        self._first_means = config.rates.means * (config.rates.surface_start if placed else 1)
        self._held: list[Float] = []  # ln of metres
        if config.holds_sizes:
            share, most = config.refinement.split_screen_size, config.refinement.max_gaussians
            self._held = [dr.opaque(ad.Float, math.log(largest_scale(dataset, self.gaussians, share, most)))]
        if config.surfels:
            lay_flat(self.gaussians)
        self.optimizer = Adam(self.gaussians.rows())
        self.light = self._initial_light(dataset)
        self.light_optimizer = NetworkAdam(_learned(self.light))
        self.strategy = make_strategy(config, dataset, self.scene_scale, self.gaussians.count)
        self.warm_start: WarmStart | None = None
        if config.warm_start is not None:
            centre = focus_point(dataset)
            nearest = nearest_camera(dataset, centre)
            self.warm_start = WarmStart(config.warm_start, self.views, centre, nearest, self.gaussians.count)
            means = self.gaussians.to_numpy()["means"]
            self._start_radius = float(np.linalg.norm(means - centre, axis=1)[is_near(means)].max())
        self.history, self.seconds = [], {"refinement": 0.0}
        self._view_pass = ViewPass(config, self.scene_scale)
        self._update = Update(config.antialiased, self.scene_scale, config.surfels, self.strategy.observe)

    @property
    def gaussian_count(self) -> int:
        """At this iteration."""
        return self.gaussians.count

    def time_left(self) -> TimeLeft:
        """See `TrainingLoop.time_left`."""
        config = self.config
        growth = Growth(config.refine_stop, config.refinement.max_gaussians)
        return TimeLeft(config.iterations, growth, lambda step: config.downscale(step) ** -2)

    def step(self) -> Float:
        """One update from one view or several, densification if it is time. Returns the mean loss, Float of width 1."""
        config, index, count = self.config, self.iteration, self.config.views_per_step
        degree = config.degree(index)
        numbers = range(index * count, (index + 1) * count)
        # all are read before anything changes: one that cannot be leaves the state as it was
        views = [self.pictures.taught(self.views, number, index) for number in numbers]
        if self.light:
            self._look_around(self.light)
        rows = self.gaussians.rows()
        results = [self._forward_backward(rows, degree, *pair) for pair in zip(numbers, views, strict=True)]
        del rows  # so that old ones go as new ones come
        losses = [result.loss for result in results]
        self._learn(degree, results)
        self.iteration += 1
        self.pictures.hold(self.iteration)
        if self.light:
            self.pictures.find_suns(self.iteration, self.gaussians, self.light)
        self.strategy.add_noise(self.iteration, self.gaussians, self.means_rate(index), config.seed)
        self._refine()
        self._turn_discs()
        return losses[0] if count == 1 else sum(losses, ad.Float(0)) / count

    def _look_around(self, light: LightModel) -> None:
        """For light that bounces, now and then, but not while opacities that were reset stop no ray."""
        step, refinement = self.iteration, self.config.refinement
        if not light.config.bounce:
            return
        if light.held_surroundings is None or (are_due(step) and not refinement.recovers_at(step, RECOVERY)):
            light.hold_surroundings(self.gaussians)

    def _turn_discs(self) -> None:
        """Now and then, where light has learned their normals, which without shadows stand in for these, too."""
        light, is_due = self.config.light, self.iteration % EVERY == 0
        if light and light.shadow and light.field.surface and self.config.surfels and is_due:
            turn_discs(self.gaussians, light.field.features, both=turns_normals(self.iteration, self.config.iterations))

    def _refine(self) -> None:
        """After a step: the strategy refines the set of Gaussians, or the warm start does while it lasts."""
        before = self.gaussians.logit_opacities
        self._refine_gaussians()
        if self.gaussians.logit_opacities.index != before.index:
            self._view_pass.pairs.after_refinement()
        source = self.optimizer.take_source()
        if self.light and source is not None:
            self.light.follow(source)

    def _refine_gaussians(self) -> None:
        warm, done = self.warm_start, self.iteration
        if warm is not None and warm.active(done - 1):
            warm.after_step(done, self.gaussians, self.optimizer)
            return
        if done % self.config.refinement.refine_every:
            return
        dr.sync_thread()  # what the steps before have left to compute is not densification's
        start = time.perf_counter()
        rng = np.random.default_rng([self.config.seed, 2, done])
        leniency = 1.0 if warm is None else warm.config.leniency(done)
        self.strategy.refine(done, self.gaussians, self.optimizer, rng, leniency)
        dr.sync_thread()
        self.seconds["refinement"] += time.perf_counter() - start

    def _forward_backward(self, rows: list[Float], degree: int, number: int, view: TrainingView) -> ViewResult:
        """Forward, loss, backward for one view, `number` of the training."""
        view_pass = self._view_pass
        view = self.pictures.shown(view)
        watched = self.strategy.observes_step(self.iteration + 1) and not self._warming(self.iteration)
        attraction = self._attraction(view)
        target = self._target_image(number, view, attraction)
        asked = rows, degree, view, target, watched
        drawn, loss, grad_splats, result = self._gradients(*asked)
        if not view_pass.pairs.all_fit():
            del drawn, loss, grad_splats, result  # of lists that are empty, and memory is short
            with view_pass.pairs.synchronous():
                drawn, loss, grad_splats, result = self._gradients(*asked)
        self.pictures.learn(self.iteration, view, rows, drawn, loss, grad_splats, self.scene_scale)
        if watched:
            result.add_seen(view_pass.watched(drawn, grad_splats, number % self.config.views_per_step))
        if attraction:
            result.add_to_rows(self._add_attraction(rows, view, attraction))
        self.pictures.learn_sun(self.iteration, view, result.by_sun)
        return result

    def _gradients(
        self, rows: list[Float], degree: int, view: TrainingView, target: TargetImage, watched: bool
    ) -> tuple[RenderedView, ViewLoss, SplatGradients, ViewResult]:
        """Of a view: what was drawn, its loss, gradients by its splats, what it teaches. Changes nothing."""
        view_pass, downscale = self._view_pass, self.config.downscale(self.iteration)
        drawn = view_pass.forward(self.gaussians, rows, self.light, view, degree, downscale, watched)
        loss, grad_splats = view_pass.backward(drawn, target, view.camera, absolute=watched)
        return drawn, loss, grad_splats, view_pass.to_gradients(drawn, loss, grad_splats, self.light)

    def _warming(self, index: int) -> bool:
        """Whether the warm start keeps densification off in step number `index`, the first of which is 0."""
        return self.warm_start is not None and self.warm_start.active(index)

    def _attraction(self, view: TrainingView) -> Attraction | None:
        """What the warm start pulls with in this step, if it still does or counts who is in the picture."""
        warm, index = self.warm_start, self.iteration
        pulls = warm is not None and (warm.active(index) or warm.config.strength(index) > 0)
        return warm.attraction(view) if warm and pulls else None

    def _add_attraction(self, rows: list[Float], view: TrainingView, attraction: Attraction) -> list[Float]:
        """What the warm start adds to the gradients of the rows."""
        assert self.warm_start is not None
        return self.warm_start.attraction_gradients(rows, Pinhole.of(view.camera), attraction, self.iteration)

    def _target_image(self, number: int, view: TrainingView, attraction: Attraction | None) -> TargetImage:
        rgba, valid, truth = self.views.pixels(view)
        if self.warm_start and attraction:
            truth = {
                **truth,
                "foreground": [attraction.mask, dr.opaque(ad.Float, self.warm_start.config.strength(self.iteration))],
            }
        background = upload_numbers(self.background(number, view).tolist())
        return TargetImage(rgba, background, valid, truth, self.pictures.gains(view))

    def _learn(self, degree: int, results: list[ViewResult]) -> None:
        """Move the Gaussians and the networks; the strategy's state is what it is after these views."""
        gaussians, light, strategy, of_light = self.gaussians, self.light, self.strategy, self.light_optimizer
        weights = self.config.penalty_weights(self.scene_scale).items()
        penalties = {name: dr.opaque(ad.Float, weight / gaussians.count) for name, weight in weights}
        factors = upload_numbers([*self.optimizer.corrections(), *self.rates(self.iteration)])
        views = [result.take_gradients() for result in results]
        watched = strategy.observed_state() if views[0].seen else None
        networks, held = self._network_step(light, results) if light else None, self._held_now()
        state, learned = self._update(
            gaussians, self.optimizer, degree, views, factors, penalties, held, watched, networks
        )
        strategy.state |= state
        if light and learned:
            moved, of_light.first, of_light.second = learned
            light.weights, light.embeddings = moved[: len(light.weights)], moved[len(light.weights) :]

    def _held_now(self) -> list[Float]:
        """ln of `largest_scale` where the configuration holds sizes, once Gaussians may be split; else nothing."""
        refinement, index = self.config.refinement, self.iteration
        begins = max(refinement.refine_start, refinement.pause_after_reset)
        return [] if index < begins or self._warming(index) else self._held

    def _network_step(self, light: LightModel, results: list[ViewResult]) -> NetworkStep:
        optimizer, rates, done = self.light_optimizer, self.config.rates, self.iteration / self.config.iterations
        rate = rates.between(rates.networks, rates.networks_final, done)
        of_embeddings = rates.features * rate / (rates.networks or 1)  # as in Splatfacto-W it falls
        factors = upload_numbers([*optimizer.corrections(), rate, *[of_embeddings for _ in light.embeddings]])
        gradients = [result.by_networks for result in results]
        return _learned(light), (optimizer.first, optimizer.second), gradients, factors

    def model_tensors(self) -> dict[str, np.ndarray]:
        """The Gaussians, and the networks where there are any."""
        return {**self.gaussians.to_numpy(), **(self.light.tensors() if self.light else {})}

    def state_tensors(self) -> dict[str, np.ndarray]:
        """Adam's moments, what is learned of pictures, statistics of the strategy and of a warm start."""
        tensors: dict[str, np.ndarray] = {}
        for name, optimizer in (("adam", self.optimizer), ("adam.light", self.light_optimizer)):
            for order, moments in zip(("first", "second"), optimizer.moments(), strict=True):
                tensors |= {f"{name}.{order}.{i:02d}": moment for i, moment in enumerate(moments)}
        tensors |= self.pictures.tensors()
        tensors |= {f"strategy.{name}": np.array(value) for name, value in self.strategy.state.items()}
        held = self.light.held_surroundings if self.light else None
        if held is not None:
            tensors |= held.tensors()
        if self.warm_start and self._warming(self.iteration):
            tensors |= {f"warm_start.{name}": np.array(value) for name, value in self.warm_start.state.items()}
        return tensors

    def counts(self) -> dict[str, int]:
        """Steps of Adam."""
        return {"adam_steps": self.optimizer.steps}

    def put(self, tensors: Mapping[str, np.ndarray], header: GaussianCheckpointHeader) -> None:
        """See `TrainingLoop.put`."""
        gaussians = Gaussians.from_numpy(tensors)
        if gaussians.count == 0:
            raise ValueError("no Gaussians")
        kinds, expected = ((g.sh_degree, g.feature_count) for g in (gaussians, self.gaussians))
        if kinds != expected:
            raise ValueError("expected Gaussians with the colours of this method, found others")
        light = LightModel.from_tensors(self.config.light, tensors) if self.config.light else None
        sizes, fresh = ([dr.width(one) for one in _learned(model)] for model in (light, self.light))
        if sizes != fresh:
            raise ValueError(f"light.embeddings: expected {len(self.views)} pictures, found another number")
        optimizer, light_optimizer = Adam(gaussians.rows()), NetworkAdam(_learned(light))
        _restore_moments(optimizer, tensors, "adam")
        _restore_moments(light_optimizer, tensors, "adam.light")
        held = HeldSurroundings.from_tensors(tensors, gaussians.count)
        if light and held:
            light.hold_surroundings(held)
        self.pictures.restore(tensors)
        state = _restore_state(self.strategy.state, tensors, "strategy", gaussians.count)
        warming = self.warm_start is not None and self._warming(header.iteration)
        names = self.warm_start.state if self.warm_start and warming else {}
        warm = _restore_state(names, tensors, "warm_start", gaussians.count)
        self.gaussians, self.light, self.strategy.state = gaussians, light, state
        self.optimizer, self.light_optimizer = optimizer, light_optimizer
        optimizer.steps = light_optimizer.steps = header.adam_steps
        if self.warm_start and warm:
            self.warm_start.state = warm

    def summary(self) -> JsonDict:
        """The number of Gaussians, what was learned of pictures."""
        return {"gaussians": self.gaussians.count, **self.pictures.summary()}

    def files(self) -> dict[str, JsonDict]:
        """RUN/cameras.json, where something was learned of pictures."""
        cameras = self.pictures.cameras()
        return {} if cameras is None else {"cameras.json": cameras}

    def complete(self, out: Path, on_progress: Callable[[TrainingProgress], None], command: Sequence[str] = ()) -> None:
        """See `TrainingLoop.complete`; logs what was learned of pictures."""
        super().complete(out, on_progress, command)
        for sentence in self.pictures.sentences():
            log.info(sentence)

    def background(self, index: int, view: TrainingView) -> np.ndarray:
        """[3] float32: the colour that a step's picture and its truth are laid over."""
        config = self.config
        if not config.random_background or (view.opaque and not config.random_behind_opaque):
            return np.zeros(3, np.float32)
        colors: np.ndarray = _backgrounds(config.seed, index // BACKGROUNDS)[index % BACKGROUNDS]
        return colors

    def rates(self, index: int) -> list[float]:
        """The step size of each row."""
        rates, means = self.config.rates, self.means_rate(index)
        if self.config.warm_start is not None:
            means = self.config.warm_start.means_rate(index, means, self._start_radius)
        shape = [means] * 3 + [rates.log_scales] * 3 + [rates.quaternions] * 4 + [rates.logit_opacities]
        if self.gaussians.features is not None:
            done = index / self.config.iterations
            return [*shape, rates.between(rates.features, rates.features_final, done)]
        return shape + [rates.sh_constant] * 3 + [rates.sh_rest] * (len(self.gaussians.sh) - 3)

    def means_rate(self, index: int) -> float:
        """Metres; falls over `means_steps`, which begin after a warm start that has larger ones."""
        rates, warm = self.config.rates, self.config.warm_start
        if self.pictures.model_stays(index):
            return 0.0
        waits = warm.steps if warm and warm.travel > 0 else 0
        steps = self.config.means_steps or self.config.iterations - waits
        done = min(max(index - waits, 0) / max(steps, 1), 1)
        return float(self.scene_scale * rates.between(self._first_means, rates.means_final, done))

    def _initial_light(self, dataset: Dataset) -> LightModel | None:
        """Networks in the frame of the Gaussians that training starts from."""
        if self.config.light is None:
            return None
        means = self.gaussians.to_numpy()["means"].astype(np.float64)
        centre = means[is_near(means)].mean(axis=0)
        field = self.config.light.field
        if field.surface:
            features, light = self.gaussians.to_numpy()["features"], self.config.light
            features[:, field.features : field.stored] = surface_normals(means)
            features[:, light.albedos :] = ALBEDO
            if light.specular is not None:
                features[:, light.specular :] = SPECULAR
            self.gaussians.features = upload(features.T.ravel())
        frame = TrainingFrame(centre, self.scene_scale, farthest_camera(dataset, centre), robust_radius(means))
        return LightModel.initial(self.config.light, frame, self.config.seed, len(self.views))


@lru_cache(maxsize=2)
def _backgrounds(seed: int, block: int) -> np.ndarray:
    """[BACKGROUNDS, 3] float32: of so many steps, for to start a generator takes longer than some kernels."""
    colors = np.random.default_rng([seed, 3, block]).uniform(size=(BACKGROUNDS, 3)).astype(np.float32)
    colors.setflags(write=False)
    return colors


def _check_sizes(dataset: Dataset, config: TrainConfig) -> None:
    """Raises InputError for pictures that cannot be made as small as training begins with, and for more Gaussians than
    can be."""
    if config.refinement.max_gaussians > MAX_GAUSSIANS:
        expected = f"refinement.max_gaussians: expected at most {MAX_GAUSSIANS}"
        raise InputError(f"{expected}, found {config.refinement.max_gaussians}")
    least = config.downscale(0)
    for frame in dataset.train:
        if min(frame.camera.width, frame.camera.height) < least:
            picture = f"{frame.camera.width}x{frame.camera.height} in {frame.file_path}"
            raise InputError(f"num_downscales: expected pictures of at least {least} pixels a side, found {picture}")


def _views(dataset: Dataset, config: TrainConfig) -> TrainingViews:
    """The training pictures with the truth that the loss asks for."""
    truth = config.shape_terms + (("visibility",) if config.visibility_weight > 0 else ())
    truth += ("radiance",) if config.light and config.light.radiance else ()
    prior = MeshPrior.of(dataset) if config.shape_terms and config.prior == "mesh" else None
    suns = config.light is not None and config.light.field.knows_sun and config.sun == "given"
    return TrainingViews(dataset, config.seed, suns, truth, prior, config.views_per_step)


def _learned(light: LightModel | None) -> list[Float]:
    """What is trained of light: the weights of its networks, then the pictures' embeddings."""
    return [*light.weights, *light.embeddings] if light else []


def _restore_state(names: Iterable[str], tensors: Mapping[str, np.ndarray], owner: str, count: int) -> JsonDict:
    """{name: Float [count]} of a checkpoint's statistics. Raises KeyError, or ValueError for another size."""
    state = {name: tensors[f"{owner}.{name}"] for name in names}
    for name, values in state.items():
        if values.shape != (count,):
            raise ValueError(f"{owner}.{name}: expected {count} numbers, found {values.shape}")
    return {name: upload(values) for name, values in state.items()}


def _restore_moments(optimizer: Adam | NetworkAdam, tensors: Mapping[str, np.ndarray], name: str) -> None:
    """Put moments from a checkpoint in place of fresh ones. Raises KeyError, or ValueError for another size."""
    moment_arrays: list[list[np.ndarray]] = []
    for order, moments in zip(("first", "second"), optimizer.moments(), strict=True):
        moment_arrays.append([tensors[f"{name}.{order}.{i:02d}"] for i in range(len(moments))])
        for i, (fresh, stored) in enumerate(zip(moments, moment_arrays[-1], strict=True)):
            if stored.shape != fresh.shape:
                raise ValueError(f"{name}.{order}.{i:02d}: expected {len(fresh)} numbers, found {stored.shape}")
    optimizer.put(*moment_arrays)
