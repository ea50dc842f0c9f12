"""Warm start: masks, losses and schedule against numpy and by hand; it pulls, it rescues, it resumes. Depth and normals
as losses, from truth and from a mesh."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
import trimesh
from PIL import Image

from spacesim.backend import ad
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at
from spacesim.data.images import load_image
from spacesim.data.mesh import SignedDistance
from spacesim.data.records import Camera
from spacesim.data.store import load_truth
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.project import Pinhole
from spacesim.splat.raster.render import render
from spacesim.splat.train.config import STRATEGIES, TrainConfig, preset, warm_start, with_settings
from spacesim.splat.train.loss.terms import depth_loss, normal_loss, penalty
from spacesim.splat.train.optimizer.adam import Adam
from spacesim.splat.train.prior import MeshPrior
from spacesim.splat.train.start import initial_gaussians, object_size, scene_scale
from spacesim.splat.train.strategies.control import DensificationConfig
from spacesim.splat.train.trainer import Trainer
from spacesim.splat.train.views import TrainingView, TrainingViews
from spacesim.splat.train.warm_start import (
    WarmStart,
    WarmStartConfig,
    bilinear,
    disc,
    distance_image,
    foreground,
    foreground_loss,
    projected_loss,
)

CONFIG = WarmStartConfig()
CAMERA = Camera.from_fov(look_at((0, -4, 0), (0, 0, 0)), 24, 16, 40)


def numbers(value) -> np.ndarray:
    return np.array(value, dtype=np.float64)


def view_of(rgba: np.ndarray, opaque: bool, valid: np.ndarray | None = None) -> TrainingView:
    height, width = rgba.shape[:2]
    camera = Camera.from_fov(look_at((0, -4, 0), (0, 0, 0)), width, height, 40)
    packed = np.ascontiguousarray(rgba.reshape(-1, 4)).view("<u4").ravel()
    return TrainingView(0, camera, None, packed, None if valid is None else valid.ravel(), opaque, {})


# Foreground


def test_foreground_by_luminance_is_dilated():
    rgba = np.zeros((20, 30, 4), np.uint8)
    rgba[..., 3] = 255
    rgba[10, 15, :3] = 0, 12, 0  # 0.7152 * 12 / 255 = 0.034
    rgba[3, 4, :3] = 30, 0, 0  # 0.2126 * 30 / 255 = 0.025
    mask = foreground(view_of(rgba, opaque=True), CONFIG)
    rows, columns = np.indices(mask.shape)
    np.testing.assert_array_equal(mask, (rows - 10) ** 2 + (columns - 15) ** 2 <= 9)
    assert foreground(view_of(rgba, opaque=True), replace(CONFIG, dilation=0)).sum() == 1
    assert not foreground(view_of(np.zeros_like(rgba), opaque=True), CONFIG).any()
    assert disc(1).sum() == 5


def test_foreground_by_alpha_is_what_is_there():
    rgba = np.zeros((6, 8, 4), np.uint8)
    rgba[2:4, 3:6, 3] = 255  # black, but there
    rgba[0, 0] = 255, 255, 255, 100
    np.testing.assert_array_equal(foreground(view_of(rgba, opaque=False), CONFIG), rgba[..., 3] == 255)
    valid = np.ones((6, 8), bool)
    valid[:, 4:] = False
    found = foreground(view_of(rgba, opaque=False, valid=valid), CONFIG)
    np.testing.assert_array_equal(found, (rgba[..., 3] == 255) & valid)


def test_foreground_by_luminance_of_pictures_with_alpha():
    """5.24 as printed, over black: what is black but there is none, nor is light that is hardly there."""
    rgba = np.zeros((12, 12, 4), np.uint8)
    rgba[2, 2] = 0, 0, 0, 255
    rgba[5, 5] = 255, 255, 255, 7  # 7 / 255 = 0.027
    rgba[9, 9] = 255, 255, 255, 8
    table = warm_start("thesis")
    rows, columns = np.indices((12, 12))
    found = foreground(view_of(rgba, opaque=False), table)
    np.testing.assert_array_equal(found, (rows - 9) ** 2 + (columns - 9) ** 2 <= 9)
    assert np.argwhere(foreground(view_of(rgba, opaque=False), replace(table, alpha_mask=True))).tolist() == [[2, 2]]


def test_distance_image_by_brute_force():
    mask = np.zeros((18, 30), bool)
    mask[5, 9] = mask[16, 29] = True
    found = distance_image(mask, replace(CONFIG, downsampling=4))
    assert found.shape == (5, 8)
    held = np.array([[1, 2], [4, 7]])  # coarse pixels that hold them, row and column
    rows, columns = np.indices(found.shape)
    each = np.sqrt((rows[..., None] - held[:, 0]) ** 2 + (columns[..., None] - held[:, 1]) ** 2)
    np.testing.assert_allclose(found, 4 * each.min(axis=-1) / (0.125 * 18), rtol=1e-6)
    assert not distance_image(np.zeros((9, 9), bool), CONFIG).any()


# Losses


def test_schedule_of_5_29():
    config = WarmStartConfig(steps=10, decay=4, weight=0.5)
    assert [config.strength(t) for t in (0, 9, 10, 11, 13, 14, 99)] == pytest.approx(
        [0.5, 0.5, 0.5, 0.375, 0.125, 0, 0]
    )
    assert [config.leniency(t) for t in (10, 1009, 1010)] == [0.5, 0.5, 1.0]
    assert WarmStartConfig(steps=10, decay=0).strength(10) == 0
    rates = [config.means_rate(t, usual=0.01, radius=10.0) for t in (0, 12, 14)]
    assert rates == pytest.approx([1.0, 0.1, 0.01])
    assert config.means_rate(0, usual=3.0, radius=10.0) == 3.0


def test_foreground_loss_of_5_25():
    alpha = np.array([0.0, 0.25, 1.0, 0.5])
    mask = np.array([True, True, False, True])
    found = foreground_loss(upload((1 - alpha).astype(np.float32)), upload(mask, ad.Bool))
    assert numbers(found)[0] == pytest.approx((1 + 0.75**2 + 0.25) / 3)
    assert numbers(foreground_loss(ad.Float([0.5]), ad.Bool([False])))[0] == 0


def bilinear_twin(image: np.ndarray, u: float, v: float) -> float:
    height, width = image.shape
    i, j = int(np.clip(np.floor(u), 0, max(width - 2, 0))), int(np.clip(np.floor(v), 0, max(height - 2, 0)))
    i1, j1, fx, fy = min(i + 1, width - 1), min(j + 1, height - 1), u - i, v - j
    upper = image[j, i] * (1 - fx) + image[j, i1] * fx
    return upper * (1 - fy) + (image[j1, i] * (1 - fx) + image[j1, i1] * fx) * fy


def projected_twin(means: np.ndarray, camera: Camera, image: np.ndarray, step: int) -> float:
    local = means @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    found = []
    for x, y, z in local:
        if z <= 0.01:
            continue
        px, py = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        if 0 <= px < camera.width and 0 <= py < camera.height:
            found.append(bilinear_twin(image, px / step - 0.5, py / step - 0.5))
    return float(np.mean(found)) if found else 0.0


@pytest.mark.parametrize("shape", [(4, 6), (1, 1), (2, 5)])
def test_projected_loss_and_its_gradient(shape):
    rng = np.random.default_rng(0)
    step = -(-24 // shape[1])
    means, image = rng.normal(size=(40, 3)) * [1.5, 3, 1], rng.uniform(0, 3, shape).astype(np.float32)
    means = means.astype(np.float32).astype(np.float64)
    ours = ad.Array3f(np.ascontiguousarray(means.T, np.float32))
    dr.enable_grad(ours)
    loss, framed = projected_loss(ours, Pinhole.of(CAMERA), upload(image.ravel()), shape[::-1], step)
    assert numbers(loss)[0] == pytest.approx(projected_twin(means, CAMERA, image, step), rel=1e-5)
    assert 5 < np.array(framed).sum() < 40
    dr.backward(loss)
    gradient = np.array(dr.grad(ours)).T
    for n in range(12):
        for axis in range(3):
            moved = [means.copy(), means.copy()]
            for sign, copy in zip((1, -1), moved, strict=True):
                copy[n, axis] += sign * 1e-6
            slope = np.subtract(*(projected_twin(copy, CAMERA, image, step) for copy in moved)) / 2e-6
            assert gradient[n, axis] == pytest.approx(slope, abs=float(2e-4 * np.abs(gradient).max()) + 1e-7)
    assert (gradient[~np.array(framed)] == 0).all()


def test_bilinear_at_pixel_centres_and_between():
    image = ad.Float([0, 1, 2, 10, 11, 12])
    found = bilinear(image, (3, 2), ad.Float([0, 2, 1, 0.5, 1.25]), ad.Float([0, 1, 0.5, 0, 0]))
    np.testing.assert_allclose(numbers(found), [0, 12, 6, 0.5, 1.25], rtol=1e-6)


def test_projected_loss_of_an_empty_picture_is_zero():
    behind = ad.Array3f([0.0], [-9.0], [0.0])
    dr.enable_grad(behind)
    loss, framed = projected_loss(behind, Pinhole.of(CAMERA), ad.Float([1.0]), (1, 1), 24)
    dr.backward(loss)
    assert numbers(loss)[0] == 0
    assert not np.array(framed).any()
    assert (np.array(dr.grad(behind)) == 0).all()


# Rescue


def cloud(means: np.ndarray) -> Gaussians:
    count = len(means)
    return Gaussians.from_numpy(
        {
            "means": means,
            "log_scales": np.full((count, 3), -3.0),
            "quaternions": np.tile([1.0, 0, 0, 0], (count, 1)),
            "logit_opacities": np.zeros(count),
            "sh": np.zeros((count, 1, 3)),
        }
    )


@pytest.mark.parametrize(("least", "target"), [(2, 3.0), (3, 0.5)])
def test_rescue_of_5_31(small_dataset, least, target):
    """Two were seen, at x = 2 and 4; one was not, at x = 10; too few seen, and the centre, x = 0.5, is the target."""
    config = replace(CONFIG, least_seen=least, rescue=0.25)
    warm = WarmStart(config, TrainingViews(small_dataset, 0), np.array([0.5, 0, 0]), 20.0, 3)
    gaussians = cloud(np.array([[2.0, 0, 0], [4, 0, 0], [10, 0, 0]]))
    warm.state["framed"] = ad.Float([1, 5, 0])
    optimizer = Adam(gaussians.rows())
    warm.after_step(99, gaussians, optimizer)
    np.testing.assert_allclose(np.array(gaussians.means)[0], [2, 4, 10])
    warm.after_step(100, gaussians, optimizer)
    np.testing.assert_allclose(np.array(gaussians.means)[0], [2, 4, 0.75 * 10 + 0.25 * target])
    assert not np.array(warm.state["framed"]).any()


def test_the_thesis_rescues_and_does_nothing_else(small_dataset):
    """5.31 with alpha_rescue = 0.5, every 100 steps up to T_ws: 16 that were seen, at x = 0 to 15, one that was not, at
    x = 40, which goes half of its way to 7.5 twice. All are wide and faint, and stay so; those beyond the cameras that
    were seen stay, too."""
    warm = WarmStart(warm_start("thesis"), TrainingViews(small_dataset, 0), np.array([0.5, 0, 0]), 3.0, 17)
    means = np.zeros((17, 3))
    means[:, 0] = [*range(16), 40]
    gaussians = cloud(means)
    gaussians.log_scales, gaussians.logit_opacities = gaussians.log_scales + 9, gaussians.logit_opacities - 9
    before, optimizer = gaussians.to_numpy(), Adam(gaussians.rows())
    for step, place in ((100, 23.75), (150, 23.75), (2000, 15.625), (2100, 15.625)):
        warm.state["framed"] = ad.Float([1] * 16 + [0])
        warm.after_step(step, gaussians, optimizer)
        means[16, 0] = place
        for name, value in gaussians.to_numpy().items():
            np.testing.assert_array_equal(
                value, means if name == "means" else before[name], err_msg=f"{name} at {step}"
            )
    few = np.arange(17) < 15
    warm.state["framed"] = upload(few.astype(np.float32))
    warm.after_step(200, gaussians, optimizer)  # 15 are no cloud: both unseen go towards the scene's centre, 0.5
    np.testing.assert_allclose(np.array(gaussians.means)[0], [*range(15), 7.75, 8.0625])


def test_the_thesis_moves_centres_at_their_usual_step_size(small_dataset):
    """With a warm start of its own as without one, and it falls from the first step over splatfacto's 30,000 steps."""
    config = replace(preset("thesis"), init_count=20)
    plain, warm = (Trainer(small_dataset, replace(config, warm_start=w)) for w in (None, warm_start("thesis")))
    for step in (0, 100, 2_500, 15_000, 30_000, 199_999):
        rate = scene_scale(small_dataset) * 1.6e-4 * 0.01 ** min(step / 30_000, 1)
        assert plain.rates(step)[0] == pytest.approx(rate)
        assert warm.rates(step)[0] == plain.rates(step)[0]
    ours = Trainer(small_dataset, replace(config, warm_start=warm_start("fast")))
    assert ours.rates(100)[0] > 1.3 * plain.rates(100)[0]


