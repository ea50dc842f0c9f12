"""Watertight, outward-oriented meshes that spacecraft are built from: boxes, rods, pipes, revolved profiles and
sectors of them. Metres.
"""

from collections.abc import Sequence

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from spacesim.data.geometry import Array, normalize

SEGMENTS = 96
"""Straight segments of a circle where nothing else is said."""


def box(size: ArrayLike, centre: ArrayLike = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    """An axis-aligned box of edge lengths `size` [3]."""
    mesh = trimesh.creation.box(extents=size)
    mesh.apply_translation(centre)
    return mesh


def crumpled_box(size: ArrayLike, levels: int, depth: float, seed: int) -> trimesh.Trimesh:
    """A box about the origin whose faces are 2**levels by 2**levels uneven facets, their corners at random up
    to `depth` above or below the face: foil that is not quite flat."""
    mesh = trimesh.creation.box(extents=(1.0, 1.0, 1.0))
    for _ in range(levels):
        mesh = mesh.subdivide()
    along_normal = np.abs(mesh.vertices) == 0.5
    reach = np.where(along_normal, depth, 0.3 * np.asarray(size) / 2**levels)
    noise = np.random.default_rng(seed).uniform(-1.0, 1.0, mesh.vertices.shape)
    return trimesh.Trimesh(mesh.vertices * np.asarray(size) + reach * noise, mesh.faces, process=False)


def rod(start: ArrayLike, end: ArrayLike, radius: float, segments: int = 24) -> trimesh.Trimesh:
    """A solid cylinder from `start` [3] to `end` [3]."""
    return stretch_mesh(revolve([(0, 0), (radius, 0), (radius, 1), (0, 1)], segments), start, end)


def tube(start: ArrayLike, end: ArrayLike, inner: float, outer: float, segments: int = SEGMENTS) -> trimesh.Trimesh:
    """A cylinder from `start` [3] to `end` [3] with a hole through it."""
    profile = [(inner, 0), (outer, 0), (outer, 1), (inner, 1)]
    return stretch_mesh(revolve(profile, segments), start, end)


def dish(diameter: float, focal_length: float, thickness: float, rings: int = 16) -> trimesh.Trimesh:
    """A paraboloid shell that opens towards +z, its vertex (inside) at the origin."""
    radius = np.linspace(0.0, 0.5 * diameter, rings + 1)
    height = radius**2 / (4.0 * focal_length)
    inside = np.stack([radius, height], axis=-1)
    outside = inside - [0.0, thickness]
    return revolve(np.concatenate([outside, inside[::-1]]))


def revolve(profile: ArrayLike, segments: int = SEGMENTS) -> trimesh.Trimesh:
    """The solid that `profile` [P, 2] of (radius, z) sweeps about the z axis.

    The profile is a polygon, counter-clockwise in the (radius, z) plane, closed by itself; where its first
    and last points lie on the axis (radius 0) the solid has no hole.
    """
    profile = np.asarray(profile, dtype=np.float64)
    count = len(profile)
    angle = np.arange(segments) * (2.0 * np.pi / segments)
    radius, z = profile[:, 0], np.broadcast_to(profile[:, 1], (segments, count))
    vertices = np.stack([np.outer(np.cos(angle), radius), np.outer(np.sin(angle), radius), z], axis=-1)
    grid = np.arange(segments * count).reshape(segments, count)
    index = np.where(radius == 0.0, grid[:1], grid)  # one vertex for all segments on the axis
    ahead = np.roll(index, -1, axis=0)
    a, b, c, d = index, np.roll(index, -1, axis=1), np.roll(ahead, -1, axis=1), ahead
    faces = np.concatenate([np.stack([a, d, b], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    mesh = trimesh.Trimesh(vertices.reshape(-1, 3), faces[proper], process=False)
    mesh.remove_unreferenced_vertices()
    return mesh


def dome(radius: float, height: float, rings: int = 12) -> list[tuple[float, float]]:
    """Profile [(radius, z)] of half an ellipse of revolution, from its rim (radius, 0) to its pole (0, height)."""
    angle = np.linspace(0.0, 0.5 * np.pi, rings + 1)
    points = np.stack([radius * np.cos(angle), height * np.sin(angle)], axis=-1)
    points[-1, 0] = 0.0
    return [(float(r), float(z)) for r, z in points]


def sector(profile: ArrayLike, start_deg: float, end_deg: float, segments: int = 24) -> trimesh.Trimesh:
    """The solid that `profile` [P, 2] of (radius > 0, z) sweeps about the z axis from azimuth `start_deg` to
    `end_deg`, closed by a flat face at either end.

    The profile is a convex polygon, counter-clockwise in the (radius, z) plane.
    """
    profile = np.asarray(profile, dtype=np.float64)
    count = len(profile)
    angle = np.radians(np.linspace(start_deg, end_deg, segments + 1))
    radius, z = profile[:, 0], np.broadcast_to(profile[:, 1], (segments + 1, count))
    vertices = np.stack([np.outer(np.cos(angle), radius), np.outer(np.sin(angle), radius), z], axis=-1)
    grid = np.arange((segments + 1) * count).reshape(segments + 1, count)
    a, d = grid[:-1], grid[1:]
    b, c = np.roll(a, -1, axis=1), np.roll(d, -1, axis=1)
    sides = np.concatenate([np.stack([a, d, b], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])
    fan = np.array([[0, i, i + 1] for i in range(1, count - 1)])
    faces = np.concatenate([sides, grid[0][fan], grid[-1][fan][:, ::-1]])
    return trimesh.Trimesh(vertices.reshape(-1, 3), faces, process=False)


def pipe(points: ArrayLike, radius: float, segments: int = 12) -> trimesh.Trimesh:
    """A bent round bar through `points` [P, 3], at least two: mitred at every bend, flat at either end.

    The cross-section is carried along without twist. No bend may be sharper than 90 degrees.
    """
    points = np.asarray(points, dtype=np.float64)
    heading = normalize(np.diff(points, axis=0))
    angle = np.arange(segments) * (2.0 * np.pi / segments)
    turn = axis_frame(points[0], heading[0])[:3, :3]
    ring = points[0] + radius * (np.outer(np.cos(angle), turn[:, 0]) + np.outer(np.sin(angle), turn[:, 1]))
    rings = [ring]
    for i, point in enumerate(points[1:]):
        mitre = normalize(heading[i] + heading[min(i + 1, len(heading) - 1)])
        step = (point - ring) @ mitre / (heading[i] @ mitre)  # along the segment until the plane of the bend
        ring = ring + step[:, None] * heading[i]
        rings.append(ring)
    vertices = np.concatenate([*rings, points[[0, -1]]])
    grid = np.arange(len(points) * segments).reshape(len(points), segments)
    a, b = grid[:-1], np.roll(grid[:-1], -1, axis=1)
    d, c = grid[1:], np.roll(grid[1:], -1, axis=1)
    first, last = grid[0], grid[-1]
    bottom, top = len(vertices) - 2, len(vertices) - 1
    faces = np.concatenate(
        [
            np.stack([a, b, d], -1).reshape(-1, 3),
            np.stack([b, c, d], -1).reshape(-1, 3),
            np.stack([np.roll(first, -1), first, np.full(segments, bottom)], -1),
            np.stack([last, np.roll(last, -1), np.full(segments, top)], -1),
        ]
    )
    return trimesh.Trimesh(vertices, faces, process=False)


def handrail(start: ArrayLike, end: ArrayLike, away: ArrayLike, height: float, radius: float) -> trimesh.Trimesh:
    """A bent bar that leaves the surface at `start` [3], runs `height` above it along direction `away` [3], and
    comes back at `end` [3]."""
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    lift = height * normalize(np.asarray(away, dtype=np.float64))
    return pipe([start, start + lift, end + lift, end], radius, 8)


def stretch_mesh(mesh: trimesh.Trimesh, start: ArrayLike, end: ArrayLike) -> trimesh.Trimesh:
    """`mesh` with z in [0, 1] stretched and turned so that its axis runs from `start` [3] to `end` [3]."""
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    mesh = mesh.copy()
    mesh.apply_scale([1.0, 1.0, float(np.linalg.norm(end - start))])
    return place_mesh(mesh, start, end - start)


def place_mesh(mesh: trimesh.Trimesh, origin: ArrayLike, axis: ArrayLike) -> trimesh.Trimesh:
    """`mesh` with its z axis turned to `axis` [3] and then moved to `origin` [3]."""
    mesh = mesh.copy()
    mesh.apply_transform(axis_frame(origin, axis))
    return mesh


def axis_frame(origin: ArrayLike, axis: ArrayLike) -> Array:
    """A rigid transform [4, 4] that takes the origin to `origin` [3] and +z to the direction of `axis`
    [3]."""
    z = normalize(axis)
    helper = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    y = normalize(np.cross(z, helper))
    transform = np.eye(4)
    transform[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
    transform[:3, 3] = origin
    return transform


def rotate_mesh(
    mesh: trimesh.Trimesh, angle_deg: float, axis: ArrayLike, about: ArrayLike = (0, 0, 0)
) -> trimesh.Trimesh:
    """`mesh` turned by `angle_deg` about the line through `about` [3] along `axis` [3], right-handed."""
    mesh = mesh.copy()
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.radians(angle_deg), axis, about))
    return mesh


def translate_mesh(mesh: trimesh.Trimesh, offset: ArrayLike) -> trimesh.Trimesh:
    """`mesh` moved by `offset` [3]."""
    mesh = mesh.copy()
    mesh.apply_translation(offset)
    return mesh


def join_meshes(meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Several solids as one mesh."""
    return trimesh.util.concatenate(list(meshes))


def whole_cells(boxes: trimesh.Trimesh, cell: tuple[float, float]) -> Array:
    """[3 F, 2] metres: the faces of `boxes`, made by `box` and joined or moved, laid flat so that each begins and ends
    at a border of a pattern of cells.

    cell: the cells' width and height, which run along the first and the second of a face's two axes, in the order x,
    y, z of its box before it was moved. As many cells as fit best lie side by side, stretched to fill the face; a side
    of less than half a cell keeps its length.
    """
    corners = boxes.vertices.reshape(-1, 8, 3)
    lengths = np.linalg.norm(corners[:, [4, 2, 1]] - corners[:, :1], axis=2)  # [B, 3] along x, y and z
    corner_of_box = trimesh.creation.box().vertices + 0.5  # [8, 3], each 0 or 1
    places = corner_of_box[boxes.faces % 8]  # [F, 3, 3]
    across = np.array([[1, 2], [0, 2], [0, 1]])[np.ptp(places, axis=1).argmin(axis=1)]  # [F, 2]
    sides = np.take_along_axis(lengths[boxes.faces[:, 0] // 8], across, axis=1)
    rounded = np.round(sides / cell) * cell
    sides = np.where(rounded > 0, rounded, sides)
    return (np.take_along_axis(places, across[:, None, :], axis=2) * sides[:, None, :]).reshape(-1, 2)
