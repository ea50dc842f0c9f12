"""How much of the Sun a surface point sees: shadow rays towards points of the disc.

All points of a frame are asked for a few directions, the centre and the rim; only where these disagree, in penumbrae,
for FINE ones, spread evenly over the disc. The same directions for every pixel, so the truth has no noise.
"""

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from spacesim import backend
from spacesim.data.records import Sun
from spacesim.scenes.emitters import Limb, opaque
from spacesim.scenes.shapes import frame
from spacesim.scenes.sun import SunConfig

RIM = 8  #: directions on the rim: a straight edge that passes between two of them hides 1.2 % of the disc at most
FINE = 256  #: directions in penumbrae: steps of 0.4 %


class SunVisibility:
    """Asks scenes. limb: of the Earth, which can hide the Sun too."""

    def __init__(self, sun: SunConfig, limb: Limb | None) -> None:
        self._limb = limb
        angle = 2 * math.pi * np.arange(RIM) / RIM
        rim = 0.999 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        k = np.arange(FINE)
        radius, turn = np.sqrt((k + 0.5) / FINE), k * math.pi * (3 - 5**0.5)  # Vogel 1979: a sunflower's seeds
        fine = radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        sine = math.sin(sun.angular_radius)
        self._coarse = sine * np.vstack([np.zeros((1, 2)), rim if sine else np.empty((0, 2))])
        self._fine = sine * fine

    def inputs(self, sun: Sun) -> "Disc":
        """What the kernels need of `sun`."""
        points = np.vstack([self._coarse, self._fine])
        height = np.sqrt(1 - (points**2).sum(axis=1))
        rotated = np.column_stack([points, height]) @ frame([0, 0, 0], sun.direction)[:3, :3].T
        directions = backend.mitsuba().Vector3f(np.ascontiguousarray(rotated.T, np.float32))
        return Disc(opaque(sun.direction), directions, self._limb)

    def coarse(self, scene: Any, disc: "Disc", origin: Any, normal: Any, active: Any) -> tuple[Any, Any]:
        """(visibility, shape pointer of what hides the Sun, null where nothing does) by the few directions.

        origin, normal: surface points and their normals on the lit side; active: which lanes face the Sun's centre.
        """
        mi = backend.mitsuba()
        seen, blocker = mi.Float(0.0), dr.zeros(mi.ShapePtr, dr.width(normal))
        for i in range(len(self._coarse)):
            towards = dr.gather(mi.Vector3f, disc.directions, i)
            hit = scene.ray_intersect_preliminary(mi.Ray3f(origin, towards), active=active)
            blocker = dr.select((blocker == None) & hit.is_valid(), hit.shape, blocker)  # noqa: E711  (lane by lane)
            seen += dr.select(active & ~hit.is_valid() & disc.in_sky(normal, towards), 1.0, 0.0)
        return seen / len(self._coarse), blocker

    def fine(self, scene: Any, disc: "Disc", origin: Any, normal: Any, active: Any) -> Any:
        """Visibility by the many directions, neighbouring lanes taking the same point's. Lanes that are not `active`
        take no part."""
        mi = backend.mitsuba()
        index = dr.arange(mi.UInt32, FINE * dr.width(active))
        lane = index // FINE
        live = dr.gather(mi.Bool, active, lane)
        towards = dr.gather(mi.Vector3f, disc.directions, len(self._coarse) + index % FINE)
        start, axis = (
            mi.Vector3f(*(dr.gather(mi.Float, x, lane, live) for x in vector)) for vector in (origin, normal)
        )
        blocked = scene.ray_test(mi.Ray3f(mi.Point3f(start), towards), active=live)
        free = live & ~blocked & disc.in_sky(axis, towards)
        return dr.block_sum(dr.select(free, mi.Float(1.0), 0.0), FINE, mode="evaluated") / FINE


@dataclass(frozen=True)
class Disc:
    """The Sun as inputs of kernels. direction: of its centre; directions: [3, N] unit vectors to points of the disc,
    the few, then the many; limb: of the Earth, or None."""

    direction: Any
    directions: Any
    limb: Limb | None

    def in_sky(self, normal: Any, direction: Any) -> Any:
        """Is `direction` above the surface's horizon and beside the Earth?"""
        above = dr.dot(normal, direction) > 0
        return above if self.limb is None else above & ~self.limb.hides(direction)
