"""Shadow splatting: how much of the Sun's light each Gaussian loses on its way (thesis 4.3.2, 4.7 to 4.10; 4.28).

A Gaussian stands in the light image's lists twice: as a receiver at z - b, its depth less its bias, and as a blocker
at its depth z. In that order each tile walks its list once: a blocker takes its share of the pixels' light, a receiver
notes what has been taken so far, weighted by its footprint. Each (tile, receiver) pair sums into a slot of its own, and
a second pass adds up each receiver's slots in order: the same input gives the same bits.
"""

from dataclasses import dataclass

import drjit as dr

from spacesim.backend import ad, recorded, select
from spacesim.backend.arrays import Array2f, Array3f, Bool, Float, UInt32
from spacesim.splat.light.padded_batch import PaddedBatch
from spacesim.splat.raster.adjoint import reduce_mode
from spacesim.splat.raster.cameras import MAX_MAGNITUDE, Orthographic
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.lists.bin import bin_splats
from spacesim.splat.raster.lists.tiles import TileLists, thread_offsets, thread_pixels
from spacesim.splat.raster.project import ALPHA_MIN, Footprints, Splats, _sortable, project
from spacesim.splat.raster.records import (
    ALPHA_MAX,
    POWER_MIN,
    TRANSMITTANCE_MIN,
    exp2,
    exponents,
    list_records,
    pack_records,
)

BETA_MIN = 0.2  #: a receiver's footprint ends there: 80 % of its weight on 29 % of the area of a cut at 1/255
TURN = {"cuda": 4, "llvm": 1}  #: events a turn of the loop: their numbers are read at once
LEAST_BETA = 0.004  #: least end of a footprint: 99.6 % of its weight; the lists hold nothing below 1/255


def occlusion_by_splatting(
    gaussians: Gaussians,
    camera: Orthographic,
    bias: Float,
    points: Array3f | None = None,
    antialiased: bool = False,
    receives: Bool | None = None,
    beta_min: float = BETA_MIN,
) -> Float:
    """Float [N] in [0, 1], detached: the share of sunlight that is blocked before it reaches each Gaussian.

    For receiver i, the mean over the pixels of its footprint of 1 - T_i, weighted by beta_i (4.7, 4.9, 4.10), with T_i
    the product of 1 - alpha_j over the blockers with z_i - z_j - b_i > 0 (4.8, 4.28). alpha_j is cut off as in pictures
    (docs/explanation/method.md), beta_i below `beta_min`. beta has no opacity in it: faint Gaussians have one, too.

    camera: looks from the Sun at the scene
    bias: Float [N] metres, of each receiver, or one for all; below 0, from 1e9 on or not a number counts as 0
    points: Array3f [3, N], world, metres: where each Gaussian is tested, if not at its centre (`bias.offset_receivers`)
    antialiased: blockers thinner than a pixel of the light image fade
    receives: Bool [N]: who is asked about, all by default; the others block, and have 0
    beta_min: where a receiver's footprint ends, `LEAST_BETA` to below 1
    0 for what cannot be projected and where no pixel of a footprint is inside of the image. Raises ValueError for a
    bias of another length, WorkError where memory is short.
    """
    count = gaussians.count
    if dr.width(bias) not in (1, count):
        raise ValueError(f"bias: expected {count} numbers or one, found {dr.width(bias)}")
    if count == 0:
        return dr.zeros(ad.Float, 0)
    bias, points = dr.detach(bias), None if points is None else dr.detach(points)
    if dr.width(bias) < count:
        bias = bias + dr.zeros(ad.Float, count)
        dr.make_opaque(bias)
    receivers = Receivers(bias, points, beta_min, receives)
    batch, rows = PaddedBatch.of(count), [dr.detach(row) for row in gaussians.shape_rows()]
    events, boxes = make_events(rows, receivers, camera, antialiased, batch)
    lists = bin_splats(events, boxes, camera.width, camera.height)
    if lists.capacity == 0:
        return dr.opaque(ad.Float, 0, count)
    return occlusion_in_events(events, lists, (camera.width, camera.height), batch, rows[0])


@dataclass
class Receivers:
    """N Gaussians as they receive light, see `occlusion_by_splatting`."""

    bias: Float  #: [N] metres
    points: Array3f | None  #: [3, N] metres
    beta_min: float  #: where their footprints end
    receives: Bool | None = None  #: [N]


@recorded
def make_events(
    rows: list[Float], receivers: Receivers, camera: Orthographic, antialiased: bool, batch: PaddedBatch
) -> tuple[Splats, Footprints]:
    """Events [2 M] of N Gaussians with these `Gaussians.shape_rows`: receivers, then blockers; the rest are invisible.

    Receivers come first, so that stable sorting puts them before blockers of the same key: nothing blocks itself, or
    what is equally deep. antialiased: see `occlusion_by_splatting`
    """
    event = dr.arange(ad.UInt32, 2 * batch.capacity)
    is_receiver = event < batch.room
    index = dr.select(is_receiver, event, event - batch.room)
    live = index < batch.count
    receiving = live & is_receiver
    x, y, z, *shape, logit = (dr.gather(ad.Float, row, index, live) for row in rows)
    means = ad.Array3f(x, y, z)
    if receivers.points is not None:
        away = dr.gather(ad.Array3f, receivers.points, index, receiving) - means
        means += dr.select(receiving, away, ad.Array3f(0))
    opacity = ALPHA_MIN / receivers.beta_min  # the cut at ALPHA_MIN falls where a receiver's footprint ends
    ends = is_receiver & (dr.abs(logit) < MAX_MAGNITUDE)
    logit = dr.select(ends, dr.log(ad.Float(opacity / (1 - opacity))), logit)
    events, boxes = project(
        Gaussians.from_rows([*means, *shape, logit]), camera, ~is_receiver if antialiased else False
    )
    boxes.visible &= live
    if receivers.receives is not None:
        boxes.visible &= ~is_receiver | dr.gather(ad.Bool, receivers.receives, index, receiving)
    bias = dr.gather(ad.Float, receivers.bias, index, receiving)
    boxes.order = _sortable(_depth(means, camera) - dr.select((bias > 0) & (bias < MAX_MAGNITUDE), bias, 0))
    return events, boxes


