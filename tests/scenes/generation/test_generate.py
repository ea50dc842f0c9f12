import json
import os
import shutil
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from forks import Forked
from tiny import contents

from spacesim.data.errors import InputError, WorkError
from spacesim.data.lock import lock_folder
from spacesim.data.store import FrameWriter, find_unreadable_files, load_depth, load_truth, read_points
from spacesim.scenes.build import build
from spacesim.scenes.cameras.sensor import SensorConfig
from spacesim.scenes.cameras.sphere_rigs import RandomRig
from spacesim.scenes.config import ObjectConfig
from spacesim.scenes.generation.generate import _DatasetPlan, estimate, generate, generate_part
from spacesim.scenes.generation.lighting import is_sunlit
from spacesim.scenes.generation.moves import warn_of_objects_inside
from spacesim.scenes.scenefile import read_scene
from spacesim.scenes.trajectory.rig import PoseRig

SMALL = {"views": 4, "test_views": 2, "resolution": (24, 24), "spp": 4, "points": 300}


def boxsat(**changes):
    return read_scene("boxsat", **{**SMALL, **changes})


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("made") / "data"
    generate(boxsat(), root)
    return root


def test_dataset_is_whole(made):
    assert find_unreadable_files(made) == []
    files = set(contents(made))
    top = {"transforms.json", "scene.json", "mesh.ply", "points.ply", "contact_sheet.png", "camera_density.png"}
    top |= {"keypoints.json"}
    top |= {"SHA256SUMS"}
    assert top | {"gt/train_00003.exr", "id/test_00001.png"} <= files
    assert len(files) == len(top) + 6 * 6


def test_test_views_have_four_times_the_samples_by_default(made, tmp_path):
    cleaner = tmp_path / "cleaner"
    generate(boxsat(spp=16, test_spp=16), cleaner)
    for name in ("gt/test_00000.exr", "gt/test_00001.exr"):
        assert (made / name).read_bytes() == (cleaner / name).read_bytes()
    assert (made / "gt/train_00000.exr").read_bytes() != (cleaner / "gt/train_00000.exr").read_bytes()
    scene = json.loads((made / "scene.json").read_text())
    assert (scene["spp"], scene["test_spp"]) == (4, 16)


def test_scene_json_holds_what_renders_it_again(made):
    scene = json.loads((made / "scene.json").read_text())
    assert scene["scene"] == "boxsat"
    assert scene["config"] == json.loads(json.dumps(boxsat().to_json()))
    known = {"schema", "objects", "parts", "materials", "mesh", "sun_irradiance", "exposure", "backend", "versions"}
    assert known <= set(scene)
    assert {part["material"] for part in scene["parts"]} == set(scene["materials"])
    assert [part["id"] for part in scene["parts"]] == list(range(1, len(scene["parts"]) + 1))


def test_points_lie_on_the_surface_and_have_its_colors(made):
    points, colors = read_points(made / "points.ply")
    mesh = build(boxsat()).mesh
    assert points.shape == (300, 3)
    _, distance, _ = mesh.nearest.on_surface(points[:60])
    assert distance.max() < 1e-5
    assert len(np.unique(colors, axis=0)) >= 4


def test_same_seed_gives_the_same_bytes_and_another_does_not(made, tmp_path):
    generate(boxsat(), tmp_path / "again")
    generate(boxsat(seed=1), tmp_path / "other")
    again, other, first = contents(tmp_path / "again"), contents(tmp_path / "other"), contents(made)
    assert again == first
    assert set(other) == set(first)
    assert [name for name in first if first[name] == other[name]] == ["keypoints.json", "mesh.ply"]


def test_resume_gives_the_same_bytes(made, tmp_path):
    root = tmp_path / "data"
    shutil.copytree(made, root)
    for name in ("transforms.json", "gt/train_00002.exr", "images/test_00001.png", "points.ply"):
        (root / name).unlink()
    (root / "id/.train_00000.png.1234.part").write_bytes(b"left by a killed process")
    calls: list[tuple[int, int, str]] = []
    generate(boxsat(), root, resume=True, progress=lambda *call: calls.append(call))
    assert contents(root) == contents(made)
    assert calls[0][:2] == (4, 6)  # whole already
    assert calls[1:] == [(5, 6, "train_00002"), (6, 6, "test_00001")]


