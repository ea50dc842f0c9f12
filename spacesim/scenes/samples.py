"""Samples of a picture: where they lie in their pixels, and the random numbers of their paths.

Both depend on a sample's own pixel and number, not on which others are traced. (Of surfaces in one place, Embree's
choice may.)
"""

from dataclasses import dataclass
from functools import cache

from spacesim import backend
from spacesim.backend import mitsuba_types as mt
from spacesim.backend.arrays import Bool, Float, UInt32

_R2_STEPS = (3242174889, 2447445414)
"""2^32 / g and 2^32 / g^2 with g^3 = g + 1 (Roberts 2018, "The unreasonable effectiveness of quasirandom
sequences"): unsigned overflow keeps the fraction."""


@dataclass(frozen=True)
class Noise:
    """Of one pass over a picture, inputs of kernels."""

    paths: UInt32  #: seeds
    shift: UInt32  #: seeds
    first: UInt32  #: number of the pass's first sample


def pixel_offsets(pixel: UInt32, sample: UInt32, seed: UInt32) -> mt.Point2f:
    """Where in its pixel a sample lies, in [0, 1)^2: the R2 sequence, shifted at random for each pixel, so
    that few samples cover it evenly."""
    mi = backend.mitsuba()
    shift = mi.sample_tea_32(pixel, seed)
    fractions = [(sample * step + start) >> 8 for step, start in zip(_R2_STEPS, shift, strict=True)]
    return mi.Point2f(*(mi.Float(fraction) * 2.0**-24 for fraction in fractions))


def path_sampler(seed: UInt32, path: UInt32) -> mt.Sampler:
    """Random numbers of paths [N]: those that Mitsuba's independent sampler gives to the numbers `path`."""
    sampler: mt.Sampler = _path_sampler()(seed, path)
    return sampler


@cache
def _path_sampler() -> type:
    """Of the chosen backend. Mitsuba's own counts paths from 0, without gaps."""
    mi = backend.mitsuba()

    class PathSampler(mi.Sampler):  # type: ignore[name-defined]
        def __init__(self, seed: UInt32, path: UInt32) -> None:
            mi.Sampler.__init__(self, mi.Properties())
            state, stream = mi.sample_tea_32(seed, path)
            self.random = mi.PCG32()
            self.random.seed(mi.UInt64(state), mi.UInt64(stream))

        def next_1d(self, active: Bool | bool = True) -> Float:
            return self.random.next_float32(mi.Bool(active))

        def next_2d(self, active: Bool | bool = True) -> mt.Point2f:
            first = self.next_1d(active)
            return mi.Point2f(first, self.next_1d(active))

    return PathSampler
