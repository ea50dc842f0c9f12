"""Stage 1: 3D Gaussians to screen-space ellipses (EWA splatting; thesis 2.10 to 2.13, in gsplat's convention).

Differentiable by Dr.Jit. Anything that cannot be drawn (behind the camera, not finite, absurdly large, too faint)
is marked invisible and gets zero gradients, never NaN.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.data.records import Camera
from spacesim.splat.gaussians import Gaussians, opacities

NEAR = 0.01  #: metres; Gaussians whose centre is nearer are not drawn
DILATION = 0.3  #: pixels^2 added to the screen-space covariance, so that no splat is thinner than a pixel
ALPHA_MIN = 1 / 255  #: fainter contributions are not blended
_LARGEST = 1e9  #: bound on lengths in metres and on footprints in pixels: their squares stay finite in float32


@dataclass
class Pinhole:
    """A camera as the kernels see it. values: Float [18]: camera_from_world rows (12), fx, fy, cx, cy, limits (2).

    The numbers live in an array, not in the kernel's text: another camera reuses the compiled kernel.
    """

    values: Any
    width: int
    height: int

    @staticmethod
    def of(camera: Camera) -> "Pinhole":
        """Upload a `Camera` record."""
        tangents = (0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy)
        numbers = [
            *camera.camera_from_world[:3].ravel(),
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy,
            *tangents,
        ]
        return Pinhole(ad.Float(np.asarray(numbers, dtype=np.float32)), camera.width, camera.height)

    def __getitem__(self, index: int) -> Any:
        return dr.gather(ad.Float, self.values, ad.UInt32(index))

    def transform(self, points: Any) -> Any:
        """Array3f [3, N] world to camera axes, metres (thesis 2.10)."""
        return ad.Array3f([dr.dot(self.row(i), points) + self[4 * i + 3] for i in range(3)])

    def row(self, i: int) -> Any:
        """Array3f: row i of the rotation camera_from_world."""
        return ad.Array3f(self[4 * i], self[4 * i + 1], self[4 * i + 2])

    @property
    def position(self) -> Any:
        """Array3f: camera centre in the world, metres."""
        return -(self.row(0) * self[3] + self.row(1) * self[7] + self.row(2) * self[11])


@dataclass
class Splats:
    """Screen-space ellipses, [N] each. exponent(dx, dy) = -(a dx^2 + 2 b dx dy + c dy^2) / 2."""

    x: Any  #: centre, pixels
    y: Any
    a: Any  #: inverse of the 2D covariance, pixels^-2
    b: Any
    c: Any
    opacity: Any
    depth: Any  #: z of the centre along the optical axis, metres


@dataclass
class Footprints:
    """Which splats can be seen, and where. Not differentiable."""

    half_width: Any  #: [N] of the box around {alpha >= ALPHA_MIN}, pixels
    half_height: Any
    visible: Any  #: [N] bool


def project(gaussians: Gaussians, camera: Pinhole) -> tuple[Splats, Footprints]:
    """Project N Gaussians. Returns `Splats` (differentiable) and `Footprints`, all [N]."""
    means, log_scales, quaternions = gaussians.means, gaussians.log_scales, gaussians.quaternions
    logits = gaussians.logit_opacities

    # Parameters that arithmetic would turn into NaN are replaced, which also cuts their gradients.
    length2 = dr.squared_norm(quaternions)
    sane = (length2 > 1e-24) & (length2 < 1e24) & (dr.abs(logits) < _LARGEST)
    for i in range(3):
        sane &= (dr.abs(means[i]) < _LARGEST) & (log_scales[i] > -60) & (log_scales[i] < 20)
    sane = dr.detach(sane)
    means = dr.select(sane, means, ad.Array3f(0))
    log_scales = dr.select(sane, log_scales, ad.Array3f(0))
    quaternions = dr.select(sane, quaternions, ad.Array4f(1, 0, 0, 0))
    opacity = opacities(dr.select(sane, logits, 0))

    center = camera.transform(means)
    sane &= dr.detach(center.z) > NEAR
    center = dr.select(sane, center, ad.Array3f(0, 0, 1))
    inverse_z = dr.rcp(center.z)
    tan_x, tan_y = center.x * inverse_z, center.y * inverse_z

    # rows m_x, m_y of J R S (2.12, 2.13); far off-screen the linearization point is held near the image's border
    fx, fy, cx, cy = (camera[i] for i in range(12, 16))
    margin_x, margin_y = 0.3 * camera[16], 0.3 * camera[17]
    held_x = dr.clip(tan_x, -cx / fx - margin_x, (camera.width - cx) / fx + margin_x)
    held_y = dr.clip(tan_y, -cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
    axes, scales = _rotation_columns(quaternions), dr.exp(log_scales)
    rows_x: list[Any] = []
    rows_y: list[Any] = []
    for i in range(3):
        axis = axes[i] * scales[i] * inverse_z
        forward = dr.dot(camera.row(2), axis)
        rows_x.append(fx * (dr.dot(camera.row(0), axis) - held_x * forward))
        rows_y.append(fy * (dr.dot(camera.row(1), axis) - held_y * forward))
    m_x, m_y = ad.Array3f(rows_x), ad.Array3f(rows_y)
    small = dr.detach(dr.max(dr.abs(m_x)) < _LARGEST) & dr.detach(dr.max(dr.abs(m_y)) < _LARGEST)
    sane &= small
    m_x, m_y = dr.select(small, m_x, ad.Array3f(0)), dr.select(small, m_y, ad.Array3f(0))

    # The determinant as a sum of squares (Lagrange's identity) cannot cancel to zero or below.
    xx, yy, xy = dr.squared_norm(m_x), dr.squared_norm(m_y), dr.dot(m_x, m_y)
    determinant = dr.squared_norm(dr.cross(m_x, m_y)) + DILATION * (xx + yy) + DILATION * DILATION
    xx, yy = xx + DILATION, yy + DILATION
    inverse_determinant = dr.rcp(determinant)
    splats = Splats(
        x=dr.fma(fx, tan_x, cx),
        y=dr.fma(fy, tan_y, cy),
        a=yy * inverse_determinant,
        b=-xy * inverse_determinant,
        c=xx * inverse_determinant,
        opacity=opacity,
        depth=center.z,
    )
    return splats, _footprints(splats, xx, yy, sane, camera)


def _rotation_columns(quaternions: Any) -> list[Any]:
    """The three columns (Array3f) of the rotation of each quaternion, normalised first."""
    q = quaternions * dr.rsqrt(dr.squared_norm(quaternions))
    w, x, y, z = q[0], q[1], q[2], q[3]
    return [
        ad.Array3f(1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        ad.Array3f(2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        ad.Array3f(2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    ]


def _footprints(splats: Splats, xx: Any, yy: Any, sane: Any, camera: Pinhole) -> Footprints:
    """Box of the ellipse where alpha reaches ALPHA_MIN: |d|^2 = 2 ln(o / ALPHA_MIN) in units of the covariance."""
    opacity, x, y = dr.detach(splats.opacity), dr.detach(splats.x), dr.detach(splats.y)
    reach2 = 2 * dr.log(dr.maximum(opacity / ALPHA_MIN, 1))
    half_width = dr.sqrt(reach2 * dr.detach(xx)) + 1e-3
    half_height = dr.sqrt(reach2 * dr.detach(yy)) + 1e-3
    visible = sane & (opacity >= ALPHA_MIN)
    visible &= (x + half_width > 0) & (x - half_width < camera.width)
    visible &= (y + half_height > 0) & (y - half_height < camera.height)
    return Footprints(half_width, half_height, visible)
