"""The benchmarks: what they compute of their measurements, and that they run and tell what they say they do."""

import importlib.util
import json
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from unittest.mock import ANY, patch
from xml.etree import ElementTree

import numpy as np
import pytest
from tiny import Outcome, captured, outcome

from spacesim import backend
from spacesim.data.errors import InputError, WorkError
from spacesim.data.geometry import look_at
from spacesim.data.images import linear_from_srgb, load_image, read_png, write_png
from spacesim.data.importers.writing import ImportedFrame, write_dataset
from spacesim.data.records import Camera, Dataset, Frame, Sun
from spacesim.data.store import read_dataset, read_points
from spacesim.eval.align import align
from spacesim.splat import sun_search
from spacesim.splat.compose.aligned import moved_frame
from spacesim.splat.compose.pose import Pose
from spacesim.splat.train.config import PRESETS, preset
from spacesim.splat.train.pictures import suns
from spacesim.splat.train.train import train

FOLDER = Path(__file__).parents[1] / "benchmarks"
RUNS: dict[str, list[list[str]]] = {}  #: of each script, the arguments that tests run it with
SVG = "{http://www.w3.org/2000/svg}"


def smallest(*commands: str) -> pytest.MarkDecorator:
    """Marks the test of scripts' commands at their smallest size: the test gets each as `command`, split."""
    split = [shlex.split(command) for command in commands]
    for script, *words in split:
        RUNS.setdefault(script, []).append(words)
    return pytest.mark.parametrize("command", split, ids=lambda words: words[0])


def test_every_script_runs_in_a_test():
    scripts = {path.name for path in FOLDER.glob("*.py") if 'if __name__ == "__main__":' in path.read_text()}
    assert set(RUNS) == scripts


@pytest.fixture(scope="module", autouse=True)
def _importable():
    sys.path.insert(0, str(FOLDER))
    yield
    sys.path.remove(str(FOLDER))


@pytest.fixture
def place(tmp_path, monkeypatch) -> Path:
    """The working directory of a script."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def ended(command: list[str]) -> Outcome:
    """How a script ends in this process; one of its own would take longer to start than to do its work."""
    script, *words = command
    path = str(FOLDER / script)

    def run(arguments: list[str]) -> None:
        with patch.object(sys, "argv", arguments):
            runpy.run_path(path, run_name="__main__")

    return captured(run, [path, *words])


def ended_alone(command: list[str]) -> Outcome:
    """How a script ends that measures its own process, or starts others."""
    script, *words = command
    done = subprocess.run([sys.executable, str(FOLDER / script), *words], capture_output=True, text=True)
    return outcome(done.returncode, done.stdout, done.stderr)


def call(command: list[str], ended: Callable[[list[str]], Outcome] = ended) -> str:
    done = ended(command)
    assert done.code == 0, done.errors
    return done.output


@pytest.fixture(scope="module")
def small_lit(tmp_path_factory) -> Path:
    """A path-traced dataset of two Suns and one never seen."""
    from spacesim.scenes.generation.generate import generate
    from spacesim.scenes.scenefile import read_scene

    root = tmp_path_factory.mktemp("lit") / "data"
    generate(read_scene("boxsat", suns=2, views=2, test_suns=1, test_views=1, resolution=(24, 24), spp=4), root)
    return root


def test_rows_are_named_with_commas_in_them():
    from support import common

    assert common.row_names("none,map, no bias,ours") == ["none", "map, no bias", "ours"]


def points_of(time):
    from support import growth

    sizes = [(1_000, 64, 3_000), (10_000, 64, 20_000), (100_000, 64, 150_000), (10_000, 256, 60_000)]
    return [growth.Point(n, side, pairs, time(n, side, pairs)) for n, side, pairs in sizes]


@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
def test_slope_is_the_exponent(power):
    from support import growth

    assert growth.slope(points_of(lambda n, side, pairs: 3 * pairs**power)) == pytest.approx(power)


def test_linear_model_finds_the_parts_it_is_made_of_and_its_own_failure():
    from support import growth

    linear = points_of(lambda n, side, pairs: 0.5 + 40e-6 * pairs + 7e-6 * n + 2e-6 * side**2)
    parts, worst = growth.model(linear)
    assert list(parts.values()) == pytest.approx([0.5, 40, 7, 2], rel=1e-6)
    assert worst < 1e-9
    assert growth.model(points_of(lambda n, side, pairs: 1e-9 * pairs**2))[1] > 0.3


def test_plot_has_a_mark_for_each_measurement():
    from support import growth

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
    from support import common

    timing = common.Timing.of(np.arange(1, 10) * 1e-3)
    assert (timing.low, timing.median, timing.high, timing.least) == pytest.approx((3, 5, 7, 1))
    table = common.table([{"a": 1_000, "b": 0.5}, {"a": 2, "b": "x"}], markdown=True)
    assert [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()] == [
        ["a", "b"], ["----:", "---:"], ["1,000", "0.50"], ["2", "x"]
    ]  # fmt: skip


@pytest.mark.parametrize("text", ["12", "axb", "100x0", "1x2x3", ""])
def test_sizes_that_are_none_are_refused(text):
    from support import common

    with pytest.raises(InputError, match="--sizes: expected"):
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
    import training
    from support import common

    monkeypatch.setattr(sys, "argv", ["training.py", *arguments])
    with pytest.raises(SystemExit, match="2"):
        common.run_main(training.main)
    assert sentence in capsys.readouterr().err


def test_measurements_are_printed_before_an_unwritable_file_fails(tmp_path, monkeypatch, capsys):
    import rasterizer
    from support import common

    (tmp_path / "file").write_text("")
    for option in ("--json", "--plot"):
        where = str(tmp_path / "file" / "x")
        monkeypatch.setattr(sys, "argv", ["rasterizer.py", "--sizes", "100x16", "--repeats", "1", option, where])
        with pytest.raises(SystemExit, match="2"):
            common.run_main(rasterizer.main)
        printed = capsys.readouterr()
        assert "Kernels, ms" in printed.out
        assert f"{where}: cannot be written" in printed.err


def stand_in(path: Path, start: float, step: float) -> Path:
    """A program that takes OpenSplat's arguments, sleeps, seconds, and writes a file."""
    script = f"import sys, time\nn = int(sys.argv[sys.argv.index('-n') + 1])\ntime.sleep({start} + {step} * n)\n"
    script += "open(sys.argv[sys.argv.index('-o') + 1], 'w').write('ply')\n"
    path.write_text(f"#!{sys.executable} -IS\n{script}")
    path.chmod(0o755)
    return path


