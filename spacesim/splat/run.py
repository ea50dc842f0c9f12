"""A trained run on disk, and what it predicts.

RUN/config.json        how it was trained and on what
RUN/checkpoints/*      where training can go on
RUN/model.safetensors  the trained Gaussians: there once training is done
RUN/training.json      history, time, backend, versions
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from spacesim import backend
from spacesim.backend.memory import check_memory
from spacesim.data.errors import InputError
from spacesim.data.files import read_json
from spacesim.data.records import Camera, Sun
from spacesim.data.structure import Rules, read_record, structure
from spacesim.data.toml import Document
from spacesim.splat.light.model import LightModel
from spacesim.splat.light.shading import LARGEST_EV
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.project import Projection
from spacesim.splat.raster.render import RenderOutput, render
from spacesim.splat.raster.supersample import supersampled
from spacesim.splat.raster.tone import developed
from spacesim.splat.train.checkpoint import HistoryEntry, read_tensors
from spacesim.splat.train.config import TrainConfig


class Rendering:
    """A view of a run, drawn when an array of it is asked for first. See `Run.render`."""

    def __init__(self, run: "Run", camera: Camera, sun: Sun | None, exposure: float | None = None) -> None:
        self.run, self.camera, self.sun, self.exposure = run, camera, sun, exposure

    @cached_property
    def _drawn(self) -> "Prediction":
        return self.run.predict(self.camera, self.sun, exposure=self.exposure)

    @property
    def rgb(self) -> np.ndarray:
        """[H, W, 3] float32, sRGB values over black, beyond 1 where what bounces makes them brighter than white."""
        return self._drawn.rgb

    @property
    def alpha(self) -> np.ndarray:
        """[H, W] float32 in [0, 1]."""
        return self._drawn.alpha

    @property
    def depth(self) -> np.ndarray:
        """[H, W] float32: expected depth along the optical axis, metres; 0 where alpha is 0."""
        return self._drawn.depth

    @property
    def visibility(self) -> np.ndarray | None:
        """[H, W] float32: the share of the Sun that the surface sees, 0 to 1; None of a method without shadows."""
        return self._drawn.visibility

    @cached_property
    def normal(self) -> np.ndarray:
        """[H, W, 3] float32: unit vectors in world axes; 0 where there is no surface."""
        drawn = self.run.predict(self.camera, self.sun, normals=True, exposure=self.exposure)
        assert drawn.normal is not None
        return drawn.normal

    def save(self, path: str | Path, kind: str = "rgb") -> Path:
        """Write a PNG to look at or an EXR to compute with; returns its path.

        kind: "rgb", "alpha", "depth", "normal" or "shadow". Raises InputError for another suffix, and for shadows of a
        method without.
        """
        from spacesim.splat.export.pictures import write_picture

        drawn = replace(self._drawn, normal=self.normal) if kind == "normal" else self._drawn
        write_picture(drawn, kind, Path(path))
        return Path(path)


A_PIXEL = {"cuda": 80, "llvm": 225}
"""Bytes of main memory that a predicted pixel takes at most, until it is written: 160 and then 65 were seen on LLVM."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """A rendered view, float32. rgb: [H, W, 3] sRGB values over black, beyond 1 where what bounces makes them brighter
    than white; alpha: [H, W];
    depth: [H, W] expected depth in metres, 0 where alpha is 0; visibility: [H, W], or None from a method without;
    normal: [H, W, 3] unit vectors in world axes, 0 where there is no surface, or None where not asked for."""

    rgb: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    visibility: np.ndarray | None
    normal: np.ndarray | None = None


@dataclass(frozen=True)
class TrainingData:
    """What a run says of its data. path: of the folder;  digest: see `training_digest`, of runs that tell it"""

    path: str
    digest: str | None = None
    train_frames: int | None = None
    test_frames: int | None = None


@dataclass(frozen=True)
class TrainingRecord:
    """What training.json says: how a run came to be. seconds: of training, and the part of it that refinement took"""

    history: tuple[HistoryEntry, ...]
    seconds: float
    gaussians: int
    backend: str
    refinement_seconds: float = 0.0
    device: str | None = None
    command: str | None = None
    versions: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.history:
            raise InputError("history: expected at least one entry, found none")


@dataclass(frozen=True, eq=False)
class Run:
    """A trained model with its history. bytes: size of the model's file. It predicts on one thread at a time, and no
    other may use Dr.Jit meanwhile: they would wait for each other for ever, or recordings fail (Dr.Jit 1.5)."""

    path: Path
    config: dict[str, Any]
    training: dict[str, Any]
    model: Gaussians
    bytes: int
    light: LightModel | None = None

    @property
    def gaussians(self) -> int:
        """Number of Gaussians."""
        return self.model.count

    @property
    def backend(self) -> str:
        """The backend that renders now."""
        return backend.select()

    @property
    def antialiased(self) -> bool:
        """Whether the model was trained, and so is drawn, with the anti-aliasing filter."""
        return bool(self.config.get("antialiased", False))

    @property
    def supersample(self) -> int:
        """Places on a side of each pixel, whose mean light it is, in training and in what is predicted."""
        return int(self.config.get("supersample", 1))

    @property
    def relightable(self) -> bool:
        """Whether the Sun's direction changes what is predicted."""
        return self.light is not None

    @property
    def curve(self) -> tuple[str, float] | None:
        """Tone curve and exposure (EV) of colours that are blended in linear light; None where they are sRGB values."""
        return self.light.config.curve if self.light else None

    def render(
        self, camera: Camera, sun: Sun | Sequence[float] | None = None, exposure: float | None = None
    ) -> "Rendering":
        """What `camera` sees under a Sun: rgb, alpha, depth, normal and visibility as numpy arrays, drawn when they are
        asked for.

        sun: (azimuth, elevation) in degrees, a direction [3] towards it, or a Sun; a run of the method `vanilla` knows
        the light of its pictures alone;  exposure: EV, of a run whose colours are linear
        Raises InputError where a run needs the Sun and none is told.
        """
        found = Sun.of(sun)
        if found is None and self.relightable:
            raise InputError(f"sun: expected its direction for a run of {self.config['method']}, found none")
        return Rendering(self, camera, found, exposure)

    def predict(
        self, camera: Camera, sun: Sun | None = None, normals: bool = False, exposure: float | None = None
    ) -> Prediction:
        """Render one view. The method `vanilla` knows one light: `sun` changes nothing. exposure: EV, of a model whose
        colours are linear; by default that of its training pictures. Raises InputError where another method is not told
        the Sun, and for an exposure of a model whose colours are sRGB values."""
        more = stops(self.curve, exposure, str(self.path))
        check_picture(camera)
        names = ("alpha", "depth", *(("normal",) if normals else ()))
        if self.light is None:
            plain = partial(render, self.model, outputs=(*names, "colour"), antialiased=self.antialiased)
            output = supersampled(plain, camera, self.supersample)
            return _prediction(output, output.image("colour"), None, normals)
        if sun is None:
            raise InputError(
                f"{self.path}: expected the Sun's direction for a run of {self.config['method']}, found none"
            )
        lit = partial(draw_lit, self.model, self.light, sun=sun.direction, outputs=names, antialiased=self.antialiased)
        output = supersampled(lit, camera, self.supersample, colours=3, linear=self.curve is not None)
        drawn, alpha = output.image("features"), output.image("alpha")
        visible = np.zeros_like(alpha)
        visibility = np.divide(drawn[..., 3], alpha, out=visible, where=alpha > 0) if drawn.shape[2] > 3 else None
        rgb = drawn[..., :3]
        if self.curve:
            rgb = developed(rgb, self.curve[0], more)
        return _prediction(output, rgb, visibility, normals)


