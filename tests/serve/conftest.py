"""What is served in the tests: a scene, path-traced, and a small model."""

from pathlib import Path

import numpy as np
import pytest

import spacesim  # noqa: F401  names libLLVM before drjit is imported
from spacesim.serve.draw import PredictedRun, Served, load_served
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.run import Run


@pytest.fixture(autouse=True)
def _needs_zmq():
    pytest.importorskip("zmq", reason="pyzmq is not installed")


@pytest.fixture(scope="session")
def traced() -> Served:
    """boxsat at 4 samples a pixel."""
    return load_served("boxsat", spp=4)


@pytest.fixture(scope="session")
def ball() -> PredictedRun:
    """A vanilla run, called ball: 200 Gaussians about the origin, red in front (+x), green behind."""
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    colors = np.where(directions[:, :1] > 0, [[0.9, 0.1, 0.1]], [[0.1, 0.9, 0.1]])
    arrays = {
        "means": 0.5 * directions,
        "log_scales": np.full((200, 3), np.log(0.08)),
        "quaternions": np.tile([1.0, 0, 0, 0], (200, 1)),
        "logit_opacities": np.full(200, 6.0),
        "sh": ((colors - 0.5) / 0.28209479177387814)[:, None].astype(np.float32),
    }
    run = Run(Path("ball"), {"method": "vanilla", "data": {"path": ""}}, {}, Gaussians.from_numpy(arrays), 0)
    return PredictedRun(run)
