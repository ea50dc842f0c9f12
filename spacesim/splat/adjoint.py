"""Adjoints of blending, by hand: from gradients of the pixels to gradients of the splats.

Sums over the pixels of a tile, of each (tile, splat) pair, go into a slot of the pair's own; a second pass adds up each
splat's slots in order. No two tiles write to one address, so the gradients are the same to the bit in every run.

- `by_tiles`: one lane holds a column of a tile's pixels, as in blending, and replays the tile's list from the last
  splat blended to the first, recovering each transmittance by division. Lanes meet in a sum for each pair.
- `by_buckets`: one lane holds a bucket of a tile's list, some pairs, and walks over the tile's pixels, from the state
  that blending kept before the bucket. Lanes share nothing; what they read twice, and the states kept, cost memory.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr

from spacesim.backend import ad, select
from spacesim.splat.project import ALPHA_MIN, Splats
from spacesim.splat.records import ALPHA_MAX, LOG2_E, Blended, bucket_numbers, exponents, lane_pixels, load, store
from spacesim.splat.tiles import TileLists

COPIES_BYTES = 2**30  #: that threads' copies of gradient slots may take on a CPU, chosen


@dataclass
class SplatGradients:
    """Gradients of a scalar with respect to the splats, [N] each (depths have none), and what refinement asks for."""

    splats: Splats
    features: list[Any]
    absolute_x: Any  #: sum over pixels of |d / d x|, per pixel of screen (Ye et al. 2024, AbsGS)
    absolute_y: Any


def by_tiles(
    splats: Splats,
    blended: Blended,
    lists: TileLists,
    image_size: tuple[int, int],
    feature_gradients: list[Any],
    transmittance_gradient: Any,
    absolute: bool,
) -> SplatGradients:
    """See `rasterize.backward`. A lane for a column of a tile's pixels."""
    channels, rows, lanes = len(feature_gradients), lists.shape.rows, lists.shape.lanes
    lane = dr.arange(ad.UInt32, lists.tiles_x * lists.tiles_y * lanes)
    tile = lane // lanes
    px, py, column, row = lane_pixels(lane, lists)

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

    arrays = _fours(channels, absolute)
    mode = reduce_mode(16 * lists.capacity * arrays)
    slots = [dr.zeros(ad.Float, 4 * lists.capacity) for _ in range(arrays)]
    records, start = blended.records, dr.gather(ad.UInt32, lists.start, tile)

    def remaining(k: Any, _transmittance: Any, _behind: Any) -> Any:
        return k > start

    def replay(k: Any, transmittance: list[Any], behind: list[Any]) -> Any:
        k = k - 1
        record = load(records, k)
        dx, dy0 = px - record[0], py - record[1]
        a, b, c = record[2], record[3], record[4]
        powers = exponents(record, px, py, rows)
        transmittance, behind = list(transmittance), list(behind)
        g0, g1, g2, absolute_x, absolute_y = (ad.Float(0) for _ in range(5))
        by_feature = [ad.Float(0) for _ in range(channels)]
        touched = ad.Bool(False)
        for p in range(rows):
            dy = dy0 + p
            unclamped = dr.exp2(powers[p])
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
            if absolute:
                absolute_x += dr.abs(2 * a * dx * g + b * g_dy)
                absolute_y += dr.abs(b * dx * g + 2 * c * g_dy)
            touched |= blends
        sums = [g0, g0 * dx, g1, g0 * dx * dx, g1 * dx, g2]
        sums += [absolute_x, absolute_y, *by_feature] if absolute else by_feature
        sums += [ad.Float(0)] * (-len(sums) % 4)
        slot = dr.gather(ad.UInt32, lists.slot, k)
        for i, target in enumerate(slots):
            value = ad.Array4f(sums[4 * i : 4 * i + 4])
            dr.scatter_reduce(dr.ReduceOp.Add, target, value, slot, active=touched, mode=mode)
        return k, transmittance, behind

    first = dr.gather(ad.UInt32, blended.tile_last, tile)
    dr.while_loop((first, transmittance, behind), remaining, replay, mode="symbolic", label="replay")
    dr.eval(slots)
    return gather_slots(slots, splats, lists, channels, absolute)


def _numbers(channels: int, absolute: bool) -> int:
    """Sums of a pair."""
    return 6 + 2 * absolute + channels


