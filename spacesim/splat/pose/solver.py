"""Damped Gauss-Newton steps (Levenberg 1944, Marquardt 1963) on a picture of one size."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from spacesim.backend.arrays import Float
from spacesim.data.geometry import Array, cross_matrix
from spacesim.data.records import Camera
from spacesim.splat.pose.motion import Pivot, moved
from spacesim.splat.pose.picture import GAINS, SunlitRun, reduced, smoothed

BLURS = 2.0, 0.7  #: pixels, standard deviation: of the coarsest picture at first, and of all but the finest
OUTLIERS = 1.0, 0.3, 0.2  #: sRGB values, of these and the finest: an error so large counts half
STEP = 0.5  #: pixels to either side of a pose for its derivatives
MAX_STEP = 2.0  #: pixels of one step
MIN_STEP, CONVERGED = 1e-3, 0.1  #: pixels: no shorter step is tried; one so short says that this is the place
REACH = 2.0  #: no pose is farther from the given one than so many times `within`
PULL = 0.3  #: of the loss of a blurred picture: what half a squared `within` from the given pose costs


@dataclass(frozen=True, eq=False)
class State:
    """A pose on its way."""

    camera: Camera  #: with the pose found so far
    gain: float = 1.0  #: factor on what is drawn
    loss: float = np.inf  #: on the level where it was solved last; see `RefinedPose`
    iterations: int = 0  #: steps that the last solving took
    converged: bool = False  #: whether the last step was, at first, shorter than `CONVERGED`


class PyramidLevel:
    """The picture at one size. Unknowns [7]: a turn and a shift in steps that move pictures by `STEP` pixels, and the
    logarithm of the gain.

    factor: pixels of the whole picture on a side of one of its pixels
    blur: pixels of its own, standard deviation
    """

    def __init__(
        self,
        drawing: SunlitRun,
        pivot: Pivot,
        target: np.ndarray,
        counts: np.ndarray,
        background: np.ndarray | None,
        factor: int,
        blur: float,
    ) -> None:
        self.drawing, self.pivot, self.background = drawing, pivot, background
        self.factor, self.blur = factor, blur
        self.outlier = OUTLIERS[(blur < BLURS[0]) + (blur == 0)]
        self.target, self.counts = reduced(target, factor), reduced(counts, factor)

    def solve(self, state: State, most: int, enough: float = 0.0) -> State:
        """`state` after at most so many steps, fewer where they become shorter than `enough` pixels."""
        camera, gain, best, damping = state.camera, state.gain, np.inf, 1e-2
        for taken in range(1, most + 1):
            colors = self.shade(camera)
            picture = self.picture(camera, colors)
            errors = self.errors(picture, gain)
            best = cauchy_loss(errors, self.outlier)
            offset, pull = self.pivot.offset(camera), PULL * best if self.blur else 0.0
            best += 0.5 * pull * float(offset @ offset)
            columns = self.derivatives(camera, picture, colors, gain)
            weights = cauchy_weights(errors, self.outlier)
            normal, slope = (
                weighed_products(columns, columns, weights),
                weighed_products(columns, errors[None], weights)[:, 0],
            )
            towards = self._offsets(camera)
            normal[:6, :6] += pull * towards @ towards.T
            slope[:6] += pull * towards @ offset
            first = None
            while True:
                step = -np.linalg.solve(damped(normal, damping), slope)
                step[:6] *= min(1.0, MAX_STEP / STEP / max(np.abs(step[:6]).max(), 1e-12))
                length = float(np.abs(step[:6]).max()) * STEP
                first = length if first is None else first
                there, exposed = self._stepped(camera, step), float(np.clip(gain * np.exp(step[6]), *GAINS))
                if self.pivot.reach(there) <= REACH:
                    loss = cauchy_loss(self.errors(self.picture(there, colors), exposed), self.outlier)
                    loss += 0.5 * pull * float((self.pivot.offset(there) ** 2).sum())
                    if loss < best:
                        break
                if length < max(enough, MIN_STEP):
                    return State(camera, gain, best, taken, first < CONVERGED)
                damping *= 5
            camera, gain, best, damping = there, exposed, loss, max(damping / 5, 1e-6)
            if length < enough:
                return State(camera, gain, best, taken, first < CONVERGED)
        return State(camera, gain, best, most)

    def aligned(self, camera: Camera, colors: list[Float] | None, gain: float) -> tuple[Camera, float]:
        """The camera panned and tilted to where the model best covers the picture, and the sum of squares of errors
        there, less that of the picture: by correlation, at whole pixels."""
        picture, (height, width) = self.picture(camera, colors), self.target.shape[:2]
        shown = np.concatenate([gain * picture[..., :3], picture[..., 3:]], axis=-1)
        if self.background is not None:
            shown = shown[..., :3] - picture[..., 3:] * self.background
        spectrum, target_spectra = self._spectrum(smoothed(shown, self.blur)), self._spectra
        squares = self._spectrum((smoothed(shown, self.blur) ** 2).sum(axis=-1, keepdims=True))
        product = target_spectra[..., -1] * squares[..., 0].conj() - 2 * (
            target_spectra[..., :-1] * spectrum.conj()
        ).sum(axis=-1)
        costs = np.fft.irfft2(product, (2 * height, 2 * width))
        rows, columns = (np.fft.fftfreq(2 * side, 1 / (2 * side)) for side in (height, width))
        middle, scaled = self.pivot.seen_by(camera), camera.downscaled(self.factor)
        limit = (self.pivot.angle + self.pivot.length / np.linalg.norm(middle)) * max(scaled.fx, scaled.fy)
        costs[np.hypot(rows[:, None], columns) > max(limit, 1)] = np.inf
        row, column = np.unravel_index(int(costs.argmin()), costs.shape)
        there = middle + middle[2] * np.array([columns[column] / scaled.fx, rows[row] / scaled.fy, 0])
        axis, both = np.cross(middle, there), np.linalg.norm(middle) * np.linalg.norm(there)
        return moved(camera, np.concatenate([axis / both, np.zeros(3)])), float(costs[row, column])

    @cached_property
    def _spectra(self) -> np.ndarray:
        """Of the picture less its background, and of the pixels that count."""
        light = self.target if self.background is None else self.target - self.background
        return self._spectrum(
            np.concatenate([self.counts * smoothed(self.counts * light, self.blur), self.counts], axis=-1)
        )

    def _spectrum(self, planes: np.ndarray) -> np.ndarray:
        height, width = planes.shape[:2]
        return np.fft.rfft2(planes, (2 * height, 2 * width), axes=(0, 1))

    def shade(self, camera: Camera) -> list[Float] | None:
        return self.drawing.shade(camera.downscaled(self.factor))

    def picture(self, camera: Camera, colors: list[Float] | None) -> np.ndarray:
        return self.drawing.draw(camera.downscaled(self.factor), colors)

    def errors(self, picture: np.ndarray, gain: float) -> np.ndarray:
        """[h, w, C] model less picture."""
        shown = gain * picture[..., :3]
        if self.background is None:
            shown = np.concatenate([shown, picture[..., 3:]], axis=-1)
        else:
            shown = shown + (1 - picture[..., 3:]) * self.background
        return self._blurred(shown - self.target)

    def derivatives(
        self, camera: Camera, picture: np.ndarray, colors: list[Float] | None, gain: float, wide: float = 1.0
    ) -> np.ndarray:
        """[7, h, w, C] of the errors by the unknowns: central differences of drawn pictures, over `wide` steps."""
        columns = []
        for way in np.eye(6, dtype=np.float64):
            ends = [self.picture(self._stepped(camera, step), colors) for step in (wide * way, -wide * way)]
            ahead, behind = (self.errors(end, gain) for end in ends)
            columns.append(0.5 * (ahead - behind) / wide)
        brighter = np.zeros_like(self.target)
        if self.blur < BLURS[0]:  # far from its place, a picture that does not fit would be dimmed, not moved
            brighter[..., :3] = gain * picture[..., :3]
        return np.stack([*columns, self._blurred(brighter)])

    def _blurred(self, planes: np.ndarray) -> np.ndarray:
        """Of pixels that count."""
        planes = self.counts * planes
        return smoothed(planes, self.blur)

    def units(self, camera: Camera) -> Array:
        """[6] radians and metres that move the picture by `STEP` pixels, those of depth at the model's rim."""
        middle, scaled = self.pivot.seen_by(camera), camera.downscaled(self.factor)
        distance = max(float(middle[2]), self.pivot.radius)
        metres = STEP * distance / np.sqrt(scaled.fx * scaled.fy)
        turn = metres / self.pivot.radius
        return np.array([turn, turn, turn, metres, metres, turn * distance])

    def _stepped(self, camera: Camera, step: np.ndarray) -> Camera:
        numbers = self.units(camera) * step[:6]
        return self.pivot.turned(camera, numbers[:3], numbers[3:])

    def _offsets(self, camera: Camera) -> Array:
        """[6, 6] derivatives of `Pivot.offset`: unknowns, then its numbers."""
        ways = 1e-3 * np.eye(6)
        ahead, behind = (
            np.array([self.pivot.offset(self._stepped(camera, sign * way)) for way in ways]) for sign in (1, -1)
        )
        derivatives: Array = (ahead - behind) / 2e-3
        return derivatives

    def twists(self, camera: Camera) -> Array:
        """[6, 6] derivative of the twist of `moved` by the first six unknowns, at 0."""
        jacobian = np.eye(6)
        jacobian[3:, :3] = cross_matrix(self.pivot.seen_by(camera))  # v = shift + middle x turn
        return jacobian * self.units(camera)


