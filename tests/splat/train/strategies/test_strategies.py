"""The strategies' masks, scores and averages on cases computed by hand; that state follows every Gaussian; resume."""

from dataclasses import asdict, replace

import numpy as np
import pytest
import trimesh
from scipy.integrate import quad
from splats import on_screen

from spacesim.backend import ad
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError, WorkError
from spacesim.data.files import read_json
from spacesim.data.mesh import SignedDistance
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.train.config import STRATEGIES, TrainConfig, preset
from spacesim.splat.train.optimizer.adam import Adam
from spacesim.splat.train.strategies.control import DensificationConfig, GaussianStatistics, select_parents
from spacesim.splat.train.strategies.default import DefaultStrategy, DefaultStrategyConfig
from spacesim.splat.train.strategies.factory import make_strategy
from spacesim.splat.train.strategies.mcmc import McmcConfig, McmcStrategy, compute_relocation
from spacesim.splat.train.strategies.mesh_aware import MeshAwareConfig, MeshAwareStrategy, backfill_score, regions
from spacesim.splat.train.strategies.strategy import Strategy
from spacesim.splat.train.strategies.support_aware import (
    SUPPORT_STATISTICS,
    SupportAwareConfig,
    SupportAwareStrategy,
    candidates,
    normalise,
    support_score,
)
from spacesim.splat.train.trainer import Trainer
from spacesim.splat.train.warm_start import WarmStartConfig

TAU = DensificationConfig().grow_gradient
STEP = 1100  #: a refinement before the first reset: nothing is pruned by size
TINY, LARGE = np.log(0.001), np.log(0.02)  #: below and above the scale at which Gaussians are split


def logit(opacity) -> np.ndarray:
    opacity = np.asarray(opacity, float)
    return np.log(opacity / (1 - opacity))


def model(heights, opacity=0.9, log_scale=TINY) -> Gaussians:
    """Gaussians at x = `heights`: a plane x = 0 as mesh makes that the signed distance."""
    count = len(heights)
    means = np.zeros((count, 3))
    means[:, 0] = heights
    return Gaussians.from_numpy(
        {
            "means": means,
            "log_scales": np.full((count, 3), log_scale),
            "quaternions": np.tile([1.0, 0, 0, 0], (count, 1)),
            "logit_opacities": np.broadcast_to(logit(opacity), count),
            "sh": np.zeros((count, 1, 3)),
        }
    )


class Height:
    """Signed distance to the half space x < 0, as `SignedDistance` has it; counts what it is asked."""

    def __init__(self) -> None:
        self.asked: list[int] = []
        self.sides: list[int] = []

    def unsigned(self, points: np.ndarray) -> np.ndarray:
        self.asked.append(len(points))
        return np.abs(points[:, 0])

    def inside(self, points: np.ndarray) -> np.ndarray:
        self.sides.append(len(points))
        return points[:, 0] < 0


def show(strategy: Strategy, gradient, radius=None, visible=None, times: int = 1) -> None:
    count = len(gradient)
    radius = np.zeros(count) if radius is None else radius
    visible = np.ones(count, bool) if visible is None else visible
    for _ in range(times):
        strategy.state |= strategy.observe(strategy.observed_state(), [on_screen(gradient, radius, visible)])


def refine(strategy: Strategy, gaussians: Gaussians, step: int = STEP, leniency: float = 1.0):
    return strategy.refine(step, gaussians, Adam(gaussians.rows()), np.random.default_rng(0), leniency)


# Mesh-aware


MESH = MeshAwareConfig(cull_every=2500, exterior_margin=0.1, interior_margin=0.2, min_gaussians=0)


def mesh_aware(count: int, config: MeshAwareConfig = MESH) -> tuple[MeshAwareStrategy, Height]:
    height = Height()
    return MeshAwareStrategy(DensificationConfig(), config, height, scene_scale=1.0, count=count), height


def test_regions_are_those_of_5_2():
    where = regions(np.array([0.11, 0.1, 0.0, -0.2, -0.21]), 0.1, 0.2)
    np.testing.assert_array_equal(where.exterior, [1, 0, 0, 0, 0])
    np.testing.assert_array_equal(where.boundary, [0, 1, 1, 1, 0])
    np.testing.assert_array_equal(where.interior, [0, 0, 0, 0, 1])


