"""One frame of a scene with all its truth, by Mitsuba's path integrator and a short loop of our own.

Radiance and alpha are means over samples spread evenly over the pixel (a box filter), summed pixel by pixel
in a fixed order: splatting into a film adds floats in whatever order threads arrive. Labels (labels.py) come from one
ray through the pixel's centre, so that none is ever averaged. Same seed, same backend: same bits.

On a GPU the kernels are recorded once for each size of picture and replayed: tracing the integrator anew takes 10 ms a
frame.
"""

import math
from collections.abc import Sequence
from functools import partial

import drjit as dr
import numpy as np

from spacesim import backend
from spacesim.backend import mitsuba_types as mt
from spacesim.backend.arrays import Float, UInt32
from spacesim.backend.readback import AsyncArray
from spacesim.data.geometry import Array, fibonacci_sphere
from spacesim.data.records import Camera, Sun, Truth
from spacesim.scenes.cameras.kernel_camera import KernelCamera, record_on_cuda
from spacesim.scenes.coverage import Coverage, Tiles
from spacesim.scenes.labels import OFFSET, Labeller
from spacesim.scenes.lights.earth import EarthConfig
from spacesim.scenes.samples import Noise, path_sampler, pixel_offsets
from spacesim.scenes.scene import Scene, load
from spacesim.scenes.steps import Steps, completed

MAX_WAVEFRONT = 1 << 24
"""Most samples in flight at once, 16 bytes each: more are rendered in several passes."""

_EARTH = 1  # stream of random numbers

_DIRECTIONS = fibonacci_sphere(64)


A_PIXEL, A_SAMPLE = 420, 16
"""Bytes that a pixel, and a sample in flight, take at most on the backend: 410 a pixel were seen, labels included."""


def _check_memory(camera: Camera, spp: int) -> None:
    pixels = camera.width * camera.height
    needed = A_PIXEL * pixels + A_SAMPLE * min(spp * pixels, MAX_WAVEFRONT)
    backend.check_free_memory(needed, f"path tracing {camera.width} x {camera.height} pixels")


