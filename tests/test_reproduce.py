"""`spacesim reproduce`: the thesis's cells, what is shared, all of it at its smallest, interruptions, Ray."""

import importlib.util
import json
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spacesim.data.errors import InputError, WorkError
from spacesim.data.geometry import look_at
from spacesim.data.mesh import read_mesh
from spacesim.data.records import Camera, Frame, Sun
from spacesim.data.store import read_dataset
from spacesim.reproduce import frames, perform
from spacesim.reproduce.experiments import Experiment, check_parts, datasets_for, experiments_for, parts_known
from spacesim.reproduce.figures import frame_times
from spacesim.reproduce.perform import depth_picture, is_fully_lit
from spacesim.reproduce.reproduce import reproduce
from spacesim.reproduce.results import Results, value_of
from spacesim.reproduce.size import FULL, QUICK, REDUCED, Size
from spacesim.reproduce.thesis import Column, best, holds, pairs, parse, thesis

SMALLEST = Size(
    name="smallest",
    **{"resolution": 24, "suns": 2, "views": 6, "known_test_views": 1, "test_suns": 1, "test_views": 1},
    **{"spp": 2, "test_spp": 4, "pair_views": 1, "one_sun_views": 6, "one_sun_test_views": 6},
    **{"telescope_suns": 2, "telescope_views": 2, "telescope_iterations": 5, "iterations": 5},
    **{"figure_steps": 10, "figure_gaussians": 100, "light": "demo", "strategies": "demo", "nerf": "demo"},
    fully_lit_deg=(90.0, 45.0),
    settings={
        **{"init_count": 120, "refinement.max_gaussians": 300, "refinement.refine_start": 2},
        **{"light.field.features": 8, "light.field.width": 16, "light.shadow.size": 16},
        **{"rays": 512, "samples": 4, "coarse.samples": 8, "fine.samples": 4, "occupancy": 8, "chunk": 512},
    },
    geometry=None,
)


def quiet(_title: str, _unit: str) -> Any:
    return nullcontext(lambda *words: None)


def numbers(root: Path) -> Any:
    return json.loads((root / "reproduce.json").read_text())


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """Everything, at the smallest size."""
    root = tmp_path_factory.mktemp("whole")
    reproduce(root, quiet, size=SMALLEST)
    return root


@pytest.mark.parametrize("table", thesis().tables, ids=lambda table: table.number)
def test_the_thesis_s_cells_are_read_and_printed_as_they_stand(table):
    for row in table.rows:
        for column, cell in zip(table.columns, row.cells, strict=True):
            found = parse(cell)
            assert column.cell(found["mean"], found.get("std")) == cell
            assert ("std" in found) == column.spread


@pytest.mark.parametrize("table", thesis().tables, ids=lambda table: table.number)
def test_what_the_thesis_claims_its_own_numbers_say(table):
    columns = {column.metric: column for column in table.columns}
    means = {row.name: table.printed_numbers(row) for row in table.rows}
    assert table.claims
    for claim in table.claims:
        values = {name: found[claim.metric]["mean"] for name, found in means.items()}
        assert holds(columns[claim.metric], values, claim.better, claim.worse), claim


def test_best_and_order_of_a_column():
    lower, near = Column("BER", "shadow.ber", "↓"), Column("Sharpness", "shadow.sharpness_ratio", "→ 1")
    assert best(lower, {"a": 0.2, "b": 0.1, "c": 0.1, "d": None}) == {"b", "c"}
    assert best(lower, {"a": 0.2, "b": None}) == set()
    assert best(near, {"a": 0.2, "b": 1.5}) == {"b"}
    assert holds(near, {"a": 0.2, "b": 1.5}, "b", "a") is True
    assert holds(near, {"a": 0.2, "b": None}, "b", "a") is None
    printed = {"a": 1.0, "b": 2.0, "c": 2.0}  # b and c are equal
    assert pairs(lower, printed, {"a": 5.0, "b": 6.0, "c": 4.0}) == [True, False]
    assert pairs(lower, printed, {"a": None, "b": 6.0, "c": 4.0}) == []


