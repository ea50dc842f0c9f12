"""Exports are read back by each format's own rules: plain json, Pillow and the projection that its documents give."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image as PillowImage
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from spacesim.data.errors import InputError
from spacesim.data.exporters import (
    LabelledObject,
    labelled_objects,
    write_bop,
    write_coco,
    write_speedplus,
    write_webdataset,
    write_yolo,
)
from spacesim.data.exporters.objects import opaque_picture, select_object
from spacesim.data.exporters.speedplus import _label
from spacesim.data.files import read_json, write_json
from spacesim.data.images import read_exr, read_png
from spacesim.data.records import Camera, Frame
from spacesim.data.store import load_truth, read_dataset
from spacesim.scenes.cameras.sensor import SensorConfig
from spacesim.scenes.config import ObjectConfig, SceneConfig, with_options
from spacesim.scenes.generation.generate import generate
from spacesim.scenes.scenefile import read_scene
from spacesim.scenes.silhouette import silhouette_finder

TURN = (0.8, 0.1, -0.5, 0.3)  # of the second object, not normalised


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """Three objects, two of one shape; the second turned and half as large. Views cut objects off and hide them."""
    objects = (
        ObjectConfig(spacecraft="boxsat"),
        ObjectConfig(spacecraft="cubesat", position=(2.0, 1.0, 2.0), rotation_wxyz=TURN, scale=0.5),
        ObjectConfig(spacecraft="boxsat", name="twin", position=(-3.0, -3.0, -3.0)),
    )
    scene = SceneConfig("three", objects)
    options = {"views": 4, "test_views": 2, "resolution": (128, 96), "spp": 4, "points": 50, "fov_deg": 40.0}
    root = tmp_path_factory.mktemp("three") / "data"
    generate(with_options(scene, **options, distance=9.0), root)
    return root


@pytest.fixture(scope="module")
def bop(data, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("three") / "bop"
    write_bop(read_dataset(data), out, silhouette_finder)
    return out


def test_targets_have_their_meshes_in_their_own_frames(data):
    first, second, third = labelled_objects(read_dataset(data))
    assert [target.name for target in (first, second, third)] == ["boxsat", "cubesat", "twin"]
    np.testing.assert_allclose(third.vertices, first.vertices, atol=1e-6)
    np.testing.assert_array_equal(third.faces, first.faces)
    np.testing.assert_allclose(third.world_from_object[:3, 3], [-3, -3, -3])
    w, *xyz = TURN
    np.testing.assert_allclose(second.world_from_object[:3, :3], Rotation.from_quat([*xyz, w]).as_matrix(), atol=1e-12)
    from spacesim.scenes.spacecraft import spacecraft

    model = trimesh.util.concatenate([part.mesh for part in spacecraft("cubesat").parts])
    np.testing.assert_allclose(second.vertices, 0.5 * model.vertices, atol=1e-6)


def test_speedplus_poses_project_the_mesh_onto_the_object(data, tmp_path):
    """By the formula of SPEED+'s utilities: scalar-first quaternion, p = R(q) x + r, then camera.json's matrix."""
    for number in (1, 2, 3):
        out = tmp_path / str(number)
        target = write_speedplus(read_dataset(data), out, str(number))
        camera = json.loads((out / "camera.json").read_text())
        labels = json.loads((out / "synthetic/train.json").read_text())
        labels += json.loads((out / "synthetic/validation.json").read_text())
        assert len(labels) == 6
        for label in labels:
            w, *xyz = label["q_vbs2tango_true"]
            points = Rotation.from_quat([*xyz, w]).apply(target.vertices) + label["r_Vo2To_vbs_true"]
            pixels = points @ np.transpose(camera["cameraMatrix"])
            pixels = pixels[:, :2] / pixels[:, 2:]
            image = np.asarray(PillowImage.open(out / "synthetic/images" / label["filename"]))
            assert image.shape == (camera["Nv"], camera["Nu"], 3)
            ids = np.asarray(PillowImage.open(data / "id" / label["filename"]))
            rows, columns = np.nonzero(ids == number)
            seen = np.stack([columns, rows], axis=1) + 0.5
            if len(seen) == 0:
                continue
            # what is seen of the object lies within the hull of its projected vertices
            assert (seen.min(axis=0) >= pixels.min(axis=0) - 0.6).all()
            assert (seen.max(axis=0) <= pixels.max(axis=0) + 0.6).all()
    assert camera["fx"] / camera["ppx"] == pytest.approx(camera["cameraMatrix"][0][0])
    assert camera["distCoeffs"] == [0] * 5


def test_objects_of_one_name_are_told_apart_by_their_numbers(data, tmp_path):
    shutil.copytree(data, tmp_path / "data")
    scene = read_json(data / "scene.json")
    scene["objects"][2]["name"] = "boxsat"
    write_json(tmp_path / "data/scene.json", scene)
    targets = labelled_objects(read_dataset(tmp_path / "data"))
    with pytest.raises(InputError, match="object: expected one of the numbers 1, 3, found 'boxsat', the name of each"):
        select_object(targets, "boxsat")
    assert [select_object(targets, name).id for name in (None, "3", "cubesat")] == [1, 3, 2]


def test_speedplus_pose_by_hand():
    """A camera 10 m behind the body that looks along the body's x, up along its z. In the camera x is -y of the body, y
    is -z and z is x: rows (0, -1, 0), (0, 0, -1), (1, 0, 0), which turn by 120 degrees about (1, -1, 1)."""
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    world_from_camera[:3, 3] = [-10, 0, 0]
    camera = Camera(world_from_camera, 64, 64, 100.0, 100.0, 32.0, 32.0)
    target = LabelledObject(1, "any", np.eye(4), np.zeros((1, 3)), np.zeros((0, 3), int))
    label = _label("a.png", Frame("images/a.png", camera), target)
    quaternion = np.array(label["q_vbs2tango_true"])
    np.testing.assert_allclose(quaternion * np.sign(quaternion[0]), [0.5, 0.5, -0.5, 0.5], atol=1e-12)
    np.testing.assert_allclose(label["r_Vo2To_vbs_true"], [0, 0, 10], atol=1e-12)


def srgb(linear: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1, values 0 to 255."""
    x = np.clip(linear.astype(np.float64), 0, 1)
    return 255 * np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def ace(linear: np.ndarray) -> np.ndarray:
    """The curve of docs/how-to/cameras.md."""
    return linear * (2.51 * linear + 0.03) / (linear * (2.43 * linear + 0.59) + 0.14)


