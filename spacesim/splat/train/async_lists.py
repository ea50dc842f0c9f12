"""Tile lists of training without a wait: with a capacity for as many pairs as a view is expected to have. Likewise the
Gaussians that a view shows (`ViewPairs.room_for`).

The trainer makes the lists of a view with what a view's `PairCounts` expect, computes with them, and before it keeps
anything of that asks `all_fit`. Where a capacity was too small, lists were empty, or not all were lit that show: it
computes again, `synchronous`. So what is learned is the same to the bit as with waits, and the host waits for a number
that the device has long had.
"""

from collections import deque
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from spacesim.backend import select
from spacesim.backend.arrays import UInt32, UInt64
from spacesim.backend.readback import AsyncNumber, can_read_async
from spacesim.splat.raster.lists.boxes import Boxes
from spacesim.splat.raster.lists.capacity import LONG, Extent, has_memory, list_capacity, rounded_pairs
from spacesim.splat.raster.lists.tiles import round_capacity

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


class TrainingPairs:
    """Says for how many pairs a training's lists are made, and learns how many there are. backends: on which without a
    wait, where Dr.Jit can; on others it waits for each count."""

    def __init__(self, backends: tuple[str, ...] = BACKENDS) -> None:
        self.is_async = select() in backends and can_read_async()
        self.forecasts: dict[str, PairForecast] = {}
        self.pending: list[_PendingLists] = []

    def of_view(self, kind: str, view: Hashable) -> "ViewPairs":
        """`PairCounts` of a view. kind: of picture; views of one kind are compared"""
        return ViewPairs(self, self.forecasts.setdefault(kind, PairForecast()), view)

    def all_fit(self) -> bool:
        """Whether the capacity of all lists since the last time was enough for all pairs, and some were there. Waits
        until they have been counted, not for later work."""
        pending, self.pending = self.pending, []
        fits = True
        for one in pending:
            pairs = one.pairs.wait()
            one.forecast.observe(one.view, pairs)
            fits &= 0 < pairs <= one.capacity
        return fits

    @contextmanager
    def synchronous(self) -> Iterator[None]:
        """With waits."""
        before, self.is_async = self.is_async, False
        try:
            yield
        finally:
            self.is_async = before

    def after_refinement(self) -> None:
        """Other Gaussians are there, or other opacities."""
        for forecast in self.forecasts.values():
            forecast.after_refinement()


class ViewPairs:
    """`PairCounts` of a view of a training."""

    def __init__(self, training: TrainingPairs, forecast: PairForecast, view: Hashable) -> None:
        self.training, self.forecast, self.view = training, forecast, view

    def expected(self, extent: Extent) -> int | None:
        """By its forecast, where that fits into memory; where it does not, the pairs that there are may. Of long lists
        the wait is short beside the work."""
        capacity = self._forecast(extent)
        if capacity is None or capacity >= LONG or not has_memory(capacity, extent):
            return None
        return capacity

    def check(self, extent: Extent, pair_ends: UInt32 | UInt64, capacity: int) -> None:
        """See `PairCounts`; `TrainingPairs.all_fit` says it."""
        self.training.pending.append(_PendingLists(self.forecast, self._key(extent), capacity, AsyncNumber(pair_ends)))

    def counted(self, extent: Extent, boxes: Boxes) -> int:
        """See `PairCounts`."""
        pairs = boxes.pairs
        capacity = list_capacity(pairs, extent)
        self._observe(extent, pairs)
        return capacity

    def room_for(self, extent: Extent, number: UInt32) -> int:
        """Capacity for as many splats of the view's as `number` says, of width 1, 0 of none: without a wait where it is
        expected, and then they may be more."""
        forecast = self._forecast(extent)
        if forecast is None:
            count = int(number[0])
            self._observe(extent, count)
            return rounded_pairs(count, few_sizes=False)
        capacity = min(forecast, extent.most)
        self.check(extent, number, capacity)
        return capacity

    def _forecast(self, extent: Extent) -> int | None:
        return self.forecast.capacity_for(self._key(extent)) if self.training.is_async else None

    def _observe(self, extent: Extent, count: int) -> None:
        if self.training.is_async:
            self.forecast.observe(self._key(extent), count)

    def _key(self, extent: Extent) -> Hashable:
        return self.view, extent.width, extent.height
