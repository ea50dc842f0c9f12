"""How long a training will still take: learned from the times of its steps, which grow with what they draw."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

MEMORY = 0.1  #: of the training, after which a time counts half: machines are busy now and then
PRIOR = 0.02  #: weight of the belief that half of a step's time grows with the Gaussians, beside the times' own
POWER = 0.7  #: by which Gaussians grow, as far as is known before; density control slows down
MAX_POWER = 1.5  #: faster and faster
SEEN = 3  #: densification steps that tell as much of the power as that belief
PARTS = 256  #: of the rest of a training, over which times are added up


@dataclass(frozen=True)
class Growth:
    """How long and how far Gaussians can grow in number."""

    ends: int  #: iterations after which none joins
    most: int  #: Gaussians that there can be


@dataclass
class TimeLeft:
    """Estimates the time left of a training from the times of finished steps.

    A step takes a + b N: pixels, as many as the schedule has then, and Gaussians, as many as there are; least squares
    find a and b, and newer times count more. N grows until `growth.ends` by the power of the iterations that leads from
    its first value by the one half way to the last.
    """

    iterations: int  #: of the whole training
    growth: Growth | None = None  #: None: of a model without Gaussians
    pixels: Callable[[int], float] = lambda step: 1.0  #: that a step draws, as a share, the first of which is 0
    times: list[tuple[int, float, int]] = field(default_factory=list)  #: finished iterations, seconds, Gaussians

    def add(self, iteration: int, seconds: float, gaussians: int | None) -> None:
        """After `iteration` finished ones. seconds: by any clock"""
        self.times.append((iteration, seconds, gaussians or 1))

    @property
    def lower_bound(self) -> bool:
        """Whether Gaussians will grow in number by an unknown amount, as none has joined yet."""
        if self.growth is None or not self.times:
            return False
        done, _, count = self.times[-1]
        return done < self.growth.ends and count == self.times[0][2] < self.growth.most

    def seconds(self) -> float | None:
        """None before the second time."""
        if len(self.times) < 2:
            return None
        iterations, seconds, counts = np.array(self.times, float).T
        steps = np.diff(iterations)
        middle, drawn = 0.5 * (iterations[1:] + iterations[:-1]), 0.5 * (counts[1:] + counts[:-1])
        age = (iterations[-1] - middle) / max(MEMORY * self.iterations, 1)
        a, b = _fit(self._shares(middle), drawn, np.diff(seconds) / steps, steps * 0.5**age)
        edges = np.linspace(iterations[-1], self.iterations, PARTS + 1)
        ahead = 0.5 * (edges[1:] + edges[:-1])
        each = a * self._shares(ahead) + b * self._gaussians(ahead, iterations, counts)
        return float(each.mean() * (self.iterations - iterations[-1]))

    def _shares(self, iterations: np.ndarray) -> np.ndarray:
        return np.array([self.pixels(int(step)) for step in iterations])

    def _gaussians(self, ahead: np.ndarray, iterations: np.ndarray, counts: np.ndarray) -> np.ndarray:
        """At the iterations `ahead`."""
        now, growth = iterations[-1], self.growth
        grown = counts[-1] - counts[0]
        if growth is None or now >= growth.ends or grown <= 0:
            return np.full(len(ahead), counts[-1])
        begins = iterations[np.argmax(counts != counts[0]) - 1]
        half = np.interp(0.5 * (begins + now), iterations, counts) - counts[0]
        seen = np.count_nonzero(np.diff(counts))
        power = float(np.clip(np.log2(grown / max(half, 1e-3 * grown)), 0, MAX_POWER))
        power = (SEEN * POWER + seen * power) / (SEEN + seen)
        share = (np.minimum(ahead, growth.ends) - begins) / (now - begins)
        return np.minimum(counts[0] + grown * share**power, max(growth.most, counts[-1]))


def _fit(pixels: np.ndarray, gaussians: np.ndarray, times: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    """a, b >= 0 of times = a pixels + b Gaussians, by weighted least squares beside PRIOR; all [T]."""
    weights = weights / weights.sum()
    scale = np.array([weights @ pixels, weights @ gaussians])
    unit = max(float(weights @ times), 1e-12)
    columns = np.stack([pixels, gaussians], axis=1) / scale
    normal = columns.T @ (weights[:, None] * columns) + PRIOR * np.eye(2)
    right = columns.T @ (weights * times / unit) + PRIOR * 0.5
    coefficients = np.linalg.solve(normal, right)
    if coefficients.min() < 0:
        coefficients = np.where(coefficients > 0, 1.0, 0.0)
    a, b = unit * coefficients / scale
    return float(a), float(b)
