"""Training, what it leaves on disk, and what a run predicts: through the commands and in Python."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_field import CONFIG, GRID

import spacesim as ss
from spacesim import methods
from spacesim.data.earth import Earth
from spacesim.data.errors import InputError
from spacesim.data.images import linear_from_srgb, load_image, read_png
from spacesim.learning.tensors import read_tensors, write_tensors
from spacesim.methods import load_predictor
from spacesim.nerf.config import NerfConfig, preset, with_settings
from spacesim.nerf.run import NerfRun, load_run
from spacesim.nerf.sampling.box import scene_box
from spacesim.nerf.train.pixels import training_pixels
from spacesim.nerf.train.train import fit_grid, train
from spacesim.nerf.train.trainer import FORMAT, NerfTrainer
from spacesim.splat.compose import ComposeConfig, PlacedRun
from spacesim.splat.raster.supersample import upsampled_camera


def model_bytes(run: NerfRun) -> bytes:
    return (run.path / "model.safetensors").read_bytes()


def test_a_run_is_shown_in_a_line(finished):
    assert repr(finished) == f"NerfRun({str(finished.path)!r}: {finished.config['method']})"


def test_training_learns_the_pictures(dataset, finished):
    history = finished.training["history"]
    assert [entry["iteration"] for entry in history] == [50, 100, 150, 200, 250]
    errors = []
    for frame in dataset.train:
        drawn, image = finished.predict(frame.camera), load_image(dataset, frame)
        assert drawn.rgb.shape == (40, 40, 3)
        assert drawn.rgb.dtype == np.float32
        errors.append([np.mean((drawn.rgb - image.over(np.zeros(3))) ** 2), np.mean(image.over(np.zeros(3)) ** 2)])
    error, power = np.mean(errors, axis=0)
    assert error < 0.5 * power
    assert np.array(finished.filled).mean() < 1  # some of the box is known as empty


@pytest.mark.parametrize(("iterations", "share"), [(200, 1 / 20), (100_000, 1 / 100), (5, 1)])
def test_the_step_size_grows_to_its_full(dataset, iterations, share):
    trainer = NerfTrainer(dataset, replace(CONFIG, iterations=iterations, rate_final=CONFIG.rate))
    before = [np.array(values) for values in trainer.parameters]
    trainer.step()
    moved = max(np.abs(np.array(after) - was).max() for after, was in zip(trainer.parameters, before, strict=True))
    assert moved == pytest.approx(CONFIG.rate * share, rel=1e-3)


def test_the_same_seed_gives_the_same_bits_and_another_does_not(dataset, finished, tmp_path):
    again = train(dataset, tmp_path / "again", CONFIG)
    assert model_bytes(again) == model_bytes(finished)
    other = train(dataset, tmp_path / "other", replace(CONFIG, seed=1, iterations=5))
    assert np.abs(np.array(other.parameters[0]) - np.array(finished.parameters[0])).max() > 0
    camera = dataset.test[0].camera
    first, second = (run.predict(camera, normals=True) for run in (again, finished))
    for plane in ("rgb", "alpha", "depth", "normal"):
        np.testing.assert_array_equal(getattr(first, plane), getattr(second, plane))


def test_killed_training_is_completed_by_resume(dataset, finished, tmp_path):
    """The process dies without warning; --resume gives the same model to the bit."""
    script = f"""
import os, signal
from pathlib import Path
from spacesim.data.store import read_dataset
from spacesim.nerf.config import NerfConfig
from spacesim.nerf.train.train import train
config = NerfConfig.from_json({CONFIG.to_json()!r})
def die(progress):
    if progress.iteration == 150:
        os.kill(os.getpid(), signal.SIGKILL)
