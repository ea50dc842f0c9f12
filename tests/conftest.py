"""One tiny dataset, one tiny run and its evaluation, for the tests of the command line."""

import cores  # first: before libraries look how many there are

# isort: split

import gc
import signal
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path

import pytest
from browser import CHROMIUM, Browser
from tiny import GENERATE, TRAIN, TRAIN_FIELD, Outcome, call

# A shell may have started us with Ctrl-C ignored, which the commands that tests start and stop would inherit.
signal.signal(signal.SIGINT, signal.default_int_handler)


LONGEST = (
    "test_attack",
    "test_benchmarks",
    "test_doc_commands",
    "test_robustness",
    "test_workers",
    "test_locate",
    "test_refine_pose",
    "test_reproduce",
    "test_browser",
    "test_generate",
    "test_interrupts",
    "test_lint",
    "test_attack_viewer",
    "test_cli",
    "test_page",
    "test_nerf_training",
)
"""Files of tests that take long, the longest first: what is left at the end is short, and processes end together."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest."""
    order = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))


def pytest_collection_finish() -> None:
    """What is there now stays: the garbage collector need not look at it again and again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="session")
def _sooner() -> None:
    """In test processes; the programs that they start have the defaults."""
    from sooner import spare_work

    spare_work()


@pytest.fixture(autouse=True)
def _threads(request) -> Iterator[None]:
    """Tests marked `threads` have all cores."""
    with cores.all_cores() if request.node.get_closest_marker("threads") else nullcontext():
        yield


@pytest.fixture
def kernels_of_text() -> None:
    """Skips where none run."""
    from spacesim.backend import select
    from spacesim.backend.kernels import llvm

    if select() != "llvm":
        pytest.skip("such kernels are a CPU's")
    if llvm.dr_library() is None:
        pytest.skip("Dr.Jit's library is not known here")
    assert llvm.is_usable()


@pytest.fixture(scope="session")
def spacesim() -> Callable[..., Outcome]:
    """Call a command in this process."""
    return call


@pytest.fixture(scope="module")
def browser(tmp_path_factory) -> Iterator[Browser]:
    """Headless Chromium."""
    if CHROMIUM is None:
        pytest.skip("there is no Chromium to drive")
    one = Browser(tmp_path_factory.mktemp("chromium"))
    yield one
    one.close()


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
    """`tiny_run` evaluated on the test views of `tiny_data`."""
    out = tmp_path_factory.mktemp("tiny") / "eval"
    done = call("eval", tiny_run, "--data", tiny_data, "--out", out)
    assert done.code == 0, done.errors
    return out


@pytest.fixture(scope="session")
def tiny_field(tiny_data, tmp_path_factory) -> Path:
    """A radiance field that takes the Sun as input, 60 iterations on `tiny_data`."""
    out = tmp_path_factory.mktemp("tiny") / "field"
    done = call("train", tiny_data, "--out", out, "--method", "nerf-relight", *TRAIN_FIELD)
    assert done.code == 0, done.errors
    return out
