"""Stage 2: which splats each screen tile blends, front to back.

Each tile lists the splats whose ellipse reaches it, in depth order, ties in index order: the result does not depend on
scheduling. Pairs of tile and splat come from the box around a splat's ellipse; those whose tile the ellipse misses are
in no list. How the lists are put in order depends on the backend, the order does not:

- CUDA counts the pairs into their tiles and orders each list by itself (`counting.py`): a radix sort's many launches
  cost more than its work, and Dr.Jit 1.5 cannot replay them.
- LLVM sorts the splats by depth once, expands them to pairs, and sorts those by tile (`pair_sort.py`); both sorts are
  stable.
"""

from dataclasses import dataclass
from math import gcd
from typing import Any

import drjit as dr

from spacesim.backend import ad, recorded, select
from spacesim.backend.arrays import UInt32
from spacesim.backend.kernels.llvm import is_usable
from spacesim.backend.packet import load
from spacesim.backend.upload import held
from spacesim.splat.raster.lists.boxes import Boxes, Grid, find_boxes, packed, tile_of_pair
from spacesim.splat.raster.lists.capacity import WAITING, Capacities, Extent
from spacesim.splat.raster.lists.counting import count_boxes, count_lists
from spacesim.splat.raster.lists.pair_sort import sort_pairs
from spacesim.splat.raster.lists.sort import segment_ids
from spacesim.splat.raster.lists.tiles import TileLists
from spacesim.splat.raster.project import Footprints, Splats

DIGIT_BITS = 11  #: at most, of the radix sort; the fewest passes whose counters stay small
MAX_SORTED_LENGTH = 2**DIGIT_BITS - 1  #: entries of a list, from which on lists count as equally long
PACKET = 16  #: SIMD lanes that run together on a CPU with AVX-512; elsewhere fewer


def bin_splats(splats: Splats, footprints: Footprints, width: int, height: int, few_sizes: bool = False) -> TileLists:
    """Sort splats [N] into the tiles of a width x height image. Raises WorkError for more pairs than can be
    sorted or held in memory. few_sizes: of lists, for pictures from all over, each of which has another number of
    pairs; lists are up to half as long again.

    Between its two parts the host waits for the number of pairs, which says how large arrays must be.
    """
    extent = Extent.of(dr.width(splats.x), width, height, few_sizes)
    if extent.count == 0:
        return lists_of_boxes(footprints, None, extent, 0)
    boxes = make_boxes(_detached(splats), footprints, extent.live, extent.most, extent.grid)
    return lists_of_boxes(footprints, boxes, extent, WAITING.counted(extent, boxes))


def lists_of_boxes(footprints: Footprints, boxes: Boxes | None, extent: Extent, capacity: int) -> TileLists:
    """Lists of boxes with a capacity for their pairs; 0: there are none, or no boxes."""
    grid = extent.grid
    if boxes is None or capacity == 0:
        none, of_splats = dr.zeros(ad.UInt32, grid.tiles), dr.zeros(ad.UInt32, max(extent.count, 1))
        return TileLists(none, none, none, none, of_splats, of_splats, 0, grid.columns, grid.rows, grid.shape)
    return make_lists(footprints, boxes, held(capacity, "pairs"), extent.capacities(capacity), grid)


def make_boxes(splats: Splats, footprints: Footprints, count: UInt32, capacity: int, grid: Grid) -> Boxes:
    """Boxes of `count` splats, [M] = [capacity], `round_capacity` of as many; may be part of a recording."""
    return (count_boxes if select() == "cuda" else _rank)(splats, footprints, count, capacity, grid)


def make_lists(footprints: Footprints, boxes: Boxes, limit: UInt32, capacities: Capacities, grid: Grid) -> TileLists:
    """Lists of such capacities; may be part of a recording. They are empty where there are more pairs than `limit`,
    the capacity on the device."""
    if select() == "cuda":
        return count_lists(footprints, boxes, limit, capacities, grid)
    if not is_usable():
        return _sort(boxes, limit, capacities, grid)
    pairs = _expand(boxes, limit, capacities, grid)
    start, end, splat, place = sort_pairs(pairs.tile, pairs.splat, grid.tiles)
    bounds = start, end, pairs.first_slot, pairs.slot_count
    tiles, order = (grid.columns, grid.rows, grid.shape), _longest_first(start, end, grid)
    return TileLists(splat, None, *bounds, capacities.pairs, *tiles, order, place)


def _detached(splats: Splats) -> Splats:
    return dr.detach(splats) if dr.grad_enabled(list(vars(splats).values())) else splats  # to detach takes long


@recorded
def _rank(splats: Splats, footprints: Footprints, count: UInt32, capacity: int, grid: Grid) -> Boxes:
    """Boxes of `count` splats; pairs are numbered in depth order."""
    dr.schedule(splats, footprints)
    index = dr.arange(ad.UInt32, dr.width(splats.x))
    live = footprints.visible & (index < count)
    seen = Footprints(footprints.half_width, footprints.half_height, live, footprints.order)
    numbers, pairs_of = find_boxes(splats, seen, grid)
    # Splats that cannot be seen have no pairs, so their place does not matter.
    pairs, key = dr.zeros(ad.UInt32, capacity), dr.full(ad.UInt32, 0xFFFFFFFF, capacity)
    dr.scatter(pairs, pairs_of, index)
    dr.scatter(key, dr.select(live, footprints.order, ad.UInt32(0xFFFFFFFF)), index)
    records = packed(numbers, index, capacity)
    dr.eval(records, pairs, key)
    order = _stable_order(key, 32)
    wide = grid.number_type(capacity)(dr.gather(ad.UInt32, pairs, order))
    return Boxes(records, pairs, count, dr.prefix_reduce(dr.ReduceOp.Add, wide, exclusive=False), order)


