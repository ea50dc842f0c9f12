"""Tile lists on CUDA: pairs are counted into their tiles, and each list is ordered by itself (`sort.py`).

Pairs are found twice, to be counted and to be listed, by threads that each go through some of a splat's: to look for a
pair's splat, and to keep what was found, takes longer. Splats of many tiles follow, by more threads each.
"""

from collections.abc import Callable
from typing import cast

import drjit as dr

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Bool, UInt32, UInt64
from spacesim.backend.packet import load
from spacesim.splat.raster.lists.boxes import Boxes, Grid, each_tile, find_boxes, packed
from spacesim.splat.raster.lists.capacity import Capacities
from spacesim.splat.raster.lists.sort import empty_entries, entry_of, list_bounds, ordered_entries
from spacesim.splat.raster.lists.tiles import TileLists
from spacesim.splat.raster.project import Footprints, Splats

MAX_LANES = 32  #: threads that share a splat's pairs: a warp
MANY = 256  #: tiles of a box; one of more is a large splat's
LANES_OF_LARGE = 1024  #: threads that share a large splat's pairs; `round_capacity` gives multiples of as many
NEVER = 2**32 - 1  #: a turn that no thread has
Visit = Callable[[UInt32, UInt32], None]
"""(number of a pair within its splat's box, its tile, the number of tiles where it is in none)."""


@recorded
def count_boxes(splats: Splats, footprints: Footprints, count: UInt32, capacity: int, grid: Grid) -> Boxes:
    """Boxes of `count` splats; pairs are numbered in the order of the splats' indices."""
    boxes = _boxes(splats, footprints, count, capacity, grid)
    wide = grid.number_type(capacity)(boxes.count)
    dr.eval(boxes, wide)
    boxes.pair_ends = dr.prefix_reduce(dr.ReduceOp.Add, wide, exclusive=False)
    return boxes


@recorded
def count_lists(footprints: Footprints, boxes: Boxes, limit: UInt32, capacities: Capacities, grid: Grid) -> TileLists:
    """Lists of boxes' pairs, which have slots; empty where there are more than `limit`."""
    fit, _ = boxes.that_fit(limit)
    first_slot, slot_count = ad.UInt32(boxes.pair_ends) - boxes.count, dr.select(fit, boxes.count, 0)
    dr.eval(first_slot, slot_count)
    return _lists(footprints, boxes, (first_slot, slot_count), fit, limit, capacities, grid)[0]


def picture_lists(
    splats: Splats, footprints: Footprints, count: UInt32, limit: UInt32, capacities: Capacities, grid: Grid
) -> tuple[TileLists, UInt32 | UInt64]:
    """(lists of `count` splats, without slots; sums whose last says how many pairs are listed), a part of recordings.
    The lists are empty where there are more than `limit`. What splats are made of is evaluated with their boxes."""
    boxes = _boxes(splats, footprints, count, capacities.splats, grid)
    dr.eval(boxes, footprints.order)
    return _lists(footprints, boxes, None, ad.Bool(True), limit, capacities, grid)


def _boxes(splats: Splats, footprints: Footprints, count: UInt32, capacity: int, grid: Grid) -> Boxes:
    """Without numbers of pairs."""
    numbers, pairs = find_boxes(splats, footprints, grid)
    index = dr.arange(ad.UInt32, dr.width(splats.x))
    large, large_count = dr.empty(ad.UInt32, capacity), dr.zeros(ad.UInt32, 1)
    place = cast(UInt32, dr.scatter_inc(large_count, ad.UInt32(0), pairs > MANY))
    dr.scatter(large, index, place, pairs > MANY)
    return Boxes(packed(numbers, index, capacity), pairs, count, large=large, large_count=large_count)


