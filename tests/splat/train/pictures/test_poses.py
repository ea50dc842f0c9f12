"""Poses refined in training: the gradient against the camera's own, the gauge, that errors shrink, resume."""

import json
import logging
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spacesim.backend import ad, recordings
from spacesim.data.errors import InputError
from spacesim.data.files import write_json
from spacesim.data.records import Dataset
from spacesim.data.transforms import read_camera
from spacesim.splat.pose import moved, twist_between
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.project import Pinhole, project
from spacesim.splat.run import read_config
from spacesim.splat.train.checkpoint import read_tensors, write_tensors
from spacesim.splat.train.config import preset
from spacesim.splat.train.pictures.numbers import PictureNumbers
from spacesim.splat.train.pictures.poses import (
    MANY_TIMES,
    WAYS,
    PoseRefinement,
    left_jacobian,
    pose_config,
    pose_warning,
)
from spacesim.splat.train.train import train
from spacesim.splat.train.trainer import Trainer

CONFIG = replace(preset("demo"), init_count=150, iterations=40, refine_poses=True)


def disturbed(dataset: Dataset, degrees: float, seed: int = 0) -> Dataset:
    """Each training camera turned about itself, and moved by as many % of its distance."""
    rng = np.random.default_rng(seed)
    frames = []
    for frame in dataset.train:
        axis, way = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
        pose = frame.camera.world_from_camera.copy()
        pose[:3, 3] += 0.01 * degrees * np.linalg.norm(pose[:3, 3]) * way
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(degrees * axis, degrees=True).as_matrix()
        frames.append(replace(frame, camera=replace(frame.camera, world_from_camera=pose)))
    return replace(dataset, train=tuple(frames))


@pytest.mark.parametrize("antialiased", [False, True])
def test_the_gradient_is_that_of_the_camera(small_dataset, known_gaussians, antialiased):
    """Of sums of splats' numbers by a twist of the camera: through `Projection.moved`, and as force and torque."""
    poses = PoseRefinement(small_dataset, 1e-3, 100, antialiased)
    poses.numbers.values[2] = [0.1, -0.2, 0.15, 0.05, -0.1, 0.2]
    gaussians = Gaussians.from_numpy(known_gaussians)
    camera, rng = Pinhole.of(poses.camera(2)), np.random.default_rng(0)
    weights = {name: ad.Float(rng.normal(size=gaussians.count).tolist()) for name in (*WAYS, "depth")}
    twist = ad.Float([0.0] * 6)
    dr.enable_grad(twist)
    splats, _ = project(gaussians, camera.moved(twist), antialiased)
    dr.backward(sum((dr.sum(getattr(splats, name) * weight) for name, weight in weights.items()), ad.Float(0)))
    expected = np.array(dr.grad(twist), np.float64)
    plain, _ = project(gaussians, camera, antialiased)
    grad_splats = replace(plain, **{name: weights[name] for name in WAYS})
    for _ in range(3):  # traced, recorded, replayed
        found = poses._gradient(
            gaussians.rows()[:11], camera, grad_splats, [ad.Float(weights["depth"])], poses._centre, antialiased
        )
    axes, found = poses.camera_axes(2), np.array(found, np.float64)
    force, torque = axes @ found[:3], axes @ found[3:]
    middle = axes @ (poses.centre - poses.camera(2).position)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(force, expected[3:], atol=2e-4 * scale)
    np.testing.assert_allclose(torque + np.cross(middle, force), expected[:3], atol=2e-4 * scale)


