"""Pictures whose lists the host does not wait for are those that it waits for, to the bit."""

import itertools
import sys
from concurrent.futures import ThreadPoolExecutor

import drjit as dr
import numpy as np
import pytest
from splats import random_splats, take_cudas

from spacesim.backend import ad, select
from spacesim.backend.readback import can_read_async
from spacesim.data.errors import WorkError
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.lists import bin as binning
from spacesim.splat.raster.lists import capacity
from spacesim.splat.raster.lists import pictures as picture_lists
from spacesim.splat.raster.lists.capacity import Extent, PairCounts, rounded_pairs
from spacesim.splat.raster.lists.pictures import computed, expected_capacity, observe
from spacesim.splat.raster.project import Pinhole, project
from spacesim.splat.raster.render import render

EXTENT = Extent(2000, 64, 48)


@pytest.fixture(autouse=True, params=["cuda", "llvm", "cuda, many pixels"])
def on_any_backend(request, monkeypatch):
    """Each backend's way of making lists, and a large picture's on CUDA, on the backend that runs."""
    assert can_read_async()
    if "many" in request.param:
        monkeypatch.setattr("spacesim.splat.raster.render.MANY_PIXELS", 1)
    if request.param.split(",")[0] != select():
        if select() == "cuda":
            pytest.skip("Dr.Jit cannot replay its sort on CUDA")
        take_cudas(monkeypatch)
    monkeypatch.setattr(picture_lists, "BACKENDS", ("cuda", "llvm"))
    monkeypatch.setattr(picture_lists, "_capacities", {})


def camera(distance: float) -> Pinhole:
    eye = [0.8 * distance, 0.5 * distance, 0.3 * distance]
    return Pinhole.of(Camera.from_fov(look_at(eye, [0.0, 0.0, 0.0]), 64, 48, 40))


def away() -> Pinhole:
    """Of nothing."""
    return Pinhole.of(Camera.from_fov(look_at([3.0, 0.0, 0.0], [9.0, 0.0, 0.0]), 64, 48, 40))


def drawn(gaussians: Gaussians, view: Pinhole) -> list[np.ndarray]:
    output = render(gaussians, view, outputs=("color", "alpha", "depth", "median_depth"))
    return [np.array(value) for value in (output.color, output.alpha, output.depth, output.median_depth)]


@pytest.mark.parametrize("count", [1500, 1501, 1024, 2])
def test_as_many_splats_as_before_and_others(count, monkeypatch):
    """Of a recording that serves other numbers, too; twice, so that the second is expected."""
    gaussians = Gaussians.from_numpy(random_splats(count, count, degree=1))
    found = [drawn(gaussians, camera(3)) for _ in range(2)]
    monkeypatch.setattr(picture_lists, "BACKENDS", ())
    for name, *planes in zip(("color", "alpha", "depth", "median"), *found, drawn(gaussians, camera(3)), strict=True):
        np.testing.assert_array_equal(planes[0], planes[2], err_msg=name)
        np.testing.assert_array_equal(planes[1], planes[2], err_msg=name)


def test_features_that_are_one_array_or_a_gaussians_own():
    """Or one number for all; as if each were an array of its own."""
    gaussians = Gaussians.from_numpy(random_splats(700, 5, degree=0))
    x = ad.Float(gaussians.means.x)
    lists = [x, x, gaussians.means.y, gaussians.log_scales.x, x, ad.Float(2)]
    apart = [ad.Float(np.array(one + dr.zeros(ad.Float, 700)).tolist()) for one in lists]
    for _ in range(2):
        found, wanted = (render(gaussians, camera(3), features=features).features for features in (lists, apart))
        for one, other in zip(found, wanted, strict=True):
            np.testing.assert_array_equal(np.array(one), np.array(other))