def test_warm_start_gathers_far_and_revives_faint_gaussians(small_dataset):
    for within, revive in ((True, 0.2), (False, 0.0)):
        config = replace(CONFIG, least_seen=1, gather=within, revive=revive)
        warm = WarmStart(config, TrainingViews(small_dataset, 0), np.zeros(3), 5.0, 3)
        gaussians = cloud(np.array([[4.0, 0, 0], [0, 6, 0], [2, 0, 0]]))
        gaussians.logit_opacities = ad.Float([-9.0, 0.0, -1.0])
        optimizer = Adam(gaussians.rows())
        first, second = optimizer.moments()
        first[10] = np.ones(3, np.float32)
        optimizer.put(first, second)
        warm.state["framed"] = ad.Float([1, 1, 1])
        warm.after_step(100, gaussians, optimizer)
        moved = [[4, 0, 0], [1.5, 3, 0] if within else [0, 6, 0], [2, 0, 0]]
        np.testing.assert_allclose(np.array(gaussians.means).T, moved, rtol=1e-6)
        opacity = 1 / (1 + np.exp(-numbers(gaussians.logit_opacities)))
        before = 1 / (1 + np.exp(-np.array([-9.0, 0.0, -1.0])))
        np.testing.assert_allclose(opacity, np.maximum(before, revive), rtol=1e-5)
        assert optimizer.moments()[0][10].any() != within


