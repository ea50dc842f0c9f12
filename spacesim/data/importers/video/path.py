"""The cameras of a film put on a smooth path: bundle adjustment with how a camera moves beside what it sees.

Features alone leave a film's cameras loose where all of an object is seen from ahead: its two halves then stand askew
by half a degree, at no cost in pixels. A camera that is not shaken does not jump: of four pictures in a row the last is
nearly where a parabola through the others would have it.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.optimize import least_squares
from scipy.sparse.linalg import splu, spsolve
from scipy.spatial.transform import Rotation

from spacesim.data.geometry import Array
from spacesim.data.importers.video.model import SfmModel, without_pictures

_ROW = 4  # pictures whose places are compared: the third difference is nought on a parabola
_LEAST_PICTURES = 12
_DEPARTURE = 3e-5  # from the path, of the distance
_SMOOTH = 4.0  # times the square of departures that independent errors explain: those of one point are alike
_SAMPLES = 60  # departures, of which these are computed
_BESIDE = 4  # pictures of a film before and after one, by which its place is told
_STRAY = 6.0  # times what the film's camera departs in the median, and its neighbours here
_LEAST_STRAY = 0.005  # of the distance
_LEAST_FEATURES = 6  # by which a camera is begun anew
_ELSEWHERE = 0.001  # of the distance: a camera that is so far off stands in another optimum
_NEARLY = 1.1  # times the cost of a camera's features, with which another optimum may begin
_STEPS, _ENOUGH = 30, 1e-5  # at most; share of the cost by which a step must lower it

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Features:
    """Where pictures show points."""

    pictures: np.ndarray  #: [F] numbers
    points: np.ndarray  #: [F] numbers
    pixels: Array  #: [F, 2]


def begun_anew(model: SfmModel, features: Features, times: Array, soft: float) -> SfmModel:
    """The model with cameras that stood in a wrong optimum of their features in a better one.

    Of a flat object, or one seen from ahead, two poses explain a picture nearly as well (G. Schweighofer, A. Pinz,
    "Robust pose estimation from a planar target", 2006). Each camera is begun anew between those before and after it
    and adjusted to its features. Where that leads elsewhere at nearly no more cost, all is adjusted to features from
    there; it stays if their cost falls.

    model: adjusted to the features with Cauchy's cost; others: as for `on_path`
    """
    problem: _Problem | None = None  # of the model, and what it costs once adjusted
    least = np.inf
    for k in range(1, len(model.names) - 1):
        other = _other_pose(model, features, times, soft, k)
        if other is None:
            continue
        if problem is None:
            problem = _Problem(model, features, times, soft, np.inf)
            least = problem.cost(*_state(_adjusted(model, problem)))
        poses = model.world_from_camera.copy()
        poses[k] = other
        found = _adjusted(replace(model, world_from_camera=poses), problem)
        if problem.cost(*_state(found)) < least:
            _log.info("begun anew between its neighbours: %s", model.names[k])
            model, problem = found, None
    return model


@np.errstate(divide="ignore", over="ignore", invalid="ignore")  # of points in a camera's plane
def _other_pose(model: SfmModel, features: Features, times: Array, soft: float, k: int) -> Array | None:
    """[4, 4] another pose of a camera that its features explain nearly as well, begun between its neighbours."""
    shown = np.flatnonzero(features.pictures == k)
    one = replace(model, names=model.names[k : k + 1], world_from_camera=model.world_from_camera[k : k + 1])
    own = Features(np.zeros(len(shown), int), features.points[shown], features.pixels[shown])
    lens, distance = _Lens(one, own), np.linalg.norm(one.positions[0] - np.median(model.points, axis=0))
    share = (times[k] - times[k - 1]) / (times[k + 1] - times[k - 1])
    before, after = model.world_from_camera[[k - 1, k + 1]]
    turn = Rotation.from_matrix(before[:3, :3].T @ after[:3, :3]).as_rotvec()
    begun = before[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
    place = (1 - share) * before[:3, 3] + share * after[:3, 3]

    def pose(step: Array) -> tuple[Array, Array]:
        turned = begun @ Rotation.from_rotvec(step[:3]).as_matrix()
        return turned[None], (place + distance * step[3:])[None]

    def cost(rotations: Array, positions: Array) -> float:
        off = lens.off(rotations, positions, model.points)[0]
        return float(np.log1p(np.square(off).sum(axis=1) / soft**2).sum())

    def residuals(step: Array) -> Array:
        return lens.off(*pose(step), model.points)[0].ravel()

    if len(shown) < _LEAST_FEATURES or not np.isfinite(residuals(np.zeros(6))).all():
        return None
    turned, placed = pose(least_squares(residuals, np.zeros(6), loss="cauchy", f_scale=soft).x)
    is_other = np.linalg.norm(placed[0] - one.positions[0]) > _ELSEWHERE * distance
    if not is_other or cost(turned, placed) > _NEARLY * cost(one.world_from_camera[:, :3, :3], one.positions):
        return None
    other = one.world_from_camera[0].copy()
    other[:3, :3], other[:3, 3] = turned[0], placed[0]
    return other


def is_smooth(model: SfmModel, features: Features, times: Array, soft: float) -> bool:
    """Whether the cameras of a film depart from a smooth path by no more, in the median, than twice what independent
    errors of features explain; False of fewer than twelve pictures.

    model: adjusted to the features with Cauchy's cost; others: as for `on_path`
    """
    if len(model.names) < _LEAST_PICTURES:
        return False
    problem = _Problem(model, features, times, soft)
    seen = np.square(problem.departures(model.positions)).sum(axis=1)
    return bool(np.median(seen) < _SMOOTH * np.median(problem.errors_of_departures(*_state(model))))


def on_path(model: SfmModel, features: Features, times: Array, soft: float) -> SfmModel:
    """The model with poses and points adjusted to features and to a smooth path of the cameras' positions.

    The cost of a feature that is d pixels off is log(1 + (d / soft)^2), Cauchy's, so that highlights, which move, pull
    little, over the mean number of a point's features: what moves one moves the others alike. The cost of a departure
    from the path is Cauchy's, too, in units of 3e-5 of the distance and what a circle about the object departs, so
    that a cut is none. A camera that shakes is pulled to a path that it did not take: see `is_smooth`.

    A point's error is the mean of its features', infinite where a camera that shows it has it behind.

    Levenberg's and Marquardt's steps, float64; the first camera and one coordinate of the farthest stay. A film of
    fewer than twelve pictures is returned as it is, and one whose cost is not finite.

    features: of this model's pictures and points; times: [N] of its pictures, rising strictly, of any unit; soft:
    pixels
    """
    if len(model.names) < _LEAST_PICTURES:
        return model
    return _adjusted(model, _Problem(model, features, times, soft))


@np.errstate(divide="ignore", over="ignore", invalid="ignore")  # of points in a camera's plane: a cost that is refused
def _adjusted(model: SfmModel, problem: "_Problem") -> SfmModel:
    features, state, free = problem.features, _state(model), problem.free
    cost, damping = problem.cost(*state), 1e-4
    if not np.isfinite(cost):
        return model
    for _ in range(_STEPS):
        slopes, residuals = problem.linearized(*state)
        slopes = slopes[:, free]
        normal, right = slopes.T @ slopes, -(slopes.T @ residuals)
        while damping < 1e6:
            step = np.zeros(problem.unknowns)
            damped = normal + damping * sparse.diags_array(normal.diagonal() + 1e-12)
            step[free] = _solved(damped.tocsr(), right, len(model.points))
            moved = _moved(state, step)
            gain = cost - problem.cost(*moved)
            if gain > 0:
                break
            damping *= 10
        else:
            break
        state, cost, damping = moved, cost - gain, max(damping / 10, 1e-8)
        if gain < _ENOUGH * cost:
            break
    poses = model.world_from_camera.copy()
    poses[:, :3, :3], poses[:, :3, 3] = state[0], state[1]
    off, local = problem.off(*state)
    away = np.where(local[:, 2] > 0, np.linalg.norm(off, axis=1), np.inf)
    sums, counts = (np.bincount(features.points, weights, len(model.points)) for weights in (away, None))
    return replace(model, world_from_camera=poses, points=state[2], errors=sums / np.maximum(counts, 1))


def without_strays(model: SfmModel, times: Array) -> SfmModel:
    """The model without the pictures whose cameras stray from the film's path (`strays`), with a warning."""
    lost = strays(model.positions, times, model.depths)
    if lost:
        _log.warning("left out, off the camera's smooth path: %s", ", ".join(model.names[k] for k in lost))
    return without_pictures(model, lost)


