"""Gaussians as samples of a Markov chain (Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo").

Dead Gaussians move to where live ones are, more come the same way, and all of them jitter. The opacity and scale
penalties that belong to it are the loss's: `TrainConfig.opacity_weight` and `scale_weight`.
"""

from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import numpy as np

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Float, UInt64
from spacesim.backend.upload import upload, upload_numbers, upload_rows
from spacesim.data.errors import InputError, check_ranges
from spacesim.data.structure import check_fields
from spacesim.splat.raster.gaussians import Gaussians, opacities, principal_axes, stack_rows
from spacesim.splat.train.optimizer.adam import Adam
from spacesim.splat.train.strategies.control import DensificationConfig
from spacesim.splat.train.strategies.densify import DensificationCounts, rearrange
from spacesim.splat.train.strategies.strategy import OnScreen, Strategy

MAX_COPIES = 51  #: of one Gaussian whose sum of binomials is computed, as the paper's code has it; more count as 51
GOLDEN = 0x9E3779B97F4A7C15  #: 2^64 over the golden ratio
OPACITY_GATE_SLOPE = 100.0  #: steepness of the paper's sigmoid gate: faint Gaussians jitter, opaque ones stay


@dataclass(frozen=True)
class McmcConfig:
    """Gaussians as samples of a Markov chain. Schedule and the greatest number of Gaussians are those of
    `DensificationConfig`, whose other rules do not count here."""

    kind: ClassVar[str] = "mcmc"
    #: of `DensificationConfig`; a strategy without this reads all
    reads: ClassVar[tuple[str, ...]] = ("refine_every", "max_gaussians", "refine_start", "refine_stop")

    min_opacity: float = 0.005  #: at most so opaque is dead
    growth: float = 0.05  #: more Gaussians each time, a share of those there are
    noise: float = 5e5  #: lambda_noise of the paper's code, for scenes as large as 1

    def __post_init__(self) -> None:
        check_fields(self)
        if not 0 < self.min_opacity < 1:
            raise InputError(f"min_opacity: expected a number above 0 and below 1, found {self.min_opacity}")
        check_ranges(self, growth=(0, 100), noise=(0, 1e12))