def _fours(channels: int, absolute: bool) -> int:
    """How many packets of four hold them."""
    return -(-_numbers(channels, absolute) // 4)


@dataclass
class _Buckets:
    """Of each bucket [B]: its tile, the tile's left and top edges in pixels, and its pairs from `first` to below `end`
    of the tile, none where no lane of blending came to it."""

    tile: Any
    live: Any
    left: Any
    top: Any
    first: Any
    end: Any


def by_buckets(
    splats: Splats,
    blended: Blended,
    lists: TileLists,
    image_size: tuple[int, int],
    feature_gradients: list[Any],
    transmittance_gradient: Any,
    absolute: bool,
) -> SplatGradients:
    """See `rasterize.backward`. A lane for a bucket: what lies behind a pair is all that the pixel shows, less what
    has been blended up to the pair."""
    channels, shape = len(feature_gradients), lists.shape
    rows, pixels, bucket = shape.rows, shape.width * shape.height, blended.bucket
    looks = _pixel_packets(blended, lists, image_size, feature_gradients, transmittance_gradient)
    number = dr.arange(ad.UInt32, bucket_numbers(lists, bucket))
    buckets = _buckets(blended, lists, number)
    records = [_record(blended, buckets, i) for i in range(bucket)]
    until = dr.select(buckets.live, ad.UInt32(pixels), ad.UInt32(0))

    def more(q: Any, _sums: Any) -> Any:
        return q < until

    def visit(q: Any, sums: list[list[Any]]) -> tuple[Any, list[list[Any]]]:
        within, below = q // rows, q % rows
        px = buckets.left + ad.Float(within % shape.width) + 0.5
        py = buckets.top + ad.Float((within // shape.width) * rows + below) + 0.5
        total, *gradients = load(looks, buckets.tile * pixels + q)
        transmittance, *shown = load(blended.checkpoints, number * pixels + q)
        last = dr.gather(ad.UInt32, blended.last, buckets.tile * pixels + q)
        gradients, behind = gradients[:channels], total
        for gradient, feature in zip(gradients, shown, strict=False):
            behind = dr.fma(-gradient, feature, behind)
        sums = [list(of_pair) for of_pair in sums]
        for i, record in enumerate(records):
            blends = buckets.first + i < last
            state = transmittance, behind
            transmittance, behind = _add_pixel(sums[i], record, (px, py), gradients, state, blends, absolute)
        return q + 1, sums

    zeros = [[ad.Float(0) for _ in range(_numbers(channels, absolute))] for _ in range(bucket)]
    _, sums = dr.while_loop((ad.UInt32(0), zeros), more, visit, mode="symbolic", label="buckets")
    fours = _fours(channels, absolute)
    slots = dr.zeros(ad.Float, 4 * fours * lists.capacity)  # a pair's numbers side by side
    for i in range(bucket):
        listed = buckets.first + i < buckets.end
        slot = dr.gather(ad.UInt32, lists.slot, buckets.first + i, listed)
        values = sums[i] + [ad.Float(0)] * (4 * fours - len(sums[i]))
        for j in range(fours):
            value = ad.Array4f(values[4 * j : 4 * j + 4])
            dr.scatter(slots, value, slot * fours + j, listed, dr.ReduceMode.NoConflicts)
    dr.eval(slots)
    return gather_slots([slots], splats, lists, channels, absolute)


def _add_pixel(
    sums: list[Any],
    record: list[Any],
    centre: tuple[Any, Any],
    gradients: list[Any],
    state: tuple[Any, Any],
    blends: Any,
    absolute: bool,
) -> tuple[Any, Any]:
    """Add what a pixel contributes to a pair's sums, and take the pair from the pixel's state: (transmittance, gradient
    of what is behind). A state that blending did not keep has no part, since `blends` is false."""
    (px, py), (transmittance, behind), channels = centre, state, len(gradients)
    dx, dy = px - record[0], py - record[1]
    unclamped = dr.exp2(exponents(record, px, py, 1)[0])
    alpha = dr.minimum(unclamped, ALPHA_MAX)
    blends &= alpha >= ALPHA_MIN
    weight = dr.select(blends, alpha * transmittance, 0)
    along = ad.Float(0)
    for gradient, feature in zip(gradients, record[6 : 6 + channels], strict=True):
        along = dr.fma(gradient, feature, along)
    behind = dr.fma(-weight, along, behind)
    by_alpha = transmittance * along - behind * dr.rcp(1 - alpha)
    g = dr.select(blends & (unclamped < ALPHA_MAX), by_alpha * alpha, 0)  # dL / d ln alpha
    g_dx, g_dy = g * dx, g * dy
    sums[0], sums[1], sums[2] = sums[0] + g, sums[1] + g_dx, sums[2] + g_dy
    sums[3], sums[4], sums[5] = dr.fma(g_dx, dx, sums[3]), dr.fma(g_dx, dy, sums[4]), dr.fma(g_dy, dy, sums[5])
    if absolute:
        sums[6] += dr.abs(dr.fma(2 * record[2], g_dx, record[3] * g_dy))
        sums[7] += dr.abs(dr.fma(2 * record[4], g_dy, record[3] * g_dx))
    for c, gradient in enumerate(gradients, 8 if absolute else 6):
        sums[c] = dr.fma(weight, gradient, sums[c])
    return transmittance - weight, behind


def _buckets(blended: Blended, lists: TileLists, number: Any) -> _Buckets:
    tile, shape = dr.gather(ad.UInt32, blended.bucket_tile, number), lists.shape
    live = tile < lists.tiles_x * lists.tiles_y
    tile = dr.select(live, tile, 0)
    start = dr.gather(ad.UInt32, lists.start, tile)
    first = start + (number - (start // blended.bucket + tile)) * blended.bucket
    end = dr.select(live, dr.gather(ad.UInt32, lists.end, tile), 0)
    left, top = (tile % lists.tiles_x) * shape.width, (tile // lists.tiles_x) * shape.height
    return _Buckets(tile, live, ad.Float(left), ad.Float(top), first, end)


def _record(blended: Blended, buckets: _Buckets, i: int) -> list[Any]:
    """Of pair i of each bucket; zeros where there is none, which no pixel has blended."""
    listed = buckets.first + i < buckets.end
    return [v for array in blended.records for v in dr.gather(ad.Array4f, array, buckets.first + i, listed)]


def _pixel_packets(
    blended: Blended,
    lists: TileLists,
    image_size: tuple[int, int],
    feature_gradients: list[Any],
    transmittance_gradient: Any,
) -> list[Any]:
    """Of each pixel, tile by tile, by fours: the scalar product of all that it shows, transmittance too, with their
    gradients; and its features' gradients."""
    rows, (width, height) = lists.shape.rows, image_size
    index = dr.arange(ad.UInt32, lists.tiles_x * lists.tiles_y * lists.shape.lanes * rows)
    _, _, column, row = lane_pixels(index // rows, lists)
    row = row + index % rows
    inside = (column < width) & (row < height)
    pixel = row * width + column
    gradients = [dr.gather(ad.Float, plane, pixel, inside) for plane in feature_gradients]
    passed = dr.gather(ad.Float, blended.tile_transmittance, index)
    total = passed * dr.gather(ad.Float, transmittance_gradient, pixel, inside)
    for gradient, plane in zip(gradients, blended.features, strict=True):
        total = dr.fma(gradient, dr.gather(ad.Float, plane, pixel, inside), total)
    values = [total, *gradients]
    values += [ad.Float(0)] * (-len(values) % 4)
    packets = [store(values[i : i + 4], index, dr.width(index)) for i in range(0, len(values), 4)]
    dr.eval(packets)
    return packets


def reduce_mode(bytes_: int) -> Any:
    """How a tile's lanes add to the slots, `bytes_` large. On CUDA a warp sums first. On LLVM every thread has a copy
    of the slots, unless that is too much. One tile alone adds to a slot: the sums depend on none of this."""
    if select() == "cuda":
        return dr.ReduceMode.Local
    return dr.ReduceMode.Expand if dr.thread_count() * bytes_ < COPIES_BYTES else dr.ReduceMode.Local


def gather_slots(
    slots: list[Any], splats: Splats, lists: TileLists, channels: int, absolute: bool = True
) -> SplatGradients:
    """Add up each splat's slots, in order, and turn the sums into gradients of the splat's own numbers.

    slots: [4 F P] each, F fours of a pair's sums side by side
    """
    splat = dr.arange(ad.UInt32, dr.width(splats.x))
    position = dr.gather(ad.UInt32, lists.first_slot, splat)
    end = position + dr.gather(ad.UInt32, lists.slot_count, splat)
    parts = [(array, dr.width(array) // (4 * lists.capacity)) for array in slots]

    def remaining(position: Any, _sums: Any) -> Any:
        return position < end

    def add(position: Any, sums: list[Any]) -> Any:
        values = [dr.gather(ad.Array4f, array, position * fours + j) for array, fours in parts for j in range(fours)]
        return position + 1, [total + value for total, value in zip(sums, values, strict=True)]

    state = position, [ad.Array4f(0) for _, fours in parts for _ in range(fours)]
    _, sums = dr.while_loop(state, remaining, add, mode="symbolic", label="gather slots")
    s0, sx, sy, sxx, sxy, syy, *rest = (v for total in sums for v in total)
    by_splat = Splats(
        x=dr.fma(splats.a, sx, splats.b * sy),
        y=dr.fma(splats.b, sx, splats.c * sy),
        a=-0.5 * sxx,
        b=-sxy,
        c=-0.5 * syy,
        opacity=s0 * dr.rcp(dr.maximum(splats.opacity, 1e-30)),
        depth=None,
    )
    absolute_x, absolute_y = [value / LOG2_E for value in rest[:2]] if absolute else (None, None)
    by_feature = rest[2 : 2 + channels] if absolute else rest[:channels]
    result = SplatGradients(by_splat, by_feature, absolute_x, absolute_y)
    dr.eval(result)
    return result
