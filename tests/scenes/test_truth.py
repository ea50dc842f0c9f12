"""The renderer against closed forms (`truth.py`)."""

import math

import numpy as np
import pytest
import raycast
import trimesh
import truth
import whole

from spacesim.data.records import Sun
from spacesim.scenes.lights.earth import EarthConfig


@pytest.mark.parametrize("elevation_deg", [90.0, 30.0, 5.0])
def test_plate_has_the_radiance_of_lamberts_law(elevation_deg):
    assert abs(truth.plate_error(elevation_deg)) < 0.005


@pytest.mark.parametrize("distance_au", [0.3, 5.2, 30.0])
def test_irradiance_falls_with_the_square_of_the_suns_distance(distance_au):
    assert abs(truth.plate_error(distance_au=distance_au)) < 0.005


@pytest.mark.parametrize("elevation_deg", [90.0, 45.0])
def test_penumbra_of_a_sphere_is_that_of_the_solar_disc(elevation_deg):
    profile = truth.penumbra_profile(elevation_deg)
    assert np.mean((profile["expected"] > 0.02) & (profile["expected"] < 0.98)) > 0.05, "there is a penumbra"
    assert np.abs(profile["visibility"] - profile["expected"]).max() < 0.02
    assert truth.edge_error(profile) < 1.0
    assert np.abs(profile["radiance"] - profile["expected"]).mean() < 0.02


def test_closed_forms_can_fail():
    assert truth.disc_seen_beside(np.array([0.0]), np.array([1.0]))[0] == pytest.approx(0)
    assert truth.disc_seen_beside(np.array([1.0]), np.array([0.1]))[0] == pytest.approx(1)
    half = truth.disc_seen_beside(np.array([10.0]), np.array([10.0]))[0]
    assert half == pytest.approx(0.5, abs=1e-3)
    assert math.degrees(truth.SOLAR_RADIUS) == pytest.approx(0.2666, abs=2e-4)


def test_light_in_a_hollow_sphere_is_conserved():
    assert abs(truth.integrating_sphere_error(0.5)) < 0.02


@pytest.mark.parametrize(("phase_deg", "altitude_km"), [(0.0, 500.0), (90.0, 500.0), (0.0, 36_000.0)])
def test_earth_gives_the_irradiance_of_a_lambertian_sphere(phase_deg, altitude_km):
    assert abs(truth.earth_error(phase_deg, altitude_km)) < 0.004


def test_the_earths_beams_are_what_the_path_tracer_shows():
    """A plate before whose horizon a part of the Earth has set."""
    earth, sun = EarthConfig(30.0, 20.0), Sun.from_angles(190.0, 10.0)
    traced = truth.seen_from_above(truth.scene_of(truth.plate(), earth=earth), sun, spp=4096)
    beams = earth.light.beams(sun.direction)
    expected = 0.5 / math.pi * truth.SOLAR_IRRADIANCE * np.maximum(beams[:, 2], 0) @ beams[:, 3]
    assert traced.radiance_earth.mean() == pytest.approx(expected, rel=0.02)


def test_sun_only_plus_earth_only_equals_both_within_noise():
    """On each part of boxsat; a tenth of the Earth's light missing would be seen."""
    difference, error, share = whole.sources_apart(spp=64)
    assert (np.abs(difference) < 5 * error + 1e-4).all()
    assert np.sqrt(np.mean((difference / error) ** 2)) < 2
    assert (share > 50 * error).any(), "the Earth matters"


def test_wavelengths_add_up_to_white():
    np.testing.assert_allclose(whole.band_weights().sum(axis=0), 1.0, atol=1e-6)


def test_visibility_in_penumbrae_of_a_spacecraft():
    """Against 1,024 rays to the disc from each of some points beside the cast shadows of boxsat."""
    found = raycast.penumbra("boxsat", count=80, views=8)
    part = (found.expected > 0) & (found.expected < 1)
    assert part.sum() > 15
    assert found.error[part].mean() < 0.015
    assert np.quantile(found.error, 0.95) < 0.04
    assert ((found.visibility == 0) == (found.expected == 0)).mean() > 0.9


def test_rays_to_the_disc_by_hand():
    """Half of the Sun is behind the edge of a wall; a point that is turned away sees none of it."""
    scene = truth.scene_of(trimesh.creation.box((1, 1, 1)))
    caster = raycast.RayCaster(scene)
    up, points = truth.OVERHEAD, np.array([[0.5, 0.0, -3.0], [0.2, 0.0, -3.0], [2.0, 0.0, -3.0], [2.0, 0.0, -3.0]])
    normals = np.array([[0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, -1]], float)
    seen = caster.sun_seen(points, normals, up, truth.SOLAR_RADIUS, 32)
    np.testing.assert_allclose(seen, [0.5, 0.0, 1.0, 0.0], atol=0.01)
