"""SSIM (Wang et al. 2004, data range 1) and its window, of Dr.Jit's arrays or of what text computes with."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

RADIUS = 5  #: 11 x 11 window
SIGMA = 1.5  #: pixels
_C1, _C2 = 0.01**2, 0.03**2
_OFFSETS = np.arange(-RADIUS, RADIUS + 1)
_WEIGHTS = np.exp(-0.5 * (_OFFSETS / SIGMA) ** 2)
WINDOW: list[float] = (_WEIGHTS / _WEIGHTS.sum()).tolist()


def blurred(values: Sequence[Any], fma: Callable[..., Any]) -> Any:
    """The middle one of 2 RADIUS + 1 neighbours, blurred. The window is symmetric: two neighbours meet before they are
    weighed, and sums and products run side by side. fma: (x, y, z) to x y + z"""
    total = values[RADIUS] * WINDOW[RADIUS]
    for k in range(1, RADIUS + 1):
        total = fma(values[RADIUS - k] + values[RADIUS + k], WINDOW[RADIUS + k], total)
    return total


def similarity(
    means: Sequence[Any], inside: Callable[[Any], Any], fma: Callable[..., Any], reciprocal: Callable[[Any], Any]
) -> tuple[Any, Any, Any, Any]:
    """SSIM of a pixel from the means of x, y, x^2 + y^2 and x y under its window, and its derivatives by those of x,
    x^2 and x y (the first with the window's other means held). inside: makes 0 of numbers of pixels beyond the picture,
    where all are 0 then;  fma, reciprocal: (x, y, z) to x y + z, x to 1 / x"""
    mx, my, squares, product = means
    mxy, mm = mx * my, fma(mx, mx, my * my)
    a1, a2 = 2 * mxy + _C1, 2 * (product - mxy) + _C2
    r1, r2 = reciprocal(mm + _C1), reciprocal(squares - mm + _C2)
    inverse = inside(r1 * r2)
    value = a1 * a2 * inverse
    grad_mean = 2 * my * (a2 - a1) * inverse + 2 * mx * value * (r2 - r1)
    return value, grad_mean, -value * r2, 2 * a1 * inverse
