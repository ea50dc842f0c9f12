"""Training as a whole: it learns, it repeats to the bit, it survives interruption."""

import gc
import json
import logging
import math
import os
import shutil
import subprocess
import sys
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from splats import random_splats

from spacesim.backend import ad, recordings
from spacesim.cli import main
from spacesim.data.errors import InputError, WorkError
from spacesim.data.images import load_image, write_png
from spacesim.data.images.tone import as_bytes
from spacesim.data.lock import lock_folder
from spacesim.data.records import Camera
from spacesim.data.store import read_points, write_points
from spacesim.learning.cameras import focus_point
from spacesim.learning.folder import checkpoints
from spacesim.splat.export.ply import read_ply, write_ply
from spacesim.splat.raster.gaussians import Gaussians, principal_axes
from spacesim.splat.raster.project import Pinhole
from spacesim.splat.raster.render import render
from spacesim.splat.run import load_run
from spacesim.splat.train import view_pass, views
from spacesim.splat.train.checkpoint import read_tensors, write_tensors
from spacesim.splat.train.config import LearningRates, TrainConfig, preset, warm_start, with_options, with_settings
from spacesim.splat.train.start import (
    COVER,
    RADIUS,
    distance_warning,
    few_left_warning,
    gaussians_at,
    initial_gaussians,
    largest_scale,
    lay_flat,
    scale_warning,
    scene_scale,
    sky_warning,
)
from spacesim.splat.train.strategies.control import DensificationConfig
from spacesim.splat.train.strategies.mcmc import McmcConfig
from spacesim.splat.train.train import train
from spacesim.splat.train.trainer import Trainer
from spacesim.splat.train.view_pass import ViewResult
from spacesim.splat.train.warm_start import WarmStartConfig

REFINEMENT = DensificationConfig(
    refine_start=10, refine_every=20, pause_after_reset=0, reset_every=4, refine_stop=150, screen_size_stop=0
)
CONFIG = TrainConfig(iterations=160, checkpoint_every=50, sh_every=40, sh_degree=1, refinement=REFINEMENT)


def psnr(model: Gaussians, dataset) -> float:
    errors = []
    for frame in dataset.test:
        color = np.array(render(model, Pinhole.of(frame.camera)).color).T
        truth = load_image(dataset, frame).over(np.zeros(3)).reshape(-1, 3)
        errors.append(np.mean((np.clip(color, 0, 1) - truth) ** 2))
    return float(np.mean(-10 * np.log10(errors)))


@pytest.fixture(scope="module")
def finished(small_dataset, tmp_path_factory):
    return train(small_dataset, tmp_path_factory.mktemp("runs") / "run", CONFIG)


def test_training_learns_views_that_it_has_not_seen(small_dataset, finished):
    start = initial_gaussians(small_dataset, None, 60, 1, 0)
    assert psnr(finished.gaussians, small_dataset) > psnr(start, small_dataset) + 6


@pytest.mark.threads
def test_same_seed_same_model_to_the_bit(small_dataset, finished, tmp_path):
    again = train(small_dataset, tmp_path / "again", CONFIG)
    name = "model.safetensors"
    assert (again.path / name).read_bytes() == (finished.path / name).read_bytes()
    assert again.training["history"] == finished.training["history"]
    other = train(small_dataset, tmp_path / "other", replace(CONFIG, seed=1, iterations=20))
    assert not np.array_equal(other.gaussians.to_numpy()["means"][:10], finished.gaussians.to_numpy()["means"][:10])


def test_no_training_ends_with_a_refinement_that_nothing_follows(small_dataset):
    """Step 80 resets opacities to at most 0.1, but not in the last quarter."""
    for steps in (80, 120):
        trainer = Trainer(small_dataset, replace(CONFIG, iterations=steps))
        trainer.gaussians.logit_opacities += 3
        trainer.iteration = 79  # finished
        trainer.step()
        assert (np.array(trainer.gaussians.logit_opacities).max() > 0) == (steps == 80)


def test_a_run_trained_with_the_filter_is_drawn_with_it(small_dataset, tmp_path, capsys):
    run = train(small_dataset, tmp_path / "run", replace(CONFIG, iterations=60, antialiased=True))
    plain = train(small_dataset, tmp_path / "plain", replace(CONFIG, iterations=60))
    assert not np.array_equal(run.gaussians.to_numpy()["means"][:20], plain.gaussians.to_numpy()["means"][:20])
    camera = small_dataset.test[0].camera
    drawn = render(load_run(run.path).gaussians, Pinhole.of(camera), outputs=("color",), antialiased=True)
    np.testing.assert_array_equal(load_run(run.path).predict(camera).rgb, drawn.image("color"))
    unfiltered = render(run.gaussians, Pinhole.of(camera), outputs=("color",)).image("color")
    assert not np.array_equal(drawn.image("color"), unfiltered)
    for exported, warned in ((run, True), (plain, False)):  # other viewers draw as they do
        assert main(["export", str(exported.path), "--ply", str(tmp_path / "model.ply")]) == 0
        assert ("is antialiased" in capsys.readouterr().err) == warned


