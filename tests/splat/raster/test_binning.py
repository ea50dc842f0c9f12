"""Lists of tiles: both ways of ordering them against numpy, and against each other."""

import dataclasses

import drjit as dr
import numpy as np
import pytest
from splats import random_splats

from spacesim.backend import ad, recorded, recordings, select
from spacesim.backend.kernels.llvm import is_usable
from spacesim.backend.readback import AsyncNumber
from spacesim.backend.upload import held, upload
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.lists import bin as binning
from spacesim.splat.raster.lists import boxes, counting, tiles
from spacesim.splat.raster.lists.capacity import Extent
from spacesim.splat.raster.lists.sort import empty_entries, entry_of, list_bounds, ordered_entries, segment_ids
from spacesim.splat.raster.lists.tiles import TileLists
from spacesim.splat.raster.project import Footprints, Pinhole, Splats, project

pytestmark = pytest.mark.threads
WAYS = ("cuda", "llvm", "llvm-drjit")  # the last without kernels of text


@pytest.fixture(params=WAYS)
def way(request, monkeypatch):
    """Each backend's way of ordering lists, and its tiles, on the backend that runs."""
    use(request.param, monkeypatch)


def use(name, monkeypatch):
    backend = name.split("-")[0]
    if backend == "llvm" and select() == "cuda":
        pytest.skip("Dr.Jit cannot replay its sort on CUDA")
    for module in (binning, tiles):
        monkeypatch.setattr(module, "select", lambda: backend)
    monkeypatch.setattr(binning, "is_usable", is_usable if name == "llvm" else lambda: False)


def projected(count: int, width: int, height: int, seed: int = 0) -> tuple[Splats, Footprints]:
    view = Camera.from_fov(look_at([2.5, 0.8, 0.6], [0.0, 0.0, 0.0]), width, height, 40)
    splats, footprints = project(Gaussians.from_numpy(random_splats(count, seed, degree=0)), Pinhole.of(view))
    dr.eval(splats, footprints)
    return splats, footprints


def listed(lists: tiles.TileLists) -> list[list[int]]:
    splat, start, end = np.array(lists.splat), np.array(lists.start), np.array(lists.end)
    return [splat[s:e].tolist() for s, e in zip(start, end, strict=True)]


def expected(splats: Splats, footprints: Footprints, width: int, height: int, shape: tiles.TileShape):
    """Of each tile, who reaches one of its pixels for certain, and who may do so by its box; in order."""
    x, y, a, b, c, opacity = (np.array(getattr(splats, n), np.float64) for n in ("x", "y", "a", "b", "c", "opacity"))
    box = np.array(footprints.half_width, np.float64), np.array(footprints.half_height, np.float64)
    order = np.lexsort((np.arange(len(x)), np.array(footprints.order)))
    order = order[np.array(footprints.visible)[order]]
    certain, possible = [], []
    for top in range(0, height, shape.height):
        for left in range(0, width, shape.width):
            px, py = np.meshgrid(left + np.arange(shape.width) + 0.5, top + np.arange(shape.height) + 0.5)
            dx, dy = px.ravel() - x[order, None], py.ravel() - y[order, None]
            power = -0.5 * (a[order, None] * dx**2 + 2 * b[order, None] * dx * dy + c[order, None] * dy**2)
            reaches = (opacity[order, None] * np.exp(power) > 1.01 / 255).any(axis=1)
            near = (x[order] + box[0][order] >= left) & (x[order] - box[0][order] <= left + shape.width)
            near &= (y[order] + box[1][order] >= top) & (y[order] - box[1][order] <= top + shape.height)
            certain.append(order[reaches].tolist())
            possible.append(order[near].tolist())
    return certain, possible


