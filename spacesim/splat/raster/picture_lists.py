"""Tile lists of pictures without a wait: with the capacity of the lists of the last picture like it.

Who computes with them asks afterwards whether all pairs had their place (`all_fit`), and where they had not, computes
again, with `bin_splats`. So a picture is the same to the bit, and the host waits for a number that the device has had
for long. Training knows more of its views: `train/async_lists.py`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import drjit as dr

from spacesim.backend import select
from spacesim.backend.readback import AsyncNumber, can_read_async
from spacesim.data.errors import WorkError
from spacesim.splat.raster.bin import (
    LONG,
    MakeLists,
    bin_async,
    bin_counted,
    bin_splats,
    check_memory,
    list_capacity,
)
from spacesim.splat.raster.project import Footprints, Splats
from spacesim.splat.raster.tiles import TileLists, round_capacity

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

_capacities: dict[Kind, int] = {}


def expected_capacity(kind: Kind) -> int | None:
    """Capacity of the lists of the last such picture; None where there was none, where it finds no place in memory, and
    where to wait is no loss."""
    capacity = _capacities.get(kind) if select() in BACKENDS and can_read_async() else None
    if capacity is not None:
        try:
            check_memory(capacity, kind.width * kind.height, training=False)
        except WorkError:
            return None
    return capacity


def observe(kind: Kind, pairs: int) -> int:
    """A picture of a kind has so many pairs of tile and splat. Returns the capacity that its lists need, 0 for none.
    Raises WorkError, see `bin_splats`."""
    needed = list_capacity(pairs, kind.width * kind.height, kind.few_sizes)
    if not needed <= _capacities.get(kind, 0) <= SPARE * needed:
        _capacities.pop(kind, None)
        if needed > 0 and pairs < LONG:  # of long ones the wait is short beside the work
            while len(_capacities) >= KINDS:
                _capacities.pop(next(iter(_capacities)))
            _capacities[kind] = needed
    return needed


def computed(compute: Callable[[MakeLists], T]) -> T:
    """What `compute` makes with the lists of a function that does as `bin_splats`: without a wait where it can be."""
    lists = _PictureLists()
    result = compute(lists.make)
    return result if lists.all_fit() else compute(bin_splats)


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
