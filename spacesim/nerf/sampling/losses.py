"""What training minimises beside the error of colours, each with its gradient by hand; sums are made in fixed order."""

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Float
from spacesim.nerf.sampling.render import spread, sum_rays
from spacesim.nerf.sampling.sampler import count_below, intervals

EPSILON = 1e-5  #: to which the interlevel loss compares weights


def interlevel(
    edges: Float,
    weights: Float,
    rays: int,
    samples: int,
    proposal_edges: Float,
    proposal_weights: Float,
    proposals: int,
) -> tuple[Float, Float]:
    """(loss [R], its gradient by the proposal's weights [R P]): how far weights of the field exceed what the proposal
    has over the same part of the ray (Barron et al. 2022, equation 13). The field is not asked to follow the proposal.

    edges, weights: of the field, [R (S + 1)] and [R S];  proposal_edges, proposal_weights: [R (P + 1)] and [R P]
    """
    low, high, ray = intervals(edges, rays, samples)
    first = ray * (proposals + 1)
    begin = count_below(proposal_edges, first, proposals + 1, low, equal=True)
    begin = dr.maximum(begin, 1) - 1
    end = count_below(proposal_edges, first, proposals + 1, high)
    sums = dr.block_prefix_sum(proposal_weights, proposals, exclusive=False)
    bound = _sum_before(sums, ray * proposals, end, proposals) - _sum_before(sums, ray * proposals, begin, proposals)
    excess = dr.maximum(weights - dr.maximum(bound, 0), 0)
    slope = dr.rcp(weights + EPSILON)
    loss = sum_rays(excess * excess * slope, samples)
    by_bound = dr.block_prefix_sum(-2 * excess * slope, samples, exclusive=False)
    # an interval of the proposal is in the bounds of all intervals of the field that overlap it: those are neighbours
    low, high, ray = intervals(proposal_edges, rays, proposals)
    first = ray * (samples + 1)
    after = count_below(edges, first + 1, samples, low, equal=True)
    until = count_below(edges, first, samples, high)
    gradient = _sum_before(by_bound, ray * samples, until, samples) - _sum_before(
        by_bound, ray * samples, after, samples
    )
    return loss, dr.select(until > after, gradient, 0)


def normal_slope(normal: Array3f, slope: Array3f, weights: Float) -> Array3f:
    """[3, N] gradient by normals [3, N], of any length, of the sum of weights |n / |n| + slope / |slope||^2 (Verbin et
    al. 2022, equation 11): normals point against the slope of density, which is not asked to follow them."""
    per_length = dr.rsqrt(dr.maximum(dr.squared_norm(normal), 1e-12))
    unit = normal * per_length
    wanted = slope * -dr.rsqrt(dr.maximum(dr.squared_norm(slope), 1e-12))
    return (unit * dr.dot(unit, wanted) - wanted) * (2 * weights * per_length)


def _sum_before(sums: Float, first: dr.ArrayBase, count: dr.ArrayBase, most: int) -> Float:
    """Sum of the first `count` values, from inclusive prefix sums."""
    place = dr.minimum(dr.maximum(count, 1), most) - 1
    return dr.select(count > 0, dr.gather(ad.Float, sums, first + place), 0)


def distortion(edges: Float, weights: Float, rays: int, samples: int) -> tuple[Float, Float]:
    """(loss [R], its gradient by the weights [R S]): mean distance between two places of a ray where light is lost
    (Barron et al. 2022, equation 15)."""
    low, high, _ = intervals(edges, rays, samples)
    middle, length = 0.5 * (low + high), high - low
    moment = weights * middle
    weight_before, moment_before = (dr.block_prefix_sum(value, samples) for value in (weights, moment))
    weight_all, moment_all = (spread(sum_rays(value, samples), samples) for value in (weights, moment))
    weight_after, moment_after = weight_all - weight_before - weights, moment_all - moment_before - moment
    to_others = middle * (weight_before - weight_after) - moment_before + moment_after
    loss = sum_rays(weights * (to_others + weights * length / 3), samples)
    return loss, 2 * to_others + 2 / 3 * weights * length
