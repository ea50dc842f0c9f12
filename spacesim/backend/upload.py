"""Arrays of numpy's become arrays of Dr.Jit's.

On LLVM, `ad.Float(values)` goes on reading numpy's own memory, and kernels read it in whole vectors, up to 60 bytes
beyond its end: where the next page is not there, the process dies. What comes from numpy comes through here.
"""

from functools import lru_cache
from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend.arrays import Array3f, Float, UInt32
from spacesim.backend.selection import ad

VECTOR = 64  # elements of the widest vector, and more


def upload(values: np.ndarray, kind: Any = None) -> Any:
    """Float [N], or UInt32, UInt64 or Bool as `kind` says, of an array of N elements (any shape, in C order), in memory
    of Dr.Jit's own: memory of numpy's may be aligned otherwise, and LLVM compiles each alignment anew."""
    kind = ad.Float if kind is None else kind
    dtype = {ad.Float: np.float32, ad.UInt32: np.uint32, ad.UInt64: np.uint64, ad.Bool: bool}[kind]
    values = np.ravel(values)
    count = len(values)
    if not count:
        return kind([])
    padded = np.empty(count + VECTOR, dtype)
    padded[:count] = values
    array = dr.opaque(kind, 0, count)
    dr.scatter(array, kind(padded[:count]), dr.arange(ad.UInt32, count))
    dr.eval(array)
    return array


def upload_rows(rows: np.ndarray) -> Array3f:
    """Array3f [3, N] of an array [3, N]."""
    return ad.Array3f(*(upload(row) for row in rows))


@lru_cache(maxsize=256)
def held(number: int, role: str) -> UInt32:
    """A number that is no part of a kernel's text, of width 1; the same array each time, for to make one is a launch.
    role: what it is: arguments of a recording that have one value must be two arrays"""
    return _held(ad.UInt32, number)


@lru_cache(maxsize=256)
def held_float(number: float, role: str) -> Float:
    """The same of numbers that are not whole."""
    return _held(ad.Float, number)


def _held(kind: Any, number: float) -> Any:
    array = dr.opaque(kind, number)
    dr.sync_thread()  # another thread may be the next to ask
    return array
