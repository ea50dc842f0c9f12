"""What blending and its adjoints read: splats as records in list order, which pixels belong to which lane, alphas."""

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr

from spacesim.backend import ad, select
from spacesim.splat.raster.bin import TileLists, TileShape
from spacesim.splat.raster.project import ALPHA_MIN, Splats

ALPHA_MAX = 0.999  #: a splat never hides everything behind it
POWER_MIN = math.log2(ALPHA_MIN)  #: of what is blended
TRANSMITTANCE_MIN = 1e-4  #: a pixel is finished once less than this passes
LOG2_E = 1.4426950408889634

_EXP2 = (1.0, 0.693147004, 0.240222469, 0.0555071086, 0.00967129413, 0.00132695748)
_ROUNDING = 1.5 * 2.0**23  #: added to a float below 2^22, it leaves its integer part in the last bits


@dataclass
class Blended:
    """What `forward` leaves behind. Planes are [height * width], row by row.

    features: C planes, sum of w_i f_i;  transmittance: plane, what passes through all splats
    Tile-major state for `backward` (a tile's pixels stand lane by lane, a lane's as in `lane_offsets`): transmittance
    and one past the last pair blended of each pixel [T * pixels of a tile], and of each tile [T]; the splats' records
    in list order, see `list_records`.
    For the adjoint by buckets of `bucket` pairs (0: none): transmittance and sums of each pixel of a bucket's tile
    before the bucket, by fours, [4 B * pixels of a tile] each, without meaning where the pixel's lane did not come to
    it; and the tile of each bucket, [B], the number of tiles where no lane came to it.
    """

    features: list[Any]
    transmittance: Any
    tile_transmittance: Any
    last: Any
    tile_last: Any
    records: list[Any]
    bucket: int
    checkpoints: list[Any]
    bucket_tile: Any


def bucket_numbers(lists: TileLists, bucket: int) -> int:
    """B, more than there are buckets: those of tile t are numbered from start[t] // bucket + t."""
    return lists.capacity // bucket + lists.tiles_x * lists.tiles_y + 1


def list_records(splats: Splats, features: list[Any], lists: TileLists, capacity: int) -> list[Any]:
    """The splats' numbers in list order, so that a tile reads memory in one run.

    Record: x, y, -a/2 log2 e, -b log2 e, -c/2 log2 e, log2 o, features; in arrays of `packet_sizes`.
    capacity: room for the N splats.
    """
    if lists.capacity == 0:
        return []
    numbers = [splats.x, splats.y, -0.5 * LOG2_E * splats.a, -LOG2_E * splats.b, -0.5 * LOG2_E * splats.c]
    numbers += [dr.log2(dr.maximum(splats.opacity, 1e-30)), *features]
    index = dr.arange(ad.UInt32, dr.width(splats.x))
    packed = [store(values, index, capacity) for values in packets(numbers)]
    dr.eval(packed)
    position = dr.arange(ad.UInt32, lists.capacity)
    records = [store(load([array], lists.splat, capacity), position, lists.capacity) for array in packed]
    dr.eval(records)
    return records


