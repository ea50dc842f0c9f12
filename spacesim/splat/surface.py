"""Geometry from Gaussians: normals as features to blend, the median depth of a pixel, the surface there."""

from dataclasses import dataclass
from typing import Any

import drjit as dr

from spacesim.backend import ad
from spacesim.splat.cameras import Projection
from spacesim.splat.gaussians import Gaussians, principal_axes
from spacesim.splat.project import ALPHA_MIN, Splats
from spacesim.splat.rasterize import ALPHA_MAX
from spacesim.splat.tiles import TileLists

REACH = 2.0  #: standard deviations to which a Gaussian's surface reaches (docs/geometry.md)


def normals(gaussians: Gaussians, camera: Projection, axes: str = "world") -> Any:
    """Array3f [3, N]: the shortest principal axis of each Gaussian, turned towards the camera; unit length.

    axes: "world", or "camera" (OpenCV's). Differentiable by the quaternions; which axis, and which way it
    points, is taken as given. Among equal scales the first axis counts.
    """
    if axes not in ("world", "camera"):
        raise ValueError(f'axes: expected "world" or "camera", found {axes!r}')
    columns, scales = principal_axes(gaussians.quaternions), dr.detach(gaussians.log_scales)
    first = (scales[0] <= scales[1]) & (scales[0] <= scales[2])
    normal = dr.select(first, columns[0], dr.select(scales[1] <= scales[2], columns[1], columns[2]))
    away = dr.detach(dr.dot(normal, camera.rays_to(gaussians.means))) > 0
    normal = dr.select(away, -normal, normal)
    return normal if axes == "world" else ad.Array3f([dr.dot(camera.row(i), normal) for i in range(3)])


def unit(vector: Any) -> Any:
    """Array3f [3, P] of unit length; 0 with no gradient where `vector` is shorter than 1e-6."""
    square = dr.squared_norm(vector)
    known = dr.detach(square) > 1e-12
    return dr.select(known, vector * dr.rsqrt(dr.select(known, square, 1)), 0)


@dataclass
class Pixels:
    """Of a picture, as arrays: in a recording neither its size nor the number of splats may be a constant.
    index: UInt32 [height * width], 0, 1, 2, ...;  none: as many times N, which stands for no splat"""

    index: Any
    none: Any

    @staticmethod
    def of(width: int, height: int, count: int) -> "Pixels":
        """For N = `count` splats."""
        index = dr.arange(ad.UInt32, width * height)
        dr.eval(index)
        return Pixels(index, dr.opaque(ad.UInt32, count, width * height))


def median_splat(splats: Splats, lists: TileLists, width: int, height: int, pixels: Pixels | None = None) -> Any:
    """UInt32 [height * width]: the splat behind which less than half of the light passes; N where there is none.

    Walks each tile's list once more, a lane a pixel. Not differentiable. pixels: an argument of a recording
    """
    splats = dr.detach(splats)
    pixels = pixels or Pixels.of(width, height, dr.width(splats.x))
    pixel = pixels.index
    column, row = pixel % width, pixel // width
    if lists.capacity == 0:
        return pixels.none
    tile = (row // lists.shape.height) * lists.tiles_x + column // lists.shape.width
    px, py = ad.Float(column) + 0.5, ad.Float(row) + 0.5
    end = dr.gather(ad.UInt32, lists.end, tile)

    def undecided(k: Any, transmittance: Any, _found: Any) -> Any:
        return (k < end) & (transmittance >= 0.5)

    def pass_splat(k: Any, transmittance: Any, found: Any) -> Any:
        i = dr.gather(ad.UInt32, lists.splat, k)
        x, y, a, b, c, opacity = (
            dr.gather(ad.Float, getattr(splats, name), i) for name in ("x", "y", "a", "b", "c", "opacity")
        )
        dx, dy = px - x, py - y
        alpha = dr.minimum(opacity * dr.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy), ALPHA_MAX)
        transmittance *= 1 - dr.select(alpha >= ALPHA_MIN, alpha, 0)
        return k + 1, transmittance, dr.select(transmittance < 0.5, i, found)

    state = dr.gather(ad.UInt32, lists.start, tile), ad.Float(1), pixels.none
    _, _, found = dr.while_loop(state, undecided, pass_splat, mode="symbolic", label="median")
    return found


def picked(values: Any, index: Any) -> Any:
    """values[index], Float [P] of values [N] and index UInt32 [P]; 0 where the index is N. Differentiable, and its
    gradients are the same to the bit in every run: they are added up as integers, in which order does not matter."""
    return dr.custom(_Pick, values, index)


def surface_depth(
    gaussians: Gaussians, splats: Splats, index: Any, camera: Projection, pixels: Pixels | None = None
) -> Any:
    """Float [height * width], metres: depth of the splat `index` of each pixel (UInt32 [P], as of `median_splat`) where
    the ray meets it, not at its centre; 0 where the index is N.

    A ray d is deepest in a Gaussian at z = d'P m / d'P d, P its inverse covariance and m its centre in camera axes.
    That is taken as linear in the pixel about the centre, as in RaDe-GS (Zhang et al. 2024), and ends `REACH` standard
    deviations of the longest axis before and behind it. Not differentiable. pixels: an argument of a recording
    """
    splats = dr.detach(splats)
    pixels = pixels or Pixels.of(camera.width, camera.height, dr.width(splats.depth))
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
    reach = REACH * dr.exp(most)

    def of(values: Any) -> Any:
        return dr.gather(ad.Float, values, index, index < pixels.none)

    pixel = pixels.index
    x, y = ad.Float(pixel % camera.width) + 0.5, ad.Float(pixel // camera.width) + 0.5
    offset = of(across / (square * screen.scale_x)) * (of(splats.x) - x)
    offset += of(along / (square * screen.scale_y)) * (of(splats.y) - y)
    offset = dr.clip(offset, -of(reach), of(reach))
    return of(splats.depth) + dr.select(dr.isfinite(offset), offset, 0)


class _Pick(dr.CustomOp):
    def eval(self, values: Any, index: Any) -> Any:
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
        total = ad.Float64(dr.reinterpret_array(ad.Int64, total))
        self.set_grad_in("values", ad.Float(total * unit_of_sum))

    def name(self) -> str:
        return "pick"
