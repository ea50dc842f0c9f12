"""The benchmarks: what they compute of their measurements, and that they run and tell what they say they do."""

import json
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from spacesim.splat.train.config import PRESETS, preset

FOLDER = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="module", autouse=True)
def _importable():
    sys.path.insert(0, str(FOLDER))
    yield
    sys.path.remove(str(FOLDER))


def call(script: str, *arguments: str) -> str:
    command = [sys.executable, str(FOLDER / script), "--backend", "llvm", *arguments]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def small_lit(tmp_path_factory) -> Path:
    """A path-traced dataset of two Suns and one never seen."""
    from spacesim.scenes import generate, read_scene

    root = tmp_path_factory.mktemp("lit") / "data"
    generate(read_scene("boxsat", suns=2, views=2, test_suns=1, test_views=1, resolution=(24, 24), spp=4), root)
    return root


def test_rows_are_named_with_commas_in_them():
    import common

    assert common.row_names("none,map, no bias,ours") == ["none", "map, no bias", "ours"]


def points_of(time):
    import growth

    sizes = [(1_000, 64, 3_000), (10_000, 64, 20_000), (100_000, 64, 150_000), (10_000, 256, 60_000)]
    return [growth.Point(n, side, pairs, time(n, side, pairs)) for n, side, pairs in sizes]


@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
def test_slope_is_the_exponent(power):
    import growth

    assert growth.slope(points_of(lambda n, side, pairs: 3 * pairs**power)) == pytest.approx(power)


def test_linear_model_finds_the_parts_it_is_made_of_and_its_own_failure():
    import growth

    linear = points_of(lambda n, side, pairs: 0.5 + 40e-6 * pairs + 7e-6 * n + 2e-6 * side**2)
    parts, worst = growth.model(linear)
    assert list(parts.values()) == pytest.approx([0.5, 40, 7, 2], rel=1e-6)
    assert worst < 1e-9
    assert growth.model(points_of(lambda n, side, pairs: 1e-9 * pairs**2))[1] > 0.3


def test_plot_has_a_mark_for_each_measurement():
    import growth

    points = points_of(lambda n, side, pairs: 1e-4 * pairs)
    root = ElementTree.fromstring(growth.plot("time <&>", points))
    circles = [(float(c.get("cx")), float(c.get("cy"))) for c in root.iter("{http://www.w3.org/2000/svg}circle")]
    assert len(circles) == 3 + 2  # three on 64 pixels, two of 10,000 Gaussians; one is both
    rise = [(y1 - y0) / (x1 - x0) for (x0, y0), (x1, y1) in pairwise(circles[:3])]
    assert max(rise) == pytest.approx(min(rise), abs=0.01)  # a power is a straight line
    lone = growth.plot("time", [growth.Point(10, 16, 30, 1.0), growth.Point(20, 32, 80, 2.0)])
    assert lone.count("<circle") == 2  # of no series
    assert "20 on 32²" in lone


def test_quartiles_and_tables():
    import common

    timing = common.Timing.of(np.arange(1, 10) * 1e-3)
    assert (timing.low, timing.median, timing.high, timing.least) == pytest.approx((3, 5, 7, 1))
    table = common.table([{"a": 1_000, "b": 0.5}, {"a": 2, "b": "x"}], markdown=True)
    assert [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()] == [
        ["a", "b"], ["----:", "---:"], ["1,000", "0.50"], ["2", "x"]
    ]  # fmt: skip


@pytest.mark.parametrize("text", ["12", "axb", "100x0", "1x2x3", ""])
def test_sizes_that_are_none_are_refused(text):
    import common

    with pytest.raises(SystemExit, match="--sizes: expected"):
        common.parse_sizes(text)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--repeats", "0"], "expected at least 1, found 0"),
        (["--steps", "100"], "--steps: expected at least 200, found 100"),
        (["--opensplat", "/nowhere"], "--opensplat: expected OpenSplat's binary, found no file /nowhere"),
    ],
)
def test_what_cannot_be_measured_is_refused(arguments, sentence, monkeypatch, capsys):
    import common
    import training

    monkeypatch.setattr(sys, "argv", ["training.py", *arguments])
    with pytest.raises(SystemExit) as ended:
        common.told(training.main)
    assert sentence in capsys.readouterr().err + str(ended.value)


def test_what_was_measured_is_told_before_a_file_that_cannot_be_written(tmp_path, monkeypatch, capsys):
    import common
    import rasterizer

    (tmp_path / "file").write_text("")
    for option in ("--json", "--plot"):
        where = str(tmp_path / "file" / "x")
        monkeypatch.setattr(sys, "argv", ["rasterizer.py", "--sizes", "100x16", "--repeats", "1", option, where])
        with pytest.raises(SystemExit, match="2"):
            common.told(rasterizer.main)
        told = capsys.readouterr()
        assert "Kernels, ms" in told.out
        assert f"{where}: cannot be written" in told.err


def test_opensplat_is_timed_without_its_start(tmp_path):
    """A program that needs half a second to start and 5 ms a step."""
    import peer_opensplat
    import synthetic

    binary = tmp_path / "opensplat"
    script = "import sys, time\nn = int(sys.argv[sys.argv.index('-n') + 1])\ntime.sleep(0.5 + 0.005 * n)\n"
    binary.write_text(f"#!{sys.executable} -IS\n{script}")
    binary.chmod(0o755)
    dataset = synthetic.write_dataset(tmp_path / "data", 50, 16, views=2)
    pairs = [peer_opensplat.run_pair(binary, dataset)]
    assert peer_opensplat.seconds_a_step(pairs) == pytest.approx([5e-3], rel=0.4)
    binary.write_text("#!/bin/sh\necho no such thing >&2\nexit 3\n")
    with pytest.raises(SystemExit, match="code 3: no such thing"):
        peer_opensplat.run_pair(binary, dataset)


