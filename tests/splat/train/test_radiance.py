"""Training on radiance: what is compared against its formula, slopes against differences, pictures brighter than
white."""

import json
import math
from dataclasses import replace
from types import MappingProxyType

import drjit as dr
import numpy as np
import pytest

from spacesim.backend import ad
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.images import read_exr, srgb_from_linear, write_exr
from spacesim.data.images.tone import (
    PEAK,
    STANDARD_EXPOSURE,
    TONES,
    WHITES,
    display_values,
    linear_from_display,
)
from spacesim.learning.pictures import write_picture
from spacesim.splat.export.sweep import suns_around, sweep
from spacesim.splat.light.config import LightConfig
from spacesim.splat.light.field import FieldConfig
from spacesim.splat.light.shadow.cast import ShadowConfig
from spacesim.splat.raster import tone
from spacesim.splat.train.config import TrainConfig, preset, with_settings
from spacesim.splat.train.downscale import truth_of_squares
from spacesim.splat.train.stages import LossSettings, TargetImage, picture_loss
from spacesim.splat.train.train import train
from spacesim.splat.train.views import TrainingViews

SIZE = 16, 12  #: width and height, pixels
PIXELS = SIZE[0] * SIZE[1]
FACTOR = 1 / 300  #: shares of the peak a W m^-2 sr^-1
FIELD = FieldConfig(features=4, width=8)


def encoded(share: np.ndarray) -> np.ndarray:
    """Of shares of the peak, in float64: sRGB values (IEC 61966-2-1), beyond white 1 + 1.055 / 2.4 ln v."""
    v = PEAK * np.asarray(share, np.float64)
    curve = np.where(v <= 0.0031308, 12.92 * v, 1.055 * np.clip(v, 0, 1) ** (1 / 2.4) - 0.055)
    return np.where(v < 1, curve, 1 + 1.055 / 2.4 * np.log(np.maximum(v, 1)))


def config(**options) -> TrainConfig:
    light = LightConfig(FIELD, linear=True, radiance=True, **options)
    return TrainConfig(light=light, iterations=3, init_count=100)


def test_what_is_compared_equals_its_formula_and_slopes_central_differences():
    shares = np.concatenate([[0, 1e-5, 1e-3, 1 / PEAK], np.linspace(0.01, 1, 40), [3, 50, 1e4]])  # beyond the peak, too
    light = upload(shares)
    dr.enable_grad(light)
    found = tone.encode_radiance(light)
    values = np.array(dr.detach(found))
    np.testing.assert_allclose(values, encoded(shares), atol=2e-6, rtol=1e-6)
    dr.backward(dr.sum(found))
    step = 1e-6 * np.maximum(shares, 1e-3)
    slopes = (encoded(shares + step) - encoded(shares - step)) / (2 * step)
    np.testing.assert_allclose(np.array(dr.grad(light)), slopes, rtol=1e-4)
    assert slopes.min() > 0
    assert encoded(1) == pytest.approx(tone.ENCODED_PEAK)
    endless = upload([math.inf])
    dr.enable_grad(endless)
    dr.backward(tone.encode_radiance(endless))
    assert np.array(dr.grad(endless))[0] == 0
    np.testing.assert_allclose(np.array(tone.decode_radiance(upload(values))), shares, rtol=2e-5)
    slopes = np.array(tone.decode_radiance_slope(upload(values)))
    np.testing.assert_allclose(slopes * np.array(dr.grad(light)), 1, rtol=1e-4)


@pytest.mark.parametrize("curve", TONES)
def test_light_beyond_white_is_shown_white(curve):
    shares = np.array([0, 0.001, 0.01, 0.05, 0.3, 1])
    expected = display_values(np.minimum(PEAK * shares, WHITES[curve]), curve)
    np.testing.assert_allclose(np.array(tone.tone_map(upload(shares), curve, PEAK)), expected, atol=3e-6)
    np.testing.assert_allclose(tone.adjust_exposure(shares, curve, white=PEAK), expected, atol=1e-6)
    darker = display_values(PEAK / 32 * shares, curve)
    np.testing.assert_allclose(tone.adjust_exposure(shares, curve, -5.0, PEAK), darker, atol=1e-6)


@pytest.mark.parametrize("curve", TONES)
def test_pictures_are_decoded_up_to_white(curve):
    light = np.linspace(0, WHITES[curve], 200)
    np.testing.assert_allclose(linear_from_display(display_values(light, curve), curve), light, atol=1e-6)
    brighter = linear_from_display(display_values(np.array([2.0, 50.0]) * WHITES[curve], curve), curve)
    np.testing.assert_allclose(brighter, WHITES[curve], rtol=1e-6)


