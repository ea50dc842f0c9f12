"""Receiver-depth bias: how far behind a blocker a Gaussian may lie before it counts as shadowed (thesis 4.3.4)."""

from dataclasses import dataclass
from typing import Any

import drjit as dr

from spacesim.backend import ad
from spacesim.splat.cameras import LARGEST
from spacesim.splat.gaussians import Gaussians, principal_axes


@dataclass
class Bias:
    """What thesis 4.19 to 4.26 say of N Gaussians under one Sun, Floats [N], detached and finite."""

    thickness: Any  #: sigma^l, metres: standard deviation along the sunlight (4.22)
    alignment: Any  #: nu in [0, 1]: |n . s| of the shortest axis (4.24)
    confidence: Any  #: gamma in [0, 1]: 1 - shortest / longest axis (4.25)
    bias: Any  #: b, metres (4.26)


def receiver_bias(gaussians: Gaussians, sun: Any, strength: float = 10.0) -> Bias:
    """Thesis 4.19 to 4.26: b = strength sigma^l nu gamma.

    sun: Array3f of width 1, unit, from the scene towards the Sun (`sunlight.towards_sun`); strength: lambda_b, whose
    value in the thesis is 10. Among equal axes the first is the shortest. A Gaussian that is not finite gets 0
    everywhere. May be part of a recording.
    """
    shape = _Shape.of(gaussians, sun)
    bias = strength * shape.thickness * shape.alignment * shape.confidence
    return Bias(shape.thickness, shape.alignment, shape.confidence, dr.minimum(bias, LARGEST))


@dataclass
class _Shape:
    """A Gaussian as the Sun sees it, Floats [N]."""

    thickness: Any  #: standard deviation along the sunlight, metres
    alignment: Any  #: |n . s|
    confidence: Any  #: 1 - shortest / longest

    @staticmethod
    def of(gaussians: Gaussians, sun: Any) -> "_Shape":
        log_scales, quaternions = dr.detach(gaussians.log_scales), dr.detach(gaussians.quaternions)
        length2 = dr.squared_norm(quaternions)
        sane = (length2 > 1e-24) & (length2 < 1e24)
        for i in range(3):
            sane &= (log_scales[i] > -60) & (log_scales[i] < 20)
        scales = dr.select(sane, dr.exp(dr.select(sane, log_scales, ad.Array3f(0))), ad.Array3f(0))  # 4.19
        columns = principal_axes(quaternions)  # 4.20
        local = ad.Array3f([dr.dot(column, sun) for column in columns])  # 4.21
        first = (scales[0] <= scales[1]) & (scales[0] <= scales[2])
        alignment = dr.select(first, local[0], dr.select(scales[1] <= scales[2], local[1], local[2]))  # 4.23
        ratio = dr.min(scales) * dr.rcp(dr.maximum(dr.max(scales), 1e-30))
        return _Shape(
            thickness=dr.norm(scales * local),
            alignment=dr.select(sane, dr.minimum(dr.abs(alignment), 1), 0),
            confidence=dr.select(sane, dr.clip(1 - ratio, 0, 1), 0),
        )