def test_no_gaussian_stays_wider_than_its_neighbours_are_near(small_dataset):
    """Narrow ones stay; of wide ones each axis shrinks to the mean distance of the three nearest, by brute force."""
    rng = np.random.default_rng(0)
    means, log_scales = rng.normal(0, 1, (40, 3)), rng.uniform(-4, 2, (40, 3))
    distances = np.sort(np.linalg.norm(means[:, None] - means, axis=2), axis=1)[:, 1:4].mean(axis=1)
    for factor in (0.0, 0.5, 1.0):
        warm = WarmStart(replace(CONFIG, spacing=factor), TrainingViews(small_dataset, 0), np.zeros(3), 20.0, 40)
        gaussians = Gaussians.from_numpy({**cloud(means).to_numpy(), "log_scales": log_scales})
        warm.state["framed"] = upload(np.ones(40, np.float32))
        warm.after_step(100, gaussians, Adam(gaussians.rows()))
        widest = np.log(factor * distances)[:, None] if factor else np.inf
        np.testing.assert_allclose(numbers(gaussians.log_scales).T, np.minimum(log_scales, widest), rtol=1e-5)
        np.testing.assert_allclose(numbers(gaussians.means).T, means, rtol=1e-6)


# In training

REFINEMENT = DensificationConfig(
    refine_start=5, refine_every=10, pause_after_reset=0, reset_every=20, refine_stop=150, screen_size_stop=0
)
WARM = WarmStartConfig(steps=40, decay=20, conservative=20, rescue_every=10)
BASE = TrainConfig(iterations=100, sh_degree=0, init="random", init_count=400, refinement=REFINEMENT)


