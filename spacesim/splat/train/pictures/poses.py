"""Poses of training pictures, refined: each camera moves as its own loss asks, in a training of its own.

Its model only has to find where cameras are and is discarded (`pose_config`); the run's model is trained from the
start with the poses found, which stay, as one that learned before its cameras stood stays worse.
It is drawn with the anti-aliasing filter: splats that are widened to a pixel cover more the farther a camera is, which
turns and moves even a camera that is right.

What moves a camera moves the whole model the other way. So the gradient by a pose is a force and a torque: sums over
the Gaussians of what the splats' adjoint gives their centres and rotations (`pose_gradient`). Colours, shadows and
normals count as given within a step, as they hardly change with so small a motion.

A picture has six numbers (w, u): the camera sees the object turned by w (rotation vector, radians, camera axes) about
its centre, the starting points' or else where cameras look, and moved by u (camera axes) in units of the distance.
Turned so, a picture changes in other ways than moved so, and a step of each moves pixels about as far:

    p' = exp([w]) (p - m) + m + d u        p: in the given camera's axes;  m: the centre there;  d = |m|

The world's axes, origin and unit of length do not follow from pictures. Where training starts at points or a mesh,
these do: at first their centres stay, and each camera finds its place before them. From then on, and from the
first step where training starts at random, the world stays where the cameras have it: what the numbers of all pictures
share with a turn, a shift and a growth of all cameras (7 ways, linearised at the given ones, least squares of what
moves in the pictures: of the starting points, or else of a ball) stays as it was, by a correction every `GAUGE_EVERY`
steps. Independent errors of cameras share little: where all moved far more alike than each by itself, points and
pictures disagree, as when points came from these very cameras, and the cameras are believed.
"""

from dataclasses import dataclass, replace

import drjit as dr
import numpy as np

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Float
from spacesim.data.geometry import Array, cross_matrix, fibonacci_sphere
from spacesim.data.records import Camera, Dataset
from spacesim.learning.cameras import focus_point
from spacesim.splat.pose import moved, twist_between
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.project import Pinhole, Splats, project
from spacesim.splat.train.config import TrainConfig
from spacesim.splat.train.optimizer.adam import OWN
from spacesim.splat.train.pictures.numbers import PictureNumbers, falling
from spacesim.splat.train.start import known_points

START, START_SHARE = 100, 0.025  #: steps that poses wait at most, until colours are rough, and share of the training
ANCHORED, ANCHORED_SHARE = 16, 0.25  #: times that each picture is shown to a model that stays; most of the training
#: times that each picture is shown, below which poses hardly get better: errors of 1 degree were 0.8 after 16 and 0.3
#: to 0.6 after 32, of 3 degrees 2.9 after 16, 2.5 after 32, 0.9 after 64 (40 and 120 pictures of boxsat, 64 pixels)
MANY_TIMES = 32
SHIFTS_FIRST = 5  #: steps of a picture that move it alone: a turn before these would only blur what a shift mends
GAUGE_EVERY = 50  #: steps
BELIEVED = 3.0  #: times what cameras share that err apart from each other, root mean square
RADIUS = 0.25  #: of an object without points, of its distance
POINTS = 200  #: of those that training starts at, by whose motion the gauge is held
WAYS = ("opacity", "x", "y", "a", "b", "c")  #: of a splat's numbers that blending differentiates by


