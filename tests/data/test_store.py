"""Datasets that we write: layout, truth, resuming, and what is said of broken ones."""

import json
import logging
import os
import signal
import subprocess
import sys
import textwrap
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image as PillowImage
from tiny import contents

from spacesim.data.errors import InputError, WorkError
from spacesim.data.geometry import fibonacci_sphere, look_at
from spacesim.data.images import load_image, read_exr, write_exr
from spacesim.data.integrity.manifest import check_manifest, digest_of, read_manifest
from spacesim.data.records import Camera, Sun, Truth
from spacesim.data.store import (
    DatasetWriter,
    choose_depth_unit,
    find_unreadable_files,
    load_depth,
    load_truth,
    read_dataset,
    read_points,
    write_points,
)

WIDTH, HEIGHT = 20, 14
SCENE = {"name": "box", "seed": 3, "suns": [[10.0, 20.0]]}
FOLDERS = {"images": "png", "gt": "exr", "shadow": "png", "silhouette": "png", "id": "png", "depth": "png"}
POINTS = np.random.default_rng(5).normal(size=(30, 3))
COLORS = np.random.default_rng(6).integers(0, 256, (30, 3)).astype(np.uint8)


def make_truth(seed=0):
    random = np.random.default_rng(seed)
    alpha = np.zeros((HEIGHT, WIDTH), np.float32)
    alpha[3:12, 4:17] = 1
    alpha[3] *= 0.25
    surface = alpha > 0.5

    def layer(*channels):
        values = random.random((HEIGHT, WIDTH, *channels), np.float32)
        return values * surface.reshape(HEIGHT, WIDTH, *[1] * len(channels))

    return Truth(
        radiance=random.random((HEIGHT, WIDTH, 3), np.float32) * alpha[..., None],
        alpha=alpha,
        depth=layer() * 5,
        distance=layer() * 6,
        normal=layer(3),
        albedo=layer(3),
        object_id=(surface * 1).astype(np.uint8),
        part_id=(surface * 3).astype(np.uint8),
        sun_visibility=layer(),
        sun_cosine=layer(),
        shadow=np.where(surface, random.choice([85, 170, 171, 255], surface.shape), 0).astype(np.uint8),
    )


def picture_of(truth):
    """[H, W, 4] uint8: any picture does, this one is linear."""
    straight = 0.8 * truth.radiance / np.where(truth.alpha > 0, truth.alpha, 1)[..., None]
    return np.round(255 * np.clip(np.dstack([straight, truth.alpha]), 0, 1)).astype(np.uint8)


def make_frame(seed=0):
    return make_truth(seed), picture_of(make_truth(seed))


def make_frames(names):
    poses = [look_at(3 * direction, [0, 0, 0]) for direction in fibonacci_sphere(len(names), seed=1)]
    cameras = [Camera.from_fov(pose, WIDTH, HEIGHT, 50.0) for pose in poses]
    return [(name, camera, Sun.from_angles(30.0, 40.0)) for name, camera in zip(names, cameras, strict=True)]


TRAIN, TEST = ["train_00000", "train_00001"], ["test_00000"]


def write_dataset(root, resume=False, frames=None):
    writer = DatasetWriter(root, SCENE, resume)
    for seed, name in enumerate(TRAIN + TEST):
        if not writer.has_frame(name):
            writer.write_frame(name, *make_frame(seed))
    frames = frames or make_frames(TRAIN + TEST)
    return writer.finish(frames[:2], frames[2:], POINTS, COLORS, trimesh.creation.box())


@pytest.fixture
def root(tmp_path):
    write_dataset(tmp_path / "data")
    return tmp_path / "data"


def test_layout(root):
    expected = {f"{folder}/{name}.{suffix}" for folder, suffix in FOLDERS.items() for name in TRAIN + TEST}
    assert set(contents(root)) == expected | {"transforms.json", "scene.json", "points.ply", "mesh.ply", "SHA256SUMS"}
    assert json.loads((root / "scene.json").read_text()) == SCENE
    assert find_unreadable_files(root) == []


