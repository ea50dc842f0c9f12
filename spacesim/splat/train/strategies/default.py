"""The default strategy: adaptive density control as it is (table 5.1)."""

import numpy as np

from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.train.strategies.control import DefaultStrategyConfig, DensityControl, Survey

__all__ = ["DefaultStrategy", "DefaultStrategyConfig"]


class DefaultStrategy(DensityControl):
    """One threshold for all; whatever is faint goes."""

    def __init__(self, config: DefaultStrategyConfig, scene_scale: float, count: int) -> None:
        super().__init__(config, scene_scale, count, kept=())

    def _thresholds(self, gaussians: Gaussians, survey: Survey) -> np.ndarray:
        return np.full(len(survey.gradient), self.config.grow_gradient)

    def _expendable(self, gaussians: Gaussians, survey: Survey, weak: np.ndarray) -> np.ndarray:
        return weak
