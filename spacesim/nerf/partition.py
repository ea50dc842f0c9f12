"""The rays of a picture through several radiance fields: each field's intervals merged into one partition of the ray,
in which densities add up and colours are their means by density (thesis 3.1, algorithm 1).

A field that others shade is darkened as Gaussians are (4.16): its colours times the share of sunlight that comes
through to its surface, which in each pixel is where half of the light that it stops is gone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Float, UInt32
from spacesim.nerf.draw import RaySamples, sample_field
from spacesim.nerf.fields.field import Parameters
from spacesim.nerf.fields.model import Networks
from spacesim.nerf.sampling.rays import Rays, pixel_rays
from spacesim.nerf.sampling.render import spread, sum_rays, volume_weights
from spacesim.nerf.sampling.sampler import count_below
from spacesim.nerf.shadow import transmittance


@dataclass
class Merged:
    """R rays in K segments each, sorted by t."""

    low: Float  #: [R K] t
    high: Float  #: [R K] t
    densities: list[Float]  #: [R K] of each model, per unit of t
    density: Float  #: [R K] their sum (3.6)
    color: list[Float]  #: 3 times [R K], mean by density; 0 where there is none
    intervals: list[UInt32]  #: [R K] of each model, which of its R S intervals a segment lies in; any where in none


def merge(models: Sequence[tuple[RaySamples, int]], rays: int) -> tuple[Merged, int]:
    """(the merged partition, its segments a ray) of models' (samples, intervals a ray) (3.2 to 3.6). A model's
    intervals abut; where they end, it has nothing."""
    edges = [_edges(samples, count, rays) for samples, count in models]
    total = sum(count + 1 for _, count in models)
    boundaries = dr.empty(ad.Float, rays * total)
    for number, (own, (_, count)) in enumerate(zip(edges, models, strict=True)):
        index = dr.arange(ad.UInt32, rays * (count + 1))
        ray, rank = index // (count + 1), index % (count + 1)
        for other, (values, (_, others)) in enumerate(zip(edges, models, strict=True)):
            if other != number:  # of equal boundaries the first model's comes first
                rank += count_below(values, ray * (others + 1), others + 1, own, equal=other < number)
        dr.scatter(boundaries, own, ray * total + rank, mode=dr.ReduceMode.Permute)
    dr.eval(boundaries)
    segments = total - 1
    index = dr.arange(ad.UInt32, rays * segments)
    ray = index // segments
    low, high = dr.gather(ad.Float, boundaries, index + ray), dr.gather(ad.Float, boundaries, index + ray + 1)
    middle = 0.5 * (low + high)
    density = ad.Float(0)
    color = [ad.Float(0)] * 3
    densities, intervals = [], []
    for own, (samples, count) in zip(edges, models, strict=True):
        passed: Any = count_below(own, ray * (count + 1), count + 1, middle, equal=True)
        inside = (passed > 0) & (passed <= count)
        interval = ray * count + dr.minimum(dr.maximum(passed, 1), count) - 1
        there = dr.gather(ad.Float, samples.density, interval, inside)
        density = density + there
        color = [
            c + there * dr.gather(ad.Float, s, interval, inside) for c, s in zip(color, samples.color, strict=True)
        ]
        densities.append(there)
        intervals.append(interval)
    share: Any = dr.select(density > 0, dr.rcp(dr.maximum(density, 1e-30)), 0)
    return Merged(low, high, densities, density, [c * share for c in color], intervals), segments


def _edges(samples: RaySamples, count: int, rays: int) -> Float:
    """[R (S + 1)] boundaries of intervals that abut."""
    index = dr.arange(ad.UInt32, rays * (count + 1))
    ray, k = index // (count + 1), index % (count + 1)
    place = ray * count + dr.minimum(k, count - 1)
    low, high = dr.gather(ad.Float, samples.low, place), dr.gather(ad.Float, samples.high, place)
    return dr.select(k < count, low, high)


@dataclass
class PlacedField:
    """What is drawn of a model: arrays that change with camera, pose and Sun."""

    camera: Float  #: [16] see `rays.camera_rows`, in the model's frame
    extent: Float  #: [3] of its box
    unit: Float  #: of width 1, metres of the world for a side of its box
    turn: Float  #: [9] world_from_model, rotation by rows
    sun: Float | None  #: [5] of `sun_numbers` in the model's axes; None: the field does not take it


class DeviceSunOccluder(Protocol):
    """What is no field and stands in the Sun's way."""

    def visibility(self, points: Array3f) -> Float:
        """[N] share of sunlight that comes through to points [3, N] of the world."""


