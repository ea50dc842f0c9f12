"""Relative motion against the two-body problem, and the world frame against an orbit drawn in inertial axes."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from spacesim.scenes.cameras.orbit import (
    EARTH_GM,
    ORBIT_NORMAL,
    WORLD_FROM_LVLH,
    ellipse,
    mean_motion,
    star_direction,
    transition,
)

RADIUS = 6_378_137.0 + 500e3  # WGS 84
N = mean_motion(500)
PERIOD = 2 * np.pi / N


def lvlh_axes(phase):
    """[3, 3] columns: V-bar, against the angular momentum, R-bar, of a target that goes round in the xy plane."""
    up = np.array([np.cos(phase), np.sin(phase), 0])
    along = np.array([-np.sin(phase), np.cos(phase), 0])
    return np.stack([along, [0, 0, -1], -up], axis=1)


def two_body(state, times):
    """[T, 3] relative positions in LVLH of a free chaser by numerical integration about the Earth's centre."""
    axes, spin = lvlh_axes(0), np.array([0, 0, N])
    position = np.array([RADIUS, 0, 0]) + axes @ state[:3]
    velocity = np.array([0, RADIUS * N, 0]) + axes @ state[3:] + np.cross(spin, axes @ state[:3])

    def fall(_, y):
        return [*y[3:], *(-EARTH_GM * y[:3] / np.linalg.norm(y[:3]) ** 3)]

    path = solve_ivp(fall, (0, times[-1]), [*position, *velocity], "DOP853", times, rtol=1e-13, atol=1e-7).y[:3].T
    targets = RADIUS * np.stack([np.cos(N * times), np.sin(N * times), 0 * times], axis=1)
    return np.array([lvlh_axes(N * t).T @ (p - q) for t, p, q in zip(times, path, targets, strict=True)])


def test_mean_motion_of_known_orbits():
    assert 86164.1 / (2 * np.pi / mean_motion(35786)) == pytest.approx(1, abs=1e-4)  # geostationary: a sidereal day
    assert pytest.approx(94.6, abs=0.1) == PERIOD / 60


@pytest.mark.parametrize(("separation", "limit"), [(10.0, 6e-6), (100.0, 6e-5), (1000.0, 6e-4)])
def test_ellipse_is_what_two_bodies_do(separation, limit):
    # What the linear equations leave out grows as separation over orbit radius, 1.5e-6 for 10 m.
    times = np.linspace(0, PERIOD, 25)
    states = ellipse(0.4 + N * times, N, separation, 0.3 * separation, 1.1)
    found = two_body(states[0], times)
    error = np.linalg.norm(found - states[:, :3], axis=1).max() / separation
    assert error < limit


def test_transition_is_what_two_bodies_do():
    state = np.array([30.0, -12, 8, 0.05, 0.01, -0.03])  # drifts away
    times = np.linspace(0, 0.8 * PERIOD, 9)
    found = two_body(state, times)
    states = np.array([transition(N, t) @ state for t in times])
    scale = np.linalg.norm(found, axis=1).max()
    assert scale > 200
    assert np.linalg.norm(found - states[:, :3], axis=1).max() / scale < 1e-3


def test_ellipse_and_transition_agree_and_velocity_is_the_derivative():
    first, later = ellipse(np.array([0.7, 0.7 + N * 900]), N, 25, 7, 0.3)
    np.testing.assert_allclose(transition(N, 900) @ first, later, atol=1e-9)
    np.testing.assert_allclose(transition(N, 400) @ transition(N, 500), transition(N, 900), atol=1e-6)
    before, after = ellipse(np.array([0.7 - 1e-5, 0.7 + 1e-5]), N, 25, 7, 0.3)
    np.testing.assert_allclose((after - before)[:3] / 2e-5 * N, first[3:], atol=1e-9)


def test_ellipse_is_closed_and_two_to_one():
    phase = np.linspace(0, 2 * np.pi, 721)
    states = ellipse(phase, N, 10)
    np.testing.assert_allclose(states[0], states[-1], atol=1e-12)
    np.testing.assert_allclose(transition(N, PERIOD) @ states[100], states[100], atol=1e-8)
    assert np.ptp(states[:, 0]) == pytest.approx(2 * np.ptp(states[:, 2]))
    np.testing.assert_allclose((states[:, 0] / 20) ** 2 + (states[:, 2] / 10) ** 2, 1)
    below = states[0]  # nearer to the Earth is faster
    assert below[2] == pytest.approx(10)
    assert below[3] > 0


def test_world_frame_and_what_stands_still():
    assert np.linalg.det(WORLD_FROM_LVLH) == pytest.approx(1)
    star = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])  # inertial
    phases = np.linspace(0, 7, 15)
    seen = [WORLD_FROM_LVLH @ lvlh_axes(phase).T @ star for phase in phases]
    for phase, expected in zip(phases, seen, strict=True):
        np.testing.assert_allclose(star_direction(seen[0], phase), expected, atol=1e-12)
    np.testing.assert_allclose(WORLD_FROM_LVLH @ lvlh_axes(0.9).T @ [0, 0, 1], ORBIT_NORMAL, atol=1e-12)
