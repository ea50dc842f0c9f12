"""The tiles that the box around each splat reaches, and which of these its ellipse does."""

from dataclasses import dataclass
from typing import cast

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Bool, Float, UInt32
from spacesim.splat.raster.lists.tiles import TileShape, tile_shape
from spacesim.splat.raster.project import ALPHA_MIN, Footprints, Splats
from spacesim.splat.raster.records import load, packets, store


@dataclass(frozen=True)
class Grid:
    """The tiles of a picture, all of one shape."""

    columns: int  #: tiles in a row
    rows: int  #: rows of tiles
    shape: TileShape  #: of each

    @staticmethod
    def of(width: int, height: int) -> "Grid":
        """For a picture of width x height pixels."""
        shape = tile_shape(width, height)
        return Grid(-(-width // shape.width), -(-height // shape.height), shape)

    @property
    def tiles(self) -> int:
        """How many they are."""
        return self.columns * self.rows


def box_records(
    splats: Splats, footprints: Footprints, count: UInt32, capacity: int, grid: Grid
) -> tuple[list[Float], UInt32, Bool]:
    """Of each of `count` splats, [M] = [capacity]: (what `tile_of_pair` reads, by packets; tiles of its box, 0 for what
    cannot be seen; whether it can be)."""
    index = dr.arange(ad.UInt32, capacity)
    live = index < count
    live &= dr.gather(ad.Bool, footprints.visible, index, live)
    x, y, a, b, c, opacity, half_width, half_height = (
        dr.gather(ad.Float, values, index, live)
        for values in (
            *(splats.x, splats.y, splats.a, splats.b, splats.c, splats.opacity),
            *(footprints.half_width, footprints.half_height),
        )
    )
    left, right = _tile_range(x, half_width, grid.shape.width, grid.columns)
    top, bottom = _tile_range(y, half_height, grid.shape.height, grid.rows)
    columns = right - left
    corner = cast(Float, dr.reinterpret_array(ad.Float, left | (top << 16)))
    most = 2 * dr.log(dr.maximum(opacity / ALPHA_MIN, 1)) * (1 + 1e-4) + 1e-4
    numbers = [x, y, a, b, c, most, corner, ad.Float(dr.maximum(columns, 1))]
    records = [store(packet, index, capacity) for packet in packets(numbers)]
    return records, dr.select(live, columns * (bottom - top), ad.UInt32(0)), live


def tile_of_pair(
    records: list[Float], capacity: int, splat: UInt32, within: UInt32, exists: Bool, grid: Grid
) -> UInt32:
    """Tile [P] of the pair `within` the box of a splat; the number of tiles where there is no such pair, or the ellipse
    misses the tile. records, capacity: of `box_records`"""
    *ellipse, corner, columns = load(records, splat, capacity)
    first, (down, across) = cast(UInt32, dr.reinterpret_array(ad.UInt32, corner)), _divided(within, columns)
    column, row = (first & 0xFFFF) + across, (first >> 16) + down
    listed = exists & _touches(ellipse, column, row, grid.shape)
    return dr.select(listed, row * grid.columns + column, grid.tiles)


def _divided(number: UInt32, by: Float) -> tuple[UInt32, UInt32]:
    """(quotient, rest) of numbers by whole ones, both below 2^24. On LLVM integers would be divided one by one."""
    quotient, divisor = ad.UInt32((ad.Float(number) + 0.5) / by), ad.UInt32(by)
    rest = number - quotient * divisor
    quotient = dr.select(rest >= 2**31, quotient - 1, dr.select(rest >= divisor, quotient + 1, quotient))  # rounded
    return quotient, number - quotient * divisor


def _touches(ellipse: list[Float], column: UInt32, row: UInt32, shape: TileShape) -> Bool:
    """Does the ellipse {alpha >= ALPHA_MIN} of a splat reach a pixel centre's rectangle of a tile? [P] each.

    Outside its centre a convex quadratic is least, over a rectangle, on an edge that faces the centre.
    ellipse: x, y, a, b, c of a splat, and the largest value of the quadratic
    """
    x, y, a, b, c, most = ellipse
    left, top = ad.Float(column * shape.width) + 0.5 - x, ad.Float(row * shape.height) + 0.5 - y
    right, bottom = left + (shape.width - 1), top + (shape.height - 1)
    near_x, near_y = dr.clip(0, left, right), dr.clip(0, top, bottom)
    on_column = dr.clip(-b * near_x * dr.rcp(c), top, bottom)  # least along the facing vertical edge
    on_row = dr.clip(-b * near_y * dr.rcp(a), left, right)

    def form(dx: Float, dy: Float) -> Float:
        return a * dx * dx + 2 * b * dx * dy + c * dy * dy

    return dr.minimum(form(near_x, on_column), form(on_row, near_y)) <= most


def _tile_range(center: Float, half: Float, size: int, tiles: int) -> tuple[UInt32, UInt32]:
    """Half-open range of tile indices that [center - half, center + half] touches, UInt32 [N] each."""
    low = dr.clip(dr.floor((center - half) / size), 0, tiles)
    high = dr.clip(dr.floor((center + half) / size) + 1, low, tiles)
    return ad.UInt32(low), ad.UInt32(high)
