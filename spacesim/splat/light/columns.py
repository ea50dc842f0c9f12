"""Gaussians as columns of the matrices that networks read and write, in few sizes."""

from dataclasses import dataclass
from typing import Any

import drjit as dr

from spacesim.backend import ad
from spacesim.splat.raster.bin import room

CHUNK = 512  #: columns of a chunk, of which `room` is a multiple: 100,000 Gaussians are chunks enough to fill a GPU
ALIGNED = 4  #: rows of matrices are a multiple of it


@dataclass
class Lanes:
    """N Gaussians in `capacity` columns M >= N: matrices come in few sizes, and each is recorded once. count: UInt32 of
    width 1, N.

    The columns of a matrix of C rows lie in B = M / m chunks of m = `CHUNK`, each a matrix of its own: TensorXf
    [B, C, m]. A sum over all columns is then B short ones, made at once, and one over these (`mlp.backward`).

    Arrays [N] are gathered into columns first, and all is computed there: to gather what was computed takes a kernel
    for each. In a recording the size of a kernel follows that of an array that it reads, first of one that it does not
    read by index: where that is `count`, it is as many times as wide as it was, so M; elsewhere hence `like`.
    """

    count: Any
    capacity: int

    @staticmethod
    def of(count: int, still: bool = False) -> "Lanes":
        """For N = `count` Gaussians, at least one. still: of a model that stays as large as it is, with less room."""
        return Lanes(dr.opaque(ad.UInt32, count), (count // CHUNK + 1) * CHUNK if still else room(count))

    def spread(self, values: Any) -> Any:
        """[N] to [M], an array or nested ones; the last is repeated."""
        return dr.gather(type(values), values, dr.minimum(self._lane(), self.count - 1))

    def padded(self, row: Any) -> Any:
        """[N] to [M], 0 beyond N."""
        lane = self._lane()
        return dr.gather(ad.Float, row, lane, lane < self.count)

    def block(self, packed: Any, first: int, rows: int) -> list[Any]:
        """Some rows of a packed array [C * N], [M] each."""
        lane = dr.minimum(self._lane(), self.count - 1)
        return [dr.gather(ad.Float, packed, (first + i) * self.count + lane) for i in range(rows)]

    def matrix(self, rows: list[Any], height: int | None = None) -> Any:
        """TensorXf [B, C, m] of rows [M], or one number for all, in one kernel. height: C, the rows that are missing
        are 0; by default as many as there are."""
        height = len(rows) if height is None else height
        numbers = dr.empty(ad.Float, height * self.capacity)
        for i in range(height):
            row = rows[i] if i < len(rows) else ad.Float(0)
            dr.scatter(numbers, row, self._place(self._lane(), i, height), mode=dr.ReduceMode.Permute)
        return ad.TensorXf(numbers, (self.capacity // CHUNK, height, CHUNK))

    def row(self, columns: Any, i: int) -> Any:
        """Row i [M] of a TensorXf [B, C, m]."""
        return dr.gather(ad.Float, columns.array, self._place(self._lane(), i, columns.shape[1]))

    def narrowed(self, rows: list[Any], like: Any) -> list[Any]:
        """Rows [M], evaluated, to [N]. like: any array [N]."""
        lane = dr.arange(ad.UInt32, dr.width(like))
        known = lane < self.count
        return [dr.select(known, dr.gather(ad.Float, row, lane), like) for row in rows]

    def packed(self, parts: list[tuple[Any, int, int]], like: Any) -> Any:
        """Float [C * N], packed, of parts (TensorXf [B, R, m], first row, rows), one under another. like: an array."""
        place = dr.arange(ad.UInt32, dr.width(like))
        row, lane = place // self.count, place % self.count
        found, before = like, 0
        for columns, first, rows in parts:
            mine = (row >= before) & (row < before + rows)
            index = self._place(lane, row - before + first, columns.shape[1])
            found = dr.select(mine, dr.gather(ad.Float, columns.array, index, mine), found)
            before += rows
        return found

    def _lane(self) -> Any:
        return dr.arange(ad.UInt32, self.capacity)

    @staticmethod
    def _place(lane: Any, row: Any, height: int) -> Any:
        """Where a matrix of `height` rows has this row of this column."""
        return ((lane // CHUNK) * height + row) * CHUNK + lane % CHUNK


def aligned(rows: int) -> int:
    """`rows` rounded up to what matrix products are fast at: Dr.Jit 1.5 reads four numbers at once on CUDA where rows
    of memory allow it, and works in tiles of 64 x 64 instead of 8 x 8."""
    return -(-rows // ALIGNED) * ALIGNED
