"""One client: what it looks at, the pictures it gets, the truth it asked for. Of the server it knows only
`ViewerScreen`."""

import threading
import time
from dataclasses import dataclass, replace
from typing import Any, Protocol

from spacesim.viewer.drawing.frames import STEPS, ResolutionControl, ViewerFrame, draw_frame
from spacesim.viewer.drawing.loop import AbandonedError, RenderLoop, RenderRequest
from spacesim.viewer.drawing.paint import ERROR_SCALE, Bytes, compare_pictures, paint
from spacesim.viewer.drawing.scene_renderer import SceneRenderer
from spacesim.viewer.state import DisplaySettings, SceneState, SharedScene, ViewerCamera
from spacesim.viewer.truth.tracer import TraceResult
from spacesim.viewer.truth.truth import ViewerTruth, resample

REPORT_EVERY = 0.25  #: seconds between two statistics while the view moves
RATE_SMOOTHING = 0.8  #: share of the last estimate of frames a second in the next
MAX_FRAME_GAP = 0.5  #: seconds between two pictures of one motion
TRUTH_MODES = {"ellipsoids": "colour"}  #: modes whose truth is that of another


@dataclass(frozen=True)
class Statistics:
    """Of the last picture."""

    rate: float  #: frames a second while moving, 0 before there is a second one
    seconds: float  #: to draw it
    width: int  #: pixels
    height: int  #: pixels
    share: float  #: of the full resolution, on a side
    #: least and greatest that the colours of depth stand for, metres; None of a picture of something else
    depths: tuple[float, float] | None
    status: str  #: sentences for the user, "" for none


class ViewerScreen(Protocol):
    """The client's end of a server; any thread may call it."""

    def show(self, picture: Bytes, sharp: bool) -> None:
        """Put a picture behind the scene. sharp: at rest, with few losses"""

    def show_statistics(self, statistics: Statistics) -> None:
        """Say how it goes."""


class TruthSource(Protocol):
    """Where truth comes from."""

    def request_truth(
        self, session: "Session", view: ViewerCamera, state: SceneState, settings: DisplaySettings
    ) -> "ViewerTruth | int | str":
        """The truth, where it is stored; else the number that answers will bear; or a sentence why there is none."""

    def cancel_truth(self, session: "Session") -> None:
        """What was asked for is not wanted any more."""


