"""Models and checkpoints: safetensors files with a JSON header, complete or not there."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from spacesim.backend.memory import check_memory
from spacesim.data.errors import InputError, check_ranges
from spacesim.data.files import open_regular, write_bytes

FORMAT = "spacesim-gaussians-1"


@dataclass(frozen=True)
class HistoryEntry:
    """What training noted of a step."""

    iteration: int  #: how many were finished
    loss: float  #: of the last one
    gaussians: int


@dataclass(frozen=True)
class CheckpointHeader:
    """What a checkpoint says beside its arrays."""

    iteration: int  #: finished ones
    adam_steps: int  #: finished ones
    history: tuple[HistoryEntry, ...]
    format: str = FORMAT

    def __post_init__(self) -> None:
        check_ranges(self, iteration=(0, 2**53), adam_steps=(0, 2**53))


def write_tensors(path: Path, tensors: Mapping[str, np.ndarray], header: Mapping[str, Any]) -> None:
    """Write named arrays and a JSON header to `path`, atomically."""
    metadata = {"spacesim": json.dumps({"format": FORMAT, **header}, sort_keys=True)}
    contiguous = {name: np.ascontiguousarray(value) for name, value in tensors.items()}
    write_bytes(path, save(contiguous, metadata=metadata))


def read_tensors(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """(arrays, header) of a file that `write_tensors` wrote. Raises InputError for anything else, and for arrays of
    other numbers than floating-point ones."""
    with open_regular(path, "a model") as file:
        check_memory(os.fstat(file.fileno()).st_size, f"{path}: reading it")
    try:
        with safe_open(path, framework="numpy") as file:
            header = json.loads((file.metadata() or {}).get("spacesim", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: expected a safetensors file, found one that cannot be read ({error})") from None
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        found = repr(header.get("format")) if isinstance(header, dict) else "none"
        raise InputError(f"{path}: expected a {FORMAT} file, found format {found}")
    for name, tensor in tensors.items():
        if tensor.dtype not in (np.float32, np.float64):
            raise InputError(f"{path}: expected floating-point numbers as {name}, found {tensor.dtype}")
    return tensors, header
