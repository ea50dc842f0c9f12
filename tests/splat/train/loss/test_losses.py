"""The training loss against scikit-image, scipy and finite differences."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from skimage.metrics import structural_similarity

from spacesim.backend import ad, recorded, select
from spacesim.backend.upload import upload
from spacesim.splat.train.loss import photometric, photometric_llvm
from spacesim.splat.train.loss.photometric import photometric_loss
from spacesim.splat.train.stages import LossSettings, TargetImage, compared_pictures, picture_loss

WIDTH, HEIGHT = 31, 23


def picture(seed: int) -> np.ndarray:
    """[3, H, W] smooth values in [0, 1]."""
    noise = np.random.default_rng(seed).uniform(size=(3, HEIGHT, WIDTH))
    for axis in (1, 2):
        noise = gaussian_filter1d(noise, 1.0, axis=axis, mode="wrap")
    return noise.astype(np.float32)


def twin(x: np.ndarray, y: np.ndarray, weight: float) -> tuple[float, np.ndarray]:
    """The loss of pictures [3, H, W] and its gradient by x, from the formulas, in float64."""

    def blur(values):
        for axis in (1, 2):
            values = gaussian_filter1d(values, 1.5, axis=axis, mode="constant", radius=5)
        return values

    x, y = x.astype(np.float64), y.astype(np.float64)
    mx, my, xx, yy, xy = blur(x), blur(y), blur(x * x), blur(y * y), blur(x * y)
    a1, a2 = 2 * mx * my + 1e-4, 2 * (xy - mx * my) + 9e-4
    b1, b2 = mx * mx + my * my + 1e-4, xx - mx * mx + yy - my * my + 9e-4
    value = a1 * a2 / (b1 * b2)
    by_mean = 2 * my * (a2 - a1) / (b1 * b2) + 2 * mx * value * (1 / b2 - 1 / b1)
    by_ssim = blur(by_mean) - 2 * x * blur(value / b2) + y * blur(2 * a1 / (b1 * b2))
    loss = (1 - weight) * np.abs(x - y).mean() + weight * (1 - value.mean())
    return loss, ((1 - weight) * np.where(x >= y, 1, -1) - weight * by_ssim) / x.size


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


@pytest.mark.parametrize("way", ["the backend's", "Dr.Jit's"])
@pytest.mark.parametrize("weight", [0.2, 1.0])
@pytest.mark.parametrize("size", [(1, 1), (3, 40), (33, 8), (50, 27), (70, 48), (34, 530)])
def test_loss_and_gradient_equal_their_twin(monkeypatch, size, weight, way):
    """Of pictures smaller than the window, and of those that end within a thread's pixels."""
    launched, kernel = [], photometric_llvm._kernel
    monkeypatch.setattr(photometric_llvm, "_kernel", lambda: launched.append(True) or kernel())
    if way == "Dr.Jit's":
        monkeypatch.setattr(photometric, "is_usable", lambda: False)
    rng = np.random.default_rng(5)
    x, y = rng.uniform(size=(2, 3, *size)).astype(np.float32)
    y[:, size[0] // 2 + 1 :] = x[:, size[0] // 2 + 1 :]
    prediction, (height, width) = planes(x), size
    dr.enable_grad(prediction)
    loss = photometric_loss(prediction, planes(y), width, height, weight)
    dr.backward(loss)
    expected, gradient = twin(x, y, weight)
    assert float(dr.detach(loss)[0]) == pytest.approx(expected, rel=1e-5, abs=1e-7)
    found = np.array(dr.grad(prediction)).reshape(3, *size)
    np.testing.assert_allclose(found, gradient, atol=2e-5 * np.abs(gradient).max())
    assert bool(launched) == (select() == "llvm" and way != "Dr.Jit's")


def test_a_recorded_loss_repeats_to_the_bit(monkeypatch):
    monkeypatch.setattr(photometric, "is_usable", lambda: False)  # as within recordings

    @recorded
    def loss_and_gradient(x, y):
        prediction = ad.Array3f(x)
        dr.enable_grad(prediction)
        loss = photometric_loss(prediction, ad.Array3f(y), WIDTH, HEIGHT)
        dr.backward(loss)
        return [dr.detach(loss), *dr.grad(prediction)]

    pairs = [[list(planes(picture(seed))) for seed in seeds] for seeds in ((6, 7), (8, 9), (6, 7))]
    first, other, again = ([np.array(one) for one in loss_and_gradient(*pair)] for pair in pairs)
    traced = [np.array(one) for one in loss_and_gradient.traced(*pairs[1])]
    for one, two, three, four in zip(first, again, other, traced, strict=True):
        np.testing.assert_array_equal(one, two)
        np.testing.assert_array_equal(three, four)
        assert not np.array_equal(one, three)


@pytest.mark.parametrize(
    "changed",
    [{}, {"tone": "filmic", "supersample": 2}, {"downscale": 2}, {"radiance": 2.0}, {"visibility": 0.5}],
)
@pytest.mark.parametrize("gains", [None, [0.9, 1.0, 1.1]])
def test_the_photometric_term_may_be_known_before(changed, gains):
    """As training on a CPU has it: by itself, between two recordings; with all the ways to compare a picture."""
    settings = replace(LossSettings(0.2, 0.0, 0.0, 0.0, 1.0, None), **changed)
    rng, (width, height) = np.random.default_rng(7), (40, 36)
    drawn, whole = (width * height * times**2 // settings.downscale**2 for times in (settings.supersample, 1))
    planes = {"color": [upload(rng.uniform(0.1, 0.9, drawn).astype(np.float32)) for _ in range(3)]}
    truth = {"radiance": [upload(rng.uniform(0.1, 0.4, whole).astype(np.float32)) for _ in range(3)]}
    if settings.visibility:
        planes["visibility"] = [upload(rng.uniform(size=drawn).astype(np.float32))]
        truth["visibility"] = [upload(rng.uniform(size=whole).astype(np.float32))]
    transmittance = upload(rng.uniform(0.1, 0.5, drawn).astype(np.float32))
    rgba = upload(rng.integers(2**24, 2**32, width * height).astype(np.uint32), ad.UInt32)
    background, valid = ad.Float([0.2, 0.1, 0.5]), upload(rng.uniform(size=width * height) < 0.9, ad.Bool)
    target = TargetImage(rgba, background, valid, truth, None if gains is None else ad.Float(gains))
    shown = planes, transmittance, target, (width, height), settings
    size = width // settings.downscale, height // settings.downscale
    compared = [dr.detach(picture) for picture in compared_pictures(*shown)]
    prediction = ad.Array3f(compared[0])
    dr.enable_grad(prediction)
    term = photometric_loss(prediction, compared[1], *size, settings.ssim)
    dr.backward(term)
    known = dr.detach(term), dr.grad(prediction)
    (value, by_planes, passed), (expected, of_planes, of_passed) = picture_loss(*shown, known), picture_loss(*shown)
    assert float(value[0]) == pytest.approx(float(expected[0]), rel=1e-6)
    for name, group in (of_planes | {"transmittance": [of_passed]}).items():
        for found, plane in zip((by_planes | {"transmittance": [passed]})[name], group, strict=True):
            np.testing.assert_allclose(np.array(found), np.array(plane), atol=1e-6 * np.abs(np.array(plane)).max())
            assert np.abs(np.array(plane)).max() > 0
