"""A trained run on disk, and what it predicts.

RUN/config.json        how it was trained and on what
RUN/checkpoints/*      where training can go on
RUN/model.safetensors  the trained Gaussians: there once training is done
RUN/training.json      history, time, backend, versions
RUN/cameras.json       poses and gains of the training pictures, where they were learned
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Protocol

import numpy as np

from spacesim import backend
from spacesim.backend.arrays import Bool
from spacesim.data.earth import Earth
from spacesim.data.errors import InputError
from spacesim.data.files import JsonDict, as_path
from spacesim.data.images.tone import Curve
from spacesim.data.records import Camera, Sun
from spacesim.data.structure import checked, read_record
from spacesim.learning.folder import finished_model, read_described
from spacesim.learning.lights import CanPredict, Light
from spacesim.learning.prediction import MaterialView, Prediction, check_picture
from spacesim.learning.record import TrainingRecord
from spacesim.learning.rendering import Rendering, checked_sun
from spacesim.learning.tensors import first_not_finite
from spacesim.splat.light.config import MAX_EXPOSURE
from spacesim.splat.light.material import FittedMaterial, has_material, read_material
from spacesim.splat.light.model import LightModel
from spacesim.splat.material import SunlitWhite, draw_material, no_material
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.output import RenderOutput, over_alpha, planes_image
from spacesim.splat.raster.project import Projection
from spacesim.splat.raster.render import render
from spacesim.splat.raster.supersample import render_supersampled
from spacesim.splat.raster.tone import adjust_exposure
from spacesim.splat.train.checkpoint import GaussianHistoryEntry, read_tensors
from spacesim.splat.train.config import METHODS, TrainConfig
from spacesim.splat.train.old_config import ALIASES


class ComposedModel(Protocol):
    """A model of a composed scene, where it stands."""

    @property
    def name(self) -> str:
        """As the scene calls it."""

    @property
    def centre(self) -> np.ndarray:
        """[3] metres, world: the middle of its Gaussians, or of its box."""

    @property
    def gaussians(self) -> Gaussians | None:
        """Its Gaussians, in the world's axes; None of a radiance field."""

    @property
    def antialiased(self) -> bool:
        """Whether it is drawn with the anti-aliasing filter."""


class Predictor(CanPredict, Protocol):
    """What evaluating, sweeping and showing ask for beside predictions: a trained `Run`, or several in one scene
    (`ComposedRun`), or a radiance field (`nerf.run.NerfRun`)."""

    @property
    def path(self) -> Path:
        """The run's folder, or the scene's file."""

    @property
    def config(self) -> JsonDict:
        """How it was trained, or composed; "method" names the method or all of them."""

    @property
    def training(self) -> JsonDict:
        """How training went, see `TrainingRecord`; {} of a scene."""

    @property
    def gaussians(self) -> Gaussians | None:
        """All Gaussians, in the world's axes; None of a radiance field, and of a scene with one."""

    @property
    def gaussian_count(self) -> int | None:
        """Number of Gaussians; None of a radiance field."""

    @property
    def model_bytes(self) -> int:
        """Size of the files of all models, each counted once."""

    @property
    def backend(self) -> str:
        """The backend that renders now."""

    @property
    def antialiased(self) -> Bool | bool:
        """Whether Gaussians are drawn with the anti-aliasing filter: one bool for all, or Bool [N]."""

    @property
    def has_shadows(self) -> bool:
        """Whether what it predicts has a visibility of the Sun."""

    @property
    def parts(self) -> Sequence[ComposedModel]:
        """The models of a scene, which stand for the dataset's objects in their order; none of a single run."""

    @property
    def gaussian_run(self) -> "Run | None":
        """The trained run of Gaussians that it is, or moves; None of a scene and of a radiance field."""

    def with_embedding(self, embedding: np.ndarray) -> "Predictor":
        """The same with every view drawn with `embedding` [E]. Raises InputError where no picture of training has
        one."""


@dataclass(frozen=True, kw_only=True)
class GaussianTrainingRecord(TrainingRecord):
    """What training.json says of a run of Gaussians."""

    history: tuple[GaussianHistoryEntry, ...]  #: of some iterations, in order
    gaussians: int  #: at the end
    refinement_seconds: float = 0.0  #: the part of `seconds` that densification took
    poses: Mapping[str, float] | None = None  #: how far training moved them (medians), where it did: degrees, share
    gains: Mapping[str, float] | None = None  #: least and most of the pictures', where they were learned
    suns: Mapping[str, float] | None = None  #: how sure they are, where they were estimated: degrees, median


