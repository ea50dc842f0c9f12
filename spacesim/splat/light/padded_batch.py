"""Gaussians as columns of the matrices that networks read and write, in few sizes."""

from dataclasses import dataclass
from typing import Any

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Bool, Float, TensorXf, UInt32
from spacesim.backend.upload import held
from spacesim.learning.networks.network import CHUNK
from spacesim.splat.raster.lists.boxes import divided
from spacesim.splat.raster.lists.tiles import round_capacity
from spacesim.splat.raster.seen import Chosen


@dataclass
class PaddedBatch:
    """N Gaussians in `capacity` columns M >= N: matrices come in few sizes, and each is recorded once. With `chosen`
    the columns are these alone, M >= K, and what goes back to all Gaussians is 0 for the others.

    The columns of a matrix of C rows lie in B = M / m chunks of m = `CHUNK`, each a matrix of its own: TensorXf [B, C,
    m]. A sum over all columns is then B short ones, made at once, and one over these (`mlp.backward`).

    Arrays [N] are gathered into columns first, and all is computed there: to gather what was computed takes a kernel
    for each. In a recording the size of a kernel follows that of an array that it reads, first of one that it does
    not read by index: where that is `count`, it is as many times as wide as it was, so M; elsewhere hence `like`.
    """

    count: UInt32  #: UInt32 of width 1, N
    capacity: int
    room: UInt32  #: UInt32 of width 1, M where it may be no number of a kernel's text, as each would be compiled
    chosen: Chosen | None = None  #: None: all

    @staticmethod
    def of(count: int, still: bool = False) -> "PaddedBatch":
        """For N = `count` Gaussians, at least one. still: of a model of constant size, with less padding."""
        capacity = (count // CHUNK + 1) * CHUNK if still else round_capacity(count)
        return PaddedBatch(held(count, "columns"), capacity, held(capacity, "room"))

    @staticmethod
    def of_chosen(chosen: Chosen, room: int, among: int) -> "PaddedBatch":
        """For these of N = `among` Gaussians, in `room` columns: of more the first ones."""
        return PaddedBatch(held(among, "columns"), room, held(room, "room"), chosen)

    @staticmethod
    def with_room_for(columns: int, count: UInt32, chosen: Chosen | None = None) -> "PaddedBatch":
        """Of so many columns, rounded up, in a recording. count: N"""
        capacity = -(-columns // CHUNK) * CHUNK
        return PaddedBatch(count, capacity, ad.UInt32(capacity), chosen)

    @property
    def used(self) -> UInt32:
        """Columns that are a Gaussian's, of width 1."""
        return dr.minimum(self.chosen.count, self.room) if self.chosen else self.count

    def is_real(self) -> Bool:
        """Bool [M]: whether a column is a Gaussian's."""
        return self._column() < self.used

    def numbers(self) -> UInt32:
        """[M]: of each column's Gaussian; the last is repeated."""
        column = dr.minimum(self._column(), self.used - 1)
        return dr.gather(ad.UInt32, self.chosen.numbers, column) if self.chosen else column

    def repeat_last(self, values: Any) -> Any:
        """[N] to [M], an array or nested ones; the last is repeated."""
        return dr.gather(type(values), values, self.numbers())

    def pad_zeros(self, row: Float) -> Float:
        """[N] to [M], 0 beyond N."""
        return dr.gather(ad.Float, row, self.numbers() if self.chosen else self._column(), self.is_real())

    def block(self, packed: Float, first: int, rows: int) -> list[Float]:
        """Some rows of a packed array [C * N], [M] each."""
        number = self.numbers()
        return [dr.gather(ad.Float, packed, (first + i) * self.count + number) for i in range(rows)]

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
        number = dr.arange(ad.UInt32, dr.width(like))
        is_real = number < self.count
        if self.chosen is None:
            return [dr.select(is_real, dr.gather(ad.Float, row, number), like) for row in rows]
        place = self.chosen.place_of(number)
        is_chosen = place < self.used
        return [dr.select(is_real, dr.gather(ad.Float, row, place, is_chosen), like) for row in rows]

    def pack(self, parts: list[tuple[TensorXf, int, int]], like: Float) -> Float:
        """Float [C * N], packed, of parts (TensorXf [B, R, m], first row, rows), one under another. like: an array."""
        place = dr.arange(ad.UInt32, dr.width(like))
        row, column = divided(place, self.count)
        is_chosen = ad.Bool(True)
        if self.chosen:
            column = self.chosen.place_of(column)
            is_chosen = column < self.used
        result, before = like, 0
        for columns, first, rows in parts:
            mine = (row >= before) & (row < before + rows)
            index = self._matrix_index(column, row - before + first, columns.shape[1])
            result = dr.select(mine, dr.gather(ad.Float, columns.array, index, mine & is_chosen), result)
            before += rows
        return result

    def _column(self) -> UInt32:
        return dr.arange(ad.UInt32, self.capacity)

    @staticmethod
    def _matrix_index(column: UInt32, row: UInt32 | int, height: int) -> UInt32:
        """Where a matrix of `height` rows has this row of this column."""
        return ((column // CHUNK) * height + row) * CHUNK + column % CHUNK
