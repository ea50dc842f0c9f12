"""Pixels as mean light: against numpy in float64, by differences, and through training, runs and scenes."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from splats import light_of, random_splats, srgb_of

from spacesim.backend import ad
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at
from spacesim.data.images import linear_from_srgb, srgb_from_linear
from spacesim.data.records import Camera
from spacesim.splat.compose.scene import GaussianComposition, PlacedRun
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.output import OUTPUTS
from spacesim.splat.raster.render import render
from spacesim.splat.raster.supersample import pixel_means, render_supersampled, upsampled_camera
from spacesim.splat.raster.tone import adjust_exposure
from spacesim.splat.train.config import TrainConfig, preset
from spacesim.splat.train.stages import LossSettings, TargetImage, picture_loss
from spacesim.splat.train.train import train
from spacesim.splat.train.trainer import Trainer
from spacesim.splat.train.warm_start import WarmStart, WarmStartConfig

WIDTH, HEIGHT = 5, 3
EYE = Camera(look_at([0, -4, 0.5], [0, 0, 0]), 9, 7, 12.0, 13.0, 4.2, 3.6)


def numbers(plane) -> np.ndarray:
    return np.array(plane, dtype=np.float64)


def boxes(plane: np.ndarray, times: int) -> np.ndarray:
    """[height, width] means of squares of [times * height, times * width, ...]."""
    height, width = plane.shape[0] // times, plane.shape[1] // times
    return plane.reshape(height, times, width, times, *plane.shape[2:]).mean(axis=(1, 3))


def mean_light(color: np.ndarray, alpha: np.ndarray, times: int) -> np.ndarray:
    """Premultiplied sRGB values [h, w, 3], beyond 1 too: the light of straight colours, averaged with the alphas."""
    straight = np.divide(color, alpha[..., None], out=np.zeros_like(color), where=alpha[..., None] > 0)
    whole = boxes(alpha, times)[..., None]
    light = boxes(alpha[..., None] * light_of(straight), times)
    return whole * srgb_of(np.divide(light, whole, out=np.zeros_like(light), where=whole > 0))


def planes(times: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(premultiplied colours [h, w, 3], alpha [h, w], another plane), some places empty, some opaque."""
    rng = np.random.default_rng(seed)
    shape = times * HEIGHT, times * WIDTH
    alpha = rng.uniform(0.05, 1, shape) * (rng.uniform(size=shape) > 0.2)
    alpha[0, :3] = 1
    return alpha[..., None] * rng.uniform(size=(*shape, 3)), alpha, rng.normal(size=shape)


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("times", [2, 3])
def test_pixels_are_the_mean_light_of_their_places(times, linear):
    color, alpha, other = planes(times)
    groups = {"color": [upload(c.ravel()) for c in np.moveaxis(color, -1, 0)], "depth": [upload(other.ravel())]}
    found, passed = pixel_means(groups, upload(1 - alpha.ravel()), (WIDTH, HEIGHT), times, linear)
    shape = HEIGHT, WIDTH
    expected = boxes(color, times) if linear else mean_light(color, alpha, times)
    drawn = np.stack([numbers(plane).reshape(shape) for plane in found["color"]], axis=-1)
    np.testing.assert_allclose(drawn, expected, atol=2e-6)
    np.testing.assert_allclose(numbers(found["depth"][0]).reshape(shape), boxes(other, times), atol=1e-6)
    np.testing.assert_allclose(1 - numbers(passed).reshape(shape), boxes(alpha, times), atol=1e-6)


def test_half_of_a_white_pixel_in_shadow_has_half_of_its_light():
    white = [ad.Float([1, 0, 1, 0]) for _ in range(3)]
    found, passed = pixel_means({"color": white}, ad.Float([0, 0, 0, 0]), (1, 1), 2, linear=False)
    assert numbers(found["color"][0]) == pytest.approx(srgb_from_linear(np.array([0.5])), abs=1e-6)
    assert numbers(passed) == 0


