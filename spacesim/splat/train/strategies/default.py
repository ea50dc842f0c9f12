"""The default strategy: adaptive density control as it is (table 5.1)."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.train.strategies.control import DensificationConfig, DensityControl, GaussianStatistics


@dataclass(frozen=True)
class DefaultStrategyConfig:
    """Nothing beside the densification of every strategy."""

    kind: ClassVar[str] = "default"


class DefaultStrategy(DensityControl):
    """One threshold for all; whatever is faint goes."""

    def __init__(self, config: DensificationConfig, scene_scale: float, count: int) -> None:
        super().__init__(config, scene_scale, count, kept=())

    def _thresholds(self, gaussians: Gaussians, statistics: GaussianStatistics) -> np.ndarray:
        return np.full(len(statistics.gradient), self.config.grow_gradient)

    def _prunable(self, gaussians: Gaussians, statistics: GaussianStatistics, weak: np.ndarray) -> np.ndarray:
        return weak