train(read_dataset(Path({str(dataset.root)!r})), Path({str(tmp_path / "run")!r}), config, on_progress=die)
"""
    died = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert died.returncode == -9, died.stderr
    assert [path.name for path in sorted((tmp_path / "run/checkpoints").glob("*.safetensors"))] == [
        "step_00000060.safetensors",
        "step_00000120.safetensors",
    ]
    with pytest.raises(InputError, match="training has not ended"):
        load_run(tmp_path / "run")
    with pytest.raises(InputError, match="expected a new folder, found a run"):
        train(dataset, tmp_path / "run", CONFIG)
    with pytest.raises(InputError, match="was started with seed 0"):
        train(dataset, tmp_path / "run", replace(CONFIG, seed=5), resume=True)
    resumed = train(dataset, tmp_path / "run", CONFIG, resume=True)
    assert model_bytes(resumed) == model_bytes(finished)


def test_a_run_of_one_family_is_not_resumed_by_the_other(dataset, finished, tiny_run):
    for out, config, words in (
        (
            finished.path,
            methods.preset("demo", "vanilla"),
            "method 'nerf', expected the same to resume it, found 'vanilla'",
        ),
        (tiny_run, CONFIG, "method 'vanilla', expected the same to resume it, found 'nerf'"),
    ):
        with pytest.raises(InputError, match=f"was started with {words}"):
            methods.train(dataset, out, config, resume=True)


@pytest.mark.parametrize("method", ["nerfx", 3, None, ["nerf"]])
def test_a_run_of_no_method_is_refused(tmp_path, method):
    (tmp_path / "config.json").write_text(json.dumps({**CONFIG.to_json(), "method": method, "data": {"path": "."}}))
    with pytest.raises(InputError, match=r"config.json: method: expected one of vanilla, .*nerf-relight, found"):
        methods.load_run(tmp_path)


def test_rays_that_do_not_fit_into_memory_are_refused(dataset, finished, monkeypatch):
    many = replace(CONFIG, rays=2**20, samples=1024, chunk=2**20)
    assert many.ray_bytes * many.rays > 10**12
    monkeypatch.setattr("spacesim.backend.memory.free_memory", lambda needed=0: 10**11)
    with pytest.raises(MemoryError, match="rays: a step of 1048576 rays needs about"):
        NerfTrainer(dataset, many)
    wide = replace(finished, networks=type(finished.networks)(many))
    for drawn in (wide, methods.compose([PlacedRun(wide)])):
        with pytest.raises(MemoryError, match="chunk: a picture by 1048576 rays at once needs about"):
            drawn.predict(dataset.test[0].camera)


def test_cells_are_looked_at_a_few_at_a_time(dataset, monkeypatch):
    """To the same bits; and so many that they do not fit are refused before anything is trained."""
    config = replace(CONFIG, occupancy=32, occupancy_every=2, iterations=4)
    whole, parts = NerfTrainer(dataset, config), NerfTrainer(dataset, config)
    for cells, trained in ((32**3, whole), (3 * 4096, parts)):
        monkeypatch.setattr("spacesim.nerf.train.trainer.CELLS", cells)
        for _ in range(4):
            trained.step()
    np.testing.assert_array_equal(np.array(parts.occupancy), np.array(whole.occupancy))
    assert np.array(whole.occupancy).max() > 0
    monkeypatch.setattr("spacesim.backend.memory.free_memory", lambda needed=0: 10**9)
    with pytest.raises(MemoryError, match="occupancy: 512 cells a side"):
        NerfTrainer(dataset, replace(config, occupancy=512))


def test_pictures_beside_the_box_are_left_out_in_one_sentence(dataset, caplog):
    turn = np.diag([-1.0, 1, -1, 1])  # looks the other way
    turned = [
        replace(f, camera=replace(f.camera, world_from_camera=f.camera.world_from_camera @ turn)) for f in dataset.train
    ]
    box = scene_box(dataset, CONFIG.margin)
    others = training_pixels(replace(dataset, train=dataset.train[2:]), box, False)
    found = training_pixels(replace(dataset, train=(*turned[:2], *dataset.train[2:])), box, False)
    assert int(found.count[0]) == int(others.count[0])
    (record,) = caplog.records
    assert f"2 of {len(dataset.train)} pictures show nothing of the scene box" in record.message
    assert dataset.train[0].file_path in record.message
    with pytest.raises(InputError, match="found rays that all miss it"):
        training_pixels(replace(dataset, train=tuple(turned)), box, False)


def test_exposures_that_a_field_does_not_know_are_named(dataset, caplog):
    box = scene_box(dataset, CONFIG.margin)
    training_pixels(dataset, box, False)
    assert not caplog.records
    exposed = tuple(replace(frame, exposure=0.001 * (1 + i % 2)) for i, frame in enumerate(dataset.train))
    training_pixels(replace(dataset, train=exposed), box, False)
    (record,) = caplog.records
    assert "pictures name several exposures, which a radiance field takes for one" in record.message


def test_damaged_checkpoints_are_refused(dataset, tmp_path):
    trainer = NerfTrainer(dataset, CONFIG)
    path = tmp_path / "good.safetensors"
    trainer.save(path)
    tensors, header = read_tensors(path, FORMAT)
    header.pop("format")
    broken = [
        ({key: value for key, value in tensors.items() if key != "field.grid"}, header, "lacks field.grid"),
        (tensors | {"field.grid": tensors["field.grid"][:-2]}, header, "field.grid: expected"),
        (tensors | {"adam.first.00": np.full_like(tensors["adam.first.00"], np.nan)}, header, "finite"),
        (tensors | {"box": tensors["box"] + 1}, header, "scene box"),
        (tensors, header | {"iteration": 10**6}, "expected an iteration up to 250"),
        (tensors, header | {"history": 3}, "history"),
    ]
    for content, changed, words in broken:
        write_tensors(tmp_path / "broken.safetensors", content, changed, FORMAT)
        with pytest.raises(InputError, match=words):
            trainer.restore(tmp_path / "broken.safetensors")
    write_tensors(tmp_path / "other.safetensors", tensors, header, "spacesim-gaussians-1")
    with pytest.raises(InputError, match="expected a spacesim-nerf-1 file"):
        trainer.restore(tmp_path / "other.safetensors")
    trainer.restore(path)


def test_memory_of_a_picture_is_that_of_a_chunk(dataset, finished):
    """Chunks change no picture, to the last bits of a sum."""
    camera = dataset.test[0].camera
    config = replace(CONFIG, chunk=1024)
    wider = replace(finished, networks=type(finished.networks)(config))
    one, other = (run.predict(camera, normals=True) for run in (finished, wider))
    for plane in ("rgb", "alpha", "depth"):
        np.testing.assert_allclose(getattr(one, plane), getattr(other, plane), atol=2e-6)
    np.testing.assert_array_equal(one.depth > 0, one.alpha > 0)
    lengths = np.linalg.norm(one.normal, axis=-1)
    np.testing.assert_allclose(lengths[one.alpha > 0.5], 1, atol=1e-4)


def test_depth_and_normals_look_at_the_camera(dataset, finished):
    frame = dataset.train[0]
    drawn = finished.predict(frame.camera, normals=True)
    solid = drawn.alpha > 0.9
    assert solid.sum() > 20
    away = frame.camera.position - scene_box(dataset, 0).low
    assert (drawn.depth[solid] < np.linalg.norm(away) + 6).all()
    axis = frame.camera.world_from_camera[:3, 2]
    assert (drawn.normal[solid] @ axis < 0.2).mean() > 0.8


def test_scene_boxes(dataset, tmp_path):
    by_mesh = scene_box(dataset, 0.0)
    by_points = scene_box(replace(dataset, mesh_path=None), 0.0)
    np.testing.assert_allclose(by_points.low, by_mesh.low, atol=0.1)
    np.testing.assert_allclose(by_points.size, by_mesh.size, atol=0.2)
    by_cameras = scene_box(replace(dataset, mesh_path=None, ply_file_path=None), 0.0)
    assert (by_cameras.low < by_mesh.low + by_mesh.size).all()
    assert (by_cameras.low + by_cameras.size > by_mesh.low).all()
    np.testing.assert_allclose(by_cameras.size, by_cameras.side)
    assert scene_box(dataset, 0.1).side == pytest.approx(1.2 * by_mesh.side)


def test_a_grid_is_as_fine_as_the_pictures(dataset, tmp_path):
    """Unless the configuration says how fine; a run knows what it was, and goes on with the same configuration."""
    box, camera = scene_box(dataset, CONFIG.margin), dataset.train[0].camera
    away = camera.world_from_camera[:3, 2] @ (box.low + 0.5 * box.size - camera.position)
    side = camera.fx * box.side / away  # all cameras look at the middle from as far away
    assert fit_grid(CONFIG, dataset) == CONFIG
    config = replace(CONFIG, grid=replace(GRID, finest=None), iterations=10)
    assert fit_grid(config, dataset).grid.finest == pytest.approx(side, rel=0.05)
    twice = [replace(frame, camera=upsampled_camera(frame.camera, 2)) for frame in dataset.train]
    assert fit_grid(config, replace(dataset, train=tuple(twice))).grid.finest == pytest.approx(2 * side, rel=0.05)
    run = train(dataset, tmp_path / "run", config)
    assert run.networks.config.grid.finest == fit_grid(config, dataset).grid.finest
    assert train(dataset, tmp_path / "run", config, resume=True).training == run.training


def test_pictures_of_something_else_are_refused(dataset, tmp_path):
    away = [replace(frame, camera=_turned(frame.camera)) for frame in dataset.train]
    with pytest.raises(InputError, match="rays that all miss it"):
        NerfTrainer(replace(dataset, train=tuple(away)), CONFIG)
    dark = replace(dataset, train=tuple(replace(frame, sun=None) for frame in dataset.train))
    with pytest.raises(InputError, match="sun_direction in every training frame"):
        NerfTrainer(dark, replace(CONFIG, method="nerf-relight"))


def _turned(camera):
    pose = camera.world_from_camera.copy()
    pose[:3, [0, 2]] *= -1
    return replace(camera, world_from_camera=pose)


def limb_before(sun, deg=0.05) -> Earth:
    """An Earth that leaves a part of the Sun: its limb is so far beyond the Sun's centre."""
    earth = Earth(sun.direction + np.array([0, 0, 1.0]))
    return replace(earth, angular_radius_deg=np.degrees(np.arccos(earth.direction @ sun.direction)) + deg)


