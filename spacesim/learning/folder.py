"""A run's folder while it is trained: what is in it, checkpoints, the time that training took."""

import logging
import os
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from spacesim import backend
from spacesim.data.errors import InputError
from spacesim.data.files import JsonDict, first_difference, holds_files, read_json, remove_leftovers, write_json
from spacesim.data.identity import same_digest, training_digest
from spacesim.data.integrity.whole import check_pictures
from spacesim.data.lock import lock_folder
from spacesim.data.records import Dataset
from spacesim.data.structure import Rules, structure
from spacesim.data.toml import Document
from spacesim.version import __version__

KEEP_CHECKPOINTS = 2

log = logging.getLogger(__name__)

ReadConfig = Callable[[Path], tuple[Any, JsonDict]]
"""config.json to (configuration, with `to_json`; what it says of the data, as `TrainingData`)."""


@dataclass(frozen=True)
class TrainingData:
    """What a run says of its data."""

    path: str  #: of the folder
    digest: str | None = None  #: see `training_digest`, of runs that have it
    train_frames: int | None = None  #: how many there are to train on
    test_frames: int | None = None  #: how many there are to evaluate on


@dataclass(frozen=True)
class TrainingProgress:
    """What a training loop reports now and then."""

    iteration: int  #: how many are finished
    iterations: int  #: how many there will be
    loss: float  #: of the last one
    gaussian_count: int | None = None  #: None of a radiance field
    seconds_left: float | None = None  #: as `TimeLeft` estimates it; None where nothing is known yet
    lower_bound: bool = False  #: whether it will take longer than that, as Gaussians are yet to join

    @property
    def words(self) -> str:
        """For a bar or a line."""
        return f"loss {self.loss:.4f}" + ("" if self.gaussian_count is None else f", {self.gaussian_count} Gaussians")


def is_finished(out: Path, described: JsonDict, resume: bool, read_config: ReadConfig) -> bool:
    """Whether `out` holds the whole run that is so described already. Raises as `check_folder`."""
    check_folder(out, described, resume, read_config)
    return (out / "model.safetensors").exists()


@contextmanager
def open_folder(out: Path, described: JsonDict, resume: bool, read_config: ReadConfig) -> Iterator[None]:
    """`out` for a training that is so described, and for no other while the block runs. Raises as `check_folder`, and
    where another training is at work in it."""
    with lock_folder(out):
        check_folder(out, described, resume, read_config)  # again: another training may have come and gone
        if resume and (out / "config.json").exists() and not holds_training(out):
            log.info("%s: no checkpoint is there; training starts from the beginning", out)
        remove_leftovers(out)
        write_json(out / "config.json", described)
        yield


def check_folder(out: Path, described: JsonDict, resume: bool, read_config: ReadConfig) -> None:
    """Raises InputError where a run that is so described cannot be written to `out`, or completed in it. read_config:
    of the method"""
    if (out / "config.json").exists():
        if holds_training(out):  # else nothing is there that could be lost
            _check_resumable(out, described, resume, read_config)
    elif out.exists() and not out.is_dir():
        raise InputError(f"{out}: expected an empty or new folder for the run, found a file")
    elif holds_files(out):
        raise InputError(f"{out}: expected an empty or new folder for the run, found other files in it")


def holds_training(out: Path) -> bool:
    """Whether a folder holds a checkpoint or a model."""
    return bool(checkpoints(out)) or (out / "model.safetensors").exists()


def checkpoints(out: Path) -> list[Path]:
    """Files of a run's checkpoints, oldest first."""
    return sorted((out / "checkpoints").glob("step_*.safetensors"))


def finished_model(path: Path) -> Path:
    """The model's file of a run. Raises InputError where the folder is no run or its training has not ended."""
    if not (path / "config.json").exists():
        raise InputError(f"{path}: expected a run of `spacesim train`, found no config.json in it")
    if not (path / "model.safetensors").exists():
        raise InputError(f"{path}: training has not ended; train with resume=True completes it")
    return path / "model.safetensors"


