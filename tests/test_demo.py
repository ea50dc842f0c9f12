"""What `spacesim demo` makes of a folder that is there already."""

import json
import re
from dataclasses import replace

import pytest

from spacesim import demo as module
from spacesim.data.errors import InputError
from spacesim.demo import _prepare, demo
from spacesim.progress import show_progress


def test_a_demo_goes_on_in_its_own_folder(tmp_path):
    _prepare(tmp_path)
    (tmp_path / "data").mkdir()
    _prepare(tmp_path)
    assert (tmp_path / "data").is_dir()


def test_a_demo_of_another_version_starts_afresh(tmp_path):
    _prepare(tmp_path)
    marker = json.loads((tmp_path / "demo.json").read_text())
    marker["versions"]["trimesh"] = "0.0.1"
    (tmp_path / "demo.json").write_text(json.dumps(marker))
    for part in ("data", "run", "mine"):
        (tmp_path / part).mkdir()
    _prepare(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["demo.json", "mine"]
    assert json.loads((tmp_path / "demo.json").read_text())["versions"]["trimesh"] != "0.0.1"


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(InputError, match="other files"):
        _prepare(tmp_path)
    assert (tmp_path / "thesis.tex").read_text() == "precious"


def test_the_page_is_called_as_the_spacecraft(tmp_path, monkeypatch):
    small = {"suns": 2, "views": 3, "test_suns": 1, "test_views": 1, "known_test_views": 0, "resolution": 32, "spp": 2}
    monkeypatch.setattr(module, "DATA", small)
    monkeypatch.setattr(module, "TRAINING", replace(module.TRAINING, iterations=1, init_count=200))
    page = demo(tmp_path / "out", show_progress)["page"].read_text()
    assert "<title>boxsat · spacesim</title>" in page
    assert re.search(r"<h1>boxsat</h1><p>shadow-map, \d+ Gaussians", page)
