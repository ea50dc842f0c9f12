"""A reconstruction in axes and a scale of its own is brought into the truth's."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import spacesim.eval.align as align_module
from spacesim.data.errors import InputError
from spacesim.data.geometry import fibonacci_sphere, look_at, rotation_from_quaternion
from spacesim.data.identity import training_digest
from spacesim.data.images import write_png
from spacesim.data.records import Camera, Dataset, Frame, Sun
from spacesim.data.store import write_points
from spacesim.eval.align import align, match_frames, moved_dataset, places_in_pictures, residuals, similarity
from spacesim.eval.evaluate import EvaluateConfig, evaluate
from spacesim.eval.report.write import write_report
from spacesim.splat.compose import ComposedRun, GaussianComposition, PlacedRun, Pose
from spacesim.splat.compose.aligned import moved_frame
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.run import Run

POSE = Pose(rotation_from_quaternion([0.3, -0.5, 0.7, 0.2]), [4.0, -1.0, 2.5], 0.37)  # truth from reconstruction
INSIDE = Pose().after(POSE).inverse()


def moved(camera: Camera, pose: Pose) -> Camera:
    place = np.eye(4)
    place[:3, :3] = pose.rotation @ camera.world_from_camera[:3, :3]
    place[:3, 3] = pose.points(camera.position)
    return replace(camera, world_from_camera=place)


def looking(positions, names="images/train_{:05d}.png") -> list[Frame]:
    cameras = [Camera.from_fov(look_at(place, [0.1, 0, 0]), 8, 8, 40) for place in positions]
    return [Frame(names.format(k), camera, Sun.from_angles(k, 10)) for k, camera in enumerate(cameras)]


@pytest.fixture
def truth(tmp_path) -> Dataset:
    frames = looking(6 * fibonacci_sphere(20))
    return Dataset(tmp_path / "truth", tuple(frames[:15]), tuple(frames[15:]))


def reconstruction(truth: Dataset, root: Path, noise: float = 0.0) -> Dataset:
    """Of the training frames, in its own frame; noise: metres of the truth, of the positions"""
    rng = np.random.default_rng(1)
    frames = []
    for frame in truth.train:
        sun = None if frame.sun is None else Sun(INSIDE.rotation @ frame.sun.direction)
        off = np.eye(4)
        off[:3, 3] = noise * rng.normal(size=3)
        shaken = replace(frame.camera, world_from_camera=off @ frame.camera.world_from_camera)
        frames.append(replace(frame, camera=moved(shaken, INSIDE), sun=sun))
    return Dataset(root, tuple(frames), ())


def same_pose(one: Pose, other: Pose, tolerance: float = 1e-9) -> None:
    np.testing.assert_allclose(one.matrix, other.matrix, atol=tolerance)


def test_the_similarity_is_found(truth, tmp_path):
    own = reconstruction(truth, tmp_path / "own")
    found = align(own, truth)
    same_pose(found.pose, POSE)
    assert (found.cameras, found.inliers, found.matched_by) == (15, 15, "file name")
    assert found.rms < 1e-9
    assert found.distance == pytest.approx(6, abs=0.2)
    back = moved_dataset(own, found.pose)
    for frame, true in zip(back.train, truth.train, strict=True):
        np.testing.assert_allclose(frame.camera.world_from_camera, true.camera.world_from_camera, atol=1e-9)
        np.testing.assert_allclose(frame.sun.direction, true.sun.direction, atol=1e-9)


def test_the_model_stands_where_cameras_see_it(tmp_path):
    """Cameras on an arc whose axes are off by a degree, as their positions are, so that their pictures fit."""
    points = fibonacci_sphere(40)
    places = [20 * np.array([np.cos(a), np.sin(a), 0.3]) for a in np.linspace(0.0, 1.0, 12)]
    truth = Dataset(tmp_path / "truth", tuple(looking(places)), ())
    wrong = []
    for k, frame in enumerate(truth.train):
        off = rotation_from_quaternion([1.0, 0.0, 0.0, 0.009 * (k > 5)])  # about the points' middle
        wrong.append(replace(frame, camera=moved(frame.camera, INSIDE.after(Pose(off)))))
    own = Dataset(tmp_path / "own", tuple(wrong), (), ply_file_path="points.ply")
    own.root.mkdir()
    write_points(own.root / "points.ply", INSIDE.points(points), np.zeros((40, 3), np.uint8))

    def off(pose: Pose) -> float:
        true, found = (
            places_in_pictures([frame.camera for frame in data.train], moving.points(INSIDE.points(points)))
            for data, moving in ((truth, pose), (own, Pose()))
        )
        return float(np.abs(true - found).mean())

    by_cameras = align(replace(own, ply_file_path=None), truth)
    by_views = align(own, truth)
    assert off(by_views.pose) < 0.6 * off(by_cameras.pose)


def test_noise_is_the_residual_of_the_alignment(truth, tmp_path):
    found = align(reconstruction(truth, tmp_path / "own", noise=0.02), truth)
    assert found.rms == pytest.approx(0.02 * 3**0.5, rel=0.3)
    assert found.to_json()["rms_over_distance"] == pytest.approx(found.rms / found.distance)
    assert f"{found.rms:.4g} m (RMS)" in found.note


def test_outliers_do_not_move_it(truth, tmp_path):
    own = reconstruction(truth, tmp_path / "own", noise=0.001)
    wild = [replace(frame, camera=own.train[(k + 6) % 15].camera) for k, frame in enumerate(own.train[:4])]
    found = align(replace(own, train=(*wild, *own.train[4:])), truth)
    same_pose(found.pose, POSE, 0.01)
    assert found.inliers == 11


def test_cameras_on_a_line_are_turned_by_their_axes():
    """Positions alone leave the turn about the line open."""
    frames = looking([[0.0, -3 - k, 0] for k in range(5)])
    own = np.array([moved(frame.camera, INSIDE).world_from_camera for frame in frames])
    true = np.array([frame.camera.world_from_camera for frame in frames])
    same_pose(similarity(own, true), POSE)
    assert max(map(np.max, residuals(POSE, own, true))) < 1e-5


def test_equal_positions_have_no_scale(truth, tmp_path):
    own = reconstruction(truth, tmp_path / "own")
    place = own.train[0].camera
    with pytest.raises(InputError, match="found all in one place"):
        align(replace(own, train=tuple(replace(frame, camera=place) for frame in own.train)), truth)


def test_a_mirrored_reconstruction_is_refused(truth, tmp_path):
    mirror = np.diag([-1.0, 1, 1])
    frames = []
    for frame in truth.train:
        place = frame.camera.world_from_camera.copy()
        place[:3, 3] = mirror @ place[:3, 3]
        place[:3, :3] = mirror @ place[:3, :3] @ mirror
        frames.append(replace(frame, camera=replace(frame.camera, world_from_camera=place)))
    with pytest.raises(InputError, match="expected cameras like those of"):
        align(Dataset(tmp_path / "own", tuple(frames), ()), truth)


def test_what_points_move_too_far_is_refused(truth, tmp_path, monkeypatch):
    own = replace(reconstruction(truth, tmp_path / "own"), ply_file_path="points.ply")
    own.root.mkdir()
    write_points(own.root / "points.ply", INSIDE.points(fibonacci_sphere(40)), np.zeros((40, 3), np.uint8))
    same_pose(align(own, truth).pose, POSE, 1e-6)
    away = Pose(np.eye(3), np.array([3.0, 0.0, 0.0])).after(POSE)
    monkeypatch.setattr(align_module, "seen_alike", lambda *_: away)
    with pytest.raises(InputError, match=r"expected cameras like those of .*, found 15 of 15 within 50 %"):
        align(own, truth)


def test_frames_without_a_partner_are_refused(truth, tmp_path):
    own = reconstruction(truth, tmp_path / "own")
    strange = tuple(replace(frame, file_path=f"images/x{k}.png") for k, frame in enumerate(own.train))
    with pytest.raises(InputError, match=r"expected at least 3 frames .* found 0 \(matched by file name\)"):
        align(replace(own, train=strange), truth)


def with_keys(dataset: Dataset, keys) -> Dataset:
    dataset.root.mkdir(exist_ok=True)
    entries = [{"file_path": f.file_path, "source_index": k} for f, k in zip(dataset.frames, keys, strict=True)]
    (dataset.root / "transforms.json").write_text(json.dumps({"frames": entries}))
    return dataset


def test_frames_of_a_video_are_counted(truth, tmp_path):
    """The video's frame 9 is the truth's ninth file, from 0, whichever split it is in and however files are called."""
    own = reconstruction(truth, tmp_path / "own")
    chosen = [own.train[k] for k in (2, 9, 14)]
    renamed = [replace(frame, file_path=f"images/frame{k}.png") for k, frame in enumerate(chosen)]
    own = with_keys(replace(own, train=tuple(renamed)), (2, 9, 14))
    matches, words = match_frames(own, truth)
    assert [true.file_path for _, true in matches] == [truth.train[k].file_path for k in (2, 9, 14)]
    assert "order of file paths" in words
    same_pose(align(own, truth).pose, POSE)
    with_keys(truth, range(100, 120))
    with_keys(own, (107, 101, 119))
    matches, words = match_frames(own, truth)
    assert [true.file_path for _, true in matches] == [truth.frames[k].file_path for k in (7, 1, 19)]
    assert words == "source_index in transforms.json"


def test_keys_that_are_no_numbers_of_frames_do_not_count(truth, tmp_path):
    own = reconstruction(truth, tmp_path / "own")
    with_keys(own, [float("inf"), *range(1, len(own.frames))])
    assert match_frames(own, truth)[1] == "file name"


@pytest.fixture
def drawn(tmp_path) -> tuple[Run, Dataset, Dataset]:
    """A run, pictures of it in the truth's world, and its own dataset, in its own."""
    rng = np.random.default_rng(0)
    model = {
        "means": rng.uniform(-0.5, 0.5, (60, 3)),
        "log_scales": rng.uniform(-2.6, -1.8, (60, 3)),
        "quaternions": rng.normal(size=(60, 4)),
        "logit_opacities": rng.uniform(1, 4, 60),
        "sh": rng.uniform(-1, 1.5, (60, 1, 3)),
    }
    run = Run(tmp_path / "run", {"method": "vanilla"}, {}, Gaussians.from_numpy(model), 1000)
    centre = POSE.points([0, 0, 0])
    cameras = [Camera.from_fov(look_at(centre + 1.5 * way, centre), 48, 48, 40) for way in fibonacci_sphere(9)]
    frames = []
    for k, camera in enumerate(cameras):
        view = run.predict(moved(camera, INSIDE))
        straight = np.clip(view.rgb, 0, 1) / np.maximum(view.alpha, 1e-3)[..., None]
        pixels = np.rint(255 * np.clip(np.dstack([straight, view.alpha]), 0, 1)).astype(np.uint8)
        frames.append(Frame(f"images/v_{k}.png", camera))
        write_png(tmp_path / "truth" / frames[-1].file_path, pixels)
    truth = Dataset(tmp_path / "truth", tuple(frames[:6]), tuple(frames[6:]))
    return run, truth, reconstruction(replace(truth, train=tuple(frames[:6])), tmp_path / "own")


