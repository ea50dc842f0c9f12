"""ruff and mypy have nothing to say, and mypy knows the public names: they run beside the other tests."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def run(tool: str, *options: object) -> subprocess.CompletedProcess:
    command = [Path(sys.executable).with_name(tool), *options]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)


@pytest.mark.parametrize("option", [("check",), ("format", "--check")], ids=" ".join)
def test_ruff_finds_nothing(option):
    done = run("ruff", *option)
    assert done.returncode == 0, done.stdout + done.stderr


def test_mypy_finds_nothing_and_knows_public_names(tmp_path):
    """Of the package there is nothing to say, of a program that uses it wrongly all that is wrong."""
    program = tmp_path / "program.py"
    program.write_text("import spacesim as ss\nreveal_type(ss.read_scene)\nss.trian\nss.replace\n", encoding="utf-8")
    done = run("mypy", "--no-error-summary", "spacesim", program)  # once, as it takes half a minute
    lines = done.stdout.splitlines()
    assert [line.split("program.py:")[-1][0] for line in lines] == ["2", "3", "4"], done.stdout + done.stderr
    assert "SceneConfig" in lines[0], done.stdout
    assert [re.findall(r'no attribute "(\w+)"', line) for line in lines[1:]] == [["trian"], ["replace"]], done.stdout
