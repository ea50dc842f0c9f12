"""Folders of Nerfstudio and of NeRF-synthetic as the world has them."""

import json
import logging
import shutil

import numpy as np
import pytest
from PIL import Image

import spacesim as ss
from spacesim.data.errors import InputError
from spacesim.data.images import read_png
from spacesim.data.store import find_unreadable_files, read_points, write_points
from spacesim.eval.frame_metrics import frame_target

POSE = [[1, 0, 0, 0.5], [0, 0, -1, -4], [0, 1, 0, 1], [0, 0, 0, 1]]
CAMERA = {"fl_x": 20.0, "fl_y": 21.0, "cx": 7.5, "cy": 6.0, "w": 16, "h": 12}


def write_picture(path, size=(16, 12), color=(10, 20, 30)):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGBA" if len(color) == 4 else "RGB", size, color).save(path)


def folder(root, frames, name="transforms.json", size=(16, 12), **meta):
    """With a picture for each frame, which has file_path and what else it has."""
    root.mkdir(parents=True, exist_ok=True)
    for frame in frames:
        frame.setdefault("transform_matrix", POSE)
        write_picture(root / frame["file_path"], size)
    (root / name).write_text(json.dumps({**CAMERA, **meta, "frames": frames}))
    return root


def named(count, **keys):
    return [{"file_path": f"images/{k}.png", **keys} for k in range(count)]


def imported(root, out, kind="nerfstudio", **options):
    dataset = ss.import_dataset(kind, root, out, **options)
    assert find_unreadable_files(out) == []
    return dataset


def of_name(dataset, name):
    return next(frame for frame in dataset.frames if frame.file_path == name)


def test_what_is_read_directly_and_what_is_imported_are_the_same(tmp_path):
    frames = named(3, sun_direction=[0, 0.6, 0.8])
    frames[1] |= {"fl_x": 33.0, "k1": 0.1, "p2": -0.01, "sun_direction": None}
    root = folder(tmp_path / "src", frames, applied_transform=[[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]], k2=0.02)
    write_points(root / "sparse.ply", np.eye(3), np.full((3, 3), 9, np.uint8))
    meta = json.loads((root / "transforms.json").read_text())
    (root / "transforms.json").write_text(json.dumps({**meta, "ply_file_path": "sparse.ply"}))
    before, after = ss.read_dataset(root), imported(root, tmp_path / "out")
    assert [f.file_path for f in before.train] == [f.file_path for f in after.train]
    assert [f.file_path for f in before.test] == [f.file_path for f in after.test]
    for one, two in zip(before.frames, after.frames, strict=True):
        np.testing.assert_allclose(one.camera.world_from_camera, two.camera.world_from_camera, atol=1e-15)
        keys = "width", "height", "fx", "fy", "cx", "cy"
        assert [getattr(one.camera, key) for key in keys] == [getattr(two.camera, key) for key in keys]
        assert one.distortion == two.distortion
        assert (one.sun is None) == (two.sun is None)
        assert one.sun is None or np.allclose(one.sun.direction, two.sun.direction)
    np.testing.assert_array_equal(read_points(tmp_path / "out/points.ply")[0], np.eye(3))


def test_a_folder_that_lacks_pictures_is_imported_and_read(tmp_path, caplog):
    """As the fox that instant-ngp comes with: 67 frames, 50 files."""
    root = folder(tmp_path / "src", named(67))
    for k in range(0, 67, 4):
        (root / f"images/{k}.png").unlink()
    dataset = imported(root, tmp_path / "out")
    assert len(dataset.frames) == len(ss.read_dataset(root).frames) == 50
    messages = [record.getMessage() for record in caplog.records]
    assert messages == 2 * [
        f"{root / 'transforms.json'}: 17 of 67 frames have no image and are left out, images/0.png first"
    ]


