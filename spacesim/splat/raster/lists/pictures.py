"""Tile lists of pictures with the capacity of those of the last picture like it, so that nothing has to be known before
they are made.

How many pairs there were is read afterwards, and where not all had their place, lists are made again, as long as they
have to be. So a picture is the same to the bit. Training knows more of its views: `train/async_lists.py`.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import drjit as dr

from spacesim.backend import select
from spacesim.backend.readback import AsyncNumber, can_read_async
from spacesim.splat.raster.lists.bin import (
    LONG,
    MakeLists,
    bin_async,
    bin_counted,
    bin_splats,
    has_memory,
    rounded_pairs,
)
from spacesim.splat.raster.lists.tiles import TileLists, round_capacity
from spacesim.splat.raster.project import Footprints, Splats

T = TypeVar("T")


@dataclass(frozen=True)
class Kind:
    """Of pictures that are compared."""

    splats: int  #: capacity of their arrays
    width: int  #: pixels
    height: int  #: pixels
    few_sizes: bool = False  #: of lists, as `bin_splats` takes it


BACKENDS = ("cuda",)  #: where it pays: on LLVM the host has no time of its own, its cores compute
KINDS = 64  #: of pictures whose capacity is kept
SPARE = 1.5  #: times what is needed, up to which a capacity is kept: pictures of a sequence take turns about a limit

_capacities: dict[Kind, int] = {}  # the latest used last
_lock = threading.Lock()


def expected_capacity(kind: Kind) -> int | None:
    """Capacity of the lists of the last such picture; None where there was none, where it finds no place in memory, and
    where to wait is no loss."""
    capacity = _capacities.get(kind) if select() in BACKENDS else None
    if capacity is None or not has_memory(capacity, kind.width * kind.height, training=False):
        return None
    return capacity


def observe(kind: Kind, pairs: int) -> None:
    """A picture of a kind has so many pairs of tile and splat."""
    needed = rounded_pairs(pairs, kind.few_sizes)
    with _lock:
        before = _capacities.pop(kind, 0)
        if pairs >= LONG or not pairs:  # of long ones the wait is short beside the work
            return
        _capacities[kind] = before if needed <= before <= SPARE * needed else needed
        if len(_capacities) > KINDS:
            del _capacities[next(iter(_capacities))]


def computed(compute: Callable[[MakeLists], T]) -> T:
    """What `compute` makes with the lists of a function that does as `bin_splats`: without a wait where it can be."""
    if select() not in BACKENDS or not can_read_async():
        return compute(bin_splats)
    lists = _PictureLists()
    result = compute(lists.make)
    if lists.all_fit():
        return result
    del result  # frees memory for the next
    return compute(bin_splats)


class _PictureLists:
    """Makes tile lists, and says afterwards whether they are those of `bin_splats`."""

    def __init__(self) -> None:
        self._pending: list[tuple[Kind, int, AsyncNumber]] = []

    def make(self, splats: Splats, footprints: Footprints, width: int, height: int) -> TileLists:
        """As `bin_splats`, but for lists that are too short, which are empty."""
        count = dr.width(splats.x)
        kind = Kind(round_capacity(count), width, height)
        capacity = expected_capacity(kind) if count else None
        if capacity is None:
            lists, pairs = bin_counted(splats, footprints, width, height)
            observe(kind, pairs)
            return lists
        lists, number = bin_async(splats, footprints, width, height, capacity)
        self._pending.append((kind, capacity, number))
        return lists

    def all_fit(self) -> bool:
        """Waits until all pairs have been counted, not for later work."""
        fits = True
        for kind, capacity, number in self._pending:
            pairs = number.wait()
            observe(kind, pairs)
            fits &= 0 < pairs <= capacity
        return fits