@dataclass
class MutualShading:
    """What stands between the Sun and the models."""

    towards: list[Float]  #: [3] of each model: towards the Sun in its axes
    casters: tuple[tuple[int, ...], ...]  #: of each model, the others that may shade it
    camera: Float | None  #: [16] see `rays.camera_rows`, world, metres; None where there are only fields
    beside: list[DeviceSunOccluder | None]  #: of each model, what there is beside fields


@dataclass
class PlacedFields:
    """The models of a scene."""

    networks: tuple[Networks, ...]  #: each once
    parameters: list[Parameters]  #: of each of the networks
    filled: list[Float]  #: of each of the networks, see `Occupancy.filled`
    which: tuple[int, ...]  #: of each model, number among the networks
    models: list[PlacedField]  #: each where it stands
    shading: MutualShading | None  #: None where models do not shade each other

    @property
    def segments(self) -> int:
        """K, of a ray that all models are merged on."""
        return sum(self.networks[number].config.samples + 1 for number in self.which) - 1

    @property
    def self_shadows(self) -> bool:
        """Whether some model casts shadows on itself."""
        return any(field.config.casts_shadows for field in self.networks)


@dataclass
class Partition:
    """What lies along R rays, in K segments each: the models merged, and what pictures show of them."""

    merged: Merged  #: density and colour of all models together
    shares: list[Float]  #: [R K] of each model in the density
    slopes: Array3f | None  #: [3, R K] gradient of the density, world axes; None where no normals are asked for
    visibility: Float | None  #: [R K] share of the Sun's light that there is; None where nothing casts shadows
    across: Float  #: [R] depth along the optical axis of a point, per t


def partition(fields: PlacedFields, pixel: UInt32, width: UInt32, count: int, normals: bool) -> Partition:
    """Of the rays through `count` pixels [R], numbered row by row, of a picture `width` wide; t is metres."""
    rays_of, samples_of, slopes_of = [], [], []
    for number, model in zip(fields.which, fields.models, strict=True):
        field, own = fields.networks[number], fields.parameters[number]
        rays, crosses = field.occupancy.clip(model_rays(model, pixel, width), fields.filled[number])
        rays.far = dr.select(crosses, rays.far, rays.near)
        dr.eval(rays.origin, rays.direction, rays.near, rays.far, rays.across)
        seen = sample_field(field, own, fields.filled[number], model.extent, rays, count, model.sun)
        if normals:
            index = dr.arange(ad.UInt32, count * field.config.samples) // field.config.samples
            point, _ = rays.at(index, 0.5 * (seen.low + seen.high))
            _, tape = field.density_tape(own, point)
            slopes = field.field.density.slopes(field.of_round(own, 2)[: field.field.split], tape)
            slopes_of.append(_turned(model.turn, slopes) / (model.unit * model.unit))
        low, high, density = seen.low * model.unit, seen.high * model.unit, seen.density / model.unit
        in_world = RaySamples(low, high, density, seen.color, seen.visibility)
        dr.eval(low, high, density, in_world.color, in_world.visibility, slopes_of)
        rays_of.append(rays)
        samples_of.append(in_world)
    counts = [fields.networks[number].config.samples for number in fields.which]
    lit = _visibilities(fields, rays_of, samples_of, pixel, width, count)
    for k, visibility in enumerate(lit):
        if visibility is not None:
            dimmed = spread(visibility, counts[k])
            samples_of[k].color = [color * dimmed for color in samples_of[k].color]
            dr.eval(samples_of[k].color)
    merged, segments = merge(list(zip(samples_of, counts, strict=True)), count)
    inverse = dr.rcp(dr.maximum(merged.density, 1e-30))
    shares = [dr.select(there > 0, there * inverse, 0) for there in merged.densities]
    slope: Any = None
    if normals:
        slope = ad.Array3f(0)
        for there, slopes, interval in zip(merged.densities, slopes_of, merged.intervals, strict=True):
            slope += dr.select(there > 0, dr.gather(ad.Array3f, slopes, interval), 0)
    seen_sun: Any = None
    if fields.shading is not None or fields.self_shadows:
        seen_sun = ad.Float(0)
        for share, others, samples, interval in zip(shares, lit, samples_of, merged.intervals, strict=True):
            own_light: Float = share if others is None else share * spread(others, segments)
            if samples.visibility is not None:
                own_light *= dr.gather(ad.Float, samples.visibility, interval)
            seen_sun += own_light
    return Partition(merged, shares, slope, seen_sun, rays_of[0].across)


