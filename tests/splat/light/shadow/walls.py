"""Flat sheets of Gaussians, uneven as trained ones are, for tests and for the tables of biases."""

from dataclasses import replace

import numpy as np

from spacesim.splat.light.shadow.cast import ShadowConfig, SplattingConfig, cast_shadows
from spacesim.splat.light.shadow.light_camera import light_rows
from spacesim.splat.light.shadow.mapping import MappingConfig
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.train.config import preset

SCREEN = 0.25  #: metres, height
DISTANCE = 5.0  #: metres, of the farthest camera, on which the softness depends
METHODS = {"mapping": MappingConfig, "splatting": SplattingConfig}
SHIPPED = {"mapping": "shadow-map", "splatting": "shadow-splat"}  #: methods of `spacesim train`
#: what is done against acne, beside the thesis's way to read the light's picture
BIASES = {
    "none": {"bias": 0.0},
    "thesis": {"bias": 10.0},
    "grazing bias": {"bias": 10.0, "grazing": "bias"},
    "lift": {"bias": 10.0, "grazing": "lift"},
    "both": {"bias": 10.0, "grazing": "both"},
}


def way(name: str, method: str = "mapping", size: int = 512) -> ShadowConfig:
    """Of BIASES, or of a preset: `fast`, as `demo`, or `fine`."""
    if name not in BIASES:
        return replace(preset(name, SHIPPED[method]).light.shadow, size=size)
    return ShadowConfig(METHODS[method](), size, **BIASES[name])


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


def plate_occlusion(arrays: dict[str, np.ndarray], elevation: float, config: ShadowConfig) -> np.ndarray:
    """[N], the Sun `elevation` degrees above the plate, towards -x."""
    light = light_rows([-np.cos(np.radians(elevation)), 0, np.sin(np.radians(elevation))])
    return np.array(cast_shadows(Gaussians.from_numpy(arrays), light, config, DISTANCE).occlusion)


def acne(elevation: float, config: ShadowConfig, count: int) -> tuple[float, float]:
    """(mean occlusion of the bare plate, which should be 0, share of its discs that count as shadowed); a border of
    5 cm is left out."""
    arrays = plate(count)
    inner = np.all(np.abs(arrays["means"][:, :2]) < 0.95, axis=1)
    occlusion = plate_occlusion(arrays, elevation, config)[inner]
    return float(occlusion.mean()), float((occlusion > 0.5).mean())


def screen_shadow(elevation: float, config: ShadowConfig, count: int) -> tuple[float, float]:
    """(metres by which the screen's shadow recedes from its foot, those by which its tip is off, nan where it is not on
    the plate): how much of a strip's discs, from the foot to 10 cm before the tip, is lit, and from there to 10 cm
    behind it, dark, as lengths."""
    arrays = plate(count, screen=True)
    x, y = arrays["means"][:count, :2].T
    dark = plate_occlusion(arrays, elevation, config)[:count] > 0.5
    strip, tip = np.abs(y) < 0.4, SCREEN / np.tan(np.radians(elevation))
    end, near, far = min(0.5 * tip, 0.5), max(tip - 0.1, 0.5 * tip), tip + 0.1
    recedes = float((~dark[strip & (x > 0) & (x < end)]).mean() * end)
    if far > 0.95:
        return recedes, float("nan")
    return recedes, float(near + dark[strip & (x > near) & (x < far)].mean() * (far - near) - tip)
