"""Adam, the moves of refinement, and the default strategy's decisions."""

import gc
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from splats import on_screen

from spacesim.backend import ad, select
from spacesim.backend.upload import upload
from spacesim.learning.adam import NetworkAdam, adam_step
from spacesim.splat.raster.gaussians import NAMES, Gaussians
from spacesim.splat.train.config import preset, shortened
from spacesim.splat.train.optimizer.adam import Adam
from spacesim.splat.train.strategies.control import DensificationConfig
from spacesim.splat.train.strategies.default import DefaultStrategy
from spacesim.splat.train.strategies.densify import grow, limit_opacities, prune, rearrange


def gaussians(count: int = 6, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians.from_numpy(
        {
            "means": rng.normal(size=(count, 3)),
            "log_scales": np.full((count, 3), -5.0),
            "quaternions": rng.normal(size=(count, 4)),
            "logit_opacities": np.full(count, 1.0),
            "sh": rng.normal(size=(count, 4, 3)),
        }
    )


def optimizer_with_marks(model: Gaussians) -> Adam:
    """Moments that name their Gaussian: entry i of every row is i + 1."""
    optimizer = Adam(model.rows())
    marks = np.arange(1, model.count + 1, dtype=np.float32)
    rows = len(model.rows())
    optimizer.put([marks] * rows, [10 * marks] * rows)
    return optimizer


def test_adam_matches_its_definition():
    rng = np.random.default_rng(0)
    value, rate = rng.normal(size=5), 0.1
    rows = [upload(value.astype(np.float32))]
    optimizer = NetworkAdam(rows)
    m, v = np.zeros(5), np.zeros(5)
    for step in range(1, 6):
        gradient = rng.normal(size=5)
        m, v = 0.9 * m + 0.1 * gradient, 0.999 * v + 0.001 * gradient**2
        value = value - rate * (m / (1 - 0.9**step)) / (np.sqrt(v / (1 - 0.999**step)) + 1e-15)
        moments = optimizer.first, optimizer.second
        grad_rows = [upload(gradient.astype(np.float32))]
        rows, optimizer.first, optimizer.second = adam_step(rows, grad_rows, moments, [rate], optimizer.corrections())
    np.testing.assert_allclose(np.array(rows[0]), value, rtol=2e-5)


def test_prune_takes_moments_along():
    model = gaussians()
    before, optimizer = model.to_numpy(), optimizer_with_marks(model)
    kept = prune(model, optimizer, np.array([False, True, False, True, True, False]))
    np.testing.assert_array_equal(kept, [0, 2, 5])
    for name in NAMES:
        np.testing.assert_array_equal(model.to_numpy()[name], before[name][kept])
    for row in optimizer.moments()[0]:
        np.testing.assert_array_equal(np.array(row), [1, 3, 6])
    for row in optimizer.moments()[1]:
        np.testing.assert_array_equal(np.array(row), [10, 30, 60])


def test_grow_duplicates_and_splits():
    model = gaussians()
    before, optimizer = model.to_numpy(), optimizer_with_marks(model)
    duplicate = np.array([True, False, False, False, False, False])
    split = np.array([False, False, True, False, False, True])
    source = grow(model, optimizer, duplicate, split, np.random.default_rng(0))
    np.testing.assert_array_equal(source, [0, 1, 3, 4, 0, 2, 5, 2, 5])
    after = model.to_numpy()
    for name in NAMES:
        np.testing.assert_array_equal(after[name][:5], before[name][source[:5]])
    for name in ("quaternions", "logit_opacities", "sh"):
        np.testing.assert_array_equal(after[name], before[name][source])
    np.testing.assert_allclose(after["log_scales"][5:], before["log_scales"][source[5:]] - np.log(1.6), rtol=1e-6)
    distance = np.linalg.norm(after["means"][5:] - before["means"][source[5:]], axis=1)
    assert (distance > 0).all()
    assert (distance < 5 * np.exp(-5.0)).all()
    first, second = optimizer.moments()
    for row in first + second:
        np.testing.assert_array_equal(row[4:], 0)  # what is new starts without moments
    np.testing.assert_array_equal(first[0][:4], [1, 2, 4, 5])


def test_opacity_reset_limits_and_forgets():
    model = gaussians()
    model.logit_opacities = ad.Float([5.0, -9.0, 0.0, 1.0, 2.0, -3.0])
    optimizer = optimizer_with_marks(model)
    limit_opacities(model, optimizer, 0.1)
    opacity = 1 / (1 + np.exp(-np.array(model.logit_opacities)))
    np.testing.assert_allclose(opacity, np.minimum(1 / (1 + np.exp(-np.array([5, -9, 0, 1, 2, -3.0]))), 0.1), rtol=1e-5)
    np.testing.assert_array_equal(optimizer.moments()[0][10], 0)
    np.testing.assert_array_equal(optimizer.moments()[0][0], [1, 2, 3, 4, 5, 6])


def refine_once(
    step: int, config: DensificationConfig, **state
) -> tuple[DefaultStrategy, Gaussians, np.ndarray, tuple]:
    model = gaussians()
    scales = np.full((6, 3), np.log(0.001), dtype=np.float32)
    scales[1] = np.log(0.02)  # larger than duplicate_scale
    scales[4] = np.log(0.2)  # larger than prune_scale
    model.log_scales = ad.Array3f(np.ascontiguousarray(scales.T))
    model.logit_opacities = ad.Float([2.0, 2.0, 2.0, -9.0, 2.0, 2.0])  # the fourth is too faint
    optimizer = Adam(model.rows())
    strategy = DefaultStrategy(config, scene_scale=1.0, count=6)
    zeros = np.zeros(6)
    gradient, radius = state.get("gradient", zeros), state.get("radius", zeros)
    for _ in range(2):
        seen = on_screen(gradient, radius, np.array([True] * 5 + [False]))
        strategy.state |= strategy.observe(strategy.observed_state(), [seen])
    means = np.array(model.means).T.copy()
    done = strategy.refine(step, model, optimizer, np.random.default_rng(0))
    return strategy, model, means, (done.duplicated, done.split, done.pruned)


GRADIENT = [0.01, 0.01, 0.0, 0.0, 0.0, 0.01]  # the sixth is never seen, so its gradient does not count


def test_high_gradients_duplicate_small_and_split_large_gaussians():
    strategy, model, means, moves = refine_once(1100, DensificationConfig(), gradient=GRADIENT)
    assert moves == (1, 1, 1)  # before the first reset only faint Gaussians are pruned
    assert model.count == 6 + 2 - 1
    np.testing.assert_array_equal(np.array(model.means).T[0], means[0])
    assert all(len(np.array(value)) == model.count and not np.array(value).any() for value in strategy.state.values())


def test_large_gaussians_are_pruned_after_the_first_reset():
    assert refine_once(4100, DensificationConfig(), gradient=GRADIENT)[3] == (1, 1, 2)


def test_screen_size_splits_and_prunes_until_its_stop():
    radius = [0.0, 0.0, 0.02, 0.0, 0.0, 0.0]
    config = DensificationConfig(screen_size_stop=5000)
    assert refine_once(1100, config, radius=radius)[3] == (0, 1, 1)
    assert refine_once(5100, config, radius=radius)[3] == (0, 0, 2)
    wide, radius = DensificationConfig(split_screen_size=1.0), [0.0, 0.0, 0.06, 0.0, 0.0, 0.0]
    assert refine_once(2900, wide, radius=radius)[3] == (0, 0, 1)  # pruned by size after the first reset alone
    assert refine_once(4100, wide, radius=radius)[3] == (0, 0, 3)
    assert refine_once(4100, replace(wide, screen_size_stop=4000), radius=radius)[3] == (0, 0, 2)


def test_splitting_by_size_can_ask_for_a_gradient():
    """5.17: of two that are wide on the screen only the one whose gradient is high grows."""
    radius, gradient = [0.0, 0.02, 0.02, 0.0, 0.0, 0.0], [0.0, 0.01, 0.0, 0.0, 0.0, 0.0]
    for which, split in (("all", 2), ("growing", 1)):
        config = DensificationConfig(split_screen=which)
        assert refine_once(1100, config, gradient=gradient, radius=radius)[3] == (0, split, 1)


def test_where_sizes_are_held_the_widest_are_split_first():
    """Of three that are wide and two whose gradients are high, one no number, within a budget of two more."""
    radius, gradient = [0.0, 0.02, 0.03, 0.04, 0.0, 0.0], [0.5, 0.3, 0.0, np.nan, 0.0, 0.0]
    moved = {}
    for which in ("all", "held"):
        config = DensificationConfig(split_screen=which, split_screen_size=0.01, max_gaussians=8)
        _, model, means, _ = refine_once(1100, config, gradient=gradient, radius=radius)
        kept = np.array(model.means).T
        moved[which] = [i for i, mean in enumerate(means) if not (np.abs(kept - mean).max(axis=1) < 1e-7).any()]
    assert {2, 3} <= set(moved["held"])
    assert 1 not in moved["held"]
    assert 1 in moved["all"]
    assert 2 not in moved["all"]


def test_what_is_small_and_wide_on_the_screen_is_duplicated_and_split():
    """As in gsplat: three where there was one, of which two are halves."""
    radius = [0.02, 0.0, 0.0, 0.0, 0.0, 0.0]
    gradient = [0.01, 0.0, 0.0, 0.0, 0.0, 0.0]
    _, model, means, moves = refine_once(1100, DensificationConfig(), gradient=gradient, radius=radius)
    assert (moves, model.count) == ((1, 1, 1), 6 + 2 - 1)
    scales = np.exp(np.array(model.log_scales)[0])
    at_first = np.linalg.norm(np.array(model.means).T - means[0], axis=1) < 0.01
    np.testing.assert_allclose(np.sort(scales[at_first]), [0.001 / 1.6, 0.001 / 1.6, 0.001], rtol=1e-5)
    full = DensificationConfig(max_gaussians=7)  # one more may be added, and this would be two
    assert refine_once(1100, full, gradient=gradient, radius=radius)[3] == (0, 0, 1)


def test_the_thesis_splits_by_size_on_the_screen_before_the_first_reset_alone():
    """Table 5.1 with splatfacto's stop at 4,000: refinements at 1,000 to 2,900, and culling by that size never."""
    config = preset("thesis").refinement
    cycle = config.reset_every * config.refine_every
    refined = [step for step in range(100, 200_000, 100) if config.refine_start < step < config.refine_stop]
    refined = [step for step in refined if step % cycle >= config.pause_after_reset]
    assert [step for step in refined if step < config.screen_size_stop] == list(range(1000, 3000, 100))
    for iterations in (200_000, 15_000, 10_000, 5_000):
        config = shortened(preset("thesis"), iterations).refinement
        refined = [step for step in range(100, iterations, 100) if config.refines_at(step)]
        assert not [step for step in refined if cycle < step < config.screen_size_stop]
    config = shortened(preset("fast"), 3_500).refinement
    assert config.screen_size_stop == preset("fast").refinement.screen_size_stop, "which culls by it"


@pytest.mark.parametrize("step", [100, 500, 999, 1150, 3500, 15_000, 20_000])
def test_no_refinement_out_of_its_time(step):
    """Before the start, off the interval, in the pause after a reset, after the stop (table 5.1)."""
    _, model, means, moves = refine_once(step, DensificationConfig(), gradient=GRADIENT)
    assert moves == (0, 0, 0)
    np.testing.assert_array_equal(np.array(model.means).T, means)


def test_the_reset_comes_every_thirty_refinements():
    for step, reset in ((3000, True), (3100, False), (6000, True)):
        _, model, _, _ = refine_once(step, DensificationConfig())
        assert (np.array(model.logit_opacities).max() < 0) == reset


def test_no_reset_whose_pause_outlasts_refinement():
    for stop, reset in ((3900, False), (4000, True)):
        _, model, _, _ = refine_once(3000, DensificationConfig(refine_stop=stop))
        assert (np.array(model.logit_opacities).max() < 0) == reset


def test_growth_stops_at_the_maximum_and_prefers_the_largest_gradients():
    config = DensificationConfig(max_gaussians=7)
    _, _, _, moves = refine_once(1100, config, gradient=[0.01, 0.02, 0.0, 0.0, 0.0, 0.0])
    assert moves == (0, 1, 1)
    assert refine_once(1100, DensificationConfig(max_gaussians=6), gradient=GRADIENT)[3] == (0, 0, 1)


def test_refinement_over_a_power_of_two_does_not_keep_both_sizes():
    """Where all rows would be held as they were and as they become, half as much again would be needed."""
    kind = dr.JitBackend.CUDA if select() == "cuda" else dr.JitBackend.LLVM

    def held() -> int:
        dr.sync_thread()
        gc.collect()
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        return int(dr.detail.malloc_watermark(kind))

    before, model = held(), gaussians(2**14 - 50)
    model.sh = ad.ArrayXf([upload(row) for row in np.zeros((48, model.count), np.float32)])
    optimizer, index = Adam(model.rows()), np.arange(2**14 + 50) % model.count
    dr.eval(model.rows())
    held()
    rearrange(model, optimizer, index, np.arange(len(index)) >= model.count)
    peak = int(dr.detail.malloc_watermark(kind)) - before
    assert model.count == optimizer.count == len(index)
    assert peak < 1.25 * (held() - before)
