"""The mesh-aware strategy (thesis 5.2.1, 5.1 to 5.9, table 5.2): a mesh says where Gaussians may be.

The signed distance is asked for lazily: only of Gaussians whose fate depends on it; of all when the exterior is pruned,
and when there are too few. The side of the surface, which costs most, stays known while a Gaussian has moved less than
it was away from it.
"""

from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Bool, Float
from spacesim.data.errors import InputError, WorkError, check_ranges
from spacesim.data.mesh import SignedDistance
from spacesim.data.structure import check_fields
from spacesim.splat.raster.gaussians import Gaussians, stack_rows
from spacesim.splat.train.strategies.control import (
    DensificationConfig,
    DensityControl,
    GaussianStatistics,
    select_parents,
)
from spacesim.splat.train.strategies.strategy import MAX_STEPS, MAX_THRESHOLD

KNOWN = ("known", "known_x", "known_y", "known_z")


@dataclass(frozen=True)
class MeshAwareConfig:
    """A mesh says where Gaussians may be. Lengths are fractions of the scene's scale."""

    kind: ClassVar[str] = "mesh-aware"

    cull_every: int = 2_500  #: table 5.2, iterations between two prunings of the exterior
    exterior_margin: float = 1e-4  #: table 5.2, tau_out: farther outside is the exterior
    interior_margin: float = 0.05  #: table 5.2, tau_in: deeper inside is the interior
    boundary_ease: float = 0.3  #: table 5.2, lambda_b, factor of the growth threshold between both margins
    min_gaussians: int = 20_000  #: where fewer are left, some are copied (table 5.2)
    protect_interior: bool = True  #: from weak pruning, as what is near the surface

    def __post_init__(self) -> None:
        check_fields(self)
        if not 0 < self.boundary_ease <= 1:
            raise InputError(f"boundary_ease: expected a number in (0, 1], found {self.boundary_ease}")
        check_ranges(
            self, exterior_margin=(0, MAX_THRESHOLD), interior_margin=(0, MAX_THRESHOLD), cull_every=(1, MAX_STEPS)
        )
        check_ranges(self, min_gaussians=(0, MAX_STEPS))


@dataclass(frozen=True, eq=False)
class Regions:
    """The partition of 5.2, [N] bool each: exterior, interior, boundary layer."""

    exterior: np.ndarray  #: outside of the mesh by more than the outer margin
    interior: np.ndarray  #: inside of it by more than the inner margin
    boundary: np.ndarray  #: between both


def regions(distance: np.ndarray, exterior_margin: float, interior_margin: float) -> Regions:
    """Of signed distances [N] (5.2); metres, margins too."""
    exterior, interior = distance > exterior_margin, distance < -interior_margin
    return Regions(exterior, interior, ~(exterior | interior))


def backfill_score(opacity: np.ndarray, distance: np.ndarray, seen: np.ndarray, where: Regions) -> np.ndarray:
    """s_bf [N] of 5.9. seen [N]: steps in which each was seen, of which c is the share of the largest; the largest
    depth below the surface is d_max."""
    depth = np.maximum(-distance, 0)
    score: np.ndarray = opacity + depth / max(depth.max(initial=0), 1e-12)
    score = score + 0.25 * seen / max(seen.max(initial=0), 1)
    return score + 0.5 * where.interior + 0.1 * where.boundary


