"""The training pictures: decoded once, kept packed in memory, handed out in a seeded order."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from spacesim.backend import ad
from spacesim.data.errors import InputError
from spacesim.data.images import load_image
from spacesim.data.records import Camera, Dataset

CACHE_BYTES = 6 * 2**30
DEVICE_BYTES = 2 * 2**30  #: of pictures that stay on the device, chosen: 512 of 1024 x 1024


@dataclass(frozen=True, eq=False)
class View:
    """rgba: [H * W] uint32, 8 bits a channel, red lowest; valid: [H * W] bool, or None where all pixels count;
    opaque: the picture has no transparency, so that what is behind the object is part of it."""

    index: int
    camera: Camera
    rgba: np.ndarray
    valid: np.ndarray | None
    opaque: bool


class TrainingViews:
    """Views of a dataset's training frames by index, decoded at first use and kept while `CACHE_BYTES` last."""

    def __init__(self, dataset: Dataset, seed: int) -> None:
        if not dataset.train:
            raise InputError(f"{dataset.root}: expected at least one training image, found none")
        self.dataset, self.seed = dataset, seed
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

    def pixels(self, view: View) -> tuple[Any, Any]:
        """(rgba UInt32 [H * W], valid Bool [H * W] or of width 1) of a view, for kernels."""
        pixels: tuple[Any, Any] = self._uploaded(view.index)
        return pixels

    def _upload(self, index: int) -> tuple[Any, Any]:
        view = self[index]
        return ad.UInt32(view.rgba), ad.Bool(True) if view.valid is None else ad.Bool(view.valid)

    def _shuffle(self, epoch: int) -> np.ndarray:
        return np.random.default_rng([self.seed, 1, epoch]).permutation(len(self))

    def _load(self, index: int) -> View:
        frame = self.dataset.train[index]
        image = load_image(self.dataset, frame)
        rgba = np.concatenate([image.rgb, image.alpha[..., None]], axis=-1)
        bytes_ = np.ascontiguousarray(np.rint(rgba * 255).astype(np.uint8)).reshape(-1, 4)
        valid = None if image.valid.all() else image.valid.ravel()
        return View(index, frame.camera, bytes_.view("<u4").ravel(), valid, bool((image.alpha == 1).all()))
