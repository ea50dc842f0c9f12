"""Sweep cameras and Suns over a scene and write the dataset."""

import platform
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import spacesim
from spacesim import backend
from spacesim.data.errors import InputError
from spacesim.data.records import Camera, Dataset, Sun
from spacesim.data.store import DatasetWriter
from spacesim.scenes.build import build
from spacesim.scenes.config import SceneConfig
from spacesim.scenes.points import surface_points
from spacesim.scenes.render import Renderer
from spacesim.scenes.rig import Target, View, plan
from spacesim.scenes.scene import Scene
from spacesim.scenes.sensor import record

SCHEMA = 2  #: of scene.json

Progress = Callable[[int, int, str], None]
Named = list[tuple[str, View]]  #: views with the names of their frames


def generate(config: SceneConfig, out: Path, resume: bool = False, progress: Progress | None = None) -> Dataset:
    """Render the scene that `config` describes into the new folder `out` and return the dataset there.

    resume: complete a folder that an interrupted run of the same scene has left; the result has the same bytes as
    an uninterrupted run's. progress: called with (frames done, frames in all, name of the frame). Raises
    InputError for a scene that cannot be built, a camera within an object or a folder that cannot be used.
    """
    scene = build(config)
    train, test = plan_views(scene, config)
    renderer = Renderer(scene, config.quality.spp, config.quality.max_depth, config.camera.distortion)
    frames = train + test
    inside = renderer.inside(np.stack([view.camera.position for _, view in frames]))
    if inside.any():
        name = frames[int(inside.argmax())][0]
        raise InputError(f"distance: expected cameras outside of {config.name}, found that of {name} within a part")
    writer = DatasetWriter(Path(out), describe(scene, config, train, test), resume)
    for index, (name, view) in enumerate(frames):
        if not writer.has(name):
            truth = renderer.render(view.camera, view.sun, (config.seed, index))
            recording = record(truth.radiance, truth.alpha, config.camera, (config.seed, index))
            writer.write_frame(name, truth, recording.image, recording.raw)
        if progress is not None:
            progress(index + 1, len(frames), name)
    points, colors = surface_points(renderer, config.quality.points, config.seed)
    return writer.finish(_listed(train), _listed(test), points, colors, scene.mesh, config.camera.distortion)


def plan_views(scene: Scene, config: SceneConfig) -> tuple[Named, Named]:
    """The named training and test views."""
    train, test = plan(config.rig, Target(*scene.bounding_sphere), config.camera, config.seed)
    return (
        [(f"train_{i:05d}", view) for i, view in enumerate(train)],
        [(f"test_{i:05d}", view) for i, view in enumerate(test)],
    )


def describe(scene: Scene, config: SceneConfig, train: Named, test: Named) -> dict[str, Any]:
    """scene.json: all that is needed to render the same dataset again."""
    return {
        "schema": SCHEMA,
        **scene.describe(),
        "suns": {"train": _angles(train), "test": _angles(test)},
        "exposure": config.camera.exposure,
        "seed": config.seed,
        "spp": config.quality.spp,
        "config": config.to_json(),
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
