"""Linear colours to pictures and back: the tone curves against float64 references, exposures of trained runs."""

import json
from dataclasses import replace
from types import MappingProxyType

import drjit as dr
import numpy as np
import pytest

from spacesim.backend import ad
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.images import linear_from_srgb
from spacesim.data.images.tone import STANDARD_EXPOSURE, TONES, WHITES, display_values, tone_and_exposure
from spacesim.scenes.lights.sun import EXPOSURE
from spacesim.splat.light.config import LightConfig
from spacesim.splat.light.field import FieldConfig
from spacesim.splat.raster.tone import adjust_exposure, inverse_tone_map, tone_map
from spacesim.splat.train.config import TrainConfig
from spacesim.splat.train.stages import LossSettings, TargetImage, picture_loss
from spacesim.splat.train.train import train


def curve(v: np.ndarray, tone: str) -> np.ndarray:
    """sRGB values of linear display values, from the formulas, in float64."""
    v = np.maximum(np.asarray(v, np.float64), 0)
    t = np.clip(v * (2.51 * v + 0.03) / (v * (2.43 * v + 0.59) + 0.14) if tone == "filmic" else v, 0, 1)
    return np.where(t <= 0.0031308, 12.92 * t, 1.055 * t ** (1 / 2.4) - 0.055)


def test_white_is_where_the_curve_reaches_one():
    # v (2.51 v + 0.03) = v (2.43 v + 0.59) + 0.14
    assert WHITES["filmic"] == pytest.approx(max(np.roots([2.51 - 2.43, 0.03 - 0.59, -0.14]).real), rel=1e-12)
    assert WHITES["srgb"] == 1
    assert set(WHITES) == set(TONES)
    assert STANDARD_EXPOSURE == EXPOSURE  # a scene's camera, as it comes, is at 0 EV


@pytest.mark.parametrize("tone", TONES)
def test_curves_equal_their_twins_and_their_inverses_undo_them(tone):
    light = np.concatenate([[0, 1e-5, 1e-4], np.linspace(0.001, 1, 500)])
    found = np.array(tone_map(upload(light), tone))
    np.testing.assert_allclose(found, curve(WHITES[tone] * light, tone), atol=3e-6)
    np.testing.assert_allclose(found, display_values(WHITES[tone] * light, tone), atol=3e-6)
    np.testing.assert_allclose(found, adjust_exposure(light, tone), atol=3e-6)
    values = np.linspace(0, 1, 256)
    back = np.array(inverse_tone_map(upload(values), tone), np.float64)
    assert back[0] == 0
    assert back[-1] == pytest.approx(1, abs=1e-5)
    np.testing.assert_allclose(curve(WHITES[tone] * back, tone), values, atol=2e-5)
    assert np.all(np.diff(found) > 0)


@pytest.mark.parametrize("tone", TONES)
def test_slopes_equal_central_differences(tone):
    light = np.linspace(0.01, 0.97, 60)
    color = upload(light)
    dr.enable_grad(color)
    dr.backward(dr.sum(tone_map(color, tone)))
    step = 1e-6
    slope = (curve(WHITES[tone] * (light + step), tone) - curve(WHITES[tone] * (light - step), tone)) / (2 * step)
    np.testing.assert_allclose(np.array(dr.grad(color)), slope, rtol=1e-3)


@pytest.mark.parametrize("tone", TONES)
def test_more_exposure_is_more_light(tone):
    light = np.linspace(0, 0.9, 50)
    for stops in (-3.0, -1.0, 0.5, 2.0):
        expected = curve(2**stops * WHITES[tone] * light, tone)
        np.testing.assert_allclose(adjust_exposure(light, tone, stops), expected, atol=1e-6)


@pytest.mark.parametrize("tone", TONES)
def test_any_exposure_ends_at_white(tone):
    light = np.array([0, 1e-6, 0.5, 1], np.float32)
    np.testing.assert_allclose(adjust_exposure(light, tone, 80.0), [0, 1, 1, 1], atol=1e-6)
    assert adjust_exposure(light, tone, -80.0).max() < 1e-6


@pytest.mark.parametrize("tone", TONES)
def test_loss_blends_light_and_compares_pictures(tone):
    """A picture that is half covered by a known colour, over a known background: no loss where light is mixed as it
    should be, and a loss where sRGB values would have been mixed."""
    config = LossSettings(ssim=0.0, visibility=0.0, depth=0.0, normal=0.0, scale=1.0, tone=tone)
    color, alpha, below = np.array([200, 90, 30]), 128, np.array([0.2, 0.9, 0.5])
    packed = int(color[0]) | int(color[1]) << 8 | int(color[2]) << 16 | alpha << 24
    target = TargetImage(ad.UInt32([packed] * 256), ad.Float(below), ad.Bool(True), {})
    share = alpha / 255
    wanted = np.array(inverse_tone_map(upload(color / 255), tone)) * share
    planes = {"color": [ad.Float([value] * 256) for value in wanted]}
    loss, _, _ = picture_loss(planes, ad.Float([1 - share] * 256), target, (16, 16), config)
    assert np.array(loss)[0] == pytest.approx(0, abs=2e-6)
    mixed = np.array(inverse_tone_map(upload(color / 255 * share + (1 - share) * below), tone))
    behind = np.array(inverse_tone_map(upload(below), tone)) * (1 - share)
    planes = {"color": [ad.Float([value] * 256) for value in mixed - behind]}
    loss, _, _ = picture_loss(planes, ad.Float([1 - share] * 256), target, (16, 16), config)
    assert np.array(loss)[0] > 0.01


