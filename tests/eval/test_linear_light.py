"""PSNR of linear light by the mu-law: against numpy, of runs that know light beyond white and of others, and null."""

import math
from dataclasses import replace

import numpy as np
import pytest

from spacesim.data.images import linear_from_srgb, load_image, read_exr, read_png, write_exr
from spacesim.data.images.tone import MU, PEAK, STANDARD_EXPOSURE, Curve, mu_law
from spacesim.eval.evaluate import evaluate
from spacesim.eval.frame_metrics import own_exposure
from spacesim.splat.run import Prediction

FACTOR = 0.01  #: display value of a W m^-2 sr^-1
SCENE = {"exposure": FACTOR, "config": {"camera": {"tone": "srgb"}}}


@pytest.fixture(autouse=True)
def no_weights(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "nowhere"))


@pytest.fixture
def bright(dataset):
    """Its radiance is up to 25 times white."""
    random = np.random.default_rng(0)
    for frame in dataset.test:
        layers = read_exr(dataset.root / frame.gt_path)
        layers["radiance"] = (10 ** random.uniform(-2, 3.4, layers["radiance"].shape)).astype(np.float32)
        write_exr(dataset.root / frame.gt_path, layers)
    return replace(dataset, scene=SCENE)


def decibels(prediction: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    """From the definition, of linear display values [H, W, 3]."""
    encoded = [np.log(1 + 5000 * np.clip(v, 0, 16) / 16) / math.log(5001) for v in (prediction, truth)]
    return -10 * math.log10(((encoded[0] - encoded[1])[mask] ** 2).mean())


def test_the_law_equals_its_formula():
    shares = np.concatenate([[0, 1e-5, 1e-3], np.linspace(0.01, 1, 40), [3, 50, 1e4]])  # beyond the peak, too
    formula = np.log(1 + 5000 * shares) / math.log(5001)
    np.testing.assert_allclose(mu_law(PEAK * shares), formula, atol=1e-12)
    assert (mu_law(np.zeros(1))[0], MU, PEAK) == (0, 5000, 16)
    assert mu_law(np.full(1, PEAK))[0] == pytest.approx(1, abs=1e-12)


def truth_of(dataset, frame) -> tuple[np.ndarray, np.ndarray]:
    """(linear display values, silhouette)"""
    radiance = read_exr(dataset.root / frame.gt_path)["radiance"].astype(np.float64)
    return FACTOR * radiance, read_png(dataset.root / frame.silhouette_path) == 255


def test_light_beyond_white_counts(make_run, bright, tmp_path):
    class Radiant(type(make_run())):
        def predict(self, camera, sun, exposure=None):
            drawn = super().predict(camera, sun)
            frame = next(frame for frame in self.dataset.test if frame.camera is camera)
            return replace(drawn, linear=(1.3 * truth_of(bright, frame)[0]).astype(np.float32))

    metrics = evaluate(Radiant(bright), bright, tmp_path / "eval")
    for frame, found in zip(bright.test, metrics["frames"], strict=True):
        truth, silhouette = truth_of(bright, frame)
        assert found["psnr_mu"] == pytest.approx(decibels(1.3 * truth, truth, silhouette), abs=1e-4)
        everywhere = np.ones_like(silhouette)
        assert found["image_full"]["psnr_mu"] == pytest.approx(decibels(1.3 * truth, truth, everywhere), abs=1e-4)
    assert metrics["image"]["psnr_mu"]["count"] == 4
    assert metrics["image"]["psnr"]["mean"] == 100  # the pictures are equal
    assert not any("psnr_mu" in note for note in metrics["notes"])


def test_pictures_count_as_light_up_to_white(make_run, bright, tmp_path):
    metrics = evaluate(make_run(), bright, tmp_path / "eval")
    for frame, found in zip(bright.test, metrics["frames"], strict=True):
        truth, silhouette = truth_of(bright, frame)
        seen = linear_from_srgb(load_image(bright, frame).over(np.zeros(3)))
        assert found["psnr_mu"] == pytest.approx(decibels(seen, truth, silhouette), abs=1e-4)


def test_a_picture_of_its_own_exposure_is_compared_with_it(make_run, bright, tmp_path):
    own = replace(bright.test[0], exposure=4 * FACTOR)
    dataset = replace(bright, test=(own,))
    found = evaluate(make_run(), dataset, tmp_path / "eval")["frames"][0]["psnr_mu"]
    truth, silhouette = truth_of(bright, own)
    seen = linear_from_srgb(load_image(bright, own).over(np.zeros(3)))
    assert found == pytest.approx(decibels(seen, 4 * truth, silhouette), abs=1e-4)


def test_runs_of_light_are_exposed_as_the_picture_was(make_run, dataset):
    class Model:
        curve = Curve("srgb", 0.0, 16.0)

    run, frame = make_run(), replace(dataset.test[0], exposure=8 * STANDARD_EXPOSURE)
    run.gaussian_run = Model()
    assert own_exposure(run, frame) == pytest.approx(3)
    assert own_exposure(run, dataset.test[0]) is None
    run.gaussian_run.curve = Curve("srgb", 0.0, 1.0)
    assert own_exposure(run, frame) == pytest.approx(3)
    run.gaussian_run.curve = None
    assert own_exposure(run, frame) is None


def test_without_radiance_or_exposure_it_is_null_and_said_once(make_run, dataset, tmp_path):
    unlit = tuple(replace(frame, gt_path=None) for frame in dataset.test)
    for name, data in (("exposure", dataset), ("truth", replace(dataset, test=unlit, scene=SCENE))):
        metrics = evaluate(make_run(), data, tmp_path / name)
        assert metrics["image"]["psnr_mu"] is None
        assert metrics["frames"][0]["psnr_mu"] is None
        said = [note for note in metrics["notes"] if "psnr_mu" in note or "PSNR-μ" in note]
        assert said == ["psnr_mu is null: the data has no radiance (gt_path), or scene.json does not say the exposure."]
    assert isinstance(make_run().predict(dataset.test[0].camera, None), Prediction)
