"""Named arrays in safetensors files with a JSON header, complete or not there."""

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from spacesim.backend.memory import check_memory
from spacesim.data.errors import InputError
from spacesim.data.files import JsonDict, JsonMapping, open_regular, write_bytes

DIGEST = "sha256"  #: its name in a header


def write_tensors(path: Path, tensors: Mapping[str, np.ndarray], header: JsonMapping, form: str) -> None:
    """Write named arrays and a JSON header to `path`, atomically, and a digest of both. form: the word by which
    `read_tensors` knows it."""
    contiguous = {n: np.ascontiguousarray(value, value.dtype.newbyteorder("<")) for n, value in tensors.items()}
    known: JsonDict = json.loads(json.dumps({"format": form, **header}))  # as it will be read: keys are strings
    text = json.dumps({**known, DIGEST: _digest(known, contiguous)}, sort_keys=True)
    write_bytes(path, save(contiguous, metadata={"spacesim": text}))  # of two entries the order would be any


def read_tensors(path: Path, form: str) -> tuple[dict[str, np.ndarray], JsonDict]:
    """(arrays, header) of a file that `write_tensors` wrote. Raises InputError for anything else, for arrays of
    other numbers than floating-point ones, and where a byte has changed since."""
    with open_regular(path, "a model") as file:
        check_memory(os.fstat(file.fileno()).st_size, f"{path}: reading it")
    try:
        with safe_open(path, framework="numpy") as file:
            header = json.loads((file.metadata() or {}).get("spacesim", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: expected a safetensors file, found one that cannot be read ({error})") from None
    if not isinstance(header, dict) or header.get("format") != form:
        named = repr(header.get("format")) if isinstance(header, dict) else "none"
        raise InputError(f"{path}: expected a {form} file, found format {named}")
    for name, tensor in tensors.items():
        if tensor.dtype not in (np.float32, np.float64):
            raise InputError(f"{path}: expected floating-point numbers as {name}, found {tensor.dtype}")
    written = header.pop(DIGEST, None)  # files of older versions have none
    if written is not None and written != _digest(header, tensors):
        raise InputError(f"{path}: expected the bytes that were written, found that some have changed since (SHA-256)")
    return tensors, header


def first_not_finite(tensors: Mapping[str, np.ndarray]) -> str:
    """Name of the first that has a number that is not finite; "" where all are."""
    return next((name for name, values in tensors.items() if not np.isfinite(values).all()), "")


def _digest(header: JsonMapping, tensors: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of a header and of named arrays, contiguous ones."""
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(tensors):
        value = tensors[name]
        digest.update(f"\n{name} {value.dtype.str} {value.shape}\n".encode())
        digest.update(value.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()
