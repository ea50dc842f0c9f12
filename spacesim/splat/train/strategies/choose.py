"""The strategy that a configuration names."""

from dataclasses import replace
from typing import TYPE_CHECKING

from spacesim.data.mesh import SignedDistance
from spacesim.data.records import Dataset
from spacesim.splat.train.prior import check_outside, known_mesh
from spacesim.splat.train.strategies.default import DefaultStrategy
from spacesim.splat.train.strategies.mcmc import McmcStrategy
from spacesim.splat.train.strategies.mesh_aware import MeshAwareStrategy
from spacesim.splat.train.strategies.strategy import Strategy
from spacesim.splat.train.strategies.support_aware import SupportAwareStrategy

if TYPE_CHECKING:
    from spacesim.splat.train.config import TrainConfig


def strategy_of(config: "TrainConfig", dataset: Dataset, scene_scale: float, count: int) -> Strategy:
    """For `count` Gaussians at the start. Refinement is over before the last step: what it changes is to be trained.

    Raises InputError where the dataset lacks the mesh that it needs, or has one that is out of place."""
    schedule = replace(config.refinement, refine_stop=min(config.refinement.refine_stop, config.iterations))
    if config.strategy == "mesh-aware":
        distance = SignedDistance.of(dataset.root / known_mesh(dataset, "--strategy mesh-aware"))
        check_outside(distance, dataset, "--strategy mesh-aware")
        return MeshAwareStrategy(schedule, config.mesh_aware, distance, scene_scale, count)
    if config.strategy == "support-aware":
        return SupportAwareStrategy(schedule, config.support_aware, scene_scale, count)
    if config.strategy == "mcmc":
        return McmcStrategy(schedule, config.mcmc, scene_scale)
    return DefaultStrategy(schedule, scene_scale, count)
