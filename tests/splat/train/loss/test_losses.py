"""The training loss against scikit-image, scipy and finite differences."""

import drjit as dr
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from skimage.metrics import structural_similarity

from spacesim.backend import ad
from spacesim.backend.upload import upload
from spacesim.splat.train.loss.photometric import photometric_loss

WIDTH, HEIGHT = 31, 23


def picture(seed: int) -> np.ndarray:
    """[3, H, W] smooth values in [0, 1]."""
    noise = np.random.default_rng(seed).uniform(size=(3, HEIGHT, WIDTH))
    for axis in (1, 2):
        noise = gaussian_filter1d(noise, 1.0, axis=axis, mode="wrap")
    return noise.astype(np.float32)


def planes(values: np.ndarray):
    return ad.Array3f([upload(np.ascontiguousarray(plane.ravel())) for plane in values])


def reference_ssim(x: np.ndarray, y: np.ndarray) -> float:
    """scikit-image on pictures with a black margin, so that its border is as ours: zero."""
    margin = ((0, 0), (8, 8), (8, 8))
    maps = structural_similarity(
        np.pad(x, margin).astype(np.float64),
        np.pad(y, margin).astype(np.float64),
        channel_axis=0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        full=True,
    )[1]
    return float(maps[:, 8:-8, 8:-8].mean())


def ssim(prediction, target):
    return 1 - photometric_loss(prediction, target, WIDTH, HEIGHT, 1.0)


def test_ssim_matches_scikit_image():
    x, y = picture(1), picture(2)
    assert float(ssim(planes(x), planes(y))[0]) == pytest.approx(reference_ssim(x, y), abs=2e-6)
    assert float(ssim(planes(x), planes(x))[0]) == pytest.approx(1, abs=1e-5)


def test_loss_is_the_weighted_sum_of_equation_2_8():
    x, y = picture(1), picture(2)
    loss = float(photometric_loss(planes(x), planes(y), WIDTH, HEIGHT, 0.2)[0])
    expected = 0.8 * np.abs(x - y).mean(dtype=np.float64) + 0.2 * (1 - reference_ssim(x, y))
    assert loss == pytest.approx(expected, abs=2e-6)


def test_gradient_of_ssim_matches_central_differences():
    x, y = picture(3), picture(4)
    prediction = planes(x)
    dr.enable_grad(prediction)
    dr.backward(ssim(prediction, planes(y)))
    gradient = np.array(dr.grad(prediction)).reshape(3, HEIGHT, WIDTH)
    rng, step = np.random.default_rng(0), 1e-3
    for _ in range(12):
        index = (rng.integers(3), rng.integers(HEIGHT), rng.integers(WIDTH))
        ends = []
        for sign in (1, -1):
            moved = x.astype(np.float64)
            moved[index] += sign * step
            ends.append(reference_ssim(moved, y))
        slope = (ends[0] - ends[1]) / (2 * step)
        assert gradient[index] == pytest.approx(slope, rel=5e-3, abs=1e-3 * float(np.abs(gradient).max()))
