"""Relative motion near a target in a circular orbit (Clohessy and Wiltshire), in closed form.

Local vertical, local horizontal (LVLH) frame of the target: x along its velocity (V-bar), z towards the Earth's centre
(R-bar), y against the orbit's angular momentum (W. Fehse, "Automated Rendezvous and Docking of Spacecraft", 2003, 3.1).
For a separation rho and an orbit of radius R:

    x'' - 2 n z' = 0      y'' + n^2 y = 0      z'' + 2 n x' - 3 n^2 z = 0      + O(n^2 rho^2 / R)

(W. H. Clohessy, R. S. Wiltshire, "Terminal guidance system for satellite rendezvous", J. Aerospace Sciences 27, 1960).
The world frame of a scene is this frame with z away from the Earth: see `WORLD_FROM_LVLH`.
"""

import math

import numpy as np

from spacesim.data.geometry import Array
from spacesim.scenes.lights.earth import EARTH_RADIUS_KM

EARTH_GM = 3.986004418e14
"""Gravitational parameter of the Earth, m^3 s^-2 (IERS Conventions 2010, table 1.1)."""

WORLD_FROM_LVLH: Array = np.diag([1.0, -1.0, -1.0])
"""[3, 3] LVLH to world axes: V-bar is +x, the zenith +z and the orbit's angular momentum +y; its own inverse."""

ORBIT_NORMAL: Array = np.array([0.0, 1.0, 0.0])
"""[3] direction of the orbit's angular momentum, world frame."""


def mean_motion(altitude_km: float) -> float:
    """Radians per second of a circular orbit at an altitude above the equator: n = sqrt(GM / R^3)."""
    return math.sqrt(EARTH_GM / (1e3 * (EARTH_RADIUS_KM + altitude_km)) ** 3)


def transition(n: float, seconds: float) -> Array:
    """[6, 6] matrix that takes a free state (x, y, z, x', y', z') in LVLH, metres and m/s, `seconds` further.

    n: mean motion, radians per second.
    """
    a = n * seconds
    s, c = math.sin(a), math.cos(a)
    return np.array(
        [
            [1, 0, 6 * (a - s), (4 * s - 3 * a) / n, 0, 2 * (1 - c) / n],
            [0, c, 0, 0, s / n, 0],
            [0, 0, 4 - 3 * c, 2 * (c - 1) / n, 0, s / n],
            [0, 0, 6 * n * (1 - c), 4 * c - 3, 0, 2 * s],
            [0, -n * s, 0, 0, c, 0],
            [0, 0, 3 * n * s, -2 * s, 0, c],
        ]
    )


def ellipse(phase: Array, n: float, size: float, across: float = 0.0, across_phase: float = 0.0) -> Array:
    """[N, 6] states in LVLH, metres and m/s, on the closed relative orbit about the target.

    phase: [N] radians, 0 where the orbit is nearest to the Earth, growing by n seconds; size: half the radial extent,
    metres: the extent along V-bar is twice that, whatever the altitude; across: amplitude out of the plane, metres;
    across_phase: radians by which that motion is ahead.
    """
    phase = np.asarray(phase, dtype=np.float64)
    s, c = np.sin(phase), np.cos(phase)
    ahead = phase + across_phase
    position = [2 * size * s, across * np.sin(ahead), size * c]
    velocity = [2 * size * n * c, across * n * np.cos(ahead), -size * n * s]
    return np.stack([*position, *velocity], axis=-1)


def star_direction(direction: Array, phase: float) -> Array:
    """[3] world direction of what is far away and was at `direction` [3] when the orbit was `phase` radians behind.

    The world frame turns with the orbit, about the orbit's normal, and so everything that stands still turns back.
    """
    s, c = math.sin(phase), math.cos(phase)
    x, y, z = direction
    return np.array([c * x - s * z, y, s * x + c * z])
