"""What a camera records: photon transfer, saturation, quantisation, blur, tone."""

import numpy as np
import pytest

from spacesim.data.errors import InputError
from spacesim.data.images import srgb_from_linear
from spacesim.data.images.tone import filmic
from spacesim.scenes.cameras.camera import CameraConfig
from spacesim.scenes.cameras.exposure import record_image
from spacesim.scenes.cameras.sensor import SensorConfig

NOISELESS = {"shot_noise": False, "read_noise_e": 0.0}


def camera(tone="srgb", exposure=1.0, **sensor):
    return CameraConfig((64, 64), exposure=exposure, tone=tone, sensor=SensorConfig(**sensor))


def flat(level, size=256):
    return np.full((size, size, 3), level, np.float32), np.ones((size, size), np.float32)


def test_without_a_sensor_the_image_is_the_srgb_encoding_with_straight_alpha():
    random = np.random.default_rng(0)
    alpha = random.random((20, 30)).astype(np.float32)
    alpha[:5] = 0
    colors = (3 * random.random((20, 30, 3))).astype(np.float32)
    found = record_image(colors * alpha[..., None], alpha, CameraConfig((30, 20), exposure=0.5), (0, 0))
    expected = np.round(255 * srgb_from_linear(0.5 * colors.astype(np.float64)))
    assert found.raw is None
    assert found.image.dtype == np.uint8
    assert np.abs(found.image[..., :3] - expected * (alpha > 0)[..., None]).max() <= 1  # float32
    np.testing.assert_array_equal(found.image[..., 3], np.round(255 * alpha))


def test_photon_transfer():
    """EMVA 1288: the variance of digital numbers grows with their mean at a slope of the gain; what is left without
    light is the read noise and the rounding, of variance 1/12."""
    gain, read, dark = 0.37, 9.0, 40.0
    taken = camera(full_well_e=9_000.0, read_noise_e=read, dark_e=dark, gain_dn_per_e=gain, black_level_dn=100)
    means, variances = [], []
    for k, level in enumerate(np.linspace(0, 0.8, 9)):
        numbers = record_image(*flat(level), taken, (7, k)).raw.astype(np.float64)
        means.append(numbers.mean() - 100)
        variances.append(numbers.var())
        assert numbers.mean() == pytest.approx(100 + gain * (9000 * level + dark), abs=5 * numbers.std() / 440)
    slope, intercept = np.polyfit(means, variances, 1)
    assert slope == pytest.approx(gain, rel=0.02)
    assert intercept == pytest.approx((gain * read) ** 2 + 1 / 12, rel=0.1)


def test_full_well_and_converter_saturate():
    found = record_image(*flat(3.0), camera(full_well_e=1000.0, read_noise_e=0.0), (0,))
    assert (found.raw == 4095).all()
    assert (found.image == 255).all()
    dim = camera(full_well_e=1000.0, read_noise_e=0.0, gain_dn_per_e=1.0, black_level_dn=10)
    assert (record_image(*flat(3.0), dim, (0,)).raw == 1010).all()  # the well is full long before the converter
    bright = camera(full_well_e=1000.0, gain_dn_per_e=100.0)
    assert (record_image(*flat(0.5), bright, (0,)).raw == 4095).all()
    glint = record_image(*flat(1e30), camera(), (0,))
    assert glint.raw.min() > 4070  # full wells, with read noise


def test_noiseless_numbers_are_rounded_to_the_bits():
    levels = np.linspace(0, 1, 1000, dtype=np.float32)
    radiance = np.tile(levels[None, :, None], (3, 1, 3))
    for bits in (1, 6, 8, 12, 16):
        found = record_image(radiance, np.ones((3, 1000)), camera(bits=bits, black_level_dn=0, **NOISELESS), (0,))
        assert found.raw.dtype == np.uint16
        np.testing.assert_array_equal(found.raw[1, 2], np.rint(levels.astype(float) * (2**bits - 1)))
    assert found.image.shape == (3, 1000, 3)
    assert np.abs(found.image[0, :, 0] - 255 * srgb_from_linear(levels)).max() < 0.51
    half = record_image(*flat(0.5), camera(exposure=0.5, bits=10, black_level_dn=23, **NOISELESS), (0,))
    assert (half.raw == 23 + 250).all()
    assert (half.image == 137).all()  # 0.25 as sRGB


