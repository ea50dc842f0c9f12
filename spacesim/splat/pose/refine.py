"""Where a camera stood: a pose refined from a picture and a trained model.

Damped Gauss-Newton steps (Levenberg 1944, Marquardt 1963) on SE(3), from coarse and blurred pictures to the picture
itself. They start from the best of random poses about the given one, each drawn small and panned to fit the picture by
correlation: a camera's turn about itself moves what it sees and hardly changes it. A step needs the derivatives of
every pixel, and an adjoint gives those of one number alone: so they are central differences of 12 rendered pictures.
Adam, which does with the adjoint's gradient, takes twice as long and diverges from some poses.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from spacesim.data.errors import InputError, expect
from spacesim.data.geometry import Array
from spacesim.data.records import Camera, Image, Sun
from spacesim.data.structure import checked
from spacesim.learning.rendering import checked_sun
from spacesim.splat.pose.covariance import uncertainty
from spacesim.splat.pose.motion import Pivot
from spacesim.splat.pose.picture import GAINS, SunlitRun, background_of, checked_picture, first_gain
from spacesim.splat.pose.solver import BLURS, REACH, PyramidLevel, State
from spacesim.splat.run import Predictor, check_gaussians, check_picture

COARSEST = 64  #: pixels that the longer side of the coarsest picture keeps
ENOUGH = 0.05, 0.005  #: pixels: shorter steps end a coarse level, and the finest one
ITERATIONS = 20  #: steps on a level at most
CANDIDATES = 128  #: random poses that are looked at for starts
FIRST_ITERATIONS = 4  #: steps that every start gets before the best goes on
NEARLY = 0.95  #: of `REACH` and of `GAINS`: what is beyond is at the bound
EXPLAINED = (
    0.09  #: of the model's apparent radius: a shift; what is left of errors at a trusted pose is below those of it
)


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


@checked
def refine_pose(
    run: Predictor | str | Path,
    image: str | Path | ArrayLike | Image,
    camera: Camera,
    sun: Sun | Sequence[float] | None = None,
    mask: ArrayLike | None = None,
    within: tuple[float, float] = (5.0, 0.05),
    starts: int = 4,
    seed: int = 0,
) -> RefinedPose:
    """The pose at which the model of `run` looks most like `image`, near that of `camera`.

    run: what `load_run` returns, or its folder
    image: [H, W, 3] sRGB values, float in [0, 1] or uint8, or [H, W, 4] with straight alpha; or the path of a picture,
        or what `load_image` gives
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

    `converged` is True where steps had become shorter than a tenth of a pixel, the pose is not at its bound (off by
    less than 1.9 times `within`), nor the exposure at its own (0.53 to 1.9), and what is left of errors is smaller than
    what a shift by 9 % of the model's apparent radius makes, both smoothed over 8 % of it: a wrong pose or another
    object leaves more, noise of pixels does not. What is dark before a dark sky cannot be seen: then it is often False.

    Raises InputError where the picture, the mask or the numbers are not as above, where the run needs a Sun and none is
    given, and where the camera does not see the model.
    """
    run = check_gaussians(run)
    direction = checked_sun(sun, run.relightable, f"a run of {run.config['method']}")
    target, counts = checked_picture(image, mask, camera)
    _check_numbers(within, starts, seed)
    check_picture(camera)
    drawing = SunlitRun.of(run, direction)
    pivot = Pivot.of(drawing, camera, within)
    background = background_of(target, counts, pivot.alpha)

    longer, coarsest = max(camera.width, camera.height), 1
    while longer // (2 * coarsest) >= COARSEST:
        coarsest *= 2
    halvings = [2**k for k in range(int(np.log2(coarsest)), 0, -1)]
    sizes = [(coarsest, BLURS[0]), *((factor, BLURS[1]) for factor in halvings), (1, 0.0)]
    levels = [PyramidLevel(drawing, pivot, target, counts, background, *size) for size in sizes]
    gain = first_gain(target, counts, background, drawing.draw(camera, drawing.shade(camera)))
    searched = _find_starts(levels[0], gain, starts, seed)
    states = [levels[0].solve(State(candidate, gain), FIRST_ITERATIONS) for candidate in searched]
    taken, state = sum(candidate.iterations for candidate in states), min(states, key=lambda candidate: candidate.loss)
    for level in levels:
        state = level.solve(state, ITERATIONS, ENOUGH[level.factor == 1 and level.blur == 0])
        taken += state.iterations
    covariance, error, shift = uncertainty(levels[-1], state)
    is_within = pivot.reach(state.camera) < NEARLY * REACH and GAINS[0] / NEARLY < state.gain < NEARLY * GAINS[1]
    trusted = state.converged and is_within and shift < EXPLAINED
    return RefinedPose(state.camera, covariance, state.gain, error, trusted, taken)


def _find_starts(level: PyramidLevel, gain: float, starts: int, seed: int) -> list[Camera]:
    """The best of the given camera and of random ones about it, rolled, in orbit, nearer and farther by up to what it
    may be off, each panned and tilted to fit the picture best."""
    pivot, rng = level.pivot, np.random.default_rng(seed)
    camera = level.aligned(pivot.camera, level.shade(pivot.camera), gain)[0]
    colors, distance = level.shade(camera), float(np.linalg.norm(pivot.seen_by(camera)))
    orbit = pivot.length / distance
    candidates = [level.aligned(camera, colors, gain)]
    for numbers in rng.uniform(-1, 1, (CANDIDATES, 4)):
        turn, shift = np.array([orbit, orbit, pivot.angle]) * numbers[:3], pivot.length * numbers[3]
        candidates.append(level.aligned(pivot.turned(camera, turn, np.array([0, 0, shift])), colors, gain))
    order = np.argsort([squares for _, squares in candidates], kind="stable")
    return [candidates[k][0] for k in order[:starts]]


def _check_numbers(within: tuple[float, float], starts: int, seed: int) -> None:
    numbers = np.asarray(within, np.float64)
    if numbers.shape != (2,) or not (0 < numbers[0] <= 60 and 0 < numbers[1] <= 0.5):
        raise InputError(f"within: expected degrees up to 60 and a share of the distance up to 0.5, found {within}")
    expect(starts >= 1, "starts", "at least 1", starts)
    expect(seed >= 0, "seed", "0 or more", seed)