def read_described(path: Path) -> tuple[JsonDict, JsonDict]:
    """(all of a run's config.json, what it says of the data: as `TrainingData`). Raises InputError where it is broken,
    but for the configuration, which its own record reads."""
    values = read_json(path)
    if not isinstance(values, dict) or "data" not in values:
        raise InputError(f"{path}: expected an object with the key data, found none")
    data = structure(TrainingData, Document(f"{path}: data", values["data"], {}), Rules())
    return values, asdict(data)


class TrainingClock:
    """Wall-clock time of training, kept across interruptions beside the checkpoints."""

    def __init__(self, out: Path, iteration: int) -> None:
        """iteration: that training goes on from"""
        self.path = out / "checkpoints" / "seconds.json"
        self.kept = _read_seconds(self.path)
        self.before, self.start = self.kept.get(str(iteration), 0.0), time.monotonic()

    def total(self) -> float:
        """Seconds until now."""
        return self.before + time.monotonic() - self.start

    def write(self, iteration: int, **more: float) -> None:
        """At a checkpoint; more: other seconds to keep."""
        write_json(self.path, {str(iteration): self.total(), **more})


def write_checkpoint(save: Callable[[Path], None], out: Path, iteration: int) -> None:
    """Let `save` write the checkpoint of an iteration, then delete all but the newest."""
    save(out / "checkpoints" / f"step_{iteration:08d}.safetensors")
    for old in checkpoints(out)[:-KEEP_CHECKPOINTS]:
        old.unlink(missing_ok=True)


def versions() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    packages = {"spacesim": __version__, "drjit": version("drjit"), "numpy": np.__version__}
    return {**packages, "python": platform.python_version()}


def device() -> str:
    """What computes, in words."""
    if backend.select() == "cuda":
        import drjit as dr

        return f"CUDA device of compute capability {dr.detail.cuda_compute_capability() / 10:.1f}"
    return f"{platform.machine()} CPU, {os.cpu_count()} cores"


def run_name(path: Path) -> str:
    """What a run is called: its folder, or the one above a "run"."""
    folder = path.resolve()
    return folder.parent.name if folder.name == "run" else folder.name


def describe_data(dataset: Dataset) -> JsonDict:
    """What a run remembers of its data: enough to find it again and to notice another one in its place. Raises
    InputError where a training picture is not whole: a run that has begun knows its pictures as whole files."""
    check_pictures(dataset, dataset.train)
    return {
        "path": str(dataset.root.resolve()),
        "digest": training_digest(dataset),
        "train_frames": len(dataset.train),
        "test_frames": len(dataset.test),
    }


def _check_resumable(out: Path, described: JsonDict, resume: bool, read_config: ReadConfig) -> None:
    if not resume:
        raise InputError(f"{out}: expected a new folder, found a run; resume=True goes on with it")
    try:
        config, data = read_config(out / "config.json")
    except InputError:
        values = read_json(out / "config.json")
        method, expected = values.get("method") if isinstance(values, dict) else None, described["method"]
        if isinstance(method, str) and method != expected:  # of another family, whose configurations have other fields
            raise started_with(out, "method", method, expected) from None
        raise
    data["path"] = described["data"]["path"]  # it may have moved
    if same_digest(str(data.get("digest")), described["data"]["digest"]):
        data["digest"] = described["data"]["digest"]  # older versions wrote less
    current = {**config.to_json(), "data": data}  # what an older version did not write is as by default
    difference = first_difference(current, described)
    if difference is not None:
        raise started_with(out, *difference)


def started_with(out: Path, key: str, old: object, new: object) -> InputError:
    """What refuses to resume the run in `out` with another value of a key than its own."""
    return InputError(f"{out}: was started with {key} {old!r}, expected the same to resume it, found {new!r}")


def _read_seconds(path: Path) -> dict[str, float]:
    """{iteration of a checkpoint, or "refinement": seconds}; {}, with a warning, where the file is damaged: only the
    report shows them."""
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
