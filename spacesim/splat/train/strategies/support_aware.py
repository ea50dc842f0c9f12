"""The support-aware strategy (thesis 5.2.2, 5.10 to 5.22, table 5.3): what many views see stays, and grows first."""

from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Bool, Float
from spacesim.data.errors import InputError, check_ranges
from spacesim.data.structure import check_fields
from spacesim.splat.raster.gaussians import Gaussians, stack_rows
from spacesim.splat.train.strategies.control import (
    DensificationConfig,
    DensityControl,
    GaussianStatistics,
    select_parents,
)
from spacesim.splat.train.strategies.strategy import MAX_STEPS, MAX_THRESHOLD

SUPPORT_STATISTICS = ("support_count", "support_gradient", "support_radius")  #: c, g and r of 5.10
TINY = 1e-12  #: epsilon of 5.11: gradients are about 1e-4


@dataclass(frozen=True)
class SupportAwareConfig:
    """What many views see stays, and grows first. Thresholds of the support score are between 0 and 1."""

    kind: ClassVar[str] = "support-aware"

    decay: float = 0.99  #: table 5.3, beta of 5.10: what an average keeps each step
    count_weight: float = 1.0  #: table 5.3, of visibility in the support score (5.12)
    gradient_weight: float = 0.75  #: table 5.3, of gradients in it
    radius_weight: float = 0.25  #: table 5.3, of sizes on the screen in it
    protect_support: float = 0.55  #: table 5.3, tau_s: with less support faint Gaussians are pruned
    warm_up: int = 500  #: table 5.3, steps from the first densification step until support protects, or eases growth
    ease_support: float = 0.95  #: table 5.3, tau_D: from such a support on growth is eased
    ease: float = 0.3  #: table 5.3, lambda_S, factor of the growth threshold
    min_gaussians: int = 20_000  #: table 5.3: where fewer are left, some are copied
    backfill_start: int = 1_000  #: table 5.3, steps before any are copied
    backfill_support: float = 0.85  #: table 5.3, least support of those that are copied
    backfill_opacity: float = 0.3  #: table 5.3, least opacity of those that are copied
    radius_quantile: float = 0.80  #: table 5.3, q: of distances from the core, which says how far copies may be
    radius_scale: float = 1.25  #: table 5.3, gamma, factor of that distance
    min_cloud: int = 16  #: table 5.3, Gaussians in a supported cloud

    def __post_init__(self) -> None:
        check_fields(self)
        if not 0 <= self.decay < 1:
            raise InputError(f"decay: expected a number from 0 to below 1, found {self.decay}")
        if not 0 < self.ease <= 1:
            raise InputError(f"ease: expected a number in (0, 1], found {self.ease}")
        check_ranges(
            self,
            radius_quantile=(0, 1),
            radius_scale=(0, MAX_THRESHOLD),
            min_cloud=(0, MAX_STEPS),
            warm_up=(0, MAX_STEPS),
        )
        check_ranges(
            self, count_weight=(0, MAX_THRESHOLD), gradient_weight=(0, MAX_THRESHOLD), radius_weight=(0, MAX_THRESHOLD)
        )
        if self.count_weight + self.gradient_weight + self.radius_weight <= 0:
            raise InputError("count_weight: expected one of the three weights of support above 0, found none")


def normalise(values: np.ndarray) -> np.ndarray:
    """[N] in [0, 1]: a statistic in units of its 95th percentile, clipped (5.11)."""
    if len(values) == 0:
        return values
    return np.clip(values / (np.quantile(values, 0.95) + TINY), 0, 1)


def support_score(scaled: list[np.ndarray], config: SupportAwareConfig) -> np.ndarray:
    """S [N] of 5.12, from normalised averages of visibility, gradient and radius, [N] each."""
    weights = config.count_weight, config.gradient_weight, config.radius_weight
    return np.average(scaled, axis=0, weights=weights)


@dataclass(frozen=True, eq=False)
class Candidates:
    """Gaussians that backfill may copy."""

    eligible: np.ndarray  #: [N] bool, the set C of 5.21
    off_core: np.ndarray  #: [N], d_core of 5.22, in [0, 1]


