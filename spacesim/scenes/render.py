"""One frame of a scene with all its truth, by Mitsuba's path integrator and a short loop of our own.

Radiance and alpha are means over samples spread evenly over the pixel (a box filter), summed pixel by pixel
in a fixed order: splatting into a film adds floats in whatever order threads arrive. Labels come from one ray
through the pixel's centre, so that none is ever averaged. Same seed, same backend: same bits.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import drjit as dr
import numpy as np

from spacesim import backend
from spacesim.data.geometry import Array, fibonacci_sphere
from spacesim.data.images import undistorted
from spacesim.data.records import Camera, Sun, Truth
from spacesim.data.store import SHADOW_ATTACHED, SHADOW_LIT, SHADOW_NONE, SHADOW_SELF_CAST
from spacesim.scenes.emitters import Limb
from spacesim.scenes.scene import Scene, load
from spacesim.scenes.visibility import SunVisibility

MAX_WAVEFRONT = 1 << 22
"""Most samples in flight at once: more are rendered in several passes."""

_EARTH = 1  # stream of random numbers

_R2_STEPS = (3242174889, 2447445414)
"""2^32 / g and 2^32 / g^2 with g^3 = g + 1 (Roberts 2018, "The unreasonable effectiveness of quasirandom
sequences"): unsigned overflow keeps the fraction."""

_DIRECTIONS = fibonacci_sphere(64)


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
        self._labels_of_shape = _labels_of_shape(scene, self._scene)
        self._textured = _textured(self._labels_of_shape, scene)
        limb = Limb(scene.earth) if scene.earth else None
        self._visibility = SunVisibility(self._scene, scene.sun, limb)

    def render(self, camera: Camera, sun: Sun, seed: Sequence[int]) -> Truth:
        """What `camera` sees under `sun`; `seed` makes the noise."""
        self._loaded.point(sun)
        radiance, alpha = self._radiance(self._scene, camera, seed)
        earth = None
        if self._loaded.earthlit is not None:
            earth, _ = self._radiance(self._loaded.earthlit, camera, (*seed, _EARTH))
            radiance = radiance + earth
        return Truth(radiance=radiance, alpha=alpha, **self._labels(camera, sun), radiance_earth=earth)

    def _radiance(self, scene: Any, camera: Camera, seed: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Radiance from one source [H, W, 3] and alpha [H, W], means over the samples of each pixel."""
        mi = backend.mitsuba()
        pixels = camera.width * camera.height
        passes = min(self.spp, -(-self.spp * pixels // MAX_WAVEFRONT))
        seeds = np.random.SeedSequence(seed).generate_state(passes)
        sums = np.zeros((4, pixels), np.float32)
        for i in range(passes):
            first, last = self.spp * i // passes, self.spp * (i + 1) // passes
            spp = last - first
            self._sampler.seed(dr.opaque(mi.UInt32, int(seeds[i])), spp * pixels)
            lane = dr.arange(mi.UInt32, spp * pixels)
            pixel = lane // spp
            offset = _pixel_offsets(pixel, lane - pixel * spp + dr.opaque(mi.UInt32, first), int(seeds[0]))
            ray = _primary_rays(camera, pixel, offset, self._distortion)
            radiance, hit, _ = self._integrator.sample(scene, self._sampler, ray)
            channels = [*radiance, dr.select(hit, mi.Float(1.0), mi.Float(0.0))]
            dr.eval(channels)
            sums += np.stack([dr.block_sum(x, spp, mode="evaluated").numpy() for x in channels])
        mean = (sums / np.float32(self.spp)).reshape(4, camera.height, camera.width)
        return np.ascontiguousarray(np.moveaxis(mean[:3], 0, -1)), mean[3]

    def _labels(self, camera: Camera, sun: Sun) -> dict[str, np.ndarray]:
        """All fields of Truth but radiance and alpha, from the ray through each pixel's centre."""
        mi = backend.mitsuba()
        pixel = dr.arange(mi.UInt32, camera.width * camera.height)
        ray = _primary_rays(camera, pixel, mi.Point2f(0.5), self._distortion)
        surface = self._scene.ray_intersect(ray)
        hit = surface.is_valid()
        normal = dr.select(dr.dot(surface.n, ray.d) > 0, -surface.n, surface.n)
        object_id, part_id, albedo = self._labels_of(surface.shape, hit)
        if self._textured is not None:
            index: Any = dr.reinterpret_array(mi.UInt32, surface.shape)
            textured = dr.gather(mi.Bool, self._textured, index, hit)
            looked_up = surface.bsdf().eval_diffuse_reflectance(surface, textured)
            albedo = dr.select(textured, looked_up, albedo)

        cosine = dr.dot(normal, _vector(sun.direction))
        faces_sun = hit & (cosine > 0)
        visibility, blocker = self._visibility(surface, normal, faces_sun, sun)
        blocker_id, _, _ = self._labels_of(blocker, faces_sun)
        cast = SHADOW_SELF_CAST + dr.select((blocker_id == 0) | (blocker_id == object_id), 0, blocker_id)
        shadow = dr.select(visibility < 0.5, cast, SHADOW_LIT)
        shadow = dr.select(hit, dr.select(faces_sun, shadow, SHADOW_ATTACHED), SHADOW_NONE)

        axis = _vector(camera.world_from_camera[:3, 2])
        distance = dr.select(hit, surface.t, 0.0)
        labels = {
            "depth": distance * dr.dot(ray.d, axis),
            "distance": distance,
            "normal": dr.select(hit, normal, 0.0),
            "albedo": albedo,
            "object_id": object_id,
            "part_id": part_id,
            "sun_visibility": dr.select(faces_sun, visibility, 0.0),
            "sun_cosine": dr.select(hit, cosine, 0.0),
            "shadow": shadow,
        }
        dr.eval(labels)  # all in one kernel
        return {name: _image(values, camera) for name, values in labels.items()}

    def _labels_of(self, shape: Any, active: Any) -> tuple[Any, Any, Any]:
        """(object id, part id, albedo) of shape pointers, 0 where not `active`."""
        mi = backend.mitsuba()
        index: Any = dr.reinterpret_array(mi.UInt32, shape)
        objects, parts, albedos = self._labels_of_shape
        return (
            dr.gather(mi.UInt32, objects, index, active),
            dr.gather(mi.UInt32, parts, index, active),
            dr.gather(mi.Color3f, albedos, index, active),
        )

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


def _primary_rays(camera: Camera, pixel: Any, offset: Any, distortion: Sequence[float]) -> Any:
    """Rays through pixels (index row by row), each at an `offset` in [0, 1)^2 from the pixel's upper left."""
    mi = backend.mitsuba()
    right, down, forward, origin = (_vector(camera.world_from_camera[:3, i]) for i in range(4))
    fx, fy, cx, cy = (dr.opaque(mi.Float, float(x)) for x in (camera.fx, camera.fy, camera.cx, camera.cy))
    x = (mi.Float(pixel % camera.width) + offset.x - cx) / fx
    y = (mi.Float(pixel // camera.width) + offset.y - cy) / fy
    if distortion:
        x, y = undistorted(x, y, [dr.opaque(mi.Float, float(k)) for k in distortion])
    return mi.RayDifferential3f(mi.Ray3f(mi.Point3f(origin), dr.normalize(x * right + y * down + forward)))


def _pixel_offsets(pixel: Any, sample: Any, seed: int) -> Any:
    """Where in its pixel a sample lies, in [0, 1)^2: the R2 sequence, shifted at random for each pixel, so
    that few samples cover it evenly."""
    mi = backend.mitsuba()
    shift = mi.sample_tea_32(pixel, dr.opaque(mi.UInt32, seed))
    fractions = [(sample * step + start) >> 8 for step, start in zip(_R2_STEPS, shift, strict=True)]
    return mi.Point2f(*(mi.Float(fraction) * 2.0**-24 for fraction in fractions))


def _gathered(vectors: Array, index: Any) -> Any:
    """Rows `index` of `vectors` [N, 3]."""
    vector = backend.mitsuba().Vector3f
    return dr.gather(vector, vector(np.ascontiguousarray(np.asarray(vectors, np.float32).T)), index)


def _vector(values: Array) -> Any:
    """[3] numbers as an input of kernels, so that other numbers reuse the compiled kernel."""
    vector = backend.mitsuba().Vector3f(values.tolist())
    dr.make_opaque(vector)
    return vector


def _textured(labels_of_shape: tuple[Any, Any, Any], scene: Scene) -> Any:
    """Which shapes, by number, have an albedo that varies over them; None where none has."""
    mi = backend.mitsuba()
    varied = [False, *(_has_color_image(p.part.material.bsdf) for p in scene.parts)]
    return dr.gather(mi.Bool, mi.Bool(varied), labels_of_shape[1]) if any(varied) else None


def _has_color_image(bsdf: Mapping[str, Any]) -> bool:
    """Conductors have no diffuse reflectance to look up."""
    if bsdf.get("type") in ("bitmap", "roughconductor", "conductor"):
        return bsdf["type"] == "bitmap" and not bsdf.get("raw", False)
    return any(_has_color_image(value) for value in bsdf.values() if isinstance(value, Mapping))


def _labels_of_shape(scene: Scene, loaded: Any) -> tuple[Any, Any, Any]:
    """Object ids, part ids and albedos, each indexed by the number that Dr.Jit knows a shape by."""
    mi = backend.mitsuba()
    shapes: dict[str, int] = {}
    for shape in loaded.shapes():
        number: Any = dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))
        shapes[shape.id()] = int(number[0])
    size = max(shapes.values()) + 1
    objects, parts = np.zeros((2, size), np.uint32)
    albedos = np.zeros((size, 3), np.float32)
    for placed in scene.parts:
        index = shapes[placed.shape_id]
        objects[index], parts[index] = placed.object_id, placed.part_id
        albedos[index] = placed.part.material.albedo
    return mi.UInt32(objects), mi.UInt32(parts), mi.Float(albedos.ravel())


def _image(values: Any, camera: Camera) -> np.ndarray:
    """One value or vector a pixel as [H, W] or [H, W, 3]: uint8 of integers, float32 of the rest."""
    array = np.moveaxis(values.numpy().reshape(-1, camera.height, camera.width), 0, -1)
    array = array[..., 0] if array.shape[-1] == 1 else array
    return np.ascontiguousarray(array, np.uint8 if array.dtype.kind in "iu" else np.float32)
