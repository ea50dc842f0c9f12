"""Adaptive density control (Kerbl et al. 2023) with the thesis's parameters (table 5.1): the schedule and the rules
that the default strategy is, and that the mesh-aware and the support-aware one change in places.

Where the table is silent the values are those of Nerfstudio's splatfacto, which the thesis trains with.
"""

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad, recorded
from spacesim.data.errors import InputError, check_ranges
from spacesim.splat.raster.bin import RECORDINGS
from spacesim.splat.raster.gaussians import Gaussians, numbers, uploaded
from spacesim.splat.train.densify import Refinement, append_copies, grow, limit_opacities, prune
from spacesim.splat.train.optimizer import Adam
from spacesim.splat.train.strategies.strategy import MOST_SIZE, MOST_STEPS, Strategy

WINDOW = ("gradient", "seen", "radius")  #: statistics since the last refinement


@dataclass(frozen=True)
class DefaultStrategyConfig:
    """Lengths are fractions of the scene's scale, screen sizes are radii as fractions of the image's longer side."""

    prune_opacity: float = 0.05  #: table 5.1, opacity culling threshold
    prune_scale: float = 0.05  #: table 5.1, scale culling threshold
    prune_screen_size: float = 0.05  #: table 5.1
    split_screen_size: float = 0.01  #: table 5.1
    refine_every: int = 100  #: table 5.1, iterations
    reset_every: int = 30  #: table 5.1, refinements between two opacity resets
    pause_after_reset: int = 1000  #: table 5.1, iterations without refinement
    max_gaussians: int = 250_000  #: table 5.1
    grow_gradient: float = 0.0008  #: absolute screen-space gradient, half images per unit of loss
    duplicate_scale: float = 0.01  #: larger Gaussians are split, smaller ones duplicated
    refine_start: int = 500  #: iterations
    refine_stop: int = 15_000  #: iterations, at most those of the training; a reset's pause is over by then
    screen_size_stop: int = 15_000  #: iterations; until then screen sizes split and, after the first reset, prune

    def __post_init__(self) -> None:
        if self.max_gaussians < 1:
            raise InputError(f"--max-gaussians: expected at least 1, found {self.max_gaussians}")
        if not 0 < self.prune_opacity < 0.5:  # a reset lowers to twice as much
            raise InputError(f"--prune-opacity: expected above 0 and below 0.5, found {self.prune_opacity}")
        if not 0 < self.split_screen_size < float("inf"):
            raise InputError(f"--split-screen-size: expected a number above 0, found {self.split_screen_size}")
        sizes, steps = (0, MOST_SIZE), (0, MOST_STEPS)
        check_ranges(self, prune_scale=sizes, prune_screen_size=sizes, grow_gradient=sizes, duplicate_scale=sizes)
        check_ranges(self, refine_every=(1, MOST_STEPS), reset_every=(1, MOST_STEPS), pause_after_reset=steps)
        check_ranges(self, refine_start=steps, refine_stop=steps, screen_size_stop=steps)


@dataclass(frozen=True, eq=False)
class Survey:
    """What a refinement knows of each Gaussian, [N] each.

    step: how many are finished
    gradient: mean over the views since the last refinement that showed it, half images per unit of loss
    radius: largest since then, fraction of the image's longer side;  opacity: in (0, 1)
    scale: standard deviation along the longest axis, metres;  kept: {name: [N]} of the state that outlives refinements,
        and what a strategy adds of its own
    """

    step: int
    gradient: np.ndarray
    radius: np.ndarray
    opacity: np.ndarray
    scale: np.ndarray
    kept: dict[str, np.ndarray]

    def at(self, index: np.ndarray) -> "Survey":
        """Of Gaussians that are copies of the Gaussians index [M]."""
        kept = {name: values[index] for name, values in self.kept.items()}
        opacity, scale = self.opacity[index], self.scale[index]
        return Survey(self.step, self.gradient[index], self.radius[index], opacity, scale, kept)