@pytest.mark.parametrize("linear", [False, True])
def test_gradients_are_those_of_the_mean_light(linear):
    color, alpha, _ = planes(2, seed=3)
    alpha, color = np.maximum(alpha, 0.05), np.maximum(color, 0.01)
    rng = np.random.default_rng(4)
    grad_color, grad_passed = rng.normal(size=(3, HEIGHT * WIDTH)), rng.normal(size=HEIGHT * WIDTH)

    def loss(color: np.ndarray, alpha: np.ndarray) -> float:
        pixels = boxes(color, 2) if linear else mean_light(color, alpha, 2)
        along = (np.moveaxis(pixels, -1, 0).reshape(3, -1) * grad_color).sum()
        return float(along + ((1 - boxes(alpha, 2)).ravel() * grad_passed).sum())

    given = [upload(c.ravel()) for c in np.moveaxis(color, -1, 0)]
    passed = upload(1 - alpha.ravel())
    dr.enable_grad(given, passed)
    found, whole = pixel_means({"color": given}, passed, (WIDTH, HEIGHT), 2, linear)
    parts = [dr.sum(p * upload(g)) for p, g in zip(found["color"], grad_color, strict=True)]
    dr.backward(sum(parts, dr.sum(whole * upload(grad_passed))))
    for _ in range(4):
        steps = rng.normal(size=color.shape), rng.normal(size=alpha.shape)
        h = 1e-6
        ends = [loss(color + sign * h * steps[0], alpha + sign * h * steps[1]) for sign in (1, -1)]
        slope = sum(numbers(dr.grad(g)) @ steps[0][..., c].ravel() for c, g in enumerate(given))
        slope -= numbers(dr.grad(passed)) @ steps[1].ravel()
        assert slope == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=2e-3, abs=2e-3)


@pytest.mark.parametrize("times", [1, 2, 3])
def test_a_supersampled_picture_is_made_of_a_wider_one(times):
    splats = Gaussians.from_numpy(random_splats(60, seed=1))
    features = [upload(np.random.default_rng(2).uniform(size=60).astype(np.float32)) for _ in range(2)]

    def draw(camera):
        return render(splats, camera, outputs=OUTPUTS, features=features, antialiased=True)

    wide, found = draw(Pinhole.of(upsampled_camera(EYE, times))), render_supersampled(draw, EYE, times)
    assert (found.width, found.height) == (EYE.width, EYE.height)
    alpha = numbers(wide.image("alpha"))
    whole = boxes(alpha, times)
    np.testing.assert_allclose(found.image("alpha"), whole, atol=1e-6)
    np.testing.assert_allclose(found.image("features"), boxes(numbers(wide.image("features")), times), atol=1e-6)
    expected = mean_light(numbers(wide.image("color")), alpha, times) if times > 1 else wide.image("color")
    np.testing.assert_allclose(found.image("color"), expected, atol=5e-6)
    depth = boxes(numbers(wide.image("depth")) * alpha, times) / np.maximum(whole, 1e-9)
    np.testing.assert_allclose(found.image("depth"), depth, rtol=1e-5, atol=1e-6)
    length = np.linalg.norm(found.image("normal"), axis=-1)
    assert np.all((np.abs(length - 1) < 1e-5) | (length == 0))
    median = numbers(wide.image("median_depth"))
    known = boxes(1.0 * (median > 0), times)
    expected = np.where(known >= 0.5, boxes(median, times) / np.maximum(known, 0.5), 0)
    np.testing.assert_allclose(found.image("median_depth"), expected, rtol=1e-6)


