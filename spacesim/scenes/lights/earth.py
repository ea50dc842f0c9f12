"""The Earth as a second source: a Lambertian sphere, lit by the same Sun, that fills part of the sky."""

import math
from dataclasses import dataclass

from spacesim.data.earth import EARTH_ALBEDO, Earth
from spacesim.data.errors import expect
from spacesim.data.geometry import Array, direction_from_angles

EARTH_RADIUS_KM = 6378.137
"""Equatorial radius of the Earth (WGS 84): altitudes of orbits are counted from it, so it is the sphere's here as well.
The mean radius is 6371.0 km: the sphere gives up to 0.2 % more light for it, far less than albedos are known to."""


@dataclass(frozen=True)
class EarthConfig:
    """Where the Earth is and how bright. Raises InputError for a value out of range."""

    azimuth_deg: float = 0.0  #: direction from the scene towards the Earth's centre, world frame
    elevation_deg: float = -90.0  #: as `azimuth_deg`
    altitude_km: float = 500.0  #: of the scene above the ground
    albedo: float = EARTH_ALBEDO  #: of the sphere, the same in all channels

    def __post_init__(self) -> None:
        expect(math.isfinite(self.azimuth_deg), "azimuth_deg", "a finite angle", self.azimuth_deg)
        expect(-90 <= self.elevation_deg <= 90, "elevation_deg", "an angle from -90 to 90 degrees", self.elevation_deg)
        expect(10 <= self.altitude_km <= 1e7, "altitude_km", "an altitude from 10 to 10,000,000 km", self.altitude_km)
        expect(0 <= self.albedo <= 1, "albedo", "a fraction from 0 to 1", self.albedo)

    @property
    def direction(self) -> Array:
        """[3] unit vector towards the Earth's centre."""
        return direction_from_angles(self.azimuth_deg, self.elevation_deg)

    @property
    def distance(self) -> float:
        """Of the Earth's centre, in Earth radii."""
        return 1 + self.altitude_km / EARTH_RADIUS_KM

    @property
    def angular_radius(self) -> float:
        """Radians from the Earth's centre to its limb."""
        return math.asin(1 / self.distance)

    @property
    def light(self) -> Earth:
        """As datasets name it."""
        return Earth(self.direction, math.degrees(self.angular_radius), self.albedo)
