"""Adjoints of blending, by hand: from gradients of the pixels to gradients of the splats.

Sums over the pixels of a tile, of each (tile, splat) pair, go into a slot of the pair's own; a second pass adds up each
splat's slots in order. No two tiles write to one address, so the gradients are the same to the bit in every run.

- `by_tiles`: one thread holds a block of a tile's pixels, as in blending, and replays the tile's list from the last
  splat blended to the first, recovering each transmittance by division. Threads meet in a sum for each pair.
- `by_buckets`: one thread holds a bucket of a tile's list, some pairs, and walks over the tile's pixels, from the
  state that blending kept before the bucket. Threads share nothing; what they read twice, and the states kept, cost
  memory.
"""

from dataclasses import dataclass
from typing import cast

import drjit as dr

from spacesim.backend import ad, recorded, select
from spacesim.backend.arrays import Bool, Float, UInt32
from spacesim.backend.kernels.llvm import is_usable
from spacesim.backend.packet import load, packet, packet_sizes, packets, store
from spacesim.splat.raster.lists.pieces import count_pieces, read_pieces
from spacesim.splat.raster.lists.tiles import TileLists, TileShape, pixel_in_tile, thread_offsets, thread_pixels
from spacesim.splat.raster.project import Splats
from spacesim.splat.raster.records import ALPHA_MAX, LOG2_E, POWER_MIN, BlendState, exp2, exponents
from spacesim.splat.raster.slot_sums import add_slots

COPIES_BYTES = 2**30  #: that copies of gradient slots, one a CPU thread, may take
PACKET = 4  #: SIMD lanes that run together on any CPU: Dr.Jit's packets have 4, 8 or 16, and start at a multiple
SLOTS = {"cuda": 8, "llvm": 1}  #: that a splat reads in a turn of its loop, all at once
ONE_PIXEL = TileShape(1, 1, 1)


@dataclass
class PlaneGradients:
    """Gradients of a scalar with respect to what blending gave: planes [height * width] of the features, and of the
    transmittance."""

    width: int  #: pixels
    height: int  #: pixels
    features: list[Float]  #: a plane for each channel
    transmittance: Float  #: a plane


@dataclass
class SplatGradients:
    """Gradients of a scalar by the splats, [N] each (depths have none), and what densification asks for."""

    splats: Splats  #: by centre, inverse covariance and opacity
    features: list[Float]  #: of what was blended, a Float [N] for each channel
    absolute_x: Float  #: sum over pixels of |d / d x|, per pixel of screen (Ye et al. 2024, AbsGS)
    absolute_y: Float  #: the same of y


def by_tiles(
    splats: Splats,
    state: BlendState,
    lists: TileLists,
    grad_planes: PlaneGradients,
    absolute: bool,
) -> SplatGradients:
    """See `blend.backward`. A thread for a block of a tile's pixels."""
    if not is_usable():
        return _by_tiles(splats, state, lists, grad_planes, absolute)
    channels, slots = len(grad_planes.features), _replay(state, lists, grad_planes, absolute)
    added = add_slots(slots, splats, lists, channels, absolute)
    if added is None:
        return _gather_slots(slots, splats, lists, channels, absolute)
    none = cast(Float, None)  # nothing reads them
    x, y, a, b, c, opacity, *rest = added
    absolute_x, absolute_y = rest[channels:] or [none, none]
    return SplatGradients(Splats(x, y, a, b, c, opacity, none), rest[:channels], absolute_x, absolute_y)


@recorded
def _by_tiles(
    splats: Splats, state: BlendState, lists: TileLists, grad_planes: PlaneGradients, absolute: bool
) -> SplatGradients:
    slots = _replay(state, lists, grad_planes, absolute)
    return _gather_slots(slots, splats, lists, len(grad_planes.features), absolute)