def pictures(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """What is blended and what it is compared with; a fifth of the truth is brighter than white, some than the peak."""
    return {
        "color": 10 ** rng.uniform(-4, 0, (3, PIXELS)),
        "transmittance": rng.uniform(0, 1, PIXELS),
        "gains": rng.uniform(0.5, 2, 3),
        "radiance": 10 ** rng.uniform(-2, 3, (3, PIXELS)),
        "alpha": rng.integers(0, 256, PIXELS),
        "valid": rng.uniform(size=PIXELS) > 0.2,
        "background": rng.uniform(size=3),
    }


def reference(numbers: dict[str, np.ndarray]) -> float:
    """The loss without D-SSIM, in float64, from its definition."""
    behind = np.where(
        numbers["background"] <= 0.04045,
        numbers["background"] / 12.92,
        ((numbers["background"] + 0.055) / 1.055) ** 2.4,
    )[:, None]
    truth = FACTOR * numbers["radiance"] + (1 - numbers["alpha"] / 255) * behind / PEAK
    shown = numbers["gains"][:, None] * numbers["color"] + numbers["transmittance"] * behind / PEAK
    return float((np.abs(encoded(shown) - encoded(truth)) * numbers["valid"]).sum() / (3 * PIXELS))


def found(numbers: dict[str, np.ndarray], ssim: float = 0.0):
    """(loss, gradients by colour [3, P], transmittance [P] and gains [3])."""
    settings = LossSettings(ssim=ssim, visibility=0.0, depth=0.0, normal=0.0, scale=1.0, tone="srgb", radiance=FACTOR)
    target = TargetImage(
        upload((numbers["alpha"].astype(np.uint32) << 24), ad.UInt32),
        ad.Float(numbers["background"].tolist()),
        upload(numbers["valid"], ad.Bool),
        {"radiance": [upload(plane) for plane in numbers["radiance"]]},
        ad.Float(numbers["gains"].tolist()),
    )
    planes = {"color": [upload(plane) for plane in numbers["color"]]}
    loss, grads, grad_transmittance = picture_loss(planes, upload(numbers["transmittance"]), target, SIZE, settings)
    gradients = [np.array(grads["color"]), np.array(grad_transmittance), np.array(grads["gains"][0])]
    return float(np.array(loss)[0]), gradients


def test_loss_and_gradients_equal_those_of_the_definition():
    numbers = pictures(np.random.default_rng(0))
    loss, gradients = found(numbers)
    assert loss == pytest.approx(reference(numbers), rel=1e-5)
    truth = FACTOR * numbers["radiance"]
    assert (truth > 1).any()
    assert (truth > 1 / PEAK).mean() > 0.2
    for name, gradient in zip(("color", "transmittance", "gains"), gradients, strict=True):
        for place in np.random.default_rng(1).permutation(numbers[name].size)[:40]:
            values = []
            for sign in (1, -1):
                moved = numbers[name].copy()
                step = 1e-6 * max(moved.flat[place], 1e-2)
                moved.flat[place] += sign * step
                values.append(reference({**numbers, name: moved}))
            slope = (values[0] - values[1]) / (2 * step)
            assert gradient.flat[place] == pytest.approx(slope, rel=2e-3, abs=1e-6), (name, place)


def test_what_is_brighter_than_white_is_still_taught():
    """A picture of eight bits has no gradient there."""
    numbers = pictures(np.random.default_rng(2))
    numbers |= {"color": np.full((3, PIXELS), 2 / PEAK), "radiance": np.full((3, PIXELS), 8 / PEAK / FACTOR)}
    numbers |= {"valid": np.ones(PIXELS, bool), "alpha": np.full(PIXELS, 255), "gains": np.ones(3)}
    numbers["transmittance"] = np.zeros(PIXELS)
    for ssim in (0.0, 0.2):
        _, (by_color, _, by_gains) = found(numbers, ssim)
        assert by_color.max() < 0
        assert by_gains.max() < 0


def test_squares_have_the_mean_radiance():
    planes = np.random.default_rng(3).uniform(0, 900, (3, 6, 8))
    radiance = [upload(plane.ravel()) for plane in planes]
    means = truth_of_squares({"radiance": radiance}, (8, 6), 2)["radiance"]
    expected = planes.reshape(3, 3, 2, 4, 2).mean(axis=(2, 4))
    np.testing.assert_allclose(np.array(means).reshape(3, 3, 4), expected, rtol=1e-6)


def test_views_have_the_radiance_of_the_files(small_lit_dataset):
    views = TrainingViews(small_lit_dataset, 0, truth=("radiance",))
    frame = small_lit_dataset.train[2]
    layers = read_exr(small_lit_dataset.root / frame.gt_path)
    np.testing.assert_array_equal(np.stack(views[2].truth["radiance"], axis=-1), layers["radiance"].reshape(-1, 3))
    alpha = views[2].rgba >> 24
    np.testing.assert_array_equal(alpha, np.rint(255 * np.clip(layers["alpha"], 0, 1)).ravel())
    assert not views[2].opaque


def test_data_without_radiance_is_one_sentence(small_lit_dataset, tmp_path):
    lacking = replace(small_lit_dataset, train=tuple(replace(f, gt_path=None) for f in small_lit_dataset.train))
    expected = r"expected path-traced radiance \(gt_path\) in every training frame, found none in images/train_00000"
    with pytest.raises(InputError, match=expected):
        train(lacking, tmp_path / "run", config())
    frame = small_lit_dataset.train[0]
    layers = read_exr(small_lit_dataset.root / frame.gt_path)
    layers["radiance"][3, 4, 1] = np.inf
    write_exr(tmp_path / "gt.exr", layers)
    broken = replace(frame, gt_path=str(tmp_path / "gt.exr"))
    views = TrainingViews(replace(small_lit_dataset, train=(broken,)), 0, truth=("radiance",))
    with pytest.raises(InputError, match=r"gt\.exr: expected finite radiance"):
        views[0]


def test_values_that_are_no_light_know_no_radiance():
    with pytest.raises(InputError, match=r"radiance: expected linear colours \(light.linear = true\), found sRGB"):
        LightConfig(FIELD, radiance=True)


def test_a_run_shows_light_beyond_white(small_lit_dataset, tmp_path):
    scene = {"exposure": 4 * STANDARD_EXPOSURE, "config": {"camera": {"tone": "filmic"}}}
    dataset, frame = replace(small_lit_dataset, scene=MappingProxyType(scene)), small_lit_dataset.test[0]
    run = train(dataset, tmp_path / "run", config(shadow=ShadowConfig()))
    assert json.loads((run.path / "config.json").read_text())["light"]["radiance"] is True
    assert run.curve == ("filmic", 2.0, PEAK)
    seen = run.predict(frame.camera, frame.sun)
    np.testing.assert_allclose(seen.rgb, display_values(seen.linear, "filmic"), atol=1e-5)
    darker = run.predict(frame.camera, frame.sun, exposure=0.0)
    np.testing.assert_allclose(darker.linear, seen.linear / 4, rtol=1e-6)
    brighter = run.predict(frame.camera, frame.sun, exposure=12.0)
    assert brighter.linear.max() > 2 * WHITES["filmic"]
    assert brighter.rgb.max() == pytest.approx(1, abs=1e-6)
    np.testing.assert_array_equal(run.render(frame.camera, frame.sun).linear, seen.linear)
    write_picture(seen, "rgb", tmp_path / "seen.exr")
    layers = read_exr(tmp_path / "seen.exr")
    assert set(layers) == {"linear"}
    np.testing.assert_array_equal(layers["linear"], seen.linear)
    suns = suns_around(2)
    sweep(run, frame.camera, suns, tmp_path / "sweep", keep_frames=True)
    kept = read_exr(tmp_path / "sweep/frames/0001.exr")["linear"]
    np.testing.assert_array_equal(kept, run.predict(frame.camera, suns[1]).linear)
    sweep(run, frame.camera, suns, tmp_path / "shadows", "shadow", keep_frames=True)
    assert not list((tmp_path / "shadows").rglob("*.exr"))


@pytest.mark.parametrize("linear", [True, False])
def test_a_run_of_pictures_shows_light_if_it_has_any(small_lit_dataset, tmp_path, linear):
    light = LightConfig(FIELD, linear=linear)
    run, frame = train(small_lit_dataset, tmp_path / "run", replace(config(), light=light)), small_lit_dataset.test[0]
    seen = run.predict(frame.camera, frame.sun)
    assert (seen.linear is not None) == linear
    write_picture(seen, "rgb", tmp_path / "seen.exr")
    layers = read_exr(tmp_path / "seen.exr")
    if linear:
        np.testing.assert_allclose(display_values(layers["linear"], "srgb"), seen.rgb, atol=1e-5)
    else:
        np.testing.assert_array_equal(layers["rgb"], seen.rgb)


def test_training_learns_what_pictures_clip(small_lit_dataset, tmp_path):
    """Exposed 4 EV too long, most that the Sun lights is white in a picture of eight bits, and no brighter."""
    settings = {"light.linear": True, "light.radiance": True, "light.exposure": 4.0, "exposure_per_picture": True}
    trained = with_settings(preset("demo", "relight"), {"iterations": 600, "init_count": 400, **settings})
    run = train(small_lit_dataset, tmp_path / "run", trained)
    frame = small_lit_dataset.train[0]
    truth = read_exr(small_lit_dataset.root / frame.gt_path)
    light = 16 * STANDARD_EXPOSURE * truth["radiance"]
    bright = light.max(axis=-1) > 2
    seen = run.predict(frame.camera, frame.sun).linear
    assert bright.sum() > 20
    assert seen[bright].mean() > 1.2
    np.testing.assert_allclose(srgb_from_linear(seen), run.predict(frame.camera, frame.sun).rgb, atol=1e-5)
