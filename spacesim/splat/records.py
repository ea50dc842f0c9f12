"""What blending and its adjoints read: splats as records in list order, and which pixels belong to which lane."""

from dataclasses import dataclass
from typing import Any

import drjit as dr

from spacesim.backend import ad
from spacesim.splat.project import Splats
from spacesim.splat.tiles import TileLists

ALPHA_MAX = 0.999  #: a splat never hides everything behind it
TRANSMITTANCE_MIN = 1e-4  #: a pixel is finished once less than this passes
LOG2_E = 1.4426950408889634


@dataclass
class Blended:
    """What `forward` leaves behind. Planes are [height * width], row by row.

    features: C planes, sum of w_i f_i;  transmittance: plane, what passes through all splats
    Tile-major state for `backward`: transmittance and one past the last pair blended of each pixel [T * lanes * rows],
    and of each tile [T]; the splats' records in list order [4 P] each.
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

    Record: x, y, -a/2 log2 e, -b log2 e, -c/2 log2 e, log2 o, features; padded to fours, one array [4 P] a four.
    capacity: room for the N splats.
    """
    if lists.capacity == 0:
        return []
    numbers = [splats.x, splats.y, -0.5 * LOG2_E * splats.a, -LOG2_E * splats.b, -0.5 * LOG2_E * splats.c]
    numbers += [dr.log2(dr.maximum(splats.opacity, 1e-30)), *features]
    numbers += [ad.Float(0)] * (-len(numbers) % 4)
    index = dr.arange(ad.UInt32, dr.width(splats.x))
    packed = [store(numbers[i : i + 4], index, capacity) for i in range(0, len(numbers), 4)]
    dr.eval(packed)
    position = dr.arange(ad.UInt32, lists.capacity)
    records = [store(list(dr.gather(ad.Array4f, array, lists.splat)), position, lists.capacity) for array in packed]
    dr.eval(records)
    return records


def store(values: list[Any], index: Any, size: int) -> Any:
    """A flat array [size * len(values)] in which `values` of lane i stand at index i, by one packet scatter."""
    array_type = type(values[0])
    target = dr.empty(array_type, len(values) * size)
    dr.scatter(target, (ad.ArrayXu if array_type is ad.UInt32 else ad.ArrayXf)(values), index)
    return target


def load(records: list[Any], k: Any) -> list[Any]:
    """Record k of arrays by fours."""
    return [value for array in records for value in dr.gather(ad.Array4f, array, k)]


def exponents(record: list[Any], px: Any, py: Any, rows: int) -> list[Any]:
    """log2 of the unclamped alpha at the pixels (px, py + p), p < rows (thesis 2.14)."""
    dx, dy0 = px - record[0], py - record[1]
    constant = dr.fma(record[2] * dx, dx, record[5])
    linear = record[3] * dx
    return [dr.fma(dr.fma(record[4], dy0 + p, linear), dy0 + p, constant) for p in range(rows)]


def lane_pixels(lane: Any, lists: TileLists) -> tuple[Any, Any, Any, Any]:
    """(x, y) pixel centres and (column, row) indices of the topmost pixel of each lane."""
    shape = lists.shape
    tile, within = lane // shape.lanes, lane % shape.lanes
    column = (tile % lists.tiles_x) * shape.width + within % shape.width
    row = (tile // lists.tiles_x) * shape.height + (within // shape.width) * shape.rows
    return ad.Float(column) + 0.5, ad.Float(row) + 0.5, column, row


def tiled_index(lists: TileLists, width: int, height: int) -> Any:
    """Position in tile-major order of each pixel of the image, UInt32 [height * width]."""
    shape = lists.shape
    pixel = dr.arange(ad.UInt32, width * height)
    x, y = pixel % width, pixel // width
    tile = (y // shape.height) * lists.tiles_x + x // shape.width
    in_column, in_row = x % shape.width, y % shape.height
    lane = tile * shape.lanes + in_column + (in_row // shape.rows) * shape.width
    return lane * shape.rows + in_row % shape.rows
