"""What becomes of the light: the tone curve of the 8-bit image."""

from dataclasses import dataclass

import numpy as np

from spacesim.data.images import srgb_from_linear

TONES = ("srgb", "filmic")


@dataclass(frozen=True)
class SensorConfig:
    """A real sensor's noise and limits."""


@dataclass(frozen=True, eq=False)
class Recording:
    """What a camera records. image: [H, W, 4], [H, W, 3] or [H, W] uint8; raw: digital numbers, uint16, or None."""

    image: np.ndarray
    raw: np.ndarray | None = None


def record(radiance: np.ndarray, alpha: np.ndarray, camera: "object", seed: tuple[int, ...]) -> Recording:
    """[H, W, 4] uint8 sRGB, straight alpha, of linear radiance [H, W, 3] that is weighted by alpha [H, W]."""
    straight = radiance / np.where(alpha > 0, alpha, 1)[..., None]
    exposed = camera.exposure * straight  # type: ignore[attr-defined]
    values = np.concatenate([srgb_from_linear(exposed), np.clip(alpha, 0, 1)[..., None]], axis=-1)
    return Recording(np.round(255 * values).astype(np.uint8))
