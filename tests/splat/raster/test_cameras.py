"""Perspective, orthographic cameras: pictures, gradients against the float64 reference, poses, crops, far and near."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from splats import device_camera, random_splats
from twin import KINDS, columns_of, our_loss, own_features, picture, record, slope, twin_loss, wide_splats

import spacesim as ss
from spacesim.backend import ad
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera
from spacesim.splat.raster.cameras import Orthographic, OrthographicCamera, Pinhole
from spacesim.splat.raster.gaussians import NAMES, Gaussians
from spacesim.splat.raster.project import project
from spacesim.splat.raster.render import render
from spacesim.splat.reference.rasterizer import render_reference


def assert_close(ours: np.ndarray, twin: np.ndarray, name: str) -> None:
    scale = np.abs(twin).max()
    assert scale > 0, name
    np.testing.assert_allclose(ours, twin, rtol=1e-3, atol=2e-4 * scale, err_msg=name)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("count", "size"), [(1, (40, 28)), (60, (40, 28)), (300, (33, 47))])
def test_picture_matches_the_twin(kind, antialiased, count, size):
    arrays, view = random_splats(count, seed=count + 1), record(kind, *size)  # no alpha within rounding of 1/255
    features = own_features(count)
    twin = render_reference(arrays, view, features=features, antialiased=antialiased)
    ours = render(
        Gaussians.from_numpy(arrays),
        device_camera(view),
        outputs=("color", "depth", "normal"),
        features=columns_of(features),
        antialiased=antialiased,
    )
    assert twin.alpha.max() > 0.1
    for name in ("color", "alpha", "features"):
        np.testing.assert_allclose(ours.image(name), getattr(twin, name), atol=1e-5, err_msg=name)
    solid = twin.alpha > 0.05  # below, depth and normal divide by next to nothing
    np.testing.assert_allclose(ours.image("depth")[solid], twin.depth[solid], atol=1e-5)
    steady = solid & (np.abs(twin.normal).max(axis=-1) > 0)
    np.testing.assert_allclose(ours.image("normal")[steady], twin.normal[steady], atol=2e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_splats_beyond_the_border_match_the_twin(kind):
    """Large ones all around a small picture: in perspective, most are linearized at its border."""
    arrays, view = random_splats(40, seed=31, degree=0), record(kind, 36, 20)
    arrays["means"] *= 2.5
    arrays["log_scales"] += 1.2
    twin, ours = render_reference(arrays, view), picture(arrays, device_camera(view), ("color", "alpha"))
    for name, plane in ours.items():
        np.testing.assert_allclose(plane, getattr(twin, name), atol=1e-5, err_msg=name)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_gradients_of_every_parameter_match_central_differences(kind, antialiased):
    arrays, view, features = wide_splats(), record(kind, 16, 12), own_features(5)
    gaussians, channels = Gaussians.from_numpy(arrays), columns_of(features)
    dr.enable_grad(*gaussians.parameters().values(), *channels)
    dr.backward(our_loss(gaussians, device_camera(view), channels, antialiased=antialiased))
    for name in NAMES:
        ours = np.array(dr.grad(getattr(gaussians, name))).T.reshape(arrays[name].shape)

        def loss(values, name=name):
            return twin_loss({**arrays, name: values}, view, features, antialiased=antialiased)

        assert_close(ours, slope(loss, arrays[name]), name)
    ours = np.stack([np.array(dr.grad(channel)) for channel in channels], axis=1)
    twin = slope(lambda values: twin_loss(arrays, view, values, antialiased=antialiased), features)
    assert_close(ours, twin, "features")


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_of_small_orthographic_splats(antialiased):
    """Splats of a pixel or two, which end at their cut: the step is too small to move it across a pixel."""
    arrays, view = random_splats(14, seed=41, degree=1), record("orthographic", 20, 14)
    gaussians = Gaussians.from_numpy(arrays)
    dr.enable_grad(*gaussians.parameters().values())
    output = render(gaussians, device_camera(view), outputs=("color",), antialiased=antialiased)
    weight = np.random.default_rng(5).normal(size=(14, 20, 4))
    planes = [*output.color, output.alpha]
    columns = [upload(weight[..., c].ravel().astype(np.float32)) for c in range(4)]
    dr.backward(sum((dr.sum(w * plane) for w, plane in zip(columns, planes, strict=True)), ad.Float(0)))
    for name in NAMES:

        def loss(values, name=name):
            twin = render_reference({**arrays, name: values}, view, antialiased=antialiased)
            return float((weight[..., :3] * twin.color).sum() + (weight[..., 3] * twin.alpha).sum())

        ours = np.array(dr.grad(getattr(gaussians, name))).T.reshape(arrays[name].shape)
        expected = slope(loss, arrays[name], 1e-7)
        assert np.linalg.norm(ours - expected) < 1e-3 * np.linalg.norm(expected), name


@pytest.mark.parametrize("start", [np.zeros(6), np.array([0.02, -0.3, 0.1, 0.05, -0.1, 0.2])])
@pytest.mark.parametrize("kind", KINDS)
def test_pose_gradients_match_central_differences(kind, start):
    arrays, view, features = wide_splats(), record(kind, 16, 12), own_features(5)
    twist = upload(start.astype(np.float32))
    dr.enable_grad(twist)
    camera = device_camera(view).moved(twist)
    dr.backward(our_loss(Gaussians.from_numpy(arrays), camera, columns_of(features)))

    def loss(values):
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_rotvec(values[:3]).as_matrix()
        motion[:3, 3] = values[3:]
        return twin_loss(
            arrays, replace(view, world_from_camera=view.world_from_camera @ np.linalg.inv(motion)), features
        )

    assert_close(np.array(dr.grad(twist)), slope(loss, start), "twist")


def one_splat(center, sigma: float, opacity_logit: float = 0.0) -> dict[str, np.ndarray]:
    return {
        "means": np.array([center], dtype=float),
        "log_scales": np.full((1, 3), np.log(sigma)),
        "quaternions": np.array([[1.0, 0, 0, 0]]),
        "logit_opacities": np.array([opacity_logit]),
        "sh": np.zeros((1, 1, 3)),
    }


@pytest.mark.parametrize("depth", [-7.0, 0.0, 3.0, 500.0])
def test_orthographic_splat_has_its_size_at_any_depth(depth):
    """A ball of sigma metres is exp(-r^2 / 2 (s^2 sigma^2 + 0.3)) / 2, s pixels per metre, also behind the origin."""
    view = OrthographicCamera(np.eye(4), 48, 32, 20.0, 10.0, 20.0, 14.0)
    found = picture(one_splat([0.4, 0.3, depth], 0.25), Orthographic.of(view))
    columns, rows = np.meshgrid(np.arange(48) + 0.5, np.arange(32) + 0.5)
    squared = (columns - 28) ** 2 / (5.0**2 + 0.3) + (rows - 17) ** 2 / (2.5**2 + 0.3)
    expected = 0.5 * np.exp(-0.5 * squared)
    expected[expected < 1 / 255] = 0
    np.testing.assert_allclose(found["alpha"], expected, atol=1e-5)
    np.testing.assert_allclose(found["depth"], np.where(expected > 0, depth, 0), rtol=1e-5)


def test_orthographic_order_runs_through_the_origin():
    """Splats in a row along the axis, the first behind the camera: the one farthest behind hides the others."""
    depths = np.array([2.0, -3.0, 0.0, -0.5, 1.0, -1e-7, 1e-7])
    arrays = {name: np.repeat(value, 7, axis=0) for name, value in one_splat([0, 0, 0], 5.0, 0.0).items()}
    arrays["means"][:, 2] = depths
    view = OrthographicCamera(np.eye(4), 8, 8, 1.0, 1.0, 4.0, 4.0)
    output = render(Gaussians.from_numpy(arrays), Orthographic.of(view), features=list(np.eye(7, dtype=np.float32)))
    shares = output.image("features")[4, 4]
    np.testing.assert_array_equal(np.argsort(-shares), np.argsort(depths))
    np.testing.assert_allclose(shares[np.argsort(depths)], 0.49 * 0.51 ** np.arange(7), atol=0.02)


def test_perspective_far_away_is_orthographic():
    arrays = random_splats(80, seed=3, degree=0)
    direction = np.array([0.8, -0.5, 0.33])
    far, scale = 4000.0, 20.0
    flat_view = OrthographicCamera(look_at(direction, [0, 0, 0]), 40, 32, scale, scale, 20, 16)
    distance = far * np.linalg.norm(direction)
    view = Camera(look_at(far * direction, [0, 0, 0]), 40, 32, scale * distance, scale * distance, 20, 16)
    near, parallel = picture(arrays, Pinhole.of(view)), picture(arrays, Orthographic.of(flat_view))
    np.testing.assert_allclose(near["alpha"], parallel["alpha"], atol=2e-2)
    assert np.abs(near["alpha"] - parallel["alpha"]).mean() < 1e-3
    assert parallel["alpha"].max() > 0.5


@pytest.mark.parametrize("kind", KINDS)
def test_rigid_motion_of_scene_and_camera_changes_nothing(kind):
    arrays, view = random_splats(100, seed=8, degree=0), record(kind)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = Rotation.from_rotvec([0.4, -1.1, 0.6]).as_matrix(), [0.4, -0.9, 0.2]
    turned = Rotation.from_matrix(motion[:3, :3]) * Rotation.from_quat(arrays["quaternions"][:, [1, 2, 3, 0]])
    moved = {
        **arrays,
        "means": arrays["means"] @ motion[:3, :3].T + motion[:3, 3],
        "quaternions": turned.as_quat()[:, [3, 0, 1, 2]],
    }
    moved_view = replace(view, world_from_camera=motion @ view.world_from_camera)
    first, second = picture(arrays, device_camera(view)), picture(moved, device_camera(moved_view))
    solid = first["alpha"] > 0.01
    for name, plane in first.items():
        np.testing.assert_allclose(plane[solid], second[name][solid], atol=3e-5, err_msg=name)


@pytest.mark.parametrize("kind", KINDS)
def test_crop_is_the_part_of_the_whole_picture(kind):
    arrays, camera = random_splats(3000, seed=12, degree=1), device_camera(record(kind, 150, 110))
    arrays["log_scales"][:20] = -0.5  # wide ones, linearized outside of every crop
    arrays["means"] *= 2.5
    names = ("color", "alpha", "depth", "median_depth", "normal")
    whole = picture(arrays, camera, names)
    for x, y, width, height in ((0, 0, 150, 110), (0, 0, 37, 21), (51, 33, 64, 48), (113, 89, 37, 21), (77, 50, 1, 1)):
        part = picture(arrays, camera.cropped(x, y, width, height), names)
        for name, plane in part.items():
            expected = whole[name][y : y + height, x : x + width]
            tolerance = 2e-5 if name == "normal" else 1e-6  # unit length divides by the blend's own
            np.testing.assert_allclose(plane, expected, atol=tolerance, rtol=1e-6, err_msg=name)
    assert whole["alpha"].mean() > 0.3


def test_crops_of_crops_add_up():
    arrays, camera = random_splats(300, seed=13, degree=0), device_camera(record("perspective", 90, 70))
    once = picture(arrays, camera.cropped(30, 25, 20, 15))
    twice = picture(arrays, camera.cropped(10, 20, 60, 40).cropped(20, 5, 20, 15))
    for name, plane in once.items():
        np.testing.assert_array_equal(plane, twice[name])
    for x, y, width, height in ((-1, 0, 5, 5), (0, 0, 91, 5), (85, 0, 6, 5), (0, 0, 0, 5), (0, 66, 5, 5)):
        with pytest.raises(InputError, match="crop: expected a part of the 90x70 pixels"):
            camera.cropped(x, y, width, height)


@pytest.mark.parametrize("vector", [np.zeros(3), [1e-4, 2e-4, -1e-4], [0.3, -0.2, 0.9], [2.0, -1.5, 1.7]])
@pytest.mark.parametrize("kind", KINDS)
def test_moved_is_the_rigid_motion(kind, vector):
    view = record(kind)
    twist = [*vector, 0.4, -0.2, 0.7]
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = Rotation.from_rotvec(vector).as_matrix(), twist[3:]
    camera = device_camera(view).moved(upload(np.array(twist, dtype=np.float32)))
    expected = (motion @ view.camera_from_world)[:3].ravel()
    np.testing.assert_allclose(np.array(camera.values)[:12], expected, atol=1e-6)
    np.testing.assert_array_equal(np.array(camera.values)[12:], np.array(device_camera(view).values)[12:])


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_of_focal_length_and_principal_point(kind):
    arrays, view, features = wide_splats(), record(kind, 16, 12), own_features(5)
    camera = device_camera(view)
    dr.enable_grad(camera.values)
    dr.backward(our_loss(Gaussians.from_numpy(arrays), camera, columns_of(features)))
    names = ["fx", "fy"] if kind == "perspective" else ["scale_x", "scale_y"]
    names += ["cx", "cy"]

    def loss(values):
        return twin_loss(arrays, replace(view, **dict(zip(names, values, strict=True))), features)

    start = np.array([getattr(view, name) for name in names])
    assert_close(np.array(dr.grad(camera.values))[12:16], slope(loss, start), "intrinsics")


def test_another_camera_compiles_nothing():
    gaussians = Gaussians.from_numpy(random_splats(50))
    for kind in KINDS:
        dr.eval(project(gaussians, device_camera(record(kind))))
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.eval(project(gaussians, device_camera(record(kind, pose=look_at([-1.5, 2.0, 0.9], [0.1, 0.0, 0.0])))))
            kernels = [kernel for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT]
        assert kernels
        assert all(kernel["cache_hit"] for kernel in kernels)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("place", [[1e30, 0, 0], [1e38, 1e38, 1e38], [-1e12, 5.0, 1e12]])
def test_cameras_beyond_reach_show_nothing(kind, place):
    pose = look_at([2.5, 0.8, 0.6], [0, 0, 0])
    pose[:3, 3] = place
    found = picture(random_splats(40), device_camera(record(kind, pose=pose)))
    for plane in found.values():
        assert np.isfinite(plane).all()
        assert not plane.any()


def test_orthographic_camera_says_what_is_wrong():
    good = {"world_from_camera": np.eye(4), "width": 4, "height": 4, "scale_x": 1, "scale_y": 1, "cx": 2, "cy": 2}
    OrthographicCamera(**good)
    for change, message in (
        ({"scale_x": 0.0}, "pixels per metre"),
        ({"scale_y": np.nan}, "pixels per metre"),
        ({"width": 0}, "at least 1x1 pixels"),
        ({"world_from_camera": 2 * np.eye(4)}, "a rotation"),
    ):
        with pytest.raises(InputError, match=message):
            OrthographicCamera(**{**good, **change})
    view = OrthographicCamera.from_extent(np.eye(4), 64, 32, 4.0)
    assert (view.scale_x, view.scale_y, view.cx, view.cy) == (16, 16, 32, 16)


@pytest.mark.parametrize("distance", [3.0, 3e4, 3e6])
def test_order_holds_however_far_the_camera_is(distance):
    """Discs a centimetre apart behind each other; at 3,000 km single precision has a quarter of a metre for a depth."""
    arrays = {name: np.repeat(value, 8, axis=0) for name, value in one_splat([0, 0, 0], 1.0, 0.0).items()}
    arrays["means"][:, 1] = 0.01 * np.array([3, 0, 6, 1, 7, 2, 5, 4])
    focal = 4.0 * distance
    view = Camera(look_at([0, -distance, 0], [0, 0, 0]), 8, 8, focal, focal, 4.0, 4.0)
    output = render(Gaussians.from_numpy(arrays), Pinhole.of(view), features=list(np.eye(8, dtype=np.float32)))
    shares = output.image("features")[4, 4]
    np.testing.assert_array_equal(np.argsort(-shares), np.argsort(arrays["means"][:, 1]))


def test_the_public_render_takes_a_motion_and_a_camera_of_arrays():
    """Along a gradient by the twist the picture changes as it says; a camera of arrays gives the record's picture."""
    model, view = Gaussians.from_numpy(wide_splats()), record("perspective")

    def brightness(twist) -> ad.Float:
        return dr.mean(ss.render(model, view, twist=twist).alpha)

    twist = dr.zeros(ad.Float, 6)
    dr.enable_grad(twist)
    dr.backward(brightness(twist))
    gradient = np.array(dr.grad(twist), np.float64)
    assert np.linalg.norm(gradient) > 1e-3
    step = 1e-2 * gradient / np.linalg.norm(gradient)
    ahead, behind = (float(brightness(upload(sign * step))[0]) for sign in (1, -1))
    np.testing.assert_allclose((ahead - behind) / 2e-2, np.linalg.norm(gradient), rtol=1e-2)
    np.testing.assert_array_equal(
        ss.render(model, Pinhole.of(view)).image("color"), ss.render(model, view).image("color")
    )


def test_a_camera_that_was_read_follows_its_values():
    """Nothing that a projection reads of a camera may outlive it: neither gradients nor changes would arrive."""
    pose = look_at([2.5, 0.8, 0.6], [0.0, 0.0, 0.0])
    camera = Pinhole.of(Camera.from_fov(pose, 24, 16, 40))
    point = ad.Array3f([0.1, 0.2], [0.3, 0.0], [0.2, 0.1])
    gaussians = Gaussians.from_numpy(random_splats(50, 0, degree=0))
    dr.enable_grad(gaussians.means)
    project(gaussians, camera)
    camera.directions_to(point)
    before = float(camera[12][0])
    camera.values += 1
    assert float(camera[12][0]) == before + 1
    dr.enable_grad(camera.values)
    splats, _ = project(gaussians, camera)
    dr.backward(dr.sum(splats.x) + dr.sum(camera.directions_to(point).x))
    gradient = np.array(dr.grad(camera.values))
    assert np.all(gradient[[12, 14]] != 0)
    assert np.all(gradient[:4] != 0)
