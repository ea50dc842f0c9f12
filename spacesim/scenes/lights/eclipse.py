"""How much of the Sun the Earth leaves visible: two discs in the sky, one before the other."""

import math

import numpy as np
from numpy.typing import ArrayLike

from spacesim.data.geometry import Array, normalize
from spacesim.scenes.lights.earth import EARTH_RADIUS_KM


def visible_fraction(sun: Array, earth: ArrayLike, angular_radius: float) -> float:
    """Fraction of the solar disc that is seen past the Earth: 0 in the umbra, up to 1 in the penumbra.

    sun: [3] direction towards the Sun; earth: [3] from here to the Earth's centre, metres; angular_radius: of the Sun,
    radians, 0 for parallel light. The Earth is a sphere without air, of its equatorial radius.

    The area that two circles of radii a and b share, their centres c apart (O. Montenbruck, E. Gill, "Satellite
    Orbits", 2000, 3.4.2), in the plane of angles: the Earth's limb bends less than 0.1 % of the Sun's disc away from
    such a circle.
    """
    centre = np.asarray(earth, dtype=np.float64)
    distance = float(np.linalg.norm(centre))
    radius = 1e3 * EARTH_RADIUS_KM
    if distance <= radius:
        return 0.0
    towards, light = centre / distance, normalize(sun)
    a, b = angular_radius, math.asin(radius / distance)
    c = 2 * math.atan2(float(np.linalg.norm(light - towards)), float(np.linalg.norm(light + towards)))  # Kahan's angle
    if c >= a + b:
        return 1.0
    if c <= b - a:
        return 0.0
    if c <= a - b:  # in the middle of the Sun
        return 1 - (b / a) ** 2
    x = (c * c + a * a - b * b) / (2 * c)
    y = math.sqrt(max(a * a - x * x, 0))
    share = a * a * math.acos(_cosine(x / a)) + b * b * math.acos(_cosine((c - x) / b)) - c * y
    return min(max(1 - share / (math.pi * a * a), 0.0), 1.0)


def _cosine(value: float) -> float:
    return min(max(value, -1.0), 1.0)
