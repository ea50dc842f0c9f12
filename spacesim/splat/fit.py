"""What a run does not know of a picture, fitted on some of its pixels: the embedding, the gain, the Sun.

`Unknown` is what each kind of it is to `spacesim.eval`; `find_unknowns` says which a run has. They are fitted in order,
each from what those before it have found.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike

from spacesim.data.errors import InputError
from spacesim.data.geometry import Array
from spacesim.data.images import linear_from_srgb, srgb_from_linear
from spacesim.data.records import Camera, Image, Sun
from spacesim.splat.compose.aligned import AlignedRun
from spacesim.splat.pose import checked_picture
from spacesim.splat.run import Prediction, Predictor, Run, check_gaussians
from spacesim.splat.sun_search import SmallPicture, SunEstimate, SunFinder

SATURATED = 254.5 / 255  #: sRGB value from which on a pixel says only that it is bright
SIDE = 128  #: pixels of the longer side, at most, of the picture that embeddings are fitted on
VARIANCE, MAX_AXES = 0.99, 16  #: share of the training embeddings' variance that is searched, and its axes at most
STEP = 0.1  #: standard deviations along an axis, of a finite difference
ITERATIONS, HALVINGS = 4, 4  #: Gauss-Newton steps, and how often each is halved until it helps
HALF = 0.5  #: least alpha of a pixel that counts, and least share of such ones in a small picture's
DARK = 0.02  #: sRGB value, below which nothing of a picture is lit
ENOUGH = 1e-3  #: a step that lowers the cost by less than this share is the last


@dataclass(frozen=True, eq=False)
class PictureLight:
    """What a view is drawn with."""

    sun: Sun | None = None  #: None: not named, and not found yet
    embedding: Array | None = None  #: [E], None: the mean of the training pictures'
    gain: float = 1.0  #: factor on linear values


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture to fit to."""

    rgb: np.ndarray  #: [H, W, 3] sRGB values in [0, 1] over black
    camera: Camera  #: of the picture


class Unknown(Protocol):
    """A kind of number that a run does not know of a picture."""

    @property
    def name(self) -> str:
        """As metrics.json has it: "sun", "embedding" or "gain"."""

    @property
    def how(self) -> str:
        """What it is and how it is fitted, in words."""

    def fit(
        self, run: Predictor, picture: Picture, masks: Sequence[np.ndarray], start: Sequence[PictureLight]
    ) -> list[PictureLight]:
        """For each mask ([H, W] bool, some pixel True) the light that fits the picture there best, from `start`, one
        for each mask. The same input gives the same bits."""


def find_unknowns(run: Predictor, gain: bool = False) -> tuple[Unknown, ...]:
    """Of a run, in the order in which they are fitted. gain: of each picture, too"""
    unknowns: list[Unknown] = []
    model = run.gaussian_run
    if model is not None and model.light is not None:
        light = model.light
        if model.config.get("sun") == "unknown":
            unknowns.append(SunFit(SunFinder(model.gaussians, light, model.antialiased, model.curve)))
        if light.embeddings:
            size = light.config.field.embeddings
            unknowns.append(EmbeddingFit.of(np.array(light.embeddings[0], np.float64).reshape(-1, size)))
    if gain:
        unknowns.append(GainFit())
    return tuple(unknowns)


def estimate_sun(
    run: Predictor | str | Path, image: str | Path | ArrayLike | Image, camera: Camera, mask: ArrayLike | None = None
) -> SunEstimate:
    """The Sun under which the model of `run` looks most like a picture: its direction, and how sure that is.

    run, image: as for `refine_pose`
    camera: of the picture, with its size and intrinsics (no distortion);  mask: [H, W], where not 0 the pixel counts
    Pixels count where the picture's alpha is at least one half, or the model's where the picture has none. Directions
    all over the sphere are compared, shadows included, on a picture of 128 pixels; the picture's exposure is taken for
    that of the training pictures. Shadows that are cast for a picture are kept as long as the run, up to 1 GiB.
    Raises InputError where the run knows no Sun, for no such picture, and where none counts.
    """
    run = check_gaussians(run)
    if not run.relightable or run.light is None:
        raise InputError(f"run: expected one of a method that takes the Sun, found {run.config['method']}")
    pixels, counts = checked_picture(image, mask, camera)
    rgb = pixels[..., :3]
    seen = pixels[..., 3] if pixels.shape[2] == 4 else run.predict(camera, Sun(np.array([0.0, 0.0, 1.0]))).alpha
    shown = (seen >= HALF) & (counts[..., 0] > 0)
    if not shown.any():
        raise InputError("image: expected a picture of the object, found no pixel that counts")
    if rgb[shown].max() < DARK:
        raise InputError("image: expected light on the object, found none")
    picture = SmallPicture.of(camera, Image(rgb, np.ones_like(seen), shown), least=HALF)
    if run not in _finders:
        _finders[run] = SunFinder(run.gaussians, run.light, run.antialiased, run.curve)
    return _finders[run].estimate(picture)


