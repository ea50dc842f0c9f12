"""benchmarks/composition.py: its rows; what it and viewer.py refuse."""

import importlib
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(autouse=True)
def _importable(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))


def test_rows_by_kind_and_by_name():
    import composition

    names = [row.name for row in composition.chosen_rows("thesis,ours", "demo")]
    assert names[:4] == ["none", "map", "splat", "baseline-park"]
    assert len(set(names)) == len(names)
    chosen = composition.chosen_rows("map-ratio,none", "demo")
    assert [(row.name, row.run, row.shadows) for row in chosen] == [
        ("none", "none", "none"),
        ("map-ratio", "map", "ratio"),
    ]
    assert chosen[1].config.method == "shadow-map"
    with pytest.raises(SystemExit, match="--rows: expected some of thesis, ours, none"):
        composition.chosen_rows("mapp", "demo")


@pytest.mark.parametrize(
    ("benchmark", "arguments", "sentence"),
    [
        ("composition", ["--rows", "none", "--run", "nune=x"], "--run: expected NAME to be one of none, found 'nune'"),
        ("viewer", ["/nowhere"], "/nowhere: expected the folder of a run or a scene file (.toml), found nothing"),
        ("viewer", ["--clients", "0"], "--clients: expected 1 to 100, found 0"),
    ],
)
def test_what_cannot_be_is_refused(benchmark, arguments, sentence, monkeypatch, capsys):
    from support import common

    monkeypatch.setattr(sys, "argv", [f"{benchmark}.py", *arguments, *(["--out", "x"] * (benchmark == "composition"))])
    if benchmark == "viewer":
        pytest.importorskip("viser", reason="viser is not installed")
    with pytest.raises(SystemExit) as ended:
        common.run_main(importlib.import_module(benchmark).main)
    assert sentence in capsys.readouterr().err + str(ended.value)
