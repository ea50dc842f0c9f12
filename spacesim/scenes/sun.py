"""The Sun as a directional emitter, white, at one astronomical unit."""

import math
from typing import Any

from spacesim.data.records import Sun

SOLAR_IRRADIANCE = 1361.0
"""Nominal total solar irradiance, W m^-2 (IAU 2015 Resolution B3). Each of R, G and B is given this value:
the Sun is white here, and an irradiance is not yet shared out over bands."""

EXPOSURE = math.pi / SOLAR_IRRADIANCE
"""Factor from radiance to display value: a white Lambertian surface that faces the Sun has linear value 1."""


def directional(sun: Sun, irradiance: float = SOLAR_IRRADIANCE) -> dict[str, Any]:
    """Mitsuba's description of the Sun: parallel light of `irradiance` W m^-2 on a surface that faces it."""
    return {
        "type": "directional",
        "direction": [float(-x) for x in sun.direction],
        "irradiance": {"type": "rgb", "value": [irradiance] * 3},
    }