def strays(positions: Array, times: Array, distances: Array) -> list[int]:
    """Numbers of the cameras of a film that are far from where they would be by their neighbours.

    That is by a parabola over time through four cameras before and four after, by least squares, the worst left out. A
    camera strays if it is off by more than half a per cent of its distance, and by six times what the film's cameras
    are in the median and what these neighbours are, so that shaking and cuts are none. The first and last four are not
    looked at. Attitudes are not: a hand turns a camera more than it moves it.

    positions: [N, 3]; times: [N], rising, of any unit; distances: [N] of the object from the cameras
    """
    judged = range(_BESIDE, len(positions) - _BESIDE)
    expected = np.empty((len(judged), 3))
    spread = np.full(len(judged), np.inf)
    for row, k in enumerate(judged):
        near = np.r_[k - _BESIDE : k, k + 1 : k + _BESIDE + 1]
        for left_out in near:
            others = near[near != left_out]
            powers = np.vander((times[others] - times[k]) / np.ptp(times[near]), 3)
            fitted = np.linalg.lstsq(powers, positions[others], rcond=None)[0]
            rest = np.square(powers @ fitted - positions[others]).sum() / (len(others) - 3)
            if rest < spread[row] ** 2:
                spread[row], expected[row] = np.sqrt(rest), fitted[2]
    away = np.linalg.norm(positions[list(judged)] - expected, axis=1) / distances[list(judged)]
    least = np.maximum(spread / distances[list(judged)], np.median(away) if len(away) else 0.0)
    found = np.flatnonzero(away > np.maximum(_LEAST_STRAY, _STRAY * least))
    return [judged[row] for row in found]