@pytest.mark.parametrize("tone", ["srgb", "filmic"])
def test_pictures_are_what_a_camera_records_over_black(tmp_path, tone):
    """From the radiance, where light is mixed at edges, not from the 8-bit picture, which has lost its highlights."""
    lens = (-0.2, 0.05, 0.001, -0.002, 0.0) if tone == "srgb" else ()
    small = {"views": 4, "test_views": 0, "resolution": (48, 32), "spp": 8, "points": 10}
    generate(read_scene("boxsat", **small, exposure=0.008, tone=tone, distortion=lens), tmp_path / "data")
    dataset = read_dataset(tmp_path / "data")
    write_speedplus(dataset, tmp_path / "speedplus")
    if not lens:
        write_bop(dataset, tmp_path / "bop", silhouette_finder)
    apart = 0.0
    for image, frame in enumerate(dataset.train):
        layers = read_exr(dataset.root / frame.gt_path)  # as the lens shows them
        light = 0.008 * layers["radiance"].astype(np.float64)
        expected = srgb(ace(light) if tone == "filmic" else light)
        name = Path(frame.file_path).name
        found = np.asarray(PillowImage.open(tmp_path / "speedplus/synthetic/images" / name))
        np.testing.assert_allclose(found, expected, atol=0.502)
        if not lens:
            other = np.asarray(PillowImage.open(tmp_path / f"bop/train/000000/rgb/{image:06d}.png"))
            np.testing.assert_array_equal(other, found)
        straight = np.asarray(PillowImage.open(dataset.root / frame.file_path)).astype(float)
        inside = layers["alpha"] == 1
        np.testing.assert_array_equal(found[inside], straight[inside][:, :3])
        apart = max(apart, np.abs(found - straight[..., :3] * straight[..., 3:] / 255).max())
    assert apart > 40, "pixels are missing in which mixing sRGB values would be wrong"


