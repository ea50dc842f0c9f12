"""Two objects that move apart, against scenes in which they stand where a frame has them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_motion import write, wxyz

import spacesim as ss
from spacesim.cli.program import main
from spacesim.data.errors import InputError
from spacesim.data.exporters import labelled_objects, write_bop
from spacesim.data.exporters.labels import VISIBLE, DatasetLabeller
from spacesim.data.images import read_png
from spacesim.data.store import load_truth
from spacesim.eval.evaluate import evaluate
from spacesim.scenes.generation.generate import generate
from spacesim.scenes.scenefile import read_scene
from spacesim.scenes.silhouette import silhouette_finder

SMALL = {"resolution": (40, 32), "spp": 1, "points": 50, "test_spp": 1}
NAMES = [
    "time_s",
    *(f"camera_{axis}_m" for axis in "xyz"),
    *(f"target_{axis}_m" for axis in "xyz"),
    *(f"world_from_target_q{axis}" for axis in "wxyz"),
    *(f"target2_{axis}_m" for axis in "xyz"),
    *(f"target2_from_world_q{axis}" for axis in "wxyz"),
]
SUN = (40.0, 25.0)
TIMES = (0.0, 10.0, 20.0)


def state(t):
    """(world_from_target, world_from_object of the scene's second object) at time t, [4, 4]."""
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[0, :3, :3] = Rotation.from_rotvec(np.array([0.01, 0.02, -0.03]) * t + [0.2, 0, 0]).as_matrix()
    poses[0, :3, 3] = [100.0 + t, 50.0, -20.0]
    poses[1, :3, :3] = Rotation.from_rotvec(np.array([0.0, 0.04, 0.01]) * t).as_matrix()
    poses[1, :3, 3] = poses[0, :3, 3] + [2.0 - 0.1 * t, -3.0, 1.0 + 0.1 * t]
    return poses


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    rows = []
    for t in TIMES:
        target, other = state(t)
        turns = [Rotation.from_matrix(pose[:3, :3]) for pose in (target, other)]
        camera = target[:3, 3] + [14.0, 4.0, 3.0]
        rows.append([t, *camera, *target[:3, 3], *wxyz(turns[0]), *other[:3, 3], *wxyz(turns[1].inv())])
    return write(tmp_path_factory.mktemp("table") / "two.csv", rows, NAMES)


@pytest.fixture(scope="module")
def pair(table):
    scene = read_scene("boxsat-pair", trajectory=table, sun=[SUN], **SMALL)
    larger = replace(scene.objects[1], scale=1.25)
    return replace(scene, objects=(scene.objects[0], larger))


@pytest.fixture(scope="module")
def moving(pair, tmp_path_factory):
    return generate(pair, tmp_path_factory.mktemp("moving") / "data")


def test_frames_show_what_scenes_with_objects_there_show(moving, tmp_path):
    scene = read_scene("boxsat-pair", **SMALL)
    for t, frame in zip(TIMES, moving.train, strict=True):
        target, other = state(t)
        pose = np.linalg.inv(target) @ other
        np.testing.assert_allclose(frame.objects[2], pose @ np.diag([1.25, 1.25, 1.25, 1]), atol=1e-9)
        turn = tuple(wxyz(Rotation.from_matrix(pose[:3, :3])))
        there = replace(scene.objects[1], position=tuple(pose[:3, 3]), rotation_wxyz=turn, scale=1.25)
        rig = ss.PoseRig(frame.camera.world_from_camera[None], sun=frame.sun.direction)
        still = generate(replace(scene, objects=(scene.objects[0], there), rig=rig), tmp_path / f"at{t:g}")
        expected, found = load_truth(still, still.train[0]), load_truth(moving, frame)
        assert set(np.unique(found.object_id)) == {0, 1, 2}
        assert (found.object_id != expected.object_id).mean() < 1e-3  # poses differ by rounding
        assert (found.shadow != expected.shadow).mean() < 2e-3
        same = found.object_id == expected.object_id
        np.testing.assert_allclose(found.depth[same], expected.depth[same], rtol=1e-4)
    first, last = (load_truth(moving, frame).object_id == 2 for frame in (moving.train[0], moving.train[-1]))
    assert (first & last).sum() < 0.8 * first.sum()  # it has moved


def test_the_share_in_sunlight_is_that_of_the_objects_where_they_are(pair, moving, tmp_path):
    frames = json.loads((moving.root / "transforms.json").read_text())["frames"]
    shares = [frame["sunlit_fraction"] for frame in frames]
    assert len(set(shares)) == 3
    least = sorted(shares)[1]
    some = generate(replace(pair, min_sunlit=least), tmp_path / "data")
    assert [frame.time for frame in some.train] == [t for t, share in zip(TIMES, shares, strict=True) if share >= least]


def test_labels_follow_the_objects(moving, tmp_path):
    targets = labelled_objects(moving)
    write_bop(moving, tmp_path / "bop", silhouette_finder)
    poses = json.loads((tmp_path / "bop/train/000000/scene_gt.json").read_text())
    labeller = DatasetLabeller(moving)
    for k, (t, frame) in enumerate(zip(TIMES, moving.train, strict=True)):
        world_from_scene, other = state(t)
        camera_from_object = np.linalg.inv(world_from_scene @ frame.camera.world_from_camera) @ other
        found = poses[str(k)][1]
        np.testing.assert_allclose(found["cam_R_m2c"], camera_from_object[:3, :3].ravel(), atol=1e-6)
        np.testing.assert_allclose(found["cam_t_m2c"], 1e3 * camera_from_object[:3, 3], atol=1e-2)
        np.testing.assert_allclose(targets[1].at(frame).camera_from_object(frame.camera), camera_from_object, atol=1e-6)
        visible = load_truth(moving, frame).object_id == 2
        mask = read_png(tmp_path / f"bop/train/000000/mask/{k:06d}_000001.png") > 0
        assert not (visible & ~mask).any()
        assert mask.sum() < 1.6 * visible.sum() + 20
        instance = labeller.instances(frame)[1]
        x, y = instance.keypoints[instance.keypoints[:, 2] == VISIBLE, :2].T
        assert len(x) >= 3
        near = np.pad(visible, 1)
        near = sum(np.roll(near, shift, (0, 1)) for shift in np.ndindex(3, 3)) > 0  # of corners, within a pixel
        assert near[y.astype(int) + 2, x.astype(int) + 2].all()


@pytest.mark.parametrize("command", ["train", "eval"])
def test_a_model_of_one_shape_is_refused(moving, command, tmp_path, capsys):
    arguments = [command, str(moving.root), "--out", str(tmp_path / "out")]
    if command == "eval":
        with pytest.raises(InputError, match="stand still to each other, found 3 frames that move some"):
            evaluate(object(), moving, tmp_path / "out")
        return
    assert main(arguments) == 2
    assert "stand still to each other, found 3 frames that move some" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("scene", "change", "message"),
    [
        ("boxsat", {}, "trajectory of boxsat: expected target alone, its one object, found target2"),
        ("boxsat-pair", {"target2": "target3"}, "expected target2, its other object, found target3"),
        ("boxsat-pair", {"target2": "target1"}, "expected target, or target2 for the scene's second object, found"),
        ("boxsat-pair", {"target2_x_m": "target2_x"}, "target2_x: expected a unit of m or km at its end"),
        ("boxsat-pair", {"target2_x_m": "target2_x_km"}, "target2_x_m: expected a column beside target2_y_m"),
    ],
)
def test_impossible_tracks_of_objects_are_refused(table, scene, change, message, tmp_path):
    text = table.read_text()
    for old, new in change.items():
        text = text.replace(old, new)
    path = tmp_path / "wrong.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        generate(read_scene(scene, trajectory=path, **SMALL), tmp_path / "data")


def test_one_too_far_away_and_a_camera_within_one_that_moves(tmp_path):
    names = ["camera_x_m", "camera_y_m", "camera_z_m", "target2_x_m", "target2_y_m", "target2_z_m"]
    far = write(tmp_path / "far.csv", [[9, 0, 2, 5e6, 0, 0]], names)
    with pytest.raises(InputError, match=r"target2: expected at most .* m from the target, found 5e"):
        generate(read_scene("boxsat-pair", trajectory=far, **SMALL), tmp_path / "data")
    within = write(tmp_path / "within.csv", [[9, 0, 2, -9, 0, 0], [9, 0, 0, 9, 0, 0]], names)
    with pytest.raises(InputError, match="found that of train_00001 within a part"):
        generate(read_scene("boxsat-pair", trajectory=within, **SMALL), tmp_path / "data")
    where_it_stood = write(tmp_path / "left.csv", [[-3, -3, -3, 9, 0, 0]], names)
    generate(read_scene("boxsat-pair", trajectory=where_it_stood, **SMALL), tmp_path / "data")