_State = tuple[Array, Array, Array]  # rotations [N, 3, 3] world from camera, positions [N, 3], points [P, 3]


def _moved(state: _State, step: Array) -> _State:
    rotations, positions, points = state
    cameras = step[: 6 * len(positions)].reshape(-1, 6)
    turned = rotations @ Rotation.from_rotvec(cameras[:, :3]).as_matrix()
    return turned, positions + cameras[:, 3:], points + step[6 * len(positions) :].reshape(-1, 3)


def _state(model: SfmModel) -> _State:
    return model.world_from_camera[:, :3, :3], model.positions, model.points


def _eliminated(normal: sparse.csr_array, points: int) -> tuple[sparse.csc_array, sparse.csr_array, sparse.bsr_array]:
    """(cameras' own normal matrix, what it shares with points [C, 3 P], the inverse of theirs), the Schur complement:
    no two points share a feature, theirs are blocks of three at the end."""
    cameras = normal.shape[0] - 3 * points
    mixed = normal[:cameras, cameras:]
    blocks = np.linalg.inv(normal[cameras:, cameras:].tobsr((3, 3)).data)
    inverse = sparse.bsr_array((blocks, np.arange(points), np.arange(points + 1)))
    return (normal[:cameras, :cameras] - mixed @ inverse @ mixed.T).tocsc(), mixed, inverse


def _solved(normal: sparse.csr_array, right: Array, points: int) -> Array:
    reduced, mixed, inverse = _eliminated(normal, points)
    cameras = reduced.shape[0]
    first = spsolve(reduced, right[:cameras] - mixed @ (inverse @ right[cameras:]))
    return np.r_[first, inverse @ (right[cameras:] - mixed.T @ first)]


class _Lens:
    """What features are off."""

    def __init__(self, model: SfmModel, features: Features) -> None:
        self.features = features
        self.focal, self.k1, self.centre = model.focal, model.k1, np.array(model.centre)

    def off(self, rotations: Array, positions: Array, points: Array) -> tuple[Array, Array]:
        """(pixels off [F, 2], features' points in camera axes [F, 3])."""
        pictures = self.features.pictures
        local = np.einsum("nji,nj->ni", rotations[pictures], points[self.features.points] - positions[pictures])
        flat = local[:, :2] / local[:, 2:]
        lens = 1 + self.k1 * np.square(flat).sum(axis=1, keepdims=True)
        return self.focal * lens * flat + self.centre - self.features.pixels, local


