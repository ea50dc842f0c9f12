"""Which voxels a surface fills, whether it is watertight or not: for the overlap of two shapes (thesis 2.29)."""

import numpy as np
from scipy import ndimage

from spacesim.data.geometry import Array
from spacesim.data.mesh import SignedDistance
from spacesim.eval.metrics.exterior import Sight
from spacesim.splat.export.fusion import Grid

PROBES = 64  #: voxels of a region that are asked whether anything far away sees it


def filled(vertices: Array, faces: np.ndarray, grid: Grid) -> np.ndarray:
    """[Z, Y, X] bool: whether the centre of each voxel is inside, by the winding number, or enclosed: cut off from
    outside by the surface, so that nothing far away can see it. A closed box is full whatever is in it, and faces
    turned inside out change nothing.

    vertices: [V, 3] metres;  faces: [F, 3];  grid: what lies beyond it does not count
    """
    distance, sight, closed = SignedDistance(vertices, faces), Sight(vertices, faces), _closed(vertices, faces)
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
        hidden[region] = not (inside.all() or outside[region] or sight.seen(_centres(probes, grid)).any())
        full[members] = hidden[region] or inside
    layer = np.flatnonzero(near)
    full[layer] = distance.inside(_centres(layer, grid))
    if hidden.any():
        around = ndimage.binary_dilation(hidden[regions], np.ones((5, 5, 5), bool))
        beside = layer[(around.ravel() & ~full)[layer]]
        full[beside] = ~sight.seen(_centres(beside, grid))
    return full.reshape(near.shape)


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
