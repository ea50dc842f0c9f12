"""Stage 2: which splats each screen tile blends, front to back.

Splats are sorted by depth once, expanded to (tile, splat) pairs, and the pairs are sorted by tile; both sorts are
stable, so each tile's list is in depth order, ties in index order: the result does not depend on scheduling. Pairs come
from the box around a splat's ellipse; those whose tile the ellipse misses are sorted behind all tiles.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr

from spacesim.backend import ad, select
from spacesim.data.errors import WorkError
from spacesim.splat.project import ALPHA_MIN, Footprints, Splats

_LARGEST_PAIRS = 2**31 - 1


@dataclass(frozen=True)
class TileShape:
    """A tile of width x height pixels is blended by `lanes` lanes; each holds a column of `rows` pixels."""

    width: int
    height: int
    lanes: int

    @property
    def rows(self) -> int:
        """Pixels a lane."""
        return self.width * self.height // self.lanes


def tile_shape() -> TileShape:
    """The fastest shape measured for the backend (docs/performance.md). One tile is one warp on CUDA, one
    AVX-512 packet on LLVM: a tile's gradients meet in a single reduction, whose order is fixed."""
    return TileShape(8, 8, 32) if select() == "cuda" else TileShape(16, 8, 16)


@dataclass
class TileLists:
    """P (tile, splat) pairs. `splat`, `slot` [P] are in blending order; `start`, `end` [T] delimit each tile.

    Slots number the pairs splat by splat: those of splat i are `first_slot[i]` .. + `slot_count[i]`.
    """

    splat: Any
    slot: Any
    start: Any
    end: Any
    first_slot: Any
    slot_count: Any
    pairs: int
    tiles_x: int
    tiles_y: int
    shape: TileShape