@pytest.mark.parametrize("stop", [50, 100])
def test_a_restored_trainer_goes_on_as_if_never_stopped(small_dataset, tmp_path, stop):
    straight = Trainer(small_dataset, CONFIG)
    for _ in range(stop):
        straight.step()
    straight.save(tmp_path / "checkpoint.safetensors")
    resumed = Trainer(small_dataset, CONFIG)
    resumed.restore(tmp_path / "checkpoint.safetensors")
    for _ in range(30):
        straight.step()
        resumed.step()
    one, other = straight.gaussians.to_numpy(), resumed.gaussians.to_numpy()
    for name, value in one.items():
        np.testing.assert_array_equal(value, other[name])


def test_checkpoints_that_do_not_fit_are_refused(small_dataset, tmp_path):
    trainer = Trainer(small_dataset, CONFIG)
    trainer.save(tmp_path / "good.safetensors")
    tensors, header = read_tensors(tmp_path / "good.safetensors")
    broken = [
        ({**tensors, "adam.first.00": tensors["adam.first.00"][1:]}, header),
        ({name: value for name, value in tensors.items() if name != "adam.second.10"}, header),
        ({**tensors, "strategy.seen": tensors["strategy.seen"][1:]}, header),
        ({name: value for name, value in tensors.items() if name != "means"}, header),
        ({**tensors, "sh": tensors["sh"][:, :1]}, header),
        (tensors, {**header, "iteration": 10**6}),
        (tensors, {**header, "iteration": "many"}),
        (tensors, {**header, "history": None}),
    ]
    for number, (content, changed) in enumerate(broken):
        path = tmp_path / f"broken_{number}.safetensors"
        write_tensors(path, content, {key: value for key, value in changed.items() if key != "format"})
        with pytest.raises(InputError, match=path.name):
            trainer.restore(path)
    trainer.restore(tmp_path / "good.safetensors")


def test_a_picture_that_is_not_whole_is_refused_before_the_first_step(small_dataset, tmp_path):
    dataset = replace(small_dataset, root=Path(shutil.copytree(small_dataset.root, tmp_path / "data")))
    path, config = dataset.root / dataset.train[-1].file_path, replace(CONFIG, iterations=1)
    whole = path.read_bytes()
    path.write_bytes(whole[:-10])
    with pytest.raises(InputError, match=path.name):
        train(dataset, tmp_path / "run", config)
    assert not (tmp_path / "run").exists()
    path.write_bytes(whole)
    train(dataset, tmp_path / "run", config)


def test_training_whose_picture_breaks_is_kept_and_resumed(small_dataset, tmp_path, monkeypatch):
    """In the middle of a step of several views; with the picture as it was, the model is the same to the bit."""
    config = replace(CONFIG, views_per_step=3, iterations=90, checkpoint_every=1000)
    straight = train(small_dataset, tmp_path / "straight", config)
    monkeypatch.setattr(views, "kept_bytes", lambda: (0, 0))  # so that pictures are read again and again
    dataset = replace(small_dataset, root=Path(shutil.copytree(small_dataset.root, tmp_path / "data")))
    path = dataset.root / dataset.train[0].file_path
    whole = path.read_bytes()
    with pytest.raises(InputError, match=path.name):
        train(dataset, tmp_path / "run", config, on_progress=lambda progress: path.write_bytes(b"x"))
    (checkpoint,) = checkpoints(tmp_path / "run")
    assert checkpoint.name > "step_00000050"
    with pytest.raises(InputError, match=path.name):
        train(dataset, tmp_path / "run", config, resume=True)
    path.write_bytes(whole)
    resumed = train(dataset, tmp_path / "run", config, resume=True)
    name = "model.safetensors"
    assert (resumed.path / name).read_bytes() == (straight.path / name).read_bytes()