def test_opensplat_is_timed_without_its_start(tmp_path):
    """A program that needs half a second to start and 5 ms a step."""
    from support import peer_opensplat, synthetic

    binary = stand_in(tmp_path / "opensplat", start=0.5, step=0.005)
    dataset = synthetic.write_dataset(tmp_path / "data", 50, 16, views=2)
    pairs = [peer_opensplat.run_pair(binary, dataset)]
    assert peer_opensplat.seconds_a_step(pairs) == pytest.approx([5e-3], rel=0.4)
    binary.write_text("#!/bin/sh\necho no such thing >&2\nexit 3\n")
    with pytest.raises(WorkError, match="code 3: no such thing"):
        peer_opensplat.run_pair(binary, dataset)
    binary.write_text("#!/bin/sh\nexit 0\n")
    with pytest.raises(WorkError, match="has written no splats"):
        peer_opensplat.run_pair(binary, dataset)


@smallest("rasterizer.py --backend llvm --sizes 300x32 --repeats 2 --json")
def test_rasterizer_tells_every_stage(command):
    report = json.loads(call(command))
    (row,) = report["rows"]
    stages = {"project", "bin", "forward", "backward", "frame"}
    assert set(row["clock"]) == stages < set(row["kernels"])
    assert all(row["kernels"][renderer] > 0 for renderer in stages)
    assert row["kernels"]["sum"] == pytest.approx(sum(row["kernels"][s] for s in stages - {"frame"}))
    assert {"device", "drjit", "spacesim", "backend"} <= set(report["machine"])
    assert row["pairs"] > 300  # every splat touches a tile, nearly every one of this sphere's front


@smallest(
    "rasterizer.py --backend llvm --sizes 300x32,600x32 --repeats 1 --growth --plot growth.svg --peers fastergs"
    " --markdown --json found.json"
)
def test_rasterizer_tells_growth_and_goes_on_without_its_peer(command, place):
    done = ended(command)
    assert done.code == 0
    assert done.errors == ["fastergs: not measured here (fastergs runs on CUDA alone)"]
    assert "| Gaussians | pixels |" in done.output
    report = json.loads((place / "found.json").read_text())
    assert report["growth"]["slope"] == pytest.approx(slope_of(report["rows"], lambda row: row["least kernels"]))
    assert len(list(ElementTree.parse(place / "growth.svg").iter(f"{SVG}circle"))) == 2


def test_a_peers_kernels_and_ours_are_by_one_profiler():
    """A frame that takes ours half of the peer's by it, whatever Dr.Jit says; none where the profiler sees nothing."""
    import rasterizer
    from support.common import Timing

    clock = {"frame": Timing.of([3e-3])}
    peer = {"clock": {"frame": Timing.of([4e-3])}, "kernels": {"frame": 2.0}, "our kernels": {"frame": 1.0}}
    ours = {"gaussians": 7, "pixels": 8, "clock": clock, "kernels": {"frame": 9.0}, "peers": {"other": peer}}
    peer["ratios"] = rasterizer.ratios(ours, peer)
    peer["apart"] = rasterizer.apart(np.zeros((3, 2, 2)), np.full((3, 2, 2), 2e-4))
    assert rasterizer.peer_row(ours, "other")["pictures apart (99.9 %)"] == "0.0002"
    assert peer["ratios"] == pytest.approx({"frame, clock": 0.75, "frame, kernels": 0.5})
    assert rasterizer.peer_row(ours, "other")["frame, kernels"] == "1.00 / 2.00"
    unseen = {**peer, "our kernels": {"frame": None}}
    assert rasterizer.ratios(ours, unseen) == pytest.approx({"frame, clock": 0.75})
    ours["peers"]["other"] = unseen
    assert rasterizer.peer_row(ours, "other")["frame, kernels"] == "- / 2.00"


@smallest(
    "schedule.py --out out --data DATA --methods vanilla --strategy mesh-aware --preset demo --iterations 110 --views 1"
    " --svg curve.svg --backend llvm --json"
)
def test_a_schedule_is_followed_and_goes_on(command, place, small_lit):
    (place / "DATA").symlink_to(small_lit)
    rows = json.loads(call(command))["rows"]
    assert [row["iteration"] for row in rows] == [50, 100, 110]
    assert all(row["Gaussians"] > 0 and 0 < row["PSNR, unseen Suns"] < 60 for row in rows)
    assert len(list(ElementTree.parse(place / "curve.svg").iter(f"{SVG}path"))) >= 1
    scores = place / "out/vanilla-mesh-aware/kept/step_00000100_1_views.json"
    scores.unlink()
    assert json.loads(call(command))["rows"] == rows
    scores.write_text("{}")  # of so many views alone
    more = ["2" if before == "--views" else word for before, word in zip(["", *command], command, strict=False)]
    assert json.loads(call(more))["rows"] == rows, "there is but one test view"


def slope_of(rows, time_of):
    (first, last), pairs = [time_of(row) for row in rows], [row["pairs"] for row in rows]
    return np.log(last / first) / np.log(pairs[1] / pairs[0])


@pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="torch is not installed")
@smallest("torch_door.py --backend llvm --sizes 300x32 --repeats 2 --peers gsplat --json")
def test_torch_door_tells_both_ways_and_goes_on_without_its_peer(command):
    done = ended(command)
    assert done.code == 0, done.errors
    assert done.errors == ["gsplat: not measured here (gsplat runs on CUDA alone)"]
    report = json.loads(done.output)
    (row,) = report["rows"]
    assert row["torch / own"] == pytest.approx(row["torch, ms"] / row["own, ms"])
    assert min(row["torch, ms"], row["own, ms"]) > 0
    assert report["differences"] == []


