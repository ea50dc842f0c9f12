"""A second ray caster, in numpy and float64, which shares no code with Mitsuba, and what it says about labels.

Rays through one point, or in one direction, are points of a plane, onto which triangles are projected: what a ray
meets first is, among the triangles that hold its point, the one with the least depth there. `test_labels.py` compares
it with trimesh's ray caster.
"""

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from spacesim.data.records import Camera, Sun, Truth
from spacesim.scenes.build import build
from spacesim.scenes.generation.generate import plan_views
from spacesim.scenes.lights.sun import SunConfig
from spacesim.scenes.render import Renderer
from spacesim.scenes.scene import Scene
from spacesim.scenes.scenefile import read_scene

NEAR_EDGE = 0.02
"""Pixels, chosen: an edge that is nearer to a pixel's centre may fall on either side of it."""

LIFT = 1.1e-5
"""The renderer begins shadow rays so far above a surface, in parts of the radius of the scene's bounding sphere, that a
surface in float32 does not shadow itself. Under grazing light, shadows begin that much later."""

OFF_PLANE = 1e-6
"""Chosen: how far the point that a depth tells may lie from its surface's plane, in parts of its distance. Float32 has
6e-8, a ray of it several such errors."""

PAIRS = 4_000_000  #: of points and triangles, tested at once
CELLS = 96  #: along a side of the grid that finds them