def test_boundary_grows_at_a_lower_gradient():
    """5.6: outside, at the surface, deep inside; the last two far above and far below both thresholds."""
    gaussians = model([0.5, 0.05, -0.05, -0.5, 0.0, 0.0])
    strategy, height = mesh_aware(6)
    show(strategy, [0.5 * TAU] * 4 + [2 * TAU, 0.2 * TAU])
    done = refine(strategy, gaussians)
    assert (done.duplicated, done.pruned) == (3, 0)
    np.testing.assert_allclose(np.array(gaussians.means)[0, 6:], [0.05, -0.05, 0.0], atol=1e-7)
    assert height.asked == [4]  # the other two's fate does not depend on the mesh


def test_weak_gaussians_are_shielded_by_the_mesh():
    """5.5: only the weak one outside goes, until the exterior's turn comes."""
    heights, opacity = [0.5, 0.05, -0.05, -0.5, 0.5], [0.01, 0.01, 0.01, 0.01, 0.9]
    gaussians = model(heights, opacity)
    strategy, height = mesh_aware(5)
    show(strategy, [0] * 5)
    assert refine(strategy, gaussians).pruned == 1
    np.testing.assert_allclose(np.array(gaussians.means)[0], heights[1:], atol=1e-7)
    assert height.asked == [4]
    bare = model(heights, opacity)
    strategy, _ = mesh_aware(5, replace(MESH, protect_interior=False))
    assert refine(strategy, bare).pruned == 2  # deep inside, too
    np.testing.assert_allclose(np.array(bare.means)[0], [0.05, -0.05, 0.5], atol=1e-7)


def test_the_exterior_is_pruned_on_its_own_cadence():
    for step, pruned in ((2400, 0), (2500, 2), (2600, 0), (5000, 2)):
        gaussians = model([0.5, 0.2, 0.05, -0.5])
        strategy, _ = mesh_aware(4)
        assert refine(strategy, gaussians, step).pruned == pruned, step
    gaussians = model([0.5, 0.2, 0.05, -0.5], [0.9, 0.9, 0.01, 0.9])
    config = replace(MESH, cull_every=3200)  # in the pause after the reset at 3000: what is weak stays
    assert refine(mesh_aware(4, config)[0], gaussians, 3200).pruned == 2
    assert refine(mesh_aware(2, config)[0], gaussians, 3300).pruned == 0
    uneven = replace(MESH, cull_every=250)  # every 100 steps, the first refinement at or after 250, 500, 750, ...
    for step, pruned in ((1100, 0), (1200, 0), (1300, 1), (1400, 0), (1500, 1), (1600, 0)):
        assert refine(mesh_aware(2, uneven)[0], model([0.5, 0.0]), step).pruned == pruned, step


def test_a_side_stays_known_while_a_gaussian_cannot_have_crossed():
    """At 0.5, 0.3 and -0.5; then the first has moved by 0.4, the second by 0.35, the third by 0.45 to 0.05 inside."""
    strategy, height = mesh_aware(3)
    gaussians = model([0.5, 0.3, -0.5], 0.01)
    survey = strategy._collect_statistics(STEP, gaussians)
    everyone = np.ones(3, bool)
    np.testing.assert_allclose(strategy._regions(gaussians, survey, everyone)[0], [0.5, 0.3, -0.5], atol=1e-7)
    gaussians.means = ad.Array3f([0.9, -0.05, -0.05], [0, 0, 0], [0, 0, 0])
    distance, where = strategy._regions(gaussians, survey, everyone)
    np.testing.assert_allclose(distance, [0.9, -0.05, -0.05], atol=1e-7)
    np.testing.assert_array_equal(where.boundary, [False, True, True])
    assert height.sides == [3, 0]  # nearer than both margins the side does not matter
    gaussians.means = ad.Array3f([0.9, -0.3, -0.3], [0, 0, 0], [0, 0, 0])
    strategy._regions(gaussians, survey, everyone)
    assert height.sides == [3, 0, 1]  # the second has moved by more than it was away


def test_known_sides_change_nothing(meshed):
    """Random walks about a mesh: regions as if each were asked for anew."""
    surface = SignedDistance.of(meshed.root / meshed.mesh_path)
    config = MeshAwareConfig(exterior_margin=0.02, interior_margin=0.1)
    strategy = MeshAwareStrategy(DensificationConfig(), config, surface, scene_scale=1.0, count=500)
    rng = np.random.default_rng(0)
    means = rng.uniform(-1, 1, (500, 3))
    survey = strategy._collect_statistics(STEP, model(np.zeros(500)))
    for step in range(12):
        means += rng.normal(scale=0.04, size=means.shape)
        gaussians = model(np.zeros(500))
        gaussians.means = ad.Array3f(np.ascontiguousarray(means.T, np.float32))
        asked = rng.random(500) < 0.7
        found = strategy._regions(gaussians, survey, asked)[1]
        exact = regions(np.where(asked, surface(np.array(gaussians.means, np.float64).T), 0), 0.02, 0.1)
        np.testing.assert_array_equal(found.exterior, exact.exterior, err_msg=str(step))
        np.testing.assert_array_equal(found.interior, exact.interior, err_msg=str(step))


