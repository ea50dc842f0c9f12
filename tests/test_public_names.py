"""What `import spacesim` gives: names that are loaded when they are used (what mypy knows of them: test_lint.py)."""

import ast
import subprocess
import sys
from collections import Counter
from pathlib import Path

import spacesim as ss

ROOT = Path(__file__).parents[1]


def run(program: str) -> None:
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_names_are_imported_when_they_are_used():
    run("""
import sys
import spacesim as ss
heavy = {"numpy", "drjit", "mitsuba", "spacesim.api"}
assert not heavy & set(sys.modules), sorted(heavy & set(sys.modules))
from spacesim.data import errors
import spacesim.cli
assert not hasattr(ss, "_repr_html_")
assert not hasattr(ss, "replace")
assert "InputError" in dir(ss)
assert ss.InputError is errors.InputError
assert not heavy & set(sys.modules), sorted(heavy & set(sys.modules))
ss.Camera, ss.read_dataset, ss.CameraClient
assert not heavy - {"numpy"} & set(sys.modules), sorted(heavy & set(sys.modules))
""")


def test_names_are_those_of_the_api():
    run("""
import spacesim as ss
from spacesim import *
from spacesim import api
assert (train, InputError) == (api.train, api.InputError)
assert ss.__all__ == sorted(api.__all__)
assert set(ss.__all__) | {"__version__"} == set(dir(ss))
assert [name for name in ss.__all__ if getattr(ss, name) is not getattr(api, name)] == []
""")


def test_no_other_class_has_the_name_of_a_public_one():
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in (ROOT / "spacesim").rglob("*.py")]
    named = Counter(node.name for tree in trees for node in tree.body if isinstance(node, ast.ClassDef))
    assert named["Dataset"] == named["Run"] == 1
    assert {name: named[name] for name in ss.__all__ if named[name] > 1} == {}
