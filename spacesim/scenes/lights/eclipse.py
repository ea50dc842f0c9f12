"""How much of the Sun the Earth leaves visible from a place that many metres away."""

import math

import numpy as np
from numpy.typing import ArrayLike

from spacesim.data.earth import visible_disc
from spacesim.data.geometry import Array
from spacesim.scenes.lights.earth import EARTH_RADIUS_KM


def visible_fraction(sun: Array, earth: ArrayLike, angular_radius: float) -> float:
    """Fraction of the solar disc that is seen past the Earth, see `visible_disc`; 0 underground.

    sun: [3] direction towards the Sun; earth: [3] from here to the Earth's centre, metres; angular_radius: of the Sun,
    radians, 0 for parallel light. The Earth has its equatorial radius.
    """
    centre = np.asarray(earth, dtype=np.float64)
    distance = float(np.linalg.norm(centre))
    radius = 1e3 * EARTH_RADIUS_KM
    if distance <= radius:
        return 0.0
    return visible_disc(sun, centre / distance, math.asin(radius / distance), angular_radius)
