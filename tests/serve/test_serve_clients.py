"""The clients of examples/: a closed loop, C++, a plain TCP socket."""

import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from spacesim.data.geometry import look_at
from spacesim.data.images import read_png
from spacesim.data.records import Camera, Sun
from spacesim.serve.server import serving

EXAMPLES = Path(__file__).parents[2] / "examples"
SUN = Sun(np.array([1.0, 0.5, 0.8]))


def view(distance):
    """What the clients ask for."""
    return Camera.from_fov(look_at([distance, 0.0, 0], [0, 0, 0]), 64, 64, 30.0)


def test_a_closed_loop_comes_to_its_target(traced):
    spec = importlib.util.spec_from_file_location("closed_loop", EXAMPLES / "08_closed_loop.py")
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    with serving(traced) as address:
        misses = example.main(address, steps=6, size=64)
    assert misses[0] > 8
    assert max(misses[3:]) < 2


def test_cpp(traced, tmp_path):
    compiler = shutil.which("c++") or shutil.which("g++")
    if compiler is None:
        pytest.skip("there is no C++ compiler")
    program, picture = tmp_path / "client", tmp_path / "view.ppm"
    command = [compiler, "-Wall", "-Wextra", "-Werror", EXAMPLES / "closed_loop/client.cpp", "-lzmq", "-o", program]
    built = subprocess.run(command, capture_output=True, text=True)
    if "zmq.h" in built.stderr.partition("\n")[0] or "-lzmq" in built.stderr:
        pytest.skip("libzmq's header or library is not installed (Debian: libzmq3-dev)")
    assert built.returncode == 0, built.stderr
    with serving(traced) as address:
        done = subprocess.run([program, address, picture], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    drawn = traced.draw(view(10), SUN, None, ("rgb", "depth"), 0)
    assert np.array_equal(read_png(picture), drawn["rgb"])
    header, depth = done.stdout.splitlines()
    assert [array["name"] for array in json.loads(header)["arrays"]] == ["rgb", "depth"]
    assert depth == f"depth in the middle: {drawn['depth'][32, 32]:.3f} m"
    refused = subprocess.run([program, "nowhere", picture], capture_output=True, text=True)
    assert (refused.returncode, refused.stderr) == (1, "no answer\n")


def test_plain_tcp(traced):
    with serving(traced) as address:
        command = [sys.executable, EXAMPLES / "closed_loop/tcp.py", address.rpartition(":")[2]]
        done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    means = [traced.draw(view(12 - k), SUN, None, ("rgb",), k)["rgb"].mean() for k in range(3)]
    assert done.stdout.splitlines() == [f"{12 - k} m: mean {means[k]:.2f}" for k in range(3)]
