"""Poses found without a guess, and files of them."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as PillowImage
from scipy.spatial.transform import Rotation
from test_refine_pose import CAMERA, SIZE, errors, picture, run_of

from spacesim import InputError, find_pose
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera
from spacesim.data.store import intrinsics_of
from spacesim.data.transforms import read_views
from spacesim.splat.locate import _frames, _guess, locate
from spacesim.splat.pose.search import ModelViews, _cut
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.run import Run, load_run


@pytest.fixture(scope="module")
def run(known_gaussians) -> Run:
    return run_of(Gaussians.from_numpy(known_gaussians))


@pytest.fixture(scope="module")
def views(run) -> dict[bool, ModelViews]:
    return {by_alpha: ModelViews.of(run, None, by_alpha) for by_alpha in (False, True)}


def camera_at(k: int) -> Camera:
    """At some place, turned about its line of sight, the object not in the middle."""
    rng = np.random.default_rng(k)
    way = rng.normal(size=3)
    pose = look_at(rng.uniform(2.5, 4) * way / np.linalg.norm(way), rng.uniform(-0.2, 0.2, 3))
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("z", rng.uniform(0, 360), degrees=True).as_matrix()
    return replace(CAMERA, world_from_camera=pose)


@pytest.mark.parametrize("alpha", [False, True])
def test_poses_from_anywhere_are_found(run, views, alpha):
    for k in range(1 if alpha else 2):
        true = camera_at(k)
        drawn = run.predict(true)
        seen = np.clip(drawn.rgb, 0, 1)
        if alpha:
            cover = np.clip(drawn.alpha, 0, 1)[..., None]
            seen = np.dstack([np.clip(seen / np.maximum(cover, 1e-6), 0, 1), cover])
        found = find_pose(run, seen, CAMERA, views=views[alpha])
        assert found.pose.converged, k
        assert max(errors(found.pose.camera, true)) < 0.1, k
        assert found.residual < 1e-3
        assert not found.ambiguous


def test_the_best_start_is_near_without_any_refinement(run, views):
    """Silhouette, size and turn alone bring it to where refining can begin."""
    near = 0
    for k in range(10):
        true = camera_at(k)
        drawn = run.predict(true)
        cut = _cut(np.clip(drawn.rgb, 0, 1), drawn.alpha, 0.04)
        starts = views[True].poses(cut, CAMERA, 24)
        off = [errors(start, true) for start in starts]
        near += any(degrees < 12 and percent < 25 for degrees, percent in off)
    assert near >= 9


def test_a_model_that_looks_the_same_from_two_sides_is_ambiguous(known_gaussians):
    """Turned by half a turn it is itself: no pose is trusted."""
    half = Rotation.from_euler("z", 180, degrees=True)
    one = {name: np.array(values) for name, values in known_gaussians.items()}
    one["means"] = one["means"] + [0.4, 0, 0]
    one["sh"] = np.zeros_like(one["sh"])
    other = {name: values.copy() for name, values in one.items()}
    other["means"] = half.apply(one["means"])
    wxyz = np.roll((half * Rotation.from_quat(np.roll(one["quaternions"], -1, axis=1))).as_quat(), 1, axis=1)
    other["quaternions"] = wxyz
    both = {name: np.concatenate([one[name], other[name]]) for name in one}
    run = run_of(Gaussians.from_numpy(both))
    found = find_pose(run, picture(run), CAMERA)
    assert found.ambiguous
    assert not found.pose.converged
    assert found.residual < 0.05


def test_pictures_without_the_object_give_no_pose(run, views):
    with pytest.raises(InputError, match="image: expected an object that is brighter than the sky, found none"):
        find_pose(run, np.full((SIZE, SIZE, 3), 0.3), CAMERA, views=views[False])
    other = np.zeros((SIZE, SIZE, 3))
    other[28:36, 4:60] = 0.8
    assert not find_pose(run, other, CAMERA, views=views[False]).pose.converged


def test_stars_do_not_move_the_middle():
    light = np.zeros((40, 40, 3))
    light[10:20, 10:20] = 0.5
    clean = _cut(light, None, 0.04)
    light[35, [3, 20, 38]] = 1
    starry = _cut(light, None, 0.04)
    assert (clean.column, clean.row) == (15, 15)
    assert (starry.column, starry.row, starry.radius) == (clean.column, clean.row, clean.radius)


@pytest.fixture
def pictures(run, tmp_path) -> Path:
    """Two pictures, one of nothing, and transforms.json of their cameras a little off in another folder."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    frames = []
    for k in range(2):
        true = camera_at(k)
        PillowImage.fromarray(np.rint(255 * picture(run, true)).astype(np.uint8)).save(folder / f"{k}.png")
        pose = true.world_from_camera.copy()
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("y", 3, degrees=True).as_matrix()
        rough = replace(true, world_from_camera=pose)
        frames.append({"file_path": f"elsewhere/{k}.png", "transform_matrix": rough.opengl.tolist()})
    PillowImage.fromarray(np.zeros((SIZE, SIZE, 3), np.uint8)).save(folder / "dark.png")
    meta = {**intrinsics_of(CAMERA), "frames": frames}
    (tmp_path / "rough.json").write_text(json.dumps(meta))
    (tmp_path / "camera.json").write_text(
        json.dumps({**intrinsics_of(CAMERA), "transform_matrix": CAMERA.opengl.tolist()})
    )
    return folder


