"""SPEED+ folders, made by our exporter or by hand in the layout of the published ones, imported again."""

import itertools
import json
import logging
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as PillowImage
from scipy.spatial.transform import Rotation

from spacesim.data.errors import InputError
from spacesim.data.exporters import labelled_objects, write_speedplus
from spacesim.data.geometry import rotation_from_quaternion
from spacesim.data.images import load_image, read_png
from spacesim.data.importers import speedplus
from spacesim.data.importers.kinds import import_dataset
from spacesim.data.importers.speedplus import import_speedplus
from spacesim.data.store import find_unreadable_files, read_dataset
from spacesim.scenes.generation.generate import generate
from spacesim.scenes.scenefile import read_scene

SIZE = (48, 30)


def labels_of(path: Path) -> list[dict]:
    return json.loads(path.read_text())


@pytest.fixture(scope="module")
def generated(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("speedplus") / "data"
    generate(read_scene("boxsat", views=6, test_views=3, resolution=(40, 30), spp=4, points=50), out)
    return out


@pytest.fixture(scope="module")
def exported(generated) -> Path:
    out = generated.parent / "speedplus"
    write_speedplus(read_dataset(generated), out)
    return out


@pytest.fixture
def published(tmp_path) -> Path:
    """Forty pictures from 2 to 21.5 m, in the layout and with the camera of SPEED+, but smaller."""
    root, random = tmp_path / "speedplus", np.random.default_rng(1)
    camera = {
        "Nu": SIZE[0],
        "Nv": SIZE[1],
        "ppx": 5.86e-6,
        "ppy": 5.86e-6,
        "cameraMatrix": [[74.7, 0, 24], [0, 74.71, 15], [0, 0, 1]],
        "distCoeffs": [-0.2238, 0.5141, -0.000665, -0.000214, -0.1312],
    }
    root.mkdir()
    (root / "camera.json").write_text(json.dumps(camera))
    for domain, names in {"synthetic": ("train", "validation"), "lightbox": ("test",)}.items():
        (root / domain / "images").mkdir(parents=True)
        for number, name in enumerate(names):
            count = 32 if name == "train" else 8
            labels = []
            for k in range(count):
                file = f"img{1000 * number + k:06d}.jpg"
                x, y, z, w = Rotation.random(random_state=random).as_quat().tolist()
                position = [0.1, -0.2, 2 + 0.5 * (k if name == "train" else 4 * k)]
                labels.append({"filename": file, "q_vbs2tango_true": [w, x, y, z], "r_Vo2To_vbs_true": position})
                pixels = random.integers(0, 40, SIZE[::-1]).astype(np.uint8)
                column, row = (74.7 * position[i] / position[2] + (24, 15)[i] for i in (0, 1))
                rows, columns = np.ogrid[: SIZE[1], : SIZE[0]]
                pixels[np.hypot(columns - column, rows - row) < 74.7 * 0.5 / position[2]] += 200  # a ball of 0.5 m
                PillowImage.fromarray(pixels).save(root / domain / "images" / file, quality=95)
            (root / domain / f"{name}.json").write_text(json.dumps(labels))
    return root


def test_our_own_export_read_back_is_equal_to_the_bit(generated, exported, tmp_path):
    """The pose of a frame is the matrix of the label, and the label stays as it was written; a quaternion holds the
    matrix that it was made of to the last digits."""
    first, again = read_dataset(generated), import_speedplus(exported, tmp_path / "data")
    target = labelled_objects(first)[0]
    assert (len(again.train), len(again.test)) == (6, 3)
    written = labels_of(exported / "synthetic/train.json") + labels_of(exported / "synthetic/validation.json")
    entries = labels_of(tmp_path / "data/transforms.json")["frames"]
    for label, entry, made, frame in zip(written, entries, first.frames, again.frames, strict=True):
        turn = rotation_from_quaternion(label["q_vbs2tango_true"])
        np.testing.assert_array_equal(frame.camera.world_from_camera[:3, :3], turn.T)
        x, y, z = label["r_Vo2To_vbs_true"]
        np.testing.assert_array_equal(frame.camera.position, -(x * turn[0] + y * turn[1] + z * turn[2]))
        assert [entry[key] for key in list(label)[1:]] == list(label.values())[1:]
        assert frame.sun is None
        for name in ("width", "height", "fx", "fy", "cx", "cy"):
            assert getattr(frame.camera, name) == getattr(made.camera, name)
        pose = np.linalg.inv(target.world_from_object) @ made.camera.world_from_camera
        np.testing.assert_allclose(frame.camera.world_from_camera, pose, atol=1e-14)
        picture = (exported / "synthetic/images" / label["filename"]).read_bytes()
        assert (again.root / frame.file_path).read_bytes() == picture
    assert find_unreadable_files(again.root) == []


def test_the_export_of_an_import_is_the_first_export_to_the_bit(exported, tmp_path):
    data = import_speedplus(exported, tmp_path / "data")
    write_speedplus(data, tmp_path / "again")
    for name in ("camera.json", "synthetic/train.json", "synthetic/validation.json"):
        assert (tmp_path / "again" / name).read_bytes() == (exported / name).read_bytes()
    for path in (exported / "synthetic/images").iterdir():
        np.testing.assert_array_equal(read_png(tmp_path / "again/synthetic/images" / path.name), read_png(path))
    twice = import_speedplus(tmp_path / "again", tmp_path / "twice")
    for one, two in zip(data.frames, twice.frames, strict=True):
        np.testing.assert_array_equal(one.camera.world_from_camera, two.camera.world_from_camera)
    with pytest.raises(InputError, match="object: expected one of 1 the body, found 'hubble'"):
        write_speedplus(data, tmp_path / "none", "hubble")


def test_poses_that_were_moved_have_labels_of_their_own(exported, tmp_path):
    import_speedplus(exported, tmp_path / "data")

    def move(meta):
        meta["frames"][0]["transform_matrix"][0][3] += 0.5
        meta["frames"][1]["q_vbs2tango_true"] = "none"

    edit(tmp_path / "data/transforms.json", move)
    moved = read_dataset(tmp_path / "data")
    write_speedplus(moved, tmp_path / "again")
    again = import_speedplus(tmp_path / "again", tmp_path / "twice")
    for one, two in zip(moved.frames, again.frames, strict=True):
        np.testing.assert_allclose(one.camera.world_from_camera, two.camera.world_from_camera, atol=1e-13)
    labels = [labels_of(root / "synthetic/train.json") for root in (exported, tmp_path / "again")]
    assert labels[0][0] != labels[1][0]
    assert labels[0][2:] == labels[1][2:]


def test_importing_twice_gives_the_same_bytes(exported, tmp_path):
    for name in ("a", "b"):
        import_dataset("speedplus", exported, tmp_path / name, scale=0.5, count=4)
    files = [path.relative_to(tmp_path / "a") for path in sorted((tmp_path / "a").rglob("*")) if path.is_file()]
    assert len(files) == 2 * 4 + 3  # pictures and silhouettes
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_published_layout(published, tmp_path):
    data = import_speedplus(published, tmp_path / "data")
    assert (len(data.train), len(data.test)) == (32, 8)
    frame, label = data.test[3], labels_of(published / "synthetic/validation.json")[3]
    assert frame.file_path == f"images/{label['filename']}"
    assert frame.distortion == (-0.2238, 0.5141, -0.000665, -0.000214, -0.1312)
    assert (frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy) == (74.7, 74.71, 24, 15)
    w, *xyz = label["q_vbs2tango_true"]
    point = Rotation.from_quat([*xyz, w]).apply([0.3, 0.2, -0.1]) + label["r_Vo2To_vbs_true"]
    seen = frame.camera.camera_from_world @ np.array([0.3, 0.2, -0.1, 1.0])
    np.testing.assert_allclose(seen[:3], point, atol=1e-12)
    assert load_image(data, frame).rgb.shape == (30, 48, 3)
    assert data.ply_file_path is None
    held_out = import_speedplus(published, tmp_path / "lightbox", domain="lightbox")
    assert (len(held_out.train), len(held_out.test)) == (7, 1)  # every eighth


def test_a_distance_limit_and_a_subset(published, tmp_path, caplog):
    with caplog.at_level(logging.INFO):
        near = import_speedplus(published, tmp_path / "near", max_distance=10.0, masks="none")
    assert "20 of 40 pictures are farther than 10 m, left out" in caplog.text
    assert all(np.linalg.norm(frame.camera.position) <= 10 for frame in near.frames)
    assert (len(near.train), len(near.test)) == (16, 4)  # 2 to 9.5 m and 2 to 8 m
    few = import_speedplus(published, tmp_path / "few", max_distance=10.0, count=10)
    other = import_speedplus(published, tmp_path / "other", max_distance=10.0, count=10, seed=1)
    assert (len(few.train), len(few.test)) == (8, 2)
    assert {frame.file_path for frame in few.frames} < {frame.file_path for frame in near.frames}
    assert [frame.file_path for frame in few.train] != [frame.file_path for frame in other.train]
    numbers = [int(Path(frame.file_path).stem[3:]) for frame in few.train]
    assert [number // 2 for number in numbers] == list(range(8))  # one of each pair
    for count, seed in itertools.product(range(3, 20), range(5)):  # pieces that are not whole
        labels = speedplus._draw(list(range(20)), count, np.random.default_rng(seed))
        assert labels == sorted(set(labels))
        assert len(labels) == count
    two = import_speedplus(published, tmp_path / "two", count=2)
    assert (len(two.train), len(two.test)) == (1, 1)
    all_ = import_speedplus(published, tmp_path / "all", count=1000, masks="none")
    assert len(all_.frames) == 40
    assert "expected 1000 pictures, found 40: all are taken" in caplog.text


def test_pictures_are_resized_by_means_over_areas(published, tmp_path):
    data = import_speedplus(published, tmp_path / "data", scale=0.5)
    frame = data.train[0]
    camera = frame.camera
    assert (camera.width, camera.height, camera.fx, camera.cy) == (24, 15, 37.35, 7.5)
    full = read_png(published / "synthetic/images/img000000.jpg").astype(np.float64)
    means = full.reshape(15, 2, 24, 2).mean(axis=(1, 3))
    assert np.abs(read_png(data.root / frame.file_path) - means).max() <= 1
    assert frame.distortion[0] == -0.2238


def test_masks_are_silhouettes(published, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    masks = published / "synthetic/masks"
    masks.mkdir()
    shape = np.zeros(SIZE[::-1], np.uint8)
    shape[8:20, 10:30] = 255
    PillowImage.fromarray(shape).save(masks / "img000000.jpg", quality=60)  # which rings
    PillowImage.fromarray(shape).save(masks / "img000001.png")
    for scale in (1.0, 0.5):
        data = import_speedplus(published, tmp_path / f"{scale}", scale=scale)
        step = round(1 / scale)
        for frame in data.train[:2]:
            np.testing.assert_array_equal(read_png(data.root / frame.silhouette_path), shape[::step, ::step])
        assert data.train[2].silhouette_path is None
    assert f"masks: those of {masks}" in caplog.text
    assert json.loads((data.root / "import.json").read_text())["masks"] == str(masks)
    ignored = import_speedplus(published, tmp_path / "ignored", masked="unknown")
    assert ignored.train[0].silhouette_path is None
    np.testing.assert_array_equal(read_png(ignored.root / ignored.train[1].mask_path), shape)
    elsewhere = tmp_path / "by-hand"
    elsewhere.mkdir()
    PillowImage.fromarray(255 - shape).save(elsewhere / "img000001.png")
    data = import_speedplus(published, tmp_path / "other", masks=elsewhere)
    np.testing.assert_array_equal(read_png(data.root / data.train[1].silhouette_path), 255 - shape)
    assert data.train[0].silhouette_path is None


def test_masks_that_show_nothing_are_counted(published, tmp_path, caplog):
    masks = published / "synthetic/masks"
    masks.mkdir()
    for k in range(3):
        PillowImage.new("L", SIZE, 255 * (k == 0)).save(masks / f"img{k:06d}.png")
    import_speedplus(published, tmp_path / "some")
    assert "masks: nothing is found in 2 of 3 pictures, img000001.jpg first" in caplog.text
    PillowImage.new("L", SIZE).save(masks / "img000000.png")
    with pytest.raises(InputError, match=r"^masks: expected an object in the pictures, found none"):
        import_speedplus(published, tmp_path / "all")
    assert not (tmp_path / "all").exists()


def test_missing_pictures_are_skipped_with_one_warning(published, tmp_path, caplog):
    for number in (3, 4, 20):
        (published / f"synthetic/images/img{number:06d}.jpg").unlink()
    with caplog.at_level(logging.WARNING):
        data = import_speedplus(published, tmp_path / "data", masks="none")
    assert [r.getMessage() for r in caplog.records] == [
        f"{published / 'synthetic/images'}: 3 of 40 pictures are missing, their frames are skipped"
    ]
    assert len(data.train) == 29


def test_speed_has_its_own_names_and_camera(published, tmp_path):
    root = tmp_path / "speed"
    (root / "images/train").mkdir(parents=True)
    labels = labels_of(published / "synthetic/train.json")[:16]
    for label in labels:
        label["q_vbs2tango"] = label.pop("q_vbs2tango_true")
        PillowImage.new("L", (1920, 1200)).save(root / "images/train" / label["filename"])
    (root / "train.json").write_text(json.dumps(labels))
    data = import_speedplus(root, tmp_path / "data", scale=0.1)
    assert (len(data.train), len(data.test)) == (14, 2)
    assert data.train[0].camera.fx == pytest.approx(0.1 * 0.0176 / 5.86e-6)
    assert (data.train[0].camera.width, data.train[0].camera.cx) == (192, 96.0)


def edit(path: Path, change) -> None:
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


@pytest.mark.parametrize(
    ("file", "change", "words"),
    [
        (
            "synthetic/train.json",
            lambda v: v[2].update(q_vbs2tango_true=[1, 1, 0, 0]),
            "length 1, found one of length 1.4",
        ),
        ("synthetic/train.json", lambda v: v[2].update(q_vbs2tango_true=[1, 0, 0]), "4 finite numbers"),
        ("synthetic/train.json", lambda v: v[2].pop("q_vbs2tango_true"), "q_vbs2tango, found None"),
        ("synthetic/train.json", lambda v: v[2].update(r_Vo2To_vbs_true=[0, 0, "far"]), "3 finite numbers"),
        ("synthetic/train.json", lambda v: v[2].update(r_Vo2To_vbs_true=[0, 0, 1e300]), "position within"),
        ("synthetic/train.json", lambda v: v[2].update(r_Vo2To_vbs_true=[0, 0, -5]), "before the camera, z above 0"),
        ("synthetic/train.json", lambda v: v[2].update(filename="../../train.json"), "file name below"),
        ("synthetic/train.json", lambda v: v[2].update(filename=7), "file name below"),
        ("synthetic/train.json", lambda v: v[2].update(filename="img000000.jpg"), "each image once"),
        ("synthetic/train.json", lambda v: v.clear(), "expected labels of pictures, found none"),
        ("camera.json", lambda v: v.pop("Nu"), "expected Nu, Nv, cameraMatrix"),
        ("camera.json", lambda v: v.update(cameraMatrix=[[1, 2], [3, 4]]), "expected Nu, Nv, cameraMatrix"),
        ("camera.json", lambda v: v.update(cameraMatrix=[[0, 0, 0]] * 3), "focal lengths"),
        ("camera.json", lambda v: v.update(distCoeffs=[1] * 8), "at most five distCoeffs"),
        ("camera.json", lambda v: v.update(distCoeffs=[1e9, 0]), "expected distCoeffs up to 100, found"),
        ("camera.json", lambda v: v["cameraMatrix"][0].__setitem__(1, 3.0), "without skew, found 3 in its first row"),
        ("camera.json", lambda v: v.update(Nu=1920), "expected 1920x30 pixels as camera.json says, found 48x30"),
    ],
)
def test_broken_folders_end_in_one_sentence(published, tmp_path, file, change, words):
    edit(published / file, change)
    with pytest.raises(InputError, match=words) as caught:
        import_speedplus(published, tmp_path / "data")
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)


def small_speedplus(root, **pictures):
    """A folder whose pictures are given by their names, "a_png" for a.png."""
    (root / "synthetic/images").mkdir(parents=True)
    camera = {"Nu": 4, "Nv": 2, "cameraMatrix": [[5, 0, 2], [0, 5, 1], [0, 0, 1]], "distCoeffs": []}
    (root / "camera.json").write_text(json.dumps(camera))
    names = [name.replace("_", ".") for name in pictures]
    for name, pixels in zip(names, pictures.values(), strict=True):
        PillowImage.fromarray(pixels).save(root / "synthetic/images" / name)
    pose = {"q_vbs2tango_true": [1, 0, 0, 0], "r_Vo2To_vbs_true": [0, 0, 3]}
    (root / "synthetic/train.json").write_text(json.dumps([{"filename": name, **pose} for name in names]))
    return root


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_names_that_differ_in_their_suffix_stay_apart(tmp_path, scale):
    grey = np.zeros((2, 4), np.uint8)
    root = small_speedplus(tmp_path / "src", a_png=grey, a_bmp=grey)
    (root / "synthetic/masks").mkdir()
    for name, value in (("a.png.png", 255), ("a.bmp.png", 0)):
        PillowImage.fromarray(grey + np.uint8(value)).save(root / "synthetic/masks" / name)
    data = import_speedplus(root, tmp_path / "data", scale=scale)
    alphas = {Path(frame.file_path).stem: load_image(data, frame).alpha.mean() for frame in data.frames}
    assert alphas == {"a_png": 1, "a_bmp": 0}


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_no_picture_counts_twice(published, tmp_path, scale):
    edit(published / "synthetic/validation.json", lambda labels: labels[3].update(filename="img000004.jpg"))
    shutil.copy(published / "synthetic/images/img000004.jpg", published / "synthetic/images/img001003.jpg")
    words = r"speedplus/synthetic/train\.json: expected each image once, found img000004\.jpg twice"
    with pytest.raises(InputError, match=words):
        import_speedplus(published, tmp_path / "data", scale=scale)
    assert not (tmp_path / "data").exists()


def test_scaled_pictures_keep_alpha_and_depth_of_colour(tmp_path):
    clear, deep = np.zeros((2, 4, 4), np.uint8), np.arange(8, dtype=np.uint16).reshape(2, 4) * 9000
    clear[:, 0] = 200, 100, 50, 255
    clear[:, 1] = 7, 8, 9, 0  # whatever colour it has
    root = small_speedplus(tmp_path / "src", clear_png=clear, deep_png=deep)
    data = import_speedplus(root, tmp_path / "data", scale=0.5)
    pixels = {Path(frame.file_path).stem: read_png(data.root / frame.file_path) for frame in data.frames}
    np.testing.assert_array_equal(pixels["clear"], [[[200, 100, 50, 128], [0, 0, 0, 0]]])
    np.testing.assert_array_equal(pixels["deep"], deep.reshape(2, 2, 2).mean(axis=(0, 2), dtype=float)[None])
    assert pixels["deep"].dtype == np.uint16


def test_broken_files_end_in_one_sentence(published, tmp_path):
    path = published / "synthetic/train.json"
    whole = path.read_text()
    path.write_text(whole[:-20])
    with pytest.raises(InputError, match=r"train\.json: expected JSON"):
        import_speedplus(published, tmp_path / "data")
    path.write_text('{"filename": "a"}')
    with pytest.raises(InputError, match="expected a list of labels"):
        import_speedplus(published, tmp_path / "data")
    path.write_text(whole)
    with pytest.raises(InputError, match=r"within 1 m .*found none of 40 labels"):
        import_speedplus(published, tmp_path / "data", max_distance=1.0)
    (published / "camera.json").unlink()
    with pytest.raises(InputError, match=r"camera\.json"):
        import_speedplus(published, tmp_path / "data")
    with pytest.raises(InputError, match="expected a folder of SPEED"):
        import_speedplus(published, tmp_path / "data", domain="sunlamp")
    assert not (tmp_path / "data").exists()
    shutil.rmtree(published)
    with pytest.raises(InputError, match="expected a folder of SPEED"):
        import_speedplus(published, tmp_path / "data")


@pytest.mark.parametrize(
    "option",
    [
        *({"domain": "moon"}, {"max_distance": -1.0}, {"max_distance": float("inf")}, {"count": 1}),
        *({"scale": 0.0}, {"scale": 2.0}, {"seed": -1}),
    ],
)
def test_wrong_options_are_refused(published, tmp_path, option):
    with pytest.raises(InputError, match=f"^{next(iter(option))}: expected"):
        import_speedplus(published, tmp_path / "data", **option)
