"""The strategy that a configuration names."""

from dataclasses import replace
from typing import TYPE_CHECKING

from spacesim.data.mesh import SignedDistance
from spacesim.data.records import Dataset
from spacesim.splat.train.prior import check_outside, known_mesh
from spacesim.splat.train.strategies.default import DefaultStrategy, DefaultStrategyConfig
from spacesim.splat.train.strategies.mcmc import McmcConfig, McmcStrategy
from spacesim.splat.train.strategies.mesh_aware import MeshAwareConfig, MeshAwareStrategy
from spacesim.splat.train.strategies.strategy import Strategy
from spacesim.splat.train.strategies.support_aware import SupportAwareConfig, SupportAwareStrategy

if TYPE_CHECKING:
    from spacesim.splat.train.config import TrainConfig


def make_strategy(config: "TrainConfig", dataset: Dataset, scene_scale: float, count: int) -> Strategy:
    """For `count` Gaussians at the start.

    Raises InputError where the dataset lacks the mesh that it needs, or has one that is out of place."""
    schedule = replace(config.refinement, refine_stop=config.refine_stop)
    strategy = config.strategy
    if isinstance(strategy, MeshAwareConfig):
        distance = SignedDistance.of(dataset.root / known_mesh(dataset, "strategy mesh-aware"))
        check_outside(distance, dataset, "strategy mesh-aware")
        return MeshAwareStrategy(schedule, strategy, distance, scene_scale, count)
    if isinstance(strategy, SupportAwareConfig):
        warm_start = config.warm_start.steps if config.warm_start else 0
        return SupportAwareStrategy(schedule, strategy, scene_scale, count, warm_start)
    if isinstance(strategy, McmcConfig):
        return McmcStrategy(schedule, strategy, scene_scale)
    if isinstance(strategy, DefaultStrategyConfig):
        return DefaultStrategy(schedule, scene_scale, count)
    raise TypeError(f"strategy: expected one that is made here, found {type(strategy).__name__}")
