"""What is served: a scene that is path-traced, or a run or a composed scene that is predicted."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from spacesim import interrupts
from spacesim.data import toml
from spacesim.data.earth import Earth
from spacesim.data.errors import InputError, WorkError
from spacesim.data.files import JsonDict
from spacesim.data.images.tone import STANDARD_EXPOSURE, as_bytes, display_values
from spacesim.data.records import Camera, Dataset, Sun
from spacesim.learning.folder import run_name
from spacesim.serve.protocol import OUTPUTS, Output

if TYPE_CHECKING:
    from spacesim.scenes.config import SceneConfig
    from spacesim.splat.run import Predictor

_log = logging.getLogger(__name__)

MAX_EXPOSURE = 40.0  #: EV, of path-traced pictures
PREDICTED: tuple[Output, ...] = ("rgb", "alpha", "depth", "normal", "visibility", "object_id")  #: at most
_LABELS = {
    "visibility": "sun_visibility",
    **{name: name for name in ("depth", "normal", "object_id", "part_id", "shadow")},
}


class Served(Protocol):
    """Draws pictures, on one thread."""

    @property
    def names(self) -> Sequence[str]:
        """What it is called: of the scene, then of its objects."""

    @property
    def facts(self) -> JsonDict:
        """What clients may want to know: served, kind, outputs, relightable."""

    def draw(
        self, camera: Camera, sun: Sun | None, exposure: float | None, outputs: Sequence[Output], seed: int
    ) -> dict[str, np.ndarray]:
        """The arrays that `outputs` name, see `protocol.Output`. Raises InputError for what it does not have, where the
        Sun matters and none is given, and for an exposure that cannot be."""


def draw(
    served: Served, camera: Camera, sun: Sun | None, exposure: float | None, outputs: Sequence[Output], seed: int
) -> dict[str, np.ndarray]:
    """What `served` draws. Raises InputError, WorkError or MemoryError where there is no picture, and nothing else: it
    ends no server."""
    try:
        return served.draw(camera, sun, exposure, outputs, seed)
    except WorkError:
        raise
    except RuntimeError as error:  # of Dr.Jit
        if interrupts.is_interrupt(error):
            raise KeyboardInterrupt from None
        _log.warning("serve: the computation failed (%s)", " ".join(str(error).split()))
        raise WorkError("the computation failed; the server's log says why") from None


class TracedScene:
    """A scene, path-traced; spp: samples a pixel, None: as the scene says."""

    outputs = OUTPUTS

    def __init__(self, config: "SceneConfig", spp: int | None = None) -> None:
        from spacesim.scenes.background.draw import Background
        from spacesim.scenes.build import build
        from spacesim.scenes.render import Renderer

        scene, self._config, self._background = build(config), config, None
        quality, lens = config.quality, config.camera.distortion
        self._renderer = Renderer(scene, spp or quality.spp, quality.max_depth, lens)
        if config.background is not None:
            self._background = Background(config.background, scene, lens, config.seed)
        self.names = (config.name, *(item.spacecraft.name for item in scene.objects))

    @property
    def facts(self) -> JsonDict:
        """See `Served`."""
        traced = {"kind": "scene", "spp": self._renderer.spp}
        return {"served": self.names[0], **traced, "outputs": list(self.outputs), "relightable": True}

    def draw(
        self, camera: Camera, sun: Sun | None, exposure: float | None, outputs: Sequence[Output], seed: int
    ) -> dict[str, np.ndarray]:
        """See `Served`."""
        if sun is None:
            raise InputError("sun: expected its direction for a scene, found none")
        if exposure is not None and not abs(exposure) <= MAX_EXPOSURE:
            raise InputError(f"exposure: expected -{MAX_EXPOSURE:g} to {MAX_EXPOSURE:g} EV, found {exposure}")
        arrays: dict[str, np.ndarray] = {}
        if {"rgb", "alpha", "radiance"} & set(outputs):
            radiance, alpha = self._renderer.radiance(camera, sun, (self._config.seed, seed))
            arrays = {"radiance": radiance, "alpha": alpha}
            if "rgb" in outputs:
                arrays["rgb"] = self._picture(radiance, alpha, camera, sun, exposure, seed)
        if set(_LABELS) & set(outputs):
            labels = self._renderer.labels(camera, sun)
            arrays |= {name: labels[key] for name, key in _LABELS.items()}
        return {name: arrays[name] for name in outputs}

    def _picture(
        self, radiance: np.ndarray, alpha: np.ndarray, camera: Camera, sun: Sun, exposure: float | None, seed: int
    ) -> np.ndarray:
        """[H, W, 3] uint8: as `generate` records it, over black where that has alpha."""
        from spacesim.scenes.cameras.exposure import record_image

        config = self._config.camera
        if exposure is not None:
            config = replace(config, exposure=STANDARD_EXPOSURE * 2.0**exposure)
        if self._background is None and config.sensor is None:
            picture, covered = np.zeros_like(radiance), alpha > 0
            share = alpha[covered][:, None]
            picture[covered] = share * display_values(config.exposure * radiance[covered] / share, config.tone)
            return as_bytes(picture)
        behind = None if self._background is None else self._background.radiance(camera, sun, seed)
        image = record_image(radiance, alpha, config, (self._config.seed, seed), behind).image
        return np.repeat(image[..., None], 3, axis=-1) if image.ndim == 2 else image


class PredictedRun:
    """A run of any method, or a composed scene: a `Predictor`. earth: that the Suns of clients light, or hide behind;
    scene: name of the one that a run was trained on, where that is known"""

    def __init__(self, run: "Predictor", earth: Earth | None = None, scene: str = "") -> None:
        self.run, self.earth = run, earth
        if run.knows_earth and earth is None:
            why = "neither all of its data nor a scene name one and the same"
            _log.warning("serve: %s has learned the Earth's light, which is left out: %s", run.path, why)
        some = {"visibility": run.has_shadows, "object_id": bool(run.parts)}
        self.outputs = [name for name in PREDICTED if some.get(name, True)]
        path = Path(run.path)
        name = path.stem if path.suffix == ".toml" else run_name(path)
        self.names = tuple(one for one in (scene, name, *(part.name for part in run.parts)) if one)

    @property
    def facts(self) -> JsonDict:
        """See `Served`."""
        known = {"kind": "run", "method": self.run.config.get("method"), "relightable": self.run.relightable}
        return {"served": self.names[0], **known, "outputs": self.outputs}

    def draw(
        self, camera: Camera, sun: Sun | None, exposure: float | None, outputs: Sequence[Output], seed: int
    ) -> dict[str, np.ndarray]:
        """See `Served`; nothing here is random."""
        for name in outputs:
            if name not in self.outputs:
                expected = f"some of {', '.join(self.outputs)} of {self.names[0]}"
                raise InputError(f"outputs: expected {expected}, found {name}")
        lit = None if sun is None else replace(sun, earth=self.earth)
        seen = self.run.predict(camera, lit, normals="normal" in outputs, exposure=exposure)
        arrays: dict[str, Any] = {"alpha": seen.alpha, "depth": seen.depth, "normal": seen.normal}
        arrays |= {"rgb": as_bytes(seen.rgb), "visibility": seen.visibility, "object_id": getattr(seen, "id", None)}
        return {name: arrays[name] for name in outputs}


def load_served(what: str | Path, spp: int | None = None) -> Served:
    """What draws a scene (a built-in name, a scene file, a mesh file), a run (a folder) or a composed scene (a TOML
    file with models). spp: samples a pixel of a scene. Raises InputError where there is none of these, and for samples
    of a run."""
    from spacesim.methods import load_run, load_scene
    from spacesim.scenes.scenefile import BUILT_IN_SCENES, read_scene

    path = Path(what)
    is_composed = path.suffix.lower() == ".toml" and "models" in toml.read_document(path).values
    if is_composed or (path.is_dir() and str(what) not in BUILT_IN_SCENES):
        if spp is not None:
            raise InputError(f"spp: expected with a scene, found {spp} with {what}, which is not path-traced")
        if not is_composed:
            run = load_run(path)
            dataset = _dataset_of(run)
            if dataset is None:
                return PredictedRun(run)
            return PredictedRun(run, _earth_of(run, dataset), str(dataset.scene.get("scene", "")))
        from spacesim.splat.compose import ComposedRun

        scene = load_scene(path)
        return PredictedRun(ComposedRun(scene.posed_at(0.0), path), scene.earth_at(0.0))
    if spp is not None and not 1 <= spp <= 1_000_000:
        raise InputError(f"spp: expected 1 to 1,000,000, found {spp}")
    return TracedScene(read_scene(what), spp)


def _dataset_of(run: "Predictor") -> Dataset | None:
    """That a run was trained on; None where that is gone."""
    from spacesim.data.store import read_dataset

    data = Path(run.config["data"]["path"])
    return read_dataset(data) if (data / "transforms.json").is_file() else None


def _earth_of(run: "Predictor", dataset: Dataset) -> Earth | None:
    """The one that all frames of the dataset of a run name; None where they name none or several, which a sentence says
    of a run that these hide the Sun from."""
    earths = {frame.sun.earth if frame.sun else None for frame in dataset.frames}
    if len(earths) > 1 and run.relightable and not run.knows_earth:
        _log.warning("serve: the frames of %s name several Earths, none of which hides the Sun here", dataset.root)
    return earths.pop() if len(earths) == 1 else None
