"""Geometry from Gaussians: normals as features to blend, the median depth of a pixel, the surface there."""

import math
from functools import reduce
from typing import cast

import drjit as dr

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Array3f, Array4f, Bool, Float, UInt32, UInt64
from spacesim.backend.packet import load, packets, store
from spacesim.splat.raster.cameras import Projection
from spacesim.splat.raster.gaussians import Gaussians, principal_axes
from spacesim.splat.raster.lists.tiles import TileLists, round_capacity, thread_pixels, tiled_index
from spacesim.splat.raster.project import Splats
from spacesim.splat.raster.records import ALPHA_MAX, POWER_MIN, bits_of, exp2, exponents, list_records, pack_records

NONE = 2**32 - 1  #: in place of a splat's number
HALF = 0x3F000000  #: the bits of 0.5
THICKNESS = 0.05  #: of a disc, in its shorter standard deviation
REACH = 2.0  #: standard deviations to which a Gaussian's surface reaches (docs/research/geometry.md)


def normals(gaussians: Gaussians, camera: Projection, axes: str = "world") -> Array3f:
    """Array3f [3, N]: the shortest principal axis of each Gaussian, turned towards the camera; unit length.

    axes: "world", or "camera" (OpenCV's). Differentiable by the quaternions; which axis, and which way it
    points, is taken as given. Among equal scales the first axis counts.
    """
    if axes not in ("world", "camera"):
        raise ValueError(f'axes: expected "world" or "camera", found {axes!r}')
    normal = shortest_axis(gaussians.quaternions, gaussians.log_scales)
    away = dr.detach(dr.dot(normal, camera.rays_to(gaussians.means))) > 0
    normal = dr.select(away, -normal, normal)
    return normal if axes == "world" else ad.Array3f([dr.dot(camera.row(i), normal) for i in range(3)])


def shortest_axis(quaternions: Array4f, log_scales: Array3f) -> Array3f:
    """Array3f [3, N], unit, of either sign; differentiable by the quaternions. Among equal scales the first counts."""
    columns, scales = principal_axes(quaternions), dr.detach(log_scales)
    first = (scales[0] <= scales[1]) & (scales[0] <= scales[2])
    return dr.select(first, columns[0], dr.select(scales[1] <= scales[2], columns[1], columns[2]))


def flattened(log_scales: list[Float]) -> list[Float]:
    """Three Floats [N], ln of metres: of a disc with the second and third of these, whose normal is the first axis."""
    _, second, third = log_scales
    return [dr.minimum(second, third) + math.log(THICKNESS), second, third]


def unit(vector: Array3f) -> Array3f:
    """Array3f [3, P] of unit length; 0 with no gradient where `vector` is shorter than 1e-6."""
    square = dr.squared_norm(vector)
    has_direction = dr.detach(square) > 1e-12
    return dr.select(has_direction, vector * dr.rsqrt(dr.select(has_direction, square, 1)), 0)


def across(direction: Array3f, towards: Array3f) -> Array3f:
    """Array3f [3, P], unit: perpendicular to the unit `direction`, in the plane of it and `towards`; in any where these
    are parallel."""
    aside = towards - dr.dot(towards, direction) * direction
    any_axis = dr.select(dr.abs(direction[0]) < 0.7, ad.Array3f(1, 0, 0), ad.Array3f(0, 1, 0))
    aside = dr.select(dr.squared_norm(aside) > 1e-8, aside, dr.cross(direction, any_axis))
    return dr.normalize(aside)


def median_splat(splats: Splats, lists: TileLists, width: int, height: int) -> UInt32:
    """UInt32 [height * width]: the splat behind which less than half of the light passes; `NONE` where there is none.

    Walks each tile's list once more, until that is known of all pixels of a thread. Not differentiable.
    """
    if lists.capacity == 0:
        return dr.opaque(ad.UInt32, NONE, width * height)
    return walk(dr.detach(splats), lists, width, height, round_capacity(dr.width(splats.x)))


@recorded(elements=lambda _, splats, lists, width, height, *_rest, **_named: width * height)
def walk(splats: Splats, lists: TileLists, width: int, height: int, capacity: int) -> UInt32:
    """`median_splat` as a part of recordings. capacity: length of the splats' arrays"""
    records = list_records(pack_records(splats, [], capacity), lists, capacity)
    thread, pixels = thread_pixels(lists), lists.shape.pixels

    def undecided(k: UInt32, end: UInt32, transmittance: list[Float], _place: object) -> Bool:
        return (k < end) & (reduce(dr.maximum, map(bits_of, transmittance)) >= HALF)

    def pass_splat(
        k: UInt32, end: UInt32, transmittance: list[Float], place: list[UInt32]
    ) -> tuple[UInt32, UInt32, list[Float], list[UInt32]]:
        """place: one past the last pair behind which half of the light passes; alphas are from 0 to `ALPHA_MAX`, so
        none follows it"""
        transmittance, place = list(transmittance), list(place)
        powers = list(exponents(records.load(lists, k), thread.x, thread.y, lists.shape))
        for p in range(pixels):
            drawn = dr.minimum(exp2(powers[p]), ALPHA_MAX)
            alpha = dr.select(powers[p] >= POWER_MIN, drawn, 0)
            transmittance[p] -= alpha * transmittance[p]
            place[p] = dr.select(transmittance[p] >= 0.5, k + 1, place[p])
        return k + 1, end, transmittance, place

    start, end = (dr.gather(ad.UInt32, bound, thread.tile) for bound in (lists.start, lists.end))
    state = start, end, [ad.Float(1) for _ in range(pixels)], [ad.UInt32(start) for _ in range(pixels)]
    *_, passed, place = dr.while_loop(state, undecided, pass_splat, mode="symbolic", label="median")
    decided = [dr.select(left < 0.5, number, NONE) for left, number in zip(passed, place, strict=True)]
    tiled = store(decided, thread.place, lists.tiles_x * lists.tiles_y * lists.shape.threads)
    dr.eval(tiled)
    place = dr.gather(ad.UInt32, tiled, tiled_index(lists, width, height))
    return dr.select(place != NONE, dr.gather(ad.UInt32, lists.splat, place, place != NONE), NONE)


