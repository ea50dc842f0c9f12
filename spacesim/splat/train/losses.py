"""What training minimises: L1 and structural dissimilarity (thesis 2.8), on planes of pixels."""

from typing import Any

import drjit as dr

from spacesim.splat.train.ssim import ssim


def photometric_loss(prediction: Any, target: Any, width: int, height: int, ssim_weight: float = 0.2) -> Any:
    """(1 - w) mean |p - t| + w (1 - SSIM(p, t)), thesis 2.8 with D-SSIM = 1 - SSIM as gsplat takes it.

    prediction, target: Array3f [3, height * width];  returns a Float of width 1.
    """
    pixels = 3 * width * height
    l1 = dr.sum(dr.sum(dr.abs(prediction - target))) / pixels
    if ssim_weight == 0:
        return l1
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim(prediction, target, width, height))
