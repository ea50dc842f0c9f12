"""Ctrl-C and SIGTERM at chosen moments, standard output that is full or closed: one sentence, never a traceback."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from tiny import GENERATE, PROGRAM, TRAIN

STOPPED = "spacesim: stopped\n"
RESUMABLE = "spacesim: stopped; what was finished is kept, --resume goes on from there\n"
FULL = Path("/dev/full")
NO_SPACE = f"spacesim: standard output: cannot be written ({os.strerror(errno.ENOSPC)})\n"

# Runs the command as `python -m spacesim.cli` does, and presses Ctrl-C: when a module is looked for, or when a function
# is called, for the first time or, as in "call:step:4:2", for the fourth time, twice; "call:step:4:2:SIGTERM" sends
# another signal.
PRESSED = """
import os, runpy, signal, sys, threading, time
kind, wanted, *rest = sys.argv[1].split(":")
nth, times, name = rest + ["1", "1", "SIGINT"][len(rest):]
del sys.argv[1]

calls = 0

def press():
    global calls
    calls += 1
    if calls == int(nth):
        for _ in range(int(times)):
            os.kill(os.getpid(), signal.Signals[name])
            time.sleep(0.01)  # two that are pending at once are one

class Watch:
    def find_spec(self, name, path=None, target=None):
        if kind == "import" and name == wanted:
            press()

def called(frame, event, argument):
    if event == "call" and kind == "call" and frame.f_code.co_name == wanted:
        press()

sys.meta_path.insert(0, Watch())
if kind == "call":
    sys.setprofile(called)
    threading.setprofile(called)
runpy.run_module("spacesim.cli", run_name="__main__", alter_sys=True)
"""

PRINTING = [
    ("--help",),
    ("generate", "boxsat", "--print"),
    ("verify", "DATA"),
]
CASES = pytest.mark.parametrize("arguments", PRINTING, ids=lambda words: " ".join(words)[:24])


def run(*words: object, **options) -> subprocess.CompletedProcess:
    """A process of Python whose output is buffered, as users have it."""
    buffered = {key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"}
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=100, env=buffered, **options)


@pytest.mark.parametrize(
    ("moment", "sentence"),
    [
        ("import:argparse", STOPPED),  # of the command line itself
        ("call:parser", STOPPED),
        ("import:drjit", RESUMABLE),
        ("import:mitsuba.mitsuba_ext", RESUMABLE),  # amid compiled modules, which wrap what is raised in them
        ("call:write_frame", RESUMABLE),  # while a thread writes
        ("call:sample_surface_points", RESUMABLE),  # when all frames are there
        ("import:drjit:1:1:SIGTERM", RESUMABLE),
        ("call:write_frame:1:1:SIGTERM", RESUMABLE),
    ],
)
def test_ctrl_c_or_sigterm_at_any_moment_is_one_sentence(tmp_path, moment, sentence):
    out = tmp_path / "data"
    done = run("-c", PRESSED, moment, "generate", "boxsat", "--out", out, *GENERATE, stdout=subprocess.PIPE)
    lines = [line for line in done.stderr.splitlines(keepends=True) if not line.startswith("generate: ")]
    code = 128 + (signal.SIGTERM if moment.endswith("SIGTERM") else signal.SIGINT)
    assert (done.returncode, "".join(lines), done.stdout) == (code, sentence, "")
    assert not (out / "transforms.json").exists()


def test_ctrl_c_in_training_loses_no_step(tiny_data, tmp_path):
    """It comes amid the fourth step; the resumed run is the undisturbed one to the bit."""
    words = ["train", tiny_data, "--out", tmp_path / "run", *TRAIN]
    done = run("-c", PRESSED, "call:_learn:4", *words, stdout=subprocess.PIPE)
    assert (done.returncode, done.stderr.splitlines(keepends=True)[-1]) == (130, RESUMABLE)
    assert [path.name for path in (tmp_path / "run" / "checkpoints").glob("*.safetensors")] == [
        "step_00000004.safetensors"
    ]
    assert run("-m", "spacesim.cli", *words, "--resume", stdout=subprocess.PIPE).returncode == 0
    assert run("-m", "spacesim.cli", *words[:3], tmp_path / "whole", *TRAIN, stdout=subprocess.PIPE).returncode == 0
    resumed, whole = ((tmp_path / name / "model.safetensors").read_bytes() for name in ("run", "whole"))
    assert resumed == whole


def test_ctrl_c_after_the_last_step_waits_for_the_model(tiny_data, tmp_path):
    done = run("-c", PRESSED, "call:versions", "train", tiny_data, "--out", tmp_path, *TRAIN, stdout=subprocess.PIPE)
    assert (done.returncode, (tmp_path / "model.safetensors").exists()) == (0, True), done.stderr


@pytest.mark.parametrize(
    ("number", "code", "last"), [(signal.SIGINT, 130, [RESUMABLE]), (signal.SIGTERM, -signal.SIGTERM, [])]
)
def test_a_second_ctrl_c_ends_a_step_that_takes_long(tiny_data, tmp_path, number, code, last):
    moment = f"call:counted:1:2:{number.name}"
    done = run("-c", PRESSED, moment, "train", tiny_data, "--out", tmp_path, *TRAIN, stdout=subprocess.PIPE)
    assert (done.returncode, done.stderr.splitlines(keepends=True)[-1:]) == (code, last)
    assert not list(tmp_path.rglob("*.safetensors"))


def test_ctrl_c_mentions_resume_only_where_possible(tiny_data, tiny_run, tmp_path):
    done = run(
        "-c",
        PRESSED,
        "call:predict",
        "eval",
        tiny_run,
        "--data",
        tiny_data,
        "--out",
        tmp_path / "e",
        stdout=subprocess.PIPE,
    )
    assert (done.returncode, done.stderr.splitlines(keepends=True)[-1]) == (130, STOPPED)
    assert not (tmp_path / "e" / "metrics.json").exists()


@pytest.mark.skipif(not FULL.exists(), reason="this system has no /dev/full")
@CASES
def test_a_full_standard_output_is_one_sentence(tiny_data, arguments):
    with open(FULL, "w") as full:
        words = [str(tiny_data) if word == "DATA" else word for word in arguments]
        done = run("-m", "spacesim.cli", *words, stdout=full)
    assert (done.returncode, done.stderr) == (1, NO_SPACE)


@CASES
def test_a_closed_standard_output_ends_quietly(tiny_data, arguments):
    reading, writing = os.pipe()
    os.close(reading)
    try:
        words = [str(tiny_data) if word == "DATA" else word for word in arguments]
        done = run("-m", "spacesim.cli", *words, stdout=writing)
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (1, "")


@pytest.mark.skipif(not FULL.exists(), reason="this system has no /dev/full")
def test_results_are_whole_where_standard_output_is_full(tiny_data, tmp_path):
    with open(FULL, "w") as full:
        done = run("-c", PROGRAM, "generate", "boxsat", "--out", tmp_path / "data", *GENERATE, stdout=full)
    assert done.returncode == 1
    assert done.stderr.splitlines(keepends=True)[-1] == NO_SPACE
    made, expected = (
        {path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()}
        for root in (tmp_path / "data", tiny_data)
    )
    assert made == expected


def test_ctrl_c_is_left_to_scripts_that_call_the_command(tmp_path):
    """Only the command itself takes SIGINT into its own hands."""
    code = "import signal, spacesim.cli; assert signal.getsignal(signal.SIGINT) is signal.default_int_handler"
    assert run("-c", code).returncode == 0
    (tmp_path / "cli.py").write_text(code)
    assert run(tmp_path / "cli.py").returncode == 0
