"""Lists in order without a sort over all of them: entries are counted into their lists, and each list is ordered by
itself.

An entry's place among those of its list is taken by an atomic increment, so lists are unordered; then each entry
counts how many of its list come before it. Key and number distinguish any two entries of a list: where one ends up does
not depend on the order of the input. A list is ordered in runs: in the shortest each entry is compared with each; from
runs of one size to those of the next an entry looks for its place in the others by bisection, and, in lists longer than
the longest run, in all other runs. With runs of 64 and 4096 a list of L takes 64 + 64 log2 64 + L / 4096 log2 4096
steps an entry.
"""

import itertools
from typing import cast

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Bool, UInt32, UInt64

SIZES = 64, 4096  #: entries, powers of two: so many are compared each with each (with 32, 128 or 256 an H100 takes
#: longer); of these as many as are searched in one pass, the lists of pictures being short
SIZES_OF_LONG = 64, 512, 4096, 32768, 262144  #: passes that take less where lists are long
ROOM = 512  #: entries a list for which there is room, from which on lists may be long
WAYS = 4  #: parts of what is left, of which a search takes one: fewer steps than by halves; 8 are slower
COMPARED = 4  #: entries compared in a turn of the loop
#: of lengths of lists: a block of threads waits for its longest walk; with neighbours of one class an H100 blends in
#: three quarters of the time
CLASSES = 64
CLASSES_AN_OCTAVE = 6  #: so all lists of 1,500 entries and more are of one class
MERGE_THREADS = 2**16  #: that share the entries of lists beyond the longest run: as many as fill a large device


def segment_ids(segment_ends: UInt32 | UInt64, slot: UInt32 | UInt64, count: int) -> UInt32:
    """Which of `count` segments each slot [P] belongs to, where segment i has those from segment_ends[i - 1] to
    segment_ends[i]; `count` for slots of no segment."""
    number, wide = type(segment_ends), type(segment_ends)(slot)
    segment, step = ad.UInt32(0), 1
    while WAYS * step <= count:
        step *= WAYS
    while step:
        past = ad.UInt32(0)
        for probe in (segment + way * step for way in range(1, WAYS)):
            within = probe <= count
            reached = within & (dr.gather(number, segment_ends, probe - 1, within) <= wide)
            past += dr.select(reached, ad.UInt32(1), 0)
        segment += past * step
        step //= WAYS
    return segment


def ordered_lists(
    members: UInt32,
    keys: UInt32,
    numbers: UInt32,
    lists: int,
    capacity: int,
    sizes: tuple[int, ...] | None = None,
) -> tuple[UInt32, UInt32, UInt32, UInt32, UInt32]:
    """Entries [P] = [capacity] in lists, each ordered by key, then number: (number, entry) [P] one list after another,
    where each list starts and ends, [lists], and all lists by classes of length, the longest first, those of a class in
    any order. Entries whose list is `lists` are in none; what stands behind the last list has no meaning. UInt32 all;
    no two entries of a list may have one key and number. Not differentiable.

    sizes: of the runs that are made one from another, by default `SIZES`, `SIZES_OF_LONG` for lists that may be long
    """
    if sizes is None:
        sizes = SIZES_OF_LONG if capacity > ROOM * lists else SIZES
    lengths = dr.zeros(ad.UInt32, lists)
    place = cast(UInt32, dr.scatter_inc(lengths, members, members < lists))
    dr.eval(place, lengths, members, numbers, keys)
    end = dr.prefix_reduce(dr.ReduceOp.Add, lengths, exclusive=False)
    start = end - lengths
    counts, class_ = dr.zeros(ad.UInt32, CLASSES), _class_of(lengths)
    rank = cast(UInt32, dr.scatter_inc(counts, class_))
    dr.eval(start, end, rank, class_, counts)
    by_length = dr.empty(ad.UInt32, lists)
    dr.scatter(by_length, dr.arange(ad.UInt32, lists), _count_longer(counts, class_) + rank)
    dr.eval(by_length)

    entry = dr.arange(ad.UInt32, capacity)
    listed = members < lists
    place += dr.gather(ad.UInt32, start, members, listed)
    entries = _packed(_joined(keys, numbers), _joined(members, entry), place, listed, capacity)
    dr.eval(entries)

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
    number, source = dr.empty(ad.UInt32, capacity), dr.empty(ad.UInt32, capacity)
    dr.scatter(number, dr.select(live, ad.UInt32(own[0]), 0), place)
    dr.scatter(source, dr.select(live, ad.UInt32(own[1]), 0), place)
    some_long = dr.zeros(ad.UInt32, 1)
    dr.scatter(some_long, ad.UInt32(1), ad.UInt32(0), is_long)
    dr.eval(number, source, in_runs, some_long)
    _merge_runs((number, source), in_runs, some_long, start, end, sizes[-1])
    return number, source, start, end, by_length


def _class_of(lengths: UInt32) -> UInt32:
    """Of lengths [N], shorter ones first, 0 of no entries."""
    return dr.minimum(ad.UInt32(CLASSES_AN_OCTAVE * dr.log2(ad.Float(lengths + 1))), CLASSES - 1)


def _count_longer(counts: UInt32, class_: UInt32) -> UInt32:
    """How many lists are of longer classes, [N]. counts: lists of each class"""

    def has_more(longer: UInt32, _sum: UInt32) -> Bool:
        return longer < CLASSES

    def add(longer: UInt32, total: UInt32) -> tuple[UInt32, UInt32]:
        return longer + 1, total + dr.gather(ad.UInt32, counts, longer)

    return dr.while_loop((class_ + 1, ad.UInt32(0)), has_more, add, mode="symbolic", label="longer lists")[1]


def _start_of_run(entry: UInt32, first: UInt32, size: int) -> UInt32:
    """Where the run of `size` entries begins that an entry of the list from `first` is in."""
    return first + ((entry - first) & ~ad.UInt32(size - 1))


def _merge_runs(
    targets: tuple[UInt32, UInt32], entries: UInt64, some_long: UInt32, start: UInt32, end: UInt32, run_size: int
) -> None:
    """Write numbers and sources of the lists longer than a run, whose runs are in order, in the order of the whole
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
        for value, target in zip(own, targets, strict=True):
            dr.scatter(target, ad.UInt32(value), first + (entry - run) + others, is_long)
        return (entry + MERGE_THREADS,)

    dr.while_loop((dr.arange(ad.UInt32, MERGE_THREADS),), remaining, merge, mode="symbolic", label="merge runs")
    dr.eval(targets)


def _joined(high: UInt32, low: UInt32) -> UInt64:
    """Both in one number."""
    return (ad.UInt64(high) << 32) | ad.UInt64(low)


def _packed(key: UInt64, source: UInt64, index: UInt32, active: Bool | bool, size: int) -> UInt64:
    """A flat array [2 size] in which an entry's two numbers stand at its index, see `_own`; and some more behind it,
    so that a turn of `_count_before` may read beyond the end."""
    target = dr.empty(ad.UInt64, 2 * (size + COMPARED))
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
