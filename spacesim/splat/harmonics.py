"""Spherical harmonics that turn with their model (Ivanic and Ruedenberg 1996, with the corrections of 1998).

The rotation of a band of degree l follows from that of degree l - 1 and of degree 1, which is the rotation matrix
itself; no function is sampled. Basis and signs are those of docs/explanation/conventions.md.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from spacesim.data.geometry import Array


def rotate_harmonics(coefficients: ArrayLike, rotation: ArrayLike) -> Array:
    """Coefficients [N, K, C] of f(R^-1 d), of those of f(d): what a model's colours become when it is turned by R.

    coefficients: [N, K, C], K = (L + 1)^2;  rotation: [3, 3], R, world from model. float64
    """
    values = np.asarray(coefficients, np.float64)
    bands = band_rotations(rotation, round(values.shape[1] ** 0.5) - 1)
    turned = [np.einsum("mn,inc->imc", band, values[:, k * k : (k + 1) ** 2]) for k, band in enumerate(bands)]
    return np.concatenate(turned, axis=1) if turned else values


def band_rotations(rotation: ArrayLike, degree: int) -> list[Array]:
    """Matrices [2 l + 1, 2 l + 1] for l = 0 ... degree that take the coefficients of order -l ... l to the turned
    function's."""
    turn = np.asarray(rotation, np.float64)
    first = turn[np.ix_((1, 2, 0), (1, 2, 0))]  # orders -1, 0, 1 are y, z, x
    bands = [np.ones((1, 1)), first]
    for band in range(2, degree + 1):
        bands.append(_next_band(band, first, bands[-1]))
    signs = [_signs(band) for band in range(degree + 1)]
    return [sign[:, None] * matrix * sign for sign, matrix in zip(signs, bands, strict=False)]


@lru_cache(maxsize=16)
def _signs(band: int) -> Array:
    """(-1)^m: the Condon-Shortley phase, which the recursion does without."""
    return np.array([(-1.0) ** abs(m) for m in range(-band, band + 1)])


def _next_band(band: int, first: Array, before: Array) -> Array:
    """Degree `band` of degrees 1 and `band` - 1: the sums u U + v V + w W of the paper's tables 1 and 2."""

    def product(i: int, m: int, n: int) -> float:
        """P of table 2: row i (-1, 0, 1) of degree 1 with row m of the band before."""
        row, last = before[m + band - 1], 2 * band - 2
        if abs(n) < band:
            return float(first[i + 1, 1] * row[n + band - 1])
        if n == band:
            return float(first[i + 1, 2] * row[last] - first[i + 1, 0] * row[0])
        return float(first[i + 1, 2] * row[0] + first[i + 1, 0] * row[last])

    def entry(m: int, n: int) -> float:
        below = (band + n) * (band - n) if abs(n) < band else 2 * band * (2 * band - 1)
        zero, one = m == 0, abs(m) == 1
        total = 0.0
        if abs(m) < band:
            total += np.sqrt((band + m) * (band - m) / below) * product(0, m, n)
        v = 0.5 * np.sqrt((1 + zero) * (band + abs(m) - 1) * (band + abs(m)) / below) * (1 - 2 * zero)
        if zero:
            total += v * (product(1, 1, n) + product(-1, -1, n))
        elif m > 0:
            away = 0.0 if one else product(-1, 1 - m, n)
            total += v * (np.sqrt(1 + one) * product(1, m - 1, n) - away)
        else:
            away = 0.0 if one else product(1, m + 1, n)
            total += v * (away + np.sqrt(1 + one) * product(-1, -m - 1, n))
        if abs(m) <= band - 2 and not zero:
            w = -0.5 * np.sqrt((band - abs(m) - 1) * (band - abs(m)) / below)
            side = 1 if m > 0 else -1
            total += w * (product(1, m + side, n) + side * product(-1, -m - side, n))
        return float(total)

    orders = range(-band, band + 1)
    return np.array([[entry(m, n) for n in orders] for m in orders])
