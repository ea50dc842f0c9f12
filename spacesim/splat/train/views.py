"""The training pictures: decoded once, kept packed in memory, handed out in a seeded order."""

import logging
import threading
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import lru_cache
from queue import SimpleQueue

import numpy as np

from spacesim.backend import ad, free_memory, main_memory
from spacesim.backend.arrays import Bool, UInt32
from spacesim.backend.upload import upload
from spacesim.data.earth import Earth
from spacesim.data.errors import InputError
from spacesim.data.images import load_image
from spacesim.data.integrity.whole import check_truth
from spacesim.data.records import Camera, Dataset, Frame, Truth
from spacesim.data.store import load_truth
from spacesim.learning.lights import sunlit_frames
from spacesim.splat.train.loss.terms import TruthPlanes

log = logging.getLogger(__name__)

CACHE_BYTES = 6 * 2**30  #: of decoded pictures, at most
DEVICE_BYTES = 2 * 2**30  #: of pictures that stay on the device, at most: 512 of 1024 x 1024
OF_PIXELS = "visibility", "radiance"  #: truth that no mesh can stand in for
AHEAD, DECODERS = 8, 2  #: pictures that threads decode while a step shows another, and threads
SHARES = 4, 8  #: a fourth and an eighth of the memory that is free are not exceeded


@dataclass(frozen=True, eq=False)
class TrainingView:
    """A training picture in main memory."""

    index: int  #: of its frame in the dataset's training frames
    camera: Camera  #: pose and intrinsics
    sun: np.ndarray | None  #: [3] unit, towards the Sun; None where the frame does not name it
    rgba: np.ndarray  #: [H * W] uint32, 8 bits a channel, red lowest
    valid: np.ndarray | None  #: [H * W] bool, or None where all pixels count
    opaque: bool  #: the picture has no transparency, so that what is behind the object is part of it
    #: {name: planes [H * W] float32} of what is asked for: "visibility", path-traced, below 0 where there is no
    #: surface; "depth", along the optical axis, metres, 0 where there is none; "normal", 3 planes, world axes;
    #: "radiance", 3 planes, W m^-2 sr^-1, weighted by alpha
    truth: dict[str, list[np.ndarray]]
    earth: Earth | None = None  #: that the Sun lights, where the frame names one


