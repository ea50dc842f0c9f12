"""Who walks which part of which tile's list, and from what state.

As a rule a thread walks the whole list for its pixels. Where splats are many and tiles few, a device would wait for a
few long walks: there lists are cut into parts. All parts are walked at once as if nothing stood before them; what
passes through each and what it adds give the state before every part, up to the one in which a pixel is finished; from
these states all are walked again.
"""

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr

from spacesim.backend import ad, select
from spacesim.backend.arrays import Bool, Float, UInt32
from spacesim.splat.raster.lists.pieces import count_pieces, name_tiles, read_pieces
from spacesim.splat.raster.lists.tiles import ThreadPixels, TileLists, pixels_of_threads, thread_pixels
from spacesim.splat.raster.records import TRANSMITTANCE_MIN

PART = 512  #: pairs, a power of two, some buckets of the adjoint
#: splats a tile from which on lists are walked in parts: on an H100 a picture of 64 x 64 pixels of a million splats is
#: blended in 0.5 ms, not 7, one of 256 x 256 in 0.7, not 1.2
IN_PARTS = {"cuda": 2**9, "llvm": 2**32}
MAX_TILES = 2**11  #: more keep the device busy


@dataclass
class Walks:
    """Of each thread: its pixels, what it walks, and from what state. Lists are of the thread's pixels."""

    thread: ThreadPixels
    list_start: UInt32  #: first pair of its tile
    start: UInt32  #: first pair of the walk
    end: UInt32  #: one past its last
    transmittance: list[Float]  #: before the walk; negative of pixels that are finished
    sums: list[list[Float]]  #: C of each pixel, before the walk
    last: UInt32  #: one past the last pair blended before the walk, or more
    finishes: list[Bool]  #: pixels that may be finished within the walk, all that are finished before it among them
    writes: list[Bool]  #: pixels whose state after the walk is that of the whole list


Walk = Callable[[Walks], tuple[list[Float], list[list[Float]]]]
"""Walks: (what passes, negative of what is finished; sums) of each pixel of each thread."""


def whole_lists(lists: TileLists, channels: int) -> Walks:
    """A thread for each pixels of each tile."""
    thread = thread_pixels(lists)
    start, end = (dr.gather(ad.UInt32, bounds, thread.tile) for bounds in (lists.start, lists.end))
    return _unwalked(lists, channels, thread, start, start, end)


def _unwalked(
    lists: TileLists, channels: int, thread: ThreadPixels, list_start: UInt32, start: UInt32, end: UInt32
) -> Walks:
    pixels = range(lists.shape.pixels)
    sums = [[ad.Float(0) for _ in range(channels)] for _ in pixels]
    true = [ad.Bool(True) for _ in pixels]
    return Walks(thread, list_start, start, end, [ad.Float(1) for _ in pixels], sums, ad.UInt32(0), true, list(true))


def are_in_parts(lists: TileLists, capacity: int) -> bool:
    """Whether lists are cut, by what does not depend on earlier pictures. capacity: length of the splats' arrays"""
    tiles = lists.tiles_x * lists.tiles_y
    return lists.capacity > 0 and tiles <= MAX_TILES and capacity >= IN_PARTS[select()] * tiles


def in_parts(lists: TileLists, channels: int, walk: Walk) -> Walks:
    """Threads for each part of each list, from the states that a first `walk` finds."""
    tiles, threads, pixels = lists.tiles_x * lists.tiles_y, lists.shape.threads, lists.shape.pixels
    numbers = count_pieces(lists, PART)
    tile_of_part, tile = dr.full(ad.UInt32, tiles, numbers), dr.arange(ad.UInt32, tiles)
    name_tiles(tile_of_part, tile, *_parts_of(lists, tile))
    dr.eval(tile_of_part)
    index = dr.arange(ad.UInt32, numbers * threads)
    parts = read_pieces(lists, PART, tile_of_part, index // threads)
    start, exists = parts.first, parts.exists
    end: UInt32 = dr.select(exists, dr.minimum(start + PART, parts.list_end), start)
    thread = pixels_of_threads(lists, parts.tile, index % threads)
    walks = _unwalked(lists, channels, thread, parts.list_start, start, end)
    transmittance, sums = walk(walks)
    passed = [[values, *added] for values, added in zip(transmittance, sums, strict=True)]
    dr.eval(passed)  # of all pixels at once, or each walks anew
    walks.last = dr.select(start > parts.list_start, start, 0)
    is_last: Bool = end == parts.list_end
    for p in range(pixels):
        before = _states_before(lists, passed[p], numbers)
        first, *walks.sums[p] = (dr.gather(ad.Float, array, index) for array in before)
        following = dr.gather(ad.Float, before[0], index + threads, ~is_last & exists)
        walks.transmittance[p] = dr.select(exists, first, -1)
        walks.finishes[p] = is_last | (following < 0)
        walks.writes[p] = exists & (first > 0) & walks.finishes[p]
    return walks


def _parts_of(lists: TileLists, tile: UInt32) -> tuple[UInt32, UInt32]:
    """(number of a tile's first part, number of the next tile's first or less)."""
    start, end = (dr.gather(ad.UInt32, bounds, tile) for bounds in (lists.start, lists.end))
    first = start // PART + tile
    return first, first + (end - start + (PART - 1)) // PART


def _states_before(lists: TileLists, passed: list[Float], numbers: int) -> list[Float]:
    """[numbers * threads] each: transmittance, negative where the pixel is finished, and sums of a pixel of each thread
    before each part. passed: what the parts let pass and add, likewise."""
    tiles, threads = lists.tiles_x * lists.tiles_y, lists.shape.threads
    states = [dr.empty(ad.Float, numbers * threads) for _ in passed]
    index = dr.arange(ad.UInt32, tiles * threads)
    tile, within = index // threads, index % threads
    first, until = _parts_of(lists, tile)

    def has_more(number: UInt32, _state: object) -> Bool:
        return number < until

    def add(number: UInt32, state: list[Float]) -> tuple[UInt32, list[Float]]:
        place = number * threads + within
        for target, value in zip(states, state, strict=True):
            dr.scatter(target, value, place, mode=dr.ReduceMode.NoConflicts)
        through, *added = (dr.gather(ad.Float, array, place) for array in passed)
        before, *sums = state
        behind = before * through
        open_still = (before > 0) & (through > 0) & (behind > TRANSMITTANCE_MIN)
        after = [dr.fma(before, value, total) for value, total in zip(added, sums, strict=True)]
        return number + 1, [dr.select(open_still, behind, -1), *after]

    state = [ad.Float(1), *(ad.Float(0) for _ in passed[1:])]
    dr.while_loop((first, state), has_more, add, mode="symbolic", label="states")
    dr.eval(states)
    return states