def test_a_run_that_has_lost_its_model_begins_anew_and_says_so(small_dataset, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    config = replace(CONFIG, iterations=1)
    run = train(small_dataset, tmp_path / "run", config, resume=True)
    assert "no checkpoint" not in caplog.text
    (run.path / "model.safetensors").unlink()
    train(small_dataset, tmp_path / "run", config, resume=True)
    assert f"{run.path}: no checkpoint is there; training starts from the beginning" in caplog.messages


def test_a_file_is_no_folder_for_a_run(small_dataset, tmp_path):
    (tmp_path / "run").write_bytes(b"")
    with pytest.raises(InputError, match="expected an empty or new folder for the run, found a file"):
        train(small_dataset, tmp_path / "run", CONFIG)


@pytest.mark.threads
def test_killed_training_is_completed_by_resume(small_dataset, finished, tmp_path):
    """The process dies without warning right after a checkpoint; --resume gives the same model to the bit."""
    script = f"""
import os, signal
from pathlib import Path
from spacesim.data.store import read_dataset
from spacesim.splat.train.checkpoint import read_tensors, write_tensors
from spacesim.splat.train.config import TrainConfig
from spacesim.splat.train.train import train
config = TrainConfig.from_json({CONFIG.to_json()!r})
def die(progress):
    if progress.iteration == 100 and progress.gaussian_count:
        os.kill(os.getpid(), signal.SIGKILL)
train(read_dataset(Path({str(small_dataset.root)!r})), Path({str(tmp_path / "run")!r}), config, on_progress=die)
"""
    died = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert died.returncode == -9, died.stderr
    with pytest.raises(InputError, match="resume"):
        load_run(tmp_path / "run")
    with pytest.raises(InputError, match="expected a new folder, found a run; resume=True"):
        train(small_dataset, tmp_path / "run", CONFIG)
    with pytest.raises(InputError, match="seed"):
        train(small_dataset, tmp_path / "run", replace(CONFIG, seed=5), resume=True)
    resumed = train(small_dataset, tmp_path / "run", CONFIG, resume=True)
    name = "model.safetensors"
    assert (resumed.path / name).read_bytes() == (finished.path / name).read_bytes()


def test_one_training_at_a_time_in_a_folder(small_dataset, tmp_path):
    """Two would mix the configuration of one with the checkpoints of the other."""
    run, config = tmp_path / "run", replace(CONFIG, iterations=2)
    with lock_folder(run), pytest.raises(InputError, match="run: expected no other run at work in the folder"):
        train(small_dataset, run, config)
    assert not list(run.iterdir())
    leftover = run / ".config.json.0123.part"  # of a process that was killed while it wrote
    leftover.write_bytes(b"half a file")
    assert train(small_dataset, run, config).gaussian_count > 0
    assert not leftover.exists()


def test_a_run_is_not_resumed_through_another_lens(small_dataset, finished):
    lens = (0.1, 0.0, 0.0, 0.0, 0.0)
    other = replace(small_dataset, train=tuple(replace(f, distortion=lens) for f in small_dataset.train))
    with pytest.raises(InputError, match=r"was started with data\.digest"):
        train(other, finished.path, CONFIG, resume=True)


def test_a_finished_run_is_left_alone_by_resume(small_dataset, finished):
    before = (finished.path / "model.safetensors").stat().st_mtime_ns
    train(small_dataset, finished.path, CONFIG, resume=True)
    assert (finished.path / "model.safetensors").stat().st_mtime_ns == before


def test_the_run_says_how_it_was_made(finished):
    config = json.loads((finished.path / "config.json").read_text())
    assert TrainConfig.from_json(config) == CONFIG
    assert finished.training["history"][-1]["iteration"] == CONFIG.iterations
    assert finished.training["gaussians"] == finished.gaussian_count
    assert len(list((finished.path / "checkpoints").glob("step_*.safetensors"))) == 2


def test_refinement_that_leaves_nothing_is_said(small_dataset):
    trainer = Trainer(small_dataset, replace(CONFIG, refinement=replace(REFINEMENT, prune_opacity=0.499)))
    with pytest.raises(WorkError, match="prune every Gaussian"):
        trainer.run(lambda progress: None, lambda: None)


def test_random_background_keeps_a_black_hull_solid(black_dataset):
    """Over black a black hull costs nothing to lose, and all of it goes; against alpha its silhouette stays."""
    over_black = Trainer(black_dataset, replace(CONFIG, random_background=False))
    with pytest.raises(WorkError, match="prune every Gaussian"):
        over_black.run(lambda progress: None, lambda: None)
    against_alpha = Trainer(black_dataset, CONFIG)
    against_alpha.run(lambda progress: None, lambda: None)
    frame = black_dataset.test[0]
    alpha = np.array(render(against_alpha.gaussians, Pinhole.of(frame.camera)).alpha)
    truth = load_image(black_dataset, frame).alpha.ravel()
    assert alpha[truth > 0.99].mean() > 0.9
    assert alpha[truth < 0.01].mean() < 0.05


def test_backgrounds_are_random_and_black_behind_opaque_pictures_unless_as_splatfacto(small_dataset, opaque_dataset):
    def drawn(dataset, **changes) -> np.ndarray:
        trainer = Trainer(dataset, replace(CONFIG, **changes))
        return np.array([trainer.background(step, trainer.views[0]) for step in range(50)])

    black = np.zeros((50, 3))
    np.testing.assert_array_equal(drawn(opaque_dataset), black)
    np.testing.assert_array_equal(drawn(small_dataset, random_background=False), black)
    np.testing.assert_array_equal(drawn(opaque_dataset, random_background=False, random_behind_opaque=True), black)
    like_splatfacto = drawn(opaque_dataset, random_behind_opaque=True)
    assert (like_splatfacto.min() < 0.1) & (like_splatfacto.max() > 0.9)
    np.testing.assert_array_equal(like_splatfacto, drawn(small_dataset))
    assert preset("thesis").random_background
    assert preset("thesis").random_behind_opaque
    assert not preset("fine").random_behind_opaque


def test_the_largest_scale_is_one_of_pictures_or_covers_the_surface(small_dataset):
    """Of a plate of 4 square metres, 5 metres before one camera that stands at the origin and looks along z."""
    points = np.random.default_rng(0).uniform(-1, 1, (3000, 3)) * [1, 1, 0] + [0, 0, 5]
    gaussians = gaussians_at(points, np.full((3000, 3), 0.5), 0)
    camera = Camera.from_fov(np.eye(4), 300, 200, 60)
    frame = replace(small_dataset.train[0], camera=camera)
    dataset = replace(small_dataset, train=(frame,))
    width = 2 * 5 * np.tan(np.radians(30))
    assert largest_scale(dataset, gaussians, 0.01, 10**6) == pytest.approx(0.01 * width / RADIUS, rel=0.01)
    for few in (100, 1000):
        covered = few * 2 * np.pi * largest_scale(dataset, gaussians, 0.01, few) ** 2
        assert covered == pytest.approx(COVER * 4, rel=0.15)


def test_sizes_are_held_while_gaussians_are_split(small_lit_dataset):
    refinement = replace(REFINEMENT, split_screen="held", split_screen_size=0.02, max_gaussians=2000)
    config = replace(CONFIG, light=preset("demo", "shadow-splat").light, surfels=True, refinement=refinement)
    trainer = Trainer(small_lit_dataset, config)
    bound = np.float32(np.log(largest_scale(small_lit_dataset, trainer.gaussians, 0.02, 2000)))
    widest = []
    for _ in range(20):
        trainer.step()
        widest.append(np.array(trainer.gaussians.log_scales).max())
    assert widest[9] > bound
    np.testing.assert_array_equal(np.maximum(widest[10:], bound), bound)
    for other in (replace(config, strategy=McmcConfig()), replace(config, iterations=10)):
        assert not other.holds_sizes


def test_a_start_like_splatfactos(small_dataset):
    """A cube of 10 scene scales about the cameras' mean, colours of 0.5 + C0 u, rotations of every kind."""
    cameras = np.array([frame.camera.position for frame in small_dataset.train])
    found = initial_gaussians(small_dataset, "random", 4000, 1, 3, like_splatfacto=True).to_numpy()
    offsets = found["means"] - cameras.mean(axis=0)
    np.testing.assert_allclose(np.abs(offsets).max(axis=0), 5 * scene_scale(small_dataset), rtol=5e-3)
    assert 0 <= found["sh"][:, 0].min() < 0.01
    assert 0.99 < found["sh"][:, 0].max() <= 1
    np.testing.assert_allclose(np.linalg.norm(found["quaternions"], axis=1), 1, rtol=1e-6)
    np.testing.assert_allclose((found["quaternions"] ** 2).mean(axis=0), 0.25, atol=0.02)
    assert (found["log_scales"] == found["log_scales"][:, :1]).all()
    points, ours = (initial_gaussians(small_dataset, "points", 40, 1, 3, like_splatfacto=s).to_numpy() for s in (1, 0))
    for name in ("means", "log_scales", "logit_opacities", "sh"):
        np.testing.assert_array_equal(points[name], ours[name])
    assert (ours["quaternions"] == [1, 0, 0, 0]).all()
    assert not (points["quaternions"] == [1, 0, 0, 0]).all()
    assert preset("thesis").splatfacto_start


def test_surfels_start_on_the_surface():
    means = np.random.default_rng(0).normal(size=(2000, 3))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    gaussians = gaussians_at(means, np.full((2000, 3), 0.5), 0)
    lay_flat(gaussians)
    normals = np.array(principal_axes(gaussians.quaternions)[0]).T
    assert np.quantile(np.abs(np.einsum("nc,nc->n", normals, means)), 0.01) > 0.98


def test_surfels_stay_discs(small_dataset):
    """Also those that have been split."""
    trainer = Trainer(small_dataset, replace(CONFIG, surfels=True, iterations=60))
    start = trainer.gaussians.to_numpy()["log_scales"]
    trainer.run(lambda progress: None, lambda: None)
    after = trainer.gaussians.to_numpy()["log_scales"]
    assert len(after) > len(start)
    assert np.ptp(after[:, 1] - after[:, 2]) > 0.01
    for scales in (start, after):
        np.testing.assert_allclose(np.exp(scales[:, 0]), 0.05 * np.exp(scales[:, 1:].min(axis=1)), rtol=1e-5)


@pytest.mark.parametrize("init", ["points", "random"])
def test_initial_gaussians(small_dataset, init):
    one, two = (initial_gaussians(small_dataset, init, 40, 2, 3).to_numpy() for _ in range(2))
    for name, value in one.items():
        np.testing.assert_array_equal(value, two[name])
    assert one["means"].shape == (40, 3)
    assert one["sh"].shape == (40, 9, 3)
    np.testing.assert_allclose(1 / (1 + np.exp(-one["logit_opacities"])), 0.1, rtol=1e-5)
    assert np.abs(one["means"]).max() < 2


def test_initialising_from_what_is_not_there(small_dataset):
    with pytest.raises(InputError, match="mesh"):
        initial_gaussians(small_dataset, "mesh", 40, 0, 0)
    with pytest.raises(InputError, match="ply_file_path"):
        initial_gaussians(replace(small_dataset, ply_file_path=None), "points", 40, 0, 0)


def test_scene_scale_and_focus(small_dataset):
    np.testing.assert_allclose(focus_point(small_dataset), 0, atol=1e-6)
    centers = np.array([frame.camera.position for frame in small_dataset.train])
    assert scene_scale(small_dataset) == pytest.approx(np.abs(centers - centers.mean(0)).max())


def placed(dataset, factor=1.0, shift=0.0):
    """The dataset with other positions of its training cameras."""
    cameras = [replace(f.camera, world_from_camera=f.camera.world_from_camera.copy()) for f in dataset.train]
    for camera in cameras:
        camera.world_from_camera[:3, 3] = factor * camera.world_from_camera[:3, 3] + shift
    return replace(dataset, train=tuple(replace(f, camera=c) for f, c in zip(dataset.train, cameras, strict=True)))


def test_poses_in_kilometres_are_warned_of(small_dataset):
    bare = replace(small_dataset, ply_file_path=None, mesh_path=None)
    assert scale_warning(bare) == scale_warning(placed(bare, 1e-2)) == scale_warning(placed(bare, 1e4)) == ""
    assert "expected poses in metres, found training cameras 0.003 m from" in scale_warning(placed(bare, 1e-3))


def test_points_too_near_to_be_drawn_are_warned_of(small_dataset, tmp_path):
    """The cameras are 3 from the middle of the object."""
    points = read_points(small_dataset.root / small_dataset.ply_file_path)[0]
    for factor, warned in ((1.0, False), (2e-2, False), (3.5e-3, True), (1e-3, True)):
        write_points(tmp_path / "points.ply", factor * points, np.zeros((len(points), 3), np.uint8))
        scaled = replace(placed(small_dataset, factor), root=tmp_path, ply_file_path="points.ply")
        assert bool(scale_warning(scaled)) == warned


def test_poses_far_from_the_origin_are_warned_of(small_dataset):
    assert distance_warning(small_dataset) == distance_warning(placed(small_dataset, shift=1e3)) == ""
    assert distance_warning(placed(small_dataset, 1e4, 1e6)) == ""
    assert "found it 1.2e+07 m away, where single precision has steps of 0.5 m" in distance_warning(
        placed(small_dataset, shift=7e6)
    )


def test_a_black_sky_without_alpha_is_warned_of(small_dataset, tmp_path):
    def shown(background: float, masks: bool = False) -> str:
        frames = []
        for frame in small_dataset.train:
            image, name = load_image(small_dataset, frame), Path(frame.file_path).name
            write_png(tmp_path / name, as_bytes(image.over(np.full(3, background))))
            write_png(tmp_path / f"mask_{name}", as_bytes(image.alpha))
            frames.append(replace(frame, file_path=name, silhouette_path=f"mask_{name}" if masks else None))
        return sky_warning(replace(small_dataset, root=tmp_path, train=tuple(frames)))

    assert sky_warning(small_dataset) == shown(0.3) == shown(0.0, masks=True) == ""
    assert "cut out of its black sky, found no alpha, silhouettes or masks" in shown(0.0)
    for frame in small_dataset.train:  # a black object before a wall
        pixels = np.full((frame.camera.height, frame.camera.width, 3), 120, np.uint8)
        pixels[8:-8, 8:-8] = 5
        write_png(tmp_path / Path(frame.file_path).name, pixels)
    walled = [replace(frame, file_path=Path(frame.file_path).name) for frame in small_dataset.train]
    assert sky_warning(replace(small_dataset, root=tmp_path, train=tuple(walled))) == ""


def test_few_gaussians_at_the_end_are_warned_of():
    def history(*counts: int) -> list[dict[str, float]]:
        return [{"iteration": 50.0 * k, "loss": 0.1, "gaussians": count} for k, count in enumerate(counts)]

    assert (
        few_left_warning([]) == few_left_warning(history(8000, 300, 2000)) == few_left_warning(history(50, 9000)) == ""
    )
    assert few_left_warning(history(8000, 4000, 1999)).startswith("1999 Gaussians are left of 8000")


def test_ply_round_trip(finished, tmp_path):
    write_ply(finished.gaussians, tmp_path / "model.ply")
    ours, back = finished.gaussians.to_numpy(), read_ply(tmp_path / "model.ply").to_numpy()
    for name in ("means", "log_scales", "logit_opacities", "sh"):
        np.testing.assert_array_equal(ours[name], back[name])
    header = (tmp_path / "model.ply").read_bytes().split(b"end_header\n")[0].decode()
    names = [line.split()[-1] for line in header.splitlines() if line.startswith("property")]
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[-8:] == ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    # INRIA's files hold the rest channel by channel: f_rest_0 .. 2 are the red ones of degree 1
    table = np.frombuffer((tmp_path / "model.ply").read_bytes().split(b"end_header\n")[1], "<f4")
    row = table.reshape(-1, len(names))[0]
    np.testing.assert_array_equal(row[9:12], ours["sh"][0, 1:4, 0])


def test_broken_files_are_named(finished, tmp_path):
    whole = (finished.path / "model.safetensors").read_bytes()
    for name in ("config.json", "training.json"):
        (tmp_path / name).write_text((finished.path / name).read_text())
    for content in (whole[: len(whole) // 2], b"", b"nonsense"):
        (tmp_path / "model.safetensors").write_bytes(content)
        with pytest.raises(InputError, match="safetensors"):
            load_run(tmp_path)
    (tmp_path / "broken.ply").write_bytes(b"ply\nformat ascii 1.0\nend_header\n")
    with pytest.raises(InputError, match=r"broken\.ply"):
        read_ply(tmp_path / "broken.ply")


def test_ply_of_no_gaussians(tmp_path):
    empty = Gaussians.from_numpy({name: values[:0] for name, values in random_splats(3).items()})
    write_ply(empty, tmp_path / "empty.ply")
    assert read_ply(tmp_path / "empty.ply").count == 0


@pytest.mark.parametrize(
    ("option", "value"),
    [
        *(("iterations", 0), ("init", "dreams"), ("seed", -1), ("sh_degree", 4)),
        *(("views_per_step", 0), ("views_per_step", 65)),
    ],
)
def test_impossible_configurations_are_refused(option, value):
    with pytest.raises(InputError, match=f"{option}: expected"):
        with_options(preset("demo"), **{option: value})


def test_the_light_tells_the_method():
    with pytest.raises(InputError, match="light: expected shadow mapping, which is the method shadow-map's"):
        TrainConfig.from_json({**preset("demo").to_json(), "method": "shadow-map"})
    assert replace(preset("demo"), light=preset("demo", "relight").light).method == "relight"


def test_presets_and_table_5_1():
    table = preset("thesis").refinement
    values = (table.prune_opacity, table.prune_scale, table.reset_every, table.prune_screen_size)
    assert values == (0.05, 0.05, 30, 0.05)
    more = (table.split_screen_size, table.refine_every, table.pause_after_reset, table.max_gaussians)
    assert more == (0.01, 100, 1000, 250_000)
    assert (preset("thesis").iterations, table.refine_stop) == (200_000, 150_000)
    with pytest.raises(InputError, match="preset"):
        preset("miracle")


def test_opaque_pictures_are_trained_over_black(opaque_dataset):
    """Pictures without alpha: the black sky is black for want of light, not for want of splats."""
    trainer = Trainer(opaque_dataset, CONFIG)
    assert not trainer.background(3, trainer.views[0]).any()
    trainer.run(lambda progress: None, lambda: None)
    assert psnr(trainer.gaussians, opaque_dataset) > 20


@pytest.mark.parametrize("init", ["points", "random"])
def test_training_starts_with_no_more_gaussians_than_it_may_ever_have(small_dataset, init):
    config = replace(CONFIG, init=init, init_count=60, refinement=replace(REFINEMENT, max_gaussians=25))
    trainer = Trainer(small_dataset, config)
    assert (trainer.gaussians.count, len(trainer.strategy.state["seen"])) == (25, 25)


@pytest.mark.threads
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs processor affinity")
def test_the_number_of_threads_does_not_show(small_dataset, tmp_path):
    """Round-off gradients of round splats are denormal when squared, and a lone thread does not flush those."""
    config = replace(CONFIG, init="random", init_count=20_000, iterations=12)
    script = f"""
import os
os.sched_setaffinity(0, {{min(os.sched_getaffinity(0))}})
from pathlib import Path
from spacesim.data.store import read_dataset
from spacesim.splat.train.config import TrainConfig
from spacesim.splat.train.train import train
config = TrainConfig.from_json({config.to_json()!r})
train(read_dataset(Path({str(small_dataset.root)!r})), Path({str(tmp_path / "alone")!r}), config)
"""
    subprocess.run([sys.executable, "-c", script], check=True)
    together = train(small_dataset, tmp_path / "together", config)
    name = "model.safetensors"
    assert (tmp_path / "alone" / name).read_bytes() == (together.path / name).read_bytes()


def test_several_views_a_step_follow_their_mean_gradient(small_dataset):
    """Adam's first moment after a first step is a tenth of the gradient."""
    config = replace(CONFIG, sh_every=10)

    def moments(views_per_step: int, iteration: int) -> np.ndarray:
        trainer = Trainer(small_dataset, replace(config, views_per_step=views_per_step))
        trainer.iteration = iteration
        trainer.step()
        return np.stack(trainer.optimizer.moments()[0])

    first, second, both = moments(1, 0), moments(1, 1), moments(2, 0)
    assert np.abs(first - second).max() > 0.1 * np.abs(first).max()
    np.testing.assert_allclose(both, (first + second) / 2, rtol=1e-4, atol=1e-6 * np.abs(first).max())


@pytest.mark.parametrize(("decay", "shares"), [("exponential", (1.0, 0.1, 0.01)), ("quadratic", (1.0, 0.7525, 0.01))])
def test_step_sizes_fall_as_the_configuration_says(small_lit_dataset, decay, shares):
    names = "means", "features", "networks"
    finals = {f"rates.{name}_final": 0.01 * getattr(LearningRates(), name) for name in names}
    config = with_settings(preset("demo", "relight"), {"rates.decay": decay, **finals})
    trainer = Trainer(small_lit_dataset, replace(config, iterations=200, init_count=50))
    for index, share in zip((0, 100, 200), shares, strict=True):
        rates, start = trainer.rates(index), config.rates
        assert rates[0] == pytest.approx(share * start.means * trainer.scene_scale)
        assert rates[-1] == pytest.approx(share * start.features)
        trainer.iteration = index
        *_, factors = trainer._network_step(trainer.light, [ViewResult(None, ad.Float(0))])
        assert float(factors[2]) == pytest.approx(share * start.networks)


@pytest.mark.parametrize("method", ["vanilla", "shadow-map"])
def test_what_is_trained_goes_with_its_trainer(small_lit_dataset, method):
    """Nothing refers back to a trainer: its arrays would stay until Python looks for cycles."""
    trainer = Trainer(small_lit_dataset, replace(preset("demo", method), init_count=50))
    for _ in range(3):
        trainer.step()
    of_trainer, of_gaussians = weakref.ref(trainer), weakref.ref(trainer.gaussians)
    gc.collect()
    gc.disable()
    try:
        del trainer
        assert of_trainer() is None
        assert of_gaussians() is None
    finally:
        gc.enable()


def test_hidden_gaussians_have_no_colour(small_lit_dataset, monkeypatch):
    """A picture loses little by those that weigh little in it, and nothing by those that weigh nothing."""
    monkeypatch.setattr(view_pass, "select", lambda: "llvm")  # where narrow networks leave them out
    config = replace(preset("demo", "shadow-map"), init_count=400, seed=2)
    assert config.hidden_weight > 0

    def losses(hidden_weight: float, **refinement: float) -> list[float]:
        changed = replace(config.refinement, **{"prune_opacity": 0.4, **refinement})
        trainer = Trainer(small_lit_dataset, replace(config, hidden_weight=hidden_weight, refinement=changed))
        return [float(trainer.step()[0]) for _ in range(6)]

    every = losses(0)
    assert losses(1) == every  # none is left: then all are lit
    assert losses(1e-30) == pytest.approx(every, rel=1e-5)
    assert losses(1e-5) == pytest.approx(every, rel=1e-3)
    assert losses(0.01) == pytest.approx(every, rel=0.05)
    assert losses(0.05) != every
    assert losses(0.05, prune_opacity=0.005) == losses(0.005), "a reset leaves opacities of twice that bound"


@pytest.mark.parametrize(
    ("backend", "name", "weight", "counts"),
    [
        ("llvm", "demo", 0.01, 0.01),
        ("llvm", "demo", 0.0, None),
        ("llvm", "thesis", 0.0, 0.0),
        ("cuda", "demo", 0.01, None),
        ("cuda", "thesis", 0.0, 0.0),
        ("cuda", "thesis", 0.01, 0.01),
        ("cuda", "thesis", 0.1, 0.05),
    ],
)
def test_hidden_gaussians_are_sought_where_that_takes_less_time(monkeypatch, backend, name, weight, counts):
    monkeypatch.setattr(view_pass, "select", lambda: backend)
    config = replace(preset(name, "shadow-map"), hidden_weight=weight)
    assert view_pass._hidden_weight(config) == counts
    assert view_pass._hidden_weight(preset(name)) is None


def test_centres_that_start_on_the_surface_take_smaller_steps_at_first(small_lit_dataset):
    """Not where the surface has yet to be found, nor under `mcmc`, whose noise is as large as they are."""
    config = replace(preset("fast", "shadow-map"), init_count=20)
    fast, share = config.rates, config.rates.surface_start
    assert share < 1
    for changes, first in (
        ({"init": "points"}, share),
        ({"init": "mesh"}, share),
        ({}, share),
        ({"init": "random"}, 1),
        ({"warm_start": warm_start("fast")}, 1),
        ({"refine_poses": True}, 1),
        ({"rates": replace(fast, surface_start=1.0)}, 1),
    ):
        trainer = Trainer(small_lit_dataset, replace(config, **changes))
        half = math.sqrt(first * fast.means * fast.means_final)
        waits = 1_000 if "warm_start" in changes else 0
        assert trainer.means_rate((7_000 + waits) // 2) == pytest.approx(half * trainer.scene_scale), changes
        assert trainer.means_rate(7_000) == pytest.approx(fast.means_final * trainer.scene_scale), changes
    assert preset("fast", "shadow-map", "mcmc").rates.surface_start == 1


@pytest.mark.parametrize("decay", ["exponential", "quadratic"])
def test_a_step_size_of_0_stays_0(decay):
    assert {LearningRates(decay=decay).between(0.0, 1e-3, done) for done in (0, 0.5, 0.9, 1)} == {0.0}


def test_fully_masked_views_are_warned_of_once(small_dataset, caplog):
    """Their loss is 0, whatever is drawn: as if all were well."""
    first = replace(small_dataset.train[0], distortion=(1e30, 0.0, 0.0, 0.0, 0.0))
    trainer = Trainer(replace(small_dataset, train=(first,)), CONFIG)
    for _ in range(2):
        assert float(trainer.step()[0]) < 1e-7
        trainer.views._cached.cache_clear()
    assert [r.message for r in caplog.records] == [
        f"{first.file_path}: no pixel of it counts, by its mask or by its lens distortion"
    ]


def test_where_memory_is_short_pictures_are_read_again(small_dataset, monkeypatch):
    kept = Trainer(small_dataset, CONFIG)
    monkeypatch.setattr(views, "main_memory", lambda: 4 * 10**9)
    monkeypatch.setattr(views, "free_memory", lambda: 4 * 10**9)
    assert views.kept_bytes() == (10**9, 5 * 10**8)
    monkeypatch.setattr(views, "main_memory", lambda: 0)
    monkeypatch.setattr(views, "free_memory", lambda: 0)
    read_again = Trainer(small_dataset, CONFIG)
    for _ in range(3):
        assert float(read_again.step()[0]) == float(kept.step()[0])
    assert read_again.views._cached.cache_info().currsize == read_again.views._device_cache.cache_info().currsize == 1
    assert kept.views._cached.cache_info().currsize == 3


def test_recordings_serve_pictures_of_any_alignment(small_dataset):
    def recorded_in_eight_steps(later: int) -> int:
        """Four with pictures at one alignment, four at another."""
        trainer = Trainer(small_dataset, CONFIG)
        load, offset, before = trainer.views._load, [0], recordings()

        def at_offset(index: int) -> views.TrainingView:
            view = load(index)
            memory = np.empty(view.rgba.size + 32, np.uint32)
            first = -memory.ctypes.data // 4 % 16 + offset[0]
            memory[first : first + view.rgba.size] = view.rgba
            return replace(view, rgba=memory[first : first + view.rgba.size])

        trainer.views._cached = at_offset
        for step in range(8):
            offset[0] = later if step >= 4 else 0
            trainer.step()
        return recordings() - before

    _, same, other = (recorded_in_eight_steps(later) for later in (0, 0, 1))  # the first makes what all share
    assert same == other > 0


def test_training_on_several_views_a_step_learns_and_resumes(small_dataset, tmp_path):
    config = replace(CONFIG, views_per_step=3, iterations=40, checkpoint_every=20)
    whole = Trainer(small_dataset, config)
    whole.run(lambda progress: None, lambda: whole.save(tmp_path / "half"))
    resumed = Trainer(small_dataset, config)
    resumed.restore(tmp_path / "half")
    resumed.run(lambda progress: None, lambda: None)
    for name, values in whole.gaussians.to_numpy().items():
        np.testing.assert_array_equal(resumed.gaussians.to_numpy()[name], values, err_msg=name)
    assert psnr(whole.gaussians, small_dataset) > psnr(Trainer(small_dataset, config).gaussians, small_dataset) + 1


@pytest.mark.parametrize("what", ["all", "means", "strategy.seen", "adam.first.00", "no statistics"])
def test_a_checkpoint_without_gaussians_is_refused(small_dataset, tmp_path, what):
    """Arrays of no length, as a file that was made by hand may have."""
    config = replace(CONFIG, warm_start=WarmStartConfig(steps=100, decay=40, conservative=10))
    trainer = Trainer(small_dataset, config)
    trainer.step()
    trainer.save(tmp_path / "c.safetensors")
    tensors, header = read_tensors(tmp_path / "c.safetensors")
    kept = {key: value for key, value in header.items() if key != "format"}
    names = [name for name in tensors if what == "all" or name == what or (what[:2] == "no" and "strategy" in name)]
    assert names
    tensors |= {name: tensors[name][:0] for name in names}
    write_tensors(tmp_path / "c.safetensors", tensors, kept)
    with pytest.raises(InputError, match=r"c\.safetensors: expected a checkpoint of this training \("):
        Trainer(small_dataset, config).restore(tmp_path / "c.safetensors")


@pytest.mark.parametrize(
    "header",
    [{"iteration": -1}, {"iteration": 10**30}, {"adam_steps": "3"}, {"history": {}}, {"history": [{"iteration": 1}]}],
)
def test_a_checkpoint_with_another_header_is_refused(small_dataset, tmp_path, header):
    trainer = Trainer(small_dataset, CONFIG)
    trainer.save(tmp_path / "c.safetensors")
    tensors, written = read_tensors(tmp_path / "c.safetensors")
    write_tensors(
        tmp_path / "c.safetensors", tensors, {**{k: v for k, v in written.items() if k != "format"}, **header}
    )
    with pytest.raises(InputError, match=r"c\.safetensors: (header: )?[a-z\[\]0-9_.: ]*expected"):
        Trainer(small_dataset, CONFIG).restore(tmp_path / "c.safetensors")


def test_a_step_of_several_views_reads_each_once(small_dataset, monkeypatch):
    """However few are kept."""
    read, load = [], views.load_image
    monkeypatch.setattr(views, "kept_bytes", lambda: (0, 0))
    monkeypatch.setattr(views, "load_image", lambda data, frame: read.append(frame.file_path) or load(data, frame))
    trainer = Trainer(small_dataset, replace(CONFIG, views_per_step=3))
    trainer.step()
    assert len(read) == len(set(read)) == 3
