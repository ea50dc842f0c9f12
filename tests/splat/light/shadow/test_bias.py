"""Receiver-depth bias against closed forms and the float64 reference."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from splats import random_splats

from spacesim.backend.upload import upload
from spacesim.data.geometry import fibonacci_sphere, look_at, quaternion_from_rotation
from spacesim.splat.light.shadow.bias import grazing_bias, offset_receivers, receiver_bias
from spacesim.splat.light.shadow.light_camera import fit_camera, light_rows, towards_sun
from spacesim.splat.raster.cameras import Orthographic, OrthographicCamera
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.reference.shadow_mapping import reference_bias

NAMES = ("thickness", "alignment", "confidence", "bias")


def biases(arrays, sun, strength=10.0):
    found = receiver_bias(Gaussians.from_numpy(arrays), towards_sun(light_rows(sun)), strength)
    return {name: np.array(getattr(found, name)) for name in NAMES}


def disc(flatness=0.01, width=0.2, quaternion=(1, 0, 0, 0)):
    """One Gaussian, flat in its z."""
    return {
        "means": np.zeros((1, 3)),
        "log_scales": np.log([[width, width, flatness * width]]),
        "quaternions": np.array([quaternion], dtype=float),
        "logit_opacities": np.zeros(1),
        "sh": np.zeros((1, 1, 3)),
    }


@pytest.mark.parametrize("sun", [*np.eye(3), *-np.eye(3), *fibonacci_sphere(7)], ids=lambda s: str(np.round(s, 2)))
def test_equals_the_twin(sun):
    arrays = random_splats(500, seed=1)
    found, expected = biases(arrays, sun), reference_bias(arrays, sun)
    for name in NAMES:
        assert found[name] == pytest.approx(expected[name], rel=2e-4, abs=2e-5), name


@pytest.mark.parametrize("angle", [0, 20, 45, 70, 90])
def test_of_a_disc_by_hand(angle):
    """Width 0.2 m, 0.002 m thick, the Sun `angle` degrees from its normal."""
    a = np.radians(angle)
    found = biases(disc(), [np.sin(a), 0, np.cos(a)], strength=3.0)
    thickness = np.hypot(0.2 * np.sin(a), 0.002 * np.cos(a))
    assert found["thickness"][0] == pytest.approx(thickness, rel=1e-5)
    assert found["alignment"][0] == pytest.approx(np.cos(a), abs=1e-6)
    assert found["confidence"][0] == pytest.approx(0.99, abs=1e-6)
    assert found["bias"][0] == pytest.approx(3 * thickness * np.cos(a) * 0.99, abs=1e-7)


def test_of_a_ball_is_none():
    found = biases(disc(flatness=1.0), [0.3, 0.4, 0.5])
    assert found["bias"][0] == pytest.approx(0, abs=1e-6)
    assert found["thickness"][0] == pytest.approx(0.2, rel=1e-5)


def test_turns_with_the_scene():
    arrays = random_splats(50, seed=2)
    sun, turn = np.array([0.48, -0.6, 0.64]), Rotation.from_rotvec([0.4, -1.1, 0.7])
    axes = Rotation.from_quat(arrays["quaternions"][:, [1, 2, 3, 0]]).as_matrix()
    turned = {**arrays, "quaternions": np.array([quaternion_from_rotation(turn.as_matrix() @ R) for R in axes])}
    for name in NAMES:
        assert biases(turned, turn.apply(sun))[name] == pytest.approx(biases(arrays, sun)[name], rel=1e-3, abs=1e-5)


@pytest.mark.parametrize("sun", [[0, 0, 1], [0, 0, -1], [0.8, 0, 0.6], [-0.8, 0, -0.6]], ids=str)
def test_lifted_by_hand(sun):
    """Along the disc's normal, to the Sun's side; a ball has no normal and stays."""
    arrays = {name: np.concatenate([disc()[name], disc(flatness=1.0)[name]]) for name in disc()}
    points = np.array(offset_receivers(Gaussians.from_numpy(arrays), towards_sun(light_rows(sun)), 3.0, 0.25)).T
    height = 0.99 * (3 * 0.002 + 0.25 * 0.2)
    assert points[0] == pytest.approx([0, 0, np.sign(sun[2]) * height], abs=1e-6)
    assert points[1] == pytest.approx([0, 0, 0], abs=1e-6)


@pytest.mark.parametrize("azimuth", [0, 30, 90])
@pytest.mark.parametrize("elevation", [90, 45, 10, 1, 0])
def test_grazing_bias_by_hand(elevation, azimuth):
    """How much the depth of the disc's plane varies over its footprint, drawn with 0.3 pixels^2 of 4 mm x 8 mm: the
    variance of a sum of two independent offsets, along the light and of the filter along the slope."""
    a, b = np.radians(elevation), np.radians(azimuth)
    sun = np.array([np.cos(a) * np.cos(b), np.cos(a) * np.sin(b), np.sin(a)])
    pose = look_at(sun, [0, 0, 0], up=[0, 0, 1] if elevation < 90 else [1, 0, 0])
    camera = Orthographic.of(OrthographicCamera(pose, 8, 8, 1 / 0.004, 1 / 0.008, 4, 4))
    found = np.array(grazing_bias(Gaussians.from_numpy(disc()), camera, 2.0))
    thickness = np.hypot(0.2 * np.cos(a), 0.002 * np.sin(a))
    # seen from the Sun the plate's depth changes upwards in the picture alone, where pixels are 8 mm high
    slope = 0.008 * np.cos(a) / max(np.sin(a), 0.05)
    assert found[0] == pytest.approx(2 * 0.99 * np.sqrt(thickness**2 + 0.3 * slope**2), rel=1e-4, abs=1e-6)


def test_grazing_bias_is_the_depth_that_a_footprint_spans():
    """Against points drawn from a tilted disc and moved by the filter: the plane's depth where they come to lie."""
    turn, rng = Rotation.from_euler("yxz", [55, 20, 10], degrees=True), np.random.default_rng(0)
    arrays = disc(flatness=1e-4, quaternion=turn.as_quat()[[3, 0, 1, 2]])
    camera = Orthographic.of(OrthographicCamera(look_at([0, 0, 5], [0, 0, 0], up=[0, 1, 0]), 8, 8, 9.0, 6.0, 4, 4))
    points = turn.apply(np.c_[rng.normal(size=(200_000, 2)) * 0.2, np.zeros(200_000)])[:, :2]
    points += rng.normal(size=points.shape) * np.sqrt(0.3) / [9.0, 6.0]
    normal = turn.apply([0, 0, 1])
    depth = points @ normal[:2] / normal[2]
    found = np.array(grazing_bias(Gaussians.from_numpy(arrays), camera, 1.0))[0]
    assert found == pytest.approx(depth.std(), rel=0.01)


