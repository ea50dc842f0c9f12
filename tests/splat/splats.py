"""Splats, colours and cameras that several test files share."""

import numpy as np

from spacesim.backend import ad
from spacesim.backend.upload import upload
from spacesim.data.records import Camera
from spacesim.splat.light.surroundings import SKY
from spacesim.splat.raster import adjoint, blend, records, render, walks
from spacesim.splat.raster.cameras import Orthographic, OrthographicCamera, Pinhole
from spacesim.splat.raster.lists import bin as binning
from spacesim.splat.raster.lists import record_copy, tiles
from spacesim.splat.train.strategies.strategy import OnScreen


def take_cudas(monkeypatch) -> None:
    """CUDA's way of drawing, on the backend that runs."""
    for module in (binning, tiles, records, adjoint, blend, walks):
        monkeypatch.setattr(module, "select", lambda: "cuda")
    for module in (adjoint, binning, blend, record_copy, render):
        monkeypatch.setattr(module, "is_usable", lambda: False)


def light_of(values: np.ndarray) -> np.ndarray:
    """Linear values of sRGB ones, beyond 1 too (IEC 61966-2-1), float64."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def srgb_of(light: np.ndarray) -> np.ndarray:
    """The inverse of `light_of`."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def random_splats(count: int, seed: int = 0, degree: int = 3) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        "means": rng.uniform(-0.6, 0.6, (count, 3)),
        "log_scales": rng.uniform(-3.2, -1.4, (count, 3)),
        "quaternions": rng.normal(size=(count, 4)),
        "logit_opacities": rng.uniform(-2.5, 2.0, count),
        "sh": rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.25,
    }


def device_camera(view: Camera | OrthographicCamera) -> Pinhole | Orthographic:
    return Pinhole.of(view) if isinstance(view, Camera) else Orthographic.of(view)


def on_screen(gradient: np.ndarray, radius: np.ndarray, visible: np.ndarray) -> OnScreen:
    """Of a picture of two pixels a side, [N] each: gradients by half a picture, radii as shares of it."""
    radii = np.where(visible, np.maximum(2.0 * np.asarray(radius), 1e-9), 0)
    across, along = (upload(np.asarray(rows, np.float32)) for rows in (gradient, np.zeros(len(radii))))
    return OnScreen(across, along, upload(np.asarray(radii, np.float32)), ad.Float([1.0, 1.0, 2.0]))


def met_along(surroundings, count: int, rays: int) -> np.ndarray:
    """[R, N] what the rays of N Gaussians meet, of `Surroundings.met`; SKY for nothing."""
    met, found = np.array(surroundings.met), np.full((rays, count), SKY)
    first, _, _, end = np.array(surroundings.bounds).reshape(4, count)
    for number in range(count):
        of_gaussian = met[first[number] : end[number]]
        found[of_gaussian >> 16, number] = of_gaussian & 0xFFFF
    return found