@pytest.mark.parametrize(("count", "size"), [(1, (16, 8)), (40, (50, 30)), (700, (90, 61)), (3000, (16, 8))])
def test_tiles_list_who_reaches_them_in_order(way, count, size):
    splats, footprints = projected(count, *size)
    lists = binning.bin_splats(splats, footprints, *size)
    certain, possible = expected(splats, footprints, *size, lists.shape)
    ours = listed(lists)
    assert sum(map(len, certain)) > 0
    for own, inner, outer in zip(ours, certain, possible, strict=True):
        assert set(inner) <= set(own)
        assert own == [splat for splat in outer if splat in set(own)]
    assert lists.pairs == sum(map(len, ours))


def test_slots_are_the_splats_own(way):
    """Each listed pair has a slot of its own among its splat's."""
    splats, footprints = projected(900, 70, 50)
    lists = binning.bin_splats(splats, footprints, 70, 50)
    start, end = np.array(lists.start), np.array(lists.end)
    entries = np.concatenate([np.arange(s, e) for s, e in zip(start, end, strict=True)])
    slots = np.array(lists.slot) if lists.place is None else np.argsort(np.array(lists.place)).astype(np.uint32)
    splat, slot = np.array(lists.splat)[entries], slots[entries]
    first, count = np.array(lists.first_slot)[splat], np.array(lists.slot_count)[splat]
    assert (slot >= first).all()
    assert (slot < first + count).all()
    assert len(np.unique(slot)) == len(slot)
    assert slot.max() < lists.capacity
    kept = np.array(lists.sum_index(upload(entries.astype(np.uint32), ad.UInt32)))
    np.testing.assert_array_equal(np.array(lists.sum_of_slot(upload(slot, ad.UInt32))), kept)
    assert len(np.unique(kept)) == len(kept)


@pytest.mark.parametrize(("count", "size"), [(2000, (64, 64)), (500, (33, 90)), (9000, (8, 8))])
def test_both_ways_list_the_same(count, size, monkeypatch):
    splats, footprints = projected(count, *size)
    monkeypatch.setattr(boxes, "tile_shape", lambda *_: tiles.TileShape(16, 8, 16))
    found = []
    for name in WAYS:
        use(name, monkeypatch)
        found.append(listed(binning.bin_splats(splats, footprints, *size)))
    assert found[0] == found[1] == found[2]
    assert sum(map(len, found[0])) > count / 2


def test_needles_are_listed_wherever_they_are_drawn(way):
    """Half a pixel thin, thousands long, aslant: the terms of their form cancel, what is left is mostly rounding."""
    width, height, long, count = 500, 350, 3000.0, 20
    rng = np.random.default_rng(1)
    turn, off = rng.uniform(0.3, 1.2, count), long * rng.uniform(-1.5, 1.5, count)
    x = rng.uniform(0, width, count) + off * np.cos(turn)
    y = rng.uniform(0, height, count) + off * np.sin(turn)
    xx, yy = (long * np.cos(turn)) ** 2 + 0.3, (long * np.sin(turn)) ** 2 + 0.3
    xy, determinant = long**2 * np.sin(turn) * np.cos(turn), 0.3 * (long**2 + 0.3)
    opacity, one = np.full(count, 0.99), np.ones(count)
    conic = yy / determinant, -xy / determinant, xx / determinant
    splats = Splats(*(upload(values.astype(np.float32)) for values in (x, y, *conic, opacity, one)))
    reach = 2 * np.log(255 * opacity)
    halves = (upload(np.sqrt(reach * half).astype(np.float32)) for half in (xx, yy))
    visible, order = upload(one.astype(bool), ad.Bool), upload(np.arange(count, dtype=np.uint32), ad.UInt32)
    footprints = Footprints(*halves, visible, order)
    lists = binning.bin_splats(splats, footprints, width, height)
    certain, _ = expected(splats, footprints, width, height, lists.shape)
    assert sum(map(len, certain)) > 300
    assert all(set(wanted) <= set(found) for wanted, found in zip(certain, listed(lists), strict=True))


