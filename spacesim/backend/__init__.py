"""Floor 0: which Dr.Jit backend runs, memory, and functions that are recorded."""

from spacesim.backend.llvm import find_llvm, name_llvm
from spacesim.backend.memory import check_free_memory, device_memory, free_memory, main_memory
from spacesim.backend.recording import RECORDINGS, Recorded, recorded, recordings
from spacesim.backend.selection import NAMES, BackendError, ad, available, mitsuba, select

__all__ = [
    "NAMES",
    "RECORDINGS",
    "BackendError",
    "Recorded",
    "ad",
    "available",
    "check_free_memory",
    "device_memory",
    "find_llvm",
    "free_memory",
    "main_memory",
    "mitsuba",
    "name_llvm",
    "recorded",
    "recordings",
    "select",
]