def test_large_gaussians_go_in_spite_of_the_mesh():
    gaussians = model([0.0, 0.0], log_scale=np.log(0.2))
    gaussians.log_scales = ad.Array3f(np.log(np.array([[0.2, 0.001]] * 3, np.float32)))
    assert refine(mesh_aware(2)[0], gaussians, 4100).pruned == 1


def test_backfill_score_of_5_9():
    distance, opacity, seen = np.array([0.05, -0.1, -0.4]), np.array([0.9, 0.5, 0.2]), np.array([30.0, 60.0, 15.0])
    score = backfill_score(opacity, distance, seen, regions(distance, 0.1, 0.2))
    expected = [0.9 + 0 + 0.125 + 0.1, 0.5 + 0.25 + 0.25 + 0.1, 0.2 + 1 + 0.0625 + 0.5]
    np.testing.assert_allclose(score, expected)
    none = np.zeros(0)
    assert len(backfill_score(none, none, none, regions(none, 0.1, 0.2))) == 0


def test_minimum_count_is_filled_from_valid_regions():
    heights = [0.5, 0.05, -0.5, 0.5]
    gaussians = model(heights, [0.9, 0.9, 0.3, 0.01])
    strategy, _ = mesh_aware(4, replace(MESH, min_gaussians=8))
    show(strategy, [0] * 4, times=2)
    done = refine(strategy, gaussians)
    assert (done.pruned, done.added, gaussians.count) == (1, 5, 8)  # 5.7 and 5.8
    copied = np.array(gaussians.means)[0, 3:]
    # scores: 0.9 + 0.25 + 0.1 at the surface, 0.3 + 1 + 0.25 + 0.5 inside; the exterior one has no share
    np.testing.assert_allclose(copied[:2], [-0.5, 0.05], atol=0.01)
    assert (copied < 0.1).all()
    assert len(np.unique(copied)) == 5  # copies do not lie on each other


def test_nothing_is_copied_where_no_region_is_valid():
    gaussians = model([0.5, 0.6])
    strategy, _ = mesh_aware(2, replace(MESH, min_gaussians=8))
    assert refine(strategy, gaussians).added == 0
    with pytest.raises(WorkError, match=r"mesh\.ply"):
        refine(strategy, gaussians, 2500)


# Support-aware


def support_aware(count: int, **changes) -> SupportAwareStrategy:
    config = SupportAwareConfig(**{"min_gaussians": 0, **changes})
    return SupportAwareStrategy(DensificationConfig(), config, scene_scale=1.0, count=count)


def test_moving_averages_are_a_plain_loop():
    rng, count = np.random.default_rng(0), 7
    strategy = support_aware(count, decay=0.9)
    expected = np.zeros((3, count))
    for _ in range(30):
        gradient, radius, visible = rng.random(count), rng.random(count), rng.random(count) < 0.5
        show(strategy, gradient, radius, visible)
        for i, seen in enumerate((1.0, gradient, radius)):
            for n in range(count):
                expected[i, n] = 0.9 * expected[i, n] + 0.1 * (np.broadcast_to(seen, count)[n] if visible[n] else 0)
    for i, name in enumerate(SUPPORT_STATISTICS):
        np.testing.assert_allclose(np.array(strategy.state[name]), expected[i], rtol=1e-5)


def test_normalisation_and_score_by_hand():
    values = np.arange(101.0)  # the 95th percentile is 95
    np.testing.assert_allclose(normalise(values), np.minimum(values / 95, 1))
    np.testing.assert_array_equal(normalise(np.zeros(5)), 0)
    assert len(normalise(np.zeros(0))) == 0
    channels = [np.array([0.0, 1.0]), np.array([2.0, 0.0]), np.array([1.0, 1.0])]
    scaled = [normalise(channel) for channel in channels]
    score = support_score(scaled, SupportAwareConfig())
    high = 1 / 0.95  # of two values 0 and 1 the 95th percentile is 0.95
    np.testing.assert_allclose(scaled, np.minimum([[0, high], [high, 0], [1, 1]], 1))
    np.testing.assert_allclose(score, [(0.75 + 0.25) / 2, (1 + 0.25) / 2])


