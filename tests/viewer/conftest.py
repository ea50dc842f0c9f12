"""Small models to look at, without training."""

from pathlib import Path

import numpy as np
import pytest

import spacesim  # noqa: F401  names libLLVM before drjit is imported
from spacesim.data.geometry import look_at
from spacesim.data.records import Sun
from spacesim.splat.compose import GaussianComposition, PlacedRun, Pose
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.run import Run
from spacesim.viewer.drawing.scene_renderer import SceneRenderer
from spacesim.viewer.load import load_setup
from spacesim.viewer.server import Viewer
from spacesim.viewer.state import SceneState, ViewerCamera

SCENE = """
[[models]]
name = "below"
run = "{run}"
[[models]]
name = "above"
run = "{run}"
position = [0.0, 0.0, 1.6]
scale = 0.5
[sun]
azimuth_deg = 20.0
elevation_deg = 60.0
[camera]
position = [12.0, -4.0, 4.5]
look_at = [0.0, 0.0, 0.8]
resolution = [400, 400]
fov_deg = 35.0
"""


def ball_run(name: str, color: tuple[float, float, float], count: int = 400, radius: float = 0.5) -> Run:
    """A vanilla run: a ball about the origin, opaque, of one colour."""
    rng = np.random.default_rng(len(name))
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    sh = np.zeros((count, 1, 3), np.float32)
    sh[:, 0] = (np.array(color) - 0.5) / 0.28209479177387814
    arrays = {
        "means": radius * directions,
        "log_scales": np.full((count, 3), np.log(0.12 * radius)),
        "quaternions": np.tile([1.0, 0, 0, 0], (count, 1)),
        "logit_opacities": np.full(count, 6.0),
        "sh": sh,
    }
    return Run(Path(name), {"method": "vanilla", "data": {"path": ""}}, {}, Gaussians.from_numpy(arrays), 0)


@pytest.fixture(scope="session")
def renderer() -> SceneRenderer:
    """A red ball on the left, a green one on the right, seen along +x with z up."""
    red, green = ball_run("red", (0.9, 0.1, 0.1)), ball_run("green", (0.1, 0.9, 0.1))
    left, right = Pose(translation=np.array([0.0, 1, 0])), Pose(translation=np.array([0.0, -1, 0]))
    return SceneRenderer(GaussianComposition([PlacedRun(red, left, "red"), PlacedRun(green, right, "green")]))


@pytest.fixture(scope="session")
def state(renderer) -> SceneState:
    """The scene as `renderer` has it, the Sun overhead."""
    poses = tuple(placed.pose for placed in renderer.composition.models)
    return SceneState(poses, Sun(np.array([0.0, 0, 1])))


@pytest.fixture(scope="session")
def view() -> ViewerCamera:
    """From 5 m on the -x side, window 4:3."""
    return ViewerCamera(look_at([-5.0, 0, 0], [0.0, 0, 0]), np.radians(40), 640, 480)


@pytest.fixture(scope="module")
def viewer(tiny_run, tiny_data, tmp_path_factory):
    """Two models of one run, one above the other, served on loopback."""
    pytest.importorskip("viser", reason="viser is not installed")
    folder = tmp_path_factory.mktemp("viewer")
    (folder / "pair.toml").write_text(SCENE.format(run=tiny_run))
    one = Viewer(load_setup(folder / "pair.toml", tiny_data, folder), port=0)
    one.start()
    yield one
    one.stop()


@pytest.fixture
def at_start(viewer):
    """The scene as it was opened."""
    viewer.set_state(viewer.setup.state)
    return viewer.setup.state
