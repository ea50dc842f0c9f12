"""How much of the Sun a surface point sees: shadow rays towards points of the disc.

All points of a frame are asked for a few directions, the centre and the rim; only where these disagree, in penumbrae,
for FINE ones, spread evenly over the disc. The same directions for every pixel, so the truth has no noise.
"""

import math
from typing import Any

import drjit as dr
import numpy as np

from spacesim import backend
from spacesim.data.geometry import Array
from spacesim.data.records import Sun
from spacesim.scenes.emitters import Limb, opaque
from spacesim.scenes.shapes import frame
from spacesim.scenes.sun import SunConfig

RIM = 8  #: directions on the rim: a straight edge that passes between two of them hides 1.2 % of the disc at most
FINE = 256  #: directions in penumbrae: steps of 0.4 %


class SunVisibility:
    """Asks a loaded scene. limb: of the Earth, which can hide the Sun too."""

    def __init__(self, scene: Any, sun: SunConfig, limb: Limb | None) -> None:
        self._scene, self._limb = scene, limb
        angle = 2 * math.pi * np.arange(RIM) / RIM
        rim = 0.999 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        k = np.arange(FINE)
        radius, turn = np.sqrt((k + 0.5) / FINE), k * math.pi * (3 - 5**0.5)  # Vogel 1979: a sunflower's seeds
        fine = radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        sine = math.sin(sun.angular_radius)
        self._coarse = sine * np.vstack([np.zeros((1, 2)), rim if sine else np.empty((0, 2))])
        self._fine = sine * fine

    def __call__(self, surface: Any, normal: Any, active: Any, sun: Sun) -> tuple[Any, Any]:
        """(visibility, shape pointer of what hides the Sun, null where nothing does) of surface points.

        surface: where rays met the scene; normal: on the lit side; active: which lanes face the Sun's centre.
        """
        mi = backend.mitsuba()
        directions = self._directions(self._coarse, sun)
        origin = surface.spawn_ray(normal).o
        seen, blocker = mi.Float(0.0), dr.zeros(mi.ShapePtr, dr.width(normal))
        for direction in directions:
            towards = mi.Vector3f(opaque(direction))
            hit = self._scene.ray_intersect_preliminary(mi.Ray3f(origin, towards), active=active)
            blocker = dr.select((blocker == None) & hit.is_valid(), hit.shape, blocker)  # noqa: E711  (lane by lane)
            seen += dr.select(active & ~hit.is_valid() & self._in_sky(normal, towards), 1.0, 0.0)
        visibility = seen / len(directions)
        mixed = active & (seen > 0) & (seen < len(directions))
        dr.eval(visibility, blocker, mixed, origin, normal)
        lanes = dr.compress(mixed)
        if dr.width(lanes) > 0:
            dr.scatter(visibility, self._refined(origin, normal, lanes, sun), lanes)
        return visibility, blocker

    def _refined(self, origin: Any, normal: Any, lanes: Any, sun: Sun) -> Any:
        """Visibility from the points in `lanes`: a shadow ray for each of them and each fine direction."""
        mi = backend.mitsuba()
        table = mi.Vector3f(np.ascontiguousarray(self._directions(self._fine, sun).T, np.float32))
        index = dr.arange(mi.UInt32, FINE * dr.width(lanes))
        lane = dr.gather(mi.UInt32, lanes, index // FINE)
        start, axis, direction = (
            mi.Vector3f(*(dr.gather(mi.Float, x, i) for x in vector))
            for vector, i in ((origin, lane), (normal, lane), (table, index % FINE))
        )
        free = ~self._scene.ray_test(mi.Ray3f(mi.Point3f(start), direction)) & self._in_sky(axis, direction)
        return dr.block_sum(dr.select(free, mi.Float(1.0), 0.0), FINE) / FINE

    def _in_sky(self, normal: Any, direction: Any) -> Any:
        above = dr.dot(normal, direction) > 0
        return above if self._limb is None else above & ~self._limb.hides(direction)

    def _directions(self, points: Array, sun: Sun) -> Array:
        """[N, 3] unit directions to `points` [N, 2] of the disc, in units of the unit sphere about its centre."""
        height = np.sqrt(1 - (points**2).sum(axis=1))
        return np.column_stack([points, height]) @ frame([0, 0, 0], sun.direction)[:3, :3].T
