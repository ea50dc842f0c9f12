"""A step of training, traced once: rays, samples, colours, losses, the adjoint of all that, Adam."""

from dataclasses import dataclass

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Float, UInt32
from spacesim.backend.packet import numbers_at
from spacesim.learning.adam import adam_step
from spacesim.nerf.fields.field import Parameters
from spacesim.nerf.fields.model import Networks, places
from spacesim.nerf.sampling.losses import distortion, interlevel, normal_slope
from spacesim.nerf.sampling.rays import pixel_rays
from spacesim.nerf.sampling.render import spread, sum_rays, volume_weights, weights_adjoint
from spacesim.nerf.sampling.sampler import random, random_below
from spacesim.nerf.shadow import mix, ray_visibility
from spacesim.nerf.train.pixels import Pixels

RAY, BACKGROUND = 8, 9  #: streams of random numbers


@dataclass
class StepNumbers:
    """What changes from one step to the next, each of width 1."""

    key: UInt32  #: see `sampler.step_key`
    anneal: Float  #: power of the proposals' weights
    skips: Float  #: 1 where rays skip what is empty, else 0
    factors: Float  #: [5] Adam's two corrections for the field, and for the proposals, step size


def step(
    networks: Networks,
    parameters: Parameters,
    first: list[Float],
    second: list[Float],
    pixels: Pixels,
    filled: Float,
    numbers: StepNumbers,
    proposals_learn: bool,
) -> tuple[Parameters, list[Float], list[Float], Float]:
    """(parameters, first moments, second moments, loss of the colours) after a step."""
    loss, gradients = loss_and_gradients(networks, parameters, pixels, filled, numbers, proposals_learn)
    first_of_field, count = networks.bounds[1], len(parameters)
    factors = numbers_at(numbers.factors, range(5))
    parts = [(first_of_field, count, factors[:2])]
    if proposals_learn:  # moments have seen fewer steps than the field's
        parts.insert(0, (0, first_of_field, factors[2:4]))
    kept = parts[0][0]
    result = parameters[:kept], first[:kept], second[:kept]
    for start, stop, (of_first, of_second) in parts:
        moments, rates = (first[start:stop], second[start:stop]), [factors[4]] * (stop - start)
        moved = adam_step(parameters[start:stop], gradients[start:stop], moments, rates, (of_first, of_second))
        dr.eval(moved)
        result = tuple(before + new for before, new in zip(result, moved, strict=True))  # type: ignore[assignment]
    return (*result, loss)