def inside(trainer: Trainer) -> int:
    return int((np.linalg.norm(trainer.gaussians.to_numpy()["means"], axis=1) < 0.75).sum())


def test_the_box_of_random_gaussians_scales_with_the_object(meshed):
    assert object_size(meshed) == pytest.approx(1.5, rel=1e-3)
    means = initial_gaussians(meshed, "random", 2000, 0, 0, box=10.0).to_numpy()["means"]
    np.testing.assert_allclose(np.abs(means).max(axis=0), 7.5, rtol=5e-3)
    points = replace(meshed, mesh_path=None)
    assert 0.8 < object_size(points) < 1.1
    with pytest.raises(InputError, match="init_box"):
        object_size(replace(points, ply_file_path=None))
    with pytest.raises(InputError, match="init_box: expected init=random beside it, found mesh"):
        replace(BASE, init="mesh", init_box=10.0)


def test_it_pulls_gaussians_into_the_object_and_keeps_their_number(meshed):
    plain = replace(BASE, init_box=4.0, refinement=replace(REFINEMENT, refine_start=10**6, refine_stop=10**6 + 1))
    found = []
    for warm in (None, WARM):
        trainer = Trainer(meshed, replace(plain, warm_start=warm))
        start = inside(trainer)
        for _ in range(60):
            trainer.step()
        assert trainer.gaussians.count == 400
        found.append(inside(trainer))
    assert found[1] > 3 * max(found[0], start)


