"""Shadow splatting: how much of the Sun's light each Gaussian loses on its way (thesis 4.3.2, 4.7 to 4.10; 4.28).

A Gaussian stands in the light image's lists twice: as a receiver at z - b, its depth less its bias, and as a blocker
at its depth z. In that order each tile walks its list once: a blocker takes its share of the pixels' light, a receiver
notes what has been taken so far, weighted by its footprint. Each (tile, receiver) pair sums into a slot of its own, and
a second pass adds up each receiver's slots in order: the same input gives the same bits.

The adjoint is by hand: it replays the lists from their ends, as `blend.backward` does.
"""

from dataclasses import dataclass, fields

import drjit as dr

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Array2f, Array3f, Bool, Float, NumberT, UInt32
from spacesim.data.errors import WorkError
from spacesim.splat.raster.adjoint import PixelMoments, add_to_slots, gather_slots, reduce_mode
from spacesim.splat.raster.bin import MakeLists, bin_splats
from spacesim.splat.raster.cameras import MAX_MAGNITUDE, Orthographic
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.project import ALPHA_MIN, Footprints, Splats, _sortable, project
from spacesim.splat.raster.records import (
    ALPHA_MAX,
    POWER_MIN,
    TRANSMITTANCE_MIN,
    exp2,
    exponents,
    list_records,
    load,
    packet_sizes,
    store,
)
from spacesim.splat.raster.tiles import ThreadPixels, TileLists, round_capacity, thread_offsets, thread_pixels

BETA_MIN = 0.05  #: a receiver's footprint ends there: 95 % of its weight on 54 % of the area of a cut at 1/255
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
    bias = dr.detach(bias) + dr.zeros(ad.Float, count)
    dr.make_opaque(bias)
    rows, away = gaussians.shape_rows(), None if points is None else dr.detach(points) - dr.detach(gaussians.means)
    opacity = ALPHA_MIN / beta_min  # of a receiver in the lists
    prepared = _prepare(rows, away, camera, bias, antialiased, receives, opacity)
    blockers, receivers, blocker_boxes, receiver_boxes = prepared
    size = camera.width, camera.height
    try:
        return dr.custom(_Occlusion, blockers, receivers, blocker_boxes, receiver_boxes, size, make_lists)
    except RuntimeError as error:  # Dr.Jit wraps what is raised in there
        raise error.__cause__ if isinstance(error.__cause__, WorkError) else error from None


@recorded
def _prepare(
    rows: list[Float],
    away: Array3f | None,
    camera: Orthographic,
    bias: Float,
    antialiased: bool,
    receives: Bool | None,
    opacity: float,
) -> tuple[Splats, Splats, Footprints, Footprints]:
    """(splats of the blockers, of the receivers, footprints of both), [N], of the Gaussians with these `_rows`.

    away: Array3f [3, N], metres, from the centres to where the receivers are, or None;  opacity: theirs, such that the
    cut at ALPHA_MIN falls where their footprints end
    """
    blockers, blocker_boxes = project(Gaussians.from_rows(rows), camera, antialiased)
    means, shape, logit = ad.Array3f(rows[:3]), rows[3:10], rows[10]
    blocker_boxes.order = _sortable(_depth(means, camera))
    if away is not None:
        means += away
    logit = dr.detach(dr.select(dr.abs(logit) < MAX_MAGNITUDE, dr.log(ad.Float(opacity / (1 - opacity))), logit))
    receivers, receiver_boxes = project(Gaussians.from_rows([*means, *shape, logit]), camera)
    if receives is not None:
        receiver_boxes.visible &= receives
    bias = dr.select((bias > 0) & (bias < MAX_MAGNITUDE), bias, 0)
    receiver_boxes.order = _sortable(_depth(means, camera) - bias)
    return blockers, receivers, blocker_boxes, receiver_boxes


def _depth(means: Array3f, camera: Orthographic) -> Float:
    """Light depths [N], metres, without the camera's own distance, for sorting: detached, finite, 0 of one sign."""
    means = dr.detach(means)
    depth = dr.dot(camera.row(2), dr.select(dr.max(dr.abs(means)) < MAX_MAGNITUDE, means, ad.Array3f(0)))
    return dr.select(depth == 0, 0, depth)