@pytest.mark.parametrize("size", [FULL, REDUCED, QUICK], ids=lambda size: size.name)
def test_tables_share_trainings(size):
    def names(*parts: str) -> set[str]:
        return {one.name for one in experiments_for(size, parts, 1)}

    assert names("4.4") == names("4.5") == names("4.6") == names("4.7")
    assert names("5.4") == names("5.5") == names("5.6")
    assert names("4.4") & names("5.4") >= {"thesis-shadow-map"}
    whole = experiments_for(size, parts_known(), 1)
    assert {one.name for one in whole} == set().union(*(names(part) for part in parts_known()))
    assert len({one.name for one in whole}) == len(whole) == (20 if size is QUICK else 21)
    relit = next(one for one in whole if one.name == "thesis-relight")
    assert isinstance(relit, Experiment)
    assert set(relit.parts) == {"own", "pair", "suns", "one-sun"}
    assert len(experiments_for(size, ("4.4",), 3)) == 3 * len(names("4.4"))
    assert datasets_for(size, ("4.7",), experiments_for(size, ("4.7",), 1)) == ["boxsat", "pair"]
    assert datasets_for(size, ("figure-6.1",), ()) == ["telescope"]


def test_full_trainings_are_the_presets_own():
    configs = {one.name: one.config for one in experiments_for(FULL, parts_known(), 1)}
    assert configs["thesis-shadow-map"].iterations == 200_000
    assert configs["telescope"].refinement.refine_stop == 40_000
    assert {configs[name].preset for name in configs if name.startswith("fine")} == {"fine"}


def test_reduced_trainings_are_the_presets_with_shorter_schedules():
    configs = {one.name: one.config for one in experiments_for(REDUCED, parts_known(), 1)}
    found = {config.iterations for name, config in configs.items() if not name.startswith("figure")}
    assert found == {10_000}
    assert configs["thesis-shadow-map"].refinement.refine_stop == 7_500
    assert configs["telescope"].refinement.refine_stop == 8_000


def test_the_quick_ones_have_its_settings_where_there_are_such_fields():
    configs = {one.name: one.config for one in experiments_for(QUICK, parts_known(), 1)}
    found: dict[str, set[Any]] = {key: set() for key in QUICK.settings}
    for name, config in configs.items():
        for key in QUICK.settings if not name.startswith("figure") else ():
            first, _, last = key.rpartition(".")
            record = getattr(config, first, None) if first else config
            if hasattr(record, last):
                found[key].add(getattr(record, last))
    assert found == {key: {value} for key, value in (QUICK.settings | {"refinement.refine_stop": 400}).items()}
    assert {config.iterations for name, config in configs.items() if not name.startswith("figure")} == {500}


def test_fully_lit_views_have_the_sun_behind_the_camera():
    def frame(azimuth: float, elevation: float) -> Frame:
        camera = Camera.from_fov(look_at(5 * Sun.from_angles(azimuth, elevation).direction, np.zeros(3)), 8, 8, 30)
        return Frame("a.png", camera, Sun.from_angles(350, 10))

    assert is_fully_lit(frame(350, 10), (30, 15))
    assert is_fully_lit(frame(19, -4), (30, 15)), "29 degrees across north"
    assert not is_fully_lit(frame(21, 10), (30, 15))
    assert not is_fully_lit(frame(350, 26), (30, 15))
    assert not is_fully_lit(replace(frame(350, 10), sun=None), (30, 15))


def test_depth_is_drawn_on_the_truth_s_scale():
    np.testing.assert_array_equal(depth_picture(np.array([[0, 2, 4, 9]]), 2, 4), [[0, 255, 51, 51]])


def test_cells_are_found_in_metrics():
    tables = {table.number: table for table in thesis().tables}
    group = {"mae": {"mean": 1.0, "std": 2.0, "count": 3}, "lpips": None}
    metrics = {
        "known_suns": {"image": group},
        "unseen_suns": None,
        "objects": [{"name": "first", "image": {}}, {"name": "second", "image": {"mae": {"mean": 5.0, "std": 6.0}}}],
        "geometry": {"chamfer": 0.5},
        "model": {"gaussians": 7, "bytes": 2_500_000, "render_ms": 4.0},
    }
    assert value_of(metrics, tables["4.4"], "image.mae", "known_suns") == (1, 2)
    assert value_of(metrics, tables["4.4"], "image.lpips", "known_suns") is None
    assert value_of(metrics, tables["4.4"], "image.mae", "unseen_suns") is None
    assert value_of(metrics, tables["4.6"], "image.mae", "") == (5, 6)
    assert value_of(metrics, tables["5.5"], "geometry.chamfer", "") == (0.5, None)
    found = [value_of(metrics, tables["5.6"], column.metric, "") for column in tables["5.6"].columns]
    assert found == [(7, None), (2.5, None), (0.004, None), (250, None)]


