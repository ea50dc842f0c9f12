"""Exposure and white balance of each training picture: a gain of each channel, learned with the model.

    shown = exp(g) c + T b      c: blended colour;  T: transmittance;  b: background

Colours are light where the method blends light (`light.linear`), so that a gain is what a shutter does; else they are
sRGB values, of which a gain in light is nearly one, too. A gain of each channel is the diagonal of the affine matrix of
Hierarchical 3DGS (Kerbl et al. 2024). All pictures brighter and a darker model are the same: the mean of g is held
where it starts in each channel, at 0 but for pictures that name their exposure. Other pictures are drawn with a gain
of 1.
"""

import numpy as np

from spacesim.backend.arrays import Float
from spacesim.backend.upload import upload_numbers
from spacesim.data.errors import InputError
from spacesim.data.geometry import Array
from spacesim.data.images.tone import exposure_value, tone_and_exposure
from spacesim.data.records import Dataset
from spacesim.splat.light.config import MAX_EXPOSURE, LightConfig
from spacesim.splat.train.pictures.numbers import PictureNumbers, falling

HOLD_EVERY = 50  #: steps


class Exposures:
    """The gains of a training's pictures."""

    def __init__(self, start: Array, rate: float, iterations: int) -> None:
        """start: [V] gains;  rate: step size of g at the start"""
        self.rate, self.iterations = rate, iterations
        self.numbers = PictureNumbers(len(start), 3, self._by_numbers)
        self.numbers.values += np.log(start)[:, None]
        self._mean = np.log(start).mean()

    def gains(self, picture: int) -> Float:
        """Float [3] of a training picture."""
        return upload_numbers(np.exp(self.numbers.of(picture)).tolist())  # no numpy array: see `backend.recorded`

    def all_gains(self) -> Array:
        """[V, 3] of all training pictures."""
        self.numbers.follow()
        return np.exp(self.numbers.values)

    def learn(self, picture: int, step: int, gradient: Float) -> None:
        """gradient: Float [3] by the gains of a picture that was shown in a step, the first of which is 0"""
        self.numbers.learn(picture, gradient, falling(self.rate, step / self.iterations))

    def hold(self, steps: int) -> None:
        """After so many steps: set the mean of g to what it was at the start, if it is time to."""
        if steps % HOLD_EVERY == 0 or steps == self.iterations:
            self.numbers.follow()
            self.numbers.values += self._mean - self.numbers.values.mean(axis=0)

    def _by_numbers(self, picture: int, gradient: Array) -> Array:
        return np.exp(self.numbers.values[picture]) * gradient


def known_gains(dataset: Dataset, light: LightConfig | None) -> Array:
    """[V] by which training pictures are brighter than what the model draws, as they name exposures of their own; 1
    where they name none, scene.json does not say what the others have, or radiance is learned, which has none. light:
    of the model. A gain of light f is nearly one of f^(1 / 2.4) of sRGB values. Raises InputError for an exposure that
    no camera has."""
    development, frames, curve = tone_and_exposure(dataset.scene), dataset.train, light.curve if light else None
    if development is None or (light and light.radiance):
        return np.ones(len(frames))
    base = curve.exposure if curve else development[1]
    stops = np.array([exposure_value(frame.exposure) - base if frame.exposure else 0.0 for frame in frames])
    far = np.flatnonzero(~(np.abs(stops) <= MAX_EXPOSURE))
    if len(far):
        expected, frame = f"expected an exposure within {MAX_EXPOSURE} EV of the scene's", frames[far[0]]
        raise InputError(f"{dataset.root}: {expected}, found {frame.exposure} in {frame.file_path}")
    return np.exp2(stops if curve else stops / 2.4)