def test_a_sensors_pictures_stay_as_they_are(tmp_path):
    small = {"views": 1, "test_views": 0, "resolution": 16, "spp": 1, "points": 10}
    generate(read_scene("boxsat", **small, sensor=SensorConfig(monochrome=True)), tmp_path / "data")
    write_speedplus(read_dataset(tmp_path / "data"), tmp_path / "out")
    pictures = [tmp_path / folder / "train_00000.png" for folder in ("data/images", "out/synthetic/images")]
    first, second = (np.asarray(PillowImage.open(path)) for path in pictures)
    assert first.ndim == 2
    np.testing.assert_array_equal(first, second)


def test_bop_models_and_poses_project_into_masks(data, bop):
    infos = json.loads((bop / "models/models_info.json").read_text())
    assert set(infos) == {"1", "2"}  # two objects are of one shape
    models = {key: trimesh.load(bop / f"models/obj_{int(key):06d}.ply", process=False) for key in infos}
    for key, info in infos.items():
        points = np.asarray(models[key].vertices)
        np.testing.assert_allclose([info[f"min_{axis}"] for axis in "xyz"], points.min(axis=0), atol=1e-3)
        np.testing.assert_allclose([info[f"size_{axis}"] for axis in "xyz"], np.ptp(points, axis=0), atol=2e-3)
        apart = cdist(points, points).max()
        assert info["diameter"] == pytest.approx(apart, abs=1e-2)
    for split, count in (("train", 4), ("test", 2)):
        scene = bop / split / "000000"
        cameras, poses, meta = (
            json.loads((scene / f"{name}.json").read_text()) for name in ("scene_camera", "scene_gt", "scene_gt_info")
        )
        assert list(cameras) == list(poses) == list(meta) == [str(i) for i in range(count)]
        for image, entries in poses.items():
            matrix = np.reshape(cameras[image]["cam_K"], (3, 3))
            for index, pose in enumerate(entries):
                model = np.asarray(models[str(pose["obj_id"])].triangles_center)
                points = model @ np.reshape(pose["cam_R_m2c"], (3, 3)).T + pose["cam_t_m2c"]
                pixels = points @ matrix.T
                pixels = np.round(pixels[:, :2] / pixels[:, 2:]).astype(int)
                mask = np.asarray(PillowImage.open(scene / "mask" / f"{int(image):06d}_{index:06d}.png")) > 0
                inside = ((pixels >= 0) & (pixels < mask.shape[::-1])).all(axis=1)
                near = trimesh.grouping.unique_rows(pixels[inside])[0]
                columns, rows = pixels[inside][near].T
                grown = np.pad(mask, 1)
                grown = np.any([grown[1 + i :, 1 + k :][:96, :128] for i in (-1, 0, 1) for k in (-1, 0, 1)], axis=0)
                assert len(near) == 0 or grown[rows, columns].mean() > 0.99
                found, info = np.nonzero(mask), meta[image][index]
                if mask.any() and info["bbox_obj"][0] >= 0:  # -1: nothing of it is seen
                    x, y, width, height = info["bbox_obj"]
                    assert x <= found[1].min()
                    assert y <= found[0].min()
                    assert found[1].max() < x + width
                    assert found[0].max() < y + height


def test_bop_visibility_depth_and_boxes_are_those_of_the_pictures(data, bop):
    dataset = read_dataset(data)
    hidden = cut = 0
    for split, frames in (("train", dataset.train), ("test", dataset.test)):
        scene = bop / split / "000000"
        meta = json.loads((scene / "scene_gt_info.json").read_text())
        cameras = json.loads((scene / "scene_camera.json").read_text())
        for image, frame in enumerate(frames):
            truth = load_truth(dataset, frame)
            depth = np.asarray(PillowImage.open(scene / "depth" / f"{image:06d}.png"))
            scale = cameras[str(image)]["depth_scale"]
            assert scale in (0.1, 1.0)
            np.testing.assert_allclose(depth * scale / 1000, truth.depth, atol=scale * 0.51e-3)
            for index, info in enumerate(meta[str(image)]):
                mask, visible = (
                    np.asarray(PillowImage.open(scene / folder / f"{image:06d}_{index:06d}.png"))
                    for folder in ("mask", "mask_visib")
                )
                assert set(np.unique(mask)) <= {0, 255}
                np.testing.assert_array_equal(visible > 0, truth.object_id == index + 1)
                assert (mask >= visible).all()
                assert info["px_count_visib"] == (visible > 0).sum()
                assert info["px_count_all"] >= (mask > 0).sum()
                assert info["px_count_valid"] == (depth[mask > 0] > 0).sum()
                expected = info["px_count_visib"] / info["px_count_all"] if info["px_count_all"] else 0
                assert info["visib_fract"] == pytest.approx(expected)
                other = (truth.object_id > 0) & (truth.object_id != index + 1)
                assert (mask > 0)[~other].sum() == (visible > 0).sum()  # only other objects hide it
                hidden += ((mask > 0) & other).any()
                cut += info["px_count_all"] > (mask > 0).sum()
    assert hidden > 0, "a view in which one object hides another one is missing"
    assert cut > 0, "a view that cuts an object off is missing"


