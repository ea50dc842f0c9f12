"""Suns of training pictures that name none, estimated together with the model (`sun = "unknown"`).

1. A model without light is trained for a while: its shape, and shading by it, give each picture a first Sun
   (`sun_search.ShapeSearch`).
2. The method of light is trained with these. Each picture's Sun follows the gradient of its loss through shading;
   shadows count as given within a step.
3. Now and then (`SEARCHES`) every picture is compared with the model under other Suns, shadows included: those near its
   own, and those that its shading allowed (`sun_search.SunFinder`).
4. A model that has taken wrong Suns for right explains its own pictures with them. So some pictures are held out for a
   while: where two halves of one name Suns far apart, the model does not know light (`SunEstimation.told`).

Pictures with a time have Suns that turn little from one to the next.
"""

import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from spacesim.backend.arrays import Float
from spacesim.data.errors import InputError
from spacesim.data.files import JsonValue
from spacesim.data.geometry import Array, degrees_between
from spacesim.data.images import load_image
from spacesim.data.records import Dataset, Frame, Sun
from spacesim.splat.light.model import LightModel
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.sun_search import (
    SHAPE_SIDE,
    SIDE,
    SPHERE,
    ShapeSearch,
    SmallPicture,
    SunFinder,
    constant_colors,
    smoothest,
)
from spacesim.splat.train.config import TrainConfig, preset, shortened, with_options
from spacesim.splat.train.pictures.numbers import PictureNumbers, falling

SEARCHES = 0.2, 0.4, 0.6, 0.8  #: of the training, after which pictures are compared with other Suns, as at its end
CHOICES = 12  #: Suns that a picture's shading allowed, of those that are looked at
LOOKED_AT = 32  #: Suns of the lattice, these and the nearest to a picture's own: two rings, of about 30 degrees
#: about so many pictures, no more than one in the second number, are held out of the training at first. At the search
#: after JOINED of it their Suns are looked for by halves; then they are trained on as the others
HELD_OUT, HELD_OUT_OF, JOINED = 16, 5, 0.6
MIDDLE = 0.25  #: share of the angles between halves that is left out at either end of their mean
CHANCE = 90.0  #: degrees: median error of Suns that are guessed
HARDLY = 40.0  #: degrees, from which on Suns are hardly known
SHAPE_SHARE, SHAPE_STEPS = 0.3, 1_500  #: of the training's steps, and at least: of the one without light before it
TURN = 3.0  #: degrees: a turn of the Sun from one picture to the next, in time order, that costs half

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class FirstSuns:
    """What shape and shading say of the Suns of V pictures."""

    directions: Array  #: [V, 3] unit, world axes
    choices: np.ndarray  #: [V, CHOICES] int, numbers of the lattice's Suns that do best

    def tensors(self) -> dict[str, np.ndarray]:
        """For a file."""
        return {"directions": self.directions, "choices": self.choices.astype(np.float64)}

    @staticmethod
    def of(tensors: Mapping[str, np.ndarray], pictures: int, path: Path) -> "FirstSuns":
        """The inverse of `tensors`, for so many pictures. Raises InputError in the name of the file."""
        directions, choices = tensors.get("directions", np.empty(0)), tensors.get("choices", np.empty(0))
        sound = directions.shape == (pictures, 3) and choices.shape == (pictures, CHOICES)
        if not sound or not np.isfinite(directions).all() or not ((choices >= 0) & (choices < SPHERE)).all():
            raise InputError(f"{path}: expected the Suns of {pictures} pictures, found others; delete it")
        return FirstSuns(directions, choices.astype(int))


