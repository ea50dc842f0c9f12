"""Arrays of different sizes in one kernel: what is small takes as long to launch as to compute."""

from collections.abc import Sequence
from itertools import accumulate
from typing import TypeVar

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Bool, Float, UInt32

Number = TypeVar("Number", Float, UInt32)


class Joined:
    """Arrays of `sizes` numbers, one after another as one row [S]. May be part of a recording, of which the sizes are
    numbers: for others it must be another recording."""

    def __init__(self, sizes: Sequence[int]) -> None:
        self.size = sum(sizes)
        self._parts = list(zip(accumulate(sizes[:-1], initial=0), sizes, strict=True))

    @property
    def starts(self) -> list[int]:
        """Where each array begins."""
        return [first for first, _ in self._parts]

    def load(self, arrays: Sequence[Float], place: UInt32 | None = None, row: UInt32 | int = 0) -> Float:
        """Numbers at `place` of the row, all by default, where arrays [rows * size] have several: of number `row`."""
        place = self._all() if place is None else place
        values = ad.Float(0)
        for array, (first, size) in zip(arrays, self._parts, strict=True):
            values += dr.gather(ad.Float, array, row * size + (place - first), is_within(place, first, size))
        return values

    def repeat(self, numbers: Sequence[Number], place: UInt32 | None = None) -> Number:
        """Of each array's number at `place` of the row, all by default."""
        place, values = self._all() if place is None else place, type(numbers[0])(0)
        for number, (first, _) in zip(numbers, self._parts, strict=True):
            values = dr.select(place >= first, number, values)
        return values

    def split(self, row: Float) -> list[Float]:
        """The arrays of a row [S]."""
        place, arrays = self._all(), []
        for first, size in self._parts:
            array = dr.empty(ad.Float, size)
            dr.scatter(array, row, place - first, is_within(place, first, size), dr.ReduceMode.NoConflicts)
            arrays.append(array)
        return arrays

    def _all(self) -> UInt32:
        return dr.arange(ad.UInt32, self.size)


def is_within(place: UInt32, first: int, size: int) -> Bool:
    """Whether it is one of `size` places from `first` on."""
    return (place >= first) & (place < first + size)
