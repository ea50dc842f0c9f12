"""Adaptive density control (Kerbl et al. 2023) with the thesis's parameters (table 5.1): the schedule and the rules
that the default strategy is, and that the mesh-aware and the support-aware one change in places.

Where the table is silent the values are those of Nerfstudio's splatfacto, which the thesis trains with.
"""

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Literal

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Bool, Float
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError, check_ranges
from spacesim.data.structure import check_fields
from spacesim.splat.raster.gaussians import Gaussians, stack_rows
from spacesim.splat.train.optimizer.adam import Adam
from spacesim.splat.train.strategies.densify import DensificationCounts, append_copies, grow, limit_opacities, prune
from spacesim.splat.train.strategies.strategy import MAX_STEPS, MAX_THRESHOLD, OnScreen, Strategy

WINDOW = ("gradient", "seen", "radius")  #: statistics since the last densification step


@dataclass(frozen=True)
class DensificationConfig:
    """When and by which rules the set of Gaussians is changed, whatever the strategy. Lengths are fractions of the
    scene's scale, screen sizes are radii as fractions of the image's longer side."""

    prune_opacity: float = 0.05  #: fainter Gaussians are pruned (table 5.1)
    prune_scale: float = 0.05  #: larger ones are pruned (table 5.1)
    prune_screen_size: float = 0.05  #: wider ones are pruned, a share of the picture (table 5.1)
    split_screen_size: float = 0.01  #: wider ones are split, a share of the picture (table 5.1)
    #: which of these: all, as gsplat; what grows by gradient (5.17); or all, the widest first, and then none gets wider
    #: (`largest_scale`): a Gaussian has one visibility, so large ones blur the edges of shadows
    split_screen: Literal["all", "growing", "held"] = "all"
    refine_every: int = 100  #: iterations between two densification steps (table 5.1)
    reset_every: int = 30  #: densification steps between two opacity resets (table 5.1)
    pause_after_reset: int = 1000  #: iterations without densification (table 5.1)
    max_gaussians: int = 250_000  #: at most this many Gaussians, at the start and ever (table 5.1)
    grow_gradient: float = 0.0008  #: grow above this absolute screen-space gradient, half images per unit of loss
    duplicate_scale: float = 0.01  #: of those that grow, larger ones are split, smaller ones duplicated
    refine_start: int = 500  #: iterations before the first densification step
    refine_stop: int = 15_000  #: iterations; three quarters of a training of no more; a reset's pause is over by then
    screen_size_stop: int = 15_000  #: iterations; until then screen sizes split and, after the first reset, prune

    def __post_init__(self) -> None:
        check_fields(self)
        if self.max_gaussians < 1:
            raise InputError(f"max_gaussians: expected at least 1, found {self.max_gaussians}")
        if not 0 < self.prune_opacity < 0.5:  # a reset lowers to twice as much
            raise InputError(f"prune_opacity: expected above 0 and below 0.5, found {self.prune_opacity}")
        if not 0 < self.split_screen_size < float("inf"):
            raise InputError(f"split_screen_size: expected a number above 0, found {self.split_screen_size}")
        sizes, steps = (0, MAX_THRESHOLD), (0, MAX_STEPS)
        check_ranges(self, prune_scale=sizes, prune_screen_size=sizes, grow_gradient=sizes, duplicate_scale=sizes)
        check_ranges(self, refine_every=(1, MAX_STEPS), reset_every=(1, MAX_STEPS), pause_after_reset=steps)
        check_ranges(self, refine_start=steps, refine_stop=steps, screen_size_stop=steps)

    def refines_at(self, step: int) -> bool:
        """Whether Gaussians grow and are pruned after so many steps: on the interval, and not in the pause that begins
        with the training and with every opacity reset (as in gsplat)."""
        pausing = self._since_reset(step) < self.pause_after_reset
        return self.is_active(step) and step % self.refine_every == 0 and not pausing

    def resets_at(self, step: int) -> bool:
        """Whether opacities are lowered after so many steps: on the interval, where the pause is over in time."""
        in_time = step + self.pause_after_reset <= self.refine_stop
        return self.is_active(step) and self._since_reset(step) == 0 and in_time

    def recovers_at(self, step: int, steps: int) -> bool:
        """Whether opacities were lowered no more than so many steps ago."""
        since = self._since_reset(step)
        return since < steps and self.resets_at(step - since)

    def is_active(self, step: int) -> bool:
        """Whether the set of Gaussians may change after so many steps."""
        return self.refine_start < step < self.refine_stop

    def _since_reset(self, step: int) -> int:
        """Steps since opacities would have been lowered, or since the training began."""
        return step % (self.reset_every * self.refine_every)


