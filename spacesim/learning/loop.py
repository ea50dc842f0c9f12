"""The loop of a training, of any method: history, progress, checkpoints, and how it is asked to stop."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from spacesim.backend.arrays import Float
from spacesim.data.errors import WorkError
from spacesim.learning.folder import TrainingProgress

HISTORY_EVERY = 50  #: iterations between two entries of the history


class TrainingLoop(ABC):
    """What trains a model, one step after another."""

    config: Any  #: with `iterations` and `checkpoint_every`
    iteration: int  #: steps taken
    history: list[dict[str, float]]  #: iteration and loss now and then, of Gaussians their number

    @abstractmethod
    def step(self) -> Float:
        """One update. Returns the loss, Float of width 1."""

    @property
    def gaussian_count(self) -> int | None:
        """None of a model without Gaussians."""
        return None

    def run(
        self,
        on_progress: Callable[[TrainingProgress], None],
        on_checkpoint: Callable[[], None],
        should_stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """Train from `self.iteration` to the end. Raises KeyboardInterrupt after a step and its checkpoint where it is
        asked to stop, WorkError where the loss is not finite."""
        config = self.config
        while self.iteration < config.iterations:
            loss = self.step()
            last = self.iteration == config.iterations
            if self.iteration % HISTORY_EVERY == 0 or last:
                on_progress(self._record(float(loss[0])))
            stop = should_stop()
            if stop:
                self._check(float(loss[0]))
            if stop or (self.iteration % config.checkpoint_every == 0 and not last):
                on_checkpoint()
            if stop:
                raise KeyboardInterrupt

    def _record(self, loss: float) -> TrainingProgress:
        self._check(loss)
        count = self.gaussian_count
        counted = {} if count is None else {"gaussians": count}
        self.history.append({"iteration": self.iteration, "loss": loss, **counted})
        return TrainingProgress(self.iteration, self.config.iterations, loss, count)

    def _check(self, loss: float) -> None:
        if not math.isfinite(loss):
            raise WorkError(f"training: the loss is {loss} at iteration {self.iteration}; the last checkpoint is kept")