def supported(strategy: SupportAwareStrategy, count, gradient, radius=None) -> None:
    """Put moving averages in place."""
    values = count, gradient, gradient if radius is None else radius
    for name, value in zip(SUPPORT_STATISTICS, values, strict=True):
        strategy.state[name] = upload(np.asarray(value, np.float32))


def test_support_protects_what_is_faint_after_the_warm_up():
    """5.14: score 1, 0.5, 0; faint, faint, faint, opaque."""
    count = [1, 0.5, 0, 0]
    for step, left in ((STEP, [0, 3]), (1000, [3])):
        gaussians = model([0, 1, 2, 3], [0.01, 0.01, 0.01, 0.9])
        strategy = support_aware(4, warm_up=50)
        supported(strategy, count, count)
        refine(strategy, gaussians, step)
        np.testing.assert_allclose(np.array(gaussians.means)[0], left, atol=1e-6)


@pytest.mark.parametrize(("warm_start", "first"), [(0, 1000), (400, 1000), (2000, 2100)])
def test_the_warm_up_counts_from_the_first_refinement(small_dataset, warm_start, first):
    """Table 5.3's 500 steps, beside table 5.1's pause, which begins with the training, and table 5.7's warm start."""
    warm = WarmStartConfig(steps=warm_start) if warm_start else None
    config = replace(preset("thesis", strategy="support-aware"), warm_start=warm)
    strategy = make_strategy(config, small_dataset, 1.0, 1)
    for step, protects in ((first, False), (first + 400, False), (first + 500, True)):
        assert config.refinement.refines_at(step)
        statistics = GaussianStatistics(step, *np.zeros((4, 1)), {name: np.ones(1) for name in SUPPORT_STATISTICS})
        weak = strategy._prunable(model([0], [0.01]), statistics, np.ones(1, bool))
        assert weak.tolist() == [not protects]


def test_support_eases_growth():
    """5.16, 5.17: only the Gaussian with a score of at least 0.95 grows at half of the usual threshold."""
    for step, grown in ((STEP, 1), (1000, 0)):
        gaussians = model([0, 1, 2])
        strategy = support_aware(3, warm_up=50)
        supported(strategy, [1, 0.9, 0], [1, 0.9, 0])
        for name, value in zip(("gradient", "seen"), (0.5 * TAU, 1.0), strict=True):
            strategy.state[name] = upload(np.full(3, value, np.float32))
        assert refine(strategy, gaussians, step).duplicated == grown
        if grown:
            np.testing.assert_allclose(np.array(gaussians.means)[0], [0, 1, 2, 0], atol=1e-6)


def test_candidates_lie_near_the_supported_core():
    """5.18 to 5.21 for five supported Gaussians at x = 0, 1, 2, 3, 14, equal weights: centre 4, distances 4, 3, 2, 1,
    10, quantile 0.5 is 3, reach 1.25 * 3 = 3.75."""
    means = np.zeros((7, 3))
    means[:, 0] = [0, 1, 2, 3, 14, 4, 4]
    score, opacity = np.array([0.9] * 5 + [0.5, 0.9]), np.array([0.5] * 5 + [0.5, 0.2])
    config = SupportAwareConfig(radius_quantile=0.5, min_cloud=5)
    found = candidates(means, score, opacity, config)
    np.testing.assert_array_equal(found.eligible, [0, 1, 1, 1, 0, 0, 0])
    np.testing.assert_allclose(found.off_core, [1, 0.8, 2 / 3.75, 1 / 3.75, 1, 0, 0])
    weighted = np.array([0.5, 0.5, 0.5, 0.5, 1.0])  # the centre moves to (0+1+2+3+28)/6
    opacity[:5] = weighted
    centre = 34 / 6
    moved = candidates(means, score, opacity, config)
    distance = np.abs(means[:5, 0] - centre)
    np.testing.assert_allclose(moved.off_core[:5], np.clip(distance / (1.25 * np.median(distance)), 0, 1))
    assert not candidates(means, score, opacity, replace(config, min_cloud=6)).eligible.any()
    assert not candidates(means[:0], score[:0], opacity[:0], config).eligible.any()


def cloud(opacity: float) -> tuple[SupportAwareStrategy, Gaussians]:
    """20 Gaussians at x = 0, 0.1, ..., all as well supported; the least number is 30."""
    strategy = support_aware(20, min_gaussians=30, backfill_start=1000)
    supported(strategy, np.ones(20), np.ones(20))
    return strategy, model(np.arange(20) / 10, opacity)


