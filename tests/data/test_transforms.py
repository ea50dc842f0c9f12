"""Folders from elsewhere: Nerfstudio's rules, Blender's pair, and hostile input."""

import json
import math

import numpy as np
import pytest
from PIL import Image as PillowImage

from spacesim.data.earth import EARTH_ALBEDO
from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at
from spacesim.data.images import load_image
from spacesim.data.store import find_unreadable_files
from spacesim.data.transforms import read_dataset

POSE = [[1, 0, 0, 0.5], [0, 0, -1, -4], [0, 1, 0, 1], [0, 0, 0, 1]]
INTRINSICS = {"fl_x": 20.0, "fl_y": 21.0, "cx": 7.5, "cy": 6.0, "w": 16, "h": 12}


def write_folder(root, names, name="transforms.json", frame=None, **meta):
    for file_path in names:
        path = root / (file_path if file_path.endswith((".png", ".jpg")) else f"{file_path}.png")
        path.parent.mkdir(parents=True, exist_ok=True)
        PillowImage.new("RGB", (16, 12), (10, 20, 30)).save(path)
    frames = [{"file_path": file_path, "transform_matrix": POSE, **(frame or {})} for file_path in names]
    (root / name).write_text(json.dumps({**INTRINSICS, "frames": frames, **meta}))
    return root


def names_of(frames):
    return [frame.file_path for frame in frames]


def test_camera_and_pose(tmp_path):
    dataset = read_dataset(write_folder(tmp_path, ["images/a.jpg"], applied_transform=[[0, 1, 0, 0]], aabb_scale=4))
    (frame,) = dataset.train
    camera = frame.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (20.0, 21.0, 7.5, 6.0)
    assert (camera.width, camera.height) == (16, 12)
    # OpenGL's camera at (0.5, -4, 1) looks along +y: in OpenCV's axes x right, y down (-z), z forward (+y).
    expected = [[1, 0, 0, 0.5], [0, 0, 1, -4], [0, -1, 0, 1], [0, 0, 0, 1]]
    np.testing.assert_array_equal(camera.world_from_camera, expected)
    assert frame.sun is frame.gt_path is frame.mask_path is dataset.ply_file_path is None
    assert frame.distortion == ()
    assert dataset.scene == {}
    image = load_image(dataset, frame)
    assert image.alpha.min() == 1
    assert image.valid.all()


def test_the_json_itself_may_be_named(tmp_path):
    write_folder(tmp_path, ["images/a.png", "images/b.png"], name="cameras.json")
    assert names_of(read_dataset(tmp_path / "cameras.json").frames) == ["images/b.png", "images/a.png"]


def test_frames_without_an_image_are_left_out_with_one_warning(tmp_path, caplog):
    names = [f"images/{k}.png" for k in range(6)]
    write_folder(tmp_path, names, train_filenames=names[:5], test_filenames=names[5:])
    for k in (1, 4):
        (tmp_path / names[k]).unlink()
    dataset = read_dataset(tmp_path)
    assert names_of(dataset.train) == ["images/0.png", "images/2.png", "images/3.png"]
    assert names_of(dataset.test) == ["images/5.png"]
    assert dataset.missing == ("images/1.png", "images/4.png")
    (record,) = caplog.records
    path = tmp_path / "transforms.json"
    assert record.getMessage() == f"{path}: 2 of 6 frames have no image and are left out, images/1.png first"
    assert [problem.split(":")[0] for problem in find_unreadable_files(tmp_path)] == [
        str(tmp_path / name) for name in dataset.missing
    ]


def test_exposures_that_are_no_factors_are_named(tmp_path, caplog):
    """What is no number means something else to others."""
    values = [1e-4, 0, -1.0, math.nan, math.inf, "f/8", None]
    names = [f"{k}.png" for k in range(len(values))]
    path = write_folder(tmp_path, names, test_filenames=names[-1:]) / "transforms.json"
    meta = json.loads(path.read_text())
    for frame, value in zip(meta["frames"], values, strict=True):
        frame["exposure"] = value
    path.write_text(json.dumps(meta))
    dataset = read_dataset(tmp_path)
    assert [frame.exposure for frame in (*dataset.train, *dataset.test)] == [1e-4, *[None] * 6]
    assert "exposure of 4 frames (1.png first) is not above 0, so not read" in caplog.text


def test_intrinsics_of_the_frame_win(tmp_path):
    frame = read_dataset(write_folder(tmp_path, ["a.png"], frame={"fl_x": 33.0})).train[0]
    assert (frame.camera.fx, frame.camera.fy) == (33.0, 21.0)


