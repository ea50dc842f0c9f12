"""Matrices by packets along their rows: a thread reads and writes some columns at once.

On LLVM what a kernel gives as its result goes past the caches, to memory, from where the next reads it again (Dr.Jit
1.5 stores it so); packets stay in them: two cores with AVX2 take a fifth less time for a layer.
"""

from typing import Any

import drjit as dr

from spacesim.backend import ad, select
from spacesim.backend.arrays import Float, TensorXf
from spacesim.backend.packet import PACKETS, gather_packet

SIZE = {name: sizes[-1] for name, sizes in PACKETS.items()}  #: columns that a thread reads at once


class Packets:
    """The numbers of B matrices [C, m] by packets along their columns, a thread each.

    shape: (B, C, m), m a multiple of `size`, the columns of a packet

    Of each thread `matrix` and `row` say where its packet is, `within` which of the row's it is.
    """

    def __init__(self, shape: tuple[int, ...], size: int) -> None:
        matrices, rows, m = shape
        assert m % size == 0, "packets are whole"
        self.shape, self.size, self._across = shape, size, m // size
        self._entry = dr.arange(ad.UInt32, matrices * rows * self._across)
        self.matrix, self.within = self._entry // (rows * self._across), self._entry % self._across
        self.row = self._entry // self._across % rows

    def load(self, values: TensorXf) -> Any:
        """Of a TensorXf [B, C, m]: `size` Floats, an Array4f or an ArrayXf."""
        return gather_packet(values.array, self._entry, self.size)

    def load_row(self, values: TensorXf, row: int) -> Any:
        """What stands above or below in a row of a TensorXf [B, any, m]."""
        place = (self.matrix * values.shape[1] + row) * self._across + self.within
        return gather_packet(values.array, place, self.size)

    def store(self, values: Any) -> TensorXf:
        """TensorXf [B, C, m]."""
        matrices, rows, m = self.shape
        numbers = dr.empty(ad.Float, matrices * rows * m)
        dr.scatter(numbers, values, self._entry, mode=dr.ReduceMode.NoConflicts)
        return ad.TensorXf(numbers, self.shape)


def activated(values: TensorXf, bias: Float) -> TensorXf:
    """ReLU of a TensorXf [B, C, m] and a bias [C]."""
    at = Packets(values.shape, SIZE[select()])
    return at.store(dr.maximum(at.load(values) + dr.gather(ad.Float, bias, at.row), 0))


def masked(gradient: TensorXf, values: TensorXf) -> TensorXf:
    """A gradient, TensorXf [B, C, m], where `values` are above 0; 0 elsewhere."""
    at = Packets(values.shape, SIZE[select()])
    return at.store(dr.select(at.load(values) > 0, at.load(gradient), 0))
