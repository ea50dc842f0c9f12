"""The training pictures: decoded once, kept packed in memory, handed out in a seeded order."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from spacesim.backend import ad
from spacesim.data.errors import InputError
from spacesim.data.images import load_image
from spacesim.data.records import Camera, Dataset
from spacesim.data.store import load_truth

CACHE_BYTES = 6 * 2**30
DEVICE_BYTES = 2 * 2**30  #: of pictures that stay on the device, chosen: 512 of 1024 x 1024


@dataclass(frozen=True, eq=False)
class View:
    """rgba: [H * W] uint32, 8 bits a channel, red lowest; valid: [H * W] bool, or None where all pixels count;
    opaque: the picture has no transparency, so that what is behind the object is part of it;
    visibility: [H * W] float32, path-traced, below 0 where there is no surface; None where it is not asked for."""

    index: int
    camera: Camera
    sun: np.ndarray | None
    rgba: np.ndarray
    valid: np.ndarray | None
    opaque: bool
    visibility: np.ndarray | None = None


class TrainingViews:
    """Views of a dataset's training frames by index, decoded at first use and kept while `CACHE_BYTES` last.

    suns: every frame must name its Sun;  visibility: and have path-traced truth. Raises InputError where one has not.
    """

    def __init__(self, dataset: Dataset, seed: int, suns: bool = False, visibility: bool = False) -> None:
        if not dataset.train:
            raise InputError(f"{dataset.root}: expected at least one training image, found none")
        _check_known(dataset, suns, visibility)
        self.dataset, self.seed, self.visibility = dataset, seed, visibility
        largest = max(4 * f.camera.width * f.camera.height for f in dataset.train)
        self._order = lru_cache(maxsize=1)(self._shuffle)
        self._cached = lru_cache(maxsize=max(1, CACHE_BYTES // largest))(self._load)
        self._uploaded = lru_cache(maxsize=max(1, DEVICE_BYTES // largest))(self._upload)

    def __len__(self) -> int:
        return len(self.dataset.train)

    def __getitem__(self, index: int) -> View:
        return self._cached(index)

    def at_step(self, step: int) -> View:
        """The view of a step: every epoch visits all views once, in an order that (seed, epoch) decides."""
        epoch, place = divmod(step, len(self))
        return self[int(self._order(epoch)[place])]

    def pixels(self, view: View) -> tuple[Any, Any, list[Any]]:
        """(rgba UInt32 [H * W], valid Bool [H * W] or of width 1, [visibility Float [H * W]] or []) of a view."""
        pixels: tuple[Any, Any, list[Any]] = self._uploaded(view.index)
        return pixels

    def _upload(self, index: int) -> tuple[Any, Any, list[Any]]:
        view = self[index]
        valid = ad.Bool(True) if view.valid is None else ad.Bool(view.valid)
        return ad.UInt32(view.rgba), valid, [] if view.visibility is None else [ad.Float(view.visibility)]

    def _shuffle(self, epoch: int) -> np.ndarray:
        return np.random.default_rng([self.seed, 1, epoch]).permutation(len(self))

    def _load(self, index: int) -> View:
        frame = self.dataset.train[index]
        image = load_image(self.dataset, frame)
        rgba = np.concatenate([image.rgb, image.alpha[..., None]], axis=-1)
        bytes_ = np.ascontiguousarray(np.rint(rgba * 255).astype(np.uint8)).reshape(-1, 4)
        valid = None if image.valid.all() else image.valid.ravel()
        sun = None if frame.sun is None else frame.sun.direction
        visibility = None
        if self.visibility:
            truth = load_truth(self.dataset, frame)
            visibility = np.where(truth.shadow > 0, truth.sun_visibility, -1).astype(np.float32).ravel()
        opaque = bool((image.alpha == 1).all())
        return View(index, frame.camera, sun, bytes_.view("<u4").ravel(), valid, opaque, visibility)


def _check_known(dataset: Dataset, suns: bool, visibility: bool) -> None:
    """Raises InputError in one sentence that names the first frame which lacks what is asked for."""
    for frame in dataset.train:
        if suns and frame.sun is None:
            raise InputError(
                f"{dataset.root}: expected sun_direction in every training frame, for methods of light, "
                f"found none in {frame.file_path}"
            )
        if visibility and frame.gt_path is None:
            raise InputError(
                f"{dataset.root}: expected path-traced visibility (gt_path) in every training frame, "
                f"found none in {frame.file_path}"
            )
