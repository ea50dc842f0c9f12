"""How much of the Sun a surface point sees: shadow rays towards points of the disc.

The same directions for every point, so the truth has no noise.
"""

import math
from dataclasses import dataclass

import drjit as dr
import numpy as np

from spacesim import backend
from spacesim.backend import mitsuba_types as mt
from spacesim.backend.arrays import Bool
from spacesim.data.geometry import Array
from spacesim.data.records import Sun
from spacesim.scenes.lights.emitters import Limb
from spacesim.scenes.lights.sun import SunConfig
from spacesim.scenes.shapes import axis_frame

RIM = 8  #: directions on the rim: a straight edge that passes between two of them hides 1.2 % of the disc at most
FINE = 256  #: directions all over the disc: steps of 0.4 %
LEAST = 1e-9
"""Components of a ray's direction below this are 0 for Embree: beside one below 1e-18, as turned axes have them, its
coherent rays miss a quarter of what they meet alone."""


@dataclass(frozen=True)
class Disc:
    """Directions to points of the Sun's disc, inputs of kernels."""

    count: int  #: of the directions
    directions: mt.Vector3f  #: `count` unit vectors
    limb: Limb | None  #: of the Earth, which can hide the Sun too, or None

    def seen(
        self, scene: mt.Scene, origin: mt.Vector3f, normal: mt.Vector3f, active: Bool
    ) -> tuple[Bool, Bool, mt.PreliminaryIntersection3f]:
        """From points [3, N] with their `normal` on the lit side; `active` says which of them are asked.

        Returns for each point and direction, [N count], neighbouring elements taking the same point: whether the Sun is
        seen there, whether a shape hides it, and where the ray meets that.
        """
        mi = backend.mitsuba()
        index = dr.arange(mi.UInt32, self.count * dr.width(active))
        point = index // self.count
        is_active = dr.gather(mi.Bool, active, point)
        start, axis = (mi.Vector3f(*(dr.gather(mi.Float, x, point) for x in vector)) for vector in (origin, normal))
        direction = dr.gather(mi.Vector3f, self.directions, index - point * self.count)
        along = mi.Vector3f(*(dr.select(dr.abs(component) < LEAST, 0, component) for component in direction))
        ray = mi.Ray3f(mi.Point3f(start), along)
        hit = scene.ray_intersect_preliminary(ray, coherent=mi.Bool(True), active=is_active)
        free = is_active & ~hit.is_valid() & (dr.dot(axis, direction) > 0)
        if self.limb is not None:
            free &= ~self.limb.hides(direction)
        return free, is_active & hit.is_valid(), hit


class SolarDirections:
    """Directions to a Sun's disc; sun: how large it is."""

    def __init__(self, sun: SunConfig) -> None:
        angle = 2 * math.pi * np.arange(RIM) / RIM
        rim = 0.999 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        k = np.arange(FINE)
        radius, turn = np.sqrt((k + 0.5) / FINE), k * math.pi * (3 - 5**0.5)  # Vogel 1979: a sunflower's seeds
        fine = radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        sine = math.sin(sun.angular_radius)
        self._coarse = sine * np.vstack([np.zeros((1, 2)), rim if sine else np.empty((0, 2))])
        self._fine = sine * fine

    def few(self, sun: Sun, limb: Limb | None) -> Disc:
        """The disc's centre and rim. limb: of the Earth, or None."""
        return self._disc(self._coarse, sun, limb)

    def many(self, sun: Sun, limb: Limb | None) -> Disc:
        """Directions spread evenly over the disc, from its centre outwards."""
        return self._disc(self._fine, sun, limb)

    def _disc(self, points: Array, sun: Sun, limb: Limb | None) -> Disc:
        height = np.sqrt(1 - (points**2).sum(axis=1))
        rotated = np.column_stack([points, height]) @ axis_frame([0, 0, 0], sun.direction)[:3, :3].T
        directions = backend.mitsuba().Vector3f(np.ascontiguousarray(rotated.T, np.float32))
        return Disc(len(points), directions, limb)
