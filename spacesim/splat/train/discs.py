"""Discs and the normals that light has learned are drawn together."""

import drjit as dr

from spacesim.backend import ad
from spacesim.splat.raster.gaussians import Gaussians, principal_axes
from spacesim.splat.raster.surface import unit

EVERY = 100  #: steps between two turns
#: step of the last turn of normals, and its share of shorter trainings: later ones cost 0.1 dB in 7,000 steps, 0.5 in
#: 20,000
BOTH_UNTIL, BOTH_SHARE = 2_500, 5 / 6
SHARE = 0.1  #: of the way to the other that each turns (docs/research/geometry.md)


def turns_normals(step: int, steps: int) -> bool:
    """Whether a turn after so many of all steps is one of normals, too."""
    return step <= min(BOTH_UNTIL, BOTH_SHARE * steps)


def turn_discs(gaussians: Gaussians, first: int, both: bool = True) -> None:
    """Turn each disc (`flattened`) by `SHARE` of the way towards its learned normal, three rows of the features from
    `first` on, of any length and either sign, and with `both` that towards the disc; a normal of no length turns
    nothing.

    A picture says little of how a disc of a pixel or two stands, its shading under many Suns little of where light is
    small or shadow errs: each knows what the other does not. Gradients know nothing of it: a step of training is
    followed by a turn.
    """
    assert gaussians.features is not None, "learned normals are features"
    count, splat = dr.opaque(ad.UInt32, gaussians.count), dr.arange(ad.UInt32, gaussians.count)
    learned = ad.Array3f([dr.gather(ad.Float, gaussians.features, (first + i) * count + splat) for i in range(3)])
    axis, length = principal_axes(gaussians.quaternions)[0], dr.norm(learned)
    axis = dr.select(dr.dot(learned, axis) < 0, -axis, axis)
    normal = unit(learned)
    goal = dr.normalize((1 - SHARE) * axis + SHARE * normal)
    s, v = 1 + dr.dot(axis, goal), dr.cross(axis, goal)  # the shortest turn from the axis to the goal
    w, u = gaussians.quaternions[0], ad.Array3f(*list(gaussians.quaternions)[1:])
    turned = ad.Array4f(s * w - dr.dot(v, u), *(s * u + w * v + dr.cross(v, u)))
    turned *= dr.rsqrt(dr.square(s) + dr.squared_norm(v))
    dr.eval(turned)
    gaussians.quaternions = turned
    if not both:
        return
    moved = length * dr.normalize((1 - SHARE) * normal + SHARE * axis)
    dr.eval(moved)
    place = dr.arange(ad.UInt32, dr.width(gaussians.features))
    row, features = place // count, gaussians.features
    for i, values in enumerate(moved):
        features = dr.select(row == first + i, dr.gather(ad.Float, values, place % count), features)
    dr.eval(features)
    gaussians.features = features
