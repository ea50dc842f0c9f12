"""What is compared: pictures as they come, and the model drawn as a run draws it."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from spacesim.backend.arrays import Float
from spacesim.data.earth import Earth
from spacesim.data.errors import InputError
from spacesim.data.geometry import Array
from spacesim.data.images import load_image
from spacesim.data.records import Camera, Dataset, Frame, Image, Sun, check_camera
from spacesim.splat.light.model import LightModel
from spacesim.splat.light.sunlight import Sunlight
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.render import RenderOutput, render
from spacesim.splat.raster.supersample import render_supersampled
from spacesim.splat.raster.tone import adjust_exposure
from spacesim.splat.run import Run

GAINS = 0.5, 2.0  #: bounds on the picture's sRGB values over the model's: 2.3 stops


@dataclass(frozen=True, eq=False)
class SunlitRun:
    """A run under one Sun."""

    run: Run  #: the trained model
    sun: Array | None  #: [3], towards it
    sunlight: Sunlight | None  #: None of a run without light
    earth: Earth | None  #: that the Sun lights

    @staticmethod
    def of(run: Run, sun: Sun | None) -> "SunlitRun":
        direction = None if sun is None else sun.direction
        sunlight = run.light.sunlight(run.gaussians, direction) if run.light else None
        return SunlitRun(run, direction, sunlight, None if sun is None else sun.earth)

    def shade(self, camera: Camera) -> list[Float] | None:
        """Colours [N] three times as seen by a camera; None of harmonics, which are summed while drawing."""
        if self.run.light is None:
            return None
        light: LightModel = self.run.light
        model: Gaussians = self.run.gaussians
        colors, _ = light.shade_picture(model, Pinhole.of(camera), self.sun, sunlight=self.sunlight, earth=self.earth)
        return colors

    def draw(self, camera: Camera, colors: list[Float] | None) -> np.ndarray:
        """[H, W, 4] float32: sRGB values over black, alpha."""
        output = self.output(camera, colors)
        rgb = output.image("color" if colors is None else "features")
        if self.run.curve:
            rgb = adjust_exposure(rgb, self.run.curve.tone, white=self.run.curve.white)
        return np.concatenate([rgb, output.image("alpha")[..., None]], axis=-1)

    def output(self, camera: Camera, colors: list[Float] | None, *outputs: str) -> RenderOutput:
        """As `Run.predict` draws it. outputs: their names, beside the colours"""
        run = self.run
        names = outputs if colors is not None else ("color", *outputs)
        plain = partial(render, run.gaussians, outputs=names, features=colors, antialiased=run.antialiased)
        color_count = 0 if colors is None else 3
        return render_supersampled(plain, camera, run.supersample, colors=color_count, linear=run.curve is not None)


def checked_picture(
    image: str | Path | ArrayLike | Image, mask: ArrayLike | None, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """([H, W, 3] or premultiplied [H, W, 4], [H, W, 1] 1 where it counts, 0 elsewhere), float32."""
    check_camera(camera)
    size = (camera.height, camera.width)
    if isinstance(image, str | Path):
        image = load_image(Dataset(Path(), (), ()), Frame(str(image), camera))
    counts = np.ones(size, np.float32)
    if isinstance(image, Image):
        counts, image = image.valid.astype(np.float32), np.dstack([image.rgb, image.alpha])
    pixels = np.asarray(image)
    if pixels.ndim != 3 or pixels.shape[:2] != size or pixels.shape[2] not in (3, 4):
        expected = f"[{camera.height}, {camera.width}, 3 or 4] as the camera has it"
        found = f"{image!r:.60}" if pixels.ndim == 0 else list(pixels.shape)
        raise InputError(f"image: expected {expected}, found {found}")
    if not (np.issubdtype(pixels.dtype, np.floating) or pixels.dtype == np.uint8):
        raise InputError(f"image: expected float values in [0, 1] or uint8, found {pixels.dtype}")
    pixels = pixels.astype(np.float32) / (255 if pixels.dtype == np.uint8 else 1)
    if not (np.isfinite(pixels).all() and pixels.min() >= 0 and pixels.max() <= 1):
        raise InputError("image: expected float values in [0, 1] or uint8, found others")
    if mask is not None:
        chosen = np.asarray(mask)
        if chosen.shape != size or chosen.dtype == object:
            raise InputError(f"mask: expected {list(size)} as the camera has it, found {list(chosen.shape)}")
        counts = counts * (chosen != 0)
    if not counts.any():
        raise InputError("mask: expected pixels that count, found none")
    if pixels.shape[2] == 4:
        opaque = pixels[..., 3:].min() == 1
        pixels = pixels[..., :3] if opaque else np.dstack([pixels[..., :3] * pixels[..., 3:], pixels[..., 3:]])
    return np.ascontiguousarray(pixels), counts.astype(np.float32)[..., None]


def background_of(target: np.ndarray, counts: np.ndarray, alpha: np.ndarray) -> np.ndarray | None:
    """[3] median of the picture where the model is not; None of a picture with alpha."""
    if target.shape[2] == 4:
        return None
    around = target[(alpha < 1 / 255) & (counts[..., 0] > 0)]
    return np.median(around, axis=0).astype(np.float32) if len(around) else np.zeros(3, np.float32)


def first_gain(target: np.ndarray, counts: np.ndarray, background: np.ndarray | None, model: np.ndarray) -> float:
    """Light of the picture over that of the model, which hardly depends on where in the picture it is."""
    light = target[..., :3] if background is None else target - (1 - model[..., 3:]) * background
    target_sum, model_sum = (float((counts * planes).sum(dtype=np.float64)) for planes in (light, model[..., :3]))
    return float(np.clip(target_sum / max(model_sum, 1e-9), *GAINS))


def reduced(planes: np.ndarray, factor: int) -> np.ndarray:
    """[h, w, C] means of squares of pixels; what is left over at the right and below goes."""
    height, width = planes.shape[0] // factor, planes.shape[1] // factor
    squares = planes[: height * factor, : width * factor].reshape(height, factor, width, factor, -1)
    return squares.mean(axis=(1, 3), dtype=np.float32)


def smoothed(planes: np.ndarray, blur: float) -> np.ndarray:
    from scipy.ndimage import gaussian_filter

    smooth: np.ndarray = gaussian_filter(planes, (blur, blur, 0), mode="nearest") if blur else planes
    return smooth