def test_rasterizer_tells_every_stage():
    report = json.loads(call("rasterizer.py", "--sizes", "300x32", "--repeats", "2", "--json"))
    (row,) = report["rows"]
    stages = {"project", "bin", "forward", "backward", "frame"}
    assert set(row["clock"]) == stages < set(row["kernels"])
    assert all(row["kernels"][stage] > 0 for stage in stages)
    assert row["kernels"]["sum"] == pytest.approx(sum(row["kernels"][s] for s in stages - {"frame"}))
    assert {"device", "drjit", "spacesim", "backend"} <= set(report["machine"])
    assert row["pairs"] > 300  # every splat touches a tile, nearly every one of this sphere's front


def test_training_tells_a_step_and_what_was_not_measured():
    output = call("training.py", "--sizes", "300x32", "--repeats", "2", "--markdown")
    assert "| spacesim |" in output
    assert "not measured here: needs the binary" in output


def test_memory_counts_the_parameters_and_their_moments():
    """16,385 rows are just above a power of two, to which Dr.Jit rounds: the most that so many ever take."""
    report = json.loads(call("training.py", "--sizes", "512x32,16385x32", "--memory", "--json"))
    few, many = (row["bytes a Gaussian"] for row in report["memory"])
    parameters = 59 * 4
    # values and two moments are there before and after an update; gradients and statistics beside them
    assert 3 * parameters < few < 12 * parameters
    assert 3 * parameters < many <= 1536


@pytest.mark.parametrize("size", PRESETS)
def test_rows_of_shadows_are_what_they_are_called(size):
    import shadows

    rows = {name: config for kind in shadows.ROWS for name, config in shadows.configurations(kind, size)}
    lit = {name: config for name, config in rows.items() if config.light}
    assert {name for name, config in lit.items() if config.light.field.surface} == {n for n in rows if "surface" in n}
    assert len({repr(config) for config in rows.values()}) == len(rows)
    of_thesis = [config for name, config in lit.items() if "surface" not in name]
    assert {(config.supersample, config.antialiased, config.light.bounce) for config in of_thesis} == {(1, False, 0)}
    if size != "thesis":
        assert rows["map, surface"] == preset(size, "shadow-map")
        assert rows["splat, surface"] == preset(size, "shadow-splat")


def test_shadows_compares_methods_and_goes_on_where_it_stopped(small_lit, tmp_path):
    arguments = "--data", str(small_lit), "--out", str(tmp_path / "runs"), "--preset", "demo", "--iterations", "8"
    first = json.loads(call("shadows.py", *arguments, "--rows", "none", "--json"))
    both = json.loads(call("shadows.py", *arguments, "--rows", "none,map", "--json"))
    assert first["rows"]["Unseen Suns"] == both["rows"]["Unseen Suns"][:1]
    assert [row["method"] for row in both["rows"]["Unseen Suns"]] == ["none", "map"]
    assert both["rows"]["Unseen Suns"][0]["mask error"] == "", "no shadows are predicted"
    assert 0 <= float(both["rows"]["Unseen Suns"][1]["mask error"]) <= 1
    assert (tmp_path / "runs/report.html").exists()


def test_light_tells_frames_and_steps():
    sizes = "--sizes", "300x32", "--step-sizes", "300x32", "--preset", "demo", "--repeats", "2"
    report = json.loads(call("light.py", *sizes, "--methods", "relight,shadow-map", "--json"))
    assert [row["method"] for row in report["frames"]] == ["relight", "shadow-map"]
    assert all(row["frames/s"] > 0 for row in report["frames"])
    assert report["frames"][1]["shadows"] > 0 == report["frames"][0]["shadows"]
    assert len(report["steps"]) == 2


def test_strategies_tells_tables_and_the_figure_and_goes_on_where_it_stopped(small_lit, tmp_path):
    arguments = ["--data", str(small_lit), "--out", str(tmp_path / "runs"), "--preset", "demo", "--method", "vanilla"]
    arguments += ["--iterations", "6", "--figure-steps", "4", "--start-gaussians", "50", "--json"]
    first = json.loads(call("strategies.py", *arguments, "--rows", "default"))
    plot = tmp_path / "figure.svg"
    both = json.loads(call("strategies.py", *arguments, "--rows", "default,mesh-aware,figure", "--plot", str(plot)))
    for title, rows in first["rows"].items():
        assert rows == both["rows"][title][: len(rows)] or title.startswith("Inside")
    pictures = both["rows"]["Pictures (table 5.4)"]
    assert [row["strategy"] for row in pictures] == ["default", "mesh-aware"]
    assert pictures[0]["thesis PSNR"] == "36.3851"
    sizes = both["rows"]["Size and speed (table 5.6)"]
    assert 0 <= float(sizes[1]["refinement [%]"]) <= 100
    for curve in both["curves"].values():
        assert [step for step, _ in curve["inside"]] == [0, 1, 2, 3, 4]
        assert all(0 <= share <= 1 for _, share in curve["inside"])
    root = ElementTree.fromstring(plot.read_text())
    lines = [path for path in root.iter("{http://www.w3.org/2000/svg}path") if "line" in path.get("class", "")]
    assert len(lines) == len(both["curves"]) == 3
