"""Which voxels a surface fills, whether it is watertight or not: for the overlap of two shapes (thesis 2.29)."""

import numpy as np
from scipy import ndimage

from spacesim.data.geometry import Array
from spacesim.data.mesh import SignedDistance
from spacesim.eval.exterior import Sight
from spacesim.splat.fusion import Grid

PROBES = 64  #: voxels of a region that tell of all of it, where they agree


def filled(vertices: Array, faces: np.ndarray, grid: Grid) -> np.ndarray:
    """[Z, Y, X] bool: whether the centre of each voxel is inside, by the winding number, or enclosed: cut off from
    outside by the surface, so that nothing far away can see it. A closed box is full whatever is in it, and faces
    turned inside out change nothing.

    vertices: [V, 3] metres;  faces: [F, 3];  grid: what lies beyond it does not count
    """
    distance, sight = SignedDistance(vertices, faces), Sight(vertices, faces)
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
        probes = _centres(members[np.linspace(0, len(members) - 1, min(PROBES, len(members))).astype(np.intp)], grid)
        answers = distance.inside(probes)
        hidden[region] = not (answers.all() or outside[region] or sight.seen(probes).any())
        agreed = hidden[region] or answers.all() or not answers.any()
        full[members] = hidden[region] or answers[0] if agreed else distance.inside(_centres(members, grid))
    layer = np.flatnonzero(near)
    full[layer] = distance.inside(_centres(layer, grid))
    if hidden.any():
        around = ndimage.binary_dilation(hidden[regions], np.ones((5, 5, 5), bool))
        beside = layer[(around.ravel() & ~full)[layer]]
        full[beside] = ~sight.seen(_centres(beside, grid))
    return full.reshape(near.shape)


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
