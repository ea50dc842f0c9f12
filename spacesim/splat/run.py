"""A trained run on disk, and what it predicts.

RUN/config.json        how it was trained and on what
RUN/checkpoints/*      where training can go on
RUN/model.safetensors  the trained Gaussians: there once training is done
RUN/training.json      history, time, backend, versions
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spacesim import backend
from spacesim.data.errors import InputError
from spacesim.data.files import read_json
from spacesim.data.records import Camera, Sun
from spacesim.splat.gaussians import Gaussians
from spacesim.splat.project import Pinhole
from spacesim.splat.render import render
from spacesim.splat.train.checkpoint import read_tensors


@dataclass(frozen=True, eq=False)
class Prediction:
    """A rendered view, float32. rgb: [H, W, 3] sRGB values over black; alpha: [H, W];
    depth: [H, W] expected depth in metres, 0 where alpha is 0; visibility: [H, W], or None from a method without;
    normal: [H, W, 3] unit vectors in world axes, 0 where there is no surface, or None where not asked for."""

    rgb: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    visibility: np.ndarray | None
    normal: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Run:
    """A trained model with its history. bytes: size of the model's file."""

    path: Path
    config: dict[str, Any]
    training: dict[str, Any]
    model: Gaussians
    bytes: int

    @property
    def gaussians(self) -> int:
        """Number of Gaussians."""
        return self.model.count

    @property
    def backend(self) -> str:
        """The backend that renders now."""
        return backend.select()

    def predict(self, camera: Camera, sun: Sun | None = None, normals: bool = False) -> Prediction:
        """Render one view. The method `vanilla` knows one light: `sun` changes nothing."""
        names = ("colour", "alpha", "depth", *(("normal",) if normals else ()))
        output = render(self.model, Pinhole.of(camera), outputs=names)
        colour, alpha, depth, *normal = (output.image(name) for name in names)
        return Prediction(rgb=colour, alpha=alpha, depth=depth, visibility=None, normal=normal[0] if normal else None)


def load_run(path: Path) -> Run:
    """Load a finished run. Raises InputError where the folder is no run or its training has not ended."""
    path = Path(path)
    model_path = path / "model.safetensors"
    if not (path / "config.json").exists():
        raise InputError(f"{path}: expected a run of `spacesim train`, found no config.json in it")
    if not model_path.exists():
        raise InputError(f"{path}: training has not ended; complete it with `spacesim train ... --resume`")
    config, training = _read_keys(path / "config.json", "data"), _read_keys(path / "training.json", "history")
    tensors, _ = read_tensors(model_path)
    try:
        model = Gaussians.from_numpy(tensors)
    except (KeyError, ValueError) as error:
        raise InputError(f"{model_path}: expected the tensors of a model, found none or others ({error})") from None
    if not all(np.isfinite(tensor).all() for tensor in tensors.values()):
        raise InputError(f"{model_path}: expected finite numbers, found others; train the run again")
    return Run(path, config, training, model, model_path.stat().st_size)


def _read_keys(path: Path, key: str) -> dict[str, Any]:
    values = read_json(path)
    if not isinstance(values, dict) or key not in values:
        raise InputError(f"{path}: expected an object with the key {key}, found none")
    return values