def test_frames_whose_sun_the_earth_hides_are_left_out(dataset, caplog):
    """Of a field that takes the Sun, also where only a part of it is hidden."""
    first, second, *others = dataset.train
    night = replace(first, sun=replace(first.sun, earth=Earth(first.sun.direction)))
    dim = replace(second, sun=replace(second.sun, earth=limb_before(second.sun, -0.05)))
    assert 0.5 < dim.sun.visible_share < 1
    box, darker = scene_box(dataset, CONFIG.margin), replace(dataset, train=(night, dim, *others))
    lit = training_pixels(replace(dataset, train=tuple(others)), box, suns=True)
    used = training_pixels(darker, box, suns=True)
    left = f"2 of {len(dataset.train)} training frames are left out"
    assert f"{left}: the Earth hides their Sun, whole or in part" in caplog.text
    for name in ("color", "view", "cameras", "suns"):
        np.testing.assert_array_equal(np.array(getattr(used, name)), np.array(getattr(lit, name)))
    assert len(training_pixels(darker, box, suns=False).color) > len(used.color)
    for frame in (night, dim):
        with pytest.raises(InputError, match="whose Sun the Earth does not hide, whole or in part, found none"):
            training_pixels(replace(dataset, train=(frame,)), box, suns=True)


def test_a_field_that_takes_the_sun_as_input(dataset, tmp_path):
    run = ss.train(dataset, tmp_path / "run", replace(CONFIG, method="nerf-relight", iterations=60))
    assert isinstance(run, NerfRun)
    camera = dataset.test[0].camera
    one, other = (run.render(camera, sun=angles) for angles in ((40, 25), (220, 40)))
    assert np.abs(one.rgb - other.rgb).max() > 1e-3
    np.testing.assert_array_equal(one.alpha, other.alpha)
    assert one.visibility.shape == one.alpha.shape
    assert run.has_shadows
    assert 0 <= one.visibility.min() < 0.9 < one.visibility.max() <= 1 + 1e-5
    assert np.abs(one.visibility - other.visibility).max() > 0.1
    composed = methods.compose([PlacedRun(run)], ComposeConfig(), None).predict(camera, ss.Sun.from_angles(40, 25))
    np.testing.assert_allclose(composed.visibility, one.visibility, atol=2e-3)
    np.testing.assert_allclose(composed.rgb, one.rgb, atol=2e-3)
    half = ss.Sun(one.sun.direction, limb_before(one.sun))
    dim, composed = run.predict(camera, half), methods.compose([PlacedRun(run)], ComposeConfig(), None)
    np.testing.assert_allclose(dim.visibility, half.visible_share * one.visibility, atol=1e-5)
    light = [linear_from_srgb(view.rgb).sum() for view in (dim, one)]
    assert light[0] / light[1] == pytest.approx(half.visible_share, abs=0.08)  # of a thin fog, blended as sRGB values
    np.testing.assert_allclose(composed.predict(camera, half).visibility, dim.visibility, atol=2e-3)
    np.testing.assert_allclose(composed.predict(camera, half).rgb, dim.rgb, atol=2e-3)
    night = ss.Sun(one.sun.direction, Earth(one.sun.direction))
    assert run.predict(camera, night).rgb.max() == 0 < run.predict(camera, night).alpha.max()
    with pytest.raises(InputError, match="sun: expected its direction for a run of nerf-relight, found none"):
        run.predict(camera)
    with pytest.raises(InputError, match="exposure"):
        run.predict(camera, ss.Sun.from_angles(0, 0), exposure=1.0)


