"""What `import spacesim as ss` gives: plain values in, records and numpy arrays out.

`generate`, `train`, `evaluate`, `compose`, `write_report` and `import_dataset` do what the commands generate, train,
eval, compose, report and import do; `render` rasterizes Gaussians, `Run.render` is the command render. What is behind
them stands in the layers of docs/explanation/architecture.md.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import BackendError
from spacesim.backend.arrays import ArrayXf, Bool, Float
from spacesim.backend.upload import upload
from spacesim.data.earth import Earth
from spacesim.data.errors import InputError, WorkError
from spacesim.data.files import JsonDict, JsonMapping, as_path
from spacesim.data.geometry import as_numbers
from spacesim.data.images import load_image
from spacesim.data.records import Camera, Dataset, Frame, Image, Sun, Truth, check_camera
from spacesim.data.store import load_depth, load_truth
from spacesim.data.structure import Rules, checked, did_you_mean, field_value, places_of
from spacesim.data.toml import dotted
from spacesim.data.transforms import read_dataset
from spacesim.learning.folder import TrainingProgress
from spacesim.learning.rendering import Rendering
from spacesim.methods import load_predictor, load_run, load_scene, preset
from spacesim.nerf.config import NerfConfig
from spacesim.nerf.run import NerfRun
from spacesim.scenes.cameras.rig import Rig
from spacesim.scenes.config import SceneConfig
from spacesim.scenes.generation.generate import generate as _generate
from spacesim.scenes.scenefile import read_scene
from spacesim.scenes.spacecraft import spacecraft
from spacesim.scenes.trajectory.rig import PoseRig
from spacesim.serve.client import CameraClient
from spacesim.splat.compose import PosedScene
from spacesim.splat.compose.output import Composed
from spacesim.splat.compose.output import compose as _compose
from spacesim.splat.fit import estimate_sun
from spacesim.splat.pose import FoundPose, RefinedPose, find_pose, refine_pose
from spacesim.splat.raster.cameras import Pinhole, Projection
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.render import RenderOutput
from spacesim.splat.raster.render import render as _render
from spacesim.splat.run import Run
from spacesim.splat.sun_search import SunEstimate
from spacesim.splat.train.config import TrainConfig

ProgressCallback = Callable[[int, int, str], None]
"""Called now and then with how much is done, of how much, and words about it."""

__all__ = [
    "BackendError",
    "Camera",
    "CameraClient",
    "Composed",
    "Dataset",
    "Earth",
    "FoundPose",
    "Frame",
    "Gaussians",
    "Image",
    "InputError",
    "NerfConfig",
    "NerfRun",
    "Pinhole",
    "PoseRig",
    "PosedScene",
    "RefinedPose",
    "RenderOutput",
    "Rendering",
    "Run",
    "SceneConfig",
    "Sun",
    "SunEstimate",
    "TrainConfig",
    "Truth",
    "WorkError",
    "compose",
    "estimate_sun",
    "evaluate",
    "find_pose",
    "generate",
    "import_dataset",
    "load_depth",
    "load_image",
    "load_run",
    "load_scene",
    "load_truth",
    "preset",
    "read_dataset",
    "read_scene",
    "refine_pose",
    "render",
    "spacecraft",
    "train",
    "write_report",
]


@checked
def generate(
    scene: str | Path | SceneConfig,
    out: str | Path,
    *,
    resume: bool = False,
    workers: int = 1,
    rig: Rig | None = None,
    trajectory: str | Path | None = None,
    progress: ProgressCallback | None = None,
    **options: object,
) -> Dataset:
    """Path-trace a dataset with its truth into the folder `out` (docs/reference/dataset.md).

    scene: name of a built-in scene ("boxsat"), a scene file (.toml), a mesh file, or what `read_scene` returns
    resume: complete what an interrupted call has left; a finished dataset is returned as it is
    workers: processes of this machine
    rig: `PoseRig` of cameras of your own, or another `Rig`;  trajectory: a table that cameras follow
        (docs/how-to/trajectory.md)
    options: of the scene, as the command line has them: suns, views (under each Sun), test_suns, test_views,
        sun=(azimuth, elevation) in degrees, a direction [3], a `Sun` or several, distance in metres, resolution=256 or
        (width, height) in pixels, fov_deg or focal=(fx, fy), principal=(cx, cy), exposure (display value of a
        radiance of 1 W m^-2 sr^-1), spp (samples a pixel), seed; of a mesh file units and up; min_sunlit (share)
    progress: called with (frames done, frames in all, name of the frame last done)

    Raises InputError for a scene, an option or a folder that cannot be, WorkError where disk, memory or processes fail,
    BackendError where no backend can run.
    """
    if rig is not None or trajectory is not None:
        options = {"rig": rig, "trajectory": trajectory, **options}
    if not isinstance(scene, SceneConfig):
        scene = read_scene(scene, **options)
    elif options:
        raise InputError(f"{next(iter(options))}: expected no options beside a scene that has been read, found one")
    return _generate(scene, as_path(out, "out"), resume, progress, workers)


@checked
def import_dataset(
    kind: str, src: str | Path, out: str | Path, *, progress: ProgressCallback | None = None, **options: object
) -> Dataset:
    """Write pictures from elsewhere as a dataset into the folder `out` (docs/reference/dataset.md#data-from-elsewhere).

    kind: "nerfstudio", "blender", ...: those of `spacesim import --help`
    src: the folder or file that they lie in
    options: of the kind, as `spacesim import KIND --help` has them, with underscores: masks="masks"
    progress: called with (pictures written, pictures in all, name of the last)

    Where an earlier import of the same source was interrupted, it begins anew. Raises InputError for a kind, a source
    or an option that cannot be, and for a folder that holds anything else.
    """
    from spacesim.data.importers.kinds import import_dataset as run_import

    return run_import(kind, as_path(src, "src"), as_path(out, "out"), progress, **options)


@checked
def train(
    data: str | Path | Dataset,
    out: str | Path,
    config: TrainConfig | NerfConfig | None = None,
    *,
    preset: str | None = None,
    method: str | None = None,
    strategy: str | None = None,
    settings: JsonMapping | None = None,
    resume: bool = False,
    progress: ProgressCallback | None = None,
    **options: Any,
) -> Run | NerfRun:
    """Train Gaussians, or a radiance field, on a dataset and write the run to the folder `out`.

    data: a folder of a Nerfstudio dataset, ours or another's, or what `read_dataset` returns
    config: the whole configuration; without one, what `preset` returns for these names, refused beside a configuration
    preset: None is "fast";  method: None is "vanilla";  strategy: None is "default", of Gaussians
    options: fields of TrainConfig, or NerfConfig of a radiance field, in place of the configuration's: seed=0,
        iterations=7000, which shortens its whole schedule where it is fewer, ...
    settings: fields by their dotted names, as `spacesim train --set` has them: {"light.shadow.bias": 5}
    resume: go on from the newest checkpoint, with the same result to the bit; a finished run is returned as it is. What
        is not named here is as in the run's config.json
    progress: called with (iterations done, iterations in all, "loss 0.0123, 4000 Gaussians") now and then

    Raises InputError for data, a configuration or a folder that cannot be, WorkError where the loss is not finite or
    the disk is full, BackendError where no backend can run.
    """
    from spacesim import methods

    names = {"preset": preset, "method": method, "strategy": strategy}
    choices = {name: word for name, word in names.items() if word is not None}
    folder = as_path(out, "out")
    if config is None:
        config = methods.configuration(preset, method, strategy, folder if resume else None)
    elif not isinstance(config, TrainConfig | NerfConfig):
        raise InputError(f"config: expected what `preset` returns, found {config!r:.60}")
    elif choices:
        name, word = next(iter(choices.items()))
        raise InputError(f"{name}: expected none beside a configuration, found {word!r}")
    if settings is not None and not (isinstance(settings, Mapping) and all(isinstance(name, str) for name in settings)):
        raise InputError(f"settings: expected {{name: value}}, found {settings!r:.60}")
    for name, value in {**options, "strategy": strategy}.items():
        if settings and name in settings and value is not None:
            raise InputError(f"{name}: expected none beside settings[{name!r}], found {value!r:.60}")
    kind = type(config)
    for name, value in options.items():
        if name not in kind.__dataclass_fields__:
            inner = [dotted(place) for place in places_of(kind, Rules()) if place[-1] == name]
            settings_hint = f"; did you mean settings={{{inner[0]!r}: {value!r:.60}}}?" if inner else ""
            hint = settings_hint or did_you_mean(name, kind.__dataclass_fields__)
            raise InputError(f"{name}: expected a field of {kind.__name__}, found none of that name{hint}")
    options = {name: field_value(kind, name, value) for name, value in options.items()}
    before = config.method
    config = methods.shortened(config, options.get("iterations"))
    config = methods.with_settings(replace(config, **options), settings or {})
    if "method" in choices and config.method != before:
        raise InputError(f"light: expected that of the method {before}, found that of {config.method}")
    dataset = _dataset(data, "data")

    def tell(state: TrainingProgress) -> None:
        if progress is not None:
            progress(state.iteration, state.iterations, state.words)

    return methods.train(dataset, folder, config, resume, tell)


@checked
def evaluate(
    run: str | Path | Run | NerfRun,
    data: str | Path | Dataset,
    out: str | Path,
    *,
    split: str = "test",
    lpips_weights: str | Path | None = None,
    geometry: bool = True,
    fit_gain: bool = False,
    align: str | Path | Dataset | None = None,
    progress: ProgressCallback | None = None,
) -> JsonDict:
    """Evaluate a run against a dataset; write metrics.json, report.html and the frames' pictures into the folder `out`.

    run: a folder, a scene file, or what `train` or `load_run` returns;  split: "test", "train" or "all"
    lpips_weights: a file or folder of AlexNet and linear weights, without which LPIPS is null
    geometry: evaluate the shape, too
    fit_gain: fit the exposure of each picture on one half of it, score it on the other
    align: the dataset in whose axes and scale the run is, where those of `data` are others: their cameras are matched
    progress: called with (frames done, frames in all, file of the next) before each frame and at the end

    Returns what metrics.json holds (docs/reference/metrics.md): scores["image"]["psnr"]["mean"] in dB, and so on; None
    for what cannot be computed. Raises InputError where there is nothing to evaluate, WorkError where a
    prediction is not finite, BackendError where no backend can run.
    """
    from spacesim.eval.evaluate import EvaluateConfig
    from spacesim.eval.evaluate import evaluate as evaluate_run

    weights = None if lpips_weights is None else as_path(lpips_weights, "lpips_weights")
    own = None if align is None else _dataset(align, "align")
    config = EvaluateConfig(split, weights, fit_gain=fit_gain, align=own)
    config = config if geometry else replace(config, geometry=None)
    expected = "a path or what load_run returns"
    loaded = run if isinstance(run, Run | NerfRun) else load_predictor(as_path(run, "run", expected))
    dataset, folder = _dataset(data, "data"), as_path(out, "out")
    metrics = evaluate_run(loaded, dataset, folder, config, progress)
    write_report(folder, folder / "report.html")
    return metrics


def write_report(evals: str | Path | Sequence[str | Path], out: str | Path) -> Path:
    """Write one HTML page about one evaluation, or several side by side; returns its path.

    evals: folders that `evaluate` has written. Raises InputError where one holds no evaluation.
    """
    from spacesim.eval.report.write import write_report as write

    folders = [evals] if isinstance(evals, str) or not isinstance(evals, Iterable) else evals
    path = as_path(out, "out")
    write([as_path(folder, "evals") for folder in folders], path)
    return path


def compose(scene: str | Path | PosedScene, out: str | Path, *, size: int | tuple[int, int] | None = None) -> Composed:
    """Render a scene of several runs, with shadows on each other, into the folder `out`: pictures, depth, object
    numbers, visibility, a contact sheet and, of several frames, a video.

    scene: a scene file (docs/reference/composed-scenes.md), or what `load_scene` returns
    size: pixels of the longer side, or (width, height), in place of the camera's

    Raises InputError for a scene or a folder that cannot be, BackendError where no backend can run.
    """
    if not isinstance(scene, PosedScene):
        scene = load_scene(as_path(scene, "scene", "a path or what load_scene returns"))
    return _compose(scene, as_path(out, "out"), size)


def render(
    gaussians: Gaussians,
    camera: Camera | Projection,
    *,
    twist: Float | np.ndarray | Sequence[float] | None = None,
    sh_degree: int | None = None,
    outputs: Sequence[str] = ("color", "alpha", "depth"),
    features: Sequence[Float] | ArrayXf | None = None,
    antialiased: Bool | bool = False,
) -> RenderOutput:
    """Gaussians seen by a camera, as Dr.Jit arrays: differentiable by every parameter that has gradients enabled.

    camera: a record, or `Pinhole.of` one, where arrays hold pose and intrinsics
    twist: Float [6], or numbers, moves the camera: a rotation vector (radians), then a translation (metres), in camera
        axes, which take points from the old camera axes to the new ones; zeros to differentiate by the pose
    sh_degree: highest degree of spherical harmonics used; by default all that are stored
    outputs: ("color", "alpha", "depth") by default, also "median_depth" and "normal"; alpha is always there
    features: C arrays [N] of numbers to blend beside them
    antialiased: with Mip-Splatting's 2D filter; see docs/how-to/gradients.md for all of these

    `RenderOutput.to_numpy()` gives (colour [H, W, 3], alpha [H, W], depth [H, W] in metres). Raises InputError for
    another output or degree, features or a twist of another length, BackendError where no backend can run.
    """
    if not isinstance(gaussians, Gaussians):
        found = f"{type(gaussians).__name__}; a run has a render of its own: run.render(camera, sun)"
        raise InputError(f"gaussians: expected Gaussians, found {found}")
    if isinstance(camera, Projection):
        view = camera
    else:
        check_camera(camera)
        view = Pinhole.of(camera)
    if twist is not None:
        view = view.moved(_twist(twist))
    return _render(gaussians, view, sh_degree, outputs, features, antialiased)


def _twist(twist: Float | np.ndarray | Sequence[float]) -> Float:
    """As Dr.Jit's array, which stays as it is."""
    if isinstance(twist, dr.ArrayBase) and dr.width(twist) == 6:
        return twist
    numbers = as_numbers(twist)
    if numbers.shape != (6,) or not np.isfinite(numbers).all():
        raise InputError(f"twist: expected 6 finite numbers, found {numbers.tolist() or twist!r:.60}")
    return upload(numbers)


def _dataset(data: str | Path | Dataset, name: str) -> Dataset:
    """What was read, or is at a path."""
    if isinstance(data, Dataset):
        return data
    return read_dataset(as_path(data, name, "a path or what read_dataset returns"))
