"""Coarse to fine: squares of pixels against numpy, and training that begins with them."""

from dataclasses import replace

import numpy as np
import pytest

from spacesim.backend import ad, recordings
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.images import linear_from_srgb, load_image, srgb_from_linear
from spacesim.splat.raster.project import Pinhole
from spacesim.splat.raster.render import render
from spacesim.splat.train.async_lists import TrainingPairs
from spacesim.splat.train.config import TrainConfig, preset
from spacesim.splat.train.downscale import covered_color, truth_of_squares, valid_squares
from spacesim.splat.train.stages import LossSettings, TargetImage, picture_loss
from spacesim.splat.train.strategies.control import DensificationConfig
from spacesim.splat.train.trainer import Trainer
from spacesim.splat.train.view_pass import ViewPass
from spacesim.splat.train.warm_start import WarmStartConfig

SIZE = WIDTH, HEIGHT = 11, 9  # 4 squares of 2 pixels a side fill neither, nor does one of 4


def numbers(value) -> np.ndarray:
    return np.array(value, dtype=np.float64)


@pytest.fixture(scope="module")
def bytes_() -> np.ndarray:
    """[H, W, 4]: half of the pixels have no alpha, and are white."""
    pixels = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 4), dtype=np.uint8)
    pixels[np.indices((HEIGHT, WIDTH)).sum(axis=0) % 2 == 0] = 255, 255, 255, 0
    return pixels


def packed(pixels: np.ndarray):
    return upload(np.ascontiguousarray(pixels).reshape(-1, 4).view("<u4").ravel(), ad.UInt32)


def squares(values: np.ndarray, times: int) -> np.ndarray:
    """[H, W, ...] to [H // times, W // times, times^2, ...]."""
    height, width = values.shape[0] // times, values.shape[1] // times
    cut = values[: height * times, : width * times].reshape(height, times, width, times, *values.shape[2:])
    return np.moveaxis(cut, 2, 1).reshape(height, width, times**2, *values.shape[2:])


# What pictures become


@pytest.mark.parametrize("times", [1, 2, 4])
@pytest.mark.parametrize("tone", [None, "srgb"])
def test_a_pixel_is_the_mean_of_its_square_times_alpha(bytes_, times, tone):
    """What is white and has no alpha shows in no square."""
    straight, alpha = bytes_[..., :3] / 255, bytes_[..., 3:] / 255
    shown = (linear_from_srgb(straight) if tone else straight) * alpha
    color, found = covered_color(packed(bytes_), SIZE, times, tone)
    np.testing.assert_allclose(numbers(color).T, squares(shown, times).mean(axis=2).reshape(-1, 3), atol=2e-6)
    np.testing.assert_allclose(numbers(found), squares(alpha, times).mean(axis=2).ravel(), atol=1e-6)


def test_beside_supersampled_pictures_light_is_averaged(bytes_):
    """As their pixels are: sRGB values of the mean light, times the mean alpha."""
    straight, alpha = squares(bytes_[..., :3] / 255, 2), squares(bytes_[..., 3:] / 255, 2)
    share = alpha.mean(axis=2)
    light = (linear_from_srgb(straight) * alpha).mean(axis=2) / np.maximum(share, 1e-9)
    color, _ = covered_color(packed(bytes_), SIZE, 2, light=True)
    np.testing.assert_allclose(numbers(color).T, (srgb_from_linear(light) * share).reshape(-1, 3), atol=2e-6)


def test_truth_of_squares_by_hand():
    """Two squares of 2 x 2: the first has three pixels of surface, the second none."""
    size = (4, 2)
    surface = [1, 1, 0, 0, 1, 0, 0, 0]
    truth = {
        "visibility": [ad.Float([1.0, 0.5, -1, -1, 0.0, -1, -1, -1])],
        "depth": [ad.Float([2.0, 3.0, 0, 0, 7.0, 0, 0, 0])],
        "normal": [ad.Float([v * s for v, s in zip((1, 0, 0, 0, 0, 0, 0, 0), surface, strict=True)]), None, None],
        "foreground": [upload(np.array(surface, bool), ad.Bool), ad.Float([0.5])],
    }
    truth["normal"][1:] = [ad.Float([0.0, 0, 0, 0, 1, 0, 0, 0]), ad.Float([0.0, 1, 0, 0, 0, 0, 0, 0])]
    found = truth_of_squares(truth, size, 2)
    np.testing.assert_allclose(numbers(found["visibility"][0]), [1.5 / 4, -1])
    np.testing.assert_allclose(numbers(found["depth"][0]), [4, 0])
    np.testing.assert_allclose(numbers(found["normal"]), np.array([[1, 0]] * 3) / np.sqrt(3), rtol=1e-6)
    assert np.array(found["foreground"][0]).tolist() == [True, False]
    assert found["foreground"][1] is truth["foreground"][1]
    valid = upload(np.array([1, 1, 1, 1, 1, 1, 0, 1], bool), ad.Bool)
    assert np.array(valid_squares(valid, size, 2)).tolist() == [True, False]
    assert numbers(valid_squares(ad.Bool(True), size, 2)).tolist() == [1]