def test_shadows_and_normals_resume_to_the_same_bits(dataset, tmp_path):
    config = replace(CONFIG, method="nerf-relight", iterations=90, checkpoint_every=70)

    def stop(progress):
        if progress.iteration >= 80:
            raise KeyboardInterrupt

    whole = train(dataset, tmp_path / "whole", config)
    with pytest.raises(KeyboardInterrupt):
        train(dataset, tmp_path / "cut", config, on_progress=stop)
    assert model_bytes(train(dataset, tmp_path / "cut", config, resume=True)) == model_bytes(whole)


def test_functions_for_gaussians_refuse_a_radiance_field(dataset, finished, tmp_path):
    image = load_image(dataset, dataset.test[0])
    with pytest.raises(InputError, match="run: expected one of Gaussians, found one of the method nerf"):
        ss.refine_pose(finished, image, dataset.test[0].camera)
    with pytest.raises(InputError, match="run: expected one of Gaussians, found one of the method nerf"):
        ss.refine_pose(finished.path, image, dataset.test[0].camera)
    with pytest.raises(InputError, match="run: expected one of Gaussians"):
        ss.estimate_sun(finished, image, dataset.test[0].camera)
    with pytest.raises(InputError, match="align: expected a run of Gaussians"):
        ss.evaluate(finished, dataset, tmp_path / "eval", align=dataset)