def test_written_again_it_has_the_same_bytes(root, tmp_path):
    write_dataset(tmp_path / "again")
    assert contents(tmp_path / "again") == contents(root)


def test_records_and_truth_read_back(root):
    dataset = read_dataset(root)
    assert [frame.file_path for frame in dataset.train] == [f"images/{name}.png" for name in TRAIN]
    assert [frame.file_path for frame in dataset.test] == [f"images/{name}.png" for name in TEST]
    assert (dataset.ply_file_path, dataset.mesh_path, dataset.scene) == ("points.ply", "mesh.ply", SCENE)
    for seed, (frame, (_, camera, sun)) in enumerate(zip(dataset.frames, make_frames(TRAIN + TEST), strict=True)):
        np.testing.assert_array_equal(frame.camera.world_from_camera, camera.world_from_camera)
        assert (frame.camera.fx, frame.camera.cy) == (camera.fx, camera.cy)
        assert frame.sun is not None
        np.testing.assert_allclose(frame.sun.direction, sun.direction, atol=1e-15)
        found, expected = load_truth(dataset, frame), make_truth(seed)
        for field in fields(Truth):
            layer = getattr(found, field.name)
            if field.name in ("radiance_earth", "radiance_background"):
                assert layer is None
                continue
            assert layer.dtype == getattr(expected, field.name).dtype, field.name
            np.testing.assert_array_equal(layer, getattr(expected, field.name), err_msg=field.name)


def test_datasets_and_planes_are_shown_in_a_line(root):
    dataset = read_dataset(root)
    counts = f"{len(TRAIN)} training, {len(TEST)} test frames"
    assert repr(dataset) == f"Dataset({str(root)!r}: {counts})"
    assert repr(replace(dataset, scene={"scene": "boxsat"})) == f"Dataset({str(root)!r}: {counts} of boxsat)"
    shown = repr(load_truth(dataset, dataset.train[0]))
    assert shown.startswith(f"Truth({WIDTH} x {HEIGHT} pixels: radiance, alpha, depth, ")
    assert shown.endswith("shadow)")  # the Earth's part is not there
    assert repr(load_image(dataset, dataset.train[0])) == f"Image({WIDTH} x {HEIGHT} pixels: rgb, alpha, valid)"


def test_read_and_written_again_the_truth_has_the_same_bytes(root, tmp_path):
    for name in TRAIN:
        write_exr(tmp_path / "again.exr", read_exr(root / "gt" / f"{name}.exr"))
        assert (tmp_path / "again.exr").read_bytes() == (root / "gt" / f"{name}.exr").read_bytes()


def test_pictures_by_hand(root):
    truth = make_truth(0)
    picture = np.asarray(PillowImage.open(root / "images/train_00000.png"))
    assert picture.shape == (HEIGHT, WIDTH, 4)
    np.testing.assert_array_equal(picture, picture_of(truth))
    silhouette = np.asarray(PillowImage.open(root / "silhouette/train_00000.png"))
    np.testing.assert_array_equal(silhouette, np.where(truth.object_id, 255, 0))
    np.testing.assert_array_equal(np.asarray(PillowImage.open(root / "id/train_00000.png")), truth.object_id)
    np.testing.assert_array_equal(np.asarray(PillowImage.open(root / "shadow/train_00000.png")), truth.shadow)
    depth = np.asarray(PillowImage.open(root / "depth/train_00000.png"))
    assert depth.dtype == np.uint16
    assert np.abs(depth * 1e-3 - truth.depth).max() <= 0.5e-3 + 1e-6


def test_depth_beyond_16_bits_is_left_out_with_one_warning(tmp_path, caplog):
    truth = make_truth()
    truth.depth[5, 5:7] = [65.535, 65.6]
    writer = DatasetWriter(tmp_path / "data", SCENE)
    with caplog.at_level(logging.WARNING):
        writer.write_frame("train_00000", truth, picture_of(truth))
        writer.write_frame("train_00001", truth, picture_of(truth))
    depth = np.asarray(PillowImage.open(tmp_path / "data/depth/train_00000.png"))
    assert depth[5, 5:7].tolist() == [65535, 0]
    assert len(caplog.records) == 1


