"""How much of the Sun a point sees through a radiance field: transmittance along a second ray, from the point towards
the Sun (thesis 2.4, of which 4.8 is the counterpart for Gaussians).

That ray is sampled as a camera's is: from the first to the last filled cell that it crosses, where the proposals see
density. Visibility counts as given, as in the literature: nothing is differentiated.
"""

from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Array3f, Float
from spacesim.backend.upload import upload
from spacesim.nerf.fields.field import Parameters
from spacesim.nerf.fields.model import Networks, places
from spacesim.nerf.sampling.box import SceneBox
from spacesim.nerf.sampling.rays import Rays, box_interval
from spacesim.nerf.sampling.render import Weights, expected_depth, median_depth, sum_rays


def transmittance(
    networks: Networks,
    parameters: Parameters,
    filled: Float,
    extent: Float,
    point: Array3f,
    sun: Array3f,
    bias: Float | float,
    count: int,
    samples: int,
) -> Float:
    """[N] share of the light that comes through the field to points [3, N] from the direction `sun` [3, N] or [3], both
    in the box's coordinates, along N = `count` rays, a multiple of 512, of so many `samples` of the field. May be part
    of a recording.

    filled: see `Occupancy.filled`;  extent: Float [3], of the box;  bias: sides of the box, by which a ray begins
    nearer to the Sun than its point
    """
    towards = sun + dr.zeros(ad.Array3f, count)
    near, far = box_interval(point, towards, extent)
    near = dr.maximum(near, bias)
    rays = Rays(point, towards, near, dr.maximum(near, far), dr.full(ad.Float, 1, count))
    rays, crosses = networks.occupancy.clip(rays, filled)
    dr.eval(rays.origin, rays.direction, rays.near, rays.far, crosses)
    edges, _ = networks.sample(parameters, rays, count, None, samples=samples)
    t, lengths, ray = places(rays, _whole(edges, count, samples), count, samples)
    between, _ = rays.at(ray, t)
    density, _ = networks.density_tape(parameters, between)
    return dr.select(crosses, dr.exp(-sum_rays(density * lengths, samples)), 1)


def ray_visibility(
    networks: Networks,
    parameters: Parameters,
    filled: Float,
    extent: Float,
    rays: Rays,
    made: Weights,
    low: Float,
    high: Float,
    sun: Array3f,
) -> Float:
    """[R] `transmittance` to where half of the light of each ray is gone, or to its mean depth where more than half
    gets through: what stands along a ray is mostly one surface, so one second ray does for all of its samples.

    made, low, high: [R S] of the field's samples, t;  sun: [3, R] or [3]
    """
    config, count = networks.config, dr.width(rays.near)
    samples = dr.width(low) // count
    median = median_depth(made, low, high, samples)
    depth = dr.select(median > 0, median, expected_depth(made.weights, 0.5 * (low + high), samples))
    point = dr.fma(rays.direction, dr.maximum(depth, rays.near), rays.origin)
    dr.eval(point)
    shadow = config.shadow
    return transmittance(networks, parameters, filled, extent, point, sun, shadow.bias, count, shadow.samples)


def mix(color: list[Float], visibility: Float) -> list[Float]:
    """Three Floats [N], of a colour in the Sun and one in the shade, 3 Floats [N] each. visibility: [N]"""
    return [visibility * lit + (1 - visibility) * shaded for lit, shaded in zip(color[:3], color[3:], strict=True)]


def _whole(edges: Float, count: int, samples: int) -> Float:
    """Edges [N (S + 1)] with the first at 0 and the last at 1: `resample` leaves out half a sample's share at both
    ends, which a picture need not see but light has to come through."""
    k = dr.arange(ad.UInt32, count * (samples + 1)) % (samples + 1)
    covering: Any = dr.select(k == 0, 0, dr.select(k == samples, 1, edges))
    return covering


_transmittance = recorded(transmittance)


def sun_visibility(
    networks: Networks,
    parameters: Parameters,
    filled: Float,
    box: SceneBox,
    points: np.ndarray,
    sun: np.ndarray,
    bias: float | None = None,
    samples: int | None = None,
) -> np.ndarray:
    """[N] float32 share of the Sun's light that reaches points [N, 3], metres, in the model's axes, anywhere.

    sun: [3] unit, towards it, model's axes;  bias: metres, and samples, each None: the configuration's (samples of
    pictures, where that has no shadows). Memory is that of a chunk of rays.
    """
    config = networks.config
    chunk, samples = config.chunk, samples or config.sun_samples
    shift = dr.opaque(ad.Float, config.shadow.bias if bias is None else bias / box.side)
    extent, towards = upload(box.extent), ad.Array3f(*(dr.opaque(ad.Float, float(x)) for x in sun))
    result = np.ones(len(points), np.float32)
    for start in range(0, len(points), chunk):
        part = box.to_unit(np.asarray(points[start : start + chunk], np.float64))
        padded = np.concatenate([part, np.repeat(part[-1:], chunk - len(part), axis=0)])
        place = ad.Array3f(*(upload(column) for column in padded.T))
        seen = _transmittance(networks, parameters, filled, extent, place, towards, shift, chunk, samples)
        result[start : start + chunk] = np.array(seen)[: len(part)]
    return result
