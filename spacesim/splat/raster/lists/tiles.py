"""Tiles of a picture: their shape, the lists of the splats that each blends, and which pixels a thread holds."""

from dataclasses import dataclass

import drjit as dr

from spacesim.backend import ad, select
from spacesim.backend.arrays import Bool, Float, UInt32

STEPS = 8  #: sizes of arrays from one power of two to the next, as a rule
SMALL = 2**18  #: pixels of a picture up to which tiles on CUDA are half as large


@dataclass(frozen=True)
class TileShape:
    """A tile of width x height pixels is blended by `threads` threads (on LLVM, SIMD lanes); each holds `columns`
    columns of `rows` pixels."""

    width: int  #: pixels
    height: int  #: pixels
    threads: int
    columns: int = 1

    @property
    def pixels(self) -> int:
        """Pixels a thread."""
        return self.width * self.height // self.threads

    @property
    def rows(self) -> int:
        """Pixels of a column."""
        return self.pixels // self.columns


def tile_shape(width: int, height: int) -> TileShape:
    """The fastest shape measured for the backend and a picture of so many pixels: one of few has few tiles, and threads
    of a large device would wait for the longest lists. One tile is one warp on CUDA, a part of a packet on LLVM, whose
    packets have 4 threads or a multiple: a tile's gradients meet in an order that is fixed."""
    if select() == "llvm":
        return TileShape(8, 8, 4, columns=2)
    return TileShape(8, 4, 32) if width * height <= SMALL else TileShape(8, 8, 32)


@dataclass
class TileLists:
    """(tile, splat) pairs. `splat`, `slot` [P] are in blending order; `start`, `end` [T] delimit each tile.

    Slots number the pairs splat by splat: those of splat i are `first_slot[i]` .. + `slot_count[i]`, [M], on CUDA [N];
    lists for a picture alone have none. `slot` is None where `place` is there. Arrays are longer than there are pairs
    and splats, so that few sizes occur: P is `capacity`, M at least N.
    """

    splat: UInt32
    slot: UInt32 | None
    start: UInt32
    end: UInt32
    first_slot: UInt32 | None
    slot_count: UInt32 | None
    capacity: int
    tiles_x: int  #: tiles in a row
    tiles_y: int  #: rows of tiles
    shape: TileShape  #: size of a tile, and how threads share its pixels
    #: the tiles in the order in which they are given to threads [T], or None for that of their indices: no result
    #: depends on it, and on CUDA it may be another each time
    order: UInt32 | None = None
    #: where each slot's pair stands in `splat` [P], or None: sums of pairs are then kept by slots (`sum_index`)
    place: UInt32 | None = None
    #: the tile of each slot's pair [P], the number of tiles where it is in no list, or None: sums of such pairs are 0
    tile: UInt32 | None = None

    def sum_index(self, k: UInt32, active: Bool | bool = True) -> UInt32:
        """Where the sums of pair k of `splat` are kept while they are added up.

        Threads of a CPU add to the pairs of their tiles, which must not share cache lines: there it is the pair's
        place."""
        return dr.gather(ad.UInt32, self.slot, k, active) if self.place is None else k

    def sum_of_slot(self, slot: UInt32) -> UInt32:
        """The same of a slot."""
        return slot if self.place is None else dr.gather(ad.UInt32, self.place, slot)

    def has_sum(self, slot: UInt32, active: Bool) -> Bool:
        """Whether there is a sum of a slot's pair; false where not `active`."""
        if self.tile is None:
            return active
        return active & (dr.gather(ad.UInt32, self.tile, slot, active) < self.tiles_x * self.tiles_y)

    @property
    def pairs(self) -> int:
        """How many pairs the tiles list. Waits for the device."""
        return int(dr.sum(self.end - self.start)[0])


def round_capacity(count: int, steps: int = STEPS) -> int:
    """`count` rounded up by about an eighth at most: few sizes are few recordings and, on LLVM, where the size of what
    is scattered into is part of a kernel's text, few kernels to compile. steps: sizes from one power of two to the
    next, itself one

    Never `count` itself: a recording in which the two are one takes the capacity from the number of splats."""
    step = max(1024, (1 << max(0, count.bit_length() - 1)) // steps)
    return (count // step + 1) * step


@dataclass
class ThreadPixels:
    """Of each thread: its tile, its place in tile-major order, and its first pixel: centre (x, y), and indices."""

    tile: UInt32  #: number, row by row
    place: UInt32  #: of the thread, where threads are counted tile by tile
    x: Float  #: of its first pixel's centre, pixels
    y: Float  #: of its first pixel's centre, pixels
    column: UInt32  #: of its first pixel, from 0
    row: UInt32  #: of its first pixel, from 0


def thread_pixels(lists: TileLists) -> ThreadPixels:
    """Of all threads [T * threads], in the order in which tiles are given to threads."""
    shape = lists.shape
    thread = dr.arange(ad.UInt32, lists.tiles_x * lists.tiles_y * shape.threads)
    tile, within = thread // shape.threads, thread % shape.threads
    if lists.order is not None:
        tile = dr.gather(ad.UInt32, lists.order, tile)
    return pixels_of_threads(lists, tile, within)


def pixels_of_threads(lists: TileLists, tile: UInt32, within: UInt32) -> ThreadPixels:
    """Of threads by their tiles and their numbers within these."""
    shape = lists.shape
    across = shape.width // shape.columns
    column = (tile % lists.tiles_x) * shape.width + (within % across) * shape.columns
    row = (tile // lists.tiles_x) * shape.height + (within // across) * shape.rows
    return ThreadPixels(tile, tile * shape.threads + within, ad.Float(column) + 0.5, ad.Float(row) + 0.5, column, row)


def thread_offsets(shape: TileShape) -> list[tuple[int, int]]:
    """(column, row) of a thread's pixels from its first: column by column."""
    return [(i, j) for i in range(shape.columns) for j in range(shape.rows)]


def pixel_in_tile(number: UInt32, shape: TileShape) -> tuple[UInt32, UInt32]:
    """(column, row) in its tile of a tile's pixel by its number in tile-major order."""
    thread, pixel, across = number // shape.pixels, number % shape.pixels, shape.width // shape.columns
    if shape.columns == 1:
        return thread % across, (thread // across) * shape.rows + pixel
    column, row = (thread % across) * shape.columns, (thread // across) * shape.rows
    return column + pixel // shape.rows, row + pixel % shape.rows


def tiled_index(lists: TileLists, width: int, height: int) -> UInt32:
    """Position in tile-major order of each pixel of the image, UInt32 [height * width]."""
    shape = lists.shape
    pixel = dr.arange(ad.UInt32, width * height)
    x, y = pixel % width, pixel // width
    tile = (y // shape.height) * lists.tiles_x + x // shape.width
    column, row = x % shape.width, y % shape.height
    within = column // shape.columns + (row // shape.rows) * (shape.width // shape.columns)
    return (tile * shape.threads + within) * shape.pixels + (column % shape.columns) * shape.rows + row % shape.rows
