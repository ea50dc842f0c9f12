import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spacesim.data.errors import InputError
from spacesim.data.store import read_points, verify_dataset
from spacesim.scenes import GenerateConfig, built_in_scene, generate

SMALL = GenerateConfig(views=4, test_views=2, resolution=24, spp=4, points=300)


def contents(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("made") / "data"
    generate("boxsat", root, SMALL)
    return root


def test_dataset_is_whole(made):
    assert verify_dataset(made) == []
    files = set(contents(made))
    assert {
        "transforms.json",
        "scene.json",
        "mesh.ply",
        "points.ply",
        "gt/train_00003.exr",
        "id/test_00001.png",
    } <= files


def test_scene_json_holds_what_renders_it_again(made):
    scene = json.loads((made / "scene.json").read_text())
    assert scene["scene"] == "boxsat"
    assert scene["config"] == json.loads(json.dumps(SMALL.__dict__))
    assert {
        "schema",
        "objects",
        "parts",
        "materials",
        "sun_irradiance",
        "exposure",
        "backend",
        "versions",
    } <= set(scene)
    assert {part["material"] for part in scene["parts"]} == set(scene["materials"])
    assert [part["id"] for part in scene["parts"]] == list(range(1, len(scene["parts"]) + 1))


def test_points_lie_on_the_surface_and_have_its_colours(made):
    points, colors = read_points(made / "points.ply")
    mesh = built_in_scene("boxsat").mesh
    assert points.shape == (300, 3)
    _, distance, _ = mesh.nearest.on_surface(points[:60])
    assert distance.max() < 1e-5
    assert len(np.unique(colors, axis=0)) >= 5


def test_same_seed_gives_the_same_bytes_and_another_does_not(made, tmp_path):
    generate("boxsat", tmp_path / "again", SMALL)
    generate("boxsat", tmp_path / "other", replace(SMALL, seed=1))
    again, other, first = contents(tmp_path / "again"), contents(tmp_path / "other"), contents(made)
    assert again == first
    assert set(other) == set(first)
    assert [name for name in first if first[name] == other[name]] == ["mesh.ply"]


def test_resume_gives_the_same_bytes(made, tmp_path):
    root = tmp_path / "data"
    generate("boxsat", root, SMALL)
    for name in ("transforms.json", "gt/train_00002.exr", "images/test_00001.png", "points.ply"):
        (root / name).unlink()
    calls: list[tuple[int, int, str]] = []
    generate("boxsat", root, SMALL, resume=True, progress=lambda *call: calls.append(call))
    assert contents(root) == contents(made)
    assert [call[:2] for call in calls] == [(i, 6) for i in range(1, 7)]


def test_killed_run_is_completed(tmp_path):
    config = replace(SMALL, views=60)
    root = tmp_path / "killed"
    code = (
        "from pathlib import Path; import sys; from spacesim.scenes import GenerateConfig, generate;"
        f"generate('boxsat', Path(sys.argv[1]), {config!r})"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(root)])
    while len(list(root.glob("gt/*.exr"))) < 3:
        assert process.poll() is None, "it should have been killed before its end"
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not (root / "transforms.json").exists()
    assert verify_dataset(root) != []
    generate("boxsat", root, config, resume=True)
    generate("boxsat", tmp_path / "whole", config)
    assert contents(root) == contents(tmp_path / "whole")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"views": 0}, "views: expected at least 1, found 0"),
        ({"suns": 0}, "suns: "),
        ({"test_views": -1}, "test_views: "),
        ({"resolution": 7}, "resolution: expected at least 8, found 7"),
        ({"spp": 0}, "spp: "),
        ({"seed": -1}, "seed: "),
        ({"max_depth": 1}, "max_depth: "),
        ({"points": 0}, "points: "),
        ({"sun": ((0.0, 91.0),)}, "sun: .* found 0.0,91.0"),
        ({"sun": ((float("nan"), 0.0),)}, "sun: "),
        ({"sun": ((1.0, 2.0),), "suns": 2}, "suns: expected 1 as in sun, found 2"),
        ({"fov_deg": 0.0}, "fov_deg: "),
        ({"distance": -1.0}, "distance: "),
        ({"exposure": 0.0}, "exposure: "),
    ],
)
def test_bad_options_are_named(changes, message):
    with pytest.raises(InputError, match=message):
        replace(SMALL, **changes)


def test_bad_scene_folder_and_camera_are_refused(made, tmp_path):
    with pytest.raises(InputError, match="expected one of boxsat"):
        generate("nosuch", tmp_path / "a", SMALL)
    with pytest.raises(InputError, match="distance: expected cameras outside of boxsat"):
        generate("boxsat", tmp_path / "b", replace(SMALL, distance=0.3))
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match="--resume"):
        generate("boxsat", made, SMALL)
    with pytest.raises(InputError, match="'config' differs"):
        generate("boxsat", made, replace(SMALL, spp=5), resume=True)