def gather_or_zero(values: Float, index: UInt32) -> Float:
    """values[index], Float [P] of values [N] and index UInt32 [P]; 0 where the index is N or more. Differentiable, and
    its gradients are the same to the bit in every run: added up as integers, in which order does not matter."""
    return dr.custom(_Gather, values, index)


def surface_depth(gaussians: Gaussians, splats: Splats, index: UInt32, camera: Projection, capacity: int) -> Float:
    """Float [height * width], metres: depth of the splat `index` of each pixel (UInt32 [P], as of `median_splat`) where
    the ray meets it, not at its centre; 0 where the index is `NONE`.

    A ray d is deepest in a Gaussian at z = d'P m / d'P d, P its inverse covariance and m its centre in camera axes.
    That is taken as linear in the pixel about the centre, as in RaDe-GS (Zhang et al. 2024), and ends `REACH` standard
    deviations of the longest axis before and behind it. Not differentiable. capacity: length of the splats' arrays
    (`round_capacity`)
    """
    return depth_on_planes(depth_planes(gaussians, splats, camera, capacity), index, camera, capacity)


def depth_planes(gaussians: Gaussians, splats: Splats, camera: Projection, capacity: int) -> list[Float]:
    """Of each Gaussian what `depth_on_planes` reads, packets in arrays of `capacity`: centre on the screen (pixels),
    slopes of depth (metres a pixel), depth and reach (metres)."""
    splats = dr.detach(splats)
    means, scales = dr.detach(gaussians.means), dr.detach(gaussians.log_scales)
    least = dr.minimum(scales[0], dr.minimum(scales[1], scales[2]))
    most = dr.maximum(scales[0], dr.maximum(scales[1], scales[2]))
    ray = ad.Array3f([dr.dot(camera.row(i), camera.rays_to(means)) for i in range(3)])
    ray *= dr.rcp(dr.select(dr.abs(ray.z) > 1e-6, ray.z, 1))
    across, along, square = ad.Float(0), ad.Float(0), ad.Float(0)
    for axis, scale in zip(principal_axes(dr.detach(gaussians.quaternions)), scales, strict=True):
        turned = ad.Array3f([dr.dot(camera.row(i), axis) for i in range(3)])
        share = dr.dot(turned, ray)
        part = dr.exp(2 * (least - scale)) * share
        across, along, square = across + part * turned.x, along + part * turned.y, square + part * share
    screen = camera.screen(camera.transform(means))
    slopes = [across / (square * screen.scale_x), along / (square * screen.scale_y)]
    numbers = [splats.x, splats.y, *slopes, splats.depth, REACH * dr.exp(most)]
    splat = dr.arange(ad.UInt32, dr.width(splats.depth))
    return [store(values, splat, capacity) for values in packets(numbers)]


def depth_on_planes(planes: list[Float], index: UInt32, camera: Projection, capacity: int) -> Float:
    """`surface_depth` by `depth_planes`."""
    is_hit = index != NONE
    x, y, slope_x, slope_y, depth, reach, *_ = load(planes, index, capacity, is_hit)
    pixel = dr.arange(ad.UInt32, camera.width * camera.height)
    offset = slope_x * (x - 0.5 - ad.Float(pixel % camera.width))
    offset += slope_y * (y - 0.5 - ad.Float(pixel // camera.width))
    offset = dr.clip(offset, -reach, reach)
    return dr.select(is_hit, depth + dr.select(dr.isfinite(offset), offset, 0), 0)


class _Gather(dr.CustomOp):
    def eval(self, values: Float, index: UInt32) -> Float:
        self.index, self.count = index, dr.width(values)
        return dr.gather(ad.Float, values, index, index < self.count)

    def backward(self) -> None:
        # Fixed point of 2^-62 of the largest sum that can come out: exact to 2^-62 P of the largest gradient.
        gradient = ad.Float64(self.grad_out())
        gradient = dr.select(dr.isfinite(gradient), gradient, 0)
        unit_of_sum = dr.maximum(dr.max(dr.abs(gradient)), 1e-300) * (dr.width(self.index) / 2.0**61)
        parts = dr.reinterpret_array(ad.UInt64, ad.Int64(dr.round(gradient / unit_of_sum)))  # CUDA adds unsigned ones
        total = dr.zeros(ad.UInt64, self.count)
        dr.scatter_reduce(dr.ReduceOp.Add, total, parts, self.index, self.index < self.count)
        sums = ad.Float64(cast(UInt64, dr.reinterpret_array(ad.Int64, total)))
        self.set_grad_in("values", ad.Float(sums * unit_of_sum))

    def name(self) -> str:
        return "pick"
