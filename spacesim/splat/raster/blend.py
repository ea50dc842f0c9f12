"""Stage 3: blend each tile's splats front to back (thesis 2.14 to 2.16), and the adjoint of that.

One thread holds a block of a tile's pixels and walks the tile's list. `forward` and `backward` are the two passes;
`rasterize` is the differentiable operation made of them. The adjoint is by hand (`adjoint.py`): by buckets of pairs on
CUDA, by tiles on LLVM. Buckets read what `forward` has kept of each pixel before each bucket. On an H100 to keep it
costs a twentieth of what the adjoint gains; on a CPU it costs more than that.
"""

from collections.abc import Callable
from functools import reduce
from operator import and_
from typing import cast

import drjit as dr

from spacesim.backend import ad, recorded, select
from spacesim.backend.arrays import Bool, Float, NumberT, UInt32
from spacesim.backend.kernels.llvm import is_usable
from spacesim.backend.packet import store
from spacesim.splat.raster.adjoint import PlaneGradients, SplatGradients, by_buckets, by_tiles
from spacesim.splat.raster.lists.pieces import count_pieces, name_tiles
from spacesim.splat.raster.lists.tiles import TileLists, round_capacity, thread_offsets
from spacesim.splat.raster.project import Splats
from spacesim.splat.raster.records import (
    ALPHA_MAX,
    POWER_MIN,
    TRANSMITTANCE_MIN,
    BlendResult,
    BlendState,
    ListedRecords,
    bits_of,
    exp2,
    exponents,
    list_records,
    pack_records,
)
from spacesim.splat.raster.walks import Walks, are_in_parts, in_parts, whole_lists

BUCKET = 8  #: pairs of a bucket, a power of two, some turns; 4 keep twice as much for 1 % of a step, 16 took longer
TURN = {"cuda": 4, "llvm": 1}  #: pairs a turn of the blending loop: their numbers are read at once
SIGN = 2**31  #: bit of a number that says that it is negative
CHECKPOINT_BYTES = 2**32  #: longer lists than these hold have their adjoint by tiles, on CUDA too

Finish = Callable[[Float, list[Float]], list[Float]]
"""(what passes, sums) of a pixel to the values of its planes."""


def forward(
    splats: Splats, features: list[Float], lists: TileLists, width: int, height: int, adjoint: bool = False
) -> BlendResult:
    """Blend `features` (C arrays [N]) over the pixels of a width x height image. Detached inputs. No part of a
    recording, which would keep N rounded up: that is `blend_lists`.

    adjoint: keep what `backward` reads; it costs memory
    """
    assert not dr.flag(dr.JitFlag.FreezingScope), "a recording would keep the capacity"
    bucket = bucket_pairs(lists, len(features)) if adjoint else None
    return blend_lists(splats, features, lists, width, height, round_capacity(dr.width(splats.x)), bucket)