@dataclass(frozen=True, eq=False)
class Run:
    """A trained model with its history.

    It predicts on one thread at a time, and no other may use Dr.Jit meanwhile: they would wait for each other for ever,
    or recordings fail (Dr.Jit 1.5).
    """

    path: Path  #: the folder
    config: JsonDict  #: what config.json says
    training: JsonDict  #: what training.json says, see docs/reference/runs.md
    gaussians: Gaussians  #: the model
    model_bytes: int  #: size of the model's file
    light: LightModel | None = None  #: None of a method without light
    #: [E] of every view, None: the mean of the training pictures', if they have any
    embedding: np.ndarray | None = None

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r}: {self.config.get('method')}, {self.gaussian_count} Gaussians)"

    @property
    def gaussian_count(self) -> int:
        """Number of Gaussians."""
        return self.gaussians.count

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
        return self.light is not None and self.light.config.field.knows_sun

    @property
    def knows_earth(self) -> bool:
        """Whether the light of a Sun's Earth changes what is predicted."""
        return self.light is not None and bool(self.light.config.earth)

    @property
    def has_shadows(self) -> bool:
        """Whether its method knows visibility."""
        return self.light is not None and self.light.config.shadow is not None

    @property
    def parts(self) -> tuple[ComposedModel, ...]:
        """None: it was trained as one."""
        return ()

    @property
    def gaussian_run(self) -> "Run":
        """Itself."""
        return self

    @property
    def curve(self) -> Curve | None:
        """How colours that are blended in linear light are shown; None where they are sRGB values."""
        return self.light.config.curve if self.light else None

    @checked
    def render(
        self,
        camera: Camera,
        sun: Sun | Sequence[float] | None = None,
        exposure: float | None = None,
        light: Light = "all",
    ) -> "Rendering":
        """What `camera` sees under a Sun: rgb, alpha, depth, normal and visibility as numpy arrays, drawn when they are
        asked for.

        sun: (azimuth, elevation) in degrees, a direction [3] towards it, or a Sun; a run that is not `relightable`
        knows the light of its pictures alone;  exposure: EV, of a run whose colours are linear;  light: "all", or that
        of the "sun" or the "earth" alone, of a `Sun` with its Earth and a run that has learned it (`knows_earth`)
        Raises InputError where a run needs the Sun and none is given, and for the Earth's light where there is none.
        """
        direction = checked_sun(sun, self.relightable, f"a run of {self.config['method']}")
        return Rendering(self, camera, direction, exposure, light)

    def with_embedding(self, embedding: np.ndarray) -> "Run":
        """The run with every view drawn with `embedding` [E] in place of the mean of the training pictures'. Raises
        InputError where these have none, or of another length."""
        size = self.light.config.field.embeddings if self.light else 0
        if not size or np.shape(embedding) != (size,):
            raise InputError(f"embedding: expected {size} numbers for {self.path}, found {np.shape(embedding)}")
        return replace(self, embedding=embedding)

    def predict(
        self, camera: Camera, sun: Sun | None = None, normals: bool = False, exposure: float | None = None
    ) -> Prediction:
        """Render one view. A run that is not `relightable` knows one light: `sun` changes nothing. Where training
        pictures have embeddings, every view is drawn with their mean, but see `with_embedding`. exposure: EV, of a
        model whose colours are linear; by default that of its training pictures. Raises InputError where a relightable
        run gets no Sun, and for an exposure of a model whose colours are sRGB values."""
        stops_more = stops(self.curve, exposure, str(self.path))
        check_picture(camera)
        names = ("alpha", "depth", *(("normal",) if normals else ()))
        if self.light is None:
            plain = partial(render, self.gaussians, outputs=(*names, "color"), antialiased=self.antialiased)
            output = render_supersampled(plain, camera, self.supersample)
            return _prediction(output, output.image("color"), None, normals)
        if sun is None and self.relightable:
            raise InputError(
                f"{self.path}: expected the Sun's direction for a run of {self.config['method']}, found none"
            )
        towards = None if sun is None else sun.direction
        lit = partial(
            draw_lit,
            self.gaussians,
            self.light,
            sun=towards,
            outputs=names,
            antialiased=self.antialiased,
            embedding=self.embedding,
            earth=None if sun is None else sun.earth,
        )
        output = render_supersampled(lit, camera, self.supersample, colors=3, linear=self.curve is not None)
        features = output.features or []
        visible = [over_alpha(plane, output.alpha) for plane in features[3:]]
        visibility = planes_image(visible, output.width, output.height)[..., 0] if visible else None
        rgb = planes_image(features[:3], output.width, output.height)
        light = None
        if curve := self.curve:
            light = display_light(rgb, curve, stops_more)
            rgb = adjust_exposure(rgb, curve.tone, stops_more, curve.white)
        tone = self.curve.tone if self.curve else "srgb"
        return replace(_prediction(output, rgb, visibility, normals), linear=light, tone=tone)

    @property
    def albedo_is_relative(self) -> bool:
        """Whether the data that says how bright the Sun was, and the exposure, is not there: 1 au and 0 EV are taken
        for it."""
        return not self._white.is_known

    @cached_property
    def _white(self) -> SunlitWhite:
        """What its reflectances are shares of."""
        return SunlitWhite.of(Path(self.config.get("data", {}).get("path", self.path)), self.curve)

    @property
    def has_material(self) -> bool:
        """Whether there is a `material` to read."""
        return self.light is not None and has_material(self.light.config.field)

    @cached_property
    def material(self) -> FittedMaterial:
        """Of each Gaussian, what the field answers about its normal, fitted: no training has seen it. Raises InputError
        where there is no light, or a field that takes directions."""
        if self.light is None or not self.has_material:
            how = "which has no light" if self.light is None else "whose light takes directions"
            raise no_material(self.path, f"one of {self.config.get('method')}, {how}")
        white = self._white
        return read_material(self.gaussians, self.light, white.display, white.tone, self.embedding)

    @cached_property
    def learned_normals(self) -> np.ndarray:
        """[N, 3] of any length, of a run that has a `material`."""
        assert self.light is not None
        first = self.light.config.field.features
        return self.gaussians.to_numpy()["features"][:, first : first + 3]

    def draw_material(self, camera: Camera) -> MaterialView:
        """What one view shows of `material`."""
        material = self.material
        return draw_material(self.gaussians, material, self.learned_normals, camera, self.antialiased, self.supersample)