def test_one_pixel_is_drawn_like_any_other():
    splats = Gaussians.from_numpy(random_splats(60, seed=1))
    camera = Camera(EYE.world_from_camera, 1, 1, 3.0, 3.0, 0.5, 0.5)
    found = render_supersampled(lambda seen: render(splats, seen), camera, 2)
    assert found.image("color").shape == (1, 1, 3)
    wide = render(splats, Pinhole.of(upsampled_camera(camera, 2)))
    expected = mean_light(numbers(wide.image("color")), numbers(wide.image("alpha")), 2)
    np.testing.assert_allclose(found.image("color"), expected, atol=2e-6)


def test_the_finer_camera_sees_the_same():
    point = np.array([0.3, 0.2, -0.1, 1])
    for times in (2, 4):
        seen = upsampled_camera(EYE, times)
        places = []
        for camera in (EYE, seen):
            x, y, z, _ = camera.camera_from_world @ point
            places.append(np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy]))
        np.testing.assert_allclose(places[1], times * places[0])
        assert (seen.width, seen.height) == (times * EYE.width, times * EYE.height)


@pytest.mark.parametrize("method", ["vanilla", "shadow-splat", "linear"])
def test_a_run_and_a_scene_of_it_draw_the_same(small_lit_dataset, tmp_path, method):
    linear = method == "linear"
    config = replace(preset("demo", "relight" if linear else method), iterations=4, init_count=60, supersample=2)
    if linear:
        config = replace(config, light=replace(config.light, linear=True, tone="srgb"))
    run = train(small_lit_dataset, tmp_path / "run", config)
    assert run.supersample == 2
    frame = small_lit_dataset.test[0]
    alone = run.predict(frame.camera, frame.sun, normals=True)
    single = replace(run, config={**run.config, "supersample": 1})
    wide = single.predict(upsampled_camera(frame.camera, 2), frame.sun)
    expected = mean_light(numbers(wide.rgb), numbers(wide.alpha), 2)
    if linear:  # what is blended is light over black
        expected = srgb_from_linear(boxes(linear_from_srgb(numbers(wide.rgb)), 2))
    np.testing.assert_allclose(alone.rgb, expected, atol=5e-6)
    scene = GaussianComposition([PlacedRun(run)])
    assert scene.supersample == 2
    composed = scene.predict(frame.camera, frame.sun, normals=True)
    for name in ("rgb", "alpha", "depth", "visibility", "normal"):
        np.testing.assert_array_equal(getattr(alone, name), getattr(composed, name), err_msg=name)
    for name in ("id", "visibility", "median_depth"):
        drawn = scene.draw(frame.camera, frame.sun, [name])
        if name != "visibility" or name in drawn.planes:
            assert np.isfinite(drawn.image(name)).all()
            assert drawn.image(name).shape == (frame.camera.height, frame.camera.width)
    with_both = GaussianComposition([PlacedRun(run), PlacedRun(single)])
    assert with_both.contents[0] != with_both.contents[1], "a picture depends on it"


@pytest.mark.threads
@pytest.mark.parametrize("warm", [False, True])
def test_supersampled_training_repeats_to_the_bit_and_resumes(small_lit_dataset, tmp_path, warm):
    changes = {"warm_start": WarmStartConfig(steps=6, decay=6, conservative=3)} if warm else {}
    config = replace(preset("demo", "shadow-map"), iterations=14, init_count=60, supersample=2, checkpoint_every=8)
    config = replace(config, visibility_weight=0.1, depth_weight=0.1, normal_weight=0.1, **changes)
    runs = [train(small_lit_dataset, tmp_path / name, config) for name in ("one", "two")]
    assert len({(run.path / "model.safetensors").read_bytes() for run in runs}) == 1
    resumed = Trainer(small_lit_dataset, config)
    resumed.restore(tmp_path / "one/checkpoints/step_00000008.safetensors")
    while resumed.iteration < config.iterations:
        resumed.step()
    for name, values in runs[0].gaussians.to_numpy().items():
        np.testing.assert_array_equal(resumed.gaussians.to_numpy()[name], values, err_msg=name)


