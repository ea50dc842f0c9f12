"""Poses against 4x4 matrices and scipy's rotations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera
from spacesim.splat.compose.pose import (
    MAX_COORDINATE,
    MAX_SCALE,
    MIN_SCALE,
    Pose,
    interpolate_pose,
    interpolate_rotation,
    rotation_about,
    slerp,
)


def random_pose(seed: int) -> Pose:
    rng = np.random.default_rng(seed)
    return Pose(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3), float(np.exp(rng.normal())))


@pytest.mark.parametrize("seed", range(4))
def test_poses_are_matrices(seed):
    one, other = random_pose(seed), random_pose(seed + 10)
    np.testing.assert_allclose(one.after(other).matrix, one.matrix @ other.matrix, atol=1e-12)
    np.testing.assert_allclose(one.inverse().matrix, np.linalg.inv(one.matrix), atol=1e-12)
    points = np.random.default_rng(seed).normal(size=(5, 3))
    np.testing.assert_allclose(one.points(points), (one.matrix @ np.c_[points, np.ones(5)].T).T[:, :3], atol=1e-12)
    np.testing.assert_allclose(Pose(one.quaternion).rotation, one.rotation, atol=1e-12)
    np.testing.assert_allclose(Pose(-3 * one.quaternion).rotation, one.rotation, atol=1e-12)


def test_a_camera_in_the_model_sees_the_same_pixels():
    pose, camera = random_pose(1), Camera(look_at([4, 5, 6], [0, 0, 1]), 64, 48, 70, 60, 30, 25)
    points = np.random.default_rng(0).normal(size=(20, 3))

    def pixels(camera, points):
        x, y, z = camera.camera_from_world[:3, :3] @ points.T + camera.camera_from_world[:3, 3:]
        return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, z

    world, model = pixels(camera, pose.points(points)), pixels(pose.camera_in_model(camera), points)
    np.testing.assert_allclose(world[:2], model[:2], atol=1e-9)
    np.testing.assert_allclose(world[2], pose.scale * model[2], atol=1e-9)


def test_a_model_seen_from_another_may_be_beyond_the_bounds_of_poses():
    small, far = Pose(scale=MIN_SCALE), Pose(translation=np.array([0, 0, MAX_COORDINATE]), scale=MAX_SCALE)
    seen = small.inverse().after(far)
    np.testing.assert_allclose(seen.translation, [0, 0, MAX_COORDINATE / MIN_SCALE])
    assert seen.scale == pytest.approx(MAX_SCALE / MIN_SCALE)
    for outside in (
        {"scale": MIN_SCALE / 2},
        {"scale": 2 * MAX_SCALE},
        {"translation": np.full(3, 2 * MAX_COORDINATE)},
    ):
        with pytest.raises(InputError):
            Pose(**outside)


def test_no_pose_changes_no_bit():
    camera = Camera(look_at([1.1, 2.3, 0.7], [0.3, 0.2, 0.1]), 64, 48, 70, 60, 30, 25)
    assert np.array_equal(Pose().camera_in_model(camera).world_from_camera, camera.world_from_camera)
    direction = np.random.default_rng(0).normal(size=3)
    assert np.array_equal(Pose().direction_in_model(direction), direction)
    assert np.array_equal(Pose().quaternion, [1, 0, 0, 0])


@pytest.mark.parametrize("share", [0.0, 0.3, 0.5, 0.9, 1.0])
def test_between_two_poses(share):
    one, other = random_pose(3), random_pose(4)
    found = interpolate_pose(one, other, share)
    expected = Slerp([0, 1], Rotation.from_matrix([one.rotation, other.rotation]))(share)
    np.testing.assert_allclose(found.rotation, expected.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(found.translation, (1 - share) * one.translation + share * other.translation)
    assert np.log(found.scale) == pytest.approx((1 - share) * np.log(one.scale) + share * np.log(other.scale))
    if share in (0.0, 1.0):
        assert np.array_equal(
            interpolate_rotation(one.rotation, other.rotation, share), (one, other)[int(share)].rotation
        )


def test_great_circles():
    np.testing.assert_allclose(slerp([1, 0, 0], [0, 1, 0], 1 / 3), [np.cos(np.pi / 6), 0.5, 0], atol=1e-12)
    half = slerp([0, 0, 1.0], [0, 0, -1.0], 0.5)  # some way round, but half of it
    assert np.linalg.norm(half) == pytest.approx(1)
    assert half[2] == pytest.approx(0, abs=1e-12)
    assert np.array_equal(slerp([0, 1.0, 0], [0, 1.0, 0], 0.7), [0, 1, 0])


def test_rotation_about_an_axis():
    expected = Rotation.from_rotvec(np.radians(37) * np.array([1, 2, -2]) / 3).as_matrix()
    np.testing.assert_allclose(rotation_about([10, 20, -20], 37), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"rotation": np.zeros((3, 3))}, "rotation"),
        ({"rotation": np.diag([1.0, 1, -1])}, "rotation"),
        ({"rotation": [0, 0, 0, 0]}, "rotation_wxyz"),
        ({"rotation": [np.nan, 0, 0, 0]}, "rotation"),
        ({"rotation": "left"}, "rotation"),
        ({"translation": [0, 0]}, "position"),
        ({"translation": [0, np.inf, 0]}, "position"),
        ({"translation": [0, 1e12, 0]}, "position"),
        ({"scale": 0.0}, "scale"),
        ({"scale": -1.0}, "scale"),
        ({"scale": float("nan")}, "scale"),
    ],
)
def test_what_is_no_pose_is_refused(arguments, named):
    with pytest.raises(InputError, match=named):
        Pose(**arguments)


def test_an_axis_needs_a_direction():
    with pytest.raises(InputError, match="axis"):
        rotation_about([0, 0, 0], 10)


def test_a_rounded_rotation_is_the_nearest_one():
    exact = Rotation.from_rotvec([0.3, -1.1, 0.6]).as_matrix()
    for decimals, off in ((3, 1e-3), (9, 1e-8)):
        pose = Pose(exact.round(decimals))
        np.testing.assert_allclose(pose.rotation, exact, atol=off)
        np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-14 if decimals == 3 else 1e-8)
    for wrong in (exact.round(1), -exact, np.diag([1.0, 1.0, 1.01])):
        with pytest.raises(InputError, match="expected a rotation matrix"):
            Pose(wrong)
