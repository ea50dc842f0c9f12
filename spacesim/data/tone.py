"""The tone curve: from linear display values to the sRGB values of the 8-bit image."""

import numpy as np
from numpy.typing import NDArray

from spacesim.data.images import srgb_from_linear

TONES = ("srgb", "filmic")


def displayed(linear: np.ndarray, tone: str) -> np.ndarray:
    """sRGB values in [0, 1] of linear display values, of which 1 is white, by one of TONES."""
    return srgb_from_linear(filmic(linear) if tone == "filmic" else linear)


def filmic(linear: np.ndarray) -> np.ndarray:
    """Linear values of a film-like curve that keeps highlights up to 7.2 apart: 0.8 for 1, clipped to [0, 1].

    K. Narkowicz, "ACES Filmic Tone Mapping Curve", 2016: a rational fit to the ACES reference and output transforms.
    """
    x = np.maximum(linear, 0)
    return np.minimum(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 1).astype(np.asarray(linear).dtype)


def as_bytes(values: np.ndarray) -> NDArray[np.uint8]:
    """8-bit numbers of values, any shape, clipped to [0, 1] first."""
    return np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)
