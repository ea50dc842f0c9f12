"""Radiance to the picture that a camera records, and a sensor's digital numbers."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spacesim.data.images.tone import as_bytes, display_values
from spacesim.scenes.cameras.camera import CameraConfig

_NOISE = 2  # stream of random numbers


@dataclass(frozen=True, eq=False)
class Recording:
    """What a camera records."""

    image: np.ndarray  #: [H, W, 4], [H, W, 3] or [H, W] uint8
    raw: np.ndarray | None = None  #: digital numbers, [H, W] or [3, H, W] uint16, None without a sensor


def record_image(
    radiance: np.ndarray,
    alpha: np.ndarray,
    camera: CameraConfig,
    seed: Sequence[int],
    background: np.ndarray | None = None,
) -> Recording:
    """What `camera` makes of linear radiance [H, W, 3], W m^-2 sr^-1, that is weighted by alpha [H, W].

    background: radiance [H, W, 3] of what is behind, which shows where alpha lets it: light is mixed, not its picture.
    Without a sensor: [H, W, 4] uint8 with straight alpha, or [H, W, 3] over a background. With one: opaque, over black
    or the background, from digital numbers, and its noise made by `seed`. The same seed gives the same noise with the
    same version of numpy, which promises no more for distributions (NEP 19), and as far as two machines' logarithms
    agree in their last bit.
    """
    if background is not None:
        radiance = radiance + (1 - np.clip(alpha, 0, 1))[..., None] * background
        if camera.sensor is None:
            return Recording(as_bytes(display_values(camera.exposure * radiance, camera.tone)))
    if camera.sensor is None:
        straight = radiance / np.where(alpha > 0, alpha, 1)[..., None]
        colors = display_values(camera.exposure * straight, camera.tone)
        return Recording(as_bytes(np.concatenate([colors, np.clip(alpha, 0, 1)[..., None]], axis=-1)))
    sensor = camera.sensor
    light = camera.exposure * radiance.astype(np.float64)
    random = np.random.Generator(np.random.PCG64(np.random.SeedSequence([*seed, _NOISE])))
    raw = sensor.expose(light.mean(axis=-1) if sensor.monochrome else light, random)
    signal = (raw.astype(np.float64) - sensor.black_level_dn) / (sensor.highest - sensor.black_level_dn)
    image = as_bytes(display_values(signal, camera.tone))
    return Recording(image, raw if sensor.monochrome else np.ascontiguousarray(np.moveaxis(raw, -1, 0)))
