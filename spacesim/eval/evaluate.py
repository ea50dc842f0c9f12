"""Judge a trained run against a dataset: metrics.json and pictures of every frame (contract: metrics.json).

Predictions are clipped to [0, 1] as a display would; both pictures lie over black. Means and
population standard deviations are over the frames, without those where a metric is null. Only `render_ms`
differs from one call to the next.
"""

import math
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.files import write_json
from spacesim.data.geometry import Array
from spacesim.data.identity import frame_names
from spacesim.data.records import Dataset, Frame
from spacesim.eval.judge import judge_picture, judge_visibility, light_of, tally_grazing, view_of, write_pictures
from spacesim.eval.labels import GROUPS
from spacesim.eval.metrics import grazing, lpips, shadow
from spacesim.eval.metrics.geometry import GeometryConfig, JudgedShape, judge_geometry
from spacesim.eval.notes import MODELS_OF_A_SCENE, explain, explain_light, explain_objects
from spacesim.eval.objects import GROUPS as OBJECT_GROUPS
from spacesim.eval.objects import judge_object_shapes, judge_objects, object_names, other_order
from spacesim.eval.relight import write_sweep
from spacesim.eval.schema import SCHEMA
from spacesim.eval.shape import write_shapes
from spacesim.eval.suns import count_suns, known_suns, rounded_angles, trained_on

if TYPE_CHECKING:
    from spacesim.splat.run import Run

_PACKAGES = ("spacesim", "mitsuba", "drjit", "numpy", "scipy", "flip-evaluator", "torch")

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class EvaluateConfig:
    """split: "test", "train" or "all";  lpips_weights: see `lpips.find_weights`;  geometry: how the
    shape is judged, None: not at all"""

    split: str = "test"
    lpips_weights: Path | None = None
    geometry: GeometryConfig | None = field(default_factory=GeometryConfig)

    def __post_init__(self) -> None:
        if self.split not in ("test", "train", "all"):
            raise InputError(f"--split: expected test, train or all, found {self.split!r}")


