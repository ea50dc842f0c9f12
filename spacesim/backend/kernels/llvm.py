"""Kernels of LLVM's text in line with Dr.Jit's on a CPU: on its threads, behind what it was asked for.

Dr.Jit's kernels run the same instructions in all lanes: they gather where a thread of its own would go on reading, and
write nothing that they read. The libLLVM that Dr.Jit needs compiles the text, so nothing else is needed.
"""

import ctypes
import logging
from collections import deque
from collections.abc import Callable, Sequence
from ctypes import POINTER, addressof, byref, c_char_p, c_int, c_size_t, c_uint32, c_uint64, c_void_p
from functools import cache
from pathlib import Path
from typing import Any

from spacesim.backend.kernels.llvm_text import DECLARED, FIRST, LANES, Text
from spacesim.backend.llvm import find_llvm
from spacesim.backend.readback import copy_functions, dr_library
from spacesim.backend.recording import one_at_a_time
from spacesim.backend.selection import ad, load_drjit, select

_FUNCTIONS = "task_submit_dep", "task_wait", "task_release"  # of Dr.Jit's threads: their addresses come first
_DONE = len(_FUNCTIONS)  # place of a parameter: 1 when all is done
assert FIRST == _DONE + 1
_BACKEND = 2  # LLVM, among Dr.Jit's
_ENQUEUE, _WIDTH = "_Z21jit_enqueue_host_func10JitBackendPFvPvES0_", "_Z21jit_llvm_vector_widthv"

log = logging.getLogger(__name__)


class LlvmKernel:
    """Functions of text that run one after another, each for indices from 0 to below a count on all threads.

    arrays, numbers: names of what it is launched with;  stages: (name of a function, what writes it)
    """

    def __init__(
        self, arrays: Sequence[str], numbers: Sequence[str], *stages: tuple[str, Callable[[Text], None]]
    ) -> None:
        """Raises RuntimeError where LLVM does not take the text, or what is needed is not there."""
        self._threads, self._size = _threads(), FIRST + len(arrays) + len(numbers) + len(stages)
        self._takes = len(arrays), len(numbers), len(stages)
        functions = []
        for name, write in stages:
            text = Text(f"@{name}", arrays, numbers)
            write(text)
            functions.append(text.finish())
        launch = _launch([name for name, _ in stages], self._size - len(stages))
        self._function = _compiled("\n".join([DECLARED, *functions, launch]))

    def __call__(self, counts: Sequence[int], arrays: Sequence[Any], numbers: Sequence[int]) -> None:
        """Launch it behind what Dr.Jit was asked for: where that is over, at once, without a word in its history.

        counts: of the stages, above 0;  arrays: of Dr.Jit's, made opaque here, those to be written of `empty`
        """
        assert (len(arrays), len(numbers), len(counts)) == self._takes
        dr, threads = load_drjit(), self._threads
        assert not dr.flag(dr.JitFlag.FreezingScope), "kernels of text are launched between recordings"
        dr.make_opaque(arrays)  # a literal has no memory of its own
        with one_at_a_time:
            while _launched and _launched[0][_DONE]:
                _launched.popleft()
            addresses = [threads.address(array) for array in arrays]
            values = (c_uint64 * self._size)(*threads.functions, 0, *addresses, *numbers, *counts)
            _launched.append(values)
            threads.enqueue(_BACKEND, self._function, addressof(values))


_launched: deque[Any] = deque()  # parameters of launches that may not be over, the oldest first


def empty(kind: Any, size: int) -> Any:
    """An array for a kernel to write."""
    array = load_drjit().empty(kind, size)
    load_drjit().make_opaque(array)
    return array


def vector_width() -> int:
    """Numbers of a register: 4 of NEON, 8 of AVX2, 16 of AVX-512. Raises RuntimeError where kernels do not run."""
    return _threads().vector_width


def is_usable() -> bool:
    """Whether kernels of text can be launched now: on LLVM, outside recordings, where they run at all."""
    dr = load_drjit()
    return select() == "llvm" and not dr.flag(dr.JitFlag.FreezingScope) and _runs()


