"""The sRGB transfer function (IEC 61966-2-1) in Dr.Jit, differentiable: for colours blended in linear light."""

from typing import Any

import drjit as dr

_LINEAR_END, _ENCODED_END = 0.0031308, 0.04045


def encoded(linear: Any) -> Any:
    """sRGB values in [0, 1] of linear ones, clipped to [0, 1]. Arrays of any shape."""
    linear = dr.clip(linear, 0, 1)
    curve = 1.055 * dr.power(dr.maximum(linear, _LINEAR_END), 1 / 2.4) - 0.055
    return dr.select(linear <= _LINEAR_END, 12.92 * linear, curve)


def decoded(values: Any) -> Any:
    """Linear values of sRGB ones in [0, 1]. Arrays of any shape."""
    curve = dr.power((dr.maximum(values, _ENCODED_END) + 0.055) / 1.055, 2.4)
    return dr.select(values <= _ENCODED_END, values / 12.92, curve)
