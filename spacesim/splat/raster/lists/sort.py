"""Lists in order without a sort over all of them: each is ordered by itself.

Entries are written into their lists as they come, each in a place taken by an atomic increment; then each counts how
many of its list come before it. Key and number distinguish any two entries of a list: where one ends up does
not depend on the order of the input. A list is ordered in runs: in the shortest each entry is compared with each; from
runs of one size to those of the next an entry looks for its place in the others by bisection, and, in lists longer than
the longest run, in all other runs. With runs of 64 and 4096 a list of L takes 64 + 64 log2 64 + L / 4096 log2 4096
steps an entry.
"""

import itertools
from dataclasses import dataclass
from typing import cast

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Array2u64, Bool, UInt32, UInt64

SIZES = 64, 4096  #: entries, powers of two: so many are compared each with each (with 32, 128 or 256 an H100 takes
#: longer); of these as many as are searched in one pass, the lists of pictures being short
SIZES_OF_LONG = 64, 512, 4096, 32768, 262144  #: passes that take less where lists are long
ROOM = 512  #: entries a list for which there is room; where there is more, lists may be long
WAYS = 4  #: parts of what is left, of which a search takes one: fewer steps than by halves; 8 are slower
COMPARED = 4  #: entries compared in a turn of the loop
#: of lengths of lists: a block of threads waits for its longest walk; with neighbours of one class an H100 blends in
#: three quarters of the time
CLASSES = 64
CLASSES_AN_OCTAVE = 6  #: so all lists of 1,500 entries and more are of one class
PACKET = 4  #: numbers that are read at once
MERGE_THREADS = 2**16  #: that share the entries of lists beyond the longest run: as many as fill a large device


def segment_ids(
    segment_ends: UInt32 | UInt64, slot: UInt32 | UInt64, count: int, order: UInt32 | None = None
) -> UInt32:
    """Which of `count` segments each slot [P] belongs to, where segment i has those from segment_ends[i - 1] to
    segment_ends[i]; `count` for slots of no segment. order: where the segments' ends stand, if not one after another"""
    number, wide = type(segment_ends), type(segment_ends)(slot)
    segment, step = ad.UInt32(0), 1
    while WAYS * step <= count:
        step *= WAYS
    while step:
        past = ad.UInt32(0)
        for probe in (segment + way * step for way in range(1, WAYS)):
            within = probe <= count
            place = probe - 1 if order is None else dr.gather(ad.UInt32, order, probe - 1, within)
            reached = within & (dr.gather(number, segment_ends, place, within) <= wide)
            past += dr.select(reached, ad.UInt32(1), 0)
        segment += past * step
        step //= WAYS
    return segment


@dataclass
class ListBounds:
    """Of lists [T], one after another."""

    sums: UInt32 | UInt64  #: entries up to the end of each list
    start: UInt32  #: of each list
    end: UInt32  #: of each list
    cursor: UInt32  #: the starts once more, of what fits: an increment takes a list's next place
    #: all lists by classes of length, the longest first, those of a class in any order
    order: UInt32
    counts: UInt32  #: lists of each class, then zeros that `ordered_entries` may change: a fill less

    def fit(self, limit: UInt32) -> Bool:
        """Whether all entries are within a limit, of width 1."""
        return _fit(self.sums, limit)


def list_bounds(lengths: UInt32, number: type[UInt32] | type[UInt64], limit: UInt32) -> ListBounds:
    """Where lists of these lengths [T] start and end, all evaluated; empty ones where there are more entries than
    `limit`. number: of integers that hold the sum of the lengths"""
    index, wide = dr.arange(ad.UInt32, dr.width(lengths)), number(lengths)
    dr.eval(lengths, wide)
    sums = dr.prefix_reduce(dr.ReduceOp.Add, wide, exclusive=False)
    fit = _fit(sums, limit)
    end = ad.UInt32(dr.select(fit, sums, 0))
    start = dr.select(fit, end - lengths, 0)
    counts, class_ = dr.zeros(ad.UInt32, CLASSES + PACKET), _class_of(lengths)
    rank = cast(UInt32, dr.scatter_inc(counts, class_))
    dr.eval(start, end, rank, class_, counts)
    order, cursor = dr.empty(ad.UInt32, dr.width(lengths)), end - lengths  # no copy of `start`: that is a launch
    dr.scatter(order, index, _count_longer(counts, class_) + rank)
    dr.eval(order, cursor)
    return ListBounds(sums, start, end, cursor, order, counts)


