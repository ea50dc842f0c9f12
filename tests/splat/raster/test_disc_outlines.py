"""How far flat discs are from where rays meet them."""

import numpy as np
import pytest
from disc_outlines import SPREAD, axes_of, displacements
from scipy.spatial.transform import Rotation

from spacesim.data.geometry import look_at
from spacesim.data.records import Camera


def view() -> Camera:
    return Camera.from_fov(look_at([4.0, 0.0, 0.0], [0.0, 0.0, 0.0]), 300, 200, 40)


def disc(normal, radius=0.1, centre=(0.1, 0.2, 0.1)):
    """(centre, axes) [1, ...] of one."""
    turned = Rotation.align_vectors([normal], [[1.0, 0.0, 0.0]])[0].as_quat(scalar_first=True)
    return np.array([centre]), axes_of(turned[None], np.array([[1e-6, radius, radius]]))


def test_a_disc_that_faces_the_picture_does_not_move():
    means, axes = disc([1.0, 0.0, 0.0])
    np.testing.assert_allclose(axes[0] @ [1.0, 0.0, 0.0], 0, atol=1e-9)
    assert displacements(means, axes, view()) == pytest.approx([0.0], abs=1e-9)


def test_a_tilted_disc_moves_by_perspective():
    """Its near half is larger and its far half smaller, by extent over distance: 2 sigma (2 sigma sin / z) cos px."""
    tilt, camera = np.radians(40), view()
    means, axes = disc([np.cos(tilt), np.sin(tilt), 0.0], centre=(0.0, 0.0, 0.0))
    extent = SPREAD * 0.1
    expected = camera.fx / 4 * extent * np.cos(tilt) * extent * np.sin(tilt) / 4
    assert displacements(means, axes, camera) == pytest.approx([expected], rel=0.1)


def test_only_discs_in_the_picture_count():
    means, axes = disc([1.0, 0.0, 0.0])
    outside = np.array([[0.0, 9.0, 0.0], [9.0, 0.0, 0.0], *means])
    assert len(displacements(outside, np.repeat(axes, 3, axis=0), view())) == 1