def test_backfill_copies_supported_gaussians_nearest_to_the_core():
    strategy, gaussians = cloud(0.5)
    done = refine(strategy, gaussians)
    assert (done.added, gaussians.count) == (10, 30)
    copied = np.sort(np.array(gaussians.means)[0, 20:])
    np.testing.assert_allclose(copied, np.arange(5, 15) / 10, atol=0.01)  # all but the distance is equal
    assert [len(np.array(v)) for v in strategy.state.values()] == [30] * 6


@pytest.mark.parametrize(
    ("what", "value", "worth"),
    [("count", 0.9, 0.1), ("gradient", 0.8, 0.1625), ("radius", 0.2, 0.15), ("away", 0.5, 0.2)],
)
def test_backfill_score_of_5_22(what, value, worth):
    """Of 21 one is copied. Two are most opaque, one of which has less of one thing: by (5.12) and (5.22) that is
    `worth` so much, which 0.75 of its greater opacity makes up for or does not. The others stand 1 away from the
    centre, on both sides, so that the reach is 1.25, and 0.5 away counts 0.5 * 0.4."""
    for side in (-1, 1):
        support = {"count": np.ones(21), "gradient": np.ones(21), "radius": np.ones(21)}
        means, opacity = np.array([0.0, 0.0, 0.0, *[1.0, -1.0] * 9]), np.full(21, 0.31)
        opacity[:2] = 0.4, 0.4 + worth / 0.75 + 0.004 * side
        if what == "away":
            opacity[2] = opacity[1]  # so that the centre stays
            means[1:3], support["count"][2] = (value, -value), 0.9
        else:
            support[what][1] = value
        strategy = support_aware(21, min_gaussians=22, backfill_start=1000)
        supported(strategy, *support.values())
        gaussians = model(means, opacity)
        kept = {name: np.array(strategy.state[name]) for name in SUPPORT_STATISTICS}
        statistics = GaussianStatistics(STEP, *np.zeros((2, 21)), opacity, np.ones(21), kept)
        parents = strategy._parents(gaussians, statistics, np.zeros(21, bool), np.random.default_rng(0))
        assert parents.tolist() == [1 if side > 0 else 0]


def test_backfill_invents_nothing():
    for opacity, step in ((0.2, STEP), (0.5, 1000)):
        strategy, gaussians = cloud(opacity)
        late = replace(strategy.support, backfill_start=1001)
        strategy.support = late
        assert refine(strategy, gaussians, step).added == 0
        assert gaussians.count == 20
    strategy, gaussians = cloud(0.5)
    supported(strategy, np.linspace(0, 1, 20), np.zeros(20), np.zeros(20))
    assert refine(strategy, gaussians).added == 0  # no gradient, so no score of 0.85


def test_parents_are_the_best_first_and_then_drawn_again():
    score, eligible = np.array([3.0, 9.0, 1.0, 5.0]), np.array([True, False, True, True])
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(select_parents(score, eligible, 2, rng), [3, 0])
    more = select_parents(score, eligible, 300, rng)
    np.testing.assert_array_equal(more[:3], [3, 0, 2])
    counts = np.bincount(more[3:], minlength=4)
    assert counts[1] == 0
    assert counts[3] > counts[0] > counts[2]
    assert len(select_parents(score, np.zeros(4, bool), 5, rng)) == 0
    assert len(select_parents(score, eligible, 0, rng)) == 0


# What all share


def marked(strategy: Strategy, count: int) -> None:
    """State that names its Gaussian: entry i of what outlives refinements is i + 1."""
    for name in strategy.state:
        if name not in ("gradient", "seen", "radius"):
            strategy.state[name] = upload(np.arange(1, count + 1, dtype=np.float32))


@pytest.mark.parametrize("kind", ["mesh-aware", "support-aware"])
def test_state_follows_duplicates_halves_and_what_is_pruned(kind):
    heights = np.arange(6) / 100
    gaussians = model(heights, [0.9, 0.9, 0.9, 0.9, 0.9, 0.01])
    scales = np.full((3, 6), TINY, np.float32)
    scales[:, 3] = LARGE
    gaussians.log_scales = ad.Array3f(scales)
    config = DensificationConfig(prune_opacity=0.499)
    if kind == "mesh-aware":
        strategy: Strategy = MeshAwareStrategy(config, replace(MESH, exterior_margin=0.0), Height(), 1.0, 6)
    else:
        strategy = SupportAwareStrategy(config, SupportAwareConfig(min_gaussians=0, warm_up=5000), 1.0, 6)
    show(strategy, [0, 2 * TAU, 0, 2 * TAU, 0, 0])
    marked(strategy, 6)
    done = refine(strategy, gaussians)
    assert (done.duplicated, done.split, done.pruned) == (1, 1, 1)
    for name, values in strategy.state.items():
        if name in ("gradient", "seen", "radius"):
            np.testing.assert_array_equal(np.array(values), np.zeros(7))
        else:
            np.testing.assert_array_equal(np.array(values), [1, 2, 3, 5, 2, 4, 4])
    stay = np.array(gaussians.means)[0][:5]
    np.testing.assert_allclose(stay, heights[[0, 1, 2, 4, 1]], atol=1e-7)