@pytest.mark.parametrize("many", [0, 250, 700])
def test_splats_of_many_tiles_are_listed_as_others(many, monkeypatch):
    """After the others, by more threads each: all, most, and few of them; more pairs than threads, too."""
    size = 480, 340
    splats, footprints = projected(60, *size)
    found = []
    for name in WAYS:
        use(name, monkeypatch)
        monkeypatch.setattr(boxes, "tile_shape", lambda *_: tiles.TileShape(8, 8, 32))
        monkeypatch.setattr(counting, "MANY", many)
        for function in ("count_boxes", "count_lists"):
            monkeypatch.setattr(binning, function, getattr(counting, function).traced)
        found.append(listed(binning.bin_splats(splats, footprints, *size)))
        counts = np.array(binning.make_boxes(splats, footprints, held(60, "splats"), 1024, boxes.Grid.of(*size)).count)
    assert found[0] == found[1]
    assert (counts > many).sum() > 5
    assert (counts[counts > 0] <= many).sum() > 5 or not many
    assert counts.max() > 1024


def test_equal_depths_are_in_index_order(way):
    """What shadow splatting relies on: of two events at one depth the first comes first."""
    splats, footprints = projected(600, 48, 48)
    footprints.order = upload(np.random.default_rng(0).integers(3, 6, 600).astype(np.uint32), ad.UInt32)
    order = np.array(footprints.order)
    lists = listed(binning.bin_splats(splats, footprints, 48, 48))
    assert max(map(len, lists)) > 30
    for own in lists:
        assert own == sorted(own, key=lambda splat: (order[splat], splat))


def test_recordings_serve_other_numbers_of_splats_and_pairs(way):
    """Larger, smaller, and as many as an array can hold, all twice; the second time nothing is recorded."""
    counts = [1000, 1023, 1024, 40, 1, 961, 2048, 2047]
    found = {}
    for count in counts:
        splats, footprints = projected(count, 64, 40, seed=count)
        lists = binning.bin_splats(splats, footprints, 64, 40)
        certain, possible = expected(splats, footprints, 64, 40, lists.shape)
        found[count] = listed(lists)
        for own, inner, outer in zip(found[count], certain, possible, strict=True):
            assert set(inner) <= set(own)
            assert own == [splat for splat in outer if splat in set(own)]
    before = recordings()
    for count in counts:
        assert listed(binning.bin_splats(*projected(count, 64, 40, seed=count), 64, 40)) == found[count]
    assert recordings() == before


def test_no_visible_splats_give_empty_lists(way):
    splats, footprints = projected(50, 32, 32)
    hidden = dataclasses.replace(footprints, visible=dr.opaque(ad.Bool, False, 50))
    lists = binning.bin_splats(splats, hidden, 32, 32)
    assert lists.pairs == 0
    assert lists.capacity == 0


