"""Arrays of numpy's, and numbers of Python's, become arrays of Dr.Jit's.

On LLVM, `ad.Float(values)` goes on reading numpy's own memory, and kernels read it in whole vectors, up to 60 bytes
beyond its end: where the next page is not there, the process dies. What comes from numpy comes through here.

On CUDA, Dr.Jit 1.5 copies a list through locked memory and frees that in a host callback, which stalls the stream: on
an H200 for 0.1 to 0.4 ms. Numbers that each step or picture has anew come through `upload_numbers`, which frees none.
"""

import ctypes
import threading
from array import array as floats
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend.arrays import Array3f, Float, UInt32
from spacesim.backend.readback import LOCKED, HostSlot, copy_entries, copy_functions
from spacesim.backend.selection import ad, select

VECTOR = 64  # elements of the widest vector, and more
MAX_NUMBERS = 128  #: of a list that `_Outbox` sends
SLOT = 4 * MAX_NUMBERS  #: bytes of a list's memory
LISTS = 256  #: that it sends from half of its memory


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


def upload_numbers(values: Sequence[float]) -> Float:
    """Float [N] of numbers of Python's, for arguments of recordings. On CUDA up to `MAX_NUMBERS` stall nothing, where
    Dr.Jit's library has the functions (`copy_functions`)."""
    sends = 0 < len(values) <= MAX_NUMBERS and select() == "cuda"
    functions = copy_functions() if sends else None
    return ad.Float(list(values)) if functions is None else _outbox.send(values, functions)


class _Outbox:
    """Locked memory of the host's from which lists of numbers go to the device, in two halves by turns: one is written
    again when all has arrived that was sent from it. Dr.Jit 1.5 has one CUDA stream for all threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._halves: list[tuple[HostSlot, memoryview]] = []  # and bytes of its memory
        self._sent = 0

    def send(self, values: Sequence[float], functions: dict[str, Any]) -> Float:
        """Float [N] of at most `MAX_NUMBERS`. functions: `copy_functions`"""
        with self._lock:
            return self._send(values, functions)

    def _send(self, values: Sequence[float], functions: dict[str, Any]) -> Float:
        array = dr.empty(ad.Float, len(values))
        dr.make_opaque(array)
        if not self._halves:
            kind, size = dr.backend_v(array).value, SLOT * LISTS
            self._halves = [_locked(functions["allocate"](kind, size, LOCKED)) for _ in range(2)]
        turn, place = divmod(self._sent, LISTS)
        slot, memory = self._halves[turn % 2]
        if place == 0 and turn >= 2:
            slot.event.wait()
        numbers, first = floats("f", values), SLOT * place
        memory[first : first + numbers.itemsize * len(numbers)] = numbers.tobytes()
        copy_entries(array, 0, len(numbers), slot.address + first, functions, to_device=True)
        self._sent += 1
        if place == LISTS - 1:
            slot.record(functions)
        return array


def _locked(address: int) -> tuple[HostSlot, memoryview]:
    return HostSlot(address), memoryview((ctypes.c_char * (SLOT * LISTS)).from_address(address)).cast("B")


_outbox = _Outbox()


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
