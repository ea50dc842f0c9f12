"""Receiver-depth bias: how far behind a blocker a Gaussian may lie before it counts as shadowed (thesis 4.3.4)."""

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Float
from spacesim.splat.raster.cameras import MAX_MAGNITUDE, Orthographic
from spacesim.splat.raster.gaussians import Gaussians, principal_axes
from spacesim.splat.raster.project import DILATION

STEEPEST = 0.05  #: sine of the Sun's elevation over a surface below which it counts as this, 2.9 degrees


@dataclass
class Bias:
    """What thesis 4.19 to 4.26 say of N Gaussians under one Sun, Floats [N], detached and finite."""

    thickness: Float  #: sigma^l, metres: standard deviation along the sunlight (4.22)
    alignment: Float  #: nu in [0, 1]: |n . s| of the shortest axis (4.24)
    confidence: Float  #: gamma in [0, 1]: 1 - shortest / longest axis (4.25)
    bias: Float  #: b, metres (4.26)

    def at_least(self, floor: Float) -> "Bias":
        """With b no smaller than `floor`, Float [N], metres."""
        return replace(self, bias=dr.maximum(self.bias, floor))


def receiver_bias(gaussians: Gaussians, sun: Array3f, strength: Float | float = 10.0) -> Bias:
    """Thesis 4.19 to 4.26: b = strength sigma^l nu gamma.

    sun: Array3f of width 1, unit, from the scene towards the Sun (`light_camera.towards_sun`); strength: lambda_b, 10
    in the thesis. Among equal axes the first is the shortest. A Gaussian that is not finite gets 0
    everywhere. May be part of a recording.
    """
    shape = _SunlitGaussian.of(gaussians, sun)
    bias = strength * shape.thickness * shape.alignment * shape.confidence
    return Bias(shape.thickness, shape.alignment, shape.confidence, dr.minimum(bias, MAX_MAGNITUDE))


def grazing_bias(gaussians: Gaussians, camera: Orthographic, reach: Float | float = 2.0) -> Float:
    """Float [N], metres: a bias that does not go to 0 where the Sun grazes a surface, as the thesis's b = 10 sigma^l nu
    gamma does; for `Bias.at_least`. Ours, no part of the thesis.

    A flat surface that passes through a receiver has another light depth wherever its neighbours' footprints meet the
    receiver's. Over a footprint's standard deviation that depth changes by sigma^l, if the light's picture shows the
    Gaussian as it is; but it is drawn with a filter of `DILATION` pixels^2, so that no splat is thinner than a pixel,
    and then by sqrt(sigma^l^2 + DILATION |g|^2) with g = (n_x / f_x, n_y / f_y) / n_z, the surface's slope a pixel, in
    light axes (anti-aliased splats have less of a filter, and a wider bias than they need). b is `reach` times that
    times gamma: in the light's picture a shadow that touches its caster recedes by `reach` standard deviations of a
    splat as drawn, however low the Sun.
    camera: the light camera;  reach: standard deviations, chosen by measurement (docs/research/shadows.md), as is the
    slope's limit, |n_z| at least `STEEPEST`. May be part of a recording.
    """
    shape = _SunlitGaussian.of(gaussians, -camera.row(2))
    x, y, z = (dr.dot(camera.row(i), shape.normal) for i in range(3))
    slope2 = dr.square(x * dr.rcp(camera[12])) + dr.square(y * dr.rcp(camera[13]))
    slope2 *= dr.rcp(dr.square(dr.maximum(dr.abs(z), STEEPEST)))
    drawn = dr.sqrt(dr.fma(DILATION, slope2, dr.square(shape.thickness)))
    return dr.minimum(reach * shape.confidence * drawn, MAX_MAGNITUDE)


def offset_receivers(gaussians: Gaussians, sun: Array3f, thickness: float = 3.0, width: float = 0.2) -> Array3f:
    """Array3f [3, N], world, metres: where to test each Gaussian instead of at its centre, so that a surface that the
    Sun grazes does not shadow itself (Holbert 2011, normal offset). Ours, no part of the thesis.

    Points are moved along the shortest axis, to the Sun's side, by gamma (thickness sigma_min + width sigma_max): out
    of the layer of Gaussians that a surface is, the second term for neighbours that are tilted or displaced. At
    grazing Suns such a layer is deep along the light, however thin it is. Shadows move by that height at most.
    thickness, width: chosen by measurement (docs/research/shadows.md). A Gaussian that is not finite stays where it is.
    """
    shape = _SunlitGaussian.of(gaussians, sun)
    height = shape.confidence * dr.fma(thickness, shape.shortest, width * shape.longest)
    towards = dr.select(dr.dot(shape.normal, sun) < 0, -height, height)
    return dr.detach(gaussians.means) + towards * shape.normal


@dataclass
class _SunlitGaussian:
    """A Gaussian as the Sun sees it, [N]; zeros where it is not finite."""

    thickness: Float  #: standard deviation along the sunlight, metres
    alignment: Float  #: |n . s|
    confidence: Float  #: 1 - shortest / longest
    longest: Float  #: largest standard deviation, metres
    shortest: Float  #: least one, metres
    normal: Array3f  #: Array3f, world axes: the shortest axis

    @staticmethod
    def of(gaussians: Gaussians, sun: Array3f) -> "_SunlitGaussian":
        log_scales, quaternions = dr.detach(gaussians.log_scales), dr.detach(gaussians.quaternions)
        length2 = dr.squared_norm(quaternions)
        sane = (length2 > 1e-24) & (length2 < 1e24)
        for i in range(3):
            sane &= (log_scales[i] > -60) & (log_scales[i] < 20)
        scales: Array3f = dr.select(sane, dr.exp(dr.select(sane, log_scales, ad.Array3f(0))), ad.Array3f(0))  # 4.19
        columns = principal_axes(quaternions)  # 4.20
        local = ad.Array3f([dr.dot(column, sun) for column in columns])  # 4.21
        first = (scales[0] <= scales[1]) & (scales[0] <= scales[2])
        normal: Any = dr.select(first, columns[0], dr.select(scales[1] <= scales[2], columns[1], columns[2]))  # 4.23
        longest = dr.max(scales)
        ratio: Any = dr.min(scales) * dr.rcp(dr.maximum(longest, 1e-30))
        return _SunlitGaussian(
            thickness=dr.norm(scales * local),
            alignment=dr.select(sane, dr.minimum(dr.abs(dr.dot(normal, sun)), 1), 0),
            confidence=dr.select(sane, dr.clip(1 - ratio, 0, 1), 0),
            longest=longest,
            shortest=dr.min(scales),
            normal=normal,
        )