def test_angle_of_view_and_size_of_the_image(tmp_path):
    write_folder(tmp_path, ["a.png"])
    meta = json.loads((tmp_path / "transforms.json").read_text())
    meta = {"camera_angle_x": 1.2, "frames": meta["frames"]}
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    camera = read_dataset(tmp_path).train[0].camera
    assert (camera.width, camera.height, camera.cx, camera.cy) == (16, 12, 8, 6)
    assert camera.fx == camera.fy == pytest.approx(8 / np.tan(0.6))


def test_distortion_in_opencvs_order(tmp_path):
    coefficients = {"k1": 0.1, "k2": 0.2, "k3": 0.3, "p1": 0.4, "p2": 0.5}
    dataset = read_dataset(write_folder(tmp_path, ["a.png"], camera_model="OPENCV", **coefficients))
    assert dataset.train[0].distortion == (0.1, 0.2, 0.4, 0.5, 0.3)


def test_suns(tmp_path):
    frame = read_dataset(write_folder(tmp_path, ["a.png"], frame={"sun_direction": [0, 0, 5]})).train[0]
    np.testing.assert_array_equal(frame.sun.direction, [0, 0, 1])
    angles = {"sun_azimuth_deg": 90, "sun_elevation_deg": 0}
    frame = read_dataset(write_folder(tmp_path, ["a.png"], frame=angles)).train[0]
    np.testing.assert_allclose(frame.sun.direction, [0, 1, 0], atol=1e-15)


def test_a_principal_point_may_lie_where_crops_have_it_and_no_farther(tmp_path):
    for cx in (-4000, 16_384):
        assert read_dataset(write_folder(tmp_path, ["a.png"], cx=cx)).train[0].camera.cx == cx
    write_folder(tmp_path, ["a.png"], cx=1e6)
    with pytest.raises(InputError, match=r"frame a\.png: expected cx and cy within 16384 pixels, found 1e\+06 and 6"):
        read_dataset(tmp_path)


def test_a_lens_that_folds_over_nearly_all_of_its_picture_is_refused(tmp_path):
    """Of 0.8 by 0.6 at depth 1: k1 = -2 turns back 0.41 from the axis, imaged at 0.27; k1 = -50 images 0.05."""
    for k1 in (-2, -0.8, 50):
        dataset = read_dataset(write_folder(tmp_path, ["a.png"], camera_model="OPENCV", k1=k1))
        assert dataset.train[0].distortion[0] == k1
    for k1 in (-50, -1e30):
        write_folder(tmp_path, ["a.png"], camera_model="OPENCV", k1=k1)
        with pytest.raises(InputError, match=r"frame a\.png: expected a lens that images 10 % of the picture before"):
            read_dataset(tmp_path)


def test_earths(tmp_path):
    lit = {"sun_direction": [0, 0, 1], "earth_direction": [0, -2, 0], "earth_angular_radius_deg": 60}
    earth = read_dataset(write_folder(tmp_path, ["a.png"], frame=lit)).train[0].sun.earth
    np.testing.assert_array_equal(earth.direction, [0, -1, 0])
    assert (earth.angular_radius_deg, earth.albedo) == (60, EARTH_ALBEDO)
    angles = {"sun_azimuth_deg": 90, "sun_elevation_deg": 0, "earth_direction": [1, 0, 0]}
    own = {**angles, "earth_angular_radius_deg": 20, "earth_albedo": 0.1}
    assert read_dataset(write_folder(tmp_path, ["a.png"], frame=own)).train[0].sun.earth.albedo == 0.1


def test_a_null_counts_as_absent(tmp_path):
    frame = {"sun_direction": None, "mask_path": None}
    dataset = read_dataset(write_folder(tmp_path, ["a.png", "b.png"], frame=frame, k1=None, train_filenames=None))
    assert dataset.frames[0].sun is None
    assert dataset.frames[0].distortion == ()
    assert names_of(dataset.test) == ["a.png"]


def test_truth_is_named_and_not_looked_for(tmp_path):
    frame = {"gt_path": "gt/a.exr", "depth_file_path": "depth/a.png", "mask_path": "./masks/a.png"}
    found = read_dataset(write_folder(tmp_path, ["a.png"], frame=frame)).train[0]
    assert (found.gt_path, found.depth_file_path, found.mask_path) == (
        "gt/a.exr",
        "depth/a.png",
        "masks/a.png",
    )
    assert found.shadow_path is None


TWENTY = [f"images/{k:02d}.png" for k in range(20)]