@pytest.mark.parametrize("kind", ["default", "mesh-aware", "support-aware"])
def test_lenient_culling_halves_the_opacity_threshold(kind):
    opacity = [0.9, 0.04, 0.02]
    for leniency, left in ((1.0, 1), (0.5, 2)):
        gaussians = model([0.3, 0.3, 0.3], opacity)
        strategy: Strategy = DefaultStrategy(DensificationConfig(), 1.0, 3)
        if kind == "mesh-aware":
            strategy = mesh_aware(3)[0]
        if kind == "support-aware":
            strategy = support_aware(3)
        refine(strategy, gaussians, leniency=leniency)
        assert gaussians.count == left


ONE_STEP = "--preset", "demo", "--iterations", 1, "--set", "init_count=50"


def test_what_is_too_faint_is_an_option(spacesim, tiny_data, tmp_path):
    for least, left in ((0.05, 1), (0.03, 2), (0.005, 3)):
        gaussians = model([0.3, 0.3, 0.3], [0.9, 0.04, 0.02])
        refine(DefaultStrategy(DensificationConfig(prune_opacity=least), 1.0, 3), gaussians)
        assert gaussians.count == left
    line = ["train", tiny_data, "--out", tmp_path / "run", *ONE_STEP]
    for wrong in ("0", "0.5", "nan"):
        refused = spacesim(*line, "--set", f"refinement.prune_opacity={wrong}")
        assert refused.is_refusal("--set refinement.prune_opacity: expected", wrong)
    line += ["--set", "refinement.prune_opacity=0.01"]
    assert spacesim(*line, "--strategy", "mcmc").is_refusal("--set refinement.prune_opacity", "mcmc")
    assert spacesim(*line).code == 0
    assert TrainConfig.from_json(read_json(tmp_path / "run" / "config.json")).refinement.prune_opacity == 0.01


def test_what_is_too_wide_is_an_option(spacesim, tiny_data, tmp_path):
    """Methods of light split at a smaller size by themselves: a Gaussian has one visibility."""
    assert preset("fast", "shadow-map").refinement.split_screen_size < preset("fast").refinement.split_screen_size
    line = ["train", tiny_data, "--out", tmp_path / "run", *ONE_STEP]
    for wrong in ("0", "-0.1", "nan", "inf"):
        refused = spacesim(*line, "--set", f"refinement.split_screen_size={wrong}")
        assert refused.is_refusal("--set refinement.split_screen_size: expected", wrong)
    line += ["--set", "refinement.split_screen_size=0.01"]
    assert spacesim(*line, "--strategy", "mcmc").is_refusal("--set refinement.split_screen_size", "mcmc")
    assert spacesim(*line).code == 0
    assert TrainConfig.from_json(read_json(tmp_path / "run" / "config.json")).refinement.split_screen_size == 0.01


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("kind", ["default", "mesh-aware", "support-aware", "mcmc"])
def test_one_gaussian_is_refined_like_many(kind, count):
    gaussians = model(np.zeros(count))
    made: dict[str, Strategy] = {
        "default": DefaultStrategy(DensificationConfig(), 1.0, count),
        "mesh-aware": mesh_aware(count)[0],
        "support-aware": support_aware(count, min_gaussians=40),
        "mcmc": McmcStrategy(DensificationConfig(), McmcConfig(growth=1.0), 1.0),
    }
    strategy = made[kind]
    show(strategy, [2 * TAU] * count)
    for step in (STEP, 2500):
        refine(strategy, gaussians, step)
        strategy.add_noise(step, gaussians, 1e-4, 0)
    assert gaussians.count >= 2 * count if kind != "support-aware" else gaussians.count >= count
    assert np.isfinite(np.array(gaussians.means)).all()


# MCMC


