"""One bounce: sunlight that Gaussians scatter onto all others that they see (`surroundings`).

What faces away from the Sun, or lies in a shadow, is not black beside a lit surface: one that a path tracer or a camera
sees. A field that takes the cosines of one Gaussian cannot know which of its neighbours are lit; visibility does.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import drjit as dr

from spacesim.backend import ad, select
from spacesim.backend.arrays import Array3f, Bool, Float, UInt32
from spacesim.backend.packet import load, packet
from spacesim.learning.networks.network import sigmoid
from spacesim.learning.reflectance import points_away, seen_side_normals, unit_normals
from spacesim.splat.light.padded_batch import PaddedBatch
from spacesim.splat.light.surroundings import Surroundings, ray_count
from spacesim.splat.raster.seen import Chosen
from spacesim.splat.raster.tone import decode_srgb, decode_srgb_slope, encode_srgb_slope, encode_srgb_unclipped

ALBEDO = -1.0  #: logit of the albedos at the start: 0.27
SPECULAR = -3.0  #: logit of the specular reflectances at the start: 0.05
ROUGHNESS = 0.15  #: GGX alpha at which surfaces mirror what others scatter (docs/research/light.md)
TURN = {"cuda": 4, "llvm": 1}  #: rays a turn of the loop: their numbers are read at once
GLASS = 0.04  #: specular reflectance of a glossy surface of refractive index 1.5


@dataclass
class Scatterers:
    """Gaussians as surfaces."""

    #: Float, packed [F * N], in which normals stand from row `normals` and the logits of albedos (RGB) from row
    #: `albedos`
    features: Float
    normals: int  #: first row of the normals in `features`
    albedos: int  #: first row of the albedos' logits in `features`
    sun: Array3f  #: Array3f of width 1, unit, towards the Sun


@dataclass(frozen=True)
class Parts:
    """What is gathered of the light that comes along rays, RGB each."""

    front: bool = False  #: w cos / pi of each ray on the side of the normal, which is 1 where the light all around is 1
    back: bool = False  #: the same of the other side
    mirrored: bool = False  #: two of `ray_weights`

    @property
    def count(self) -> int:
        """Weights of a ray."""
        return self.front + self.back + 2 * self.mirrored


@dataclass
class Rays:
    """Of M Gaussians: where theirs stand in `Surroundings.met`, and what weighs them."""

    begin: UInt32  #: [M], the first
    end: UInt32  #: [M], one past the last
    normals: Array3f  #: [3, M], unit
    direction: Array3f | None  #: [3, M], unit, from the camera; None: none is mirrored


BOTH_SIDES = Parts(front=True, back=True)  #: of light that arrives, what does not depend on the viewer


def rays_on_sides(scatterers: Scatterers, surroundings: Surroundings, batch: PaddedBatch) -> Rays:
    """All rays of the batch's Gaussians."""
    begin, *_, end = _bounds(surroundings, batch)
    return Rays(begin, _of_real(batch, begin, end), _normals(scatterers, batch), None)


def rays_on_seen(scatterers: Scatterers, surroundings: Surroundings, batch: PaddedBatch, direction: Array3f) -> Rays:
    """Those on the side that is seen, to which normals are turned. direction: [3, M], unit, from the camera"""
    normals = _normals(scatterers, batch)
    away, normals = points_away(normals, direction), seen_side_normals(normals, direction)
    begin, behind, past, end = _bounds(surroundings, batch)
    begin, end = dr.select(away, behind, begin), dr.select(away, end, past)
    return Rays(begin, _of_real(batch, begin, end), normals, direction)


def _of_real(batch: PaddedBatch, begin: UInt32, end: UInt32) -> UInt32:
    """The end of each Gaussian's rays; columns that are no Gaussian's have none."""
    return dr.select(batch.is_real(), end, begin)


def received_on_sides(
    scatterers: Scatterers, surroundings: Surroundings, emitted: list[Float], emitters: int, batch: PaddedBatch
) -> list[Float]:
    """Light that each Gaussian receives at the side to which its normal points, then at the other: RGB, Floats [M]
    each. emitted: of `emission`, by so many `emitters`"""
    sorted_ = _sorted_batch(surroundings, batch)
    rays = rays_on_sides(scatterers, surroundings, sorted_)
    return _in_columns(_gathered(surroundings, emitted, emitters, rays, BOTH_SIDES), sorted_, batch)