@pytest.mark.parametrize(
    ("names", "meta", "test"),
    [
        (TWENTY, {}, [TWENTY[0], TWENTY[8], TWENTY[16]]),
        (TWENTY[:2], {}, TWENTY[:1]),
        (TWENTY[:1], {}, []),
        (TWENTY, {"train_filenames": TWENTY[:5], "test_filenames": TWENTY[9:]}, TWENTY[9:]),
        (TWENTY, {"train_filenames": TWENTY[:5], "val_filenames": TWENTY[6:7]}, TWENTY[6:7]),
        (
            TWENTY,
            {"train_filenames": TWENTY[:5], "val_filenames": TWENTY[6:7], "test_filenames": TWENTY[8:9]},
            TWENTY[8:9],
        ),
        (TWENTY, {"train_filenames": TWENTY[:18]}, TWENTY[18:]),
        (TWENTY, {"test_filenames": ["./" + TWENTY[3]]}, TWENTY[3:4]),
        (["train/a.png", "train/b.png", "test/c.png"], {}, ["test/c.png"]),
        (["train/a.png", "val/b.png"], {}, ["val/b.png"]),
        (["train/a.png", "train/b.png"], {}, ["train/a.png"]),
        (["a_train.png", "b_test.png"], {}, ["a_train.png"]),
    ],
)
def test_split(tmp_path, names, meta, test):
    dataset = read_dataset(write_folder(tmp_path, list(reversed(names)), **meta))
    assert names_of(dataset.test) == test
    expected = meta.get("train_filenames", [name for name in names if name not in test])
    assert names_of(dataset.train) == expected


def test_blenders_pair(tmp_path):
    write_folder(tmp_path, ["./train/r_0", "./train/r_1"], name="transforms_train.json")
    write_folder(tmp_path, ["./test/r_0.5"], name="transforms_test.json")
    for path in (tmp_path, tmp_path / "transforms_train.json"):
        dataset = read_dataset(path)
        assert names_of(dataset.train) == ["train/r_0.png", "train/r_1.png"]
        assert names_of(dataset.test) == ["test/r_0.5.png"]


def break_json(root, change):
    meta = json.loads((root / "transforms.json").read_text())
    change(meta)
    (root / "transforms.json").write_text(json.dumps(meta))


def set_pose(value):
    return lambda meta: meta["frames"][0].update(transform_matrix=value)


def test_rotations_of_rounded_numbers_are_the_nearest(tmp_path):
    exact = look_at([1, 2, 3], [0.2, 0, 0])
    for decimals, off in ((3, 1e-3), (9, 1e-8)):
        frame = {"transform_matrix": exact.round(decimals).tolist()}
        found = read_dataset(write_folder(tmp_path / str(decimals), ["a.png"], frame=frame)).train[0].camera
        rotation = found.opengl[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14 if decimals == 3 else 1e-8)
        np.testing.assert_allclose(found.opengl, exact, atol=off)


