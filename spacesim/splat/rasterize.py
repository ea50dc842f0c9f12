"""Stage 3: blend each tile's splats front to back (thesis 2.14 to 2.16), and the adjoint of that by hand.

One lane holds a column of a tile's pixels and walks the tile's list. The adjoint replays the list from the last
splat blended to the first, recovering each transmittance by division, and sums a tile's gradient of each
(tile, splat) pair into a slot of its own; a second pass adds up each splat's slots in order. No two tiles write to
one address, so the gradients are the same to the bit in every run.

`forward` and `backward` are the two passes; `rasterize` is the differentiable operation made of them.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr

from spacesim.backend import ad, recorded, select
from spacesim.splat.project import ALPHA_MIN, Splats
from spacesim.splat.tiles import RECORDINGS, TileLists, room

ALPHA_MAX = 0.999  #: a splat never hides everything behind it
TRANSMITTANCE_MIN = 1e-4  #: a pixel is finished once less than this passes
COPIES_BYTES = 2**30  #: that threads' copies of gradient slots may take on a CPU, chosen
_LOG2_E = 1.4426950408889634


@dataclass
class Blended:
    """What `forward` leaves behind. Planes are [height * width], row by row.

    features: C planes, sum of w_i f_i;  transmittance: plane, what passes through all splats
    Tile-major state for `backward`: transmittance and one past the last pair blended of each pixel [T * lanes * rows],
    and of each tile [T]; the splats' records in list order [4 P] each.
    """

    features: list[Any]
    transmittance: Any
    tile_transmittance: Any
    last: Any
    tile_last: Any
    records: list[Any]


@dataclass
class SplatGradients:
    """Gradients of a scalar with respect to the splats, [N] each (depths have none), and what refinement asks for."""

    splats: Splats
    features: list[Any]
    absolute_x: Any  #: sum over pixels of |d / d x|, per pixel of screen (Ye et al. 2024, AbsGS)
    absolute_y: Any


def forward(splats: Splats, features: list[Any], lists: TileLists, width: int, height: int) -> Blended:
    """Blend `features` (C arrays [N]) over the pixels of a width x height image. Detached inputs."""
    run = _forward if width * height > 1 else _trace_forward  # a recording gives a plane of one pixel another size
    blended: Blended = run(splats, features, lists, width, height, room(dr.width(splats.x)))
    return blended


def _trace_forward(
    splats: Splats, features: list[Any], lists: TileLists, width: int, height: int, capacity: int
) -> Blended:
    shape, tiles = lists.shape, lists.tiles_x * lists.tiles_y
    channels, rows = len(features), lists.shape.rows
    records = _list_records(splats, features, lists, capacity)
    lane = dr.arange(ad.UInt32, tiles * shape.lanes)
    tile = lane // shape.lanes
    px, py, _, _ = _lane_pixels(lane, lists)

    def alive(k: Any, end: Any, transmittance: list[Any], _sums: Any, _last: Any) -> Any:
        open_pixel = transmittance[0] > TRANSMITTANCE_MIN
        for value in transmittance[1:]:
            open_pixel |= value > TRANSMITTANCE_MIN
        return (k < end) & open_pixel

    def blend(k: Any, end: Any, transmittance: list[Any], sums: list[list[Any]], last: list[Any]) -> Any:
        record = _load(records, k)
        exponents = _exponents(record, px, py, rows)
        transmittance, last, sums = list(transmittance), list(last), [list(pixel) for pixel in sums]
        for p in range(rows):
            alpha = dr.minimum(dr.exp2(exponents[p]), ALPHA_MAX)
            blends = (alpha >= ALPHA_MIN) & (transmittance[p] > TRANSMITTANCE_MIN)
            weight = dr.select(blends, alpha * transmittance[p], 0)
            for c in range(channels):
                sums[p][c] = dr.fma(weight, record[6 + c], sums[p][c])
            transmittance[p] -= weight
            last[p] = dr.select(blends, k + 1, last[p])
        return k + 1, end, transmittance, sums, last

    state = (
        dr.gather(ad.UInt32, lists.start, tile),
        dr.gather(ad.UInt32, lists.end, tile),
        [ad.Float(1) for _ in range(rows)],
        [[ad.Float(0) for _ in range(channels)] for _ in range(rows)],
        [ad.UInt32(0) for _ in range(rows)],
    )
    if lists.capacity > 0:
        state = dr.while_loop(state, alive, blend, mode="symbolic", label="blend")
    _, _, transmittance, sums, last = state

    lanes = tiles * shape.lanes
    tiled = [_store([sums[p][c] for p in range(rows)], lane, lanes) for c in range(channels)]
    tiled_transmittance, tiled_last = _store(transmittance, lane, lanes), _store(last, lane, lanes)
    dr.eval(tiled, tiled_transmittance, tiled_last)
    pixel = _tiled_index(lists, width, height)
    return Blended(
        features=[dr.gather(ad.Float, plane, pixel) for plane in tiled],
        transmittance=dr.gather(ad.Float, tiled_transmittance, pixel),
        tile_transmittance=tiled_transmittance,
        last=tiled_last,
        tile_last=dr.block_reduce(dr.ReduceOp.Max, tiled_last, shape.lanes * rows),
        records=records,
    )


def backward(
    splats: Splats,
    blended: Blended,
    lists: TileLists,
    image_size: tuple[int, int],
    feature_gradients: list[Any],
    transmittance_gradient: Any,
) -> SplatGradients:
    """Adjoint of `forward`: from gradients of its planes [height * width] to gradients of the splats [N].

    image_size: (width, height). With w_i = alpha_i T_i and d_i = <dL/dC, f_i>:
    dL/d alpha_i = T_i d_i - (sum_{j > i} w_j d_j + T_end dL/dT_end) / (1 - alpha_i).
    """
    count, channels = dr.width(splats.x), len(feature_gradients)
    if lists.capacity == 0:
        zeros = [dr.opaque(ad.Float, 0, count) for _ in range(9 + channels)]  # no literals: they fold gradients away
        return SplatGradients(Splats(*zeros[:7]), zeros[9:], zeros[7], zeros[8])
    inputs = image_size, feature_gradients, transmittance_gradient
    gradients: SplatGradients = _backward(splats, blended, lists, *inputs)
    return gradients


def _trace_backward(
    splats: Splats,
    blended: Blended,
    lists: TileLists,
    image_size: tuple[int, int],
    feature_gradients: list[Any],
    transmittance_gradient: Any,
) -> SplatGradients:
    channels, rows, lanes = len(feature_gradients), lists.shape.rows, lists.shape.lanes
    lane = dr.arange(ad.UInt32, lists.tiles_x * lists.tiles_y * lanes)
    tile = lane // lanes
    px, py, column, row = _lane_pixels(lane, lists)

    width, height = image_size
    transmittance, last, behind, gradients = [], [], [], []
    for p in range(rows):
        inside = (column < width) & (row + p < height)
        pixel = (row + p) * width + column
        gradients.append([dr.gather(ad.Float, plane, pixel, inside) for plane in feature_gradients])
        end = dr.gather(ad.Float, blended.tile_transmittance, lane * rows + p)
        transmittance.append(end)
        behind.append(end * dr.gather(ad.Float, transmittance_gradient, pixel, inside))
        last.append(dr.select(inside, dr.gather(ad.UInt32, blended.last, lane * rows + p), 0))

    arrays = 2 + -(-channels // 4)
    mode = _reduce_mode(16 * lists.capacity * arrays)
    slots = [dr.zeros(ad.Float, 4 * lists.capacity) for _ in range(arrays)]
    records, start = blended.records, dr.gather(ad.UInt32, lists.start, tile)

    def remaining(k: Any, _transmittance: Any, _behind: Any) -> Any:
        return k > start

    def replay(k: Any, transmittance: list[Any], behind: list[Any]) -> Any:
        k = k - 1
        record = _load(records, k)
        dx, dy0 = px - record[0], py - record[1]
        a, b, c = record[2], record[3], record[4]
        exponents = _exponents(record, px, py, rows)
        transmittance, behind = list(transmittance), list(behind)
        g0, g1, g2, absolute_x, absolute_y = (ad.Float(0) for _ in range(5))
        by_feature = [ad.Float(0) for _ in range(channels)]
        touched = ad.Bool(False)
        for p in range(rows):
            dy = dy0 + p
            unclamped = dr.exp2(exponents[p])
            alpha = dr.minimum(unclamped, ALPHA_MAX)
            blends = (alpha >= ALPHA_MIN) & (k < last[p])
            alpha = dr.select(blends, alpha, 0)
            inverse = dr.rcp(1 - alpha)
            before = transmittance[p] * inverse
            weight = alpha * before
            along = ad.Float(0)
            for i in range(channels):
                along = dr.fma(gradients[p][i], record[6 + i], along)
                by_feature[i] = dr.fma(weight, gradients[p][i], by_feature[i])
            by_alpha = dr.fma(along, before, -behind[p] * inverse)
            behind[p] = dr.fma(weight, along, behind[p])
            transmittance[p] = before
            g = dr.select(blends & (unclamped < ALPHA_MAX), by_alpha * alpha, 0)  # dL / d ln alpha
            g_dy = g * dy
            g0, g1, g2 = g0 + g, g1 + g_dy, dr.fma(g_dy, dy, g2)
            # records hold -a/2, -b, -c/2 in units of log2 e; the factor is put back with the sums below
            absolute_x += dr.abs(2 * a * dx * g + b * g_dy)
            absolute_y += dr.abs(b * dx * g + 2 * c * g_dy)
            touched |= blends
        sums = [g0, g0 * dx, g1, g0 * dx * dx, g1 * dx, g2, absolute_x, absolute_y, *by_feature]
        sums += [ad.Float(0)] * (-len(sums) % 4)
        slot = dr.gather(ad.UInt32, lists.slot, k)
        for i, target in enumerate(slots):
            value = ad.Array4f(sums[4 * i : 4 * i + 4])
            dr.scatter_reduce(dr.ReduceOp.Add, target, value, slot, active=touched, mode=mode)
        return k, transmittance, behind

    first = dr.gather(ad.UInt32, blended.tile_last, tile)
    dr.while_loop((first, transmittance, behind), remaining, replay, mode="symbolic", label="replay")
    dr.eval(slots)
    return _gather_slots(slots, splats, lists, channels)


class _Rasterize(dr.CustomOp):
    """`forward` and `backward` as one node of Dr.Jit's graph. Differentiable in reverse mode."""

    def eval(self, splats: Splats, features: list[Any], lists: TileLists, width: int, height: int) -> list[Any]:
        self.splats, self.lists, self.size = splats, lists, (width, height)
        self.blended = forward(splats, features, lists, width, height)
        return [*self.blended.features, self.blended.transmittance]

    def backward(self) -> None:
        gradients: Any = self.grad_out()
        *by_feature, by_transmittance = gradients
        result = backward(self.splats, self.blended, self.lists, self.size, by_feature, by_transmittance)
        result.splats.depth = dr.opaque(ad.Float, 0, dr.width(self.splats.x))
        self.set_grad_in("splats", result.splats)
        self.set_grad_in("features", result.features)

    def name(self) -> str:
        return "rasterize"


