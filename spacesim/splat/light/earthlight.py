"""Earthlight: what the sunlit Earth adds to each Gaussian, by its learned normal and albedo, nothing in between.

The Earth is so large in the sky that it reaches far beyond the terminator and into all shadows of the Sun, and how
bright it is depends on where the Sun stands: no cosine of a Gaussian says so.
"""

from typing import Any

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Bool, Float, UInt32
from spacesim.data.earth import BEAMS
from spacesim.learning.reflectance import seen_side_normals, unit_normals


def earth_irradiance(normals: Array3f, direction: Array3f, beams: Float) -> Float:
    """[M] of the side that is seen, where sunlight has 1: sum over beams k of E_k max(n . d_k, 0), differentiable by
    the normals. The object hides none of the Earth: where that stands still, albedos learn how much is seen of it.

    normals: Array3f [3, M], of any length;  direction: Array3f [3, M], unit, from the camera;  beams: Float
    [4 * BEAMS] of `Earth.beams`
    """
    seen: Any = seen_side_normals(unit_normals(normals), direction)
    facing = dr.detach(seen)

    def collected(k: UInt32, total: Array3f) -> tuple[UInt32, Array3f]:
        x, y, z, power = dr.gather(ad.Array4f, beams, k)
        beam = ad.Array3f(x, y, z)
        return k + 1, total + dr.select(dr.dot(facing, beam) > 0, power, 0) * beam

    def has_more(k: UInt32, _total: Array3f) -> Bool:
        return k < BEAMS

    start = ad.UInt32(0), dr.zeros(ad.Array3f, dr.width(facing))
    _, total = dr.while_loop(start, has_more, collected, mode="symbolic", label="earthlight")
    return dr.dot(seen, dr.detach(total))  # the vector irradiance of what stands above the horizon