def test_loads_by_nerfstudios_documented_rules(root):
    """Independent of our reader: plain json, PIL and the conventions at docs.nerf.studio."""
    meta = json.loads((root / "transforms.json").read_text())
    assert set(meta["train_filenames"]).isdisjoint(meta["test_filenames"])
    assert set(meta["train_filenames"] + meta["test_filenames"]) == {f["file_path"] for f in meta["frames"]}
    assert (root / meta["ply_file_path"]).is_file()
    cloud = trimesh.load(root / meta["ply_file_path"])
    np.testing.assert_allclose(cloud.vertices, POINTS.astype(np.float32))
    for frame, (_, camera, _) in zip(meta["frames"], make_frames(TRAIN + TEST), strict=True):
        picture = PillowImage.open(root / frame["file_path"])
        assert picture.size == (meta["w"], meta["h"])
        assert picture.mode == "RGBA"
        depth = PillowImage.open(root / frame["depth_file_path"])
        assert depth.size == picture.size
        pose = np.array(frame["transform_matrix"])  # camera to world; x right, y up, looks along -z
        np.testing.assert_allclose(pose[:3, 3], camera.position)
        to_origin = -camera.position / np.linalg.norm(camera.position)
        np.testing.assert_allclose(-pose[:3, 2], to_origin, atol=1e-12)
        x, y, z = np.linalg.inv(pose)[:3, :3] @ (np.array([0.1, 0.2, 0.3]) - pose[:3, 3])
        column, row = meta["fl_x"] * x / -z + meta["cx"], meta["fl_y"] * y / z + meta["cy"]
        own = camera.camera_from_world @ [0.1, 0.2, 0.3, 1]
        assert column == pytest.approx(camera.fx * own[0] / own[2] + camera.cx)
        assert row == pytest.approx(camera.fy * own[1] / own[2] + camera.cy)
        assert np.linalg.norm(frame["sun_direction"]) == pytest.approx(1)
        assert (frame["sun_azimuth_deg"], frame["sun_elevation_deg"]) == pytest.approx((30, 40))


def test_intrinsics_stand_in_the_frames_where_they_differ(tmp_path):
    frames = make_frames(TRAIN + TEST)
    frames[1] = (frames[1][0], replace(frames[1][1], fx=33.0), frames[1][2])
    dataset = write_dataset(tmp_path / "data", frames=frames)
    meta = json.loads((tmp_path / "data/transforms.json").read_text())
    assert "fl_x" not in meta
    assert [frame.camera.fx for frame in dataset.frames] == [camera.fx for _, camera, _ in frames]


def test_resume_completes_what_was_left(root, tmp_path):
    whole = contents(root)
    for victim in ("gt/train_00001.exr", "id/test_00000.png", "transforms.json"):
        (root / victim).unlink()
    (root / "images/train_00000.png").write_bytes(b"")
    (root / "images" / ".train_00001.png.abcd.part").write_bytes(b"half")
    writer = DatasetWriter(root, SCENE, resume=True)
    assert [writer.has_frame(name) for name in TRAIN + TEST] == [False, False, False]
    assert "generate with resume=True completes it" in find_unreadable_files(root)[0]
    write_dataset(root, resume=True)
    assert contents(root) == whole