def candidates(means: np.ndarray, score: np.ndarray, opacity: np.ndarray, config: SupportAwareConfig) -> Candidates:
    """Whom backfill may copy: Gaussians that are supported, opaque, and near the core of all that are (5.18 to 5.21;
    that they survive is the caller's part of 5.21). means [N, 3] metres;  score, opacity [N]. None where the supported
    cloud has less than `min_cloud`."""
    supported = (score >= config.backfill_support) & (opacity >= config.backfill_opacity)  # 5.18
    if supported.sum() < max(config.min_cloud, 1):
        return Candidates(np.zeros(len(score), bool), np.ones(len(score)))
    weights = (score * opacity)[supported]
    centre = (weights[:, None] * means[supported]).sum(axis=0) / weights.sum()  # 5.19
    distance = np.linalg.norm(means - centre, axis=1)
    reach = config.radius_scale * np.quantile(distance[supported], config.radius_quantile)  # 5.20
    off_core = np.clip(distance / max(reach, 1e-12), 0, 1)
    return Candidates(supported & (distance <= reach), off_core)


def _first_refinement(config: DensificationConfig, warm_start: int) -> int:
    """The first step after a warm start of so many that refines."""
    steps = range(0, config.refine_stop, config.refine_every)
    return next((step for step in steps if step > warm_start and config.refines_at(step)), config.refine_stop)


class SupportAwareStrategy(DensityControl):
    """State beside that of `DensityControl`: the three moving averages of 5.10."""

    def __init__(
        self,
        config: DensificationConfig,
        support: SupportAwareConfig,
        scene_scale: float,
        count: int,
        warm_start: int = 0,
    ) -> None:
        """warm_start: steps of a warm start, which keeps densification off"""
        super().__init__(config, scene_scale, count, kept=SUPPORT_STATISTICS)
        self.support = support
        #: the first step whose densification knows support: the thesis names no step to count from, and counted from
        #: the start it is over when table 5.1's pause ends, and long over after table 5.7's warm start
        self.protects_from = _first_refinement(config, warm_start) + support.warm_up

    def _accumulate(self, state: dict[str, Float], gradient: Float, radius: Float, visible: Bool) -> None:
        """5.10, every step; a Gaussian that is not seen adds 0."""
        beta = self.support.decay
        for name, seen in zip(SUPPORT_STATISTICS, (ad.Float(1), gradient, radius), strict=True):
            state[name] = beta * state[name] + (1 - beta) * dr.select(visible, seen, 0)

    def _thresholds(self, gaussians: Gaussians, statistics: GaussianStatistics) -> np.ndarray:
        """5.16."""
        usual = np.full(gaussians.count, self.config.grow_gradient)
        if statistics.step < self.protects_from:
            return usual
        return np.where(self._score(statistics) >= self.support.ease_support, self.support.ease * usual, usual)

    def _prunable(self, gaussians: Gaussians, statistics: GaussianStatistics, weak: np.ndarray) -> np.ndarray:
        """5.14."""
        if statistics.step < self.protects_from:
            return weak
        return weak & (self._score(statistics) < self.support.protect_support)

    def _parents(
        self, gaussians: Gaussians, statistics: GaussianStatistics, remove: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """5.18 to 5.22."""
        missing = min(self.support.min_gaussians, self.config.max_gaussians) - int((~remove).sum())
        if missing <= 0 or statistics.step < self.support.backfill_start:
            return np.zeros(0, np.int64)
        score, (count, gradient, _) = self._score(statistics), self._scaled(statistics)
        means = stack_rows(gaussians.means).T.astype(np.float64)
        eligible = candidates(means, score, statistics.opacity, self.support)
        rank = (
            1.5 * score + 0.75 * statistics.opacity + 0.25 * count + 0.25 * gradient - 0.5 * eligible.off_core
        )  # 5.22
        return select_parents(rank, eligible.eligible & ~remove, missing, rng)

    def _scaled(self, statistics: GaussianStatistics) -> list[np.ndarray]:
        """Normalised averages, [N] each; made once in a densification step, and copied where Gaussians are."""
        names = [f"scaled_{name}" for name in SUPPORT_STATISTICS]
        if names[0] not in statistics.kept:
            statistics.kept.update({f"scaled_{name}": normalise(statistics.kept[name]) for name in SUPPORT_STATISTICS})
        return [statistics.kept[name] for name in names]

    def _score(self, statistics: GaussianStatistics) -> np.ndarray:
        return support_score(self._scaled(statistics), self.support)