def test_without_attraction_those_in_a_picture_are_still_not_rescued(meshed):
    trainer = Trainer(meshed, replace(BASE, warm_start=replace(WARM, weight=0.0), init="points"))
    spread = trainer.gaussians.to_numpy()["means"].std(axis=0)
    for _ in range(30):
        trainer.step()
    assert (trainer.gaussians.to_numpy()["means"].std(axis=0) > 0.8 * spread).all()


def test_gathered_gaussians_train_to_a_lower_loss(meshed):
    """From a box of ten times the object's size; as wide as they start, Gaussians would hide the object for good."""
    config = replace(BASE, init_box=10.0, refinement=replace(REFINEMENT, reset_every=10**6, max_gaussians=3000))
    losses = []
    for spacing in (1.0, 0.0):
        trainer = Trainer(meshed, replace(config, warm_start=replace(WARM, steps=60, spacing=spacing)))
        losses.append(np.mean([float(trainer.step()[0]) for _ in range(220)][-40:]))
    assert losses[0] < 0.4 * losses[1]


def own(strategy: str) -> dict[str, object]:
    """Settings of a strategy; the mesh-aware one fills nothing up."""
    return {"strategy": strategy, **({"strategy.min_gaussians": 0} if strategy == "mesh-aware" else {})}


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_refinement_waits_and_resume_goes_on_as_if_never_stopped(meshed, tmp_path, strategy):
    config = with_settings(replace(BASE, warm_start=WARM, init_box=3.0), own(strategy))
    straight = Trainer(meshed, config)
    counts = []
    for done in range(1, 71):
        straight.step()
        counts.append(straight.gaussians.count)
        if done in (25, 55):
            straight.save(tmp_path / f"at_{done}")
    assert counts[39] == 400
    assert counts[-1] != 400
    for done in (25, 55):
        resumed = Trainer(meshed, TrainConfig.from_json(config.to_json()))
        resumed.restore(tmp_path / f"at_{done}")
        for _ in range(70 - done):
            resumed.step()
        for name, value in straight.gaussians.to_numpy().items():
            np.testing.assert_array_equal(value, resumed.gaussians.to_numpy()[name], err_msg=f"{name} from {done}")