@pytest.mark.parametrize(("opacity", "copies"), [(0.9, 2), (0.5, 3), (0.99, 7), (0.2, 20)])
def test_copies_that_share_look_like_one(opacity, copies):
    """In the middle, and integrated along a line through it: what the paper's formula is derived from."""
    each, scales = compute_relocation(np.array([opacity]), np.array([[1.0, 0.5, 2.0]]), np.array([copies]))
    assert 1 - (1 - each[0]) ** copies == pytest.approx(opacity)
    np.testing.assert_allclose(scales[0] / scales[0, 0], [1, 0.5, 2])
    together, _ = quad(
        lambda x: 1 - (1 - each[0] * np.exp(-0.5 * (x / scales[0, 0]) ** 2)) ** copies, -40, 40, limit=200
    )
    assert together == pytest.approx(opacity * np.sqrt(2 * np.pi), rel=1e-6)


def mcmc(**changes) -> McmcStrategy:
    return McmcStrategy(DensificationConfig(max_gaussians=changes.pop("most", 100)), McmcConfig(**changes), 1.0)


def test_dead_gaussians_move_to_live_ones():
    gaussians = model([0.0, 1.0, 2.0, 3.0], [0.8, 0.004, 0.001, 0.5])
    optimizer = Adam(gaussians.rows())
    marks = [np.array([1, 2, 3, 4], np.float32)] * len(gaussians.rows())
    optimizer.put(marks, marks)
    done = mcmc(growth=0.0).refine(STEP, gaussians, optimizer, np.random.default_rng(3))
    assert (done.relocated, done.added, gaussians.count) == (2, 0, 4)
    x = np.array(gaussians.means)[0]
    assert set(x[1:3]) <= {0.0, 3.0}
    opacity = 1 / (1 + np.exp(-np.array(gaussians.logit_opacities, np.float64)))
    for place, before in ((0.0, 0.8), (3.0, 0.5)):
        here = np.flatnonzero(x == place)
        assert 1 - np.prod(1 - opacity[here]) == pytest.approx(before, rel=1e-4)
        moments = optimizer.moments()[0][0][here]
        assert (moments == (0 if len(here) > 1 else moments)).all()


def test_growth_is_five_percent_up_to_the_most():
    counts = []
    gaussians = model(np.arange(40.0))
    for step in (STEP, STEP + 100, STEP + 200):
        refine(mcmc(most=43), gaussians, step)
        counts.append(gaussians.count)
    assert counts == [42, 43, 43]
    assert refine(mcmc(), gaussians, STEP + 50).added == 0
    dead = model(np.arange(4.0), 0.001)
    assert refine(mcmc(), dead).relocated == 0  # there is nowhere to go


def test_noise_is_normal_along_the_scales_and_gated_by_opacity():
    count, rate = 20_000, 1e-4
    gaussians = model(np.zeros(count), 0.001)
    scales = np.array([0.1, 0.2, 0.05])
    gaussians.log_scales = ad.Array3f(np.tile(np.log(scales)[:, None], (1, count)).astype(np.float32))
    turned = np.tile([np.sqrt(0.5), 0, 0, np.sqrt(0.5)], (count, 1)).T  # x to y
    gaussians.quaternions = ad.Array4f(turned.astype(np.float32))
    strategy = mcmc(noise=2e3)
    strategy.add_noise(1, gaussians, rate, 0)
    first = np.array(gaussians.means)
    gate = 1 / (1 + np.exp(100 * (0.001 - 0.005)))
    np.testing.assert_allclose(first.std(axis=1), 0.2 * gate * scales[[1, 0, 2]] ** 2, rtol=0.02)
    assert (np.abs(first.mean(axis=1)) < 0.03 * first.std(axis=1)).all()
    assert np.abs(np.corrcoef(first)[0, 1:]).max() < 0.03
    assert abs(np.corrcoef(first[0, 1:], first[0, :-1])[0, 1]) < 0.03  # neighbours
    strategy.add_noise(2, gaussians, rate, 0)
    assert abs(np.corrcoef(first[0], np.array(gaussians.means)[0] - first[0])[0, 1]) < 0.03  # steps
    opaque = model(np.zeros(100), 0.9)
    strategy.add_noise(1, opaque, rate, 0)
    assert np.abs(np.array(opaque.means)).max() < 1e-30


# In training