def test_the_gradient_by_the_numbers_follows_from_that_of_a_small_motion(small_dataset):
    """For any force and torque f, t about the centre: (f, t) . d(motion) / d(numbers), by central differences."""
    poses = PoseRefinement(small_dataset, 1e-3, 100, False)
    at = np.array([0.3, -0.2, 0.4, 0.1, -0.2, 0.05])
    poses.numbers.values[1] = at
    points = np.random.default_rng(0).normal(size=(20, 3))
    pulls = np.random.default_rng(1).normal(size=(20, 3))  # of points in the camera's axes

    def energy(numbers: np.ndarray) -> float:
        camera = moved(poses.given[1], poses._twist(1, numbers)).camera_from_world
        return float((pulls * (points @ camera[:3, :3].T + camera[:3, 3])).sum())

    expected = [(energy(at + step) - energy(at - step)) / 2e-6 for step in 1e-6 * np.eye(6)]
    world = pulls @ poses.camera_axes(1)  # of points in the world's
    gradient = np.concatenate([world.sum(axis=0), np.cross(points - poses.centre, world).sum(axis=0)])
    np.testing.assert_allclose(poses._by_numbers(1, gradient), expected, rtol=1e-6)


def test_the_loss_falls_as_the_gradient_says(small_dataset, known_gaussians):
    """Central differences of the whole loss, of the true model from a wrong place. The adjoint leaves out that splats
    are cut off at an alpha of 1/255."""
    trainer = Trainer(small_dataset, CONFIG)
    trainer.gaussians = Gaussians.from_numpy(known_gaussians)
    poses, view_pass, rows = trainer.pictures.poses, trainer._view_pass, trainer.gaussians.rows()
    at = np.array([0.03, -0.04, 0.05, 0.02, -0.03, 0.04])

    def loss(numbers: np.ndarray) -> tuple[float, np.ndarray]:
        poses.numbers.values[0] = numbers
        view = trainer.pictures.shown(trainer.views[0])
        drawn = view_pass.forward(trainer.gaussians, rows, None, view, 0, 1, False)
        target = trainer._target_image(5, view, None)
        found, grad_splats = view_pass.backward(drawn, target, view.camera, absolute=False)
        read = poses._gradient(rows[:11], drawn.camera, grad_splats.splats, [], poses._centre, False)
        return float(found.value[0]), poses._by_numbers(0, np.array(read, np.float64))

    step = 1e-3
    slopes = [(loss(at + way)[0] - loss(at - way)[0]) / (2 * step) for way in step * np.eye(6)]
    gradient = loss(at)[1]
    for part in (slice(0, 3), slice(3, 6)):
        np.testing.assert_allclose(gradient[part], slopes[part], atol=0.1 * np.abs(slopes[part]).max())


def test_the_left_jacobian_says_how_turns_add():
    turn, small = np.array([0.4, -0.7, 0.2]), 1e-6 * np.array([1.0, 2, -1])
    added = (Rotation.from_rotvec(turn + small) * Rotation.from_rotvec(turn).inv()).as_rotvec()
    np.testing.assert_allclose(left_jacobian(turn) @ small, added, rtol=1e-4)
    np.testing.assert_array_equal(left_jacobian(np.zeros(3)), np.eye(3))


def test_what_all_cameras_share_is_taken_out(small_dataset):
    """A turn about any axis, a shift and a growth of all cameras; what is left of other motions shares nothing."""
    poses = PoseRefinement(small_dataset, 1e-3, 100, False)
    turn = Rotation.from_rotvec([3e-4, -2e-4, 4e-4])
    for i, camera in enumerate(poses.given):
        pose = camera.world_from_camera.copy()
        pose[:3, :3] = turn.as_matrix() @ pose[:3, :3]
        pose[:3, 3] = 1.0003 * turn.apply(pose[:3, 3]) + [1e-4, 3e-4, -2e-4]
        there = replace(camera, world_from_camera=pose)
        w = Rotation.from_matrix(there.camera_from_world[:3, :3] @ camera.world_from_camera[:3, :3]).as_rotvec()
        seen = there.camera_from_world[:3, :3] @ (poses.centre - there.position)
        poses.numbers.values[i] = [*w, *(seen - poses.seen[i]) / poses.distances[i]]
    common = np.abs(poses.numbers.values).max()
    assert common > 2e-4
    assert np.abs(poses._gauge.held(poses.numbers.values)).max() < 2e-3 * common
    others = np.random.default_rng(0).normal(size=poses.numbers.values.shape)
    held = poses._gauge.held(others)
    np.testing.assert_allclose(poses._gauge.held(held), held, atol=1e-12)
    assert 0.1 * np.abs(others).mean() < np.abs(held - others).mean() < np.abs(held).mean()