@smallest("async_lists.py --backend llvm --sizes 300x32 --methods vanilla,shadow-map --preset demo --repeats 2 --json")
def test_both_ways_to_lists_are_measured(command):
    rows = json.loads(call(command))["rows"]
    assert [row["method"] for row in rows] == ["vanilla", "shadow-map"]
    for row in rows:
        assert min(row[f"{what}, async / wait"] for what in ("in a row", "host", "alone")) > 0
        assert row["again"] == 0


@smallest("training.py --backend llvm --sizes 300x32 --repeats 2 --markdown")
def test_training_tells_a_step_and_what_was_not_measured(command):
    output = call(command)
    assert "| spacesim |" in output
    assert "not measured here: needs the binary" in output


@smallest("training.py --backend llvm --sizes 300x32,600x32 --repeats 1 --growth --plot step.svg --json found.json")
def test_training_tells_growth(command, place):
    call(command)
    report = json.loads((place / "found.json").read_text())
    expected = slope_of(report["rows"], lambda row: row["clock"]["spacesim"]["least"])
    assert report["growth"]["slope"] == pytest.approx(expected)
    assert len(list(ElementTree.parse(place / "step.svg").iter(f"{SVG}circle"))) == 2


@smallest(
    "training.py --backend llvm --sizes 300x32 --repeats 1 --peers fastergs --opensplat ./opensplat --markdown"
    " --json found.json"
)
def test_training_beside_opensplat(command, place):
    """A program that needs 0.1 s to start and 2 ms a step."""
    stand_in(place / "opensplat", start=0.1, step=0.002)
    done = ended(command)
    assert done.code == 0, done.errors
    assert done.errors == ["fastergs: not measured here (fastergs runs on CUDA alone)"]
    (row,) = json.loads((place / "found.json").read_text())["opensplat"]
    assert row["OpenSplat"]["median"] == pytest.approx(2, rel=0.5)
    assert row["ours / theirs"] == pytest.approx(row["spacesim"]["median"] / row["OpenSplat"]["median"])


@smallest("training.py --backend llvm --sizes 300x32 --repeats 2 --profile --markdown --json found.json")
def test_profile_tells_stages_and_floors(command, place):
    call(command)
    (profile,) = json.loads((place / "found.json").read_text())["profiles"]
    *parts, step, clock = profile["rows"]
    assert [row["stage"] for row in parts] == ["project", "bin", "forward", "loss", "backward", "update", "rest"]
    assert sum(row["ms"] for row in parts) == pytest.approx(step["ms"])
    assert min(row["ms"] for row in (*parts[:-1], step, clock)) > 0
    bandwidth = profile["device"]["bandwidth"]
    assert 1e8 < bandwidth < 1e13
    # of 300 Gaussians 59 parameters with two moments, read and written, seven gradients and two statistics
    assert parts[5]["floor by bytes, ms"] == pytest.approx(1e3 * 300 * 4 * (6 * 59 + 9) / bandwidth)
    assert all(row["floor by operations, ms"] > 0 for row in parts if row["stage"] in ("forward", "loss", "backward"))


@smallest("training.py --backend llvm --steps 200 --json")
def test_counters_over_steps(command):
    rows = json.loads(call(command, ended_alone))["steps"]
    assert [row["step"] for row in rows] == list(range(20, 201, 20))
    recordings = [row["recordings so far"] for row in rows]
    assert recordings[0] > 0
    assert recordings == sorted(recordings)
    for row in rows:
        assert row["kernels a step"] >= 1
        assert 2_000 * 59 * 3 * 4 / 1e6 < row["arrays' peak, MB"] < row["process, MB"]  # parameters and two moments


@smallest("training.py --sizes 512x32,16385x32,31200x32 --memory --markdown --json found.json")
def test_memory_counts_the_parameters_and_their_moments(command, place):
    """16,385 rows are just above a power of two, to which Dr.Jit rounds: the most that so many ever take. Where there
    is a CUDA device, those of 31,200 are moved at once."""
    call(command, ended_alone)
    report = json.loads((place / "found.json").read_text())
    few, *many = (row["bytes a Gaussian"] for row in report["memory"])
    parameters = 59 * 4
    # values and two moments are there before and after an update; gradients and statistics beside them
    assert 3 * parameters < few < 12 * parameters
    assert 3 * parameters < min(many) < max(many) <= 1536


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


@smallest(
    "shadows.py --backend llvm --data DATA --out RUNS --preset demo --seed 1 --iterations 8 --no-geometry"
    " --rows none,map"
)
def test_shadows_compares_methods_and_goes_on_where_it_stopped(command, small_lit, place):
    (place / "DATA").symlink_to(small_lit)
    first = json.loads(call([*command[:-1], "none", "--json"]))
    both = json.loads(call([*command, "--json"]))
    assert first["rows"]["Unseen Suns"] == both["rows"]["Unseen Suns"][:1]
    assert [row["method"] for row in both["rows"]["Unseen Suns"]] == ["none", "map"]
    assert both["rows"]["Unseen Suns"][0]["mask error"] == "", "no shadows are predicted"
    assert 0 <= float(both["rows"]["Unseen Suns"][1]["mask error"]) <= 1
    assert [0 < float(row["normals"]) < 180 for row in both["rows"]["Materials"]] == [True, True]
    assert (place / "RUNS/report.html").exists()


@smallest(
    "suns.py --out OUT --pictures 8 --suns 2,8 --resolution 32 --samples 16 --preset demo --iterations 6 --seeds 2"
    " --backend llvm --json"
)
def test_suns_compares_the_same_number_of_pictures(command, place):
    rows = json.loads(call(command))["rows"]
    assert [(row["Suns"], row["views of each"]) for row in rows] == [(2, 4), (8, 1)]
    for row, suns_of_row in zip(rows, (2, 8), strict=True):
        train = read_dataset(place / f"OUT/data-{suns_of_row}").train
        assert len(train) == 8
        assert len({tuple(frame.sun.direction) for frame in train}) == suns_of_row
        assert 0 < row["PSNR"] < 40
        assert row["PSNR, deviation"] >= 0
        assert 0 <= row["BER"] <= 1
    unseen = {tuple(frame.sun.direction) for frame in read_dataset(place / "OUT/unseen").test}
    assert len(unseen) == 8
    assert not unseen & {tuple(frame.sun.direction) for frame in read_dataset(place / "OUT/data-8").train}