@dataclass(frozen=True, eq=False)
class GaussianStatistics:
    """What a densification step knows of each Gaussian, [N] each."""

    step: int  #: how many are finished
    #: mean over the views since the last densification step that showed it, half images per unit of loss
    gradient: np.ndarray
    radius: np.ndarray  #: largest since then, fraction of the image's longer side
    opacity: np.ndarray  #: in (0, 1)
    scale: np.ndarray  #: standard deviation along the longest axis, metres
    #: {name: [N]} of the state that outlives densification steps, and what a strategy adds of its own
    kept: dict[str, np.ndarray]

    def at(self, index: np.ndarray) -> "GaussianStatistics":
        """Of Gaussians that are copies of the Gaussians index [M]."""
        kept = {name: values[index] for name, values in self.kept.items()}
        opacity, scale = self.opacity[index], self.scale[index]
        return GaussianStatistics(self.step, self.gradient[index], self.radius[index], opacity, scale, kept)


class DensityControl(Strategy):
    """Duplicates, splits, prunes and resets on table 5.1's schedule. Subclasses say which gradients make a Gaussian
    grow (`_thresholds`), which Gaussians are too weak to stay (`_prunable`), what is pruned beside (`_outside`), and
    which ones are copied where too few are left (`_parents`).

    State, [N] each: sum of gradient norms, number of steps in which a Gaussian was seen, largest radius, all since the
    last densification step; and what a subclass adds, which outlives densification steps.
    """

    unseen: tuple[str, ...] = ()  #: of the state, what no observation changes

    def __init__(self, config: DensificationConfig, scene_scale: float, count: int, kept: tuple[str, ...]) -> None:
        self.config, self.scene_scale, self.kept = config, scene_scale, kept
        self.state = {name: _zeros(count) for name in (*WINDOW, *kept)}

    def observes_step(self, step: int) -> bool:
        return step < self.config.refine_stop

    def observed_state(self) -> dict[str, Float]:
        return {name: values for name, values in self.state.items() if name not in self.unseen}

    def observe(self, state: dict[str, Float], seen: list[OnScreen]) -> dict[str, Float]:
        state = dict(state)
        for view in seen:
            gradient, radius, visible = view.measures()
            state["gradient"] = state["gradient"] + dr.select(visible, gradient, 0)
            state["seen"] = state["seen"] + dr.select(visible, ad.Float(1), 0)
            state["radius"] = dr.maximum(state["radius"], dr.select(visible, radius, 0))
            self._accumulate(state, gradient, radius, visible)
        return state

    def refine(
        self, step: int, gaussians: Gaussians, optimizer: Adam, rng: np.random.Generator, leniency: float = 1.0
    ) -> DensificationCounts:
        config = self.config
        done = DensificationCounts()
        if config.refines_at(step):
            done = self._grow_and_prune(step, gaussians, optimizer, rng, leniency)
        elif config.is_active(step) and step % config.refine_every == 0 and self._outside_is_due(step):
            done = self._prune_outside(step, gaussians, optimizer, rng)
        if config.resets_at(step):
            limit_opacities(gaussians, optimizer, 2 * config.prune_opacity)
        return done

    def _accumulate(self, state: dict[str, Float], gradient: Float, radius: Float, visible: Bool) -> None:
        """Add an observation to what of the state is kept. Recorded: it depends on nothing else."""

    @abstractmethod
    def _thresholds(self, gaussians: Gaussians, statistics: GaussianStatistics) -> np.ndarray:
        """[N] gradient above which each Gaussian grows (5.6, 5.16)."""

    @abstractmethod
    def _prunable(self, gaussians: Gaussians, statistics: GaussianStatistics, weak: np.ndarray) -> np.ndarray:
        """[N] bool: those of the weak ones, [N] bool, that nothing protects (5.5, 5.14)."""

    def _outside_is_due(self, step: int) -> bool:
        """Whether Gaussians are pruned at this densification step for where they are."""
        return False

    def _outside(self, gaussians: Gaussians, statistics: GaussianStatistics) -> np.ndarray:
        """[N] bool: pruned for where they are (5.3)."""
        return np.zeros(gaussians.count, bool)

    def _parents(
        self, gaussians: Gaussians, statistics: GaussianStatistics, remove: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """[K] Gaussians that are copied so that there are enough after those in `remove` [N] have gone (5.8); they are
        none of these, and may repeat."""
        return np.zeros(0, np.int64)

    def _grow_and_prune(
        self, step: int, gaussians: Gaussians, optimizer: Adam, rng: np.random.Generator, leniency: float
    ) -> DensificationCounts:
        config = self.config
        statistics = self._collect_statistics(step, gaussians)
        duplicate, split = self._growing(gaussians, statistics)
        source = grow(gaussians, optimizer, duplicate, split, rng)
        halves = np.arange(len(source)) >= len(split) - split.sum() + duplicate.sum()
        statistics = statistics.at(source)
        statistics = replace(statistics, radius=np.where(halves, 0, statistics.radius), scale=_largest_scale(gaussians))

        remove = self._prunable(
            gaussians, statistics, statistics.opacity < leniency * config.prune_opacity
        )  # 5.4, 5.13
        if step > config.reset_every * config.refine_every:
            remove = remove | (statistics.scale > config.prune_scale * self.scene_scale)
            if step < config.screen_size_stop:
                remove |= statistics.radius > config.prune_screen_size
        if self._outside_is_due(step):
            remove = remove | self._outside(gaussians, statistics)
        added = self._prune_and_fill(gaussians, optimizer, statistics, remove, rng)
        return DensificationCounts(int(duplicate.sum()), int(split.sum()), int(remove.sum()), added)

    def _prune_outside(
        self, step: int, gaussians: Gaussians, optimizer: Adam, rng: np.random.Generator
    ) -> DensificationCounts:
        """In the pause after a reset, when opacities mean nothing."""
        statistics = self._collect_statistics(step, gaussians)
        remove = self._outside(gaussians, statistics)
        added = self._prune_and_fill(gaussians, optimizer, statistics, remove, rng)
        return DensificationCounts(pruned=int(remove.sum()), added=added)

    def _prune_and_fill(
        self,
        gaussians: Gaussians,
        optimizer: Adam,
        statistics: GaussianStatistics,
        remove: np.ndarray,
        rng: np.random.Generator,
    ) -> int:
        """Prune, copy where too few are left, begin new statistics. Returns how many were added."""
        parents = self._parents(gaussians, statistics, remove, rng)
        index = prune(gaussians, optimizer, remove)
        copies = append_copies(gaussians, optimizer, np.searchsorted(index, parents), rng)
        statistics = statistics.at(index[copies])
        self.state = {name: _zeros(gaussians.count) for name in WINDOW}
        self.state |= {name: upload(statistics.kept[name]) for name in self.kept}
        return len(parents)

    def _collect_statistics(self, step: int, gaussians: Gaussians) -> GaussianStatistics:
        state = {name: np.array(values) for name, values in self.state.items()}
        return GaussianStatistics(
            step=step,
            gradient=state.pop("gradient") / np.maximum(state.pop("seen"), 1),
            radius=state.pop("radius"),
            opacity=1 / (1 + np.exp(-np.array(gaussians.logit_opacities))),
            scale=_largest_scale(gaussians),
            kept=state,
        )

    def _growing(self, gaussians: Gaussians, statistics: GaussianStatistics) -> tuple[np.ndarray, np.ndarray]:
        """(duplicate, split), [N] bool each: small and large Gaussians that are to grow; what is small and wide on the
        screen is both, as in gsplat."""
        config = self.config
        large = statistics.scale > config.duplicate_scale * self.scene_scale
        high = statistics.gradient > self._thresholds(gaussians, statistics)
        split = high & large
        first = np.zeros(len(split))
        if statistics.step < config.screen_size_stop:
            wide = statistics.radius > config.split_screen_size
            split |= wide & high if config.split_screen == "growing" else wide
            if config.split_screen == "held":
                first = np.where(wide, statistics.radius, 0)
        duplicate = high & ~large
        return _limit(duplicate, split, first, statistics.gradient, config.max_gaussians - gaussians.count)


def select_parents(score: np.ndarray, eligible: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """[count] of the eligible ([N] bool) Gaussians, those with the highest score [N] first; where more are wanted than
    there are, the rest is drawn from them with replacement, by score above the lowest. None without eligible ones.

    (Thesis 5.2.1.3 and 5.2.2.4; how the rest is drawn is not said there.)"""
    candidates = np.flatnonzero(eligible)
    if len(candidates) == 0 or count <= 0:
        return np.zeros(0, np.int64)
    best = candidates[np.argsort(-score[candidates], kind="stable")][:count]
    weights = score[candidates] - score[candidates].min() + 1e-6
    rest = rng.choice(candidates, count - len(best), p=weights / weights.sum())
    return np.concatenate([best, rest])


def _largest_scale(gaussians: Gaussians) -> np.ndarray:
    """[N] metres."""
    scales: np.ndarray = np.exp(stack_rows(gaussians.log_scales).max(axis=0))
    return scales


def _limit(
    duplicate: np.ndarray, split: np.ndarray, first: np.ndarray, gradient: np.ndarray, budget: int
) -> tuple[np.ndarray, np.ndarray]:
    """Keep the moves with the largest `first`, of equal ones those with the largest gradients, that add at most
    `budget` Gaussians; each adds one."""
    chosen = np.flatnonzero(duplicate | split)
    added = duplicate.astype(np.int64) + split
    if added.sum() <= budget:
        return duplicate, split
    order = chosen[np.lexsort((-gradient[chosen], -first[chosen]))]
    keep = np.zeros_like(duplicate)
    keep[order[np.cumsum(added[order]) <= budget]] = True
    return duplicate & keep, split & keep


def _zeros(count: int) -> Float:
    """An array of its own: zeros as constants would be one to a recording."""
    return dr.opaque(ad.Float, 0, count)