@cache
def _runs() -> bool:
    """Whether they run here: tried once in a process."""
    dr = load_drjit()
    numbers, results = dr.arange(ad.Float, 2 * LANES), empty(ad.Float, 2 * LANES + 1)
    try:
        LlvmKernel(["numbers", "results"], ["end"], ("try", _try))([1], [numbers, results], [LANES + 3])
    except RuntimeError as reason:  # whatever the libraries say: Dr.Jit computes the same
        log.info("no kernels beside Dr.Jit's, which take longer (%s)", reason)
        return False
    index = dr.arange(ad.UInt32, 2 * LANES)
    squares = dr.select(index < LANES + 3, numbers * numbers + numbers, 0)
    found = dr.gather(ad.Float, results, index)
    is_right = dr.all((found == squares) | ((index >= LANES + 3) & (index < 2 * LANES)))
    return bool(is_right) and float(results[2 * LANES]) == float(dr.sum(squares)[0])


def _try(text: Text) -> None:
    """One of each instruction that calls for more than LLVM's core: x^2 + x up to a number, and the sum of these."""
    total = text.zeros(LANES)
    for start in (text.integer(0), text.integer(LANES)):
        text.prefetch("numbers", start)
        lanes = text.lanes(LANES, start, text.number("end"))
        values = text.load_lanes("numbers", start, lanes)
        squares = text.fma(values, values, values)
        text.store_lanes("results", start, squares, lanes)
        total = total + squares
    text.store("results", text.integer(2 * LANES), text.sum(total))


def _launch(names: Sequence[str], place: int) -> str:
    """Function that runs others one after another. place: of their counts among the parameters"""
    lines = ["define void @launch(ptr %p) nounwind {"]
    for i, function in enumerate(("submit", "wait", "release")):
        lines += [f"  %{function}_at = getelementptr i64, ptr %p, i64 {i}"]
        lines += [f"  %{function} = load ptr, ptr %{function}_at"]
    for i, name in enumerate(names):
        lines += [
            f"  %count_at{i} = getelementptr i64, ptr %p, i64 {place + i}",
            f"  %count{i} = load i32, ptr %count_at{i}",
            f"  %task{i} = call ptr %submit(ptr null, ptr null, i32 0, i32 %count{i}, ptr @{name}, ptr %p, i32 0, "
            "ptr null, i32 1, i32 0)",
            f"  call void %wait(ptr %task{i})",
            f"  call void %release(ptr %task{i})",
        ]
    lines += [
        f"  %done_at = getelementptr i64, ptr %p, i64 {_DONE}",
        "  store atomic i64 1, ptr %done_at release, align 8",
        "  ret void",
        "}",
    ]
    return "\n".join(lines)


class _Threads:
    """Those of Dr.Jit, and its queue."""

    def __init__(self) -> None:
        """Raises RuntimeError where its libraries do not have what is needed by these names."""
        library, functions = dr_library(), copy_functions()
        if library is None or functions is None:
            raise RuntimeError("Dr.Jit's library is not known")
        try:
            pool = ctypes.CDLL(str(Path(library._name).with_name(f"libnanothread{Path(library._name).suffix}")))
            self.enqueue, self.vector_width = library[_ENQUEUE], int(library[_WIDTH]())
            found = [pool[name] for name in _FUNCTIONS]
        except (OSError, AttributeError) as error:
            raise RuntimeError(str(error)) from None
        self.enqueue.restype, self.enqueue.argtypes = None, [c_uint32, c_void_p, c_void_p]
        self.functions = [ctypes.cast(function, c_void_p).value or 0 for function in found]
        self._address, self._release = functions["address"], functions["release"]

    def address(self, array: Any) -> int:
        """Of an evaluated array's numbers."""
        start = c_void_p()
        found = self._address(array.index, byref(start))
        self._release(found)
        assert found == array.index, "an array has memory of its own"
        return start.value or 0


@cache
def _threads() -> _Threads:
    return _Threads()


