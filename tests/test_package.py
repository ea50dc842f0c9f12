"""The wheel holds what a run of the program needs, and runs without the checkout; how the project is cited."""

import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import spacesim as ss
from spacesim.data.toml import parse

ROOT = Path(__file__).parents[1]


def test_the_wheel_stands_alone(tmp_path):
    build = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "--no-cache-dir"]
    source = tmp_path / "source"  # building writes beside what it reads
    shutil.copytree(ROOT / "spacesim", source / "spacesim", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    done = subprocess.run([*build, "-w", tmp_path, source], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
        wheel.extractall(tmp_path / "site")
        names = set(wheel.namelist())
    assets = {path.relative_to(ROOT).as_posix() for path in (ROOT / "spacesim/assets").rglob("*") if path.is_file()}
    assert assets - names == set()
    assert {"spacesim/py.typed", f"spacesim-{ss.__version__}.dist-info/METADATA"} <= names
    program = "import spacesim as ss; print(ss.__file__); ss.preset('demo', 'shadow-map'); ss.read_scene('boxsat')"
    alone = {"PYTHONPATH": str(tmp_path / "site"), "HOME": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, env=alone, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(tmp_path / "site"))


def test_every_extra_is_installed_for_the_tests():
    """And locked; torch's, which `lpips` and `torch` ask for, is another build."""
    project = parse((ROOT / "pyproject.toml").read_text(encoding="utf-8"), "pyproject.toml").values["project"]
    extras = set(project["optional-dependencies"]) - {"lpips", "torch"}
    lock = (ROOT / "requirements" / "lock.txt").read_text(encoding="utf-8")
    (loop,) = re.findall(r"for extra in (.+); do", (ROOT / "scripts" / "setup.sh").read_text(encoding="utf-8"))
    assert set(loop.split()) | {"dev"} == extras
    assert set(re.findall(r"--extra (\w+)", lock)) == extras
    assert set(re.findall(r'-e "\.\[(.+)\]"', lock)[0].split(",")) == extras


def test_the_citation_is_that_of_the_package():
    """In the format's fields that 1.2.0 asks for, by what the project says of itself elsewhere."""
    yaml = pytest.importorskip("yaml", reason="PyYAML (extra: docs) is not installed")
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = parse((ROOT / "pyproject.toml").read_text(encoding="utf-8"), "pyproject.toml").values["project"]
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    assert (citation["title"], citation["abstract"]) == (project["name"], project["description"])
    for record in (citation, citation["preferred-citation"]):
        assert (record["version"], record["type"]) == (ss.__version__, "software")
    assert (citation["license"], citation["keywords"]) == (project["license"], project["keywords"])
    year, authors = citation["preferred-citation"]["year"], citation["authors"][0]["name"]
    assert f"Copyright (c) {year}, {authors[0].lower()}{authors[1:]}" in (ROOT / "LICENSE").read_text(encoding="utf-8")
    (thesis,) = citation["references"]
    assert {"type", "title", "authors"} <= set(thesis)
    assert f'"{thesis["title"]}"' in (ROOT / "README.md").read_text(encoding="utf-8")
