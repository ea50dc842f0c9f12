"""project -> bin -> rasterize -> RenderOutput: one differentiable picture of Gaussians (thesis 2.2)."""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.splat.gaussians import SH_C0, Gaussians
from spacesim.splat.project import Pinhole, project
from spacesim.splat.rasterize import rasterize
from spacesim.splat.tiles import bin_splats


@dataclass
class RenderOutput:
    """Planes are [height * width], row by row; `to_numpy` gives them their shape.

    colour: Array3f, premultiplied (over black), sRGB values;  alpha: Float in [0, 1]
    depth: Float, expected depth: z of the centres averaged with the blending weights, metres; 0 where alpha is 0
    """

    colour: Any
    alpha: Any
    depth: Any
    width: int
    height: int

    def to_numpy(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(colour [H, W, 3], alpha [H, W], depth [H, W]), float32."""
        shape = (self.height, self.width)
        colour = np.stack([np.array(plane).reshape(shape) for plane in self.colour], axis=-1)
        return colour, np.array(self.alpha).reshape(shape), np.array(self.depth).reshape(shape)

    def over(self, background: Any) -> Any:
        """Array3f: the picture over a background colour (Array3f) or picture."""
        return self.colour + (1 - self.alpha) * background


def render(gaussians: Gaussians, camera: Pinhole, sh_degree: int | None = None) -> RenderOutput:
    """Render; differentiable with respect to every parameter of `gaussians` that has gradients enabled.

    sh_degree: highest degree of spherical harmonics used, all that are stored by default.
    """
    if gaussians.count == 0:
        zero = dr.zeros(ad.Float, camera.width * camera.height)
        return RenderOutput(ad.Array3f(zero, zero, zero), zero, zero, camera.width, camera.height)
    splats, footprints = project(gaussians, camera)
    colour = view_colours(gaussians, camera, sh_degree)
    lists = bin_splats(splats, footprints, camera.width, camera.height)
    planes, transmittance = rasterize(splats, [*colour, splats.depth], lists, camera.width, camera.height)
    return compose_output(planes, transmittance, camera)


def compose_output(planes: list[Any], transmittance: Any, camera: Pinhole) -> RenderOutput:
    """Name the rasterizer's planes (r, g, b, depth) and normalise the depth."""
    alpha = 1 - transmittance
    covered = alpha > 0
    depth = dr.select(covered, planes[3] / dr.select(covered, alpha, 1), 0)
    return RenderOutput(ad.Array3f(planes[:3]), alpha, depth, camera.width, camera.height)


def view_colours(gaussians: Gaussians, camera: Pinhole, sh_degree: int | None = None) -> Any:
    """Array3f [3, N]: colour of each Gaussian seen from the camera, sRGB values >= 0 (thesis 2.17).

    c(d) = max(sum_lm a_lm Y_lm(d) + 1/2, 0), d from the camera towards the Gaussian; the offset is INRIA's.
    """
    degree = gaussians.sh_degree if sh_degree is None else min(sh_degree, gaussians.sh_degree)
    sh = gaussians.sh
    colour = ad.Array3f(*(SH_C0 * sh[c] + 0.5 for c in range(3)))
    if degree > 0:
        offset = gaussians.means - camera.position
        length2 = dr.squared_norm(offset)
        far = dr.detach((length2 > 1e-20) & (length2 < 1e20))
        direction = dr.select(far, offset * dr.rsqrt(dr.select(far, length2, 1)), ad.Array3f(0, 0, 1))
        basis = dr.sh_eval(direction, degree)
        for k in range(1, (degree + 1) ** 2):
            colour += basis[k] * ad.Array3f(*(sh[3 * k + c] for c in range(3)))
    finite = dr.detach(dr.abs(colour) < 1e9)
    return dr.maximum(dr.select(finite, colour, 0), 0)