_ARGUMENTS: dict[str, tuple[Any, list[Any]]] = {
    "LLVMContextCreate": (c_void_p, []),
    "LLVMCreateMemoryBufferWithMemoryRangeCopy": (c_void_p, [c_char_p, c_size_t, c_char_p]),
    "LLVMParseIRInContext": (c_int, [c_void_p, c_void_p, POINTER(c_void_p), POINTER(c_char_p)]),
    "LLVMOrcCreateNewThreadSafeModule": (c_void_p, [c_void_p, c_void_p]),
    "LLVMOrcCreateLLJIT": (c_void_p, [POINTER(c_void_p), c_void_p]),
    "LLVMOrcLLJITGetMainJITDylib": (c_void_p, [c_void_p]),
    "LLVMOrcLLJITAddLLVMIRModule": (c_void_p, [c_void_p, c_void_p, c_void_p]),
    "LLVMOrcLLJITLookup": (c_void_p, [c_void_p, POINTER(c_uint64), c_char_p]),
    "LLVMGetErrorMessage": (c_void_p, [c_void_p]),
}
_OF_CONTEXTS: tuple[dict[str, tuple[Any, list[Any]]], ...] = (
    {"LLVMOrcCreateNewThreadSafeContextFromLLVMContext": (c_void_p, [c_void_p])},  # from LLVM 21 on
    {
        "LLVMOrcCreateNewThreadSafeContext": (c_void_p, []),
        "LLVMOrcThreadSafeContextGetContext": (c_void_p, [c_void_p]),
    },
)


@cache
def _llvm() -> dict[str, Any]:
    """Functions of the libLLVM that Dr.Jit uses. Raises RuntimeError where one is missing."""
    path, sentence = find_llvm()
    try:
        library = ctypes.CDLL(str(path))
        of_contexts = next((some for some in _OF_CONTEXTS if all(hasattr(library, name) for name in some)), {})
        functions = {}
        for name, (result, arguments) in (_ARGUMENTS | of_contexts).items():
            functions[name] = library[name]
            functions[name].restype, functions[name].argtypes = result, arguments
    except (OSError, AttributeError) as error:
        raise RuntimeError(f"{sentence}: {error}") from None
    for target in ("X86", "AArch64"):
        for part in ("TargetInfo", "Target", "TargetMC", "AsmPrinter"):
            getattr(library, f"LLVMInitialize{target}{part}", lambda: None)()
    return functions


def _new_context() -> tuple[int, int]:
    """(context, the same for several threads)."""
    call = _llvm()
    if "LLVMOrcCreateNewThreadSafeContextFromLLVMContext" in call:
        context = call["LLVMContextCreate"]()
        return context, call["LLVMOrcCreateNewThreadSafeContextFromLLVMContext"](context)
    shared = call["LLVMOrcCreateNewThreadSafeContext"]()
    return call["LLVMOrcThreadSafeContextGetContext"](shared), shared


def _compiled(text: str) -> int:
    """Address of the function `launch` of a text, compiled for this CPU; its code stays. Raises RuntimeError."""
    call = _llvm()

    def check(error: int | None) -> None:
        if error:
            message = ctypes.cast(call["LLVMGetErrorMessage"](error), c_char_p).value or b""
            raise RuntimeError(f"LLVM: {message.decode(errors='replace')}")

    context, shared = _new_context()
    code = text.encode()
    buffer = call["LLVMCreateMemoryBufferWithMemoryRangeCopy"](code, len(code), b"kernel")
    module, message, engine, address = c_void_p(), c_char_p(), c_void_p(), c_uint64()
    if call["LLVMParseIRInContext"](context, buffer, byref(module), byref(message)):
        raise RuntimeError(f"LLVM: {(message.value or b'').decode(errors='replace')}")
    check(call["LLVMOrcCreateLLJIT"](byref(engine), None))
    owned = call["LLVMOrcCreateNewThreadSafeModule"](module, shared)
    check(call["LLVMOrcLLJITAddLLVMIRModule"](engine, call["LLVMOrcLLJITGetMainJITDylib"](engine), owned))
    check(call["LLVMOrcLLJITLookup"](engine, byref(address), b"launch"))
    return address.value
