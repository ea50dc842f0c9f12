"""The light camera: axes for every Sun, bounds against the float64 reference, strays, degenerate and hostile sets."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from splats import random_splats

from spacesim.backend import recorded, recordings
from spacesim.data.errors import InputError
from spacesim.data.geometry import direction_from_angles, fibonacci_sphere
from spacesim.splat.light.padded_batch import PaddedBatch
from spacesim.splat.light.shadow.light_camera import MARGIN, REACH, fit_camera, light_axes, light_rows, towards_sun
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.reference.shadow_mapping import camera_record, reference_bounds

AXES = [*np.eye(3), *-np.eye(3)]


@pytest.mark.parametrize("sun", [*AXES, [1, 2, 3], [1e-9, 0, -1], [-1e-4, 1e-4, -1], [0, 1e-300, -1]], ids=str)
def test_axes_are_a_rotation_that_looks_along_the_light(sun):
    axes = light_axes(sun)
    assert np.abs(axes.T @ axes - np.eye(3)).max() < 1e-14
    assert np.linalg.det(axes) == pytest.approx(1, abs=1e-14)
    assert axes[:, 2] == pytest.approx(-np.asarray(sun) / np.linalg.norm(sun), abs=1e-15)


def test_axes_turn_by_the_shortest_way_from_the_sun_overhead():
    overhead = np.diag([1.0, -1.0, -1.0])
    assert light_axes([0, 0, 1]) == pytest.approx(overhead)
    for sun in fibonacci_sphere(50):
        turn = Rotation.from_matrix(light_axes(sun) @ overhead.T)
        assert turn.magnitude() == pytest.approx(np.arccos(sun[2]), abs=1e-7)


def test_axes_are_continuous_save_for_the_sun_straight_below():
    for sun in fibonacci_sphere(200):
        near = sun + 1e-7 * np.array([1.0, -2.0, 0.5])
        bound = 1e-6 * 4 / (1 + sun[2] + 1e-9)  # the frame spins faster towards -z
        assert np.abs(light_axes(near) - light_axes(sun)).max() < bound


@pytest.mark.parametrize("sun", [[0, 0, 0], [np.nan, 0, 1], [0, 1], [[0, 0.6, 0.8]]])
def test_no_direction_is_one_sentence(sun):
    for function in (light_axes, light_rows):
        with pytest.raises(InputError, match="sun direction: expected 3 finite numbers"):
            function(sun)


@pytest.mark.parametrize("crop", [True, False])
@pytest.mark.parametrize("sun", [[0.3, -0.5, 0.8], [0, 0, -1], [0, 1, 0]], ids=str)
def test_the_image_holds_the_supports(sun, crop):
    arrays = random_splats(60, seed=3)
    arrays["means"][7] = [5, -6, 7]
    camera = camera_record(fit_camera(Gaussians.from_numpy(arrays), light_rows(sun), 64, crop))
    axes = light_axes(sun)
    expected = reference_bounds(arrays, axes, REACH if crop else np.inf)
    assert crop == (np.ptp(expected) < 0.9 * np.ptp(reference_bounds(arrays, axes, np.inf)))
    origin = camera.world_from_camera[:3, 3] @ axes[:, :2]
    pixels = np.array([[camera.scale_x], [camera.scale_y]]) * (expected - origin[:, None]) + [[camera.cx], [camera.cy]]
    assert pixels == pytest.approx(np.array([[MARGIN, 64 - MARGIN]] * 2), abs=1e-3)
    assert camera.world_from_camera[:3, 3] == pytest.approx(arrays["means"].mean(axis=0), abs=1e-6)
    assert camera.world_from_camera[:3, :3] == pytest.approx(axes, abs=1e-6)


@pytest.mark.parametrize("drawn", [True, False])
@pytest.mark.parametrize("distance", [1e3, 1e5])
def test_the_first_gaussian_may_be_a_stray(distance, drawn):
    """No place among the Gaussians is special: the image is as the float64 reference has it."""
    arrays = random_splats(500, seed=6)
    arrays["means"][0] = [0.6 * distance, 0.8 * distance, 0]
    if not drawn:
        arrays["logit_opacities"][0] = -9.0
    kept = arrays if drawn else {name: values[1:] for name, values in arrays.items()}
    camera = camera_record(fit_camera(Gaussians.from_numpy(arrays), light_rows([0.3, -0.5, 0.8]), 64))
    expected = np.ptp(reference_bounds(kept, light_axes([0.3, -0.5, 0.8]), REACH), axis=1)
    found = (64 - 2 * MARGIN) / np.array([camera.scale_x, camera.scale_y])
    assert found == pytest.approx(expected, rel=1e-4 if drawn else 1e-6)


@pytest.mark.parametrize("distance", [1e2, 1e4])
def test_the_image_is_as_large_far_from_the_origin(distance):
    arrays = random_splats(300, seed=7)
    near = camera_record(fit_camera(Gaussians.from_numpy(arrays), light_rows([0.3, -0.5, 0.8]), 64))
    arrays["means"] += np.float32([distance, -distance, distance])
    far = camera_record(fit_camera(Gaussians.from_numpy(arrays), light_rows([0.3, -0.5, 0.8]), 64))
    rounding = 1e-6 * distance
    assert [far.scale_x, far.scale_y] == pytest.approx([near.scale_x, near.scale_y], rel=1e-4 + rounding)


def test_a_stray_costs_no_resolution():
    arrays = random_splats(2000, seed=4)
    alone = camera_record(fit_camera(Gaussians.from_numpy(arrays), light_rows([0, 0, 1]), 64))
    arrays["means"][7] = [50, 0, 0]
    stray = camera_record(fit_camera(Gaussians.from_numpy(arrays), light_rows([0, 0, 1]), 64))
    assert stray.scale_x > 0.2 * alone.scale_x  # the bounds alone would give 0.05
    assert stray.scale_y == pytest.approx(alone.scale_y, rel=0.05)
    expected = reference_bounds(arrays, light_axes([0, 0, 1]), REACH)
    assert (64 - 2 * MARGIN) / np.ptp(expected[0]) == pytest.approx(stray.scale_x, rel=1e-4)


@pytest.mark.parametrize(
    "spoil",
    [{"means": np.nan}, {"means": np.inf}, {"log_scales": 90.0}, {"quaternions": 0.0}, {"logit_opacities": -9.0}],
    ids=str,
)
def test_what_cannot_be_drawn_does_not_count(spoil):
    arrays = random_splats(40, seed=5)
    fewer = {name: values[1:] for name, values in arrays.items()}
    for name, value in spoil.items():
        arrays[name][0] = value
    fitted, expected = (
        np.array(fit_camera(Gaussians.from_numpy(some), light_rows([1, 0, 1]), 32).values) for some in (arrays, fewer)
    )
    assert fitted == pytest.approx(expected, rel=1e-4, abs=1e-4)


def test_degenerate_sets_have_sensible_cameras():
    one = random_splats(1)
    line = {**random_splats(9), "means": np.linspace([0, 0, 0], [0, 0, 9], 9), "log_scales": np.full((9, 3), -50.0)}
    none = {**random_splats(2), "means": np.full((2, 3), np.nan)}
    empty = {name: values[:0] for name, values in one.items()}
    for arrays in (one, line, none, empty):
        for sun in AXES:
            camera = camera_record(fit_camera(Gaussians.from_numpy(arrays), light_rows(sun), 16))
            extent = np.array([16 / camera.scale_x, 16 / camera.scale_y])
            assert np.all((extent >= 1e-6) & (extent < 12)), extent
            assert extent.max() / extent.min() < 1.01e3
    camera = camera_record(fit_camera(Gaussians.from_numpy(none), light_rows([0, 0, 1]), 16))
    assert 14 / camera.scale_x == pytest.approx(1)


def test_another_sun_replays_the_recording():
    def fit(rows, light, batch):
        return fit_camera(Gaussians.from_rows(rows), light, 32, batch=batch)

    gaussians = Gaussians.from_numpy(random_splats(64))
    replay, before = recorded(fit, limit=8), recordings()
    for sun in ([0, 0, 1], [1, 0, 0], [-1, -1, 0.2]):
        again = replay(gaussians.rows(), light_rows(sun), PaddedBatch.of(64))
        alone = fit_camera(gaussians, light_rows(sun), 32)
        assert np.array_equal(np.array(again.values), np.array(alone.values))
        assert (again.width, again.height) == (32, 32)
    for count in (100, 1023):  # of the same capacity
        others = Gaussians.from_numpy(random_splats(count))
        again = replay(others.rows(), light_rows([0, 1, 1]), PaddedBatch.of(count))
        alone = fit_camera(others, light_rows([0, 1, 1]), 32)
        assert np.array_equal(np.array(again.values), np.array(alone.values))
    assert recordings() == before + 1


def test_sun_of_the_rows():
    assert np.array(towards_sun(light_rows([3, 0, 4]))).ravel() == pytest.approx([0.6, 0, 0.8])


def test_a_tiny_image_is_refused():
    with pytest.raises(ValueError, match="size: expected at least 4 pixels, found 2"):
        fit_camera(Gaussians.from_numpy(random_splats(3)), light_rows([0, 0, 1]), 2)


@pytest.mark.parametrize("elevation", [90.0, -90.0])
def test_azimuth_of_a_vertical_sun_says_nothing(elevation):
    first, second = (light_axes(direction_from_angles(azimuth, elevation)) for azimuth in (0.0, 37.0))
    np.testing.assert_allclose(first, second, atol=1e-15)