@smallest(
    "exposures.py --out OUT --suns 2 --views 2 --resolution 32 --samples 4 --preset demo --iterations 3 --seeds 2"
    " --rows '0 EV, radiance,varied, as if alike,varied, given, linear' --backend llvm --json"
)
def test_exposures_vary_and_are_named_where_the_rows_say_so(command, place):
    rows = json.loads(call(command))["rows"]
    assert [row.pop("pictures, trained on") for row in rows] == [
        "0 EV, radiance",
        "varied, as if alike",
        "varied, given, linear",
    ]
    for row in rows:
        assert len(row) == 16
        assert min(row.values()) >= 0
    same, named, hidden = (read_dataset(place / "OUT" / name) for name in ("0 EV", "varied", "varied, not named"))
    factors = np.array([frame.exposure for frame in named.train]) / named.scene["exposure"]
    assert np.ptp(np.log2(factors)) > 0.5
    assert np.log2(factors).mean() == pytest.approx(0, abs=1e-9)
    assert {frame.exposure for frame in (*same.train, *named.test, *hidden.train)} == {None}
    for k in (factors.argmin(), factors.argmax()):
        images = [load_image(data, data.train[k]) for data in (same, named, hidden)]
        once, varied, other = (linear_from_srgb(image.rgb) for image in images)
        np.testing.assert_array_equal(varied, other)
        bright = (once.min(axis=2) > 0.02) & (np.maximum(once, varied).max(axis=2) < 0.98) & (images[0].alpha == 1)
        assert np.median(varied[bright] / once[bright]) == pytest.approx(factors[k], rel=0.05)


@smallest(
    "scenes.py --out OUT --craft cubesat,lander --suns 2 --views 2 --resolution 32 --samples 4 --preset demo"
    " --iterations 6 --seeds 2 --backend llvm --json"
)
def test_scenes_compare_methods_on_each_craft(command, place):
    rows = {row["craft"]: row for row in json.loads(call(command))["rows"]}
    assert list(rows) == ["cubesat", "lander"]
    for craft, row in rows.items():
        data = read_dataset(place / f"OUT/{craft}/data")
        assert (len(data.train), len(data.test)) == (4, 44)
        assert row["PSNR"] - row["no shadows"] == pytest.approx(row["gain"], abs=2e-4)
        known, unseen = (
            np.mean([report(place, craft, seed)[part]["image"]["psnr"]["mean"] for seed in range(2)])
            for part in ("known_suns", "unseen_suns")
        )
        assert (unseen, known - unseen) == pytest.approx((row["PSNR"], row["gap"]), abs=2e-4)
        assert row["gain, deviation"] >= 0
    assert len(read_dataset(place / "OUT/lander/data").scene["parts"]) > 20


def report(place: Path, craft: str, seed: int) -> dict:
    """metrics.json of a training with shadows."""
    return json.loads((place / f"OUT/{craft}/shadow-splat-{seed}/eval/metrics.json").read_text())


@smallest(
    "light.py --backend llvm --sizes 300x32 --step-sizes 300x32 --preset demo --repeats 2 --methods relight,shadow-map"
    " --markdown --json found.json"
)
def test_light_tells_frames_and_steps(command, place):
    call(command)
    report = json.loads((place / "found.json").read_text())
    assert [row["method"] for row in report["frames"]] == ["relight", "shadow-map"]
    assert all(row["frames/s"] > 0 for row in report["frames"])
    assert report["frames"][1]["shadows"] > 0 == report["frames"][0]["shadows"]
    assert len(report["steps"]) == 2


@smallest(
    "strategies.py --backend llvm --data DATA --out RUNS --preset demo --method vanilla --iterations 6"
    " --start-gaussians 50 --rows default,mesh-aware"
)
def test_strategies_tells_tables_and_goes_on_where_it_stopped(command, small_lit, place):
    (place / "DATA").symlink_to(small_lit)
    first = json.loads(call([*command[:-1], "default", "--json"]))
    both = json.loads(call([*command, "--json"]))
    for title, rows in first["rows"].items():
        assert rows == both["rows"][title][: len(rows)]
    pictures = both["rows"]["Pictures (table 5.4)"]
    assert [row["strategy"] for row in pictures] == ["default", "mesh-aware"]
    sizes = both["rows"]["Size and speed (table 5.6)"]
    assert 0 <= float(sizes[1]["refinement [%]"]) <= 100


@pytest.fixture(scope="module")
def small_pair(tmp_path_factory) -> Path:
    """Path-traced pictures of two boxsats, the first before the Sun of the second."""
    from spacesim.scenes.generation.generate import generate
    from spacesim.scenes.scenefile import read_scene

    root = tmp_path_factory.mktemp("pair") / "data"
    size = {"views": 1, "test_suns": 0, "test_views": 2, "resolution": 32, "spp": 16}
    generate(read_scene("boxsat-pair", sun=[(45.0, 35.0)], **size), root)
    return root


COMPOSITION = "composition.py --backend llvm --out RUNS --rows none,none-shaded --run none=RUN --preset demo --markdown"


@smallest(
    f"{COMPOSITION} --views 2 --resolution 32 --no-geometry --json found.json",
    f"{COMPOSITION} --pair PAIR --no-geometry --json found.json",
)
def test_composition_tells_both_tables(command, tiny_run, small_pair, place):
    (place / "RUN").symlink_to(tiny_run)
    (place / "PAIR").symlink_to(small_pair)
    output = call(command)
    found = json.loads((place / "found.json").read_text())
    for which in ("first", "second"):
        rows = found["rows"][f"The {which} boxsat, Sun (45, 35)"]
        assert [row["row"] for row in rows] == ["none", "none-shaded"]
    second = found["rows"]["The second boxsat, Sun (45, 35)"]
    assert float(second[1]["PSNR"]) > float(second[0]["PSNR"])
    assert "none-shaded" in output
    assert (place / "RUNS/pairs/report.html").exists()
    assert "PAIR" in command or len(read_dataset(place / "RUNS/pair").test) == 2


