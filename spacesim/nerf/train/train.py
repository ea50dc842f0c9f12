"""`train`: a dataset and a configuration to a run on disk, resumable at any time."""

import logging
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path

import drjit as dr

from spacesim import backend, interrupts
from spacesim.data.files import remove_leftovers, write_json
from spacesim.data.lock import lock_folder
from spacesim.data.records import Dataset
from spacesim.learning.folder import (
    TrainingClock,
    TrainingProgress,
    check_folder,
    checkpoints,
    describe_data,
    device,
    versions,
    write_checkpoint,
)
from spacesim.learning.tensors import write_tensors
from spacesim.nerf.config import NerfConfig
from spacesim.nerf.run import NerfRun, load_run, read_config
from spacesim.nerf.train.trainer import FORMAT, Trainer

log = logging.getLogger(__name__)


def train(
    dataset: Dataset,
    out: Path,
    config: NerfConfig,
    resume: bool = False,
    on_progress: Callable[[TrainingProgress], None] = lambda progress: None,
    command: Sequence[str] = (),
) -> NerfRun:
    """Train and write RUN (see `spacesim.nerf.run`). With `resume`, go on from the newest checkpoint, with the same
    result to the bit; a finished run is returned as it is. command: what the user typed, for the report.

    Ctrl-C on the command line leaves a checkpoint of the step that it came in. Raises InputError where `out` holds a
    run and `resume` is not asked for, or one of another configuration, or where another training is at work in it.
    """
    out, described = Path(out), {**config.to_json(), "data": describe_data(dataset)}
    check_folder(out, described, resume, read_config)
    if (out / "model.safetensors").exists():
        return load_run(out)
    trainer = Trainer(dataset, config)
    with lock_folder(out):
        check_folder(out, described, resume, read_config)  # again: another training may have come and gone
        remove_leftovers(out)
        write_json(out / "config.json", described)
        _train(trainer, out, on_progress, command)
    return load_run(out)


def _train(
    trainer: Trainer, out: Path, on_progress: Callable[[TrainingProgress], None], command: Sequence[str]
) -> None:
    """From the newest checkpoint in `out` to the end, and write the run."""
    newest = max(checkpoints(out), default=None)
    if newest is not None:
        trainer.restore(newest)
        log.info("resumed at iteration %d from %s", trainer.iteration, newest)
    clock = TrainingClock(out, trainer.iteration)

    def checkpoint() -> None:
        write_checkpoint(trainer.save, out, trainer.iteration)
        clock.write(trainer.iteration)

    with interrupts.defer_interrupts() as should_stop:  # the writing, too: the last steps may have no checkpoint yet
        trainer.run(on_progress, checkpoint, should_stop)
        write_json(
            out / "training.json",
            {
                "history": trainer.history,
                "seconds": round(clock.total(), 3),
                "parameters": sum(dr.width(values) for values in trainer.parameters),
                "backend": backend.select(),
                "device": device(),
                "command": shlex.join(command) if command else None,
                "versions": versions(),
            },
        )
        header = {"iteration": trainer.iteration, "config": trainer.config.to_json()}
        write_tensors(out / "model.safetensors", trainer.model_tensors(), header, FORMAT)
