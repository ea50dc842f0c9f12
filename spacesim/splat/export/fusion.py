"""Depth pictures fused into a truncated signed distance: what a run's shape is taken from.

The mean, over the views, of how far a voxel lies before the surface that each sees, in units of the truncation (Curless
and Levoy 1996), weighted by how squarely the view sees it. A pixel without surface says that its whole ray is empty.
Each voxel is a thread of its own and takes the views in their order: the same input gives the same bits.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import prod

import drjit as dr
import numpy as np

from spacesim import backend
from spacesim.backend import ad
from spacesim.backend.arrays import Array2f, Bool, Float, UInt32
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.geometry import Array
from spacesim.data.records import Camera

TRUNCATION = 2.0  #: voxels (docs/research/geometry.md says what was tried)
STEP = 2.0  #: voxels; between pixels whose depths differ by more, depth is not interpolated
BATCH = 16  #: views in one kernel
BYTES = 32  #: a voxel takes at most, while views are fused and the surface is looked for: 23 to 30 were seen
USED = 0.8  #: share of the free memory that a grid may take
MAX_VOXELS = 2**31  #: what 32-bit indices reach
MAX_SIDE = 1e15  #: voxels along a side, that they can be counted
NEAR = 1e-6  #: metres; nearer voxels are behind the camera


@dataclass(frozen=True, eq=False)
class Grid:
    """Cubic voxels, aligned with the world."""

    origin: Array  #: [3] metres, centre of the first
    voxel: float  #: their side, metres
    shape: tuple[int, int, int]  #: (X, Y, Z) how many; fields over it are [Z, Y, X]

    @property
    def count(self) -> int:
        """Number of voxels."""
        return prod(self.shape)

    @staticmethod
    def around(low: Array, high: Array, voxel: float, margin: float) -> "Grid":
        """Voxels of side `voxel` that hold the box from `low` to `high` [3] and `margin` metres around it."""
        low, high = np.asarray(low) - margin, np.asarray(high) + margin
        sides = np.ceil(np.minimum((high - low) / voxel, MAX_SIDE))
        shape = np.maximum(sides, 1).astype(np.int64) + 1
        x, y, z = (int(side) for side in shape)
        return Grid(0.5 * (low + high) - 0.5 * voxel * (shape - 1), float(voxel), (x, y, z))


@dataclass(frozen=True, eq=False)
class DepthView:
    """A depth picture and its camera."""

    camera: Camera  #: from where it is seen
    depth: np.ndarray  #: [H, W] float32, z along the optical axis of `camera`, metres; 0 where there is no surface


@dataclass(frozen=True, eq=False)
class DistanceField:
    """A truncated signed distance on a grid."""

    grid: Grid  #: where the voxels are
    distance: np.ndarray  #: [Z, Y, X] float32 in [-1, 1], mean signed distance by the truncation, above 0 outside
    #: [Z, Y, X] bool, whether a view sees the voxel, or the surface less than the truncation before it
    observed: np.ndarray


def fuse(
    views: Iterable[DepthView],
    grid: Grid,
    truncation: float = TRUNCATION,
    progress: Callable[[int], None] | None = None,
) -> DistanceField:
    """The field of some views. truncation: voxels;  progress: called with the views done.

    Raises InputError where the grid does not fit into memory.
    """
    check_memory(grid)
    sums = dr.zeros(ad.Float, grid.count), dr.zeros(ad.Float, grid.count)
    lattice = upload(np.array([*grid.origin, grid.voxel])), ad.UInt32(list(grid.shape))
    limits = ad.Float([truncation * grid.voxel, STEP * grid.voxel])
    batch: list[DepthView] = []
    done = 0
    for view in views:
        batch.append(view)
        if len(batch) == BATCH:
            sums = _add(sums, _upload(batch), lattice, limits, grid.count)
            done, batch = done + BATCH, []
            if progress:
                progress(done)
    if batch:
        sums = _add(sums, _upload(batch), lattice, limits, grid.count)
        if progress:
            progress(done + len(batch))
    total, weight = (np.array(values).reshape(grid.shape[::-1]) for values in sums)
    observed = weight > 0
    distance = np.divide(total, weight, out=np.ones_like(total), where=observed)
    return DistanceField(grid, distance, observed)


def check_memory(grid: Grid) -> None:
    """Raises InputError where the voxels of `grid` do not fit into memory, with the size that would."""
    free = backend.free_memory(int(BYTES * grid.count / USED))
    most = MAX_VOXELS if free is None else min(MAX_VOXELS, int(USED * free / BYTES))
    if grid.count > most:
        sides = "x".join(map(str, grid.shape))
        least = grid.voxel * (grid.count / most) ** (1 / 3)
        raise InputError(
            f"voxel: expected a size whose grid fits into memory, found {grid.voxel:.4g} m: {sides} voxels take "
            f"{BYTES * grid.count / 1e9:.1f} GB; take at least {1.02 * least:.3g} m"
        )


@dataclass
class _Batch:
    """Views on the device."""

    numbers: Float  #: [18 V], of each view camera_from_world rows (12), fx, fy, cx, cy, width, height
    start: UInt32  #: [V], its first pixel in `depth`
    depth: Float
    count: UInt32  #: V


def _upload(views: Sequence[DepthView]) -> _Batch:
    numbers: list[float] = []
    for view in views:
        camera = view.camera
        height, width = view.depth.shape
        rows = camera.camera_from_world[:3].ravel()
        numbers += [*rows, camera.fx, camera.fy, camera.cx, camera.cy, width, height]
    sizes = [view.depth.size for view in views]
    start = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.uint32)
    depth = np.concatenate([np.asarray(view.depth, np.float32).ravel() for view in views])
    return _Batch(
        upload(np.asarray(numbers)),
        upload(start, ad.UInt32),
        upload(np.where(np.isfinite(depth), depth, 0)),
        ad.UInt32([len(views)]),
    )


def _add(
    sums: tuple[Float, Float], batch: _Batch, lattice: tuple[Float, UInt32], limits: Float, count: int
) -> tuple[Float, Float]:
    """The sums of (weight x distance, weight) over the views so far and those of `batch`."""
    place, side = lattice
    truncation, step = (dr.gather(ad.Float, limits, ad.UInt32(i)) for i in range(2))
    nx, ny = dr.gather(ad.UInt32, side, ad.UInt32(0)), dr.gather(ad.UInt32, side, ad.UInt32(1))
    index = dr.arange(ad.UInt32, count)
    nx, ny = dr.maximum(nx, 1), dr.maximum(ny, 1)  # LLVM's padding lanes divide, too
    cells = ad.Array3f(ad.Float(index % nx), ad.Float(index // nx % ny), ad.Float(index // (nx * ny)))
    x, y, z, voxel = (dr.gather(ad.Float, place, ad.UInt32(i)) for i in range(4))
    point = ad.Array3f(x, y, z) + voxel * cells
    last = dr.gather(ad.UInt32, batch.count, ad.UInt32(0))

    def has_more(view: UInt32, _total: object, _weight: object) -> Bool:
        return view < last

    def add_view(view: UInt32, total: Float, weight: Float) -> tuple[UInt32, Float, Float]:
        def number(i: int) -> Float:
            return dr.gather(ad.Float, batch.numbers, 18 * view + i)

        at = ad.Array3f(
            [dr.dot(ad.Array3f([number(4 * i + j) for j in range(3)]), point) + number(4 * i + 3) for i in range(3)]
        )
        before = at.z > NEAR
        scale = dr.rcp(dr.select(before, at.z, 1))
        column = dr.fma(number(12) * at.x, scale, number(14))
        row = dr.fma(number(13) * at.y, scale, number(15))
        width, height = number(16), number(17)
        inside = before & (column >= 0) & (row >= 0) & (column < width) & (row < height)
        focal = ad.Array2f(number(12), number(13))
        pixel = ad.Array2f(column, row)
        cell = _cell(batch.depth, dr.gather(ad.UInt32, batch.start, view), width, height, pixel, inside, step)
        ahead, slope = _signed_distance(cell, ad.Array2f(at.x, at.y) * scale, at.z, focal, truncation)
        share = slope * dr.minimum(2 * (1 + ahead / truncation), 1)  # deep behind the surface is guessed
        share = dr.select(inside & (ahead > -truncation), share, 0)
        above = dr.maximum(ahead / truncation, -1)
        return view + 1, total + share * dr.minimum(above, 1), weight + share

    state = dr.zeros(ad.UInt32, count), *sums
    _, total, weight = dr.while_loop(state, has_more, add_view, mode="symbolic", label="fuse")
    dr.eval(total, weight)
    return total, weight


@dataclass
class _Cell:
    """What the four pixels around a place show."""

    depth: Float  #: of the surface in front, metres, 0 where none has any
    rise: Array2f  #: its change by a column and by a row
    share: Float  #: bilinear, of the pixels that show it, 1 for all
    back: Float  #: depth of the others, infinite without surface


def _signed_distance(cell: _Cell, ray: Array2f, z: Float, focal: Array2f, truncation: Float) -> tuple[Float, Float]:
    """How far a voxel at depth `z` on the ray (x, y, 1) lies before the surface that a view sees, metres, and the
    weight of that.

    It is the distance from the plane through the surface: along the axis, times the cosine between that and the plane's
    normal, which is the weight, too. At an outline the distance is at most the one to the outline, across the ray: so
    outlines move neither in nor out.
    """
    inverse = dr.rcp(dr.select(cell.depth > 0, cell.depth, 1))
    a, b = (cell.rise[i] * focal[i] * inverse for i in range(2))
    slope = dr.rsqrt(a * a + b * b + dr.square(1 + a * ray.x + b * ray.y))
    is_covered = cell.share > 1 - 1e-4
    across = (0.5 - cell.share) * z / focal.x
    front = (cell.depth - z) * slope
    inner = dr.select(is_covered | (front >= 0) | (front <= -truncation), front, dr.maximum(front, across))
    beside = dr.minimum(cell.back - z, across)
    ahead = dr.select(cell.depth > 0, dr.select(cell.share >= 0.5, inner, beside), truncation)
    return ahead, slope


def _cell(depth: Float, start: UInt32, width: Float, height: Float, pixel: Array2f, inside: Bool, step: Float) -> _Cell:
    """The four pixels whose centres are around `pixel` ."""
    stride = ad.UInt32(width)
    left, top = dr.clip(pixel.x - 0.5, 0, width - 1), dr.clip(pixel.y - 0.5, 0, height - 1)
    x0, y0 = dr.minimum(dr.floor(left), dr.maximum(width - 2, 0)), dr.minimum(dr.floor(top), dr.maximum(height - 2, 0))
    fx, fy = left - x0, top - y0
    corner = start + ad.UInt32(y0) * stride + ad.UInt32(x0)
    right, down = dr.select(width > 1, ad.UInt32(1), 0), dr.select(height > 1, stride, 0)
    depths = [
        dr.gather(ad.Float, depth, corner + offset, inside) for offset in (ad.UInt32(0), right, down, right + down)
    ]
    weights = [(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy]
    near = [dr.select(pixel_depth > 0, pixel_depth, dr.inf) for pixel_depth in depths]
    upper, lower = dr.minimum(near[0], near[1]), dr.minimum(near[2], near[3])
    lowest = dr.minimum(upper, lower)
    share, mean, back = ad.Float(0), ad.Float(0), ad.Float(dr.inf)
    for pixel_depth, weight in zip(near, weights, strict=True):
        front = pixel_depth - lowest <= step
        share += dr.select(front, weight, 0)
        mean += dr.select(front, weight * pixel_depth, 0)
        back = dr.select(front, back, dr.minimum(back, pixel_depth))
    shown = dr.isfinite(lowest)
    share = dr.select(shown, share, 0)
    a, b, c, d = depths
    is_covered = share > 1 - 1e-4
    rise = ad.Array2f(dr.lerp(b - a, d - c, fy), dr.lerp(c - a, d - b, fx))
    value = dr.select(shown, dr.select(share > 1e-4, mean / dr.maximum(share, 1e-4), lowest), 0)
    return _Cell(value, dr.select(is_covered, rise, 0), share, back)