@pytest.mark.parametrize("tone", [None, "srgb"])
def test_the_loss_compares_with_squares_over_any_background(bytes_, tone):
    below = np.array([0.9, 0.1, 0.4])
    color, alpha = covered_color(packed(bytes_), SIZE, 2, tone)
    target = TargetImage(packed(bytes_), ad.Float(below.tolist()), ad.Bool(True), {})
    config = LossSettings(0.2, 0.0, 0.0, 0.0, 1.0, tone, downscale=2)
    for shift, wrong in ((0.0, False), (0.1, True)):
        planes = {"color": [plane + shift for plane in color]}
        loss, _, _ = picture_loss(planes, 1 - alpha, target, SIZE, config)
        assert (numbers(loss)[0] > 0.01) == wrong
        assert wrong or numbers(loss)[0] < 1e-5


# In training

REFINEMENT = DensificationConfig(
    refine_start=5, refine_every=10, pause_after_reset=0, refine_stop=40, screen_size_stop=0
)
CONFIG = TrainConfig(iterations=60, num_downscales=2, resolution_schedule=10, refinement=REFINEMENT, init_count=300)


def test_the_schedule_is_splatfactos():
    assert [CONFIG.downscale(step) for step in (0, 9, 10, 19, 20, 10**6)] == [4, 4, 2, 2, 1, 1]
    assert {preset(name).num_downscales for name in ("demo", "fast", "fine")} == {0}
    thesis = preset("thesis")
    assert [thesis.downscale(step) for step in (2_999, 3_000, 6_000)] == [4, 2, 1]


def test_pictures_grow_and_nothing_is_recorded_but_at_a_change(small_dataset, monkeypatch):
    frozen = replace(REFINEMENT, refine_start=10**6, refine_stop=10**6 + 1)
    trainer = Trainer(small_dataset, replace(CONFIG, refinement=frozen, sh_degree=0))
    trainer._view_pass.pairs = TrainingPairs(())  # without waits there are recordings of their own
    sizes, made, forward = [], [], ViewPass.forward

    def watched(self, *given):
        drawn = forward(self, *given)
        sizes.append((drawn.camera.width, drawn.camera.height))
        return drawn

    monkeypatch.setattr(ViewPass, "forward", watched)
    for _ in range(30):
        known = recordings()
        trainer.step()
        made.append(recordings() - known)
    side = small_dataset.train[0].camera.width
    assert sizes == [(side // times,) * 2 for times in (4, 2, 1) for _ in range(10)]
    assert [step for step in range(30) if made[step] and step % 10 > 4] == []  # lists that grow are recorded anew, too
    assert made[10] > 0
    assert made[20] > 0


def test_coarse_pictures_teach_what_fine_ones_show(small_dataset):
    """Never of more than a half of their side."""

    def error(trainer: Trainer) -> float:
        found = []
        for frame in small_dataset.test:
            drawn = numbers(render(trainer.gaussians, Pinhole.of(frame.camera)).color).T
            truth = load_image(small_dataset, frame).over(np.zeros(3)).reshape(-1, 3)
            found.append(np.mean((np.clip(drawn, 0, 1) - truth) ** 2))
        return float(np.mean(found))

    trainer = Trainer(small_dataset, replace(CONFIG, num_downscales=1, resolution_schedule=1_000, iterations=100))
    before = error(trainer)
    trainer.run(lambda progress: None, lambda: None)
    assert error(trainer) < 0.5 * before


def everything() -> TrainConfig:
    """Every plane that a loss reads, a warm start, and supersampling."""
    config = replace(preset("demo", "shadow-map"), iterations=14, init_count=60, supersample=2)
    weights = {"visibility_weight": 0.1, "depth_weight": 0.1, "normal_weight": 0.1}
    warm = WarmStartConfig(steps=6, decay=6, conservative=3)
    return replace(config, num_downscales=2, resolution_schedule=4, warm_start=warm, **weights)


def test_resume_goes_on_across_a_change_of_size(small_lit_dataset, tmp_path):
    config = everything()
    straight = Trainer(small_lit_dataset, config)
    for done in range(1, 15):
        straight.step()
        if done in (3, 4, 7):
            straight.save(tmp_path / f"at_{done}")
    for done in (3, 4, 7):
        resumed = Trainer(small_lit_dataset, TrainConfig.from_json(config.to_json()))
        resumed.restore(tmp_path / f"at_{done}")
        while resumed.iteration < 14:
            resumed.step()
        for name, value in straight.gaussians.to_numpy().items():
            np.testing.assert_array_equal(value, resumed.gaussians.to_numpy()[name], err_msg=f"{name} from {done}")


def test_pictures_of_full_size_teach_what_they_teach_without_it(small_lit_dataset, tmp_path):
    """To the bit: from one checkpoint, after the last change of size."""
    config = everything()
    coarse = Trainer(small_lit_dataset, config)
    for _ in range(8):
        coarse.step()
    coarse.save(tmp_path / "at_8")
    plain = Trainer(small_lit_dataset, replace(config, num_downscales=0))
    plain.restore(tmp_path / "at_8")
    for trainer in (coarse, plain):
        for _ in range(4):
            trainer.step()
    for name, value in coarse.gaussians.to_numpy().items():
        np.testing.assert_array_equal(value, plain.gaussians.to_numpy()[name], err_msg=name)


def test_impossible_downscales_are_refused(small_dataset):
    tiny = tuple(replace(frame, camera=frame.camera.downscaled(16)) for frame in small_dataset.train)
    with pytest.raises(InputError, match="num_downscales: expected pictures of at least 4 pixels a side, found 2x2"):
        Trainer(replace(small_dataset, train=tiny), CONFIG)
    with pytest.raises(InputError, match="num_downscales: expected 0 to 4"):
        replace(CONFIG, num_downscales=9)
    with pytest.raises(InputError, match="resolution_schedule: expected 1 to"):
        replace(CONFIG, resolution_schedule=0)
