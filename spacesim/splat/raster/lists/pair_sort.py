"""Pairs by their tiles, on a CPU, as text for LLVM: a counting sort of one pass, which also says where each pair is.

Dr.Jit would sort keys alone, then gather and scatter what belongs to them.
"""

from functools import cache

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import UInt32
from spacesim.backend.kernels.llvm import LlvmKernel, empty
from spacesim.backend.kernels.llvm_text import Text, Value

CHUNKS = 16  #: of the pairs, at most: each has counters of its own, which one thread adds up
ARRAYS = "tile", "splat", "start", "end", "sorted", "place", "counters"
NUMBERS = "pairs", "tiles", "chunk", "chunks"


def sort_pairs(tile: UInt32, splat: UInt32, tiles: int) -> tuple[UInt32, UInt32, UInt32, UInt32]:
    """(start, end) of the list of each tile [T]; the splats in the lists' order [P]; the place of each pair there [P].

    tile, splat: of each pair [P], T pairs of no tile, which come behind all lists
    """
    pairs = dr.width(tile)
    chunks = min(CHUNKS, 2 * dr.thread_count(), 1 + pairs // tiles)
    chunk = -(-pairs // chunks)
    start, end, counters = (empty(ad.UInt32, size) for size in (tiles, tiles, chunks * (tiles + 1)))
    in_order, place = (empty(ad.UInt32, pairs) for _ in range(2))
    arrays = [tile, splat, start, end, in_order, place, counters]
    _kernel()([chunks, 1, chunks], arrays, [pairs, tiles, chunk, chunks])
    return start, end, in_order, place


@cache
def _kernel() -> LlvmKernel:
    return LlvmKernel(ARRAYS, NUMBERS, ("count", _count), ("add_up", _add_up), ("fill", _fill))


def _counter(text: Text, chunk: Value, tile: Value) -> Value:
    return chunk * (text.number("tiles") + 1) + tile


def _pairs(text: Text) -> tuple[Value, Value]:
    """The first of a chunk, and one past its last."""
    chunk, pairs = text.number("chunk"), text.number("pairs")
    first = (text.index * chunk).least(pairs)
    return first, (first + chunk).least(pairs)


def _count(text: Text) -> None:
    """A chunk's pairs of each tile."""
    zero = text.integer(0)
    with text.loop(zero, text.number("tiles") + 1) as tiles:
        text.store("counters", _counter(text, text.index, tiles.at), zero)
    with text.loop(*_pairs(text)) as pairs:
        counter = _counter(text, text.index, text.load("tile", pairs.at))
        text.store("counters", counter, text.load("counters", counter) + 1)


def _add_up(text: Text) -> None:
    """Where each list begins, and each chunk's part of it."""
    zero, tiles = text.integer(0), text.number("tiles")

    def turn_into_places(tile: Value, place: Value) -> Value:
        with text.loop(zero, text.number("chunks"), [place]) as chunks:
            counter = _counter(text, chunks.at, tile)
            counted = text.load("counters", counter)
            text.store("counters", counter, chunks.state[0])
            chunks.following = [chunks.state[0] + counted]
        return chunks.state[0]

    with text.loop(zero, tiles, [zero]) as lists:
        text.store("start", lists.at, lists.state[0])
        end = turn_into_places(lists.at, lists.state[0])
        text.store("end", lists.at, end)
        lists.following = [end]
    turn_into_places(tiles, lists.state[0])


def _fill(text: Text) -> None:
    """Each pair into its place."""
    with text.loop(*_pairs(text)) as pairs:
        counter = _counter(text, text.index, text.load("tile", pairs.at))
        place = text.load("counters", counter)
        text.store("counters", counter, place + 1)
        text.store("sorted", place, text.load("splat", pairs.at))
        text.store("place", pairs.at, place)