def check_picture(camera: Camera) -> None:
    """Raise MemoryError, before it is drawn, where a camera's picture does not fit into memory."""
    needed = A_PIXEL[backend.select()] * camera.width * camera.height
    check_memory(needed, f"a picture of {camera.width} x {camera.height} pixels")


def stops(curve: tuple[str, float] | None, exposure: float | None, found: str) -> float:
    """By how many EV a picture is exposed more than those of training: none where no `exposure` is asked for. curve: as
    `Run.curve`;  found: whose it is. Raises InputError for colours that are sRGB values, and for no such exposure."""
    if exposure is None:
        return 0.0
    if curve is None:
        raise InputError(f"--exposure: expected a run trained with --linear, found {found}")
    if not abs(exposure) <= LARGEST_EV:
        raise InputError(f"--exposure: expected -{LARGEST_EV} to {LARGEST_EV} EV, found {exposure}")
    return exposure - curve[1]


def draw_lit(
    model: Gaussians,
    light: LightModel,
    camera: Projection,
    sun: np.ndarray,
    outputs: Sequence[str] = (),
    antialiased: bool = False,
) -> RenderOutput:
    """A relit and shadowed frame on the device. features: colour (3 planes), then, of a model with shadows, visibility,
    all premultiplied. sun: [3], unit, towards the Sun;  outputs, antialiased: see `render`"""
    colours, visibility = light.lit(model, camera, sun, adaptive=True)
    lit = [] if visibility is None else [visibility]
    return render(model, camera, outputs=outputs, features=[*colours, *lit], antialiased=antialiased)


def _prediction(output: RenderOutput, rgb: np.ndarray, visibility: np.ndarray | None, normals: bool) -> Prediction:
    alpha, depth = output.image("alpha"), output.image("depth")
    return Prediction(np.ascontiguousarray(rgb), alpha, depth, visibility, output.image("normal") if normals else None)


def load_run(path: Path) -> Run:
    """Load a finished run. Raises InputError where the folder is no run or its training has not ended."""
    path = Path(path)
    model_path = path / "model.safetensors"
    if not (path / "config.json").exists():
        raise InputError(f"{path}: expected a run of `spacesim train`, found no config.json in it")
    if not model_path.exists():
        raise InputError(f"{path}: training has not ended; complete it with `spacesim train ... --resume`")
    known, data = read_config(path / "config.json")
    _, training = read_record(path / "training.json", TrainingRecord)
    config, light_config = {**known.to_json(), "data": data}, known.light
    tensors, _ = read_tensors(model_path)
    try:
        model = Gaussians.from_numpy(tensors)
        light = LightModel.from_tensors(light_config, tensors) if light_config else None
        if light_config and (model.count == 0 or model.feature_count != light_config.features):
            found = f"{model.count} with {model.feature_count if model.count else 0}"
            raise ValueError(f"features: expected Gaussians with {light_config.features} each, found {found}")
    except (KeyError, ValueError) as error:
        raise InputError(f"{model_path}: expected the tensors of a model, found none or others ({error})") from None
    if not all(np.isfinite(tensor).all() for tensor in tensors.values()):
        raise InputError(f"{model_path}: expected finite numbers, found others; train the run again")
    return Run(path, config, training, model, model_path.stat().st_size, light)


def read_config(path: Path) -> tuple[TrainConfig, dict[str, Any]]:
    """(how a run is trained, what on: as `TrainingData`) by its config.json. Raises InputError where it is broken."""
    values = read_json(path)
    if not isinstance(values, dict) or "data" not in values:
        raise InputError(f"{path}: expected an object with the key data, found none")
    data = structure(TrainingData, Document(f"{path}: data", values["data"], {}), Rules())
    return TrainConfig.from_json(values, str(path)), asdict(data)