def test_a_killed_writer_leaves_whole_frames_only(tmp_path):
    program = f"""
        import sys
        sys.path[:0] = {[os.path.dirname(__file__), *sys.path]!r}
        from pathlib import Path
        from test_store import SCENE, DatasetWriter, make_frame
        writer = DatasetWriter(Path({str(tmp_path / "data")!r}), SCENE)
        print("ready", flush=True)
        for index in range(10_000):
            writer.write_frame(f"train_{{index:05d}}", *make_frame(index))
    """
    process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(program)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    process.stdout.readline()
    try:
        process.wait(timeout=0.15)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    writer = DatasetWriter(tmp_path / "data", SCENE, resume=True)
    names = sorted({path.stem for path in (tmp_path / "data").glob("*/*.png")})
    complete = [name for name in names if writer.has_frame(name)]
    assert len(names) - len(complete) <= 1  # the one that it was at
    for name in complete:
        np.testing.assert_array_equal(
            read_exr(tmp_path / "data/gt" / f"{name}.exr")["radiance"], make_truth(int(name[6:])).radiance
        )
        PillowImage.open(tmp_path / "data/images" / f"{name}.png").load()


def test_writer_refuses_what_is_not_its_own(root, tmp_path):
    with pytest.raises(InputError, match="expected a new folder, found a dataset; resume=True"):
        DatasetWriter(root, SCENE)
    with pytest.raises(InputError, match=r"was made with seed 3, expected the same to resume it, found 4"):
        DatasetWriter(root, {**SCENE, "seed": 4}, resume=True)
    with pytest.raises(InputError, match="was made with suns"):
        DatasetWriter(root, {key: SCENE[key] for key in ("name", "seed")}, resume=True)
    DatasetWriter(root, {**SCENE, "suns": [(10, 20)]}, resume=True)  # the same once it is JSON
    (tmp_path / "other").mkdir()
    (tmp_path / "other/thesis.doc").write_text("years of work")
    for resume in (False, True):
        with pytest.raises(InputError, match=r"thesis\.doc"):
            DatasetWriter(tmp_path / "other", SCENE, resume)
    with pytest.raises(InputError, match="found a file"):
        DatasetWriter(tmp_path / "other/thesis.doc", SCENE)
    with pytest.raises(InputError, match="cannot be written"):
        DatasetWriter(tmp_path / "other/thesis.doc/data", SCENE)


def test_unwritable_folder_and_full_disk(tmp_path, monkeypatch):
    writer = DatasetWriter(tmp_path / "data", SCENE)
    for number, expected in ((13, InputError), (30, InputError), (28, WorkError)):

        def refuse(*_, number=number):
            raise OSError(number, os.strerror(number))

        with monkeypatch.context() as patch:
            patch.setattr("os.replace", refuse)
            with pytest.raises(expected, match=r"train_00000\.png"):
                writer.write_frame("train_00000", *make_frame())
        assert not writer.has_frame("train_00000")
    assert not list((tmp_path / "data").glob("**/.*.part"))


def test_finish_needs_all_frames(tmp_path):
    writer = DatasetWriter(tmp_path / "data", SCENE)
    writer.write_frame("train_00000", *make_frame())
    with pytest.raises(WorkError, match="train_00001"):
        writer.finish(make_frames(TRAIN), [], POINTS, COLORS, trimesh.creation.box())
    assert not (tmp_path / "data/transforms.json").exists()


def test_what_was_said_of_frames_as_they_were_written_is_what_their_files_say(root, tmp_path, monkeypatch):
    """With a sensor's pictures too. No file of theirs is read to finish the dataset."""
    writer = DatasetWriter(tmp_path / "again", SCENE, raw=("_r", "_g", "_b"))
    raw = np.arange(3 * HEIGHT * WIDTH, dtype=np.uint16).reshape(3, HEIGHT, WIDTH)
    written = [writer.write_frame(name, *make_frame(seed), raw) for seed, name in enumerate(TRAIN + TEST)]
    assert written == [writer.read_written(name) for name in TRAIN + TEST]
    shadow = make_truth(0).shadow
    assert written[0].sunlit == np.mean(shadow[shadow > 0] == 255)
    frames = make_frames(TRAIN + TEST)
    asked: list[Path] = []
    monkeypatch.setattr(
        "spacesim.data.integrity.manifest.digest_of", lambda path: asked.append(path) or digest_of(path)
    )
    writer.finish(frames[:2], frames[2:], POINTS, COLORS, trimesh.creation.box(), written=written)
    assert {path.name for path in asked} == {"scene.json", "points.ply", "mesh.ply"}
    assert check_manifest(tmp_path / "again") == {}
    listed, before = read_manifest(tmp_path / "again"), read_manifest(root)
    assert {path: digest for path, digest in listed.items() if not path.startswith("raw/")} == before
    assert sum(path.startswith("raw/") for path in listed) == 9


