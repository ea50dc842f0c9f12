"""Image metrics against scikit-image, FLIP's own call and hand-computed cases."""

import flip_evaluator
import numpy as np
import pytest
from skimage.metrics import mean_squared_error, peak_signal_noise_ratio, structural_similarity

from spacesim.eval.metrics import image

METRICS = (image.mae, image.rmse, image.psnr, image.ssim, image.flip)


@pytest.fixture
def pictures():
    generator = np.random.default_rng(3)
    truth = generator.random((37, 29, 3)).astype(np.float32)
    return np.clip(truth + 0.1 * generator.normal(size=truth.shape), 0, 1).astype(np.float32), truth


def disc(height, width, radius):
    y, x = np.mgrid[:height, :width]
    return (y - height / 2) ** 2 + (x - width / 2) ** 2 < radius**2


def test_hand_computed():
    truth = np.zeros((2, 2, 3))
    prediction = truth.copy()
    prediction[0, 0] = (0.3, 0.0, 0.0)
    prediction[1, 1] = (0.0, 0.4, 0.0)
    assert image.mae(prediction, truth) == pytest.approx(0.7 / 12)
    assert image.rmse(prediction, truth) == pytest.approx(np.sqrt(0.25 / 12))
    assert image.psnr(prediction, truth) == pytest.approx(10 * np.log10(12 / 0.25))
    only = np.array([[True, False], [False, False]])
    assert image.mae(prediction, truth, only) == pytest.approx(0.1)
    assert image.psnr(prediction, truth, only) == pytest.approx(10 * np.log10(3 / 0.09))


def test_pixel_metrics_agree_with_scikit_image(pictures):
    prediction, truth = (p.astype(np.float64) for p in pictures)
    mask = disc(*truth.shape[:2], 11)
    for p, t, m in ((prediction, truth, None), (prediction[mask], truth[mask], mask)):
        squared = mean_squared_error(t, p)
        assert image.rmse(prediction, truth, m) == pytest.approx(np.sqrt(squared), abs=1e-6)
        decibels = peak_signal_noise_ratio(t, p, data_range=1)
        assert image.psnr(prediction, truth, m) == pytest.approx(decibels, abs=1e-6)
        assert image.mae(prediction, truth, m) == pytest.approx(np.abs(t - p).mean(), abs=1e-6)


def test_ssim_agrees_with_scikit_image(pictures):
    prediction, truth = (p.astype(np.float64) for p in pictures)
    mean, full = structural_similarity(
        truth, prediction, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0,
        channel_axis=2, full=True,
    )  # fmt: skip
    mask = disc(*truth.shape[:2], 11)
    assert image.ssim(prediction, truth) == pytest.approx(mean, abs=1e-6)
    np.testing.assert_allclose(image.ssim_map(prediction, truth), full.mean(axis=2), atol=1e-6)
    assert image.ssim(prediction, truth, mask) == pytest.approx(full[mask].mean(), abs=1e-6)


def test_float32_loses_nothing(pictures):
    prediction, truth = pictures
    for metric in METRICS:
        double = metric(prediction.astype(np.float64), truth.astype(np.float64))
        assert metric(prediction, truth) == pytest.approx(double, abs=1e-9)


def test_flip_is_the_packages_own_mean(pictures):
    prediction, truth = pictures
    expected = flip_evaluator.evaluate(truth, prediction, "LDR")[1]
    assert image.flip(prediction, truth) == pytest.approx(expected, abs=1e-6)
    assert image.flip(truth, truth) == 0
    mask = disc(*truth.shape[:2], 9)
    rows, columns = np.nonzero(mask)
    box = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    inside = [np.ascontiguousarray((p * mask[..., None])[box], np.float32) for p in (truth, prediction)]
    assert image.flip(prediction, truth, mask) == pytest.approx(flip_evaluator.evaluate(*inside, "LDR")[1], abs=1e-6)


def test_mask_hides_everything_outside(pictures):
    prediction, truth = pictures
    mask = disc(*truth.shape[:2], 9)
    spoiled = np.where(mask[..., None], prediction, 1 - truth)
    for metric in (image.mae, image.rmse, image.psnr, image.flip):
        assert metric(spoiled, truth, mask) == metric(prediction, truth, mask)
        assert metric(spoiled, truth) != metric(prediction, truth)


def test_empty_mask_is_none(pictures):
    prediction, truth = pictures
    nothing = np.zeros(truth.shape[:2], bool)
    assert [metric(prediction, truth, nothing) for metric in METRICS] == [None] * 5


def test_equal_pictures(pictures):
    _, truth = pictures
    assert [metric(truth, truth) for metric in METRICS] == [0, 0, 100, pytest.approx(1), 0]


@pytest.mark.parametrize(("error", "decibels"), [(1e-4, 80), (1.01e-5, 99.913573), (0.99e-5, 100), (1e-9, 100)])
def test_psnr_ends_at_a_hundred(error, decibels):
    truth = np.full((6, 7, 3), 0.25)
    assert image.psnr(truth + error, truth) == pytest.approx(decibels, abs=1e-6)


def test_picture_smaller_than_the_window_has_no_ssim():
    assert image.ssim(np.ones((10, 40, 3)), np.ones((10, 40, 3))) is None
