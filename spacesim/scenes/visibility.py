"""How much of the Sun a surface point sees: shadow rays towards points of the disc.

All points of a frame are asked for a few directions, the centre and the rim; only where these disagree, in penumbrae,
for FINE ones, spread evenly over the disc. The same directions for every pixel, so the truth has no noise.
"""

import math
from typing import Any

import drjit as dr
import numpy as np

from spacesim import backend
from spacesim.data.records import Sun
from spacesim.scenes.emitters import Limb
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

    def inputs(self, sun: Sun) -> tuple[Any, Any]:
        """(unit directions to points of the disc [3, N], first the coarse ones; the limb): inputs of kernels."""
        points = np.vstack([self._coarse, self._fine])
        height = np.sqrt(1 - (points**2).sum(axis=1))
        rotated = np.column_stack([points, height]) @ frame([0, 0, 0], sun.direction)[:3, :3].T
        return backend.mitsuba().Vector3f(np.ascontiguousarray(rotated.T, np.float32)), self._limb

    def __call__(self, surface: Any, normal: Any, active: Any, inputs: tuple[Any, Any]) -> tuple[Any, Any]:
        """(visibility, shape pointer of what hides the Sun, null where nothing does) of surface points.

        surface: where rays met the scene; normal: on the lit side; active: which lanes face the Sun's centre.
        """
        mi = backend.mitsuba()
        directions, limb = inputs
        origin = surface.spawn_ray(normal).o
        seen, blocker = mi.Float(0.0), dr.zeros(mi.ShapePtr, dr.width(normal))
        for i in range(len(self._coarse)):
            towards = dr.gather(mi.Vector3f, directions, i)
            hit = self._scene.ray_intersect_preliminary(mi.Ray3f(origin, towards), active=active)
            blocker = dr.select((blocker == None) & hit.is_valid(), hit.shape, blocker)  # noqa: E711  (lane by lane)
            seen += dr.select(active & ~hit.is_valid() & _in_sky(normal, towards, limb), 1.0, 0.0)
        mixed = active & (seen > 0) & (seen < len(self._coarse))
        fine = self._count_fine(origin, normal, mixed, *inputs)
        return dr.select(mixed, fine / FINE, seen / len(self._coarse)), blocker

    def _count_fine(self, origin: Any, normal: Any, active: Any, directions: Any, limb: Any) -> Any:
        """How many of the fine directions are free, one after another: lanes that are not `active` take no part."""
        mi = backend.mitsuba()

        def waiting(i: Any, seen: Any) -> Any:
            return active & (i < FINE)

        def cast(i: Any, seen: Any) -> tuple[Any, Any]:
            towards = dr.gather(mi.Vector3f, directions, len(self._coarse) + i)
            free = ~self._scene.ray_test(mi.Ray3f(origin, towards)) & _in_sky(normal, towards, limb)
            return i + 1, seen + dr.select(free, 1.0, 0.0)

        start = dr.zeros(mi.UInt32, dr.width(normal)), dr.zeros(mi.Float, dr.width(normal))
        _, seen = dr.while_loop(start, waiting, cast, labels=("i", "seen"))
        return seen


def _in_sky(normal: Any, direction: Any, limb: Limb | None) -> Any:
    above = dr.dot(normal, direction) > 0
    return above if limb is None else above & ~limb.hides(direction)
