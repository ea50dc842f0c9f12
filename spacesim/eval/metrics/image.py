"""How far a picture is from the truth (thesis 2.3): MAE, RMSE, PSNR, SSIM and FLIP, over a mask.

Pictures are [H, W, 3] sRGB values in [0, 1] over black; masks are [H, W] bool, None for every pixel. Sums are
in float64. A measure over no pixel at all is None.
"""

import math

import flip_evaluator
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from spacesim.data.geometry import Array

Mask = NDArray[np.bool_]

LEAST_MSE = 1e-10
"""Of PSNR, where (2.18) has no bound: equal pictures have 100 dB, and so count in means."""

SSIM_RADIUS = 5
"""Half width of the 11 x 11 window of SSIM, pixels; its Gaussian has a standard deviation of 1.5 pixels."""


def mae(prediction: np.ndarray, truth: np.ndarray, mask: Mask | None = None) -> float | None:
    """Mean absolute error (2.21) over the mask's pixels and the channels."""
    error = _difference(prediction, truth, mask)
    return float(np.abs(error).mean()) if error.size else None


def rmse(prediction: np.ndarray, truth: np.ndarray, mask: Mask | None = None) -> float | None:
    """Root mean squared error (2.22) over the mask's pixels and the channels."""
    error = _difference(prediction, truth, mask)
    return float(np.sqrt(np.square(error).mean())) if error.size else None


def psnr(prediction: np.ndarray, truth: np.ndarray, mask: Mask | None = None) -> float | None:
    """Peak signal-to-noise ratio (2.18), dB, MAX = 1, of a mean squared error of at least `LEAST_MSE`."""
    error = rmse(prediction, truth, mask)
    return None if error is None else -10.0 * math.log10(max(error**2, LEAST_MSE))


def ssim_map(prediction: np.ndarray, truth: np.ndarray) -> Array:
    """[H, W] structural similarity (2.19) of the window around each pixel, the mean of the channels.

    Gaussian window of 11 x 11 pixels (sigma 1.5), C1 = 0.01^2 and C2 = 0.03^2 (Wang et al. 2004). The picture
    is mirrored at its borders.
    """
    x, y = np.asarray(prediction, np.float64), np.asarray(truth, np.float64)
    mean_x, mean_y = _window(x), _window(y)
    variance_x = _window(x * x) - mean_x**2
    variance_y = _window(y * y) - mean_y**2
    covariance = _window(x * y) - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    similarity = ((2 * mean_x * mean_y + c1) * (2 * covariance + c2)) / (
        (mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2)
    )
    return similarity.mean(axis=-1)


def ssim(prediction: np.ndarray, truth: np.ndarray, mask: Mask | None = None) -> float | None:
    """Mean of `ssim_map` over the mask; without one over the pixels whose window lies inside the picture."""
    mask = interior(truth.shape[:2]) if mask is None else mask
    return float(ssim_map(prediction, truth)[mask].mean()) if mask.any() else None


def interior(shape: tuple[int, ...]) -> Mask:
    """[H, W] bool: the pixels of a picture whose SSIM window lies inside it."""
    mask = np.zeros(shape, bool)
    mask[SSIM_RADIUS:-SSIM_RADIUS, SSIM_RADIUS:-SSIM_RADIUS] = True
    return mask


def flip(prediction: np.ndarray, truth: np.ndarray, mask: Mask | None = None) -> float | None:
    """Mean LDR FLIP (Andersson et al. 2020), in [0, 1], of both pictures `crop_to_mask` to the mask.

    Viewed as its authors assume by default: 67 pixels per degree, a 0.7 m wide 4K display at 0.7 m.
    """
    if mask is not None and not mask.any():
        return None
    reference, test = (np.ascontiguousarray(crop_to_mask(p, mask), dtype=np.float32) for p in (truth, prediction))
    _, mean, _ = flip_evaluator.evaluate(reference, test, "LDR", applyMagma=False, parameters={})
    return float(mean)


def crop_to_mask(picture: np.ndarray, mask: Mask | None) -> np.ndarray:
    """The bounding box [h, w, 3] of the mask's pixels, black outside the mask; the mask must not be empty."""
    if mask is None:
        return picture
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return picture[box] * mask[box][..., None]


def _difference(prediction: np.ndarray, truth: np.ndarray, mask: Mask | None) -> Array:
    """[N, 3] prediction minus truth at the mask's pixels."""
    mask = np.ones(truth.shape[:2], bool) if mask is None else mask
    return np.asarray(prediction, np.float64)[mask] - np.asarray(truth, np.float64)[mask]


def _window(values: Array) -> Array:
    return gaussian_filter(values, sigma=1.5, radius=SSIM_RADIUS, axes=(0, 1))