DATASET = "dataset.py --backend llvm --resolution 16 --spp 1"


@smallest(f"{DATASET} --views 7 --workers 1,2 --markdown --json found.json")
def test_dataset_tells_ways_and_ratios(command, place):
    start = time.monotonic()
    output = call(command, ended_alone)
    lasted = 1e3 * (time.monotonic() - start)
    report = json.loads((place / "found.json").read_text())
    assert report["machine"]["backend"] == "llvm"
    rows = {row["way"]: row for row in report["rows"]}
    ways = ["mi.render", "radiance", "radiance and labels", "labels", "written"]
    assert list(rows) == [*ways, "written, 2 processes"]
    found = {way: rows[way]["ms a frame"] for way in ways}
    for way, timing in found.items():
        assert 0 < timing["least"] <= timing["low"] <= timing["median"] <= timing["high"], way
        assert rows[way]["frames/s"] == pytest.approx(1e3 / timing["median"])
        assert re.search(rf"\| +{way} \| +[\d.]+ \([\d.]+ to [\d.]+\) \|", output)
    assert 7 * sum(timing["least"] for timing in found.values()) < lasted
    assert found["written"]["low"] < found["written"]["high"]  # of several rounds
    assert rows["written, 2 processes"]["ms a frame"] > 0
    assert report["written_to_raw"] > 0
    labels = found["radiance and labels"]["median"] / found["radiance"]["median"] - 1
    assert report["labels_to_radiance"] == pytest.approx(labels)


@smallest(f"{DATASET} --views 1 --json")
def test_dataset_tells_of_one_frame(command):
    report = json.loads(call(command, ended_alone))
    raw, written = (report["rows"][row]["ms a frame"]["median"] for row in (0, -1))
    assert report["written_to_raw"] == pytest.approx(raw / written)  # of the same round


@smallest("dataset.py --backend llvm --frames 20 --json")
def test_dataset_tells_memory_on_the_way(command):
    rows = json.loads(call(command, ended_alone))["memory"]
    assert [row["frames"] for row in rows] == list(range(2, 21, 2))
    assert all(one["seconds"] < other["seconds"] for one, other in pairwise(rows))
    largest = 1024 * int(re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())[1]) / 1e6
    assert all(20 < row["MB"] < 20 * largest for row in rows)


def test_dataset_measures_the_same_pictures():
    """Mitsuba's own rendering and ours show the same, so that their times can be compared."""
    import dataset

    from spacesim.scenes.scene import load

    renderer, job, shots = dataset.planned("boxsat", views=1, resolution=(24, 24), spp=256)
    mi, loaded, shot = backend.mitsuba(), load(job.scene), shots[0]
    loaded.point(shot.sun)
    integrator = mi.load_dict({"type": "path", "max_depth": job.quality.max_depth, "hide_emitters": True})
    view = dataset.sensor(shot.camera, loaded.units)
    theirs = np.array(mi.render(loaded.sunlit, sensor=view, integrator=integrator, spp=256))[..., :3]
    ours, _ = renderer.radiance(shot.camera, shot.sun, (0, 0))
    assert ours.mean() == pytest.approx(theirs.mean(), rel=0.03)
    assert np.corrcoef(ours.ravel(), theirs.ravel())[0, 1] > 0.98


def test_frames_count_from_when_the_kernels_are_there():
    import dataset

    def names(*pauses: float):
        for pause in pauses:
            time.sleep(pause)
            yield "name"

    assert dataset.seconds_a_frame(names(0.2, 0.2, 0.02, 0.02, 0.02), 2) == pytest.approx(0.02, rel=0.6)
    assert dataset.seconds_a_frame(names(0.2, 0.02, 0.02, 0.2, 0.2), 1, after=2) == pytest.approx(0.02, rel=0.6)
    with pytest.raises(InputError, match="--views: expected at least 2 with"):
        dataset.seconds_a_frame(iter("abcd"), before=4)


@smallest(
    "nerf.py --backend llvm --out OUT --data DATA --preset demo --iterations 8 --rays 512 --pixels 24 --repeats 2"
    " --splats --peers nerfacc --json"
)
def test_a_radiance_field_is_trained_and_drawn_without_its_peer(command, place, tiny_data):
    (place / "DATA").symlink_to(tiny_data)
    done = ended(command)
    assert done.code == 0, done.errors
    assert "nerfacc: not measured here (nerfacc runs on CUDA alone)" in done.errors
    report = json.loads(done.output)
    row, splats = report["training"]
    assert row["step, ms"] > 0
    for model in (row, splats):
        assert 5 < model["over the silhouette"] < model["PSNR"] < 60
    (mixed,) = report["mixed"]
    assert mixed["PSNR"] > 5
    assert 0 <= mixed["off by a tenth, %"] <= 100
    assert [frame["models"] for frame in report["frames"]] == [1, 3]
    assert all(frame["frame, ms"] > 0 for frame in report["frames"])


@smallest("pose.py --backend llvm --out OUT --data DATA --run RUN --views 2 --starts 1 --seed 1 --json")
def test_pose_tells_errors_before_and_after(command, tiny_data, tiny_run, place):
    (place / "DATA").symlink_to(tiny_data)
    (place / "RUN").symlink_to(tiny_run)
    report = json.loads(call(command))
    assert list(report["views"]) == ["traced, alpha", "traced, black sky", "the model's own"]
    for views in report["views"].values():
        assert len(views) == 2
        for view in views:
            assert view["before"] == pytest.approx([5, 5])
    for row in report["rows"]:
        assert 0 <= row["within 0.5 deg, 0.5 %"] <= 1
        assert row["median, deg"] <= row["90th, deg"]
        assert row["s a view"] > 0