def test_an_aligned_run_is_evaluated_in_the_truths_world(drawn, tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "nowhere"))
    run, truth, own = drawn
    metrics = evaluate(run, truth, tmp_path / "eval", EvaluateConfig(align=own))
    assert metrics["image"]["psnr"]["mean"] > 40
    assert metrics["alignment"]["cameras"] == 6
    assert metrics["alignment"]["scale"] == pytest.approx(0.37)
    assert metrics["notes"][0].startswith("The run was moved into the axes and scale of the data by 6 of 6 cameras")
    write_report([tmp_path / "eval"], tmp_path / "report.html")
    assert "Moved into the axes and scale of the data by 6 of 6" in (tmp_path / "report.html").read_text()
    plain = evaluate(run, truth, tmp_path / "plain")
    assert plain["alignment"] is None
    assert plain["image"]["psnr"]["mean"] < 20


def test_a_run_is_aligned_by_the_cameras_that_it_refined(drawn, tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "nowhere"))
    run, truth, own = drawn
    frames = []
    for frame in own.train:  # given where nothing of the model is
        keys = {"w": frame.camera.width, "h": frame.camera.height, "fl_x": frame.camera.fx, "fl_y": frame.camera.fy}
        keys |= {"cx": frame.camera.cx, "cy": frame.camera.cy, "transform_matrix": frame.camera.opengl.tolist()}
        frames.append({"file_path": frame.file_path, **keys})
    run.path.mkdir()
    (run.path / "cameras.json").write_text(json.dumps({"frames": frames}))
    elsewhere = Pose(np.eye(3), np.array([0.5, 0.2, 0.1]), 1.0)
    given = replace(own, train=tuple(moved_frame(frame, elsewhere) for frame in own.train))
    metrics = evaluate(run, truth, tmp_path / "eval", EvaluateConfig(align=given))
    assert metrics["image"]["psnr"]["mean"] > 40
    assert metrics["alignment"]["rms"] < 1e-3
    others = [{**entry, "file_path": f"other/{k}.png"} for k, entry in enumerate(frames)]
    (run.path / "cameras.json").write_text(json.dumps({"frames": others}))
    with pytest.raises(InputError, match=r"cameras.json: expected cameras of frames of .*, found other/0.png"):
        evaluate(run, truth, tmp_path / "other", EvaluateConfig(align=given))


