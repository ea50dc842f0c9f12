"""Where a ray is sampled: evenly in the first round, then where proposals saw density.

Arrays of samples lie ray by ray: interval k of ray r is number r S + k, its edges are r (S + 1) + k and the next. Edges
are shares of the ray's part in the box, from 0 to 1.
"""

from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Float, UInt32

PADDING = 0.05  #: of the samples of a round, at most, that are spread over all intervals alike


def step_key(seed: int, step: int) -> int:
    """The key of `random` in a step of a training."""
    return int(np.random.SeedSequence([seed, 4, step]).generate_state(1)[0])


def random(key: UInt32, index: UInt32, stream: int) -> Float:
    """[N] uniform in [0, 1), by counter: number `index` of a stream, the same whatever computes it (PCG output
    function, O'Neill 2014, as a hash: Jarzynski & Olano 2020).  key: UInt32 of width 1, see `step_key`"""
    bits = _hash(index + _hash(key + _hash(ad.UInt32(stream))))
    return ad.Float(bits >> 8) * 2.0**-24


def random_below(key: UInt32, index: UInt32, stream: int, count: UInt32) -> UInt32:
    """[N] whole numbers from 0 to `count` - 1 (Lemire 2019, biased by at most count / 2^32)."""
    drawn: Any = dr.mul_hi(_hash(index + _hash(key + _hash(ad.UInt32(stream)))), count)
    return drawn


def _hash(value: UInt32) -> UInt32:
    state = value * 747796405 + 2891336453
    word = ((state >> ((state >> 28) + 4)) ^ state) * 277803737
    return (word >> 22) ^ word


def uniform_edges(rays: int, samples: int, jitter: Float) -> Float:
    """[R (S + 1)] even edges, the inner ones shifted by `jitter` [R], one half for none, within half an interval."""
    index = dr.arange(ad.UInt32, rays * (samples + 1))
    ray, k = index // (samples + 1), index % (samples + 1)
    shift = dr.gather(ad.Float, jitter, ray) - 0.5
    inner = (k > 0) & (k < samples)
    return (ad.Float(k) + dr.select(inner, shift, 0)) / samples


def resample(edges: Float, weights: Float, rays: int, samples: int, wanted: int, jitter: Float) -> Float:
    """[R (wanted + 1)] edges at shares (k + jitter) / (wanted + 1) of the piecewise constant density that `weights` [R
    S] give over intervals with `edges` [R (S + 1)]: with jitter [R] uniform in [0, 1), the mean number of edges in an
    interval is proportional to its weight. Each interval's weight is raised by `PADDING` / S, so that all are seen."""
    raised = dr.maximum(weights, 0) + PADDING / samples
    before = dr.block_prefix_sum(raised, samples)
    total = dr.block_reduce(dr.ReduceOp.Add, raised, samples, mode="evaluated")
    index = dr.arange(ad.UInt32, rays * (wanted + 1))
    ray, k = index // (wanted + 1), index % (wanted + 1)
    target = (ad.Float(k) + dr.gather(ad.Float, jitter, ray)) / (wanted + 1) * dr.gather(ad.Float, total, ray)
    first = ray * samples
    interval = last_at_most(before, first, samples, target)
    share = (target - dr.gather(ad.Float, before, first + interval)) / dr.gather(ad.Float, raised, first + interval)
    low = dr.gather(ad.Float, edges, ray * (samples + 1) + interval)
    high = dr.gather(ad.Float, edges, ray * (samples + 1) + interval + 1)
    return low + dr.clip(share, 0, 1) * (high - low)


def last_at_most(values: Float, first: UInt32, count: int, target: Float) -> UInt32:
    """[N] place, from `first` [N] on, of the last of `count` rising values that is at most `target`; 0 where none
    is."""
    return dr.maximum(count_below(values, first, count, target, equal=True), 1) - 1


def count_below(values: Float, first: UInt32, count: int, target: Float, equal: bool = False) -> UInt32:
    """[N] how many of `count` rising values from `first` [N] on are below `target` [N], or also equal to it."""
    below = dr.zeros(ad.UInt32, dr.width(target))
    step = 1 << (count.bit_length() - 1)
    while step:
        place = below + step
        inside = place <= count
        value = dr.gather(ad.Float, values, first + place - 1, inside)
        below = dr.select(inside & ((value <= target) if equal else (value < target)), place, below)
        step >>= 1
    return below


def intervals(edges: Float, rays: int, samples: int) -> tuple[Float, Float, UInt32]:
    """(low edge, high edge, ray) [R S] of each interval."""
    index = dr.arange(ad.UInt32, rays * samples)
    ray = index // samples
    return dr.gather(ad.Float, edges, index + ray), dr.gather(ad.Float, edges, index + ray + 1), ray