def rasterize(splats: Splats, features: list[Any], lists: TileLists, width: int, height: int) -> tuple[list[Any], Any]:
    """Differentiable blending. Returns (C feature planes, transmittance plane), [height * width] each."""
    outputs: list[Any] = dr.custom(_Rasterize, splats, features, lists, width, height)
    return outputs[:-1], outputs[-1]


def _reduce_mode(bytes_: int) -> Any:
    """How a tile's lanes add to the slots, `bytes_` large. On CUDA a warp sums first. On LLVM every thread has a copy
    of the slots, unless that is too much. One tile alone adds to a slot: the sums depend on none of this."""
    if select() == "cuda":
        return dr.ReduceMode.Local
    return dr.ReduceMode.Expand if dr.thread_count() * bytes_ < COPIES_BYTES else dr.ReduceMode.Local


def _list_records(splats: Splats, features: list[Any], lists: TileLists, capacity: int) -> list[Any]:
    """The splats' numbers in list order, so that a tile reads memory in one run.

    Record: x, y, -a/2 log2 e, -b log2 e, -c/2 log2 e, log2 o, features; padded to fours, one array [4 P] a four.
    capacity: room for the N splats.
    """
    if lists.capacity == 0:
        return []
    numbers = [splats.x, splats.y, -0.5 * _LOG2_E * splats.a, -_LOG2_E * splats.b, -0.5 * _LOG2_E * splats.c]
    numbers += [dr.log2(dr.maximum(splats.opacity, 1e-30)), *features]
    numbers += [ad.Float(0)] * (-len(numbers) % 4)
    index = dr.arange(ad.UInt32, dr.width(splats.x))
    packed = [_store(numbers[i : i + 4], index, capacity) for i in range(0, len(numbers), 4)]
    dr.eval(packed)
    position = dr.arange(ad.UInt32, lists.capacity)
    records = [_store(list(dr.gather(ad.Array4f, array, lists.splat)), position, lists.capacity) for array in packed]
    dr.eval(records)
    return records


