"""The one thread that draws: newest wishes first served, one picture a client at a time, full resolution at rest.

Dr.Jit is called from this thread alone. A client that moves gets coarse pictures as fast as they come; once nothing new
is wished for during REST seconds, one in full resolution. A newer wish of a client takes the place of an older one, so
nothing queues up, and clients take turns.
"""

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import partial
from typing import Any

REST = 0.2  #: seconds without a new wish after which a view is at rest, chosen
PATIENCE = 0.5  #: seconds that a view at rest waits for others that move, chosen
TIDY = 20.0  #: seconds between two times that the loop tidies up while nothing is to be drawn, chosen

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Wish:
    """A picture that a client wants. draw: told whether in full resolution, makes and delivers it, on the render
    thread"""

    draw: Callable[[bool], Any]


class RenderLoop:
    """Draws what clients wish for, until `stop`. tidy: called now and then after pictures, on the render thread: every
    `every` seconds where there is a pause, or after twice as many where there is none"""

    def __init__(self, rest: float = REST, tidy: Callable[[], Any] | None = None, every: float = TIDY) -> None:
        self._rest, self._tidy, self._every = rest, tidy, every
        self._tidy_at: float | None = None  # None where nothing was drawn since the last time
        self._wishes: OrderedDict[Hashable, tuple[Wish, bool]] = OrderedDict()
        self._resting: dict[Hashable, tuple[float, Wish]] = {}
        self._work: OrderedDict[Hashable, Callable[[], Any]] = OrderedDict()
        self._worked = False  # since the last picture
        self._changed = threading.Condition()
        self._going, self._busy = True, False
        self._thread = threading.Thread(target=self._run, name="render", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def wish(self, client: Hashable, wish: Wish, moving: bool = True) -> None:
        """Draw for a client, instead of what it wished for before; moving: coarse first, in full at rest."""
        with self._changed:
            self._wishes[client] = (wish, moving)
            self._resting.pop(client, None)
            self._changed.notify()

    def forget(self, client: Hashable) -> None:
        """A client has gone."""
        with self._changed:
            self._wishes.pop(client, None)
            self._resting.pop(client, None)

    def do(self, work: Callable[[], Any], kind: Hashable = None) -> None:
        """Call `work` on the render thread, before the next picture but one, instead of what was to be done before of
        the same kind, if that is not None."""
        with self._changed:
            self._work[object() if kind is None else kind] = work
            self._changed.notify()

    @property
    def idle(self) -> bool:
        """Whether nothing is drawn or waits to be."""
        with self._changed:
            return not (self._busy or self._wishes or self._resting or self._work)

    def stop(self, patience: float = 5.0) -> None:
        """End after the picture that is being drawn."""
        with self._changed:
            self._going = False
            self._changed.notify()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join(patience)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._busy = False
                task = self._next()
                while task is None and self._going:
                    moments = [moment for moment, _ in self._resting.values()]
                    due = min(moments + ([] if self._tidy_at is None else [self._tidy_at]), default=None)
                    self._changed.wait(None if due is None else max(due - time.monotonic(), 0.0))
                    task = self._next()
                self._busy = task is not None
                if not self._going:
                    return
            assert task is not None
            try:
                task()
            except Exception as error:  # one picture that fails must not end all others
                _log.warning("viewer: a picture failed (%s)", " ".join(str(error).split()) or type(error).__name__)
                _log.debug("traceback", exc_info=error)

    def _next(self) -> Callable[[], Any] | None:
        """What to do now, None for nothing. The lock is held."""
        if self._work and not self._worked:
            return self._other_work()
        self._worked = False
        now = time.monotonic()
        task = self._untidy(now - self._every) or self._rested(now - PATIENCE)
        if task is None and self._wishes:
            client, (wish, moving) = self._wishes.popitem(last=False)
            if moving:
                self._resting[client] = (now + self._rest, wish)
            task = self._drawing(partial(wish.draw, not moving))
        task = task or self._rested(now) or self._untidy(now)
        return task or (self._other_work() if self._work else None)

    def _other_work(self) -> Callable[[], Any]:
        """The first that is no picture. The lock is held."""
        self._worked = True
        return self._work.popitem(last=False)[1]

    def _rested(self, now: float) -> Callable[[], Any] | None:
        """A picture in full resolution that was due before `now`. The lock is held."""
        for client, (moment, wish) in self._resting.items():
            if moment <= now:
                del self._resting[client]
                return self._drawing(partial(wish.draw, True))
        return None

    def _drawing(self, draw: Callable[[], Any]) -> Callable[[], Any]:
        """A picture, after which there may be something to tidy up. The lock is held."""
        if self._tidy is not None and self._tidy_at is None:
            self._tidy_at = time.monotonic() + self._every
        return draw

    def _untidy(self, now: float) -> Callable[[], Any] | None:
        """Tidying that was due before `now`. The lock is held."""
        if self._tidy_at is None or self._tidy_at > now:
            return None
        self._tidy_at = None
        return self._tidy