def bucket_pairs(lists: TileLists, channels: int) -> int:
    """Pairs of a bucket of the adjoint; 0 for that by tiles."""
    pixels = lists.shape.width * lists.shape.height
    needed = 16 * -(-(1 + channels) // 4) * pixels * count_pieces(lists, BUCKET)
    return BUCKET if select() == "cuda" and lists.capacity > 0 and needed <= CHECKPOINT_BYTES else 0


def blend_lists(
    splats: Splats,
    features: list[Float],
    lists: TileLists,
    width: int,
    height: int,
    capacity: int,
    bucket: int | None = None,
) -> BlendResult:
    """`forward`, which may be a part of recordings. capacity: length of the splats' arrays;  bucket: `bucket_pairs`,
    None where there is no adjoint"""
    size = width, height
    if is_usable() and lists.capacity > 0:  # records are copied between two recordings
        records = list_records(_packed(splats, features, capacity), lists, capacity)
        return _blend_records(records, len(features), lists, size, capacity, bucket)
    return _blend_splats(splats, features, lists, size, capacity, bucket)


def blend_packed(
    packed: list[Float], channels: int, lists: TileLists, width: int, height: int, capacity: int
) -> BlendResult:
    """`blend_lists` of what is packed already, with `channels` features."""
    return _blend_records(list_records(packed, lists, capacity), channels, lists, (width, height), capacity, None)


_packed = recorded(pack_records)


@recorded(elements=lambda _, splats, features, lists, size, *_rest: size[0] * size[1])
def _blend_splats(
    splats: Splats, features: list[Float], lists: TileLists, size: tuple[int, int], capacity: int, bucket: int | None
) -> BlendResult:
    records = list_records(pack_records(splats, features, capacity), lists, capacity)
    return _blend_records(records, len(features), lists, size, capacity, bucket)


@recorded(elements=lambda _, records, channels, lists, size, *_rest: size[0] * size[1])
def _blend_records(
    records: ListedRecords, channels: int, lists: TileLists, size: tuple[int, int], capacity: int, bucket: int | None
) -> BlendResult:
    (transmittance, *sums), kept = blend_planes(
        records, channels, lists, size, capacity, lambda passed, sums: [passed, *sums], bucket
    )
    return BlendResult(sums, transmittance, kept)


def blend_planes(
    records: ListedRecords,
    channels: int,
    lists: TileLists,
    image_size: tuple[int, int],
    capacity: int,
    finish: Finish,
    bucket: int | None = None,
) -> tuple[list[Float], BlendState | None]:
    """(planes of what `finish` makes of each pixel; what the adjoint reads), else as `blend_lists`. records: with
    so many channels"""
    (width, height), shape = image_size, lists.shape
    assert not bucket or bucket % TURN[select()] == 0, "a bucket is some turns of the loop"
    walks = whole_lists(lists, channels)
    if cut := are_in_parts(lists, capacity):
        walks = in_parts(lists, channels, lambda first: _walk(lists, records, first)[:2])
    snapshots = _Checkpoints(lists, bucket, channels, walks) if bucket else None
    transmittance, sums, last = _walk(lists, records, walks, snapshots)
    transmittance, thread = [dr.abs(value) for value in transmittance], walks.thread
    finished = [finish(passed, added) for passed, added in zip(transmittance, sums, strict=True)]
    planes = [dr.empty(ad.Float, width * height) for _ in finished[0]]
    if cut:  # where a list is empty, nobody writes
        nothing = finish(ad.Float(1), [ad.Float(0)] * channels)
        planes = [value + dr.zeros(ad.Float, width * height) for value in nothing]
    for p, (i, j) in enumerate(thread_offsets(shape)):
        column, row = thread.column + i, thread.row + j
        inside = walks.writes[p] & (column < width) & (row < height)
        for plane, value in zip(planes, finished[p], strict=True):
            dr.scatter(plane, value, row * width + column, inside, dr.ReduceMode.NoConflicts)
    kept = None
    if bucket is not None:
        kept = BlendState(
            transmittance=_of_pixels(transmittance, lists, walks, 1, cut),
            last=_of_pixels(last, lists, walks, 0, cut),
            records=records,
            bucket=bucket,
            checkpoints=snapshots.states if snapshots else [],
            bucket_tile=snapshots.tile if snapshots else None,
            bucket_reached=snapshots.reached if snapshots else None,
        )
    dr.eval(planes, kept)
    return planes, kept


def _walk(
    lists: TileLists, records: ListedRecords, walks: Walks, snapshots: "_Checkpoints | None" = None
) -> tuple[list[Float], list[list[Float]], list[UInt32]]:
    """Of each pixel of each thread: what passes, negative where it is finished; sums; one past the last pair blended,
    at least where a walk goes on."""
    shape, turn, thread = lists.shape, TURN[select()], walks.thread

    def alive(k: UInt32, end: UInt32, transmittance: list[Float], _sums: object, _last: object) -> Bool:
        return (k < end) & (reduce(and_, map(bits_of, transmittance)) < SIGN)

    def blend(
        k: UInt32, end: UInt32, transmittance: list[Float], sums: list[list[Float]], last: list[UInt32]
    ) -> tuple[UInt32, UInt32, list[Float], list[list[Float]], list[UInt32]]:
        if snapshots:
            snapshots.keep(k, transmittance, sums)
        transmittance, last, sums = list(transmittance), list(last), [list(pixel) for pixel in sums]
        for u in range(turn):
            listed = k + u < end if u else ad.Bool(True)
            record = records.load(lists, k + u, listed)
            for p, power in enumerate(exponents(record, thread.x, thread.y, shape, blocks=True)):
                shows = listed & (power >= POWER_MIN)
                weight = dr.minimum(exp2(power), ALPHA_MAX) * transmittance[p]
                behind = transmittance[p] - weight  # negative where the pixel is finished: it blends nothing more
                blends = shows & ((behind > TRANSMITTANCE_MIN) | ~walks.finishes[p])
                weight = dr.select(blends, weight, 0)
                for c, value in enumerate(sums[p]):
                    sums[p][c] = dr.fma(weight, record[6 + c], value)
                finished: Float = dr.select(shows, _negative(transmittance[p]), transmittance[p])
                transmittance[p] = dr.select(blends, behind, finished)
                last[p] = dr.select(blends, k + (u + 1), last[p])
        return k + turn, end, transmittance, sums, last

    state = walks.start, walks.end, walks.transmittance, walks.sums, [ad.UInt32(walks.last) for _ in walks.sums]
    if lists.capacity > 0:
        state = dr.while_loop(state, alive, blend, mode="symbolic", label="blend")
    return state[2:]


def _negative(value: Float) -> Float:
    """-|x|."""
    return cast(Float, dr.reinterpret_array(ad.Float, bits_of(value) | SIGN))


def _of_pixels(values: list[NumberT], lists: TileLists, walks: Walks, otherwise: int, cut: bool) -> NumberT:
    """[T * pixels of a tile] of those of the threads that say it; `otherwise` where lists are cut and none does."""
    shape = lists.shape
    threads = lists.tiles_x * lists.tiles_y * shape.threads
    if not cut:
        return store(values, walks.thread.place, threads)
    target = dr.full(type(values[0]), otherwise, threads * shape.pixels)
    for p, value in enumerate(values):
        dr.scatter(target, value, walks.thread.place * shape.pixels + p, walks.writes[p], dr.ReduceMode.NoConflicts)
    return target


class _Checkpoints:
    """What the blending loop keeps of pixels before each bucket, see `BlendState`."""

    def __init__(self, lists: TileLists, bucket: int, channels: int, walks: Walks) -> None:
        numbers, fours = count_pieces(lists, bucket), -(-(1 + channels) // 4)
        pixels, thread = lists.shape.width * lists.shape.height, walks.thread.place
        self.shape, self.bucket, self.start = lists.shape, bucket, walks.list_start
        self.tile_number, self.within = thread // lists.shape.threads, thread % lists.shape.threads
        self.first = walks.list_start // bucket + self.tile_number
        self.states = [dr.empty(ad.Float, 4 * numbers * pixels) for _ in range(fours)]
        self.reached = dr.zeros(ad.UInt32, numbers)
        self.tile = dr.full(ad.UInt32, lists.tiles_x * lists.tiles_y, numbers)
        begin, length = (walks.start - walks.list_start) // bucket, walks.end - walks.list_start
        until = self.first + (length + (bucket - 1)) // bucket
        name_tiles(self.tile, self.tile_number, self.first + begin + self.within, until, lists.shape.threads)

    def keep(self, k: UInt32, transmittance: list[Float], sums: list[list[Float]]) -> None:
        """Before pair k, where a bucket starts there; of the pixels whose thread still walks."""
        starts = ((k - self.start) & (self.bucket - 1)) == 0
        number, pixels = self.first + (k - self.start) // self.bucket, self.shape.pixels
        dr.scatter(self.reached, ad.UInt32(1), number, active=starts)  # whichever thread still walks
        for p in range(pixels):
            values = [transmittance[p], *sums[p]]
            values += [ad.Float(0)] * (-len(values) % 4)
            place = (number * self.shape.threads + self.within) * pixels + p
            for i, target in enumerate(self.states):
                dr.scatter(target, ad.Array4f(values[4 * i : 4 * i + 4]), place, starts, dr.ReduceMode.NoConflicts)


def backward(
    splats: Splats,
    blended: BlendResult,
    lists: TileLists,
    image_size: tuple[int, int],
    feature_gradients: list[Float],
    transmittance_gradient: Float,
    absolute: bool = True,
) -> SplatGradients:
    """Adjoint of `forward`: from gradients of its planes [height * width] to gradients of the splats [N].

    image_size: (width, height). absolute: sum |d / d x| and |d / d y|, too. With w_i = alpha_i T_i and
    d_i = <dL/dC, f_i>: dL/d alpha_i = T_i d_i - (sum_{j > i} w_j d_j + T_end dL/dT_end) / (1 - alpha_i).
    """
    count, channels = dr.width(splats.x), len(feature_gradients)
    if lists.capacity == 0:
        assert not dr.flag(dr.JitFlag.FreezingScope), "a recording would keep how many splats there are"
        zeros = [dr.opaque(ad.Float, 0, count) for _ in range(9 + channels)]  # no literals: they fold gradients away
        return SplatGradients(Splats(*zeros[:7]), zeros[9:], zeros[7], zeros[8])
    assert blended.state is not None, "blending has kept nothing for its adjoint"
    grad_planes = PlaneGradients(*image_size, feature_gradients, transmittance_gradient)
    if blended.state.bucket:
        return by_buckets(splats, blended.features, blended.state, lists, grad_planes, absolute)
    return by_tiles(splats, blended.state, lists, grad_planes, absolute)


class _Rasterize(dr.CustomOp):
    """`forward` and `backward` as one node of Dr.Jit's graph. Differentiable in reverse mode."""

    def eval(self, splats: Splats, features: list[Float], lists: TileLists, width: int, height: int) -> list[Float]:
        self.splats, self.lists, self.size = splats, lists, (width, height)
        self.blended = forward(splats, features, lists, width, height, adjoint=True)
        return [*self.blended.features, self.blended.transmittance]

    def backward(self) -> None:
        *grad_features, grad_transmittance = cast(list[Float], self.grad_out())
        result = backward(self.splats, self.blended, self.lists, self.size, grad_features, grad_transmittance, False)
        result.splats.depth = dr.opaque(ad.Float, 0, dr.width(self.splats.x))
        self.set_grad_in("splats", result.splats)
        self.set_grad_in("features", result.features)

    def name(self) -> str:
        return "rasterize"


def rasterize(
    splats: Splats, features: list[Float], lists: TileLists, width: int, height: int
) -> tuple[list[Float], Float]:
    """Differentiable blending. Returns (C feature planes, transmittance plane), [height * width] each."""
    if not dr.grad_enabled(splats, features):
        blended = forward(splats, features, lists, width, height)
        return blended.features, blended.transmittance
    outputs: list[Float] = dr.custom(_Rasterize, splats, features, lists, width, height)
    return outputs[:-1], outputs[-1]
