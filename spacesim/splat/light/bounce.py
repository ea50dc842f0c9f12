"""One bounce: sunlight that some Gaussians scatter onto all others, as if nothing stood in between.

What faces away from the Sun, or lies in a shadow, is not black beside a lit surface: one that a path tracer or a camera
sees. A field that takes the cosines of one Gaussian cannot know which of its neighbours are lit; visibility does.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Bool, Float, UInt32, UInt64
from spacesim.learning.mlp import sigmoid
from spacesim.learning.reflectance import seen_side_normals, unit_normals
from spacesim.splat.light.padded_batch import PaddedBatch
from spacesim.splat.raster.gaussians import opacities
from spacesim.splat.raster.records import load, packets, store
from spacesim.splat.raster.sort import segment_ids
from spacesim.splat.raster.tone import decode_srgb, decode_srgb_slope, encode_srgb_slope, encode_srgb_unclipped

ALBEDO = -1.0  #: logit of the albedos at the start: 0.27
SPECULAR = -3.0  #: logit of the specular reflectances at the start: 0.05
ROUGHNESS = 0.15  #: GGX alpha at which surfaces mirror what others scatter (docs/research/light.md)
OVERLAP = 0.3  #: share of the Gaussians' areas that is surface: they overlap, albedos learn the rest
GLASS = 0.04  #: specular reflectance of a glossy surface of refractive index 1.5
EMITTER = 10  #: numbers of an emitter: place, normal, area, light
WIDE = 0.1  #: of the training frame's unit, squared: what has more area is no likelier to be chosen as an emitter
LEAST_COSINE = 0.3  #: a glossy surface at a grazing Sun is brighter than its cosine says: it counts as much at least
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
    unit: Float  #: of width 1, metres, of the training frame


Weights = Callable[[Array3f, Float], list[Float]]
"""How much light of an emitter counts where it arrives: (unit direction towards it [3, M], w / pi, see `_seen_emitter`)
to Floats [M]."""


def received(
    scatterers: Scatterers, emitters: list[Float], count: int, batch: PaddedBatch, *kinds: Weights
) -> list[Float]:
    """Light of all emitters that arrives at each Gaussian, three Floats [M], RGB, for each weight of each kind.

    emitters: of `scattering`, `count` of them
    """
    means = batch.repeat_last(scatterers.means)

    def has_more(k: UInt32, _sums: list[Float]) -> Bool:
        return k < dr.minimum(batch.count, count)

    def add(k: UInt32, sums: list[Float]) -> tuple[UInt32, list[Float]]:
        towards, share, light = _seen_emitter(emitters, k, count, means)
        weights = [weight for kind in kinds for weight in kind(towards, share)]
        return k + 1, [dr.fma(weight, light[c], sums[3 * i + c]) for i, weight in enumerate(weights) for c in range(3)]

    sums = [dr.zeros(ad.Float, batch.capacity) for _ in range(6 * len(kinds))]
    return list(dr.while_loop((ad.UInt32(0), sums), has_more, add, mode="symbolic", label="bounce")[1])


def irradiance(scatterers: Scatterers, batch: PaddedBatch) -> Weights:
    """Light at the side to which a Gaussian's normal points, then at the other; 1 where the light of all around is 1,
    as far as areas add up to surfaces (`OVERLAP`).

    F = A cos_i cos_k / (pi r^2 + A), the disc of Wallace et al. (1989), A its area.
    """
    normals = _normals(scatterers, batch)

    def at_sides(towards: Array3f, share: Float) -> list[Float]:
        here = dr.dot(normals, towards)
        return [share * dr.maximum(here, 0), share * dr.maximum(-here, 0)]

    return at_sides


def mirroring(scatterers: Scatterers, direction: Array3f, batch: PaddedBatch) -> Weights:
    """Light that a Gaussian mirrors towards the viewer, on the scale of `irradiance`: per specular reflectance at
    normal incidence, then per what it is at grazing incidence. direction: Array3f [3, M], unit, from the camera

    D n.l w / (4 (l.h)^2), the first times 1 - f, the other times f = (1 - l.h)^5: facets of GGX (Walter et al. 2007)
    with the visibility of Kelemen and Szirmay-Kalos (2001) and Schlick's reflectance (1994); w = pi A cos_k / (pi r^2
    + A) the angle that the emitter fills, h halfway between it and the viewer, alpha^2 = `ROUGHNESS`^2 + w / (4 pi):
    half of the emitter's own spread.
    """
    normals = seen_side_normals(_normals(scatterers, batch), direction)
    view = -dr.dot(normals, direction)

    def mirrored(towards: Array3f, share: Float) -> list[Float]:
        here = dr.dot(normals, towards)
        both = dr.maximum(1 - dr.dot(towards, direction), 1e-6)  # 1 + l.v = 2 (l.h)^2
        alpha2 = 0.25 * share + ROUGHNESS**2
        spread = dr.maximum(1 - 0.5 * dr.square(here + view) * dr.rcp(both) * (1 - alpha2), 1e-4)
        weight: Float = 0.5 * share * alpha2 * dr.maximum(here, 0) * dr.rcp(dr.square(spread) * both)
        beyond = 1 - dr.sqrt(0.5 * both)
        grazing: Float = weight * dr.square(dr.square(beyond)) * beyond
        return [weight - grazing, grazing]

    return mirrored


def grazing_reflectance(specular: Float) -> Float:
    """What a surface of this specular reflectance at normal incidence reflects at grazing incidence: all of it from the
    0.04 of glass on, less where facets hide each other or there are none."""
    return dr.minimum(specular / GLASS, 1)


def grazing_reflectance_slope(specular: Float) -> Float:
    """d `grazing_reflectance`."""
    return dr.select(specular < GLASS, ad.Float(1 / GLASS), 0)


@dataclass
class Chosen:
    """Gaussians that scatter in place of all, [count] each."""

    number: UInt32  #: which
    share: Float  #: of how many such as it is each stands for


def choose(scatterers: Scatterers, visibility: list[Float], count: int, batch: PaddedBatch) -> Chosen:
    """One of each of `count` even blocks of the N Gaussians: that at the middle of the block's running sum of the
    sunlight that they catch, area v max(|n . s|, `LEAST_COSINE`), in whole numbers, so that the bits repeat; all, once
    each, where they are no more than `count`. In blocks, since a Sun that turns a little then changes few of them.
    visibility: v [M] in a list, or nothing for 1"""
    cosine: Float = dr.abs(dr.dot(_normals(scatterers, batch), scatterers.sun))
    areas = _areas(batch.repeat_last(scatterers.log_scales), batch.repeat_last(scatterers.logit_opacities))
    caught = dr.maximum(cosine, LEAST_COSINE) * dr.minimum(areas, dr.square(WIDE * scatterers.unit))
    for share in visibility:
        caught *= share
    column = dr.arange(ad.UInt32, batch.capacity)
    caught = dr.select((column < batch.count) & (caught > 0), caught, 0)  # what is no number is not above 0
    dr.eval(caught)
    most = dr.max(caught)
    weights: UInt64 = ad.UInt64(caught * (2.0**24 / dr.maximum(most, 1e-30)))
    dr.eval(weights)
    ends: UInt64 = dr.prefix_reduce(dr.ReduceOp.Add, weights, exclusive=False)
    dr.eval(ends)

    index, last = dr.arange(ad.UInt32, count), batch.count - 1

    def sum_before(block: UInt32) -> UInt64:
        first = ad.UInt32(ad.UInt64(block) * ad.UInt64(batch.count) // count)
        return dr.gather(ad.UInt64, ends, first - 1, first > 0)

    before, beyond = sum_before(index), sum_before(index + 1)
    number = dr.minimum(segment_ids(ends, (before + beyond) // 2, batch.capacity), last)
    weight = ad.Float(dr.gather(ad.UInt64, weights, number))
    share = dr.select(beyond > before, ad.Float(beyond - before) / dr.maximum(weight, 1), 0)
    are_few = batch.count <= count
    number = dr.select(are_few, dr.minimum(index, last), number)
    share = dr.select(are_few, dr.select(index <= last, ad.Float(1), 0), share)
    dr.eval(number, share)
    return Chosen(number, share)


def _areas(log_scales: Array3f, logit_opacities: Float) -> Float:
    """m^2: 2 pi s_1 s_2 opacity, of the two longer axes, times `OVERLAP`."""
    least = dr.minimum(log_scales[0], dr.minimum(log_scales[1], log_scales[2]))
    return 2 * dr.pi * OVERLAP * opacities(logit_opacities) * dr.exp(dr.sum(log_scales) - least)


def scattering(
    scatterers: Scatterers, chosen: Chosen, count: int, light: list[Float], batch: PaddedBatch
) -> list[Float]:
    """Emitters as `received` reads them: `count` `chosen` Gaussians, as large as what each stands for; one that stands
    for less than itself is as large as it is, and darker. light: that they scatter, RGB, Floats [count]"""
    index, k = dr.arange(ad.UInt32, count), chosen.number
    place, log_scales = (dr.gather(ad.Array3f, of, k) for of in (scatterers.means, scatterers.log_scales))
    normal = lit_normals(scatterers, k, batch.count)
    area = dr.maximum(chosen.share, 1) * _areas(log_scales, dr.gather(ad.Float, scatterers.logit_opacities, k))
    light = [value * dr.minimum(chosen.share, 1) for value in light]
    numbers = [*place, *normal, dr.minimum(area, MAX_EMITTER_AREA), *light]
    sound = dr.isfinite(sum(numbers, ad.Float(0))) & ~dr.isnan(area)  # one that is not would reach all others
    packed = [store(values, index, count) for values in packets([dr.select(sound, number, 0) for number in numbers])]
    dr.eval(packed)
    return packed


def albedo_radiance(scatterers: Scatterers, visibility: list[Float], k: UInt32, gaussians: UInt32) -> list[Float]:
    """rho_k v_k |n_k . s| of the Gaussians k, [count], three Floats. visibility: [M] in a list, or nothing for 1;
    gaussians: N"""
    seen = dr.dot(lit_normals(scatterers, k, gaussians), scatterers.sun)
    if visibility:
        seen *= dr.gather(ad.Float, visibility[0], k)
    logits = [dr.gather(ad.Float, scatterers.features, (scatterers.albedos + i) * gaussians + k) for i in range(3)]
    return [seen * sigmoid(logit) for logit in logits]


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


def _normals(scatterers: Scatterers, batch: PaddedBatch) -> Array3f:
    """Array3f [3, M], unit."""
    return unit_normals(ad.Array3f(batch.block(scatterers.features, scatterers.normals, 3)))


def _seen_emitter(emitters: list[Float], k: UInt32, count: int, means: Array3f) -> tuple[Array3f, Float, list[Float]]:
    """(unit direction towards emitter k [3, M], w / pi: share of the hemisphere's projected angle that it fills seen
    from `means`, its light)."""
    x, y, z, nx, ny, nz, area, *light = load(emitters, k, count)[:EMITTER]
    away = ad.Array3f(x, y, z) - means
    square: Any = dr.squared_norm(away)
    away *= dr.rsqrt(dr.maximum(square, 1e-12))
    there = dr.maximum(-dr.dot(ad.Array3f(nx, ny, nz), away), 0)
    return away, area * there / dr.maximum(dr.fma(dr.pi, square, area), 1e-20), light


def lit_normals(scatterers: Scatterers, k: UInt32, gaussians: UInt32) -> Array3f:
    """Unit normals of Gaussians k on their sides that face the Sun. gaussians: N"""
    rows = [dr.gather(ad.Float, scatterers.features, (scatterers.normals + i) * gaussians + k) for i in range(3)]
    normal = unit_normals(ad.Array3f(rows))
    return dr.select(dr.dot(normal, scatterers.sun) < 0, -normal, normal)