NAN_POSE = [[float("nan"), 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda m: m.update(frames=[]), "expected a list of frames, found none"),
        (lambda m: m.pop("frames"), "expected a list of frames, found none"),
        (lambda m: m.update(frames={"a": 1}), "expected a list of frames"),
        (lambda m: m.update(frames=[3]), "expected a list of frames"),
        (lambda m: m["frames"][0].pop("file_path"), "file_path"),
        (lambda m: m["frames"][0].update(file_path=7), "file path as file_path, found 7"),
        (
            lambda m: [frame.update(file_path=f"images/absent{k}.png") for k, frame in enumerate(m["frames"])],
            "absent0.png: expected an image file, found none, nor one of any other frame",
        ),
        (lambda m: m["frames"].append(m["frames"][0]), "images/a.png twice"),
        (set_pose(NAN_POSE), "images/a.png: expected a transform_matrix of 4x4 finite"),
        (set_pose(None), "images/a.png: expected a transform_matrix"),
        (set_pose([[1, 2], [3]]), "images/a.png: expected a transform_matrix"),
        (set_pose(np.diag([1, 1, 1, 2]).tolist()), "expected 0 0 0 1 as the last row of transform_matrix, found"),
        (lambda m: m.update(is_fisheye="yes"), "expected true or false as is_fisheye, found 'yes'"),
        (set_pose("identity"), "images/a.png: expected a transform_matrix"),
        (set_pose(np.diag([2, 2, 2, 1]).tolist()), "images/a.png: world_from_camera: expected a rotation"),
        (set_pose(look_at([1, 2, 3], [0, 0, 0]).round(1).tolist()), "world_from_camera: expected a rotation"),
        (lambda m: m.update(fl_x=-1), "images/a.png: camera: expected focal lengths above 0"),
        (lambda m: m.update(fl_x="wide"), "expected a finite number as fl_x, found 'wide'"),
        (lambda m: m.update(cx=float("inf")), "expected a finite number as cx, found inf"),
        (lambda m: (m.pop("fl_x"), m.pop("fl_y")), "expected fl_x or camera_angle_x"),
        (lambda m: m.update(w=0), "at least 1x1 pixels, found 0x12"),
        (lambda m: m.update(camera_model="OPENCV_FISHEYE"), "found OPENCV_FISHEYE"),
        (lambda m: m.update(camera_model="EQUIRECTANGULAR"), "found EQUIRECTANGULAR"),
        (lambda m: m.update(camera_model="two\nlines"), r"found 'two\nlines'"),
        (lambda m: m.update(fl_y=0), "images/a.png: camera: expected focal lengths above 0"),
        (lambda m: m.update(k4=0.1), "found k4"),
        (lambda m: m["frames"][0].update(sun_direction=[0, 0, 0]), "sun_direction"),
        (lambda m: m["frames"][0].update(sun_direction="up"), "sun_direction"),
        (lambda m: m["frames"][0].update(sun_direction=[10**400, 0, 0]), "sun_direction"),
        (lambda m: m["frames"][0].update(sun_direction=[0, 0, 1], earth_direction=[0, 0, 1]), "earth_angular_radius"),
        (
            lambda m: m["frames"][0].update(sun_direction=[0, 0, 1], earth_direction="up", earth_angular_radius_deg=9),
            "earth_direction: expected 3 finite numbers",
        ),
        (lambda m: m.update(w=10**400), "expected a finite number as w"),
        (lambda m: m["frames"][0]["transform_matrix"][0].__setitem__(0, 10**400), "transform_matrix"),
        (lambda m: (m.pop("fl_x"), m.pop("fl_y"), m.update(camera_angle_x=0)), "camera_angle_x, found 0"),
        (lambda m: m.update(frames=[{**m["frames"][0], "file_path": "x" * 5000}]), "expected an image file"),
        (lambda m: m.update(train_filenames=["images/z.png"]), "none for images/z.png"),
        (lambda m: m.update(train_filenames="images/a.png"), "lists of file paths"),
        (lambda m: m.update(test_filenames=["images/a.png", "images/b.png"]), "frames to train on"),
        (
            lambda m: m.update(train_filenames=["images/a.png"], test_filenames=["images/a.png"]),
            "images/a.png in both",
        ),
        (lambda m: m.update(ply_file_path=3), "ply_file_path"),
    ],
)
def test_hostile_json_is_refused_in_one_sentence(tmp_path, change, sentence):
    write_folder(tmp_path, ["images/a.png", "images/b.png"])
    break_json(tmp_path, change)
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path)
    message = str(caught.value)
    assert message.startswith(str(tmp_path / "transforms.json"))
    assert sentence in message
    assert "\n" not in message


CUT_OFF = [
    "",
    "{",
    '{"frames": [{"file_path": "a.pn',
    "[]",
    "3",
    "\x00\x01",
    "null",
    100_000 * "[",
    f'{{"w": {5000 * "9"}}}',
]


@pytest.mark.parametrize("content", CUT_OFF, ids=range(len(CUT_OFF)))
def test_cut_off_json_is_refused(tmp_path, content):
    (tmp_path / "transforms.json").write_text(content)
    with pytest.raises(InputError, match=r"transforms\.json"):
        read_dataset(tmp_path)


def test_folders_that_are_no_dataset(tmp_path):
    with pytest.raises(InputError, match="found nothing"):
        read_dataset(tmp_path / "absent")
    with pytest.raises(InputError, match=r"a transforms\.json, found none"):
        read_dataset(tmp_path)
    (tmp_path / "scene.json").write_text("{}")
    with pytest.raises(InputError, match="unfinished one; generate with resume=True completes it"):
        read_dataset(tmp_path)


def test_an_image_without_size_in_the_json_must_be_an_image(tmp_path):
    write_folder(tmp_path, ["images/a.png"])
    break_json(tmp_path, lambda meta: (meta.pop("w"), meta.pop("h")))
    (tmp_path / "images/a.png").write_bytes(b"\x89PNG")
    with pytest.raises(InputError, match=r"a\.png"):
        read_dataset(tmp_path)


def test_sizes_are_checked_on_loading(tmp_path):
    dataset = read_dataset(write_folder(tmp_path, ["images/a.png"], w=32, h=24))
    with pytest.raises(InputError, match=r"images/a\.png: expected 32x24 .* found 16x12"):
        load_image(dataset, dataset.train[0])
