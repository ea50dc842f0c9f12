"""Linear light to sRGB values and back in Dr.Jit, differentiable: for colours that are blended in linear light.

A model's linear colours are shares of what its tone curve makes white (`spacesim.data.images.tone.WHITES`): at most 1
but where light bounces. What is brighter than white is clipped. Of models that learn radiance they are shares of PEAK.
"""

import math
from typing import cast

import drjit as dr
import numpy as np

from spacesim.backend.arrays import ArrayT
from spacesim.data.images import srgb_from_linear
from spacesim.data.images.tone import PEAK, WHITES, filmic

_LINEAR_END, _ENCODED_END = 0.0031308, 0.04045
_SLOPE_AT_WHITE = 1.055 / 2.4  # of sRGB values by light
ENCODED_PEAK = 1 + _SLOPE_AT_WHITE * math.log(PEAK)  #: of `encode_radiance`


def tone_map(light: ArrayT, tone: str, white: float | None = None) -> ArrayT:
    """sRGB values in [0, 1] of linear colours by a tone curve. Arrays of any shape. white: linear display value of a
    colour of 1, by default what the curve makes white"""
    if white is not None and white != WHITES[tone]:
        light = (white / WHITES[tone]) * light
    if tone == "srgb":
        return encode_srgb(light)
    v = WHITES[tone] * dr.clip(light, 0, 1)
    return encode_srgb(v * dr.fma(2.51, v, 0.03) / dr.fma(v, dr.fma(2.43, v, 0.59), 0.14))  # `filmic`


def inverse_tone_map(values: ArrayT, tone: str) -> ArrayT:
    """The inverse: linear colours, shares of white, of sRGB values in [0, 1]."""
    t = decode_srgb(values)
    if tone == "srgb":
        return t
    a, b = 2.51 - 2.43 * t, 0.03 - 0.59 * t  # a v^2 + b v - 0.14 t = 0
    return dr.clip((dr.sqrt(dr.fma(b, b, 0.56 * a * t)) - b) / (2 * a) / WHITES[tone], 0, 1)


def adjust_exposure(light: np.ndarray, tone: str, stops: float = 0.0, white: float | None = None) -> np.ndarray:
    """sRGB values in [0, 1] of a picture of such colours, exposed by `stops` (EV) more than those trained on."""
    white = WHITES[tone] if white is None else white
    if tone == "srgb" and stops == 0 and white == 1:
        return srgb_from_linear(light)
    v = (white * 2.0**stops) * light
    return srgb_from_linear(filmic(v) if tone == "filmic" else v)


def encode_radiance(light: ArrayT) -> ArrayT:
    """Numbers by which a model that learns radiance is compared with it, of colours that are shares of PEAK, 0 or more:
    sRGB values up to white, beyond it logarithms that go on with the slope there, ENCODED_PEAK at PEAK. Arrays of any
    shape."""
    v = PEAK * light
    below = v <= 1
    beyond: ArrayT = _SLOPE_AT_WHITE * dr.log(dr.maximum(v, 1)) + 1
    inside: ArrayT = dr.select(below, v, dr.minimum(v, 1))  # at white the gradient is v's
    return dr.select(below, encode_srgb_unclipped(inside), beyond)


def decode_radiance(values: ArrayT) -> ArrayT:
    """The inverse: colours, shares of PEAK. Arrays of any shape."""
    beyond = dr.exp((dr.maximum(values, 1) - 1) / _SLOPE_AT_WHITE)
    return dr.select(values <= 1, decode_srgb(dr.minimum(values, 1)), beyond) / PEAK


def decode_radiance_slope(values: ArrayT) -> ArrayT:
    """d `decode_radiance`. Arrays of any shape."""
    beyond = dr.exp((dr.maximum(values, 1) - 1) / _SLOPE_AT_WHITE) / _SLOPE_AT_WHITE
    return dr.select(values <= 1, decode_srgb_slope(dr.minimum(values, 1)), beyond) / PEAK


def encode_srgb(linear: ArrayT) -> ArrayT:
    """sRGB values in [0, 1] of linear ones, clipped to [0, 1]. Arrays of any shape."""
    return encode_srgb_unclipped(dr.clip(linear, 0, 1))


def encode_srgb_unclipped(linear: ArrayT) -> ArrayT:
    """sRGB values of linear ones, 0 or more, beyond 1 by the same curve. Arrays of any shape. The slope is computed of
    the values, without another power."""
    light = dr.detach(linear)
    bright = dr.maximum(light, _LINEAR_END)
    values = dr.select(light <= _LINEAR_END, 12.92 * light, 1.055 * _power(bright, 1 / 2.4) - 0.055)
    if not dr.grad_enabled(linear):
        return values
    slope = dr.select(light <= _LINEAR_END, 12.92, (values + 0.055) / (2.4 * bright))
    return cast(ArrayT, dr.replace_grad(values, slope * linear))


def encode_srgb_slope(linear: ArrayT) -> ArrayT:
    """d `encode_srgb_unclipped`. Arrays of any shape."""
    curve = 1.055 / 2.4 * _power(dr.maximum(linear, _LINEAR_END), 1 / 2.4 - 1)
    return dr.select(linear <= _LINEAR_END, 12.92, curve)


def decode_srgb_slope(values: ArrayT) -> ArrayT:
    """d `decode_srgb`. Arrays of any shape."""
    curve = 2.4 / 1.055 * _power((dr.maximum(values, _ENCODED_END) + 0.055) / 1.055, 1.4)
    return dr.select(values <= _ENCODED_END, 1 / 12.92, curve)


def decode_srgb(values: ArrayT) -> ArrayT:
    """Linear values of sRGB ones in [0, 1]. Arrays of any shape."""
    curve = _power((dr.maximum(values, _ENCODED_END) + 0.055) / 1.055, 2.4)
    return dr.select(values <= _ENCODED_END, values / 12.92, curve)


def _power(values: ArrayT, exponent: float) -> ArrayT:
    """`dr.power`, which says to give an object."""
    return cast(ArrayT, dr.power(values, exponent))
