"""Receiver-depth bias against closed forms and the float64 twin."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from splats import random_splats

from spacesim.data.geometry import fibonacci_sphere, quaternion_from_rotation
from spacesim.splat.gaussians import Gaussians
from spacesim.splat.shadow.bias import receiver_bias
from spacesim.splat.shadow.reference import reference_bias
from spacesim.splat.shadow.sunlight import light_rows, towards_sun

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