_finders: WeakKeyDictionary[Run, SunFinder] = WeakKeyDictionary()
"""Of the runs that were asked for Suns: what they know of the lattice's light serves other pictures."""


def draw(run: Predictor, camera: Camera, light: PictureLight) -> Prediction:
    """A view with a light. Its colours are clipped to [0, 1] where there is a gain."""
    if light.embedding is not None:
        run = run.with_embedding(light.embedding)
    drawn = run.predict(camera, light.sun)
    if light.gain == 1:
        return drawn
    linear = None if drawn.linear is None else light.gain * drawn.linear
    return replace(drawn, rgb=srgb_from_linear(light.gain * linear_from_srgb(drawn.rgb)), linear=linear)


@dataclass(frozen=True, eq=False)
class SunFit:
    """The Sun of a picture that does not name it, by a run whose training pictures did not name theirs."""

    finder: SunFinder  #: of the run's model

    name = "sun"
    how = "its direction, searched over the sphere by shading and shadows of a picture of 128 pixels"

    def fit(
        self, run: Predictor, picture: Picture, masks: Sequence[np.ndarray], start: Sequence[PictureLight]
    ) -> list[PictureLight]:
        """See `Unknown`. A Sun that is named stays."""
        pose = run.pose if isinstance(run, AlignedRun) else None
        camera = picture.camera if pose is None else pose.camera_in_model(picture.camera)
        opaque = np.ones(picture.rgb.shape[:2], np.float32)
        lights = []
        for mask, light in zip(masks, start, strict=True):
            if light.sun is None:
                image = Image(picture.rgb.astype(np.float32), opaque, mask)
                direction = self.finder.estimate(SmallPicture.of(camera, image, least=HALF)).direction
                if pose is not None:
                    direction = pose.rotation @ direction
                light = replace(light, sun=Sun(direction))
            lights.append(light)
        return lights


class GainFit:
    """The exposure of a picture: one factor on linear values (sRGB ones decoded), in closed form by least squares, over
    pixels that are not saturated in the picture."""

    name = "gain"
    how = "one factor on linear values, least squares over pixels that are not saturated"

    def fit(
        self, run: Predictor, picture: Picture, masks: Sequence[np.ndarray], start: Sequence[PictureLight]
    ) -> list[PictureLight]:
        """See `Unknown`."""
        truth = linear_from_srgb(picture.rgb).astype(np.float64)
        lights = []
        for mask, light in zip(masks, start, strict=True):
            drawn = linear_from_srgb(draw(run, picture.camera, light).rgb).astype(np.float64)
            counted = mask & (picture.rgb.max(axis=2) < SATURATED)
            squares = float(np.square(drawn[counted]).sum())
            factor = float((drawn[counted] * truth[counted]).sum()) / squares if squares > 0 else 1.0
            lights.append(replace(light, gain=light.gain * factor))
        return lights