@dataclass
class _Pairs:
    """Of tile and splat, splat by splat."""

    tile: UInt32  #: [P], the number of tiles of those in no list
    splat: UInt32  #: [P]
    first_slot: UInt32  #: of each splat's pairs [M]
    slot_count: UInt32  #: [M]


@recorded
def _expand(boxes: Boxes, limit: UInt32, capacities: Capacities, grid: Grid) -> _Pairs:
    """The pairs of boxes; none where there are more than `limit`."""
    capacity, splat_capacity = capacities.pairs, capacities.splats
    # Mark each splat's first pair with its rank, then a running maximum fills in the rest.
    splat_rank = dr.arange(ad.UInt32, splat_capacity)
    assert boxes.order is not None
    fits, total = boxes.that_fit(limit)
    slot_count = dr.select(fits, boxes.count, 0)
    pairs_of = dr.gather(ad.UInt32, boxes.count, boxes.order)
    first = ad.UInt32(boxes.pair_ends) - pairs_of
    dr.eval(first, slot_count, fits, total)
    rank = dr.zeros(ad.UInt32, capacity)
    dr.scatter(rank, splat_rank, first, active=(pairs_of > 0) & fits)
    rank = dr.prefix_reduce(dr.ReduceOp.Max, rank, exclusive=False)
    first_slot = dr.empty(ad.UInt32, splat_capacity)
    dr.scatter(first_slot, first, boxes.order)

    slot = dr.arange(ad.UInt32, capacity)
    splat = dr.gather(ad.UInt32, boxes.order, rank)
    within = slot - dr.gather(ad.UInt32, first, rank)
    ellipse = load(boxes.records, splat, splat_capacity)
    tile = tile_of_pair(ellipse, within, slot < total, grid)
    dr.eval(tile, splat, first_slot)
    return _Pairs(tile, splat, first_slot, slot_count)


@recorded
def _sort(boxes: Boxes, limit: UInt32, capacities: Capacities, grid: Grid) -> TileLists:
    """Lists from a stable sort by tiles."""
    pairs, capacity, count = _expand(boxes, limit, capacities, grid), capacities.pairs, grid.tiles
    slot = _stable_order(pairs.tile, count.bit_length())
    splat = dr.gather(ad.UInt32, pairs.splat, slot)
    number = dr.arange(ad.UInt32, count)
    end = segment_ids(pairs.tile, number, capacity, slot)
    dr.eval(end)
    start = dr.gather(ad.UInt32, end, number - 1, number > 0)
    order = _longest_first(start, end, grid)
    place = dr.empty(ad.UInt32, capacity)
    dr.scatter(place, dr.arange(ad.UInt32, capacity), slot)
    dr.eval(splat, start, end, order, place)
    bounds, tiles = (start, end, pairs.first_slot, pairs.slot_count), (grid.columns, grid.rows, grid.shape)
    return TileLists(splat, None, *bounds, capacity, *tiles, order, place)


@recorded
def _longest_first(start: UInt32, end: UInt32, grid: Grid) -> UInt32:
    """Tiles by the lengths of their lists, from `start` to `end` [T], longest first, in packets that are then spread by
    the golden ratio.

    Tiles that share a packet are walked together until the longest list ends: neighbours are of about one length.
    CPU threads take runs of packets: each run, of whatever length, has long lists and short ones alike.
    """
    count, length = grid.tiles, end - start
    sorted_ = _stable_order(MAX_SORTED_LENGTH - dr.minimum(length, MAX_SORTED_LENGTH), MAX_SORTED_LENGTH.bit_length())
    group = max(PACKET // grid.shape.threads, 1)
    groups = count // group
    stride = _golden_stride(groups)
    if stride < 2:
        return sorted_
    index = dr.arange(ad.UInt32, count)
    rank = ad.UInt32(ad.UInt64(index // group) * stride % groups)
    is_spread = index < groups * group  # the last few tiles, with the shortest lists, stay where they are
    return dr.gather(ad.UInt32, sorted_, dr.select(is_spread, rank * group + index % group, index))


def _golden_stride(count: int) -> int:
    """About the golden part of `count`, and without a common divisor: multiples of it, modulo `count`, are all numbers
    below it once, and those of any run are spread evenly."""
    stride = round(0.618034 * count)
    while gcd(stride, count) > 1:
        stride += 1
    return stride


def _stable_order(keys: UInt32, bits: int) -> UInt32:
    """Indices that sort `keys` [N] of so many bits: a radix sort that knows how few digits there are, where dr.argsort
    goes through all 32 bits."""
    passes = -(-bits // DIGIT_BITS)
    digit_bits = -(-bits // passes)
    order: Any = None
    for i in range(passes):
        last = i == passes - 1
        digit = (keys >> (i * digit_bits)) & ((1 << digit_bits) - 1) if passes > 1 else keys
        dr.eval(digit, order, None if last else keys)
        plain: Any = dr.detach(digit)  # `block_mkperm` is said to take other arrays
        moved = ad.UInt32(dr.detail.block_mkperm(plain, dr.width(keys), 1 << digit_bits))
        order = moved if order is None else dr.gather(ad.UInt32, order, moved)
        if not last:
            keys = dr.gather(ad.UInt32, keys, moved)
        del digit, plain, moved  # what is over goes: memory is short here
    return order
