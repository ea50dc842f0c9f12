"""One client: what it looks at, the pictures it gets, the truth it asked for. Of the server it knows `Screen` alone."""

import threading
import time
from dataclasses import dataclass, replace
from typing import Any, Protocol

from spacesim.viewer.frames import Frame, Pace, draw
from spacesim.viewer.loop import RenderLoop, Wish
from spacesim.viewer.paint import Bytes, compared, painted
from spacesim.viewer.stage import Stage
from spacesim.viewer.state import Look, Shared, Stand, View
from spacesim.viewer.truth.tracer import Answer
from spacesim.viewer.truth.truth import Truth, fitted

TELL_EVERY = 0.25  #: seconds between two statistics while the view moves
STEADY = 0.8  #: share of the last estimate of frames a second in the next, chosen
LONGEST_GAP = 0.5  #: seconds between two pictures of one motion, chosen
TRUTH_MODES = {"ellipsoids": "colour"}  #: modes whose truth is that of another


@dataclass(frozen=True)
class Statistics:
    """Of the last picture. rate: frames a second while moving, 0 before there is a second one;  seconds: to draw it;
    status: sentences for the user, "" for none"""

    rate: float
    seconds: float
    width: int
    height: int
    share: float
    depths: tuple[float, float] | None
    status: str


class Screen(Protocol):
    """The client's end of a server; any thread may call it."""

    def show(self, picture: Bytes, sharp: bool) -> None:
        """Put a picture behind the scene. sharp: at rest, with few losses"""

    def tell(self, statistics: Statistics) -> None:
        """Say how it goes."""


class TruthSource(Protocol):
    """Where truth comes from."""

    def truth(self, session: "Session", view: View, stand: Stand, look: Look) -> "Truth | int | str":
        """The truth, where it is stored; else the number that answers will bear; or a sentence why there is none."""

    def no_truth(self, session: "Session") -> None:
        """What was asked for is not wanted any more."""