@smallest("pose_refinement.py --backend llvm --out OUT --views 4 --resolution 24 --iterations 30 --degrees 2 --json")
def test_pose_refinement_tells_errors_and_gauge(command, place):
    rows = {row["cameras"]: row for row in json.loads(call(command))["rows"]}
    assert list(rows) == ["true", "off by 2, refined", "off by 2", "true, refined"]
    assert rows["true"]["off, deg"] == pytest.approx(0, abs=1e-6)
    assert (rows["off by 2"]["off, deg"], rows["off by 2"]["off, %"]) == pytest.approx((2, 2))
    assert 0 < rows["true, refined"]["off, deg"] < 5
    assert all(row["PSNR, dB"] > 5 for row in rows.values())
    assert [name for name, row in rows.items() if row["aligned, dB"] != row["PSNR, dB"]] == [
        "off by 2, refined",
        "true, refined",
    ]


@smallest("background.py DATA --backend llvm --preset demo --iterations 8 --json")
def test_background_tells_both(command, small_lit, place):
    (place / "DATA").symlink_to(small_lit)
    rows = json.loads(call(command))
    assert set(rows) == {"random", "black"}
    assert rows["random"] != rows["black"]
    for row in rows.values():
        assert 0 <= row["alpha outside"] < row["alpha inside"] <= 1
        assert 0 <= row["holes"] <= 1
        assert 5 < row["psnr over black"] < 60


def test_background_of_a_model_that_shows_nothing(small_lit):
    import background
    from support import common

    from spacesim.splat.raster.gaussians import Gaussians

    data = read_dataset(small_lit)
    unseen = Gaussians.from_numpy({**common.sphere_arrays(10), "logit_opacities": np.full(10, -20.0)})
    inside, outside, holes, *psnr = background.measured_errors(unseen, data)
    assert (inside, outside, holes) == (0, 0, 1)
    pictures = [load_image(data, frame).over(np.zeros(3)) for frame in data.test]
    light = [load_image(data, frame).over(np.ones(3)) for frame in data.test]
    errors = [[np.mean(p**2) for p in pictures], [np.mean((1 - p) ** 2) for p in light]]
    assert psnr == pytest.approx([np.mean(-10 * np.log10(error)) for error in errors], rel=1e-5)


@smallest("against_gsplat.py picture", "against_gsplat.py training --data DATA --iterations 2")
def test_against_gsplat_says_what_it_needs(command):
    if importlib.util.find_spec("gsplat") is not None:
        pytest.skip("gsplat is installed: tests/splat/raster/test_gsplat.py compares")
    done = ended(command)
    assert (done.code, done.output) == (2, "")
    (said,) = done.errors
    assert re.fullmatch(r"gsplat: expected gsplat 1.5 and torch with CUDA, found none \(.*\)", said)


@smallest("html_page.py RUN --backend llvm --seconds 0.5 --size 120x90 --suns 2 --json")
def test_the_page_tells_its_size_its_speed_and_how_near_it_is(command, tiny_run, place):
    if shutil.which("chromium") is None:
        pytest.skip("there is no Chromium to drive")
    (place / "RUN").symlink_to(tiny_run)
    report = json.loads(call(command, ended))
    assert report["page"]["Gaussians"] == 300
    assert 0.03 < report["page"]["MB"] < 0.3
    assert len(report["rates"]) == 3
    assert min(row["frames/s"] for row in report["rates"]) > 0
    assert len(report["suns"]) == 2
    assert report["means"]["page against render, dB"] > 30
    assert report["worst_loss"] < 1.5


@smallest("materials.py RUN --backend llvm --json")
def test_materials_are_compared_part_by_part(command, tiny_data, place):
    train(read_dataset(tiny_data), place / "RUN", replace(preset("demo", "relight"), iterations=20, init_count=200))
    report = json.loads(call(command, ended))
    rows = {row["part"]: row for row in report["parts"]}
    bus, radiator = rows["bus"], rows["radiator"]
    assert (bus["material"], bus["true metal"], bus["true roughness"]) == ("gold-mli", 1, 0.12)
    assert (radiator["true metal"], radiator["true roughness"]) == (0, 0.4)
    assert min(row["pixels"] for row in report["parts"]) >= 20
    assert all(0 <= row["metal"] <= 1 for row in report["parts"])
    metals = [row for row in report["parts"] if row["true metal"]]
    right = sum(row["pixels"] * row["metal"] for row in metals) / sum(row["pixels"] for row in metals)
    assert report["told"]["metals"] == pytest.approx(right, abs=0.01)
    assert 0 <= report["told"]["others"] <= 1
    assert all(value is None or -1 <= value <= 1 for value in report["rank"].values())
    assert report["rank"]["albedo"] is not None


@smallest(
    "viewer.py --backend llvm --gaussians 200 --side 64 --repeats 1 --moving 0.5 --seconds 1 --clients 1 --json",
    "viewer.py RUN --backend llvm --side 64 --repeats 1 --moving 0.5 --seconds 0 --json",
    "viewer.py FIELD --backend llvm --side 64 --repeats 1 --moving 0.8 --seconds 0 --json",
)
def test_viewer_tells_pictures_rates_and_memory(command, tiny_run, tiny_field, place):
    pytest.importorskip("viser", reason="viser is not installed")
    for name, run in (("RUN", tiny_run), ("FIELD", tiny_field)):
        (place / name).symlink_to(run)
    report = json.loads(call(command, ended_alone))
    assert report["gaussians"] == (300 if "RUN" in command else 0 if "FIELD" in command else 200)
    pictures = {row["picture"]: float(row["ms"].split()[0]) for row in report["draw"]}
    assert {"colour, another camera", "depth, another camera", "colour, another Sun"} < set(pictures)
    assert min(pictures.values()) > 0
    assert [row["mode"] for row in report["rates"]] == ["colour", "depth", "ellipsoids"][: 3 - ("FIELD" in command)]
    for row in report["at_rest"]:
        first, refined = (float(row[key].split()[0]) for key in ("first", "in full resolution"))
        assert 0 < first <= refined
    assert len(report["at_rest"]) == ("FIELD" in command)
    for row in report["rates"]:
        assert float(row["frames/s"]) > 0
        assert 0 < float(row["of full resolution"]) <= 1
    if "RUN" in command or "FIELD" in command:
        assert report["soak"] == {}
    else:
        kept = [float(size) for size in report["soak"]["MiB kept after each tenth"].split(", ")]
        assert report["soak"]["frames"] > 0
        assert 20 < max(kept) < report["soak"]["MiB at most"] + 20


