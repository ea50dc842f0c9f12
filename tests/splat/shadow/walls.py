"""Flat sheets of Gaussians, uneven as trained ones are, for tests and for the table of biases."""

from dataclasses import replace

import numpy as np

from spacesim.backend import ad
from spacesim.splat.gaussians import Gaussians
from spacesim.splat.shadow.bias import grazing_bias, lifted, receiver_bias
from spacesim.splat.shadow.cast import cast_shadows
from spacesim.splat.shadow.mapping import MappingConfig, occlusion_by_mapping
from spacesim.splat.shadow.sunlight import fit_camera, light_rows, towards_sun
from spacesim.splat.train.config import preset

SCREEN = 0.25  #: metres, height
BIASES = ("none", "thesis", "grazing bias", "lifted")
SHIPPED = ("shadow-map", "shadow-splat")  #: methods, with the shadows of the preset `fast`
DISTANCE = 5.0  #: metres, of the farthest camera, on which the softness depends


def sheet(corner, along, across, count: int, rng: np.random.Generator, width: float) -> dict[str, np.ndarray]:
    """`count` discs strewn over the parallelogram from `corner` [3] along two vectors [3], metres: standard deviations
    of `width` within a factor of 1.65, a tenth of it thick, tilted by 3.4 degrees and displaced by a tenth of it."""
    along, across = np.asarray(along, float), np.asarray(across, float)
    normal = np.cross(along, across) / np.linalg.norm(np.cross(along, across))
    tilted = normal + 0.06 * rng.normal(size=(count, 3))
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    half = tilted + np.array([0, 0, 1])  # half a turn about it takes z to the normal
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    places = rng.uniform(size=(count, 2)) @ np.stack([along, across])
    return {
        "means": np.asarray(corner) + places + 0.1 * width * rng.normal(size=(count, 1)) * normal,
        "log_scales": np.log(width * np.exp(rng.uniform(-0.5, 0.5, (count, 3))) * [1, 1, 0.1]),
        "quaternions": np.concatenate([np.zeros((count, 1)), half], axis=1),
        "logit_opacities": rng.uniform(0.5, 4.0, count),
        "sh": np.zeros((count, 1, 3)),
    }


def plate(count: int, screen: bool = False, seed: int = 0) -> dict[str, np.ndarray]:
    """A plate of 2 m x 2 m in the plane z = 0, `count` discs; then those of a screen, if any, 1 m wide, that stands
    on it in the plane x = 0."""
    rng, width = np.random.default_rng(seed), 0.012 * np.sqrt(20_000 / count)
    parts = [sheet([-1, -1, 0], [2, 0, 0], [0, 2, 0], count, rng, width)]
    if screen:
        parts.append(sheet([0, -0.5, 0], [0, 1, 0], [0, 0, SCREEN], int(count * SCREEN / 2), rng, width))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def plate_occlusion(arrays, elevation: float, bias: str, config: MappingConfig | None = None, size: int = 512):
    """[N] occlusion, the Sun `elevation` degrees above the plate, towards -x. bias: of BIASES, or of SHIPPED"""
    gaussians = Gaussians.from_numpy(arrays)
    light = light_rows([-np.cos(np.radians(elevation)), 0, np.sin(np.radians(elevation))])
    if bias in SHIPPED:
        shadow = replace(preset("fast", bias).light.shadow, size=size)
        return np.array(cast_shadows(gaussians, light, shadow, DISTANCE).occlusion)
    camera = fit_camera(gaussians, light, size)
    biases = receiver_bias(gaussians, towards_sun(light))
    if bias == "grazing bias":
        biases = biases.at_least(grazing_bias(gaussians, camera))
    depths = ad.Float(np.zeros(gaussians.count)) if bias == "none" else biases.bias
    points = lifted(gaussians, towards_sun(light)) if bias == "lifted" else None
    return np.array(occlusion_by_mapping(gaussians, camera, depths, 1e-5, config, points))


def acne(elevation: float, bias: str, count: int, config: MappingConfig | None = None) -> float:
    """Share of the bare plate's discs that count as shadowed; a border of 5 cm is left out."""
    arrays = plate(count)
    inner = np.all(np.abs(arrays["means"][:, :2]) < 0.95, axis=1)
    return float((plate_occlusion(arrays, elevation, bias, config)[inner] > 0.5).mean())


def screen_shadow(elevation: float, bias: str, count: int, config: MappingConfig | None = None) -> tuple[float, float]:
    """(metres by which the screen's shadow recedes from its foot, those by which its tip is off): how much of a strip's
    discs, from the foot to 10 cm before the tip, is lit, and from there to 10 cm behind it, dark, as lengths."""
    arrays = plate(count, screen=True)
    x, y = arrays["means"][:count, :2].T
    dark = plate_occlusion(arrays, elevation, bias, config)[:count] > 0.5
    strip, tip = np.abs(y) < 0.4, SCREEN / np.tan(np.radians(elevation))
    foot_end = min(0.5 * tip, 0.5)
    foot = strip & (x > 0) & (x < foot_end)
    recedes = float((~dark[foot]).mean() * foot_end)
    if tip + 0.1 > 0.95:
        return recedes, float("nan")
    near, far = max(tip - 0.1, 0.5 * tip), tip + 0.1
    edge = strip & (x > near) & (x < far)
    return recedes, float(near + dark[edge].mean() * (far - near) - tip)