def test_a_folder_from_windows_is_read(tmp_path):
    root = folder(tmp_path / "src", named(9, mask_path="masks/m.png"))
    write_picture(root / "masks/m.png", color=(255, 255, 255))
    plain, path = ss.read_dataset(root), root / "transforms.json"
    meta = json.loads(path.read_text())
    meta["train_filenames"] = [frame["file_path"].replace("/", "\\") for frame in meta["frames"][:8]]
    meta["test_filenames"] = ["images\\8.png"]
    for frame in meta["frames"]:
        frame |= {key: frame[key].replace("/", "\\") for key in ("file_path", "mask_path")}
    path.write_text(json.dumps(meta), encoding="utf-8-sig")
    read = ss.read_dataset(root)
    assert [frame.file_path for frame in read.frames] == [f"images/{k}.png" for k in range(9)]
    assert {frame.mask_path for frame in read.frames} == {frame.mask_path for frame in plain.frames}
    assert len(imported(root, tmp_path / "out").test) == 1


def test_masks_from_elsewhere_take_the_place_of_those_named(tmp_path):
    root = folder(tmp_path / "src", named(2, mask_path="masks/m.png"))
    write_picture(root / "masks/m.png", color=(0, 0, 0))
    write_picture(root / "others/0.png", color=(255, 255, 255))
    write_picture(root / "others/1.png", color=(0, 0, 0))
    first, second = imported(root, tmp_path / "given", masks=root / "others").frames[:2]
    alphas = [ss.load_image(ss.read_dataset(tmp_path / "given"), frame).alpha.mean() for frame in (first, second)]
    assert sorted(alphas) == [0, 1]
    assert all(frame.mask_path is None for frame in imported(root, tmp_path / "none", masks="none").frames)


@pytest.mark.parametrize("key", ["mask_path", "silhouette_path"])
def test_masks_that_show_nothing_are_counted(tmp_path, caplog, key):
    frames = [{**frame, key: f"m{k}.png"} for k, frame in enumerate(named(3))]
    root = folder(tmp_path / "src", frames)
    for k in range(3):
        write_picture(root / f"m{k}.png", color=(255 * (k == 0),) * 3)
    imported(root, tmp_path / "some")
    assert [record.getMessage() for record in caplog.records] == ["masks: nothing is found in 2 of 3 pictures, 1 first"]
    write_picture(root / "m0.png", color=(0, 0, 0))
    with pytest.raises(InputError, match=r"expected an object in the (pictures|silhouettes), found none"):
        imported(root, tmp_path / "all")
    assert not (tmp_path / "all").exists()


def test_fisheye_cameras_are_undistorted(tmp_path):
    width, height, f, k1 = 128, 96, 90.0, 0.08
    x, y = np.meshgrid((np.arange(width) + 0.5 - 64) / f, (np.arange(height) + 0.5 - 48) / f)
    t = np.linspace(0, 1.5, 200_000)
    slope = np.tan(np.interp(np.hypot(x, y), t + k1 * t**3, t)) / np.hypot(x, y)

    def pattern(x, y):
        return 0.5 + 0.25 * np.sin(9 * x + 1) + 0.25 * np.cos(7 * y)

    camera = {"fl_x": f, "fl_y": f, "cx": 64.0, "cy": 48.0, "w": width, "h": height, "k1": k1}
    frames = named(2)
    frames[1]["camera_model"] = "PINHOLE"
    frames[1]["k1"] = 0
    root = folder(tmp_path / "src", frames, size=(width, height), camera_model="OPENCV_FISHEYE", **camera)
    Image.fromarray(np.rint(255 * pattern(x * slope, y * slope)).astype(np.uint8)).save(root / "images/0.png")
    dataset = imported(root, tmp_path / "out")
    frame = of_name(dataset, "images/0.png")
    image = ss.load_image(dataset, frame)
    assert np.abs(image.rgb[..., 0] - pattern(x, y))[image.valid].max() < 0.02
    assert image.valid.mean() > 0.95
    assert of_name(dataset, "images/1.png").distortion == ()
    with pytest.raises(InputError, match="found OPENCV_FISHEYE; spacesim import nerfstudio undistorts"):
        ss.read_dataset(root)


def test_fisheye_cameras_of_instant_ngp(tmp_path):
    root = folder(tmp_path / "src", named(2), is_fisheye=True, k1=0.01)
    assert imported(root, tmp_path / "out").frames[0].distortion == ()
    with pytest.raises(InputError, match="found OPENCV_FISHEYE"):
        ss.read_dataset(root)


