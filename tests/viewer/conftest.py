"""Small models to look at, without training."""

from pathlib import Path

import numpy as np
import pytest

import spacesim  # noqa: F401  names libLLVM before drjit is imported
from spacesim.data.geometry import look_at
from spacesim.data.records import Sun
from spacesim.splat.compose import Composition, Placed, Pose
from spacesim.splat.gaussians import Gaussians
from spacesim.splat.run import Run
from spacesim.viewer.stage import Stage
from spacesim.viewer.state import Stand, View


def ball_run(name: str, colour: tuple[float, float, float], count: int = 400, radius: float = 0.5) -> Run:
    """A vanilla run: a ball about the origin, opaque, of one colour."""
    rng = np.random.default_rng(len(name))
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    sh = np.zeros((count, 1, 3), np.float32)
    sh[:, 0] = (np.array(colour) - 0.5) / 0.28209479177387814
    arrays = {
        "means": radius * directions,
        "log_scales": np.full((count, 3), np.log(0.12 * radius)),
        "quaternions": np.tile([1.0, 0, 0, 0], (count, 1)),
        "logit_opacities": np.full(count, 6.0),
        "sh": sh,
    }
    return Run(Path(name), {"method": "vanilla", "data": {"path": ""}}, {}, Gaussians.from_numpy(arrays), 0)


@pytest.fixture(scope="session")
def stage() -> Stage:
    """A red ball on the left, a green one on the right, seen along +x with z up."""
    red, green = ball_run("red", (0.9, 0.1, 0.1)), ball_run("green", (0.1, 0.9, 0.1))
    left, right = Pose(translation=np.array([0.0, 1, 0])), Pose(translation=np.array([0.0, -1, 0]))
    return Stage(Composition([Placed(red, left, "red"), Placed(green, right, "green")]))


@pytest.fixture(scope="session")
def stand(stage) -> Stand:
    """The scene as `stage` has it, the Sun overhead."""
    poses = tuple(placed.pose for placed in stage.composition.models)
    return Stand(poses, Sun(np.array([0.0, 0, 1])))


@pytest.fixture(scope="session")
def view() -> View:
    """From 5 m on the -x side, window 4:3."""
    return View(look_at([-5.0, 0, 0], [0.0, 0, 0]), np.radians(40), 640, 480)