def check_gaussians(run: Predictor | str | Path) -> Run:
    """The trained run of Gaussians that `run` is, or that lies in the folder `run`. Raises InputError where it is
    none."""
    if isinstance(run, str | Path) or not hasattr(run, "gaussian_run"):
        path = as_path(run, "run", "a path or what load_run returns")
        finished_model(path)
        method = read_described(path / "config.json")[0].get("method", "vanilla")
        if isinstance(method, str) and method not in (*METHODS, *ALIASES):
            raise InputError(f"run: expected one of Gaussians, found one of the method {method:.60}")
        return load_run(path)
    if run.gaussian_run is None:
        raise InputError(f"run: expected one of Gaussians, found one of the method {run.config['method']}")
    return run.gaussian_run


def stops(curve: Curve | None, exposure: float | None, source: str) -> float:
    """By how many EV a picture is exposed more than those of training: none where no `exposure` is asked for. curve: as
    `Run.curve`;  source: whose it is. Raises InputError for colours that are sRGB values, and for no such exposure."""
    if exposure is None:
        return 0.0
    if curve is None:
        raise InputError(
            f"exposure: expected a run trained in linear light (light.linear), found {source}, trained without it"
        )
    if not abs(exposure) <= MAX_EXPOSURE:
        raise InputError(f"exposure: expected -{MAX_EXPOSURE} to {MAX_EXPOSURE} EV, found {exposure}")
    return exposure - curve.exposure


def display_light(light: np.ndarray, curve: Curve, stops: float = 0.0) -> np.ndarray:
    """`Prediction.linear` of a picture [H, W, 3] of linear colours. stops: as in `adjust_exposure`"""
    return np.float32(curve.white * 2.0**stops) * light


def draw_lit(
    gaussians: Gaussians,
    light: LightModel,
    camera: Projection,
    sun: np.ndarray | None,
    outputs: Sequence[str] = (),
    antialiased: bool = False,
    embedding: np.ndarray | None = None,
    earth: Earth | None = None,
) -> RenderOutput:
    """A relit and shadowed frame on the device. features: colour (3 planes), then, of a model with shadows, visibility,
    all premultiplied. sun: [3], unit, towards the Sun, None: the model takes none;  outputs, antialiased: see
    `render`;  embedding: of the picture, see `LightModel.shade_picture`;  earth: that the Sun lights"""
    colors, visibility = light.shade_picture(gaussians, camera, sun, embedding=embedding, earth=earth)
    visibilities = [] if visibility is None else [visibility]
    return render(gaussians, camera, outputs=outputs, features=[*colors, *visibilities], antialiased=antialiased)


def _prediction(output: RenderOutput, rgb: np.ndarray, visibility: np.ndarray | None, normals: bool) -> Prediction:
    alpha, depth = output.image("alpha"), output.image("depth")
    return Prediction(rgb, alpha, depth, visibility, output.image("normal") if normals else None)


def load_run(path: str | Path) -> Run:
    """Load a finished run. Raises InputError where the folder is no run or its training has not ended."""
    path = Path(path)
    model_path = finished_model(path)
    train_config, data = read_config(path / "config.json")
    _, training = read_record(path / "training.json", GaussianTrainingRecord)
    config, light_config = {**train_config.to_json(), "data": data}, train_config.light
    tensors, _ = read_tensors(model_path)
    try:
        gaussians = Gaussians.from_numpy(tensors)
        light = LightModel.from_tensors(light_config, tensors) if light_config else None
        if light_config and (gaussians.count == 0 or gaussians.feature_count != light_config.features):
            counts = f"{gaussians.count} with {gaussians.feature_count if gaussians.count else 0}"
            raise ValueError(f"features: expected Gaussians with {light_config.features} each, found {counts}")
    except (KeyError, ValueError) as error:
        raise InputError(f"{model_path}: expected the tensors of a model, found none or others ({error})") from None
    if first_not_finite(tensors):
        raise InputError(f"{model_path}: expected finite numbers, found others; train the run again")
    return Run(path, config, training, gaussians, model_path.stat().st_size, light)


def read_config(path: Path) -> tuple[TrainConfig, JsonDict]:
    """(how a run is trained, what on: as `TrainingData`) by its config.json. Raises InputError where it is broken."""
    values, data = read_described(path)
    return TrainConfig.from_json(values, str(path)), data