@pytest.mark.parametrize("tone", [None, "srgb", "filmic"])
def test_training_compares_the_mean_light(tone):
    """An empty picture half lit: its loss by the mean of light, or of what is light already."""
    half = np.tile([1.0, 0.0], 2 * WIDTH * HEIGHT)
    groups = {"color": [upload(half) for _ in range(3)]}
    light = {None: srgb_from_linear(np.array(0.5)), "srgb": srgb_from_linear(np.array(0.5))}
    light["filmic"] = adjust_exposure(np.array(0.5), "filmic")
    for level, same in ((float(light[tone]), True), (0.5, tone == "filmic" and abs(float(light[tone]) - 0.5) < 0.01)):
        byte = round(255 * level)
        rgba = upload(np.full(WIDTH * HEIGHT, byte * 0x10101 + (255 << 24), np.uint32), ad.UInt32)
        target = TargetImage(rgba, ad.Float([0, 0, 0]), ad.Bool(True), {})
        config = LossSettings(0.0, 0.0, 0.0, 0.0, 1.0, tone, 2)
        loss, _, _ = picture_loss(groups, upload(1 - np.ones_like(half)), target, (WIDTH, HEIGHT), config)
        assert (numbers(loss)[0] < 0.004) == same


def test_refinement_watches_the_same_gradients_and_sizes(small_dataset):
    """As shares of the picture, however finely it is drawn."""
    found = []
    for times in (1, 2):
        config = replace(preset("demo"), init_count=200, supersample=times, antialiased=True)
        trainer = Trainer(small_dataset, config)
        trainer.step()
        state = {name: np.array(values) for name, values in trainer.strategy.state.items()}
        visible = state["seen"] > 0
        assert 20 < visible.sum() <= 200
        found.append([state["gradient"][visible].mean(), state["radius"][visible].mean()])
    np.testing.assert_allclose(found[1], found[0], rtol=0.15)


def test_the_warm_start_reads_its_masks_in_the_pixels_of_the_view(small_dataset, monkeypatch):
    config = replace(preset("demo"), init_count=60, supersample=2)
    config = replace(config, warm_start=WarmStartConfig(steps=6, decay=6, conservative=3))
    trainer, sizes, pull = Trainer(small_dataset, config), [], WarmStart.attraction_gradients

    def watched(self, rows, camera, *rest):
        sizes.append((camera.width, camera.height))
        return pull(self, rows, camera, *rest)

    monkeypatch.setattr(WarmStart, "attraction_gradients", watched)
    trainer.step()
    camera = small_dataset.train[0].camera
    assert sizes == [(camera.width, camera.height)]


def test_fine_light_is_drawn_finely():
    for method in ("relight", "shadow-map", "shadow-splat", "park"):
        config, fast = preset("fine", method), preset("fast", method)
        size = 0.008 if method == "shadow-splat" else 0.015
        assert (config.supersample, config.refinement.split_screen_size) == (2, size)
        assert (fast.supersample == 2) == (fast.refinement.split_screen_size == size) == (method[:6] == "shadow")
        assert config.holds_sizes == fast.holds_sizes == (method == "shadow-splat")
        assert (config.views_per_step, config.refinement.max_gaussians) == (
            (2, 100_000) if method[:6] == "shadow" else (1, 250_000)
        )
        assert preset("demo", method).supersample == preset("thesis", method).supersample == 1
    assert preset("fine").supersample == 1
    assert preset("fine", "shadow-map").light.shadow.method.filter == "variance"


def test_pictures_too_large_to_draw_are_named():
    vast = Camera(EYE.world_from_camera, 8000, 8000, 8000, 8000, 4000, 4000)
    with pytest.raises(
        InputError, match=r"supersample: expected pictures of at most 33554432 pixels .*2 times as wide, found 8000x"
    ):
        upsampled_camera(vast, 2)


def test_supersampling_is_1_to_4():
    for times in (0, 5):
        with pytest.raises(InputError, match=f"supersample: expected 1 to 4, found {times}"):
            TrainConfig(supersample=times)
