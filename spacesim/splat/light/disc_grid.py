"""Discs in the cells of a grid, and the first that a ray meets (Amanatides and Woo 1987).

Of two discs equally far, as those in one plane are, a ray tracer's hierarchy may give either: OptiX promises nothing.
Here the one of the lower number is met, so that training repeats to the bit, with OptiX or without.
"""

from dataclasses import dataclass
from typing import Any, cast

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Bool, Float, UInt32
from spacesim.backend.upload import upload
from spacesim.data.geometry import Array
from spacesim.splat.raster.records import load, packets, store

MISSED = 0xFFFFFFFF  #: in place of a disc's number
MOST_CELLS = 160  #: along the longest side
CELL = 1.5  #: median radii of a disc
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
    def of(centers: Array, axes: Array) -> "DiscGrid":
        """centers: [n, 3] metres;  axes: [n, 2, 3] metres, at right angles, the semi-axes, above 0 all"""
        squares = np.einsum("nij,nij->ni", axes, axes)
        half = np.sqrt(axes[:, 0] ** 2 + axes[:, 1] ** 2)
        low, high = (centers - half).min(axis=0), (centers + half).max(axis=0)
        size = float((high - low).max())
        longer = np.sqrt(np.maximum(squares[:, 0], squares[:, 1]))
        cell = max(CELL * float(np.median(longer)), size / MOST_CELLS, 1e-9)
        while _products((boxes := _cells(centers - low, half, cell))[1]).sum() > MOST_ENTRIES:
            cell *= 2
        columns = boxes[0].max(axis=0) + boxes[1].max(axis=0)
        scaled, normals = axes / squares[:, :, None], np.cross(axes[:, 0], axes[:, 1])
        normals /= np.sqrt(squares[:, 0] * squares[:, 1])[:, None]
        discs, starts = _lists(*boxes, columns, normals, np.einsum("ni,ni->n", normals, (centers - low) / cell))
        index = dr.arange(ad.UInt32, len(centers))
        columns_of = [upload(row) for row in np.hstack([centers, normals, scaled.reshape(-1, 6)]).T]
        records = [store(values, index, len(centers)) for values in packets(columns_of)]
        grid = DiscGrid(
            len(centers),
            records,
            discs,
            starts,
            ad.Array3f([dr.opaque(ad.Float, float(value)) for value in low]),
            dr.opaque(ad.Float, cell),
            _opaque(columns),
        )
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

        def entries(at: list[Any], active: Bool) -> tuple[UInt32, UInt32]:
            cell = (ad.UInt32(at[2]) * self.columns[1] + ad.UInt32(at[1])) * self.columns[0] + ad.UInt32(at[0])
            return dr.gather(ad.UInt32, self.starts, cell, active), dr.gather(ad.UInt32, self.starts, cell + 1, active)

        def goes_on(going: Bool, *_state: object) -> Bool:
            return going

        def step(
            going: Bool, at: list[Any], leaves: list[Float], k: UInt32, end: UInt32, nearest: Float, met: UInt32
        ) -> tuple[Bool, list[Any], list[Float], UInt32, UInt32, Float, UInt32]:
            tests = going & (k < end)
            disc = dr.gather(ad.UInt32, self.discs, k, tests)
            numbers = load(self.records, disc, self.count, tests)
            center, normal, first, second = (ad.Array3f(numbers[i : i + 3]) for i in (0, 3, 6, 9))
            distance = dr.dot(center - start, normal) / dr.dot(direction, normal)
            off = start + distance * direction - center
            is_met = dr.square(dr.dot(off, first)) + dr.square(dr.dot(off, second)) < 1
            is_nearer = (distance < nearest) | ((distance == nearest) & (disc < met))
            is_met &= tests & (distance > 0) & is_nearer
            nearest, met = dr.select(is_met, distance, nearest), dr.select(is_met, disc, met)

            moves, leave = going & ~tests, dr.minimum(dr.minimum(leaves[0], leaves[1]), leaves[2])
            going &= tests | (nearest > leave)
            moves &= going
            along = [leaves[0] == leave, (leaves[1] == leave) & (leaves[0] != leave)]
            along.append(~(along[0] | along[1]))
            at, leaves = list(at), list(leaves)
            for i in range(3):
                goes = moves & along[i]
                at[i] += dr.select(goes, dr.select(forward[i], ad.Int32(1), -1), 0)
                leaves[i] += dr.select(goes, width[i], 0)
                going &= ~goes | ((at[i] >= 0) & (at[i] < ad.Int32(self.columns[i])))
            moves &= going
            start_of, end_of = entries(at, moves)
            k, end = dr.select(moves, start_of, k + 1), dr.select(moves, end_of, end)
            return going, at, leaves, k, end, nearest, met

        k, end = entries(at, inside)
        state = (inside, at, leaves, k, end, ad.Float(FAR), ad.UInt32(MISSED))
        return dr.while_loop(state, goes_on, step, mode="symbolic", label="first disc")[-1]