def test_opaque_pictures_have_a_foreground_too(opaque_dataset):
    trainer = Trainer(opaque_dataset, replace(BASE, warm_start=WARM))
    before = inside(trainer)
    for _ in range(60):
        trainer.step()
    assert inside(trainer) > 1.5 * before


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("count", [1, 2])
def test_one_gaussian_and_pictures_that_show_nothing(meshed, strategy, count, tmp_path):
    """A start of one Gaussian; the second time every picture is empty."""
    dataset = meshed
    if count == 2:
        for frame in meshed.frames:
            (tmp_path / frame.file_path).parent.mkdir(exist_ok=True)
            Image.new("RGBA", (32, 32), (0, 0, 0, 0)).save(tmp_path / frame.file_path)
        dataset = replace(meshed, root=tmp_path)
    config = replace(BASE, warm_start=replace(WARM, steps=10, decay=5), init_count=count)
    config = with_settings(config, own(strategy))
    trainer = Trainer(dataset, config)
    for _ in range(18):
        trainer.step()
    assert np.isfinite(trainer.gaussians.to_numpy()["means"]).all()
    assert trainer.gaussians.count >= 1


def test_presets_and_table_5_7():
    table = warm_start("thesis")
    assert (table.steps, table.decay, table.weight, table.luminance, table.dilation) == (2000, 2000, 0.5, 0.03, 3)
    found = table.projection_weight, table.downsampling, table.rescue, table.conservative, table.opacity_scale
    assert found == (0.4, 4, 0.5, 1000, 0.5)
    assert table.reach == 0.125
    assert (table.alpha_mask, table.travel, table.gather, table.spacing, table.revive) == (False, 0, False, 0, 0)
    for name in ("demo", "fast", "fine"):
        ours = warm_start(name)
        assert (ours.alpha_mask, ours.travel, ours.gather, ours.spacing, ours.revive) == (True, 1, True, 1, 0.1)
    for name in ("thesis", "fast", "demo"):
        assert warm_start(name).steps + warm_start(name).decay < preset(name).refinement.refine_stop
    with pytest.raises(InputError, match="rescue: expected 0 to 1"):
        WarmStartConfig(rescue=2.0)


def test_a_training_that_ends_before_its_warm_start_is_warned_of(spacesim, tiny_data, tmp_path, caplog):
    """`remark` begins at the sum of what gathers and what fades. Fewer iterations shorten both, unless they are set."""
    table = WarmStartConfig(steps=20, decay=10)
    assert [bool(table.remark(iterations)) for iterations in (5, 20, 30, 31)] == [True, True, True, False]
    line = ["train", tiny_data, "--preset", "demo", "--set", "init_count=300", "--init", "random", "--warm-start"]
    lengths = "--set", "warm_start.steps=500", "--set", "warm_start.decay=500"
    assert spacesim(*line, "--out", tmp_path / "short", "--iterations", 3, *lengths).code == 0
    warnings = [record.message for record in caplog.records if record.levelname == "WARNING"]
    assert len(warnings) == 1
    for word in ("warm_start", "500 iterations", "more than 1000", "found 3"):
        assert word in warnings[0]


def test_a_prior_that_nothing_uses_is_a_mistake(spacesim, tiny_data, tmp_path):
    line = ["train", tiny_data, "--preset", "demo", "--set", "prior=mesh", "--iterations", "2"]
    line += ["--out", tmp_path / "run"]
    assert spacesim(*line).is_refusal("--set prior: expected depth_weight or normal_weight above 0")
    assert spacesim(*line, "--set", "normal_weight=0").is_refusal("--set prior: expected depth_weight or normal_weight")
    assert not (tmp_path / "run").exists()
    assert spacesim(*line, "--set", "normal_weight=0.1").code == 0


# Depth, normals


