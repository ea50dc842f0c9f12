"""Pairs of rows in few arrays that fill the memory that Dr.Jit takes for them.

Dr.Jit gives an array the next power of two of bytes: 20,000 numbers take as much as 32,768. Fifteen pairs of such rows
in one array take as much as 16 would of 20,000 * 16 / 15. So pairs are dealt to arrays that are nearly full; a thread
reads and writes those of its Gaussian by packets. On CUDA these cost no more than rows. On a CPU they do: two cores
take 0.59 ms for 15 pairs of 30,000 Gaussians, rows 0.44. There rows stay as they are where packets take no less memory.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import drjit as dr
import numpy as np

from spacesim.backend import ad, select
from spacesim.backend.arrays import Float, UInt32
from spacesim.backend.packet import PACKETS, gather_packet, packet
from spacesim.backend.upload import upload

SMALL = 2**14  #: Gaussians: so few take little anyway, and each way to deal their rows is compiled on its own
SHARES = (15, 14, 12, 8, 4, 3, 2, 1)  #: pairs of an array: few, and most near powers of two


@dataclass(frozen=True)
class PackedArray:
    """An array for `pairs` pairs of rows: `size` numbers, a power of two, for up to `capacity` Gaussians.

    So it stays the same array, to recordings and compiled kernels, while the number of Gaussians changes a little.
    """

    pairs: int
    size: int

    @property
    def capacity(self) -> int:
        """How many Gaussians find place."""
        return self.size // (2 * self.pairs)

    def packets(self) -> Iterator[tuple[int, int]]:
        """(numbers of a packet, number of the first Gaussian's packet of that size), packet by packet. Those of all
        Gaussians stand together: pairs of rows, side by side."""
        largest, done = PACKETS[select()][-1], 0
        for size in (8, 4, 2):
            while size <= largest and 2 * self.pairs - done >= size:
                yield size, done * self.capacity // size
                done += size


Layout = tuple[PackedArray, ...]
PLAIN: Layout = ()  #: rows as they are, [N] each


def plan_packing(pairs: int, count: int) -> Layout:
    """The arrays for `pairs` pairs of rows of `count` Gaussians that take the least memory, large ones first; of equals
    the fewest. On LLVM `PLAIN` where rows take no more, as those of up to `SMALL` Gaussians; on CUDA these have the
    same arrays up to each power of two, as large as single rows would be."""
    plan = _least(pairs, count)
    of_rows = 2 * pairs << (max(count, 1) - 1).bit_length()
    return PLAIN if select() == "llvm" and sum(pack.size for pack in plan) >= of_rows else plan


@lru_cache(maxsize=1024)
def _least(pairs: int, count: int) -> Layout:
    if pairs == 0:
        return ()
    plans = []
    for share in SHARES:
        if share <= pairs and (count > SMALL or share.bit_count() == 1):
            size = 1 << (2 * share * max(count, 1) - 1).bit_length()
            plans.append((PackedArray(share, size), *_least(pairs - share, count)))
    return min(plans, key=lambda several: (sum(pack.size for pack in several), len(several)))


def zeros(layout: Layout, pairs: int, count: int) -> list[Float]:
    """Arrays of nothing but zeros, in memory of their own."""
    return [dr.opaque(ad.Float, 0, size) for size in [pack.size for pack in layout] or [count] * (2 * pairs)]


def load(arrays: list[Float], layout: Layout, index: UInt32) -> tuple[list[Float], list[Float]]:
    """The first and the second row of each pair, at entries `index`."""
    numbers: list[Float] = []
    if layout == PLAIN:
        numbers = [dr.gather(ad.Float, row, index) for row in arrays]
    else:
        for array, pack in zip(arrays, layout, strict=True):
            for size, first in pack.packets():
                numbers += list(gather_packet(array, index + first, size))
    return numbers[::2], numbers[1::2]


def store(first_moments: list[Float], second_moments: list[Float], layout: Layout) -> list[Float]:
    """New arrays with such rows, of one width: `load`'s inverse. To be evaluated with what else comes of the same
    numbers; entries beyond the rows have no meaning."""
    numbers = [row for pair in zip(first_moments, second_moments, strict=True) for row in pair]
    if layout == PLAIN:
        return numbers
    index, arrays, done = dr.arange(ad.UInt32, dr.width(first_moments[0])), [], 0
    for pack in layout:
        array = dr.empty(ad.Float, pack.size)
        for size, first in pack.packets():
            values = packet(numbers[done : done + size])
            dr.scatter(array, values, index + first, mode=dr.ReduceMode.NoConflicts)  # all in one kernel
            done += size
        arrays.append(array)
    return arrays


def unpack_numpy(arrays: list[Float], layout: Layout, count: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """`load` of the first `count` entries, without Dr.Jit: float32 [count] each."""
    numbers: list[np.ndarray] = []
    if layout == PLAIN:
        numbers = [np.array(row) for row in arrays]
    else:
        for array, pack in zip(arrays, layout, strict=True):
            values = np.array(array)
            for size, first in pack.packets():
                numbers += list(values[first * size : (first + count) * size].reshape(count, size).T.copy())
    return numbers[::2], numbers[1::2]


def pack_numpy(
    first_moments: Sequence[np.ndarray], second_moments: Sequence[np.ndarray], layout: Layout
) -> list[Float]:
    """`store` without Dr.Jit: of float32 [N] each."""
    numbers = [row for pair in zip(first_moments, second_moments, strict=True) for row in pair]
    if layout == PLAIN:
        return [upload(row) for row in numbers]
    arrays, done, count = [], 0, len(first_moments[0]) if first_moments else 0
    for pack in layout:
        values = np.zeros(pack.size, np.float32)
        for size, first in pack.packets():
            values[first * size : (first + count) * size] = np.stack(numbers[done : done + size], axis=-1).ravel()
            done += size
        arrays.append(upload(values))
    return arrays


def release(before: int, after: int) -> None:
    """Give back to the system what was freed, where rows of `after` numbers take another size of memory than rows of
    `before`: Dr.Jit keeps freed arrays by their size, and nothing would ever use those again."""
    if (before - 1).bit_length() != (after - 1).bit_length():
        dr.flush_malloc_cache()