@recorded
def _events(
    blockers: Splats,
    receivers: Splats,
    blocker_boxes: Footprints,
    receiver_boxes: Footprints,
    count: UInt32,
    capacity: int,
) -> tuple[Splats, Footprints]:
    """Events [2 capacity]: receivers, then blockers, of `count` Gaussians; the rest are invisible.

    Receivers come first, so that stable sorting puts them before blockers of the same key: nothing blocks itself, or
    what is equally deep.
    """
    event = dr.arange(ad.UInt32, 2 * capacity)
    receives = event < capacity
    index = dr.select(receives, event, event - capacity)
    live = index < count

    def joined(of_receivers: NumberT, of_blockers: NumberT) -> NumberT:
        receiver = dr.gather(type(of_receivers), of_receivers, index, live & receives)
        return dr.select(receives, receiver, dr.gather(type(of_blockers), of_blockers, index, live & ~receives))

    events = Splats(**{f.name: joined(getattr(receivers, f.name), getattr(blockers, f.name)) for f in fields(Splats)})
    boxes = Footprints(
        **{f.name: joined(getattr(receiver_boxes, f.name), getattr(blocker_boxes, f.name)) for f in fields(Footprints)}
    )
    boxes.visible &= live
    return events, boxes


@dataclass
class _WalkResult:
    """What `_walk` leaves behind. occlusion, weight (sum of beta): [capacity]

    Tile-major, for the adjoint: transmittance and one past the last blocker of each pixel [T * threads * rows]; the
    events' records in list order, see `records.BlendState`.
    """

    occlusion: Float
    weight: Float
    transmittance: Float
    last: UInt32
    records: list[Float]


@recorded
def _walk(events: Splats, lists: TileLists, image_size: tuple[UInt32, UInt32], capacity: int) -> _WalkResult:
    """What each receiver has lost; one thread holds a block of a tile's pixels."""
    shape, pixels = lists.shape, lists.shape.pixels
    receives = dr.select(dr.arange(ad.UInt32, 2 * capacity) < capacity, ad.Float(1), ad.Float(0))
    records = list_records(events, [receives], lists, round_capacity(2 * capacity))
    threads, thread = lists.tiles_x * lists.tiles_y * shape.threads, thread_pixels(lists)
    inside = [_inside(thread, offset, image_size) for offset in thread_offsets(shape)]
    slots = dr.zeros(ad.Float, 2 * lists.capacity)
    mode = reduce_mode(8 * lists.capacity, shape)
    end = dr.gather(ad.UInt32, lists.end, thread.tile)

    def remaining(k: UInt32, _transmittance: object, _last: object) -> Bool:
        return k < end

    def take(k: UInt32, transmittance: list[Float], last: list[UInt32]) -> tuple[UInt32, list[Float], list[UInt32]]:
        record = load(records, k, lists.capacity)
        powers = exponents(record, thread.x, thread.y, shape)
        receiver = record[6] > 0
        transmittance, last = list(transmittance), list(last)
        lost, weight = ad.Float(0), ad.Float(0)
        for p in range(pixels):
            alpha = dr.minimum(exp2(powers[p]), ALPHA_MAX)
            reached = powers[p] >= POWER_MIN
            beta = dr.select(reached & inside[p], alpha, 0)
            lost, weight = dr.fma(beta, 1 - transmittance[p], lost), weight + beta
            blocks = reached & ~receiver & (transmittance[p] > TRANSMITTANCE_MIN)
            transmittance[p] = dr.select(blocks, transmittance[p] * (1 - alpha), transmittance[p])
            last[p] = dr.select(blocks, k + 1, last[p])
        slot = lists.sum_index(k)
        noted = receiver & (weight > 0)
        dr.scatter_reduce(dr.ReduceOp.Add, slots, ad.Array2f(lost, weight), slot, active=noted, mode=mode)
        return k + 1, transmittance, last

    state = (
        dr.gather(ad.UInt32, lists.start, thread.tile),
        [ad.Float(1) for _ in range(pixels)],
        [ad.UInt32(0) for _ in range(pixels)],
    )
    _, transmittance, last = dr.while_loop(state, remaining, take, mode="symbolic", label="shadow")
    transmittance, last = store(transmittance, thread.place, threads), store(last, thread.place, threads)
    dr.eval(slots, transmittance, last)
    lost, weight = _sum_slots(slots, lists, capacity)
    seen = weight > 0
    occlusion = dr.select(seen, dr.clip(lost / dr.select(seen, weight, 1), 0, 1), 0)
    return _WalkResult(occlusion, weight, transmittance, last, records)


