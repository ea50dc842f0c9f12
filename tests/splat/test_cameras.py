"""Perspective and orthographic cameras: pictures and gradients against the float64 twin, poses, crops, far and near."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spacesim.backend import ad
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera
from spacesim.splat.cameras import Orthographic, OrthographicCamera, Pinhole
from spacesim.splat.gaussians import NAMES, Gaussians
from spacesim.splat.reference import render_reference
from spacesim.splat.render import render

KINDS = ("perspective", "orthographic")
POSE = look_at([2.5, 0.8, 0.6], [0.0, 0.0, 0.0])
PLANES = ("colour", "alpha", "depth", "normal", "features")


def record(kind: str, width: int = 40, height: int = 28, pose=POSE) -> Camera | OrthographicCamera:
    if kind == "perspective":
        return Camera(pose, width, height, 1.3 * width, 1.2 * width, 0.52 * width, 0.47 * height)
    return OrthographicCamera(pose, width, height, 0.55 * width, 0.6 * width, 0.52 * width, 0.47 * height)


def upload(view: Camera | OrthographicCamera) -> Pinhole | Orthographic:
    return Pinhole.of(view) if isinstance(view, Camera) else Orthographic.of(view)


def random_splats(count: int, seed: int = 0, degree: int = 3) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        "means": rng.uniform(-0.6, 0.6, (count, 3)),
        "log_scales": rng.uniform(-3.2, -1.4, (count, 3)),
        "quaternions": rng.normal(size=(count, 4)),
        "logit_opacities": rng.uniform(-2.5, 2.0, count),
        "sh": rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.25,
    }


def wide_splats() -> dict[str, np.ndarray]:
    """Five half-transparent splats wider than the picture: no cut-off and no clamped colour within a step's reach."""
    rng = np.random.default_rng(7)
    sh = rng.normal(size=(5, 16, 3)) * 0.04
    sh[:, 0] = rng.uniform(0.2, 0.8, (5, 3))
    return {
        "means": np.array([[0.3, 0.05, 0.0], [0.0, -0.2, 0.1], [-0.3, 0.15, -0.1], [-0.6, 0, 0.05], [-0.9, 0.1, 0.1]]),
        "log_scales": np.log(rng.uniform(0.7, 1.3, (5, 3))),
        "quaternions": rng.normal(size=(5, 4)),
        "logit_opacities": np.array([-0.4, 0.2, -0.8, 0.5, 0.1]),
        "sh": sh,
    }


def own_features(count: int) -> np.ndarray:
    return np.random.default_rng(9).normal(size=(count, 2))


def weights(size: int) -> list[np.ndarray]:
    """One for each plane of `flat`."""
    return list(np.random.default_rng(3).normal(size=(10, size)))


def flat(output) -> list:
    """Planes of an output of the twin: r, g, b, alpha, depth, normal (3), features (2)."""
    columns = [np.atleast_3d(getattr(output, name)) for name in PLANES]
    return [plane.ravel() for column in columns for plane in np.moveaxis(column, -1, 0)]


def twin_loss(arrays, view, features, **options) -> float:
    planes = flat(render_reference(arrays, view, features=features, **options))
    return float(sum(w @ p for w, p in zip(weights(planes[0].size), planes, strict=True)))


def our_loss(gaussians, camera, features, **options):
    outputs = [name for name in PLANES if name != "features"]
    output = render(gaussians, camera, outputs=outputs, features=features, **options)
    planes = [*output.colour, output.alpha, output.depth, *output.normal, *output.features]
    loss = ad.Float(0)
    for weight, plane in zip(weights(camera.width * camera.height), planes, strict=True):
        loss += dr.sum(ad.Float(weight.astype(np.float32)) * plane)
    return loss


def columns_of(features: np.ndarray) -> list:
    return [ad.Float(np.ascontiguousarray(column, dtype=np.float32)) for column in features.T]


def slope(function, values: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """Central differences of a scalar function of an array."""
    result = np.empty(values.shape)
    for index in np.ndindex(values.shape):
        ends = []
        for sign in (1, -1):
            moved = np.array(values, dtype=np.float64)
            moved[index] += sign * step
            ends.append(function(moved))
        result[index] = (ends[0] - ends[1]) / (2 * step)
    return result


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
        upload(view),
        outputs=("colour", "depth", "normal"),
        features=columns_of(features),
        antialiased=antialiased,
    )
    assert twin.alpha.max() > 0.1
    for name in ("colour", "alpha", "features"):
        np.testing.assert_allclose(ours.image(name), getattr(twin, name), atol=1e-5, err_msg=name)
    solid = twin.alpha > 0.05  # below, depth and normal divide by next to nothing
    np.testing.assert_allclose(ours.image("depth")[solid], twin.depth[solid], atol=1e-5)
    steady = solid & (np.abs(twin.normal).max(axis=-1) > 0)
    np.testing.assert_allclose(ours.image("normal")[steady], twin.normal[steady], atol=2e-3)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_gradients_of_every_parameter_match_central_differences(kind, antialiased):
    arrays, view, features = wide_splats(), record(kind, 16, 12), own_features(5)
    gaussians, channels = Gaussians.from_numpy(arrays), columns_of(features)
    dr.enable_grad(*gaussians.parameters().values(), *channels)
    dr.backward(our_loss(gaussians, upload(view), channels, antialiased=antialiased))
    for name in NAMES:
        ours = np.array(dr.grad(getattr(gaussians, name))).T.reshape(arrays[name].shape)

        def loss(values, name=name):
            return twin_loss({**arrays, name: values}, view, features, antialiased=antialiased)

        assert_close(ours, slope(loss, arrays[name]), name)
    ours = np.stack([np.array(dr.grad(channel)) for channel in channels], axis=1)
    twin = slope(lambda values: twin_loss(arrays, view, values, antialiased=antialiased), features)
    assert_close(ours, twin, "features")


@pytest.mark.parametrize("start", [np.zeros(6), np.array([0.02, -0.3, 0.1, 0.05, -0.1, 0.2])])
@pytest.mark.parametrize("kind", KINDS)
def test_pose_gradients_match_central_differences(kind, start):
    arrays, view, features = wide_splats(), record(kind, 16, 12), own_features(5)
    twist = ad.Float(start.astype(np.float32))
    dr.enable_grad(twist)
    camera = upload(view).moved(twist)
    dr.backward(our_loss(Gaussians.from_numpy(arrays), camera, columns_of(features)))

    def loss(values):
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_rotvec(values[:3]).as_matrix()
        motion[:3, 3] = values[3:]
        return twin_loss(
            arrays, replace(view, world_from_camera=view.world_from_camera @ np.linalg.inv(motion)), features
        )

    assert_close(np.array(dr.grad(twist)), slope(loss, start), "twist")
