"""Where instructions of a kernel stand."""

import drjit as dr

from spacesim.backend.selection import select


def new_block() -> None:
    """On LLVM, keep what is computed from here on behind what has been computed before, in a kernel's text.

    Dr.Jit writes a kernel's instructions output by output, each with all that it needs: numbers that several outputs
    need wait in memory until the last is written. In blocks each is used where it has been computed. Results are the
    same to the bit."""
    if select() == "llvm":
        dr.detail.new_scope(dr.JitBackend.LLVM)
