"""Frames from the path tracer to the disk: rendering goes on while others encode and write."""

import math
import os
import platform
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np

from spacesim.backend import select
from spacesim.data.geometry import Array
from spacesim.data.records import Camera, Sun, Truth
from spacesim.data.store import RAW_COLOR, RAW_MONOCHROME, SHADOW_LIT, SHADOW_SELF_CAST, FrameWriter, WrittenFrame
from spacesim.data.transforms import MILLIMETRE
from spacesim.scenes.background.config import BackgroundConfig
from spacesim.scenes.background.draw import Background
from spacesim.scenes.cameras.camera import CameraConfig
from spacesim.scenes.config import QualityConfig
from spacesim.scenes.generation.encoders import EncoderProcesses, FrameEncoder, TracedFrame
from spacesim.scenes.generation.moves import as_moved
from spacesim.scenes.lights.earth import EarthConfig
from spacesim.scenes.render import Renderer
from spacesim.scenes.scene import Scene
from spacesim.scenes.steps import Steps
from spacesim.version import __version__

AT_ONCE = {"cuda": 4, "llvm": 1}
"""Frames under way beside the newest, at most: the device traces paths of one while the host reads others."""
UNDER_WAY = 1 << 21
"""Pixels of these: each holds about 100 bytes of the device's."""
MAX_THREADS = 32
PROCESSES_FROM = {"cuda": 1 << 16, "llvm": math.inf}
"""Pixels of frames from which processes encode, if there may be several: on a CPU rendering leaves them no core."""
IN_FLIGHT = 1 << 30
"""Bytes that frames which wait for a thread may hold: 48 frames of 512 x 512."""
BYTES_A_PIXEL = 84
"""Of a frame's truth: 21 numbers, float32."""


@dataclass(frozen=True, eq=False)
class FrameSpec:
    """One frame to render."""

    index: int  #: among all frames of the dataset, it makes the noise
    name: str  #: e.g. "train_00012"
    camera: Camera  #: pose and intrinsics
    sun: Sun  #: that lights it
    spp: int  #: samples a pixel
    exposure: float | None = None  #: None: the camera's
    earth: EarthConfig | None = None  #: None: where the scene says, if it has one at all
    sunlight: float = 1.0  #: factor on the Sun's light, of an Earth that the scene does not have
    sky_from_world: Array | None = None  #: [3, 3], None: stars stand still in the world
    objects: Mapping[int, Array] = field(default_factory=dict)  #: rigid poses [4, 4] of those moved, by number


@dataclass(frozen=True, eq=False)
class Job:
    """What every process that takes part has to know."""

    scene: Scene  #: what is rendered
    camera: CameraConfig  #: size, lens, sensor and exposure of all frames
    quality: QualityConfig  #: samples and lengths of light paths
    seed: int  #: of the noise and of what is drawn behind
    root: Path  #: the dataset's folder
    threads: int  #: that encode, a process that renders
    background: BackgroundConfig | None = None  #: behind the objects, None: nothing
    shared: bool = False  #: other jobs make frames in the same folder now
    depth_unit: float = MILLIMETRE  #: metres a step of the pictures of depth

    @property
    def writer(self) -> FrameWriter:
        """Writes into the folder."""
        return FrameWriter(self.root, raw_suffixes(self.camera), self.depth_unit)


def raw_suffixes(camera: CameraConfig) -> tuple[str, ...]:
    """Of the files in raw/ that `record_image` makes a frame."""
    if camera.sensor is None:
        return ()
    return RAW_MONOCHROME if camera.sensor.monochrome else RAW_COLOR


def versions() -> dict[str, str]:
    """Versions of what the pictures depend on."""
    packages = {name: version(name) for name in ("mitsuba", "drjit", "numpy", "trimesh")}
    return {"spacesim": __version__, "python": platform.python_version(), **packages}


def cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def writing_threads(processes: int) -> int:
    """Threads that encode in each of so many processes on this machine."""
    return min(MAX_THREADS, max(1, math.ceil(cores() / processes)))


def dim(truth: Truth, sunlight: float) -> Truth:
    """`truth`, all of whose light is the Sun's, under a fraction of it: that much of the disc is seen."""
    if sunlight == 1:
        return truth
    factor = np.float32(sunlight)
    visibility = factor * truth.sun_visibility
    shadow = shadow_under(visibility, truth.shadow)
    return replace(truth, radiance=factor * truth.radiance, sun_visibility=visibility, shadow=shadow)


def shadow_under(visibility: np.ndarray, shadow: np.ndarray) -> np.ndarray:
    """Classes [H, W] where no more of the Sun's disc is seen than `visibility` [H, W] says."""
    hidden = (shadow == SHADOW_LIT) & (visibility < 0.5)
    return np.where(hidden, np.uint8(SHADOW_SELF_CAST), shadow)