class SunEstimation:
    """The Suns of a training's pictures."""

    def __init__(
        self, dataset: Dataset, first: FirstSuns, rate: float, iterations: int, holds_out: bool = True
    ) -> None:
        """rate: step size at the start, radians;  holds_out: some pictures, without which nothing is told of Suns"""
        self.dataset, self.rate, self.iterations = dataset, rate, iterations
        self.order = time_order(dataset.train)
        self.choices = first.choices
        self.sigmas = np.full(len(dataset.train), 180.0)  #: degrees, of the latest search
        self.numbers = PictureNumbers(len(dataset.train), 3, self._on_sphere)
        self.numbers.values = first.directions.copy()
        self._steps = [round(share * iterations) for share in (*SEARCHES, 1.0)]
        count = len(dataset.train) if holds_out else 0
        self.held_out = range(0, count, max(HELD_OUT_OF, count // HELD_OUT))
        self._joined = min(step for step in self._steps if step >= round(JOINED * iterations))
        self.apart = np.full(len(self.held_out), np.nan)  #: degrees, between Suns by halves, see `SunFinder.apart`

    def waits(self, picture: int, step: int) -> bool:
        """Whether a picture is still held out in a step, the first of which is 0."""
        return step < self._joined and picture in self.held_out

    @cached_property
    def _small_pictures(self) -> list[SmallPicture]:
        return small_pictures(self.dataset, SIDE)

    def direction(self, picture: int) -> Array:
        """[3] unit, of a training picture."""
        values = self.numbers.of(picture)
        unit: Array = values / np.linalg.norm(values)
        return unit

    def directions(self) -> Array:
        """[V, 3] unit."""
        return np.array([self.direction(picture) for picture in range(len(self.sigmas))])

    def learn(self, picture: int, step: int, gradient: Float) -> None:
        """gradient: Float [3] by the Sun's direction of a picture that was drawn in a step, the first of which is 0"""
        self.numbers.learn(picture, gradient, falling(self.rate, step / self.iterations))

    def search(self, steps: int, gaussians: Gaussians, light: LightModel, antialiased: bool) -> None:
        """After so many steps: compare all pictures with other Suns, if it is time to."""
        if steps not in self._steps:
            return
        finder = SunFinder(gaussians, light, antialiased, light.config.curve)
        if steps == self._joined:
            self.apart = np.array([finder.apart(self._small_pictures[picture]) for picture in self.held_out])
        directions = self.directions()
        for place, picture in enumerate(self.order if self.order is not None else range(len(directions))):
            before = directions[self.order[place - 1]] if self.order is not None and place else None
            estimate = finder.estimate(
                self._small_pictures[picture],
                finder.near(directions[picture], self.choices[picture], LOOKED_AT),
                lambda direction, before=before: _turn_cost(direction, before),  # type: ignore[misc]
            )
            directions[picture], self.sigmas[picture] = estimate.direction, estimate.sigma_deg
        moved = degrees_between((directions * self.directions()).sum(axis=1))
        log.info("Suns compared with the model: moved by %.1f degrees (median)", np.median(moved))
        self.numbers.values = directions
        self.numbers.first[:] = 0

    def described(self) -> list[dict[str, JsonValue]]:
        """Of cameras.json, for each picture: as transforms.json names a Sun, and how sure it is."""
        described: list[dict[str, JsonValue]] = []
        for direction, sigma in zip(self.directions(), self.told(), strict=True):
            sun = Sun(direction)
            azimuth, elevation = sun.angles
            named = {"sun_direction": sun.direction.tolist(), "sun_azimuth_deg": azimuth}
            described.append({**named, "sun_elevation_deg": elevation, "sun_sigma_deg": float(sigma)})
        return described

    def told(self) -> Array:
        """[V] degrees: how far Suns may be off, their own sigmas, but no less than what halves of pictures held out are
        apart (`_between_halves`), and at most `CHANCE`, which it is where no half shows enough.

        Of 40 to 600 pictures like SPEED+'s (`fast`, 75 to 300 pixels high) the median was 1.0 to 1.8 times the true
        one. Halves agree, too, in a model that is wrong as a whole, as after too few steps.
        """
        return np.clip(self.sigmas, min(self._between_halves(), CHANCE), CHANCE)

    def _between_halves(self) -> float:
        """Degrees: mean of the middle half of `apart`, `CHANCE` where it has none."""
        from scipy.stats import trim_mean

        known = self.apart[np.isfinite(self.apart)]
        return float(trim_mean(known, MIDDLE)) if len(known) else CHANCE

    def sentence(self) -> str:
        """What the log says at the end."""
        count, median = int(np.isfinite(self.apart).sum()), float(np.median(self.told()))
        if not count:
            return (
                "Suns are hardly known: no picture held out shows enough of an object that is cut out to tell how well"
            )
        by = f"two halves of {count} pictures held out name Suns {self._between_halves():.0f} degrees apart"
        if median < HARDLY:
            return f"Suns are estimated to {median:.1f} degrees (median), unless the model is wrong as a whole: {by}"
        return f"Suns are hardly known: {by}, where chance is 90; take more pictures, the object cut out"

    def tensors(self) -> dict[str, np.ndarray]:
        """For a checkpoint, beside `numbers`."""
        own = {"choices": self.choices.astype(np.float64), "sigmas": self.sigmas, "apart": self.apart}
        return {f"pictures.suns.{name}": values.copy() for name, values in own.items()}

    def restore(self, tensors: Mapping[str, np.ndarray]) -> None:
        """The inverse of `tensors`. Raises KeyError, or ValueError for another number of pictures."""
        choices, sigmas, apart = (tensors[f"pictures.suns.{name}"] for name in ("choices", "sigmas", "apart"))
        if (
            choices.ndim != 2
            or len(choices) != len(self.sigmas)
            or sigmas.shape != self.sigmas.shape
            or apart.shape != self.apart.shape
        ):
            raise ValueError(f"pictures.suns: expected {len(self.sigmas)} pictures, found another number")
        if choices.min(initial=0) < 0 or choices.max(initial=0) >= SPHERE:
            raise ValueError("pictures.suns.choices: expected numbers of the lattice, found others")
        self.choices, self.sigmas = choices.astype(int), np.array(sigmas, np.float64)
        self.apart = np.array(apart, np.float64)

    def _on_sphere(self, picture: int, gradient: Array) -> Array:
        """[3] gradient by the numbers, whose length does not count."""
        values = self.numbers.values[picture]
        length = float(np.linalg.norm(values))
        self.numbers.values[picture] = unit = values / length
        along: Array = gradient - unit * (unit @ gradient)
        return along


def shape_config(config: TrainConfig) -> TrainConfig:
    """Of the training without light that comes first, shorter than `config`'s."""
    steps = max(round(SHAPE_SHARE * config.iterations), min(SHAPE_STEPS, config.iterations))
    plain = with_options(preset(config.preset or "fast"), iterations=steps, seed=config.seed, init=config.init)
    return replace(
        plain,
        rates=replace(plain.rates, decay=config.rates.decay),
        init_count=config.init_count,
        init_box=config.init_box,
        refine_poses=config.refine_poses,
        warm_start=config.warm_start and shortened(replace(config, refine_poses=False), steps).warm_start,
    )


def surface_points(gaussians: Gaussians) -> tuple[Array, np.ndarray]:
    """(centres [N, 3] of Gaussians that can be seen well, metres; their constant colours [N, 3] uint8)."""
    arrays = gaussians.to_numpy()
    solid = arrays["logit_opacities"].ravel() > 0
    solid = solid if solid.any() else np.ones_like(solid)
    return arrays["means"][solid], np.rint(255 * np.clip(constant_colors(gaussians)[solid], 0, 1)).astype(np.uint8)


def first_suns(dataset: Dataset, gaussians: Gaussians, distance: float) -> FirstSuns:
    """By a model that was trained without light. distance: metres, of the farthest camera

    However it was trained, it is drawn with the anti-aliasing filter: pictures are far smaller here.
    """
    search = ShapeSearch(gaussians, True, distance)
    losses = search.losses(small_pictures(dataset, SHAPE_SIDE))
    best, order = losses.argmin(axis=1), time_order(dataset.train)
    if order is not None:
        best[order] = smoothest(losses[order], search.sphere, TURN)
    return FirstSuns(search.sphere[best], np.argsort(losses, axis=1, kind="stable")[:, :CHOICES])


def time_order(frames: Sequence[Frame]) -> np.ndarray | None:
    """[V] numbers of frames in the order of their times; None where some have none, or all the same."""
    times = [frame.time for frame in frames]
    if any(time is None for time in times) or len(set(times)) < 2:
        return None
    return np.argsort(np.array(times, np.float64), kind="stable")


def check_pictures(dataset: Dataset) -> None:
    """Raise InputError where too few pictures are there to separate Suns from albedo."""
    if len(dataset.train) < 8:
        raise InputError(f"sun: expected at least 8 training pictures to estimate it, found {len(dataset.train)}")


def _turn_cost(direction: Array, before: Array | None) -> float:
    if before is None:
        return 0.0
    turn = degrees_between(direction @ before)
    return float(0.5 * (turn / TURN) ** 2)


def small_pictures(dataset: Dataset, side: int) -> list[SmallPicture]:
    """Of the training pictures, in order, of at most so many pixels a side."""

    def of(frame: Frame) -> SmallPicture:
        return SmallPicture.of(frame.camera, load_image(dataset, frame), side=side)

    with ThreadPoolExecutor() as pool:
        return list(pool.map(of, dataset.train))