@smallest("visitor.py URL --seconds 1.5 --clients 2 --side 64")
def test_visitors_get_pictures(command, tiny_run):
    pytest.importorskip("viser", reason="viser is not installed")
    from spacesim.viewer.load import load_setup
    from spacesim.viewer.server import Viewer

    viewer = Viewer(load_setup(tiny_run), port=0)
    viewer.start()
    try:
        counts = json.loads(call([word.replace("URL", viewer.url) for word in command]))["pictures"]
    finally:
        viewer.stop()
    assert len(counts) == 2
    assert min(counts) > 0
    gone = ended([word.replace("URL", viewer.url) for word in command])
    assert (gone.code, gone.output) == (2, "")
    (said,) = gone.errors
    assert re.fullmatch(rf"{viewer.url}: expected the address of a viewer, found none \(.*\)", said)


@smallest(
    "attack.py --inputs 8 --kills 1 --bits 2 --viewer 0.1 --seed 5 --processes 1 --json", "attack.py --seed 5 --trial 7"
)
def test_attack_tells_what_was_tried_and_held(place, command):
    printed = call(command)
    if "--trial" in command:
        assert printed.startswith("7 ")
        assert printed.splitlines()[-1] == "None"
        return
    found = json.loads(printed)
    assert (found["seed"], found["finds"]) == (5, [])
    tried = {row[""]: row["tried"] for row in found["rows"]}
    assert tried["the viewer"] > 10
    assert tried == {"damaged inputs, command lines": 8, "kills and signals": 1, "flipped bits": 2, "the viewer": ANY}
    assert all(row["held"] == row["tried"] for row in found["rows"])


@smallest("speedplus_data.py --out data --frames 4 --height 30 --spp 2 --backend llvm --json")
def test_data_like_speedplus_have_suns_only_in_the_labels(command, place):
    import speedplus_data

    report = json.loads(call(command))
    assert (report["frames"], report["size"]) == (5, [48, 30])
    made = speedplus_data.make(place / "data", 4, 30, spp=2)  # all there
    assert made.data.scene == {}
    assert len({tuple(frame.sun.direction) for frame in made.made.frames}) == 5
    for truth, frame, labelled in zip(made.made.frames, made.data.frames, made.labelled.frames, strict=True):
        assert frame.sun is None
        assert frame.silhouette_path is None
        assert frame.file_path == labelled.file_path
        np.testing.assert_allclose(labelled.sun.direction, truth.sun.direction, atol=1e-15)
        np.testing.assert_allclose(frame.camera.world_from_camera, truth.camera.world_from_camera, atol=1e-12)
        np.testing.assert_array_equal(frame.camera.world_from_camera, labelled.camera.world_from_camera)
        assert (load_image(made.data, frame).alpha == 1).all()
        assert load_image(made.labelled, labelled).alpha.min() == 0


@smallest(
    "earth.py --out OUT --suns 3 --views 2 --resolution 24 --spp 2 --method relight --preset demo"
    " --iterations 2 --seed 1 --backend llvm --json"
)
def test_the_earths_light_is_told_from_the_suns(command, place):
    without, known = json.loads(call(command))["rows"]
    assert (without["the Earth"], without["predicted"]) == ("without", 0)
    assert without["of earthlight"] > 20
    assert known["predicted"] > 0
    assert known["earthlight, true"] == without["earthlight, true"] > 1e-5


@smallest(
    "unknown_suns.py --out OUT --frames 8 --height 30 --spp 2 --preset demo --iterations 2 --rows known,unknown,vanilla"
    " --backend llvm --json"
)
def test_unknown_suns_are_compared_with_true_ones(command, place, monkeypatch):
    for module in (sun_search, suns):  # a lattice of few Suns
        monkeypatch.setattr(module, "SPHERE", 24)
    rows = {row["Suns"]: row for row in json.loads(call(command))["rows"]}
    assert list(rows) == ["known", "unknown", "vanilla"]
    assert 0 <= rows["unknown"]["Sun off, deg"] <= 180
    assert all(5 < row["PSNR, dB"] < 60 for row in rows.values())
    assert 5 < rows["unknown"]["PSNR, told"] < 60


def test_errors_of_suns(tmp_path):
    """Two Suns that are right and two a quarter turn off, the less sure ones."""
    import unknown_suns

    true = [(0, 0), (10, 20), (30, 40), (50, 60)]
    frames = tuple(Frame("a.png", Camera.from_fov(np.eye(4), 4, 4, 40), sun=Sun.from_angles(*pair)) for pair in true)
    found = [Sun.from_angles(*true[0]), Sun.from_angles(*true[1])]
    found += [Sun.from_angles(azimuth, elevation - 90) for azimuth, elevation in true[2:]]
    estimated = [
        {"sun_direction": sun.direction.tolist(), "sun_sigma_deg": sigma}
        for sun, sigma in zip(found, (1, 2, 9, 30), strict=True)
    ]
    (tmp_path / "cameras.json").write_text(json.dumps({"frames": estimated}))
    row = unknown_suns.sun_errors(tmp_path / "cameras.json", Dataset(tmp_path, frames, ()))
    assert (row["mean"], row["Sun off, deg"], row["of the surer half, deg"]) == pytest.approx((45, 45, 0), abs=1e-4)
    assert (row["at most 8 deg, %"], row["over 60 deg, %"], row["sigma, deg"]) == (50, 50, 5.5)


def test_noise_like_speedpluss_is_that_of_the_full_size_averaged():
    """A grey of 0.5 keeps its mean; black, where half of the noise is cut off, shows sigma / sqrt(2 pi)."""
    import speedplus_data

    sigma = 255 * np.sqrt(speedplus_data.VARIANCE)
    grey, black = (np.full((150, 240), value, np.uint8) for value in (128, 0))
    noisy = speedplus_data.degraded(grey, (0, 1)).astype(np.float64)
    assert noisy.mean() == pytest.approx(128, abs=0.1)
    assert noisy.std() == pytest.approx(np.hypot(sigma / 8, np.sqrt(1 / 12)), rel=0.03)
    assert speedplus_data.degraded(black, (0, 1)).mean() == pytest.approx(sigma / np.sqrt(2 * np.pi), abs=0.15)
    np.testing.assert_array_equal(noisy, speedplus_data.degraded(grey, (0, 1)))
    full = speedplus_data.degraded(np.full((1200, 1920), 128, np.uint8), (0, 1))
    assert full.std() == pytest.approx(sigma, rel=0.02)