@pytest.mark.parametrize("victim", ["gt/train_00001.exr", "depth/train_00001.png"])
@pytest.mark.parametrize("damage", ["cut", "empty", "zeros", "longer"])
def test_a_damaged_file_is_not_whole(made, tmp_path, victim, damage):
    root = tmp_path / "data"
    shutil.copytree(made, root)
    assert FrameWriter(root).has_frame("train_00001")
    whole = (root / victim).read_bytes()
    # a power cut can leave the size without the bytes: zeros in the last block
    bad = {"cut": whole[:-1], "empty": b"", "zeros": bytes(len(whole)), "longer": whole + b"\0"}
    (root / victim).write_bytes(bad[damage])
    assert not FrameWriter(root).has_frame("train_00001")
    generate(boxsat(), root, resume=True)
    assert (root / victim).read_bytes() == whole


def test_the_headers_of_a_large_exr_are_found_beyond_the_first_block(tmp_path):
    """Tall pictures have chunk tables longer than the block that is read first."""
    from spacesim.data.images import write_exr
    from spacesim.data.integrity.whole import is_whole

    path = tmp_path / "tall.exr"
    write_exr(path, dict.fromkeys(("depth", "alpha"), np.zeros((16 * 10_000, 1), np.float32)))
    assert is_whole(path)
    path.write_bytes(path.read_bytes()[:-1])
    assert not is_whole(path)


def test_killed_run_is_completed(tmp_path):
    """Killed twice, at other frames each time."""
    config = boxsat(views=16, test_views=0)
    root = tmp_path / "killed"
    code = (
        "from pathlib import Path; import sys; from spacesim.scenes.scenefile import read_scene;"
        "from spacesim.scenes.generation.generate import generate;"
        f"generate(read_scene('boxsat', **{ {**SMALL, 'views': 16, 'test_views': 0}!r}), Path(sys.argv[1]), True)"
    )
    for frames in (2, 6):
        process = Forked(["-c", code, root])
        while len(list(root.glob("gt/*.exr"))) < frames:
            assert process.poll() is None, "it should have been killed before its end"
            time.sleep(0.002)
        os.kill(process.pid, signal.SIGKILL)
        process.communicate()
    assert not (root / "transforms.json").exists()
    assert find_unreadable_files(root) != []
    generate(config, root, resume=True)
    generate(config, tmp_path / "whole")
    assert contents(root) == contents(tmp_path / "whole")


def test_the_first_error_of_a_writing_thread_ends_the_run(tmp_path, monkeypatch):
    done: list[str] = []

    def full(_, name, *rest):
        if name == "train_00002":
            raise WorkError("the disk is full")
        done.append(name)

    monkeypatch.setattr(FrameWriter, "write_frame", full)
    with pytest.raises(WorkError, match="the disk is full"):
        generate(boxsat(views=80), tmp_path / "data")
    assert 2 <= len(done) < 40
    assert not (tmp_path / "data/transforms.json").exists()


def test_far_views_have_depth_too(tmp_path, caplog):
    """In coarser steps, of which transforms.json tells; near ones keep millimetres."""
    far = read_scene("boxsat", views=2, test_views=1, resolution=24, spp=1, distance=300.0, fov_deg=1.0, points=20)
    dataset = generate(far, tmp_path / "far")
    assert dataset.depth_unit == 0.005
    for frame in dataset.frames:
        truth = load_truth(dataset, frame)
        assert truth.depth.max() > 295
        np.testing.assert_allclose(load_depth(dataset, frame), truth.depth, atol=0.0026)
    assert not [record for record in caplog.records if "depth/" in record.getMessage()]
    very_far = read_scene("boxsat", views=1, test_views=0, resolution=8, spp=1, distance=4e5, fov_deg=0.001, points=1)
    assert generate(very_far, tmp_path / "very-far").depth_unit == 10
    assert len([record for record in caplog.records if "are coarse for" in record.getMessage()]) == 1