def loss_and_gradients(
    networks: Networks,
    parameters: Parameters,
    pixels: Pixels,
    filled: Float,
    numbers: StepNumbers,
    proposals_learn: bool,
) -> tuple[Float, Parameters]:
    """(mean squared error of colours, gradients of the whole loss by the parameters; those of proposals that do not
    learn are empty)."""
    config = networks.config
    count, samples = config.rays, config.samples
    ray = dr.arange(ad.UInt32, count)
    chosen = random_below(numbers.key, ray, RAY, pixels.count)
    place, view = dr.gather(ad.UInt32, pixels.place, chosen), dr.gather(ad.UInt32, pixels.view, chosen)
    x, y = ad.Float(place & 0xFFFF) + 0.5, ad.Float(place >> 16) + 0.5
    rays = pixel_rays(pixels.cameras, view, x, y, pixels.extent)
    clipped, crosses = networks.occupancy.clip(rays, filled)
    skips = crosses & (numbers.skips > 0)  # a ray that crosses nothing is sampled everywhere: there may be something
    rays.near, rays.far = dr.select(skips, clipped.near, rays.near), dr.select(skips, clipped.far, rays.far)
    dr.eval(rays.origin, rays.direction, rays.near, rays.far)

    edges, rounds = networks.sample(parameters, rays, count, numbers.key, numbers.anneal)
    t, lengths, index = places(rays, edges, count, samples)
    point, direction = rays.at(index, t)
    towards = ad.Array3f([dr.gather(ad.Float, pixels.suns, view * 3 + i) for i in range(3)])
    sun = dr.gather(ad.Array3f, towards, index) if config.knows_sun else None
    own = networks.of_round(parameters, 2)
    density, color, tape = networks.field.look_up(own, point, direction, sun)
    made = volume_weights(density * lengths, samples)
    weights = made.weights
    visible = ad.Float(1)
    if config.casts_shadows:
        low, high = t - 0.5 * lengths, t + 0.5 * lengths
        seen = ray_visibility(networks, parameters, filled, pixels.extent, rays, made, low, high, towards)
        visible = spread(dr.select(numbers.skips > 0, seen, 1), samples)  # at first all is fog
        color = mix(color, visible)

    background = [_background(config.random_background, numbers.key, 3 * ray + i) for i in range(3)]
    truth = dr.gather(ad.UInt32, pixels.color, chosen)
    alpha = ad.Float(truth >> 24) / 255
    opacity = sum_rays(weights, samples)
    scale = 1 / (3 * count)
    loss = ad.Float(0)
    by_weights = dr.zeros(ad.Float, count * samples)
    by_color = []
    for i in range(3):
        shown = sum_rays(weights * color[i], samples) + (1 - opacity) * background[i]
        wanted = ad.Float(truth >> (8 * i) & 0xFF) / 255 * alpha + (1 - alpha) * background[i]
        error = shown - wanted
        loss += dr.sum(error * error) * scale
        by_shown = spread(2 * scale * error, samples)
        by_color.append(by_shown * weights)
        by_weights += by_shown * (color[i] - spread(background[i], samples))
    if config.casts_shadows:
        by_color = [g * visible for g in by_color] + [g * (1 - visible) for g in by_color]
    if config.distortion_weight > 0:
        _, by_distortion = distortion(edges, weights, count, samples)
        by_weights += config.distortion_weight / count * by_distortion
    by_density = weights_adjoint(made, by_weights, samples) * lengths
    by_normal = None
    if tape.normal is not None and config.normal_weight > 0:
        slopes = networks.field.density.slopes(own[: networks.field.split], tape.density)
        by_normal = normal_slope(tape.normal, slopes, config.normal_weight / count * weights)
    of_field = networks.field.adjoint(own, tape, by_density, by_color, by_normal)

    of_proposals: Parameters = []
    if proposals_learn:
        for number, (round_, round_config) in enumerate(zip(rounds, networks.rounds, strict=True)):
            wanted_samples = round_config.samples
            weights_there = round_.made.weights
            _, slope = interlevel(edges, weights, count, samples, round_.edges, weights_there, wanted_samples)
            slope *= config.interlevel_weight / count
            by_density = weights_adjoint(round_.made, slope, wanted_samples) * round_.lengths
            proposal = networks.proposals[number]
            of_proposals += proposal.adjoint(networks.of_round(parameters, number), round_.tape, by_density, [])
    else:
        of_proposals = [ad.Float(0)] * networks.bounds[1]
    return loss, of_proposals + of_field


def look_at_cells(networks: Networks, parameters: Parameters, key: UInt32, first: UInt32, count: int) -> Float:
    """[count] densities in cells of the occupancy grid, from number `first` (width 1) on."""
    point = networks.occupancy.points(key, dr.arange(ad.UInt32, count) + first)
    dr.eval(point)
    density, _ = networks.density_tape(parameters, point)
    return density


def note_densities(networks: Networks, state: Float, density: Float) -> tuple[Float, Float]:
    """(state, filled cells) of the occupancy grid after a look at all cells."""
    state = networks.occupancy.updated(state, density)
    dr.eval(state)
    return state, networks.occupancy.filled(state)


def _background(is_random: bool, key: UInt32, index: UInt32) -> Float:
    return random(key, index, BACKGROUND) if is_random else dr.zeros(ad.Float, dr.width(index))
