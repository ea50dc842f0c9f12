"""The training of a model, of any method: its loop, checkpoints, how it is asked to stop, the run that it leaves."""

import logging
import math
import shlex
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from spacesim import backend, interrupts
from spacesim.backend.arrays import Float
from spacesim.data.errors import InputError, WorkError
from spacesim.data.files import JsonDict, write_json
from spacesim.data.structure import Rules, structure
from spacesim.data.toml import Document
from spacesim.learning.folder import (
    TrainingClock,
    TrainingProgress,
    checkpoints,
    device,
    versions,
    write_checkpoint,
)
from spacesim.learning.forecast import TimeLeft
from spacesim.learning.tensors import first_not_finite, read_tensors, write_tensors

HISTORY_EVERY = 50  #: iterations between two entries of the history

log = logging.getLogger(__name__)


class TrainingLoop(ABC):
    """What trains a model, one step after another. A family of methods says what a step is, and what there is to keep.

    The same dataset, configuration and backend give bitwise the same model, also across `save` and `restore`.
    """

    form: ClassVar[str]  #: the word by which files of the family are known, see `read_tensors`
    header: ClassVar[type]  #: record of what a checkpoint says beside its arrays: iteration, history, `counts`
    config: Any  #: with `iterations`, `checkpoint_every`, `to_json`
    iteration: int  #: steps taken
    history: list[dict[str, float]]  #: iteration and loss now and then, of Gaussians their number
    seconds: dict[str, float]  #: parts of training's time that the run distinguishes, by their names

    @abstractmethod
    def step(self) -> Float:
        """One update. Returns the loss, Float of width 1."""

    @abstractmethod
    def model_tensors(self) -> dict[str, np.ndarray]:
        """The trained model by name."""

    @abstractmethod
    def state_tensors(self) -> dict[str, np.ndarray]:
        """What the next step depends on beside the model, by name."""

    @abstractmethod
    def counts(self) -> dict[str, int]:
        """What it depends on of whole numbers beside the iteration, by name."""

    @abstractmethod
    def put(self, tensors: Mapping[str, np.ndarray], header: Any) -> None:
        """Take over what a checkpoint holds. header: its record. Raises KeyError, TypeError or ValueError where that
        does not fit."""

    @abstractmethod
    def summary(self) -> JsonDict:
        """What training.json says of the model."""

    def files(self) -> dict[str, JsonDict]:
        """What a finished run has beside its model: files by name."""
        return {}

    @property
    def gaussian_count(self) -> int | None:
        """None of a model without Gaussians."""
        return None

    def time_left(self) -> TimeLeft:
        """Of this training, without times yet."""
        return TimeLeft(self.config.iterations)

    def save(self, path: Path) -> None:
        """Write a checkpoint: everything that the next step depends on. Raises WorkError where the model is not
        finite."""
        header = {"iteration": self.iteration, "history": self.history, **self.counts()}
        write_tensors(path, {**self._finite_model(), **self.state_tensors()}, header, self.form)

    def restore(self, path: Path) -> None:
        """Continue from what `save` wrote. Raises InputError where the file does not fit."""
        tensors, metadata = read_tensors(path, self.form)
        header: Any = structure(self.header, Document(f"{path}: header", metadata, {}), Rules())
        if header.iteration > self.config.iterations:
            raise InputError(f"{path}: expected an iteration up to {self.config.iterations}, found {header.iteration}")
        try:
            self.put(tensors, header)
        except TypeError:
            raise InputError(f"{path}: expected a checkpoint of training, found tensors of other shapes") from None
        except KeyError as error:
            (name,) = error.args
            raise InputError(f"{path}: expected a checkpoint of training, found one that lacks {name}") from None
        except ValueError as error:
            raise InputError(f"{path}: expected a checkpoint of this training ({error})") from None
        if broken := first_not_finite(self.model_tensors()):
            raise InputError(f"{path}: expected finite numbers as {broken}, found others")
        self.iteration, self.history = header.iteration, [asdict(entry) for entry in header.history]

    def complete(self, out: Path, on_progress: Callable[[TrainingProgress], None], command: Sequence[str] = ()) -> None:
        """Train from the newest checkpoint in `out` to the end, and write the run, its model last. command: the
        command line, for the report."""
        newest = max(checkpoints(out), default=None)
        if newest is not None:
            try:
                self.restore(newest)
            except InputError as error:
                raise InputError(f"{error}; without this file training goes on from an earlier one, or anew") from None
            log.info("resumed at iteration %d from %s", self.iteration, newest)
        clock = TrainingClock(out, self.iteration)
        self.seconds = {name: clock.kept.get(name, 0.0) if clock.before else 0.0 for name in self.seconds}

        def checkpoint() -> None:
            write_checkpoint(self.save, out, self.iteration)
            clock.write(self.iteration, **self.seconds)

        with interrupts.defer_interrupts() as should_stop:  # the writing, too: the last steps may have no checkpoint
            self.run(on_progress, checkpoint, should_stop)
            model = self._finite_model()
            write_json(
                out / "training.json",
                {
                    "history": self.history,
                    "seconds": round(clock.total(), 3),
                    **{f"{name}_seconds": round(seconds, 3) for name, seconds in self.seconds.items()},
                    "backend": backend.select(),
                    "device": device(),
                    "command": shlex.join(command) if command else None,
                    "versions": versions(),
                    **self.summary(),
                },
            )
            for name, content in self.files().items():
                write_json(out / name, content)
            header = {"iteration": self.iteration, "config": self.config.to_json()}
            write_tensors(out / "model.safetensors", model, header, self.form)

    def run(
        self,
        on_progress: Callable[[TrainingProgress], None],
        on_checkpoint: Callable[[], None],
        should_stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """Train from `self.iteration` to the end. Raises KeyboardInterrupt after a step and its checkpoint where it is
        asked to stop, or InputError where a step cannot read its pictures, WorkError where the loss is not finite."""
        config, left, loss = self.config, self.time_left(), None
        while self.iteration < config.iterations:
            before = self.iteration
            try:
                loss = self.step()
            except InputError:
                if loss is not None and self.iteration == before and math.isfinite(float(loss[0])):
                    on_checkpoint()
                    log.info("stopped after iteration %d, which is kept: resume goes on from there", before)
                raise
            last = self.iteration == config.iterations
            if self.iteration % HISTORY_EVERY == 0 or last:
                on_progress(self._record(float(loss[0]), left))
            stop = should_stop()
            if stop:
                self._check(float(loss[0]))
            if stop or (self.iteration % config.checkpoint_every == 0 and not last):
                on_checkpoint()
            if stop:
                raise KeyboardInterrupt

    def _record(self, loss: float, left: TimeLeft) -> TrainingProgress:
        self._check(loss)
        count = self.gaussian_count
        left.add(self.iteration, time.perf_counter(), count)
        counted = {} if count is None else {"gaussians": count}
        self.history.append({"iteration": self.iteration, "loss": loss, **counted})
        return TrainingProgress(
            self.iteration,
            self.config.iterations,
            loss,
            gaussian_count=count,
            seconds_left=left.seconds(),
            lower_bound=left.lower_bound,
        )

    def _check(self, loss: float) -> None:
        if not math.isfinite(loss):
            raise WorkError(f"training: the loss is {loss} at iteration {self.iteration}; the last checkpoint is kept")

    def _finite_model(self) -> dict[str, np.ndarray]:
        """`model_tensors`. Raises WorkError where some are not finite: what is not drawn is not seen in the loss."""
        model = self.model_tensors()
        if broken := first_not_finite(model):
            at = f"at iteration {self.iteration}; the last checkpoint is kept"
            raise WorkError(f"training: {broken} of the model are not finite {at}")
        return model
