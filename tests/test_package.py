"""The wheel holds what a run of the program needs, and runs without the checkout."""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

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
    assert "spacesim/py.typed" in names
    program = "import spacesim as ss; print(ss.__file__); ss.preset('demo', 'shadow-map'); ss.read_scene('boxsat')"
    alone = {"PYTHONPATH": str(tmp_path / "site"), "HOME": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, env=alone, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(tmp_path / "site"))