class _FrameUnderWay:
    """A frame whose first step is taken."""

    def __init__(self, spec: FrameSpec, steps: Steps[Truth | None]) -> None:
        self._spec, self._steps = spec, steps
        self._truth: Future[Truth | None] = Future()
        self.advance()

    @property
    def is_done(self) -> bool:
        """Whether no step is left."""
        return self._truth.done()

    @property
    def has_failed(self) -> bool:
        """Whether a step has met an error."""
        return self.is_done and self._truth.exception() is not None

    def advance(self) -> None:
        """By a step, if there is one left."""
        if self.is_done:
            return
        try:
            next(self._steps)
        except StopIteration as end:
            self._truth.set_result(end.value)
        except Exception as error:
            self._truth.set_exception(error)

    def finish(self) -> tuple[FrameSpec, Truth | None]:
        """The frame, with all its steps taken. Raises the error that one of them met."""
        while not self.is_done:
            self.advance()
        return self._spec, self._truth.result()


class FrameMaker:
    """Renders and writes the frames of a job; loads its scene once. renderer: that of the scene, where there is one."""

    def __init__(self, job: Job, renderer: Renderer | None = None) -> None:
        quality = job.quality
        self.root = job.root
        self._job = job
        self._writer = job.writer
        self._renderer = renderer or Renderer(job.scene, quality.spp, quality.max_depth, job.camera.distortion)
        self._background = None
        if job.background is not None:
            self._background = Background(job.background, job.scene, job.camera.distortion, job.seed)
        pixels = math.prod(job.camera.resolution)
        self._most = max(1, min(2 * job.threads, IN_FLIGHT // (BYTES_A_PIXEL * pixels)))
        self._at_once = min(AT_ONCE[select()], UNDER_WAY // pixels)
        encoder = FrameEncoder(self._writer, job.camera, job.seed)
        self._encode: Callable[[TracedFrame], WrittenFrame] = encoder.write
        self._processes: EncoderProcesses | None = None
        if job.threads > 1 and pixels >= PROCESSES_FROM[select()] and hasattr(os, "memfd_create"):
            self._processes = EncoderProcesses(encoder)
            self._encode = self._processes.write
            weakref.finalize(self, self._processes.close)

    def start_encoders(self, frames: int) -> None:
        """As many as so many frames need, where processes encode; else with the first frames."""
        if self._processes is not None:
            self._processes.start(min(self._job.threads, frames))

    def make(self, specs: Iterable[FrameSpec]) -> Iterator[WrittenFrame]:
        """Make the frames that are not whole on disk yet; yields each of all once it is there, in order.

        The first error, of rendering or writing, ends it: what is being written then is finished first.
        """
        waiting: deque[Future[WrittenFrame]] = deque()
        with ThreadPoolExecutor(self._job.threads, "write") as pool:
            try:
                for spec, truth in self._rendered(specs):
                    while waiting and (waiting[0].done() or len(waiting) >= self._most):
                        yield waiting.popleft().result()
                    waiting.append(pool.submit(self._write, spec, truth))
                while waiting:
                    yield waiting.popleft().result()
            finally:
                pool.shutdown(cancel_futures=True)

    def _rendered(self, specs: Iterable[FrameSpec]) -> Iterator[tuple[FrameSpec, Truth | None]]:
        """Frames with their truth, None of those that are whole on disk, in order; some are under way at once. The
        first error comes after the frames before it."""
        under_way: deque[_FrameUnderWay] = deque()
        for spec in specs:
            under_way.append(_FrameUnderWay(spec, self._steps(spec)))
            for frame in list(under_way)[:-1]:
                frame.advance()
            if any(frame.has_failed for frame in under_way):
                break
            while under_way and (len(under_way) > self._at_once or under_way[0].is_done):
                yield under_way.popleft().finish()
        for frame in under_way:
            yield frame.finish()

    def _steps(self, spec: FrameSpec) -> Steps[Truth | None]:
        """Of a frame's truth."""
        if self._writer.has_frame(spec.name):
            return None
        seed, background = (self._job.seed, spec.index), None
        if self._background is not None:
            background = self._background.drawing(spec.camera, spec.sun, spec.index, spec.earth, spec.sky_from_world)
            next(background)
        renderer = as_moved(self._renderer, spec.objects)
        truth = yield from renderer.rendering(spec.camera, spec.sun, seed, spec.spp, spec.earth)
        truth = dim(truth, spec.sunlight)
        if background is None:
            return truth
        return replace(truth, radiance_background=(yield from background))

    def _write(self, spec: FrameSpec, truth: Truth | None) -> WrittenFrame:
        if truth is None:
            return self._writer.read_written(spec.name)
        return self._encode(TracedFrame(spec.name, spec.index, spec.exposure, truth))
