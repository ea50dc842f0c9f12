"""COLMAP projects: models that the tests write themselves and those of pycolmap, their pictures and masks."""

import logging
import shutil

import numpy as np
import pytest
from colmap_files import (
    EXAMPLES,
    WRITERS,
    ColmapImage,
    Model,
    imported,
    lens_of,
    project,
    ring,
    write_binary,
    write_masks,
    write_pictures,
    write_text,
)
from PIL import Image

import spacesim as ss
from spacesim.data.errors import InputError
from spacesim.data.importers.colmap_model import read_model
from spacesim.data.store import find_unreadable_files, read_points


@pytest.mark.parametrize("form", WRITERS)
@pytest.mark.parametrize("place", ["", "sparse", "sparse/0"])
def test_a_model_comes_through(tmp_path, form, place):
    model = ring()
    dataset = imported(project(tmp_path / "src", model, form, sparse=place), tmp_path / "out")
    assert [frame.file_path for frame in dataset.test] == ["images/view 0.png"]
    assert [frame.file_path for frame in dataset.train] == [f"images/view {k}.png" for k in range(1, 5)]
    assert find_unreadable_files(tmp_path / "out") == []
    frames = sorted(dataset.frames, key=lambda frame: frame.file_path)
    for image, frame in zip(model.images, frames, strict=True):
        w, x, y, z, *shift = image.pose
        axis_angle = 2 * np.arctan2(y, w)  # poses of `ring` turn about y
        rotation = [
            [np.cos(axis_angle), 0, np.sin(axis_angle)],
            [0, 1, 0],
            [-np.sin(axis_angle), 0, np.cos(axis_angle)],
        ]
        assert x == z == 0
        point = np.array([0.3, -0.4, 0.5])
        expected = np.array(rotation) @ point + shift
        pose = frame.camera.camera_from_world
        np.testing.assert_allclose(pose[:3, :3] @ point + pose[:3, 3], expected, atol=1e-12)
        camera = frame.camera
        assert (camera.width, camera.height, camera.fx, camera.fy) == (16, 12, 20.0, 20.0)
        assert (camera.cx, camera.cy, frame.distortion, frame.mask_path) == (8.0, 6.0, (), None)
        source = tmp_path / "src/images" / image.name
        assert (tmp_path / "out" / frame.file_path).read_bytes() == source.read_bytes()
    points, colors = read_points(tmp_path / "out" / dataset.ply_file_path)
    np.testing.assert_allclose(points, [xyz for xyz, _ in model.points.values()], rtol=1e-6)
    np.testing.assert_array_equal(colors, [rgb for _, rgb in model.points.values()])


def test_the_folder_of_the_model_itself_may_be_named(tmp_path):
    project(tmp_path / "src")
    assert len(imported(tmp_path / "src/sparse/0", tmp_path / "out").frames) == 5


@pytest.mark.parametrize("form", WRITERS)
def test_the_same_twice_is_the_same_to_the_byte(tmp_path, form):
    project(tmp_path / "src", ring(cameras={1: ("FISHEYE", 16, 12, (20.0, 20.0, 8.0, 6.0))}), form)
    for name in ("one", "two"):
        imported(tmp_path / "src", tmp_path / name)
    one, two = (
        {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}
        for root in (tmp_path / "one", tmp_path / "two")
    )
    assert one == two
    assert len([name for name in one if name.startswith("images/")]) == 5