def test_no_bias_is_below_its_floor():
    bias = receiver_bias(Gaussians.from_numpy(random_splats(9)), towards_sun(light_rows([0, 0, 1])))
    floor = upload(np.linspace(0, 1, 9))
    raised = bias.at_least(floor)
    assert np.array(raised.bias) == pytest.approx(np.maximum(np.array(bias.bias), np.linspace(0, 1, 9)))
    assert raised.thickness is bias.thickness


def test_hostile_gaussians_get_none():
    arrays = random_splats(8, seed=3)
    arrays["log_scales"][0, 1] = np.nan
    arrays["log_scales"][1, 0] = np.inf
    arrays["log_scales"][2] = -np.inf
    arrays["quaternions"][3] = 0
    arrays["quaternions"][4, 2] = np.nan
    arrays["log_scales"][5] = 19.9
    found = biases(arrays, [0, 0, 1])
    for name in NAMES:
        assert np.all(np.isfinite(found[name]))
        assert np.all(found[name][:5] == 0), name
    gaussians = Gaussians.from_numpy(arrays)
    camera = fit_camera(gaussians, light_rows([0, 0, 1]), 16)
    assert np.all(np.isfinite(np.array(grazing_bias(gaussians, camera))))
    assert np.all(np.isfinite(np.array(offset_receivers(gaussians, towards_sun(light_rows([0, 0, 1]))))))