def test_a_frame_that_is_gone_or_shows_nothing_is_said(tmp_path):
    writer = DatasetWriter(tmp_path / "data", SCENE)
    truth = make_truth()
    nothing = replace(truth, object_id=np.zeros_like(truth.object_id), shadow=np.zeros_like(truth.shadow))
    written = [writer.write_frame(name, nothing, picture_of(nothing)) for name in TRAIN]
    assert [frame.sunlit for frame in written] == [None, None]
    assert writer.read_written(TRAIN[0]).sunlit is None
    victim = tmp_path / "data/id/train_00001.png"
    content = victim.read_bytes()
    victim.write_bytes(content[:-1])
    for _ in range(2):
        with pytest.raises(WorkError, match="train_00001 is not"):
            writer.finish(make_frames(TRAIN), [], POINTS, COLORS, trimesh.creation.box(), written=written)
        victim.unlink(missing_ok=True)


def test_a_sensors_numbers_are_asked_for_where_they_have_a_place(tmp_path):
    for raw, given in (("",), None), ((), np.zeros((HEIGHT, WIDTH), np.uint16)):
        writer = DatasetWriter(tmp_path / f"data{len(raw)}", SCENE, raw=raw)
        with pytest.raises(ValueError, match="raw: expected"):
            writer.write_frame("train_00000", *make_frame(), given)
        assert not list(writer.root.glob("*/*"))


def test_what_cannot_be_made_again_is_said(root):
    (root / "transforms.json").unlink()
    (root / "SHA256SUMS").unlink()
    (root / "id/train_00001.png").unlink()
    (root / "id/train_00001.png").mkdir()
    with pytest.raises(InputError, match=r"id/train_00001\.png: cannot be removed"):
        DatasetWriter(root, SCENE, resume=True)


def test_broken_truth_is_named(root):
    dataset = read_dataset(root)
    frame = dataset.train[0]
    path = root / "gt/train_00000.exr"
    layers = read_exr(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match=r"train_00000\.exr"):
        load_truth(dataset, frame)
    write_exr(path, {name: layer for name, layer in layers.items() if name != "albedo"})
    with pytest.raises(InputError, match="found no albedo"):
        load_truth(dataset, frame)
    write_exr(path, {name: layer[1:] for name, layer in layers.items()})
    with pytest.raises(InputError, match=r"expected 20x14 .* found 20x13"):
        load_truth(dataset, frame)
    path.unlink()
    with pytest.raises(InputError, match=r"train_00000\.exr"):
        load_truth(dataset, frame)
    with pytest.raises(InputError, match="no gt_path"):
        load_truth(dataset, replace(frame, gt_path=None))


def test_verify_tells_all_that_is_wrong(root):
    (root / "gt/train_00000.exr").write_bytes(b"")
    (root / "shadow/train_00001.png").unlink()
    PillowImage.new("L", (3, 3)).save(root / "id/test_00000.png")
    (root / "points.ply").write_text("ply")
    problems = find_unreadable_files(root)
    names = ["gt/train_00000.exr", "shadow/train_00001.png", "id/test_00000.png", "points.ply"]
    assert len(problems) == len(names)
    for name, problem in zip(names, problems, strict=True):
        assert name in problem
        assert "\n" not in problem
    (root / "images/train_00000.png").unlink()
    assert "images/train_00000.png: expected an image file, found none" in find_unreadable_files(root)[0]
    (root / "transforms.json").write_text("{}")
    assert len(find_unreadable_files(root)) == 1  # not even to be read


