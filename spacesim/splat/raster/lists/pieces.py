"""Lists cut into pieces of so many pairs: buckets of the adjoint, parts of a walk.

The pieces of all lists are numbered, those of tile t from start[t] // size + t on. size: pairs of a piece.
"""

from dataclasses import dataclass

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Bool, UInt32
from spacesim.splat.raster.lists.tiles import TileLists


def count_pieces(lists: TileLists, size: int) -> int:
    """More than there are."""
    return lists.capacity // size + lists.tiles_x * lists.tiles_y + 1


def name_tiles(target: UInt32, tile: UInt32, number: UInt32, until: UInt32, step: int = 1) -> None:
    """Into `target`, [pieces], the tile of the pieces number, number + step, ... below `until`."""

    def has_more(number: UInt32) -> Bool:
        return number < until

    def write(number: UInt32) -> tuple[UInt32]:
        dr.scatter(target, tile, number)
        return (number + step,)

    dr.while_loop((number,), has_more, write, mode="symbolic", label="pieces")


@dataclass
class Pieces:
    """Of each: its tile, 0 where it is none, its first pair, and the pairs that bound the tile's list."""

    exists: Bool  #: whether it is one
    tile: UInt32  #: number, row by row
    first: UInt32  #: pair
    list_start: UInt32  #: first pair of the list
    list_end: UInt32  #: one past its last


def read_pieces(lists: TileLists, size: int, tiles: UInt32, number: UInt32) -> Pieces:
    """Those of such numbers. tiles: of all pieces, the number of tiles where there is none (`name_tiles`)"""
    tile = dr.gather(ad.UInt32, tiles, number)
    exists = tile < lists.tiles_x * lists.tiles_y
    tile = dr.select(exists, tile, 0)
    start, end = (dr.gather(ad.UInt32, bounds, tile) for bounds in (lists.start, lists.end))
    return Pieces(exists, tile, start + (number - (start // size + tile)) * size, start, end)
