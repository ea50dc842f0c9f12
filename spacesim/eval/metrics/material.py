"""How well materials and normals are known: albedo up to one scale for all pictures, angles between normals."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from spacesim.eval.metrics.image import Mask

OVER_PIXELS = ("albedo_error", "normals_deg", "learned_normals_deg")
"""Measures that are means over pixels."""


@dataclass(frozen=True)
class AlbedoSums:
    """Of a picture's pixels and channels, linear values."""

    predicted_by_true: float  #: sum of a b, a predicted and b true
    predicted_squared: float  #: sum of a^2
    true: float  #: sum of b
    values: int  #: how many there are

    @staticmethod
    def of(predicted: np.ndarray, truth: np.ndarray, mask: Mask) -> "AlbedoSums":
        """predicted, truth: [H, W, 3]"""
        a, b = predicted[mask].astype(np.float64), truth[mask].astype(np.float64)
        return AlbedoSums(float((a * b).sum()), float((a * a).sum()), float(b.sum()), b.size)

    @staticmethod
    def total(sums: Iterable["AlbedoSums"]) -> "AlbedoSums":
        """Of several pictures."""
        rows = [(each.predicted_by_true, each.predicted_squared, each.true, each.values) for each in sums]
        by_true, squared, true, values = (sum(column) for column in zip(*rows, strict=True)) if rows else (0, 0, 0, 0)
        return AlbedoSums(by_true, squared, true, int(values))

    @property
    def scale(self) -> float | None:
        """s that makes sum (a s - b)^2 least; None where all that is predicted, or true, is 0."""
        known = self.predicted_squared > 0 and self.true > 0
        return self.predicted_by_true / self.predicted_squared if known else None


def albedo_error(predicted: np.ndarray, truth: np.ndarray, mask: Mask, scale: float, mean: float) -> float | None:
    """Mean of |a s - b| over the pixels of `mask` and the channels, as a share of `mean`, the mean of b over all
    pictures: the mean of such errors by pixels is sum |a s - b| / sum b. None over no pixel."""
    if not mask.any():
        return None
    return float(np.abs(predicted[mask].astype(np.float64) * scale - truth[mask]).mean()) / mean


def normals_deg(predicted: np.ndarray, truth: np.ndarray, mask: Mask) -> float | None:
    """Mean angle of unit vectors [H, W, 3] over `mask`, degrees; 90 where none is predicted. None over no pixel."""
    if not mask.any():
        return None
    cosine = np.einsum("pc,pc->p", predicted[mask].astype(np.float64), truth[mask].astype(np.float64))
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())