def test_pictures_near_and_far_and_of_nothing(monkeypatch):
    """Longer lists than the last picture's, shorter ones, none."""
    gaussians = Gaussians.from_numpy(random_splats(1500, 0, degree=1))
    views = [camera(3), camera(3.01), camera(1.2), away(), away(), camera(9), camera(1.2), camera(1.2)]
    expected, given = [], []
    monkeypatch.setattr("spacesim.splat.raster.render.expected_capacity", lambda extent: None)
    for view in views:
        expected.append(drawn(gaussians, view))
    picture_lists._capacities.clear()

    def spy(extent: Extent) -> int | None:
        given.append(expected_capacity(extent))
        return given[-1]

    monkeypatch.setattr("spacesim.splat.raster.render.expected_capacity", spy)
    for view, pictures in zip(views, expected, strict=True):
        for found, wanted in zip(drawn(gaussians, view), pictures, strict=True):
            np.testing.assert_array_equal(found, wanted)
    assert [one is None for one in given] == [True, False, False, False, True, True, False, False]
    assert given[2] < given[7]  # the first near picture did not fit
    assert len(np.unique(expected[0][1])) > 100


def test_what_is_computed_with_lists_is_computed_again_where_they_do_not_fit():
    gaussians = Gaussians.from_numpy(random_splats(1500, 0, degree=0))
    calls = []

    def pairs_of(distance: float) -> int:
        splats, footprints = project(gaussians, camera(distance))
        extent = Extent(1500, 64, 48)

        def compute(pairs: PairCounts) -> int:
            calls.append(distance)
            boxes = binning.make_boxes(splats, footprints, extent.live, extent.most, extent.grid)
            expected = pairs.expected(extent)
            if expected is not None:
                pairs.check(extent, boxes.pair_ends, expected)
            enough = pairs.counted(extent, boxes) if expected is None else expected
            return binning.lists_of_boxes(footprints, boxes, extent, enough).pairs

        return computed(compute)

    found = [pairs_of(distance) for distance in (3, 3, 1.2, 1.2, 3)]
    assert calls == [3, 3, 1.2, 1.2, 1.2, 3]
    for distance, pairs in zip((3, 3, 1.2, 1.2, 3), found, strict=True):
        assert pairs == binning.bin_splats(*project(gaussians, camera(distance)), 64, 48).pairs > 1500
    assert computed(lambda pairs: pairs.expected(Extent(0, 64, 48))) is None


def seen(extent: Extent, pairs: int) -> int | None:
    observe(extent, pairs)
    return expected_capacity(extent)


def test_a_capacity_is_kept_while_it_is_enough_and_not_much_too_large():
    kept = seen(EXTENT, 100_000)
    assert kept == rounded_pairs(100_000, few_sizes=False) > 100_000
    assert seen(EXTENT, 80_000) == kept
    assert seen(EXTENT, 40_000) == rounded_pairs(40_000, few_sizes=False) < kept
    assert expected_capacity(Extent(2000, 64, 50)) is None
    assert seen(EXTENT, 0) is None
    assert seen(EXTENT, picture_lists.LONG) is None
    used = Extent(1000, 10**6, 1)
    for i in range(3 * picture_lists.KINDS):
        observe(Extent(1000, i, 1), 5)
        observe(used, 5)
    assert len(picture_lists._capacities) == picture_lists.KINDS
    assert expected_capacity(used) is not None


def test_threads_observe_pictures_of_many_kinds():
    """More kinds than are kept."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as pool:
            extents = [Extent(1000, 1 + i % 150, 1) for i in range(8000)]
            assert len(list(pool.map(seen, extents, itertools.repeat(5)))) == 8000
    finally:
        sys.setswitchinterval(before)
    assert len(picture_lists._capacities) == picture_lists.KINDS


def test_a_capacity_that_finds_no_place_is_not_expected(monkeypatch):
    observe(EXTENT, 100_000)
    monkeypatch.setattr(capacity, "check_memory", refuse)
    assert expected_capacity(EXTENT) is None
    observe(EXTENT, 120_000)  # what is drawn already needs no place


def refuse(*_: object, **__: object) -> None:
    raise WorkError("no memory")


def test_a_backend_whose_host_computes_waits(monkeypatch):
    observe(EXTENT, 100_000)
    monkeypatch.setattr(picture_lists, "BACKENDS", ())
    assert expected_capacity(EXTENT) is None


def test_extents_of_equal_numbers_are_not_mixed_up():
    assert isinstance(Extent.of(7, 32.0, 32.0).grid.columns, float)
    assert isinstance(Extent.of(7, 32, 32).grid.columns, int)
    assert Extent.of(7, 32, 32) is Extent.of(7, 32, 32)