def test_what_cameras_share_far_beyond_chance_is_not_believed(small_dataset):
    """As where points are off the pictures that these cameras fit."""
    poses = PoseRefinement(small_dataset, 1e-3, 100, False)
    gauge, numbers = poses._gauge, np.random.default_rng(0).normal(0, 1e-3, poses.numbers.values.shape)
    numbers = np.linalg.solve(gauge.moves, numbers[:, :, None])[:, :, 0]  # all move pictures alike
    by_chance = gauge.believed(numbers)
    assert np.abs(by_chance).max() > 1e-4
    alike = (gauge.ways @ (np.array([0, 0, 1, 0, 0, 0, 0]) - gauge.growth * gauge.growth[2])).reshape(numbers.shape)
    np.testing.assert_array_equal(gauge.believed(numbers + 0.1 * alike), 0)
    np.testing.assert_allclose(gauge.believed(numbers + 1e-4 * alike), by_chance, atol=2e-4)


def test_one_camera_stays(small_dataset):
    """Wherever it goes, the model could go."""
    poses = PoseRefinement(replace(small_dataset, train=small_dataset.train[:1]), 1e-3, 50, False)
    poses.numbers.values[0] = [0.1, 0.2, -0.1, 0.1, 0.1, -0.2]
    poses.hold(50)
    np.testing.assert_allclose(poses.numbers.values, 0, atol=1e-12)


def test_disturbed_poses_come_back_before_a_model_that_is_right(small_dataset, known_gaussians):
    """Where the object is seen, and how it is turned: medians."""
    given = disturbed(small_dataset, 2)
    drawn_as = {"antialiased": False, "surfels": False}  # the model that is right
    config = replace(CONFIG, iterations=800, rates=replace(CONFIG.rates, poses=6e-3), **drawn_as)
    trainer = Trainer(given, config)
    trainer.gaussians = Gaussians.from_numpy(known_gaussians)
    poses = trainer.pictures.poses

    def off() -> tuple[float, float]:
        shifts, turns = [], []
        for i, frame in enumerate(small_dataset.train):
            camera = poses.camera(i)
            seen, true = (c.camera_from_world[:3, :3] @ (poses.centre - c.position) for c in (camera, frame.camera))
            shifts.append(np.linalg.norm(seen - true) / 3)
            turns.append(np.linalg.norm(twist_between(camera, frame.camera)[:3]))
        return float(np.median(shifts)), float(np.median(turns))

    before = off()
    rows = trainer.gaussians.rows()
    for step in range(40, 700):
        view = trainer.pictures.shown(trainer.views.at_step(step))
        drawn = trainer._view_pass.forward(trainer.gaussians, rows, None, view, 1, 1, False)
        target = trainer._target_image(step, view, None)
        loss, grad_splats = trainer._view_pass.backward(drawn, target, view.camera, absolute=False)
        trainer.pictures.learn(step, view, rows, drawn, loss, grad_splats, trainer.scene_scale)
    after = off()
    assert after[0] < 0.2 * before[0]
    assert after[1] < 0.4 * before[1]


def test_the_model_stays_while_cameras_find_their_places(small_dataset):
    trainer = Trainer(disturbed(small_dataset, 1), replace(CONFIG, iterations=100))
    before = trainer.gaussians.to_numpy()["means"]
    assert trainer.pictures.poses.anchored == 25
    while trainer.iteration < 25:
        trainer.step()
    np.testing.assert_array_equal(trainer.gaussians.to_numpy()["means"], before)
    common = trainer.pictures.poses.common
    assert np.abs(common).max() > 0
    while trainer.iteration < 100:
        trainer.step()
    assert np.abs(trainer.gaussians.to_numpy()["means"] - before).max() > 0
    poses = trainer.pictures.poses
    np.testing.assert_allclose(poses._gauge.shares @ poses.numbers.values.ravel(), common, atol=1e-9)