def test_runs_of_both_families_are_evaluated_and_reported_side_by_side(dataset, finished, tiny_run, tmp_path):
    folders = []
    for number, run in enumerate((finished, ss.load_run(tiny_run))):
        folders.append(tmp_path / f"eval_{number}")
        ss.evaluate(run, dataset, folders[-1], geometry=False, fit_gain=number == 0)
    page = ss.write_report([str(folder) for folder in folders], tmp_path / "report.html").read_text()
    assert "nerf" in page
    assert "vanilla" in page


def test_the_commands(spacesim, tiny_data, tmp_path):
    """One run through train, eval, render and export."""
    run = tmp_path / "run"
    sizes = ["--set", "rays=512", "--set", "samples=8", "--set", "coarse.samples=12", "--set", "fine.samples=8"]
    done = spacesim(
        "train", tiny_data, "--out", run, "--method", "nerf", "--preset", "demo", "--iterations", 80, *sizes
    )
    assert done.code == 0, done.errors
    assert "numbers after 80 iterations" in done.output
    assert json.loads((run / "config.json").read_text())["coarse"]["samples"] == 12
    assert isinstance(load_predictor(run), NerfRun)
    done = spacesim("eval", run, "--data", tiny_data, "--out", tmp_path / "eval")
    assert done.code == 0, done.errors
    metrics = json.loads((tmp_path / "eval/metrics.json").read_text())
    assert metrics["model"]["gaussians"] is None
    assert metrics["image"]["psnr"]["mean"] > 5
    assert metrics["geometry"]["mesh"]["depth"] == "median"
    assert metrics["geometry"]["floaters"] is None
    assert (tmp_path / "eval/report.html").exists()
    for kind in ("rgb", "depth", "alpha", "normal"):
        done = spacesim("render", run, "--frame", 0, "--kind", kind, "--out", tmp_path / f"{kind}.png")
        assert done.code == 0, done.errors
    assert read_png(tmp_path / "rgb.png").shape == (40, 40, 4)
    done = spacesim("render", run, "--kind", "shadow", "--out", tmp_path / "no.png")
    assert (done.code, "predicts none" in done.errors[0]) == (2, True)
    done = spacesim("sweep", run, "--out", tmp_path / "sweep")
    assert (done.code, "expected a run that the Sun relights" in done.errors[0]) == (2, True)
    done = spacesim("export", run, "--ply", tmp_path / "no.ply")
    assert (done.code, "a radiance field; --mesh takes it" in done.errors[0]) == (2, True)
    done = spacesim("export", run, "--mesh", tmp_path / "mesh.ply", "--views", 6, "--voxel", 0.2)
    assert done.code == 0 or "no view of the run shows an opaque surface" in done.errors[-1]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--strategy", "mcmc"], "--strategy: expected with a method of Gaussians, found 'mcmc' with nerf"),
        (["--init", "mesh"], "--init: expected with a method of Gaussians, found with nerf"),
        (["--set", "light.shadow.bias=10"], "--set light.shadow.bias: expected with a method of Gaussians, found with"),
        (["--max-gaussians", "5"], "--max-gaussians: expected with a method of Gaussians"),
        (["--warm-start"], "--warm-start: expected with a method of Gaussians"),
        (["--sun", "unknown"], "--sun: expected with a method of Gaussians"),
        (["--refine-poses"], "--refine-poses: expected with a method of Gaussians"),
        (["--preset", "fine"], "--preset: expected one of demo, fast, thesis, found 'fine'"),
        (["--set", "rays=100"], "rays: expected 512 to 1048576, found 100"),
        (["--set", "rays=600"], "rays: expected a multiple of 512, found 600"),
        (["--set", "grid.finest=4"], "finest: expected at least coarsest, 16, found 4"),
        (
            ["--set", "coarse.grid.finest=none"],
            "coarse.grid: expected one whose finest level is given",
        ),
        (["--set", "sh_degree=2"], "sh_degree"),
    ],
)
def test_options_that_do_not_apply(spacesim, tiny_data, tmp_path, options, words):
    done = spacesim("train", tiny_data, "--out", tmp_path / "run", "--method", "nerf", *options)
    assert done.code == 2
    assert words in done.errors[0]
    assert not (tmp_path / "run").exists()


