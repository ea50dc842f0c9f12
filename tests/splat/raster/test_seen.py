"""Which splats a picture shows."""

import numpy as np
import pytest
from splats import random_splats

from spacesim.backend import ad
from spacesim.backend.upload import upload
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera
from spacesim.splat.raster.blend import forward
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.lists.bin import bin_splats
from spacesim.splat.raster.lists.tiles import TileLists, round_capacity
from spacesim.splat.raster.project import Pinhole, Splats, project
from spacesim.splat.raster.seen import shown_splats

SIZE = 33, 25  #: pixels, not of whole tiles
CAMERA = Pinhole.of(Camera(look_at([0, -3, 1], [0, 0, 0]), *SIZE, 30, 30, 16, 12))


def weights(count: int) -> tuple[Splats, TileLists, np.ndarray]:
    """Splats, their lists, and what each weighs at most in a pixel."""
    gaussians = Gaussians.from_numpy({**random_splats(count, seed=count), "logit_opacities": np.full(count, 3.0)})
    projected, footprints = project(gaussians, CAMERA, False)
    lists = bin_splats(projected, footprints, *SIZE)
    planes = [upload(row) for row in np.eye(count)]
    most = [np.array(weights).max() for weights in forward(projected, planes, lists, *SIZE).features]
    return projected, lists, np.array(most)


@pytest.mark.parametrize("least", [0.01, 0.1, 0.5])
@pytest.mark.parametrize("ordered", [False, True])
def test_what_weighs_more_in_some_pixel_is_shown(least, ordered):
    for count in (40, 75):
        splats, lists, most = weights(count)
        order = np.arange(round_capacity(count))
        if ordered:
            order[:count] = np.random.default_rng(count).permutation(count)
        shown = shown_splats(splats, lists, SIZE, least, upload(order, ad.UInt32) if ordered else None)
        total = int(shown.count[0])
        found = np.array(shown.numbers)[:total]
        np.testing.assert_array_equal(found, [number for number in order[:count] if most[number] > least])
        assert 0 < total < count
        assert np.abs(most - least).min() > 1e-5, "none is undecided"
        places = np.array(shown.places)[:count]
        np.testing.assert_array_equal(places[found], np.arange(total))
        assert (np.delete(places, found) >= total).all()


def test_what_weighs_nothing_is_not_shown():
    """But what finishes a pixel is, which is not blended."""
    splats, lists, most = weights(300)
    shown = shown_splats(splats, lists, SIZE, 0.0)
    found = np.array(shown.numbers)[: int(shown.count[0])]
    assert set(np.flatnonzero(most > 0)) <= set(found)
    assert len(found) < (most > 0).sum() + 0.1 * (most == 0).sum()
    assert (most == 0).sum() > 50
