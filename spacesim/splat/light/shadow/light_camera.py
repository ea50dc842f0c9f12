"""The light camera: an orthographic camera that looks along the sunlight and holds all Gaussians (thesis 4.3.1, 4.3.5).

A Sun enters the kernels as an array of nine numbers, so another Sun compiles nothing; the camera is fitted where the
Gaussians are, so that no step waits for the host.
"""

import math
from functools import lru_cache

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Array4f, Bool, Float, Float64
from spacesim.backend.packet import numbers_at
from spacesim.backend.upload import upload_numbers
from spacesim.data.geometry import Array
from spacesim.data.records import Sun
from spacesim.splat.light.padded_batch import PaddedBatch
from spacesim.splat.raster.cameras import MAX_MAGNITUDE, Orthographic
from spacesim.splat.raster.gaussians import Gaussians, opacities, principal_axes
from spacesim.splat.raster.project import ALPHA_MIN

SUPPORT = 3.0  #: standard deviations of a single Gaussian that its light camera holds (thesis 4.31)
REACH = 4.0  #: standard deviations of the whole, on either side of its mean, that a light camera holds at most
MARGIN = 1.0  #: pixels left free along each border
BLOCK = 1024  #: numbers that are reduced at once, of which capacities are a multiple
UPRIGHT = 1e-10  #: radians off the vertical that are rounding of angles
SUNS = 4096  #: whose axes and encodings are kept
MIN_EXTENT_SHARE = 1e-3  #: least extent of the image, as a share of its larger one


def light_axes(direction: ArrayLike) -> Array:
    """R_l of thesis 4.12: [3, 3] float64, columns are the light camera's x, y and z axes in the world (OpenCV axes).

    direction: [3], from the scene towards the Sun, of any length. z = -s. The frame is the one of (x, -y, -z), a Sun
    overhead, turned to s by the shortest way: continuous for all Suns but the one straight below, at -z, where x stays
    the world's. Raises InputError where the direction is none.
    """
    return np.array(_axes(*_unit(direction))).T


def _unit(direction: ArrayLike) -> list[float]:
    """Unit vector, in numbers of Python's: numpy takes ten times as long for three. Raises InputError as `Sun`."""
    numbers = np.asarray(direction, dtype=np.float64)
    length = math.hypot(*numbers.tolist()) if numbers.shape == (3,) else 0.0
    if not 0.5 < length < 2:  # far from a unit vector, and perhaps none at all
        return list(Sun(numbers).direction.tolist())
    return [number / length for number in numbers.tolist()]


def _axes(x: float, y: float, z: float) -> list[list[float]]:
    """The x, y and z axes of `light_axes` for a unit vector."""
    across = x * x + y * y
    if across < UPRIGHT**2:
        sign = -1.0 if z > 0 else 1.0
        return [[1.0, 0.0, 0.0], [0.0, sign, 0.0], [0.0, 0.0, sign]]
    inverse = 1 / (1 + z) if z >= 0 else (1 - z) / across  # equal on the unit sphere; the latter does not cancel
    return [[1 - x * x * inverse, -x * y * inverse, -x], [x * y * inverse, y * y * inverse - 1, y], [-x, -y, -z]]


def light_rows(direction: ArrayLike) -> Float:
    """`light_axes` for the kernels: Float [9], the light camera's x, y and z axes one after another. Kept for the next
    picture under this Sun. Raises InputError as it does."""
    return _rows(*_unit(direction))


@lru_cache(maxsize=SUNS)
def _rows(x: float, y: float, z: float) -> Float:
    return upload_numbers([number for axis in _axes(x, y, z) for number in axis])


def towards_sun(light: Float) -> Array3f:
    """s: Array3f of width 1, from the scene towards the Sun, of `light_rows`."""
    return -_axis(light, 2)