def compute_relocation(opacity: np.ndarray, scales: np.ndarray, copies: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(opacities [N], scales [N, 3]) that `copies` [N] Gaussians in one place need to look like one, by the paper:
    o' = 1 - (1 - o)^(1/n), s' = s o / sum_{i=1}^n sum_{k=0}^{i-1} C(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1).

    The sum over i is C(n, k+1): hockey sticks of Pascal's triangle."""
    from scipy.special import comb

    copies = np.minimum(copies, MAX_COPIES)
    opacity = np.minimum(np.asarray(opacity, np.float64), 1 - 1e-6)
    each = -np.expm1(np.log1p(-opacity) / copies)
    total = np.zeros(len(each))
    for k in range(int(copies.max(initial=1))):
        total += comb(copies, k + 1) * (-1) ** k * each ** (k + 1) / np.sqrt(k + 1)
    return each, scales * (opacity / total)[:, None]


class McmcStrategy(Strategy):
    """Without state: who is dead is seen from the opacity."""

    def __init__(self, schedule: DensificationConfig, mcmc: McmcConfig, scene_scale: float) -> None:
        self.schedule, self.mcmc, self.scene_scale = schedule, mcmc, scene_scale
        self.state: dict[str, Float] = {}

    def observes_step(self, step: int) -> bool:
        return False

    def observed_state(self) -> dict[str, Float]:
        return {}

    def observe(self, state: dict[str, Float], seen: list[OnScreen]) -> dict[str, Float]:
        return state

    def add_noise(self, step: int, gaussians: Gaussians, rate: float, seed: int) -> None:
        """Noise on the means (stochastic gradient Langevin dynamics): Sigma times a normal vector, times the learning
        rate, times a gate that closes above the opacity at which Gaussians are dead. In a scene of size 1, as the
        paper's lengths."""
        if self.mcmc.noise == 0:
            return
        factor = self.mcmc.noise * rate / self.scene_scale**2
        stream = int(np.random.SeedSequence([seed, 5, step]).generate_state(1, np.uint64)[0])
        values = upload_numbers([factor, self.mcmc.min_opacity])
        gaussians.means = ad.Array3f(_jittered(gaussians.shape_rows(), values, dr.opaque(ad.UInt64, stream)))

    def refine(
        self, step: int, gaussians: Gaussians, optimizer: Adam, rng: np.random.Generator, leniency: float = 1.0
    ) -> DensificationCounts:
        schedule = self.schedule
        if not (schedule.is_active(step) and step % schedule.refine_every == 0):
            return DensificationCounts()
        opacity = 1 / (1 + np.exp(-np.array(gaussians.logit_opacities, np.float64)))
        dead = opacity <= leniency * self.mcmc.min_opacity
        alive = np.flatnonzero(~dead)
        if len(alive) == 0:
            return DensificationCounts()
        target = min(int((1 + self.mcmc.growth) * gaussians.count), max(schedule.max_gaussians, gaussians.count))
        fresh = np.concatenate([np.flatnonzero(dead), np.arange(gaussians.count, target)])
        weights = opacity[alive]
        chosen = rng.choice(alive, len(fresh), p=weights / weights.sum())
        self._relocate(gaussians, optimizer, opacity, fresh, chosen)
        return DensificationCounts(added=target - len(opacity), relocated=int(dead.sum()))

    def _relocate(
        self, gaussians: Gaussians, optimizer: Adam, opacity: np.ndarray, fresh: np.ndarray, chosen: np.ndarray
    ) -> None:
        """Gaussians `fresh` [K], dead or new, become copies of Gaussians `chosen` [K], which share with them."""
        if len(fresh) == 0:
            return
        count = max(int(fresh.max()) + 1, gaussians.count)
        index = np.arange(count)
        index[fresh] = chosen
        copies = 1 + np.bincount(chosen, minlength=len(opacity))
        moved = copies[index] > 1
        before = stack_rows(gaussians.log_scales)
        scales = np.exp(before.T.astype(np.float64))
        each, narrower = opacity.copy(), scales.copy()
        several = copies > 1
        each[several], narrower[several] = compute_relocation(opacity[several], scales[several], copies[several])
        each = np.clip(each, self.mcmc.min_opacity, 1 - 1e-6)
        logits = np.array(gaussians.logit_opacities)[index]
        log_scales = before[:, index]
        logits[moved] = np.log(each / (1 - each))[index[moved]]
        log_scales[:, moved] = np.log(narrower[index[moved]]).T
        rearrange(gaussians, optimizer, index, moved)
        gaussians.logit_opacities = upload(logits)
        gaussians.log_scales = upload_rows(log_scales)


@recorded
def _jittered(rows: list[Float], values: Float, streams: UInt64) -> list[Float]:
    """Means after noise. values: Float [2], factor and gate;  streams: UInt64 [1], where random numbers begin"""
    place = dr.arange(ad.UInt32, dr.width(rows[0]))
    random = ad.PCG32()
    start = dr.gather(ad.UInt64, streams, ad.UInt32(0)) ^ (ad.UInt64(place) * GOLDEN)  # neighbours begin far apart
    random.seed(initstate=start, initseq=ad.UInt64(place))
    normal = [random.next_float32_normal() for _ in range(3)]
    scales = [dr.exp(row) for row in rows[3:6]]
    axes = principal_axes(ad.Array4f(rows[6:10]))
    factor, least = (dr.gather(ad.Float, values, ad.UInt32(i)) for i in range(2))
    opening = factor * dr.rcp(1 + dr.exp(OPACITY_GATE_SLOPE * (opacities(rows[10]) - least)))
    vector = ad.Array3f(normal)
    along = [dr.dot(axis, vector) * scale * scale for axis, scale in zip(axes, scales, strict=True)]
    moved = ad.Array3f(rows[:3]) + opening * (along[0] * axes[0] + along[1] * axes[1] + along[2] * axes[2])
    return list(moved)
