"""The Sun's disc and the Earth as emitters for Mitsuba. Both are at infinity, so a scene holds one of them.

Which directions shine, and how brightly, are inputs of the compiled kernels: turning the Sun compiles nothing.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

import drjit as dr
import numpy as np

from spacesim import backend
from spacesim.backend import mitsuba_types as mt
from spacesim.backend.arrays import Bool, Float
from spacesim.data.geometry import Array
from spacesim.data.records import Sun
from spacesim.scenes.lights.earth import EarthConfig
from spacesim.scenes.lights.sun import SunConfig

PARALLEL = 1e-6  #: radians: the radius that densities of parallel light, which are infinite, are computed with


def kernel_input(value: float | Array) -> Any:
    """A number, or [3] numbers as a colour or vector, as an input of kernels."""
    mi = backend.mitsuba()
    result = mi.Float(value) if np.ndim(value) == 0 else mi.Vector3f(np.asarray(value, np.float64).tolist())
    dr.make_opaque(result)
    return result


@dataclass(frozen=True)
class Limb:
    """The Earth's outline, as seen from the scene: what lies behind it is hidden. An input of kernels."""

    centre: mt.Vector3f  #: unit, towards the Earth's centre
    cosine: Float  #: of the angle between the centre and the outline

    @classmethod
    def of(cls, earth: EarthConfig) -> "Limb":
        """The outline of `earth`."""
        return cls(kernel_input(earth.direction), kernel_input(math.cos(earth.angular_radius)))

    def hides(self, direction: mt.Vector3f) -> Bool:
        """Does the Earth fill the sky in unit `direction`?"""
        return dr.dot(direction, self.centre) > self.cosine


class Source(Protocol):
    """A Mitsuba emitter that follows the Sun."""

    limb: Limb | None  #: of the Earth, where it hides or reflects sunlight

    def point(self, sun: Sun) -> None:
        """Move the Sun."""

    def place(self, earth: EarthConfig) -> None:
        """Move the Earth."""