def first_below(
    points: np.ndarray, corners: np.ndarray, depths: np.ndarray, floor: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(triangle [N], -1 for none; depth [N]) of least depth above `floor` [N] at `points` [N, 2].

    corners: [F, 3, 2], depths: [F, 3] of triangles, linear over each of them.
    """
    face, depth = np.full(len(points), -1), np.full(len(points), np.inf)
    for point, triangle in _pairs(points, corners):
        a, b, c = np.moveaxis(corners[triangle], 1, 0) - points[point][None]
        weights = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)])
        area = weights.sum(axis=0)
        inside = (area != 0) & ((weights >= 0).all(axis=0) | (weights <= 0).all(axis=0))
        point, triangle, weights = point[inside], triangle[inside], weights[:, inside] / area[inside]
        found = (weights * depths[triangle].T).sum(axis=0)
        above = found > floor[point]
        point, triangle, found = point[above], triangle[above], found[above]
        order = np.lexsort((triangle, found, point))
        point, triangle, found = point[order], triangle[order], found[order]
        first = np.unique(point, return_index=True)[1]
        point, triangle, found = point[first], triangle[first], found[first]
        nearer = found < depth[point]
        face[point[nearer]], depth[point[nearer]] = triangle[nearer], found[nearer]
    return face, depth


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _pairs(points: np.ndarray, corners: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(point, triangle) numbers whose boxes share a cell of a grid, in several batches."""
    low, high = points.min(axis=0), points.max(axis=0)
    size = np.maximum(high - low, 1e-12) / CELLS * (1 + 1e-9)
    cell_of = np.clip(((points - low) / size).astype(int), 0, CELLS - 1) @ [CELLS, 1]
    order = np.argsort(cell_of, kind="stable")
    starts = np.searchsorted(cell_of[order], np.arange(CELLS**2 + 1))
    first = np.floor((corners.min(axis=1) - low) / size - 1e-6).clip(-1, CELLS).astype(int)
    last = np.floor((corners.max(axis=1) - low) / size + 1e-6).clip(-1, CELLS).astype(int)
    (triangle,) = np.nonzero(((last >= 0) & (first < CELLS)).all(axis=1))
    first, last = first[triangle].clip(0), last[triangle].clip(None, CELLS - 1)
    sides = last - first + 1
    which, k = _repeated(sides.prod(axis=1))
    cell = (first[which, 0] + k // sides[which, 1]) * CELLS + first[which, 1] + k % sides[which, 1]
    held = starts[cell + 1] - starts[cell]
    which, cell, held = which[held > 0], cell[held > 0], held[held > 0]
    batch = np.cumsum(held) // PAIRS
    for i in np.unique(batch):
        one = batch == i
        item, k = _repeated(held[one])
        yield order[starts[cell[one][item]] + k], triangle[which[one][item]]


def _repeated(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(item, k): each item as often as `counts` says, k from 0 on."""
    item = np.repeat(np.arange(len(counts)), counts)
    return item, np.arange(len(item)) - np.repeat(np.cumsum(counts) - counts, counts)


def across(direction: np.ndarray) -> np.ndarray:
    """[3, 2] two unit vectors at right angles to a unit vector and to each other."""
    one = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    one /= np.linalg.norm(one)
    return np.stack([one, np.cross(direction, one)], axis=1)


class RayCaster:
    """Casts rays at all parts of a scene."""

    def __init__(self, scene: Scene) -> None:
        sizes = [len(placed.mesh.faces) for placed in scene.parts]
        self.part_of_face = np.repeat([placed.part_id for placed in scene.parts], sizes)
        self.object_of_face = np.repeat([placed.object_id for placed in scene.parts], sizes)
        self.triangles = np.concatenate([np.asarray(placed.mesh.triangles, np.float64) for placed in scene.parts])
        edges = self.triangles[:, 1:] - self.triangles[:, :1]
        normals = np.cross(edges[:, 0], edges[:, 1])
        self.normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        self.radius = scene.bounding_sphere[1]
        self.size = np.abs(self.triangles).max()

    def seen(self, camera: Camera, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(face [N], -1 for none; depth [N] along the axis; ray [N, 3] of depth 1) at image positions `at` [N, 2]."""
        x, y = (at[:, 0] - camera.cx) / camera.fx, (at[:, 1] - camera.cy) / camera.fy
        local = (self.triangles - camera.position) @ camera.world_from_camera[:3, :3]
        assert local[..., 2].min() > 0, "all triangles are before the camera"
        inverse = 1 / local[..., 2]  # linear in the image
        corners = local[..., :2] * inverse[..., None]
        face, depth = first_below(np.stack([x, y], axis=1), corners, -inverse, np.full(len(at), -np.inf))
        ray = np.stack([x, y, np.ones_like(x)], axis=1) @ camera.world_from_camera[:3, :3].T
        return face, np.where(face >= 0, -1 / depth, 0.0), ray

    def towards(self, direction: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Face [N] that rays from `points` [N, 3] on surfaces meet first, -1 for none. What is nearer than 1e-6 of the
        scene's size is the surface itself."""
        axes = across(direction)
        floor = points @ direction + 1e-6 * self.size
        return first_below(points @ axes, self.triangles @ axes, self.triangles @ direction, floor)[0]

    def labels(
        self, camera: Camera, sun: Sun, at: np.ndarray, pixel: np.ndarray | None = None, lift: float = 0.0
    ) -> dict[str, np.ndarray]:
        """Labels under parallel light at the image positions `at` [N, 2] (x, y).

        pixel: [2] an image position; lengths are where its ray meets the planes that are seen `at` places about it.
        lift: how far above the surface shadow rays begin, in parts of the bounding sphere's radius.
        """
        face, depth, ray = self.seen(camera, at)
        hit = face >= 0
        normals = self.normals[face] * hit[:, None]
        normals *= np.where((normals * ray).sum(axis=1) > 0, -1.0, 1.0)[:, None]  # surfaces have two sides
        cosine = normals @ sun.direction
        shadow = np.where(hit, np.where(cosine > 0, 255, 85), 0)
        lit = np.flatnonzero(cosine > 0)
        points = camera.position + depth[lit, None] * ray[lit]
        points += lift * self.radius * normals[lit]
        blocker = self.towards(sun.direction, points) if len(lit) else lit
        if pixel is not None:
            x, y = (pixel - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
            steep = (normals * ray).sum(axis=1)
            ray = np.tile(camera.world_from_camera[:3, :3] @ [x, y, 1.0], (len(at), 1))
            depth = depth * np.divide(steep, (normals * ray).sum(axis=1), out=np.ones(len(at)), where=hit)
        by, own = self.object_of_face[blocker], self.object_of_face[face[lit]]
        shadow[lit] = np.where(blocker >= 0, np.where(by == own, 170, 170 + by), 255)
        return {
            "incidence": np.where(hit, np.abs((normals * ray).sum(axis=1)) / np.linalg.norm(ray, axis=1), 1.0),
            "depth": depth,
            "distance": depth * np.linalg.norm(ray, axis=1),
            "normal": normals,
            "object_id": np.where(hit, self.object_of_face[face], 0),
            "part_id": np.where(hit, self.part_of_face[face], 0),
            "sun_cosine": cosine,
            "sun_visibility": (shadow == 255).astype(float),
            "shadow": shadow,
        }

    def sun_seen(self, points: np.ndarray, normals: np.ndarray, sun: Sun, radius: float, strata: int) -> np.ndarray:
        """[N] fraction of the solar disc (angular `radius`, radians) that `points` [N, 3] see, by strata^2 directions.
        What is below the horizon of `normals` [N, 3] is hidden."""
        rng = np.random.default_rng(1)
        i, j = np.divmod(np.arange(strata**2), strata)
        r = math.sin(radius) * np.sqrt((i + rng.random(i.size)) / strata)
        turn = 2 * math.pi * (j + rng.random(i.size)) / strata
        axes = across(sun.direction)
        offsets = r[:, None] * (np.cos(turn)[:, None] * axes[:, 0] + np.sin(turn)[:, None] * axes[:, 1])
        directions = offsets + np.sqrt(1 - r**2)[:, None] * sun.direction
        seen = normals @ directions.T > 0
        point, triangle = self._beneath(points @ axes, self.triangles @ axes, 4 * self.size * math.tan(radius))
        for k in np.unique(point):
            seen[k] &= ~self._hidden(points[k], directions, triangle[point == k])
        return seen.mean(axis=1)

    def _beneath(self, points: np.ndarray, corners: np.ndarray, margin: float) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of points and of triangles whose box, made wider by `margin`, holds them."""
        low, high = corners.min(axis=1) - margin, corners.max(axis=1) + margin
        pairs = [np.stack(pair) for pair in _pairs(points, np.stack([low, high], axis=1))]
        point, triangle = np.concatenate(pairs, axis=1)
        inside = ((points[point] >= low[triangle]) & (points[point] <= high[triangle])).all(axis=1)
        return point[inside], triangle[inside]

    def _hidden(self, start: np.ndarray, directions: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """[N] bool: rays from `start` [3] in `directions` [N, 3] that meet one of the `faces` [K].

        Moeller and Trumbore 1997: distance and barycentric coordinates as ratios of triple products.
        """
        corner, one, other = np.moveaxis(self.triangles[faces], 1, 0)
        one, other, to = one - corner, other - corner, start - corner
        normal, moment = np.cross(one, other), np.cross(to, directions[:, None])  # [K, 3], [N, K, 3]
        volume = -directions @ normal.T  # [N, K]
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = (moment * other).sum(-1) / volume, -(moment * one).sum(-1) / volume
            t = (to * normal).sum(-1) / volume
        return ((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-6 * self.size)).any(axis=1)


@dataclass(frozen=True)
class Agreement:
    """Of labels in one or several images: pixels of the images, of a surface, those that differ from the ray caster's.

    edge: of these, pixels with that answer within NEAR_EDGE
    offset: others with it where shadow rays begin as high as the renderer's
    wrong: all others, counted for each label
    classes: shadow classes and how many pixels have them
    off_plane: largest of the pixels that agree, see OFF_PLANE
    """

    pixels: int
    surface: int
    edge: int
    offset: int
    wrong: Counter[str]
    classes: Counter[int]
    off_plane: float

    def __add__(self, other: "Agreement") -> "Agreement":
        numbers = {key: getattr(self, key) + getattr(other, key) for key in ("pixels", "surface", "edge", "offset")}
        both = Counter(self.wrong) + Counter(other.wrong), Counter(self.classes) + Counter(other.classes)
        return Agreement(**numbers, wrong=both[0], classes=both[1], off_plane=max(self.off_plane, other.off_plane))


LENGTHS = ("depth", "distance")
LABELS = (*LENGTHS, "normal", "object_id", "part_id", "sun_cosine", "sun_visibility", "shadow")


def differences(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """[N] bool for each label of `found`: off the plane by more than OFF_PLANE, or not the same up to 0.001 of a normal
    or cosine."""
    different = {}
    for key, values in found.items():
        off = np.abs(values - expected[key]).reshape(len(values), -1).max(axis=1)
        if key in LENGTHS:
            off, limit = off * expected["incidence"], OFF_PLANE * expected[key]
        else:
            limit = np.full(len(values), 1e-3)
        different[key] = off > limit
    return different


def any_of(different: dict[str, np.ndarray]) -> np.ndarray:
    return np.any(list(different.values()), axis=0)


def compare(truth: Truth, caster: RayCaster, camera: Camera, sun: Sun, seed: int = 0) -> Agreement:
    """The labels of every pixel against the ray caster's. Where they differ, the same answer must be found within
    NEAR_EDGE pixels of the centre (256 places, at random): the pixel is on an edge."""
    height, width = truth.object_id.shape
    centres = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1).reshape(-1, 2)
    expected = caster.labels(camera, sun, centres)
    found = {key: getattr(truth, key).reshape(height * width, -1).squeeze().astype(float) for key in LABELS}
    different = differences(found, expected)
    counts, wrong = {0.0: 0, LIFT: 0}, Counter[str]()
    rng = np.random.default_rng(seed)
    for k in np.flatnonzero(any_of(different)):
        near = centres[k] + NEAR_EDGE * rng.uniform(-1, 1, (256, 2))
        answer = {key: np.repeat(values[k : k + 1], len(near), axis=0) for key, values in found.items()}
        for lift in counts:
            if not any_of(differences(answer, caster.labels(camera, sun, near, centres[k], lift))).all():
                counts[lift] += 1
                break
        else:
            wrong.update(key for key, values in different.items() if values[k])
    same = (expected["depth"] > 0) & ~different["depth"]
    off = np.abs(found["depth"] / np.where(same, expected["depth"], 1) - 1) * expected["incidence"]
    return Agreement(
        pixels=len(centres),
        surface=int((expected["depth"] > 0).sum()),
        edge=counts[0.0],
        offset=counts[LIFT],
        wrong=wrong,
        classes=Counter(truth.shadow.ravel().tolist()),
        off_plane=float(off[same].max(initial=0)),
    )


def labels_agree(
    source: str | Path,
    views: int = 1,
    resolution: int = 128,
    first: int = 0,
    sun: tuple[float, float] = (45.0, 35.0),
    **options: Any,
) -> Agreement:
    """`compare` over some of 8 test views of a scene, built in or a file, under one Sun of parallel light."""
    config = read_scene(source, sun=(sun,), test_views=8, resolution=resolution, **options)
    scene = replace(build(config), sun=SunConfig("directional"))
    renderer, caster = Renderer(scene, spp=1), RayCaster(scene)
    found = []
    for _, view in plan_views(scene, config)[1][first : first + views]:
        truth = renderer.render(view.camera, view.sun, seed=(0,))
        found.append(compare(truth, caster, view.camera, view.sun))
    return sum(found[1:], found[0])


@dataclass(frozen=True)
class Penumbra:
    """Points beside cast shadows."""

    visibility: np.ndarray  #: [N]
    expected: np.ndarray  #: [N]
    pixel: np.ndarray  #: [N, 3] view, row and column of each

    @property
    def error(self) -> np.ndarray:
        return np.abs(self.visibility - self.expected)


def penumbra(
    source: str | Path, count: int = 2000, views: int = 8, resolution: int = 256, strata: int = 32
) -> Penumbra:
    """The label sun_visibility at `count` points in or within a pixel of penumbrae and edges of cast shadows, and the
    fraction of strata^2 directions, at random in equal parts of the solar disc, that the ray caster finds free."""
    config = read_scene(source, sun=((45.0, 35.0),), test_views=8, resolution=resolution)
    scene = build(config)
    renderer, caster = Renderer(scene, spp=1), RayCaster(scene)
    rng = np.random.default_rng(0)
    found = []
    for i, (_, view) in enumerate(plan_views(scene, config)[1][:views]):
        truth = renderer.render(view.camera, view.sun, seed=(0,))
        at = np.concatenate([rng.permutation(np.argwhere(mask))[: count // views // 2] for mask in _penumbrae(truth)])
        if len(at) == 0:
            continue
        face, depth, ray = caster.seen(view.camera, at[:, ::-1] + 0.5)
        hit = face >= 0
        hit[hit] = caster.part_of_face[face[hit]] == truth.part_id[tuple(at[hit].T)]  # else the pixel is on an edge
        at, face, points = at[hit], face[hit], (view.camera.position + depth[:, None] * ray)[hit]
        normals = caster.normals[face] * np.where((caster.normals[face] * ray[hit]).sum(axis=1) > 0, -1, 1)[:, None]
        expected = caster.sun_seen(points, normals, view.sun, scene.sun.angular_radius, strata)
        pixel = np.column_stack([np.full(len(at), i), at])
        found.append((truth.sun_visibility[tuple(at.T)], expected, pixel))
    return Penumbra(*(np.concatenate(values) for values in zip(*found, strict=True)))


def _penumbrae(truth: Truth) -> tuple[np.ndarray, np.ndarray]:
    """[H, W] bool, of sides that face the Sun: penumbrae, and what is within a pixel of one or of a shadow's edge."""
    faces = truth.sun_cosine > 0
    full, none = faces & (truth.sun_visibility == 1), faces & (truth.sun_visibility == 0)
    part = faces & ~full & ~none

    def grown(mask: np.ndarray) -> np.ndarray:
        padded = np.pad(mask, 1)
        return np.any([np.roll(padded, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)[1:-1, 1:-1]

    return part, faces & ~part & (grown(part) | (grown(full) & grown(none)))
