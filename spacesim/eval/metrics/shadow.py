"""How well shadows are reproduced: by luminance (thesis 2.23 to 2.26) and by predicted sun visibility.

Luminance is Rec. 709 of the sRGB-encoded values, [H, W] in [0, 1]; below 0.1 a pixel counts as shadowed.
Masks are [H, W] bool. A measure over no pixel at all is None.
"""

import numpy as np
from scipy.ndimage import binary_dilation

from spacesim.data.store import SHADOW_ATTACHED, SHADOW_LIT, SHADOW_SELF_CAST
from spacesim.eval.metrics.image import Mask

THRESHOLD = 0.1
"""Luminance below which a pixel is shadowed (thesis 2.3)."""

BAND = 2
"""Pixels to each side of the shadow boundary that make its band (the thesis gives no width)."""

KINDS = {
    "shadow_attached": (SHADOW_ATTACHED, SHADOW_ATTACHED),
    "shadow_self_cast": (SHADOW_SELF_CAST, SHADOW_SELF_CAST),
    "shadow_other_cast": (SHADOW_SELF_CAST + 1, SHADOW_LIT - 1),
}
"""First and last class (`spacesim.data.store.SHADOW_*`) of each kind of shadow, by its group in metrics.json."""

OVER_PIXELS = ("error_rate", "visibility_mae")
"""Measures of visibility that are means over pixels, and so can be taken over those of many frames at once."""

Metrics = dict[str, float | None]


def is_shadowed(luminance: np.ndarray) -> Mask:
    """[H, W] bool: luminance below the thesis's threshold."""
    return np.asarray(luminance) < THRESHOLD


def boundary_band(shadowed: Mask, mask: Mask) -> Mask:
    """[H, W] bool: pixels of `mask` within `BAND` rows and columns of both shadowed and lit pixels of `mask`.

    Both sides lie in the mask, so the outline of a silhouette is no shadow boundary.
    """
    square = np.ones((2 * BAND + 1, 2 * BAND + 1), bool)
    return mask & binary_dilation(shadowed & mask, square) & binary_dilation(~shadowed & mask, square)


def luminance_metrics(prediction: np.ndarray, truth: np.ndarray, mask: Mask) -> Metrics:
    """The thesis's four shadow measures of luminances [H, W] over `mask`.

    ber: (FP + FN) / all pixels (2.23);  bias: mean of prediction - truth over true shadow (2.24);
    boundary_mae: mean |prediction - truth| over the boundary band of the true shadow (2.25);
    sharpness_ratio: mean |gradient| of the prediction over the band by that of the truth (2.26), from central
    differences. Across an edge slopes add up to its height, so only blur beyond the band lowers the ratio.
    """
    prediction, truth = np.asarray(prediction, np.float64), np.asarray(truth, np.float64)
    shadowed = is_shadowed(truth)
    band = boundary_band(shadowed, mask)
    error = prediction - truth
    slope, true_slope = _mean(_gradient(prediction), band), _mean(_gradient(truth), band)
    return {
        "ber": _mean(is_shadowed(prediction) != shadowed, mask),
        "bias": _mean(error, mask & shadowed),
        "boundary_mae": _mean(np.abs(error), band),
        "sharpness_ratio": slope / true_slope if slope is not None and true_slope else None,
    }


def visibility_metrics(prediction: np.ndarray, truth: np.ndarray, mask: Mask) -> Metrics:
    """Predicted against path-traced visibility, [H, W] in [0, 1], over `mask`: lit and cast-shadow pixels.

    At least one half is lit. error_rate: wrong pixels by all;  balanced_error_rate: mean of the error rates
    of truly shadowed and truly lit pixels;  iou: of the shadows;  visibility_mae: mean |prediction - truth|;
    pixels: how many are evaluated.
    """
    predicted, shadowed = prediction < 0.5, truth < 0.5
    missed, invented = _mean(~predicted, mask & shadowed), _mean(predicted, mask & ~shadowed)
    return {
        "error_rate": _mean(predicted != shadowed, mask),
        "balanced_error_rate": None if missed is None or invented is None else 0.5 * (missed + invented),
        "iou": _mean(predicted & shadowed, mask & (predicted | shadowed)),
        "visibility_mae": _mean(np.abs(np.asarray(prediction, np.float64) - truth), mask),
        "pixels": int(mask.sum()),
    }


def kind_metrics(
    prediction: np.ndarray, truth: np.ndarray, classes: np.ndarray, kind: str, valid: Mask
) -> Metrics | None:
    """`visibility_metrics` over lit pixels and those of one of `KINDS`, with recall: the share of the latter that is
    predicted dark. None where the frame shows no shadow of that kind.

    classes: [H, W] shadow classes;  valid: [H, W] pixels that count
    """
    first, last = KINDS[kind]
    of_kind = valid & (classes >= first) & (classes <= last)
    if not of_kind.any():
        return None
    lit = valid & (classes == SHADOW_LIT)
    return {
        "recall": _mean(prediction < 0.5, of_kind),
        **visibility_metrics(prediction, truth, of_kind | lit),
    }


def _mean(values: np.ndarray, mask: Mask) -> float | None:
    return float(values[mask].mean()) if mask.any() else None


def _gradient(luminance: np.ndarray) -> np.ndarray:
    """[H, W] length of the gradient, 1/pixel; central differences, one-sided at the frame's edges."""
    if min(luminance.shape) < 2:
        return np.zeros_like(luminance)
    return np.hypot(*np.gradient(luminance))
