"""An unmodified Basilisk renders through us (bsk 2.12: `pip install bsk`, in any environment beside this one)."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from spacesim.data.images import read_png
from spacesim.data.records import Camera, Sun
from spacesim.serve.server import serving
from spacesim.serve.vizard import rotation_from_mrp

SCRIPT = Path(__file__).parents[2] / "examples" / "closed_loop" / "basilisk.py"
OWN = Path(sys.prefix) / "basilisk" / "bin" / "python"  #: where scripts/setup.sh puts it
PYTHON = os.environ.get("BASILISK_PYTHON", str(OWN) if OWN.exists() else sys.executable)  #: of what has bsk
STEP, SIZE, FOV = 0.5, (96, 80), np.radians(30.0)
LEVER, SIGMA_CB = [0.5, -0.3, 0.1], [0.03, -0.04, 0.2]  #: of the second camera


@pytest.fixture(scope="module", autouse=True)
def _needs_basilisk():
    if subprocess.run([PYTHON, "-c", "import Basilisk.simulation.vizInterface"], capture_output=True).returncode:
        pytest.skip(f"bsk is not installed for {PYTHON}; BASILISK_PYTHON names one that has it")


def flown(address, minutes, folder):
    """What Basilisk tells of each picture."""
    port, variables = address.rpartition(":")[2], {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    command = [PYTHON, str(SCRIPT), port, str(minutes), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, env=variables, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]


def view(state):
    """The second camera and the Sun in the target's axes, by the states of the simulation."""
    (r, sigma), (at, turn) = (np.array(state[name]) for name in ("chaser", "target"))
    NB, TN = rotation_from_mrp(sigma).T, rotation_from_mrp(turn)
    pose = np.eye(4)
    pose[:3, :3] = TN @ NB @ rotation_from_mrp(np.array(SIGMA_CB)).T
    pose[:3, 3] = TN @ (r + NB @ LEVER - at)
    focal = 0.5 * SIZE[1] / np.tan(0.5 * FOV)
    camera = Camera(pose, *SIZE, focal, focal, 0.5 * SIZE[0], 0.5 * SIZE[1])
    return camera, Sun(TN @ (np.array(state["sun"]) - at))


def test_optical_navigation_turns_the_camera_to_the_target(traced, tmp_path):
    with serving(traced) as address:
        states = flown(address, 2.0, tmp_path)
    assert len(states) == 60
    assert states[0]["off_axis_deg"] > 5
    assert max(each["off_axis_deg"] for each in states[-20:]) < 1.5
    assert max(each["centroid_error_deg"] for each in states) < 1.5  # boxsat is 6 degrees wide, and lit from aside


@pytest.mark.parametrize("name", ["ball", "traced"])
def test_pictures_are_those_of_the_same_relative_pose(name, request, tmp_path):
    served = request.getfixturevalue(name)
    with serving(served) as address:
        states = flown(address, 0.15, tmp_path)
    assert len(states) == 4
    for each in states:
        seen = read_png(tmp_path / f"{each['seconds']:05.1f}.png")
        expected = served.draw(*view(each), None, ("rgb",), round(each["seconds"] / STEP))["rgb"]
        assert expected.max() > 100
        off = np.abs(seen.astype(int) - expected).max(axis=-1)
        assert (off > 2).mean() < 1e-3  # rays that graze an edge: its pose went through MRPs