def _visibilities(
    fields: PlacedFields, rays_of: list[Rays], samples_of: list[RaySamples], pixel: UInt32, width: UInt32, count: int
) -> list[Float | None]:
    """Of each model, the share of sunlight [R] that comes through what is not this model to its surface, or None where
    nothing stands before the Sun."""
    shading = fields.shading
    if shading is None:
        return [None] * len(samples_of)
    result: list[Float | None] = []
    for k, own in enumerate(samples_of):
        beside = shading.beside[k]
        if not shading.casters[k] and beside is None:
            result.append(None)
            continue
        t = surface(own, fields.networks[fields.which[k]].config.samples)
        seen = dr.full(ad.Float, 1, count)
        for caster in shading.casters[k]:
            number, model, rays = fields.which[caster], fields.models[caster], rays_of[caster]
            point = dr.fma(rays.direction, t / model.unit, rays.origin)
            towards = ad.Array3f([dr.gather(ad.Float, shading.towards[caster], ad.UInt32(i)) for i in range(3)])
            field = fields.networks[number]
            seen *= transmittance(
                field,
                fields.parameters[number],
                fields.filled[number],
                model.extent,
                point,
                towards,
                0.0,
                count,
                field.config.sun_samples,
            )
        if beside is not None:
            rays = _rays_of(shading.camera, fields.models[k].extent, pixel, width)
            seen *= beside.visibility(dr.fma(rays.direction, t, rays.origin))
        dr.eval(seen)
        result.append(seen)
    return result


def surface(samples: RaySamples, count: int) -> Float:
    """[R] t at which half of the light is gone that a field stops on its own, of `count` samples a ray; any where it
    stops none."""
    made = volume_weights(samples.density * (samples.high - samples.low), count)
    dr.eval(made.weights)
    passed = dr.block_prefix_sum(made.weights, count, exclusive=False)
    half = 0.5 * spread(sum_rays(made.weights, count), count)
    before = sum_rays(dr.select(passed < half, ad.UInt32(1), ad.UInt32(0)), count)
    ray = dr.arange(ad.UInt32, dr.width(before))
    place = ray * count + dr.minimum(before, count - 1)
    low, high, weight, until, wanted = (
        dr.gather(ad.Float, values, place) for values in (samples.low, samples.high, made.weights, passed, half)
    )
    share = 1 - (until - wanted) / dr.maximum(weight, 1e-12)
    return dr.fma(dr.clip(share, 0, 1), high - low, low)


def model_rays(model: PlacedField, pixel: UInt32, width: UInt32) -> Rays:
    """[R] in the coordinates of the model's box."""
    return _rays_of(model.camera, model.extent, pixel, width)


def _rays_of(camera: Any, extent: Float, pixel: UInt32, width: UInt32) -> Rays:
    across = dr.maximum(width, 1)
    x, y = ad.Float(pixel % across) + 0.5, ad.Float(pixel // across) + 0.5
    return pixel_rays(camera, dr.zeros(ad.UInt32, dr.width(pixel)), x, y, extent)


def _turned(turn: Float, vectors: Array3f) -> Array3f:
    numbers = [dr.gather(ad.Float, turn, ad.UInt32(i)) for i in range(9)]
    rows = [sum((numbers[3 * i + k] * vectors[k] for k in range(3)), ad.Float(0)) for i in range(3)]
    return ad.Array3f(*rows)
