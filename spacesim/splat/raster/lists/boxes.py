"""The tiles that the box around each splat reaches, and which of these its ellipse does."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Bool, Float, UInt32, UInt64
from spacesim.backend.packet import packets, store
from spacesim.splat.raster.lists.tiles import TileShape, tile_shape
from spacesim.splat.raster.project import ALPHA_MIN, Footprints, Splats

ROUNDING = 4 * 2.0**-23  #: of the sum of what an ellipse's form adds up


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

    def number_type(self, splats: int) -> type[UInt32] | type[UInt64]:
        """Of integers that hold the number of pairs, whatever so many splats reach."""
        return ad.UInt32 if splats * self.tiles < 2**32 else ad.UInt64


@dataclass
class Boxes:
    """Of splats, [N] on CUDA, [M] on LLVM: the tiles that the box around each reaches."""

    records: list[Float]  #: the numbers of `find_boxes`, `packed`
    count: UInt32  #: of the tiles, 0 for what cannot be seen
    splats: UInt32  #: how many they are, of width 1
    pair_ends: UInt32 | UInt64 | None = None  #: pairs up to and including each splat, where pairs have numbers
    #: the splats in the order in which pairs are numbered, None: that of their indices
    order: UInt32 | None = None
    large: UInt32 | None = None  #: on CUDA, splats of many tiles, in any order
    large_count: UInt32 | None = None  #: on CUDA, how many they are, of width 1

    @property
    def pairs(self) -> int:
        """How many they are. Waits for the device."""
        assert self.pair_ends is not None, "pairs have no numbers"
        return int(self.pair_ends[dr.width(self.pair_ends) - 1])

    def that_fit(self, limit: UInt32) -> tuple[Bool, UInt32]:
        """Whether all pairs are within a limit, of width 1; how many they are, 0 where they are not."""
        assert self.pair_ends is not None, "pairs have no numbers"
        number = type(self.pair_ends)
        pairs = dr.gather(number, self.pair_ends, self.splats - 1)
        fit = pairs <= number(limit)
        return fit, ad.UInt32(dr.select(fit, pairs, 0))


def find_boxes(splats: Splats, footprints: Footprints, grid: Grid) -> tuple[list[Float], UInt32]:
    """Of each splat, [N]: (the numbers that `tile_of_pair` reads; tiles of its box, 0 for what cannot be seen)."""
    left, right = _tile_range(splats.x, footprints.half_width, grid.shape.width, grid.columns)
    top, bottom = _tile_range(splats.y, footprints.half_height, grid.shape.height, grid.rows)
    columns = right - left
    corner = cast(Float, dr.reinterpret_array(ad.Float, left | (top << 16)))
    most = 2 * dr.log(dr.maximum(splats.opacity / ALPHA_MIN, 1)) * (1 + 1e-4) + 1e-4
    numbers = [splats.x, splats.y, splats.a, splats.b, splats.c, most, corner, ad.Float(dr.maximum(columns, 1))]
    return numbers, dr.select(footprints.visible, columns * (bottom - top), ad.UInt32(0))


def packed(numbers: list[Float], index: UInt32, capacity: int) -> list[Float]:
    """Numbers by packets, in arrays of `capacity`."""
    return [store(packet, index, capacity) for packet in packets(numbers)]


def tile_of_pair(ellipse: list[Float], within: UInt32, exists: Bool | bool, grid: Grid) -> UInt32:
    """Tile [P] of the pair `within` the box of a splat; the number of tiles where there is no such pair, or the ellipse
    misses the tile. ellipse: the numbers of `find_boxes`"""
    *form, corner, columns = ellipse
    first, (down, across) = cast(UInt32, dr.reinterpret_array(ad.UInt32, corner)), divided(within, columns)
    column, row = (first & 0xFFFF) + across, (first >> 16) + down
    listed = _touches(form, column, row, grid.shape) & exists
    return dr.select(listed, row * grid.columns + column, grid.tiles)


def each_tile(
    ellipse: list[Float],
    pairs: UInt32,
    lane: UInt32,
    lanes: UInt32,
    grid: Grid,
    visit: Callable[[UInt32, UInt32], None],
) -> None:
    """Visit (the pair within its box, its tile) of the pairs of a splat, which `lanes` threads share; see
    `tile_of_pair`."""

    def has_more(within: UInt32) -> Bool:
        return within < pairs

    def visit_one(within: UInt32) -> tuple[UInt32]:
        visit(within, tile_of_pair(ellipse, within, True, grid))
        return (within + lanes,)

    dr.while_loop((lane,), has_more, visit_one, mode="symbolic", label="tiles of splats")


def divided(number: UInt32, by: Float | UInt32) -> tuple[UInt32, UInt32]:
    """(quotient, rest) of whole numbers: the quotient is below 2^21, a divisor that is a Float below 2^24. On LLVM
    integers would be divided one by one."""
    quotient, divisor = ad.UInt32((ad.Float(number) + 0.5) / ad.Float(by)), ad.UInt32(by)
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
        """Less what rounding may have added, which is much where a needle's terms cancel. Fused by us, not where a
        compiler likes to: kernels that count and kernels that list must agree to the bit."""
        square, across = dr.fma(a * dx, dx, c * dy * dy), 2 * b * dx
        return dr.fma(-ROUNDING, dr.fma(dr.abs(across), dr.abs(dy), square), dr.fma(across, dy, square))

    return dr.minimum(form(near_x, on_column), form(on_row, near_y)) <= most


def _tile_range(center: Float, half: Float, size: int, tiles: int) -> tuple[UInt32, UInt32]:
    """Half-open range of tile indices that [center - half, center + half] touches, UInt32 [N] each."""
    low = dr.clip(dr.floor((center - half) / size), 0, tiles)
    high = dr.clip(dr.floor((center + half) / size) + 1, low, tiles)
    return ad.UInt32(low), ad.UInt32(high)
