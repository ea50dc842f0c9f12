"""Pictures of a radiance field: rays of a chunk at a time, and of these only such as cross what is filled."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import drjit as dr
import numpy as np

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Array3f, Float, UInt32
from spacesim.backend.memory import check_free_memory
from spacesim.backend.upload import upload
from spacesim.data.geometry import Array
from spacesim.data.records import Camera, Sun
from spacesim.learning.reflectance import eclipse_numbers, past_earth
from spacesim.nerf.config import CHUNK, NerfConfig
from spacesim.nerf.fields.field import Parameters
from spacesim.nerf.fields.model import Networks, places
from spacesim.nerf.sampling.box import SceneBox
from spacesim.nerf.sampling.rays import Rays, camera_rows, pixel_rays
from spacesim.nerf.sampling.render import Weights, expected_depth, median_depth, spread, sum_rays, volume_weights
from spacesim.nerf.shadow import mix, ray_visibility

A_SAMPLE = 300  #: bytes that are kept of each, of models that are merged: by peaks seen on LLVM
INTERRUPTIBLE = 2_048  #: rays of a chunk, at most, of a picture that may be given up after any
PLANES = {"rgb": 3, "alpha": 1, "depth": 1, "median_depth": 1, "visibility": 1, "normal": 3}
"""Of a picture, in this order: colours over black, opacity, depths (sides of the box, along the ray), the share of the
Sun that is seen, where the field casts shadows, by weight, and the sum of density gradients by weight, which points
inwards."""


@dataclass
class RaySamples:
    """Of R rays, S samples each: what several fields are merged from, see `compose`."""

    low: Float  #: [R S] t
    high: Float  #: [R S] t
    density: Float  #: [R S] per unit of t
    color: list[Float]  #: 3 times [R S]
    visibility: Float | None = None  #: [R S] of the Sun, by which colours are dimmed, where the field casts shadows


def sample_field(
    networks: Networks,
    parameters: Parameters,
    filled: Float,
    extent: Float,
    rays: Rays,
    count: int,
    sun: Float | None,
) -> RaySamples:
    """Intervals of the field's own samples of `count` rays, and what it has there.

    filled: see `Occupancy.filled`;  extent: Float [3], of the box;  sun: Float [5] of `sun_numbers`
    """
    samples, towards = networks.config.samples, _towards(sun)
    edges, _ = networks.sample(parameters, rays, count, None)
    t, lengths, index = places(rays, edges, count, samples)
    point, direction = rays.at(index, t)
    own = networks.of_round(parameters, 2)
    low, high = t - 0.5 * lengths, t + 0.5 * lengths
    density, color, _ = networks.field.look_up(own, point, direction, towards)
    if sun is None or towards is None:
        return RaySamples(low, high, density, color)
    if not networks.config.casts_shadows:
        return RaySamples(low, high, density, past_earth(color, sun, at=3)[0])
    made = volume_weights(density * lengths, samples)
    seen = ray_visibility(networks, parameters, filled, extent, rays, made, low, high, towards)
    visibility = spread(seen, samples)
    dimmed, _ = past_earth(mix(color, visibility), sun, at=3)
    return RaySamples(low, high, density, dimmed, visibility * dr.gather(ad.Float, sun, ad.UInt32(3)))


def draw_rays(
    networks: Networks,
    parameters: Parameters,
    filled: Float,
    extent: Float,
    rays: Rays,
    count: int,
    sun: Float | None,
    normals: bool,
) -> Float:
    """[C R] planes of `PLANES`, packed, of `count` rays, with the normals or without."""
    samples = networks.config.samples
    seen = sample_field(networks, parameters, filled, extent, rays, count, sun)
    made = volume_weights(seen.density * (seen.high - seen.low), samples)
    planes = shown(made, seen, rays, samples)
    if seen.visibility is not None:
        planes.append(sum_rays(made.weights * seen.visibility, samples))
    if normals:
        index = dr.arange(ad.UInt32, count * samples) // samples
        point, _ = rays.at(index, 0.5 * (seen.low + seen.high))
        _, tape = networks.density_tape(parameters, point)
        slopes = networks.field.density.slopes(networks.of_round(parameters, 2)[: networks.field.split], tape)
        planes += [sum_rays(made.weights * slopes[i], samples) for i in range(3)]
    return dr.concat(planes)


def shown(made: Weights, seen: RaySamples, rays: Rays, samples: int) -> list[Float]:
    """[R] each: colour (3), opacity, expected and median depth along the optical axis, unit of t."""
    planes = [sum_rays(made.weights * seen.color[i], samples) for i in range(3)]
    expected = expected_depth(made.weights, 0.5 * (seen.low + seen.high), samples)
    median = median_depth(made, seen.low, seen.high, samples)
    return [*planes, sum_rays(made.weights, samples), expected * rays.across, median * rays.across]


def draw_chunk(
    networks: Networks,
    parameters: Parameters,
    filled: Float,
    cameras: Float,
    pixel: UInt32,
    width: UInt32,
    extent: Float,
    sun: Float | None,
    normals: bool,
) -> Float:
    """`draw_rays` of pixels [R], row by row, of a camera."""
    rays, _ = networks.occupancy.clip(_rays(cameras, pixel, width, extent), filled)
    dr.eval(rays.origin, rays.direction, rays.near, rays.far, rays.across)
    return draw_rays(networks, parameters, filled, extent, rays, networks.config.chunk, sun, normals)


def find_crossing(
    networks: Networks, filled: Float, cameras: Float, first: UInt32, width: UInt32, extent: Float
) -> UInt32:
    """[R] 1 where the ray through a pixel, number `first` and the following, crosses what is filled."""
    pixel = dr.arange(ad.UInt32, networks.config.chunk) + first
    _, crosses = networks.occupancy.clip(_rays(cameras, pixel, width, extent), filled)
    return dr.select(crosses, ad.UInt32(1), ad.UInt32(0))


_draw_chunk, _find_crossing = recorded(draw_chunk), recorded(find_crossing)


def draw(
    networks: Networks,
    parameters: Parameters,
    filled: Float,
    box: SceneBox,
    camera: Camera,
    sun: Sun | None,
    normals: bool,
) -> dict[str, np.ndarray]:
    """Planes of a picture by name, [H, W] or [H, W, 3] float32, depths in metres. Memory on the device is that of a
    chunk of rays: raises MemoryError where these do not fit. sun: of a field that takes it"""
    check_chunk([networks.config], networks.config.chunk)
    left_out = {"normal": not normals, "visibility": not networks.config.casts_shadows}
    names = [name for name in PLANES if not left_out.get(name)]
    size, chunk = camera.width * camera.height, networks.config.chunk
    cameras, extent = upload(camera_rows([camera], box)), upload(box.extent)
    width = dr.opaque(ad.UInt32, camera.width)
    towards = None if sun is None else sun_numbers(sun.direction, sun)
    crossing = np.concatenate(
        [
            np.array(_find_crossing(networks, filled, cameras, dr.opaque(ad.UInt32, first), width, extent), bool)
            for first in range(0, size, chunk)
        ]
    )[:size]
    pixels = np.flatnonzero(crossing).astype(np.uint32)
    planes = np.zeros((sum(PLANES[name] for name in names), size), np.float32)
    for part, padded in chunks(pixels, chunk):
        packed = _draw_chunk(networks, parameters, filled, cameras, padded, width, extent, towards, normals)
        planes[:, part] = np.array(packed).reshape(-1, chunk)[:, : len(part)]
    result, row = {}, 0
    for name in names:
        count = PLANES[name]
        values = np.moveaxis(planes[row : row + count].reshape(count, camera.height, camera.width), 0, -1)
        result[name] = np.ascontiguousarray(values if count > 1 else values[..., 0])
        row += count
    for name in ("depth", "median_depth"):
        result[name] *= np.float32(box.side)
    if "visibility" in result:
        alpha = result["alpha"]
        result["visibility"] = np.divide(result["visibility"], alpha, out=np.zeros_like(alpha), where=alpha > 0)
    if normals:
        result["normal"] = unit_normals(result["normal"])
    return result


def check_chunk(configs: Sequence[NerfConfig], chunk: int) -> None:
    """Raise MemoryError where `chunk` rays that are drawn at once through models of these configurations, one after the
    other, do not fit into memory."""
    kept = A_SAMPLE * sum(config.samples for config in configs) if len(configs) > 1 else 0
    most = max(config.ray_bytes for config in configs) // 2
    check_free_memory((most + kept) * chunk, f"chunk: a picture by {chunk} rays at once")


def chunks(
    pixels: np.ndarray, most: int, on_chunk: Callable[[], None] | None = None
) -> Iterator[tuple[np.ndarray, UInt32]]:
    """(some of the pixels, these filled up with the last one to a number that occurs often), at most `most` at a time.

    on_chunk: called before each; an exception that it raises ends the picture. Chunks are smaller then, and the last
    one filled up by less: who waits for a picture wants it soon, or given up soon
    """
    if on_chunk is not None:
        most = min(most, INTERRUPTIBLE)
    for start in range(0, len(pixels), most):
        part, count = pixels[start : start + most], most
        if on_chunk is not None:
            on_chunk()
            while count % (2 * CHUNK) == 0 and count // 2 >= len(part):
                count //= 2
        yield part, upload(np.concatenate([part, np.repeat(part[-1:], count - len(part))]), ad.UInt32)


def unit_normals(slopes: np.ndarray) -> np.ndarray:
    """[H, W, 3] unit vectors against density gradients, 0 where there are none."""
    length = np.linalg.norm(slopes, axis=-1, keepdims=True)
    return np.asarray(np.where(length > 0, -slopes / np.maximum(length, 1e-30), 0), np.float32)


def _rays(cameras: Float, pixel: UInt32, width: UInt32, extent: Float) -> Rays:
    across = dr.maximum(width, 1)
    x, y = ad.Float(pixel % across) + 0.5, ad.Float(pixel // across) + 0.5
    return pixel_rays(cameras, dr.zeros(ad.UInt32, dr.width(pixel)), x, y, extent)


def sun_numbers(towards: Array, sun: Sun) -> Float:
    """[5]: the direction `towards` a Sun in the field's axes, then `eclipse_numbers`."""
    return upload(np.concatenate([towards, eclipse_numbers(sun.visible_share, linear=False)]))


def _towards(sun: Float | None) -> Array3f | None:
    return None if sun is None else ad.Array3f([dr.gather(ad.Float, sun, ad.UInt32(i)) for i in range(3)])
