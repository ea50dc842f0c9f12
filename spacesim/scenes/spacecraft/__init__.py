"""Spacecraft as named parts: closed meshes in the body frame (metres), a material each."""

from spacesim.scenes.spacecraft.boxsat import boxsat
from spacesim.scenes.spacecraft.catalogue import SPACECRAFT, spacecraft
from spacesim.scenes.spacecraft.part import Part, Spacecraft

__all__ = ["SPACECRAFT", "Part", "Spacecraft", "boxsat", "spacecraft"]
