"""`train`: a dataset and a configuration to a run on disk, resumable at any time."""

import logging
import os
import platform
import shlex
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import spacesim
from spacesim import backend, interrupts
from spacesim.data.errors import InputError
from spacesim.data.files import holds_files, read_json, remove_leftovers, write_json
from spacesim.data.identity import training_digest
from spacesim.data.lock import lock_folder
from spacesim.data.records import Dataset
from spacesim.data.store import write_points
from spacesim.data.tone import tone_and_exposure
from spacesim.splat.run import Run, load_run, read_config
from spacesim.splat.train.checkpoint import read_tensors, write_tensors
from spacesim.splat.train.config import TrainConfig
from spacesim.splat.train.pictures.suns import FirstSuns, check_pictures, first_suns, shape_config, surface_points
from spacesim.splat.train.start import distance_warning, farthest_camera, focus_point, scale_warning
from spacesim.splat.train.trainer import Trainer, TrainingProgress

KEEP_CHECKPOINTS = 2

log = logging.getLogger(__name__)


def train(
    dataset: Dataset,
    out: Path,
    config: TrainConfig,
    resume: bool = False,
    on_progress: Callable[[TrainingProgress], None] = lambda progress: None,
    command: Sequence[str] = (),
) -> Run:
    """Train and write RUN (see `spacesim.splat.run`). With `resume`, go on from the newest checkpoint, with the
    same result to the bit; a finished run is returned as it is. command: what the user typed, for the report.

    Ctrl-C on the command line leaves a checkpoint of the step that it came in. Raises InputError where `out` holds a
    run and `resume` is not asked for, or one of another configuration, or where another training is at work in it.
    """
    out, config = Path(out), _with_tone_and_exposure(config, dataset)
    described = {**config.to_json(), "data": _identity(dataset)}
    _check_folder(out, described, resume)
    if (out / "model.safetensors").exists():
        return load_run(out)
    if config.warm_start is not None and (remark := config.warm_start.remark(config.iterations)):
        log.warning(remark)
    if config.sun == "given":
        trainer = Trainer(dataset, config)
    else:
        check_pictures(dataset)
    for remark in filter(None, (scale_warning(dataset), distance_warning(dataset))):
        log.warning(remark)
    with lock_folder(out):
        _check_folder(out, described, resume)  # again: another training may have come and gone
        remove_leftovers(out)
        write_json(out / "config.json", described)
        if config.sun == "unknown":
            trainer = _trainer_from_shape(dataset, config, out, on_progress)
        _train(trainer, out, on_progress, command)
    return load_run(out)


def _trainer_from_shape(
    dataset: Dataset, config: TrainConfig, out: Path, on_progress: Callable[[TrainingProgress], None]
) -> Trainer:
    """Of Suns that are unknown: a run without light, RUN/shape, is trained first. It gives the first Suns, kept in
    RUN/suns.safetensors, and the points to start from, RUN/points.ply, where `init` is not to be another one."""
    path, points = out / "suns.safetensors", out / "points.ply"
    if not path.exists():
        run = train(dataset, out / "shape", shape_config(config), resume=True, on_progress=on_progress)
        log.info("looking for the Suns of %d pictures by shape and shading", len(dataset.train))
        write_points(points, *surface_points(run.gaussians))
        distance = farthest_camera(dataset, focus_point(dataset))
        write_tensors(path, first_suns(dataset, run.gaussians, run.antialiased, distance).tensors(), {})
    suns = FirstSuns.of(read_tensors(path)[0], len(dataset.train), path)
    if config.init in (None, "random"):
        dataset = replace(dataset, ply_file_path=str(points.absolute()))
        config = replace(config, init="points", init_box=None, warm_start=None)
    return Trainer(dataset, config, suns)


def _train(
    trainer: Trainer, out: Path, on_progress: Callable[[TrainingProgress], None], command: Sequence[str]
) -> None:
    """From the newest checkpoint in `out` to the end, and write the run."""
    newest = max(_checkpoints(out), default=None)
    if newest is not None:
        trainer.restore(newest)
        log.info("resumed at iteration %d from %s", trainer.iteration, newest)
    seconds = _TrainingClock(out, trainer)

    def checkpoint() -> None:
        trainer.save(out / "checkpoints" / f"step_{trainer.iteration:08d}.safetensors")
        seconds.write()
        for old in _checkpoints(out)[:-KEEP_CHECKPOINTS]:
            old.unlink(missing_ok=True)

    with interrupts.defer_interrupts() as should_stop:  # the writing, too: the last steps may have no checkpoint yet
        trainer.run(on_progress, checkpoint, should_stop)
        _write(trainer, out, seconds.total(), command)
        for sentence in trainer.pictures.sentences():
            log.info(sentence)


