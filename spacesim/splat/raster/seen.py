"""Which splats a picture shows: most of a closed body's stand behind others."""

from dataclasses import dataclass
from functools import reduce
from operator import or_

import drjit as dr

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Bool, Float, UInt32
from spacesim.splat.raster.lists.tiles import TileLists, round_capacity
from spacesim.splat.raster.project import Splats
from spacesim.splat.raster.records import ALPHA_MAX, POWER_MIN, exp2, exponents, list_records, pack_records
from spacesim.splat.raster.walks import whole_lists


@dataclass
class Chosen:
    """Some of N splats or Gaussians. Arrays are of length N or longer; what stands beyond has no meaning."""

    count: UInt32  #: UInt32 of width 1, K
    numbers: UInt32  #: of the chosen, in order
    places: UInt32  #: of each among the chosen, K or more where it is not one of them


def shown_splats(splats: Splats, lists: TileLists, least: float) -> Chosen:
    """Those that weigh more than `least` in some pixel."""
    return _shown(splats, lists, least, round_capacity(dr.width(splats.x)))


@recorded
def _shown(splats: Splats, lists: TileLists, least: float, capacity: int) -> Chosen:
    """capacity: length of the arrays"""
    is_shown = _weighing(splats, lists, least, capacity)
    places = dr.prefix_sum(is_shown)
    total = dr.gather(ad.UInt32, places, capacity - 1) + dr.gather(ad.UInt32, is_shown, capacity - 1)
    dr.eval(places, total)
    numbers, index = dr.zeros(ad.UInt32, capacity), dr.arange(ad.UInt32, capacity)
    dr.scatter(numbers, index, places, is_shown > 0, dr.ReduceMode.Permute)
    places = dr.select(is_shown > 0, places, capacity)
    dr.eval(numbers, places)
    return Chosen(total, numbers, places)


def _weighing(splats: Splats, lists: TileLists, least: float, capacity: int) -> UInt32:
    """1 for each splat that is shown, 0 for others, [capacity]: a walk as blending's, which ends sooner."""
    records = list_records(pack_records(splats, [], capacity), lists, capacity)
    walks, found = whole_lists(lists, 0), dr.zeros(ad.UInt32, capacity)
    thread, end = walks.thread, walks.end

    def alive(k: UInt32, transmittance: list[Float]) -> Bool:
        return (k < end) & reduce(or_, (passed > least for passed in transmittance))

    def pass_through(k: UInt32, transmittance: list[Float]) -> tuple[UInt32, list[Float]]:
        powers = exponents(records.load(lists, k), thread.x, thread.y, lists.shape)
        weights = []
        for power, passed in zip(powers, transmittance, strict=True):
            weights.append(dr.select(power >= POWER_MIN, dr.minimum(exp2(power), ALPHA_MAX) * passed, 0))
        weighs = reduce(or_, (weight > least for weight in weights))
        dr.scatter(found, ad.UInt32(1), dr.gather(ad.UInt32, lists.splat, k), weighs)
        return k + 1, [passed - weight for passed, weight in zip(transmittance, weights, strict=True)]

    if lists.capacity > 0:
        dr.while_loop((walks.start, walks.transmittance), alive, pass_through, mode="symbolic", label="shown")
        dr.eval(found)
    return found
