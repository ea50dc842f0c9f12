"""Gradients of splats from the sums of their pairs: `adjoint._gather_slots` on a CPU, as text for LLVM.

A thread goes through a splat's slots by itself, a pair's numbers side by side in registers. Dr.Jit's lanes, a splat
each, wait for the longest of sixteen, and turn the numbers around.
"""

import math
from functools import cache, partial

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Float
from spacesim.backend.kernels.llvm import LlvmKernel, empty
from spacesim.backend.kernels.llvm_text import Text
from spacesim.backend.packet import packet_sizes
from spacesim.splat.raster.lists.tiles import TileLists
from spacesim.splat.raster.project import Splats

#: splats of a task, whose slots, 100 kB or so, are all asked for before they are added: to wait for each took half as
#: long again
BLOCK = 256
SHAPE = ("x", "y", "a", "b", "c", "opacity")  #: that have gradients


def add_slots(
    slots: list[Float], splats: Splats, lists: TileLists, channels: int, absolute: bool
) -> list[Float] | None:
    """Gradients by `SHAPE`, features and, if `absolute`, sums of |d / d x| and |d / d y|, [N] each; None where it is
    Dr.Jit's to add. slots: as `adjoint._gather_slots` takes them"""
    count, of_splats = dr.width(splats.x), [splats.a, splats.b, splats.c, splats.opacity]
    if lists.place is None or any(dr.width(row) != count for row in of_splats):
        return None
    results = [empty(ad.Float, count) for _ in range(len(SHAPE) + channels + 2 * absolute)]
    arrays = [lists.first_slot, lists.slot_count, lists.place, *slots, *of_splats, *results]
    _kernel(channels, absolute)([-(-count // BLOCK)], arrays, [count])
    return results


@cache
def _kernel(channels: int, absolute: bool) -> LlvmKernel:
    sizes = packet_sizes(6 + 2 * absolute + channels)
    names = [*SHAPE, *[f"feature{i}" for i in range(channels)], *["absolute_x", "absolute_y"][: 2 * absolute]]
    arrays = ["first_slot", "slot_count", "place", *[f"slots{i}" for i in range(len(sizes))]]
    arrays += ["splat_a", "splat_b", "splat_c", "splat_opacity", *names]
    return LlvmKernel(arrays, ["count"], ("add", partial(_write, sizes, channels, absolute)))


def _write(sizes: list[int], channels: int, absolute: bool, text: Text) -> None:
    start = text.index * BLOCK
    end = (start + BLOCK).least(text.number("count"))
    with text.loop(start, end) as ahead:
        first = text.load("first_slot", ahead.at)
        with text.loop(first, first + text.load("slot_count", ahead.at)) as of_splat:
            pair = text.load("place", of_splat.at)
            for i, size in enumerate(sizes):
                text.prefetch(f"slots{i}", pair * size)
    with text.loop(start, end) as splats:
        splat = splats.at
        first = text.load("first_slot", splat)
        with text.loop(first, first + text.load("slot_count", splat), [text.zeros(size) for size in sizes]) as of_splat:
            pair = text.load("place", of_splat.at)
            of_splat.following = [
                total + text.load_floats(f"slots{i}", pair * size, size)
                for i, (size, total) in enumerate(zip(sizes, of_splat.state, strict=True))
            ]
        s0, sx, sy, sxx, sxy, syy, *rest = (
            total.entry(i) for size, total in zip(sizes, of_splat.state, strict=True) for i in range(size)
        )
        a, b, c, opacity = (text.load_floats(f"splat_{name}", splat) for name in ("a", "b", "c", "opacity"))
        values = {
            "x": text.fma(a, sx, b * sy),
            "y": text.fma(b, sx, c * sy),
            "a": sxx * -0.5,
            "b": -sxy,
            "c": syy * -0.5,
            "opacity": s0 * (text.one_float(1) / text.maximum(opacity, text.one_float(1e-30))),
        }
        if absolute:
            for name in ("absolute_x", "absolute_y"):
                values[name] = rest.pop(0) * math.log(2)  # records are in units of log2 e
        values |= {f"feature{i}": rest[i] for i in range(channels)}
        for name, value in values.items():
            text.store(name, splat, value)
