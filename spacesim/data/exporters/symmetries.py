"""Rotations that take a body's shape to itself, as BOP counts symmetries."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from spacesim.data.geometry import Array, normalize
from spacesim.data.mesh import drawable_faces

SAMPLES = 2000  #: points of the surface that are turned
TOLERANCE = 0.01  #: of the body's size: how far all of them may be from the surface after that
FOLDS = (2, 3, 4, 5, 6, 8)  #: of axes that are tried
TURNS = 36  #: steps of a whole turn that a continuous axis must pass


@dataclass(frozen=True)
class SymmetryAxis:
    """The body looks the same however it is turned about it."""

    axis: tuple[float, float, float]  #: unit, body frame
    offset: tuple[float, float, float]  #: metres: a point on it


def find_symmetries(
    vertices: Array, faces: np.ndarray
) -> tuple[tuple[tuple[float, ...], ...], tuple[SymmetryAxis, ...]]:
    """(discrete ones as 16 numbers each, identity left out; continuous ones) of a mesh's shape: colours do not count.

    vertices: [V, 3], faces: [F, 3]. Axes tried go through the surface's centre of area: the body frame's and those
    between them, 13 in all, and the principal ones. About a continuous axis no discrete one is listed, and of those
    that turn such an axis round one is enough.
    """
    vertices = np.asarray(vertices, np.float64)
    faces = drawable_faces(vertices, np.asarray(faces, np.int64))
    if len(faces) == 0:
        return (), ()
    shape = _Surface(vertices, faces)
    axes = _axes(shape)
    steps = 2 * np.pi * np.arange(1, TURNS) / TURNS
    round_axes = [axis for axis in axes if all(shape.is_kept(Rotation.from_rotvec(step * axis)) for step in steps)]
    discrete: list[Rotation] = []
    for axis in axes:
        if any(abs(axis @ other) > 1 - 1e-6 for other in round_axes):
            continue
        for fold in FOLDS:
            turn = Rotation.from_rotvec(2 * np.pi / fold * axis)
            if all(_is_new(turn**power, discrete) for power in range(1, fold)) and shape.is_kept(turn):
                new = [turn**power for power in range(1, fold)]
                discrete += new if not round_axes else new[:1]
        if round_axes and discrete:
            break
    at = (shape.centre[0], shape.centre[1], shape.centre[2])
    continuous = [SymmetryAxis((axis[0], axis[1], axis[2]), at) for axis in map(np.ndarray.tolist, round_axes)]
    return tuple(shape.matrix(turn) for turn in _group(discrete, bool(round_axes))), tuple(continuous)


def sample_surface(vertices: Array, faces: np.ndarray, count: int) -> Array:
    """[count, 3] points spread evenly over a mesh, the same in whatever order its vertices and faces are."""
    corners = vertices[faces]
    corners = np.take_along_axis(corners, np.lexsort(corners.transpose(2, 0, 1))[..., None], axis=1)
    corners = corners[np.lexsort(corners.reshape(-1, 9).T)]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    ends = np.cumsum(areas)
    triangle = np.minimum(np.searchsorted(ends, ends[-1] * (np.arange(count) + 0.5) / count), len(ends) - 1)
    share = np.random.default_rng(0).random((count, 2))
    share = np.where(share.sum(axis=1, keepdims=True) > 1, 1 - share, share)
    along = corners[triangle, 1:] - corners[triangle, :1]
    points: Array = corners[triangle, 0] + (share[..., None] * along).sum(axis=1)
    return points


class _Surface:
    """A surface, and points on it."""

    def __init__(self, vertices: Array, faces: np.ndarray) -> None:
        import igl

        self.vertices, self.faces = np.ascontiguousarray(vertices), np.ascontiguousarray(faces)
        corners = vertices[faces]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        some = vertices[np.unique(faces)][:: max(1, len(vertices) // SAMPLES)]
        self.points: Array = np.concatenate([sample_surface(vertices, faces, SAMPLES), some])
        self.centre: list[float] = (np.average(corners.mean(axis=1), axis=0, weights=areas)).tolist()
        arms = corners - self.centre
        squares = np.einsum("f,fki,fkj->ij", areas, arms, arms)  # of a triangle: sum of those of corners and of the sum
        sums = arms.sum(axis=1)
        self.moments: Array = squares + np.einsum("f,fi,fj->ij", areas, sums, sums)
        self.size = float(np.ptp(vertices[np.unique(faces)], axis=0).max())
        self._tree = igl.AABB()
        self._tree.init(self.vertices, self.faces)

    def is_kept(self, turn: Rotation) -> bool:
        """Whether all points stay on the surface."""
        turned = np.ascontiguousarray(turn.apply(self.points - self.centre) + self.centre)
        limit = (TOLERANCE * self.size) ** 2
        first = self._tree.squared_distance(self.vertices, self.faces, turned[::50])[0]  # most fail here already
        if first.max() > limit:
            return False
        return bool(self._tree.squared_distance(self.vertices, self.faces, turned)[0].max() <= limit)

    def matrix(self, turn: Rotation) -> tuple[float, ...]:
        pose = np.eye(4)
        pose[:3, :3] = turn.as_matrix()
        pose[:3, 3] = self.centre - pose[:3, :3] @ self.centre
        return tuple(pose.ravel().tolist())


def _axes(shape: _Surface) -> list[Array]:
    """Unit vectors [3], each of a pair of opposite ones once."""
    lattice = [(x, y, z) for x in (0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) > (0, 0, 0)]
    principal = np.linalg.eigh(shape.moments)[1].T
    axes: list[Array] = []
    for axis in sorted(lattice, key=lambda numbers: sum(map(abs, numbers))) + list(principal):
        unit = normalize(np.array(axis, np.float64))
        if all(abs(unit @ other) < 1 - 1e-4 for other in axes):
            axes.append(unit)
    return axes


def _is_new(turn: Rotation, others: list[Rotation]) -> bool:
    return all((turn.inv() * other).magnitude() > 1e-3 for other in others)


def _group(turns: list[Rotation], has_axis: bool) -> list[Rotation]:
    """All products, without the identity, in the order in which they are found."""
    if has_axis:
        return turns
    group, before = list(turns), -1
    while before != len(group) <= 120:
        before = len(group)
        for turn in turns:
            for other in list(group):
                product = turn * other
                if product.magnitude() > 1e-3 and _is_new(product, group):
                    group.append(product)
    return group
