"""Whole renders of spacecraft against the sum of their sources, and against wavelength by wavelength."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from spacesim.data.records import Camera, Sun, Truth
from spacesim.scenes.build import build
from spacesim.scenes.generation.generate import plan_views
from spacesim.scenes.lights.earth import EarthConfig
from spacesim.scenes.lights.sun import SunConfig
from spacesim.scenes.materials import spectra
from spacesim.scenes.materials.table import Material, customise, lambertian
from spacesim.scenes.render import Renderer
from spacesim.scenes.scene import Scene
from spacesim.scenes.scenefile import read_scene

EARTH = EarthConfig(azimuth_deg=200.0, elevation_deg=-40.0, altitude_km=500.0)


def one_view(source: str, resolution: int = 48, view: int = 3) -> tuple[Scene, Camera, Sun]:
    """A built-in scene with one of its 8 test views under one Sun."""
    config = read_scene(source, sun=((45.0, 35.0),), test_views=8, resolution=resolution)
    scene = build(config)
    chosen = plan_views(scene, config)[1][view][1]
    return scene, chosen.camera, chosen.sun


def means(values: np.ndarray, truth: Truth, parts: Sequence[int]) -> np.ndarray:
    """[P, 3] means of `values` [H, W, 3] over the pixels of each part."""
    return np.stack([values[truth.part_id == part].mean(axis=0) for part in parts])


def large_parts(truth: Truth, pixels: int = 20) -> list[int]:
    """Parts that have so many pixels."""
    counts = np.bincount(truth.part_id.ravel())
    return [part for part in range(1, len(counts)) if counts[part] >= pixels]


def sources_apart(source: str = "boxsat", spp: int = 256, view: int = 2) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean radiance [P, 3] of each large part under Sun and Earth, less that under the Sun and under the Earth alone;
    and its standard error, from renders of six seeds, both relative to the first; and the Earth's share of that.

    Sun alone: a scene without the Earth. Earth alone: the layer of another run with other seeds.
    """
    scene, camera, sun = one_view(source, view=view)
    both = Renderer(replace(scene, earth=EARTH), spp)
    alone = Renderer(replace(scene, earth=None), spp)
    seeds = range(6)
    together = [both.render(camera, sun, (1, i)) for i in seeds]
    parts = large_parts(together[0])
    first = [means(truth.radiance, truth, parts) for truth in together]
    second = [means(alone.render(camera, sun, (2, i)).radiance, together[0], parts) for i in seeds]
    third = [means(both.render(camera, sun, (3, i)).radiance_earth, together[0], parts) for i in seeds]
    difference = np.mean(first, axis=0) - np.mean(second, axis=0) - np.mean(third, axis=0)
    variance = sum(np.var(one, axis=0, ddof=1) for one in (first, second, third)) / len(seeds)
    mean = np.mean(first, axis=0)
    return difference / mean, np.sqrt(variance) / mean, np.mean(third, axis=0) / mean


GRID = np.linspace(380.0, 780.0, 39)  #: nm


def band_weights() -> np.ndarray:
    """[39, 3] camera RGB, relative to sunlight, of light with sunlight's spectrum times a hat about each wavelength of
    GRID: their sum over any function that is linear between these is its integral."""
    wavelength, response = spectra.response("sun")
    sunlight = np.interp(wavelength, *spectra.solar_spectrum())
    hats = np.stack([np.interp(wavelength, GRID, row) for row in np.eye(len(GRID))])
    return hats @ (sunlight[:, None] * response) / spectra.SOLAR_IRRADIANCE


def at_wavelengths(scene: Scene, wavelengths: np.ndarray | None) -> Scene:
    """The scene with each material's reflectance at three wavelengths in place of its albedo; None: with the albedo.
    Materials without a spectrum become diffuse and grey in either."""
    made: dict[str, Material] = {}

    def changed(material: Material) -> Material:
        name = material.name
        if name in made:
            return made[name]
        if not material.reflectance:
            made[name] = lambertian(name, (float(np.mean(material.albedo)),) * 3, "grey")
        elif wavelengths is None:
            made[name] = material
        else:
            red, green, blue = spectra.reflectance_at(material.reflectance, wavelengths).tolist()
            made[name] = customise(name, name, albedo=(red, green, blue))
        return made[name]

    objects = [
        replace(
            item,
            spacecraft=replace(
                item.spacecraft,
                parts=tuple(replace(part, material=changed(part.material)) for part in item.spacecraft.parts),
            ),
        )
        for item in scene.objects
    ]
    return replace(scene, objects=tuple(objects), sun=SunConfig(scene.sun.shape))


def rgb_against_spectral(source: str = "boxsat", spp: int = 64) -> dict[str, float]:
    """For each large part of a whole render, all bounces: largest difference of a channel of its mean, RGB against 39
    wavelengths, relative to the spectral render's brightest channel. Both have the same seed."""
    scene, camera, sun = one_view(source)
    rgb = Renderer(at_wavelengths(scene, None), spp).render(camera, sun, (1,))
    weights, spectral = band_weights(), np.zeros_like(rgb.radiance, np.float64)
    for k in range(0, len(GRID), 3):  # three wavelengths a render, one in each channel
        found = Renderer(at_wavelengths(scene, GRID[k : k + 3]), spp).render(camera, sun, (1,))
        spectral += found.radiance @ weights[k : k + 3]
    names = {placed.part_id: placed.part for placed in scene.parts}
    parts = [part for part in large_parts(rgb) if names[part].material.reflectance]
    expected, got = np.maximum(means(spectral, rgb, parts), 0), means(rgb.radiance, rgb, parts)
    differences = np.abs(got - expected).max(axis=1) / expected.max(axis=1)
    return {
        f"{names[part].name} ({names[part].material.name})": float(x)
        for part, x in zip(parts, differences, strict=True)
    }
