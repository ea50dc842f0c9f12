"""What training minimises beside the `photometric_loss`, on planes of pixels and on Gaussians."""

from typing import Any

import drjit as dr

from spacesim.backend.arrays import Array3f, Bool, Float
from spacesim.splat.raster.gaussians import Gaussians, opacities

ROUND = 1e-4  #: of a Gaussian's mean scale
TruthPlanes = dict[str, list[Any]]  #: on the device: Floats [H * W] by name; of "foreground" a Bool and its weight


def visibility_loss(prediction: Float, truth: Float, valid: Bool) -> Float:
    """Mean |blended visibility - path-traced visibility| over the object's pixels, planes [height * width], as a share
    of all pixels. truth: below 0 where there is no surface;  valid: Bool, pixels that count."""
    counts = valid & (truth >= 0)
    error = dr.abs(prediction - truth)
    return dr.sum(_where(counts, error)) / dr.width(truth)


def depth_loss(blended: Float, transmittance: Float, truth: Float, valid: Bool) -> Float:
    """Mean |sum_i w_i (z_i - z)| over the surface's pixels, as a share of all pixels: the expected depth's error, times
    alpha. blended: plane of sum_i w_i z_i;  truth: plane of z, 0 where there is no surface;  both in one unit"""
    counts = valid & (truth > 0)
    error = dr.abs(blended - (1 - transmittance) * truth)
    return dr.sum(_where(counts, error)) / dr.width(truth)


def normal_loss(blended: Array3f, transmittance: Float, truth: Array3f, valid: Bool) -> Float:
    """Mean of sum_i w_i (1 - n_i . n) over the surface's pixels, as a share of all pixels (Huang et al. 2024, 2DGS,
    with the true normal). blended: Array3f of sum_i w_i n_i;  truth: Array3f, unit, 0 where there is no surface"""
    counts = valid & (dr.squared_norm(truth) > 0.25)
    error = 1 - transmittance - dr.dot(blended, truth)
    return dr.sum(_where(counts, error)) / dr.width(truth)


def _where(counts: Bool, error: Float) -> Float:
    """The error of what counts, else 0."""
    return dr.select(counts, error, 0)


def penalty(name: str, gaussians: Gaussians) -> Float:
    """[N] what a named penalty on Gaussians adds up; lengths in metres. The weight of the sum is the caller's.

    "isotropy": see `anisotropy`;  "opacity" and "scale": opacity, and mean scale (Kheradmand et al. 2024)."""
    if name == "isotropy":
        return anisotropy(gaussians.log_scales)
    if name == "opacity":
        return opacities(gaussians.logit_opacities)
    if name == "scale":
        return dr.sum(dr.exp(gaussians.log_scales)) / 3
    raise ValueError(f"name: expected isotropy, opacity or scale, found {name!r}")


def anisotropy(log_scales: Array3f) -> Float:
    """[N] metres: mean distance of a Gaussian's three scales, Array3f [3, N], from their mean (Matsuki et al. 2024,
    section 3.3.3; the weight of the sum is the caller's). Within `ROUND` of the mean a scale counts as the mean: else
    the last bit of a round Gaussian would decide the sign of its gradient."""
    scales = dr.exp(log_scales)
    mean = dr.sum(scales) / 3  # dr.mean puts N into the kernel: a replay rounded by another N
    distances = [dr.abs(scales[i] - mean) for i in range(3)]
    return sum((dr.select(d > ROUND * mean, d, 0) for d in distances), type(mean)(0)) / 3
