"""Adam (Kingma & Ba 2015): a step of rows of parameters, and the moments of networks."""

from collections.abc import Sequence

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Float
from spacesim.backend.upload import upload

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15


class AdamSteps:
    """How many steps were taken."""

    steps = 0

    def corrections(self) -> tuple[float, float]:
        """Count a step; the factors that make the moments unbiased estimates."""
        self.steps += 1
        return corrections(self.steps)


class NetworkAdam(AdamSteps):
    """Moments of the weights of networks, arrays of any lengths."""

    def __init__(self, weights: list[Float]) -> None:
        self.first = [dr.zeros(ad.Float, dr.width(weight)) for weight in weights]
        self.second = [dr.zeros(ad.Float, dr.width(weight)) for weight in weights]

    def moments(self) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """The first and the second moment of each array."""
        return [np.array(moment) for moment in self.first], [np.array(moment) for moment in self.second]

    def put(self, first: Sequence[np.ndarray], second: Sequence[np.ndarray]) -> None:
        """The inverse of `moments`."""
        self.first, self.second = [upload(moment) for moment in first], [upload(moment) for moment in second]


def adam_step(
    rows: list[Float],
    gradients: list[Float],
    moments: tuple[list[Float], list[Float]],
    rates: list[Float],
    corrections: tuple[Float, Float],
) -> tuple[list[Float], list[Float], list[Float]]:
    """(rows, first, second) after a step; pure, so that it can be recorded once and replayed. rates: a row each.

    Gradients below EPSILON count as 0. They are round-off, and their squares are denormal numbers, which Dr.Jit's
    worker threads flush to zero and the main thread does not: Adam would make the number of threads visible.
    """
    moved, first, second = [], [], []
    for row, gradient, m, v, rate in zip(rows, gradients, *moments, rates, strict=True):
        gradient = dr.select(dr.abs(gradient) < EPSILON, 0, gradient)
        m = BETA1 * m + (1 - BETA1) * gradient
        v = BETA2 * v + (1 - BETA2) * gradient * gradient
        moved.append(row - rate * (corrections[0] * m) / (dr.sqrt(corrections[1] * v) + EPSILON))
        first.append(m)
        second.append(v)
    return moved, first, second


def corrections(steps: int) -> tuple[float, float]:
    """Adam's two factors after so many steps."""
    return 1 / (1 - BETA1**steps), 1 / (1 - BETA2**steps)