def test_broken_pictures_are_not_imported(tmp_path):
    """Their headers are whole."""
    noise = np.random.default_rng(0).integers(0, 255, (12, 16, 3)).astype(np.uint8)
    for suffix in ("jpg", "png", "tif"):
        root = folder(tmp_path / suffix, [{"file_path": f"{k}.{suffix}"} for k in range(2)])
        path = root / f"1.{suffix}"
        if suffix == "tif":
            Image.fromarray(noise[..., 0].astype(np.float32)).save(path)
        else:
            Image.fromarray(noise).save(path)
            path.write_bytes(path.read_bytes()[:-100])
        with pytest.raises(InputError, match=rf"1\.{suffix}: expected"):
            ss.import_dataset("nerfstudio", root, tmp_path / f"out {suffix}")


@pytest.mark.parametrize("count", [0, 3])
def test_the_split_stays(tmp_path, count):
    """Also where nothing is to be tested with, which does not ask for every eighth frame to be held out."""
    frames = named(9)
    names = [frame["file_path"] for frame in frames]
    root = folder(tmp_path / "src", frames, train_filenames=names[count:], test_filenames=names[:count])
    dataset = imported(root, tmp_path / "out")
    assert [frame.file_path for frame in dataset.train] == names[count:]
    assert [frame.file_path for frame in dataset.test] == names[:count]


def test_blenders_pictures_of_training_alone(tmp_path):
    frames = [{"file_path": f"train/{k}.png"} for k in range(3)]
    root = folder(tmp_path / "src", frames, name="transforms_train.json")
    dataset = imported(root, tmp_path / "out", kind="blender")
    assert [(len(one.train), len(one.test)) for one in (dataset, ss.read_dataset(root))] == 2 * [(3, 0)]


def test_masks_are_read_as_the_option_says(tmp_path):
    root = folder(tmp_path / "src", named(2, mask_path="masks/m.png"))
    mask = np.zeros((12, 16), np.uint8)
    mask[:, :8] = 1  # as some programs write them: 0 and 1
    (root / "masks").mkdir()
    Image.fromarray(mask).save(root / "masks/m.png")
    dataset = imported(root, tmp_path / "unknown")
    image = ss.load_image(dataset, dataset.frames[0])
    assert (image.valid == (mask > 0)).all()
    assert image.alpha.min() == 1
    dataset = imported(root, tmp_path / "empty", masked="empty")
    image = ss.load_image(dataset, dataset.frames[0])
    assert image.valid.all()
    assert (image.alpha == mask).all()


@pytest.mark.parametrize("form", ["png", "npy", "float npy"])
@pytest.mark.parametrize("declared", [{}, {"depth_unit_scale_factor": 0.01}, {"integer_depth_scale": 0.25}, None])
def test_depth_of_any_unit_becomes_millimetres_where_these_reach(tmp_path, form, declared):
    unit = 0.5 if declared is None else next(iter(declared.values()), 0.001)
    key = "depth_path" if declared and "integer_depth_scale" in declared else "depth_file_path"
    steps = np.arange(192).reshape(12, 16).astype(np.uint16)
    root = folder(tmp_path / "src", named(2, **{key: f"depth.{form[-3:]}"}), **(declared or {}))
    if form == "png":
        Image.fromarray(steps).save(root / "depth.png")
    else:
        np.save(root / "depth.npy", steps.astype(np.float32)[..., None] if form == "float npy" else steps)
    dataset = imported(root, tmp_path / "out", **({"depth_unit": 0.5} if declared is None else {}))
    depth = read_png(tmp_path / "out" / dataset.frames[0].depth_file_path)
    expected = 0.001 if unit < 0.3 else 0.5 if form == "png" else 0.002
    assert dataset.depth_unit == expected
    assert json.loads((tmp_path / "out/transforms.json").read_text())["depth_unit_scale_factor"] == expected
    np.testing.assert_array_equal(depth, np.rint(steps * unit / expected))
    metres = ss.load_depth(dataset, dataset.frames[0])
    np.testing.assert_allclose(metres, steps * unit, atol=0.51 * expected)