def test_an_object_within_another_is_noted(tmp_path, caplog):
    small = {"views": 1, "test_views": 0, "resolution": 8, "spp": 1, "points": 20}
    around = boxsat(**small)
    within = replace(around, objects=(ObjectConfig("cubesat"), *around.objects))
    generate(within, tmp_path / "within")
    assert caplog.messages == ["generate: most of object 1 (cubesat) lies within object 2 (boxsat)"]
    caplog.clear()
    out, beside = np.eye(4), np.eye(4)
    out[0, 3], beside[0, 3] = 0.8, 5.0  # metres: its larger part sticks out; they do not touch
    scene = build(replace(around, objects=(*around.objects, ObjectConfig("cubesat", position=(5.0, 0.0, 0.0)))))
    for pose in (out, beside):
        warn_of_objects_inside(scene, {2: pose})
    warn_of_objects_inside(scene, {})
    assert not caplog.messages
    warn_of_objects_inside(scene, {2: np.eye(4)})
    assert caplog.messages == ["generate: most of object 2 (cubesat) lies within object 1 (boxsat) in the first frame"]


def test_keypoints_lie_beside_the_mesh(made):
    (body,) = json.loads((made / "keypoints.json").read_text())["objects"]
    assert (body["id"], body["name"], len(body["keypoints"])) == (1, "boxsat", 11)
    _, distance, _ = build(boxsat()).mesh.nearest.on_surface(list(body["keypoints"].values()))
    assert distance.max() < 1e-5


def test_a_sensors_raw_pictures_are_part_of_a_frame(tmp_path):
    for monochrome, suffixes in ((True, [""]), (False, ["_b", "_g", "_r"])):
        root = tmp_path / f"mono{monochrome}"
        config = boxsat(views=1, test_views=0, sensor=SensorConfig(monochrome=monochrome))
        generate(config, root)
        raw = sorted((root / "raw").iterdir())
        assert [path.name for path in raw] == [f"train_00000{suffix}.png" for suffix in suffixes]
        whole = contents(root)
        raw[0].unlink()
        generate(config, root, resume=True)
        assert contents(root) == whole


