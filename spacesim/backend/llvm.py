"""A libLLVM that Dr.Jit can use: it takes the first that it finds, when it is imported, and versions before 19 abort
the whole process. So the package, when it is imported, names a good one in DRJIT_LIBLLVM_PATH."""

import ctypes
import os
import re
import sys
from functools import cache
from pathlib import Path

MIN_LLVM = 19
INSTALL_LLVM = "sudo apt-get install libllvm19"
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


@cache
def find_llvm() -> tuple[Path | None, str]:
    """(library, sentence): the newest libLLVM of version 19 or later, or None and what was found instead."""
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    if named:
        version = _library_version(Path(named))
        if version is None:
            return (
                None,
                f"DRJIT_LIBLLVM_PATH names {named}, which cannot be loaded as libLLVM {MIN_LLVM} or newer",
            )
        if version < MIN_LLVM:
            return None, f"DRJIT_LIBLLVM_PATH names libLLVM {version}, expected {MIN_LLVM} or newer"
        return Path(named), f"libLLVM {version} at {named}"
    candidates = _candidates()
    for path, version in candidates:
        if version >= MIN_LLVM and (_library_version(path) or 0) >= MIN_LLVM:
            return path, f"libLLVM {version} at {path}"
    versions = sorted({version for _, version in candidates})
    other = f"only version {', '.join(map(str, versions))}" if versions else "none"
    return None, f"libLLVM {MIN_LLVM} or newer is needed, found {other}; type: {INSTALL_LLVM}"


def name_llvm() -> None:
    """Name the newest libLLVM in DRJIT_LIBLLVM_PATH, unless the user has named one. Only file names are looked at."""
    good = [path for path, version in _candidates() if version >= MIN_LLVM]
    if good:
        os.environ.setdefault("DRJIT_LIBLLVM_PATH", str(good[0]))


@cache
def _candidates() -> list[tuple[Path, int]]:
    """(library, version by its name) in the usual places, newest first."""
    by_path: dict[Path, int] = {}
    for pattern in _LIBRARY_PLACES:
        for path in Path("/").glob(pattern.lstrip("/")):
            match = re.search(r"libLLVM(?:-|\.so\.|\.)?(\d+)", path.name)
            if match and path.exists() and _is_for_this_machine(path):
                by_path.setdefault(path.resolve(), int(match.group(1)))
    return sorted(by_path.items(), key=lambda item: (-item[1], str(item[0])))


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
