"""What each Gaussian sees around it: which others rays from it meet first, in directions all around.

Light that bounces comes along these rays (`bounce`), so that what stands in between hides it, and what overlaps counts
once. To rays, Gaussians are discs across their two longer axes. They are traced when a model is first lit, and in
training each time that Gaussians come or go, and now and then (`are_due`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields

import drjit as dr
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from spacesim.backend import ad, select
from spacesim.backend.arrays import Array3f, Float, UInt32
from spacesim.backend.upload import upload
from spacesim.data.geometry import Array, fibonacci_sphere, rotation_from_quaternion
from spacesim.splat.light.disc_grid import MISSED, DiscGrid
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.records import packets, store

#: steps of training after which rays are traced anew: the first ones, and each so many from the last of them on, which
#: none of them is near an opacity reset, after which rays meet nothing
FIRST, EVERY = (50, 100, 200), 500
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
SKY = 0xFFFF  #: of `Surroundings.seen`: nothing
RAYS_AT_ONCE = {"cuda": 1 << 25, "llvm": 1 << 21}  #: so that they take little memory


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
        arrays = gaussians.to_numpy()
        normals = arrays["features"][:, first_normal : first_normal + 3]
        arrays = {field.name: arrays[field.name] for field in fields(Surfaces) if field.name != "normals"}
        return Surfaces(**arrays, normals=np.ascontiguousarray(normals))

    def tensors(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        return {f"surfaces.{field.name}": getattr(self, field.name) for field in fields(self)}

    @staticmethod
    def from_tensors(tensors: Mapping[str, np.ndarray], count: int) -> "Surfaces | None":
        """The inverse of `tensors`, of so many; None where a checkpoint holds none. Raises KeyError where some are
        missing, ValueError where shapes do not fit."""
        if not any(name.startswith("surfaces.") for name in tensors):
            return None
        shapes = {"means": (3,), "log_scales": (3,), "quaternions": (4,), "logit_opacities": (), "normals": (3,)}
        values = {name: tensors[f"surfaces.{name}"] for name in shapes}
        for name, shape in shapes.items():
            if values[name].shape != (count, *shape):
                raise ValueError(f"surfaces.{name}: expected {(count, *shape)}, found {values[name].shape}")
        return Surfaces(**{name: np.asarray(value, np.float32) for name, value in values.items()})


@dataclass
class Surroundings:
    """What N Gaussians see along R rays each, whose directions are the same for all."""

    emitters: UInt32  #: the Gaussians that stand for all where light comes from, [`LightConfig.bounce`]
    #: of rays 2 k and 2 k + 1 of Gaussian i in place k N + i, 16 bits each, the lower ones first: twice the number of
    #: the emitter, and 1 more where the ray meets the side to which its normal does not point; SKY for nothing
    seen: UInt32
    directions: list[Float]  #: of two rays a record, see `records.load`


def are_due(step: int) -> bool:
    """Whether rays are traced anew after so many steps, the first time before the first."""
    return step in FIRST or step % EVERY == FIRST[-1]


def ray_count(emitters: int) -> int:
    """R, even."""
    return min(max(emitters // EMITTERS_PER_RAY, LEAST_RAYS), MOST_RAYS) // 2 * 2


def look_around(surfaces: Surfaces, emitters: int, radius: float) -> Surroundings:
    """Trace the rays. emitters: how many;  radius: of the model, metres"""
    directions = fibonacci_sphere(ray_count(emitters))
    pairs = len(directions) // 2
    rows = [upload(row) for row in directions.reshape(pairs, 6).T]
    packed = [store(values, dr.arange(ad.UInt32, pairs), pairs) for values in packets(rows)]
    shapes = _Shapes.of(surfaces, radius)
    numbers, emitter_of = _choose(shapes, emitters)
    seen = dr.opaque(ad.UInt32, SKY | SKY << 16, pairs * len(surfaces.means))
    discs = _Discs.of(shapes)
    if len(discs.numbers):
        _trace(seen, shapes, discs, directions, emitter_of)
    result = Surroundings(upload(numbers, ad.UInt32), seen, packed)
    dr.eval(result)
    return result


@dataclass
class _Shapes:
    """N surfaces as tracing takes them, float64."""

    surfaces: Surfaces
    radius: float  #: of the model, metres
    scales: Array  #: [N, 3] metres
    areas: Array  #: [N] m^2: the product of the two longer ones
    opacities: Array  #: [N] in [0, 1]; 0 of what is no number
    normals: Array  #: [N, 3] of unit length; (0, 0, 1) in place of what has no direction
    middle: Array  #: [3] metres: the median of the places that are numbers
    #: [N] places along a curve through all cells of a cube (Morton 1966): near ones are mostly near on it
    curve: NDArray[np.int64]

    @staticmethod
    def of(surfaces: Surfaces, radius: float) -> "_Shapes":
        middle = _middle(surfaces)
        with np.errstate(over="ignore", invalid="ignore"):
            scales = np.exp(surfaces.log_scales.astype(np.float64))
            x, y, z = scales.T
            areas = np.maximum(np.maximum(x * y, y * z), z * x)
            opacities = np.nan_to_num(1 / (1 + np.exp(-surfaces.logit_opacities.astype(np.float64))))
        curve = _along_curve(surfaces.means - (middle - 2 * radius), 4 * radius)
        return _Shapes(surfaces, radius, scales, areas, opacities, _unit(surfaces.normals), middle, curve)


@dataclass
class _Discs:
    """What stops rays."""

    numbers: NDArray[np.uint32]  #: of the Gaussians, [n]
    centers: Array  #: [n, 3] metres
    axes: Array  #: [n, 2, 3] metres, the semi-axes

    @staticmethod
    def of(shapes: _Shapes) -> "_Discs":
        surfaces, opacity, radius = shapes.surfaces, shapes.opacities, shapes.radius
        scales = np.maximum(shapes.scales, LEAST_SCALE * radius)
        reach = np.sqrt(2 * np.log(np.maximum(opacity, OPAQUE) / EDGE))
        x, y, z = scales.T
        length2 = np.einsum("ni,ni->n", surfaces.quaternions, surfaces.quaternions, dtype=np.float64)
        keep = (opacity > OPAQUE) & (length2 > 0) & np.isfinite(length2)
        keep &= np.maximum(np.maximum(x, y), z) * reach < radius
        for column, middle in zip(surfaces.means.T, shapes.middle, strict=True):
            keep &= np.abs(column - middle) < FARTHEST_DISC * radius
        numbers = np.flatnonzero(keep).astype(np.uint32)
        x, y, z = (axis[numbers] for axis in (x, y, z))
        shortest = np.where((x <= y) & (x <= z), 0, np.where(y <= z, 1, 2))
        turns, place = rotation_from_quaternion(surfaces.quaternions[numbers]), np.arange(len(numbers))
        axes = np.empty((len(numbers), 2, 3))
        for i in range(2):
            longer = i + (shortest <= i)
            axes[:, i] = turns[place, :, longer] * (scales[numbers, longer] * reach[numbers])[:, None]
        return _Discs(numbers, surfaces.means[numbers].astype(np.float64), axes)


def _trace(seen: UInt32, shapes: _Shapes, discs: _Discs, directions: Array, emitter_of: NDArray[np.uint32]) -> None:
    """Fill in `Surroundings.seen`. emitter_of: as `_choose` says"""
    grid = DiscGrid.of(discs.centers, discs.axes)
    away = np.nan_to_num(np.minimum(AWAY * np.sqrt(shapes.areas), FARTHEST * shapes.radius))
    place, normal, towards = (_vectors(of) for of in (shapes.surfaces.means, shapes.normals, directions))
    number_of, emitter = (upload(of, ad.UInt32) for of in (discs.numbers, emitter_of))
    order = upload(np.argsort(shapes.curve, kind="stable"), ad.UInt32)  # near ones, whose rays take as long, together
    distance, gaussians = upload(away), dr.opaque(ad.UInt32, len(away))
    pairs, at_once = len(directions) // 2, max(RAYS_AT_ONCE[select()] // (2 * len(away)), 1)
    for first in range(0, pairs, at_once):
        slot = dr.arange(ad.UInt32, min(at_once, pairs - first) * len(away)) + dr.opaque(ad.UInt32, first * len(away))
        pair, word = slot // gaussians, ad.UInt32(0)
        index = dr.gather(ad.UInt32, order, slot % gaussians)
        for half in (0, 1):
            direction = dr.gather(ad.Array3f, towards, 2 * pair + half)
            side = dr.gather(ad.Array3f, normal, index)
            over = dr.select(dr.dot(side, direction) < 0, -1, 1) * dr.gather(ad.Float, distance, index)
            start = dr.gather(ad.Array3f, place, index) + over * side
            disc = grid.first_met(start, direction, dr.isfinite(dr.sum(start)))
            hit = disc != MISSED
            number = dr.gather(ad.UInt32, number_of, disc, hit)
            is_back = dr.dot(dr.gather(ad.Array3f, normal, number, hit), direction) > 0
            met = dr.gather(ad.UInt32, emitter, number, hit)
            word |= dr.select(hit, 2 * met + dr.select(is_back, ad.UInt32(1), 0), SKY) << (16 * half)
        dr.scatter(seen, word, pair * gaussians + index)
        dr.eval(seen)


def _choose(shapes: _Shapes, count: int) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """(emitters [count], which of them stands for each Gaussian [N]): of the Gaussians in the order of the axis along
    which their normals point most, then of `_Shapes.curve`, one in the middle of each of `count` parts of equal area;
    all, once each, where they are no more. The nearest stands for a Gaussian, by place and normal."""
    means, normals, total = shapes.surfaces.means, shapes.normals, len(shapes.curve)
    if total <= count:
        return np.resize(np.arange(total, dtype=np.uint32), count), np.arange(total, dtype=np.uint32)
    area = np.minimum(shapes.areas, (CHOSEN * shapes.radius) ** 2) * shapes.opacities
    sound = np.isfinite(means).all(axis=1) & (area > 0)
    if not sound.any():
        return np.zeros(count, np.uint32), np.zeros(total, np.uint32)
    axis = np.abs(normals).argmax(axis=1)
    points_back = normals[np.arange(total), axis] < 0
    order = np.argsort(shapes.curve + ((2 * axis + points_back) << 30), kind="stable")
    ends = np.cumsum(np.where(sound, area, 0)[order])
    middles = (np.arange(count) + 0.5) / count * ends[-1]
    emitters = order[np.searchsorted(ends, middles, side="right")].astype(np.uint32)
    places = np.hstack([np.where(sound[:, None], means, 0), NORMALS_APART * shapes.radius * normals])
    _, nearest = cKDTree(places[emitters]).query(places, workers=-1)
    return emitters, nearest.astype(np.uint32)


def _along_curve(places: Array, side: float) -> NDArray[np.int64]:
    """[N] see `_Shapes.curve`. places: [N, 3] in a cube of this side with a corner at 0"""
    spread = np.clip(np.nan_to_num(places * (CELLS / side), posinf=0, neginf=0), 0, CELLS - 1).astype(np.int64)
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        spread = (spread | spread << shift) & mask
    return spread[:, 0] | spread[:, 1] << 1 | spread[:, 2] << 2


def _middle(surfaces: Surfaces) -> Array:
    """[3] metres: the median of the places that are numbers."""
    means = surfaces.means[np.isfinite(surfaces.means).all(axis=1)].astype(np.float64)
    return np.median(means, axis=0) if len(means) else np.zeros(3)


def _unit(normals: NDArray[np.float32]) -> Array:
    """[N, 3] of unit length; (0, 0, 1) in place of what has no direction."""
    lengths = np.linalg.norm(normals.astype(np.float64), axis=1, keepdims=True)
    has_direction = np.isfinite(lengths) & (lengths > 1e-6)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(has_direction, normals / lengths, [0.0, 0.0, 1.0])


def _vectors(rows: np.ndarray) -> Array3f:
    """Array3f [3, N] of [N, 3]."""
    return ad.Array3f([upload(column) for column in rows.T])