class Session:
    """A client's state, changed from any thread; pictures are made on the render thread."""

    def __init__(
        self, renderer: SceneRenderer, shared: SharedScene, loop: RenderLoop, screen: ViewerScreen, source: TruthSource
    ) -> None:
        self._renderer, self._shared, self._loop, self._screen, self._source = renderer, shared, loop, screen, source
        self._lock = threading.RLock()
        self._view: ViewerCamera | None = None
        self._settings = DisplaySettings()
        self._resolution = ResolutionControl.of(renderer)
        self._truth: ViewerTruth | None = None
        self._pending_request: int | None = None  # number of answers that are awaited
        self._truth_status = ""  # about the truth
        #: in full resolution, or a step there
        self._last_frame: tuple[ViewerCamera, SceneState, DisplaySettings, ViewerFrame] | None = None
        self._rate, self._shown_at, self._reported_at = 0.0, 0.0, 0.0
        self._closed = False

    @property
    def view(self) -> ViewerCamera | None:
        """Where the client looks from; None before it has said."""
        with self._lock:
            return self._view

    @property
    def settings(self) -> DisplaySettings:
        """How it wants pictures."""
        with self._lock:
            return self._settings

    def on_camera_moved(self, view: ViewerCamera) -> None:
        """The client looks from elsewhere."""
        with self._lock:
            if view.same(self._view):
                return
            self._view = view
            self._drop_truth()
        self._request_frame(moving=True)

    def on_scene_changed(self) -> None:
        """Poses or Sun are others."""
        with self._lock:
            self._drop_truth()
        self._request_frame(moving=True)

    def change_settings(self, **changes: Any) -> None:
        """Change fields of the look."""
        with self._lock:
            before, self._settings = self._settings, replace(self._settings, **changes)
            after = self._settings
            if before.of_truth != after.of_truth or after.compare == "off":
                self._drop_truth()
        if before != after:
            self._request_frame(moving=False)

    def on_trace_result(self, answer: TraceResult) -> None:
        """The path tracer has come further."""
        with self._lock:
            if answer.number != self._pending_request or self._view is None:
                return
            if answer.planes is None:
                self._truth_status, self._pending_request = f"no truth: {answer.error}", None
            else:
                height, width = answer.planes.alpha.shape
                source = f"path-traced, {answer.samples} sample{'s' * (answer.samples != 1)} a pixel"
                self._truth_status = f"truth: {source}" + ("" if answer.done else ", more to come")
                self._truth = ViewerTruth(answer.planes, self._view.camera(width, height), source)
        self._request_frame(moving=False)

    def close(self) -> None:
        """The client has gone."""
        with self._lock:
            self._closed = True
            self._last_frame = None
            self._drop_truth()
        self._loop.forget(self)

    def _drop_truth(self) -> None:
        if self._truth is not None or self._pending_request is not None:
            self._source.cancel_truth(self)
        self._truth, self._pending_request, self._truth_status = None, None, ""

    def _request_frame(self, moving: bool) -> None:
        if not self._closed and self._view is not None:
            self._loop.request(self, RenderRequest(self._draw), moving)

    # ---- on the render thread ----

    def _draw(self, full: bool) -> bool:
        """Whether the picture is but a step to the one in full resolution."""
        with self._lock:
            view, settings, closed = self._view, self._settings, self._closed
        if view is None or closed:
            return False
        state, progressive = self._shared.state, self._renderer.progressive
        frame = self._reusable_frame(view, state, settings)
        share = self._next_share(frame, full)
        if frame is None or frame.share != share:

            def on_chunk() -> None:
                if full:
                    self._loop.give_way(self)
                if self._is_stale(view, state, settings, full):
                    raise AbandonedError

            frame = draw_frame(self._renderer, state, view, settings, share, on_chunk if progressive else None)
            height, width = frame.picture.shape[:2]
            self._resolution.record_time(share, (width, height), frame.seconds)
        if share == 1 or progressive:
            self._last_frame = view, state, settings, replace(frame, planes=None)  # which are six times as large
        picture = (
            self._with_truth(frame, view, state, settings) if full and settings.compare != "off" else frame.picture
        )
        with self._lock:
            if self._closed:
                return False
        self._screen.show(picture, full)
        self._report(frame, full)
        return full and share < 1 and not frame.note  # which more pixels would say again

    def _next_share(self, last: ViewerFrame | None, full: bool) -> float:
        """Of the full resolution. last: of the same view, if there is one"""
        if not self._renderer.progressive:
            return 1.0 if full else self._resolution.share
        if last is None:
            return self._resolution.share
        return next((share for share in STEPS if share > last.share), last.share) if full else last.share

    def _is_stale(self, view: ViewerCamera, state: SceneState, settings: DisplaySettings, full: bool) -> bool:
        """Whether no client waits for a picture: it has gone, or, of a picture at rest, it sees another one."""
        with self._lock:
            if self._closed or not full:
                return self._closed
            now = self._view, self._settings.of_picture
        return now != (view, settings.of_picture) or not state.same(self._shared.state)

    def _reusable_frame(self, view: ViewerCamera, state: SceneState, settings: DisplaySettings) -> ViewerFrame | None:
        """The last picture kept, if it is this one but for its resolution and the comparison with the truth."""
        last = self._last_frame  # which `close` may take away at any moment
        if last is None:
            return None
        last_view, last_state, last_settings, frame = last
        same = last_settings.of_picture == settings.of_picture
        return frame if same and view.same(last_view) and state.same(last_state) else None

    def _with_truth(
        self, frame: ViewerFrame, view: ViewerCamera, state: SceneState, settings: DisplaySettings
    ) -> Bytes:
        with self._lock:
            if not self._is_current(view, state, settings):
                return frame.picture
            if self._truth is None and self._pending_request is None and not self._truth_status:
                reply = self._source.request_truth(self, view, state, settings)
                if isinstance(reply, ViewerTruth):
                    self._truth, self._truth_status = reply, f"truth: {reply.source}"
                elif isinstance(reply, int):
                    self._pending_request, self._truth_status = reply, "truth: the path tracer is starting"
                else:
                    self._truth_status = f"no truth: {reply}"
            truth = self._truth
        if truth is None:
            return frame.picture
        mode = TRUTH_MODES.get(settings.mode, settings.mode)
        picture = paint(truth.planes, mode, frame.depths)
        if picture is None:
            return frame.picture
        height, width = frame.picture.shape[:2]
        there, has_truth = resample(picture, truth.camera, view.camera(width, height), smooth=mode != "object id")
        return compare_pictures(frame.picture, there, has_truth, settings.compare, settings.wipe)

    def _is_current(self, view: ViewerCamera, state: SceneState, settings: DisplaySettings) -> bool:
        """Whether a picture is still of what the client looks at; else the next one asks. The lock is held."""
        now = self._settings
        as_asked = (settings.of_truth, settings.compare) == (now.of_truth, now.compare)
        return view is self._view and state.same(self._shared.state) and as_asked

    def _report(self, frame: ViewerFrame, full: bool) -> None:
        now = time.monotonic()
        gap, self._shown_at = now - self._shown_at, now
        if not full and gap < MAX_FRAME_GAP:
            rate = 1 / max(gap, 1e-3)
            self._rate = RATE_SMOOTHING * self._rate + (1 - RATE_SMOOTHING) * rate if self._rate else rate
        if not full and now - self._reported_at < REPORT_EVERY:
            return
        self._reported_at = now
        height, width = frame.picture.shape[:2]
        with self._lock:
            differs = self._truth is not None and self._settings.compare == "difference"
            scale = f"mean difference of the channels: black 0, white {ERROR_SCALE} of 1 and more" if differs else ""
            status = "; ".join(filter(None, (frame.note, self._truth_status, scale)))
        depths = None if differs else frame.depths
        statistics = Statistics(self._rate, frame.seconds, width, height, frame.share, depths, status)
        self._screen.show_statistics(statistics)
