"""A trained radiance field on disk, and what it predicts.

RUN/config.json        how it was trained and on what
RUN/checkpoints/*      where training can go on
RUN/model.safetensors  grids, networks, which cells are filled, the box: there once training is done
RUN/training.json      history, time, backend, versions
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import numpy as np

from spacesim import backend
from spacesim.backend import ad
from spacesim.backend.arrays import Float
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.files import JsonDict
from spacesim.data.records import Camera, Sun
from spacesim.data.structure import read_record
from spacesim.learning.folder import finished_model, read_described
from spacesim.learning.prediction import MaterialView, Prediction, check_picture
from spacesim.learning.record import TrainingRecord
from spacesim.learning.rendering import Rendering, checked_sun
from spacesim.learning.tensors import read_tensors
from spacesim.nerf.config import NerfConfig
from spacesim.nerf.draw import draw
from spacesim.nerf.fields.field import Parameters
from spacesim.nerf.fields.model import Networks
from spacesim.nerf.sampling.box import SceneBox
from spacesim.nerf.train.trainer import FORMAT, box_of

OPAQUE = 0.5  #: alpha from which on a pixel shows a surface


@dataclass(frozen=True, kw_only=True)
class NerfTrainingRecord(TrainingRecord):
    """What training.json says of a run of a radiance field; losses are mean squared errors of colours."""

    parameters: int  #: numbers that were trained


@dataclass(frozen=True, eq=False)
class NerfRun:
    """A trained radiance field with its history; a `Predictor` without Gaussians."""

    path: Path  #: the folder
    config: JsonDict  #: what config.json says
    training: JsonDict  #: what training.json says
    networks: Networks  #: the field and its proposals, without their numbers
    parameters: Parameters  #: their numbers
    filled: Float  #: see `Occupancy.filled`
    box: SceneBox  #: outside of which there is nothing
    model_bytes: int  #: size of the model's file
    gaussians: None = None  #: there are none
    gaussian_count: None = None  #: nor a number of them
    antialiased: bool = False  #: rays see points, not areas of pixels

    def __repr__(self) -> str:
        return f"NerfRun({str(self.path)!r}: {self.config.get('method')})"

    @property
    def backend(self) -> str:
        """The backend that renders now."""
        return backend.select()

    @property
    def relightable(self) -> bool:
        """Whether the Sun's direction changes what is predicted."""
        return self.networks.config.knows_sun

    @property
    def knows_earth(self) -> bool:
        """Whether the light of a Sun's Earth changes what is predicted."""
        return False

    @property
    def has_shadows(self) -> bool:
        """Whether it casts shadows on itself, so that visibility is predicted."""
        return self.networks.config.casts_shadows

    @property
    def parts(self) -> tuple[()]:
        """None: it was trained as one."""
        return ()

    @property
    def gaussian_run(self) -> None:
        """None: it has no Gaussians."""

    def with_embedding(self, embedding: np.ndarray) -> "NerfRun":
        """Raises InputError: its pictures have none."""
        raise InputError(f"embedding: expected a run of Gaussians, found {self.path}, a radiance field")

    def render(self, camera: Camera, sun: Sun | Sequence[float] | None = None) -> Rendering:
        """What `camera` sees under a Sun: rgb, alpha, depth and normal as numpy arrays, drawn when they are asked for.

        sun: (azimuth, elevation) in degrees, a direction [3] towards it, or a Sun.  Raises InputError where a run needs
        the Sun and none is given.
        """
        direction = Sun.of(sun)
        self._check(direction, None)
        return Rendering(self, camera, direction)

    def predict(
        self, camera: Camera, sun: Sun | None = None, normals: bool = False, exposure: float | None = None
    ) -> Prediction:
        """Render one view. Raises InputError where the Sun matters and none is given, and for an exposure: colours are
        sRGB values."""
        self._check(sun, exposure)
        drawn = self._draw(camera, sun, normals)
        return Prediction(drawn["rgb"], drawn["alpha"], drawn["depth"], drawn.get("visibility"), drawn.get("normal"))

    def draw_material(self, camera: Camera) -> MaterialView:
        """Raises InputError: a field of colours has none."""
        raise InputError(f"{self.path}: expected a run of Gaussians, to read materials, found a radiance field")

    def surface_depth(self, camera: Camera) -> np.ndarray:
        """[H, W] float32: depth in metres along the optical axis at which half of the light is gone, 0 where it is
        not. A field that takes the Sun has one shape under all Suns."""
        drawn = self._draw(camera, Sun(np.array([0.0, 0.0, 1.0])), False)
        return np.where(drawn["alpha"] >= OPAQUE, drawn["median_depth"], np.float32(0))

    def _draw(self, camera: Camera, sun: Sun | None, normals: bool) -> dict[str, np.ndarray]:
        check_picture(camera)
        known = sun if self.relightable else None
        return draw(self.networks, self.parameters, self.filled, self.box, camera, known, normals)

    def _check(self, sun: Sun | None, exposure: float | None) -> None:
        checked_sun(sun, self.relightable, f"a run of {self.config['method']}")
        if exposure is not None:
            expected = "expected a run trained in linear light (light.linear)"
            raise InputError(f"exposure: {expected}, found {self.path}, trained without it")


def load_run(path: str | Path) -> NerfRun:
    """Load a finished run. Raises InputError where the folder is none of a radiance field, or its training has not
    ended."""
    path = Path(path)
    model_path = finished_model(path)
    settings, data = read_config(path / "config.json")
    _, training = read_record(path / "training.json", NerfTrainingRecord)
    tensors, _ = read_tensors(model_path, FORMAT)
    networks = Networks(settings)
    try:
        parameters, box, state = networks.parameters(tensors), box_of(tensors), tensors["occupancy"]
        if state.shape != (settings.occupancy**3,) or not np.isfinite(state).all():
            raise ValueError(f"occupancy: expected {settings.occupancy**3} finite numbers, found others")
    except (KeyError, ValueError) as error:
        raise InputError(f"{model_path}: expected the tensors of a model, found none or others ({error})") from None
    filled = networks.occupancy.filled(upload(state)) if state.any() else dr.opaque(ad.Float, 1, len(state))
    dr.eval(filled)
    config = {**settings.to_json(), "data": data}
    return NerfRun(path, config, training, networks, parameters, filled, box, model_path.stat().st_size)


def read_config(path: Path) -> tuple[NerfConfig, JsonDict]:
    """(how a run is trained, what on: as `TrainingData`) by its config.json. Raises InputError where it is broken."""
    values, data = read_described(path)
    return NerfConfig.from_json(values, str(path)), data
