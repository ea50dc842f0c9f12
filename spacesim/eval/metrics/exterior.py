"""Points on the part of a surface that can be seen from outside: what is compared of two shapes (thesis 5.2.3)."""

from dataclasses import dataclass

import drjit as dr
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from spacesim import backend
from spacesim.backend import mitsuba_types as mt
from spacesim.backend.arrays import Bool, Float, UInt32
from spacesim.backend.upload import upload
from spacesim.data.geometry import Array, fibonacci_sphere

DIRECTIONS = 128  #: from which a point may be seen; on boxsat 64 find what 4096 do but for 0.1 % of the faces
LIFT = 1e-4  #: of the box's diagonal: how far from the surface rays start
MIN_VISIBLE_SHARE = 1e-3  #: of the area that must be visible; with less, sampling would go on for ever
LOW_SHARE = 0.5  #: with less of it visible, whole pieces of the surface are looked for that are not
HIDDEN = 300  #: points of a piece, none of them visible, after which none is drawn from it


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points on a surface that can be seen from outside."""

    points: Array  #: [N, 3] metres
    normals: Array  #: [N, 3] unit, towards a side that can be seen
    faces: np.ndarray  #: [N], which they lie on


def exterior_samples(vertices: Array, faces: np.ndarray, count: int, seed: int) -> SurfaceSamples | None:
    """`count` points, even over what can be seen from far away of a surface, from either side of its faces.

    vertices: [V, 3] metres;  faces: [F, 3].  None where there is no area, or next to none of it can be seen.
    """
    corners = np.asarray(vertices, np.float64)[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(across, axis=1)
    if not np.isfinite(doubled).all() or not doubled.sum() > 0:
        return None
    solid = doubled > 0
    corners, doubled, index = corners[solid], doubled[solid], np.flatnonzero(solid)
    normals = across[solid] / doubled[:, None]
    sight, rest = ExteriorView(vertices, faces), _CandidateFaces(corners, doubled)
    rng = np.random.default_rng([seed, 5])
    batches: list[tuple[Array, Array, np.ndarray]] = []
    missing = count
    while missing > 0:
        share = max((count - missing) / rest.drawn, MIN_VISIBLE_SHARE) if rest.drawn else 1.0
        number = min(int(1.05 * missing / share) + 16, 4 * count)
        face = rest.draw(number, rng)
        points = _points_on(corners[face], rng.random((2, number)))
        side = sight.visible_sides(points, normals[face])
        visible = np.flatnonzero(side)[:missing]
        batches.append((points[visible], normals[face[visible]] * side[visible, None], index[face[visible]]))
        missing -= len(visible)
        rest.drop_hidden(face, side != 0)
        if rest.drawn == 0 or (count - missing < MIN_VISIBLE_SHARE * rest.drawn and rest.drawn >= count):
            return None
    return SurfaceSamples(*(np.concatenate(parts) for parts in zip(*batches, strict=True)))


class _CandidateFaces:
    """Faces that points are drawn from, even over their area: all, until there are pieces of which none is visible.

    drawn: how many points were drawn from those that are left
    """

    def __init__(self, corners: Array, area: Array) -> None:
        """corners: [F, 3, 3];  area: [F], in any unit."""
        self.corners, self.area, self.drawn = corners, area.copy(), 0
        self.pieces: np.ndarray | None = None

    def draw(self, number: int, rng: np.random.Generator) -> np.ndarray:
        """[number] faces."""
        ends = np.cumsum(self.area / self.area.sum())
        return np.minimum(np.searchsorted(ends, rng.random(number), side="right"), len(ends) - 1)

    def drop_hidden(self, face: np.ndarray, visible: np.ndarray) -> None:
        """Of points [N] that were drawn, their faces and whether they are visible, [N] bool."""
        if self.drawn == 0 and visible.mean() < LOW_SHARE:
            self.pieces = _pieces(self.corners)
            self.tried, self.seen = (np.zeros(self.pieces.max() + 1, np.int64) for _ in range(2))
        self.drawn += len(face)
        if self.pieces is None:
            return
        self.tried += np.bincount(self.pieces[face], minlength=len(self.tried))
        self.seen += np.bincount(self.pieces[face[visible]], minlength=len(self.seen))
        gone = (self.tried >= HIDDEN) & (self.seen == 0)
        self.area[gone[self.pieces]] = 0
        self.drawn = int(self.tried[~gone].sum())


def _pieces(corners: Array) -> np.ndarray:
    """[F] the piece of each of triangles [F, 3, 3]: those that share corners, by their places, are of one."""
    places, corner = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    faces = corner.reshape(-1, 3)
    linked = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_array((np.ones(len(linked), bool), linked.T), shape=(len(places), len(places)))
    return np.asarray(connected_components(graph, directed=False)[1])[faces[:, 0]]


def _points_on(corners: Array, uniform: Array) -> Array:
    """[N, 3] points even over triangles [N, 3, 3], of two uniform numbers each [2, N]."""
    root = np.sqrt(uniform[0])[:, None]
    second = uniform[1][:, None] * root
    return corners[:, 0] * (1 - root) + corners[:, 1] * (root - second) + corners[:, 2] * second


class ExteriorView:
    """What something far away can see past a surface, by rays to `DIRECTIONS` directions."""

    def __init__(self, vertices: Array, faces: np.ndarray) -> None:
        """vertices: [V, 3] metres;  faces: [F, 3], at least one."""
        corners = np.asarray(vertices, np.float64)[faces]
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        self.centre, self.size = 0.5 * (low + high), float(np.linalg.norm(high - low)) or 1.0
        self.scene = _scene(self._unit(corners))
        directions = fibonacci_sphere(DIRECTIONS, seed=0)
        self.directions = np.random.default_rng(0).permutation(directions)  # any first few are even

    def visible_sides(self, points: Array, normals: Array) -> np.ndarray:
        """[N] int8, of points [N, 3] on the surface with unit normals [N, 3]: the side from which one is seen, 1 or -1,
        or 0 where it is seen from none."""
        return self._visible_side(points, normals)

    def is_seen(self, points: Array) -> np.ndarray:
        """[N] bool, of points [N, 3] that are not on the surface: whether anything far away sees them."""
        return self._visible_side(points, np.zeros_like(points)) != 0

    def first_hit(self, start: Array, towards: Array) -> tuple[Array, np.ndarray]:
        """Where rays from points [N, 3] metres in directions [N, 3] meet the surface: (distances [N] in lengths of the
        directions, infinite where they do not; the faces [N])."""
        mi = backend.mitsuba()
        origin, ray = (
            np.ascontiguousarray(values.T, np.float32) for values in (self._unit(start), towards / self.size)
        )
        hits = self.scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(origin), mi.Vector3f(ray)))
        hit = np.array(hits.is_valid())
        return np.where(hit, np.array(hits.t, np.float64), np.inf), np.where(hit, np.array(hits.prim_index), 0)

    def _unit(self, points: Array) -> Array:
        """In units of the surface's size, about its centre: single precision resolves any scene."""
        return np.asarray((points - self.centre) / self.size, np.float64)

    def _visible_side(self, points: Array, normals: Array) -> np.ndarray:
        """[N] int8: the first direction in which nothing is in the way, as the sign of its cosine with the normal; 0
        where there is none. A thread a point."""
        if len(points) == 0:
            return np.zeros(0, np.int8)
        mi = backend.mitsuba()
        start, normal = (
            kind(np.ascontiguousarray(values.T, np.float32))
            for kind, values in ((mi.Point3f, self._unit(points)), (mi.Vector3f, normals))
        )
        last = mi.UInt32([len(self.directions)])
        table = upload(self.directions)

        def hidden(k: UInt32, side: Float) -> Bool:
            return (k < dr.gather(mi.UInt32, last, mi.UInt32(0))) & (side == 0)

        def test_direction(k: UInt32, side: Float) -> tuple[UInt32, Float]:
            towards = dr.gather(mi.Vector3f, table, k)
            facing = dr.select(dr.dot(normal, towards) >= 0, mi.Float(1), mi.Float(-1))
            free = ~self.scene.ray_test(mi.Ray3f(start + LIFT * facing * normal, towards))
            return k + 1, dr.select(free, facing, side)

        state = dr.zeros(mi.UInt32, len(points)), dr.zeros(mi.Float, len(points))
        _, side = dr.while_loop(state, hidden, test_direction, mode="symbolic", label="sight")
        return np.array(side).astype(np.int8)


def _scene(corners: Array) -> mt.Scene:
    """Mitsuba's scene of triangles [F, 3, 3]."""
    mi = backend.mitsuba()
    mesh = mi.Mesh("surface", 3 * len(corners), len(corners))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = upload(corners)
    parameters["faces"] = dr.arange(mi.UInt32, 3 * len(corners))
    parameters.update()
    return mi.load_dict({"type": "scene", "mesh": mesh})