@cache
def _classes() -> tuple[type, type]:
    """(SolarDisc, Earthshine) of the chosen backend."""
    mi = backend.mitsuba()

    class Distant(mi.Emitter):  # type: ignore[name-defined]
        """Light from directions alone. Subclasses say what shines (`shines`) and how it is sampled (`draw`). outside:
        surfaces reflect on the side of their normals alone, so where one faces away no ray has to ask for shadow."""

        def __init__(self, outside: bool) -> None:
            mi.Emitter.__init__(self, mi.Properties())
            self.outside = outside
            self.m_flags = mi.EmitterFlags.Infinite
            self.reach = kernel_input(1e7)  # metres: beyond any scene, so that every part between casts a shadow

        def eval(self, si: mt.SurfaceInteraction3f, active: Bool | bool = True) -> mt.Color3f:
            return dr.select(active, self.shines(-si.wi), 0)

        def sample_direction(
            self, it: mt.Interaction3f, sample: mt.Point2f, active: Bool | bool = True
        ) -> tuple[mt.DirectionSample3f, mt.Color3f]:
            ds = dr.zeros(mi.DirectionSample3f, dr.width(it.p))
            ds.d = self.draw(sample)
            ds.dist, ds.n, ds.uv, ds.time = self.reach, -ds.d, sample, it.time
            ds.p = it.p + ds.d * ds.dist
            asked = dr.dot(it.n, ds.d) > 0 if self.outside else mi.Bool(True)
            ds.pdf, ds.delta, ds.emitter = dr.select(asked, self.density, 0), False, mi.EmitterPtr(self)
            return ds, dr.select(active & asked, self.shines(ds.d, drawn=True) / self.density, 0)

        def pdf_direction(self, it: mt.Interaction3f, ds: mt.DirectionSample3f, active: Bool | bool = True) -> Float:
            return dr.select(active & self.covers(ds.d), self.density, 0)

        def eval_direction(
            self, it: mt.Interaction3f, ds: mt.DirectionSample3f, active: Bool | bool = True
        ) -> mt.Color3f:
            return dr.select(active, self.shines(ds.d), 0)

    class SolarDisc(Distant):
        """A disc of even radiance; its rim is `angular_radius` from `direction`. Of parallel light every draw is the
        direction itself, and no path that scatters meets it."""

        def __init__(self, sun: SunConfig, earth: EarthConfig | None, outside: bool) -> None:
            super().__init__(outside)
            radius = sun.angular_radius
            self.sine, self.chord = kernel_input(math.sin(radius)), kernel_input(4 * math.sin(radius / 2) ** 2)
            size = math.pi * max(math.sin(radius), PARALLEL) ** 2  # the cosine to the axis is 1 within 1e-5 at 1 au
            self.density = kernel_input(1 / size)
            self.radiance = mi.Color3f(kernel_input(sun.irradiance / size))
            self.limb = Limb.of(earth) if earth else None
            self.point(Sun(np.array([1.0, 0.0, 0.0])))

        def place(self, earth: EarthConfig) -> None:
            """Move the Earth, which hides it."""
            self.limb = Limb.of(earth)

        def point(self, sun: Sun) -> None:
            """Move the Sun."""
            self.direction = kernel_input(sun.direction)

        def covers(self, direction: mt.Vector3f) -> Bool:
            offset = direction - self.direction
            return dr.dot(offset, offset) <= self.chord

        def shines(self, direction: mt.Vector3f, drawn: bool = False) -> mt.Color3f:
            lit = mi.Bool(True) if drawn else self.covers(direction)
            if self.limb is not None:
                lit &= ~self.limb.hides(direction)
            return dr.select(lit, self.radiance, 0)

        def draw(self, sample: mt.Point2f) -> mt.Vector3f:
            disc = self.sine * mi.warp.square_to_uniform_disk_concentric(sample)
            local = mi.Vector3f(disc.x, disc.y, dr.safe_sqrt(1 - dr.dot(disc, disc)))
            return mi.Frame3f(self.direction).to_world(local)

    class Earthshine(Distant):
        """Sunlight that a Lambertian sphere reflects: radiance albedo E / pi max(n . s, 0), n its normal where a
        direction meets it. Its night side is dark."""

        def __init__(self, earth: EarthConfig, sun: SunConfig, outside: bool) -> None:
            super().__init__(outside)
            self.place(earth)
            self.full = mi.Color3f(kernel_input(earth.albedo / math.pi * sun.irradiance))
            self.point(Sun(np.array([1.0, 0.0, 0.0])))

        def place(self, earth: EarthConfig) -> None:
            """Move the Earth; its albedo stays."""
            self.limb = Limb.of(earth)
            self.centre, self.distance = kernel_input(earth.direction), kernel_input(earth.distance)
            self.density = kernel_input(1 / (2 * math.pi * (1 - math.cos(earth.angular_radius))))

        def point(self, sun: Sun) -> None:
            """Move the Sun: the phase changes."""
            self.sun = kernel_input(sun.direction)

        def covers(self, direction: mt.Vector3f) -> Bool:
            return self.limb.hides(direction)

        def shines(self, direction: mt.Vector3f, drawn: bool = False) -> mt.Color3f:
            along = self.distance * dr.dot(direction, self.centre)  # lengths are in Earth radii
            ahead = along - dr.safe_sqrt(along * along - self.distance * self.distance + 1)
            normal = ahead * direction - self.distance * self.centre
            lit = mi.Bool(True) if drawn else self.covers(direction)
            return dr.select(lit, self.full * dr.maximum(dr.dot(normal, self.sun), 0), 0)

        def draw(self, sample: mt.Point2f) -> mt.Vector3f:
            return mi.Frame3f(self.centre).to_world(mi.warp.square_to_uniform_cone(sample, self.limb.cosine))

    return SolarDisc, Earthshine


def solar_disc(sun: SunConfig, earth: EarthConfig | None = None, outside: bool = False) -> Source:
    """The Sun as a Mitsuba emitter; the Earth hides it where it is before it. outside: every surface is closed and
    flat-shaded, and reflects on its outside alone."""
    return _classes()[0](sun, earth, outside)


def earthshine(earth: EarthConfig, sun: SunConfig, outside: bool = False) -> Source:
    """The Earth as a Mitsuba emitter. outside: as for the Sun"""
    return _classes()[1](earth, sun, outside)