@recorded(elements=lambda _, state, lists, grad_planes, absolute: grad_planes.width * grad_planes.height)
def _replay(state: BlendState, lists: TileLists, grad_planes: PlaneGradients, absolute: bool) -> list[Float]:
    """Sums of pairs, as `_gather_slots` takes them."""
    channels, shape = len(grad_planes.features), lists.shape
    thread, offsets = thread_pixels(lists), thread_offsets(shape)
    transmittance, last, behind, gradients = [], [], [], []
    for p, (i, j) in enumerate(offsets):
        inside = (thread.column + i < grad_planes.width) & (thread.row + j < grad_planes.height)
        pixel, place = (thread.row + j) * grad_planes.width + thread.column + i, thread.place * shape.pixels + p
        gradients.append([dr.gather(ad.Float, plane, pixel, inside) for plane in grad_planes.features])
        end = dr.gather(ad.Float, state.transmittance, place)
        transmittance.append(end)
        behind.append(end * dr.gather(ad.Float, grad_planes.transmittance, pixel, inside))
        last.append(dr.select(inside, dr.gather(ad.UInt32, state.last, place), 0))

    sizes = packet_sizes(_numbers(channels, absolute))
    mode = reduce_mode(4 * sum(sizes) * lists.capacity, shape)
    slots = [dr.zeros(ad.Float, size * lists.capacity) for size in sizes]
    start = dr.gather(ad.UInt32, lists.start, thread.tile)

    def remaining(k: UInt32, _transmittance: object, _behind: object) -> Bool:
        return k > start

    def replay(k: UInt32, transmittance: list[Float], behind: list[Float]) -> tuple[UInt32, list[Float], list[Float]]:
        k = k - 1
        record = state.records.load(lists, k)
        dx, dy = thread.x - record[0], thread.y - record[1]
        a, b, c = record[2], record[3], record[4]
        powers = list(exponents(record, thread.x, thread.y, shape, blocks=True))
        transmittance, behind = list(transmittance), list(behind)
        moments = _PixelMoments(dx, dy)
        absolute_x, absolute_y = ad.Float(0), ad.Float(0)
        grad_features = [ad.Float(0) for _ in range(channels)]
        for p, (i, j) in enumerate(offsets):
            unclamped = exp2(powers[p])
            alpha = dr.minimum(unclamped, ALPHA_MAX)
            blends = (powers[p] >= POWER_MIN) & (k < last[p])
            # with T behind the pair: T before it is T / (1 - alpha), and its weight alpha T / (1 - alpha)
            ratio = dr.select(blends, alpha * dr.rcp(1 - alpha), 0)
            weight = ratio * transmittance[p]
            along = _scalar_product(gradients[p], record[6:])
            for n, gradient in enumerate(gradients[p]):
                grad_features[n] = dr.fma(weight, gradient, grad_features[n])
            grad_log_alpha = ratio * dr.fma(along, transmittance[p], -behind[p])
            behind[p] = dr.fma(weight, along, behind[p])
            transmittance[p] += weight
            g = dr.select(unclamped < ALPHA_MAX, grad_log_alpha, 0)
            moments.add(i, j, g)
            # records hold -a/2, -b, -c/2 in units of log2 e; the factor is put back with the sums below
            if absolute:
                size = dr.abs(g)
                absolute_x = dr.fma(size, dr.abs(2 * a * (dx + i) + b * (dy + j)), absolute_x)
                absolute_y = dr.fma(size, dr.abs(b * (dx + i) + 2 * c * (dy + j)), absolute_y)
        sums = moments.sums()
        sums += [absolute_x, absolute_y, *grad_features] if absolute else grad_features
        _add_to_slots(slots, sums, lists.sum_index(k), mode)
        return k, transmittance, behind

    tile_last = dr.block_reduce(dr.ReduceOp.Max, state.last, shape.threads * shape.pixels)
    first = dr.gather(ad.UInt32, tile_last, thread.tile)
    dr.while_loop((first, transmittance, behind), remaining, replay, mode="symbolic", label="replay")
    dr.eval(slots)
    return slots


class _PixelMoments:
    """Sums over a thread's pixels, column by column, of g, g dx, g dy, g dx^2, g dx dy and g dy^2; (dx, dy): from the
    splat's centre to the pixel. dx, dy: of the thread's first pixel"""

    def __init__(self, dx: Float, dy: Float) -> None:
        self.dx, self.dy = dx, dy
        self.columns: dict[int, list[Float]] = {}

    def add(self, column: int, row: int, g: Float) -> None:
        """A pixel's g."""
        dy = self.dy + row
        g_dy = g * dy
        s0, s1, s2 = self.columns.get(column, [ad.Float(0)] * 3)
        self.columns[column] = [s0 + g, s1 + g_dy, dr.fma(g_dy, dy, s2)]

    def sums(self) -> list[Float]:
        """The six."""
        total = [ad.Float(0) for _ in range(6)]
        for column, (s0, s1, s2) in self.columns.items():
            dx = self.dx + column
            s0_dx = s0 * dx
            for n, value in enumerate((s0, s0_dx, s1, s0_dx * dx, s1 * dx, s2)):
                total[n] += value
        return total


