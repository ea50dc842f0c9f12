"""What each Gaussian sees around it: which others rays from it meet first, in directions all around.

Light that bounces comes along these rays (`bounce`), so that what stands in between hides it, and what overlaps counts
once. To rays, Gaussians are discs across their two longer axes. They are traced when a model is first lit, and in
training now and then (`are_due`): in between, Gaussians that come see what those see that they were made of.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import cast

import drjit as dr
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from spacesim.backend import ad, select
from spacesim.backend.arrays import Array3f, Array4f, Bool, Float, UInt32
from spacesim.backend.memory import check_free_memory
from spacesim.backend.packet import load, packets, store
from spacesim.backend.upload import upload, upload_rows
from spacesim.data.geometry import Array, fibonacci_sphere
from spacesim.learning.reflectance import unit_normals
from spacesim.splat.light.disc_grid import MISSED, DiscGrid
from spacesim.splat.raster.gaussians import Gaussians, opacities, principal_axes
from spacesim.splat.raster.lists.tiles import round_capacity

#: steps of training after which rays are traced anew: the first, then each so many, and from `EARLY` on each so many
FIRST, OFTEN, EARLY, RARELY = 50, 200, 1000, 500
RECOVERY = 200  #: steps after an opacity reset until most opacities stop rays again
MOST_RAYS = 512  #: from each Gaussian; docs/research/light.md
LEAST_RAYS = 128  #: from each Gaussian
EMITTERS_PER_RAY = 8  #: while that makes neither more nor fewer rays
OPAQUE = 0.35  #: a Gaussian of no more opacity stops no ray
EDGE = 0.3  #: where its opacity has fallen to this, a Gaussian ends for rays
AWAY = 4.0  #: standard deviations of a Gaussian from which its rays start, along its normal: over its neighbours
FARTHEST = 0.05  #: of the model's radius: they start no farther away than this
LEAST_SCALE = 1e-5  #: of the model's radius: no disc is smaller
FARTHEST_DISC = 4.0  #: of the model's radius: what is farther away from its middle is no part of it
CHOSEN = 0.1  #: of the model's radius: a Gaussian counts no more for the choice of emitters than one of this size
NORMALS_APART = 0.05  #: of the model's radius: how much a normal counts beside a place where the nearest is sought
CELLS = 1 << 10  #: on a side of the model, along whose curve emitters are chosen
MIDDLE_STEP = 0.25  #: of the model's radius: the curve's cube moves by so much at least
SOME = 10_000  #: Gaussians that say where the middle of a model is
SKY = 0xFFFF  #: in place of an emitter's side: nothing
#: cosine to the normal up to which a ray is along the surface. Normals turn until rays are traced again, early in
#: training by more than that; with 0.3 pictures are as good
LEVEL = 0.1
SOURCE = "surfaces.source"  #: in checkpoints
GONE = 0xFFFFFFFF  #: in place of a Gaussian's number
RAYS_AT_ONCE = {"cuda": 1 << 25, "llvm": 1 << 21}  #: so that they take little memory

Indices = NDArray[np.signedinteger] | NDArray[np.unsignedinteger]


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Gaussians as rays meet them, N of them, float32."""

    means: NDArray[np.float32]  #: [N, 3] metres
    log_scales: NDArray[np.float32]  #: [N, 3]
    quaternions: NDArray[np.float32]  #: [N, 4]
    logit_opacities: NDArray[np.float32]  #: [N]
    normals: NDArray[np.float32]  #: [N, 3] of any length

    @staticmethod
    def of(gaussians: Gaussians, first_normal: int) -> "Surfaces":
        """first_normal: row of the features from which on normals stand"""
        assert gaussians.features is not None, "normals are features"
        shape = (gaussians.means, gaussians.log_scales, gaussians.quaternions)
        means, log_scales, quaternions = (np.ascontiguousarray(vectors.numpy().T) for vectors in shape)
        first, count = first_normal * gaussians.count, gaussians.count
        index = dr.arange(ad.UInt32, 3 * count) + dr.opaque(ad.UInt32, first)
        normals = dr.gather(ad.Float, gaussians.features, index).numpy().reshape(3, count)
        opacity = gaussians.logit_opacities.numpy().copy()
        return Surfaces(means, log_scales, quaternions, opacity, np.ascontiguousarray(normals.T))

    def tensors(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        return {f"surfaces.{field.name}": getattr(self, field.name) for field in fields(self)}

    @staticmethod
    def from_tensors(tensors: Mapping[str, np.ndarray]) -> "Surfaces | None":
        """The inverse of `tensors`; None where a checkpoint holds none. Raises KeyError where some are missing,
        ValueError where shapes do not fit."""
        if not any(name.startswith("surfaces.") for name in tensors):
            return None
        shapes = {"means": (3,), "log_scales": (3,), "quaternions": (4,), "logit_opacities": (), "normals": (3,)}
        values = {name: tensors[f"surfaces.{name}"] for name in shapes}
        count = len(values["means"])
        for name, shape in shapes.items():
            if values[name].shape != (count, *shape):
                raise ValueError(f"surfaces.{name}: expected {(count, *shape)}, found {values[name].shape}")
        return Surfaces(**{name: np.asarray(value, np.float32) for name, value in values.items()})


@dataclass
class Surroundings:
    """What N Gaussians see along R rays each, whose directions are the same for all: of the rays that meet something,
    one Gaussian's after another's."""

    emitters: UInt32  #: the Gaussians that stand for all where light comes from, [`LightConfig.bounce`]
    #: of each such ray in the lower 16 bits twice the number of the emitter, and 1 more where the ray meets the side to
    #: which its normal does not point; above them the ray's number
    met: UInt32
    #: where a Gaussian's rays stand in `met`, [4 N], row by row: the first; the first on the side to which its normal
    #: does not point; one past the last on the other; one past the last. Those along the surface (`LEVEL`) are on both
    bounds: UInt32
    #: the Gaussians by how many of their rays are on the side that has fewer, as a rule the one that is seen: threads
    #: that run together take as long, and the longest begin first. Then the numbers from N up to `round_capacity(N)`
    order: UInt32
    directions: list[Float]  #: a ray's is a record, see `records.load`

    def of(self, source: UInt32, count: int) -> "Surroundings":
        """What Gaussians see each of which was `source` [M] of the `count` that saw this. One that emits and has gone
        does so from the place of the emitter before it, which is mostly near."""
        sources = source.numpy()
        first = np.full(count, GONE, np.uint32)
        first[sources[::-1]] = np.arange(len(sources), dtype=np.uint32)[::-1]  # the first of several is written last
        emitters = first[self.emitters.numpy()]
        is_gone = emitters == GONE
        if is_gone.all():
            emitters[:] = 0
        else:
            numbers = np.where(is_gone, np.argmin(is_gone), np.arange(len(emitters)))
            emitters = emitters[np.maximum.accumulate(numbers)]
        bounds = self.bounds.numpy().reshape(4, count)[:, sources]
        return Surroundings(upload(emitters, ad.UInt32), self.met, *_bounds_and_order(bounds), self.directions)


class HeldSurroundings:
    """What Gaussians saw when rays were traced last, for them and those that they have become.

    surfaces: what rays met, M
    source: which of the M each Gaussian was, UInt32 [N]; None: there are still the same
    """

    def __init__(self, surfaces: Surfaces, source: UInt32 | None = None) -> None:
        self.surfaces, self.source = surfaces, source
        self._traced: Surroundings | None = None
        self._now: Surroundings | None = None

    @property
    def count(self) -> int:
        """Gaussians now, N."""
        return len(self.surfaces.means) if self.source is None else dr.width(self.source)

    def follow(self, source: UInt32) -> None:
        """Each Gaussian was `source` [N] of those before."""
        self.source = source if self.source is None else dr.gather(ad.UInt32, self.source, source)
        dr.eval(self.source)
        self._now = None

    def surroundings(self, emitters: int, radius: float, count: int) -> Surroundings:
        """Of so many Gaussians; rays are traced at the first call. emitters, radius: see `look_around`. Raises
        ValueError where these are others."""
        if self.count != count:
            raise ValueError(f"surroundings: held for {self.count} Gaussians, found {count}")
        if self._traced is None:
            self._traced = look_around(self.surfaces, emitters, radius)
        if self._now is None:
            all_of = self._traced
            self._now = all_of if self.source is None else all_of.of(self.source, len(self.surfaces.means))
        return self._now

    def tensors(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        source = {} if self.source is None else {SOURCE: self.source.numpy().astype(np.float64)}
        return self.surfaces.tensors() | source

    @staticmethod
    def from_tensors(tensors: Mapping[str, np.ndarray], count: int) -> "HeldSurroundings | None":
        """The inverse of `tensors`, of so many Gaussians; None where a checkpoint holds none. Raises KeyError where
        some are missing, ValueError where they do not fit."""
        surfaces = Surfaces.from_tensors(tensors)
        if surfaces is None:
            return None
        total, source = len(surfaces.means), tensors.get(SOURCE)
        expected, found = (count,), (total,) if source is None else source.shape
        if found != expected or (source is not None and not ((source >= 0) & (source < total)).all()):
            raise ValueError(f"{SOURCE}: expected {count} numbers of {total} Gaussians, found others")
        return HeldSurroundings(surfaces, None if source is None else upload(source, ad.UInt32))


def are_due(step: int) -> bool:
    """Whether rays are traced anew after so many steps, the first time before the first."""
    return step == FIRST or step % (OFTEN if step < EARLY else RARELY) == 0


def ray_count(emitters: int) -> int:
    """R, even."""
    return min(max(emitters // EMITTERS_PER_RAY, LEAST_RAYS), MOST_RAYS) // 2 * 2


def look_around(surfaces: Surfaces, emitters: int, radius: float) -> Surroundings:
    """Trace the rays. emitters: how many;  radius: of the model, metres. Raises MemoryError where what they meet does
    not fit into memory."""
    directions, count = fibonacci_sphere(ray_count(emitters)), len(surfaces.means)
    _check_memory(len(directions) // 2 * count, count)
    packed = _packed(directions)
    shapes = _Shapes.of(surfaces, radius)
    order = _order(shapes)
    numbers, emitter_of = _choose(shapes, order, emitters)
    seen = dr.opaque(ad.UInt32, SKY | SKY << 16, len(directions) // 2 * count)
    discs = _Discs.of(shapes)
    if discs is not None:
        _trace(seen, shapes, discs, directions, order, emitter_of)
    result = Surroundings(upload(numbers, ad.UInt32), *_met(seen, shapes.normals, packed, len(directions)), packed)
    dr.eval(result)
    return result


def _packed(directions: Array) -> list[Float]:
    """`Surroundings.directions` of [R, 3]."""
    ray, rows = dr.arange(ad.UInt32, len(directions)), [upload(row) for row in directions.T]
    return [store(values, ray, len(directions)) for values in packets(rows)]


def _check_memory(numbers: int, count: int) -> None:
    """Raise MemoryError where so many numbers do not fit into memory. count: Gaussians"""
    work = f"light that bounces onto {count} Gaussians"
    if numbers >= 2**32:
        raise MemoryError(f"{work} has more rays than 32 bits can number")
    check_free_memory(4 * numbers, work)


def _met(seen: UInt32, normals: Array3f, directions: list[Float], rays: int) -> tuple[UInt32, UInt32, UInt32]:
    """(`Surroundings.met`, bounds, order) of what N Gaussians see. seen: of rays 2 k and 2 k + 1 of Gaussian i in place
    k N + i, 16 bits each, the lower ones first: as in `Surroundings.met`, or SKY for nothing"""
    gaussian, count = dr.arange(ad.UInt32, dr.width(normals)), dr.opaque(ad.UInt32, dr.width(normals))

    def has_more(pair: UInt32, _state: object) -> Bool:
        return pair < rays // 2

    def met(pair: UInt32) -> Iterator[tuple[UInt32, list[Bool]]]:
        """Of both rays: what stands in `Surroundings.met`, whether it is before, along, behind the surface."""
        word = dr.gather(ad.UInt32, seen, pair * count + gaussian)
        for half, side in enumerate((word & 0xFFFF, word >> 16)):
            ray = 2 * pair + half
            cosine = dr.dot(normals, ad.Array3f(load(directions, ray, rays)[:3]))
            before, behind = cosine > LEVEL, cosine < -LEVEL
            yield ray << 16 | side, [(side != SKY) & part for part in (before, ~(before | behind), behind)]

    def counted(numbers: list[UInt32], parts: list[Bool]) -> list[UInt32]:
        return [number + dr.select(part, ad.UInt32(1), 0) for number, part in zip(numbers, parts, strict=True)]

    def count_met(pair: UInt32, numbers: list[UInt32]) -> tuple[UInt32, list[UInt32]]:
        for _, parts in met(pair):
            numbers = counted(numbers, parts)
        return pair + 1, numbers

    nothing = [dr.zeros(ad.UInt32, dr.width(normals)) for _ in range(3)]
    _, numbers = dr.while_loop((ad.UInt32(0), nothing), has_more, count_met, mode="symbolic", label="count rays")
    dr.eval(numbers)
    before, along, behind = (number.numpy().astype(np.int64) for number in numbers)
    end = np.cumsum(before + along + behind)
    capacity = round_capacity(int(end[-1]))
    _check_memory(capacity, len(end))
    target = dr.zeros(ad.UInt32, capacity)
    dr.eval(target)
    bounds = np.stack([end - behind - along - before, end - behind - along, end - behind, end]).astype(np.uint32)

    def write_met(pair: UInt32, places: list[UInt32]) -> tuple[UInt32, list[UInt32]]:
        for value, parts in met(pair):
            for place, part in zip(places, parts, strict=True):
                dr.scatter(target, value, place, part)
            places = counted(places, parts)
        return pair + 1, places

    first = [upload(row, ad.UInt32) for row in bounds[:3]]
    dr.while_loop((ad.UInt32(0), first), has_more, write_met, mode="symbolic", label="list rays")
    dr.eval(target)
    return target, *_bounds_and_order(bounds)


def _bounds_and_order(bounds: Indices) -> tuple[UInt32, UInt32]:
    """(`Surroundings.bounds`, order) of [4, N]."""
    first, behind, past, end = bounds
    missing = MOST_RAYS - np.minimum(past - first, end - behind)
    order = np.argsort(missing.astype(np.uint16), kind="stable")
    beyond = np.arange(len(order), round_capacity(len(order)))
    return upload(bounds.ravel(), ad.UInt32), upload(np.concatenate([order, beyond]).astype(np.uint32), ad.UInt32)


@dataclass
class _Shapes:
    """N surfaces as tracing takes them."""

    radius: float  #: of the model, metres
    middle: list[float]  #: of the model, metres
    means: Array3f  #: [3, N] metres
    is_part: Bool  #: [N] of the model, and not far away
    scales: Array3f  #: [3, N] metres
    quaternions: Array4f  #: [4, N]
    opacities: Float  #: [N] in [0, 1]; 0 of what is no number
    normals: Array3f  #: [3, N], unit
    areas: Float  #: [N] m^2: the product of the two longer scales

    @staticmethod
    def of(surfaces: Surfaces, radius: float) -> "_Shapes":
        middle = _middle(surfaces).tolist()
        rows = (surfaces.means, surfaces.log_scales, surfaces.normals)
        means, log_scales, normals = (upload_rows(values.T) for values in rows)
        scales, opacity = dr.exp(log_scales), opacities(upload(surfaces.logit_opacities))
        x, y, z = scales
        is_part = ad.Bool(True)
        # axis by axis: the larger of two numbers may hide what is none
        for column, place in zip(means, middle, strict=True):
            is_part &= dr.abs(column - place) < FARTHEST_DISC * radius
        shapes = _Shapes(
            radius,
            middle,
            means,
            is_part,
            scales,
            ad.Array4f([upload(row) for row in surfaces.quaternions.T]),
            dr.select(dr.isfinite(opacity), opacity, 0),
            unit_normals(normals),
            dr.maximum(dr.maximum(x * y, y * z), z * x),
        )
        dr.eval(shapes)
        return shapes


@dataclass
class _Discs:
    """What stops rays."""

    numbers: UInt32  #: of the Gaussians, [n]
    centers: Array3f  #: [3, n] metres
    axes: list[Array3f]  #: two of [3, n] metres, the semi-axes

    @staticmethod
    def of(shapes: _Shapes) -> "_Discs | None":
        """None where nothing stops rays."""
        opacity, scales = shapes.opacities, dr.maximum(shapes.scales, LEAST_SCALE * shapes.radius)
        reach = dr.sqrt(2 * dr.log(dr.maximum(opacity, OPAQUE) / EDGE))
        length2 = dr.squared_norm(shapes.quaternions)
        keep = shapes.is_part & (opacity > OPAQUE) & (length2 > 0) & dr.isfinite(length2)
        for scale in scales:
            keep &= scale * reach < shapes.radius
        numbers = cast(UInt32, dr.compress(keep))
        if not len(numbers):
            return None
        centers, scales = (dr.gather(ad.Array3f, vectors, numbers) for vectors in (shapes.means, scales))
        directions = principal_axes(dr.gather(ad.Array4f, shapes.quaternions, numbers))
        reach = dr.gather(ad.Float, reach, numbers)
        x, y, z = (reach * scale * direction for scale, direction in zip(scales, directions, strict=True))
        is_x, is_z = (scales.x <= scales.y) & (scales.x <= scales.z), scales.z < dr.minimum(scales.x, scales.y)
        return _Discs(numbers, centers, [dr.select(is_x, y, x), dr.select(is_x | ~is_z, z, y)])


def _trace(
    seen: UInt32, shapes: _Shapes, discs: _Discs, directions: Array, order: Indices, emitter_of: Indices
) -> None:
    """Fill in what is `seen`, see `_met`. order: of `_order`: rays that follow on each other take as long;
    emitter_of: as `_choose` says"""
    grid, count = DiscGrid.of(discs.centers, discs.axes), len(order)
    # of areas that are no number, too: nothing
    distance: Float = dr.select(shapes.areas > 0, AWAY * dr.sqrt(shapes.areas), 0)
    distance = dr.minimum(distance, FARTHEST * shapes.radius)
    towards, gaussians = upload_rows(directions.T), dr.opaque(ad.UInt32, count)
    turn, emitter = (upload(numbers, ad.UInt32) for numbers in (order, emitter_of))
    dr.eval(distance)
    pairs, at_once = len(directions) // 2, max(RAYS_AT_ONCE[select()] // (2 * count), 1)
    for first in range(0, pairs, at_once):
        slot = dr.arange(ad.UInt32, min(at_once, pairs - first) * count) + dr.opaque(ad.UInt32, first * count)
        pair, word = slot // gaussians, ad.UInt32(0)
        index = dr.gather(ad.UInt32, turn, slot % gaussians)
        for half in (0, 1):
            direction = dr.gather(ad.Array3f, towards, 2 * pair + half)
            side = dr.gather(ad.Array3f, shapes.normals, index)
            over = dr.select(dr.dot(side, direction) < 0, -1, 1) * dr.gather(ad.Float, distance, index)
            start = dr.gather(ad.Array3f, shapes.means, index) + over * side
            disc = grid.first_met(start, direction, dr.isfinite(dr.sum(start)))
            hit = disc != MISSED
            number = dr.gather(ad.UInt32, discs.numbers, disc, hit)
            is_back = dr.dot(dr.gather(ad.Array3f, shapes.normals, number, hit), direction) > 0
            met = dr.gather(ad.UInt32, emitter, number, hit)
            word |= dr.select(hit, 2 * met + dr.select(is_back, ad.UInt32(1), 0), SKY) << (16 * half)
        dr.scatter(seen, word, pair * gaussians + index)
        dr.eval(seen)


def _order(shapes: _Shapes) -> Indices:
    """[N] the Gaussians by the axis along which their normals point most, then along a curve through all cells of a
    cube about the model (Morton 1966): near ones are mostly near in it."""
    normal = shapes.normals
    x, y, z = dr.abs(normal)
    axis = dr.select((x >= y) & (x >= z), ad.UInt32(0), dr.select(y >= z, ad.UInt32(1), 2))
    side = 2 * axis + dr.select(dr.select(axis == 0, normal.x, dr.select(axis == 1, normal.y, normal.z)) < 0, 1, 0)
    curve = ad.UInt32(0)
    step = MIDDLE_STEP * shapes.radius  # so that a Gaussian more does not move the curve
    for number, (column, place) in enumerate(zip(shapes.means, shapes.middle, strict=True)):
        cell = (column - round(place / step) * step) * (CELLS / (4 * shapes.radius)) + CELLS / 2
        spread = ad.UInt32(dr.select(cell > 0, dr.minimum(cell, CELLS - 1), 0))
        for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
            spread = (spread | spread << shift) & mask
        curve |= spread << number
    dr.eval(side, curve)
    # 3 bits of the side, 30 of the place on the curve, 31 of the number: no two keys are equal
    keys = side.numpy().astype(np.uint64) << np.uint64(61) | curve.numpy().astype(np.uint64) << np.uint64(31)
    return np.sort(keys | np.arange(len(keys), dtype=np.uint64)) & np.uint64(0x7FFFFFFF)


def _choose(shapes: _Shapes, order: Indices, count: int) -> tuple[Indices, Indices]:
    """(emitters [count], which of them stands for each Gaussian [N]): one in the middle of each of `count` parts of
    equal area of the Gaussians in their `order`; all, once each, where they are no more. The nearest stands for a
    Gaussian, by place and normal."""
    total = len(order)
    if total <= count:
        return np.resize(np.arange(total, dtype=np.uint32), count), np.arange(total, dtype=np.uint32)
    weight = dr.minimum(shapes.areas, (CHOSEN * shapes.radius) ** 2) * shapes.opacities
    is_sound = shapes.is_part & (weight > 0)
    weight, place = dr.select(is_sound, weight, 0), dr.select(is_sound, shapes.means, 0)
    normal = dr.select(dr.isfinite(shapes.normals), shapes.normals, 0)
    dr.eval(weight, place, normal)
    ends = np.cumsum(weight.numpy()[order], dtype=np.float64)
    if ends[-1] == 0:
        return np.zeros(count, np.uint32), np.zeros(total, np.uint32)
    middles = (np.arange(count) + 0.5) / count * ends[-1]
    emitters = order[np.searchsorted(ends, middles, side="right")].astype(np.uint32)
    places = np.stack([*place.numpy(), *(NORMALS_APART * shapes.radius * normal.numpy())], axis=1, dtype=np.float64)
    _, nearest = cKDTree(places[emitters]).query(places, workers=-1)
    return emitters, nearest.astype(np.uint32)


def _middle(surfaces: Surfaces) -> Array:
    """[3] metres: the median of the places that are numbers, of some of many."""
    means = surfaces.means[:: max(len(surfaces.means) // SOME, 1)]
    means = means[np.isfinite(means).all(axis=1)].astype(np.float64)
    return np.median(means, axis=0) if len(means) else np.zeros(3)