def test_estimate_leaves_nothing_behind_and_is_near_what_is_needed(made, tmp_path):
    found = estimate(boxsat(), tmp_path / "data")
    assert not list(tmp_path.iterdir())
    taken = sum(-(-path.stat().st_size // 4096) * 4096 for path in made.glob("*/*"))
    assert found.frames == 6
    assert found.needed == pytest.approx(taken, rel=0.1)
    assert found.seconds > 0
    assert estimate(boxsat(), made).frames == 0


def test_a_long_run_begins_with_an_estimate_and_ends_where_the_disk_is_too_small(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(sys.modules["spacesim.scenes.generation.generate"], "LONG", 5)
    with caplog.at_level("INFO"):
        generate(boxsat(), tmp_path / "data")
    assert "6 frames left: about" in caplog.text
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage._replace(free=10_000))
    with pytest.raises(WorkError, match=r"expected \d+ kB of free disk for 6 frames, found 10 kB"):
        generate(boxsat(), tmp_path / "other")
    assert not (tmp_path / "other/transforms.json").exists()


def test_bad_scene_folder_and_camera_are_refused(made, tmp_path):
    with pytest.raises(InputError, match="distance: expected cameras outside of boxsat"):
        generate(boxsat(distance=0.3), tmp_path / "b")
    with pytest.raises(InputError, match="workers: expected at least 1, found 0"):
        generate(boxsat(), tmp_path / "b", workers=0)
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match="expected a new folder, found a dataset"):
        generate(boxsat(), made)
    with pytest.raises(InputError, match=r"was made with quality\.spp 4, expected the same to resume it, found 5"):
        generate(boxsat(spp=5), made, resume=True)


def test_parts_make_the_same_dataset_as_one_run(made, tmp_path, spacesim):
    """Two at once in one folder, one in a folder of its own that is copied, then one command that completes it."""
    root, apart = tmp_path / "data", tmp_path / "apart"
    assert generate_part(boxsat(), root, (0, 2)) == (2, 6, False)
    with lock_folder(root, shared=True):  # as another part holds it
        generate_part(boxsat(), root, (2, 3))
        (root / "id/.other.part").write_bytes(b"of another part, in the making")
        generate_part(boxsat(), root, (2, 3))
        assert (root / "id/.other.part").exists()
        with pytest.raises(InputError, match="expected no other run at work in the folder"):
            generate(boxsat(), root, resume=True)
    generate_part(boxsat(), apart, (3, 5), workers=2)
    shutil.copytree(apart, root, dirs_exist_ok=True)
    assert not (root / "transforms.json").exists()
    generate(boxsat(), root, resume=True)
    assert contents(root) == contents(made)
    assert generate_part(boxsat(), root, (0, 2)) == (2, 6, True)
    (root / "id/test_00001.png").unlink()
    assert generate_part(boxsat(), root, (0, 2)) == (2, 6, False)
    with pytest.raises(InputError, match=r"was made with quality\.spp 4, expected the same to resume it, found 5"):
        generate_part(boxsat(spp=5), root, (0, 1))
    with pytest.raises(InputError, match=r"frames: expected A:B, A from 0 to 5, .* found '6:'"):
        generate_part(boxsat(), root, (6, None))
    with pytest.raises(InputError, match=r"frames: expected .* found '3:3'"):
        generate_part(boxsat(), root, (3, 3))
    small = ("generate", "boxsat", "--views", 4, "--test-views", 2, "--resolution", 16, "--spp", 1, "--out")
    for part, frames in (("0:3", "0:3"), ("3:100", "3:6")):
        done = spacesim(*small, tmp_path / "b", "--frames", part)
        expected = f"frames {frames} of all 6 are made; --resume completes the dataset"
        assert (done.code, done.output) == (0, f"{tmp_path / 'b'}: {expected}\n")
    assert spacesim(*small, tmp_path / "b", "--resume").code == 0
    done = spacesim(*small, tmp_path / "b", "--frames", "0:3")
    assert done.output == f"{tmp_path / 'b'}: frames 0:3 of all 6 are made; the dataset is complete\n"
    assert done.code == 0
    assert spacesim(*small, tmp_path / "c").code == 0
    assert contents(tmp_path / "b") == contents(tmp_path / "c")
    assert spacesim(*small, tmp_path / "d", "--frames", "1-2").is_refusal("--frames", "A:B")
    assert spacesim(*small, tmp_path / "d", "--frames", "9:").is_refusal("frames")


def test_dark_and_empty_frames_are_counted_in_one_warning(tmp_path, caplog):
    from spacesim.data.geometry import look_at

    poses = [look_at([9, 0, 0], [0, 0, 0]), look_at([-9, 0, 0], [0, 0, 0]), look_at([9, 0, 0], [99, 0, 0])]
    rig = PoseRig(np.array(poses), sun=(0, 0))
    config = read_scene("boxsat", resolution=(24, 24), spp=4, points=50, rig=rig)
    generate(config, tmp_path / "data")
    warnings = [record.message for record in caplog.records if record.levelname == "WARNING"]
    assert warnings == [
        "generate: 1 of 3 frames show the object in the dark (train_00001 first); 1 of 3 frames show no object "
        "(train_00002 first); min_sunlit = 0.05 (--min-sunlit) leaves them out"
    ]
    frames = json.loads((tmp_path / "data/transforms.json").read_text())["frames"]
    assert [frame["sunlit_fraction"] for frame in frames] == [pytest.approx(0.8, abs=0.2), 0.0, None]
    caplog.clear()
    generate(replace(config, rig=PoseRig(np.array(poses[2:]), sun=(0, 0))), tmp_path / "empty")
    assert [record.message for record in caplog.records if record.levelname == "WARNING"] == [
        "generate: 1 of 1 frames show no object (train_00000 first); check which way attitudes turn, and whether "
        "lengths are in m or km"
    ]
    caplog.clear()
    far = read_scene("boxsat", resolution=(8, 8), spp=1, points=50, distance=1e5, views=1, test_views=1)
    generate(far, tmp_path / "far")
    expected = "generate: 2 of 2 frames show no object (train_00000 first); it is smaller than a pixel, most likely"
    assert expected in [record.message for record in caplog.records]


def test_frames_of_other_shared_cameras_are_not_taken_over(tmp_path):
    """Once the fewer views of a Sun were none of the cameras that others share; frames so made are no part of this."""
    options = {"test_suns": 1, "test_views": 3, "known_test_views": 1, "shared_test_views": True}
    config = read_scene("boxsat", resolution=(8, 8), spp=1, points=50, suns=1, views=1, **options)
    generate(config, tmp_path / "data")
    path = tmp_path / "data/scene.json"
    described = json.loads(path.read_text())
    assert described["test_cameras"] == 3
    path.write_text(json.dumps({key: value for key, value in described.items() if key != "test_cameras"}))
    with pytest.raises(InputError, match="was made with test_cameras"):
        generate(config, tmp_path / "data", resume=True)


LENS = (-0.25, 0.08, 0.002, -0.001, 0.0)
RANDOM = {"resolution": (160, 120), "spp": 1, "points": 50, "distortion": LENS}


@pytest.fixture(scope="module")
def lit_and_dark(tmp_path_factory):
    """(its configuration, its folder) of a dataset of random poses and Suns under a lens that distorts."""
    rig = RandomRig(views=16, test_views=6, random_suns=True, cropped=True)
    config = read_scene("boxsat", rig=rig, **RANDOM)
    root = tmp_path_factory.mktemp("lit") / "data"
    generate(config, root)
    return config, root


def frames_of(root):
    return json.loads((root / "transforms.json").read_text())["frames"]


def test_the_share_in_sunlight_is_known_before_a_frame_is_made(lit_and_dark, monkeypatch):
    """To the pixel; where it is far from the limit by small pictures alone."""
    config, root = lit_and_dark
    sweep, sizes = _DatasetPlan(config), []
    labels = sweep.renderer.labels

    def counted(camera, *others):
        sizes.append((camera.width, camera.height))
        return labels(camera, *others)

    monkeypatch.setattr(sweep.renderer, "labels", counted)
    shares = [frame["sunlit_fraction"] for frame in frames_of(root)]
    assert len({share for share in shares if share}) > 10
    for spec, share in zip(sweep.specs[::2], shares[::2], strict=True):
        assert is_sunlit(sweep.renderer, spec, share or 1e-9) == bool(share)
        assert not is_sunlit(sweep.renderer, spec, (share or 0) + 1e-6)
        assert sizes[-1] == (160, 120)
        for least in (0.05, 0.3, 0.6, 0.9):
            assert is_sunlit(sweep.renderer, spec, least) == ((share or 0) >= least)
            if share is not None and abs(share - least) > 0.4:
                assert sizes[-1] in ((64, 48), (128, 96))
    assert (64, 48) in sizes


def test_frames_with_less_in_sunlight_are_left_out(lit_and_dark, tmp_path, caplog):
    config, root = lit_and_dark
    limited = replace(config, min_sunlit=0.4)
    assert "min_sunlit" not in config.to_json()
    assert limited.to_json()["min_sunlit"] == 0.4
    caplog.set_level("INFO")
    generate(limited, tmp_path / "data")
    whole = frames_of(root)
    is_kept = [(frame["sunlit_fraction"] or 0) >= 0.4 for frame in whole]
    assert 4 <= sum(is_kept[:16]) <= 12
    kept = [frame for frame, stays in zip(whole, is_kept, strict=True) if stays]
    found = frames_of(tmp_path / "data")
    for key in ("transform_matrix", "sun_direction", "sunlit_fraction"):
        assert [frame[key] for frame in found] == [frame[key] for frame in kept]
    names = [
        f"{some}_{k:05d}"
        for some, count in (("train", sum(is_kept[:16])), ("test", sum(is_kept[16:])))
        for k in range(count)
    ]
    assert [Path(frame["file_path"]).stem for frame in found] == names
    for old, new in zip(kept, found, strict=True):
        assert (root / old["shadow_path"]).read_bytes() == (tmp_path / "data" / new["shadow_path"]).read_bytes()
    said = [record.getMessage() for record in caplog.records if "left out" in record.getMessage()]
    assert len(said) == 1
    assert said[0].startswith(f"generate: {22 - len(kept)} of 22 frames are left out, as less than 0.4 of their object")
    assert not any("in the dark" in record.getMessage() for record in caplog.records)
    scene = json.loads((tmp_path / "data/scene.json").read_text())
    dark = np.flatnonzero(~np.array(is_kept))
    assert scene["left_out"] == {"train": [k for k in dark if k < 16], "test": [k - 16 for k in dark if k >= 16]}
    assert "left_out" not in json.loads((root / "scene.json").read_text())
    caplog.clear()
    generate(replace(limited, rig=replace(config.rig, max_phase_deg=20.0, views=2, test_views=0)), tmp_path / "lit")
    assert json.loads((tmp_path / "lit/scene.json").read_text())["left_out"] == {"train": [], "test": []}
    assert not any("left out" in record.getMessage() for record in caplog.records)


def test_parts_resume_and_workers_leave_out_the_same_frames(lit_and_dark, tmp_path):
    camera = replace(lit_and_dark[0].camera, resolution=(40, 30))
    config = replace(lit_and_dark[0], min_sunlit=0.4, camera=camera)
    generate(config, tmp_path / "a")
    count = len(frames_of(tmp_path / "a"))
    assert generate_part(config, tmp_path / "b", (3, 6)) == (3, count, False)
    assert generate_part(config, tmp_path / "b", (count - 2, None)) == (2, count, False)
    assert estimate(config, tmp_path / "b").frames == count - 5
    generate(config, tmp_path / "b", resume=True, workers=2)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    with pytest.raises(InputError, match=f"frames: expected A:B, A from 0 to {count - 1}"):
        generate_part(config, tmp_path / "b", (count, None))
    with pytest.raises(InputError, match=r"was made with min_sunlit 0\.4, expected the same to resume it, found None"):
        generate(replace(config, min_sunlit=0.0), tmp_path / "b", resume=True)


def test_a_limit_of_sunlight_that_no_frame_keeps_is_refused(spacesim, tmp_path):
    small = ("--views", 4, "--test-views", 1, "--resolution", 16, "--spp", 1)
    refused = spacesim("generate", "boxsat", *small, "--min-sunlit", 0.99, "--out", tmp_path / "data")
    assert refused.is_refusal("--min-sunlit: expected a training frame of whose object at least 0.99 is sunlit")
    assert refused.errors[-1].endswith("found none of 4")
    assert not (tmp_path / "data").exists()
    for wrong in (1, -0.1, "nan"):
        assert spacesim("generate", "boxsat", *small, "--min-sunlit", wrong, "--print").is_refusal("--min-sunlit")


def test_estimate_and_workers_on_the_command_line(spacesim, tmp_path):
    small = ("--views", 6, "--test-views", 0, "--resolution", 16, "--spp", 1)
    done = spacesim("generate", "boxsat", *small, "--out", tmp_path / "a", "--estimate")
    assert (done.code, done.errors) == (0, [])
    assert done.output.startswith("6 frames left: about ")
    assert not list(tmp_path.iterdir())
    assert spacesim("generate", "boxsat", *small, "--out", tmp_path / "a", "--workers", 2).code == 0
    assert spacesim("generate", "boxsat", *small, "--out", tmp_path / "b").code == 0
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert spacesim("generate", "boxsat", "--out", tmp_path / "c", "--workers", 0).is_refusal("workers")
    refused = spacesim("generate", "boxsat", "--out", tmp_path / "c", "--workers", 2, "--ray", "local")
    assert refused.is_refusal("--workers", "--ray")
