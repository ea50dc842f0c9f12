"""Floor 0: which Dr.Jit backend runs, chosen once: CUDA where a device works, else LLVM on the CPU.

`ad` names Dr.Jit's array types of the chosen backend (`ad.Float`, `ad.Array3f`, ...); the first use chooses, if
`select` has not. Dr.Jit takes the first libLLVM that it finds, when it is imported, and versions before 19 abort the
whole process: so the package, when it is imported, has `name_llvm` put a good one into DRJIT_LIBLLVM_PATH.
"""

import ctypes
import gc
import importlib
import itertools
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any
from weakref import WeakSet

from spacesim.memory import LARGE, main_memory

NAMES = ("auto", "cuda", "llvm")
_PLAIN = frozenset((int, float, bool, str, type(None)))
_EQUAL_TO_INTEGERS = frozenset((float, bool))  # 1, 1.0 and True are one key of a dictionary, 0.0 and -0.0 too
MINIMUM_LLVM = 19
MOST_KEYS = 2**14  # that are remembered of what is not an array, chosen
INSTALL_LLVM = "sudo apt-get install libllvm19"
INSTALL_ATOMIC = "sudo apt-get install libatomic1"

_LIBRARY_PLACES = (
    "/usr/lib/*-linux-gnu*/libLLVM*.so*",
    "/usr/lib/llvm-*/lib/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    "/usr/lib64/llvm*/lib*/libLLVM*.so*",
    "/usr/lib/libLLVM*.so*",
    "/usr/local/lib/libLLVM*.so*",
    "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
    "/usr/local/opt/llvm*/lib/libLLVM*.dylib",
)

_selected: str | None = None
_recorded: WeakSet[Any] = WeakSet()
_constants: dict[int, tuple[Any, Any]] = {}  # frozen dataclasses without arrays, by `id`: what `_split` told of them
_leaves: set[type] = set()  # types of arguments that Dr.Jit is left to look into


class BackendError(RuntimeError):
    """No backend can run here; the message says in one sentence what to install."""


@cache
def find_llvm() -> tuple[Path | None, str]:
    """(library, sentence): the newest libLLVM of version 19 or later, or None and what was found instead."""
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    if named:
        version = _library_version(Path(named))
        if version is None:
            return (
                None,
                f"DRJIT_LIBLLVM_PATH names {named}, which cannot be loaded as libLLVM {MINIMUM_LLVM} or newer",
            )
        if version < MINIMUM_LLVM:
            return None, f"DRJIT_LIBLLVM_PATH names libLLVM {version}, expected {MINIMUM_LLVM} or newer"
        return Path(named), f"libLLVM {version} at {named}"
    candidates = _candidates()
    for path, version in candidates:
        if version >= MINIMUM_LLVM and (_library_version(path) or 0) >= MINIMUM_LLVM:
            return path, f"libLLVM {version} at {path}"
    found = sorted({version for _, version in candidates})
    other = f"only version {', '.join(map(str, found))}" if found else "none"
    return None, f"libLLVM {MINIMUM_LLVM} or newer is needed, found {other}; type: {INSTALL_LLVM}"


def name_llvm() -> None:
    """Name the newest libLLVM in DRJIT_LIBLLVM_PATH, unless the user has named one. Judges by file names alone."""
    good = [path for path, version in _candidates() if version >= MINIMUM_LLVM]
    if good:
        os.environ.setdefault("DRJIT_LIBLLVM_PATH", str(good[0]))


@cache
def _candidates() -> list[tuple[Path, int]]:
    """(library, version by its name) in the usual places, newest first."""
    found: dict[Path, int] = {}
    for pattern in _LIBRARY_PLACES:
        for path in Path("/").glob(pattern.lstrip("/")):
            match = re.search(r"libLLVM(?:-|\.so\.|\.)?(\d+)", path.name)
            if match and path.exists() and _is_for_this_machine(path):
                found.setdefault(path.resolve(), int(match.group(1)))
    return sorted(found.items(), key=lambda item: (-item[1], str(item[0])))


def _is_for_this_machine(path: Path) -> bool:
    """An ELF file's class and machine are those of the interpreter: i386 libraries may lie beside those of x86-64."""
    try:
        with path.open("rb") as library, open(sys.executable, "rb") as interpreter:
            one, other = library.read(20), interpreter.read(20)
    except OSError:
        return False
    return other[:4] != b"\x7fELF" or (one[:6], one[18:]) == (other[:6], other[18:])


def _library_version(path: Path) -> int | None:
    """Major version that a libLLVM reports of itself; None where it does not load or is older than 16."""
    try:
        get_version = ctypes.CDLL(str(path)).LLVMGetVersion
    except (OSError, AttributeError):
        return None
    numbers = (ctypes.c_uint * 3)()
    get_version(*(ctypes.byref(numbers, 4 * i) for i in range(3)))
    return int(numbers[0])