class Session:
    """A client's state, changed from any thread; pictures are made on the render thread."""

    def __init__(self, stage: Stage, shared: Shared, loop: RenderLoop, screen: Screen, source: TruthSource) -> None:
        self._stage, self._shared, self._loop, self._screen, self._source = stage, shared, loop, screen, source
        self._lock = threading.RLock()
        self._view: View | None = None
        self._look = Look()
        self._pace = Pace()
        self._truth: Truth | None = None
        self._asked: int | None = None  # number of answers that are awaited
        self._told = ""  # about the truth
        self._last: tuple[View, Stand, Look, Frame] | None = None  # in full resolution
        self._rate, self._shown_at, self._told_at = 0.0, 0.0, 0.0
        self._closed = False

    @property
    def view(self) -> View | None:
        """Where the client looks from; None before it has said."""
        with self._lock:
            return self._view

    @property
    def look(self) -> Look:
        """How it wants pictures."""
        with self._lock:
            return self._look

    def moved(self, view: View) -> None:
        """The client looks from elsewhere."""
        with self._lock:
            if view.same(self._view):
                return
            self._view = view
            self._drop_truth()
        self._wish(moving=True)

    def scene_changed(self) -> None:
        """Poses or Sun are others."""
        with self._lock:
            self._drop_truth()
        self._wish(moving=True)

    def set(self, **changes: Any) -> None:
        """Change fields of the look."""
        with self._lock:
            before, self._look = self._look, replace(self._look, **changes)
            after = self._look
            if (before.mode, before.samples) != (after.mode, after.samples) or after.compare == "off":
                self._drop_truth()
        if before != after:
            self._wish(moving=False)

    def answer(self, answer: Answer) -> None:
        """The path tracer has come further."""
        with self._lock:
            if answer.number != self._asked or self._view is None:
                return
            if answer.planes is None:
                self._told, self._asked = f"no truth: {answer.error}", None
            else:
                height, width = answer.planes.alpha.shape
                source = f"path-traced, {answer.samples} sample{'s' * (answer.samples != 1)} a pixel"
                self._told = f"truth: {source}" + ("" if answer.done else ", more to come")
                self._truth = Truth(answer.planes, self._view.camera(width, height), source)
        self._wish(moving=False)

    def close(self) -> None:
        """The client has gone."""
        with self._lock:
            self._closed = True
            self._last = None
            self._drop_truth()
        self._loop.forget(self)

    def _drop_truth(self) -> None:
        if self._truth is not None or self._asked is not None:
            self._source.no_truth(self)
        self._truth, self._asked, self._told = None, None, ""

    def _wish(self, moving: bool) -> None:
        if not self._closed and self._view is not None:
            self._loop.wish(self, Wish(self._draw), moving)

    # ---- on the render thread ----

    def _draw(self, full: bool) -> None:
        with self._lock:
            view, look, closed = self._view, self._look, self._closed
            share = 1.0 if full else self._pace.share
        if view is None or closed:
            return
        stand = self._shared.stand
        frame = self._kept(view, stand, look) if share == 1 else None
        if frame is None:
            frame = draw(self._stage, stand, view, look, share)
            height, width = frame.picture.shape[:2]
            self._pace.took(share, (width, height), frame.seconds)
        if share == 1:
            self._last = view, stand, look, replace(frame, planes=None)  # which are six times as large
        picture = self._with_truth(frame, view, stand, look) if full and look.compare != "off" else frame.picture
        with self._lock:
            if self._closed:
                return
        self._screen.show(picture, full)
        self._tell(frame, full)

    def _kept(self, view: View, stand: Stand, look: Look) -> Frame | None:
        """The last picture in full resolution, if it is this one but for the comparison with the truth."""
        last = self._last  # which `close` may take away at any moment
        if last is None:
            return None
        last_view, last_stand, last_look, frame = last
        same = (last_look.mode, last_look.side) == (look.mode, look.side)
        return frame if same and view.same(last_view) and stand.same(last_stand) else None

    def _with_truth(self, frame: Frame, view: View, stand: Stand, look: Look) -> Bytes:
        with self._lock:
            if not self._wanted(view, stand, look):
                return frame.picture
            if self._truth is None and self._asked is None and not self._told:
                found = self._source.truth(self, view, stand, look)
                if isinstance(found, Truth):
                    self._truth, self._told = found, f"truth: {found.source}"
                elif isinstance(found, int):
                    self._asked, self._told = found, "truth: the path tracer is starting"
                else:
                    self._told = f"no truth: {found}"
            truth = self._truth
        if truth is None:
            return frame.picture
        mode = TRUTH_MODES.get(look.mode, look.mode)
        picture = painted(truth.planes, mode, frame.depths)
        if picture is None:
            return frame.picture
        height, width = frame.picture.shape[:2]
        there, known = fitted(picture, truth.camera, view.camera(width, height), smooth=mode != "object id")
        return compared(frame.picture, there, known, look.compare, look.wipe)

    def _wanted(self, view: View, stand: Stand, look: Look) -> bool:
        """Whether a picture is still of what the client looks at; else the next one asks. The lock is held."""
        as_asked = (look.mode, look.samples, look.compare) == (self._look.mode, self._look.samples, self._look.compare)
        return view is self._view and stand.same(self._shared.stand) and as_asked

    def _tell(self, frame: Frame, full: bool) -> None:
        now = time.monotonic()
        gap, self._shown_at = now - self._shown_at, now
        if not full and gap < LONGEST_GAP:
            rate = 1 / max(gap, 1e-3)
            self._rate = STEADY * self._rate + (1 - STEADY) * rate if self._rate else rate
        if not full and now - self._told_at < TELL_EVERY:
            return
        self._told_at = now
        height, width = frame.picture.shape[:2]
        with self._lock:
            status = "; ".join(filter(None, (frame.note, self._told)))
        told = Statistics(self._rate, frame.seconds, width, height, frame.share, frame.depths, status)
        self._screen.tell(told)
