"""Runs with random Gaussians and networks, for scenes of several."""

from dataclasses import replace
from pathlib import Path

import drjit as dr
import numpy as np
from splats import random_splats

from spacesim.backend.upload import upload
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera
from spacesim.splat.light.config import LightConfig
from spacesim.splat.light.encoding import Encoding
from spacesim.splat.light.field import DirectionsConfig, FieldConfig, SurfaceConfig
from spacesim.splat.light.model import LightModel, TrainingFrame
from spacesim.splat.light.shadow.cast import ShadowConfig, SplattingConfig
from spacesim.splat.light.shadow.mapping import MappingConfig
from spacesim.splat.light.shadow.refine import ShadowRefinementConfig
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.run import Run

ENCODINGS = {"sun": Encoding("harmonics", 2), "view": Encoding("harmonics", 2)}
FIELD = FieldConfig(features=5, width=12, layers=3, inputs=DirectionsConfig(**ENCODINGS))
REFINE = ShadowRefinementConfig(features=3, width=8, sun=Encoding("harmonics", 1))
MAP = ShadowConfig(MappingConfig(), 64, refine=REFINE)
CONFIGS = {
    "relight": LightConfig(FIELD),
    "map": LightConfig(FIELD, MAP),
    "splat": LightConfig(FIELD, ShadowConfig(SplattingConfig(), 64, refine=REFINE)),
    "linear": LightConfig(FIELD, MAP, linear=True),
    "surface": LightConfig(  # shadows as in `fast`
        replace(FIELD, features=7, inputs=SurfaceConfig(**ENCODINGS)),
        replace(MAP, bias=5.0, grazing="both", size=96, method=MappingConfig("median")),
    ),
    "bounce": LightConfig(
        replace(FIELD, features=7, inputs=SurfaceConfig(**ENCODINGS)), replace(MAP, size=96), bounce=20, earth=True
    ),
    "gloss": LightConfig(replace(FIELD, inputs=SurfaceConfig(**ENCODINGS)), MAP, bounce=20, gloss=True, earth=True),
    "park": LightConfig(
        FIELD,
        ShadowConfig(
            SplattingConfig(), 64, bias=0.0, refine=replace(REFINE, positions="world", positional=2, bias_info=False)
        ),
    ),
}
METHODS = ("vanilla", *CONFIGS)


def made_run(method: str, seed: int = 0, count: int = 80, degree: int = 2, antialiased: bool = False) -> Run:
    """A run of `count` Gaussians within a metre of the origin, with networks that do something."""
    arrays = random_splats(count, seed, degree)
    config = {"method": method, "antialiased": antialiased}
    if method == "vanilla":
        return Run(Path(f"runs/{method}{seed}"), config, {}, Gaussians.from_numpy(arrays), 1000)
    light_config, rng = CONFIGS[method], np.random.default_rng(seed)
    arrays |= {"sh": np.zeros((count, 0, 3)), "features": rng.normal(size=(count, light_config.features))}
    light = LightModel.initial(light_config, TrainingFrame(np.array([0.1, 0.0, -0.1]), 1.5, 4.0, 1.0), seed)
    light.weights = [upload(np.array(w) + 0.3 * rng.normal(size=dr.width(w))) for w in light.weights]
    return Run(Path(f"runs/{method}{seed}"), config, {}, Gaussians.from_numpy(arrays), 1000, light)


def disc_run(radius: float, seed: int = 0) -> Run:
    """A vanilla run: an opaque, white, flat disc about the origin, facing z."""
    count = 4000
    k = np.arange(count) + 0.5
    angle, away = np.pi * (3 - 5**0.5) * k, radius * np.sqrt(k / count)  # a sunflower's seeds: even
    arrays = {
        "means": np.stack([away * np.cos(angle), away * np.sin(angle), np.zeros(count)], axis=1),
        "log_scales": np.log(np.tile([0.02 * radius, 0.02 * radius, 0.001 * radius], (count, 1))),
        "quaternions": np.tile([1.0, 0, 0, 0], (count, 1)),
        "logit_opacities": np.full(count, 5.0),
        "sh": np.full((count, 1, 3), 0.5 / 0.28209479177387814),
    }
    return Run(Path(f"runs/disc{seed}"), {"method": "vanilla"}, {}, Gaussians.from_numpy(arrays), 1000)


def seen_from(place, target=(0, 0, 0), pixels: int = 48, fov: float = 40) -> Camera:
    return Camera.from_fov(look_at(place, np.asarray(target, float)), pixels, pixels, fov)
