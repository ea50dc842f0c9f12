"""Records in the order of the lists: `records.list_records` on a CPU, as text for LLVM.

Dr.Jit's lanes would take each record apart, and put it together again.
"""

from functools import cache, partial

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Float
from spacesim.backend.kernels.llvm import LlvmKernel, empty, is_usable
from spacesim.backend.kernels.llvm_text import Text
from spacesim.splat.raster.lists.tiles import TileLists

BLOCK = 2048  #: pairs of a task


def copy_records(packed: list[Float], lists: TileLists, capacity: int) -> list[Float] | None:
    """Those of each pair of the lists, without meaning behind the last list; None where it is Dr.Jit's to copy.

    packed: of `pack_records`, with this capacity
    """
    if lists.place is None or not is_usable():
        return None
    sizes = tuple(dr.width(array) // capacity for array in packed)
    copies = [empty(ad.Float, size * lists.capacity) for size in sizes]
    last = lists.tiles_x * lists.tiles_y - 1
    _kernel(sizes)([-(-lists.capacity // BLOCK)], [lists.splat, lists.end, *packed, *copies], [last])
    return copies


@cache
def _kernel(sizes: tuple[int, ...]) -> LlvmKernel:
    arrays = ["splat", "end", *[f"{name}{i}" for name in ("record", "copy") for i in range(len(sizes))]]
    return LlvmKernel(arrays, ["last"], ("copy", partial(_write, sizes)))


def _write(sizes: tuple[int, ...], text: Text) -> None:
    start, listed = text.index * BLOCK, text.load("end", text.number("last"))
    with text.loop(start, (start + BLOCK).least(listed)) as pairs:
        splat = text.load("splat", pairs.at)
        for i, size in enumerate(sizes):
            text.store(f"copy{i}", pairs.at * size, text.load_floats(f"record{i}", splat * size, size))