def config_of(strategy: str) -> TrainConfig:
    refinement = DensificationConfig(
        refine_start=10, refine_every=20, pause_after_reset=20, reset_every=4, refine_stop=150, screen_size_stop=0
    )
    own = {
        "mesh-aware": MeshAwareConfig(cull_every=40, min_gaussians=90),
        "support-aware": SupportAwareConfig(warm_up=20, backfill_start=20, min_gaussians=90, min_cloud=2),
        "mcmc": McmcConfig(),
    }
    return TrainConfig(
        strategy=own.get(strategy, DefaultStrategyConfig()),
        iterations=100,
        sh_degree=1,
        sh_every=40,
        refinement=refinement,
        opacity_weight=0.01 if strategy == "mcmc" else 0,
        scale_weight=0.01 if strategy == "mcmc" else 0,
        surfels=True,
    )


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_resumed_training_goes_on_as_if_never_stopped(meshed, tmp_path, strategy):
    config = config_of(strategy)
    straight = Trainer(meshed, config)
    for _ in range(50):
        straight.step()
    straight.save(tmp_path / "half")
    resumed = Trainer(meshed, TrainConfig.from_json(config.to_json()))
    resumed.restore(tmp_path / "half")
    for _ in range(45):
        straight.step()
        resumed.step()
    for name, value in straight.gaussians.to_numpy().items():
        np.testing.assert_array_equal(value, resumed.gaussians.to_numpy()[name], err_msg=name)
    assert straight.gaussians.count != 60


def test_a_missing_or_misplaced_mesh_is_an_error(small_dataset, tmp_path):
    with pytest.raises(InputError, match="strategy mesh-aware"):
        Trainer(small_dataset, config_of("mesh-aware"))
    trimesh.creation.box((1, 1, 1)).apply_translation((50, 0, 0)).export(tmp_path / "far.ply")
    far = replace(small_dataset, mesh_path=str(tmp_path / "far.ply"))
    trainer = Trainer(far, config_of("mesh-aware"))
    with pytest.raises(WorkError, match=r"mesh\.ply"):
        trainer.run(lambda progress: None, lambda: None)
    trimesh.creation.box((1e3, 1e3, 1e3)).export(tmp_path / "millimetres.ply")
    with pytest.raises(InputError, match="strategy mesh-aware expects a mesh in the place and unit"):
        Trainer(replace(small_dataset, mesh_path=str(tmp_path / "millimetres.ply")), config_of("mesh-aware"))


def test_a_configuration_tells_of_its_own_strategy_alone():
    config = config_of("mesh-aware")
    written = config.to_json()
    assert written["strategy"] == {"kind": "mesh-aware", **asdict(config.strategy)}
    assert TrainConfig.from_json(written).strategy == config.strategy
    assert config_of("default").to_json()["strategy"] == {"kind": "default"}


def test_presets_know_their_strategies():
    thesis = preset("thesis", "vanilla", "support-aware")
    mesh, support = preset("thesis", "vanilla", "mesh-aware").strategy, thesis.strategy
    found = mesh.cull_every, mesh.exterior_margin, mesh.interior_margin, mesh.boundary_ease, mesh.min_gaussians
    assert found == (2500, 1e-4, 0.05, 0.3, 20_000)  # table 5.2
    weights = support.count_weight, support.gradient_weight, support.radius_weight
    assert (support.decay, *weights) == (0.99, 1.0, 0.75, 0.25)  # table 5.3
    thresholds = support.protect_support, support.warm_up, support.ease_support, support.ease, support.min_gaussians
    assert thresholds == (0.55, 500, 0.95, 0.3, 20_000)
    backfill = support.backfill_start, support.backfill_support, support.backfill_opacity
    assert backfill == (1000, 0.85, 0.3)
    assert (support.radius_quantile, support.radius_scale, support.min_cloud) == (0.80, 1.25, 16)
    assert preset("fast", "vanilla", "mcmc").opacity_weight == preset("fast", "vanilla", "mcmc").scale_weight == 0.01
    with pytest.raises(InputError, match=f"strategy: expected one of {', '.join(STRATEGIES)}, found 'hope'"):
        preset("fast", "vanilla", "hope")


@pytest.mark.parametrize(
    ("cls", "broken"),
    [
        (MeshAwareConfig, {"boundary_ease": 0.0}),
        (MeshAwareConfig, {"exterior_margin": -1.0}),
        (MeshAwareConfig, {"min_gaussians": -1}),
        (SupportAwareConfig, {"decay": 1.0}),
        (SupportAwareConfig, {"gradient_weight": -1.0}),
        (SupportAwareConfig, {"count_weight": 0, "gradient_weight": 0, "radius_weight": 0}),
        (McmcConfig, {"min_opacity": 0.0}),
        (McmcConfig, {"growth": -0.1}),
    ],
)
def test_configurations_that_make_no_sense(cls, broken):
    with pytest.raises(InputError, match=f"{next(iter(broken))}: expected"):
        cls(**broken)
