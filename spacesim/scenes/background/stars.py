"""Stars: points all over the sky, as many of each magnitude as there are, spread over about a pixel."""

import math

import numpy as np
from scipy.special import erf

from spacesim.data.geometry import Array, normalize
from spacesim.data.images import distort_points, undistort_points
from spacesim.data.records import Camera
from spacesim.scenes.lights.sun import SOLAR_IRRADIANCE

COUNT, SLOPE = 4968, 0.506
"""Stars brighter than magnitude 6, and by how much the logarithm of their number grows with each magnitude: from the
Hipparcos catalogue's 15, 172, 1,600 and 15,328 stars brighter than 1, 3, 5 and 7 (OEIS A053406)."""

BRIGHTEST, FAINTEST = -1.44, 7.0
"""Magnitudes, the first that of Sirius."""

SUN_MAGNITUDE = -26.76
"""Apparent magnitude of the Sun at 1 au in Johnson's V (C. N. A. Willmer, "The absolute magnitude of the Sun in several
filters", ApJS 236, 2018)."""

SPREAD = 0.5
"""Pixels: standard deviation of a star's picture."""

_REACH = 3  # pixels on each side that a star's picture is drawn on


class Stars:
    """A made-up sky, fixed in the world frame. seed: places the stars."""

    def __init__(self, seed: int) -> None:
        random = np.random.default_rng(seed)
        count = round(stars_brighter_than(FAINTEST))
        self.directions: Array = normalize(random.normal(size=(count, 3)))  #: [N, 3] unit, world frame
        rank = count * random.random(count)  # uniform: as many as the law has of each magnitude
        magnitudes = 6 + np.log10(np.maximum(rank, 1e-9) / COUNT) / SLOPE
        self.magnitudes: Array = np.maximum(magnitudes, BRIGHTEST)  #: [N] apparent, visual

    @property
    def irradiance(self) -> Array:
        """[N] W m^-2, the same in R, G and B."""
        return SOLAR_IRRADIANCE * 10 ** (-0.4 * (self.magnitudes - SUN_MAGNITUDE))

    def pixels(self, camera: Camera, distortion: tuple[float, ...] = ()) -> tuple[Array, np.ndarray]:
        """(positions [M, 2] in pixels, numbers [M]) of the stars in the image, or up to some pixels beside it."""
        local = self.directions @ camera.world_from_camera[:3, :3]
        ahead = np.flatnonzero(local[:, 2] > 1e-3)
        x, y = (local[ahead, :2] / local[ahead, 2:]).T
        if any(distortion):  # beyond where the lens folds back it shows nothing
            with np.errstate(all="ignore"):
                u, v = distort_points(x, y, distortion)
                back = undistort_points(u, v, distortion)
                kept = np.hypot(back[0] - x, back[1] - y) <= 1e-6
            x, y, ahead = u[kept], v[kept], ahead[kept]
        places = np.stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy], axis=1)
        inside = ((places > -_REACH) & (places < np.array([camera.width, camera.height]) + _REACH)).all(axis=1)
        return places[inside], ahead[inside]

    def draw(self, camera: Camera, distortion: tuple[float, ...] = ()) -> np.ndarray:
        """[H, W] radiance, W m^-2 sr^-1, the same in R, G and B: the means over the pixels."""
        places, numbers = self.pixels(camera, distortion)
        padded = np.zeros((camera.height + 4 * _REACH, camera.width + 4 * _REACH))
        first = np.floor(places).astype(np.int64) - _REACH
        edges = first[:, :, None] + np.arange(2 * _REACH + 2)  # of the columns, and of the rows
        shares = np.diff(0.5 * erf((edges - places[:, :, None]) / (math.sqrt(2) * SPREAD)), axis=2)  # [M, 2, 7]
        radiance = self.irradiance[numbers] * camera.fx * camera.fy  # over a pixel's solid angle, near the axis
        spots = radiance[:, None, None] * shares[:, 1, :, None] * shares[:, 0, None, :]
        rows, columns = (first[:, axis, None] + np.arange(2 * _REACH + 1) + 2 * _REACH for axis in (1, 0))
        np.add.at(padded, (rows[:, :, None], columns[:, None, :]), spots)
        return padded[2 * _REACH : -2 * _REACH, 2 * _REACH : -2 * _REACH].astype(np.float32)


def stars_brighter_than(magnitude: float) -> float:
    """How many of the whole sky."""
    return COUNT * 10 ** (SLOPE * (magnitude - 6))