def scene(tone: str, exposure: float) -> MappingProxyType:
    return MappingProxyType({"exposure": exposure, "config": {"camera": {"tone": tone}}})


@pytest.mark.parametrize(
    ("described", "found"),
    [
        (scene("filmic", 4 * STANDARD_EXPOSURE), ("filmic", 2.0)),
        (scene("srgb", STANDARD_EXPOSURE / 2), ("srgb", -1.0)),
        (scene("unknown", 1.0), None),
        (scene("srgb", 0.0), None),
        ({"exposure": "much", "config": {"camera": {"tone": "srgb"}}}, None),
        ({}, None),
    ],
)
def test_a_dataset_tells_how_its_pictures_were_made(described, found):
    assert tone_and_exposure(described) == found


def linear(**options) -> TrainConfig:
    light = LightConfig(FieldConfig(features=4, width=8), linear=True, **options)
    return TrainConfig(light=light, iterations=3, init_count=100)


def test_a_run_takes_tone_and_exposure_of_its_data_and_can_be_exposed_anew(small_lit_dataset, tmp_path):
    dataset, frame = replace(small_lit_dataset, scene=scene("filmic", 4 * STANDARD_EXPOSURE)), small_lit_dataset.test[0]
    run = train(dataset, tmp_path / "own", linear())
    kept = json.loads((run.path / "config.json").read_text())["light"]
    assert (kept["tone"], kept["exposure"]) == ("filmic", 2.0)
    assert run.curve == ("filmic", 2.0, WHITES["filmic"])
    assert train(dataset, tmp_path / "own", linear(), resume=True).curve == run.curve
    as_taken = run.predict(frame.camera, frame.sun)
    np.testing.assert_array_equal(run.predict(frame.camera, frame.sun, exposure=2.0).rgb, as_taken.rgb)
    darker = run.predict(frame.camera, frame.sun, exposure=-1.0).rgb
    light = inverse_tone_map(upload(as_taken.rgb.ravel()), "filmic")
    expected = curve(WHITES["filmic"] * np.array(light, np.float64) / 8, "filmic").reshape(darker.shape)
    np.testing.assert_allclose(darker, expected, atol=1e-3)
    assert darker.mean() < 0.9 * as_taken.rgb.mean()
    given = train(dataset, tmp_path / "given", linear(tone="srgb", exposure=0.5))
    assert given.curve == ("srgb", 0.5, 1)
    with pytest.raises(InputError, match="exposure: expected -40 to 40 EV, found nan"):
        given.predict(frame.camera, frame.sun, exposure=float("nan"))
    plain = train(small_lit_dataset, tmp_path / "plain", linear())
    assert plain.curve == ("srgb", 0.0, 1)
    doubled = plain.predict(frame.camera, frame.sun, exposure=1.0).rgb
    once = linear_from_srgb(plain.predict(frame.camera, frame.sun).rgb)
    np.testing.assert_allclose(linear_from_srgb(doubled), np.minimum(2 * once, 1), atol=1e-4)


def test_tone_changes_what_is_learned(small_lit_dataset, tmp_path):
    runs = [train(small_lit_dataset, tmp_path / tone, linear(tone=tone)) for tone in TONES]
    frame = small_lit_dataset.test[0]
    one, other = (run.predict(frame.camera, frame.sun).rgb for run in runs)
    assert np.abs(one - other).max() > 0.02


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"linear": False, "tone": "filmic"}, "tone: expected linear colours"),
        ({"linear": False, "exposure": 1.0}, "exposure: expected linear colours"),
        ({"linear": True, "tone": "aces"}, "tone: expected one of srgb, filmic, found 'aces'"),
        ({"linear": True, "exposure": float("nan")}, "exposure: expected -40 to 40 EV, found nan"),
        ({"linear": True, "exposure": 99.0}, "exposure: expected -40 to 40 EV, found 99.0"),
    ],
)
def test_wrong_developments_are_one_sentence(options, sentence):
    with pytest.raises(InputError, match=sentence):
        LightConfig(**options)


def test_values_that_are_no_light_have_no_exposure(small_lit_dataset, tmp_path):
    light = LightConfig(FieldConfig(features=4, width=8))
    run = train(small_lit_dataset, tmp_path / "run", replace(linear(), light=light))
    frame = small_lit_dataset.test[0]
    with pytest.raises(
        InputError,
        match=r"exposure: expected a run trained in linear light \(light.linear\), found .*run, trained without it",
    ):
        run.predict(frame.camera, frame.sun, exposure=0.0)
