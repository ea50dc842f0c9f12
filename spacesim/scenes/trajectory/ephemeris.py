"""Where the Sun is, as the Earth sees it."""

from datetime import date

import numpy as np

from spacesim.data.geometry import Array

J2000_FRAMES = ("EME2000", "J2000", "ICRF", "GCRF")
"""Frames whose axes are those of the mean equator and equinox of J2000, to 0.1 arc seconds."""

OBLIQUITY_DEG = 23.43928
"""Of the ecliptic of J2000."""

_NOON_2000 = date(2000, 1, 1).toordinal() + 0.5


def sun_direction(day: int, seconds: Array) -> Array:
    """[N, 3] unit vectors from the Earth's centre towards the Sun, in the axes of J2000, within 0.02 degrees from 1800
    to 2050, whatever the time system (a minute is 0.0007 degrees).

    day: a proleptic ordinal; seconds: [N] since its midnight. By the Earth's orbit of E. M. Standish and J. G.
    Williams, "Approximate positions of the major planets" (JPL Solar System Dynamics, table 1).
    """
    centuries = (day - _NOON_2000 + np.asarray(seconds) / 86_400) / 36_525
    e = 0.01671123 - 0.00004392 * centuries
    perihelion = np.radians(102.93768193 + 0.32327364 * centuries)
    mean = np.radians(100.46457166 + 35_999.37244981 * centuries) - perihelion
    eccentric = mean
    for _ in range(5):  # Newton's: the error falls by more than e each time
        eccentric = eccentric - (eccentric - e * np.sin(eccentric) - mean) / (1 - e * np.cos(eccentric))
    true = np.arctan2(np.sqrt(1 - e * e) * np.sin(eccentric), np.cos(eccentric) - e)
    longitude = true + perihelion + np.pi  # of the Sun; the orbit is within 0.002 degrees of the ecliptic
    obliquity = np.radians(OBLIQUITY_DEG)
    across = np.sin(longitude)
    return np.stack([np.cos(longitude), np.cos(obliquity) * across, np.sin(obliquity) * across], axis=-1)
