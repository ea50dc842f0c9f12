"""Where a camera stood: a pose refined from a picture and a trained model.

Damped Gauss-Newton steps (Levenberg 1944, Marquardt 1963) on SE(3), from coarse and blurred pictures to the picture
itself. They start from the best of random poses about the given one, each drawn small and panned to fit the picture by
correlation: a camera's turn about itself moves what it sees and hardly changes it. Such a step asks for the derivative
of every pixel, an adjoint gives that of one number: so derivatives are central differences of 12 drawn pictures. Of
three views tried, Adam on the adjoint's gradient came to nearly the same pose in two, taking twice as long, and ran
away in the third.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from spacesim.backend.arrays import Float
from spacesim.data.errors import InputError
from spacesim.data.geometry import Array
from spacesim.data.records import Camera, Image, Sun
from spacesim.splat.light.model import LightModel
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.render import RenderOutput, render
from spacesim.splat.raster.supersample import render_supersampled
from spacesim.splat.raster.tone import adjust_exposure
from spacesim.splat.run import Run, check_gaussians, check_picture

UNKNOWNS = 7  #: a turn, a shift and the logarithm of the gain
COARSEST = 64  #: pixels that the longer side of the coarsest picture keeps
BLURS = 2.0, 0.7  #: pixels, standard deviation: of the coarsest picture at first, and of all but the finest
OUTLIERS = 1.0, 0.3, 0.2  #: sRGB values, of these and the finest: an error so large counts half
STEP = 0.5  #: pixels to either side of a pose for its derivatives
MAX_STEP = 2.0  #: pixels of one step
ENOUGH = 0.05, 0.005  #: pixels: shorter steps end a coarse level, and the finest one
MIN_STEP, CONVERGED = 1e-3, 0.1  #: pixels: no shorter step is tried; one so short says that this is the place
ITERATIONS = 20  #: steps on a level at most
CANDIDATES = 128  #: random poses that are looked at for starts
FIRST_ITERATIONS = 4  #: steps that every start gets before the best goes on
GAINS = 0.5, 2.0  #: bounds on the picture's sRGB values over the model's: 2.3 stops
REACH = 2.0  #: no pose is farther from the given one than so many times `within`
NEARLY = 0.95  #: of that bound: a pose beyond is at it
PULL = 0.3  #: of the loss of a blurred picture: what half a squared `within` from the given pose costs
SMOOTHING = 0.08  #: of the model's apparent radius: errors are smoothed so far, against noise, for what is next
EXPLAINED = 0.09  #: of that radius: a shift; what is left of errors at a trusted pose is below those of it
WIDE = 4.0  #: steps to either side for the covariance's: jumps of pictures, as of order in depth, look like knowledge
BLOCK = 8  #: pixels: errors within a square of this side may depend on each other
ROUNDING = 1 / 255 / np.sqrt(12)  #: standard deviation of sRGB values of 8 bits


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """A camera that stands where its picture says.

    The covariance is of the small motion from this camera to the true one, `moved(camera, twist)`: rotation vector in
    radians, then translation in metres, camera axes. It is that of a robust estimate, with errors of pixels that
    depend on each other within blocks of 8 x 8 pixels: by how much the pose moves where one after the other is left out
    (the jackknife, CR3 of Bell and McCaffrey 2002), and of rounding to 8 bits. It holds what the errors at the end say,
    so noise and what the model shows otherwise here and there; not a model that is wrong as a whole, whose errors
    depend on each other farther off, nor wrong intrinsics, nor another minimum. Of noise alone on small pictures,
    errors were 1.2 times what it says, as pictures of Gaussians jump where their order changes. Take it as a lower
    bound.
    """

    camera: Camera  #: the given one at its refined place
    covariance: Array  #: [6, 6] symmetric, positive definite
    gain: float  #: sRGB values of the picture over those of the model: exposure
    error: float  #: root mean square difference of sRGB values where the model is, outliers weighed down
    converged: bool  #: whether the pose may be trusted: see `refine_pose`
    iterations: int  #: steps of all starts and sizes


def refine_pose(
    run: Run,
    image: ArrayLike | Image,
    camera: Camera,
    sun: Sun | Sequence[float] | None = None,
    mask: ArrayLike | None = None,
    within: tuple[float, float] = (5.0, 0.05),
    starts: int = 4,
    seed: int = 0,
) -> RefinedPose:
    """The pose at which the model of `run` looks most like `image`, near that of `camera`.

    image: [H, W, 3] sRGB values, float in [0, 1] or uint8, or [H, W, 4] with straight alpha; or what `load_image` gives
    camera: a guess of the pose, with the picture's size and intrinsics (no distortion)
    sun: as for `Run.render`, in the frame of the model
    mask: [H, W], where not 0 the pixel counts; by default all do
    within: (degrees, share of the distance) by which the guess may well be off, as it turns and where it stands.
        Starts are searched so far off. Poses nearer to the guess are preferred while pictures are blurred, and none is
        turned or moved by more than twice that
    starts: how many of the best of 128 random poses are tried;  seed: of these. The same seed gives the same bits

    The picture's exposure is free: a factor of 0.5 to 2 on sRGB values. Of a picture with alpha, colours and alpha are
    compared. One without, or with an alpha of 1 everywhere, is compared with the model over one colour, the median of
    the picture where the model is not. What is not so, stars or the Earth, is an outlier (Cauchy's loss); mask it if it
    is large. Colours that depend on the view are computed anew before each step and count as given within it.

    `converged` is True where steps had become shorter than a tenth of a pixel, the pose is not at the bound (off by
    less than 1.9 times `within`), and what is left of errors is smaller than what a shift by 9 % of the model's
    apparent radius makes, both smoothed over 8 % of it: a wrong pose or another object leaves more, noise of pixels
    does not. What is dark before a dark sky cannot be seen: then it is often False.

    Raises InputError where the picture, the mask or the numbers are not as above, where the run needs a Sun and none is
    told, and where the camera does not see the model.
    """
    check_gaussians(run)
    told = Sun.of(sun)
    if told is None and run.relightable:
        raise InputError(f"sun: expected its direction for a run of {run.config['method']}, found none")
    target, counts = checked_picture(image, mask, camera)
    _check_numbers(within, starts)
    check_picture(camera)
    drawing = _Drawing.of(run, told)
    pivot = _Pivot.of(drawing, camera, within)
    background = _background(target, counts, pivot.alpha)

    longer, coarsest = max(camera.width, camera.height), 1
    while longer // (2 * coarsest) >= COARSEST:
        coarsest *= 2
    halvings = [2**k for k in range(int(np.log2(coarsest)), 0, -1)]
    sizes = [(coarsest, BLURS[0]), *((factor, BLURS[1]) for factor in halvings), (1, 0.0)]
    levels = [_Level(drawing, pivot, target, counts, background, *size) for size in sizes]
    gain = _first_gain(target, counts, background, drawing.draw(camera, drawing.shade(camera)))
    searched = _searched(levels[0], gain, starts, seed)
    states = [levels[0].solve(_State(candidate, gain), FIRST_ITERATIONS) for candidate in searched]
    taken, state = sum(candidate.iterations for candidate in states), min(states, key=lambda candidate: candidate.loss)
    for level in levels:
        state = level.solve(state, ITERATIONS, ENOUGH[level.factor == 1 and level.blur == 0])
        taken += state.iterations
    covariance, error, shift = levels[-1].uncertainty(state)
    trusted = state.converged and pivot.reach(state.camera) < NEARLY * REACH and shift < EXPLAINED
    return RefinedPose(state.camera, covariance, state.gain, error, trusted, taken)


def moved(camera: Camera, twist: ArrayLike) -> Camera:
    """The camera after a motion, as `Projection.moved` has it: points go from `camera`'s axes to the moved one's by
    p' = exp([w]) p + v. twist: [6] = (w, v), rotation vector in radians and translation in metres, camera axes."""
    numbers = np.asarray(twist, np.float64)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = Rotation.from_rotvec(numbers[:3]).as_matrix(), numbers[3:]
    motion[:3, :3] = motion[:3, :3].T  # the inverse
    motion[:3, 3] = -motion[:3, :3] @ motion[:3, 3]
    return replace(camera, world_from_camera=camera.world_from_camera @ motion)


def twist_between(camera: Camera, other: Camera) -> Array:
    """[6] the motion from `camera` to `other`: the inverse of `moved`, for rotations below pi."""
    motion = other.camera_from_world @ camera.world_from_camera
    return np.concatenate([Rotation.from_matrix(motion[:3, :3]).as_rotvec(), motion[:3, 3]])


@dataclass(frozen=True, eq=False)
class _Drawing:
    """A run under one Sun."""

    run: Run
    sun: Array | None  #: [3], towards it
    sunlight: Any  #: `LightModel.sunlight` of it, None of a run without light

    @staticmethod
    def of(run: Run, sun: Sun | None) -> "_Drawing":
        direction = None if sun is None else sun.direction
        sunlight = run.light.sunlight(run.gaussians, direction) if run.light else None
        return _Drawing(run, direction, sunlight)

    def shade(self, camera: Camera) -> list[Float] | None:
        """Colours [N] three times as seen by a camera; None of harmonics, which are summed while drawing."""
        if self.run.light is None:
            return None
        light: LightModel = self.run.light
        model: Gaussians = self.run.gaussians
        colors, _ = light.shade_picture(model, Pinhole.of(camera), self.sun, sunlight=self.sunlight)
        return colors

    def draw(self, camera: Camera, colors: list[Float] | None) -> np.ndarray:
        """[H, W, 4] float32: sRGB values over black, alpha."""
        output = self.output(camera, colors)
        rgb = output.image("color" if colors is None else "features")
        if self.run.curve:
            rgb = adjust_exposure(rgb, self.run.curve[0])
        return np.concatenate([rgb, output.image("alpha")[..., None]], axis=-1)

    def output(self, camera: Camera, colors: list[Float] | None, *outputs: str) -> RenderOutput:
        """As `Run.predict` draws it. outputs: their names, beside the colours"""
        run = self.run
        names = outputs if colors is not None else ("color", *outputs)
        plain = partial(render, run.gaussians, outputs=names, features=colors, antialiased=run.antialiased)
        color_count = 0 if colors is None else 3
        return render_supersampled(plain, camera, run.supersample, colors=color_count, linear=run.curve is not None)


@dataclass(frozen=True, eq=False)
class _Pivot:
    """What a camera sees of the model at first. Poses turn about its middle: turns and shifts are then nearly
    independent of each other in pictures."""

    camera: Camera  #: the given one
    point: Array  #: [3] metres, world
    radius: float  #: root mean square distance from it of the surface seen, metres
    alpha: np.ndarray  #: [H, W]
    angle: float  #: radians that the pose may well be off
    length: float  #: metres that the pose may well be off

    @staticmethod
    def of(drawing: _Drawing, camera: Camera, within: tuple[float, float]) -> "_Pivot":
        """Raises InputError where the camera does not see the model."""
        output = drawing.output(camera, drawing.shade(camera), "depth")
        alpha, depth = output.image("alpha"), output.image("depth")
        rows, columns = np.nonzero(alpha > 0.5 * alpha.max())
        if alpha.max() < 0.5:
            raise InputError("camera: expected one that sees the model, found one before which it is not")
        z = depth[rows, columns].astype(np.float64)
        x, y = (columns + 0.5 - camera.cx) / camera.fx * z, (rows + 0.5 - camera.cy) / camera.fy * z
        points = np.stack([x, y, z], axis=1)
        middle = points.mean(axis=0)
        radius = float(np.sqrt(((points - middle) ** 2).sum(axis=1).mean()))
        distance = float(np.linalg.norm(middle))
        point = camera.world_from_camera[:3, :3] @ middle + camera.position
        radius = max(radius, 1e-3 * distance)
        return _Pivot(camera, point, radius, alpha, float(np.radians(within[0])), within[1] * distance)

    def seen_by(self, camera: Camera) -> Array:
        """[3] the point in the camera's axes, metres."""
        position: Array = camera.camera_from_world[:3, :3] @ (self.point - camera.position)
        return position

    def turned(self, camera: Camera, turn: Array, shift: Array) -> Camera:
        """The camera after a turn (rotation vector [3]) about the point, and a shift [3], metres, both in its axes."""
        middle = self.seen_by(camera)
        return moved(camera, np.concatenate([turn, shift + middle - Rotation.from_rotvec(turn).apply(middle)]))

    def offset(self, camera: Camera) -> Array:
        """[6] turn and shift from the given camera, each by how much that may well be off."""
        turn = twist_between(self.camera, camera)[:3] / self.angle
        return np.concatenate([turn, (camera.position - self.camera.position) / self.length])

    def reach(self, camera: Camera) -> float:
        """The larger of turn and shift."""
        offset = self.offset(camera)
        return float(max(np.linalg.norm(offset[:3]), np.linalg.norm(offset[3:])))


def _searched(level: "_Level", gain: float, starts: int, seed: int) -> list[Camera]:
    """The best of the given camera and of random ones about it, rolled, in orbit, nearer and farther by up to what it
    may be off, each panned and tilted to fit the picture best."""
    pivot, rng = level.pivot, np.random.default_rng(seed)
    camera = level.aligned(pivot.camera, level._shade(pivot.camera), gain)[0]
    colors, distance = level._shade(camera), float(np.linalg.norm(pivot.seen_by(camera)))
    orbit = pivot.length / distance
    candidates = [level.aligned(camera, colors, gain)]
    for numbers in rng.uniform(-1, 1, (CANDIDATES, 4)):
        turn, shift = np.array([orbit, orbit, pivot.angle]) * numbers[:3], pivot.length * numbers[3]
        candidates.append(level.aligned(pivot.turned(camera, turn, np.array([0, 0, shift])), colors, gain))
    order = np.argsort([squares for _, squares in candidates], kind="stable")
    return [candidates[k][0] for k in order[:starts]]


@dataclass(frozen=True, eq=False)
class _State:
    """A pose on its way."""

    camera: Camera
    gain: float = 1.0
    loss: float = np.inf  #: on the level where it was solved last; see `RefinedPose`
    iterations: int = 0
    converged: bool = False


class _Level:
    """The picture at one size. factor: pixels of the whole picture on a side of one of its pixels;  blur: pixels of
    its own, standard deviation. Unknowns [7]: a turn and a shift in steps that move pictures by `STEP` pixels, and
    the logarithm of the gain."""

    def __init__(
        self,
        drawing: _Drawing,
        pivot: _Pivot,
        target: np.ndarray,
        counts: np.ndarray,
        background: np.ndarray | None,
        factor: int,
        blur: float,
    ) -> None:
        self.drawing, self.pivot, self.background = drawing, pivot, background
        self.factor, self.blur = factor, blur
        self.outlier = OUTLIERS[(blur < BLURS[0]) + (blur == 0)]
        self.target, self.counts = _reduced(target, factor), _reduced(counts, factor)

    def solve(self, state: _State, most: int, enough: float = 0.0) -> _State:
        """`state` after at most so many steps, fewer where they become shorter than `enough` pixels."""
        camera, gain, best, damping = state.camera, state.gain, np.inf, 1e-2
        for taken in range(1, most + 1):
            colors = self._shade(camera)
            picture = self._picture(camera, colors)
            errors = self._errors(picture, gain)
            best = _loss(errors, self.outlier)
            offset, pull = self.pivot.offset(camera), PULL * best if self.blur else 0.0
            best += 0.5 * pull * float(offset @ offset)
            columns = self._derivatives(camera, picture, colors, gain)
            weights = _weights(errors, self.outlier)
            normal, slope = _products(columns, columns, weights), _products(columns, errors[None], weights)[:, 0]
            towards = self._offsets(camera)
            normal[:6, :6] += pull * towards @ towards.T
            slope[:6] += pull * towards @ offset
            first = None
            while True:
                step = -np.linalg.solve(_damped(normal, damping), slope)
                step[:6] *= min(1.0, MAX_STEP / STEP / max(np.abs(step[:6]).max(), 1e-12))
                length = float(np.abs(step[:6]).max()) * STEP
                first = length if first is None else first
                there, exposed = self._stepped(camera, step), float(np.clip(gain * np.exp(step[6]), *GAINS))
                if self.pivot.reach(there) <= REACH:
                    loss = _loss(self._errors(self._picture(there, colors), exposed), self.outlier)
                    loss += 0.5 * pull * float((self.pivot.offset(there) ** 2).sum())
                    if loss < best:
                        break
                if length < max(enough, MIN_STEP):
                    return _State(camera, gain, best, taken, first < CONVERGED)
                damping *= 5
            camera, gain, best, damping = there, exposed, loss, max(damping / 5, 1e-6)
            if length < enough:
                return _State(camera, gain, best, taken, first < CONVERGED)
        return _State(camera, gain, best, most)

    def aligned(self, camera: Camera, colors: list[Float] | None, gain: float) -> tuple[Camera, float]:
        """The camera panned and tilted to where the model best covers the picture, and the sum of squares of errors
        there, less that of the picture: by correlation, at whole pixels."""
        picture, (height, width) = self._picture(camera, colors), self.target.shape[:2]
        shown = np.concatenate([gain * picture[..., :3], picture[..., 3:]], axis=-1)
        if self.background is not None:
            shown = shown[..., :3] - picture[..., 3:] * self.background
        spectrum, target_spectra = self._spectrum(_smoothed(shown, self.blur)), self._spectra
        squares = self._spectrum((_smoothed(shown, self.blur) ** 2).sum(axis=-1, keepdims=True))
        product = target_spectra[..., -1] * squares[..., 0].conj() - 2 * (
            target_spectra[..., :-1] * spectrum.conj()
        ).sum(axis=-1)
        costs = np.fft.irfft2(product, (2 * height, 2 * width))
        rows, columns = (np.fft.fftfreq(2 * side, 1 / (2 * side)) for side in (height, width))
        middle, scaled = self.pivot.seen_by(camera), self._scaled(camera)
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
            np.concatenate([self.counts * _smoothed(self.counts * light, self.blur), self.counts], axis=-1)
        )

    def _spectrum(self, planes: np.ndarray) -> np.ndarray:
        height, width = planes.shape[:2]
        return np.fft.rfft2(planes, (2 * height, 2 * width), axes=(0, 1))

    def uncertainty(self, state: _State) -> tuple[Array, float, float]:
        """Covariance [6, 6] and root mean square error, see `RefinedPose`; and the shift whose smoothed errors
        are as large, as a share of the model's radius."""
        colors = self._shade(state.camera)
        picture = self._picture(state.camera, colors)
        errors = self._errors(picture, state.gain)
        columns = self._derivatives(state.camera, picture, colors, state.gain, WIDE)
        weights = _weights(errors, self.outlier)
        scores, normals = _of_blocks(columns, errors, weights)
        normal = _damped(normals.sum(axis=0), 0.0)
        left_out = np.linalg.solve(normal - normals, scores[..., None])[..., 0]  # by how much it moves without a block
        inverse = np.linalg.inv(normal)
        rounding = inverse @ _products(columns, columns, weights * weights) @ inverse
        twists = self._twists(state.camera)
        covariance = twists @ (left_out.T @ left_out + ROUNDING**2 * rounding)[:6, :6] @ twists.T
        inside = weights * (picture[..., 3] > 1 / 255)
        error = np.sqrt((inside * (errors * errors).mean(axis=-1)).sum() / max(inside.sum(), 1e-12))
        pixel = self._units(state.camera)[3] / STEP / self.pivot.radius
        roots = np.sqrt(weights)[..., None]
        smoothed = [_smoothed(roots * planes, SMOOTHING / pixel) for planes in (errors, *columns[3:5])]
        squares = [float((planes * planes).sum(dtype=np.float64)) for planes in smoothed]
        shift = STEP * pixel * np.sqrt(2 * squares[0] / max(squares[1] + squares[2], 1e-12))
        return 0.5 * (covariance + covariance.T), float(error), float(shift)

    def _scaled(self, camera: Camera) -> Camera:
        """The camera with the pixels of this level."""
        factor = self.factor
        numbers = [number / factor for number in (camera.fx, camera.fy, camera.cx, camera.cy)]
        return Camera(camera.world_from_camera, camera.width // factor, camera.height // factor, *numbers)

    def _shade(self, camera: Camera) -> list[Float] | None:
        return self.drawing.shade(self._scaled(camera))

    def _picture(self, camera: Camera, colors: list[Float] | None) -> np.ndarray:
        return self.drawing.draw(self._scaled(camera), colors)

    def _errors(self, picture: np.ndarray, gain: float) -> np.ndarray:
        """[h, w, C] model less picture."""
        shown = gain * picture[..., :3]
        if self.background is None:
            shown = np.concatenate([shown, picture[..., 3:]], axis=-1)
        else:
            shown = shown + (1 - picture[..., 3:]) * self.background
        return self._blurred(shown - self.target)

    def _derivatives(
        self, camera: Camera, picture: np.ndarray, colors: list[Float] | None, gain: float, wide: float = 1.0
    ) -> np.ndarray:
        """[7, h, w, C] of the errors by the unknowns: central differences of drawn pictures, over `wide` steps."""
        columns = []
        for way in np.eye(6, dtype=np.float64):
            ends = [self._picture(self._stepped(camera, step), colors) for step in (wide * way, -wide * way)]
            ahead, behind = (self._errors(end, gain) for end in ends)
            columns.append(0.5 * (ahead - behind) / wide)
        brighter = np.zeros_like(self.target)
        if self.blur < BLURS[0]:  # far from its place, a picture that does not fit would be dimmed, not moved
            brighter[..., :3] = gain * picture[..., :3]
        return np.stack([*columns, self._blurred(brighter)])

    def _blurred(self, planes: np.ndarray) -> np.ndarray:
        """Of pixels that count."""
        planes = self.counts * planes
        return _smoothed(planes, self.blur)

    def _units(self, camera: Camera) -> Array:
        """[6] radians and metres that move the picture by `STEP` pixels, those of depth at the model's rim."""
        middle, scaled = self.pivot.seen_by(camera), self._scaled(camera)
        distance = max(float(middle[2]), self.pivot.radius)
        metres = STEP * distance / np.sqrt(scaled.fx * scaled.fy)
        turn = metres / self.pivot.radius
        return np.array([turn, turn, turn, metres, metres, turn * distance])

    def _stepped(self, camera: Camera, step: np.ndarray) -> Camera:
        numbers = self._units(camera) * step[:6]
        return self.pivot.turned(camera, numbers[:3], numbers[3:])

    def _offsets(self, camera: Camera) -> Array:
        """[6, 6] derivatives of `_Pivot.offset`: unknowns, then its numbers."""
        ways = 1e-3 * np.eye(6)
        ahead, behind = (
            np.array([self.pivot.offset(self._stepped(camera, sign * way)) for way in ways]) for sign in (1, -1)
        )
        derivatives: Array = (ahead - behind) / 2e-3
        return derivatives

    def _twists(self, camera: Camera) -> Array:
        """[6, 6] derivative of the twist of `moved` by the first six unknowns, at 0."""
        x, y, z = self.pivot.seen_by(camera)
        jacobian = np.eye(6)
        jacobian[3:, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]  # v = shift + middle x turn
        return jacobian * self._units(camera)


def _smoothed(planes: np.ndarray, blur: float) -> np.ndarray:
    smooth: np.ndarray = gaussian_filter(planes, (blur, blur, 0), mode="nearest") if blur else planes
    return smooth


def _of_blocks(columns: np.ndarray, errors: np.ndarray, weights: np.ndarray) -> tuple[Array, Array]:
    """([B, I] weighed sums of products of columns [I, h, w, C] and errors [h, w, C], [B, I, I] of columns with each
    other) over squares of `BLOCK` pixels."""
    starts = np.arange(0, errors.shape[1], BLOCK)
    scores: list[Array] = []
    normals: list[Array] = []
    for top in range(0, errors.shape[0], BLOCK):
        band = np.s_[top : top + BLOCK]
        weighed = columns[:, band] * weights[band, :, None]
        for found, sums in (
            (scores, np.einsum("ihwc,hwc->wi", weighed, errors[band], dtype=np.float64)),
            (normals, np.einsum("ihwc,jhwc->wij", weighed, columns[:, band], dtype=np.float64)),
        ):
            found.append(np.add.reduceat(sums, starts, axis=0))
    return np.concatenate(scores), np.concatenate(normals)


def _products(rows: np.ndarray, columns: np.ndarray, weights: np.ndarray) -> Array:
    """[I, J] weighed sums of products of rows [I, h, w, C] and columns [J, h, w, C]; weights: [h, w]."""
    left, right = (weights[..., None] * rows).reshape(len(rows), -1), columns.reshape(len(columns), -1)
    return np.array([[np.sum(first * second, dtype=np.float64) for second in right] for first in left])


def _damped(normal: Array, damping: float) -> Array:
    """With a share of its diagonal more, and a little more still: no picture tells of an unknown that it does not
    depend on."""
    diagonal = np.diag(normal)
    return normal + np.diag(damping * diagonal + 1e-9 * diagonal.mean() + 1e-20)


def _loss(errors: np.ndarray, scale: float) -> float:
    """Cauchy's: log(1 + |e|^2 / s^2) s^2 / 2, summed over pixels."""
    squares = (errors * errors).sum(axis=-1, dtype=np.float64)
    return float(0.5 * scale**2 * np.log1p(squares / scale**2).sum())


def _weights(errors: np.ndarray, scale: float) -> np.ndarray:
    """[h, w] of its derivative: d loss = weight e de."""
    return 1 / (1 + (errors * errors).sum(axis=-1) / scale**2)


def _reduced(planes: np.ndarray, factor: int) -> np.ndarray:
    """[h, w, C] means of squares of pixels; what is left over at the right and below goes."""
    height, width = planes.shape[0] // factor, planes.shape[1] // factor
    squares = planes[: height * factor, : width * factor].reshape(height, factor, width, factor, -1)
    return squares.mean(axis=(1, 3), dtype=np.float32)


def _background(target: np.ndarray, counts: np.ndarray, alpha: np.ndarray) -> np.ndarray | None:
    """[3] median of the picture where the model is not; None of a picture with alpha."""
    if target.shape[2] == 4:
        return None
    around = target[(alpha < 1 / 255) & (counts[..., 0] > 0)]
    return np.median(around, axis=0).astype(np.float32) if len(around) else np.zeros(3, np.float32)


def _first_gain(target: np.ndarray, counts: np.ndarray, background: np.ndarray | None, model: np.ndarray) -> float:
    """Light of the picture over that of the model, which hardly depends on where in the picture it is."""
    light = target[..., :3] if background is None else target - (1 - model[..., 3:]) * background
    target_sum, model_sum = (float((counts * planes).sum(dtype=np.float64)) for planes in (light, model[..., :3]))
    return float(np.clip(target_sum / max(model_sum, 1e-9), *GAINS))


def checked_picture(image: ArrayLike | Image, mask: ArrayLike | None, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """([H, W, 3] or premultiplied [H, W, 4], [H, W, 1] 1 where it counts, 0 elsewhere), float32."""
    size = (camera.height, camera.width)
    counts = np.ones(size, np.float32)
    if isinstance(image, Image):
        counts, image = image.valid.astype(np.float32), np.dstack([image.rgb, image.alpha])
    pixels = np.asarray(image)
    if pixels.ndim != 3 or pixels.shape[:2] != size or pixels.shape[2] not in (3, 4):
        expected = f"[{camera.height}, {camera.width}, 3 or 4] as the camera has it"
        raise InputError(f"image: expected {expected}, found {list(pixels.shape)}")
    if not (np.issubdtype(pixels.dtype, np.floating) or pixels.dtype == np.uint8):
        raise InputError(f"image: expected float values in [0, 1] or uint8, found {pixels.dtype}")
    pixels = pixels.astype(np.float32) / (255 if pixels.dtype == np.uint8 else 1)
    if not (np.isfinite(pixels).all() and pixels.min() >= 0 and pixels.max() <= 1):
        raise InputError("image: expected float values in [0, 1] or uint8, found others")
    if mask is not None:
        chosen = np.asarray(mask)
        if chosen.shape != size or chosen.dtype == object:
            raise InputError(f"mask: expected {list(size)} as the camera has it, found {list(chosen.shape)}")
        counts = counts * (chosen != 0)
    if not counts.any():
        raise InputError("mask: expected pixels that count, found none")
    if pixels.shape[2] == 4:
        opaque = pixels[..., 3:].min() == 1
        pixels = pixels[..., :3] if opaque else np.dstack([pixels[..., :3] * pixels[..., 3:], pixels[..., 3:]])
    return np.ascontiguousarray(pixels), counts.astype(np.float32)[..., None]


def _check_numbers(within: tuple[float, float], starts: int) -> None:
    numbers = np.asarray(within, np.float64)
    if numbers.shape != (2,) or not (0 < numbers[0] <= 60 and 0 < numbers[1] <= 0.5):
        raise InputError(f"within: expected degrees up to 60 and a share of the distance up to 0.5, found {within}")
    if starts < 1:
        raise InputError(f"starts: expected at least 1, found {starts}")