def test_a_file_of_poses_reads_back_and_goes_on(run, pictures, tmp_path):
    out, calls = tmp_path / "poses.json", []
    rough, camera = tmp_path / "rough.json", tmp_path / "camera.json"
    done = locate(run, pictures, out, rough, camera, progress=lambda *call: calls.append(call))
    assert (done.pictures, done.converged, done.failed) == (3, 2, 1)
    assert calls[-1] == (3, 3, "dark.png")
    entries = {entry["file_path"]: entry for entry in json.loads(out.read_text())["frames"]}
    assert "found none" in entries["dark.png"]["failed"]
    for k, (name, frame) in enumerate(read_views(out).items()):
        assert name == f"{k}.png"
        assert max(errors(frame.camera, camera_at(k))) < 0.3
        entry = entries[name]
        assert entry["start"] == "given"
        assert entry["converged"]
        assert 0 <= entry["residual"] < 0.01
        assert np.linalg.eigvalsh(entry["covariance"]).min() > 0
    with pytest.raises(InputError, match=r"poses\.json: expected a new file, found one; resume=True goes on with it"):
        locate(run, pictures, out, rough, camera)
    first = out.read_bytes()
    del (left := json.loads(first))["frames"][1]
    out.write_text(json.dumps(left))
    calls.clear()
    locate(run, pictures, out, rough, camera, resume=True, progress=lambda *call: calls.append(call))
    again = {entry["file_path"]: entry for entry in json.loads(out.read_text())["frames"]}
    assert again == entries
    with pytest.raises(InputError, match="expected poses of the same run, pictures and options, found others"):
        locate(run, pictures, out, rough, camera, within=(4, 0.05), resume=True)
    searched = locate(run, pictures / "1.png", tmp_path / "one.json", None, rough)
    assert (searched.pictures, searched.converged) == (1, 1)
    assert max(errors(read_views(tmp_path / "one.json")["1.png"].camera, camera_at(1))) < 0.3


def test_poses_of_another_camera_are_not_gone_on_with(run, pictures, tmp_path):
    """The same intrinsics in another file are the same camera; others in a file of the same name are not."""
    one, camera, copy = pictures / "1.png", tmp_path / "camera.json", tmp_path / "copy.json"
    out = tmp_path / "poses.json"
    locate(run, one, out, None, camera)
    first = out.read_bytes()
    shutil.copy(camera, copy)
    locate(run, one, out, None, copy, resume=True)
    assert out.read_bytes() == first
    meta = json.loads(camera.read_text())
    for change in ({"fl_x": 1.01 * meta["fl_x"]}, {"k1": 0.01}):
        camera.write_text(json.dumps({**meta, **change}))
        with pytest.raises(
            InputError, match=r"poses\.json: expected poses found with the same camera, found .* 1\.png"
        ):
            locate(run, one, out, None, camera, resume=True)
    assert out.read_bytes() == first