class _Problem(_Lens):
    """Residuals of features and of the path, and their slopes. departure: the path's unit, of the distance"""

    def __init__(
        self, model: SfmModel, features: Features, times: Array, soft: float, departure: float = _DEPARTURE
    ) -> None:
        super().__init__(model, features)
        self.soft = soft
        self.alike = len(features.points) / max(len(np.unique(features.points)), 1)
        times, positions = np.asarray(times, np.float64), model.positions
        self.rows = np.arange(len(times) - _ROW + 1)[:, None] + np.arange(_ROW)
        gaps = times[self.rows][:, :, None] - times[self.rows][:, None] + np.eye(_ROW)
        weights = 1 / gaps.prod(axis=2)
        self.weights = weights / np.linalg.norm(weights, axis=1, keepdims=True)
        around = np.linalg.norm(positions - np.median(model.points, axis=0), axis=1)
        step = float(np.median(np.linalg.norm(np.diff(positions, axis=0), axis=1) / around[1:]))
        self.sizes = around[self.rows].mean(axis=1) * (departure + step**3 / np.sqrt(20))  # of 1, -3, 3, -1
        far = int(np.argmax(np.linalg.norm(positions - positions[0], axis=1)))
        held = [*range(6), 6 * far + 3 + int(np.argmax(np.abs(positions[far] - positions[0])))]
        self.unknowns = 6 * len(positions) + 3 * len(model.points)
        self.free = np.setdiff1d(np.arange(self.unknowns), held)

    def departures(self, positions: Array) -> Array:
        """[R, 3] from a parabola, in units."""
        return np.asarray(np.einsum("rk,rki->ri", self.weights, positions[self.rows])) / self.sizes[:, None]

    def errors_of_departures(self, rotations: Array, positions: Array, points: Array) -> Array:
        """Expected squares of departures, in units, for features alone that are independently off by as much as these
        are (Huber's "Robust statistics", 1981, covariance of an estimate), of at most `_SAMPLES` of them."""
        off = self.off(rotations, positions, points)[0]
        shares = 1 / (1 + np.square(off).sum(axis=1) / self.soft**2)
        slopes = self.linearized(rotations, positions, points)[0][: 2 * len(off), self.free]
        normal = (slopes.T @ slopes).tocsr() * self.alike
        reduced = _eliminated(normal + sparse.diags_array(1e-9 * normal.diagonal() + 1e-12).tocsr(), len(points))[0]
        taken = np.unique(np.linspace(0, len(self.rows) - 1, min(_SAMPLES, len(self.rows))).astype(int))
        chosen = np.zeros((6 * len(positions), len(taken), 3))
        for axis in range(3):
            columns = 6 * self.rows[taken] + 3 + axis
            chosen[columns, np.arange(len(taken))[:, None], axis] = self.weights[taken] / self.sizes[taken, None]
        flat = chosen.reshape(len(chosen), -1)[self.free[: reduced.shape[0]]]
        spread = (flat * splu(reduced).solve(flat)).sum(axis=0).reshape(-1, 3).sum(axis=1)
        pull = 0.5 * np.square(shares[:, None] * off / self.soft).sum() / len(off)
        return np.asarray(spread * pull * shares.mean() / np.square(shares).mean() ** 2)

    def cost(self, rotations: Array, positions: Array, points: Array) -> float:
        away = np.square(self.off(rotations, positions, points)[0]).sum(axis=1) / self.soft**2
        astray = np.square(self.departures(positions)).sum(axis=1)
        return float(np.log1p(away).sum() / self.alike + np.log1p(astray).sum())

    def linearized(self, rotations: Array, positions: Array, points: Array) -> tuple[sparse.csr_array, Array]:
        """(slopes, residuals) of least squares whose step lowers the cost (iteratively reweighted)."""
        pictures, count = self.features.pictures, len(positions)
        off, local = self.off(rotations, positions, points)
        flat = local[:, :2] / local[:, 2:]
        square = np.square(flat).sum(axis=1)[:, None, None]
        lens = (1 + self.k1 * square) * np.eye(2) + 2 * self.k1 * flat[:, :, None] * flat[:, None]
        by_local = np.concatenate([lens, -lens @ flat[:, :, None]], axis=2) * (self.focal / local[:, 2, None, None])
        by_point = by_local @ rotations[pictures].transpose(0, 2, 1)
        by_turn = np.cross(by_local, local[:, None])
        weights = 1 / (self.soft * np.sqrt((1 + np.square(off).sum(axis=1) / self.soft**2) * self.alike))
        blocks = np.concatenate([by_turn, -by_point, by_point], axis=2) * weights[:, None, None]
        columns = np.column_stack(
            [6 * pictures[:, None] + np.arange(6), 6 * count + 3 * self.features.points[:, None] + np.arange(3)]
        )
        seen = sparse.coo_array(
            (blocks.ravel(), (np.repeat(np.arange(2 * len(off)), 9), np.repeat(columns, 2, axis=0).ravel())),
            shape=(2 * len(off), 6 * count + 3 * len(points)),
        )
        astray = self.departures(positions)
        pulls = 1 / np.sqrt(1 + np.square(astray).sum(axis=1))
        values = (pulls / self.sizes)[:, None] * self.weights
        axes = np.arange(3)
        path = sparse.coo_array(
            (
                np.repeat(values[:, None], 3, axis=1).ravel(),
                (
                    np.repeat(np.arange(3 * len(values)), _ROW),
                    (6 * self.rows[:, None] + 3 + axes[:, None]).ravel(),
                ),
            ),
            shape=(3 * len(values), seen.shape[1]),
        )
        residuals = np.r_[(off * weights[:, None]).ravel(), (astray * pulls[:, None]).ravel()]
        return sparse.vstack([seen, path]).tocsr(), residuals
