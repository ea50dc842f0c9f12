"""Gaussians as columns of the matrices that networks read and write, in few sizes."""

from dataclasses import dataclass
from typing import Any

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Bool, Float, TensorXf, UInt32
from spacesim.backend.upload import held
from spacesim.splat.raster.lists.tiles import round_capacity

CHUNK = 512  #: columns of a chunk, of which `round_capacity` is a multiple: 100,000 Gaussians fill a GPU


@dataclass
class PaddedBatch:
    """N Gaussians in `capacity` columns M >= N: matrices come in few sizes, and each is recorded once.

    The columns of a matrix of C rows lie in B = M / m chunks of m = `CHUNK`, each a matrix of its own: TensorXf [B, C,
    m]. A sum over all columns is then B short ones, made at once, and one over these (`mlp.backward`).

    Arrays [N] are gathered into columns first, and all is computed there: to gather what was computed takes a kernel
    for each. In a recording the size of a kernel follows that of an array that it reads, first of one that it does
    not read by index: where that is `count`, it is as many times as wide as it was, so M; elsewhere hence `like`.
    """

    count: UInt32  #: UInt32 of width 1, N
    capacity: int
    room: UInt32  #: UInt32 of width 1, M where it may be no number of a kernel's text, as each would be compiled

    @staticmethod
    def of(count: int, still: bool = False) -> "PaddedBatch":
        """For N = `count` Gaussians, at least one. still: of a model of constant size, with less padding."""
        capacity = (count // CHUNK + 1) * CHUNK if still else round_capacity(count)
        return PaddedBatch(held(count, "columns"), capacity, held(capacity, "room"))

    def is_real(self) -> Bool:
        """Bool [M]: whether a column is a Gaussian's."""
        return self._column() < self.count

    def repeat_last(self, values: Any) -> Any:
        """[N] to [M], an array or nested ones; the last is repeated."""
        return dr.gather(type(values), values, dr.minimum(self._column(), self.count - 1))

    def pad_zeros(self, row: Float) -> Float:
        """[N] to [M], 0 beyond N."""
        return dr.gather(ad.Float, row, self._column(), self.is_real())

    def block(self, packed: Float, first: int, rows: int) -> list[Float]:
        """Some rows of a packed array [C * N], [M] each."""
        column = dr.minimum(self._column(), self.count - 1)
        return [dr.gather(ad.Float, packed, (first + i) * self.count + column) for i in range(rows)]

    def matrix(self, rows: list[Float], height: int | None = None) -> TensorXf:
        """TensorXf [B, C, m] of rows [M], or one number for all, in one kernel. height: C, the rows that are missing
        are 0; by default as many as there are."""
        height = len(rows) if height is None else height
        numbers = dr.empty(ad.Float, height * self.capacity)
        for i in range(height):
            row = rows[i] if i < len(rows) else ad.Float(0)
            dr.scatter(numbers, row, self._matrix_index(self._column(), i, height), mode=dr.ReduceMode.Permute)
        return ad.TensorXf(numbers, (self.capacity // CHUNK, height, CHUNK))

    def unpad(self, rows: list[Float], like: Float) -> list[Float]:
        """Rows [M], evaluated, to [N]. like: any array [N]."""
        column = dr.arange(ad.UInt32, dr.width(like))
        is_real = column < self.count
        return [dr.select(is_real, dr.gather(ad.Float, row, column), like) for row in rows]

    def pack(self, parts: list[tuple[TensorXf, int, int]], like: Float) -> Float:
        """Float [C * N], packed, of parts (TensorXf [B, R, m], first row, rows), one under another. like: an array."""
        place = dr.arange(ad.UInt32, dr.width(like))
        row, column = place // self.count, place % self.count
        result, before = like, 0
        for columns, first, rows in parts:
            mine = (row >= before) & (row < before + rows)
            index = self._matrix_index(column, row - before + first, columns.shape[1])
            result = dr.select(mine, dr.gather(ad.Float, columns.array, index, mine), result)
            before += rows
        return result

    def _column(self) -> UInt32:
        return dr.arange(ad.UInt32, self.capacity)

    @staticmethod
    def _matrix_index(column: UInt32, row: UInt32 | int, height: int) -> UInt32:
        """Where a matrix of `height` rows has this row of this column."""
        return ((column // CHUNK) * height + row) * CHUNK + column % CHUNK
