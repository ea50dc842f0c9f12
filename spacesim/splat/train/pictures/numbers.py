"""Learned numbers of each training picture, which have steps of their own.

A picture is shown once in an epoch, so its moments count its own steps, not the training's. Its numbers are few: they
stay in main memory in double precision, and gradients are read when a later step has begun, so that no step waits.
"""

from collections.abc import Callable, Mapping

import numpy as np

from spacesim.backend.arrays import Float
from spacesim.data.geometry import Array
from spacesim.learning.adam import EPSILON

BETA1, BETA2 = 0.5, 0.9  #: of Adam: a picture has some hundred steps at most, so its moments forget sooner


class PictureNumbers:
    """K numbers of each of V pictures, 0 at first, moved by Adam (Kingma & Ba 2015)."""

    def __init__(self, pictures: int, count: int, slope: Callable[[int, Array], Array] | None = None) -> None:
        """slope: (picture, what was read) -> gradient [K] by its numbers as they are; None: it was read"""
        self.values, self.first, self.second = (np.zeros((pictures, count)) for _ in range(3))
        self.steps = np.zeros(pictures)
        self._slope = slope or (lambda picture, gradient: gradient)
        self._pending: list[tuple[int, Float, float]] = []

    def of(self, picture: int) -> Array:
        """[K] of a picture, which has followed all that it has taught."""
        if any(other == picture for other, _, _ in self._pending):
            self.follow()
        numbers: Array = self.values[picture]
        return numbers

    def learn(self, picture: int, gradient: Float, rate: float) -> None:
        """gradient: Float, which need not be there yet;  rate: step size of each number"""
        self.follow()  # what an earlier view has taught is there by now
        self._pending.append((picture, gradient, rate))

    def follow(self) -> None:
        """Take all steps that are pending. A picture's depend on that picture alone: nothing depends on when."""
        for picture, read, rate in self._pending:
            gradient = np.asarray(read, np.float64)
            if np.isfinite(gradient).all():
                self._step(picture, self._slope(picture, gradient), rate)
        self._pending.clear()

    def tensors(self, name: str) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        self.follow()
        arrays = {"values": self.values, "first": self.first, "second": self.second, "steps": self.steps}
        return {f"{name}.{key}": array.copy() for key, array in arrays.items()}

    def restore(self, name: str, tensors: Mapping[str, np.ndarray]) -> None:
        """The inverse of `tensors`. Raises KeyError, or ValueError for another size."""
        for key, like in self.tensors(name).items():
            if tensors[key].shape != like.shape:
                raise ValueError(f"{key}: expected {list(like.shape)} numbers, found {list(tensors[key].shape)}")
        self.values, self.first, self.second, self.steps = (
            np.array(tensors[f"{name}.{key}"], np.float64) for key in ("values", "first", "second", "steps")
        )
        self._pending.clear()

    def _step(self, picture: int, gradient: Array, rate: float) -> None:
        self.steps[picture] += 1
        m, v, steps = self.first[picture], self.second[picture], self.steps[picture]
        m += (1 - BETA1) * (gradient - m)
        v += (1 - BETA2) * (gradient * gradient - v)
        step = m / (1 - BETA1**steps) / (np.sqrt(v / (1 - BETA2**steps)) + EPSILON)
        self.values[picture] -= rate * step


def falling(first: float, done: float) -> float:
    """A step size that falls exponentially, to a hundredth at the end. done: share of the steps, 0 to 1"""
    return float(first * 0.01 ** min(max(done, 0.0), 1.0))