def test_depth_and_normal_loss_by_hand():
    alpha = np.array([1.0, 0.5, 0.8, 1.0])
    transmittance, valid = upload((1 - alpha).astype(np.float32)), ad.Bool([True, True, True, False])
    depth = ad.Float([2.0, 2.0, 0.0, 5.0])  # the third has no surface, the fourth is to be ignored
    blended = ad.Float([2.5, 0.75, 3.0, 0.0])
    assert numbers(depth_loss(blended, transmittance, depth, valid))[0] == pytest.approx((0.5 + 0.25) / 4)
    normal = ad.Array3f([0, 0, 0, 0], [0, 1, 0, 0], [1, 0, 0, 1])
    blended = ad.Array3f([0, 0.3, 0, 1], [0.6, 0.4, 0, 0], [0.8, 0, 0, 0])
    assert numbers(normal_loss(blended, transmittance, normal, valid))[0] == pytest.approx((0.2 + 0.1) / 4)


def test_penalties_by_hand():
    gaussians = cloud(np.zeros((2, 3)))
    gaussians.log_scales = ad.Array3f(np.log(np.array([[1, 3], [2, 3], [3, 6]], np.float32)))
    gaussians.logit_opacities = ad.Float([0.0, np.log(3)])
    for name, expected in (("opacity", [0.5, 0.75]), ("scale", [2, 4])):
        np.testing.assert_allclose(numbers(penalty(name, gaussians)), expected, rtol=1e-6)
    with pytest.raises(ValueError, match="isotropy, opacity or scale"):
        penalty("beauty", gaussians)


@pytest.fixture(scope="module")
def ball_prior(tmp_path_factory):
    path = tmp_path_factory.mktemp("ball") / "ball.ply"
    trimesh.creation.icosphere(5, 1.0).export(path)
    return MeshPrior(path)


def test_mesh_prior_of_a_ball_is_a_closed_form(ball_prior):
    camera = Camera.from_fov(look_at((3, -2, 1), (0.2, 0, 0)), 40, 30, 45)
    depth, normal = ball_prior(camera)
    row, column = np.mgrid[:30, :40] + 0.5
    rays = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones_like(row)], axis=-1)
    world = rays @ camera.world_from_camera[:3, :3].T  # a step of one metre of depth
    a, b, c = (world**2).sum(-1), world @ camera.position, camera.position @ camera.position - 1
    square = b**2 - a * c
    exact = (-b - np.sqrt(np.maximum(square, 0))) / a
    clear = square > 0.3
    assert clear.sum() > 100
    np.testing.assert_allclose(depth[clear], exact[clear], atol=2e-3)
    points = camera.position + depth[..., None] * world
    assert ((normal * points).sum(-1)[clear] > 0.999).all()
    assert (depth[square < -0.1] == 0).all()
    assert (normal[square < -0.1] == 0).all()


def test_mesh_prior_agrees_with_the_path_tracers_labels(small_lit_dataset):
    frame = small_lit_dataset.train[0]
    truth = load_truth(small_lit_dataset, frame)
    depth, normal = MeshPrior.of(small_lit_dataset)(frame.camera)
    both = (depth > 0) & (truth.depth > 0)
    assert ((depth > 0) == (truth.depth > 0)).mean() > 0.98
    assert np.median(np.abs(depth - truth.depth)[both]) < 1e-3
    assert np.median((normal * truth.normal).sum(-1)[both]) > 0.999


def shape_error(trainer: Trainer, dataset) -> tuple[float, float]:
    """Mean error of depth, metres, and of normals, 1 - cosine, over the training views."""
    depths, cosines = [], []
    for frame in dataset.train:
        output = render(trainer.gaussians, Pinhole.of(frame.camera), outputs=("depth", "normal"))
        truth = load_truth(dataset, frame)
        known = (truth.depth > 0) & (load_image(dataset, frame).alpha > 0.99)
        depths.append(np.abs(output.image("depth") - truth.depth)[known].mean())
        cosines.append(1 - (output.image("normal") * truth.normal).sum(-1)[known].mean())
    return float(np.mean(depths)), float(np.mean(cosines))


