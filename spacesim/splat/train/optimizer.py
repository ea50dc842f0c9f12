"""Adam (Kingma & Ba 2015) over rows of parameters, whose moments follow when Gaussians come and go."""

from typing import Any

import drjit as dr

from spacesim.backend import ad


class Adam:
    """Moments of R rows of N parameters each; every row has a step size of its own.

    `Gaussians.rows` gives the rows. `update` is pure, so that it can be recorded once and replayed.
    """

    def __init__(self, rows: list[Any], beta1: float = 0.9, beta2: float = 0.999, eps: float = 1e-15) -> None:
        self.first = [dr.zeros(ad.Float, dr.width(row)) for row in rows]
        self.second = [dr.zeros(ad.Float, dr.width(row)) for row in rows]
        self.beta1, self.beta2, self.eps = beta1, beta2, eps
        self.steps = 0

    def corrections(self) -> tuple[float, float]:
        """Count a step; the factors that turn the moments into unbiased estimates."""
        self.steps += 1
        return 1 / (1 - self.beta1**self.steps), 1 / (1 - self.beta2**self.steps)

    def update(
        self,
        rows: list[Any],
        gradients: list[Any],
        moments: tuple[list[Any], list[Any]],
        rates: list[Any],
        unbias: Any,
    ) -> tuple[list[Any], list[Any], list[Any]]:
        """(rows, first, second) after a step. rates: [R] step sizes; unbias: what `corrections` gave."""
        moved, first, second = [], [], []
        for row, gradient, m, v, rate in zip(rows, gradients, *moments, rates, strict=True):
            m = self.beta1 * m + (1 - self.beta1) * gradient
            v = self.beta2 * v + (1 - self.beta2) * gradient * gradient
            moved.append(row - rate * (unbias[0] * m) / (dr.sqrt(unbias[1] * v) + self.eps))
            first.append(m)
            second.append(v)
        return moved, first, second

    def select(self, index: Any, fresh: Any) -> None:
        """Entry i of each moment becomes entry index[i], or zero where `fresh[i]`. index, fresh: [M]."""
        keep = [dr.select(fresh, 0, dr.gather(ad.Float, m, index)) for m in (*self.first, *self.second)]
        dr.eval(keep)
        self.first, self.second = keep[: len(self.first)], keep[len(self.first) :]

    def forget(self, rows: slice) -> None:
        """Set the moments of some rows to zero."""
        for moments in (self.first, self.second):
            moments[rows] = [dr.zeros(ad.Float, dr.width(m)) for m in moments[rows]]
