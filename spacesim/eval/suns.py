"""Which evaluated frames are lit by a Sun that training has seen."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from spacesim.data.errors import InputError
from spacesim.data.files import JsonMapping
from spacesim.data.identity import same_digest, training_digest
from spacesim.data.records import Dataset, Frame
from spacesim.data.store import read_dataset

SAME_SUN_DEG = 0.01
"""Degrees between two directions that still count as one Sun (files keep directions far better than that, and
the Suns of a dataset stand degrees apart)."""


@dataclass(frozen=True, eq=False)
class TrainedOn:
    """What a run was trained on."""

    frames: Sequence[Frame]  #: () where they are gone or have changed
    why_unknown: str = ""  #: the reason why there are none
    other: Path | None = None  #: their folder, where they are not those of the dataset asked for


def training_frames(config: JsonMapping, dataset: Dataset) -> TrainedOn:
    """The frames that a run was trained on: those of `dataset` if it is the run's own, else those of the dataset that
    the run names. config: the run's
    """
    data = config.get("data") or {}
    if "digest" not in data:
        return TrainedOn(dataset.train)
    path = Path(data["path"])
    digest = _digest(dataset)
    if _same(digest, data["digest"]) or (digest is None and path == dataset.root.resolve()):
        return TrainedOn(dataset.train)
    try:
        training_set = read_dataset(path)
    except InputError:
        return TrainedOn((), f"the run was trained on other data, {path}, which is gone", path)
    if not _same(_digest(training_set), data["digest"]):
        return TrainedOn((), f"the run was trained on other data, and {path} has changed since", path)
    return TrainedOn(training_set.train, other=path)


def known_suns(frames: Sequence[Frame], training: Sequence[Frame]) -> list[bool | None]:
    """For each frame whether its Sun stands within `SAME_SUN_DEG` of that of a training frame.

    None for a frame without a Sun, and for all frames where no training frame has one.
    """
    trained = [frame.sun.direction for frame in training if frame.sun is not None]
    if not trained:
        return [None] * len(frames)
    tree = KDTree(np.unique(trained, axis=0))
    chord = 2 * np.sin(0.5 * np.radians(SAME_SUN_DEG))
    return [None if frame.sun is None else bool(tree.query(frame.sun.direction)[0] <= chord) for frame in frames]


def rounded_angles(frame: Frame) -> list[float] | None:
    """[azimuth, elevation] of the Sun, degrees, to 1e-4."""
    return None if frame.sun is None else [round(angle, 4) for angle in frame.sun.angles]


def _digest(dataset: Dataset) -> str | None:
    """As training records it; None where pictures of it are missing or cannot be read."""
    try:
        return training_digest(dataset)
    except (OSError, InputError):
        return None


def _same(digest: str | None, recorded: object) -> bool:
    return digest is not None and same_digest(digest, str(recorded))


def count_suns(frames: Sequence[Frame]) -> int:
    """How many Suns light the frames, by their rounded angles."""
    return len({tuple(angles) for frame in frames if (angles := rounded_angles(frame)) is not None})
