"""What the look of a surface depends on: cosines between its normal, the Sun and the view, and how much of the Sun the
Earth leaves."""

from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Bool, Float
from spacesim.data.geometry import Array

LOBES = (8, 32, 128, 512)  #: exponents of n . h, from satin to mirror: each is the one before to the fourth
COSINES = 4 + len(LOBES)  #: numbers that `surface_cosines` gives


def surface_cosines(normals: Array3f, direction: Array3f, sun: Array3f) -> list[Float]:
    """n . s, max(n . s, 0), n . v, n . h, and powers of the last: what a reflectance model of an isotropic surface
    depends on (Blinn 1977), [M] each. A network of few units makes no lobe as narrow as a glint out of n . h alone.

    normals: Array3f [3, M], of any length; the side that is seen counts, n . v >= 0;  direction: Array3f [3, M], unit,
    from the camera;  sun: Array3f, unit, towards the Sun;  h: halfway between the Sun and the viewer, v = -direction
    """
    seen = seen_side_normals(unit_normals(normals), direction)
    half = sun - direction
    half2 = dr.squared_norm(half)
    per_length: Any = dr.select(half2 > 1e-12, dr.rsqrt(dr.maximum(half2, 1e-12)), 0)
    half *= per_length
    lambert = dr.dot(seen, sun)
    halfway = dr.maximum(dr.dot(seen, half), 0)
    lobes = [dr.square(dr.square(dr.square(halfway)))]
    for _ in LOBES[1:]:
        lobes.append(dr.square(dr.square(lobes[-1])))
    return [lambert, dr.maximum(lambert, 0), -dr.dot(seen, direction), halfway, *lobes]


def unit_normals(normals: Array3f) -> Array3f:
    """Array3f [3, M] of unit length; (0, 0, 1) in place of what has no direction."""
    length2 = dr.squared_norm(normals)
    has_direction = dr.detach(length2) > 1e-12
    return dr.select(has_direction, normals, ad.Array3f(0, 0, 1)) * dr.rsqrt(dr.select(has_direction, length2, 1))


def seen_side_normals(normals: Array3f, direction: Array3f) -> Any:
    """Normals of the side that is seen. direction: from the camera"""
    return dr.select(points_away(normals, direction), -normals, normals)


def points_away(normals: Array3f, direction: Array3f) -> Bool:
    """Bool [M]: is the side seen to which the normal does not point? direction: from the camera"""
    return dr.detach(dr.dot(normals, direction)) > 0


def eclipse_numbers(share: float, linear: bool) -> Array:
    """[2]: what `past_earth` reads. share: of the Sun that the Earth leaves;  linear: of colours, else sRGB values"""
    return np.array([share, 0.0 if linear or share == 1 else share ** (1 / 2.4)])


def past_earth(colors: list[Float], numbers: Float, at: int = 0) -> tuple[list[Float], list[Float]]:
    """(colours in the share of sunlight that the Earth leaves, their slopes by the colours). numbers: has
    `eclipse_numbers` from place `at` on

    Of sRGB values c it is encode(f decode(c)), which is f^(1 / 2.4) (c + 0.055) - 0.055 but near black, where it is f c
    (IEC 61966-2-1); the larger of both is within 0.011 of it, and f c of linear colours.
    """
    share, power = (dr.gather(ad.Float, numbers, ad.UInt32(at + i)) for i in range(2))
    bright = [power * (color + 0.055) - 0.055 for color in colors]
    pairs = list(zip(colors, bright, strict=True))
    seen = [dr.maximum(share * color, other) for color, other in pairs]
    return seen, [dr.select(share * color < other, power, share) for color, other in pairs]
