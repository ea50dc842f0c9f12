"""Tile lists of pictures with the capacity of those of the last picture like it, so that nothing has to be known before
they are made.

How many pairs there were is read afterwards, and where not all had their place, lists are made again, as long as they
have to be. So a picture is the same to the bit. Training knows more of its views: `train/async_lists.py`.
"""

import threading
from collections.abc import Callable
from typing import TypeVar

from spacesim.backend import select
from spacesim.backend.arrays import UInt32, UInt64
from spacesim.backend.readback import AsyncNumber, can_read_async
from spacesim.splat.raster.lists.boxes import Boxes
from spacesim.splat.raster.lists.capacity import (
    LONG,
    WAITING,
    Extent,
    PairCounts,
    has_memory,
    list_capacity,
    rounded_pairs,
)

T = TypeVar("T")

BACKENDS = ("cuda",)  #: where it pays: on LLVM the host has no time of its own, its cores compute
KINDS = 64  #: of pictures whose capacity is kept
SPARE = 1.5  #: times what is needed, up to which a capacity is kept: pictures of a sequence take turns about a limit

_capacities: dict[tuple[int, int, int, bool], int] = {}  # by kind of picture, the latest used last
_lock = threading.Lock()


def expected_capacity(extent: Extent) -> int | None:
    """Capacity of the lists of the last such picture; None where there was none, where it finds no place in memory, and
    where to wait is no loss."""
    capacity = _capacities.get(_kind(extent)) if select() in BACKENDS and extent.count else None
    return capacity if capacity is not None and has_memory(capacity, extent) else None


def observe(extent: Extent, pairs: int) -> None:
    """A picture has so many pairs of tile and splat: in its lists, or, where these alone were counted, in boxes."""
    needed, kind = rounded_pairs(pairs, extent.few_sizes), _kind(extent)
    with _lock:
        before = _capacities.pop(kind, 0)
        if pairs >= LONG or not pairs:  # of long ones the wait is short beside the work
            return
        _capacities[kind] = before if needed <= before <= SPARE * needed else needed
        if len(_capacities) > KINDS:
            del _capacities[next(iter(_capacities))]


def computed(compute: Callable[[PairCounts], T]) -> T:
    """What `compute` makes by these counts: without a wait where it can be."""
    if select() not in BACKENDS or not can_read_async():
        return compute(WAITING)
    pairs = _PicturePairs()
    result = compute(pairs)
    if pairs.all_fit():
        return result
    del result  # frees memory for the next
    return compute(WAITING)


class _PicturePairs:
    """`PairCounts` by what pictures had before."""

    def __init__(self) -> None:
        self._pending: list[tuple[Extent, int, AsyncNumber]] = []

    def expected(self, extent: Extent) -> int | None:
        return expected_capacity(extent)

    def check(self, extent: Extent, pair_ends: UInt32 | UInt64, capacity: int) -> None:
        self._pending.append((extent, capacity, AsyncNumber(pair_ends)))

    def counted(self, extent: Extent, boxes: Boxes) -> int:
        pairs = boxes.pairs
        capacity = list_capacity(pairs, extent)
        observe(extent, pairs)
        return capacity

    def all_fit(self) -> bool:
        """Waits until all pairs have been counted, not for later work."""
        fits = True
        for extent, capacity, number in self._pending:
            pairs = number.wait()
            observe(extent, pairs)
            fits &= 0 < pairs <= capacity
        return fits


def _kind(extent: Extent) -> tuple[int, int, int, bool]:
    """Of pictures that are compared: the capacity of their splats' arrays, not how many they are."""
    return extent.most, extent.width, extent.height, extent.few_sizes
