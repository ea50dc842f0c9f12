"""The Earth as a picture: what stands where on a made-up globe, and the light that ground, clouds and air send.

The ground and the clouds are Lambertian: radiance A E mu_s / pi, weakened by the air on both ways, where the half of
what air scatters that goes forwards counts as not scattered. For the light of the air itself it scatters once, by
Rayleigh's phase function P, in plane-parallel layers (J. E. Hansen, L. D. Travis, "Light scattering in planetary
atmospheres", Space Science Reviews 16, 1974):

    L = E P / (4 pi)  mu_s / (mu_s + mu_v)  (1 - exp(-tau (1 / mu_s + 1 / mu_v)))

and beyond the limb along a chord at the tangent height h, of optical depth tau exp(-h / H) sqrt(2 pi R / H).

Albedos are within what T. R. Oke, "Boundary Layer Climates", 2nd edition, 1987, table 1.1, gives for the whole
solar spectrum (water 0.03 to 0.10, forests 0.05 to 0.20, desert 0.20 to 0.45, snow 0.40 to 0.95); their hues are
assumed. How much is land and how much is under clouds follows what is known of the Earth: 29 % and 67 % (M. D. King et
al., "Spatial and temporal distribution of clouds observed by MODIS", IEEE TGRS 51, 2013).
"""

import math
from dataclasses import dataclass

import drjit as dr
import numpy as np

from spacesim import backend
from spacesim.backend import mitsuba_types as mt
from spacesim.backend.arrays import Float, UInt32
from spacesim.backend.readback import AsyncArray
from spacesim.data.geometry import Array
from spacesim.data.records import Camera, Sun
from spacesim.scenes.background.noise import octaves
from spacesim.scenes.cameras.kernel_camera import KernelCamera, Units, record_on_cuda
from spacesim.scenes.lights.earth import EARTH_RADIUS_KM
from spacesim.scenes.lights.emitters import kernel_input
from spacesim.scenes.steps import Steps

OCEAN, FOREST, STEPPE, DESERT = (0.022, 0.038, 0.062), (0.055, 0.085, 0.040), (0.16, 0.15, 0.085), (0.38, 0.30, 0.20)
ICE, CLOUD = (0.74, 0.77, 0.80), (0.74, 0.74, 0.74)
"""Albedos in linear camera RGB."""

RAYLEIGH = (0.0493, 0.0973, 0.2213)
"""Optical depth of the air at 650, 550 and 450 nm: 0.008569 l^-4 (1 + 0.0113 l^-2 + 0.00013 l^-4), l in micrometres
(Hansen and Travis 1974)."""

SCALE_HEIGHT = 8.0 / EARTH_RADIUS_KM
"""Of the air, in Earth radii: 8 km (U.S. Standard Atmosphere 1976, R T / g at 273 K)."""

CHORD = math.sqrt(2 * math.pi / SCALE_HEIGHT)
"""Optical depth of a ray that grazes the ground, over the vertical one."""

TWILIGHT = 0.056
"""Sine of how far beyond the terminator air at 10 km, a mean height of what is seen at the limb, is sunlit."""


@dataclass(frozen=True, eq=False)
class Placement:
    """Where the Earth is, as seen from the scene."""

    direction: Array  #: [3] unit, world frame, towards its centre
    distance: float  #: of its centre, Earth radii
    globe_from_world: Array  #: [3, 3] world axes to those of the globe, whose z is the pole

    def normal_behind(self, direction: Array) -> Array | None:
        """[3] unit, world frame: the ground's normal that is seen in a unit direction [3]; None where none is."""
        along = self.distance * float(direction @ self.direction)
        inside = along * along - self.distance**2 + 1
        if along <= 0 or inside < 0:
            return None
        return (along - math.sqrt(inside)) * direction - self.distance * self.direction


