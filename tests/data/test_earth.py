"""The Earth's beams against the ground that sends them."""

import numpy as np
import pytest

from spacesim.data.earth import Earth
from spacesim.data.errors import InputError
from spacesim.data.geometry import direction_from_angles, fibonacci_sphere, normalize

NADIR = np.array([0.0, 0.0, -1.0])


def irradiance(earth: Earth, sun: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """[N] by pieces of the ground: albedo / pi (n . s) cos cos dA / r^2, lengths in Earth radii."""
    ground = fibonacci_sphere(200_000)
    towards = ground + earth.direction / np.sin(np.radians(earth.angular_radius_deg))
    r = np.linalg.norm(towards, axis=1)
    towards /= r[:, None]
    leaving, lit = np.maximum(-(ground * towards).sum(axis=1), 0), np.maximum(ground @ sun, 0)
    power = earth.albedo / np.pi * lit * leaving / r**2 * 4 * np.pi / len(ground)
    return np.array([power @ np.maximum(towards @ normal, 0) for normal in normals])


@pytest.mark.parametrize("angular_radius_deg", [68.0, 8.7])
@pytest.mark.parametrize("phase_deg", [0.0, 60.0, 90.0])
def test_beams_light_surfaces_as_the_ground_does(angular_radius_deg, phase_deg):
    earth = Earth(normalize([0.3, -0.4, -0.8]), angular_radius_deg, albedo=0.5)
    across = normalize(np.cross(earth.direction, [1.0, 0, 0]))
    sun = -np.cos(np.radians(phase_deg)) * earth.direction + np.sin(np.radians(phase_deg)) * across
    normals, beams = fibonacci_sphere(50), earth.beams(sun)
    np.testing.assert_allclose(np.linalg.norm(beams[:, :3], axis=1), 1)
    found = np.maximum(normals @ beams[:, :3].T, 0) @ beams[:, 3]
    expected = irradiance(earth, sun, normals)
    assert expected.max() > 1e-3
    tolerance = 0.08 if phase_deg == 90 else 0.015  # the crescent is a part of few beams
    np.testing.assert_allclose(found, expected, atol=tolerance * expected.max())


def test_its_night_side_is_dark():
    assert not Earth(NADIR, 30.0).beams(NADIR)[:, 3].any()
    assert Earth(NADIR, 30.0).beams(-NADIR)[:, 3].all()


@pytest.mark.parametrize(
    ("direction", "options", "name"),
    [
        ([0, 0, 0], {}, "earth_direction"),
        ([1.0, 2.0], {}, "earth_direction"),
        ([np.nan, 0, 1], {}, "earth_direction"),
        (direction_from_angles(20, 30), {"angular_radius_deg": 90.0}, "earth_angular_radius_deg"),
        (direction_from_angles(20, 30), {"angular_radius_deg": "wide"}, "earth_angular_radius_deg"),
        ("up", {}, "earth_direction"),
        (10**400, {}, "earth_direction"),
        (direction_from_angles(20, 30), {"albedo": 1.5}, "earth_albedo"),
    ],
)
def test_impossible_ones_are_named(direction, options, name):
    with pytest.raises(InputError, match=f"{name}: expected"):
        Earth(np.array(direction), **options)
