"""Arrays of the device's that the host reads without a wait for all that the device was asked for since.

To read an array synchronises with the device. Here the device copies it, or an entry, to memory of the host's as soon
as it is there, and an event says when. Dr.Jit has the events for Python, the copy in C++ alone: `can_read_async` says
whether its library has that by the names of Dr.Jit 1.5 on Linux and macOS.
"""

import ctypes
import importlib
from ctypes import c_int, c_size_t, c_uint32, c_void_p
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from spacesim.backend.arrays import Float, UInt32, UInt64
from spacesim.backend.selection import load_drjit, select

SLOT = 64  #: bytes of memory for a copy that is used again: to give it back stalls the device's stream
MAX_BYTES = 2**26  #: of an array that is copied on its own: such memory of the host's is scarce
_LIBRARIES = "libdrjit-core.so", "libdrjit-core.dylib"
_FUNCTIONS: dict[str, tuple[str, Any, tuple[Any, ...]]] = {
    "allocate": ("_Z10jit_malloc10JitBackendmi", c_void_p, (c_uint32, c_size_t, c_int)),
    "free": ("_Z8jit_freePv", None, (c_void_p,)),
    "copy": ("_Z16jit_memcpy_async10JitBackendPvPKvm", None, (c_uint32, c_void_p, c_void_p, c_size_t)),
    "address": ("_Z12jit_var_datajPPv", c_uint32, (c_uint32, c_void_p)),
    "release": ("_Z20jit_var_dec_ref_implj", None, (c_uint32,)),
}
"""Name in the library, which encodes the types of the arguments, what it returns, and these types."""
_FUNCTIONS_OF_CUDA: dict[str, tuple[str, Any, tuple[Any, ...]]] = {
    "context": ("_Z16jit_cuda_contextv", c_void_p, ()),
    "push": ("_Z21jit_cuda_push_contextPv", None, (c_void_p,)),
    "pop": ("_Z20jit_cuda_pop_contextv", c_void_p, ()),
}
LOCKED = 1  #: kind of memory for copies between host and device: on CUDA its pages are locked, or a copy would wait


class AsyncNumber:
    """The last entry of an evaluated array UInt32 or UInt64 [N], read once with `wait`."""

    def __init__(self, array: UInt32 | UInt64) -> None:
        """Raises RuntimeError where `can_read_async` is false."""
        self._copy = _Copy(array, len(array) - 1, 1)

    def wait(self) -> int:
        """The number. Waits for what was asked of the device before this was made, and for nothing else."""
        return int(self._copy.wait()[0])


class AsyncArray:
    """An array Float or UInt32 [N], read once with `wait`, which waits for all that the device was asked for where
    `can_read_async` is false, or the array takes more than `MAX_BYTES`."""

    def __init__(self, array: Float | UInt32) -> None:
        load_drjit().eval(array)
        count = len(array)
        copies = can_read_async() and 0 < 4 * count <= MAX_BYTES
        self._array, self._copy = None if copies else array, _Copy(array, 0, count) if copies else None

    def wait(self) -> np.ndarray:
        """[N], memory of its own. Waits for what was asked of the device before this was made, and for nothing else."""
        if self._copy is not None:
            return self._copy.wait()
        assert self._array is not None
        return np.array(self._array)


class _Copy:
    """`count` entries of an array, from the `first` on, on their way to the host."""

    def __init__(self, array: Any, first: int, count: int) -> None:
        functions = copy_functions()
        if functions is None:
            raise RuntimeError("this Dr.Jit does not copy numbers to the host while the device goes on")
        backend, self._type = _layout(array.__class__)
        self._bytes = count * self._type.itemsize
        self._free = functions["free"] if self._bytes > SLOT else None
        if self._free is None and _slots:
            self._slot = _slots.pop()
        else:
            self._slot = HostSlot(functions["allocate"](backend, max(self._bytes, SLOT), LOCKED))
        copy_entries(array, first, count, self._slot.address, functions, to_device=False)
        self._slot.record(functions)
        self._is_pending = True

    def wait(self) -> np.ndarray:
        """[count], once."""
        assert self._is_pending, "read once"
        self._slot.event.wait()
        memory: Any = (ctypes.c_char * self._bytes).from_address(self._slot.address)
        entries: np.ndarray = np.frombuffer(memory, self._type).copy()
        self._give_back()
        return entries

    def _give_back(self) -> None:
        """The memory, once the device has written into it."""
        self._is_pending = False
        if self._free is None:
            _slots.append(self._slot)
        else:
            self._free(self._slot.address)

    def __del__(self) -> None:
        if getattr(self, "_is_pending", False):
            self._slot.event.wait()
            self._give_back()


def copy_entries(array: Any, first: int, count: int, address: int, functions: dict[str, Any], to_device: bool) -> None:
    """Ask the device for a copy of so many entries of an evaluated array, from the `first` on, to or from `LOCKED`
    memory at an address. functions: `copy_functions`"""
    start, (backend, dtype) = c_void_p(), _layout(array.__class__)
    variable = functions["address"](array.index, ctypes.byref(start))
    place, size = (start.value or 0) + dtype.itemsize * first, dtype.itemsize * count
    functions["copy"](backend, *((place, address) if to_device else (address, place)), size)
    functions["release"](variable)


@cache
def _layout(array: type) -> tuple[int, np.dtype]:
    """(number of the backend, type of the entries) of a type of arrays."""
    dr = load_drjit()
    return dr.backend_v(array).value, np.dtype("f4" if dr.is_float_v(array) else f"u{dr.itemsize_v(array)}")


def can_read_async() -> bool:
    """Whether Dr.Jit has what `AsyncNumber` needs."""
    return copy_functions() is not None


class HostSlot:
    """Memory of the host's, and an event."""

    def __init__(self, address: int) -> None:
        self.address = address
        self.event = importlib.import_module(f"drjit.{select()}").Event(enable_timing=False)

    def record(self, functions: dict[str, Any]) -> None:
        """Record the event behind what the device has been asked for. Dr.Jit's other functions make the device's
        context current, this one does not in 1.5."""
        if "push" not in functions:
            self.event.record()
            return
        functions["push"](functions["context"]())
        try:
            self.event.record()
        finally:
            functions["pop"]()


_slots: list[HostSlot] = []  # of `SLOT` bytes, free; taken and given back without a lock: `__del__` comes at any moment


@cache
def dr_library() -> ctypes.CDLL | None:
    """Dr.Jit's core, as it is loaded; None where no library has one of its names."""
    folder = Path(str(load_drjit().__file__)).parent
    path = next((folder / name for name in _LIBRARIES if (folder / name).exists()), None)
    try:
        return ctypes.CDLL(str(path)) if path else None
    except OSError:
        return None


@cache
def copy_functions() -> dict[str, Any] | None:
    """Of Dr.Jit's library, by the names of `_FUNCTIONS`; None where one is missing."""
    library = dr_library()
    if library is None or not hasattr(importlib.import_module(f"drjit.{select()}"), "Event"):
        return None
    functions: dict[str, Any] = {}
    wanted = _FUNCTIONS | (_FUNCTIONS_OF_CUDA if select() == "cuda" else {})
    try:
        for name, (symbol, result, arguments) in wanted.items():
            functions[name] = library[symbol]
            functions[name].restype, functions[name].argtypes = result, arguments
    except AttributeError:
        return None
    return functions