@pytest.mark.parametrize("form", WRITERS)
def test_what_pycolmap_writes_comes_through(tmp_path, form):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    theirs = pycolmap.Reconstruction()
    rng = np.random.default_rng(3)
    for number, name in enumerate(EXAMPLES, start=1):
        lens = lens_of(name)
        model = getattr(pycolmap.CameraModelId, name, None)
        if model is None:  # of an older pycolmap
            continue
        camera = pycolmap.Camera(model=model, width=64, height=48, params=list(lens.parameters), camera_id=number)
        theirs.add_camera_with_trivial_rig(camera)
        turn = rng.normal(size=4)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn / np.linalg.norm(turn)), rng.normal(size=3))
        image = pycolmap.Image(name=f"{name}.png", camera_id=number, image_id=number)
        theirs.add_image_with_trivial_frame(image, pose)
    for _ in range(30):
        theirs.add_point3D(rng.normal(size=3), pycolmap.Track(), rng.integers(0, 256, 3).astype(np.uint8))
    (tmp_path / "sparse").mkdir()
    (theirs.write_binary if form == "binary" else theirs.write_text)(str(tmp_path / "sparse"))
    ours = read_model(tmp_path / "sparse")
    assert len(ours.images) == len(theirs.images) >= 12
    by_name = {image.name: image for image in ours.images}
    for image in theirs.images.values():
        lens, pose = ours.cameras[image.camera_id], np.linalg.inv(by_name[image.name].world_from_camera)
        np.testing.assert_allclose(pose[:3], image.cam_from_world().matrix(), atol=1e-12)
        assert (lens.model.name, lens.width, lens.height) == (image.camera.model.name, 64, 48)
        np.testing.assert_allclose(lens.parameters, image.camera.params, rtol=1e-15)
    points = {number: (point.xyz, point.color) for number, point in theirs.points3D.items()}
    np.testing.assert_allclose(ours.points, [points[number][0] for number in ours.numbers], rtol=1e-15)
    np.testing.assert_array_equal(ours.colors, [points[number][1] for number in ours.numbers])
    write_pictures(tmp_path / "images", by_name, (64, 48))
    dataset = imported(tmp_path, tmp_path / "out")
    assert {frame.file_path for frame in dataset.frames} == {f"images/{name}" for name in by_name}
    assert find_unreadable_files(tmp_path / "out") == []


KEPT = {
    "SIMPLE_RADIAL": (0.1, 0, 0, 0, 0),
    "RADIAL": (0.1, -0.05, 0, 0, 0),
    "OPENCV": (0.1, -0.05, 0.01, -0.02, 0),
    "PINHOLE": (),
}


@pytest.mark.parametrize("name", KEPT)
def test_lenses_that_our_cameras_have_are_kept(tmp_path, name):
    lens = lens_of(name)
    root = project(tmp_path / "src", ring(2, cameras={1: (name, 64, 48, lens.parameters)}), size=(64, 48))
    frame = imported(root, tmp_path / "out").frames[0]
    assert frame.distortion == KEPT[name]
    assert (frame.camera.fx, frame.camera.cx) == (40.0, 33.0)
    assert frame.mask_path is None
    assert (tmp_path / "out" / frame.file_path).read_bytes() == (root / frame.file_path).read_bytes()


@pytest.mark.parametrize("size", [(16, 12), (8, 6), (32, 24), (5, 4)])
def test_pictures_of_any_scale(tmp_path, size):
    root = project(tmp_path / "src", ring(cameras={1: ("OPENCV", 16, 12, (20.0, 21.0, 8.5, 6.5, 0.1, 0, 0, 0))}))
    write_pictures(root / "images_x", [f"view {k}.png" for k in range(5)], size)
    frame = imported(root, tmp_path / "out", images=root / "images_x").frames[0]
    camera, x, y = frame.camera, size[0] / 16, size[1] / 12
    assert (camera.width, camera.height) == size
    np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], [20 * x, 21 * y, 8.5 * x, 6.5 * y])
    assert frame.distortion == (0.1, 0, 0, 0, 0)


def test_pictures_of_a_fraction_stand_for_the_others(tmp_path):
    root = project(tmp_path / "src")
    whole = imported(root, tmp_path / "whole").frames[0].camera
    shutil.rmtree(root / "images")
    write_pictures(root / "images_2", [f"view {k}.png" for k in range(5)], (8, 6))
    camera = imported(root, tmp_path / "out").frames[0].camera
    assert (camera.width, camera.fx, camera.cx) == (8, 0.5 * whole.fx, 0.5 * whole.cx)


def test_images_without_a_file_are_left_out(tmp_path, caplog):
    root = project(tmp_path / "src")
    for k in (1, 3):
        (root / f"images/view {k}.png").unlink()
    dataset = imported(root, tmp_path / "out")
    assert {frame.file_path for frame in dataset.frames} == {f"images/view {k}.png" for k in (0, 2, 4)}
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert "2 of 5 images of the model have no file and are left out, view 1.png first" in record.getMessage()


def test_the_largest_of_several_models_is_taken(tmp_path, caplog):
    root = project(tmp_path / "src", ring(5))
    write_text(root / "sparse/1", ring(3))
    write_binary(root / "sparse/2", ring(2))
    assert len(imported(root, tmp_path / "out").frames) == 5
    (record,) = caplog.records
    assert "3 models; the largest is taken, 0 with 5 images" in record.getMessage()


