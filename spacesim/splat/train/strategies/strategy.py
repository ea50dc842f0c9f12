"""What every strategy of densification is: it watches steps, and now and then changes the set of Gaussians.

It knows nothing of pictures, losses or cameras: a trainer gives it gradients and radii on the screen, and hands it
Gaussians and the optimizer whose moments have to follow them.
"""

from abc import ABC, abstractmethod

import numpy as np

from spacesim.backend.arrays import Bool, Float
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.train.optimizer.adam import Adam
from spacesim.splat.train.strategies.densify import DensificationCounts

MAX_STEPS = 10**9  #: of any count of iterations that is configured
MAX_THRESHOLD = 1e6  #: of any threshold or length that is configured


class Strategy(ABC):
    """state: {name: Float [N]}, all that the next densification step depends on beside the Gaussians themselves; goes
    into checkpoints. `refine` rearranges it with the Gaussians that it duplicates, splits or prunes."""

    state: dict[str, Float]

    @abstractmethod
    def observes_step(self, step: int) -> bool:
        """Whether `observe` is wanted after step number `step`, the first of which is 1."""

    @abstractmethod
    def observe(self, gradient: Float, radius: Float, visible: Bool) -> None:
        """After each view of a step. gradient: norm of the absolute screen-space gradient [N]; radius: three standard
        deviations on the screen as a fraction of the image's longer side [N]; visible: [N] bool, what is in the
        picture, however faint."""

    @abstractmethod
    def refine(
        self, step: int, gaussians: Gaussians, optimizer: Adam, rng: np.random.Generator, leniency: float = 1.0
    ) -> DensificationCounts:
        """Refine if it is time to, after `step` finished steps, a multiple of `refine_every`. Changes `gaussians`,
        `optimizer` and the state.

        leniency: factor of the opacity below which a Gaussian is too faint (conservative culling, thesis 5.3)."""

    def add_noise(self, step: int, gaussians: Gaussians, rate: float, seed: int) -> None:  # noqa: B027
        """After each step, before `refine`. rate: step size of the means, metres. Most do nothing."""
