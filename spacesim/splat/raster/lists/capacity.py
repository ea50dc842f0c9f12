"""For how many pairs of tile and splat lists are made: what is expected, what was counted, what memory holds."""

import time
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Protocol

from spacesim.backend import free_memory, select
from spacesim.backend.arrays import UInt32, UInt64
from spacesim.backend.upload import held
from spacesim.data.errors import WorkError
from spacesim.splat.raster.lists.boxes import Boxes, Grid
from spacesim.splat.raster.lists.tiles import STEPS, round_capacity

FEW = 2  #: sizes of the lists of pictures from one power of two to the next
LONG = 2**22  #: pairs from which on lists of pictures have no more capacity than others: a gigabyte
MAX_PAIRS = {"cuda": 0.9 * 2**30, "llvm": 0.9 * 2**29}  #: records hold four or eight numbers a pair, arrays 2^32
PICTURE_BYTES = 200, 85  #: a pair (lists, sorting, blending), a pixel (colour and transmittance): measured on LLVM, 90
#: to 210 a pair, as the rounding of arrays has it
TRAINING_BYTES = {"cuda": (430, 160), "llvm": (300, 280)}  #: the same of a training step, with gradients and the loss;
#: 140 to 280 a pair measured on LLVM; on CUDA, which keeps pixels' states for the adjoint, up to 430

BELIEVED = 0.1  #: seconds for which memory that was free is taken to be


@dataclass(frozen=True)
class Capacities:
    """Of the arrays of a picture's lists."""

    pairs: int  #: P
    splats: int  #: M


@dataclass(frozen=True)
class Extent:
    """Of a picture whose lists are made."""

    count: int  #: splats, N
    width: int  #: pixels
    height: int  #: pixels
    few_sizes: bool = False  #: of lists, as `bin_splats` takes it
    training: bool = False  #: a training step has to find place in memory, not a picture

    @staticmethod
    @lru_cache(maxsize=256, typed=True)
    def of(count: int, width: int, height: int, few_sizes: bool = False, training: bool = False) -> "Extent":
        """The one of the last call like this one: to make what it says takes as long as a kernel."""
        return Extent(count, width, height, few_sizes, training)

    @property
    def live(self) -> UInt32:
        """N on the device."""
        return held(self.count, "splats")

    @cached_property
    def most(self) -> int:
        """M, the capacity of arrays of N."""
        return round_capacity(self.count)

    @cached_property
    def grid(self) -> Grid:
        """Its tiles."""
        return Grid.of(self.width, self.height)

    def capacities(self, pairs: int) -> Capacities:
        """Of lists of so many pairs."""
        return Capacities(pairs, self.most)


class PairCounts(Protocol):
    """Says for how many pairs the lists of pictures are made."""

    def expected(self, extent: Extent) -> int | None:
        """Their capacity before pairs are counted, or None. Who makes such lists says so to `check`."""

    def check(self, extent: Extent, pair_ends: UInt32 | UInt64, capacity: int) -> None:
        """Lists of boxes with these `pair_ends` were made with a capacity that was expected: are there more pairs, they
        are empty."""

    def counted(self, extent: Extent, boxes: Boxes) -> int:
        """Their capacity by the pairs that there are, 0 of none, for which it waits. Raises WorkError for more than can
        be sorted or held in memory."""


class _Waiting:
    """Waits for each count."""

    def expected(self, _: Extent) -> None:
        return None

    def check(self, *_: object) -> None:
        raise AssertionError("no capacity was expected")

    def counted(self, extent: Extent, boxes: Boxes) -> int:
        return list_capacity(boxes.pairs, extent)


WAITING = _Waiting()


def list_capacity(pairs: int, extent: Extent) -> int:
    """Capacity of lists of so many pairs, 0 of none. Raises WorkError, see `check_memory`."""
    check_memory(pairs, extent)
    return rounded_pairs(pairs, extent.few_sizes)


def rounded_pairs(pairs: int, few_sizes: bool) -> int:
    """Capacity of lists of so many pairs, whether there is memory for them or not; 0 of none."""
    return round_capacity(pairs, FEW if few_sizes and pairs < LONG else STEPS) if pairs else 0


def check_memory(pairs: int, extent: Extent) -> None:
    """Raises WorkError where lists of so many pairs cannot be made, or find no place in memory."""
    bytes_a_pair, bytes_a_pixel = TRAINING_BYTES[select()] if extent.training else PICTURE_BYTES
    pixels = extent.width * extent.height
    needed = pairs * bytes_a_pair + pixels * bytes_a_pixel
    most = MAX_PAIRS[select()]
    if pairs > most:
        raise WorkError(f"rasterizer: {pairs:.3g} pairs of tile and splat, at most {most:.3g} can be sorted")
    if needed <= 2**28 or _found.holds(needed):
        return
    free = free_memory(needed)
    if free is not None and needed > free:
        raise WorkError(
            f"rasterizer: {pairs:.3g} pairs of tile and splat on {pixels:.3g} pixels need about {needed / 1e9:.3g} GB "
            f"of memory, {free / 1e9:.3g} GB are free"
        )
    _found.note(needed)


def has_memory(pairs: int, extent: Extent) -> bool:
    """Whether `check_memory` raises nothing."""
    try:
        check_memory(pairs, extent)
    except WorkError:
        return False
    return True


class _Found:
    """Memory that was free a moment ago: to ask takes as long as some kernels."""

    def __init__(self) -> None:
        self.clear()

    def holds(self, needed: int) -> bool:
        """Whether as many bytes were free less than `BELIEVED` seconds ago."""
        return needed <= self._bytes and time.monotonic() < self._until

    def note(self, needed: int) -> None:
        """So many bytes are."""
        self._bytes, self._until = needed, time.monotonic() + BELIEVED

    def clear(self) -> None:
        """Nothing is known."""
        self._bytes, self._until = 0, 0.0


_found = _Found()
