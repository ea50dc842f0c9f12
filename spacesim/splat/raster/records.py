"""What blending and its adjoints read: splats as records, and their alphas at a thread's pixels."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import cast

import drjit as dr

from spacesim.backend import ad, recorded, select
from spacesim.backend.arrays import Bool, Float, UInt32
from spacesim.backend.blocks import new_block
from spacesim.backend.packet import load, packets, store
from spacesim.splat.raster.lists.record_copy import copy_records
from spacesim.splat.raster.lists.tiles import TileLists, TileShape
from spacesim.splat.raster.project import ALPHA_MIN, Splats

ALPHA_MAX = 0.999  #: a splat never hides everything behind it
POWER_MIN = math.log2(ALPHA_MIN)  #: of what is blended
TRANSMITTANCE_MIN = 1e-4  #: a pixel is finished before the first splat behind which no more than this would pass
#: splats from which on records are copied in the lists' order first; of fewer threads read them by the splats' numbers:
#: 9 % less of a frame on an H100, 4 % more on two cores; a million are more than the device's cache holds
IN_ORDER = {"cuda": 2**19, "llvm": 0}
LOG2_E = 1.4426950408889634

_EXP2 = (1.0, 0.693147004, 0.240222469, 0.0555071086, 0.00967129413, 0.00132695748)
_ROUNDING = 1.5 * 2.0**23  #: added to a float below 2^22, it leaves its integer part in the last bits


@dataclass
class ListedRecords:
    """The records of splats for walks along their tiles' lists."""

    arrays: list[Float]  #: of `pack_records`; from `IN_ORDER` splats on copied in the lists' order
    capacity: int  #: of `pack_records`

    def load(self, lists: TileLists, k: UInt32, active: Bool | bool = True) -> list[Float]:
        """The record of the splat in place k of the lists; 0 where not `active`."""
        if self.capacity < IN_ORDER[select()]:
            return load(self.arrays, dr.gather(ad.UInt32, lists.splat, k, active), self.capacity, active)
        return load(self.arrays, k, lists.capacity, active)


@dataclass
class BlendState:
    """What blending leaves behind for its way back. What is [T * pixels of a tile] is tile-major: a tile's pixels stand
    thread by thread, a thread's as in `thread_offsets`. B is `count_pieces` of buckets."""

    transmittance: Float  #: what passes through all splats, [T * pixels of a tile]
    last: UInt32  #: one past the last pair blended of each pixel, [T * pixels of a tile]
    records: ListedRecords  #: of the splats
    bucket: int  #: pairs of a bucket of the adjoint, 0 for none
    #: transmittance and sums of each pixel of a bucket's tile before the bucket, by fours, [4 B * pixels of a tile]
    #: each, without meaning where the pixel's thread did not reach it
    checkpoints: list[Float]
    bucket_tile: UInt32 | None  #: the tile of each bucket, [B], the number of tiles where there is none
    bucket_reached: UInt32 | None  #: 1 of each bucket that a thread reached, [B], 0 of others


@dataclass
class BlendResult:
    """What `forward` leaves behind. Planes are [height * width], row by row."""

    features: list[Float]  #: C planes, sum of w_i f_i
    transmittance: Float  #: plane, what passes through all splats
    state: BlendState | None  #: for `backward`, where it was asked for


def pack_records(splats: Splats, features: list[Float], capacity: int) -> list[Float]:
    """The splats' records, in arrays of `packet_sizes`: x, y, -a/2 log2 e, -b log2 e, -c/2 log2 e, log2 o, features.

    capacity: length of the splats' arrays
    """
    numbers = [splats.x, splats.y, -0.5 * LOG2_E * splats.a, -LOG2_E * splats.b, -0.5 * LOG2_E * splats.c]
    numbers += [dr.log2(dr.maximum(splats.opacity, 1e-30)), *features]
    index = dr.arange(ad.UInt32, dr.width(splats.x))
    return [store(values, index, capacity) for values in packets(numbers)]


def list_records(packed: list[Float], lists: TileLists, capacity: int) -> ListedRecords:
    """Records as walks along the lists read them. packed: of `pack_records`, with this capacity"""
    if lists.capacity == 0:
        return ListedRecords([], capacity)
    dr.eval(packed)
    if capacity < IN_ORDER[select()]:
        return ListedRecords(packed, capacity)
    copies = copy_records(packed, lists, capacity)
    return ListedRecords(_ordered(packed, lists, capacity) if copies is None else copies, capacity)


@recorded
def _ordered(packed: list[Float], lists: TileLists, capacity: int) -> list[Float]:
    position = dr.arange(ad.UInt32, lists.capacity)
    ordered = [store(load([array], lists.splat, capacity), position, lists.capacity) for array in packed]
    dr.eval(ordered)
    return ordered


def exponents(record: list[Float], px: Float, py: Float, shape: TileShape, blocks: bool = False) -> Iterator[Float]:
    """log2 of the unclamped alpha (thesis 2.14) at the pixels of a thread whose first is centred at (px, py), one by
    one. blocks: each, and what is done before the next is asked for, is a `new_block`"""
    for i in range(shape.columns):
        dx, dy = px + i - record[0], py - record[1]
        constant = dr.fma(record[2] * dx, dx, record[5])
        linear = record[3] * dx
        for j in range(shape.rows):
            if blocks:
                new_block()
            yield dr.fma(dr.fma(record[4], dy + j, linear), dy + j, constant)


def exp2(power: Float) -> Float:
    """2^power for powers from -126 to 126, without meaning beyond: ask for `power >= POWER_MIN` before it is used.

    CUDA has an instruction for it. On LLVM a polynomial of degree 5 over half a unit to each side of an integer, whose
    largest relative error is least, 9.3e-8, and the integer added to its exponent: half the operations of `dr.exp2`.
    """
    if select() == "cuda":
        return dr.exp2(power)
    shifted = power + _ROUNDING
    fraction = power - (shifted - _ROUNDING)
    value = ad.Float(_EXP2[-1])
    for coefficient in _EXP2[-2::-1]:
        value = dr.fma(value, fraction, coefficient)
    return cast(Float, dr.reinterpret_array(ad.Float, bits_of(value) + (bits_of(shifted) << 23)))


def bits_of(value: Float) -> UInt32:
    """Of a number, as they are: of numbers from 0 on they are in the same order."""
    return cast(UInt32, dr.reinterpret_array(ad.UInt32, value))
