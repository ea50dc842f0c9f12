"""Memory that nothing needs any more goes back to the system, or hours of looking around would take more and more.

Nothing is lost without this, but what is free lies scattered: Dr.Jit keeps arrays that were freed for others of their
size, and the C library keeps what lies between pieces in use. New kernels, one for each new size of a picture or its
lists, are compiled in between, and holes grow by tens of megabytes within minutes (docs/research/viewer.md).
"""

import ctypes
from collections.abc import Callable
from functools import cache

import drjit as dr


def give_back() -> None:
    """To be called on the thread that draws. Takes milliseconds; so does the next picture, which asks for its memory
    again."""
    dr.flush_malloc_cache()
    trim = _trim()
    if trim is not None:
        trim(0)


@cache
def _trim() -> Callable[[int], int] | None:
    """glibc's malloc_trim; None where the C library is another one, whose allocator does so by itself."""
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):
        return None
    trim.argtypes, trim.restype = [ctypes.c_size_t], ctypes.c_int
    return trim