def _write(trainer: Trainer, out: Path, seconds: float, command: Sequence[str]) -> None:
    """What a finished run says of itself, then the model."""
    write_json(
        out / "training.json",
        {
            "history": trainer.history,
            "seconds": round(seconds, 3),
            "refinement_seconds": round(trainer.refinement_seconds, 3),
            "gaussians": trainer.gaussians.count,
            "backend": backend.select(),
            "device": device(),
            "command": shlex.join(command) if command else None,
            "versions": versions(),
            **trainer.pictures.summary(),
        },
    )
    cameras = trainer.pictures.cameras()
    if cameras is not None:
        write_json(out / "cameras.json", cameras)
    header = {"iteration": trainer.iteration, "config": trainer.config.to_json()}
    write_tensors(out / "model.safetensors", trainer.model_tensors(), header)


def _check_folder(out: Path, described: dict[str, Any], resume: bool) -> None:
    """Raises InputError where a run that is so described cannot be written to `out`, or completed in it."""
    if (out / "config.json").exists():
        if _checkpoints(out) or (out / "model.safetensors").exists():  # else nothing is there that could be lost
            _check_resumable(out, described, resume)
    elif out.exists() and not out.is_dir():
        raise InputError(f"{out}: expected an empty or new folder for the run, found no folder")
    elif holds_files(out):
        raise InputError(f"{out}: expected an empty or new folder for the run, found other files in it")


def _with_tone_and_exposure(config: TrainConfig, dataset: Dataset) -> TrainConfig:
    """Linear colours have the tone curve and the exposure of the dataset's pictures, where they were given none."""
    light = config.light
    if light is None or not light.linear:
        return config
    tone, exposure = tone_and_exposure(dataset.scene) or ("srgb", 0.0)
    light = replace(light, tone=light.tone or tone, exposure=exposure if light.exposure is None else light.exposure)
    return replace(config, light=light)


def versions() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    packages = {"spacesim": spacesim.__version__, "drjit": version("drjit"), "numpy": np.__version__}
    return {**packages, "python": platform.python_version()}


def device() -> str:
    """What computes, in words."""
    if backend.select() == "cuda":
        import drjit as dr

        return f"CUDA device of compute capability {dr.detail.cuda_compute_capability() / 10:.1f}"
    return f"{platform.machine()} CPU, {os.cpu_count()} cores"


def _identity(dataset: Dataset) -> dict[str, Any]:
    """What a run remembers of its data: enough to find it again and to notice another one in its place."""
    return {
        "path": str(dataset.root.resolve()),
        "digest": training_digest(dataset),
        "train_frames": len(dataset.train),
        "test_frames": len(dataset.test),
    }


def _check_resumable(out: Path, described: dict[str, Any], resume: bool) -> None:
    if not resume:
        raise InputError(f"{out}: expected a new folder, found a run; resume=True goes on with it")
    config, data = read_config(out / "config.json")
    data["path"] = described["data"]["path"]  # it may have moved
    current = {**config.to_json(), "data": data}  # what an older version did not write is as by default
    difference = _first_difference(current, described)
    if difference is not None:
        key, old, new = difference
        raise InputError(f"{out}: was started with {key} {old!r}, expected the same to resume it, found {new!r}")


def _first_difference(old: dict[str, Any], new: dict[str, Any], within: str = "") -> tuple[str, Any, Any] | None:
    """(key, old value, new value) of the first key of `new` that `old` has otherwise; "light.field.width" within
    others."""
    for key, value in new.items():
        was = old.get(key)
        if isinstance(was, dict) and isinstance(value, dict):
            difference = _first_difference(was, value, f"{within}{key}.")
            if difference is not None:
                return difference
        elif was != value:
            return f"{within}{key}", was, value
    return None


def _checkpoints(out: Path) -> list[Path]:
    return sorted((out / "checkpoints").glob("step_*.safetensors"))


def _read_seconds(path: Path) -> dict[str, float]:
    """{iteration of a checkpoint, or "refinement": seconds}; {}, with a warning, where the file is damaged: only the
    report tells of them."""
    if not path.exists():
        return {}
    try:
        values = read_json(path)
        if not isinstance(values, dict):
            raise InputError(f"{path}: expected a JSON object, found another value")
        for key, value in values.items():
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1e12:
                raise InputError(f"{path}: {key}: expected seconds, found {value!r:.60}")
        return {key: float(value) for key, value in values.items()}
    except InputError as error:
        log.warning("%s; the time that training took before is not known", error)
        return {}


class _TrainingClock:
    """Wall-clock time of training and the part of it that refinement took, kept across interruptions beside the
    checkpoints."""

    def __init__(self, out: Path, trainer: Trainer) -> None:
        self.path, self.trainer = out / "checkpoints" / "seconds.json", trainer
        seconds = _read_seconds(self.path)
        self.before, self.start = seconds.get(str(trainer.iteration), 0.0), time.monotonic()
        trainer.refinement_seconds = seconds.get("refinement", 0.0) if self.before else 0.0

    def total(self) -> float:
        return self.before + time.monotonic() - self.start

    def write(self) -> None:
        spent = {str(self.trainer.iteration): self.total(), "refinement": self.trainer.refinement_seconds}
        write_json(self.path, spent)
