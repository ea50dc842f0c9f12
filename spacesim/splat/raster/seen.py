"""Which splats a picture shows: most of a closed body's stand behind others."""

from dataclasses import dataclass
from functools import reduce
from operator import or_

import drjit as dr

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Bool, Float, UInt32
from spacesim.splat.raster.lists.tiles import TileLists, round_capacity, thread_offsets
from spacesim.splat.raster.project import Splats
from spacesim.splat.raster.records import (
    ALPHA_MAX,
    POWER_MIN,
    TRANSMITTANCE_MIN,
    exp2,
    exponents,
    list_records,
    pack_records,
)
from spacesim.splat.raster.walks import whole_lists


@dataclass
class Chosen:
    """Some of N splats or Gaussians. Arrays may be longer; what stands beyond has no meaning."""

    count: UInt32  #: UInt32 of width 1, K
    numbers: UInt32  #: of the chosen
    #: of each of the N among the chosen, K or more where it is not one of them; None where nobody asks
    places: UInt32 | None

    def place_of(self, number: UInt32) -> UInt32:
        """Of `places`."""
        assert self.places is not None, "nothing goes back from these to all"
        return dr.gather(ad.UInt32, self.places, number)


def shown_splats(
    splats: Splats, lists: TileLists, size: tuple[int, int], least: float, order: UInt32 | None = None
) -> Chosen:
    """Those that weigh more than `least` in some pixel, among them what finishes a pixel and is not blended. size:
    width and height of the picture;  order: in which they are wanted, of all N and of the numbers up to
    `round_capacity(N)`"""
    return _shown(splats, lists, size, least, round_capacity(dr.width(splats.x)), order)


@recorded
def _shown(
    splats: Splats, lists: TileLists, size: tuple[int, int], least: float, capacity: int, order: UInt32 | None
) -> Chosen:
    """capacity: length of the arrays"""
    is_shown, number = _weighing(splats, lists, size, least, capacity), dr.arange(ad.UInt32, capacity)
    if order is not None:
        is_shown, number = dr.gather(ad.UInt32, is_shown, order), order
    before = dr.prefix_sum(is_shown)
    total = dr.gather(ad.UInt32, before, capacity - 1) + dr.gather(ad.UInt32, is_shown, capacity - 1)
    dr.eval(before, total)
    numbers, places = dr.zeros(ad.UInt32, capacity), dr.empty(ad.UInt32, capacity)
    dr.scatter(numbers, number, before, is_shown > 0, dr.ReduceMode.Permute)
    dr.scatter(places, dr.select(is_shown > 0, before, capacity), number, mode=dr.ReduceMode.Permute)
    dr.eval(numbers, places)
    return Chosen(total, numbers, places)


def _weighing(splats: Splats, lists: TileLists, size: tuple[int, int], least: float, capacity: int) -> UInt32:
    """1 for each splat that is shown, 0 for others, [capacity]: a walk as blending's, which ends sooner."""
    records = list_records(pack_records(splats, [], capacity), lists, capacity)
    walks, found = whole_lists(lists, 0), dr.zeros(ad.UInt32, capacity)
    thread, end = walks.thread, walks.end
    inside = [(thread.column + i < size[0]) & (thread.row + j < size[1]) for i, j in thread_offsets(lists.shape)]
    open_still = max(least, TRANSMITTANCE_MIN)
    passed_first = [dr.select(of_picture, ad.Float(1), 0) for of_picture in inside]

    def alive(k: UInt32, transmittance: list[Float]) -> Bool:
        return (k < end) & reduce(or_, (passed > open_still for passed in transmittance))

    def pass_through(k: UInt32, transmittance: list[Float]) -> tuple[UInt32, list[Float]]:
        powers = list(exponents(records.load(lists, k), thread.x, thread.y, lists.shape))
        weights = []
        for power, passed in zip(powers, transmittance, strict=True):
            shows = (power >= POWER_MIN) & (passed > open_still)
            weights.append(dr.select(shows, dr.minimum(exp2(power), ALPHA_MAX) * passed, 0))
        weighs = reduce(or_, (weight > least for weight in weights))
        dr.scatter(found, ad.UInt32(1), dr.gather(ad.UInt32, lists.splat, k), weighs)
        return k + 1, [passed - weight for passed, weight in zip(transmittance, weights, strict=True)]

    if lists.capacity > 0:
        dr.while_loop((walks.start, passed_first), alive, pass_through, mode="symbolic", label="shown")
        dr.eval(found)
    return found