def test_an_interrupted_call_has_written_what_it_found(run, pictures, tmp_path):
    def stop(done: int, total: int, name: str) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        locate(run, pictures, tmp_path / "poses.json", tmp_path / "rough.json", tmp_path / "camera.json", progress=stop)
    assert list(read_views(tmp_path / "poses.json")) == ["0.png"]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"images": "none"}, "none: expected a dataset, a folder of pictures or one picture, found nothing"),
        ({"images": "."}, "expected a dataset or a folder of pictures, found neither"),
        ({"camera": None}, "camera: expected a file with the intrinsics of the pictures, found none"),
        ({"start": "camera.json", "camera": "none.json"}, r"none\.json: expected a JSON file, found none"),
        ({"start": "none.json"}, r"none\.json: expected a JSON file, found none"),
    ],
)
def test_wrong_inputs_are_refused_in_a_sentence(run, pictures, tmp_path, change, sentence):
    options = {"images": "pictures", "start": None, "camera": "camera.json", **change}
    paths = {name: None if value is None else tmp_path / value for name, value in options.items()}
    if paths["images"] == tmp_path:
        paths["images"] = tmp_path / "empty"
        paths["images"].mkdir()
    with pytest.raises(InputError, match=sentence):
        locate(run, paths["images"], tmp_path / "out.json", paths["start"], paths["camera"])


def test_a_picture_without_a_sun_that_the_start_lacks_is_named(run, pictures, tmp_path, monkeypatch):
    monkeypatch.setattr(Run, "relightable", True)
    out, start = tmp_path / "out.json", tmp_path / "rough.json"
    with pytest.raises(InputError, match=r"found none for dark\.png, which .*rough\.json does not have$"):
        locate(run, pictures / "dark.png", out, start, tmp_path / "camera.json")
    with pytest.raises(InputError, match=r"found none for 0\.png$"):
        locate(run, pictures / "0.png", out, start)


def test_the_command(spacesim, tiny_run, tiny_data, tmp_path):
    """Cameras are those of the poses to start from, or of the run's data."""
    folder, out = tmp_path / "pictures", tmp_path / "poses.json"
    folder.mkdir()
    shutil.copy(tiny_data / "images/test_00000.png", folder)
    done = spacesim("locate", tiny_run, folder, "--out", out, "--start", tiny_data / "transforms.json")
    assert done.code == 0, done.errors
    assert f"{out}: 1 pictures, " in done.output
    (entry,) = json.loads(out.read_text())["frames"]
    assert entry["file_path"] == "test_00000.png"
    assert entry["start"] == "given"
    assert np.isfinite(entry["covariance"]).all()
    assert spacesim("locate", tiny_run, folder, "--out", out).is_refusal(out, "--resume")
    assert spacesim("locate", tiny_run, tmp_path / "x", "--out", tmp_path / "b.json").is_refusal(tmp_path / "x")
    assert spacesim("locate", tiny_run, folder, "--out", tmp_path / "b.json", "--within", "5").is_refusal("--within")
    assert not (tmp_path / "b.json").exists()


def test_an_opaque_picture_needs_no_files_beside_it(spacesim, tiny_run, tiny_data, tmp_path):
    """Its camera is that of the run's data, whose silhouettes are of other pictures."""
    picture, out = tmp_path / "opaque.png", tmp_path / "poses.json"
    PillowImage.open(tiny_data / "images/test_00000.png").convert("RGB").save(picture)
    done = spacesim("locate", tiny_run, picture, "--out", out)
    assert done.code == 0, done.errors
    assert "transform_matrix" in json.loads(out.read_text())["frames"][0]
    picture.write_bytes(b"no picture")
    done = spacesim("locate", tiny_run, picture, "--out", tmp_path / "none.json")
    assert done.code == 1
    assert re.search(r"found none: \S+opaque\.png: expected PNG, JPEG", done.errors[-1])


def test_a_datasets_own_poses_are_not_looked_at(tiny_run, tiny_data):
    frames, dataset = _frames(load_run(tiny_run), tiny_data, {}, None)
    assert dataset is not None
    assert [frame.file_path for frame in frames] == [frame.file_path for frame in dataset.frames]
    assert _guess({}, frames[0]) is None
    guesses = read_views(tiny_data / "transforms.json")
    guess = _guess(guesses, frames[0])
    np.testing.assert_array_equal(guess.world_from_camera, dataset.frames[0].camera.world_from_camera)
