"""Pairs of rows in few arrays: against numpy, in every layout; what they take; recordings that outlive a new count."""

import drjit as dr
import numpy as np
import pytest

from spacesim.backend import ad, recorded, recordings, select
from spacesim.backend.upload import upload
from spacesim.splat.train.optimizer import packing
from spacesim.splat.train.optimizer.adam import Adam
from spacesim.splat.train.optimizer.packing import (
    PLAIN,
    PackedArray,
    load,
    pack_numpy,
    plan_packing,
    store,
    unpack_numpy,
    zeros,
)

MAX_PACKET = {"cuda": 4, "llvm": 8}  #: packets
LAYOUTS = [(15, 16_400), (15, 17_500), (15, 19_000), (15, 22_000), (14, 17_500), (11, 1030), (9, 1024), (3, 1)]


@pytest.fixture(autouse=True, params=list(MAX_PACKET))
def way(request, monkeypatch) -> str:
    """Each backend's packets, on the backend that runs."""
    if request.param != select():
        if select() == "cuda":
            pytest.skip("CUDA reads no more than four numbers at once")
        monkeypatch.setattr(packing, "select", lambda: request.param)
    return request.param


def rows(pairs: int, count: int, seed: int = 0) -> tuple[list[np.ndarray], list[np.ndarray]]:
    one, two = np.random.default_rng(seed).normal(size=(2, pairs, count)).astype(np.float32)
    return list(one), list(two)


def numbers(found: tuple[list, list]) -> np.ndarray:
    return np.array([[np.array(row) for row in half] for half in found])


@pytest.mark.parametrize(("pairs", "count"), LAYOUTS)
def test_rows_come_back_in_every_order(pairs, count):
    layout, given = plan_packing(pairs, count), rows(pairs, count)
    assert layout == PLAIN or sum(pack.pairs for pack in layout) == pairs
    index = np.random.default_rng(1).integers(0, count, 2 * count + 7).astype(np.uint32)
    by_numpy = pack_numpy(*given, layout)
    by_drjit = store([upload(row) for row in given[0]], [upload(row) for row in given[1]], layout)
    dr.eval(by_drjit)
    for arrays in (by_numpy, by_drjit):
        assert [dr.width(array) for array in arrays] == ([pack.size for pack in layout] or [count] * (2 * pairs))
        np.testing.assert_array_equal(numbers(unpack_numpy(arrays, layout, count)), given)
        np.testing.assert_array_equal(
            numbers(load(arrays, layout, upload(index, ad.UInt32))), np.array(given)[:, :, index]
        )
    nothing = zeros(layout, pairs, count)
    assert [dr.width(array) for array in nothing] == [dr.width(array) for array in by_drjit]
    assert not any(np.array(array).any() for array in nothing)


def test_no_two_numbers_share_a_place():
    for pairs in (1, 3, 11, 14, 15):
        for count in (1, 3, 1025, 2048, 16_385, 17_480, 18_730, 21_850):
            for pack in plan_packing(pairs, count):
                assert pack.capacity >= count
                places = [
                    (first + np.arange(pack.capacity)) * size + part
                    for size, first in pack.packets()
                    for part in range(size)
                ]
                assert len(places) == 2 * pack.pairs
                taken = np.bincount(np.concatenate(places))
                assert taken.max() == 1
                assert taken.sum() == 2 * pack.pairs * pack.capacity <= pack.size


def test_packets_are_of_the_sizes_that_the_backend_reads_at_once(way):
    assert max(size for size, _ in PackedArray(15, 2**15).packets()) == MAX_PACKET[way]


def allocated(numbers: int) -> int:
    """Bytes that Dr.Jit takes for an array."""
    return 2 ** int(np.ceil(np.log2(4 * numbers)))


def bytes_of(pairs: int, count: int) -> int:
    """That the moments of so many rows take."""
    layout = plan_packing(pairs, count)
    return 2 * pairs * allocated(count) if layout == PLAIN else sum(4 * pack.size for pack in layout)


def test_moments_fill_what_is_allocated_for_them():
    """118 rows take as much as 118 arrays just below a power of two, and little more than their numbers above one."""
    worst = {}
    for count in range(20_000, 200_000, 151):
        optimizer_bytes = sum(bytes_of(pairs, count) for pairs in (14, 15, 15, 15))
        plain = 118 * allocated(count)
        assert optimizer_bytes <= plain
        fraction = 2.0 ** (np.log2(count) % 1)
        key = "first third" if fraction < 4 / 3 else "rest"
        worst[key] = max(worst.get(key, 0), optimizer_bytes / (118 * 4 * count))
    assert worst["first third"] < 1.2
    assert worst["rest"] < 1.51


def test_few_gaussians_have_one_layout_up_to_each_power_of_two():
    assert len({plan_packing(15, count) for count in [*range(2**13 + 1, 2**14, 61), 2**14]}) == 1
    assert len({plan_packing(15, count) for count in [*range(2**14 + 1, 2**15, 61), 2**15]}) == 4


def test_rows_stay_as_they_are_on_a_cpu_where_packets_take_as_much(way):
    for count in (1, 1024, 2**14, 22_000, 30_000, 2**15, 120_000):
        assert (plan_packing(15, count) == PLAIN) == (way == "llvm")
    for count in (2**14 + 1, 20_000, 80_000):
        assert plan_packing(15, count) != PLAIN


def test_adam_holds_what_its_layouts_say():
    for count, packed in ((18_000, 2**15 * (16 + 3 * 18)), (24_000, 2**15 * 118)):
        optimizer = Adam([dr.opaque(ad.Float, 0, count) for _ in range(59)])
        assert [rows.stop for rows in optimizer.slices] == [14, 29, 44, 59]
        plain = all(layout == PLAIN for layout in optimizer.layouts)
        first, second = rows(59, count)
        optimizer.put(first, second)
        np.testing.assert_array_equal(numbers(optimizer.moments()), (first, second))
        optimizer.forget(10)
        first[10][:], second[10][:] = 0, 0
        np.testing.assert_array_equal(numbers(optimizer.moments()), (first, second))
        held = sum(dr.width(array) for part in optimizer.arrays for array in part)
        assert held == (118 * count if plain else packed)


def test_a_recording_serves_every_count_of_a_layout():
    def doubled(row, arrays, layout):
        one, two = load(arrays, layout, dr.arange(ad.UInt32, dr.width(row)))
        found = store([2 * value + row for value in one], [2 * value - row for value in two], layout)
        dr.eval(found)
        return found

    run, made = recorded(doubled, limit=8), []
    for count in (16_400, 17_400, 17_000):
        layout, given = plan_packing(15, count), rows(15, count, count)
        assert layout == plan_packing(15, 16_385)
        found = run(upload(given[0][0]), pack_numpy(*given, layout), layout)
        expected = np.array(
            [[2 * row + sign * given[0][0] for row in half] for half, sign in zip(given, (1, -1), strict=True)]
        )
        np.testing.assert_allclose(numbers(unpack_numpy(found, layout, count)), expected, rtol=1e-6, atol=1e-6)
        made.append(recordings())
    assert made[1:] == made[:1] * 2