class Globe:
    """Draws the Earth.

    units: of the scene
    distortion: of the lens
    irradiance: [3] of sunlight, W m^-2
    seed: makes the continents and clouds
    """

    def __init__(self, units: Units, distortion: tuple[float, ...], irradiance: Array, seed: int) -> None:
        self._units, self._distortion = units, distortion
        self._irradiance = kernel_input(irradiance)
        self._seed = dr.opaque(backend.mitsuba().UInt32, seed)
        self._trace = record_on_cuda(self._shade)

    def draw(self, camera: Camera, sun: Sun, place: Placement) -> Steps[tuple[np.ndarray, np.ndarray]]:
        """(radiance [H, W, 3], W m^-2 sr^-1, of ground, clouds and air; cover [H, W], the share of each pixel that the
        ground fills)."""
        view = KernelCamera.of(camera, self._units)
        axes = [kernel_input(axis) for axis in place.globe_from_world]
        inputs = kernel_input(place.direction), kernel_input(place.distance), *axes, kernel_input(sun.direction)
        read = AsyncArray(self._trace(view, inputs, self._irradiance, self._seed))
        yield
        values, shape = read.wait(), (camera.height, camera.width)
        count = math.prod(shape)
        return values[: 3 * count].reshape(*shape, 3), values[3 * count :].reshape(shape)

    def _shade(
        self, view: KernelCamera, inputs: tuple[Float | mt.Vector3f, ...], irradiance: mt.Vector3f, seed: UInt32
    ) -> Float:
        """RGB, then cover, of each pixel, [3 H W + H W]."""
        mi = backend.mitsuba()
        centre, distance, *axes, sun = inputs
        ray, _ = view.rays(dr.arange(mi.UInt32, view.width * view.height), mi.Point2f(0.5), self._distortion)
        d = ray.d
        ahead = dr.dot(d, view.forward)
        pixel = dr.sqrt(ahead * ahead * ahead / (view.focal[0] * view.focal[1]))  # radians, the root of its solid angle

        # the tangent ray's distance from the centre, in Earth radii, without the cancellation of along^2 - D^2 + 1
        across = dr.cross(centre, d)
        sine = dr.norm(across)
        miss, cosine = distance * sine, dr.dot(centre, d)
        to_limb = dr.asin(1 / distance) - dr.atan2(sine, cosine)  # radians, positive over the ground
        cover = dr.clip(0.5 + to_limb / pixel, 0, 1)
        half = dr.safe_sqrt(1 - miss * miss)  # of the chord within the sphere
        reach = dr.select(miss < 1, distance * cosine - half, distance * cosine)
        normal = dr.normalize(reach * d - distance * centre)
        mu_v, mu_s = dr.clip(half, 0, 1), dr.dot(normal, sun)

        # ground and clouds under the air
        tau, phase = mi.Color3f(*RAYLEIGH), _rayleigh_phase(dr.dot(d, sun))
        slant_v = dr.rcp(dr.sqrt(mu_v * mu_v + (2 / CHORD) ** 2))  # the air bends away with the ground
        day = dr.maximum(mu_s, 0)
        slant_s = dr.rcp(dr.sqrt(day * day + (2 / CHORD) ** 2))
        width = dr.maximum(reach, 0) * pixel * dr.rsqrt(dr.maximum(mu_v, 0.02))
        width = dr.select((cover > 0) & (day > 0), width, dr.inf)  # noise is not looked at elsewhere, and ends at once
        point = mi.Point3f(*(dr.dot(axis, normal) for axis in axes))
        through = dr.exp(-tau * (slant_s + slant_v))
        ground = albedo(point, width, seed) * (day / math.pi) * dr.sqrt(through)
        air = phase / (4 * math.pi) * slant_v / (slant_s + slant_v) * (1 - through)

        # the limb, the mean over four heights of each pixel
        glow = mi.Color3f(0)
        for step in (-0.375, -0.125, 0.125, 0.375):
            height = dr.maximum(miss - 1 + step * pixel * dr.maximum(distance * cosine, 0), 0)
            glow += 0.25 * (1 - dr.exp(-tau * CHORD * dr.exp(-height / SCALE_HEIGHT)))
        lit = _smoothstep(mu_s, -TWILIGHT, TWILIGHT)
        glow *= phase / (4 * math.pi) * lit * dr.select(cosine > 0, mi.Float(1), 0)
        color = mi.Color3f(irradiance) * (cover * (ground + air * lit) + (1 - cover) * glow)
        return dr.concat([dr.ravel(color), cover])


def albedo(point: mt.Point3f, width: Float, seed: UInt32) -> mt.Color3f:
    """Albedo of the globe at unit vectors `point`, the pole at +z; width: of a pixel there, in radii."""
    mi = backend.mitsuba()
    latitude = dr.abs(point.z)  # its sine
    warp = octaves(point, seed, 3, 1.7, 0.5, width)
    flow = mi.Point3f(point.x, point.y, 1.4 * point.z)  # clouds are longer from west to east
    swirl = octaves(flow, seed + 2, 3, 2.6, 0.55, width)
    fine = octaves(flow + 0.02 * swirl, seed + 4, 11, 23.0, 0.68, width)  # cells of 280 km and less

    shape = octaves(point + 0.35 * warp, seed + 1, 12, 1.15, 0.57, width)
    land = _smoothstep(shape.x, 0.1, 0.115)
    relief, wet = shape.y + 0.5 * fine.y, shape.z + 0.35 * fine.z
    dry = dr.exp(-dr.square((latitude - 0.40) / 0.17)) + 0.55 * wet - 0.15
    plants = _mix(FOREST, STEPPE, _smoothstep(dry, 0.15, 0.45))
    soil = _mix(plants, DESERT, _smoothstep(dry, 0.45, 0.85)) * (1 + 0.5 * dr.clip(relief, -1, 1))
    surface = dr.lerp(mi.Color3f(*OCEAN), soil, land)
    surface = _mix(surface, ICE, _smoothstep(latitude + 0.06 * wet + 0.05 * land, 0.955, 0.985))

    cloud = octaves(flow + 0.11 * swirl, seed + 3, 14, 3.7, 0.64, width)
    wetness = 0.10 * dr.cos(3 * math.pi * latitude) + 0.30 * warp.z  # belts at the equator and at 42 degrees
    sheets = 0.9 * _smoothstep(cloud.x + wetness, -0.23, 0.8)
    heaps = _smoothstep(fine.x + 0.9 * (cloud.y + wetness), 0.05, 0.85)
    return _mix(surface, CLOUD, 1 - (1 - sheets) * (1 - heaps))


Colors = mt.Color3f | tuple[float, float, float]  #: of each point, or one of all


def _mix(first: Colors, second: Colors, share: Float) -> mt.Color3f:
    """Of two colours, by the share of the second."""
    color = backend.mitsuba().Color3f
    one, other = (color(*value) if isinstance(value, tuple) else value for value in (first, second))
    return dr.lerp(one, other, share)


def _smoothstep(x: Float, low: float, high: float) -> Float:
    t = dr.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def _rayleigh_phase(cosine: Float) -> Float:
    """Rayleigh's, of mean 1 over the sphere; cosine: of the angle between the ray from the camera and the Sun."""
    return 0.75 * (1 + cosine * cosine)