def test_of_a_model_in_two_parts_the_larger_is_taken(tmp_path, caplog):
    points = {k: ((float(k), 0.0, 1.0), (k, k, k)) for k in range(8)}
    images = [ColmapImage(f"{k}.png", seen=(0, 1, k) if k < 4 else (6, 7)) for k in range(6)]
    dataset = imported(project(tmp_path / "src", Model(images=images, points=points)), tmp_path / "out")
    assert {frame.file_path for frame in dataset.frames} == {f"images/{k}.png" for k in range(4)}
    (record,) = caplog.records
    assert "2 parts that share no point" in record.getMessage()
    assert "with 4 images, and 2 are left out" in record.getMessage()
    assert set(read_points(tmp_path / "out/points.ply")[1][:, 0]) == {0, 1, 2, 3}


def test_a_model_of_given_poses_has_no_parts(tmp_path, caplog):
    images = [ColmapImage(f"{k}.png") for k in range(3)]
    (tmp_path / "src").mkdir()
    root = project(tmp_path / "src", Model(images=images))
    (root / "sparse/0/points3D.bin").unlink()
    dataset = imported(root, tmp_path / "out")
    assert (len(dataset.frames), dataset.ply_file_path, caplog.records) == (3, None, [])


def test_wild_points_are_left_out_and_counted(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    model = ring()
    model.points[3] = ((1e6, 0.0, 0.0), (1, 2, 3))
    for image in model.images:
        image.seen = (*image.seen, 3)
    imported(project(tmp_path / "src", model), tmp_path / "out")
    assert len(read_points(tmp_path / "out/points.ply")[0]) == 20
    (record,) = caplog.records
    assert "1 of 21 points lie more than 100 times as far out" in record.getMessage()


def test_names_that_differ_in_their_suffix_or_folder(tmp_path):
    names = ["left/a.png", "right/a.png", "a.png", "a.jpg"]
    images = [ColmapImage(name) for name in names]
    dataset = imported(project(tmp_path / "src", Model(images=images)), tmp_path / "out")
    expected = {"images/left/a.png", "images/right/a.png", "images/a_png.png", "images/a_jpg.jpg"}
    assert {frame.file_path for frame in dataset.frames} == expected


# ---- masks ----


@pytest.mark.parametrize("suffix", [".png", ".png.png", ".tif"])
@pytest.mark.parametrize("size", [(16, 12), (32, 24)])
@pytest.mark.parametrize("mode", ["L", "RGBA"])
def test_masked_pixels_are_empty(tmp_path, suffix, size, mode):
    root = project(tmp_path / "src")
    write_masks(tmp_path / "masks", [f"view {k}{suffix}" for k in range(5)], size, mode)
    dataset = imported(root, tmp_path / "out", masks=tmp_path / "masks")
    for frame in dataset.frames:
        image = ss.load_image(dataset, frame)
        assert image.valid.all()
        np.testing.assert_array_equal(image.alpha, np.repeat([[1.0] * 8 + [0.0] * 8], 12, axis=0))
        assert frame.silhouette_path is not None
        assert frame.mask_path is None


def test_masked_pixels_are_unknown(tmp_path):
    write_masks(tmp_path / "masks", [f"view {k}.png" for k in range(5)])
    dataset = imported(project(tmp_path / "src"), tmp_path / "out", masks=str(tmp_path / "masks"), masked="unknown")
    for frame in dataset.frames:
        image = ss.load_image(dataset, frame)
        np.testing.assert_array_equal(image.valid, np.repeat([[True] * 8 + [False] * 8], 12, axis=0))
        assert image.alpha.min() == 1
        assert frame.silhouette_path is None


def test_a_mask_cuts_what_the_alpha_of_a_picture_leaves(tmp_path):
    root = project(tmp_path / "src")
    for path in (root / "images").iterdir():
        pixels = np.full((12, 16, 4), 200, np.uint8)
        pixels[:6, :, 3] = 0
        Image.fromarray(pixels).save(path)
    write_masks(tmp_path / "masks", [f"view {k}.png" for k in range(5)])
    dataset = imported(root, tmp_path / "out", masks=tmp_path / "masks")
    alpha = ss.load_image(dataset, dataset.frames[0]).alpha
    expected = np.zeros((12, 16), np.float32)
    expected[6:, :8] = 200 / 255
    np.testing.assert_allclose(alpha, expected, atol=1 / 255)


@pytest.mark.parametrize("masked", ["empty", "unknown"])
def test_masks_go_through_the_lens_with_their_picture(tmp_path, masked):
    root = project(tmp_path / "src", ring(cameras={1: ("FISHEYE", 64, 48, (30.0, 30.0, 32.0, 24.0))}), size=(64, 48))
    write_masks(tmp_path / "masks", [f"view {k}.png" for k in range(5)], (64, 48))
    dataset = imported(root, tmp_path / "out", masks=tmp_path / "masks", masked=masked)
    image = ss.load_image(dataset, dataset.frames[0])
    found = image.alpha > 0 if masked == "empty" else image.valid
    assert found[:, :31].all()
    assert not found[:, 33:].any()


def test_pictures_without_a_mask_are_counted(tmp_path, caplog):
    write_masks(tmp_path / "masks", ["view 2.png"])
    dataset = imported(project(tmp_path / "src"), tmp_path / "out", masks=tmp_path / "masks")
    assert sum(frame.silhouette_path is not None for frame in dataset.frames) == 1
    (record,) = caplog.records
    assert "4 of 5 pictures have no mask and count as a whole, view 0.png first" in record.getMessage()


def test_masks_that_show_nothing_are_refused(tmp_path):
    for k in range(5):
        (tmp_path / "masks").mkdir(exist_ok=True)
        Image.new("L", (16, 12)).save(tmp_path / f"masks/view {k}.png")
    with pytest.raises(InputError, match=r"^masks: expected an object in the pictures, found none"):
        imported(project(tmp_path / "src"), tmp_path / "out", masks=tmp_path / "masks")
    assert not (tmp_path / "out").exists()


def test_an_interrupted_import_begins_anew(tmp_path):
    root = project(tmp_path / "src")

    def stop(done, total, name):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        imported(root, tmp_path / "out", progress=stop)
    with pytest.raises(InputError, match="unfinished import of something else"):
        imported(root, tmp_path / "out", images=root / "images")
    assert len(imported(root, tmp_path / "out").frames) == 5
    with pytest.raises(InputError, match="expected a new or empty folder"):
        imported(root, tmp_path / "out")


def test_the_command(spacesim, tmp_path):
    root = project(tmp_path / "src")
    write_masks(tmp_path / "masks", [f"view {k}.png" for k in range(5)])
    words = "--masks", tmp_path / "masks", "--masked", "unknown"
    done = spacesim("import", "colmap", root, "--out", tmp_path / "out", *words)
    assert done.code == 0, done.errors
    assert done.output.strip() == f"{tmp_path / 'out'}: 4 frames to train on, 1 to test with, with points to start from"
    helped = spacesim("import", "colmap", "--help").output
    assert all(option in helped for option in ("--images", "--masks", "--masked", "training ignores them"))
    assert all("DIR|auto|none" in spacesim("import", kind, "--help").output for kind in ("nerfstudio", "speedplus"))
    refused = spacesim("import", "colmap", root, "--out", tmp_path / "new", "--masks", tmp_path / "nowhere")
    assert refused.code == 2
    assert "spacesim: --masks: expected a folder" in refused.errors[0]
    refused = spacesim("import", "colmap", root, "--out", tmp_path / "new", "--masked", "half")
    assert (refused.code, "expected one of empty, unknown" in "".join(refused.errors)) == (2, True)


@pytest.mark.parametrize(
    ("mode", "color"), [("L", 77), ("RGB", (10, 20, 30)), ("RGBA", (10, 20, 30, 128)), ("I;16", 20_000)]
)
def test_pictures_of_every_kind_go_through_a_lens(tmp_path, mode, color):
    root = project(tmp_path / "src", ring(2, cameras={1: ("FISHEYE", 64, 48, (60.0, 60.0, 32.0, 24.0))}), size=(64, 48))
    for path in (root / "images").iterdir():
        Image.new(mode, (64, 48), color).save(path)
    dataset = imported(root, tmp_path / "out")
    frame = dataset.frames[0]
    image = ss.load_image(dataset, frame)
    channels = np.atleast_1d(color) / (65535 if mode == "I;16" else 255)
    np.testing.assert_allclose(image.rgb[5, 7], np.broadcast_to(channels[:3], 3), atol=0.5 / 255)
    assert image.alpha[5, 7] == pytest.approx(128 / 255 if mode == "RGBA" else 1)
    assert Image.open(tmp_path / "out" / frame.file_path).mode == ("L" if mode == "I;16" else mode)