def evaluate(
    run: "Run",
    dataset: Dataset,
    out: Path,
    config: EvaluateConfig | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Judge every frame of the split and return what EVAL/metrics.json, written last, then holds.

    progress: called with (frames done, frames in all, the next one's file) before each frame and at the end.
    run: or a `ComposedRun` in its place. Raises InputError where there is no frame to judge or the dataset is broken,
    WorkError where a prediction
    is not finite.
    """
    config = config or EvaluateConfig()
    frames = {"test": dataset.test, "train": dataset.train, "all": dataset.frames}[config.split]
    if not frames:
        raise InputError(f"{dataset.root}: expected frames in the split {config.split}, found none")
    dark = next((frame for frame in frames if frame.sun is None), None)
    if dark is not None and run.relightable:
        raise InputError(
            f"{dataset.root}: expected the Sun of every frame for a relightable run, {dark.file_path} has none"
        )
    network, lpips_sentence = lpips.load(config.lpips_weights)
    _prepare(out)
    run.predict(frames[0].camera, frames[0].sun)  # compiles the kernels
    models: list[str] | None = getattr(run, "names", None)  # of a composed scene, which was not trained on this dataset
    trained, untold = trained_on(run.config, dataset) if models is None else ((), MODELS_OF_A_SCENE)
    objects = object_names(dataset, models or ())
    known_of = known_suns(frames, trained)
    judged: list[Judgement] = []
    for name, frame, known in zip(frame_names(frames), frames, known_of, strict=True):
        if progress:
            progress(len(judged), len(frames), frame.file_path)
        judged.append(_judge(run, dataset, frame, known, network, out / "frames" / name, objects))
    sweep, no_sweep = write_sweep(run, dataset, frames, trained, out)
    if progress:
        progress(len(frames), len(frames), "its shape" if config.geometry else "")
    shape, shapes = _judge_shapes(run, dataset, objects, config.geometry)
    write_shapes(out / "geometry", shape)

    method = str(run.config.get("method"))
    records = [one.record for one in judged]
    metrics = {
        "schema": SCHEMA,
        "run": str(run.path),
        "data": str(dataset.root),
        "split": config.split,
        "model": {
            "gaussians": run.gaussians,
            "bytes": run.bytes,
            "render_ms": 1e3 * statistics.median(one.seconds for one in judged),
            "backend": run.backend,
        },
        **_summaries(judged),
        "geometry": shape.values,
        "objects": _by_object(judged, objects, shapes),
        "known_suns": _over([one for one in judged if one.known is True]),
        "unseen_suns": _over([one for one in judged if one.known is False]),
        "relight": sweep,
        "notes": [
            *([shape.note] if shape.note else []),
            *explain(records, [one.source for one in judged], None if network else lpips_sentence, method),
            *explain_light(
                [one.known for one in judged],
                any(one.grazing is not None for one in judged),
                no_sweep,
                untold,
            ),
            *explain_objects(objects, records, models, other_order(run, dataset)),
        ],
        "dataset": _describe(dataset, frames),
        "config": dict(run.config),
        "training": dict(run.training),
        "versions": _versions(),
        "frames": [_flattened(record) for record in records],
    }
    write_json(out / "metrics.json", metrics := _finite(metrics))
    return metrics


@dataclass(frozen=True, eq=False)
class Judgement:
    """A frame's numbers. record: its values by group, and what it is; source: where its silhouette is from;
    known: whether training has seen its Sun; grazing: sums by grazing angle; seconds: that its prediction took"""

    frame: Frame
    record: dict[str, Any]
    source: str
    known: bool | None
    grazing: Array | None
    seconds: float


def _judge_shapes(
    run: "Run", dataset: Dataset, objects: Mapping[int, str], config: GeometryConfig | None
) -> tuple[JudgedShape, dict[int, dict[str, Any] | None]]:
    """Of the whole, and of each object where models stand for them. A mesh that cannot be read, or a grid that does not
    fit, costs the shape's numbers and no others."""
    try:
        return judge_geometry(run, dataset, config), judge_object_shapes(run, dataset, objects, config)
    except InputError as error:
        return JudgedShape(None, f"Geometry is null: {error}."), {}


def _judge(
    run: "Run",
    dataset: Dataset,
    frame: Frame,
    known: bool | None,
    network: lpips.Lpips | None,
    folder: Path,
    objects: Mapping[int, str],
) -> Judgement:
    """Predict a frame, judge it and each of its `objects`, write its pictures into `folder`."""
    start = time.perf_counter()
    prediction = run.predict(frame.camera, frame.sun)
    seconds = time.perf_counter() - start
    view, source = view_of(dataset, frame, prediction)
    light = light_of(dataset, frame, prediction)
    write_pictures(folder, view, light)
    named = {"file_path": frame.file_path, "name": folder.name, "sun": rounded_angles(frame), "known_sun": known}
    record: dict[str, Any] = named | judge_picture(view, network) | judge_visibility(light, view)
    if objects:
        record["objects"] = judge_objects(dataset, frame, objects, view, light, network)
    return Judgement(frame, record, source, known, tally_grazing(light, view), seconds)


def _summaries(judged: Sequence[Judgement]) -> dict[str, Any]:
    """The groups over some frames."""
    groups = {group: summary(one.record[group] for one in judged) for group in GROUPS}
    return {**groups, "by_grazing_angle": grazing.summary(one.grazing for one in judged)}


def _by_object(
    judged: Sequence[Judgement], names: Mapping[int, str], shapes: Mapping[int, dict[str, Any] | None]
) -> list[dict[str, Any]] | None:
    """Of each object that a frame shows: number, name, in how many frames, the groups over its pixels, its shape; None
    for data with one object."""
    found: list[dict[str, Any]] = []
    for number, name in names.items():
        records = [one.record["objects"][name] for one in judged if name in one.record["objects"]]
        if records:
            groups = {group: summary(record[group] for record in records) for group in OBJECT_GROUPS}
            own = {"id": number, "name": name, "frames": len(records), **groups, "geometry": shapes.get(number)}
            found.append(own)
    return found or None


def _over(judged: Sequence[Judgement]) -> dict[str, Any] | None:
    """How many frames and Suns there are, and the groups over them; None where there is no frame."""
    if not judged:
        return None
    return {"frames": len(judged), "suns": count_suns([one.frame for one in judged]), **_summaries(judged)}


def _prepare(out: Path) -> None:
    """Make the folder and take away the numbers of an earlier call: a folder that has them is complete."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "metrics.json").unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{out}: expected a folder to write to, found none ({error.strerror})") from None


def summary(records: Iterable[Mapping[str, float | None] | None]) -> dict[str, Any] | None:
    """{metric: {"mean", "std" of the population, "count" of frames that have it}, None if no frame has}.

    Where records tell their `pixels`, measures over pixels have "pooled", too: over the pixels of all frames at once.
    None where every record is None: the group was not measured at all.
    """
    present = [record for record in records if record is not None]
    if not present:
        return None
    result: dict[str, Any] = {metric: None for metric in present[0] if metric != "pixels"}
    for metric in result:
        pairs = [(value, record.get("pixels")) for record in present if (value := record[metric]) is not None]
        if pairs:
            values, pixels = np.array(pairs, float).T
            result[metric] = {"mean": float(values.mean()), "std": float(values.std()), "count": len(values)}
            if metric in shadow.OVER_PIXELS and "pixels" in present[0]:
                result[metric]["pooled"] = float(np.average(values, weights=pixels))
    return result


def _describe(dataset: Dataset, frames: Sequence[Frame]) -> dict[str, Any]:
    """What the report says about the data: its size, and from scene.json how it was made."""
    return {
        "frames": len(frames),
        "train_frames": len(dataset.train),
        "suns": count_suns(frames),
        "resolution": [frames[0].camera.width, frames[0].camera.height],
        **{key: dataset.scene.get(key) for key in ("scene", "config", "versions")},
    }


def _flattened(record: dict[str, Any]) -> dict[str, Any]:
    """A frame as the contract has it: values over the silhouette beside the name, others in their groups."""
    rest = {key: value for key, value in record.items() if key not in ("image", "shadow")}
    return {**rest, **record["image"], **record["shadow"]}


def _versions() -> dict[str, str]:
    versions = {}
    for package in _PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions


def _finite(value: Any) -> Any:
    """`value` with None for numbers that JSON has no word for."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value