def test_silhouettes_agree_with_an_independent_ray_caster(data):
    dataset = read_dataset(data)
    targets = labelled_objects(dataset)
    camera = dataset.train[0].camera
    columns, rows = np.meshgrid(np.arange(0, camera.width, 6), np.arange(0, camera.height, 6))
    x, y = (columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ camera.world_from_camera[:3, :3].T
    for target, silhouette in zip(targets, silhouette_finder(targets)(camera), strict=True):
        world = target.vertices @ target.world_from_object[:3, :3].T + target.world_from_object[:3, 3]
        mesh = trimesh.Trimesh(world, target.faces, process=False)
        hits = mesh.ray.intersects_any(np.broadcast_to(camera.position, rays.shape), rays).reshape(columns.shape)
        assert (hits != silhouette.mask[::6, ::6]).sum() <= 1


def test_what_cannot_be_exported_is_refused_in_a_sentence(data, tmp_path):
    dataset = read_dataset(data)
    with pytest.raises(InputError, match="object: expected one of 1 boxsat, 2 cubesat, 3 twin, found 'hubble'"):
        write_speedplus(dataset, tmp_path / "a", "hubble")
    (tmp_path / "full").mkdir()
    (tmp_path / "full/file").write_text("mine")
    for write in (lambda out: write_speedplus(dataset, out), lambda out: write_bop(dataset, out, silhouette_finder)):
        with pytest.raises(InputError, match="full: expected a new or empty folder"):
            write(tmp_path / "full")
    generate(
        read_scene("boxsat", views=1, test_views=0, resolution=16, spp=1, points=1, distortion=(0.1, 0, 0, 0, 0)),
        tmp_path / "lens",
    )
    lens = read_dataset(tmp_path / "lens")
    with pytest.raises(InputError, match=r"train_00000\.png: expected an image without lens distortion"):
        write_bop(lens, tmp_path / "b", silhouette_finder)
    write_speedplus(lens, tmp_path / "c")
    assert json.loads((tmp_path / "c/camera.json").read_text())["distCoeffs"] == [0.1, 0, 0, 0, 0]
    shutil.copytree(data, tmp_path / "old")
    scene = read_json(tmp_path / "old/scene.json")
    del scene["mesh"]
    write_json(tmp_path / "old/scene.json", scene)
    with pytest.raises(InputError, match=r"scene\.json: expected objects, their poses"):
        labelled_objects(read_dataset(tmp_path / "old"))
    (tmp_path / "old/scene.json").unlink()
    with pytest.raises(InputError, match=r"old: expected data that `spacesim generate` made, .* found no scene\.json"):
        write_coco(read_dataset(tmp_path / "old"), tmp_path / "d")
    scene = read_json(data / "scene.json")
    del scene["exposure"]
    write_json(tmp_path / "old/scene.json", scene)
    with pytest.raises(InputError, match=r"scene\.json: expected the exposure and the tone, found none"):
        write_speedplus(read_dataset(tmp_path / "old"), tmp_path / "d")


@pytest.mark.parametrize("write", [write_coco, write_yolo, write_webdataset, write_speedplus, write_bop])
def test_an_interrupted_export_leaves_nothing_in_the_way(write, data, tmp_path, monkeypatch):
    monkeypatch.setattr("spacesim.data.exporters.webdataset.MOST", 1)  # a shard for each picture
    rest = (silhouette_finder,) if write is write_bop else (None,) if write is write_speedplus else ()

    def stop(done: int, _count: int, _name: str) -> None:
        if done == 3:
            raise KeyboardInterrupt

    for out in (tmp_path / "new", tmp_path / "there"):
        if was_there := out.name == "there":
            (out / ".spacesim-part").mkdir(parents=True)
            (out / ".spacesim-part/old").write_text("of a process that was killed")
        with pytest.raises(KeyboardInterrupt):
            write(read_dataset(data), out, *rest, progress=stop)
        assert list(tmp_path.iterdir()) == [out] * was_there
        assert not was_there or not list(out.iterdir())
        write(read_dataset(data), out, *rest)
        assert len(list(out.rglob("*.tar" if write is write_webdataset else "*.png"))) >= 6
        assert not [path for name in ("old", ".spacesim-part") for path in out.rglob(name)]
        shutil.rmtree(out)


def test_two_exports_into_one_folder_do_not_mix(data, tmp_path):
    dataset = read_dataset(data)

    def another(_done: int, _count: int, _name: str) -> None:
        with pytest.raises(InputError, match="expected no other run at work in the folder"):
            write_coco(dataset, tmp_path / "coco")

    write_coco(dataset, tmp_path / "coco", progress=another)


def test_commands(spacesim, data, tmp_path):
    done = spacesim("export", data, "--speedplus", tmp_path / "s", "--object", "twin")
    assert (done.code, done.errors) == (0, [line for line in done.errors if line.startswith("export: ")])
    assert "6 images with the pose of twin" in done.output
    done = spacesim("export", data, "--bop", tmp_path / "b")
    assert done.code == 0
    assert "boxsat, cubesat, twin" in done.output
    assert (tmp_path / "b/models/models_info.json").exists()
    assert spacesim("export", data, "--bop", tmp_path / "c", "--object", "1").is_refusal("--object", "--speedplus")
    assert spacesim("export", data, "--bop", tmp_path / "c", "--ply", "x").is_refusal("--bop", "--ply")
    assert spacesim("export", tmp_path, "--speedplus", tmp_path / "c").is_refusal(tmp_path)
    assert not (tmp_path / "c").exists()


def test_verify_names_what_is_broken(spacesim, data, tmp_path):
    done = spacesim("verify", data)
    assert (done.code, done.errors) == (0, [])
    assert "6 frames" in done.output
    shutil.copytree(data, tmp_path / "broken")
    victims = [tmp_path / "broken" / name for name in ("depth/train_00001.png", "gt/test_00000.exr")]
    for victim in victims:
        content = bytearray(victim.read_bytes())
        content[len(content) // 2] ^= 0xFF  # one byte within, which only decoding finds
        victim.write_bytes(content)
    done = spacesim("verify", tmp_path / "broken")
    assert done.code == 1
    assert len(done.errors) == 3
    assert all(str(victim) in "\n".join(done.errors[:2]) for victim in victims)
    assert "2 faulty files" in done.errors[2]
    assert spacesim("verify", tmp_path / "none").is_refusal(tmp_path / "none")


def test_pictures_of_one_name_in_two_folders_stay_two(data, tmp_path):
    """As Blender's scenes have them: train/r_0 and test/r_0. Labels still name the pictures that they are of."""
    root = Path(shutil.copytree(data, tmp_path / "data"))
    meta = json.loads((root / "transforms.json").read_text())
    for name in ("train_filenames", "test_filenames"):
        split = name.split("_")[0]
        (root / split).mkdir()
        for number, old in enumerate(meta[name]):
            new = f"{split}/r_{number}.png"
            (root / old).rename(root / new)
            meta[name][number] = new
            next(frame for frame in meta["frames"] if frame["file_path"] == old)["file_path"] = new
    (root / "transforms.json").write_text(json.dumps(meta))
    dataset = read_dataset(root)
    write_speedplus(dataset, tmp_path / "plus")
    written = sorted(path.name for path in (tmp_path / "plus/synthetic/images").iterdir())
    assert len(written) == len(dataset.frames)
    for split, frames in (("train", dataset.train), ("validation", dataset.test)):
        labels = json.loads((tmp_path / f"plus/synthetic/{split}.json").read_text())
        for label, frame in zip(labels, frames, strict=True):
            expected = opaque_picture(dataset, frame)
            assert np.array_equal(read_png(tmp_path / "plus/synthetic/images" / label["filename"]), expected)
    assert written[0] == "test_r_0.png"
