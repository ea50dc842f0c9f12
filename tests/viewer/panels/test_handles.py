"""The Sun that is dragged on its sphere, and cameras to jump to."""

from types import SimpleNamespace

import numpy as np
import pytest

from spacesim.data.geometry import fibonacci_sphere, look_at
from spacesim.data.records import Camera
from spacesim.viewer.client import fov_to_hold
from spacesim.viewer.panels.handles import dataset_cameras, sun_from_drag

CENTRE, RADIUS, EYE = np.array([1.0, 2, 3]), 2.0, np.array([11.0, 2, 3])


@pytest.mark.parametrize("direction", list(fibonacci_sphere(24)), ids=str)
def test_a_handle_that_is_not_moved_stays(direction):
    """The pointer is on the handle: from both sides of the sphere, and from within."""
    for eye in (EYE, CENTRE + 0.3):
        pointer = CENTRE + RADIUS * direction
        assert sun_from_drag(CENTRE, RADIUS, eye, pointer, direction) == pytest.approx(direction, abs=1e-6)


def test_the_handle_follows_the_pointer_on_its_side():
    before = np.array([1.0, 0, 0])  # towards the eye
    pointer = CENTRE + np.array([RADIUS, 0.5, 0])
    moved = sun_from_drag(CENTRE, RADIUS, EYE, pointer, before)
    assert moved[0] > 0.9
    on_ray = np.cross(CENTRE + RADIUS * moved - EYE, pointer - EYE)
    assert np.linalg.norm(on_ray) < 1e-9
    behind = sun_from_drag(CENTRE, RADIUS, EYE, pointer, -before)
    assert behind[0] < -0.9


def test_beyond_the_rim_the_nearest_point_counts():
    moved = sun_from_drag(CENTRE, RADIUS, EYE, CENTRE + np.array([0, 0, 50.0]), np.array([1.0, 0, 0]))
    assert moved == pytest.approx([0.2, 0, np.sqrt(1 - 0.2**2)])  # where a line from the eye touches the sphere
    assert np.linalg.norm(moved) == pytest.approx(1)


@pytest.mark.parametrize("pointer", [EYE, np.full(3, np.nan), np.full(3, np.inf)], ids=("eye", "nan", "inf"))
def test_a_pointer_without_direction_leaves_the_sun(pointer):
    before = np.array([0.0, 1, 0])
    assert sun_from_drag(CENTRE, RADIUS, EYE, pointer, before) is before


def test_spots_are_each_place_once_and_thinned_out():
    def frame(k):
        return SimpleNamespace(camera=Camera.from_fov(look_at([3.0, k, 0], [0.0, 0, 0]), 64, 64, 30.0))

    frames = tuple(frame(k % 10) for k in range(40))
    dataset = SimpleNamespace(frames=frames, train=frames[:5], test=frames[5:])
    found = dataset_cameras(dataset)
    assert [spot.frame for spot in found] == list(range(10))
    assert [spot.test for spot in found] == [False] * 5 + [True] * 5
    assert [spot.frame for spot in dataset_cameras(dataset, 4)] == [0, 2, 5, 7]


@pytest.mark.parametrize("aspect", [0.4, 1.0, 2.5])
def test_a_view_of_a_frame_holds_all_of_it(aspect):
    camera = Camera(np.eye(4), 300, 200, 400.0, 350.0, 140.0, 105.0)
    down = np.tan(0.5 * fov_to_hold(camera, aspect))
    assert down >= 105 / 350 - 1e-12
    assert down * aspect >= 160 / 400 - 1e-12
    assert min(down - 105 / 350, down * aspect - 160 / 400) < 1e-9  # and no more