def test_data_that_are_not_the_runs_are_noted(drawn, tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "nowhere"))
    run, truth, own = drawn
    for frame in own.frames:
        write_png(own.root / frame.file_path, np.zeros((48, 48, 3), np.uint8))

    def notes(data, **config):
        trained = replace(run, config={"method": "vanilla", "data": data})
        config = EvaluateConfig(geometry=None, **config)
        return [note for note in evaluate(trained, truth, tmp_path / "eval", config)["notes"] if "trained on" in note][
            :1
        ]

    its_own = {"path": str(own.root), "digest": training_digest(own)}
    others = {"path": "/elsewhere", "digest": "0123"}
    assert notes(its_own, align=own) == []
    assert notes(its_own)[0] == (
        f"The run was trained on other data, {own.root}, and is taken to be in the axes and scale of these."
    )
    sentence = f"The run was moved as one in the axes and scale of {own.root}, but was trained on /elsewhere."
    assert notes(others, align=own) == [sentence]


def test_a_scene_is_not_aligned(drawn, tmp_path):
    run, truth, own = drawn
    scene = ComposedRun(GaussianComposition([PlacedRun(run)]), tmp_path / "scene.toml")
    with pytest.raises(InputError, match=r"align: expected a run, found .*scene\.toml"):
        evaluate(scene, truth, tmp_path / "eval", EvaluateConfig(align=own))
