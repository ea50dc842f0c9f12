"""Stage 1: 3D Gaussians to screen-space ellipses (EWA splatting; thesis 2.10 to 2.13, in gsplat's convention).

Differentiable by Dr.Jit, with respect to the Gaussians and the camera. Anything that cannot be drawn (out of the
camera's reach, not finite, absurdly large, too faint) is marked invisible and gets zero gradients, never NaN.
"""

from dataclasses import dataclass
from typing import cast

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Array4f, Bool, Float, UInt32
from spacesim.splat.raster.cameras import MAX_MAGNITUDE, NEAR, Orthographic, Pinhole, Projection
from spacesim.splat.raster.gaussians import Gaussians, opacities, principal_axes

__all__ = ["ALPHA_MIN", "DILATION", "NEAR", "PIXEL", "Footprints", "Orthographic", "Pinhole", "Splats", "project"]

DILATION = 0.3  #: pixels^2 added to the screen-space covariance, so that no splat is thinner than a pixel
PIXEL = 1 / 12  #: pixels^2 added in its place where splats are anti-aliased: the variance of a pixel's square
ALPHA_MIN = 1 / 255  #: fainter contributions are not blended


@dataclass
class Splats:
    """Screen-space ellipses, [N] each. exponent(dx, dy) = -(a dx^2 + 2 b dx dy + c dy^2) / 2."""

    x: Float  #: centre, pixels
    y: Float  #: centre, pixels
    a: Float  #: inverse of the 2D covariance, pixels^-2
    b: Float  #: likewise, off the diagonal
    c: Float  #: likewise, of y
    opacity: Float  #: in [0, 1]
    depth: Float  #: z of the centre along the camera's axis, metres; negative behind an orthographic camera's origin


@dataclass
class Footprints:
    """Which splats can be seen, where, and in which order. Not differentiable."""

    half_width: Float  #: [N] of the box around {alpha >= ALPHA_MIN}, pixels
    half_height: Float  #: of the same box, pixels
    visible: Bool  #: [N] bool
    order: UInt32  #: [N] UInt32 below 2^31, grows with depth; whatever its sign, and however far away the camera is


def project(gaussians: Gaussians, camera: Projection, antialiased: Bool | bool = False) -> tuple[Splats, Footprints]:
    """Project N Gaussians. Returns `Splats` (differentiable) and `Footprints`, all [N].

    antialiased: splats are spread by a pixel's own width (`PIXEL`) and not to a pixel's (`DILATION`), and what that
    adds to a splat's area is taken from its opacity (Yu et al. 2024, Mip-Splatting's 2D filter, with 1/10): a splat
    thinner than a pixel fades instead of growing. True, False, or Bool [N]: of which Gaussians.
    """
    means, log_scales, quaternions = gaussians.means, gaussians.log_scales, gaussians.quaternions
    logits = gaussians.logit_opacities

    # Parameters that arithmetic would turn into NaN are replaced, which also cuts their gradients.
    length2 = dr.squared_norm(quaternions)
    sane = (length2 > 1e-24) & (length2 < 1e24) & (dr.abs(logits) < MAX_MAGNITUDE)
    for i in range(3):
        sane &= (dr.abs(means[i]) < MAX_MAGNITUDE) & (log_scales[i] > -60) & (log_scales[i] < 20)
    sane = dr.detach(sane)
    means = dr.select(sane, means, ad.Array3f(0))
    log_scales = dr.select(sane, log_scales, ad.Array3f(0))
    opacity = opacities(dr.select(sane, logits, 0))
    spread = _spread(antialiased)
    return project_ellipsoids(means, dr.exp(log_scales), quaternions, opacity, sane, camera, spread, antialiased)