class TrainingViews:
    """Views of a dataset's training frames by index, decoded at first use and kept while memory suffices, see
    `kept_bytes`.

    suns: every frame must name its Sun; see `sunlit_frames`
    truth: path-traced planes that it must have, by name
    surface: gives depth and normals of a camera, in place of the path-traced ones; see `prior.MeshPrior`
    at_once: how many views in a row are kept at least
    Raises InputError where a frame has not what it must have, or its truth is not whole, and where `sunlit_frames`
    does.
    """

    def __init__(
        self,
        dataset: Dataset,
        seed: int,
        suns: bool = False,
        truth: Sequence[str] = (),
        surface: Callable[[Camera], tuple[np.ndarray, np.ndarray]] | None = None,
        at_once: int = 1,
    ) -> None:
        if not dataset.train:
            raise InputError(f"{dataset.root}: expected at least one training image, found none")
        traced = [name for name in truth if surface is None or name in OF_PIXELS]
        _check_known(dataset, suns, traced)
        self.dataset, self.seed, self.truth, self.surface = dataset, seed, tuple(truth), surface
        self.most_pixels = max(f.camera.width * f.camera.height for f in dataset.train)
        largest = 4 * self.most_pixels * (1 + sum(3 if name in ("normal", "radiance") else 1 for name in truth))
        self._used = sunlit_frames(dataset) if suns else list(range(len(dataset.train)))
        if traced:
            check_truth(dataset, [dataset.train[index] for index in self._used])
        self._empty: set[int] = set()  # views that have been reported to show nothing
        self._order = lru_cache(maxsize=2)(self._shuffle)
        in_memory, on_device = kept_bytes()
        kept = max(at_once, in_memory // largest)
        self._cached = lru_cache(maxsize=kept)(self._take)
        self._ahead: dict[int, Future[TrainingView]] = {}  # views that are being decoded
        self._decoded: set[int] = set()
        # what a mesh gives is computed on the device, and what is not kept would be decoded for nothing
        reads_ahead = surface is None and kept >= len(self._used)
        self._decoders = _Decoders() if reads_ahead else None
        self._device_cache = lru_cache(maxsize=max(1, on_device // largest))(self._upload)

    def __len__(self) -> int:
        return len(self.dataset.train)

    def __getitem__(self, index: int) -> TrainingView:
        return self._cached(index)

    def at_step(self, step: int) -> TrainingView:
        """The view of a step: every epoch visits all views that are used once, in an order that (seed, epoch)
        decides."""
        if self._decoders and len(self._decoded) < len(self._used):
            for later in range(step, step + AHEAD):
                index = self._shown(later)
                if index not in self._decoded:
                    self._decoded.add(index)
                    self._ahead[index] = self._decoders.submit(self._load, index)
        return self[self._shown(step)]

    def _shown(self, step: int) -> int:
        """Index of the view of a step."""
        epoch, place = divmod(step, len(self._used))
        return int(self._order(epoch)[place])

    def pixels(self, view: TrainingView) -> tuple[UInt32, Bool, TruthPlanes]:
        """(rgba UInt32 [H * W], valid Bool [H * W] or of width 1, truth as Floats [H * W]) of a view."""
        pixels: tuple[UInt32, Bool, TruthPlanes] = self._device_cache(view.index)
        return pixels

    def _upload(self, index: int) -> tuple[UInt32, Bool, TruthPlanes]:
        view = self[index]
        valid = ad.Bool(True) if view.valid is None else upload(view.valid, ad.Bool)
        truth = {name: [upload(plane) for plane in planes] for name, planes in view.truth.items()}
        return upload(view.rgba, ad.UInt32), valid, truth

    def _shuffle(self, epoch: int) -> np.ndarray:
        return np.random.default_rng([self.seed, 1, epoch]).permutation(self._used)

    def _take(self, index: int) -> TrainingView:
        self._decoded.add(index)
        ahead = self._ahead.pop(index, None)
        return self._load(index) if ahead is None else ahead.result()

    def _load(self, index: int) -> TrainingView:
        frame = self.dataset.train[index]
        image = load_image(self.dataset, frame)
        traced, alpha = self._traced(frame), image.alpha
        if "radiance" in self.truth and traced is not None:  # which is weighted by this one
            alpha = np.where(image.valid, np.clip(traced.alpha, 0, 1), np.float32(1))
        rgba = np.concatenate([image.rgb, alpha[..., None]], axis=-1)
        bytes_ = np.ascontiguousarray(np.rint(rgba * 255).astype(np.uint8)).reshape(-1, 4)
        valid = None if image.valid.all() else image.valid.ravel()
        if not image.valid.any() and index not in self._empty:
            self._empty.add(index)
            log.warning("%s: no pixel of it counts, by its mask or by its lens distortion", frame.file_path)
        sun = None if frame.sun is None else frame.sun.direction
        opaque, planes = bool((alpha == 1).all()), self._planes(frame, traced)
        earth = None if frame.sun is None else frame.sun.earth
        return TrainingView(index, frame.camera, sun, bytes_.view("<u4").ravel(), valid, opaque, planes, earth)

    def _traced(self, frame: Frame) -> Truth | None:
        """A frame's truth, if any of it is asked for. Raises InputError for radiance that is not finite."""
        if any(name in OF_PIXELS for name in self.truth) or (self.truth and self.surface is None):
            traced = load_truth(self.dataset, frame)
            if "radiance" in self.truth and not np.isfinite(traced.radiance).all():
                path = self.dataset.root / str(frame.gt_path)
                raise InputError(f"{path}: expected finite radiance, found infinite values or none")
            return traced
        return None

    def _planes(self, frame: Frame, traced: Truth | None) -> dict[str, list[np.ndarray]]:
        """What is asked for of a frame's truth, or of the surface as its camera sees it."""
        planes: dict[str, np.ndarray] = {}
        if traced is not None:
            planes["radiance"] = np.maximum(traced.radiance, 0)
            planes["visibility"] = np.where(traced.shadow > 0, traced.sun_visibility, -1)[..., None]
        if self.surface is not None:
            depth, normal = self.surface(frame.camera)
        elif traced is not None:
            depth, normal = traced.depth, traced.normal
        else:
            return {}
        planes |= {"depth": depth[..., None], "normal": normal}
        planes_first = {name: np.moveaxis(planes[name], -1, 0).astype(np.float32) for name in self.truth}
        return {name: [np.ascontiguousarray(plane).ravel() for plane in group] for name, group in planes_first.items()}


_Task = tuple["Future[TrainingView]", Callable[[int], TrainingView], int]


class _Decoders:
    """Threads that load views. They are daemons: an exception that comes while a ThreadPoolExecutor starts a thread, as
    Ctrl-C's may, leaves one that Python does not know and waits for at its exit."""

    def __init__(self) -> None:
        self._tasks: SimpleQueue[_Task | None] = SimpleQueue()
        for _ in range(DECODERS):
            threading.Thread(target=_decode, args=(self._tasks,), name="decode", daemon=True).start()
        weakref.finalize(self, _end, self._tasks)

    def submit(self, load: Callable[[int], TrainingView], index: int) -> "Future[TrainingView]":
        """What `load` makes of a view's index, later."""
        future: Future[TrainingView] = Future()
        self._tasks.put((future, load, index))
        return future


def _decode(tasks: "SimpleQueue[_Task | None]") -> None:
    while (task := tasks.get()) is not None:
        future, load, index = task
        try:
            future.set_result(load(index))
        except BaseException as error:
            future.set_exception(error)
        del task, future, load  # else whose pictures they are would live on


def _end(tasks: "SimpleQueue[_Task | None]") -> None:
    for _ in range(DECODERS):
        tasks.put(None)


def kept_bytes() -> tuple[int, int]:
    """How many bytes of pictures are kept in main memory, and on the device."""
    free = main_memory(), free_memory()
    most, device = (
        largest if a_view is None else min(largest, a_view // share)
        for largest, a_view, share in zip((CACHE_BYTES, DEVICE_BYTES), free, SHARES, strict=True)
    )
    return most, device


def _check_known(dataset: Dataset, suns: bool, traced: Sequence[str]) -> None:
    """Raises InputError in one sentence that names the first frame which lacks what is asked for."""
    for frame in dataset.train:
        if suns and frame.sun is None:
            raise InputError(
                f"{dataset.root}: expected sun_direction in every training frame, or sun=unknown, which "
                f"estimates it, or the method relight with light.field.inputs=view, found none in {frame.file_path}"
            )
        if traced and frame.gt_path is None:
            raise InputError(
                f"{dataset.root}: expected path-traced {' and '.join(traced)} (gt_path) in every training frame, "
                f"found none in {frame.file_path}"
            )