def _cells(centers: Array, half: Array, cell: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(first cell, number of cells) [n, 3] along each axis of the boxes of `half` about `centers` [n, 3]."""
    first = np.maximum((centers - half) / cell, 0).astype(np.int64)
    return first, ((centers + half) / cell).astype(np.int64) - first + 1


def _lists(
    first: NDArray[np.int64], sides: NDArray[np.int64], columns: NDArray[np.int64], normals: Array, offsets: Array
) -> tuple[UInt32, UInt32]:
    """(discs cell by cell, in a cell in any order, where each cell's start and the last one's end): of boxes of cells,
    see `_cells`, those that the disc's plane n.x = d cuts. columns: cells along each axis;  normals: [n, 3], unit;
    offsets: d, [n], in cells from the corner"""
    counts = _products(sides)
    before = np.cumsum(counts) - counts
    disc = upload(np.repeat(np.arange(len(first)), counts), ad.UInt32)
    number = dr.arange(ad.UInt32, dr.width(disc)) - dr.gather(ad.UInt32, upload(before, ad.UInt32), disc)
    x, y, z = (dr.gather(ad.UInt32, upload(values, ad.UInt32), disc) for values in first.T)
    # no division by 0 in lanes beyond the last one, which run along
    wide, high, _ = (dr.maximum(dr.gather(ad.UInt32, upload(values, ad.UInt32), disc), 1) for values in sides.T)
    nx, ny, _ = _opaque(columns)
    x, y, z = x + number % wide, y + number // wide % high, z + number // wide // high
    a, b, c, d = (dr.gather(ad.Float, upload(values), disc) for values in (*normals.T, offsets))
    middle: list[Float] = [ad.Float(number) + 0.5 for number in (x, y, z)]
    away: Float = dr.abs(a * middle[0] + b * middle[1] + c * middle[2] - d)
    is_cut = away < 0.5 * (dr.abs(a) + dr.abs(b) + dr.abs(c)) + ROUNDING
    cell = (z * ny + y) * nx + x
    lengths = dr.opaque(ad.UInt32, 0, int(columns.prod()) + 1)
    place = cast(UInt32, dr.scatter_inc(lengths, cell, is_cut))
    dr.eval(place, cell, is_cut, lengths)
    starts = dr.prefix_reduce(dr.ReduceOp.Add, lengths, exclusive=True)
    dr.eval(starts)
    discs = dr.opaque(ad.UInt32, 0, dr.width(disc))
    dr.scatter(discs, disc, dr.gather(ad.UInt32, starts, cell) + place, is_cut)
    dr.eval(discs)
    return discs, starts


def _products(sides: NDArray[np.int64]) -> NDArray[np.int64]:
    return sides[:, 0] * sides[:, 1] * sides[:, 2]


def _opaque(columns: NDArray[np.int64]) -> tuple[UInt32, UInt32, UInt32]:
    x, y, z = (dr.opaque(ad.UInt32, int(count)) for count in columns)
    return x, y, z
