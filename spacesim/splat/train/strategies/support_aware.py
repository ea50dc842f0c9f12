"""The support-aware strategy (thesis 5.2.2, 5.10 to 5.22, table 5.3): what many views see stays, and grows first."""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.data.errors import InputError, check_ranges
from spacesim.splat.raster.gaussians import Gaussians, numbers
from spacesim.splat.train.strategies.control import DefaultStrategyConfig, DensityControl, Survey, chosen_parents
from spacesim.splat.train.strategies.strategy import MOST_SIZE, MOST_STEPS

CHANNELS = ("support_count", "support_gradient", "support_radius")  #: c, g and r of 5.10
TINY = 1e-12  #: epsilon of 5.11, chosen: gradients are about 1e-4


@dataclass(frozen=True)
class SupportAwareConfig:
    """Thresholds of the support score are between 0 and 1."""

    decay: float = 0.99  #: table 5.3, beta of 5.10, each step
    count_weight: float = 1.0  #: table 5.3
    gradient_weight: float = 0.75  #: table 5.3
    radius_weight: float = 0.25  #: table 5.3
    protect_support: float = 0.55  #: table 5.3, tau_s
    warm_up: int = 500  #: table 5.3, steps before support protects, or eases growth
    ease_support: float = 0.95  #: table 5.3, tau_D
    ease: float = 0.3  #: table 5.3, lambda_S, factor of the growth threshold
    min_gaussians: int = 20_000  #: table 5.3
    backfill_start: int = 1_000  #: table 5.3, steps
    backfill_support: float = 0.85  #: table 5.3
    backfill_opacity: float = 0.3  #: table 5.3
    radius_quantile: float = 0.80  #: table 5.3, q
    radius_scale: float = 1.25  #: table 5.3, gamma
    min_cloud: int = 16  #: table 5.3, Gaussians in a supported cloud

    def __post_init__(self) -> None:
        if not (0 <= self.decay < 1 and 0 < self.ease <= 1 and 0 <= self.radius_quantile <= 1):
            raise InputError(f"support-aware strategy: expected decay, ease and quantile between 0 and 1, found {self}")
        check_ranges(self, radius_scale=(0, MOST_SIZE), min_cloud=(0, MOST_STEPS), warm_up=(0, MOST_STEPS))
        weights = self.count_weight, self.gradient_weight, self.radius_weight
        if min(weights) < 0 or sum(weights) <= 0:
            raise InputError(f"support-aware strategy: expected weights of 0 or more, not all 0, found {weights}")


def normalised(values: np.ndarray) -> np.ndarray:
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
    """eligible: [N] bool, the set C of 5.21;  off_core: [N], d_core of 5.22, in [0, 1]"""

    eligible: np.ndarray
    off_core: np.ndarray


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


class SupportAwareStrategy(DensityControl):
    """State beside that of `DensityControl`: the three moving averages of 5.10."""

    def __init__(
        self, config: DefaultStrategyConfig, support: SupportAwareConfig, scene_scale: float, count: int
    ) -> None:
        super().__init__(config, scene_scale, count, kept=CHANNELS)
        self.support = support

    def _accumulate(self, state: dict[str, Any], gradient: Any, radius: Any, visible: Any) -> None:
        """5.10, every step; a Gaussian that is not seen adds 0."""
        beta = self.support.decay
        for name, seen in zip(CHANNELS, (ad.Float(1), gradient, radius), strict=True):
            state[name] = beta * state[name] + (1 - beta) * dr.select(visible, seen, 0)

    def _thresholds(self, gaussians: Gaussians, survey: Survey) -> np.ndarray:
        """5.16."""
        usual = np.full(gaussians.count, self.config.grow_gradient)
        if survey.step < self.support.warm_up:
            return usual
        return np.where(self._score(survey) >= self.support.ease_support, self.support.ease * usual, usual)

    def _expendable(self, gaussians: Gaussians, survey: Survey, weak: np.ndarray) -> np.ndarray:
        """5.14."""
        if survey.step < self.support.warm_up:
            return weak
        return weak & (self._score(survey) < self.support.protect_support)

    def _parents(
        self, gaussians: Gaussians, survey: Survey, remove: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """5.18 to 5.22."""
        missing = min(self.support.min_gaussians, self.config.max_gaussians) - int((~remove).sum())
        if missing <= 0 or survey.step < self.support.backfill_start:
            return np.zeros(0, np.int64)
        score, (count, gradient, _) = self._score(survey), self._scaled(survey)
        means = numbers(gaussians.means).T.astype(np.float64)
        found = candidates(means, score, survey.opacity, self.support)
        rank = 1.5 * score + 0.75 * survey.opacity + 0.25 * count + 0.25 * gradient - 0.5 * found.off_core  # 5.22
        return chosen_parents(rank, found.eligible & ~remove, missing, rng)

    def _scaled(self, survey: Survey) -> list[np.ndarray]:
        """Normalised averages, [N] each; made once in a refinement, and copied where Gaussians are."""
        names = [f"scaled_{name}" for name in CHANNELS]
        if names[0] not in survey.kept:
            survey.kept.update({f"scaled_{name}": normalised(survey.kept[name]) for name in CHANNELS})
        return [survey.kept[name] for name in names]

    def _score(self, survey: Survey) -> np.ndarray:
        return support_score(self._scaled(survey), self.support)
