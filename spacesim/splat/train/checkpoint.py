"""Models and checkpoints: safetensors files with a JSON header, complete or not there."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from spacesim.data.errors import InputError
from spacesim.data.files import write_bytes

FORMAT = "spacesim-gaussians-1"


def write_tensors(path: Path, tensors: Mapping[str, np.ndarray], header: Mapping[str, Any]) -> None:
    """Write named arrays and a JSON header to `path`, atomically."""
    metadata = {"spacesim": json.dumps({"format": FORMAT, **header}, sort_keys=True)}
    contiguous = {name: np.ascontiguousarray(value) for name, value in tensors.items()}
    write_bytes(path, save(contiguous, metadata=metadata))


def read_tensors(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """(arrays, header) of a file that `write_tensors` wrote. Raises InputError for anything else."""
    try:
        with safe_open(path, framework="numpy") as file:
            header = json.loads((file.metadata() or {}).get("spacesim", "{}"))
            if header.get("format") != FORMAT:
                raise InputError(f"{path}: expected a {FORMAT} file, found format {header.get('format')!r}")
            return {name: file.get_tensor(name) for name in file.keys()}, header  # noqa: SIM118
    except FileNotFoundError:
        raise InputError(f"{path}: expected a model, found no such file") from None
    except (SafetensorError, OSError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: expected a safetensors file, found one that cannot be read ({error})") from None