@pytest.mark.skipif(
    not all(map(importlib.util.find_spec, ("av", "pycolmap"))), reason="PyAV or pycolmap is not installed"
)
@smallest("video_import.py --backend llvm --out OUT --width 64 --frames 8 --spp 1 --iterations 5 --json")
def test_video_import_tells_what_cannot_be_found(command, place):
    """At this size there is nothing to be matched; what is found is tested with the importer."""
    rows = json.loads(call(command))["rows"]
    assert [row["field of view"] for row in rows] == ["given", "estimated"]
    assert all("expected" in row["note"] for row in rows)
    assert (place / "OUT" / "film.mp4").stat().st_size > 1000


def test_a_film_is_compared_with_its_own_frames(tmp_path):
    """An import that lacks two frames of a film and has its own axes, scale, masks and split."""
    import video_import

    rng = np.random.default_rng(0)
    places = [12 * np.array([np.cos(a), np.sin(a), 0.1 * a]) for a in np.linspace(0, 1.5, 12)]
    cameras = [Camera.from_fov(look_at(place, np.zeros(3)), 8, 6, 40) for place in places]
    silhouettes = [(255 * (rng.uniform(size=(6, 8)) > 0.5)).astype(np.uint8) for _ in cameras]
    colors = rng.integers(0, 256, (2, 12, 6, 8, 3), np.uint8)  # as traced, as in the film
    frames = []
    for k, camera in enumerate(cameras):
        frames.append(Frame(f"images/{k}.png", camera, silhouette_path=f"silhouette/{k}.png"))
        write_png(tmp_path / "film" / frames[k].file_path, colors[0, k])
        write_png(tmp_path / "film" / str(frames[k].silhouette_path), silhouettes[k])
    film = [(Dataset(tmp_path / "film", tuple(frames), ()), frame) for frame in frames]
    inside = Pose(look_at([1.0, 2.0, 3.0], np.zeros(3))[:3, :3], [4.0, 5.0, 6.0], 0.25)  # of the truth in the import
    imported = [
        ImportedFrame(
            f"frame_{k:06d}",
            lambda k=k: np.dstack([colors[1, k], 255 - silhouettes[k]]),
            moved_frame(frame, inside).camera,
            keys={"source_index": k},
        )
        for k, frame in enumerate(frames)
        if k not in (0, 5)
    ]
    points = rng.normal(size=(7, 3))
    cloud = inside.points(points), np.zeros((7, 3), np.uint8)
    report = {"structure.json": b'{"pictures": 12, "reprojection_error_px": 0.5, "points": 7}'}
    own = write_dataset(tmp_path / "own", imported, None, {}, cloud, report)
    row = video_import.compared(own, film)
    assert row["registered"] == pytest.approx(10 / 12)
    assert row["% largest"] == pytest.approx(0, abs=1e-9)
    assert row["length, % off"] == pytest.approx(75)
    assert row["mask IoU"] == 0
    true = video_import.true_dataset(tmp_path / "true", own, film)
    assert (
        [f.file_path for f in true.test]
        == [f.file_path for f in own.test]
        == [
            "images/frame_000001.png",
            "images/frame_000010.png",
        ]
    )
    seen = video_import.seen_by(own, true)
    for frame, of_truth, of_import in zip(seen.test, true.test, own.test, strict=True):
        assert frame.file_path == of_truth.file_path
        np.testing.assert_array_equal(frame.camera.world_from_camera, of_import.camera.world_from_camera)
    for split, source in ((true.train, colors[1]), (true.test, colors[0])):
        for frame in split:
            number = int(frame.file_path[-6:-4])
            np.testing.assert_allclose(frame.camera.world_from_camera, cameras[number].world_from_camera, atol=1e-12)
            pixels = read_png(true.root / frame.file_path)
            np.testing.assert_array_equal(pixels, np.dstack([source[number], silhouettes[number]]))
    np.testing.assert_allclose(read_points(true.root / "points.ply")[0], points, atol=1e-5)
    found = align(own, true)
    assert (found.cameras, found.matched_by) == (10, "source_index in transforms.json")
    np.testing.assert_allclose(found.pose.matrix, inside.inverse().matrix, atol=1e-9)


@smallest("serve.py --backend llvm --gaussians 300 --side 32 --spp 1 --repeats 2 --requests 50 --json")
def test_serve_loses_no_request(command):
    pytest.importorskip("zmq", reason="pyzmq is not installed")
    report = json.loads(call(command))
    served = [(row["served"], row["the Sun"]) for row in report["rows"]]
    assert served == [("sphere0", "stays"), ("sphere0", "moves"), ("boxsat, 1 samples", "stays")]
    assert all(row["pictures/s"] > 0 for row in report["rows"])
    (many,) = report["many"]
    assert many["answered"] == many["requests"] == 50


@smallest("pose_basin.py --backend llvm --out OUT --data DATA --run RUN --views 1 --searched 1 --seed 1 --json")
def test_pose_basin_tells_each_case(command, tiny_data, tiny_run, place, monkeypatch):
    monkeypatch.setattr("spacesim.splat.pose.search.DIRECTIONS", 30)
    monkeypatch.setattr("spacesim.splat.pose.refine.CANDIDATES", 4)
    (place / "DATA").symlink_to(tiny_data)
    (place / "RUN").symlink_to(tiny_run)
    report = json.loads(call(command))
    cases = [row["case"] for row in report["rows"]]
    assert cases[:4] == [f"angle {angle} deg, range 5 %" for angle in (5, 10, 20, 40)]
    assert "searched" in cases
    assert cases[-1].startswith("phase ")
    for row in report["rows"]:
        assert 0 <= row["found"] <= 1
        assert 0 <= row["wrong of converged"] <= 1
