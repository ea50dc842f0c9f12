"""Gaussians and a merged partition of radiance fields on the rays of some pixels, in one order from the camera on.

What fills a ray is constant in its segments; a Gaussian is a thin screen at its centre's depth, as splatting has it
(2.14 to 2.16). So the order is that of depths along the optical axis: before a Gaussian comes what of the segments lies
before its depth, and the one in which it lies is cut there. Nothing is approximated beyond what both have alone.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Bool, Float, UInt32
from spacesim.backend.packet import load, packets, store
from spacesim.splat.raster.lists.tiles import TileLists, round_capacity
from spacesim.splat.raster.project import Splats
from spacesim.splat.raster.records import (
    ALPHA_MAX,
    POWER_MIN,
    TRANSMITTANCE_MIN,
    ListedRecords,
    exp2,
    list_records,
    pack_records,
)

OF_SPLAT = 6  #: numbers of a splat's record before its depth and its features


@dataclass
class Segments:
    """What lies along the rays of R pixels, in K segments each that abut, from the nearest on."""

    low: Float  #: [R K] depth along the optical axis, metres
    high: Float  #: [R K]
    density: Float  #: [R K] per metre of that depth
    features: list[Float]  #: [R K] each


@dataclass
class ListedSplats:
    """The splats of a picture's tiles, nearest first, with their features."""

    records: ListedRecords  #: the first feature is the depth
    lists: TileLists  #: which splats each tile has
    features: int  #: without the depth


def listed(splats: Splats, features: list[Float], lists: TileLists) -> ListedSplats:
    """For `blend_segments`. features: [N] each"""
    records = _records(splats, [splats.depth, *features], lists, round_capacity(dr.width(splats.x)))
    return ListedSplats(records, lists, len(features))


@recorded
def _records(splats: Splats, features: list[Float], lists: TileLists, capacity: int) -> ListedRecords:
    return list_records(pack_records(splats, features, capacity), lists, capacity)


@dataclass
class Blended:
    """Of R pixels; sums are of weight x value."""

    transmittance: Float  #: [R]
    depth: Float  #: [R] sum, metres; a segment's, or that of a piece of one, is its middle's
    median_depth: Float  #: [R] metres, where half of the light is gone; 0 where it is not
    common: list[Float]  #: [R] each, of the features that both have
    of_splats: list[Float]  #: [R] each, of the Gaussians' other ones
    of_segments: list[Float]  #: [R] each, of the segments' other ones


@recorded(elements=None)
def blend_segments(
    splats: ListedSplats, segments: Segments, pixel: UInt32, width: UInt32, count: int, common: int
) -> Blended:
    """Blend splats and segments over the pixels number `pixel` [R], row by row, of a picture `width` wide.

    count: K, segments of a ray;  common: so many features, from the first, are the same of both
    """
    lists, rays, shape = splats.lists, dr.width(pixel), splats.lists.shape
    numbers = [segments.low, segments.high, segments.density, *segments.features]
    index = dr.arange(ad.UInt32, rays * count)
    packed = [store(values, index, rays * count) for values in packets(numbers)]
    dr.eval(packed)
    across = dr.maximum(width, 1)
    column, row = pixel % across, pixel // across
    x, y = ad.Float(column) + 0.5, ad.Float(row) + 0.5
    tile = (row // shape.height) * lists.tiles_x + column // shape.width
    first = dr.arange(ad.UInt32, rays) * count
    sizes = common, splats.features - common, len(segments.features) - common

    def goes_on(k: UInt32, end: UInt32, j: UInt32, _reached: Float, transmittance: Float, *_: object) -> Bool:
        return ((k < end) & (transmittance > TRANSMITTANCE_MIN)) | (j < count)

    def take_next(
        k: UInt32,
        end: UInt32,
        j: UInt32,
        reached: Float,
        transmittance: Float,
        depth: Float,
        median: Float,
        sums: list[list[Float]],
    ) -> Any:
        is_segment, is_splat = j < count, (k < end) & (transmittance > TRANSMITTANCE_MIN)
        low, high, density, *there = load(packed, first + j, rays * count, is_segment)
        record = _splat(splats, k, is_splat)
        high, z = dr.select(is_segment, high, dr.inf), dr.select(is_splat, record[OF_SPLAT], dr.inf)
        splat_first = is_splat & (z <= high)
        dx, dy = x - record[0], y - record[1]
        power = dr.fma(dr.fma(record[4], dy, record[3] * dx), dy, dr.fma(record[2] * dx, dx, record[5]))
        blends = splat_first & (power >= POWER_MIN)

        # the segment, or what is left of it before the splat
        passes = is_segment & (blends | ~splat_first)
        start, stop = dr.maximum(low, reached), dr.select(splat_first, z, high)
        thickness = dr.select(passes, density * dr.maximum(stop - start, 0), 0)
        behind = transmittance * dr.exp(-thickness)
        weight = transmittance - behind
        share = dr.log(dr.maximum(2 * transmittance, 1)) / dr.maximum(thickness, 1e-12)
        half = (transmittance >= 0.5) & (behind < 0.5)
        median = dr.select(half, dr.fma(dr.minimum(share, 1), stop - start, start), median)
        depth = dr.fma(weight, dr.select(is_segment, 0.5 * (start + stop), 0), depth)

        # the splat
        alpha: Any = dr.select(blends, dr.minimum(exp2(power), ALPHA_MAX), 0)
        finishes = blends & (behind * (1 - alpha) <= TRANSMITTANCE_MIN)
        taken = dr.select(finishes, 0, alpha * behind)
        left = behind - taken
        median = dr.select((behind >= 0.5) & (left < 0.5), z, median)
        depth = dr.fma(taken, dr.select(is_splat, z, 0), depth)

        own = record[OF_SPLAT + 1 :]
        both, splat, segment = sums
        both = [dr.fma(weight, there[c], dr.fma(taken, own[c], both[c])) for c in range(sizes[0])]
        splat = [dr.fma(taken, own[common + c], splat[c]) for c in range(sizes[1])]
        segment = [dr.fma(weight, there[common + c], segment[c]) for c in range(sizes[2])]
        reached = dr.select(passes, dr.maximum(reached, stop), reached)
        k, j = dr.select(finishes, end, dr.select(splat_first, k + 1, k)), dr.select(splat_first, j, j + 1)
        return k, end, j, reached, left, depth, median, [both, splat, segment]

    state = (
        dr.gather(ad.UInt32, lists.start, tile),
        dr.gather(ad.UInt32, lists.end, tile),
        dr.zeros(ad.UInt32, rays),
        dr.full(ad.Float, -dr.inf, rays),
        dr.full(ad.Float, 1, rays),
        dr.zeros(ad.Float, rays),
        dr.zeros(ad.Float, rays),
        [[dr.zeros(ad.Float, rays) for _ in range(size)] for size in sizes],
    )
    *_, transmittance, depth, median, sums = dr.while_loop(state, goes_on, take_next, mode="symbolic", label="walk")
    dr.eval(transmittance, depth, median, sums)
    return Blended(transmittance, depth, median, *sums)


def _splat(splats: ListedSplats, k: UInt32, active: Bool) -> list[Float]:
    if splats.lists.capacity == 0:  # there is none
        return [ad.Float(0)] * (OF_SPLAT + 1 + splats.features)
    return splats.records.load(splats.lists, k, active)
