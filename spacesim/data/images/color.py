"""Colours as numbers: sRGB and linear values, luminance."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float = NDArray[np.floating]


def srgb_from_linear(linear: ArrayLike) -> Float:
    """sRGB values of linear ones, clipped to [0, 1] first (IEC 61966-2-1). Any shape; float32 stays so."""
    x = np.clip(_as_float(linear), 0, 1)
    values = np.array(12.92 * x)
    bright = ~(x <= 0.0031308)  # of most pictures a small part
    values[bright] = 1.055 * x[bright] ** (1 / 2.4) - 0.055
    return values


def linear_from_srgb(srgb: ArrayLike) -> Float:
    """Linear values of sRGB ones, clipped to [0, 1] first (IEC 61966-2-1). Any shape; float32 stays so."""
    x = np.clip(_as_float(srgb), 0, 1)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(x.dtype)


def luminance(rgb: ArrayLike) -> Float:
    """[...] luminance of the values `rgb` [..., 3] as they are, by the weights of Rec. 709."""
    rgb = _as_float(rgb)
    return rgb @ np.array([0.2126, 0.7152, 0.0722], rgb.dtype)


def _as_float(values: ArrayLike) -> Float:
    array = np.asarray(values)
    return array if np.issubdtype(array.dtype, np.floating) else array.astype(np.float64)