def test_points_are_stored_as_other_trainers_read_them(tmp_path):
    write_points(tmp_path / "points.ply", POINTS, COLORS)
    header, body = (tmp_path / "points.ply").read_bytes().split(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 30"]
    assert lines[3:6] == ["property float x", "property float y", "property float z"]
    assert lines[6:] == [f"property uchar {name}" for name in ("red", "green", "blue")]
    assert len(body) == 30 * 15
    points, colors = read_points(tmp_path / "points.ply")
    np.testing.assert_array_equal(points, POINTS.astype(np.float32))
    np.testing.assert_array_equal(colors, COLORS)


def test_points_of_others(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    path = tmp_path / "points.ply"
    path.write_text(head + "end_header\n1 2 3\n4 5 6.5\n")
    points, colors = read_points(path)
    assert points.tolist() == [[1, 2, 3], [4, 5, 6.5]]
    assert (colors == 128).all()
    path.write_text(
        head + "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n1 2 3 9 8 7\n4 5 6 255 0 1\n"
    )
    assert read_points(path)[1].tolist() == [[9, 8, 7], [255, 0, 1]]
    trimesh.creation.box().export(path)
    assert len(read_points(path)[0]) == 8
    for broken in ("", "ply", head + "end_header\n1 2 3\n", head + "end_header\n1 2 nan\n4 5 6\n", "solid x"):
        path.write_text(broken)
        with pytest.raises(InputError, match=r"points\.ply"):
            read_points(path)
    write_points(path, POINTS, COLORS)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(InputError, match=r"points\.ply"):
        read_points(path)
    with pytest.raises(InputError, match=r"absent\.ply"):
        read_points(tmp_path / "absent.ply")


def test_our_own_images_load(root):
    dataset = read_dataset(root)
    image = load_image(dataset, dataset.train[0])
    assert image.rgb.shape == (HEIGHT, WIDTH, 3)
    np.testing.assert_allclose(image.alpha, make_truth().alpha, atol=0.5 / 255)
    assert image.valid.all()


@pytest.mark.parametrize(
    ("farthest", "unit"), [(0, 1e-3), (65.535, 1e-3), (65.6, 2e-3), (124.8, 2e-3), (125, 5e-3), (4e5, 10), (7e6, 200)]
)
def test_depth_unit_is_the_finest_round_step_that_reaches(farthest, unit):
    assert choose_depth_unit(farthest) == pytest.approx(unit, rel=1e-12)


def test_far_depth_is_stored_in_the_unit_that_transforms_json_says(tmp_path, caplog):
    truth = make_truth()
    truth.depth[5, 5:7] = [500.0, 655.0]
    writer = DatasetWriter(tmp_path / "data", {**SCENE, "depth_unit": 0.01})
    for name in TRAIN + TEST:
        writer.write_frame(name, truth, picture_of(truth))
    frames = make_frames(TRAIN + TEST)
    dataset = writer.finish(frames[:2], frames[2:], POINTS, COLORS, trimesh.creation.box())
    assert json.loads((tmp_path / "data/transforms.json").read_text())["depth_unit_scale_factor"] == 0.01
    stored = np.asarray(PillowImage.open(tmp_path / "data/depth/train_00000.png"))
    assert stored[5, 5:7].tolist() == [50000, 65500]
    np.testing.assert_allclose(load_depth(dataset, dataset.train[0]), truth.depth, atol=5.1e-3)
    assert not caplog.records
    with pytest.raises(InputError, match=r"was made with depth_unit 0\.01, expected the same to resume it, found None"):
        DatasetWriter(tmp_path / "data", SCENE, True)


@pytest.mark.parametrize("unit", [0, -1, "x", True, float("nan")])
def test_impossible_units_of_depth_are_refused(root, unit):
    meta = json.loads((root / "transforms.json").read_text())
    (root / "transforms.json").write_text(json.dumps({**meta, "depth_unit_scale_factor": unit}))
    with pytest.raises(InputError, match=r"transforms\.json: expected .* as depth_unit_scale_factor"):
        read_dataset(root)