def _store(values: list[Any], index: Any, size: int) -> Any:
    """A flat array [size * len(values)] in which `values` of lane i stand at index i, by one packet scatter."""
    array_type = type(values[0])
    target = dr.empty(array_type, len(values) * size)
    dr.scatter(target, (ad.ArrayXu if array_type is ad.UInt32 else ad.ArrayXf)(values), index)
    return target


def _load(records: list[Any], k: Any) -> list[Any]:
    return [value for array in records for value in dr.gather(ad.Array4f, array, k)]


def _exponents(record: list[Any], px: Any, py: Any, rows: int) -> list[Any]:
    """log2 of the unclamped alpha at the pixels (px, py + p), p < rows (thesis 2.14)."""
    dx, dy0 = px - record[0], py - record[1]
    constant = dr.fma(record[2] * dx, dx, record[5])
    linear = record[3] * dx
    return [dr.fma(dr.fma(record[4], dy0 + p, linear), dy0 + p, constant) for p in range(rows)]


def _lane_pixels(lane: Any, lists: TileLists) -> tuple[Any, Any, Any, Any]:
    """(x, y) pixel centres and (column, row) indices of the topmost pixel of each lane."""
    shape = lists.shape
    tile, within = lane // shape.lanes, lane % shape.lanes
    column = (tile % lists.tiles_x) * shape.width + within % shape.width
    row = (tile // lists.tiles_x) * shape.height + (within // shape.width) * shape.rows
    return ad.Float(column) + 0.5, ad.Float(row) + 0.5, column, row


def _tiled_index(lists: TileLists, width: int, height: int) -> Any:
    """Position in tile-major order of each pixel of the image, UInt32 [height * width]."""
    shape = lists.shape
    pixel = dr.arange(ad.UInt32, width * height)
    x, y = pixel % width, pixel // width
    tile = (y // shape.height) * lists.tiles_x + x // shape.width
    in_column, in_row = x % shape.width, y % shape.height
    lane = tile * shape.lanes + in_column + (in_row // shape.rows) * shape.width
    return lane * shape.rows + in_row % shape.rows


def _gather_slots(slots: list[Any], splats: Splats, lists: TileLists, channels: int) -> SplatGradients:
    """Add up each splat's slots, in order, and turn the sums into gradients of the splat's own numbers."""
    splat = dr.arange(ad.UInt32, dr.width(splats.x))
    position = dr.gather(ad.UInt32, lists.first_slot, splat)
    end = position + dr.gather(ad.UInt32, lists.slot_count, splat)
    sums = [ad.Array4f(0) for _ in slots]

    def remaining(position: Any, _sums: Any) -> Any:
        return position < end

    def add(position: Any, sums: list[Any]) -> Any:
        return position + 1, [
            total + dr.gather(ad.Array4f, slot, position) for total, slot in zip(sums, slots, strict=True)
        ]

    _, sums = dr.while_loop((position, sums), remaining, add, mode="symbolic", label="gather slots")
    s0, sx, sy, sxx, sxy, syy, absolute_x, absolute_y, *by_feature = (v for total in sums for v in total)
    by_splat = Splats(
        x=dr.fma(splats.a, sx, splats.b * sy),
        y=dr.fma(splats.b, sx, splats.c * sy),
        a=-0.5 * sxx,
        b=-sxy,
        c=-0.5 * syy,
        opacity=s0 * dr.rcp(dr.maximum(splats.opacity, 1e-30)),
        depth=None,
    )
    result = SplatGradients(by_splat, by_feature[:channels], absolute_x / _LOG2_E, absolute_y / _LOG2_E)
    dr.eval(result)
    return result


_forward = recorded(_trace_forward, RECORDINGS)
_backward = recorded(_trace_backward, RECORDINGS)
