"""Rotations, cameras and directions against hand values and independent formulas."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from spacesim.data.errors import InputError
from spacesim.data.geometry import (
    OPENCV_FROM_MITSUBA,
    OPENCV_FROM_OPENGL,
    angles_from_direction,
    direction_from_angles,
    fibonacci_sphere,
    look_at,
    normalize,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from spacesim.data.records import Camera, Sun


def test_angles_by_hand():
    half = np.sqrt(0.5)
    cases = {(0, 0): (1, 0, 0), (90, 0): (0, 1, 0), (180, 0): (-1, 0, 0), (0, 90): (0, 0, 1)}
    cases |= {(270, -45): (0, -half, -half), (45, 0): (half, half, 0)}
    for angles, direction in cases.items():
        np.testing.assert_allclose(direction_from_angles(*angles), direction, atol=1e-15)
        np.testing.assert_allclose(Sun.from_angles(*angles).direction, direction, atol=1e-15)


@pytest.mark.parametrize("angles", [(40, 125), (40, -90.1), (40, np.nan), (np.inf, 3), (None, 3), ([1, 2], 3)])
def test_impossible_angles_of_the_sun_are_refused(angles):
    with pytest.raises(InputError, match=r"^sun: expected a finite azimuth and an elevation from -90 to 90 degrees"):
        Sun.from_angles(*angles)


def test_any_finite_azimuth_is_one_of_the_sun():
    np.testing.assert_allclose(Sun.from_angles(-680, 90).direction, [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(Sun.from_angles(-680, 25).direction, Sun.from_angles(40, 25).direction, atol=1e-12)


def test_angles_round_trip():
    for direction in fibonacci_sphere(50, seed=3):
        azimuth, elevation = angles_from_direction(direction)
        assert 0 <= azimuth < 360
        assert -90 <= elevation <= 90
        np.testing.assert_allclose(direction_from_angles(azimuth, elevation), direction, atol=1e-12)
    assert angles_from_direction([1.0, -1e-30, 0.0])[0] == 0.0


def test_look_at_puts_the_target_on_the_axis_and_up_above():
    origin, target = np.array([3.0, -2.0, 1.0]), np.array([0.5, 0.25, -0.5])
    pose = look_at(origin, target)
    camera_from_world = np.linalg.inv(pose)
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    seen = camera_from_world @ [*target, 1]
    np.testing.assert_allclose(seen, [0, 0, np.linalg.norm(target - origin), 1], atol=1e-12)
    above = camera_from_world @ [*(target + np.array([0, 0, 0.1])), 1]
    assert above[1] < 0  # y points down: what is higher has a smaller row
    assert above[0] == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("direction", [(0, 0, 1), (0, 0, -1), (0, 1e-5, 1)])
def test_look_at_along_up(direction):
    pose = look_at(4 * normalize(np.array(direction, float)), np.zeros(3))
    assert np.isfinite(pose).all()
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(pose[:3, 2], -normalize(np.array(direction, float)), atol=1e-12)


def test_look_at_from_the_target_is_refused():
    with pytest.raises(ValueError, match="non-zero"):
        look_at([1, 2, 3], [1, 2, 3])


def test_quaternions_against_scipy_and_back():
    quaternions = np.random.default_rng(0).normal(size=(40, 4))
    matrices = rotation_from_quaternion(quaternions)
    expected = Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix()  # scipy: x, y, z, w
    np.testing.assert_allclose(matrices, expected, atol=1e-12)
    for quaternion, matrix in zip(quaternions, matrices, strict=True):
        unit = quaternion / np.linalg.norm(quaternion) * np.sign(quaternion[0])
        np.testing.assert_allclose(quaternion_from_rotation(matrix), unit, atol=1e-9)


def test_quaternions_of_half_turns():
    for axis in np.eye(3):
        matrix = 2 * np.outer(axis, axis) - np.eye(3)
        np.testing.assert_allclose(rotation_from_quaternion(quaternion_from_rotation(matrix)), matrix, atol=1e-9)


def test_axes_by_hand():
    right, up, forward = np.array([1, 0, 0, 0]), np.array([0, 1, 0, 0]), np.array([0, 0, -1, 0])  # OpenGL
    np.testing.assert_array_equal(OPENCV_FROM_OPENGL @ right, [1, 0, 0, 0])
    np.testing.assert_array_equal(OPENCV_FROM_OPENGL @ up, [0, -1, 0, 0])
    np.testing.assert_array_equal(OPENCV_FROM_OPENGL @ forward, [0, 0, 1, 0])
    np.testing.assert_array_equal(OPENCV_FROM_MITSUBA @ [1, 0, 0, 0], [-1, 0, 0, 0])  # Mitsuba: x left, y up
    np.testing.assert_array_equal(OPENCV_FROM_MITSUBA @ [0, 1, 0, 0], [0, -1, 0, 0])
    np.testing.assert_array_equal(OPENCV_FROM_MITSUBA @ [0, 0, 1, 0], [0, 0, 1, 0])


def test_opengl_pose_of_a_camera_is_that_of_blender():
    # Blender's camera at (0, -5, 0) that looks at the origin: 90 degrees about x.
    expected = [[1, 0, 0, 0], [0, 0, -1, -5], [0, 1, 0, 0], [0, 0, 0, 1]]
    camera = Camera.from_fov(look_at([0, -5, 0], [0, 0, 0]), 100, 80, 90.0)
    np.testing.assert_allclose(camera.opengl, expected, atol=1e-12)
    assert (camera.fx, camera.cx, camera.cy) == pytest.approx((50, 50, 40))
    np.testing.assert_allclose(camera.camera_from_world, np.linalg.inv(camera.world_from_camera), atol=1e-12)


def test_a_downscaled_camera_sees_what_its_pixels_saw():
    camera = Camera(look_at((0, -4, 0), (0, 0, 0)), 11, 9, 14.0, 15.0, 4.5, 5.0)
    seen = camera.downscaled(4)
    assert (seen.width, seen.height) == (2, 2)  # 3 columns and a row fill no square
    assert (seen.fx, seen.fy, seen.cx, seen.cy) == (14 / 4, 15 / 4, 4.5 / 4, 5 / 4)
    np.testing.assert_array_equal(seen.world_from_camera, camera.world_from_camera)
    assert camera.downscaled(1) is camera


@pytest.mark.parametrize("count", [50, 400])
def test_fibonacci_directions_are_even(count):
    for seed in (None, 7):
        points = fibonacci_sphere(count, seed)
        np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1, atol=1e-12)
        assert np.linalg.norm(points.mean(axis=0)) < 2 / count
        nearest = cKDTree(points).query(points, k=2)[0][:, 1]
        assert nearest.min() > 0.7 * np.sqrt(4 * np.pi / count)  # a square of that side for each
        second_moments = points.T @ points / count
        np.testing.assert_allclose(second_moments, np.eye(3) / 3, atol=3 / count)


def test_fibonacci_seeds():
    np.testing.assert_array_equal(fibonacci_sphere(9, 1), fibonacci_sphere(9, 1))
    assert np.abs(fibonacci_sphere(9, 1) - fibonacci_sphere(9, 2)).max() > 0.1
    assert fibonacci_sphere(0).shape == (0, 3)


@pytest.mark.parametrize(
    "change",
    [
        {"world_from_camera": np.full((4, 4), np.nan)},
        {"world_from_camera": np.diag([2.0, 2, 2, 1])},
        {"world_from_camera": np.diag([1.0, 1, -1, 1])},
        {"width": 0},
        {"fx": 0.0},
        {"fy": float("inf")},
        {"cx": float("nan")},
    ],
)
def test_impossible_cameras_are_refused(change):
    camera = {
        "world_from_camera": np.eye(4),
        "width": 4,
        "height": 4,
        "fx": 5.0,
        "fy": 5.0,
        "cx": 2.0,
        "cy": 2.0,
    }
    Camera(**camera)
    with pytest.raises(InputError):
        Camera(**{**camera, **change})


@pytest.mark.parametrize("direction", [(0, 0, 0), (1, 2), (np.nan, 0, 1), "40,25", None, [1, [2]]])
def test_impossible_suns_are_refused(direction):
    with pytest.raises(InputError, match="sun direction"):
        Sun(direction)
