"""Which splats a picture shows."""

import numpy as np
import pytest
from splats import random_splats

from spacesim.backend.upload import upload
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera
from spacesim.splat.raster.blend import forward
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.lists.bin import bin_splats
from spacesim.splat.raster.project import Pinhole, project
from spacesim.splat.raster.seen import shown_splats

SIZE = 33, 25  #: pixels, not of whole tiles
CAMERA = Pinhole.of(Camera(look_at([0, -3, 1], [0, 0, 0]), *SIZE, 30, 30, 16, 12))


@pytest.mark.parametrize("least", [0.01, 0.1, 0.5])
def test_what_weighs_more_in_some_pixel_is_shown(least):
    for count in (40, 75):
        gaussians = Gaussians.from_numpy({**random_splats(count, seed=count), "logit_opacities": np.full(count, 3.0)})
        projected, footprints = project(gaussians, CAMERA, False)
        lists = bin_splats(projected, footprints, *SIZE)
        planes = [upload(row) for row in np.eye(count)]
        most = np.array([np.array(weights).max() for weights in forward(projected, planes, lists, *SIZE).features])
        shown = shown_splats(projected, lists, SIZE, least)
        total = int(shown.count[0])
        found = np.array(shown.numbers)[:total]
        np.testing.assert_array_equal(found, np.flatnonzero(most > least))
        assert 0 < total < count
        assert np.abs(most - least).min() > 1e-5, "none is undecided"
        places = np.array(shown.places)[:count]
        np.testing.assert_array_equal(places[found], np.arange(total))
        assert (np.delete(places, found) >= total).all()