def _depth(means: Array3f, camera: Orthographic) -> Float:
    """Light depths [N], metres, without the camera's own distance, for sorting: finite, 0 of one sign."""
    depth = dr.dot(camera.row(2), dr.select(dr.max(dr.abs(means)) < MAX_MAGNITUDE, means, ad.Array3f(0)))
    return dr.select(depth == 0, 0, depth)


@recorded
def occlusion_in_events(
    events: Splats, lists: TileLists, image_size: tuple[int, int], batch: PaddedBatch, like: Float
) -> Float:
    """[N]: what each receiver of `make_events` has lost. One thread holds a block of a tile's pixels. like: any array
    [N]"""
    shape, pixels, turn = lists.shape, lists.shape.pixels, TURN[select()]
    branches = select() == "cuda"  # where a warp holds one tile, which meets receivers and blockers as one
    records = list_records(pack_records(events, [], 2 * batch.capacity), lists, 2 * batch.capacity)
    thread, (width, height) = thread_pixels(lists), image_size
    inside = [(thread.column + i < width) & (thread.row + j < height) for i, j in thread_offsets(shape)]
    slots = dr.zeros(ad.Float, 2 * lists.capacity)
    mode = reduce_mode(8 * lists.capacity, shape)
    end = dr.gather(ad.UInt32, lists.end, thread.tile)

    def remaining(k: UInt32, _transmittance: object) -> Bool:
        return k < end

    def note(k: UInt32, powers: list[Float], transmittance: list[Float], active: Bool) -> list[Float]:
        """What receiver k has lost. All threads note theirs: to ask each whether it has anything to note costs more."""
        lost, weight = ad.Float(0), ad.Float(0)
        for p in range(pixels):
            alpha = dr.minimum(exp2(powers[p]), ALPHA_MAX)
            beta = dr.select(inside[p] & (powers[p] >= POWER_MIN), alpha, 0)
            lost, weight = dr.fma(beta, 1 - transmittance[p], lost), weight + beta
        sums = ad.Array2f(lost, weight)
        dr.scatter_reduce(dr.ReduceOp.Add, slots, sums, lists.sum_index(k, active), active, mode)
        return transmittance

    def block(_k: UInt32, powers: list[Float], transmittance: list[Float], active: Bool) -> list[Float]:
        """What blocker k lets through."""
        transmittance = list(transmittance)
        for p in range(pixels):
            blocks = active & (powers[p] >= POWER_MIN) & (transmittance[p] > TRANSMITTANCE_MIN)
            passed = transmittance[p] * (1 - dr.minimum(exp2(powers[p]), ALPHA_MAX))
            transmittance[p] = dr.select(blocks, passed, transmittance[p])
        return transmittance

    def take(k: UInt32, transmittance: list[Float]) -> tuple[UInt32, list[Float]]:
        listed = [k + u < end if u else ad.Bool(True) for u in range(turn)]
        numbers = [dr.gather(ad.UInt32, lists.splat, k + u, listed[u]) for u in range(turn)]
        loaded = [records.load(lists, k + u, listed[u]) for u in range(turn)]
        for u, record in enumerate(loaded):
            powers, receiver = list(exponents(record, thread.x, thread.y, shape)), numbers[u] < batch.room
            if branches:
                state = k + u, powers, transmittance, listed[u]
                transmittance = dr.if_stmt(state, receiver, note, block, mode="symbolic")
            else:
                note(k + u, powers, transmittance, receiver)
                transmittance = block(k + u, powers, transmittance, listed[u] & ~receiver)
        return k + turn, transmittance

    state = dr.gather(ad.UInt32, lists.start, thread.tile), [ad.Float(1) for _ in range(pixels)]
    dr.while_loop(state, remaining, take, mode="symbolic", label="shadow")
    dr.eval(slots)
    index = dr.arange(ad.UInt32, dr.width(like))
    lost, weight = _sum_slots(slots, lists, index)
    seen = weight > 0
    occlusion = dr.select(seen, dr.clip(lost / dr.select(seen, weight, 1), 0, 1), 0)
    return dr.select(index < batch.count, occlusion, like)  # as wide as that in each replay, see `PaddedBatch`


def _sum_slots(slots: Float, lists: TileLists, index: UInt32) -> Array2f:
    """Array2f [N]: the sums over the slots of each receiver of number `index`, in order."""
    position = dr.gather(ad.UInt32, lists.first_slot, index)
    end = position + dr.gather(ad.UInt32, lists.slot_count, index)

    def remaining(position: UInt32, _total: object) -> Bool:
        return position < end

    def add(position: UInt32, total: Array2f) -> tuple[UInt32, Array2f]:
        return position + 1, total + dr.gather(ad.Array2f, slots, lists.sum_of_slot(position))

    state = position, ad.Array2f(0)
    _, total = dr.while_loop(state, remaining, add, mode="symbolic", label="sum shadow slots")
    return total