def test_mean_of_noisy_frames_is_the_noiseless_one():
    gradient = np.tile(np.linspace(0.05, 0.9, 48, dtype=np.float32)[:, None, None], (1, 48, 3))
    alpha = np.ones((48, 48))
    mean = np.mean([record_image(gradient, alpha, camera(read_noise_e=20.0), (3, i)).raw for i in range(64)], axis=0)
    clean = record_image(gradient, alpha, camera(**NOISELESS), (0,)).raw
    sigma = 0.4 * np.hypot(np.sqrt(10_000 * gradient), 20).transpose(2, 0, 1) / 8  # gain 0.403 DN/e
    assert np.abs((mean - clean) / sigma).max() < 5.5
    assert np.abs(((mean - clean) / sigma).mean()) < 0.1


def test_point_spread_keeps_energy_and_has_its_width():
    radiance = np.zeros((65, 65, 3), np.float32)
    radiance[32, 32] = 0.9
    taken = camera(psf_sigma_px=2.5, full_well_e=1e6, bits=16, black_level_dn=0, **NOISELESS)
    spread = record_image(radiance, np.ones((65, 65)), taken, (0,)).raw[1].astype(np.float64)
    assert spread.sum() / 65535 == pytest.approx(0.9, rel=0.005)
    x = np.arange(65) - 32
    for axis in (0, 1):
        assert (spread.sum(axis) * x**2).sum() / spread.sum() == pytest.approx(2.5**2, rel=0.02)
    even = record_image(*flat(0.6, 40), taken, (0,)).raw
    assert (even == even[0, 0, 0]).all()  # no dark border


def test_seed_decides_the_noise():
    picture = flat(0.3, 32)
    first, again, other = (record_image(*picture, camera(), seed).raw for seed in ((1, 2), (1, 2), (1, 3)))
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.9
    planes = first.astype(float) - first.mean(axis=(1, 2), keepdims=True)
    assert abs((planes[0] * planes[1]).mean()) < 0.1 * planes.var()  # each channel has its own noise


def test_sky_is_opaque_and_noisy():
    found = record_image(np.zeros((64, 64, 3)), np.zeros((64, 64)), camera(read_noise_e=30.0), (0,))
    assert found.image.shape == (64, 64, 3)
    assert found.image.std() > 0
    assert found.raw.mean() == pytest.approx(64, abs=0.5)


def test_monochrome_records_the_mean_of_the_channels():
    radiance = np.tile(np.float32([0.2, 0.4, 0.6]), (30, 40, 1))
    found = record_image(radiance, np.ones((30, 40)), camera(monochrome=True, black_level_dn=0, **NOISELESS), (0,))
    assert found.image.shape == found.raw.shape == (30, 40)
    assert (found.raw == round(0.4 * 4095)).all()
    assert (found.image == 170).all()


def test_filmic_curve():
    assert filmic(np.float64(1.0)) == pytest.approx(2.54 / 3.16)
    assert filmic(np.float64(0.18)) == pytest.approx(0.2669, abs=1e-4)
    levels = np.linspace(0, 20, 4000)
    curve = filmic(levels)
    assert curve[0] == 0
    assert (np.diff(curve) >= 0).all()
    assert levels[np.argmax(curve == 1)] == pytest.approx(7.24, abs=0.02)  # root of 0.08 x^2 - 0.56 x - 0.14
    plain = record_image(*flat(0.5, 8), CameraConfig((8, 8), exposure=1.0), (0,)).image[0, 0, 0]
    film = record_image(*flat(0.5, 8), CameraConfig((8, 8), exposure=1.0, tone="filmic"), (0,)).image[0, 0, 0]
    assert plain == 188
    assert film == np.round(255 * srgb_from_linear(filmic(np.float64(0.5))))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"psf_sigma_px": -1.0}, "psf_sigma_px: expected 0 to 100 pixels, found -1.0"),
        ({"full_well_e": 0.0}, "full_well_e: "),
        ({"dark_e": float("nan")}, "dark_e: "),
        ({"read_noise_e": -2.0}, "read_noise_e: "),
        ({"bits": 17}, "bits: expected 1 to 16, found 17"),
        ({"bits": 4}, "black_level_dn: expected at least 0, below 15"),
        ({"gain_dn_per_e": 0.0}, "gain_dn_per_e: "),
    ],
)
def test_impossible_sensors_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        SensorConfig(**changes)
