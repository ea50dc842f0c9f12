"""Sweep cameras and Suns over a scene and write the dataset."""

import math
import platform
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import spacesim
from spacesim import backend
from spacesim.data.errors import InputError
from spacesim.data.records import Camera, Dataset, Sun
from spacesim.data.store import DatasetWriter
from spacesim.scenes.points import surface_points
from spacesim.scenes.render import Renderer
from spacesim.scenes.rig import (
    Lens,
    View,
    fitting_distance,
    held_out_suns,
    training_suns,
    views_around,
)
from spacesim.scenes.scene import Scene, built_in_scene
from spacesim.scenes.sun import EXPOSURE

SCHEMA = 1  #: of scene.json

Progress = Callable[[int, int, str], None]
Named = list[tuple[str, View]]  #: views with the names of their frames


@dataclass(frozen=True)
class GenerateConfig:
    """What to render. Raises InputError for a value out of range.

    Every training Sun has `views` training views. Every test Sun has `test_views` test views; the test Suns
    are `test_suns` directions that training never sees or, where that is 0, the training Suns.
    """

    suns: int = 1  #: training Suns on a Fibonacci lattice; one alone stands at `rig.SINGLE_SUN`
    views: int = 100  #: training views for each training Sun
    test_suns: int = 0  #: Suns held out of training; 0: test under the training Suns
    test_views: int = 20  #: test views for each test Sun
    resolution: int = 256  #: pixels of each side
    spp: int = 64  #: samples a pixel
    seed: int = 0  #: of view lattices, noise and points
    sun: tuple[tuple[float, float], ...] = ()  #: training Suns as (azimuth, elevation), degrees; () a lattice
    max_depth: int = 6  #: longest light path in edges, 2 is direct light alone
    fov_deg: float = 30.0  #: angle that a side of the image covers
    distance: float | None = None  #: metres from the centre; None: the scene just fits into the image
    points: int = 20_000  #: surface samples in points.ply
    exposure: float = EXPOSURE  #: linear display value of a radiance of 1 W m^-2 sr^-1

    def __post_init__(self) -> None:
        lowest = {
            "suns": 1,
            "views": 1,
            "test_suns": 0,
            "test_views": 0,
            "resolution": 8,
            "spp": 1,
            "seed": 0,
            "max_depth": 2,
            "points": 1,
        }
        for name, bound in lowest.items():
            if getattr(self, name) < bound:
                raise InputError(f"{name}: expected at least {bound}, found {getattr(self, name)}")
        for azimuth, elevation in self.sun:
            if not (math.isfinite(azimuth) and -90 <= elevation <= 90):
                raise InputError(
                    "sun: expected a finite azimuth and an elevation from -90 to 90 degrees, "
                    f"found {azimuth},{elevation}"
                )
        if self.sun and self.suns not in (1, len(self.sun)):
            raise InputError(f"suns: expected {len(self.sun)} as in sun, found {self.suns}")
        if not 0 < self.fov_deg <= 120:
            raise InputError(f"fov_deg: expected an angle up to 120 degrees, found {self.fov_deg}")
        if self.distance is not None and not 0 < self.distance < math.inf:
            raise InputError(f"distance: expected metres above 0, found {self.distance}")
        if not 0 < self.exposure < math.inf:
            raise InputError(f"exposure: expected a number above 0, found {self.exposure}")


def generate(
    scene: str, out: Path, config: GenerateConfig, resume: bool = False, progress: Progress | None = None
) -> Dataset:
    """Render the built-in scene called `scene` into the new folder `out` and return the dataset there.

    resume: complete a folder that an interrupted run of the same scene and configuration has left; the result
    has the same bytes as an uninterrupted run's. progress: called with (frames done, frames in all, name of
    the frame). Raises InputError for an unknown scene, a camera within the object or a folder that cannot be
    used.
    """
    described = built_in_scene(scene)
    train, test = plan_views(described, config)
    renderer = Renderer(described, config.spp, config.max_depth)
    frames = train + test
    inside = renderer.inside(np.stack([view.camera.position for _, view in frames]))
    if inside.any():
        name = frames[int(inside.argmax())][0]
        raise InputError(f"distance: expected cameras outside of {scene}, found that of {name} within a part")
    writer = DatasetWriter(Path(out), describe(described, config, train, test), resume)
    for index, (name, view) in enumerate(frames):
        if not writer.has(name):
            truth = renderer.render(view.camera, view.sun, (config.seed, index))
            writer.write_frame(name, truth, config.exposure)
        if progress is not None:
            progress(index + 1, len(frames), name)
    points, colors = surface_points(renderer, config.points, config.seed)
    return writer.finish(_listed(train), _listed(test), points, colors, described.mesh)


def plan_views(scene: Scene, config: GenerateConfig) -> tuple[Named, Named]:
    """The named training and test views."""
    centre, radius = scene.bounding_sphere
    distance = config.distance or fitting_distance(radius, config.fov_deg)
    lens = Lens(centre, distance, config.resolution, config.fov_deg)
    suns = training_suns(config.suns, config.sun)
    test_suns = held_out_suns(config.test_suns, config.seed) if config.test_suns else suns
    train = views_around(suns, lens, config.views, config.seed, "train")
    test = views_around(test_suns, lens, config.test_views, config.seed, "test")
    return (
        [(f"train_{i:05d}", view) for i, view in enumerate(train)],
        [(f"test_{i:05d}", view) for i, view in enumerate(test)],
    )


def describe(scene: Scene, config: GenerateConfig, train: Named, test: Named) -> dict[str, Any]:
    """scene.json: all that is needed to render the same dataset again."""
    return {
        "schema": SCHEMA,
        **scene.describe(),
        "suns": {"train": _angles(train), "test": _angles(test)},
        "exposure": config.exposure,
        "config": asdict(config),
        "backend": backend.select(),
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    """Versions of what the pictures depend on."""
    packages = {name: version(name) for name in ("mitsuba", "drjit", "numpy", "trimesh")}
    return {"spacesim": spacesim.__version__, "python": platform.python_version(), **packages}


def _angles(named: Named) -> list[list[float]]:
    """Azimuth and elevation, degrees, of each Sun once, in the order of the views."""
    return [list(angles) for angles in dict.fromkeys(view.sun.angles for _, view in named)]


def _listed(named: Named) -> list[tuple[str, Camera, Sun]]:
    return [(name, view.camera, view.sun) for name, view in named]
