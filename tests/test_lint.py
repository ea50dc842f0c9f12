"""ruff and mypy have nothing to say: they run beside the other tests, and not before them."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("command", ["mypy", "ruff check", "ruff format --check"])
def test_nothing_to_mend(command):
    tool, *options = command.split()
    done = subprocess.run(
        [Path(sys.executable).with_name(tool), *options], cwd=ROOT, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