@pytest.mark.threads
@pytest.mark.parametrize("changes", [{}, {"views_per_step": 3}, {"num_downscales": 1, "supersample": 2}])
def test_resume_is_the_same_to_the_bit(small_dataset, tmp_path, changes):
    config = replace(CONFIG, exposure_per_picture=True, **changes)
    straight = Trainer(small_dataset, config)
    for _ in range(17):
        straight.step()
    straight.save(tmp_path / "c.safetensors")
    resumed = Trainer(small_dataset, config)
    resumed.restore(tmp_path / "c.safetensors")
    for _ in range(15):
        straight.step()
        resumed.step()
    for name, values in straight.pictures.tensors().items():
        np.testing.assert_array_equal(resumed.pictures.tensors()[name], values, err_msg=name)
    assert np.abs(straight.pictures.poses.numbers.values).max() > 0
    for name, values in straight.gaussians.to_numpy().items():
        np.testing.assert_array_equal(resumed.gaussians.to_numpy()[name], values, err_msg=name)


def test_a_checkpoint_does_not_change_what_follows(small_dataset, tmp_path):
    """Steps that are pending are taken when it is written, else later."""
    config = replace(CONFIG, exposure_per_picture=True)
    plain, saved = Trainer(small_dataset, config), Trainer(small_dataset, config)
    for _ in range(20):
        plain.step()
        saved.step()
        saved.save(tmp_path / "c.safetensors")
    for name, values in plain.gaussians.to_numpy().items():
        np.testing.assert_array_equal(saved.gaussians.to_numpy()[name], values, err_msg=name)


@pytest.mark.parametrize("method", ["shadow-map", "shadow-splat"])
def test_methods_with_shadows_refine_poses_too(small_lit_dataset, method):
    trainer = Trainer(
        small_lit_dataset, replace(preset("demo", method), init_count=60, iterations=30, refine_poses=True)
    )
    while trainer.iteration < 12:
        trainer.step()
    trainer.pictures.poses.numbers.follow()
    assert (np.abs(trainer.pictures.poses.numbers.values).max(axis=1) > 0).any()


def test_no_picture_is_recorded_anew(small_dataset):
    trainer, known = Trainer(small_dataset, replace(CONFIG, exposure_per_picture=True)), []
    for _ in range(24):
        trainer.step()
        known.append(recordings())
    assert len(set(known[16:])) == 1  # from the second visits of eight views on, the host may not wait for lists


def test_a_run_tells_of_its_poses(small_dataset, tmp_path, caplog):
    with caplog.at_level(logging.INFO):
        run = train(small_dataset, tmp_path / "run", replace(CONFIG, exposure_per_picture=True))
    assert "% of the distance (median)" in caplog.text
    record = json.loads((run.path / "training.json").read_text())
    assert 0 < record["poses"]["degrees"] < 10
    assert 0 < record["poses"]["share_of_distance"] < 0.2
    assert record["gains"]["least"] < record["gains"]["most"]
    cameras = json.loads((run.path / "cameras.json").read_text())
    assert [frame["file_path"] for frame in cameras["frames"]] == [frame.file_path for frame in small_dataset.train]
    camera, first = read_camera(run.path / "cameras.json"), small_dataset.train[0].camera
    assert (camera.width, camera.fx) == (first.width, first.fx)
    assert 0 < np.abs(camera.world_from_camera - first.world_from_camera).max() < 0.3


def test_the_model_starts_anew_with_poses_that_stay(small_dataset, tmp_path):
    run = train(small_dataset, tmp_path / "run", CONFIG)
    values = read_tensors(run.path / "poses.safetensors")[0]["values"]
    first, _ = read_config(run.path / "poses" / "config.json")
    assert (first.iterations, first.antialiased) == (CONFIG.iterations, True)
    assert np.abs(values).max() > 0
    trainer = Trainer(small_dataset, CONFIG, poses=values)
    while trainer.iteration < CONFIG.iterations:
        trainer.step()
    np.testing.assert_array_equal(trainer.pictures.poses.numbers.values, values)
    for name, array in trainer.gaussians.to_numpy().items():
        np.testing.assert_array_equal(run.gaussians.to_numpy()[name], array, err_msg=name)
    cameras = json.loads((run.path / "cameras.json").read_text())
    np.testing.assert_allclose(cameras["frames"][3]["transform_matrix"], trainer.pictures.poses.camera(3).opengl)


