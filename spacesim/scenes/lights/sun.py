"""The Sun: its shape, distance and irradiance, and the default exposure."""

import math
from dataclasses import dataclass

import numpy as np

from spacesim.data.earth import ASTRONOMICAL_UNIT_KM, SOLAR_RADIUS_KM
from spacesim.data.errors import expect
from spacesim.data.geometry import Array

SOLAR_IRRADIANCE = 1361.0
"""Nominal total solar irradiance at 1 au, W m^-2 (IAU 2015 Resolution B3). Camera RGB is balanced on sunlight, so that
each of R, G and B has this value."""

EXPOSURE = math.pi / SOLAR_IRRADIANCE
"""Factor from radiance to display value: a white Lambertian surface that faces the Sun at 1 au has linear value 1."""

SHAPES = ("disc", "directional")


@dataclass(frozen=True)
class SunConfig:
    """The source. Raises InputError for a value out of range."""

    #: "disc" of even radiance and true angular radius, or "directional", parallel light without a penumbra
    shape: str = "disc"
    distance_au: float = 1.0  #: of the scene from the Sun
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)  #: camera RGB of sunlight relative to its mean

    def __post_init__(self) -> None:
        expect(self.shape in SHAPES, "shape", f"one of {', '.join(SHAPES)}", self.shape)
        expect(0.01 <= self.distance_au <= 1000, "distance_au", "a distance from 0.01 to 1000 au", self.distance_au)
        expect(min(self.color) >= 0 and max(self.color) > 0, "color", "three numbers, not all 0", self.color)

    @property
    def irradiance(self) -> Array:
        """[3] W m^-2 in camera RGB on a surface that faces the Sun: the inverse square of the distance."""
        return SOLAR_IRRADIANCE / self.distance_au**2 * np.asarray(self.color)

    @property
    def angular_radius(self) -> float:
        """Radians that the Sun's radius covers, 0 of parallel light: 0.2666 degrees at 1 au."""
        if self.shape == "directional":
            return 0.0
        return math.asin(SOLAR_RADIUS_KM / (self.distance_au * ASTRONOMICAL_UNIT_KM))