def test_everything_is_on_one_page(whole):
    values, text = numbers(whole), (whole / "reproduce.html").read_text()
    assert {one["state"] for one in values["experiments"]} == {"finished"}
    for table in thesis().tables:
        assert f"Table {table.number}" in text
        for row in table.rows:
            assert all(cell in text for cell in row.cells)
    for name in ("3.2", "4.2", "s 4.3 and 4.4", "5.5", "6.1", "6.2"):
        assert f"<h2>Figure{name if name.startswith('s') else f' {name}'}</h2>" in text
    assert "Not run" not in text
    assert "not run" not in text
    metrics = json.loads((whole / "experiments/thesis-shadow-map/own/metrics.json").read_text())
    cell = values["tables"][0]["metrics"][2]["rows"][1]["cells"]["thesis_unseen"]
    assert cell["mean"] == metrics["unseen_suns"]["image"]["psnr"]["mean"]
    assert f"{cell['mean']:.4f}" in text
    lit = values["figures"]["figure-4.3"]["rows"][0]
    assert 0 < lit["frames"][0] < lit["frames"][1] == 6
    splats, field = values["figures"]["figure-3.2"]["rows"]
    for row in (splats, field):
        assert row["frames"]["models"] == [1, 2, 3, 4, 5]
        assert (row["frames"]["pixels"], row["frames"]["views"]) == ([24, 24], 6)
        assert min(row["frames"]["ms"]) > 0
    assert field["times"][4] == field["frames"]["ms"][4] / splats["frames"]["ms"][4]
    assert "around 400 ×" in text
    assert f"{field['frames']['ms'][4]:,.1f} ms" in text
    for curve in values["figures"]["figure-5.5"]["rows"]:
        assert curve["gaussians"] == SMALLEST.figure_gaussians
        assert [step for step, _ in curve["inside"]] == list(range(11))


def test_all_models_of_figure_3_2_are_in_the_picture_and_apart(whole):
    dataset = read_dataset(whole / "data/one-sun")
    vertices, _ = read_mesh(dataset.root / dataset.mesh_path)
    boxes = [(vertices.min(axis=0) + place, vertices.max(axis=0) + place) for place in frames.places(dataset)]
    for one, (low, high) in enumerate(boxes):
        assert all((low >= other[1]).any() or (high <= other[0]).any() for other in boxes[one + 1 :])
    for frame, near in zip(frames.views(dataset), dataset.test, strict=False):
        np.testing.assert_array_equal(frame.camera.world_from_camera[:3, :3], near.camera.world_from_camera[:3, :3])
        for place in frames.places(dataset):
            x, y, z = frame.camera.camera_from_world[:3] @ np.c_[vertices + place, np.ones(len(vertices))].T
            assert z.min() > 0
            assert max(abs(x / z).max(), abs(y / z).max()) * frame.camera.fx <= 12


def test_ratios_are_of_one_device(whole, tmp_path):
    for name in ("one-sun", "one-sun-nerf"):
        (tmp_path / "experiments" / name).mkdir(parents=True)
        (tmp_path / "experiments" / name / "frames").symlink_to(whole / "experiments" / name / "frames")
    there = Results(tmp_path, SMALLEST, 1).frames()
    assert there[0]["times"] == [1] * 5
    path = tmp_path / "experiments/one-sun-nerf/frames"
    values = json.loads((path / "frames.json").read_text()) | {"device": "another"}
    path.unlink()
    assert "radiance field: not run" in frame_times(tmp_path, Results(tmp_path, SMALLEST, 1).frames())
    path.mkdir()
    (path / "frames.json").write_text(json.dumps(values))
    rows = Results(tmp_path, SMALLEST, 1).frames()
    assert rows[1]["times"] is None
    assert "; radiance field: 24 × 24 pixels, median of 6 views, another" in frame_times(tmp_path, rows)
    assert "radiance field / Gaussians" not in frame_times(tmp_path, rows)


def test_what_is_finished_is_not_done_again(whole, monkeypatch):
    before = {path: path.stat().st_mtime_ns for path in whole.glob("experiments/**/*") if path.is_file()}
    for word in ("trained", "evaluated", "draw_suns", "follow", "time_frames"):
        monkeypatch.setattr(perform, word, None)
    reproduce(whole, quiet, ["5.6", "figure-6.1"], SMALLEST, resume=True)
    assert {path: path.stat().st_mtime_ns for path in whole.glob("experiments/**/*") if path.is_file()} == before
    assert numbers(whole)["parts"] == ["5.6", "figure-6.1"]
    reproduce(whole, quiet, (), SMALLEST, resume=True)


