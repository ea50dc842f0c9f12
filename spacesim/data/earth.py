"""The Earth as a source of light: a Lambertian sphere, lit by the Sun, that fills part of the sky and can hide it."""

import math
from dataclasses import dataclass

import numpy as np

from spacesim.data.errors import expect
from spacesim.data.geometry import Array, as_numbers, normalize, perpendicular

EARTH_ALBEDO = 0.294
"""Bond albedo of the Earth (D. R. Williams, "Earth Fact Sheet", NASA Goddard Space Flight Center); to the two digits
that G. L. Stephens et al. give ("The albedo of Earth", Reviews of Geophysics 53, 2015), 0.29."""

SOLAR_RADIUS_KM, ASTRONOMICAL_UNIT_KM = 695_700.0, 149_597_870.7
"""Nominal solar radius (IAU 2015 Resolution B3) and astronomical unit (IAU 2012 Resolution B2)."""

BEAMS = 64
"""Directions that stand for the Earth. What a surface gets is within 1.5 % of the most that one gets from all of the
disc, up to phase angles of 60 degrees; of the dim crescent at 90 within 7 %."""


@dataclass(frozen=True, eq=False)
class Earth:
    """Where the Earth is, how large in the sky and how bright."""

    direction: Array  #: [3] unit vector, world frame, from the scene towards the Earth's centre
    angular_radius_deg: float = 68.0  #: from the Earth's centre to its limb; 68 at an altitude of 500 km
    albedo: float = EARTH_ALBEDO  #: of the sphere, the same in all channels

    def __post_init__(self) -> None:
        direction = as_numbers(self.direction)
        is_vector = direction.shape == (3,) and bool(np.isfinite(direction).all() and np.abs(direction).max() > 0)
        expect(is_vector, "earth_direction", "3 finite numbers, not all 0", self.direction)
        radius = self.angular_radius_deg
        for name, value in (("angular_radius_deg", radius), ("albedo", self.albedo)):
            expect(isinstance(value, int | float | np.number), f"earth_{name}", "a number", value)
        expect(0 < radius < 90, "earth_angular_radius_deg", "an angle from 0 to 90 degrees", radius)
        expect(0 <= self.albedo <= 1, "earth_albedo", "a fraction from 0 to 1", self.albedo)
        object.__setattr__(self, "direction", normalize(direction))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Earth) and self._numbers == other._numbers

    def __hash__(self) -> int:
        return hash(self._numbers)

    @property
    def _numbers(self) -> tuple[float, ...]:
        return *self.direction.tolist(), self.angular_radius_deg, self.albedo

    def visible_sun(self, sun: Array) -> float:
        """Share of the disc of a Sun in the direction `sun` [3], 1 au away, that is seen past it: `visible_disc`."""
        sun_radius = math.asin(SOLAR_RADIUS_KM / ASTRONOMICAL_UNIT_KM)
        return visible_disc(sun, self.direction, math.radians(self.angular_radius_deg), sun_radius)

    def beams(self, sun: Array) -> Array:
        """[BEAMS, 4]: the Earth's light under the Sun in the unit direction `sun` [3] as parallel beams, each a unit
        vector towards its part of the disc and its irradiance at normal incidence, where sunlight has 1.

        Parts of equal solid angle lie on a spherical Fibonacci lattice; the radiance of each is albedo / pi times the
        cosine of the Sun at the ground that is seen there. Lengths are in Earth radii.
        """
        radius = math.radians(self.angular_radius_deg)
        limb, distance = math.cos(radius), 1 / math.sin(radius)
        k = np.arange(BEAMS) + 0.5
        height = 1 - (1 - limb) * k / BEAMS
        turn = np.pi * (1 + 5**0.5) * k
        side = -perpendicular(self.direction)
        across = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(self.direction, side)
        towards = height[:, None] * self.direction + np.sqrt(1 - height**2)[:, None] * across
        along = distance * height
        ground = (along - np.sqrt(along**2 - distance**2 + 1))[:, None] * towards - distance * self.direction
        irradiance = 2 * (1 - limb) / BEAMS * self.albedo * np.maximum(ground @ sun, 0)
        return np.column_stack([towards, irradiance])


def visible_disc(sun: Array, earth: Array, earth_radius: float, sun_radius: float) -> float:
    """Fraction of the solar disc that is seen past the Earth's: 0 in the umbra, up to 1 in the penumbra.

    sun, earth: [3] directions towards the centres, the latter unit; earth_radius, sun_radius: angular, radians, the
    latter 0 for parallel light. The Earth is a sphere without air.

    The area that two circles of radii a and b share, their centres c apart (O. Montenbruck, E. Gill, "Satellite
    Orbits", 2000, 3.4.2), in the plane of angles: the Earth's limb bends less than 0.1 % of the Sun's disc away from
    such a circle.
    """
    a, b, light = sun_radius, earth_radius, normalize(sun)
    c = 2 * math.atan2(float(np.linalg.norm(light - earth)), float(np.linalg.norm(light + earth)))  # Kahan's angle
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
