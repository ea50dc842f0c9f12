"""One bounce: sunlight that some Gaussians scatter onto all others, as if nothing stood in between.

What faces away from the Sun, or lies in a shadow, is not black beside a lit surface: one that a path tracer or a camera
sees. A field that is told the cosines of one Gaussian cannot know which of its neighbours are lit; visibility does.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr

from spacesim.backend import ad
from spacesim.splat.light.columns import Lanes
from spacesim.splat.light.field import unit_normals
from spacesim.splat.light.mlp import sigmoid
from spacesim.splat.raster.gaussians import opacities
from spacesim.splat.raster.records import load, packets, store
from spacesim.splat.raster.tone import decoded, decoded_slope, encoded_slope, encoded_unclipped

ALBEDO = -1.0  #: logit of the albedos at the start: 0.27, chosen
OVERLAP = 0.3  #: share of the Gaussians' areas that is surface: they overlap; chosen, albedos learn the rest
LARGEST_AREA = 1e12  #: bound on an emitter's area, m^2: products stay finite in float32
MOST_EMITTERS = 2**14  #: chosen


@dataclass
class Scatterers:
    """Gaussians as surfaces. features: Float, packed [F * N], in which normals stand from row `normals` and the logits
    of albedos (RGB) from row `albedos`;  means: Array3f [3, N], metres;  log_scales: Array3f [3, N];
    logit_opacities: [N];  sun: Array3f of width 1, unit, towards the Sun"""

    features: Any
    normals: int
    albedos: int
    means: Any
    log_scales: Any
    logit_opacities: Any
    sun: Any


def irradiance(scatterers: Scatterers, emitters: int, visibility: list[Any], lanes: Lanes) -> list[Any]:
    """Light that arrives at each Gaussian: three Floats [M] at the side to which its normal points, three at the other;
    1 where all around is as bright as a white surface under the Sun, as far as areas add up to surfaces (`OVERLAP`).

    emitters: how many of the Gaussians scatter, evenly chosen by number, each in place of N / emitters;
    visibility: [M] in a list, or nothing for 1

    Sum over emitters k of rho_k v_k |n_k . s| F with F = A cos_i cos_k / (pi r^2 + A), the disc of Wallace et al.
    (1989), A its area: 2 pi s_1 s_2 opacity, its two longer axes', times N / emitters, times `OVERLAP`.
    """
    numbers = _emitters(scatterers, emitters, visibility, lanes)
    packed = [store(values, dr.arange(ad.UInt32, emitters), emitters) for values in packets(numbers)]
    dr.eval(packed)
    means = lanes.spread(scatterers.means)
    normals = unit_normals(ad.Array3f(lanes.block(scatterers.features, scatterers.normals, 3)))

    def received(k: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
        x, y, z, nx, ny, nz, area, *light = load(packed, k, emitters)[:10]
        away = ad.Array3f(x, y, z) - means
        square = dr.squared_norm(away)
        away *= dr.rsqrt(dr.maximum(square, 1e-12))
        here, there = dr.dot(normals, away), dr.maximum(-dr.dot(ad.Array3f(nx, ny, nz), away), 0)
        share = area * there / dr.maximum(dr.fma(dr.pi, square, area), 1e-20)
        sides = share * dr.maximum(here, 0), share * dr.maximum(-here, 0)
        return k + 1, [dr.fma(side, light[c], sums[3 * i + c]) for i, side in enumerate(sides) for c in range(3)]

    def more(k: Any, _sums: list[Any]) -> Any:
        return k < emitters

    start = ad.UInt32(0), [dr.zeros(ad.Float, lanes.capacity) for _ in range(6)]
    _, sums = dr.while_loop(start, more, received, mode="symbolic", label="bounce")
    return list(sums)


def brightened(colour: Any, light: Any, linear: bool) -> Any:
    """A colour with more light on it, `light` linear. linear: of the colour, which is an sRGB value else, and may get
    beyond 1 as one"""
    return colour + light if linear else encoded_unclipped(decoded(colour) + light)


def brightened_slopes(colour: Any, light: Any, linear: bool) -> tuple[Any, Any]:
    """d `brightened` by colour and by light."""
    if linear:
        return ad.Float(1), ad.Float(1)
    by_light = encoded_slope(decoded(colour) + light)
    return by_light * decoded_slope(colour), by_light


def _emitters(scatterers: Scatterers, emitters: int, visibility: list[Any], lanes: Lanes) -> list[Any]:
    """Ten Floats [emitters]: place, normal of the lit side, area, light that it scatters a piece of area."""
    each = ad.Float(lanes.count) / emitters
    k = ad.UInt32((ad.Float(dr.arange(ad.UInt32, emitters)) + 0.5) * each)
    k = dr.minimum(k, lanes.count - 1)

    def rows(first: int) -> list[Any]:
        return [dr.gather(ad.Float, scatterers.features, (first + i) * lanes.count + k) for i in range(3)]

    place, log_scales = (dr.gather(ad.Array3f, of, k) for of in (scatterers.means, scatterers.log_scales))
    normal = unit_normals(ad.Array3f(rows(scatterers.normals)))
    cosine = dr.dot(normal, scatterers.sun)
    least = dr.minimum(log_scales[0], dr.minimum(log_scales[1], log_scales[2]))
    opacity = opacities(dr.gather(ad.Float, scatterers.logit_opacities, k))
    area = 2 * dr.pi * OVERLAP * each * opacity * dr.exp(dr.sum(log_scales) - least)
    seen = dr.abs(cosine)
    if visibility:
        seen *= dr.gather(ad.Float, visibility[0], k)
    light = [seen * sigmoid(logit) for logit in rows(scatterers.albedos)]
    numbers = [*place, *dr.select(cosine < 0, -normal, normal), dr.minimum(area, LARGEST_AREA), *light]
    sound = dr.isfinite(sum(numbers, ad.Float(0))) & ~dr.isnan(area)  # one that is not would reach all others
    return [dr.select(sound, number, 0) for number in numbers]
