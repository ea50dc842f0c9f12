"""Checkpoints of Gaussians, and what they say of themselves."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spacesim.data.errors import check_ranges
from spacesim.data.files import JsonDict, JsonMapping
from spacesim.learning import tensors as files
from spacesim.learning.record import CheckpointHeader, HistoryEntry

FORMAT = "spacesim-gaussians-1"


@dataclass(frozen=True, kw_only=True)
class GaussianHistoryEntry(HistoryEntry):
    """What training noted of a step."""

    gaussians: int  #: how many there were then


@dataclass(frozen=True, kw_only=True)
class GaussianCheckpointHeader(CheckpointHeader):
    """What a checkpoint of Gaussians says beside its arrays."""

    history: tuple[GaussianHistoryEntry, ...]  #: of some iterations, in order
    adam_steps: int  #: finished ones
    format: str = FORMAT  #: by which such files are known

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(self, adam_steps=(0, 2**53))


def write_tensors(path: Path, tensors: Mapping[str, np.ndarray], header: JsonMapping) -> None:
    """Write a model or a checkpoint of Gaussians; see `learning.tensors`."""
    files.write_tensors(path, tensors, header, FORMAT)


def read_tensors(path: Path) -> tuple[dict[str, np.ndarray], JsonDict]:
    """The inverse of `write_tensors`. Raises InputError for another file."""
    return files.read_tensors(path, FORMAT)