class MeshAwareStrategy(DensityControl):
    """State beside that of `DensityControl`: "views", steps in which a Gaussian, or what it was copied from, was seen
    since the start; "known" and "known_x", "known_y", "known_z", the signed distance (metres) and the place at which
    its side was asked for, 0 where it was not."""

    unseen = KNOWN

    def __init__(
        self,
        config: DensificationConfig,
        mesh_aware: MeshAwareConfig,
        surface: SignedDistance,
        scene_scale: float,
        count: int,
    ) -> None:
        super().__init__(config, scene_scale, count, kept=("views", *KNOWN))
        self.mesh_aware, self.surface = mesh_aware, surface

    def _accumulate(self, state: dict[str, Float], gradient: Float, radius: Float, visible: Bool) -> None:
        state["views"] = state["views"] + dr.select(visible, ad.Float(1), 0)

    def _thresholds(self, gaussians: Gaussians, statistics: GaussianStatistics) -> np.ndarray:
        """5.6."""
        ease, usual = self.mesh_aware.boundary_ease, self.config.grow_gradient
        open_ = (statistics.gradient > ease * usual) & (statistics.gradient <= usual)
        boundary = self._regions(gaussians, statistics, open_)[1].boundary & open_
        return np.where(boundary, ease * usual, usual)

    def _prunable(self, gaussians: Gaussians, statistics: GaussianStatistics, weak: np.ndarray) -> np.ndarray:
        """The second term of 5.5."""
        where = self._regions(gaussians, statistics, weak)[1]
        return weak & (where.exterior if self.mesh_aware.protect_interior else ~where.boundary)

    def _outside_is_due(self, step: int) -> bool:
        every = self.mesh_aware.cull_every
        return step // every != (step - self.config.refine_every) // every

    def _outside(self, gaussians: Gaussians, statistics: GaussianStatistics) -> np.ndarray:
        """5.3."""
        outside = self._regions(gaussians, statistics, np.ones(gaussians.count, bool))[1].exterior
        if outside.all():
            raise WorkError(
                "training: the strategy mesh-aware would prune every Gaussian, none is within the mesh; "
                "is mesh.ply in the place and scale of the pictures?"
            )
        return outside

    def _parents(
        self, gaussians: Gaussians, statistics: GaussianStatistics, remove: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """5.7 to 5.9, from the interior and the boundary layer."""
        missing = min(self.mesh_aware.min_gaussians, self.config.max_gaussians) - int((~remove).sum())
        if missing <= 0:
            return np.zeros(0, np.int64)
        distance, where = self._regions(gaussians, statistics, ~remove)
        score = backfill_score(statistics.opacity, distance, statistics.kept["views"], where)
        return select_parents(score, ~(remove | where.exterior), missing, rng)

    def _regions(
        self, gaussians: Gaussians, statistics: GaussianStatistics, index: np.ndarray
    ) -> tuple[np.ndarray, Regions]:
        """(signed distance [N] metres, regions); those that are not asked for, [N] bool, have distance 0."""
        margins = [self.scene_scale * m for m in (self.mesh_aware.exterior_margin, self.mesh_aware.interior_margin)]
        distance, means = np.zeros(gaussians.count), stack_rows(gaussians.means).T.astype(np.float64)
        finite = np.isfinite(means).all(axis=1)
        distance[~finite] = np.inf
        index = index & finite
        if index.any():
            distance[index] = self._signed(means, statistics.kept, index, min(margins))
        return distance, regions(distance, *margins)

    def _signed(self, means: np.ndarray, kept: dict[str, np.ndarray], index: np.ndarray, near: float) -> np.ndarray:
        """Signed distances of those asked for, metres; nearer than `near` they count as inside: the regions are the
        same. means [N, 3]; kept: the state, [N] each, which is brought up to date."""
        points = means[index]
        last_distance, *place = (kept[name][index].astype(np.float64) for name in KNOWN)
        distance = self.surface.unsigned(points)
        moved = np.linalg.norm(points - np.stack(place, axis=1), axis=1)
        stale = (moved >= np.abs(last_distance)) & (distance > near)
        outside = last_distance > 0
        outside[stale] = ~self.surface.inside(points[stale])
        signed = np.where(outside & (distance > near), distance, -distance)
        fresh = np.flatnonzero(index)[stale]
        for name, values in zip(KNOWN, (signed, *points.T), strict=True):
            kept[name][fresh] = values[stale]
        return signed