def test_depth_that_stands_for_none_does_not_count(tmp_path, caplog):
    """As far planes are written: it would take all steps away from what is near."""
    depth = np.linspace(2, 80, 192).reshape(12, 16)
    depth[0] = 1e10
    root = folder(tmp_path / "src", named(2, depth_file_path="depth.npy"), depth_unit_scale_factor=1.0)
    np.save(root / "depth.npy", depth)
    dataset = imported(root, tmp_path / "out")
    metres = ss.load_depth(dataset, dataset.frames[0])
    assert (metres[0] == 0).all()
    np.testing.assert_allclose(metres[1:], depth[1:], atol=1.01e-3)
    assert len([r for r in caplog.records if "depth beyond 131.07 m" in r.getMessage()]) == 1


def test_pictures_of_a_fraction_of_the_size(tmp_path):
    root = folder(tmp_path / "src", named(2), size=(8, 6), k1=0.1)
    camera = imported(root, tmp_path / "out").frames[0].camera
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (8, 6, 10.0, 10.5, 3.75, 3.0)


def test_a_picture_that_is_nearly_as_its_camera_says_is_refused(tmp_path):
    """One side as the camera has it, the other a pixel off: no fraction."""
    root = folder(tmp_path / "src", named(2), size=(16, 11))
    with pytest.raises(InputError, match=r"expected 16x12 pixels as its camera says, or .* found 16x11"):
        imported(root, tmp_path / "out")


def blender(root):
    for split, count in (("train", 3), ("test", 2)):
        frames = [{"file_path": f"./{split}/r_{k}", "transform_matrix": POSE} for k in range(count)]
        for k in range(count):
            write_picture(root / split / f"r_{k}.png", color=(9, 9, 9, 128))
        (root / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))
    return root


def test_nerf_synthetic(tmp_path):
    root = blender(tmp_path / "src")
    (root / "train/r_1.png").unlink()
    dataset = imported(root, tmp_path / "out", "blender")
    assert [frame.file_path for frame in dataset.train] == ["images/train/r_0.png", "images/train/r_2.png"]
    assert [frame.file_path for frame in dataset.test] == ["images/test/r_0.png", "images/test/r_1.png"]
    camera = dataset.train[0].camera
    assert camera.fx == camera.fy == pytest.approx(8 / np.tan(0.35))
    assert (camera.cx, camera.cy) == (8, 6)
    assert ss.load_image(dataset, dataset.train[0]).alpha[0, 0] == pytest.approx(128 / 255)


def test_times_and_source_indices_of_frames_are_kept(tmp_path):
    frames = named(3)
    for k, frame in enumerate(frames):
        frame |= {"time": 0.25 * k, "source_index": 7 * k}
    frames[2]["source_index"] = float("inf")
    dataset = imported(folder(tmp_path / "src", frames), tmp_path / "out")
    assert {frame.file_path[7]: frame.time for frame in dataset.frames} == {"0": 0, "1": 0.25, "2": 0.5}
    entries = json.loads((tmp_path / "out/transforms.json").read_text())["frames"]
    assert {entry["file_path"][7]: entry.get("source_index") for entry in entries} == {"0": 0, "1": 7, "2": None}


def test_blenders_pictures_to_test_with_may_all_be_missing(tmp_path, caplog):
    root = blender(tmp_path / "src")
    shutil.rmtree(root / "test")
    dataset = imported(root, tmp_path / "out", "blender")
    assert (len(dataset.train), len(dataset.test)) == (3, 0)
    assert [r.getMessage() for r in caplog.records] == [
        f"{root / 'transforms_train.json'}: 2 of 5 frames have no image and are left out, test/r_0 first"
    ]
    shutil.rmtree(root / "train")
    with pytest.raises(InputError, match="nor one of any other frame"):
        ss.read_dataset(root)


def test_a_name_that_is_not_there_is_not_its_folder(tmp_path):
    root = blender(tmp_path / "src")
    with pytest.raises(InputError, match=r"nope: expected a folder with transforms_train\.json, found none"):
        ss.import_dataset("blender", root / "nope", tmp_path / "out")
    with pytest.raises(InputError, match=r"nope: expected a dataset folder or a transforms\.json, found nothing"):
        ss.read_dataset(root / "nope")
    assert len(ss.read_dataset(root / "transforms_train.json").frames) == 5