@pytest.mark.parametrize("at", [12, 40, 55])
def test_an_interruption_in_either_phase_changes_nothing(small_dataset, tmp_path, monkeypatch, at):
    """at: steps of both together; where a phase has not begun, its folder holds nothing that stands in the way."""
    straight = train(small_dataset, tmp_path / "straight", CONFIG)
    step, taken = Trainer.step, []

    def killed(self):
        if len(taken) == at:
            raise SystemExit
        taken.append(0)
        return step(self)

    config = replace(CONFIG, checkpoint_every=5)
    monkeypatch.setattr(Trainer, "step", killed)
    with pytest.raises(SystemExit):
        train(small_dataset, tmp_path / "run", config)
    monkeypatch.setattr(Trainer, "step", step)
    run = train(small_dataset, tmp_path / "run", config, resume=True)
    for name, array in straight.gaussians.to_numpy().items():
        np.testing.assert_array_equal(run.gaussians.to_numpy()[name], array, err_msg=name)
    assert (run.path / "cameras.json").read_bytes() == (straight.path / "cameras.json").read_bytes()


def test_poses_of_another_training_are_refused(small_dataset, tmp_path):
    train(small_dataset, tmp_path / "run" / "poses", pose_config(replace(CONFIG, refine_poses=False)))
    write_json(tmp_path / "run" / "config.json", {})
    with pytest.raises(InputError, match=r"poses: was started with refine_poses False"):
        train(small_dataset, tmp_path / "run", CONFIG)
    write_tensors(tmp_path / "other" / "poses.safetensors", {"values": np.zeros((2, 6))}, {})
    write_json(tmp_path / "other" / "config.json", {})
    with pytest.raises(InputError, match=r"expected the poses of .* pictures, found others; delete it"):
        train(small_dataset, tmp_path / "other", CONFIG)


def test_a_training_too_short_to_find_poses_says_so(small_dataset, tmp_path, caplog):
    count = len(small_dataset.train)
    train(small_dataset, tmp_path / "run", replace(CONFIG, iterations=3))
    least = f"expected {MANY_TIMES * count} or more iterations for {count} training pictures, found"
    assert [record.getMessage().count(least) for record in caplog.records if record.levelname == "WARNING"] == [1]
    enough = replace(CONFIG, iterations=MANY_TIMES * count)
    assert pose_warning(count, enough) == ""
    assert pose_warning(count, replace(enough, iterations=enough.iterations - 1)) != ""
    assert pose_warning(2 * count, replace(enough, views_per_step=2)) == ""


def test_a_run_without_has_none(small_dataset, tmp_path):
    run = train(small_dataset, tmp_path / "run", replace(CONFIG, refine_poses=False, iterations=3))
    assert not (run.path / "cameras.json").exists()
    assert "poses" not in json.loads((run.path / "training.json").read_text())


def test_a_checkpoint_of_other_pictures_is_refused(small_dataset, tmp_path):
    fewer = replace(small_dataset, train=small_dataset.train[:-1])
    Trainer(fewer, CONFIG).save(tmp_path / "c.safetensors")
    with pytest.raises(InputError, match=r"expected a checkpoint of this training \(pictures\.poses\.values"):
        Trainer(small_dataset, CONFIG).restore(tmp_path / "c.safetensors")


def test_what_is_not_finite_moves_nothing():
    numbers = PictureNumbers(2, 3)
    numbers.learn(1, np.array([np.nan, 1, 1]), 0.1)
    np.testing.assert_array_equal(numbers.of(1), 0)
    numbers.learn(1, np.array([2.0, -1, 0]), 0.1)
    np.testing.assert_allclose(numbers.of(1), [-0.1, 0.1, 0])
    np.testing.assert_array_equal(numbers.of(0), 0)
