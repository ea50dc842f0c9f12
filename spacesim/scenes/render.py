"""One frame of a scene with all its truth, by Mitsuba's path integrator and a short loop of our own.

Radiance and alpha are means over samples spread evenly over the pixel (a box filter), summed pixel by pixel
in a fixed order: splatting into a film adds floats in whatever order threads arrive. Labels come from one ray
through the pixel's centre, so that none is ever averaged. Same seed, same backend: same bits.

Both are recorded once for each size of picture and replayed: tracing the integrator anew takes 10 ms a frame.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from spacesim import backend
from spacesim.data.geometry import Array, fibonacci_sphere
from spacesim.data.images import undistorted
from spacesim.data.records import Camera, Sun, Truth
from spacesim.data.store import SHADOW_ATTACHED, SHADOW_LIT, SHADOW_NONE, SHADOW_SELF_CAST
from spacesim.scenes.emitters import opaque
from spacesim.scenes.scene import Scene, load
from spacesim.scenes.visibility import Disc, SunVisibility

MAX_WAVEFRONT = 1 << 24
"""Most samples in flight at once, 16 bytes each: more are rendered in several passes."""

_EARTH = 1  # stream of random numbers

_R2_STEPS = (3242174889, 2447445414)
"""2^32 / g and 2^32 / g^2 with g^3 = g + 1 (Roberts 2018, "The unreasonable effectiveness of quasirandom
sequences"): unsigned overflow keeps the fraction."""

_DIRECTIONS = fibonacci_sphere(64)

RECORDINGS = 16
"""Recorded kernels kept of each kind: one for each size of picture."""


class Renderer:
    """A scene loaded once, from which frames are rendered under any Sun.

    spp: samples a pixel; max_depth: longest path in edges from camera to source (2 is direct light only);
    distortion: Brown-Conrady k1, k2, p1, p2, k3 of the lens, () none.
    """

    def __init__(self, scene: Scene, spp: int, max_depth: int = 6, distortion: Sequence[float] = ()) -> None:
        mi = backend.mitsuba()
        self.scene = scene
        self.spp = spp
        self._distortion = tuple(distortion)
        self._loaded = load(scene)
        self._scene = self._loaded.sunlit
        self._integrator = mi.load_dict({"type": "path", "max_depth": max_depth, "hide_emitters": True})
        self._sampler = mi.load_dict({"type": "independent"})
        self._parts = _PartTable.of(scene, self._scene)
        self._visibility = SunVisibility(scene.sun, self._loaded.sun.limb)
        self._sums = dr.freeze(self._trace_paths, warn_after=RECORDINGS, limit=RECORDINGS)
        self._centres = dr.freeze(self._trace_centres, warn_after=RECORDINGS, limit=RECORDINGS)
        self._penumbrae = dr.freeze(self._trace_penumbrae, warn_after=RECORDINGS, limit=RECORDINGS)

    def render(self, camera: Camera, sun: Sun, seed: Sequence[int]) -> Truth:
        """What `camera` sees under `sun`; `seed` makes the noise."""
        self._loaded.point(sun)
        sunlight = self._launched(self._loaded.sunlit, camera, seed)
        earthlight = self._launched(self._loaded.earthlit, camera, (*seed, _EARTH)) if self._loaded.earthlit else None
        labels = self._labels(camera, sun)  # while the device traces paths
        radiance, alpha = self._means(sunlight, camera)
        if earthlight is None:
            return Truth(radiance=radiance, alpha=alpha, **labels)
        earth, _ = self._means(earthlight, camera)
        return Truth(radiance=radiance + earth, alpha=alpha, **labels, radiance_earth=earth)

    def _launched(self, scene: Any, camera: Camera, seed: Sequence[int]) -> list[Any]:
        """Sums over samples, as `_trace_paths` returns them, of each pass; the device may still be at work on them."""
        uint, view = backend.mitsuba().UInt32, _View.of(camera)
        passes = min(self.spp, -(-self.spp * view.width * view.height // MAX_WAVEFRONT))
        seeds = [dr.opaque(uint, int(state)) for state in np.random.SeedSequence(seed).generate_state(passes)]
        firsts = [self.spp * i // passes for i in range(passes + 1)]
        return [
            self._sums(scene, view, _Noise(seeds[i], seeds[0], dr.opaque(uint, firsts[i])), firsts[i + 1] - firsts[i])
            for i in range(passes)
        ]

    def _means(self, sums: Sequence[Any], camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Radiance from one source [H, W, 3] and alpha [H, W], means over the samples of each pixel."""
        total: np.ndarray = sum(values.numpy() for values in sums) / np.float32(self.spp)
        shape = camera.height, camera.width
        return total[: -math.prod(shape)].reshape(*shape, 3), total[-math.prod(shape) :].reshape(shape)

    def _trace_paths(self, scene: Any, view: "_View", noise: "_Noise", spp: int) -> Any:
        """Sums of RGB, then of alpha, over `spp` samples a pixel, [3 H W + H W]."""
        mi = backend.mitsuba()
        samples = spp * view.width * view.height
        self._sampler.seed(noise.sampler, samples)
        lane = dr.arange(mi.UInt32, samples)
        pixel = lane // spp
        ray = view.rays(pixel, _pixel_offsets(pixel, lane - pixel * spp + noise.first, noise.shift), self._distortion)
        radiance, hit, _ = self._integrator.sample(scene, self._sampler, ray)
        channels = [*radiance, dr.select(hit, mi.Float(1.0), mi.Float(0.0))]
        dr.eval(channels)
        *rgb, alpha = (dr.block_sum(x, spp, mode="evaluated") for x in channels)
        return dr.concat([dr.ravel(mi.Color3f(rgb)), alpha])

    def _labels(self, camera: Camera, sun: Sun) -> dict[str, np.ndarray]:
        """All fields of Truth but radiance and alpha, from the ray through each pixel's centre."""
        mi = backend.mitsuba()
        disc = self._visibility.inputs(sun)
        numbers, ids, points, mixed = self._centres(self._scene, self._parts, _View.of(camera), disc)
        lanes = dr.compress(mixed)
        labels = _images(numbers, ids, camera)
        count = dr.width(lanes)
        if count:
            capacity = max(1024, 1 << (count - 1).bit_length())
            inputs = disc, points, lanes, dr.opaque(mi.UInt32, count), capacity
            refined: Any = self._penumbrae(self._scene, *inputs)
            seen, shadow = (np.asarray(values.numpy()[:count]) for values in refined)
            labels["sun_visibility"].reshape(-1)[lanes.numpy()] = seen
            labels["shadow"].reshape(-1)[lanes.numpy()] = shadow
        return labels

    def _trace_centres(self, scene: Any, parts: "_PartTable", view: "_View", disc: Disc) -> tuple[Any, ...]:
        """(the labels that are numbers, one after another; those that are ids, packed; points; which of them see some
        of the Sun's disc and not all)."""
        mi = backend.mitsuba()
        ray = view.rays(dr.arange(mi.UInt32, view.width * view.height), mi.Point2f(0.5), self._distortion)
        surface = scene.ray_intersect(ray)
        hit = surface.is_valid()
        normal = dr.select(dr.dot(surface.n, ray.d) > 0, -surface.n, surface.n)
        object_id, part_id = parts.ids(surface.shape, hit)
        cosine = dr.dot(normal, disc.direction)
        faces_sun = hit & (cosine > 0)
        origin = surface.spawn_ray(normal).o
        visibility, blocker = self._visibility.coarse(scene, disc, origin, normal, faces_sun)
        blocker_id, _ = parts.ids(blocker, faces_sun)
        cast = SHADOW_SELF_CAST + dr.select((blocker_id == 0) | (blocker_id == object_id), 0, blocker_id)
        shadow = dr.select(hit, dr.select(faces_sun, _shadow(visibility, cast), SHADOW_ATTACHED), SHADOW_NONE)
        distance = dr.select(hit, surface.t, 0.0)
        numbers: dict[str, Any] = {
            "depth": distance * dr.dot(ray.d, view.forward),
            "distance": distance,
            "sun_visibility": dr.select(faces_sun, visibility, 0.0),
            "sun_cosine": dr.select(hit, cosine, 0.0),
            "normal": dr.select(hit, normal, 0.0),
            "albedo": parts.albedo(surface, hit),
        }
        dr.eval(numbers, object_id, part_id, shadow, origin, normal, cast, visibility, faces_sun)  # one kernel
        flat: list[Any] = [dr.ravel(values) for values in numbers.values()]
        return (
            dr.concat(flat),
            object_id | (part_id << 8) | (shadow << 16),
            _Points(origin, normal, cast),
            faces_sun & (visibility > 0) & (visibility < 1),
        )

    def _trace_penumbrae(
        self, scene: Any, disc: Disc, points: "_Points", lanes: Any, count: Any, capacity: int
    ) -> tuple[Any, Any]:
        """(visibility, shadow class) of the points `lanes`, the first `count` of `capacity`."""
        mi = backend.mitsuba()
        index = dr.arange(mi.UInt32, capacity)
        active = index < count
        lane = dr.gather(mi.UInt32, lanes, index, active)
        origin, normal = (
            mi.Vector3f(*(dr.gather(mi.Float, x, lane, active) for x in vector))
            for vector in (points.origin, points.normal)
        )
        cast = dr.gather(mi.UInt32, points.cast, lane, active)
        visibility = self._visibility.fine(scene, disc, origin, normal, active)
        return visibility, _shadow(visibility, cast)

    def inside(self, positions: Array) -> np.ndarray:
        """[N] bool: which of the `positions` [N, 3] are within a part.

        From outside, a ray meets a closed surface from its front; from within, many rays meet a back first.
        """
        mi = backend.mitsuba()
        lane = dr.arange(mi.UInt32, len(positions) * len(_DIRECTIONS))
        direction = _gathered(_DIRECTIONS, lane % len(_DIRECTIONS))
        origin = _gathered(positions, lane // len(_DIRECTIONS))
        surface = self._scene.ray_intersect(mi.Ray3f(origin, direction))
        back = surface.is_valid() & (dr.dot(surface.n, direction) > 0)
        return back.numpy().reshape(len(positions), -1).mean(axis=1) > 0.1

    def exposed(self, points: Array, normals: Array) -> np.ndarray:
        """[N] bool: which of the surface `points` [N, 3] with outward `normals` [N, 3] can see space.

        Where parts touch or overlap, their surfaces are hidden for good.
        """
        mi = backend.mitsuba()
        lane = dr.arange(mi.UInt32, len(points) * len(_DIRECTIONS))
        normal = _gathered(normals, lane // len(_DIRECTIONS))
        origin = _gathered(points + 1e-4 * normals, lane // len(_DIRECTIONS))
        direction = _gathered(_DIRECTIONS, lane % len(_DIRECTIONS)) + 1.001 * normal  # cosine-weighted
        free = ~self._scene.ray_test(mi.Ray3f(origin, dr.normalize(direction)))
        return free.numpy().reshape(len(points), -1).any(axis=1)


@dataclass(frozen=True)
class _View:
    """A camera as inputs of kernels: another pose or focal length reuses what was recorded."""

    width: int
    height: int
    right: Any
    down: Any
    forward: Any
    origin: Any
    focal: Any
    centre: Any

    @classmethod
    def of(cls, camera: Camera) -> "_View":
        right, down, forward, origin = (opaque(camera.world_from_camera[:3, i]) for i in range(4))
        focal, centre = ([opaque(x) for x in pair] for pair in ((camera.fx, camera.fy), (camera.cx, camera.cy)))
        return cls(camera.width, camera.height, right, down, forward, origin, focal, centre)

    def rays(self, pixel: Any, offset: Any, distortion: Sequence[float]) -> Any:
        """Rays through pixels (index row by row), each at an `offset` in [0, 1)^2 from the pixel's upper left."""
        mi = backend.mitsuba()
        x = (mi.Float(pixel % self.width) + offset.x - self.centre[0]) / self.focal[0]
        y = (mi.Float(pixel // self.width) + offset.y - self.centre[1]) / self.focal[1]
        if distortion:
            x, y = undistorted(x, y, distortion)
        direction = dr.normalize(x * self.right + y * self.down + self.forward)
        return mi.RayDifferential3f(mi.Ray3f(mi.Point3f(self.origin), direction))


@dataclass(frozen=True)
class _Points:
    """Surface points [3, N], their normals on the camera's side, and the shadow class where the Sun is hidden."""

    origin: Any
    normal: Any
    cast: Any


@dataclass(frozen=True)
class _PartTable:
    """Labels of parts, each indexed by the number that Dr.Jit knows a shape by; inputs of kernels.

    textured: whose albedo varies over them, None where no part's does.
    """

    objects: Any
    parts: Any
    albedos: Any
    textured: Any

    @classmethod
    def of(cls, scene: Scene, loaded: Any) -> "_PartTable":
        mi = backend.mitsuba()
        shapes: dict[str, int] = {}
        for shape in loaded.shapes():
            number: Any = dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))
            shapes[shape.id()] = int(number[0])
        size = max(shapes.values()) + 1
        objects, parts = np.zeros((2, size), np.uint32)
        albedos, textured = np.zeros((size, 3), np.float32), np.zeros(size, bool)
        for placed in scene.parts:
            index, material = shapes[placed.shape_id], placed.part.material
            objects[index], parts[index] = placed.object_id, placed.part_id
            albedos[index], textured[index] = material.albedo, _has_color_image(material.bsdf)
        varied = mi.Bool(textured) if textured.any() else None
        return cls(mi.UInt32(objects), mi.UInt32(parts), mi.Float(albedos.ravel()), varied)

    def ids(self, shape: Any, active: Any) -> tuple[Any, Any]:
        """(object id, part id) of shape pointers, 0 where not `active`."""
        mi = backend.mitsuba()
        index: Any = dr.reinterpret_array(mi.UInt32, shape)
        return dr.gather(mi.UInt32, self.objects, index, active), dr.gather(mi.UInt32, self.parts, index, active)

    def albedo(self, surface: Any, active: Any) -> Any:
        """RGB where rays met the scene, 0 where not `active`."""
        mi = backend.mitsuba()
        index: Any = dr.reinterpret_array(mi.UInt32, surface.shape)
        albedo = dr.gather(mi.Color3f, self.albedos, index, active)
        if self.textured is None:
            return albedo
        varied = dr.gather(mi.Bool, self.textured, index, active)
        return dr.select(varied, surface.bsdf().eval_diffuse_reflectance(surface, varied), albedo)


@dataclass(frozen=True)
class _Noise:
    """Of one pass, inputs of kernels. sampler, shift: seeds; first: number of the pass's first sample."""

    sampler: Any
    shift: Any
    first: Any


def _pixel_offsets(pixel: Any, sample: Any, seed: Any) -> Any:
    """Where in its pixel a sample lies, in [0, 1)^2: the R2 sequence, shifted at random for each pixel, so
    that few samples cover it evenly."""
    mi = backend.mitsuba()
    shift = mi.sample_tea_32(pixel, seed)
    fractions = [(sample * step + start) >> 8 for step, start in zip(_R2_STEPS, shift, strict=True)]
    return mi.Point2f(*(mi.Float(fraction) * 2.0**-24 for fraction in fractions))


def _gathered(vectors: Array, index: Any) -> Any:
    """Rows `index` of `vectors` [N, 3]."""
    vector = backend.mitsuba().Vector3f
    return dr.gather(vector, vector(np.ascontiguousarray(np.asarray(vectors, np.float32).T)), index)


def _has_color_image(bsdf: Mapping[str, Any]) -> bool:
    """Conductors have no diffuse reflectance to look up."""
    if bsdf.get("type") in ("bitmap", "roughconductor", "conductor"):
        return bsdf["type"] == "bitmap" and not bsdf.get("raw", False)
    return any(_has_color_image(value) for value in bsdf.values() if isinstance(value, Mapping))


def _shadow(visibility: Any, cast: Any) -> Any:
    return dr.select(visibility < 0.5, cast, SHADOW_LIT)


def _images(numbers: Any, ids: Any, camera: Camera) -> dict[str, np.ndarray]:
    """Labels as [H, W] or [H, W, 3], float32 or uint8, from what `Renderer._trace_centres` returns."""
    shape = camera.height, camera.width
    planes = np.split(numbers.numpy().reshape(-1, camera.height * camera.width), [1, 2, 3, 4, 7])
    names = "depth", "distance", "sun_visibility", "sun_cosine", "normal", "albedo"
    labels = {
        name: plane.reshape(shape if len(plane) == 1 else (*shape, 3))
        for name, plane in zip(names, planes, strict=True)
    }
    packed = ids.numpy().view(np.uint8).reshape(*shape, 4)
    for i, name in enumerate(("object_id", "part_id", "shadow")):
        labels[name] = np.ascontiguousarray(packed[..., i])
    return labels