def available() -> dict[str, str | None]:
    """{backend: None where it can run, else one sentence that says why not and what to type}."""
    library, sentence = find_llvm()
    dr = _load_drjit()
    reasons: dict[str, str | None] = {"cuda": None, "llvm": None}
    if not dr.has_backend(dr.JitBackend.CUDA):
        reasons["cuda"] = "no CUDA device answers; an NVIDIA GPU with driver 535 or newer is needed"
    if library is None:
        reasons["llvm"] = sentence
    elif not dr.has_backend(dr.JitBackend.LLVM):
        reasons["llvm"] = f"Dr.Jit cannot load {sentence}; import spacesim before drjit and mitsuba"
    return reasons


def _load_drjit() -> ModuleType:
    """drjit; BackendError in one sentence where a library that its wheel takes for granted is missing."""
    try:
        return importlib.import_module("drjit")
    except (ImportError, NameError) as error:  # drjit 1.5 trips over its own handler of the ImportError
        cause = error.__context__ if isinstance(error, NameError) else error
        hint = f"; type: {INSTALL_ATOMIC}" if "libatomic" in str(cause) else ""
        raise BackendError(f"Dr.Jit cannot be loaded ({cause}){hint}") from None


def select(name: str = "auto") -> str:
    """Choose the backend: "cuda", "llvm" or "auto" (CUDA if it can run, else LLVM). Returns "cuda" or "llvm".

    Chosen once in a process. Raises ValueError for another name, or for another backend than the one chosen before,
    and BackendError where it cannot run.
    """
    global _selected
    if name not in NAMES:
        raise ValueError(f"backend: expected one of {', '.join(NAMES)}, found {name!r}")
    if _selected is not None:
        if name not in ("auto", _selected):
            raise ValueError(f"backend: {_selected} has been chosen in this process, {name} cannot follow")
        return _selected
    reasons = available()
    wanted = ["cuda", "llvm"] if name == "auto" else [name]
    usable = [backend for backend in wanted if reasons[backend] is None]
    if not usable:
        raise BackendError("; ".join(f"{backend}: {reasons[backend]}" for backend in wanted))
    _selected = usable[0]
    return _selected


def mitsuba() -> ModuleType:
    """The mitsuba module with `cuda_ad_rgb` or `llvm_ad_rgb` set, unless the caller has set one of them before.

    Raises BackendError where another variant is set, which our records cannot be computed with.
    """
    name = select()
    import mitsuba as mi

    variant = mi.variant()
    if variant is None:
        mi.set_variant(f"{name}_ad_rgb")
    elif variant != f"{name}_ad_rgb":
        raise BackendError(f"mitsuba's variant is {variant}, expected {name}_ad_rgb or none set")
    return mi


def free_memory(wanted: int = 0) -> int | None:
    """Bytes that arrays may still take on the chosen backend; None where the system does not say. Where fewer than
    `wanted` are free, what Dr.Jit keeps of freed arrays, each for others of its size, goes back to the system first."""
    asked = main_memory if select() == "llvm" else device_memory
    free = asked()
    if free is not None and free < wanted:
        dr = _load_drjit()
        dr.sync_thread()
        dr.flush_malloc_cache()
        dr.sync_thread()  # only then CUDA lets go of it
        free = asked()
    return free


def check_free_memory(needed: int, what: str) -> None:
    """Raise MemoryError, in one sentence that begins with `what`, where fewer than `needed` bytes are free on the
    chosen backend."""
    free = free_memory(needed) if needed > LARGE else None
    if free is not None and needed > free:
        raise MemoryError(f"{what} needs about {needed / 1e9:.3g} GB of memory, {free / 1e9:.3g} GB are free")


def device_memory() -> int | None:
    """Bytes free on the first CUDA device, which Dr.Jit uses, by the driver; None where that does not say."""
    try:
        driver = ctypes.CDLL("nvcuda.dll" if os.name == "nt" else "libcuda.so.1")
    except OSError:
        return None
    context, free, total = ctypes.c_void_p(), ctypes.c_size_t(), ctypes.c_size_t()
    if driver.cuInit(0) or driver.cuDevicePrimaryCtxRetain(ctypes.byref(context), 0):
        return None
    failed = driver.cuCtxPushCurrent_v2(context)
    if not failed:
        failed = driver.cuMemGetInfo_v2(ctypes.byref(free), ctypes.byref(total))
        driver.cuCtxPopCurrent_v2(ctypes.byref(ctypes.c_void_p()))
    driver.cuDevicePrimaryCtxRelease_v2(0)
    return None if failed else free.value


