"""The Earth as a source of light: a Lambertian sphere, lit by the Sun, that fills part of the sky."""

import math
from dataclasses import dataclass

import numpy as np

from spacesim.data.errors import expect
from spacesim.data.geometry import Array, normalize, perpendicular

EARTH_ALBEDO = 0.294
"""Bond albedo of the Earth (D. R. Williams, "Earth Fact Sheet", NASA Goddard Space Flight Center); to the two digits
that G. L. Stephens et al. give ("The albedo of Earth", Reviews of Geophysics 53, 2015), 0.29."""

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
        direction = np.asarray(self.direction, np.float64)
        is_vector = direction.shape == (3,) and bool(np.isfinite(direction).all() and np.abs(direction).max() > 0)
        expect(is_vector, "earth_direction", "3 finite numbers, not all 0", self.direction)
        radius = self.angular_radius_deg
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
