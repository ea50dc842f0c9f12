"""Small models to look at, without training."""

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from tiny import pair_scene

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

for folder in ("splat", "splat/compose"):
    sys.path.insert(0, str(Path(__file__).parents[1] / folder))


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
def serve_pair(tmp_path_factory) -> Iterator[Callable[..., Viewer]]:
    """The function (one run, the run above it, dataset or None) -> a viewer of both, on loopback."""
    pytest.importorskip("viser", reason="viser is not installed")
    with ExitStack() as stack:

        def serve(below: Path, above: Path, data: Path | None = None) -> Viewer:
            folder = tmp_path_factory.mktemp("viewer")
            scene = pair_scene(below, above, (0, 0, 1.6), (20, 60), (12, -4, 4.5), (400, 400))
            (folder / "pair.toml").write_text(scene)
            one = Viewer(load_setup(folder / "pair.toml", data, folder), port=0)
            one.start()
            stack.callback(one.stop)
            return one

        yield serve


@pytest.fixture(scope="module")
def viewer(serve_pair, tiny_run, tiny_data) -> Viewer:
    """Two models of one run, one above the other."""
    return serve_pair(tiny_run, tiny_run, tiny_data)


@pytest.fixture
def at_start(viewer):
    """The scene as it was opened."""
    viewer.set_state(viewer.setup.state)
    return viewer.setup.state
