"""The tone curve: from linear display values to the sRGB values of the 8-bit image."""

import math
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from spacesim.data.files import JsonMapping
from spacesim.data.images.color import linear_from_srgb, srgb_from_linear

Tone = Literal["srgb", "filmic"]
TONES: tuple[Tone, ...] = get_args(Tone)
WHITES = {"srgb": 1.0, "filmic": (0.56 + math.sqrt(0.56**2 + 4 * 0.08 * 0.14)) / 0.16}
"""Linear display value that each curve makes white: the least v with t(v) = 1, which is 7.24 for `filmic`."""
STANDARD_EXPOSURE = math.pi / 1361.0
"""Display value of a radiance of 1 W m^-2 sr^-1 at an exposure of 0 EV: a white Lambertian surface that faces the Sun
at 1 au, whose irradiance is 1361 W m^-2 (IAU 2015 B3), shows 1."""

MU, PEAK = 5000.0, 16.0
"""Of `mu_law`, as Kalantari and Ramamoorthi 2017 have it; and the linear display value at which it is 1: 4 EV above
white."""

_BLOCK = 1 << 14  # values at a time: their copies stay in the processor's cache


class Curve(NamedTuple):
    """How a model's linear colours are shown."""

    tone: Tone  #: the tone curve
    exposure: float  #: EV of the pictures trained on
    white: float  #: linear display value of a colour of 1: of `WHITES`, or PEAK


def tone_and_exposure(scene: JsonMapping) -> tuple[Tone, float] | None:
    """(tone curve, exposure in EV) of a dataset's pictures, by its scene.json; None where that does not say."""
    try:
        tone = TONES[TONES.index(scene["config"]["camera"]["tone"])]
        exposure = float(scene["exposure"])
        return (tone, exposure_value(exposure)) if exposure > 0 else None
    except (KeyError, TypeError, ValueError):
        return None


def exposure_value(factor: float) -> float:
    """EV of a factor from radiance to display values."""
    return math.log2(factor / STANDARD_EXPOSURE)


def display_values(linear: np.ndarray, tone: str) -> np.ndarray:
    """sRGB values in [0, 1] of linear display values, of which 1 is white, by one of TONES."""
    return srgb_from_linear(filmic(linear) if tone == "filmic" else linear)


def linear_from_display(values: np.ndarray, tone: str) -> np.ndarray:
    """The inverse of `display_values`: linear display values, at most white, of sRGB ones. Any shape."""
    t = linear_from_srgb(values)
    if tone == "srgb":
        return t
    a, b = 2.51 - 2.43 * t, 0.03 - 0.59 * t  # a v^2 + b v - 0.14 t = 0
    return np.clip((np.sqrt(b * b + 0.56 * a * t) - b) / (2 * a), 0, WHITES[tone]).astype(t.dtype)


def mu_law(linear: np.ndarray) -> np.ndarray:
    """log(1 + MU v / PEAK) / log(1 + MU) of linear display values v, 0 or more: 0 to 1 up to PEAK, by the same formula
    beyond (Kalantari and Ramamoorthi, "Deep High Dynamic Range Imaging of Dynamic Scenes", 2017). Any shape."""
    encoded: np.ndarray = np.log1p(MU / PEAK * np.asarray(linear)) / math.log1p(MU)
    return encoded


def filmic(linear: np.ndarray) -> np.ndarray:
    """Linear values in [0, 1] of a film-like curve: its white is 7.2, and it makes 0.8 of 1.

    K. Narkowicz, "ACES Filmic Tone Mapping Curve", 2016: a rational fit to the ACES reference and output transforms.
    """
    x = np.clip(linear, 0, 8)  # white already; the square of what is far beyond would not be finite
    return np.minimum(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 1).astype(np.asarray(linear).dtype)


def as_bytes(values: np.ndarray) -> NDArray[np.uint8]:
    """8-bit numbers of values, any shape, clipped to [0, 1] first."""
    result = np.empty(np.shape(values), np.uint8)
    flat, every = result.reshape(-1), np.reshape(values, -1)
    for start in range(0, flat.size, _BLOCK):
        block = slice(start, start + _BLOCK)
        flat[block] = np.rint(255 * np.clip(every[block], 0, 1))
    return result