def _inside(thread: ThreadPixels, offset: tuple[int, int], image_size: tuple[UInt32, UInt32]) -> Bool:
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
    events: Splats, walked: _WalkResult, lists: TileLists, image_size: tuple[UInt32, UInt32], gradient: Float
) -> Splats:
    """Adjoint of `_walk`: from gradients of the occlusions [capacity] to gradients of the events.

    With u_i = dL/d occ_i / sum of beta_i: dL/d beta_i = u_i (1 - T_i - occ_i), and
    dL/d alpha_j = (sum over receivers i behind j of u_i beta_i T_i) / (1 - alpha_j).
    """
    shape, thread, offsets = lists.shape, thread_pixels(lists), thread_offsets(lists.shape)
    inside = [_inside(thread, offset, image_size) for offset in offsets]
    places = [thread.place * shape.pixels + p for p in range(shape.pixels)]
    transmittance = [dr.gather(ad.Float, walked.transmittance, place) for place in places]
    last = [dr.gather(ad.UInt32, walked.last, place) for place in places]
    shares = dr.select(walked.weight > 0, gradient / dr.maximum(walked.weight, 1e-30), 0)
    dr.eval(shares)
    slots = [dr.zeros(ad.Float, size * lists.capacity) for size in packet_sizes(6)]
    mode = reduce_mode(32 * lists.capacity, shape)
    start = dr.gather(ad.UInt32, lists.start, thread.tile)

    def remaining(k: UInt32, _transmittance: object, _behind: object) -> Bool:
        return k > start

    def replay(k: UInt32, transmittance: list[Float], behind: list[Float]) -> tuple[UInt32, list[Float], list[Float]]:
        k = k - 1
        record = load(walked.records, k, lists.capacity)
        powers = exponents(record, thread.x, thread.y, shape)
        receiver = record[6] > 0
        event = dr.gather(ad.UInt32, lists.splat, k)
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
    gradients: Splats = gather_slots(slots, events, lists, 0).splats
    return gradients


class _Occlusion(dr.CustomOp):
    """From splats [N] to occlusions [N], as one node of Dr.Jit's graph. Differentiable in reverse mode."""

    def eval(
        self,
        blockers: Splats,
        receivers: Splats,
        blocker_boxes: Footprints,
        receiver_boxes: Footprints,
        image_size: tuple[int, int],
        make_lists: MakeLists,
    ) -> Float:
        # Sizes in arrays: dr.freeze (1.5) takes one number for another where both have occurred among the arguments.
        self.size = dr.opaque(ad.UInt32, image_size[0]), dr.opaque(ad.UInt32, image_size[1])
        self.count = dr.width(blockers.x)
        count = dr.opaque(ad.UInt32, self.count)
        self.capacity = round_capacity(self.count)
        self.events, boxes = _events(
            dr.detach(blockers), dr.detach(receivers), blocker_boxes, receiver_boxes, count, self.capacity
        )
        self.lists = make_lists(self.events, boxes, *image_size)
        if self.lists.capacity == 0:
            return dr.opaque(ad.Float, 0, self.count)
        self.walked = _walk(self.events, self.lists, self.size, self.capacity)
        return dr.gather(ad.Float, self.walked.occlusion, dr.arange(ad.UInt32, self.count))

    def backward(self) -> None:
        index, capacity = dr.arange(ad.UInt32, self.count), self.capacity
        none = dr.opaque(ad.Float, 0, self.count)
        zero = dr.opaque(ad.Float, 0, 2 * capacity)
        grad_events = Splats(x=zero, y=zero, a=zero, b=zero, c=zero, opacity=zero, depth=zero)
        if self.lists.capacity > 0:
            receiver = dr.arange(ad.UInt32, capacity)
            padded = dr.gather(ad.Float, self.grad_out(), receiver, receiver < dr.opaque(ad.UInt32, self.count))
            grad_events = _replay(self.events, self.walked, self.lists, self.size, padded)
        for name, first in (("receivers", 0), ("blockers", capacity)):
            x, y, a, b, c, opacity = (
                dr.gather(ad.Float, value, index + first)
                for value in (
                    grad_events.x,
                    grad_events.y,
                    grad_events.a,
                    grad_events.b,
                    grad_events.c,
                    grad_events.opacity,
                )
            )
            self.set_grad_in(name, Splats(x, y, a, b, c, opacity, none))

    def name(self) -> str:
        return "occlusion by splatting"
