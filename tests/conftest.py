"""One tiny dataset, one tiny run and its evaluation, for the tests of the command line."""

import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from tiny import GENERATE, TRAIN, Outcome, call

# A shell may have started us with Ctrl-C ignored, which the commands that tests start and stop would inherit.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def spacesim() -> Callable[..., Outcome]:
    """Call a command in this process."""
    return call


@pytest.fixture(scope="session")
def tiny_data(tmp_path_factory) -> Path:
    """boxsat, 6 training and 2 test views of 40x40 pixels."""
    out = tmp_path_factory.mktemp("tiny") / "data"
    done = call("generate", "boxsat", "--out", out, *GENERATE)
    assert done.code == 0, done.errors
    return out


@pytest.fixture(scope="session")
def tiny_run(tiny_data, tmp_path_factory) -> Path:
    """50 iterations on `tiny_data`."""
    out = tmp_path_factory.mktemp("tiny") / "run"
    done = call("train", tiny_data, "--out", out, *TRAIN)
    assert done.code == 0, done.errors
    return out


@pytest.fixture(scope="session")
def tiny_eval(tiny_run, tiny_data, tmp_path_factory) -> Path:
    """`tiny_run` judged on the test views of `tiny_data`."""
    out = tmp_path_factory.mktemp("tiny") / "eval"
    done = call("eval", tiny_run, "--data", tiny_data, "--out", out)
    assert done.code == 0, done.errors
    return out
