"""Discs in the cells of a grid, and the first that a ray meets (Amanatides and Woo 1987).

Of two discs equally far, as those in one plane are, a ray tracer's hierarchy may give either: OptiX promises nothing.
Here the one of the lower number is met, so that training repeats to the bit, with OptiX or without.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Bool, Float, UInt32
from spacesim.backend.packet import load, packets, store
from spacesim.splat.raster.lists.tiles import round_capacity

MISSED = 0xFFFFFFFF  #: in place of a disc's number
MOST_CELLS = 160  #: along the longest side
CELL = 1.25  #: median radii of a disc
MOST_ENTRIES = 1 << 25  #: of discs in cells; larger cells have fewer
ROUNDING = 1e-3  #: of a cell
FAR = 1e30  #: metres, no ray gets there


@dataclass
class DiscGrid:
    """Ellipses in space."""

    count: int  #: n of them
    records: list[Float]  #: centre, normal, and what gives places in units of the semi-axes, see `records.load`
    discs: UInt32  #: cell by cell, in a cell in any order
    starts: UInt32  #: where those of each cell start, and the end
    low: Array3f  #: corner, metres
    cell: Float  #: metres
    columns: tuple[UInt32, UInt32, UInt32]  #: cells along each axis

    @staticmethod
    def of(centers: Array3f, axes: Sequence[Array3f]) -> "DiscGrid":
        """centers: [3, n] metres, finite;  axes: two of [3, n] metres, at right angles, the semi-axes, above 0 all"""
        squares = [dr.squared_norm(axis) for axis in axes]
        half = dr.sqrt(dr.square(axes[0]) + dr.square(axes[1]))
        low, high, longer = centers - half, centers + half, dr.sqrt(dr.maximum(squares[0], squares[1]))
        dr.eval(low, high, longer)
        corner, end = (np.array(dr.ravel(edge), float) for edge in (dr.min(low, axis=1), dr.max(high, axis=1)))
        size = float((end - corner).max())
        cell = max(CELL * float(np.median(longer.numpy())), size / MOST_CELLS, 1e-9)
        normals = dr.cross(*axes) * dr.rsqrt(squares[0] * squares[1])
        corner_of = ad.Array3f([dr.opaque(ad.Float, value) for value in corner.tolist()])
        while True:
            cell_of = dr.opaque(ad.Float, cell)
            boxes = _Boxes.of((low - corner_of) / cell_of, (high - corner_of) / cell_of)
            entries = boxes.entries()
            if entries <= MOST_ENTRIES:
                break
            cell *= 2
        columns = [int(count) for count in np.floor((end - corner) / cell) + 2]
        discs, starts = _lists(boxes, entries, columns, normals, dr.dot(normals, (centers - corner_of) / cell_of))
        count, scaled = len(longer), [axis / square for axis, square in zip(axes, squares, strict=True)]
        numbers = [value for vector in (centers, normals, *scaled) for value in vector]
        records = [store(values, dr.arange(ad.UInt32, count), count) for values in packets(numbers)]
        grid = DiscGrid(count, records, discs, starts, corner_of, cell_of, _opaque(columns))
        dr.eval(grid)
        return grid

    def first_met(self, start: Array3f, direction: Array3f, active: Bool) -> UInt32:
        """[M] the nearest of the discs along rays, of equally near ones the one of the lowest number; MISSED for none.
        start: [3, M] metres;  direction: [3, M] unit"""
        steep = dr.select(dr.abs(direction) < 1e-12, ad.Array3f(1e-12), direction)
        inverse, high = dr.rcp(steep), self.low + self.cell * ad.Array3f([ad.Float(n) for n in self.columns])
        crossings: list[Any] = [(self.low - start) * inverse, (high - start) * inverse]
        enters = dr.maximum(dr.max(dr.minimum(*crossings)), 0)
        inside = active & (enters < dr.min(dr.maximum(*crossings)))
        place = (start + enters * direction - self.low) / self.cell
        at = [dr.clip(ad.Int32(dr.floor(place[i])), 0, ad.Int32(self.columns[i]) - 1) for i in range(3)]
        forward = [steep[i] > 0 for i in range(3)]
        edges = [ad.Float(at[i] + dr.select(forward[i], ad.Int32(1), 0)) for i in range(3)]
        leaves = [(self.low[i] + self.cell * edges[i] - start[i]) * inverse[i] for i in range(3)]
        width = [self.cell * dr.abs(inverse[i]) for i in range(3)]
        strides = [ad.Int32(1), ad.Int32(self.columns[0]), ad.Int32(self.columns[0] * self.columns[1])]
        steps = [dr.select(forward[i], strides[i], -strides[i]) for i in range(3)]
        left = [dr.select(forward[i], ad.Int32(self.columns[i]) - 1 - at[i], at[i]) for i in range(3)]  # cells ahead
        cell = sum((at[i] * strides[i] for i in (1, 2)), at[0])

        def has_more(k: UInt32, end: UInt32, *_state: object) -> Bool:
            return k < end

        def test(k: UInt32, end: UInt32, nearest: Float, met: UInt32) -> tuple[UInt32, UInt32, Float, UInt32]:
            disc = dr.gather(ad.UInt32, self.discs, k)
            numbers = load(self.records, disc, self.count)
            center, normal, first, second = (ad.Array3f(numbers[i : i + 3]) for i in (0, 3, 6, 9))
            distance = dr.dot(center - start, normal) / dr.dot(direction, normal)
            off = start + distance * direction - center
            is_met = dr.square(dr.dot(off, first)) + dr.square(dr.dot(off, second)) < 1
            is_met &= (distance > 0) & ((distance < nearest) | ((distance == nearest) & (disc < met)))
            return k + 1, end, dr.select(is_met, distance, nearest), dr.select(is_met, disc, met)

        def goes_on(going: Bool, *_state: object) -> Bool:
            return going

        def step(
            going: Bool, cell: Any, left: list[Any], leaves: list[Float], nearest: Float, met: UInt32
        ) -> tuple[Bool, Any, list[Any], list[Float], Float, UInt32]:
            k, end = (dr.gather(ad.UInt32, self.starts, ad.UInt32(cell + i), going) for i in (0, 1))
            *_, nearest, met = dr.while_loop(
                (k, end, nearest, met), has_more, test, mode="symbolic", label="discs of a cell"
            )
            leave = dr.minimum(dr.minimum(leaves[0], leaves[1]), leaves[2])
            going &= nearest > leave
            along = [leaves[0] == leave, (leaves[1] == leave) & (leaves[0] != leave)]
            along.append(~(along[0] | along[1]))
            left, leaves = list(left), list(leaves)
            for i in range(3):
                left[i] -= dr.select(along[i], ad.Int32(1), 0)
                leaves[i] += dr.select(along[i], width[i], 0)
                cell += dr.select(along[i], steps[i], 0)
                going &= left[i] >= 0
            return going, cell, left, leaves, nearest, met

        state = (inside, cell, left, leaves, ad.Float(FAR), ad.UInt32(MISSED))
        return dr.while_loop(state, goes_on, step, mode="symbolic", label="first disc")[-1]


@dataclass
class _Boxes:
    """Boxes of cells, [n] of each."""

    first: list[UInt32]  #: the first along each axis
    sides: list[UInt32]  #: how many along each
    count: UInt32  #: in all

    @staticmethod
    def of(low: Array3f, high: Array3f) -> "_Boxes":
        """low, high: corners [3, n], in cells, which are whole numbers from 0 on"""
        first = [ad.UInt32(dr.maximum(edge - ROUNDING, 0)) for edge in low]
        sides = [ad.UInt32(edge + ROUNDING) - start + 1 for edge, start in zip(high, first, strict=True)]
        return _Boxes(first, sides, sides[0] * sides[1] * sides[2])

    def entries(self) -> int:
        """Of discs in cells. Waits for the device."""
        dr.eval(self)
        return int(dr.sum(ad.UInt64(self.count))[0])


def _lists(
    boxes: _Boxes, entries: int, columns: Sequence[int], normals: Array3f, offsets: Float
) -> tuple[UInt32, UInt32]:
    """(discs cell by cell, in a cell in any order, where each cell's start and the last one's end): of boxes of cells
    those that the disc's plane n.x = d cuts. columns: cells along each axis;  normals: [3, n], unit;  offsets: d, [n],
    in cells from the corner"""
    before = dr.prefix_reduce(dr.ReduceOp.Add, boxes.count, exclusive=True)
    disc = dr.opaque(ad.UInt32, 0, round_capacity(entries))
    dr.scatter(disc, dr.arange(ad.UInt32, dr.width(before)), before)
    dr.eval(disc, normals, offsets)
    disc = dr.prefix_reduce(dr.ReduceOp.Max, disc, exclusive=False)
    dr.eval(disc)
    number = dr.arange(ad.UInt32, dr.width(disc)) - dr.gather(ad.UInt32, before, disc)
    # no division by 0 in lanes beyond the last one, which run along
    wide, high = (dr.maximum(dr.gather(ad.UInt32, side, disc), 1) for side in boxes.sides[:2])
    steps = number % wide, number // wide % high, number // wide // high
    x, y, z = (dr.gather(ad.UInt32, start, disc) + step for start, step in zip(boxes.first, steps, strict=True))
    a, b, c = dr.gather(ad.Array3f, normals, disc)
    middle: list[Float] = [ad.Float(place) + 0.5 for place in (x, y, z)]
    away: Float = dr.abs(a * middle[0] + b * middle[1] + c * middle[2] - dr.gather(ad.Float, offsets, disc))
    is_cut = away < 0.5 * (dr.abs(a) + dr.abs(b) + dr.abs(c)) + ROUNDING
    is_cut &= number < dr.gather(ad.UInt32, boxes.count, disc)
    nx, ny, _ = _opaque(columns)
    cell = (z * ny + y) * nx + x
    lengths = dr.opaque(ad.UInt32, 0, round_capacity(math.prod(columns) + 1))
    place = cast(UInt32, dr.scatter_inc(lengths, cell, is_cut))
    dr.eval(place, cell, is_cut, lengths)
    starts = dr.prefix_reduce(dr.ReduceOp.Add, lengths, exclusive=True)
    dr.eval(starts)
    discs = dr.opaque(ad.UInt32, 0, dr.width(disc))
    dr.scatter(discs, disc, dr.gather(ad.UInt32, starts, cell, is_cut) + place, is_cut)
    dr.eval(discs)
    return discs, starts


def _opaque(columns: Sequence[int]) -> tuple[UInt32, UInt32, UInt32]:
    x, y, z = (dr.opaque(ad.UInt32, count) for count in columns)
    return x, y, z
