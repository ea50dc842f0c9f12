"""A field without the Sun (4.2 without s), and learned numbers of each training picture."""

import json
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from PIL import Image

import spacesim as ss
from spacesim.backend import recordings
from spacesim.cli import main
from spacesim.data.errors import InputError
from spacesim.data.records import Dataset, Sun
from spacesim.data.store import read_dataset
from spacesim.splat.compose.scene import GaussianComposition, PlacedRun
from spacesim.splat.export.ply import read_ply
from spacesim.splat.export.sweep import sweep
from spacesim.splat.pose.picture import SunlitRun
from spacesim.splat.run import Run, load_run
from spacesim.splat.train.checkpoint import read_tensors, write_tensors
from spacesim.splat.train.config import TrainConfig, preset, with_settings
from spacesim.splat.train.train import train
from spacesim.splat.train.trainer import Trainer

BRIGHTNESS = (0.3, 0.5, 0.7, 0.9)


def config(embeddings: int, **changes) -> TrainConfig:
    settings = {"light.field.inputs": "view", "light.field.embeddings": embeddings}
    return replace(with_settings(preset("demo", "relight"), settings), init_count=100, **changes)


@pytest.fixture(scope="module")
def one_view(small_dataset, tmp_path_factory) -> Dataset:
    """A view four times, under lights of other brightness."""
    root = tmp_path_factory.mktemp("bright")
    (root / "images").mkdir()
    values = json.loads((small_dataset.root / "transforms.json").read_text())
    frame = next(one for one in values["frames"] if "train" in one["file_path"])
    rgba = np.asarray(Image.open(small_dataset.root / frame["file_path"])).astype(float)
    frames = []
    for number, share in enumerate(BRIGHTNESS):
        name = f"images/train_{number}.png"
        Image.fromarray(np.rint(rgba * [share, share, share, 1]).astype(np.uint8)).save(root / name)
        frames.append({**frame, "file_path": name})
    for split in ("train", "test"):
        values.pop(f"{split}_filenames")
    (root / "points.ply").write_bytes((small_dataset.root / "points.ply").read_bytes())
    (root / "transforms.json").write_text(
        json.dumps({**values, "frames": frames, "train_filenames": [one["file_path"] for one in frames]})
    )
    return read_dataset(root)


def level(trainer: Trainer, picture: int) -> float:
    """Mean colour of a training picture as the trainer draws it."""
    rows, view = trainer.gaussians.rows(), trainer.views[picture]
    drawn = trainer._view_pass.forward(
        trainer.gaussians, rows, trainer.light, view, degree=0, downscale=1, watched=False
    )
    blended = drawn.tape.blend((drawn.camera.width, drawn.camera.height)).blended
    return float(np.mean([np.array(plane) for plane in blended.features]))


def test_a_view_under_several_lights_is_fitted_by_embeddings_alone(one_view):
    truth = [np.asarray(Image.open(one_view.root / f.file_path)).astype(float) for f in one_view.train]
    wanted = [float((rgba[..., :3] * rgba[..., 3:]).mean() / 255**2) for rgba in truth]
    found = {}
    for embeddings in (0, 2):
        trainer = Trainer(one_view, config(embeddings, iterations=300))
        trainer.run(lambda progress: None, lambda: None)
        found[embeddings] = [level(trainer, picture) for picture in range(len(BRIGHTNESS))]
    np.testing.assert_allclose(found[2], wanted, atol=0.05 * np.ptp(wanted))
    assert np.ptp(found[0]) == 0


def test_no_view_is_recorded_anew(small_dataset):
    """Nor compiled: what the first three pictures need serves the others."""
    trainer, known = Trainer(small_dataset, config(2)), []
    for _ in range(len(small_dataset.train)):
        trainer.step()
        _, loaded, compiled = dr.detail.launch_stats()
        known.append((recordings(), loaded, compiled))
    assert len(set(known[2:])) == 1


def test_only_pictures_that_were_shown_move_at_first(small_dataset):
    """Two in a step: both get half of their gradient."""
    trainer = Trainer(small_dataset, config(3, views_per_step=2))
    trainer.step()
    shown = {trainer.views.at_step(step).index for step in (0, 1)}
    moved = np.abs(trainer.light.tensors()["light.embeddings"]).max(axis=1)
    assert set(np.flatnonzero(moved)) == shown
    np.testing.assert_allclose(moved[sorted(shown)], trainer.config.rates.features, rtol=1e-3)


@pytest.fixture(scope="module")
def sunless(small_dataset, tmp_path_factory) -> Run:
    return train(small_dataset, tmp_path_factory.mktemp("sunless") / "run", config(2, iterations=40))


def test_a_run_without_the_sun_is_drawn_without_one(small_dataset, sunless, tmp_path):
    run, camera = load_run(sunless.path), small_dataset.test[0].camera
    assert not run.relightable
    drawn = run.predict(camera).rgb
    assert drawn.max() > 0.1
    np.testing.assert_array_equal(run.render(camera).rgb, drawn)
    for azimuth in (0, 90):
        np.testing.assert_array_equal(run.predict(camera, Sun.from_angles(azimuth, 20)).rgb, drawn)
    for_pose = SunlitRun.of(run, None)
    np.testing.assert_array_equal(for_pose.draw(camera, for_pose.shade(camera))[..., :3], drawn)
    alone = GaussianComposition([PlacedRun(run)])
    assert not alone.relightable
    np.testing.assert_allclose(alone.predict(camera).rgb, drawn, atol=1e-5)
    with pytest.raises(InputError, match="found one of the method relight that knows one light only"):
        sweep(run, camera, [Sun.from_angles(0, 0)], tmp_path / "sweep")


def test_a_run_without_the_sun_is_exported_and_evaluated(small_dataset, sunless, tmp_path, capsys):
    assert main(["export", str(sunless.path), "--ply", str(tmp_path / "model.ply"), "--sun", "0,0"]) == 0
    assert "knows the light that it was trained under only" in capsys.readouterr().err
    assert main(["export", str(sunless.path), "--ply", str(tmp_path / "again.ply")]) == 0
    one, other = (read_ply(tmp_path / name).to_numpy()["sh"] for name in ("model.ply", "again.ply"))
    np.testing.assert_array_equal(one, other)
    assert one.shape[1] == 16
    metrics = ss.evaluate(sunless, small_dataset, tmp_path / "eval", geometry=False)
    assert metrics["image_full"]["psnr"]["mean"] > 5


@pytest.mark.parametrize("method", ["shadow-map", "shadow-splat", "baseline-park"])
def test_methods_with_shadows_refuse_inputs_without_the_sun(method):
    with pytest.raises(InputError, match=r"^light\.field: expected inputs with the Sun, .* found view$"):
        with_settings(preset("fast", method), {"light.field.inputs": "view", "light.bounce": 0})


@pytest.mark.parametrize("shape", [(7, 2), (8, 3), (0, 2), (16,)])
def test_embeddings_of_other_pictures_are_refused(small_dataset, sunless, tmp_path, shape):
    trainer = Trainer(small_dataset, config(2))
    trainer.save(tmp_path / "c.safetensors")
    tensors, header = read_tensors(tmp_path / "c.safetensors")
    tensors["light.embeddings"] = np.zeros(shape, np.float32)
    write_tensors(tmp_path / "c.safetensors", tensors, {k: v for k, v in header.items() if k != "format"})
    with pytest.raises(InputError, match=r"c\.safetensors: expected a checkpoint of this training \(light\.embeddings"):
        trainer.restore(tmp_path / "c.safetensors")
