"""Shadow splatting: how much of the Sun's light each Gaussian loses on its way (thesis 4.3.2, 4.7 to 4.10; 4.28).

A Gaussian stands in the light image's lists twice: as a receiver at z - b, its depth less its bias, and as a blocker
at its depth z. In that order each tile walks its list once: a blocker takes its share of the pixels' light, a receiver
notes what has been taken so far, weighted by its footprint. Each (tile, receiver) pair sums into a slot of its own, and
a second pass adds up each receiver's slots in order: the same input gives the same bits.

The adjoint is by hand: it replays the lists from their ends, as `blend.backward` does.
"""

from dataclasses import dataclass
from typing import cast

import drjit as dr

from spacesim.backend import ad, recorded, select
from spacesim.backend.arrays import Array2f, Array3f, Bool, Float, UInt32
from spacesim.data.errors import WorkError
from spacesim.splat.raster.adjoint import PixelMoments, add_to_slots, gather_slots, reduce_mode
from spacesim.splat.raster.cameras import MAX_MAGNITUDE, Orthographic
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.lists.bin import MakeLists, bin_splats
from spacesim.splat.raster.lists.tiles import ThreadPixels, TileLists, round_capacity, thread_offsets, thread_pixels
from spacesim.splat.raster.project import ALPHA_MIN, Footprints, Splats, _sortable, project
from spacesim.splat.raster.records import (
    ALPHA_MAX,
    POWER_MIN,
    TRANSMITTANCE_MIN,
    ListedRecords,
    exp2,
    exponents,
    list_records,
    packet_sizes,
    store,
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
    make_lists: MakeLists = bin_splats,
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
    rows = [dr.detach(row) for row in gaussians.shape_rows()]
    detached = Gaussians.from_rows(rows)
    return differentiable_occlusion(detached, camera, bias, points, antialiased, receives, beta_min, make_lists)


def differentiable_occlusion(
    gaussians: Gaussians,
    camera: Orthographic,
    bias: Float,
    points: Array3f | None = None,
    antialiased: bool = False,
    receives: Bool | None = None,
    beta_min: float = BETA_MIN,
    make_lists: MakeLists = bin_splats,
) -> Float:
    """`occlusion_by_splatting` with gradients (reverse mode) by means, log scales, quaternions and opacities, of the
    blockers' alpha and the receivers' beta. Who is before whom, the bias, and by how much `points` are off the centres
    are taken as given."""
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
    live, capacity = dr.opaque(ad.UInt32, count), round_capacity(count)
    events, boxes = make_events(gaussians.shape_rows(), receivers, camera, antialiased, live, capacity)
    return occlude(events, boxes, camera, count, make_lists)


def occlude(events: Splats, boxes: Footprints, camera: Orthographic, count: int, make_lists: MakeLists) -> Float:
    """Float [N]: occlusion of the N = `count` Gaussians of `make_events`, with gradients by the events where these have
    some."""
    size = camera.width, camera.height
    if not dr.grad_enabled(events):
        return _Walk(events, boxes, size, count, make_lists).occlusion
    try:
        return dr.custom(_Occlusion, events, boxes, size, count, make_lists)
    except RuntimeError as error:  # Dr.Jit wraps what is raised in there
        raise error.__cause__ if isinstance(error.__cause__, WorkError) else error from None


@dataclass
class Receivers:
    """N Gaussians as they receive light, see `occlusion_by_splatting`."""

    bias: Float  #: [N] metres
    points: Array3f | None  #: [3, N] metres
    beta_min: float  #: where their footprints end
    receives: Bool | None = None  #: [N]


@recorded
def make_events(
    rows: list[Float], receivers: Receivers, camera: Orthographic, antialiased: bool, count: UInt32, capacity: int
) -> tuple[Splats, Footprints]:
    """Events [2 capacity] of `count` Gaussians with these `Gaussians.shape_rows`: receivers, then blockers; the rest
    are invisible.

    Receivers come first, so that stable sorting puts them before blockers of the same key: nothing blocks itself, or
    what is equally deep. antialiased: see `occlusion_by_splatting`;  capacity: `round_capacity` of `count`
    """
    event, half = dr.arange(ad.UInt32, 2 * capacity), dr.opaque(ad.UInt32, capacity)  # no number of a kernel's text
    is_receiver = event < half
    index = dr.select(is_receiver, event, event - half)
    live = index < count
    receiving = live & is_receiver
    of_events = dr.custom(_Twice, rows, index, live) if dr.grad_enabled(rows) else _gather_rows(rows, index, live)
    x, y, z, *shape, logit = of_events
    means = ad.Array3f(x, y, z)
    if receivers.points is not None:
        away = dr.gather(ad.Array3f, receivers.points, index, receiving) - dr.detach(means)
        means += dr.select(receiving, away, ad.Array3f(0))
    opacity = ALPHA_MIN / receivers.beta_min  # the cut at ALPHA_MIN falls where a receiver's footprint ends
    ends = is_receiver & (dr.abs(dr.detach(logit)) < MAX_MAGNITUDE)
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


def _gather_rows(rows: list[Float], index: UInt32, live: Bool) -> list[Float]:
    return [dr.gather(ad.Float, row, index, live) for row in rows]


class _Twice(dr.CustomOp):
    """`_gather_rows` of events, whose receivers stand before their blockers, as one node of Dr.Jit's graph: the adjoint
    of two gathers adds to what else there is in an order that nobody knows."""

    def eval(self, rows: list[Float], index: UInt32, live: Bool) -> list[Float]:
        self.count, self.capacity = dr.width(rows[0]), dr.width(index) // 2
        return _gather_rows([dr.detach(row) for row in rows], index, live)

    def backward(self) -> None:
        index = dr.arange(ad.UInt32, self.count)
        places = index, index + dr.opaque(ad.UInt32, self.capacity)
        gradients = cast(list[Float], self.grad_out())
        of_receivers, of_blockers = (_gather_rows(gradients, place, ad.Bool(True)) for place in places)
        self.set_grad_in("rows", [a + b for a, b in zip(of_receivers, of_blockers, strict=True)])

    def name(self) -> str:
        return "rows of receivers and blockers"


def _depth(means: Array3f, camera: Orthographic) -> Float:
    """Light depths [N], metres, without the camera's own distance, for sorting: detached, finite, 0 of one sign."""
    means = dr.detach(means)
    depth = dr.dot(camera.row(2), dr.select(dr.max(dr.abs(means)) < MAX_MAGNITUDE, means, ad.Array3f(0)))
    return dr.select(depth == 0, 0, depth)


@dataclass
class _WalkTape:
    """What `_replay` needs of `_walk`.

    Tile-major: transmittance and one past the last blocker of each pixel [T * pixels of a tile].
    """

    transmittance: Float
    last: UInt32
    records: ListedRecords  #: of the events, of whose capacity one half are receivers


@dataclass
class _WalkResult:
    """What `_walk` leaves behind. occlusion, weight (sum of beta): [capacity]"""

    occlusion: Float
    weight: Float
    tape: _WalkTape | None  #: where it was asked for


Passed = tuple[list[Float], list[UInt32]]  #: transmittance and one past the last blocker of a thread's pixels


@recorded
def _walk(events: Splats, lists: TileLists, image_size: tuple[int, int], capacity: int, adjoint: bool) -> _WalkResult:
    """What each receiver has lost; one thread holds a block of a tile's pixels."""
    shape, pixels, turn = lists.shape, lists.shape.pixels, TURN[select()]
    branches = select() == "cuda"  # where a warp holds one tile, which meets receivers and blockers as one
    records = list_records(events, [], lists, 2 * capacity)
    receivers = dr.opaque(ad.UInt32, capacity)  # no number of a kernel's text, as in `make_events`
    threads, thread = lists.tiles_x * lists.tiles_y * shape.threads, thread_pixels(lists)
    inside = [_inside(thread, offset, image_size) for offset in thread_offsets(shape)]
    slots = dr.zeros(ad.Float, 2 * lists.capacity)
    mode = reduce_mode(8 * lists.capacity, shape)
    end = dr.gather(ad.UInt32, lists.end, thread.tile)

    def remaining(k: UInt32, _transmittance: object, _last: object) -> Bool:
        return k < end

    def note(k: UInt32, powers: list[Float], transmittance: list[Float], last: list[UInt32], active: Bool) -> Passed:
        """What receiver k has lost. All threads note theirs: to ask each whether it has anything to note costs more."""
        lost, weight = ad.Float(0), ad.Float(0)
        for p in range(pixels):
            alpha = dr.minimum(exp2(powers[p]), ALPHA_MAX)
            beta = dr.select(inside[p] & (powers[p] >= POWER_MIN), alpha, 0)
            lost, weight = dr.fma(beta, 1 - transmittance[p], lost), weight + beta
        sums = ad.Array2f(lost, weight)
        dr.scatter_reduce(dr.ReduceOp.Add, slots, sums, lists.sum_index(k, active), active, mode)
        return transmittance, last

    def block(k: UInt32, powers: list[Float], transmittance: list[Float], last: list[UInt32], active: Bool) -> Passed:
        """What blocker k lets through."""
        transmittance, last = list(transmittance), list(last)
        for p in range(pixels):
            blocks = active & (powers[p] >= POWER_MIN) & (transmittance[p] > TRANSMITTANCE_MIN)
            passed = transmittance[p] * (1 - dr.minimum(exp2(powers[p]), ALPHA_MAX))
            transmittance[p] = dr.select(blocks, passed, transmittance[p])
            if adjoint:
                last[p] = dr.select(blocks, k + 1, last[p])
        return transmittance, last

    def take(k: UInt32, transmittance: list[Float], last: list[UInt32]) -> tuple[UInt32, list[Float], list[UInt32]]:
        listed = [k + u < end if u else ad.Bool(True) for u in range(turn)]
        numbers = [dr.gather(ad.UInt32, lists.splat, k + u, listed[u]) for u in range(turn)]
        loaded = [records.load(lists, k + u, listed[u]) for u in range(turn)]
        for u, record in enumerate(loaded):
            powers, receiver = exponents(record, thread.x, thread.y, shape), numbers[u] < receivers
            if branches:
                state = k + u, powers, transmittance, last, listed[u]
                transmittance, last = dr.if_stmt(state, receiver, note, block, mode="symbolic")
            else:
                note(k + u, powers, transmittance, last, receiver)
                transmittance, last = block(k + u, powers, transmittance, last, listed[u] & ~receiver)
        return k + turn, transmittance, last

    state = (
        dr.gather(ad.UInt32, lists.start, thread.tile),
        [ad.Float(1) for _ in range(pixels)],
        [ad.UInt32(0) for _ in range(pixels if adjoint else 0)],
    )
    _, transmittance, last = dr.while_loop(state, remaining, take, mode="symbolic", label="shadow")
    tape = None
    if adjoint:
        tape = _WalkTape(store(transmittance, thread.place, threads), store(last, thread.place, threads), records)
    dr.eval(slots, tape)
    lost, weight = _sum_slots(slots, lists, capacity)
    seen = weight > 0
    occlusion = dr.select(seen, dr.clip(lost / dr.select(seen, weight, 1), 0, 1), 0)
    return _WalkResult(occlusion, weight, tape)


def _inside(thread: ThreadPixels, offset: tuple[int, int], image_size: tuple[int, int]) -> Bool:
    """Is the thread's pixel at an offset from its first one of the picture's?"""
    return (thread.column + offset[0] < image_size[0]) & (thread.row + offset[1] < image_size[1])


def _sum_slots(slots: Float, lists: TileLists, capacity: int) -> Array2f:
    """Array2f [capacity]: the sums over each receiver's slots, in order."""
    index = dr.arange(ad.UInt32, capacity)
    position = dr.gather(ad.UInt32, lists.first_slot, index)
    end = position + dr.gather(ad.UInt32, lists.slot_count, index)

    def remaining(position: UInt32, _total: object) -> Bool:
        return position < end

    def add(position: UInt32, total: Array2f) -> tuple[UInt32, Array2f]:
        return position + 1, total + dr.gather(ad.Array2f, slots, lists.sum_of_slot(position))

    state = position, ad.Array2f(0)
    _, total = dr.while_loop(state, remaining, add, mode="symbolic", label="sum shadow slots")
    return total


@recorded
def _replay(
    events: Splats, walked: _WalkResult, lists: TileLists, image_size: tuple[int, int], gradient: Float
) -> Splats:
    """Adjoint of `_walk`: from gradients of the occlusions [capacity] to gradients of the events.

    With u_i = dL/d occ_i / sum of beta_i: dL/d beta_i = u_i (1 - T_i - occ_i), and
    dL/d alpha_j = (sum over receivers i behind j of u_i beta_i T_i) / (1 - alpha_j).
    """
    shape, thread, offsets = lists.shape, thread_pixels(lists), thread_offsets(lists.shape)
    inside, tape = [_inside(thread, offset, image_size) for offset in offsets], walked.tape
    assert tape is not None, "the way through the lists has kept nothing for its adjoint"
    places = [thread.place * shape.pixels + p for p in range(shape.pixels)]
    transmittance = [dr.gather(ad.Float, tape.transmittance, place) for place in places]
    last = [dr.gather(ad.UInt32, tape.last, place) for place in places]
    shares = dr.select(walked.weight > 0, gradient / dr.maximum(walked.weight, 1e-30), 0)
    dr.eval(shares)
    slots = [dr.zeros(ad.Float, size * lists.capacity) for size in packet_sizes(6)]
    mode = reduce_mode(32 * lists.capacity, shape)
    start = dr.gather(ad.UInt32, lists.start, thread.tile)
    receivers = dr.opaque(ad.UInt32, tape.records.capacity // 2)

    def remaining(k: UInt32, _transmittance: object, _behind: object) -> Bool:
        return k > start

    def replay(k: UInt32, transmittance: list[Float], behind: list[Float]) -> tuple[UInt32, list[Float], list[Float]]:
        k = k - 1
        event = dr.gather(ad.UInt32, lists.splat, k)
        record, receiver = tape.records.load(lists, k), event < receivers
        powers = exponents(record, thread.x, thread.y, shape)
        share = dr.gather(ad.Float, shares, event, receiver)
        occlusion = dr.gather(ad.Float, walked.occlusion, event, receiver)
        transmittance, behind = list(transmittance), list(behind)
        moments = PixelMoments(thread.x - record[0], thread.y - record[1])
        for p, offset in enumerate(offsets):
            unclamped = exp2(powers[p])
            alpha = dr.minimum(unclamped, ALPHA_MAX)
            reached = powers[p] >= POWER_MIN
            receives, blocks = reached & receiver & inside[p], reached & ~receiver & (k < last[p])
            weight = dr.select(receives, alpha * share, 0)
            inverse = dr.rcp(1 - dr.select(blocks, alpha, 0))
            grad_log_beta = weight * (1 - transmittance[p] - occlusion)  # dL / d ln beta
            # dL / d ln alpha
            grad_log_alpha = dr.select(blocks & (unclamped < ALPHA_MAX), behind[p] * inverse * alpha, 0)
            behind[p] = dr.fma(weight, transmittance[p], behind[p])
            transmittance[p] *= inverse
            moments.add(*offset, grad_log_beta + grad_log_alpha)
        add_to_slots(slots, moments.sums(), lists.sum_index(k), mode)
        return k, transmittance, behind

    state = dr.gather(ad.UInt32, lists.end, thread.tile), transmittance, [ad.Float(0) for _ in offsets]
    dr.while_loop(state, remaining, replay, mode="symbolic", label="replay shadow")
    dr.eval(slots)
    gradients: Splats = gather_slots(slots, events, lists, 0, absolute=False).splats
    return gradients


class _Walk:
    """Lists of the events of `count` Gaussians, and what was found on the way through them."""

    def __init__(
        self,
        events: Splats,
        boxes: Footprints,
        size: tuple[int, int],
        count: int,
        make_lists: MakeLists,
        adjoint: bool = False,
    ) -> None:
        self.events, self.size, self.count, self.capacity = events, size, count, round_capacity(count)
        self.lists = make_lists(events, boxes, *size)
        self.result: _WalkResult | None = None
        if self.lists.capacity > 0:
            self.result = _walk(events, self.lists, self.size, self.capacity, adjoint)

    @property
    def occlusion(self) -> Float:
        """[N]"""
        if self.result is None:
            return dr.opaque(ad.Float, 0, self.count)
        return dr.gather(ad.Float, self.result.occlusion, dr.arange(ad.UInt32, self.count))

    def adjoint(self, grad_occlusion: Float) -> Splats:
        """Gradients of the events from that of the occlusion [N]."""
        if self.result is None:
            zero = dr.opaque(ad.Float, 0, 2 * self.capacity)
            return Splats(x=zero, y=zero, a=zero, b=zero, c=zero, opacity=zero, depth=zero)
        receiver = dr.arange(ad.UInt32, self.capacity)
        padded = dr.gather(ad.Float, grad_occlusion, receiver, receiver < dr.opaque(ad.UInt32, self.count))
        return _replay(self.events, self.result, self.lists, self.size, padded)


class _Occlusion(dr.CustomOp):
    """From events [2 capacity] to occlusions [N], as one node of Dr.Jit's graph. Differentiable in reverse mode."""

    def eval(
        self, events: Splats, boxes: Footprints, size: tuple[int, int], count: int, make_lists: MakeLists
    ) -> Float:
        self.walk = _Walk(dr.detach(events), boxes, size, count, make_lists, adjoint=True)
        return self.walk.occlusion

    def backward(self) -> None:
        gradients = self.walk.adjoint(cast(Float, self.grad_out()))
        gradients.depth = dr.opaque(ad.Float, 0, dr.width(gradients.x))
        self.set_grad_in("events", gradients)

    def name(self) -> str:
        return "occlusion by splatting"