def test_a_folder_of_something_else_is_refused(whole, tmp_path):
    with pytest.raises(InputError, match="expected a new folder, found a reproduction; resume=True"):
        reproduce(whole, quiet, (), SMALLEST)
    with pytest.raises(InputError, match="expected a folder of the size 'full', found 'smallest'"):
        reproduce(whole, quiet, (), FULL, resume=True)
    other = replace(SMALLEST, spp=3)
    with pytest.raises(InputError, match="with the scenes and trainings of this version, found one with others"):
        reproduce(whole, quiet, (), other, resume=True)
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(InputError, match="found other files in it"):
        reproduce(tmp_path, quiet, (), SMALLEST)
    with pytest.raises(InputError, match=r"^tables: expected some of 4\.4, .*, found '4\.8'"):
        check_parts(["4.8"])


def test_an_interruption_loses_no_more_than_a_checkpoint_does(whole, tmp_path):
    counted = []

    @contextmanager
    def stopping(_title: str, unit: str) -> Any:
        def tell(done: int, _total: int, _words: str) -> None:
            counted.append(done)
            if unit == "steps" and done == 7:
                raise KeyboardInterrupt

        yield tell

    with pytest.raises(KeyboardInterrupt):
        reproduce(tmp_path, stopping, ["figure-5.5"], SMALLEST)
    assert "Not run" in (tmp_path / "reproduce.html").read_text()
    counted.clear()
    with pytest.raises(KeyboardInterrupt):
        reproduce(tmp_path, stopping, ["figure-5.5"], SMALLEST, resume=True)
    assert counted == [6, 7], "from the checkpoint of step 6 on"
    reproduce(tmp_path, quiet, ["figure-5.5"], SMALLEST, resume=True)
    assert numbers(tmp_path)["figures"]["figure-5.5"] == numbers(whole)["figures"]["figure-5.5"]


def test_a_failed_training_is_reported_and_tried_again(whole, tmp_path, monkeypatch):
    (tmp_path / "data").symlink_to(whole / "data")
    (tmp_path / "size.json").write_bytes((whole / "size.json").read_bytes())

    def fail(*_given: Any) -> None:
        raise WorkError("the loss is not finite")

    with monkeypatch.context() as broken:
        broken.setattr(perform, "trained", fail)
        with pytest.raises(WorkError, match="1 experiments failed, telescope the first"):
            reproduce(tmp_path, quiet, ["figure-6.2"], SMALLEST, resume=True)
    assert numbers(tmp_path)["experiments"][0]["reason"] == "the loss is not finite"
    assert "failed: the loss is not finite" in (tmp_path / "reproduce.html").read_text()
    (tmp_path / "experiments/telescope/run").symlink_to(whole / "experiments/telescope/run")
    reproduce(tmp_path, quiet, ["figure-6.2"], SMALLEST, resume=True)
    assert numbers(tmp_path)["figures"] == {"figure-6.2": numbers(whole)["figures"]["figure-6.2"]}


def test_ray_finds_the_same_numbers(whole, tmp_path):
    if importlib.util.find_spec("ray") is None:
        pytest.skip("the extra 'cluster' is not installed")
    reproduce(tmp_path, quiet, ["figure-6.2"], SMALLEST, ray="local")
    assert numbers(tmp_path)["figures"] == {"figure-6.2": numbers(whole)["figures"]["figure-6.2"]}
    assert not list(tmp_path.glob("experiments/*/progress.json"))


def test_the_command_line(spacesim, tmp_path, monkeypatch):
    assert spacesim("reproduce", "4.9", "--out", tmp_path / "a").is_refusal("4.9", "4.4")
    assert spacesim("reproduce", "--out", tmp_path / "a", "--seeds", 0).is_refusal("--seeds")
    called: list[Any] = []
    monkeypatch.setattr("spacesim.reproduce.reproduce.reproduce", lambda *given: called.append(given) or given[0])
    done = spacesim("reproduce", "4.4", "figure-5.5", "--quick", "--resume", "--seeds", 2, "--out", tmp_path / "a")
    assert (done.code, done.output.strip()) == (0, str(tmp_path / "a"))
    assert called[0][2:] == (["4.4", "figure-5.5"], QUICK, True, None, 2)
    assert spacesim("reproduce", "--reduced", "--out", tmp_path / "a").code == 0
    assert called[1][3] is REDUCED
    assert spacesim("reproduce", "--reduced", "--quick", "--out", tmp_path / "a").is_refusal("--quick", "--reduced")