def packet_sizes(numbers: int) -> list[int]:
    """How so many numbers of an entry are divided among arrays, in each of which those of an entry stand side by side:
    a lane reads or adds a packet at once. On LLVM one of eight numbers costs little more than one of four."""
    if select() == "cuda":
        return [4] * -(-numbers // 4)
    rest = numbers % 8
    return [8] * (numbers // 8) + ([] if rest == 0 else [2] if rest <= 2 else [4] if rest <= 4 else [8])


def packets(values: list[Any]) -> list[list[Any]]:
    """Values by `packet_sizes`, the last filled up with zeros."""
    found, done = [], 0
    for size in packet_sizes(len(values)):
        packet = values[done : done + size]
        found.append(packet + [ad.Float(0)] * (size - len(packet)))
        done += size
    return found


def store(values: list[Any], index: Any, size: int) -> Any:
    """A flat array [size * len(values)] in which `values` of lane i stand at index i, by one packet scatter."""
    array_type = type(values[0])
    target = dr.empty(array_type, len(values) * size)
    dr.scatter(target, (ad.ArrayXu if array_type is ad.UInt32 else ad.ArrayXf)(values), index)
    return target


def packet(values: list[Any]) -> Any:
    """Values of an entry as one array, to be stored or added at once."""
    kinds = {2: ad.Array2f, 4: ad.Array4f}
    return kinds.get(len(values), ad.ArrayXf)(values)


def load(arrays: list[Any], index: Any, capacity: int, active: Any = True) -> list[Any]:
    """The numbers of entry `index` of arrays with room for `capacity` entries; 0 where not `active`."""
    found: list[Any] = []
    for array in arrays:
        count = dr.width(array) // capacity
        size = packet_sizes(count)[-1]
        for part in range(count // size):
            place = index * (count // size) + part
            if size == 8:
                found += list(dr.gather(ad.ArrayXf, array, place, active, shape=(size, dr.width(index))))
            else:
                found += list(dr.gather(ad.Array4f if size == 4 else ad.Array2f, array, place, active))
    return found


def exponents(record: list[Any], px: Any, py: Any, shape: TileShape) -> list[Any]:
    """log2 of the unclamped alpha (thesis 2.14) at the pixels of a lane whose first is centred at (px, py)."""
    powers: list[Any] = []
    for i in range(shape.columns):
        dx, dy = px + i - record[0], py - record[1]
        constant = dr.fma(record[2] * dx, dx, record[5])
        linear = record[3] * dx
        powers += [dr.fma(dr.fma(record[4], dy + j, linear), dy + j, constant) for j in range(shape.rows)]
    return powers


def exp2(power: Any) -> Any:
    """2^power for powers from -126 to 126, without meaning beyond: ask for `power >= POWER_MIN` before it is used.

    CUDA has an instruction for it. On LLVM a polynomial of degree 5 over half a unit to each side of an integer, whose
    largest relative error is least, 9.3e-8, and the integer added to its exponent: half the operations of `dr.exp2`.
    """
    if select() == "cuda":
        return dr.exp2(power)
    shifted = power + _ROUNDING
    fraction = power - (shifted - _ROUNDING)
    value = ad.Float(_EXP2[-1])
    for coefficient in _EXP2[-2::-1]:
        value = dr.fma(value, fraction, coefficient)
    bits: Any = dr.reinterpret_array(ad.UInt32, shifted)
    return dr.reinterpret_array(ad.Float, dr.reinterpret_array(ad.UInt32, value) + (bits << 23))


def lane_offsets(shape: TileShape) -> list[tuple[int, int]]:
    """(column, row) of a lane's pixels from its first: column by column."""
    return [(i, j) for i in range(shape.columns) for j in range(shape.rows)]


@dataclass
class LanePixels:
    """Of each lane: its tile, its place in tile-major order, and its first pixel: centre (x, y), and indices."""

    tile: Any
    place: Any
    x: Any
    y: Any
    column: Any
    row: Any


def lane_pixels(lists: TileLists) -> LanePixels:
    """Of all lanes [T * lanes], in the order in which tiles are given to lanes."""
    shape = lists.shape
    lane = dr.arange(ad.UInt32, lists.tiles_x * lists.tiles_y * shape.lanes)
    tile, within = lane // shape.lanes, lane % shape.lanes
    if lists.order is not None:
        tile = dr.gather(ad.UInt32, lists.order, tile)
    across = shape.width // shape.columns
    column = (tile % lists.tiles_x) * shape.width + (within % across) * shape.columns
    row = (tile // lists.tiles_x) * shape.height + (within // across) * shape.rows
    return LanePixels(tile, tile * shape.lanes + within, ad.Float(column) + 0.5, ad.Float(row) + 0.5, column, row)


def pixel_in_tile(number: Any, shape: TileShape) -> tuple[Any, Any]:
    """(column, row) in its tile of a tile's pixel by its number in tile-major order."""
    lane, pixel, across = number // shape.pixels, number % shape.pixels, shape.width // shape.columns
    if shape.columns == 1:
        return lane % across, (lane // across) * shape.rows + pixel
    column, row = (lane % across) * shape.columns, (lane // across) * shape.rows
    return column + pixel // shape.rows, row + pixel % shape.rows


def tiled_index(lists: TileLists, width: int, height: int) -> Any:
    """Position in tile-major order of each pixel of the image, UInt32 [height * width]."""
    shape = lists.shape
    pixel = dr.arange(ad.UInt32, width * height)
    x, y = pixel % width, pixel // width
    tile = (y // shape.height) * lists.tiles_x + x // shape.width
    column, row = x % shape.width, y % shape.height
    within = column // shape.columns + (row // shape.rows) * (shape.width // shape.columns)
    return (tile * shape.lanes + within) * shape.pixels + (column % shape.columns) * shape.rows + row % shape.rows