def cauchy_loss(errors: np.ndarray, scale: float) -> float:
    """Cauchy's: log(1 + |e|^2 / s^2) s^2 / 2, summed over pixels."""
    squares = (errors * errors).sum(axis=-1, dtype=np.float64)
    return float(0.5 * scale**2 * np.log1p(squares / scale**2).sum())


def cauchy_weights(errors: np.ndarray, scale: float) -> np.ndarray:
    """[h, w] of its derivative: d loss = weight e de."""
    return 1 / (1 + (errors * errors).sum(axis=-1) / scale**2)


def weighed_products(rows: np.ndarray, columns: np.ndarray, weights: np.ndarray) -> Array:
    """[I, J] weighed sums of products of rows [I, h, w, C] and columns [J, h, w, C]; weights: [h, w]."""
    left, right = (weights[..., None] * rows).reshape(len(rows), -1), columns.reshape(len(columns), -1)
    return np.array([[np.sum(first * second, dtype=np.float64) for second in right] for first in left])


def damped(normal: Array, damping: float) -> Array:
    """With a share of its diagonal more, and a little more still: no picture constrains an unknown that it does not
    depend on."""
    diagonal = np.diag(normal)
    return normal + np.diag(damping * diagonal + 1e-9 * diagonal.mean() + 1e-20)
