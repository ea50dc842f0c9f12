"""Figure 3.2: how long a frame takes in which one model stands several times, Gaussians or a radiance field."""

import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from spacesim import backend
from spacesim.data.density import target_of
from spacesim.data.files import JsonValue
from spacesim.data.geometry import Array
from spacesim.data.records import Dataset, Frame
from spacesim.learning.folder import device
from spacesim.nerf.compose import FieldComposition
from spacesim.nerf.run import NerfRun
from spacesim.splat.compose import ComposeConfig, GaussianComposition, PlacedRun, Pose

if TYPE_CHECKING:
    from spacesim.splat.run import Run

#: of the models, in widths of the picture that one just fills: one in the middle, four around it that do not touch
PLACES = ((0, 0, 0), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0))
FARTHER = 3.1  #: times: the distance from which one just fills the picture
VIEWS = 9  #: frames of each scene, each from another test view, drawn before once; the median counts


def time_frames(run: "Run | NerfRun", dataset: Dataset, tell: Callable[[int, int, str], None]) -> dict[str, JsonValue]:
    """{"models": [1, ...], "ms": [median of a frame, milliseconds], "pixels": [width, height], "views", "device",
    "backend"}: of pictures as `predict` returns them, in the computer's memory."""
    frames = views(dataset)
    models = [PlacedRun(run, Pose(translation=place)) for place in places(dataset)]  # type: ignore[arg-type]
    compose = FieldComposition if isinstance(run, NerfRun) else GaussianComposition
    medians = []
    for count in range(1, len(models) + 1):
        scene = compose(models[:count], ComposeConfig("none"))
        for frame in frames:  # kernels are compiled, and recorded for each length of the tile lists
            scene.predict(frame.camera, frame.sun)
        seconds = []
        for frame in frames:
            start = time.perf_counter()
            scene.predict(frame.camera, frame.sun)
            seconds.append(time.perf_counter() - start)
        medians.append(1e3 * statistics.median(seconds))
        tell(count, len(models), f"{medians[-1]:.1f} ms a frame")
    camera = frames[0].camera
    return {
        "models": list(range(1, len(models) + 1)),
        "ms": medians,
        "pixels": [camera.width, camera.height],
        "views": len(frames),
        "device": device(),
        "backend": backend.select(),
    }


def views(dataset: Dataset) -> list[Frame]:
    """The first test views of one object, from so far away that all models just fit into the picture."""
    centre = target_of(dataset)
    frames = []
    for frame in dataset.test[:VIEWS]:
        pose = frame.camera.world_from_camera.copy()
        pose[:3, 3] = centre + FARTHER * (frame.camera.position - centre)
        frames.append(replace(frame, camera=replace(frame.camera, world_from_camera=pose)))
    return frames


def places(dataset: Dataset) -> Array:
    """[5, 3] metres, by which the models stand apart from where they were trained."""
    camera = dataset.test[0].camera
    width = np.linalg.norm(camera.position - target_of(dataset)) * camera.width / camera.fx
    return np.asarray(width * np.array(PLACES), np.float64)
