"""The strategy that a configuration names."""

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
    """For `count` Gaussians at the start. Raises InputError where the dataset lacks the mesh that it needs, or
    has one that is out of place."""
    if config.strategy == "mesh-aware":
        distance = SignedDistance.of(dataset.root / known_mesh(dataset, "--strategy mesh-aware"))
        check_outside(distance, dataset, "--strategy mesh-aware")
        return MeshAwareStrategy(config.refinement, config.mesh_aware, distance, scene_scale, count)
    if config.strategy == "support-aware":
        return SupportAwareStrategy(config.refinement, config.support_aware, scene_scale, count)
    if config.strategy == "mcmc":
        return McmcStrategy(config.refinement, config.mcmc, scene_scale)
    return DefaultStrategy(config.refinement, scene_scale, count)