def _fit(sums: UInt32 | UInt64, limit: UInt32) -> Bool:
    number = type(sums)
    return dr.gather(number, sums, ad.UInt32(dr.width(sums) - 1)) <= number(limit)


def empty_entries(capacity: int) -> UInt64:
    """Room for so many `entry_of`, and some more behind them: a turn of `_count_before` may read beyond the end."""
    return dr.empty(ad.UInt64, 2 * (capacity + COMPARED))


def entry_of(key: UInt32, number: UInt32, list_: UInt32, source: UInt32) -> Array2u64:
    """An entry of a list: what orders it, key and number, and its list and where it comes from."""
    return ad.Array2u64(_joined(key, number), _joined(list_, source))


def ordered_entries(
    entries: UInt64, bounds: ListBounds, capacity: int, parts: int = 2, sizes: tuple[int, ...] | None = None
) -> list[UInt32]:
    """Number and source, or the first `parts` of these, [P] = [capacity], of entries that stand in their lists in any
    order, each list ordered by key, then number; what stands behind the last list has no meaning. Not differentiable.

    entries: of `empty_entries`, each an `entry_of`; no two of a list may have one key and number
    sizes: of the runs that are made one from another, by default `SIZES`, `SIZES_OF_LONG` for lists that may be long
    """
    start, end = bounds.start, bounds.end
    lists = dr.width(end)
    if sizes is None:
        sizes = SIZES_OF_LONG if capacity > ROOM * lists else SIZES
    entry = dr.arange(ad.UInt32, capacity)
    live = entry < dr.gather(ad.UInt32, end, ad.UInt32(lists - 1))
    own, first, last = _own(entries, entry, live, start, end)
    chunk = _start_of_run(entry, first, sizes[0])
    rank = _count_before(entries, own[0], chunk, dr.minimum(chunk + sizes[0], last))
    entries = _packed(*own, chunk + rank, live, capacity)
    dr.eval(entries)

    def in_run(size: int, larger: int) -> tuple[tuple[UInt64, UInt64], UInt32, UInt32]:
        """(what an entry holds, its place when runs of `size` are put together to `larger` ones, its list's length)."""
        own, first, last = _own(entries, entry, live, start, end)
        chunk, run = _start_of_run(entry, first, size), _start_of_run(entry, first, larger)
        others = _search_others(entries, own[0], chunk, run, dr.minimum(run + larger, last), size)
        return own, dr.select(live, run + (entry - chunk) + others, entry), last - first

    for size, larger in itertools.pairwise(sizes[:-1]):
        own, place, _ = in_run(size, larger)
        entries = _packed(*own, place, live, capacity)
        dr.eval(entries)
    own, place, length = in_run(*sizes[-2:])
    is_long = live & (length > sizes[-1])
    in_runs = _packed(*own, place, is_long, capacity)
    targets = [dr.empty(ad.UInt32, capacity) for _ in range(parts)]
    for value, target in zip(own, targets, strict=False):
        dr.scatter(target, dr.select(live, ad.UInt32(value), 0), place)
    dr.scatter(bounds.counts, ad.UInt32(1), ad.UInt32(CLASSES), is_long)
    dr.eval(targets, in_runs, bounds.counts)
    some_long = dr.gather(ad.UInt32, bounds.counts, ad.UInt32(CLASSES))
    _merge_runs(targets, in_runs, some_long, start, end, sizes[-1])
    return targets


def _class_of(lengths: UInt32) -> UInt32:
    """Of lengths [N], shorter ones first, 0 of no entries."""
    return dr.minimum(ad.UInt32(CLASSES_AN_OCTAVE * dr.log2(ad.Float(lengths + 1))), CLASSES - 1)


