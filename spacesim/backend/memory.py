"""How much memory the process may still take, on the machine and on the device: asked before much of it is taken. And
what becomes of memory that it frees."""

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from spacesim.backend.selection import load_drjit, select

CUDA_DRIVER = "nvcuda.dll" if os.name == "nt" else "libcuda.so.1"
LARGE = 1 << 28  #: bytes below which free memory is not checked: checking it reads files of the system
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of glibc's `mallopt`
_KEPT, _LARGEST_KEPT = 1 << 30, 1 << 25  # bytes: freed in all, and of an array, of which older glibc allow no more


def keep_freed_memory() -> None:
    """Have this process keep what it frees for what it needs next. By itself glibc gives large arrays back to the
    system, and each page of the next ones is a fault: of a frame of 512 x 512 pixels 8,000, a sixth of the time that it
    takes to encode, and more where many processes ask. Does nothing where there is no glibc."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            mallopt = ctypes.CDLL(None).mallopt
            mallopt(_TRIM_THRESHOLD, _KEPT)
            mallopt(_MMAP_THRESHOLD, _LARGEST_KEPT)


def check_memory(needed: int, what: str) -> None:
    """Raise MemoryError, in one sentence that begins with `what`, where fewer than `needed` bytes of main memory are
    free. Systems let a process take more than there is and end it later, without a word."""
    free = main_memory() if needed > LARGE else None
    if free is not None and needed > free:
        raise MemoryError(f"{what} needs about {needed / 1e9:.3g} GB of memory, {free / 1e9:.3g} GB are free")


def main_memory(root: Path = Path("/")) -> int | None:
    """Bytes of main memory that the process may still take; None where the system does not say (not Linux).

    What the machine has free, or less where a container, a batch system or `ulimit -v` allows the process less. root:
    where the machine's files are
    """
    free = _known_numbers(root / "proc/meminfo").get("MemAvailable:")
    return None if free is None else min([1024 * free, *_left_by_groups(root), *_left_by_limit(root)])


def _left_by_limit(root: Path) -> Iterator[int]:
    """Bytes that the limit of the address space leaves, if there is one."""
    if os.name != "posix":
        return
    import resource

    most, taken = resource.getrlimit(resource.RLIMIT_AS)[0], _known_numbers(root / "proc/self/status").get("VmSize:")
    if most != resource.RLIM_INFINITY and taken is not None:
        yield max(most - 1024 * taken, 0)


def _left_by_groups(root: Path) -> Iterator[int]:
    """Bytes that each control group of this process leaves (cgroups(7), both versions). Files that were read once, and
    that the kernel drops when memory is short, do not count as used."""
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return
    first = "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"
    second = "memory.max", "memory.current", "inactive_file"
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers not in ("", "memory"):
            continue
        mount = root / "sys/fs/cgroup" / controllers
        most, used, dropped = first if controllers else second
        group_path = mount / path.strip("/")  # in a container that is the mount itself, whatever its path outside
        for group in (group_path, *group_path.parents):
            if not group.is_relative_to(mount):
                break
            try:
                left = int((group / most).read_text()) - int((group / used).read_text())
            except (OSError, ValueError):  # no such group here, or no limit
                continue
            yield max(left + _known_numbers(group / "memory.stat").get(dropped, 0), 0)


def _known_numbers(path: Path) -> dict[str, int]:
    """{name: number} of a file with a name and a number in each line; {} where it cannot be read."""
    try:
        rows = [line.split() for line in path.read_text().splitlines()]
    except OSError:
        return {}
    return {row[0]: int(row[1]) for row in rows if len(row) > 1 and row[1].isdigit()}


def free_memory(needed: int = 0) -> int | None:
    """Bytes that arrays may still take on the chosen backend; None where the system does not say. Where fewer than
    `needed` are free, what Dr.Jit keeps of freed arrays, each for others of its size, goes back to the system first."""
    measure = main_memory if select() == "llvm" else device_memory
    free = measure()
    if free is not None and free < needed:
        dr = load_drjit()
        dr.sync_thread()
        dr.flush_malloc_cache()
        dr.sync_thread()  # only then CUDA lets go of it
        free = measure()
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
        driver = ctypes.CDLL(CUDA_DRIVER)
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
