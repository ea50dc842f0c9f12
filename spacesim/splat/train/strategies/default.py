"""The default strategy: adaptive density control (Kerbl et al. 2023), with the thesis's parameters (table 5.1).

Where the table is silent the values are those of Nerfstudio's splatfacto, which the thesis trains with.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.splat.gaussians import Gaussians
from spacesim.splat.train.densify import Refinement, grow, limit_opacities, prune
from spacesim.splat.train.optimizer import Adam


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
    refine_stop: int = 15_000  #: iterations
    screen_size_stop: int = 15_000  #: iterations; until then screen sizes split and, after the first reset, prune


class DefaultStrategy:
    """Watches every step (`observe`) and now and then changes the set of Gaussians (`refine`).

    State, [N] each: sum of gradient norms, number of steps in which a Gaussian was seen, largest radius.
    """

    def __init__(self, config: DefaultStrategyConfig, scene_scale: float, count: int) -> None:
        self.config, self.scene_scale = config, scene_scale
        self.state = {name: dr.zeros(ad.Float, count) for name in ("gradient", "seen", "radius")}

    def observe(self, gradient: Any, radius: Any, visible: Any) -> None:
        """After each step. gradient: norm of the absolute screen-space gradient [N]; radius: largest screen-space
        radius as a fraction of the image's longer side [N]; visible: [N] bool."""
        state = self.state
        state["gradient"] = state["gradient"] + dr.select(visible, gradient, 0)
        state["seen"] = state["seen"] + dr.select(visible, ad.Float(1), 0)
        state["radius"] = dr.maximum(state["radius"], dr.select(visible, radius, 0))
        dr.eval(state)

    def refine(self, step: int, gaussians: Gaussians, optimizer: Adam, rng: np.random.Generator) -> Refinement:
        """Refine if it is time to, after `step` finished steps. Changes `gaussians`, `optimizer` and the state."""
        config = self.config
        done = Refinement()
        since_reset = step % (config.reset_every * config.refine_every)
        active = config.refine_start < step < config.refine_stop
        if active and step % config.refine_every == 0 and since_reset >= config.pause_after_reset:
            done = self._grow_and_prune(step, gaussians, optimizer, rng)
        if active and since_reset == 0:
            limit_opacities(gaussians, optimizer, 2 * config.prune_opacity)
        return done

    def _grow_and_prune(self, step: int, gaussians: Gaussians, optimizer: Adam, rng: np.random.Generator) -> Refinement:
        config = self.config
        seen, radius = np.array(self.state["seen"]), np.array(self.state["radius"])
        gradient = np.array(self.state["gradient"]) / np.maximum(seen, 1)
        large = _largest_scale(gaussians) > config.duplicate_scale * self.scene_scale
        high = gradient > config.grow_gradient
        split = high & large
        if step < config.screen_size_stop:
            split |= radius > config.split_screen_size
        duplicate = high & ~large & ~split
        duplicate, split = _limit(duplicate, split, gradient, config.max_gaussians - gaussians.count)
        source = grow(gaussians, optimizer, duplicate, split, rng)
        halves = np.arange(len(source)) >= len(split) - split.sum() + duplicate.sum()
        radius = np.where(halves, 0, radius[source])

        remove = 1 / (1 + np.exp(-np.array(gaussians.logit_opacities))) < config.prune_opacity
        if step > config.reset_every * config.refine_every:
            remove |= _largest_scale(gaussians) > config.prune_scale * self.scene_scale
            if step < config.screen_size_stop:
                remove |= radius > config.prune_screen_size
        prune(gaussians, optimizer, remove)
        self.state = {name: dr.zeros(ad.Float, gaussians.count) for name in self.state}
        return Refinement(int(duplicate.sum()), int(split.sum()), int(remove.sum()))


def _largest_scale(gaussians: Gaussians) -> np.ndarray:
    """[N] metres."""
    return np.exp(np.array(gaussians.log_scales).max(axis=0))


def _limit(duplicate: np.ndarray, split: np.ndarray, gradient: np.ndarray, room: int) -> tuple[np.ndarray, np.ndarray]:
    """Keep the `room` moves with the largest gradients; each adds one Gaussian."""
    wanted = np.flatnonzero(duplicate | split)
    if len(wanted) <= room:
        return duplicate, split
    keep = np.zeros_like(duplicate)
    keep[wanted[np.argsort(-gradient[wanted], kind="stable")[: max(room, 0)]]] = True
    return duplicate & keep, split & keep