class DensityControl(Strategy):
    """Duplicates, splits, prunes and resets on table 5.1's schedule. Subclasses say which gradients make a Gaussian
    grow (`_thresholds`), which Gaussians are too weak to stay (`_expendable`), what is pruned beside (`_outside`), and
    which ones are copied where too few are left (`_parents`).

    State, [N] each: sum of gradient norms, number of steps in which a Gaussian was seen, largest radius, all since the
    last refinement; and what a subclass adds, which outlives refinements.
    """

    unseen: tuple[str, ...] = ()  #: of the state, what no observation changes

    def __init__(self, config: DefaultStrategyConfig, scene_scale: float, count: int, kept: tuple[str, ...]) -> None:
        self.config, self.scene_scale, self.kept = config, scene_scale, kept
        self.state = {name: _zeros(count) for name in (*WINDOW, *kept)}
        self._observed = recorded(self._observation, RECORDINGS)

    def watches(self, step: int) -> bool:
        return step < self.config.refine_stop

    def observe(self, gradient: Any, radius: Any, visible: Any) -> None:
        seen = {name: values for name, values in self.state.items() if name not in self.unseen}
        self.state |= self._observed(seen, gradient, radius, visible)

    def _observation(self, state: dict[str, Any], gradient: Any, radius: Any, visible: Any) -> dict[str, Any]:
        """The state with an observation more."""
        state = dict(state)
        state["gradient"] = state["gradient"] + dr.select(visible, gradient, 0)
        state["seen"] = state["seen"] + dr.select(visible, ad.Float(1), 0)
        state["radius"] = dr.maximum(state["radius"], dr.select(visible, radius, 0))
        self._accumulate(state, gradient, radius, visible)
        return state

    def refine(
        self, step: int, gaussians: Gaussians, optimizer: Adam, rng: np.random.Generator, leniency: float = 1.0
    ) -> Refinement:
        config = self.config
        done = Refinement()
        since_reset = step % (config.reset_every * config.refine_every)
        active = config.refine_start < step < config.refine_stop
        if active and step % config.refine_every == 0:
            if since_reset >= config.pause_after_reset:
                done = self._grow_and_prune(step, gaussians, optimizer, rng, leniency)
            elif self._outside_is_due(step):
                done = self._prune_outside(step, gaussians, optimizer, rng)
        if active and since_reset == 0 and step + config.pause_after_reset <= config.refine_stop:
            limit_opacities(gaussians, optimizer, 2 * config.prune_opacity)
        return done

    def _accumulate(self, state: dict[str, Any], gradient: Any, radius: Any, visible: Any) -> None:
        """Add an observation to what of the state outlives refinements. Recorded: it depends on nothing else."""

    @abstractmethod
    def _thresholds(self, gaussians: Gaussians, survey: Survey) -> np.ndarray:
        """[N] gradient above which each Gaussian grows (5.6, 5.16)."""

    @abstractmethod
    def _expendable(self, gaussians: Gaussians, survey: Survey, weak: np.ndarray) -> np.ndarray:
        """[N] bool: those of the weak ones, [N] bool, that nothing protects (5.5, 5.14)."""

    def _outside_is_due(self, step: int) -> bool:
        """Whether Gaussians are pruned at this refinement for where they are."""
        return False

    def _outside(self, gaussians: Gaussians, survey: Survey) -> np.ndarray:
        """[N] bool: pruned for where they are (5.3)."""
        return np.zeros(gaussians.count, bool)

    def _parents(
        self, gaussians: Gaussians, survey: Survey, remove: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """[K] Gaussians that are copied so that there are enough after those in `remove` [N] have gone (5.8); they are
        none of these, and may repeat."""
        return np.zeros(0, np.int64)

    def _grow_and_prune(
        self, step: int, gaussians: Gaussians, optimizer: Adam, rng: np.random.Generator, leniency: float
    ) -> Refinement:
        config = self.config
        survey = self._survey(step, gaussians)
        duplicate, split = self._growing(gaussians, survey)
        source = grow(gaussians, optimizer, duplicate, split, rng)
        halves = np.arange(len(source)) >= len(split) - split.sum() + duplicate.sum()
        survey = survey.at(source)
        survey = replace(survey, radius=np.where(halves, 0, survey.radius), scale=_largest_scale(gaussians))

        remove = self._expendable(gaussians, survey, survey.opacity < leniency * config.prune_opacity)  # 5.4, 5.13
        if step > config.reset_every * config.refine_every:
            remove = remove | (survey.scale > config.prune_scale * self.scene_scale)
            if step < config.screen_size_stop:
                remove |= survey.radius > config.prune_screen_size
        if self._outside_is_due(step):
            remove = remove | self._outside(gaussians, survey)
        added = self._prune_and_fill(gaussians, optimizer, survey, remove, rng)
        return Refinement(int(duplicate.sum()), int(split.sum()), int(remove.sum()), added)

    def _prune_outside(self, step: int, gaussians: Gaussians, optimizer: Adam, rng: np.random.Generator) -> Refinement:
        """In the pause after a reset, when opacities tell nothing."""
        survey = self._survey(step, gaussians)
        remove = self._outside(gaussians, survey)
        added = self._prune_and_fill(gaussians, optimizer, survey, remove, rng)
        return Refinement(pruned=int(remove.sum()), added=added)

    def _prune_and_fill(
        self,
        gaussians: Gaussians,
        optimizer: Adam,
        survey: Survey,
        remove: np.ndarray,
        rng: np.random.Generator,
    ) -> int:
        """Prune, copy where too few are left, begin new statistics. Returns how many were added."""
        parents = self._parents(gaussians, survey, remove, rng)
        index = prune(gaussians, optimizer, remove)
        copies = append_copies(gaussians, optimizer, np.searchsorted(index, parents), rng)
        survey = survey.at(index[copies])
        self.state = {name: _zeros(gaussians.count) for name in WINDOW}
        self.state |= {name: uploaded(survey.kept[name]) for name in self.kept}
        return len(parents)

    def _survey(self, step: int, gaussians: Gaussians) -> Survey:
        state = {name: np.array(values) for name, values in self.state.items()}
        return Survey(
            step=step,
            gradient=state.pop("gradient") / np.maximum(state.pop("seen"), 1),
            radius=state.pop("radius"),
            opacity=1 / (1 + np.exp(-np.array(gaussians.logit_opacities))),
            scale=_largest_scale(gaussians),
            kept=state,
        )

    def _growing(self, gaussians: Gaussians, survey: Survey) -> tuple[np.ndarray, np.ndarray]:
        """(duplicate, split), [N] bool each: small and large Gaussians that are to grow."""
        config = self.config
        large = survey.scale > config.duplicate_scale * self.scene_scale
        high = survey.gradient > self._thresholds(gaussians, survey)
        split = high & large
        if survey.step < config.screen_size_stop:
            split |= survey.radius > config.split_screen_size
        duplicate = high & ~large & ~split
        return _limit(duplicate, split, survey.gradient, config.max_gaussians - gaussians.count)


def chosen_parents(score: np.ndarray, eligible: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
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
    scales: np.ndarray = np.exp(numbers(gaussians.log_scales).max(axis=0))
    return scales


def _limit(duplicate: np.ndarray, split: np.ndarray, gradient: np.ndarray, room: int) -> tuple[np.ndarray, np.ndarray]:
    """Keep the `room` moves with the largest gradients; each adds one Gaussian."""
    wanted = np.flatnonzero(duplicate | split)
    if len(wanted) <= room:
        return duplicate, split
    keep = np.zeros_like(duplicate)
    keep[wanted[np.argsort(-gradient[wanted], kind="stable")[: max(room, 0)]]] = True
    return duplicate & keep, split & keep


def _zeros(count: int) -> Any:
    """An array of its own: zeros as constants would be one to a recording."""
    return dr.opaque(ad.Float, 0, count)
