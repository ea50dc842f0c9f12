"""Gaussians as binary glTF with the extension KHR_gaussian_splatting.

Source: KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting/README.md, release candidate of 15 April 2026.
"""

from pathlib import Path

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.glb import POINTS, write_glb
from spacesim.data.images.color import linear_from_srgb
from spacesim.splat.export.frame import unit_quaternions
from spacesim.splat.raster.gaussians import SH_C0, Gaussians

NAME = "KHR_gaussian_splatting"
LARGEST_LOG = 80.0  #: of what exp in single precision takes


def write_gaussian_glb(gaussians: Gaussians, path: Path) -> None:
    """Write points with linear scales, opacities from 0 to 1, unit quaternions (x, y, z, w) and one attribute a
    harmonic, orders -l to l: its basis, Condon-Shortley phase included, is ours. Colours are sRGB values. What does not
    know the extension draws points in the mean colours (COLOR_0, linear). Axes are taken as they are: glTF has y up.

    Raises InputError for no Gaussians, which glTF cannot say, and where the file cannot be written.
    """
    if gaussians.count == 0:
        raise InputError(f"{path}: expected at least one Gaussian, found none")
    arrays = gaussians.to_numpy()
    opacity = opacity_of(arrays["logit_opacities"])
    colors = linear_from_srgb(np.clip(SH_C0 * arrays["sh"][:, 0] + 0.5, 0, 1))
    attributes = {
        "POSITION": arrays["means"],
        "COLOR_0": np.concatenate([colors, opacity[:, None]], axis=1).astype(np.float32),
        f"{NAME}:ROTATION": np.roll(unit_quaternions(arrays["quaternions"]), -1, axis=1).astype(np.float32),
        f"{NAME}:SCALE": np.exp(np.clip(arrays["log_scales"], -LARGEST_LOG, LARGEST_LOG)),
        f"{NAME}:OPACITY": opacity.astype(np.float32),
    }
    for degree in range(gaussians.sh_degree + 1):
        for k in range(2 * degree + 1):
            attributes[f"{NAME}:SH_DEGREE_{degree}_COEF_{k}"] = arrays["sh"][:, degree * degree + k]
    extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    extension |= {"projection": "perspective", "sortingMethod": "cameraDistance"}
    write_glb(path, attributes, POINTS, [(None, {"extensions": {NAME: extension}})], {"extensionsUsed": [NAME]})


def opacity_of(logits: np.ndarray) -> np.ndarray:
    """[N] float64 from 0 to 1, of logits [N]."""
    return np.asarray(1 / (1 + np.exp(-np.clip(logits.astype(np.float64), -700, 700))))
