"""Which Dr.Jit backend runs, chosen once in a process: CUDA where a device works, else LLVM on the CPU.

`ad` names Dr.Jit's array types of the chosen backend (`ad.Float`, `ad.Array3f`, ...); the first use chooses, if
`select` has not.
"""

import importlib
from types import ModuleType
from typing import TYPE_CHECKING, Any

from spacesim.backend.llvm import find_llvm

NAMES = ("auto", "cuda", "llvm")
INSTALL_ATOMIC = "sudo apt-get install libatomic1"
_selected: str | None = None


class BackendError(RuntimeError):
    """No backend can run here; the message says in one sentence what to install."""


def available() -> dict[str, str | None]:
    """{backend: None where it can run, else one sentence that says why not and what to type}."""
    library, sentence = find_llvm()
    dr = load_drjit()
    reasons: dict[str, str | None] = {"cuda": None, "llvm": None}
    if not dr.has_backend(dr.JitBackend.CUDA):
        reasons["cuda"] = "no CUDA device answers; an NVIDIA GPU with driver 535 or newer is needed"
    if library is None:
        reasons["llvm"] = sentence
    elif not dr.has_backend(dr.JitBackend.LLVM):
        reasons["llvm"] = f"Dr.Jit cannot load {sentence}; import spacesim before drjit and mitsuba"
    return reasons


def load_drjit() -> ModuleType:
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
    candidates = ["cuda", "llvm"] if name == "auto" else [name]
    usable = [backend for backend in candidates if reasons[backend] is None]
    if not usable:
        raise BackendError("; ".join(f"{backend}: {reasons[backend]}" for backend in candidates))
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


class _Arrays:
    """Dr.Jit's differentiable array types of the chosen backend, looked up at first use."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        value = getattr(importlib.import_module(f"drjit.{select()}.ad"), name)
        setattr(self, name, value)
        return value


if TYPE_CHECKING:
    import drjit.auto.ad as ad  # the same types, whichever backend they are of
else:
    ad = _Arrays()
