"""Pictures whose lists the host does not wait for are those that it waits for, to the bit."""

import drjit as dr
import numpy as np
import pytest
from splats import random_splats

from spacesim.backend import ad
from spacesim.backend.readback import can_read_async
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera
from spacesim.splat.raster import bin as binning
from spacesim.splat.raster import picture_lists
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.picture_lists import Kind, computed, expected_capacity, observe
from spacesim.splat.raster.project import Footprints, Pinhole, Splats, project
from spacesim.splat.raster.render import render

KIND = Kind(2048, 64, 48)


@pytest.fixture(autouse=True)
def on_any_backend(monkeypatch):
    assert can_read_async()
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


def test_pictures_near_and_far_and_of_nothing(monkeypatch):
    """Longer lists than the last picture's, shorter ones, none."""
    gaussians = Gaussians.from_numpy(random_splats(1500, 0, degree=1))
    views = [camera(3), camera(3.01), camera(1.2), away(), away(), camera(9), camera(1.2), camera(1.2)]
    expected, given = [], []
    monkeypatch.setattr("spacesim.splat.raster.render.expected_capacity", lambda kind: None)
    for view in views:
        expected.append(drawn(gaussians, view))
    picture_lists._capacities.clear()

    def spy(kind: Kind) -> int | None:
        given.append(expected_capacity(kind))
        return given[-1]

    monkeypatch.setattr("spacesim.splat.raster.render.expected_capacity", spy)
    for view, pictures in zip(views, expected, strict=True):
        for found, wanted in zip(drawn(gaussians, view), pictures, strict=True):
            np.testing.assert_array_equal(found, wanted)
    assert [capacity is None for capacity in given] == [True, False, False, False, True, True, False, False]
    assert given[2] < given[7]  # the first near picture did not fit
    assert len(np.unique(expected[0][1])) > 100


def test_what_is_computed_with_lists_is_computed_again_where_they_do_not_fit():
    gaussians = Gaussians.from_numpy(random_splats(1500, 0, degree=0))
    calls = []

    def pairs_of(distance: float) -> int:
        splats, footprints = project(gaussians, camera(distance))

        def compute(make_lists: binning.MakeLists) -> int:
            calls.append(distance)
            return make_lists(splats, footprints, 64, 48).pairs

        return computed(compute)

    found = [pairs_of(distance) for distance in (3, 3, 1.2, 1.2, 3)]
    assert calls == [3, 3, 1.2, 1.2, 1.2, 3]
    for distance, pairs in zip((3, 3, 1.2, 1.2, 3), found, strict=True):
        assert pairs == binning.bin_splats(*project(gaussians, camera(distance)), 64, 48).pairs > 1500
    nothing = dr.zeros(ad.Float, 0)
    none = Splats(*[nothing] * 7), Footprints(nothing, nothing, dr.zeros(ad.Bool, 0), dr.zeros(ad.UInt32, 0))
    assert computed(lambda make_lists: make_lists(*none, 64, 48).pairs) == 0


def test_a_capacity_is_kept_while_it_is_enough_and_not_much_too_large():
    capacity = observe(KIND, 100_000)
    assert expected_capacity(KIND) == capacity > 100_000
    assert observe(KIND, 80_000) < capacity
    assert expected_capacity(KIND) == capacity
    less = observe(KIND, 40_000)
    assert expected_capacity(KIND) == less < capacity
    assert expected_capacity(Kind(2048, 64, 50)) is None
    observe(KIND, 0)
    assert expected_capacity(KIND) is None
    assert observe(KIND, picture_lists.LONG) > 0
    assert expected_capacity(KIND) is None
    for i in range(3 * picture_lists.KINDS):
        observe(Kind(1024, i, 1), 5)
    assert len(picture_lists._capacities) == picture_lists.KINDS


def test_a_capacity_that_finds_no_place_is_not_expected(monkeypatch):
    observe(KIND, 100_000)
    monkeypatch.setattr(picture_lists, "check_memory", refuse)
    assert expected_capacity(KIND) is None


def refuse(*_: object, **__: object) -> None:
    raise picture_lists.WorkError("no memory")


def test_a_backend_whose_host_computes_waits(monkeypatch):
    observe(KIND, 100_000)
    monkeypatch.setattr(picture_lists, "BACKENDS", ())
    assert expected_capacity(KIND) is None
