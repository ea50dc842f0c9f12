"""What every strategy of densification is: it watches steps, and now and then changes the set of Gaussians.

It knows nothing of losses or cameras, and of pictures their size: a trainer gives it gradients and radii on the screen,
and hands it Gaussians and the optimizer whose moments have to follow them.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import drjit as dr
import numpy as np

from spacesim.backend.arrays import Bool, Float
from spacesim.backend.packet import numbers_at
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.train.optimizer.adam import Adam
from spacesim.splat.train.strategies.densify import DensificationCounts

MAX_STEPS = 10**9  #: of any count of iterations that is configured
MAX_THRESHOLD = 1e6  #: of any threshold or length that is configured


@dataclass(frozen=True, eq=False)
class OnScreen:
    """What a view of a step says of each Gaussian, [N] but for `sizes`."""

    absolute_x: Float  #: absolute gradient by the place on the screen, per pixel
    absolute_y: Float  #: likewise
    radii: Float  #: three standard deviations on the screen, pixels, 0 of what is not in the picture
    sizes: Float  #: Float [3], half the picture's width and height, its longer side, pixels

    def measures(self) -> tuple[Float, Float, Bool]:
        """The norm of the gradient by half a picture, the radius as a share of the picture's longer side, and who is in
        the picture, however faint."""
        half_width, half_height, longer = numbers_at(self.sizes, range(3))
        gradient = dr.sqrt(dr.square(self.absolute_x * half_width) + dr.square(self.absolute_y * half_height))
        return gradient, self.radii / longer, self.radii > 0


class Strategy(ABC):
    """state: {name: Float [N]}, all that the next densification step depends on beside the Gaussians themselves; goes
    into checkpoints. `refine` rearranges it with the Gaussians that it duplicates, splits or prunes."""

    state: dict[str, Float]

    @abstractmethod
    def observes_step(self, step: int) -> bool:
        """Whether `observe` is wanted after step number `step`, the first of which is 1."""

    @abstractmethod
    def observed_state(self) -> dict[str, Float]:
        """What of the state observations change."""

    @abstractmethod
    def observe(self, state: dict[str, Float], seen: list[OnScreen]) -> dict[str, Float]:
        """`observed_state` after the views of a step. A part of recordings: it depends on nothing that changes."""

    @abstractmethod
    def refine(
        self, step: int, gaussians: Gaussians, optimizer: Adam, rng: np.random.Generator, leniency: float = 1.0
    ) -> DensificationCounts:
        """Refine if it is time to, after `step` finished steps, a multiple of `refine_every`. Changes `gaussians`,
        `optimizer` and the state.

        leniency: factor of the opacity below which a Gaussian is too faint (conservative culling, thesis 5.3)."""

    def add_noise(self, step: int, gaussians: Gaussians, rate: float, seed: int) -> None:  # noqa: B027
        """After each step, before `refine`. rate: step size of the means, metres. Most do nothing."""
