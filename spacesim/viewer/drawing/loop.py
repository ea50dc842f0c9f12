"""The one thread that draws: the newest request first, one picture a client at a time, full resolution at rest.

Dr.Jit is called from this thread alone. A client that moves gets coarse pictures as fast as they come; once nothing new
is asked for during REST seconds, one in full resolution. A newer request of a client takes the place of an older one,
so nothing queues up, and clients take turns. A picture in full resolution that takes long may come in steps, and give
way to others within each (`give_way`).
"""

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import partial

REST = 0.2  #: seconds without a new request after which a view is at rest
PATIENCE = 0.5  #: seconds that a view at rest waits for others that move
TIDY = 20.0  #: seconds between two times that the loop tidies up while nothing is to be drawn

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class RenderRequest:
    """A picture that a client wants."""

    #: called with whether it is in full resolution: makes and delivers it, on the render thread; returns, of one in
    #: full resolution, whether it is but a step there
    draw: Callable[[bool], object]


class AbandonedError(Exception):
    """A picture that no client waits for."""


class RenderLoop:
    """Draws what clients ask for, until `stop`. tidy: called now and then after pictures, on the render thread: every
    `every` seconds where there is a pause, or after twice as many where there is none"""

    def __init__(self, rest: float = REST, tidy: Callable[[], object] | None = None, every: float = TIDY) -> None:
        self._rest, self._tidy, self._every = rest, tidy, every
        self._tidy_at: float | None = None  # None where nothing was drawn since the last time
        self._requests: OrderedDict[Hashable, tuple[RenderRequest, bool]] = OrderedDict()
        self._resting: dict[Hashable, tuple[float, RenderRequest]] = {}
        self._work: OrderedDict[Hashable, Callable[[], object]] = OrderedDict()
        self._worked = False  # since the last picture
        self._changed = threading.Condition()
        self._running, self._busy = True, False
        self._thread = threading.Thread(target=self._run, name="render", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def request(self, client: Hashable, request: RenderRequest, moving: bool = True) -> None:
        """Draw for a client, instead of what it asked for before; moving: coarse first, in full at rest."""
        with self._changed:
            self._requests[client] = (request, moving)
            self._resting.pop(client, None)
            self._changed.notify()

    def forget(self, client: Hashable) -> None:
        """A client has gone."""
        with self._changed:
            self._requests.pop(client, None)
            self._resting.pop(client, None)

    def submit(self, work: Callable[[], object], kind: Hashable = None) -> None:
        """Call `work` on the render thread, before the next picture but one, instead of what was to be done before of
        the same kind, if that is not None."""
        with self._changed:
            self._work[object() if kind is None else kind] = work
            self._changed.notify()

    @property
    def idle(self) -> bool:
        """Whether nothing is drawn or waits to be."""
        with self._changed:
            return not (self._busy or self._requests or self._resting or self._work)

    def stop(self, patience: float = 5.0) -> None:
        """End after the picture that is being drawn."""
        with self._changed:
            self._running = False
            self._changed.notify()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join(patience)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._busy = False
                task = self._next()
                while task is None and self._running:
                    moments = [moment for moment, _ in self._resting.values()]
                    due = min(moments + ([] if self._tidy_at is None else [self._tidy_at]), default=None)
                    self._changed.wait(None if due is None else max(due - time.monotonic(), 0.0))
                    task = self._next()
                self._busy = task is not None
                if not self._running:
                    return
            assert task is not None
            _perform(task)

    def give_way(self, client: Hashable = None) -> None:
        """Called on the render thread within a long picture of a client: does the next work, and draws for the next
        of the other clients that has moved. Raises AbandonedError where the loop shall end."""
        with self._changed:
            if not self._running:
                raise AbandonedError
            other = next((one for one in self._requests if one != client), None)
            tasks = [self._next_work()] if self._work else []
            tasks += [] if other is None else [self._next_request(other)]
        for task in tasks:
            _perform(task)

    def _next(self) -> Callable[[], object] | None:
        """What to do now, None for nothing. The lock is held."""
        if self._work and not self._worked:
            return self._next_work()
        self._worked = False
        now = time.monotonic()
        task = self._due_tidying(now - self._every) or self._due_full_resolution(now - PATIENCE)
        if task is None and self._requests:
            task = self._next_request(next(iter(self._requests)))
        task = task or self._due_full_resolution(now) or self._due_tidying(now)
        return task or (self._next_work() if self._work else None)

    def _next_request(self, client: Hashable) -> Callable[[], object]:
        """The picture that a client wants. The lock is held."""
        request, moving = self._requests.pop(client)
        if moving:
            self._resting[client] = (time.monotonic() + self._rest, request)
            return self._schedule_tidying(partial(request.draw, False))
        return self._schedule_tidying(partial(self._draw_full_resolution, client, request))

    def _draw_full_resolution(self, client: Hashable, request: RenderRequest) -> None:
        """A step, and the next one when others had their turn."""
        if request.draw(True):
            with self._changed:
                if client not in self._requests:
                    self._resting[client] = (time.monotonic(), request)

    def _next_work(self) -> Callable[[], object]:
        """The first that is no picture. The lock is held."""
        self._worked = True
        return self._work.popitem(last=False)[1]

    def _due_full_resolution(self, now: float) -> Callable[[], object] | None:
        """A picture in full resolution that was due before `now`. The lock is held."""
        for client, (moment, request) in self._resting.items():
            if moment <= now:
                del self._resting[client]
                return self._schedule_tidying(partial(self._draw_full_resolution, client, request))
        return None

    def _schedule_tidying(self, draw: Callable[[], object]) -> Callable[[], object]:
        """A picture, after which there may be something to tidy up. The lock is held."""
        if self._tidy is not None and self._tidy_at is None:
            self._tidy_at = time.monotonic() + self._every
        return draw

    def _due_tidying(self, now: float) -> Callable[[], object] | None:
        """Tidying that was due before `now`. The lock is held."""
        if self._tidy_at is None or self._tidy_at > now:
            return None
        self._tidy_at = None
        return self._tidy


def _perform(task: Callable[[], object]) -> None:
    try:
        task()
    except AbandonedError:
        pass
    except Exception as error:  # one picture that fails must not end all others
        _log.warning("viewer: a picture failed (%s)", " ".join(str(error).split()) or type(error).__name__)
        _log.debug("traceback", exc_info=error)
