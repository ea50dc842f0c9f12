"""Adam (Kingma & Ba 2015) over rows of parameters, whose moments follow when Gaussians come and go."""

from typing import Any

import drjit as dr

from spacesim.backend import ad
from spacesim.splat.gaussians import entries

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15
AT_ONCE = 12  #: rows of moments that are rearranged at once, chosen


class Adam:
    """First and second moments of rows of parameters (`Gaussians.rows`, or the weights of networks)."""

    def __init__(self, rows: list[Any]) -> None:
        self.first = [dr.zeros(ad.Float, dr.width(row)) for row in rows]
        self.second = [dr.zeros(ad.Float, dr.width(row)) for row in rows]
        self.steps = 0

    def corrections(self) -> tuple[float, float]:
        """Count a step; the factors that make the moments unbiased estimates."""
        self.steps += 1
        return 1 / (1 - BETA1**self.steps), 1 / (1 - BETA2**self.steps)

    def part(self, rows: slice) -> tuple[list[Any], list[Any]]:
        """First and second moments of some rows."""
        return self.first[rows], self.second[rows]

    def select(self, index: Any, fresh: Any) -> None:
        """Entry i of each moment becomes entry index[i], or zero where `fresh[i]`. index, fresh: [M]. The first row is
        of length N; longer ones are packed rows."""
        count, chosen = dr.width(self.first[0]), dr.width(index)
        size = dr.opaque(ad.UInt32, chosen)  # as a literal each size would be compiled
        for moments in (self.first, self.second):
            for start in range(0, len(moments), AT_ONCE):  # in parts, so that old ones go as new ones come
                part = []
                for moment in moments[start : start + AT_ONCE]:
                    copies, forget = dr.width(moment) // count, fresh
                    if copies > 1:
                        forget = dr.gather(ad.Bool, fresh, dr.arange(ad.UInt32, copies * chosen) % size)
                    part.append(dr.select(forget, 0, entries(moment, index, count)))
                dr.eval(part)
                moments[start : start + AT_ONCE] = part

    def forget(self, rows: slice) -> None:
        """Set the moments of some rows to zero."""
        for moments in (self.first, self.second):
            moments[rows] = [dr.zeros(ad.Float, dr.width(m)) for m in moments[rows]]


def adam_step(
    rows: list[Any],
    gradients: list[Any],
    moments: tuple[list[Any], list[Any]],
    rates: list[Any],
    corrections: tuple[Any, Any],
) -> tuple[list[Any], list[Any], list[Any]]:
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