def fit_camera(
    gaussians: Gaussians, light: Float, size: int, crop: bool = True, batch: PaddedBatch | None = None
) -> Orthographic:
    """The light camera of size x size pixels that holds the Gaussians' 3 sigma supports (thesis 4.29 to 4.35).

    light: Float [9] of `light_rows`. Pixels need not be square (4.35). The image's bounds are those of the supports,
    with `crop` at most `REACH` standard deviations of the whole (the spread of the means and of the Gaussians
    themselves) to either side of the mean, so that a stray Gaussian does not cost the others their resolution; depth
    counts from the plane through that mean. Only Gaussians that can be drawn count; of none, the image is a metre wide
    about the world's origin. Nothing waits for the device. Detached.
    batch: of these, which a recording that this is a part of must have as an argument
    """
    if gaussians.count == 0:
        return _camera(light, ad.Array3f(0), [(ad.Float(-0.5), ad.Float(0.5))] * 2, size)
    assert batch is not None or not dr.flag(dr.JitFlag.FreezingScope), "a recording is of one capacity"
    batch = PaddedBatch.of(gaussians.count) if batch is None else batch
    shapes = gaussians.means, gaussians.log_scales, gaussians.quaternions, gaussians.logit_opacities
    means, log_scales, quaternions, logits = (batch.repeat_last(dr.detach(values)) for values in shapes)
    drawn = drawable_mask(means, log_scales, quaternions, logits) & batch.is_real()
    columns, scales = principal_axes(quaternions), dr.exp(dr.select(drawn, log_scales, ad.Array3f(0)))
    # in double precision, sums about the world's origin are as good as about the mean, which took a pass of its own
    places = [ad.Float64(dr.select(drawn, row, 0)) for row in means]
    axes = [_axis(light, i) for i in range(2)]
    ends, squares = [], []
    for axis in axes:
        across = _along(axis, places)
        spread2 = dr.squared_norm(ad.Array3f([dr.dot(axis, columns[k]) * scales[k] for k in range(3)]))  # 4.30
        support = ad.Float64(SUPPORT * dr.sqrt(spread2))  # 4.31
        ends += [dr.select(drawn, end, MAX_MAGNITUDE) for end in (across - support, -across - support)]
        squares.append(dr.select(drawn, dr.fma(across, across, ad.Float64(spread2)), 0))
    added = [ad.Float64(dr.select(drawn, ad.Float(1), 0)), *places, *squares]
    lowest_ends, (total, *sums) = _reduced(batch, (dr.ReduceOp.Min, ends), (dr.ReduceOp.Add, added))  # 4.32
    *mean, x_square, y_square = (of_all / dr.maximum(total, 1) for of_all in sums)
    middle = ad.Array3f([ad.Float(number) for number in mean])
    bounds = []
    for i, (axis, square) in enumerate(zip(axes, (x_square, y_square), strict=True)):
        from_middle = _along(axis, [ad.Float64(number) for number in middle])
        lowest, highest = ad.Float(lowest_ends[2 * i] - from_middle), ad.Float(-lowest_ends[2 * i + 1] - from_middle)
        if crop:
            along = _along(axis, mean)
            limit = REACH * dr.sqrt(ad.Float(dr.maximum(dr.fma(-along, along, square), 0)))
            lowest, highest = dr.maximum(lowest, -limit), dr.minimum(highest, limit)
        some = lowest < highest
        bounds.append((dr.select(some, lowest, -0.5), dr.select(some, highest, 0.5)))
    return _camera(light, middle, bounds, size)


def _along(axis: Array3f, places: list[Float64]) -> Float64:
    """Scalar product in double precision."""
    x, y, z = (ad.Float64(number) * place for number, place in zip(axis, places, strict=True))
    return x + y + z


def _reduced(batch: PaddedBatch, *parts: tuple[dr.ReduceOp, list[Float64]]) -> list[list[Float64]]:
    """Of each part (operation, rows [M]) its reduced rows, of width 1. Rows lie one after another: a reduction
    is two launches, however many rows there are."""
    blocks, column = [], dr.arange(ad.UInt32, batch.capacity)
    for _, rows in parts:
        numbers = dr.empty(ad.Float64, len(rows) * batch.capacity)
        for i, row in enumerate(rows):
            dr.scatter(numbers, row, column + i * batch.room, mode=dr.ReduceMode.NoConflicts)
        blocks.append(numbers)
    reduced = []
    for (op, rows), numbers in zip(parts, blocks, strict=True):
        of_blocks = dr.block_reduce(op, numbers, BLOCK)
        of_rows = dr.block_reduce(op, of_blocks, batch.capacity // BLOCK)
        reduced.append([dr.gather(ad.Float64, of_rows, ad.UInt32(i)) for i in range(len(rows))])
    return reduced


def _axis(light: Float, i: int) -> Array3f:
    """Array3f of width 1: axis i of `light_rows`."""
    return ad.Array3f(numbers_at(light, range(3 * i, 3 * i + 3)))


def drawable_mask(means: Array3f, log_scales: Array3f, quaternions: Array4f, logits: Float) -> Bool:
    """Bool [N]: the Gaussians that `project` would draw if the image were large enough."""
    length2 = dr.squared_norm(quaternions)
    drawn = (length2 > 1e-24) & (length2 < 1e24) & (dr.abs(logits) < MAX_MAGNITUDE)
    for i in range(3):
        drawn &= (dr.abs(means[i]) < MAX_MAGNITUDE) & (log_scales[i] > -60) & (log_scales[i] < 20)
    return drawn & (opacities(dr.select(drawn, logits, 0)) >= ALPHA_MIN)


def _camera(light: Float, middle: Array3f, bounds: list[tuple[Float, Float]], size: int) -> Orthographic:
    """Camera whose depths count from `middle` (Array3f, world) and whose image spans `bounds` (low, high in x and y,
    metres from there) and the margin (thesis 4.33 to 4.35)."""
    if size < 4:
        raise ValueError(f"size: expected at least 4 pixels, found {size}")
    extents = [high - low for low, high in bounds]
    least = dr.maximum(MIN_EXTENT_SHARE * dr.maximum(*extents), 1e-6)
    scales = [(size - 2 * MARGIN) * dr.rcp(dr.maximum(extent, least)) for extent in extents]
    principal = [0.5 * size - scale * 0.5 * (low + high) for scale, (low, high) in zip(scales, bounds, strict=True)]
    numbers: list[Float] = []
    for i in range(3):
        axis = _axis(light, i)
        numbers += [*axis, -dr.dot(axis, middle)]
    numbers += [*scales, *principal, ad.Float(0), ad.Float(0)]
    place, values = dr.arange(ad.UInt32, len(numbers)), ad.Float(0)
    for i, number in enumerate(numbers):  # eighteen elements pick their own: one kernel, where dr.concat is eighteen
        values = dr.select(place == i, number, values)
    return Orthographic(values, size, size)