def project_ellipsoids(
    means: Array3f,
    scales: Array3f,
    quaternions: Array4f,
    opacity: Float,
    sane: Bool,
    camera: Projection,
    spread: Float | float,
    compensated: Bool | bool,
) -> tuple[Splats, Footprints]:
    """`project` of Gaussians with these means, standard deviations (Array3f [3, N], metres), rotations and opacities.

    sane: Bool [N]: numbers that can be drawn; the others must be finite all the same
    spread: pixels^2 added to the screen-space covariance, a number or Float [N]
    compensated: whether what that adds to a splat's area is taken from its opacity; True, False or Bool [N]
    """
    camera = camera.evaluated()
    center = camera.transform(means)
    sane &= dr.detach(camera.in_reach(center))
    center = dr.select(sane, center, ad.Array3f(0, 0, 1))
    screen = camera.screen(center)

    # rows m_x, m_y of J R S (2.12, 2.13)
    axes = principal_axes(quaternions)
    rows_x: list[Float] = []
    rows_y: list[Float] = []
    for i in range(3):
        axis = axes[i] * scales[i]
        forward = dr.dot(camera.row(2), axis)
        rows_x.append(screen.scale_x * (dr.dot(camera.row(0), axis) - screen.slope_x * forward))
        rows_y.append(screen.scale_y * (dr.dot(camera.row(1), axis) - screen.slope_y * forward))
    m_x, m_y = ad.Array3f(rows_x), ad.Array3f(rows_y)
    small = dr.detach(dr.max(dr.abs(m_x)) < MAX_MAGNITUDE) & dr.detach(dr.max(dr.abs(m_y)) < MAX_MAGNITUDE)
    sane &= small
    m_x, m_y = dr.select(small, m_x, ad.Array3f(0)), dr.select(small, m_y, ad.Array3f(0))

    # The determinant as a sum of squares (Lagrange's identity) cannot cancel to zero or below.
    xx, yy, xy = dr.squared_norm(m_x), dr.squared_norm(m_y), dr.dot(m_x, m_y)
    own_determinant = dr.squared_norm(dr.cross(m_x, m_y))
    determinant = own_determinant + spread * (xx + yy + spread)
    xx, yy = xx + spread, yy + spread
    inverse_determinant = dr.rcp(determinant)
    if compensated is not False:
        compensation = _compensation(own_determinant * inverse_determinant)
        opacity *= compensation if compensated is True else dr.select(compensated, compensation, 1)
    splats = Splats(
        x=screen.x,
        y=screen.y,
        a=yy * inverse_determinant,
        b=-xy * inverse_determinant,
        c=xx * inverse_determinant,
        opacity=opacity,
        depth=center.z,
    )
    # The camera's own distance is the same for all: without it, single precision still resolves near and far.
    order = _sortable(dr.detach(dr.dot(camera.row(2), means)))
    return splats, _footprints(splats, xx, yy, order, sane, camera)


def _spread(antialiased: Bool | bool) -> Float | float:
    """pixels^2, a number or Float [N]."""
    if isinstance(antialiased, bool):
        return PIXEL if antialiased else DILATION
    return dr.select(antialiased, ad.Float(PIXEL), DILATION)


def _compensation(ratio: Float) -> Float:
    """sqrt(det Sigma / det(Sigma + PIXEL I)) [N]; 0 with no gradient where the splat would be invisible anyway."""
    positive = dr.detach(ratio) > 1e-10
    root = dr.sqrt(dr.select(positive, ratio, 1))
    return dr.select(positive, root, 0)


def _sortable(depth: Float) -> UInt32:
    """UInt32 [N] below 2^31 in the order of finite floats `depth` [N]; equal where only the last bit differs."""
    bits = cast(UInt32, dr.reinterpret_array(ad.UInt32, depth))
    ordered = dr.select(bits >> 31 == 0, bits | 0x80000000, ~bits)
    return ordered >> 1


def _footprints(splats: Splats, xx: Float, yy: Float, order: UInt32, sane: Bool, camera: Projection) -> Footprints:
    """Box of the ellipse where alpha reaches ALPHA_MIN: |d|^2 = 2 ln(o / ALPHA_MIN) in units of the covariance."""
    opacity, x, y = dr.detach(splats.opacity), dr.detach(splats.x), dr.detach(splats.y)
    reach2 = 2 * dr.log(dr.maximum(opacity / ALPHA_MIN, 1))
    half_width = dr.sqrt(reach2 * dr.detach(xx)) + 1e-3
    half_height = dr.sqrt(reach2 * dr.detach(yy)) + 1e-3
    visible = sane & (opacity >= ALPHA_MIN)
    visible &= (x + half_width > 0) & (x - half_width < camera.width)
    visible &= (y + half_height > 0) & (y - half_height < camera.height)
    return Footprints(half_width, half_height, visible, order)