class PoseRefinement:
    """The poses of a training's pictures."""

    def __init__(
        self, dataset: Dataset, rate: float, iterations: int, antialiased: bool, anchor: bool = False, views: int = 1
    ) -> None:
        """rate: step size at the start, radians and shares of the distance;  anchor: whether the model starts where the
        object is;  views: of a step"""
        self.given = [frame.camera for frame in dataset.train]
        self.rate, self.iterations, self.antialiased = rate, iterations, antialiased
        self.start = int(min(START, START_SHARE * iterations))
        self.end = iterations
        shown = -(-ANCHORED * len(self.given) // views)
        self.anchored = int(min(self.start + shown, ANCHORED_SHARE * iterations)) if anchor else 0
        self.centre, points = _object_of(dataset)
        self.seen = np.array([c.camera_from_world[:3, :3] @ (self.centre - c.position) for c in self.given])
        self.distances = np.maximum(np.linalg.norm(self.seen, axis=1), 1e-6)
        self.numbers = PictureNumbers(len(self.given), 6, self._taught)
        self._gauge = _Gauge.of(self.given, self.centre, self.seen, self.distances, points)
        self.common = np.zeros(self._gauge.shares.shape[0])  #: of the gauge's ways, what is held
        self._centre = ad.Float(self.centre.tolist())
        self._gradient = recorded(pose_gradient)

    def stay(self, values: Array) -> None:
        """Pictures have these numbers [V, 6] from now on. Raises ValueError for another number of pictures."""
        if values.shape != self.numbers.values.shape:
            raise ValueError(f"expected {list(self.numbers.values.shape)} numbers, found {list(values.shape)}")
        self.numbers.values = np.array(values, np.float64)
        self.end = self.anchored = 0

    def camera(self, picture: int) -> Camera:
        """Of a training picture, where it is thought to stand."""
        return moved(self.given[picture], self._twist(picture, self.numbers.of(picture)))

    def learn(
        self, picture: int, step: int, rows: list[Float], camera: Pinhole, grad_splats: Splats, grad_depth: list[Float]
    ) -> None:
        """What a view that was drawn teaches of its pose. step: number of the step, the first of which is 0;  camera:
        that it was drawn with;  grad_splats: gradients of its splats;  grad_depth: of their depths, metres, if any"""
        if not self.start <= step < self.end:
            return
        gradient = self._gradient(rows[:OWN], camera, grad_splats, grad_depth, self._centre, self.antialiased)
        done = (step - self.start) / max(self.end - self.start, 1)
        self.numbers.learn(picture, gradient, falling(self.rate, done))

    def hold(self, steps: int) -> None:
        """After so many steps: take out what all cameras moved alike, if it is time to; or, where the model has stayed
        until now, remember it."""
        if self.end == 0:
            return
        if steps == self.anchored and steps > 0:
            self.numbers.follow()
            self.common = self._gauge.believed(self.numbers.values)
        elif steps > self.anchored and (steps % GAUGE_EVERY == 0 or steps == self.iterations):
            self.numbers.follow()
            self.numbers.values = self._gauge.held(self.numbers.values, self.common)

    def moves(self) -> Array:
        """[V, 2] how far each camera was turned, degrees, and moved, share of the distance."""
        moves = []
        for picture, (camera, distance) in enumerate(zip(self.given, self.distances, strict=True)):
            there = self.camera(picture)
            turn = np.linalg.norm(twist_between(camera, there)[:3])
            moves.append([np.degrees(turn), np.linalg.norm(there.position - camera.position) / distance])
        return np.array(moves)

    def _twist(self, picture: int, numbers: Array) -> Array:
        """[6] of `moved`, from the given camera."""
        from scipy.spatial.transform import Rotation

        middle, turn = self.seen[picture], numbers[:3]
        shift = self.distances[picture] * numbers[3:] + middle - Rotation.from_rotvec(turn).apply(middle)
        return np.concatenate([turn, shift])

    def _taught(self, picture: int, gradient: Array) -> Array:
        """`_by_numbers`, without that by the turn while a picture is only shifted."""
        taught = self._by_numbers(picture, gradient)
        if self.numbers.steps[picture] < SHIFTS_FIRST:
            taught[:3] = 0
        return taught

    def _by_numbers(self, picture: int, gradient: Array) -> Array:
        """[6] gradient by the numbers, from that of `pose_gradient`: exp([w + dw]) = exp([J dw]) exp([w])."""
        camera_from_world = self.camera_axes(picture)
        force, torque = camera_from_world @ gradient[:3], camera_from_world @ gradient[3:]
        turns = left_jacobian(self.numbers.values[picture, :3])
        return np.concatenate([turns.T @ torque, self.distances[picture] * force])

    def camera_axes(self, picture: int) -> Array:
        """[3, 3] rotation camera_from_world of the refined camera."""
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_rotvec(self.numbers.values[picture, :3]).as_matrix()
        axes: Array = turn @ self.given[picture].camera_from_world[:3, :3]
        return axes


def pose_config(config: TrainConfig) -> TrainConfig:
    """Of the training that learns poses, before the one of `config`."""
    return replace(config, antialiased=True)


def pose_warning(pictures: int, config: TrainConfig) -> str:
    """A sentence where training is far too short to find poses of so many pictures; "" where it is not."""
    least = -(-MANY_TIMES * pictures // config.views_per_step)
    if config.iterations >= least:
        return ""
    return (
        f"refine_poses: expected {least} or more iterations for {pictures} training pictures, found "
        f"{config.iterations}: each is shown fewer than {MANY_TIMES} times, and poses will hardly get better"
    )


def pose_gradient(
    rows: list[Float],
    camera: Pinhole,
    grad_splats: Splats,
    grad_depth: list[Float],
    centre: Float,
    antialiased: bool,
) -> Float:
    """Float [6]: gradient by a shift of all Gaussians (force, per metre) and by a turn of them about `centre` (torque,
    per radian), world axes, from the gradients of one view's splats.

    A quaternion q of a Gaussian that is turned by a small vector t becomes q + (0, t) q / 2.
    rows: place, shape and opacity;  grad_depth: Float [N] or nothing;  centre: Float [3], metres
    """
    rows = [ad.Float(row) for row in rows]
    dr.enable_grad(rows[:3], rows[6:10])
    gaussians = Gaussians.from_rows(rows)
    splats, _ = project(gaussians, camera, antialiased)
    along = ad.Float(0)
    for name in WAYS:
        along += getattr(splats, name) * getattr(grad_splats, name)
    for gradient in grad_depth:
        along += splats.depth * gradient
    dr.backward(along)
    force = ad.Array3f([dr.grad(row) for row in rows[:3]])
    w, x, y, z = (dr.detach(row) for row in rows[6:10])
    gw, gx, gy, gz = (dr.grad(row) for row in rows[6:10])
    arm = ad.Array3f([dr.detach(rows[i]) - dr.gather(ad.Float, centre, ad.UInt32(i)) for i in range(3)])
    torque = dr.cross(arm, force) + 0.5 * ad.Array3f(
        w * gx - x * gw + y * gz - z * gy,
        w * gy - y * gw + z * gx - x * gz,
        w * gz - z * gw + x * gy - y * gx,
    )
    return dr.concat([dr.sum(value) for value in (*force, *torque)])


def left_jacobian(turn: Array) -> Array:
    """[3, 3] J of SO(3): exp([w + dw]) = exp([J dw]) exp([w]) to first order."""
    angle, cross = float(np.linalg.norm(turn)), cross_matrix(turn)
    if angle < 1e-6:
        return np.eye(3) + 0.5 * cross
    half = (1 - np.cos(angle)) / angle**2
    jacobian: Array = np.eye(3) + half * cross + (angle - np.sin(angle)) / angle**3 * cross @ cross
    return jacobian


def _object_of(dataset: Dataset) -> tuple[Array, Array]:
    """(its centre [3], some of its points [P, 3], none where training starts without any)."""
    points = known_points(dataset)
    if points is None:
        return focus_point(dataset), np.zeros((0, 3))
    return np.median(points, axis=0), points[np.random.default_rng(0).permutation(len(points))[:POINTS]]


@dataclass(frozen=True, eq=False)
class _Gauge:
    """What all cameras may share: 7 ways of the numbers of all pictures, and how much of each there is."""

    moves: Array  #: [V, 6, 6] by a picture's numbers: their squares' sum is how far points move, widths squared, mean
    ways: Array  #: [6 V, R] numbers that a common motion gives; R of 7, fewer where cameras are few
    shares: Array  #: [R, 6 V] of each, in given numbers
    growth: Array  #: [R] unit, of the ways: what a growth gives

    @staticmethod
    def of(cameras: list[Camera], centre: Array, seen: Array, distances: Array, points: Array) -> "_Gauge":
        common, moves = np.zeros((len(cameras), 6, 7)), np.zeros((len(cameras), 6, 6))
        for i, (camera, middle, distance) in enumerate(zip(cameras, seen, distances, strict=True)):
            back = np.block([[np.eye(3), np.zeros((3, 3))], [-cross_matrix(middle / distance), -np.eye(3)]])
            # (turn w, shift of the camera per distance) = back (w, u), its own inverse: the shift is w x m / d - u
            axes, arm = camera.camera_from_world[:3, :3], camera.position - centre
            common[i, :3, :3] = -axes
            common[i, 3:, :3] = -axes @ cross_matrix(arm) / distance
            common[i, 3:, 3:6] = axes / distances.mean()
            common[i, 3:, 6] = axes @ arm / distance
            common[i] = back @ common[i]
            local = (points - camera.position) @ axes.T
            local = local[local[:, 2] > 0.1 * distance]
            if len(local) < 8:
                local = middle + RADIUS * distance * fibonacci_sphere(32)
            turned = np.array([cross_matrix(middle - point) for point in local])
            slopes = np.concatenate([turned, np.broadcast_to(distance * np.eye(3), turned.shape)], axis=2)
            flat = slopes[:, :2] - (local[:, :2] / local[:, 2:])[:, :, None] * slopes[:, 2:]
            flat *= np.array([[camera.fx], [camera.fy]]) / (camera.width * local[:, 2, None, None])
            square = np.einsum("pai,paj->ij", flat, flat) / len(local)
            moves[i] = np.linalg.cholesky(square + 1e-9 * np.trace(square) * np.eye(6)).T
        weighted = (moves @ common).reshape(-1, 7)
        left, sizes, _ = np.linalg.svd(weighted, full_matrices=False)
        basis = left[:, sizes > 1e-6 * sizes.max()]
        apart = basis.reshape(*moves.shape[:2], -1)
        growth = basis.T @ weighted[:, 6]
        growth /= max(float(np.linalg.norm(growth)), 1e-12)
        shares = (moves.transpose(0, 2, 1) @ apart).reshape(basis.shape).T
        return _Gauge(moves, np.linalg.solve(moves, apart).reshape(basis.shape), shares, growth)

    def believed(self, numbers: Array) -> Array:
        """[R] of each way in numbers [V, 6], without growth: splats' sizes, which change while their centres stay,
        would follow it. Nothing where it is more than `BELIEVED` times what errors of the size that is left would share
        by chance: the ways are orthonormal in what moves in pictures, each has as much of it as each number."""
        shares = self.shares @ numbers.ravel()
        rigid: Array = shares - self.growth * (self.growth @ shares)
        left = np.square(self.moves @ numbers[:, :, None]).sum() - np.square(shares).sum()
        by_chance = left / max(numbers.size - len(shares), 1)
        return rigid if np.square(rigid).mean() <= BELIEVED**2 * by_chance else np.zeros_like(rigid)

    def held(self, numbers: Array, common: Array | float = 0.0) -> Array:
        """The numbers [V, 6] with `common` [R] in place of what all share."""
        flat = numbers.ravel()
        return (flat - self.ways @ (self.shares @ flat - common)).reshape(numbers.shape)