def received_on_seen(
    scatterers: Scatterers,
    surroundings: Surroundings,
    emitted: list[Float],
    emitters: int,
    batch: PaddedBatch,
    directions: Callable[[PaddedBatch], Array3f],
    parts: Parts,
) -> list[Float]:
    """These parts of the light that arrives at the side that is seen, Floats [M]. directions: Array3f [3, M], unit,
    from the camera to a batch's Gaussians"""
    sorted_ = _sorted_batch(surroundings, batch)
    rays = rays_on_seen(scatterers, surroundings, sorted_, directions(sorted_))
    return _in_columns(_gathered(surroundings, emitted, emitters, rays, parts), sorted_, batch)


def _sorted_batch(surroundings: Surroundings, batch: PaddedBatch) -> PaddedBatch:
    """The same Gaussians in `Surroundings.order`, in which their rays are gathered sooner; chosen ones as they come."""
    return batch if batch.chosen else replace(batch, chosen=Chosen(batch.count, surroundings.order, None))


def _in_columns(values: list[Float], rays: PaddedBatch, batch: PaddedBatch) -> list[Float]:
    """Values [M] of the Gaussians of `rays`, a `_sorted_batch`, as the batch has these."""
    if rays is batch:
        return values
    is_real, own = rays.is_real(), dr.arange(ad.UInt32, batch.capacity)
    place = dr.select(is_real, rays.numbers(), own)
    columns = [dr.empty(ad.Float, batch.capacity) for _ in values]
    for column, value in zip(columns, values, strict=True):
        dr.scatter(column, dr.select(is_real, value, 0), place, mode=dr.ReduceMode.Permute)
    dr.eval(columns)
    return columns


def _bounds(surroundings: Surroundings, batch: PaddedBatch) -> list[UInt32]:
    """The four of `Surroundings.bounds`, [M] each."""
    return [dr.gather(ad.UInt32, surroundings.bounds, i * batch.count + batch.numbers()) for i in range(4)]


def _gathered(surroundings: Surroundings, emitted: list[Float], emitters: int, own: Rays, parts: Parts) -> list[Float]:
    """Light along rays, three Floats [M], RGB, for each weight."""
    rays, turn, share = ray_count(emitters), TURN[select()], ad.Float(ray_share(emitters))
    normals, direction = own.normals, own.normals if own.direction is None else own.direction
    view = -dr.dot(normals, direction)

    def has_more(k: UInt32, end: UInt32, _sums: list[Float]) -> Bool:
        return k < end

    def add(k: UInt32, end: UInt32, sums: list[Float]) -> tuple[UInt32, UInt32, list[Float]]:
        listed = [k + u < end if u else ad.Bool(True) for u in range(turn)]
        met = [dr.gather(ad.UInt32, surroundings.met, k + u, listed[u]) for u in range(turn)]
        light = [load(emitted, met[u] & 0xFFFF, 2 * emitters, listed[u])[:3] for u in range(turn)]
        towards = [ad.Array3f(load(surroundings.directions, ray >> 16, rays)[:3]) for ray in met]
        for u in range(turn):
            here, along = dr.dot(normals, towards[u]), dr.dot(towards[u], direction)
            weights = ray_weights(parts, here, along, view, share, dr)
            terms = [(weight, light[u][c]) for weight in weights for c in range(3)]
            sums = [dr.fma(*term, total) for term, total in zip(terms, sums, strict=True)]
        return k + turn, end, sums

    sums = [ad.Float(0) for _ in range(3 * parts.count)]
    return list(dr.while_loop((own.begin, own.end, sums), has_more, add, mode="symbolic", label="bounce")[2])


def ray_share(emitters: int) -> float:
    """The angle w that a ray stands for, over pi."""
    return 4 / ray_count(emitters)


class Functions(Protocol):
    """Of numbers: Dr.Jit's, or those of a kernel's text."""

    def maximum(self, x: Any, y: Any) -> Any:
        """The larger of two."""

    def rcp(self, x: Any) -> Any:
        """1 / x."""

    def sqrt(self, x: Any) -> Any:
        """Square root."""


