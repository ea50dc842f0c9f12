"""Exposure and white balance of each training picture: a gain of each channel, learned with the model.

    shown = exp(g) c + T b      c: blended colour;  T: transmittance;  b: background

Colours are light where the method blends light (`light.linear`), so that a gain is what a shutter does; else they are
sRGB values, of which a gain in light is nearly one, too. A gain of each channel is the diagonal of the affine matrix of
Hierarchical 3DGS (Kerbl et al. 2024). All pictures brighter and a darker model are the same: the mean of g is held at 0
in each channel. Other pictures are drawn with a gain of 1.
"""

import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Float
from spacesim.data.geometry import Array
from spacesim.splat.train.pictures.numbers import PictureNumbers, falling

HOLD_EVERY = 50  #: steps


class Exposures:
    """The gains of a training's pictures."""

    def __init__(self, pictures: int, rate: float, iterations: int) -> None:
        """rate: step size of g at the start"""
        self.rate, self.iterations = rate, iterations
        self.numbers = PictureNumbers(pictures, 3, self._by_numbers)

    def gains(self, picture: int) -> Float:
        """Float [3] of a training picture."""
        return ad.Float(np.exp(self.numbers.of(picture)).tolist())  # no numpy array: see `backend.recorded`

    def all_gains(self) -> Array:
        """[V, 3] of all training pictures."""
        self.numbers.follow()
        return np.exp(self.numbers.values)

    def learn(self, picture: int, step: int, gradient: Float) -> None:
        """gradient: Float [3] by the gains of a picture that was shown in a step, the first of which is 0"""
        self.numbers.learn(picture, gradient, falling(self.rate, step / self.iterations))

    def hold(self, steps: int) -> None:
        """After so many steps: set the mean of g to 0, if it is time to."""
        if steps % HOLD_EVERY == 0 or steps == self.iterations:
            self.numbers.follow()
            self.numbers.values -= self.numbers.values.mean(axis=0)

    def _by_numbers(self, picture: int, gradient: Array) -> Array:
        return np.exp(self.numbers.values[picture]) * gradient