def _count_longer(counts: UInt32, class_: UInt32) -> UInt32:
    """How many lists are of longer classes, [N]. counts: lists of each class"""
    longer = ad.UInt32(0)
    for four in range(CLASSES // PACKET):
        for i, count in enumerate(dr.gather(ad.Array4u, counts, ad.UInt32(four))):
            longer += dr.select(PACKET * four + i > class_, count, 0)
    return longer


def _start_of_run(entry: UInt32, first: UInt32, size: int) -> UInt32:
    """Where the run of `size` entries begins that an entry of the list from `first` is in."""
    return first + ((entry - first) & ~ad.UInt32(size - 1))


def _merge_runs(
    targets: list[UInt32], entries: UInt64, some_long: UInt32, start: UInt32, end: UInt32, run_size: int
) -> None:
    """Write numbers, and sources, of the lists longer than a run, whose runs are in order, in the order of the whole
    list. One launch, which is over at once where there are none: some_long, of width 1, is 0."""
    lists = dr.width(end)
    total = dr.select(some_long > 0, dr.gather(ad.UInt32, end, ad.UInt32(lists - 1)), 0)

    def remaining(entry: UInt32) -> Bool:
        return entry < total

    def merge(entry: UInt32) -> tuple[UInt32]:
        here = segment_ids(end, entry, lists)
        first, last = dr.gather(ad.UInt32, start, here), dr.gather(ad.UInt32, end, here)
        is_long = last - first > run_size
        own = dr.gather(ad.Array2u64, entries, entry, is_long)
        run = _start_of_run(entry, first, run_size)
        others = _search_others(entries, own[0], run, first, dr.select(is_long, last, first), run_size)
        for value, target in zip(own, targets, strict=False):
            dr.scatter(target, ad.UInt32(value), first + (entry - run) + others, is_long)
        return (entry + MERGE_THREADS,)

    dr.while_loop((dr.arange(ad.UInt32, MERGE_THREADS),), remaining, merge, mode="symbolic", label="merge runs")
    dr.eval(targets)


def _joined(high: UInt32, low: UInt32) -> UInt64:
    """Both in one number."""
    return (ad.UInt64(high) << 32) | ad.UInt64(low)


def _packed(key: UInt64, source: UInt64, index: UInt32, active: Bool | bool, size: int) -> UInt64:
    """Entries [2 size], see `_own`, in other places."""
    target = empty_entries(size)
    dr.scatter(target, ad.Array2u64(key, source), index, active=active)
    return target


def _own(
    entries: UInt64, entry: UInt32, live: Bool, start: UInt32, end: UInt32
) -> tuple[tuple[UInt64, UInt64], UInt32, UInt32]:
    """((key and number, list and source) of an entry, where its list starts, and ends): an empty one if it is not
    live."""
    own = dr.gather(ad.Array2u64, entries, entry, live)
    list_ = ad.UInt32(own[1] >> 32)
    return (own[0], own[1]), dr.gather(ad.UInt32, start, list_, live), dr.gather(ad.UInt32, end, list_, live)


def _count_before(entries: UInt64, key: UInt64, start: UInt32, end: UInt32) -> UInt32:
    """How many entries of [start, end) come before `key`."""

    def has_more(i: UInt32, _rank: UInt32) -> Bool:
        return i < end

    def compare(i: UInt32, rank: UInt32) -> tuple[UInt32, UInt32]:
        for at in (i + u for u in range(COMPARED)):
            before = dr.gather(ad.UInt64, entries, 2 * at) < key
            rank = rank + dr.select(before & (at < end), ad.UInt32(1), ad.UInt32(0))
        return i + COMPARED, rank

    _, rank = dr.while_loop((start, ad.UInt32(0)), has_more, compare, mode="symbolic", label="count before")
    return rank


def _search_others(entries: UInt64, key: UInt64, chunk: UInt32, start: UInt32, end: UInt32, size: int) -> UInt32:
    """How many entries of [start, end), which is in ordered chunks of `size`, come before `key`; but for the chunk that
    starts at `chunk`."""

    def has_more(at: UInt32, _rank: UInt32) -> Bool:
        return at < end

    def search(at: UInt32, rank: UInt32) -> tuple[UInt32, UInt32]:
        here, stop = at != chunk, dr.minimum(at + size, end)
        low, step = at, size
        while step:
            probe = low + step
            within = here & (probe <= stop)
            before = dr.gather(ad.UInt64, entries, 2 * (probe - 1), within) < key
            low = dr.select(within & before, probe, low)
            step >>= 1
        return at + size, rank + (low - at)

    _, rank = dr.while_loop((start, ad.UInt32(0)), has_more, search, mode="symbolic", label="search others")
    return rank
