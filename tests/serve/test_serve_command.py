"""`spacesim serve` as a command: what it says, how it ends, what it refuses."""

import os
import re
import signal
import subprocess
import sys
from contextlib import contextmanager

import pytest
from serving import CAMERA, SUN

from spacesim.serve.client import CameraClient

PATIENCE = 60  #: seconds


@contextmanager
def started(*arguments):
    """The command in a process of its own, and the address that it tells."""
    process = subprocess.Popen(
        [sys.executable, "-m", "spacesim.cli", "serve", *map(str, arguments), "--port", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    try:
        line = process.stdout.readline()
        found = re.fullmatch(r"serve: (.+) at (tcp://127\.0\.0\.1:\d+) \(Ctrl-C ends it\)\n", line)
        assert found, f"{line} {process.stderr.read()}"
        yield process, found[1], found[2]
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_answers_and_ends_quietly(number):
    with started("boxsat", "--spp", 2) as (process, name, address):
        assert name == "boxsat"
        with CameraClient(address) as client:
            assert client.picture(CAMERA, SUN)["rgb"].any()
        process.send_signal(number)
        output, errors = process.communicate(timeout=PATIENCE)
    assert (process.returncode, output, errors) == (0, "", "")


def test_a_run_and_a_composed_scene(tiny_run, tiny_data, tmp_path):
    from spacesim.data.store import read_dataset

    frame = read_dataset(tiny_data).test[0]
    models = "".join(f'[[models]]\nname = "{name}"\nrun = "{tiny_run}"\n' for name in ("below", "above"))
    (tmp_path / "pair.toml").write_text(models + "position = [0.0, 0.0, 1.6]\n")
    for what, name, outputs in (
        (tiny_run, "boxsat", ("rgb", "depth")),
        (tmp_path / "pair.toml", "pair", ("rgb", "object_id")),
    ):
        with started(what) as (_, served, address), CameraClient(address) as client:
            seen = client.picture(frame.camera, frame.sun, outputs=outputs)
        assert served == name
        assert all(array.any() for array in seen.values())
    assert set(seen["object_id"].ravel()) == {0, 1, 2}


def test_what_cannot_be_is_refused(spacesim, tiny_run, tmp_path):
    assert spacesim("serve", "boxsaat").is_refusal("boxsaat", "did you mean boxsat?")
    assert spacesim("serve", tmp_path).is_refusal(tmp_path)
    assert spacesim("serve", tmp_path / "none.toml").is_refusal("none.toml")
    assert spacesim("serve", tiny_run, "--spp", 4).is_refusal("--spp", "not path-traced")
    assert spacesim("serve", "boxsat", "--spp", 0).is_refusal("--spp")
    assert spacesim("serve", tiny_run, "--port", 65536).is_refusal("--port")
    assert spacesim("serve", tiny_run, "--host", "192.0.2.1").is_refusal("--host")


def test_without_pyzmq_it_says_what_to_install(spacesim, tiny_run, monkeypatch):
    monkeypatch.setitem(sys.modules, "zmq", None)
    assert spacesim("serve", tiny_run).is_refusal("pyzmq", "pip install 'spacesim[serve]'")
