"""Volume rendering (thesis 2.2 to 2.5) of densities that are constant in each interval, and its adjoint by hand.

tau is density times length of an interval. Sums along rays are made in a fixed order: the same bits in every run.
"""

from dataclasses import dataclass
from typing import TypeVar

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Float, UInt32

LN2 = 0.6931471805599453


@dataclass
class Weights:
    """What each of R S intervals contributes."""

    weights: Float  #: [R S] T_i alpha_i (2.5)
    behind: Float  #: [R S] transmittance after the interval
    tau: Float  #: [R S] density times length


def volume_weights(tau: Float, samples: int) -> Weights:
    """Of optical thicknesses [R S], at least 0."""
    before = dr.block_prefix_sum(tau, samples)
    reaches = dr.exp(-before)
    behind = reaches * dr.exp(-tau)
    return Weights(reaches - behind, behind, tau)


def weights_adjoint(made: Weights, gradient: Float, samples: int) -> Float:
    """[R S] gradient by tau from that by the weights: d w_j / d tau_i is T_i+1 for j = i and -w_j for j > i."""
    later = dr.block_prefix_sum(made.weights * gradient, samples, exclusive=True, reverse=True)
    return made.behind * gradient - later


SumT = TypeVar("SumT", Float, UInt32, Array3f)  #: the same type in and out


def sum_rays(values: SumT, samples: int) -> SumT:
    """[R] sums over the intervals of each ray, of an array [R S] or nested ones."""
    return dr.block_reduce(dr.ReduceOp.Add, values, samples, mode="evaluated")


def spread(values: SumT, samples: int) -> SumT:
    """[R S] a ray's value for each of its intervals."""
    size = dr.width(values) * samples
    return dr.gather(type(values), values, dr.arange(ad.UInt32, size) // samples)


def expected_depth(weights: Float, middles: Float, samples: int) -> Float:
    """[R] mean t of the light that stays; 0 where none does. middles: [R S] t"""
    mass = sum_rays(weights, samples)
    return dr.select(mass > 0, sum_rays(weights * middles, samples) / dr.maximum(mass, 1e-12), 0)


def median_depth(made: Weights, low: Float, high: Float, samples: int) -> Float:
    """[R] t at which half of the light is gone, exact where densities are constant in intervals; 0 where more than
    half gets through. low, high: [R S] t"""
    passed = sum_rays(dr.select(made.behind > 0.5, ad.UInt32(1), ad.UInt32(0)), samples)
    reached = passed < samples
    place: UInt32 = dr.arange(ad.UInt32, dr.width(passed)) * samples + dr.minimum(passed, samples - 1)
    first, last, tau = (dr.gather(ad.Float, value, place) for value in (low, high, made.tau))
    thickness_before = -dr.log(dr.gather(ad.Float, made.behind, place)) - tau
    share = dr.clip((LN2 - thickness_before) / dr.maximum(tau, 1e-12), 0, 1)
    return dr.select(reached, dr.fma(share, last - first, first), 0)
