"""Gains of pictures: known ones are found, others are drawn without, off changes nothing."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from spacesim.data.errors import InputError
from spacesim.data.images import linear_from_srgb, srgb_from_linear
from spacesim.data.images.tone import STANDARD_EXPOSURE
from spacesim.data.records import Dataset
from spacesim.data.store import read_dataset
from spacesim.splat.raster.project import Pinhole
from spacesim.splat.raster.render import render
from spacesim.splat.train.config import TrainConfig, preset, with_settings
from spacesim.splat.train.pictures.exposure import known_gains
from spacesim.splat.train.trainer import Trainer

RANGES = 0.7, 0.35  #: of the logarithms of gains: of one picture a view, of several


@pytest.fixture(scope="module")
def exposed(small_dataset, tmp_path_factory) -> tuple[Dataset, np.ndarray]:
    """Its pictures under known gains."""
    return with_gains(small_dataset, tmp_path_factory.mktemp("exposed"), len(small_dataset.train), 1)


@pytest.fixture(scope="module")
def again(small_dataset, tmp_path_factory) -> tuple[Dataset, np.ndarray]:
    """Three of its pictures, each under three gains: what depends on the view explains no difference of these."""
    return with_gains(small_dataset, tmp_path_factory.mktemp("again"), 3, 3)


@pytest.fixture(scope="module")
def named(small_dataset, tmp_path_factory) -> tuple[Dataset, np.ndarray]:
    """Its pictures under known exposures, which they name."""
    root = tmp_path_factory.mktemp("named")
    dataset, gains = with_gains(small_dataset, root, len(small_dataset.train), 1, channels=1)
    base = 0.45 * STANDARD_EXPOSURE
    frames = zip(dataset.train, gains[:, 0], strict=True)
    train = tuple(replace(frame, exposure=float(base * gain)) for frame, gain in frames)
    scene = {"config": {"camera": {"tone": "srgb"}}, "exposure": base}
    return replace(dataset, train=train, scene=scene), gains[:, 0]


def with_gains(dataset: Dataset, root: Path, views: int, times: int, channels: int = 3) -> tuple[Dataset, np.ndarray]:
    """(dataset, gains [V, channels]): pictures 0.45 as bright, so that hardly any clips, under random gains in light,
    whose mean logarithm is 0 over all pictures, and over those of a view where there are several."""
    (root / "images").mkdir()
    values = json.loads((dataset.root / "transforms.json").read_text())
    logs = np.random.default_rng(0).uniform(-1, 1, (views, times, channels))
    logs *= RANGES[times > 1]
    logs -= logs.mean(axis=1 if times > 1 else 0, keepdims=True)
    poses = {frame["file_path"]: frame["transform_matrix"] for frame in values["frames"]}
    frames = []

    def write(source: str, name: str, gain: np.ndarray) -> None:
        rgba = np.asarray(Image.open(dataset.root / source)) / 255
        shown = np.dstack([srgb_from_linear(0.45 * linear_from_srgb(rgba[..., :3]) * gain), rgba[..., 3:]])
        Image.fromarray(np.rint(255 * shown).astype(np.uint8)).save(root / name)
        frames.append({"file_path": name, "transform_matrix": poses[source]})

    for view, frame in enumerate(dataset.train[:views]):
        for k in range(times):
            write(frame.file_path, f"images/train_{times * view + k:02d}.png", np.exp(logs[view, k]))
    values["train_filenames"] = [frame["file_path"] for frame in frames]
    for view, frame in enumerate(dataset.test):
        write(frame.file_path, f"images/test_{view:02d}.png", np.ones(3))
    values["test_filenames"] = [frame["file_path"] for frame in frames[views * times :]]
    (root / "points.ply").write_bytes((dataset.root / "points.ply").read_bytes())
    (root / "transforms.json").write_text(json.dumps({**values, "frames": frames}))
    return read_dataset(root), np.exp(logs.reshape(-1, channels))


def trained(dataset: Dataset, config: TrainConfig) -> Trainer:
    trainer = Trainer(dataset, replace(config, init_count=150, iterations=600))
    trainer.run(lambda progress: None, lambda: None)
    return trainer


def psnr_of_tests(trainer: Trainer, dataset: Dataset) -> float:
    errors = []
    for frame in dataset.test:
        color, _, _ = render(trainer.gaussians, Pinhole.of(frame.camera)).to_numpy()
        rgba = np.asarray(Image.open(dataset.root / frame.file_path)) / 255
        errors.append(((np.clip(color, 0, 1) - rgba[..., :3] * rgba[..., 3:])[rgba[..., 3] > 0.5] ** 2).mean())
    return float(-10 * np.log10(np.mean(errors)))


def test_known_gains_are_found_in_light(again):
    dataset, gains = again
    light = {"light.linear": True, "light.tone": "srgb", "light.exposure": 0.0, "light.field.inputs": "view"}
    config = with_settings(preset("demo", "relight"), {**light, "light.field.width": 16, "light.field.features": 8})
    found = trained(dataset, replace(config, exposure_per_picture=True)).pictures.exposures.all_gains()
    np.testing.assert_allclose(np.log(found).mean(axis=0), 0, atol=1e-9)
    assert np.abs(np.log(gains)).mean() > 0.15
    assert np.abs(np.log(found / gains)).mean() < 0.05


def test_pictures_of_a_model_of_srgb_values_gain(exposed):
    """There a gain of light g is one of about g^(1 / 2.4), and pictures that were not trained on are nearer."""
    dataset, gains = exposed
    config = replace(preset("demo"), sh_degree=0)
    without, trainer = trained(dataset, config), trained(dataset, replace(config, exposure_per_picture=True))
    found, true = np.log(trainer.pictures.exposures.all_gains()).ravel(), np.log(gains).ravel()
    assert 1 / 2.4 - 0.1 < found @ true / (true @ true) < 1 / 2.4 + 0.1
    assert np.corrcoef(found, true)[0, 1] > 0.95
    assert psnr_of_tests(trainer, dataset) > psnr_of_tests(without, dataset) + 0.5


def test_the_gradient_by_gains_is_that_of_the_loss(exposed):
    trainer = Trainer(exposed[0], replace(preset("demo"), init_count=150, iterations=50, exposure_per_picture=True))
    for _ in range(20):
        trainer.step()
    exposures, view, rows = trainer.pictures.exposures, trainer.views[0], trainer.gaussians.rows()
    exposures.numbers.follow()

    def loss():
        drawn = trainer._view_pass.forward(trainer.gaussians, rows, None, view, 0, 1, False)
        return trainer._view_pass.backward(drawn, trainer._target_image(3, view, None), view.camera, False)[0]

    gradient = exposures._by_numbers(0, np.array(loss().grad_gains, np.float64))
    for channel in range(3):
        ends = []
        for step in (0.01, -0.02):
            exposures.numbers.values[0, channel] += step
            ends.append(float(loss().value[0]))
        exposures.numbers.values[0, channel] += 0.01
        assert gradient[channel] == pytest.approx((ends[0] - ends[1]) / 0.02, rel=0.05)


def test_exposures_that_pictures_name_are_their_gains(named):
    """Of light as they are, of sRGB values by their curve's power, none of radiance or where the scene says none."""
    dataset, gains = named
    light = with_settings(
        preset("demo", "relight"), {"light.linear": True, "light.exposure": float(np.log2(0.45))}
    ).light
    np.testing.assert_allclose(known_gains(dataset, light), gains, rtol=1e-12)
    np.testing.assert_allclose(known_gains(dataset, replace(light, exposure=0.0)), 0.45 * gains, rtol=1e-12)
    np.testing.assert_allclose(known_gains(dataset, None), gains ** (1 / 2.4), rtol=1e-12)
    assert (known_gains(dataset, replace(light, radiance=True)) == 1).all()
    assert (known_gains(replace(dataset, scene={}), light) == 1).all()
    broken = replace(dataset, train=(replace(dataset.train[0], exposure=1e300), *dataset.train[1:]))
    with pytest.raises(InputError, match="expected an exposure within 40 EV of the scene's, found 1e"):
        known_gains(broken, light)


def test_pictures_of_named_exposures_train_a_nearer_model(named):
    """And no gain is learned; where gains are, they start there, and keep their mean."""
    dataset, gains = named
    config = replace(preset("demo"), sh_degree=0)
    nameless = replace(dataset, train=tuple(replace(frame, exposure=None) for frame in dataset.train))
    without, trainer = trained(nameless, config), trained(dataset, config)
    assert without.pictures.exposures is None
    assert without.pictures.gains(without.views[0]) is None
    given = np.array([trainer.pictures.gains(trainer.views[i]) for i in range(len(gains))])
    np.testing.assert_allclose(given, gains[:, None] ** (1 / 2.4) * np.ones(3))
    assert trainer.pictures.exposures is None
    assert trainer.pictures.cameras() is None
    assert psnr_of_tests(trainer, dataset) > psnr_of_tests(without, dataset) + 0.5
    learned = trained(dataset, replace(config, exposure_per_picture=True)).pictures.exposures.all_gains()
    np.testing.assert_allclose(np.log(learned).mean(axis=0), np.log(gains).mean() / 2.4, atol=1e-9)
    assert (np.abs(learned / given - 1) > 1e-3).any()