@pytest.mark.parametrize(("size", "mode"), [((16, 12), "RGB"), ((8, 6), "L"), ((8, 6), "RGB")])
@pytest.mark.parametrize("k4", [0.0, 0.001])
def test_silhouettes_are_read_like_masks(tmp_path, size, mode, k4):
    """Of several channels and of another size; those that are copied, too."""
    lens = {"camera_model": "OPENCV_FISHEYE", "k4": k4} if k4 else {}
    root = folder(tmp_path / "src", named(2, silhouette_path="s.png"), **lens)
    left = np.where(np.arange(size[0]) < size[0] // 2, 1, 0)[None].repeat(size[1], 0).astype(np.uint8)
    Image.fromarray(left).convert(mode).save(root / "s.png")
    dataset = imported(root, tmp_path / "out")
    target = frame_target(dataset, dataset.frames[0])
    middle = target.silhouette[3:9, 3:13]
    assert (target.image.alpha[3:9, 3:13] == middle).all()
    assert (middle == (np.arange(3, 13) < 8)).all()
    folder(tmp_path / "tall", named(2, silhouette_path="s.png"))
    Image.new("L", (16, 24)).save(tmp_path / "tall/s.png")
    with pytest.raises(InputError, match="or a multiple or fraction, as its picture, found 16x24"):
        ss.import_dataset("nerfstudio", tmp_path / "tall", tmp_path / "none")


@pytest.mark.parametrize("kind", ["up", "absolute", "both"])
def test_pictures_may_lie_elsewhere(tmp_path, kind):
    """As `read_dataset` takes them."""
    elsewhere = tmp_path / "elsewhere"
    root = folder(tmp_path / "src", named(3))
    (root / "images").rename(elsewhere)
    meta = json.loads((root / "transforms.json").read_text())
    for k, entry in enumerate(meta["frames"]):
        up = kind == "up" or (kind == "both" and k == 0)
        entry["file_path"] = f"../elsewhere/{k}.png" if up else str(elsewhere / f"{k}.png")
    (root / "transforms.json").write_text(json.dumps(meta))
    assert len(ss.read_dataset(root).frames) == 3
    dataset = imported(root, tmp_path / "out")
    assert sorted(frame.file_path for frame in dataset.frames) == [f"images/{k}.png" for k in range(3)]


def test_a_dataset_of_ours_comes_through(tiny_data, tmp_path):
    before, after = ss.read_dataset(tiny_data), imported(tiny_data, tmp_path / "out")
    for one, two in zip(before.frames, after.frames, strict=True):
        assert one.file_path == two.file_path
        np.testing.assert_allclose(one.sun.direction, two.sun.direction, atol=1e-15)
        for name in (one.file_path, one.silhouette_path):
            assert (tiny_data / name).read_bytes() == (tmp_path / "out" / name).read_bytes()
        mine, theirs = (read_png(root / f.depth_file_path) for root, f in ((tiny_data, one), (tmp_path / "out", two)))
        np.testing.assert_array_equal(mine, theirs)


def change(**keys):
    return lambda root: edit(root, lambda meta: meta.update(keys))


def edit(root, what):
    meta = json.loads((root / "transforms.json").read_text())
    what(meta)
    (root / "transforms.json").write_text(json.dumps(meta))


BROKEN = {
    "nothing": (lambda root: (root / "transforms.json").unlink(), "transforms.json: expected a JSON file, found none"),
    "no JSON": (lambda root: (root / "transforms.json").write_text("{"), "transforms.json: expected JSON, found text"),
    "a list": (lambda root: (root / "transforms.json").write_text("[]"), "expected a JSON object, found list"),
    "no frames": (change(frames=[]), "expected a list of frames, found none"),
    "other frames": (change(frames=[1]), "expected a list of frames, found another value"),
    "no pictures": (
        lambda root: [path.unlink() for path in (root / "images").iterdir()],
        "expected an image file, found none",
    ),
    "another model": (change(camera_model="EQUIRECTANGULAR"), "found EQUIRECTANGULAR"),
    "fisheye of words": (change(camera_model="OPENCV_FISHEYE", k2="a"), "expected finite numbers as k1 to k4, found"),
    "another shape": (change(w=12, h=16), "expected 12x16 pixels as its camera says, or a multiple"),
    "no unit": (change(depth_unit_scale_factor=0), "expected metres above 0 as depth_unit_scale_factor, found 0"),
    "unit in words": (change(integer_depth_scale="mm"), "expected metres above 0 as integer_depth_scale, found 'mm'"),
    "no depth": (lambda root: (root / "depth.npy").unlink(), "depth.npy: expected depth, found none"),
    "depth cut": (
        lambda root: (root / "depth.npy").write_bytes((root / "depth.npy").read_bytes()[:-8]),
        "another size",
    ),
    "depth of objects": (
        lambda root: np.save(root / "depth.npy", np.array([{}])),
        "expected an array of NumPy's, found",
    ),
    "depth of colours": (
        lambda root: np.save(root / "depth.npy", np.zeros((12, 16, 3))),
        "expected depth in one channel",
    ),
    "depth of words": (lambda root: np.save(root / "depth.npy", np.array(["a"])), "expected numbers, found <U1"),
    "depth of a shape": (
        lambda root: np.save(root / "depth.npy", np.ones((10, 10))),
        "depth.npy: expected 16x12 pixels, or a multiple or fraction, as its picture, found 10x10",
    ),
    "another name": (change(train_filenames=["images/z.png"]), "its lists, found none for images/z.png"),
    "black mask": (
        lambda root: write_picture(root / "mask.png", color=(0, 0, 0)),
        "masks: expected an object in the pictures, found none; give masks, or masks none",
    ),
    "no mask": (lambda root: (root / "mask.png").unlink(), "mask.png: expected a file, found none"),
    "mask of a shape": (lambda root: write_picture(root / "mask.png", (12, 16)), "mask.png: expected 16x12 pixels, or"),
    "no points": (change(ply_file_path="a.ply"), "a.ply: expected a mesh, found none"),
    "far pose": (
        lambda root: edit(root, lambda m: m["frames"][0]["transform_matrix"][1].__setitem__(3, 1e30)),
        "0.png: expected a camera within 1e+09 m of the origin, found it at",
    ),
    "bent pose": (
        lambda root: edit(root, lambda m: m["frames"][0].update(transform_matrix=[[1] * 4] * 4)),
        "expected a rot",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_folder_ends_in_one_sentence(tmp_path, case):
    damage, sentence = BROKEN[case]
    root = folder(tmp_path / "src", named(3, depth_file_path="depth.npy", mask_path="mask.png"))
    np.save(root / "depth.npy", np.ones((12, 16)))
    write_picture(root / "mask.png", color=(255, 255, 255))
    damage(root)
    with pytest.raises(InputError) as caught:
        ss.import_dataset("nerfstudio", root, tmp_path / "out")
    assert sentence in str(caught.value)
    assert ".png.png" not in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out/transforms.json").exists()


def test_wrong_kinds_and_options(tmp_path, caplog):
    caplog.set_level(logging.ERROR)
    root = folder(tmp_path / "src", named(2))
    with pytest.raises(InputError, match=r"kind: expected one of nerfstudio, .*, found 'nerf'"):
        ss.import_dataset("nerf", root, tmp_path / "out")
    with pytest.raises(InputError, match="depth_unit: expected metres above 0, found -1"):
        ss.import_dataset("nerfstudio", root, tmp_path / "out", depth_unit=-1.0)
    for wrong in ("deep", [1], True):
        with pytest.raises(InputError, match="depth_unit: expected M, found"):
            ss.import_dataset("nerfstudio", root, tmp_path / "out", depth_unit=wrong)
    with pytest.raises(InputError, match=r"expected a folder with transforms_train\.json, found none"):
        ss.import_dataset("blender", root, tmp_path / "out")
    assert len(ss.import_dataset("nerfstudio", str(root), str(tmp_path / "out"), depth_unit="0.01").frames) == 2


def test_training_takes_what_was_imported(spacesim, tmp_path):
    done = spacesim("import", "blender", blender(tmp_path / "src"), "--out", tmp_path / "data")
    assert done.code == 0, done.errors
    few = "--preset", "demo", "--iterations", 2, "--set", "init_count=20"
    assert spacesim("train", tmp_path / "data", "--out", tmp_path / "run", *few).code == 0