@dataclass(frozen=True, eq=False)
class EmbeddingFit:
    """The embedding of a picture: the most likely one, where those of the training pictures are a normal distribution
    and errors, too (maximum a posteriori), by Gauss-Newton steps along the distribution's principal axes.

    Derivatives are differences of drawn pictures, smaller than the one to fit: of tens of numbers that is cheaper than
    descent by the adjoint's gradient, which takes some hundred pictures there and back, and has no step size to choose.
    NeRF-W (Martin-Brualla et al. 2021) descends, and fits the left half of a picture only.
    """

    mean: Array  #: [E]
    axes: Array  #: [E, K]: a standard deviation along each principal axis

    name = "embedding"

    @staticmethod
    def of(embeddings: Array) -> "EmbeddingFit":
        """embeddings: [V, E], of the training pictures"""
        mean = embeddings.mean(axis=0)
        _, lengths, directions = np.linalg.svd(embeddings - mean, full_matrices=False)
        variances = np.square(lengths) / max(len(embeddings) - 1, 1)
        total = float(variances.sum())
        needed = 1 + int(np.searchsorted(np.cumsum(variances), VARIANCE * total)) if total > 0 else 0
        count = min(needed, MAX_AXES, len(variances))
        return EmbeddingFit(mean, directions[:count].T * np.sqrt(variances[:count]))

    @property
    def how(self) -> str:
        """In words."""
        size, count = self.axes.shape
        return f"{size} numbers, Gauss-Newton along {count} principal axes of the training pictures' embeddings"

    def fit(
        self, run: Predictor, picture: Picture, masks: Sequence[np.ndarray], start: Sequence[PictureLight]
    ) -> list[PictureLight]:
        """See `Unknown`."""
        if not self.axes.shape[1]:
            return list(start)
        times = -(-max(picture.rgb.shape[:2]) // SIDE)
        small = _Reduced(run, picture, times, self)
        first: dict[bytes, tuple[Array, Array]] = {}  # both halves of a picture start at one place
        lights = []
        for mask, light in zip(masks, start, strict=True):
            key = b"" if light.sun is None else light.sun.direction.tobytes()
            if key not in first:
                first[key] = small.linearised(light, np.zeros(self.axes.shape[1]))
            numbers = _most_likely(small, light, small.share(mask), first[key])
            lights.append(replace(light, embedding=self.at(numbers)))
        return lights

    def at(self, numbers: Array) -> Array:
        """[E]: so many standard deviations [K] from the mean."""
        return self.mean + self.axes @ numbers


class _Reduced:
    """A picture with `times` x `times` pixels in one, and what a run draws of it."""

    def __init__(self, run: Predictor, picture: Picture, times: int, space: EmbeddingFit) -> None:
        self.run, self.times, self.space = run, times, space
        self.camera = picture.camera.downscaled(times)
        self.height, self.width = self.camera.height, self.camera.width
        self.truth = self._means(picture.rgb).reshape(-1, 3)

    def share(self, mask: np.ndarray) -> Array:
        """[P]: of each pixel, how much of it is in a mask."""
        return self._means(mask[..., None]).ravel()

    def drawn(self, light: PictureLight, numbers: Array) -> Array:
        """[P, 3]"""
        light = replace(light, embedding=self.space.at(numbers))
        rgb = draw(self.run, self.camera, light).rgb
        return np.asarray(np.clip(rgb, 0, 1), np.float64).reshape(-1, 3)

    def linearised(self, light: PictureLight, numbers: Array) -> tuple[Array, Array]:
        """(picture [P, 3], its derivatives [K, P, 3]) at `numbers` [K]."""
        here = self.drawn(light, numbers)
        there = [self.drawn(light, numbers + step) for step in STEP * np.eye(len(numbers))]
        return here, (np.stack(there) - here) / STEP

    def _means(self, values: np.ndarray) -> Array:
        """[height, width, C] of [H, W, C]; rows and columns that fill no square are left out."""
        inside = values[: self.height * self.times, : self.width * self.times].astype(np.float64)
        squares = inside.reshape(self.height, self.times, self.width, self.times, -1)
        return np.asarray(squares.mean(axis=(1, 3)))


def _most_likely(small: _Reduced, light: PictureLight, weights: Array, first: tuple[Array, Array]) -> Array:
    """[K] numbers that minimise the weighted squared error over the noise, whose variance is what is left of errors,
    plus |numbers|^2. weights: [P];  first: `linearised` at 0

    Pixels count as independent: with a prior 16 times as strong, pictures under Suns that training had not seen were
    0.7 dB worse on the half not fitted (boxsat, 96 x 96, 9 views)."""
    numbers = np.zeros(len(first[1]))
    if not weights.sum() > 0:
        return numbers

    def squares(drawn: Array) -> float:
        return float(weights @ np.square(drawn - small.truth).sum(axis=1))

    picture, slopes = first
    for iteration in range(ITERATIONS):
        if iteration:
            picture, slopes = small.linearised(light, numbers)
        error = squares(picture)
        noise = max(error / (3 * float(weights.sum())), 1e-8)
        weighted = slopes * weights[:, None]
        slope = np.einsum("kpc,pc->k", weighted, small.truth - picture) / noise - numbers
        curvature = np.einsum("kpc,jpc->kj", weighted, slopes) / noise + np.eye(len(numbers))
        step, cost = np.linalg.solve(curvature, slope), error / noise + float(numbers @ numbers)
        for _ in range(HALVINGS):
            there = numbers + step
            new_cost = squares(small.drawn(light, there)) / noise + float(there @ there)
            if new_cost < cost:
                break
            step = 0.5 * step
        else:
            return numbers
        numbers = there
        if new_cost > (1 - ENOUGH) * cost:
            break
    return numbers