def _add_to_slots(slots: list[Float], sums: list[Float], slot: UInt32, mode: dr.ReduceMode) -> None:
    """Add a thread's sums to its pair's slot in each array. All threads do: to ask each whether it has anything to add
    costs more, on a CPU and on CUDA."""
    for target, values in zip(slots, packets(sums), strict=True):
        dr.scatter_reduce(dr.ReduceOp.Add, target, packet(values), slot, mode=mode)


def _scalar_product(first: list[Float], second: list[Float]) -> Float:
    """Scalar product over as many entries as `first` has."""
    total = first[0] * second[0] if first else ad.Float(0)
    for x, y in zip(first[1:], second[1:], strict=False):
        total = dr.fma(x, y, total)
    return total


def _numbers(channels: int, absolute: bool) -> int:
    """Sums of a pair."""
    return 6 + 2 * absolute + channels


def _fours(channels: int, absolute: bool) -> int:
    """How many packets of four hold them."""
    return -(-_numbers(channels, absolute) // 4)


@dataclass
class _Buckets:
    """Of each bucket [B]: its tile, whether a thread of blending reached it, the tile's left and top edges in pixels,
    and its pairs, from `first` on, below `end` of the tile."""

    tile: UInt32
    reached: Bool
    left: Float
    top: Float
    first: UInt32
    end: UInt32


_BucketPixel = tuple[list[Float], list[Float], UInt32]
"""Of a pixel: its `_pixel_packets`, its state before a bucket, one past the last pair that it blends."""


@recorded
def by_buckets(
    splats: Splats,
    features: list[Float],
    state: BlendState,
    lists: TileLists,
    grad_planes: PlaneGradients,
    absolute: bool,
) -> SplatGradients:
    """See `blend.backward`. A thread for a bucket: what lies behind a pair is all that the pixel shows, less what
    has been blended up to the pair."""
    channels, shape = len(grad_planes.features), lists.shape
    assert lists.tile is not None, "slots of pairs in no list are not written"
    pixels, bucket = shape.width * shape.height, state.bucket
    looks = _pixel_packets(features, state.transmittance, lists, grad_planes)
    tiles, bucket_count = lists.tiles_x * lists.tiles_y, count_pieces(lists, bucket)
    number = dr.arange(ad.UInt32, bucket_count)
    buckets = _buckets(state, lists, number)
    records = [_record(state, buckets, i, lists) for i in range(bucket)]
    until = dr.select(buckets.reached, ad.UInt32(pixels), ad.UInt32(0))

    def read(q: UInt32) -> _BucketPixel:
        exists, place = q < until, buckets.tile * pixels + q
        looked = load(looks, place, tiles * pixels, exists)
        kept = load(state.checkpoints, number * pixels + q, bucket_count * pixels, exists)
        return looked[: 1 + channels], kept[: 1 + channels], dr.gather(ad.UInt32, state.last, place, exists)

    def has_more(q: UInt32, _pixel: object, _sums: object) -> Bool:
        return q < until

    def visit(
        q: UInt32, pixel: _BucketPixel, sums: list[list[Float]]
    ) -> tuple[UInt32, _BucketPixel, list[list[Float]]]:
        following = read(q + 1)  # on its way while this one is added
        column, row = pixel_in_tile(q, shape)
        px, py = buckets.left + ad.Float(column) + 0.5, buckets.top + ad.Float(row) + 0.5
        (total, *gradients), (transmittance, *shown), last = pixel
        behind = total
        for gradient, feature in zip(gradients, shown, strict=True):
            behind = dr.fma(-gradient, feature, behind)
        sums = [list(of_pair) for of_pair in sums]
        for i, record in enumerate(records):
            blends = buckets.first + i < last
            before = transmittance, behind
            transmittance, behind = _add_pixel(sums[i], record, (px, py), gradients, before, blends, absolute)
        return q + 1, following, sums

    zeros = [[ad.Float(0) for _ in range(_numbers(channels, absolute))] for _ in range(bucket)]
    first = ad.UInt32(0)
    *_, sums = dr.while_loop((first, read(first), zeros), has_more, visit, mode="symbolic", label="buckets")
    fours = _fours(channels, absolute)
    slots = dr.empty(ad.Float, 4 * fours * lists.capacity)  # a pair's numbers side by side, of all that are listed
    for i in range(bucket):
        listed = buckets.first + i < buckets.end
        slot = lists.sum_index(buckets.first + i, listed)
        values = sums[i] + [ad.Float(0)] * (4 * fours - len(sums[i]))
        for j in range(fours):
            value = ad.Array4f(values[4 * j : 4 * j + 4])
            dr.scatter(slots, value, slot * fours + j, listed, dr.ReduceMode.NoConflicts)
    dr.eval(slots)
    return _gather_slots([slots], splats, lists, channels, absolute)


def _add_pixel(
    sums: list[Float],
    record: list[Float],
    centre: tuple[Float, Float],
    gradients: list[Float],
    state: tuple[Float, Float],
    blends: Bool,
    absolute: bool,
) -> tuple[Float, Float]:
    """Add what a pixel contributes to a pair's sums, and take the pair from the pixel's state: (transmittance, gradient
    of what is behind). A state that blending did not keep has no part, since `blends` is false."""
    (px, py), (transmittance, behind), channels = centre, state, len(gradients)
    dx, dy = px - record[0], py - record[1]
    (power,) = exponents(record, px, py, ONE_PIXEL)
    unclamped = exp2(power)
    alpha = dr.minimum(unclamped, ALPHA_MAX)
    blends &= power >= POWER_MIN
    weight = dr.select(blends, alpha * transmittance, 0)
    along = ad.Float(0)
    for gradient, feature in zip(gradients, record[6 : 6 + channels], strict=True):
        along = dr.fma(gradient, feature, along)
    behind = dr.fma(-weight, along, behind)
    grad_alpha = transmittance * along - behind * dr.rcp(1 - alpha)
    g = dr.select(blends & (unclamped < ALPHA_MAX), grad_alpha * alpha, 0)  # dL / d ln alpha
    g_dx, g_dy = g * dx, g * dy
    sums[0], sums[1], sums[2] = sums[0] + g, sums[1] + g_dx, sums[2] + g_dy
    sums[3], sums[4], sums[5] = dr.fma(g_dx, dx, sums[3]), dr.fma(g_dx, dy, sums[4]), dr.fma(g_dy, dy, sums[5])
    if absolute:
        sums[6] += dr.abs(dr.fma(2 * record[2], g_dx, record[3] * g_dy))
        sums[7] += dr.abs(dr.fma(2 * record[4], g_dy, record[3] * g_dx))
    for c, gradient in enumerate(gradients, 8 if absolute else 6):
        sums[c] = dr.fma(weight, gradient, sums[c])
    return transmittance - weight, behind


def _buckets(state: BlendState, lists: TileLists, number: UInt32) -> _Buckets:
    assert state.bucket_tile is not None, "blending has kept no buckets"
    pieces, shape = read_pieces(lists, state.bucket, state.bucket_tile, number), lists.shape
    tile, end = pieces.tile, dr.select(pieces.exists, pieces.list_end, 0)
    left, top = (tile % lists.tiles_x) * shape.width, (tile // lists.tiles_x) * shape.height
    reached = pieces.exists & (dr.gather(ad.UInt32, state.bucket_reached, number) > 0)
    return _Buckets(tile, reached, ad.Float(left), ad.Float(top), pieces.first, end)


def _record(state: BlendState, buckets: _Buckets, i: int, lists: TileLists) -> list[Float]:
    """Of pair i of each bucket; zeros where there is none, which no pixel has blended."""
    listed = buckets.first + i < buckets.end
    return state.records.load(lists, buckets.first + i, listed)


def _pixel_packets(
    features: list[Float], transmittance: Float, lists: TileLists, grad_planes: PlaneGradients
) -> list[Float]:
    """Of each pixel, tile by tile, by fours: the scalar product of all that it shows, transmittance too, with their
    gradients; and its features' gradients."""
    shape, width, height = lists.shape, grad_planes.width, grad_planes.height
    pixels = shape.width * shape.height
    index = dr.arange(ad.UInt32, lists.tiles_x * lists.tiles_y * pixels)
    tile, (column, row) = index // pixels, pixel_in_tile(index % pixels, shape)
    column, row = column + (tile % lists.tiles_x) * shape.width, row + (tile // lists.tiles_x) * shape.height
    inside = (column < width) & (row < height)
    pixel = row * width + column
    gradients = [dr.gather(ad.Float, plane, pixel, inside) for plane in grad_planes.features]
    passed = dr.gather(ad.Float, transmittance, index)
    total = passed * dr.gather(ad.Float, grad_planes.transmittance, pixel, inside)
    for gradient, plane in zip(gradients, features, strict=True):
        total = dr.fma(gradient, dr.gather(ad.Float, plane, pixel, inside), total)
    values = [total, *gradients]
    values += [ad.Float(0)] * (-len(values) % 4)
    looks = [store(values[i : i + 4], index, dr.width(index)) for i in range(0, len(values), 4)]
    dr.eval(looks)
    return looks


def reduce_mode(bytes_: int, shape: TileShape) -> dr.ReduceMode:
    """How a tile's threads add to the slots, `bytes_` large. One tile alone adds to a slot: the sums depend on none of
    this.

    On CUDA a warp sums first. On LLVM a tile in one packet belongs to one CPU thread, which adds lane by lane in place.
    For larger tiles each CPU thread adds to its own copy, unless copies are too large.
    """
    if select() == "cuda":
        return dr.ReduceMode.Local
    if PACKET % shape.threads == 0:
        return dr.ReduceMode.NoConflicts
    return dr.ReduceMode.Expand if dr.thread_count() * bytes_ < COPIES_BYTES else dr.ReduceMode.Local


@recorded(elements=lambda _, slots, splats, *_rest: dr.width(splats.x))
def _gather_slots(
    slots: list[Float], splats: Splats, lists: TileLists, channels: int, absolute: bool
) -> SplatGradients:
    """Add up each splat's slots, in order, and turn the sums into gradients of the splat's own numbers.

    slots: arrays [F P], F of a pair's sums side by side in each
    """
    splat = dr.arange(ad.UInt32, dr.width(splats.x))
    position = dr.gather(ad.UInt32, lists.first_slot, splat)
    end = position + dr.gather(ad.UInt32, lists.slot_count, splat)

    turn = SLOTS[select()]

    def remaining(position: UInt32, _sums: object) -> Bool:
        return position < end

    def add(position: UInt32, sums: list[Float]) -> tuple[UInt32, list[Float]]:
        for u in range(turn):
            at = position + u
            has_sum = lists.has_sum(at, at < end if u else ad.Bool(True))
            values = load(slots, lists.sum_of_slot(at), lists.capacity, has_sum)
            sums = [total + value for total, value in zip(sums, values, strict=True)]
        return position + turn, sums

    numbers = sum(dr.width(array) for array in slots) // lists.capacity
    state = position, [ad.Float(0) for _ in range(numbers)]
    _, sums = dr.while_loop(state, remaining, add, mode="symbolic", label="gather slots")
    s0, sx, sy, sxx, sxy, syy, *rest = sums
    none = cast(Float, None)  # nothing reads them
    grad_splats = Splats(
        x=dr.fma(splats.a, sx, splats.b * sy),
        y=dr.fma(splats.b, sx, splats.c * sy),
        a=-0.5 * sxx,
        b=-sxy,
        c=-0.5 * syy,
        opacity=s0 * dr.rcp(dr.maximum(splats.opacity, 1e-30)),
        depth=none,
    )
    absolute_x, absolute_y = [value / LOG2_E for value in rest[:2]] if absolute else (none, none)
    grad_features = rest[2 : 2 + channels] if absolute else rest[:channels]
    result = SplatGradients(grad_splats, grad_features, absolute_x, absolute_y)
    dr.eval(result)
    return result
