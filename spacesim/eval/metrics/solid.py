"""Which voxels a surface fills, whether it is watertight or not: for the overlap of two shapes (thesis 2.29)."""

import numpy as np
from scipy import ndimage

from spacesim.data.geometry import Array
from spacesim.data.mesh import SignedDistance, drawable_faces
from spacesim.eval.metrics.exterior import ExteriorView
from spacesim.splat.export.fusion import Grid

MAX_VOXELS = 2**23  #: of a grid beyond the common one; with more, its voxels are twice, four times... as wide
MAX_SIDE = 1024  #: voxels along a side of it, likewise
APART = 4  #: voxels between parts of a surface that are counted on their own: too many for them to enclose anything
PROBES = 64  #: voxels of a region that are asked whether anything far away sees it


def filled_voxels(vertices: Array, faces: np.ndarray, grid: Grid) -> np.ndarray:
    """[Z, Y, X] bool: whether the centre of each voxel is inside, by the winding number, or enclosed: cut off from
    outside by the surface, so that nothing far away can see it. A closed box is full whatever is in it, and faces
    turned inside out change nothing.

    vertices: [V, 3] metres;  faces: [F, 3];  grid: what lies beyond it does not count
    """
    distance, sight, closed = SignedDistance(vertices, faces), ExteriorView(vertices, faces), _closed(vertices, faces)
    near = _near(vertices[faces], grid)
    regions, count = ndimage.label(~near)
    outside = np.zeros(count + 1, bool)
    for axis in range(3):
        for end in (0, -1):
            outside[regions.take(end, axis)] = True
    order = np.argsort(regions, axis=None, kind="stable")
    ends = np.cumsum(np.bincount(regions.ravel(), minlength=count + 1))
    full = np.zeros(near.size, bool)
    hidden = np.zeros(count + 1, bool)
    for region in range(1, count + 1):
        members = order[ends[region - 1] : ends[region]]
        inside = distance.inside(_centres(members[:1] if closed else members, grid))
        probes = members[np.linspace(0, len(members) - 1, min(PROBES, len(members))).astype(np.intp)]
        hidden[region] = not (inside.all() or outside[region] or sight.is_seen(_centres(probes, grid)).any())
        full[members] = hidden[region] or inside
    layer = np.flatnonzero(near)
    full[layer] = distance.inside(_centres(layer, grid))
    if hidden.any():
        around = ndimage.binary_dilation(hidden[regions], np.ones((5, 5, 5), bool))
        beside = layer[(around.ravel() & ~full)[layer]]
        full[beside] = ~sight.is_seen(_centres(beside, grid))
    return full.reshape(near.shape)


def filled_beyond(vertices: Array, faces: np.ndarray, grid: Grid) -> float:
    """How many voxels of `grid`'s lattice a surface fills beyond `grid`.

    Parts of the surface that lie apart have a grid of their own on that lattice, one after the other, so that memory is
    bounded. Where that takes more than `MAX_VOXELS`, wider voxels are counted by their volume.

    vertices: [V, 3] metres;  faces: [F, 3]
    """
    low, high = grid.origin - 0.5 * grid.voxel, grid.origin + (np.array(grid.shape) - 0.5) * grid.voxel
    faces = drawable_faces(vertices, faces)
    corners = vertices[faces]
    lowest, highest = corners.min(axis=1), corners.max(axis=1)
    total = 0.0
    for part in _apart(lowest, highest, APART * grid.voxel):
        ends = lowest[part].min(axis=0), highest[part].max(axis=0)
        if (ends[0] >= low).all() and (ends[1] <= high).all():
            continue
        own = _on_lattice(*ends, grid)
        centres = _centres(np.flatnonzero(filled_voxels(vertices, faces[part], own)), own)
        beyond = ~((centres > low) & (centres < high)).all(axis=1)
        total += int(beyond.sum()) * (own.voxel / grid.voxel) ** 3
    return total


def _apart(low: Array, high: Array, gap: float) -> list[np.ndarray]:
    """Indices of boxes from `low` to `high` [N, 3], in sets between which planes across the axes leave more than `gap`
    metres free. Boxes that touch are in one set."""
    pending, groups = [np.arange(len(low))] if len(low) else [], []
    while pending:
        index = pending.pop()
        for axis in range(3):
            order = index[np.argsort(low[index, axis], kind="stable")]
            ends = np.maximum.accumulate(high[order, axis])
            cuts = np.flatnonzero(low[order[1:], axis] > ends[:-1] + gap) + 1
            if len(cuts):
                pending += np.split(order, cuts)
                break
        else:
            groups.append(index)
    return groups


def _on_lattice(low: Array, high: Array, grid: Grid) -> Grid:
    """Around the box from `low` to `high` [3], voxels at the places where those of `grid` would go on; wider ones where
    there would be too many."""
    voxel = grid.voxel
    while True:
        first = np.floor((low - grid.origin) / voxel).astype(np.int64) - 3
        x, y, z = (int(side) for side in np.ceil((high - grid.origin) / voxel).astype(np.int64) + 4 - first)
        if max(x, y, z) <= MAX_SIDE and x * y * z <= MAX_VOXELS:
            return Grid(grid.origin + voxel * first, voxel, (x, y, z))
        voxel *= 2


def _closed(vertices: Array, faces: np.ndarray) -> bool:
    """Whether every edge is passed as often one way as the other: then winding numbers are the same all over a region
    that no face cuts. Corners in one place are one."""
    corner = np.unique(vertices, axis=0, return_inverse=True)[1].ravel()[faces]
    ends = np.stack([corner, np.roll(corner, -1, axis=1)], axis=-1).reshape(-1, 2)
    edge = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)[1].ravel()
    return not np.bincount(edge, np.sign(ends[:, 1] - ends[:, 0])).any()


def _near(corners: Array, grid: Grid) -> np.ndarray:
    """[Z, Y, X] bool: a closed layer of voxels around triangles [F, 3, 3]: those that hold points of them at most half
    a voxel apart, and all neighbours of these."""
    mark = np.zeros(grid.shape[::-1], bool)
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps = np.maximum(np.ceil(edges / (0.5 * grid.voxel)), 1).astype(np.int64)
    for step in np.unique(steps):
        i, j = np.nonzero(np.tri(step + 1)[::-1])
        weights = np.stack([i, j, step - i - j], axis=1) / step
        group = corners[steps == step]
        for part in np.array_split(group, max(len(group) * len(weights) // 2_000_000, 1)):
            cells = np.rint((np.einsum("kc,fcd->fkd", weights, part).reshape(-1, 3) - grid.origin) / grid.voxel)
            x, y, z = cells[((cells >= 0) & (cells < grid.shape)).all(axis=1)].astype(np.int64).T
            mark[z, y, x] = True
    return ndimage.binary_dilation(mark, np.ones((3, 3, 3), bool))


def _centres(index: np.ndarray, grid: Grid) -> Array:
    """[N, 3] metres, of voxels by their place in a field."""
    z, y, x = np.unravel_index(index, grid.shape[::-1])
    return np.asarray(grid.origin + grid.voxel * np.stack([x, y, z], axis=1), np.float64)