def test_depth_and_normals_are_learnt_from_truth_and_from_a_mesh(small_lit_dataset):
    base = TrainConfig(iterations=150, init="mesh", init_count=1500, sh_degree=0, refinement=REFINEMENT)
    base = replace(base, refinement=replace(REFINEMENT, refine_stop=1))
    plain = Trainer(small_lit_dataset, base)
    plain.run(lambda progress: None, lambda: None)
    depth, cosine = shape_error(plain, small_lit_dataset)
    for prior in ("truth", "mesh"):
        supervised = Trainer(small_lit_dataset, replace(base, depth_weight=10.0, normal_weight=0.1, prior=prior))
        supervised.run(lambda progress: None, lambda: None)
        better_depth, better_cosine = shape_error(supervised, small_lit_dataset)
        assert better_depth < 0.9 * depth, prior
        assert better_cosine < 0.9 * cosine, prior


def test_gradients_of_depth_and_normals_reach_every_parameter(small_lit_dataset):
    """One step with the photometric loss, one with the others beside it: different first moments where they should."""
    base = TrainConfig(iterations=10, init="points", init_count=300, sh_degree=0)
    plain = Trainer(small_lit_dataset, base)
    plain.step()
    for term, rows in (("depth_weight", range(11)), ("normal_weight", range(11))):
        supervised = Trainer(small_lit_dataset, replace(base, **{term: 1.0}))
        supervised.step()
        found, expected = supervised.optimizer.moments()[0], plain.optimizer.moments()[0]
        changed = [np.abs(found[i] - expected[i]).max() for i in rows]
        scales = [np.abs(expected[i]).max() + 1e-12 for i in rows]
        moved = np.array(changed) / np.array(scales) > 1e-3
        assert moved[[0, 1, 2, 3, 4, 5, 10]].all(), term


def test_missing_inputs_of_depth_and_normals_are_refused(small_dataset):
    with pytest.raises(InputError, match="depth"):
        Trainer(small_dataset, replace(BASE, depth_weight=1.0))
    with pytest.raises(InputError, match="prior mesh"):
        Trainer(small_dataset, replace(BASE, normal_weight=1.0, prior="mesh"))
    with pytest.raises(InputError, match="prior: expected one of truth, mesh"):
        replace(BASE, prior="rumours")


@pytest.mark.parametrize(("scale", "shift", "said"), [(1, 1e3, "none sees"), (1e3, 0, "inside of it")])
def test_a_misplaced_prior_is_refused(small_dataset, tmp_path, scale, shift, said):
    trimesh.creation.box((scale,) * 3).apply_translation((shift, 0, 0)).export(tmp_path / "mesh.ply")
    elsewhere = replace(small_dataset, mesh_path=str(tmp_path / "mesh.ply"))
    with pytest.raises(InputError, match=f"prior mesh expects a mesh .*{said}"):
        Trainer(elsewhere, replace(BASE, depth_weight=1.0, prior="mesh"))


def test_methods_of_light_take_them_all(small_lit_dataset):
    """Attraction, depth and normals beside shadows."""
    config = replace(
        preset("demo", "shadow-splat"),
        iterations=6,
        init_count=200,
        warm_start=replace(WARM, steps=4, decay=1),
        depth_weight=0.1,
        normal_weight=0.1,
        visibility_weight=0.1,
    )
    trainer = Trainer(small_lit_dataset, config)
    trainer.run(lambda progress: None, lambda: None)
    assert all(np.isfinite(value).all() for value in trainer.gaussians.to_numpy().values())


def test_the_ball_of_the_tests_has_an_inside(meshed):
    """The fraction that figure 5.5 counts, as the benchmark computes it."""
    distance = SignedDistance.of(meshed.root / meshed.mesh_path)
    points = np.random.default_rng(0).uniform(-1, 1, (2000, 3))
    radius = np.linalg.norm(points, axis=1)
    clear = np.abs(radius - 0.75) > 0.01
    np.testing.assert_array_equal(distance.inside(points)[clear], radius[clear] < 0.75)