def recorded(function: Callable[..., Any], limit: int) -> Callable[..., Any]:
    """`function` by `dr.freeze`: traced at its first call with arguments of a kind, replayed at the others.

    At most `limit` recordings are kept. Arguments may be arrays, numbers and texts, and tuples, lists, dicts and
    dataclasses of them. Dr.Jit 1.5 takes long to walk through these, knows an argument that occurs twice in a call by
    identity, and takes f(1, 2, 1) for f(1, 2, 2): it gets a flat list of the arrays and one text for all the rest. No
    array may stand in two places. What Dr.Jit's LLVM backend makes of a numpy array is numpy's own memory, whose
    kernels and recordings differ by whether it happens to begin at a multiple of 64 bytes: make arguments of lists, or
    copy them (`gaussians.uploaded`). Python's garbage collector waits during a call: arrays that it frees in the
    middle of a recording end the process.
    """
    import drjit as dr

    now, names = _Arguments(), _Names()
    frozen = dr.freeze(
        lambda _, arrays: function(*_joined(now.arguments, iter(arrays))),
        limit=limit,
        warn_after=2**31 - 1,  # who looks around for hours makes more recordings than are kept, and need not hear of it
    )
    _recorded.add(frozen)

    def call(*arguments: Any) -> Any:
        arrays: list[Any] = []
        name = names[_split(arguments, arrays)]
        now.arguments = arguments
        collecting = gc.isenabled()
        gc.disable()
        try:
            return frozen(name, arrays)
        finally:
            now.arguments = ()
            if collecting:
                gc.enable()

    return call


class _Arguments:
    """Of the call that may be traced now; to Dr.Jit an object that never changes."""

    arguments: tuple[Any, ...] = ()


class _Names(dict[Any, str]):
    """A text for each value of `_split`, short and never given twice; the values that came are forgotten when they are
    very many."""

    def __init__(self) -> None:
        self._numbers = itertools.count()

    def __missing__(self, told: Any) -> str:
        if len(self) >= MOST_KEYS:
            self.clear()
        name = self[told] = str(next(self._numbers))
        return name


_names_of_constants = _Names()


def _split(value: Any, arrays: list[Any]) -> Any:
    """All of `value` that is no array, as a key of dictionaries; its arrays are added to a list."""
    kind = type(value)
    if kind in _EQUAL_TO_INTEGERS:
        return kind, repr(value)
    if kind in _PLAIN:
        return value
    if kind is list and _leaves.issuperset(map(type, value)):
        arrays.extend(value)
        return kind, len(value)
    if kind is list or kind is tuple:
        told = _split_each(value, arrays)
        new = kind is list and all(part is ... for part in told)  # of a type that is in `_leaves` from now on
        return kind, len(told) if new else told
    if kind is dict:
        return kind, tuple(value), _split_each(value.values(), arrays)
    known = _constants.get(id(value))
    if known is not None:
        return known[1]
    names = _names(kind)  # type: ignore[arg-type]
    if names is not None:
        before = len(arrays)
        told = _split_each([getattr(value, name) for name in names], arrays)
        if len(arrays) > before or not _is_constant(value):
            return kind, told
        if len(_constants) >= MOST_KEYS:
            _constants.clear()
        _constants[id(value)] = value, (kind, _names_of_constants[told])
        return _constants[id(value)][1]
    _leaves.add(kind)
    arrays.append(value)
    return ...


def _is_constant(value: Any) -> bool:
    """A dataclass whose fields stay as they are: frozen, and without lists and dicts."""
    try:
        hash(value)
    except TypeError:
        return False
    return bool(type(value).__dataclass_params__.frozen)


def _split_each(values: Iterable[Any], arrays: list[Any]) -> tuple[Any, ...]:
    told = []
    for value in values:
        kind = type(value)
        if kind in _leaves:  # as most are
            arrays.append(value)
            told.append(...)
        elif kind is int:
            told.append(value)
        else:
            told.append(_split(value, arrays))
    return tuple(told)


def _joined(value: Any, arrays: Iterator[Any]) -> Any:
    """`value` with `arrays` in place of its own, in the order of `_split`."""
    kind = type(value)
    if kind in _PLAIN:
        return value
    if kind is list or kind is tuple:
        return kind(_joined(one, arrays) for one in value)
    if kind is dict:
        return {key: _joined(one, arrays) for key, one in value.items()}
    names = _names(kind)  # type: ignore[arg-type]
    if names is None:
        return next(arrays)
    copy = object.__new__(kind)
    for name in names:
        object.__setattr__(copy, name, _joined(getattr(value, name), arrays))
    return copy


@cache
def _names(kind: Any) -> tuple[str, ...] | None:
    """Of a dataclass's fields; None for any other type."""
    return tuple(field.name for field in fields(kind)) if is_dataclass(kind) else None


def recordings() -> int:
    """How many recordings the functions of `recorded` that are alive have made: once warm, it stands still."""
    return sum(frozen.n_recordings for frozen in _recorded)


class _Arrays:
    """Dr.Jit's differentiable array types of the chosen backend, looked up at first use."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        value = getattr(importlib.import_module(f"drjit.{select()}.ad"), name)
        setattr(self, name, value)
        return value


ad: Any = _Arrays()
