"""Packets: numbers side by side in memory, which a thread reads at once."""

from collections.abc import Iterable
from typing import Any

import drjit as dr

from spacesim.backend.arrays import ArrayXf, Bool, Float, NumberT, UInt32
from spacesim.backend.selection import ad, select

PACKETS = {"cuda": (1, 2, 4), "llvm": (2, 4, 8)}  #: numbers that a thread reads or adds at once


def gather_packet(array: Float, index: UInt32, size: int, active: Bool | bool = True) -> Any:
    """Packet `index` of `size` numbers, 2, 4 or 8: an Array2f, Array4f or ArrayXf; 0 where not `active`."""
    if size == 8:
        return dr.gather(ad.ArrayXf, array, index, active, shape=(size, dr.width(index)))
    return dr.gather(ad.Array4f if size == 4 else ad.Array2f, array, index, active)


def numbers_at(array: NumberT, indices: Iterable[int]) -> list[NumberT]:
    """Entries of an array, of width 1 each; evaluated where `evaluates_numbers`."""
    numbers = [dr.gather(type(array), array, ad.UInt32(i)) for i in indices]
    if evaluates_numbers():
        dr.eval(numbers)
    return numbers


def evaluates_numbers() -> bool:
    """Whether numbers of an array that a kernel reads are evaluated before: on LLVM each packet of SIMD lanes would
    gather them anew (two cores project 30,000 Gaussians in 0.11 ms, gathering the camera's numbers in 0.21). A symbolic
    loop cannot wait for that."""
    return select() == "llvm" and not dr.flag(dr.JitFlag.SymbolicScope)


def packet_sizes(numbers: int) -> list[int]:
    """How so many numbers of an entry are divided among arrays, in each of which those of an entry stand side by side:
    a thread reads or adds a packet at once. On LLVM one of eight numbers costs little more than one of four."""
    sizes = PACKETS[select()]
    rest = numbers % sizes[-1]
    return [sizes[-1]] * (numbers // sizes[-1]) + ([next(size for size in sizes if size >= rest)] if rest else [])


def packets(values: list[Float]) -> list[list[Float]]:
    """Values by `packet_sizes`, the last filled up with zeros."""
    filled, done = [], 0
    for size in packet_sizes(len(values)):
        packet = values[done : done + size]
        filled.append(packet + [ad.Float(0)] * (size - len(packet)))
        done += size
    return filled


def store(values: list[NumberT], index: UInt32, size: int) -> NumberT:
    """A flat array [size * len(values)] in which `values` of an element stand at its index, by one packet scatter."""
    array_type = type(values[0])
    target = dr.empty(array_type, len(values) * size)
    if len(values) == 1:
        dr.scatter(target, values[0], index)
        return target
    dr.scatter(target, (ad.ArrayXu if array_type is ad.UInt32 else ad.ArrayXf)(values), index)
    return target


def packet(values: list[Float]) -> ArrayXf | Float:
    """Values of an entry as one array, to be stored or added at once."""
    kinds = {2: ad.Array2f, 4: ad.Array4f}
    return values[0] if len(values) == 1 else kinds.get(len(values), ad.ArrayXf)(values)


def load(arrays: list[Float], index: UInt32, capacity: int, active: Bool | bool = True) -> list[Float]:
    """The numbers of entry `index` of arrays of `capacity` entries; 0 where not `active`."""
    values: list[Float] = []
    for array in arrays:
        count = dr.width(array) // capacity
        size = packet_sizes(count)[-1]
        for part in range(count // size):
            place = index * (count // size) + part
            if size == 1:
                values.append(dr.gather(ad.Float, array, place, active))
            else:
                values += list(gather_packet(array, place, size, active))
    return values
