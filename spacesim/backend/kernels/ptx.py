"""Kernels of PTX text in line with Dr.Jit's on CUDA: launched on its stream, they read and write its arrays.

For what Dr.Jit cannot say, such as products on tensor cores of arrays in memory. The driver compiles the text, as it
does Dr.Jit's, so nothing else is needed. No recording takes in such a kernel: it is launched between recordings.
"""

import ctypes
from collections.abc import Sequence
from ctypes import POINTER, addressof, byref, c_char_p, c_float, c_int, c_uint, c_uint32, c_uint64, c_void_p
from functools import cache
from typing import Any

from spacesim.backend.memory import CUDA_DRIVER
from spacesim.backend.readback import dr_library
from spacesim.backend.recording import one_at_a_time
from spacesim.backend.selection import load_drjit

MAX_TIMED = 10_000  #: launches whose times are kept, if nobody takes them
MAX_SHARED = 8  #: CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES
_DLTENSOR = b"dltensor"  #: name of a capsule of DLPack, whose first field is the address


class PtxKernel:
    """An entry of PTX text, with parameters: addresses of arrays (u64), then numbers (u32).

    arrays, numbers: how many;  shared: bytes of shared memory of a block;  threads: of a block
    """

    def __init__(self, text: str, entry: str, arrays: int, numbers: int, shared: int, threads: int) -> None:
        """Raises RuntimeError where the driver does not take it, or cannot be reached."""
        self._driver, self._shared, self._threads = _driver(), shared, threads
        self._addresses, self._numbers = (c_uint64 * arrays)(), (c_uint32 * numbers)()
        values = [addressof(self._addresses) + 8 * i for i in range(arrays)]
        self._parameters = (c_void_p * (arrays + numbers))(
            *values, *[addressof(self._numbers) + 4 * i for i in range(numbers)]
        )
        module, self._function = c_void_p(), c_void_p()
        with one_at_a_time, self._driver:
            call = self._driver.call
            call("cuModuleLoadData", byref(module), text.encode())
            call("cuModuleGetFunction", byref(self._function), module, entry.encode())
            call("cuFuncSetAttribute", self._function, MAX_SHARED, shared)

    def __call__(self, grid: tuple[int, int, int], arrays: Sequence[Any], numbers: Sequence[int]) -> None:
        """Launch it behind what the device was asked for. arrays: of Dr.Jit's, evaluated here where they are not"""
        driver, dr = self._driver, load_drjit()
        with one_at_a_time, driver:
            self._addresses[:] = [_address(array) for array in arrays]
            self._numbers[:] = list(numbers)
            events = driver.events() if dr.flag(dr.JitFlag.KernelHistory) else ()
            for event in events[:1]:
                driver.call("cuEventRecord", event, driver.stream)
            driver.call(
                "cuLaunchKernel",
                self._function,
                *grid,
                self._threads,
                1,
                1,
                self._shared,
                driver.stream,
                self._parameters,
                None,
            )
            for event in events[1:]:
                driver.call("cuEventRecord", event, driver.stream)
                _timed.append(events)
        if len(_timed) > MAX_TIMED:
            take_times()


_timed: list[tuple[c_void_p, ...]] = []  # events before and after launches that were timed


def take_times() -> list[float]:
    """Milliseconds of each launch since the last time while `dr.JitFlag.KernelHistory` was set: Dr.Jit's own history
    does not know of them. Waits for the device."""
    times = []
    if _timed:
        driver = _driver()
        with one_at_a_time, driver:
            for begin, end in _timed:
                elapsed = c_float()
                driver.call("cuEventSynchronize", end)
                driver.call("cuEventElapsedTime", byref(elapsed), begin, end)
                times.append(elapsed.value)
                for event in (begin, end):
                    driver.call("cuEventDestroy_v2", event)
        _timed.clear()
    return times


def _address(array: Any) -> int:
    """Of an array's numbers in the device's memory."""
    capsule = array.__dlpack__()
    return c_uint64.from_address(_pointer(capsule, _DLTENSOR)).value


_pointer = ctypes.pythonapi.PyCapsule_GetPointer
_pointer.restype, _pointer.argtypes = c_void_p, [ctypes.py_object, c_char_p]


_ARGUMENTS: dict[str, list[Any]] = {
    "cuModuleLoadData": [POINTER(c_void_p), c_char_p],
    "cuModuleGetFunction": [POINTER(c_void_p), c_void_p, c_char_p],
    "cuFuncSetAttribute": [c_void_p, c_int, c_int],
    "cuLaunchKernel": [c_void_p, *[c_uint] * 7, c_void_p, c_void_p, c_void_p],
    "cuCtxPushCurrent_v2": [c_void_p],
    "cuCtxPopCurrent_v2": [POINTER(c_void_p)],
    "cuEventCreate": [POINTER(c_void_p), c_uint],
    "cuEventRecord": [c_void_p, c_void_p],
    "cuEventSynchronize": [c_void_p],
    "cuEventElapsedTime": [POINTER(c_float), c_void_p, c_void_p],
    "cuEventDestroy_v2": [c_void_p],
}


class _Driver:
    """CUDA's driver with Dr.Jit's context, which is current within a `with` block, and its stream."""

    def __init__(self) -> None:
        """Raises RuntimeError where driver, context or stream are not to be had by these names."""
        library = dr_library()
        try:
            self._driver = ctypes.CDLL(CUDA_DRIVER)
            handles = [library[name] for name in ("_Z16jit_cuda_contextv", "_Z15jit_cuda_streamv")] if library else []
            self._functions = {name: self._driver[name] for name in _ARGUMENTS}
        except (OSError, AttributeError) as error:
            raise RuntimeError(f"no launches beside Dr.Jit's ({error})") from None
        for handle in handles:
            handle.restype = c_void_p
        self.context, self.stream = [handle() for handle in handles] or [None, None]
        if not self.context or not self.stream:
            raise RuntimeError("no launches beside Dr.Jit's (its context or stream is not known)")
        for name, arguments in _ARGUMENTS.items():
            self._functions[name].argtypes = arguments

    def call(self, name: str, *arguments: Any) -> None:
        """Raises RuntimeError where it fails."""
        failed = self._functions[name](*arguments)
        if failed:
            raise RuntimeError(f"{name} failed with error {failed} of the CUDA driver")

    def events(self) -> tuple[c_void_p, ...]:
        """Two that know the time."""
        pair = c_void_p(), c_void_p()
        for event in pair:
            self.call("cuEventCreate", byref(event), 0)
        return pair

    def __enter__(self) -> None:
        self.call("cuCtxPushCurrent_v2", self.context)

    def __exit__(self, *_: object) -> None:
        self.call("cuCtxPopCurrent_v2", byref(c_void_p()))


@cache
def _driver() -> _Driver:
    return _Driver()
