"""`spacesim view` as a command: what it says, how it ends, what it refuses."""

import os
import re
import signal
import socket
import subprocess
import sys
import urllib.request

import pytest
from browser import PATIENCE


@pytest.fixture(autouse=True)
def needs_viser():
    pytest.importorskip("viser", reason="viser is not installed")


def started(*arguments):
    """The command in a process of its own, and the address that it tells."""
    process = subprocess.Popen(
        [sys.executable, "-m", "spacesim.cli", "view", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    lines = []
    for line in process.stdout:
        lines.append(line)
        found = re.search(r"viewer: (http://\S+) \(Ctrl-C ends it\)", line)
        if found:
            return process, found[1], lines
    raise AssertionError(f"{lines} {process.stderr.read()}")


def test_it_says_where_to_look_and_ends_quietly(tiny_run):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        process, url, lines = started(tiny_run, "--port", port)
    try:
        assert f":{port}" not in url
        assert any(str(port) in line and "taken" in line for line in lines)
        with urllib.request.urlopen(url, timeout=PATIENCE) as answer:
            assert answer.status == 200
    finally:
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0
    assert output == ""
    assert [line for line in errors.splitlines() if "cannot be relit" not in line] == []  # a vanilla run's sentence


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (("--port", "65536"), "--port"),
        (("--port", "-1"), "--port"),
        (("--host", "192.0.2.1"), "--host"),
        (("--data", "nothing"), "nothing"),
    ],
)
def test_what_cannot_be_is_refused(spacesim, tiny_run, arguments, name):
    assert spacesim("view", tiny_run, *arguments).is_refusal(name)


def test_paths_that_are_nothing_are_refused(spacesim, tmp_path, tiny_data):
    assert spacesim("view", tmp_path / "nothing").is_refusal("nothing")
    assert spacesim("view", tmp_path / "no.toml").is_refusal("no.toml")
    assert spacesim("view", tiny_data).is_refusal(tiny_data)
    (tmp_path / "bad.toml").write_text('[[models]]\nrun = "gone"\n')
    assert spacesim("view", tmp_path / "bad.toml").is_refusal("bad.toml", "line 2", "gone")


def test_without_viser_it_says_what_to_install(spacesim, tiny_run, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert spacesim("view", tiny_run).is_refusal("viser", "pip install 'spacesim[viewer]'")
