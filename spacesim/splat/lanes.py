"""Gaussians as columns of the matrices that networks read and write, in few sizes."""

from dataclasses import dataclass
from typing import Any

import drjit as dr

from spacesim.backend import ad
from spacesim.splat.tiles import room


@dataclass
class Lanes:
    """N Gaussians in `capacity` columns M >= N: matrices come in few sizes, and each is recorded once. count: UInt32 of
    width 1, N.

    Arrays [N] are gathered into columns first, and all is computed there: to gather what was computed takes a kernel
    for each. In a recording the size of a kernel follows that of an array that it reads: hence `like`.
    """

    count: Any
    capacity: int

    @staticmethod
    def of(count: int) -> "Lanes":
        """For N = `count` Gaussians, at least one."""
        return Lanes(dr.opaque(ad.UInt32, count), room(count))

    def spread(self, values: Any) -> Any:
        """[N] to [M], an array or nested ones; the last is repeated."""
        return dr.gather(type(values), values, dr.minimum(dr.arange(ad.UInt32, self.capacity), self.count - 1))

    def padded(self, row: Any) -> Any:
        """[N] to [M], 0 beyond N."""
        lane = dr.arange(ad.UInt32, self.capacity)
        return dr.gather(ad.Float, row, lane, lane < self.count)

    def block(self, packed: Any, first: int, rows: int) -> Any:
        """Some rows of a packed array [C * N], one after another in columns: Float [rows * M]."""
        place = dr.arange(ad.UInt32, rows * self.capacity)
        row, lane = place // self.capacity, place % self.capacity
        return dr.gather(ad.Float, packed, (first + row) * self.count + dr.minimum(lane, self.count - 1))

    def matrix(self, blocks: list[Any]) -> Any:
        """TensorXf [C, M] of rows [M] (or one number for all) and blocks of several rows, C rows in all."""
        zeros = dr.zeros(ad.Float, self.capacity)
        numbers = dr.concat([block + zeros if dr.width(block) == 1 else block for block in blocks])
        return ad.TensorXf(numbers, (dr.width(numbers) // self.capacity, self.capacity))

    def row(self, columns: Any, i: int) -> Any:
        """Row i [M] of a TensorXf [C, M]."""
        return dr.gather(ad.Float, columns.array, dr.arange(ad.UInt32, self.capacity) + i * self.capacity)

    def narrowed(self, rows: list[Any], like: Any) -> list[Any]:
        """Rows [M], evaluated, to [N]. like: any array [N]."""
        lane = dr.arange(ad.UInt32, dr.width(like))
        known = lane < self.count
        return [dr.select(known, dr.gather(ad.Float, row, lane), like) for row in rows]

    def packed(self, parts: list[tuple[Any, int, int]], like: Any) -> Any:
        """Float [C * N], packed, of parts (TensorXf [R, M], first row, rows), one under another. like: an array."""
        place = dr.arange(ad.UInt32, dr.width(like))
        row, lane = place // self.count, place % self.count
        found, before = like, 0
        for columns, first, rows in parts:
            mine = (row >= before) & (row < before + rows)
            index = (row - before + first) * self.capacity + lane
            found = dr.select(mine, dr.gather(ad.Float, columns.array, index, mine), found)
            before += rows
        return found
