"""The truth of a view: the dataset's own picture where the camera stands at one of its views, else path-traced."""

import logging
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from spacesim import backend
from spacesim.data.errors import InputError
from spacesim.data.images import load_image
from spacesim.data.records import Camera, Dataset, Frame
from spacesim.data.store import load_truth
from spacesim.processes import ChildProcess, end
from spacesim.viewer.drawing.paint import Bytes, Planes
from spacesim.viewer.state import SceneState, ViewerCamera
from spacesim.viewer.truth import tracer
from spacesim.viewer.truth.tracer import OF_COLOUR, TraceRequest, TraceResult, model_ids

SIDE = 512  #: pixels of the longer side of what is path-traced, at most
SAME_DIRECTION = 1e-4  #: radians between two Suns or two axes that count as one

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class ViewerTruth:
    """The truth of a view."""

    planes: Planes  #: what is true
    camera: Camera  #: of these planes
    source: str  #: what they are, in words


def matching_frame(dataset: Dataset, view: ViewerCamera, state: SceneState) -> int | None:
    """Number of the dataset's frame that a view stands at, under its Sun; None for none."""
    pose = view.world_from_camera
    for number, frame in enumerate(dataset.frames):
        other = frame.camera.world_from_camera
        reach = 1e-4 * max(1e-3, float(np.linalg.norm(other[:3, 3])))
        if np.abs(pose[:3, 3] - other[:3, 3]).max() > reach:
            continue
        if np.abs(pose[:3, :3] - other[:3, :3]).max() > 10 * SAME_DIRECTION:
            continue
        if frame.sun is None or state.sun is None or _near(frame.sun.direction, state.sun.direction):
            return number
    return None


def _near(first: np.ndarray, second: np.ndarray) -> bool:
    return float(np.linalg.norm(first - second)) < SAME_DIRECTION


def stored_truth(dataset: Dataset, number: int, mode: str, models: Sequence[int] = ()) -> ViewerTruth | None:
    """What the dataset holds of a frame for a mode; None where it does not. models: see `model_ids`"""
    frame = dataset.frames[number]
    source = f"the dataset's frame {number}"
    try:
        if mode in OF_COLOUR:
            image = load_image(dataset, frame)
            rgb = image.over(np.zeros(3)).astype(np.float32)
            return ViewerTruth(Planes(image.alpha, rgb=rgb), frame.camera, source)
        return ViewerTruth(_labels(dataset, frame, models), frame.camera, source)
    except InputError as error:
        _log.debug("viewer: no truth of frame %d is stored (%s)", number, error)
        return None


def _labels(dataset: Dataset, frame: Frame, models: Sequence[int]) -> Planes:
    truth = load_truth(dataset, frame)
    surface = (truth.object_id > 0).astype(np.float32)
    return Planes(
        surface,
        depth=truth.depth,
        visibility=truth.sun_visibility,
        normal=truth.normal,
        albedo=truth.albedo,
        object_id=model_ids(truth.object_id, models),
    )


def resample(picture: Bytes, source: Camera, target: Camera, smooth: bool = True) -> tuple[Bytes, NDArray[np.bool_]]:
    """(picture [H, W, 3], where it is known [H, W]) as camera `target` sees what `picture` [h, w, 3] shows, which
    camera `source` took at the same place in the same direction. smooth: colours may be mixed"""
    size = (picture.shape[1] / source.width, picture.shape[0] / source.height)
    across, down = source.fx / target.fx * size[0], source.fy / target.fy * size[1]
    left = size[0] * source.cx - across * target.cx
    top = size[1] * source.cy - down * target.cy
    how = Image.Resampling.BILINEAR if smooth else Image.Resampling.NEAREST
    numbers = (across, 0, left, 0, down, top)
    image = Image.fromarray(picture).transform((target.width, target.height), Image.Transform.AFFINE, numbers, how)
    x, y = (np.arange(side) + 0.5 for side in (target.width, target.height))
    within_x = (across * x + left >= 0) & (across * x + left <= picture.shape[1])
    within_y = (down * y + top >= 0) & (down * y + top <= picture.shape[0])
    return np.asarray(image), within_y[:, None] & within_x[None, :]


class TraceQueue:
    """Takes requests of clients to the process that traces, one after another; a client's newest counts.

    deliver: called with (client, answer), on a thread of its own
    """

    def __init__(self, deliver: Callable[[Hashable, TraceResult], None]) -> None:
        self._deliver = deliver
        self._waiting: OrderedDict[Hashable, TraceRequest] = OrderedDict()
        self._running: tuple[Hashable, TraceRequest] | None = None
        self._lock = threading.RLock()
        self._child: ChildProcess | None = None
        self._count = 0
        self._stopped = False

    def ask(self, client: Hashable, request: TraceRequest) -> int:
        """Trace for a client, instead of what it asked for before. Returns the number that answers bear."""
        with self._lock:
            self._count += 1
            self._waiting[client] = replace(request, number=self._count)
            if self._running and self._running[0] == client:
                self._running = None
            self._pump()
            return self._count

    def cancel(self, client: Hashable) -> None:
        """A client does not want the truth any more."""
        with self._lock:
            self._waiting.pop(client, None)
            if self._running and self._running[0] == client:
                self._running = None
                if not self._pump():
                    self._send(None)

    def stop(self) -> None:
        """End the process."""
        with self._lock:
            self._stopped = True
            self._waiting.clear()
            self._running = None
            child, self._child = self._child, None
        if child is not None:
            end([child])

    def _pump(self) -> bool:
        """Send the next request, if the process is free and there is one. The lock is held."""
        if self._running or not self._waiting or self._stopped:
            return False
        client, request = self._waiting.popitem(last=False)
        self._running = client, request
        self._start()
        self._send(request)
        return True

    def _send(self, request: TraceRequest | None) -> None:
        if self._child is not None:
            with suppress(OSError, ValueError):  # where it is dead, the listener says so
                self._child.send(request)

    def _start(self) -> None:
        if self._child is not None:
            return
        self._child = ChildProcess(tracer.__name__)
        self._child.send((backend.select(), max(1, (os.cpu_count() or 2) // 2)))
        threading.Thread(target=self._listen, args=(self._child,), daemon=True).start()

    def _listen(self, child: ChildProcess) -> None:
        """Hand on answers until the process has gone."""
        while True:
            try:
                answer = child.receive()
            except Exception:  # closed, or what no answer is
                break
            with self._lock:
                running = self._running
                fits = running is not None and running[1].number == answer.number
                if fits and answer.done:
                    self._running = None
                    self._pump()
            if fits and running is not None:
                self._deliver(running[0], answer)
        with self._lock:
            if self._child is not child:
                return  # ended by `stop`
            running, self._running = self._running, None
            self._child = None
        ending = child.ending()
        if running is not None:
            reason = f"the process that traces {ending}"
            self._deliver(running[0], TraceResult(running[1].number, None, 0, True, reason))
        with self._lock:
            self._pump()
