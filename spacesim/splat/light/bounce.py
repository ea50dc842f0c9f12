"""One bounce: sunlight that some Gaussians scatter onto all others, as if nothing stood in between.

What faces away from the Sun, or lies in a shadow, is not black beside a lit surface: one that a path tracer or a camera
sees. A field that takes the cosines of one Gaussian cannot know which of its neighbours are lit; visibility does.
"""

from dataclasses import dataclass

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Bool, Float, UInt32
from spacesim.learning.mlp import sigmoid
from spacesim.learning.reflectance import unit_normals
from spacesim.splat.light.padded_batch import PaddedBatch
from spacesim.splat.raster.gaussians import opacities
from spacesim.splat.raster.records import load, packets, store
from spacesim.splat.raster.tone import decode_srgb, decode_srgb_slope, encode_srgb_slope, encode_srgb_unclipped

ALBEDO = -1.0  #: logit of the albedos at the start: 0.27
OVERLAP = 0.3  #: share of the Gaussians' areas that is surface: they overlap, albedos learn the rest
MAX_EMITTER_AREA = 1e12  #: bound on an emitter's area, m^2: products stay finite in float32


@dataclass
class Scatterers:
    """Gaussians as surfaces."""

    #: Float, packed [F * N], in which normals stand from row `normals` and the logits of albedos (RGB) from row
    #: `albedos`
    features: Float
    normals: int  #: first row of the normals in `features`
    albedos: int  #: first row of the albedos' logits in `features`
    means: Array3f  #: Array3f [3, N], metres
    log_scales: Array3f  #: Array3f [3, N]
    logit_opacities: Float  #: [N]
    sun: Array3f  #: Array3f of width 1, unit, towards the Sun


def irradiance(scatterers: Scatterers, emitters: int, visibility: list[Float], batch: PaddedBatch) -> list[Float]:
    """Light that arrives at each Gaussian: three Floats [M] at the side to which its normal points, three at the other;
    1 where all around is as bright as a white surface under the Sun, as far as areas add up to surfaces (`OVERLAP`).

    emitters: how many of the Gaussians scatter, evenly chosen by number, each in place of N / emitters;
    visibility: [M] in a list, or nothing for 1

    Sum over emitters k of rho_k v_k |n_k . s| F with F = A cos_i cos_k / (pi r^2 + A), the disc of Wallace et al.
    (1989), A its area: 2 pi s_1 s_2 opacity, its two longer axes', times N / emitters, times `OVERLAP`.
    """
    numbers = _emitters(scatterers, emitters, visibility, batch)
    packed = [store(values, dr.arange(ad.UInt32, emitters), emitters) for values in packets(numbers)]
    dr.eval(packed)
    means = batch.repeat_last(scatterers.means)
    normals = unit_normals(ad.Array3f(batch.block(scatterers.features, scatterers.normals, 3)))

    def received(k: UInt32, sums: list[Float]) -> tuple[UInt32, list[Float]]:
        x, y, z, nx, ny, nz, area, *light = load(packed, k, emitters)[:10]
        away = ad.Array3f(x, y, z) - means
        square = dr.squared_norm(away)
        away *= dr.rsqrt(dr.maximum(square, 1e-12))
        here, there = dr.dot(normals, away), dr.maximum(-dr.dot(ad.Array3f(nx, ny, nz), away), 0)
        share = area * there / dr.maximum(dr.fma(dr.pi, square, area), 1e-20)
        sides = share * dr.maximum(here, 0), share * dr.maximum(-here, 0)
        return k + 1, [dr.fma(side, light[c], sums[3 * i + c]) for i, side in enumerate(sides) for c in range(3)]

    def has_more(k: UInt32, _sums: list[Float]) -> Bool:
        return k < emitters

    start = ad.UInt32(0), [dr.zeros(ad.Float, batch.capacity) for _ in range(6)]
    _, sums = dr.while_loop(start, has_more, received, mode="symbolic", label="bounce")
    return list(sums)


def add_irradiance(color: Float, light: Float, linear: bool) -> Float:
    """A colour with more light on it, `light` linear. linear: of the colour, which is an sRGB value else, and may get
    beyond 1 as one"""
    return color + light if linear else encode_srgb_unclipped(decode_srgb(color) + light)


def add_irradiance_slopes(color: Float, light: Float, linear: bool) -> tuple[Float, Float]:
    """d `add_irradiance` by colour and by light."""
    if linear:
        return ad.Float(1), ad.Float(1)
    light_slope = encode_srgb_slope(decode_srgb(color) + light)
    return light_slope * decode_srgb_slope(color), light_slope


def _emitters(scatterers: Scatterers, emitters: int, visibility: list[Float], batch: PaddedBatch) -> list[Float]:
    """Ten Floats [emitters]: place, normal of the lit side, area, light that it scatters a piece of area."""
    each = ad.Float(batch.count) / emitters
    k = ad.UInt32((ad.Float(dr.arange(ad.UInt32, emitters)) + 0.5) * each)
    k = dr.minimum(k, batch.count - 1)

    def rows(first: int) -> list[Float]:
        return [dr.gather(ad.Float, scatterers.features, (first + i) * batch.count + k) for i in range(3)]

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
    numbers = [*place, *dr.select(cosine < 0, -normal, normal), dr.minimum(area, MAX_EMITTER_AREA), *light]
    sound = dr.isfinite(sum(numbers, ad.Float(0))) & ~dr.isnan(area)  # one that is not would reach all others
    return [dr.select(sound, number, 0) for number in numbers]