def test_fields_are_listed(spacesim):
    done = spacesim("train", "--fields", "--method", "nerf", "--preset", "thesis")
    assert done.code == 0, done.errors
    assert "grid.log2_size" in done.output
    assert "init_count" not in done.output


def test_settings_and_presets():
    config = preset("thesis", "nerf-relight")
    assert (config.samples, config.coarse.samples, config.fine.samples) == (48, 256, 96)
    assert NerfConfig.from_json(config.to_json()) == config
    assert with_settings(config, {"grid.levels": 3}).grid.levels == 3
    with pytest.raises(InputError, match=r"rate\.x: expected rate alone"):
        with_settings(config, {"rate.x": 3})
    with pytest.raises(InputError, match="method: expected none beside a configuration"):
        ss.train(Path("nowhere"), Path("run"), config, method="nerf")


def test_a_run_is_refused_in_one_sentence(finished, tmp_path):
    path = tmp_path / "run"
    path.mkdir()
    for name in ("config.json", "training.json"):
        (path / name).write_bytes((finished.path / name).read_bytes())
    tensors, header = read_tensors(finished.path / "model.safetensors", FORMAT)
    header.pop("format")
    for name in ("occupancy", "box", "field.color.1"):
        short = {key: value for key, value in tensors.items() if key != name}
        write_tensors(path / "model.safetensors", short, header, FORMAT)
        with pytest.raises(InputError, match=name):
            ss.load_run(path)
    config = json.loads((path / "config.json").read_text())
    (path / "config.json").write_text(json.dumps(config | {"rays": 7}))
    with pytest.raises(InputError, match="rays: expected"):
        ss.load_run(path)