def ray_weights(parts: Parts, here: Any, along: Any, view: Any, share: Any, functions: Functions) -> list[Any]:
    """How much light along a ray l counts, for each of the parts. here: n.l;  along: l.d, d from the camera;
    view: n.v = -n.d;  share: of `ray_share`

    What is mirrored towards the viewer is on the scale of the others: per specular reflectance at normal incidence,
    then per what it is at grazing incidence, D n.l w / (4 (l.h)^2), the first times 1 - f, the other times
    f = (1 - l.h)^5: facets of GGX (Walter et al. 2007) with the visibility of Kelemen and Szirmay-Kalos (2001) and
    Schlick's reflectance (1994); h halfway between ray and viewer, alpha^2 = `ROUGHNESS`^2 + w / (4 pi): half of the
    ray's own spread.
    """
    maximum, rcp = functions.maximum, functions.rcp
    weights = [share * maximum(here, 0)] if parts.front else []
    if parts.back:
        weights.append(share * maximum(-here, 0))
    if parts.mirrored:
        both = maximum(1 - along, 1e-6)  # 1 + l.v = 2 (l.h)^2
        alpha2, sum_ = 0.25 * share + ROUGHNESS**2, here + view
        spread = maximum(both - 0.5 * (1 - alpha2) * (sum_ * sum_), 1e-4 * both)
        weight = 0.5 * share * alpha2 * maximum(here, 0) * both * rcp(spread * spread)
        beyond = 1 - functions.sqrt(0.5 * both)
        square = beyond * beyond
        grazing = weight * (square * square) * beyond
        weights += [weight - grazing, grazing]
    return weights


def grazing_reflectance(specular: Float) -> Float:
    """What a surface of this specular reflectance at normal incidence reflects at grazing incidence: all of it from the
    0.04 of glass on, less where facets hide each other or there are none."""
    return dr.minimum(specular / GLASS, 1)


def grazing_reflectance_slope(specular: Float) -> Float:
    """d `grazing_reflectance`."""
    return dr.select(specular < GLASS, ad.Float(1 / GLASS), 0)


def emission(
    scatterers: Scatterers, surroundings: Surroundings, emitters: int, light: list[Float], gaussians: UInt32
) -> list[Float]:
    """What is gathered of `emitters`: each scatters light from its side that faces the Sun alone. light: that
    they scatter, RGB, Floats [emitters];  gaussians: N"""
    is_back_lit = dr.dot(_normals_of(scatterers, surroundings.emitters, gaussians), scatterers.sun) < 0
    side = 2 * dr.arange(ad.UInt32, emitters) + dr.select(is_back_lit, ad.UInt32(1), 0)
    sound = dr.isfinite(sum(light, ad.Float(0)))  # one that is not would reach all that see it
    sides = dr.zeros(ad.Float, 4 * 2 * emitters)
    dr.scatter(sides, packet([*(dr.select(sound, value, 0) for value in light), ad.Float(0)]), side)
    dr.eval(sides)
    return [sides]


def albedo_radiance(scatterers: Scatterers, visibility: list[Float], k: UInt32, gaussians: UInt32) -> list[Float]:
    """rho_k v_k |n_k . s| of the Gaussians k, [count], three Floats. visibility: theirs in a list, or nothing for 1;
    gaussians: N"""
    seen = dr.dot(lit_normals(scatterers, k, gaussians), scatterers.sun)
    for share in visibility:
        seen *= share
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


def lit_normals(scatterers: Scatterers, k: UInt32, gaussians: UInt32) -> Array3f:
    """Unit normals of Gaussians k on their sides that face the Sun. gaussians: N"""
    normal = _normals_of(scatterers, k, gaussians)
    return dr.select(dr.dot(normal, scatterers.sun) < 0, -normal, normal)


def _normals_of(scatterers: Scatterers, k: UInt32, gaussians: UInt32) -> Array3f:
    """Unit normals of Gaussians k. gaussians: N"""
    rows = [dr.gather(ad.Float, scatterers.features, (scatterers.normals + i) * gaussians + k) for i in range(3)]
    return unit_normals(ad.Array3f(rows))