def _lists(
    footprints: Footprints,
    boxes: Boxes,
    slots: tuple[UInt32, UInt32] | None,
    fit: Bool,
    limit: UInt32,
    capacities: Capacities,
    grid: Grid,
) -> tuple[TileLists, UInt32 | UInt64]:
    """(lists, sums of their lengths). slots: `TileLists.first_slot` and `slot_count`, or None;  fit: whether anything
    is to be listed"""
    lengths = dr.zeros(ad.UInt32, grid.tiles)

    def count_pairs(_splat: UInt32) -> Visit:
        def count_pair(_within: UInt32, tile: UInt32) -> None:
            one, mode = ad.UInt32(1), dr.ReduceMode.Direct
            dr.scatter_reduce(dr.ReduceOp.Add, lengths, one, tile, tile < grid.tiles, mode)

        return count_pair

    _each_pair(boxes, fit, capacities, grid, count_pairs)
    bounds = list_bounds(lengths, grid.number_type(capacities.splats), limit)
    tiles, entries, cursor = dr.empty(ad.UInt32, capacities.pairs), empty_entries(capacities.pairs), bounds.cursor

    def list_pairs(splat: UInt32) -> Visit:
        key = dr.gather(ad.UInt32, footprints.order, splat)
        first = dr.gather(ad.UInt32, slots[0], splat) if slots else ad.UInt32(0)

        def list_pair(within: UInt32, tile: UInt32) -> None:
            listed, slot = tile < grid.tiles, first + within
            place = cast(UInt32, dr.scatter_inc(cursor, tile, listed))
            dr.scatter(entries, entry_of(key, splat, tile, slot), place, listed)
            if slots:
                dr.scatter(tiles, tile, slot)

        return list_pair

    _each_pair(boxes, fit & bounds.fit(limit), capacities, grid, list_pairs)
    dr.eval(entries, tiles if slots else None)
    ordered = ordered_entries(entries, bounds, capacities.pairs, 2 if slots else 1)
    lists = TileLists(
        splat=ordered[0],
        slot=ordered[1] if slots else None,
        start=bounds.start,
        end=bounds.end,
        first_slot=slots[0] if slots else None,
        slot_count=slots[1] if slots else None,
        capacity=capacities.pairs,
        tiles_x=grid.columns,
        tiles_y=grid.rows,
        shape=grid.shape,
        order=bounds.order,
        tile=tiles if slots else None,
    )
    return lists, bounds.sums


def _each_pair(
    boxes: Boxes, fit: Bool, capacities: Capacities, grid: Grid, visit_of: Callable[[UInt32], Visit]
) -> None:
    """Visit all pairs of boxes, none where not `fit`: by what `visit_of` gives for a splat that is there."""
    lanes, capacity = _lanes(capacities), capacities.splats
    thread, large = dr.arange(ad.UInt32, capacity * lanes), boxes.large
    assert large is not None
    assert boxes.large_count is not None
    large_count = dr.select(fit, dr.gather(ad.UInt32, boxes.large_count, ad.UInt32(0)), 0)
    # by the splats that there are: by the capacity, a literal, each would be compiled
    group, groups = thread // LANES_OF_LARGE, dr.maximum(boxes.splats * lanes // LANES_OF_LARGE, 1)

    def has_more(turn: UInt32) -> Bool:
        return turn <= large_count

    def visit(turn: UInt32) -> tuple[UInt32]:
        """First a thread's own splat, then large ones."""
        own, number = turn == 0, thread // lanes
        splat = dr.select(own, dr.minimum(number, boxes.splats - 1), dr.gather(ad.UInt32, large, turn - 1, ~own))
        pairs = dr.gather(ad.UInt32, boxes.count, splat)
        pairs = dr.select(~own | (fit & (pairs <= MANY) & (number < boxes.splats)), pairs, 0)
        lane, step = dr.select(own, thread % lanes, thread % LANES_OF_LARGE), dr.select(own, lanes, LANES_OF_LARGE)
        each_tile(load(boxes.records, splat, capacity), pairs, lane, ad.UInt32(step), grid, visit_of(splat))
        return (dr.select(own, dr.select(group < groups, 1 + group, NEVER), turn + groups),)

    dr.while_loop((ad.UInt32(0),), has_more, visit, mode="symbolic", label="tiles of splats")


def _lanes(capacities: Capacities) -> int:
    """Threads that share a splat's pairs, a power of two: about as many as it has."""
    return min(1 << (max(capacities.pairs // capacities.splats, 1).bit_length() - 1), MAX_LANES)