@pytest.mark.parametrize("spare", [0, 1, 5000])
def test_lists_made_without_a_wait_are_the_same_where_they_fit(way, spare):
    """And empty where they do not; the capacity may be exact or much too large."""
    splats, footprints = projected(900, 70, 50)
    extent, known = Extent(900, 70, 50), binning.bin_splats(splats, footprints, 70, 50)

    def made(hidden: bool, capacity: int) -> tuple[int, TileLists]:
        """(how many pairs there are, lists with room for so many)."""
        shown = footprints if not hidden else dataclasses.replace(footprints, visible=dr.opaque(ad.Bool, False, 900))
        boxes = binning.make_boxes(splats, shown, extent.live, extent.most, extent.grid)
        return AsyncNumber(boxes.pair_ends).wait(), binning.lists_of_boxes(shown, boxes, extent, capacity)

    pairs, _ = made(False, 1)
    found, lists = made(False, pairs + spare)
    assert found == pairs > sum(map(len, listed(lists))) > 900
    assert listed(lists) == listed(known)
    np.testing.assert_array_equal(np.array(lists.slot_count), np.array(known.slot_count))
    for less in (1, pairs // 2, pairs - 1):
        found, lists = made(False, less)
        assert found == pairs
        assert sum(map(len, listed(lists))) == np.array(lists.slot_count).sum() == 0
    found, lists = made(True, pairs)
    assert found == sum(map(len, listed(lists))) == 0


def assert_longest_first(order: np.ndarray, lengths) -> None:
    """Each list once, and none before one that is longer by a class; all of 1,448 and more are of one class."""
    np.testing.assert_array_equal(np.sort(order), np.arange(len(lengths)))
    longest_first = np.minimum(np.array(lengths), 1447)[order] + 1.0
    assert (longest_first[1:] <= longest_first[:-1] * 2 ** (1 / 6) + 1e-3).all()


def in_lists(members, keys, numbers, lists: int, sizes=None):
    """(numbers, sources, bounds) of entries, arrays UInt32 [P], in their lists; those of list `lists` are in none."""
    size, listed = dr.width(members), members < lists
    lengths = dr.zeros(ad.UInt32, lists)
    dr.scatter_add(lengths, ad.UInt32(1), members, listed)
    bounds = list_bounds(lengths, ad.UInt32, dr.opaque(ad.UInt32, size))
    entries, place = empty_entries(size), dr.scatter_inc(bounds.cursor, members, listed)
    dr.scatter(entries, entry_of(keys, numbers, members, dr.arange(ad.UInt32, size)), place, listed)
    dr.eval(entries)
    return *ordered_entries(entries, bounds, size, sizes=sizes), bounds


def test_thousands_of_lists_are_named_longest_first():
    """More than a block of threads has; by a recording that is replayed for other lengths."""
    bounds_of = recorded(lambda *arrays: in_lists(*arrays, 4000)[2])
    for seed in range(3):
        lengths = np.random.default_rng(seed).choice([0, 0, 1, 7, 40, 150], 4000)[: 4000 - seed]
        members = np.repeat(np.arange(len(lengths)), lengths)[:60000]
        lengths = np.bincount(members, minlength=4000)
        members = np.concatenate([members, np.full(65536 - len(members), 4000)])
        numbers = np.arange(65536)
        arrays = (upload(values.astype(np.uint32), ad.UInt32) for values in (members, numbers % 5, numbers))
        bounds = bounds_of(*arrays)
        np.testing.assert_array_equal(np.array(bounds.end) - np.array(bounds.start), lengths)
        assert_longest_first(np.array(bounds.order), lengths)


@pytest.mark.parametrize("sizes", [(4, 16), (4, 4096), (64, 4096), (8, 8), (4, 8, 32, 128), (2, 4, 8, 4096), None])
@pytest.mark.parametrize(
    "lengths", [[1], [0, 5, 0], [300, 0, 17, 1, 64], [16, 4, 15, 17, 3], [1500, 3, 2000], [0, 0, 1]]
)
def test_lists_of_any_length_are_ordered(lengths, sizes):
    """Against numpy's sort; lists longer than a run, as long, and shorter; many equal keys."""
    rng = np.random.default_rng(sum(lengths))
    members = np.repeat(np.arange(len(lengths)), lengths)
    members = np.concatenate([members, np.full(37, len(lengths))])  # in no list
    rng.shuffle(members)
    size = len(members)
    keys, numbers = rng.integers(0, 9, size), rng.permutation(size)
    arrays = (upload(values.astype(np.uint32), ad.UInt32) for values in (members, keys, numbers))
    number, source, bounds = in_lists(*arrays, len(lengths), sizes)
    number, source, start, end = (np.array(values) for values in (number, source, bounds.start, bounds.end))
    np.testing.assert_array_equal(end - start, lengths)
    assert_longest_first(np.array(bounds.order), lengths)
    for i, (s, e) in enumerate(zip(start, end, strict=True)):
        mine = np.flatnonzero(members == i)
        wanted = mine[np.lexsort((numbers[mine], keys[mine]))]
        np.testing.assert_array_equal(source[s:e], wanted)
        np.testing.assert_array_equal(number[s:e], numbers[wanted])


@pytest.mark.parametrize("number", ["UInt32", "UInt64"])
@pytest.mark.parametrize("segments", [1, 3, 4, 5, 7, 15, 16, 17, 64, 300, 1023])
def test_segment_ids_of_slots(number, segments):
    counts = np.random.default_rng(segments).choice([0, 0, 1, 3, 5, 90], segments)
    ends = upload(np.cumsum(counts).astype(number.lower()), getattr(ad, number))
    found = np.array(segment_ids(ends, dr.arange(ad.UInt32, int(counts.sum()) + 2), segments))
    np.testing.assert_array_equal(found, [*np.repeat(np.arange(segments), counts), segments, segments])


def test_quotients_of_floats_are_those_of_integers():
    """Also of multiples and their neighbours, where floats round to the next."""
    rng = np.random.default_rng(0)
    by = rng.integers(1, 4097, 200_000)
    number = np.minimum(rng.integers(0, 4096, by.size) * by + rng.integers(-1, 2, by.size), 2**24 - 1)
    by, number = np.append(by, [1, 2**12, 3]), np.append(np.maximum(number, 0), [2**24 - 1] * 3)
    down, across = boxes.divided(upload(number.astype(np.uint32), ad.UInt32), upload(by.astype(np.float32), ad.Float))
    np.testing.assert_array_equal(np.array(down), number // by)
    np.testing.assert_array_equal(np.array(across), number % by)


def test_quotients_of_large_numbers_are_those_of_integers():
    """Of rows of millions, too."""
    rng = np.random.default_rng(0)
    by = rng.integers(2**11, 2**31, 200_000)
    quotient = rng.integers(0, np.minimum(2**21, (2**32 - 1) // by))
    number = np.clip(quotient * by + rng.integers(-1, 2, by.size), 0, 2**32 - 1)
    down, rest = boxes.divided(*(upload(values.astype(np.uint32), ad.UInt32) for values in (number, by)))
    np.testing.assert_array_equal(np.array(down), number // by)
    np.testing.assert_array_equal(np.array(rest), number % by)


def test_pairs_are_numbered_in_few_bits_where_they_fit(way):
    """In any case where all splats could reach all tiles."""
    splats, footprints = projected(900, 70, 50)
    for size, number in ((70, 50), ad.UInt32), ((16384, 16384), ad.UInt64):
        grid = binning.Grid.of(*size)
        boxes = binning.make_boxes(splats, footprints, dr.opaque(ad.UInt32, 900), tiles.round_capacity(900), grid)
        assert type(boxes.pair_ends) is number
        assert boxes.pairs > 900


@pytest.mark.parametrize(
    "lengths",
    [
        [3],
        [0, 5, 2],
        [7] * 70,
        list(range(300)),
        list(range(1024)),
        [5000, 3000, 2047, 1, 0] * 40,
        [n * n // 2048 for n in range(1024)],
    ],
)
def test_tiles_are_dealt_longest_first(lengths):
    """Each tile once; those that share a packet have lists of about one length; runs of tiles have long and short."""
    lengths = np.random.default_rng(0).permutation(lengths)
    grid, ends = boxes.Grid(len(lengths), 1, tiles.TileShape(8, 8, 4, 2)), np.cumsum(lengths)
    start, end = (upload(bounds.astype(np.uint32), ad.UInt32) for bounds in (ends - lengths, ends))
    order = np.array(binning._longest_first.traced(start, end, grid))
    assert sorted(order.tolist()) == list(range(len(lengths)))
    dealt = np.minimum(lengths, binning.MAX_SORTED_LENGTH)[order]
    ranks = np.sort(np.minimum(lengths, binning.MAX_SORTED_LENGTH))[::-1]
    packets = dealt[: len(dealt) // 4 * 4].reshape(-1, 4)
    assert sorted(map(tuple, packets)) == sorted(map(tuple, ranks[: len(dealt) // 4 * 4].reshape(-1, 4)))
    if len(lengths) >= 300:
        quarters = [part.sum() for part in np.array_split(dealt, 4)]
        assert max(quarters) < (1.2 if len(lengths) == 300 else 1.06) * min(quarters)