def bin_splats(splats: Splats, footprints: Footprints, width: int, height: int) -> TileLists:
    """Sort splats [N] into the tiles of a width x height image. Raises WorkError past 2^31 pairs."""
    shape = tile_shape()
    tiles_x, tiles_y = -(-width // shape.width), -(-height // shape.height)
    x0, x1 = _tile_range(dr.detach(splats.x), footprints.half_width, shape.width, tiles_x)
    y0, y1 = _tile_range(dr.detach(splats.y), footprints.half_height, shape.height, tiles_y)
    count = dr.select(footprints.visible, (x1 - x0) * (y1 - y0), ad.UInt32(0))

    # Positive floats sort as their bits. Invisible splats have no pairs, so their place does not matter.
    key = dr.select(footprints.visible, dr.reinterpret_array(ad.UInt32, dr.detach(splats.depth)), ad.UInt32(0xFFFFFFFF))
    dr.eval(x0, x1, y0, y1, count, key)
    order = dr.argsort(key)
    sorted_count = dr.gather(ad.UInt32, count, order)
    sorted_first = dr.prefix_sum(sorted_count)
    splat_count = dr.width(key)
    pairs = 0
    if splat_count > 0:
        total = dr.sum(ad.Float64(sorted_count))
        last = dr.opaque(ad.UInt32, splat_count - 1)
        tail = dr.gather(ad.UInt32, sorted_first, last) + dr.gather(ad.UInt32, sorted_count, last)
        dr.eval(total, tail)
        if total[0] > _LARGEST_PAIRS:
            raise WorkError(f"rasterizer: {total[0]:.3g} pairs of tile and splat, more than 2^31 - 1 can be sorted")
        pairs = int(tail[0])
    first_slot = dr.zeros(ad.UInt32, splat_count)
    dr.scatter(first_slot, sorted_first, order)
    if pairs == 0:
        none = dr.zeros(ad.UInt32, tiles_x * tiles_y)
        return TileLists(none, none, none, none, first_slot, count, 0, tiles_x, tiles_y, shape)

    # Expand: mark each splat's first pair with its rank, then a running maximum fills in the rest.
    rank = dr.zeros(ad.UInt32, pairs)
    dr.scatter(rank, dr.arange(ad.UInt32, splat_count), sorted_first, active=sorted_count > 0)
    rank = dr.prefix_reduce(dr.ReduceOp.Max, rank, exclusive=False)
    slot = dr.arange(ad.UInt32, pairs)
    splat = dr.gather(ad.UInt32, order, rank)
    within = slot - dr.gather(ad.UInt32, sorted_first, rank)
    left = dr.gather(ad.UInt32, x0, splat)
    columns = dr.maximum(dr.gather(ad.UInt32, x1, splat) - left, 1)
    column, row = left + within % columns, dr.gather(ad.UInt32, y0, splat) + within // columns
    touched = _touches(splats, splat, column, row, shape)
    tile = dr.select(touched, row * tiles_x + column, tiles_x * tiles_y)
    slot = _stable_order(tile, (tiles_x * tiles_y).bit_length())
    tile = dr.gather(ad.UInt32, tile, slot)
    splat = dr.gather(ad.UInt32, splat, slot)
    dr.eval(tile, splat)
    start, end = _runs(tile, pairs, tiles_x * tiles_y)
    dr.eval(splat, slot, start, end, first_slot)
    return TileLists(splat, slot, start, end, first_slot, count, pairs, tiles_x, tiles_y, shape)


def _touches(splats: Splats, splat: Any, column: Any, row: Any, shape: TileShape) -> Any:
    """Does the ellipse {alpha >= ALPHA_MIN} of a splat reach a pixel centre's rectangle of a tile? [P] each.

    Outside its centre a convex quadratic is least, over a rectangle, on an edge that faces the centre.
    """
    x, y, a, b, c, opacity = (
        dr.gather(ad.Float, dr.detach(v), splat)
        for v in (splats.x, splats.y, splats.a, splats.b, splats.c, splats.opacity)
    )
    left, top = ad.Float(column * shape.width) + 0.5 - x, ad.Float(row * shape.height) + 0.5 - y
    right, bottom = left + (shape.width - 1), top + (shape.height - 1)
    near_x, near_y = dr.clip(0, left, right), dr.clip(0, top, bottom)
    on_column = dr.clip(-b * near_x * dr.rcp(c), top, bottom)  # least along the facing vertical edge
    on_row = dr.clip(-b * near_y * dr.rcp(a), left, right)

    def form(dx: Any, dy: Any) -> Any:
        return a * dx * dx + 2 * b * dx * dy + c * dy * dy

    least = dr.minimum(form(near_x, on_column), form(on_row, near_y))
    return least <= 2 * dr.log(dr.maximum(opacity / ALPHA_MIN, 1)) * (1 + 1e-4) + 1e-4


def _stable_order(keys: Any, bits: int) -> Any:
    """Indices that sort `keys` [N] of so many bits: a radix sort that knows how few digits there are, where dr.argsort
    goes through all 32 bits."""
    digit_bits = 8 if select() == "cuda" else 11
    passes = -(-bits // digit_bits)
    digit_bits = -(-bits // passes)
    order = dr.arange(ad.UInt32, dr.width(keys))
    for i in range(passes):
        digit = (keys >> (i * digit_bits)) & ((1 << digit_bits) - 1)
        dr.eval(digit, keys, order)
        moved = dr.detail.block_mkperm(dr.detach(digit), dr.width(keys), 1 << digit_bits)
        order = dr.gather(ad.UInt32, order, moved)
        keys = dr.gather(ad.UInt32, keys, moved)
    return order


def _tile_range(center: Any, half: Any, size: int, tiles: int) -> tuple[Any, Any]:
    """Half-open range of tile indices that [center - half, center + half] touches, UInt32 [N] each."""
    low = dr.clip(dr.floor((center - half) / size), 0, tiles)
    high = dr.clip(dr.floor((center + half) / size) + 1, low, tiles)
    return ad.UInt32(low), ad.UInt32(high)


def _runs(tile: Any, pairs: int, tiles: int) -> tuple[Any, Any]:
    """First and one-past-last position of each tile's run in the sorted array `tile` [P]; 0, 0 where it has none.
    Entries of `tiles` and above are in no tile."""
    position = dr.arange(ad.UInt32, pairs)
    previous = dr.gather(ad.UInt32, tile, dr.select(position > 0, position - 1, 0))
    final = dr.opaque(ad.UInt32, pairs - 1)  # a literal would be another kernel every time
    following = dr.gather(ad.UInt32, tile, dr.minimum(position + 1, final))
    start, end = dr.zeros(ad.UInt32, tiles), dr.zeros(ad.UInt32, tiles)
    listed = tile < tiles
    dr.scatter(start, position, tile, active=listed & ((position == 0) | (previous != tile)))
    dr.scatter(end, position + 1, tile, active=listed & ((position == final) | (following != tile)))
    return start, end
