"""Tile lists of training without a wait: with a capacity for as many pairs as a view is expected to have.

The trainer asks for the lists of a view, computes with them, and before it keeps anything of that asks `all_fit`.
Where a capacity was too small, lists were empty: it computes again, `synchronous`. So what is learned is the same to
the bit as with `bin_splats`, and the host waits for a number that the device has long had.
"""

from collections import deque
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from spacesim.backend import select
from spacesim.backend.readback import AsyncNumber, can_read_async
from spacesim.splat.raster.lists.bin import LONG, bin_async, bin_counted, has_memory
from spacesim.splat.raster.lists.tiles import TileLists, round_capacity
from spacesim.splat.raster.project import Footprints, Splats

HISTORY = 16  #: changes from a view's last visit to the next, of which the largest counts
ENOUGH = 4  #: of them, from which on there is a forecast
MARGIN = 1.02  #: of the forecast: changes are a little larger now and then
BACKENDS = ("cuda",)  #: where it pays: on LLVM the host has no time of its own, its cores compute


class PairForecast:
    """How many pairs a view will have: what it had at its last visit, times the largest of the changes that the latest
    views have shown since theirs. Views that were last seen before as many refinements are compared with one another:
    a refinement changes all at once. The same calls give the same forecasts."""

    def __init__(self) -> None:
        self._refinements = 0
        self._visits: dict[Hashable, tuple[int, int]] = {}  # pairs, and refinements before
        self._changes: dict[int, deque[float]] = {}  # by refinements since the last visit

    def capacity_for(self, view: Hashable) -> int | None:
        """For how many pairs lists should have capacity; None where too little is known."""
        pairs, refinements = self._visits.get(view, (0, 0))
        changes = self._changes.get(self._refinements - refinements, ())
        if not pairs or len(changes) < ENOUGH:
            return None
        return round_capacity(int(MARGIN * max(changes) * pairs))

    def observe(self, view: Hashable, pairs: int) -> None:
        """A view has so many."""
        before, refinements = self._visits.get(view, (0, 0))
        if before:
            since = self._refinements - refinements
            self._changes.setdefault(since, deque(maxlen=HISTORY)).append(pairs / before)
        self._visits[view] = pairs, self._refinements

    def after_refinement(self) -> None:
        """Other Gaussians are there, or other opacities: what the latest views have shown no longer holds."""
        self._refinements += 1
        self._changes.clear()


@dataclass(frozen=True)
class _PendingLists:
    """Lists whose number of pairs the host has not read."""

    forecast: PairForecast
    view: Hashable
    capacity: int  #: pairs
    pairs: AsyncNumber


class AsyncTileLists:
    """Makes tile lists, and learns how long they are. backends: on which without a wait, where Dr.Jit can; on others
    all of this is `bin_splats`."""

    def __init__(self, backends: tuple[str, ...] = BACKENDS) -> None:
        self.is_async = select() in backends and can_read_async()
        self._forecasts: dict[str, PairForecast] = {}
        self._pending: list[_PendingLists] = []

    def make(
        self,
        kind: str,
        view: Hashable,
        splats: Splats,
        footprints: Footprints,
        width: int,
        height: int,
        training: bool = False,
    ) -> TileLists:
        """`bin_splats` of a view, without a wait where its number of pairs is known well enough. kind: of picture;
        views of one kind are compared"""
        forecast, view = self._forecasts.setdefault(kind, PairForecast()), (view, width, height)
        capacity = forecast.capacity_for(view) if self.is_async else None
        if capacity is not None and self._has_memory(capacity, width * height, training):
            lists, number = bin_async(splats, footprints, width, height, capacity)
            self._pending.append(_PendingLists(forecast, view, capacity, number))
            return lists
        lists, pairs = bin_counted(splats, footprints, width, height, training=training)
        if self.is_async:
            forecast.observe(view, pairs)
        return lists

    def _has_memory(self, capacity: int, pixels: int, training: bool) -> bool:
        """Whether lists of a capacity fit into memory; where they do not, the pairs that there are may. Of long ones
        the wait is short beside the work."""
        return capacity <= LONG and has_memory(capacity, pixels, training)

    def all_fit(self) -> bool:
        """Whether all lists since the last time are those of `bin_splats`: the capacity was enough for all pairs, and
        some were there. Waits until they have been counted, not for later work."""
        pending, self._pending = self._pending, []
        fits = True
        for one in pending:
            pairs = one.pairs.wait()
            one.forecast.observe(one.view, pairs)
            fits &= 0 < pairs <= one.capacity
        return fits

    @contextmanager
    def synchronous(self) -> Iterator[None]:
        """With waits, as `bin_splats`."""
        before, self.is_async = self.is_async, False
        try:
            yield
        finally:
            self.is_async = before

    def after_refinement(self) -> None:
        """Other Gaussians are there, or other opacities."""
        for forecast in self._forecasts.values():
            forecast.after_refinement()
