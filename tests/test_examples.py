"""The examples run as they stand, only smaller, each on what the one before it has left."""

import ast
import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spacesim.data.images import read_exr, read_png
from spacesim.data.store import find_unreadable_files

EXAMPLES = Path(__file__).parents[1] / "examples"
MAX_LINES, MAX_CLIENT_LINES = 20, 110
CLIENTS = EXAMPLES / "closed_loop"
"""Programs that ask `spacesim serve` from elsewhere (Basilisk, a plain socket): each is one file that stands alone,
with the other program's scene or the bytes of the protocol in it, so they may be longer than examples."""


def imports(path: Path) -> list[str]:
    tree = ast.parse(path.read_text())
    names = [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    return names + [node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]


def example(name: str) -> Any:
    """The example's module, without running it."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def lines_of_code(path: Path) -> int:
    """Without docstrings, comments and empty lines; a statement over several lines counts them all."""
    text, said = path.read_text(), set[int]()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.FunctionDef) and ast.get_docstring(node) is not None:
            said |= set(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
    lines = enumerate(text.splitlines(), start=1)
    return sum(bool(line.strip()) and not line.strip().startswith("#") and i not in said for i, line in lines)


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_examples_are_short_and_import_from_spacesim_alone(path):
    names = imports(path)
    others = {name.partition(".")[0] for name in names} - sys.stdlib_module_names - {"numpy"}
    assert others == ({"spacesim", "drjit"} if path.stem == "04_rasterizer_gradients" else {"spacesim"})
    assert [name for name in names if name.startswith("spacesim")] == ["spacesim"]
    assert lines_of_code(path) <= MAX_LINES


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*/**/*.py")), ids=lambda path: path.stem)
def test_only_clients_of_other_programs_are_longer(path):
    assert path.parent == CLIENTS
    assert [name for name in imports(path) if name.partition(".")[0] == "spacesim"] == []
    assert lines_of_code(path) <= MAX_CLIENT_LINES


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    out = tmp_path_factory.mktemp("examples") / "data"
    example("01_simulate").main(out, views=6, resolution=48, spp=4)
    return out


@pytest.fixture(scope="module")
def run(data):
    out = data.parent / "run"
    example("02_reconstruct").main(data, out, iterations=60, gaussians=500)
    return out


def test_compose(run, tmp_path):
    text = (EXAMPLES / "05_compose.toml").read_text()
    assert text.count("../out/examples/run") == 2
    small = (
        text.replace("../out/examples/run", str(run)).replace("frames = 48", "frames = 3").replace("1.9583", "0.0833")
    )
    (tmp_path / "scene.toml").write_text(small)
    scene = example("05_compose").main(tmp_path / "scene.toml", tmp_path / "out", size=40)
    assert scene.frames == 3
    ids = [read_png(tmp_path / f"out/id/{k:04d}.png") for k in range(3)]
    assert set(np.unique(ids[0])) == {0, 1, 2}
    assert (ids[0] != ids[2]).any()


def test_simulate(data, capsys):
    assert find_unreadable_files(data) == []
    dataset = example("01_simulate").main(data, views=6, resolution=48, spp=4)  # all there already
    assert (len(dataset.train), len(dataset.test)) == (6, 4)
    printed = capsys.readouterr().out
    shares = [int(line.split(":")[1].split("%")[0]) for line in printed.splitlines() if "of the surface's" in line]
    assert len(shares) == 3
    assert sum(shares) == pytest.approx(100, abs=2)


def test_reconstruct(run):
    assert read_png(run / "view.png").shape == (48, 48, 4)
    assert read_png(run / "shadow.png").shape == (48, 48, 3)
    depth = read_exr(run / "depth.exr")["depth"]
    assert 5 < np.median(depth[depth > 0]) < 15


def test_evaluate(data, run):
    out = data.parent / "eval"
    scores = example("03_evaluate").main(data, run, out)
    assert scores["image_full"]["psnr"]["mean"] > 15
    assert (out / "report.html").stat().st_size > 10_000


def test_rasterizer_gradients(tmp_path):
    first, last = example("04_rasterizer_gradients").main(tmp_path / "fit.pgm", count=60, size=40, steps=40)
    assert last < 0.6 * first
    assert read_png(tmp_path / "fit.pgm").shape == (40, 80)


def test_refine_pose(data, run):
    pose, before, after = example("06_refine_pose").main(run, data, starts=1)
    assert before == pytest.approx((5, 5))
    assert pose.covariance.shape == (6, 6)
    assert np.isfinite(after).all()
    assert after != before


def test_radiance_fields(data, tmp_path):
    text = (EXAMPLES / "07_radiance_fields.toml").read_text()
    text = text.replace("../out/examples/field", "field").replace("[256, 256]", "[32, 32]")
    (tmp_path / "scene.toml").write_text(text)
    trained = example("07_radiance_fields").main(data, tmp_path / "field", tmp_path / "scene.toml", iterations=60)
    assert trained.gaussian_count is None
    numbers = read_png(next((tmp_path / "fields/id").glob("*.png")))
    assert numbers.shape == (32, 32)
    assert read_png(next((tmp_path / "fields").glob("rgb/*.png"))).shape[:2] == (32, 32)