class Renderer:
    """A scene loaded once, from which frames are rendered under any Sun.

    spp: samples a pixel, where a frame does not say
    max_depth: longest path in edges from camera to source (2 is direct light only)
    distortion: Brown-Conrady k1, k2, p1, p2, k3 of the lens, () none
    """

    def __init__(self, scene: Scene, spp: int, max_depth: int = 6, distortion: Sequence[float] = ()) -> None:
        mi = backend.mitsuba()
        self.scene = scene
        self.spp = spp
        self._max_depth = max_depth
        self._distortion = tuple(distortion)
        self._loaded = load(scene)
        self._earth = scene.earth  # where it is now
        integrator = mi.load_dict({"type": "path", "max_depth": max_depth, "hide_emitters": True})
        self._labeller = Labeller(scene, self._loaded, distortion)
        self._coverage = Coverage(scene, self._loaded.units, distortion)
        self._lists_pixels = backend.select() == "llvm" and not any(distortion)  # a recording has all: one size
        self._sums = record_on_cuda(partial(_trace_paths, integrator, self._distortion))

    def of(self, scene: Scene) -> "Renderer":
        """The same of another scene."""
        return Renderer(scene, self.spp, self._max_depth, self._distortion)

    def render(
        self, camera: Camera, sun: Sun, seed: Sequence[int], spp: int | None = None, earth: EarthConfig | None = None
    ) -> Truth:
        """What `camera` sees under `sun` by `spp` samples a pixel; `seed` makes the noise. earth: where the scene's
        Earth is; None: where the scene says."""
        return completed(self.rendering(camera, sun, seed, spp, earth))

    def rendering(
        self, camera: Camera, sun: Sun, seed: Sequence[int], spp: int | None = None, earth: EarthConfig | None = None
    ) -> Steps[Truth]:
        """`render` in steps: while others are done, the device traces this one's paths."""
        spp = spp or self.spp
        _check_memory(camera, spp)
        self._point(sun, earth)
        labelling = self._labeller.labels(camera, sun)
        next(labelling)  # read while the device traces paths
        sunlight, earthlight = self._launch(camera, seed, spp)
        yield
        labels = yield from labelling
        radiance, alpha = _mean_radiance(sunlight, camera, spp)
        if earthlight is None:
            return Truth(radiance=radiance, alpha=alpha, **labels)
        reflected, _ = _mean_radiance(earthlight, camera, spp)
        return Truth(radiance=radiance + reflected, alpha=alpha, **labels, radiance_earth=reflected)

    def radiance(self, camera: Camera, sun: Sun, seed: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """(radiance [H, W, 3] from all sources, alpha [H, W]) of what `render` returns, without the labels."""
        _check_memory(camera, self.spp)
        self._point(sun)
        sunlight, earthlight = self._launch(camera, seed, self.spp)
        radiance, alpha = _mean_radiance(sunlight, camera, self.spp)
        if earthlight is not None:
            radiance = radiance + _mean_radiance(earthlight, camera, self.spp)[0]
        return radiance, alpha

    def _point(self, sun: Sun, earth: EarthConfig | None = None) -> None:
        """Move the Sun and the Earth. None: to where the scene says"""
        earth = earth or self.scene.earth
        self._loaded.point(sun, None if earth == self._earth else earth)
        self._earth = earth

    def labels(self, camera: Camera, sun: Sun, earth: EarthConfig | None = None) -> dict[str, np.ndarray]:
        """All fields of what `render` returns but radiance and alpha, which take no paths. earth: as in `render`."""
        self._point(sun, earth)
        return completed(self._labeller.labels(camera, sun))

    def _launch(
        self, camera: Camera, seed: Sequence[int], spp: int
    ) -> tuple[list[AsyncArray], list[AsyncArray] | None]:
        """Sums of all passes (under the Sun, by the Earth's light, None without)."""
        view = KernelCamera.of(camera, self._loaded.units)
        tiles, earthlit = self._coverage.tiles(camera, view), self._loaded.earthlit
        pixels = tiles.pixels(view) if self._lists_pixels else None
        sunlight = self._launch_passes(self._loaded.sunlit, view, tiles, pixels, seed, spp)
        return sunlight, self._launch_passes(earthlit, view, tiles, pixels, (*seed, _EARTH), spp) if earthlit else None

    def _launch_passes(
        self,
        scene: mt.Scene,
        view: KernelCamera,
        tiles: Tiles,
        pixels: UInt32 | None,
        seed: Sequence[int],
        spp: int,
    ) -> list[AsyncArray]:
        """Sums over samples, as `_trace_paths` returns them, of each pass; the device may still be at work on them."""
        uint = backend.mitsuba().UInt32
        passes = min(spp, -(-spp * view.width * view.height // MAX_WAVEFRONT))
        seeds = [dr.opaque(uint, int(state)) for state in np.random.SeedSequence(seed).generate_state(passes)]
        firsts = [spp * i // passes for i in range(passes + 1)]
        noise = [Noise(seeds[i], seeds[0], dr.opaque(uint, firsts[i])) for i in range(passes)]
        counts = np.diff(firsts).tolist()
        return [AsyncArray(self._sums(scene, view, tiles, pixels, noise[i], counts[i])) for i in range(passes)]

    def inside(self, positions: Array) -> np.ndarray:
        """[N] bool: which of the `positions` [N, 3] are within a part.

        From outside, a ray meets a closed surface from its front; from within, many rays meet a back first.
        """
        mi = backend.mitsuba()
        index = dr.arange(mi.UInt32, len(positions) * len(_DIRECTIONS))
        direction = _gather(_DIRECTIONS, index % len(_DIRECTIONS))
        origin = _gather(self._loaded.units.points(positions), index // len(_DIRECTIONS))
        surface: mt.SurfaceInteraction3f = self._loaded.labelled.ray_intersect(mi.Ray3f(origin, direction))
        back = surface.is_valid() & (dr.dot(surface.n, direction) > 0)
        return back.numpy().reshape(len(positions), -1).mean(axis=1) > 0.1

    def exposed(self, points: Array, normals: Array) -> np.ndarray:
        """[N] bool: which of the surface `points` [N, 3] with outward `normals` [N, 3] can see space.

        Where parts touch or overlap, their surfaces are hidden for good.
        """
        mi = backend.mitsuba()
        index = dr.arange(mi.UInt32, len(points) * len(_DIRECTIONS))
        normal = _gather(normals, index // len(_DIRECTIONS))
        origin = _gather(self._loaded.units.points(points) + OFFSET * normals, index // len(_DIRECTIONS))
        direction = _gather(_DIRECTIONS, index % len(_DIRECTIONS)) + 1.001 * normal  # cosine-weighted
        free = ~self._loaded.labelled.ray_test(mi.Ray3f(origin, dr.normalize(direction)))
        return np.any(free.numpy().reshape(len(points), -1), axis=1)


def _trace_paths(
    integrator: mt.Integrator,
    distortion: Sequence[float],
    scene: mt.Scene,
    view: KernelCamera,
    tiles: Tiles,
    pixels: UInt32 | None,
    noise: Noise,
    spp: int,
) -> Float:
    """Sums of RGB, then of alpha, over `spp` samples a pixel, [3 H W + H W]. pixels: those of `tiles`, which alone
    are traced; None: each sample of the picture is asked whether it is within them"""
    mi = backend.mitsuba()
    size = view.width * view.height
    traced = size if pixels is None else dr.width(pixels)
    if traced == 0:
        return dr.zeros(mi.Float, 4 * size)
    index = dr.arange(mi.UInt32, spp * traced)
    place = index // spp
    sample = index - place * spp
    pixel = place if pixels is None else dr.gather(mi.UInt32, pixels, place)
    offset = pixel_offsets(pixel, sample + noise.first, noise.shift)
    x, y = view.directions(pixel, offset, distortion)
    ray, _ = view.rays_to(x, y)
    sampler = path_sampler(noise.paths, pixel * spp + sample)
    shown = tiles.may_show(view, x, y) if pixels is None else mi.Bool(True)
    radiance, hit, _ = integrator.sample(scene, sampler, ray, active=shown)
    channels = [*radiance, dr.select(hit, mi.Float(1.0), mi.Float(0.0))]
    dr.eval(channels)
    *rgb, alpha = (dr.block_sum(x, spp, mode="evaluated") for x in channels)
    if pixels is None:
        return dr.concat([dr.ravel(mi.Color3f(rgb)), alpha])
    sums = dr.zeros(mi.Float, 4 * size)
    for k, channel in enumerate(rgb):
        dr.scatter(sums, channel, 3 * pixels + k)
    dr.scatter(sums, alpha, 3 * size + pixels)
    return sums


def _mean_radiance(sums: Sequence[AsyncArray], camera: Camera, spp: int) -> tuple[np.ndarray, np.ndarray]:
    """Radiance from one source [H, W, 3] and alpha [H, W], means over the samples of each pixel."""
    total = sums[0].wait()  # memory of its own
    for values in sums[1:]:
        total += values.wait()
    total /= np.float32(spp)
    shape = camera.height, camera.width
    return total[: -math.prod(shape)].reshape(*shape, 3), total[-math.prod(shape) :].reshape(shape)


def _gather(vectors: Array, index: UInt32) -> mt.Vector3f:
    """Rows `index` of `vectors` [N, 3]."""
    vector = backend.mitsuba().Vector3f
    return dr.gather(vector, vector(np.ascontiguousarray(np.asarray(vectors, np.float32).T)), index)
