"""Evaluate a trained run against a dataset: metrics.json (docs/reference/metrics.md), pictures of every frame.

Predictions are clipped to [0, 1] as a display would; both pictures lie over black. Means and
population standard deviations are over the frames, without those where a metric is null. Only `render_ms`
differs from one call to the next.
"""

import math
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spacesim.data import density
from spacesim.data.errors import InputError
from spacesim.data.files import JsonDict, write_json
from spacesim.data.geometry import Array
from spacesim.data.identity import frame_names, frames_digest
from spacesim.data.integrity.outputs import check_evaluation_folder, clear_evaluation, replaced_content
from spacesim.data.integrity.whole import check_pictures
from spacesim.data.records import Dataset, Frame
from spacesim.data.transforms import check_still
from spacesim.eval.align import align, as_trained
from spacesim.eval.fit import predict_by_halves
from spacesim.eval.frame_metrics import (
    depth_groups,
    depth_range,
    frame_images,
    frame_light,
    image_groups,
    is_photograph,
    own_exposure,
    tally_grazing,
    visibility_groups,
    write_pictures,
)
from spacesim.eval.labels import GROUPS, SHADOW
from spacesim.eval.material import MaterialComparison
from spacesim.eval.metrics import grazing, lpips, material, shadow
from spacesim.eval.metrics.geometry import GeometryConfig, ShapeResult, compare_geometry
from spacesim.eval.notes import (
    MODELS_OF_A_SCENE,
    explain,
    explain_fit,
    explain_ignored,
    explain_light,
    explain_objects,
    explain_other_data,
    explain_sensor,
)
from spacesim.eval.objects import GROUPS as OBJECT_GROUPS
from spacesim.eval.objects import compare_object_shapes, object_groups, object_names, swapped_order
from spacesim.eval.relight import write_sweep
from spacesim.eval.schema import SCHEMA
from spacesim.eval.shape import write_shapes
from spacesim.eval.suns import TrainedOn, count_suns, known_suns, rounded_angles, training_frames
from spacesim.splat.compose.aligned import AlignedRun, moved_frame
from spacesim.splat.fit import Unknown, find_unknowns

if TYPE_CHECKING:
    from spacesim.splat.run import Predictor

_PACKAGES = ("spacesim", "mitsuba", "drjit", "numpy", "scipy", "flip-evaluator", "torch")

EvaluationProgress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class EvaluateConfig:
    """What is evaluated, and how."""

    split: str = "test"  #: "test", "train" or "all"
    lpips_weights: Path | None = None  #: see `lpips.find_weights`
    #: how the shape is evaluated, None: not at all
    geometry: GeometryConfig | None = field(default_factory=GeometryConfig)
    fit_gain: bool = False  #: one factor on each picture's linear values is fitted by halves (`eval.fit`)
    #: the dataset in whose axes and scale the run is, where these are not those of the evaluated one (`eval.align`)
    align: Dataset | None = None

    def __post_init__(self) -> None:
        if self.split not in ("test", "train", "all"):
            raise InputError(f"split: expected test, train or all, found {self.split!r}")


def evaluate(
    run: "Predictor",
    dataset: Dataset,
    out: Path,
    config: EvaluateConfig | None = None,
    progress: EvaluationProgress | None = None,
) -> JsonDict:
    """Evaluate every frame of the split and return what EVAL/metrics.json, written last, then holds. What an earlier
    evaluation has left in the folder goes when this one is complete.

    What a run does not know of a picture (`splat.fit.find_unknowns`) is fitted on one half of it and scored on the
    other.
    progress: called with (frames done, frames in all, the next one's file) before each frame and at the end.
    Raises InputError where there is no frame to evaluate, the dataset is broken or `out` holds another's report,
    WorkError where a prediction is not finite.
    """
    config, dataset = config or EvaluateConfig(), check_still(dataset)
    splits = {"train": dataset.train, "test": dataset.test, "all": dataset.frames}
    frames = splits[config.split]
    if not frames:
        hint = "".join(f"; {name} has some" for name in ("train", "test") if splits[name])
        raise InputError(f"{dataset.root}: expected frames in the split {config.split}, found none{hint}")
    alignment = align(as_trained(config.align, run.path), dataset) if config.align else None
    if alignment:
        if run.parts:
            raise InputError(f"align: expected a run, found {run.path}, a scene, which says itself where models stand")
        if run.gaussian_run is None:
            raise InputError(f"align: expected a run of Gaussians, found {run.path}, a radiance field")
        run = AlignedRun(run.gaussian_run, alignment.pose)
    unknowns = find_unknowns(run, config.fit_gain)
    dark = next((frame for frame in frames if frame.sun is None), None)
    if dark is not None and run.relightable and not any(unknown.name == "sun" for unknown in unknowns):
        raise InputError(
            f"{dataset.root}: expected the Sun of every frame for a relightable run, {dark.file_path} has none"
        )
    network, lpips_sentence = lpips.load(config.lpips_weights)
    check_pictures(dataset, frames)
    _check_folder(out)
    with replaced_content(out, clear_evaluation) as part:
        if dark is None or not run.relightable:
            run.predict(frames[0].camera, frames[0].sun)  # compiles the kernels
        models = [part.name for part in run.parts] or None  # of a composed scene, which was not trained on this dataset
        own = config.align or dataset
        known = training_frames(run.config, own) if models is None else TrainedOn((), MODELS_OF_A_SCENE)
        trained = known.frames
        other_data = explain_other_data(known.other, config.align.root if config.align else None)
        if alignment:
            trained = [moved_frame(frame, alignment.pose) for frame in trained]
        objects = object_names(dataset, models or ())
        knows_sun = known_suns(frames, trained)
        comparison = MaterialComparison(run, dataset, frames)
        results: list[FrameResult] = []
        for name, frame, has_known_sun in zip(frame_names(frames), frames, knows_sun, strict=True):
            if progress:
                progress(len(results), len(frames), frame.file_path)
            folder = part / "frames" / name
            results.append(
                _evaluate_frame(run, dataset, frame, has_known_sun, network, folder, objects, unknowns, comparison)
            )
        folders = [part / "frames" / result.record["name"] for result in results]
        materials = comparison.scores(folders)
        for result, values in zip(results, materials.records, strict=True):
            result.record["material"] = values
        no_map = _write_camera_density(dataset, trained, part)
        sweep, no_sweep = write_sweep(run, dataset, frames, trained, part)
        if progress:
            progress(len(frames), len(frames), "its shape" if config.geometry else "")
        shape, shapes = _evaluate_shapes(run, dataset, objects, config.geometry)
        write_shapes(part / "geometry", shape)

        method = str(run.config.get("method"))
        records = [result.record for result in results]
        ignored = statistics.fmean(result.ignored for result in results)
        region = "frame" if all(result.source == "frame" for result in results) else "silhouette"
        metrics = {
            "schema": SCHEMA,
            "run": str(run.path),
            "data": str(dataset.root),
            "split": config.split,
            "model": {
                "gaussians": run.gaussian_count,
                "bytes": run.model_bytes,
                "render_ms": 1e3 * statistics.median(result.seconds for result in results),
                "backend": run.backend,
            },
            "image_region": region,
            "fitted": [{"name": unknown.name, "how": unknown.how} for unknown in unknowns] or None,
            "alignment": alignment.to_json() if alignment else None,
            **_summaries(results),
            "material": summary(materials.records),
            "albedo_scale": materials.scale,
            "geometry": shape.values,
            "objects": _by_object(results, objects, shapes),
            "known_suns": _sun_group([result for result in results if result.has_known_sun is True]),
            "unseen_suns": _sun_group([result for result in results if result.has_known_sun is False]),
            "relight": sweep,
            "notes": [
                *([alignment.note] if alignment else []),
                *other_data,
                *explain_fit(unknowns, records, region == "frame"),
                *([shape.note] if shape.note else []),
                *materials.notes,
                *([no_map] if no_map else []),
                *explain_ignored(ignored),
                *explain_sensor(dataset.scene),
                *explain(records, [result.source for result in results], None if network else lpips_sentence, method),
                *explain_light(
                    [result.has_known_sun for result in results],
                    any(result.grazing is not None for result in results),
                    no_sweep,
                    known.why_unknown,
                ),
                *explain_objects(objects, records, models, swapped_order(run, dataset)),
            ],
            "dataset": _describe(dataset, frames, ignored),
            "config": dict(run.config),
            "training": dict(run.training),
            "versions": _versions(),
            "frames": [_flatten(record) for record in records],
        }
        write_json(part / "metrics.json", metrics := _without_nan(metrics))
        return metrics


@dataclass(frozen=True, eq=False)
class FrameResult:
    """A frame's numbers."""

    frame: Frame  #: the frame that was evaluated
    record: JsonDict  #: its values by group, and what it is
    source: str  #: where its silhouette is from
    has_known_sun: bool | None  #: whether training has seen its Sun
    ignored: float  #: share of its pixels that count nowhere
    grazing: Array | None  #: sums by grazing angle
    seconds: float  #: that its prediction took


def _evaluate_shapes(
    run: "Predictor", dataset: Dataset, objects: Mapping[int, str], config: GeometryConfig | None
) -> tuple[ShapeResult, dict[int, JsonDict | None]]:
    """Of the whole, and of each object where models stand for them. A mesh that cannot be read, or a grid that does not
    fit, costs the shape's numbers and no others."""
    try:
        return compare_geometry(run, dataset, config), compare_object_shapes(run, dataset, objects, config)
    except InputError as error:
        return ShapeResult(None, f"Geometry is null: {error}."), {}


def _write_camera_density(dataset: Dataset, trained: Sequence[Frame], out: Path) -> str:
    """Write the map of the cameras `trained` on into `out`. A sentence where that fails: it costs no numbers."""
    if trained:
        try:
            density.write_camera_density(out / density.NAME, replace(dataset, train=tuple(trained)))
        except InputError as error:
            return f"There is no map of the training cameras: {error}."
    return ""


def _evaluate_frame(
    run: "Predictor",
    dataset: Dataset,
    frame: Frame,
    has_known_sun: bool | None,
    network: lpips.Lpips | None,
    folder: Path,
    objects: Mapping[int, str],
    unknowns: Sequence[Unknown],
    comparison: MaterialComparison,
) -> FrameResult:
    """Predict a frame, what is not known of it fitted by halves, evaluate it and each of its `objects`, write its
    pictures into `folder`, and add it to the `comparison`."""
    fitted = None
    if unknowns:
        fit = predict_by_halves(run, dataset, frame, unknowns)
        prediction, seconds, fitted = fit.prediction, fit.seconds, fit.record
    else:
        start = time.perf_counter()
        prediction = run.predict(frame.camera, frame.sun, exposure=own_exposure(run, frame))
        seconds = time.perf_counter() - start
    light = frame_light(dataset, frame, prediction)
    view, source = frame_images(dataset, frame, prediction, light.truth)
    comparison.add(frame, light.truth, view.valid)
    photograph = is_photograph(frame, source)
    ignored = float(1 - view.valid.mean())
    write_pictures(folder, view, light, photograph)
    named: JsonDict = {
        "file_path": frame.file_path,
        "name": folder.name,
        "sun": rounded_angles(frame),
        "known_sun": has_known_sun,
        "depth_range": depth_range(light),
    }
    if unknowns:
        named["fitted"] = fitted
    groups = image_groups(view, network, source, photograph)
    record: JsonDict = named | groups | visibility_groups(light, view) | depth_groups(light, view)
    if objects:
        record["objects"] = object_groups(dataset, frame, objects, view, light, network)
    return FrameResult(frame, record, source, has_known_sun, ignored, tally_grazing(light, view), seconds)


def _summaries(results: Sequence[FrameResult]) -> JsonDict:
    """The groups over some frames."""
    groups = {group: summary(result.record[group] for result in results) for group in GROUPS}
    return {**groups, "by_grazing_angle": grazing.summary(result.grazing for result in results)}


def _by_object(
    results: Sequence[FrameResult], names: Mapping[int, str], shapes: Mapping[int, JsonDict | None]
) -> list[JsonDict] | None:
    """Of each object that a frame shows: number, name, in how many frames, the groups over its pixels, its shape; None
    for data with one object."""
    summaries: list[JsonDict] = []
    for number, name in names.items():
        records = [result.record["objects"][name] for result in results if name in result.record["objects"]]
        if records:
            groups = {group: summary(record[group] for record in records) for group in OBJECT_GROUPS}
            entry = {"id": number, "name": name, "frames": len(records), **groups, "geometry": shapes.get(number)}
            summaries.append(entry)
    return summaries or None


def _sun_group(results: Sequence[FrameResult]) -> JsonDict | None:
    """How many frames and Suns there are, and the groups over them; None where there is no frame."""
    if not results:
        return None
    return {"frames": len(results), "suns": count_suns([result.frame for result in results]), **_summaries(results)}


def _check_folder(out: Path) -> None:
    """Raise InputError where no evaluation may be written into a folder."""
    if (out / "transforms.json").exists() or (out / "config.json").exists():
        raise InputError(f"{out}: expected a folder for an evaluation, found a dataset or a run")
    check_evaluation_folder(out)


def summary(records: Iterable[Mapping[str, float | None] | None]) -> JsonDict | None:
    """{metric: {"mean", "std" of the population, "count" of frames that have it}, None if no frame has}.

    Where records have their `pixels`, measures over pixels have "pooled", too: over the pixels of all frames at once.
    None where every record is None: the group was not measured at all.
    """
    present = [record for record in records if record is not None]
    if not present:
        return None
    result: JsonDict = {metric: None for metric in present[0] if metric != "pixels"}
    for metric in result:
        pairs = [(value, record.get("pixels")) for record in present if (value := record[metric]) is not None]
        if pairs:
            values, pixels = np.array(pairs, float).T
            result[metric] = {"mean": float(values.mean()), "std": float(values.std()), "count": len(values)}
            if metric in (*shadow.OVER_PIXELS, *material.OVER_PIXELS) and "pixels" in present[0]:
                result[metric]["pooled"] = float(np.average(values, weights=pixels))
    return result


def _describe(dataset: Dataset, frames: Sequence[Frame], ignored: float) -> JsonDict:
    """What the report says about the data: its size, and from scene.json how it was made."""
    return {
        "digest": _digest(dataset, frames),
        "ignored": ignored,
        "truth": any(frame.gt_path is not None for frame in frames),
        "frames": len(frames),
        "train_frames": len(dataset.train),
        "suns": count_suns(frames),
        "resolution": [frames[0].camera.width, frames[0].camera.height],
        "sizes": len({(frame.camera.width, frame.camera.height) for frame in frames}),
        **{key: dataset.scene.get(key) for key in ("scene", "config", "versions")},
    }


def _digest(dataset: Dataset, frames: Sequence[Frame]) -> str | None:
    """By which reports know that runs were evaluated on the same frames; None where their files do not say."""
    try:
        return frames_digest(dataset.root, frames)
    except (OSError, InputError):
        return None


def _flatten(record: JsonDict) -> JsonDict:
    """A frame as the contract has it: values over the silhouette beside the name, others in their groups."""
    rest = {key: value for key, value in record.items() if key not in ("image", "shadow")}
    return {**rest, **record["image"], **(record["shadow"] or dict.fromkeys(metric.key for metric in SHADOW))}


def _versions() -> dict[str, str]:
    versions = {}
    for package in _PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions


def _without_nan(value: object) -> Any:
    """`value` with None for numbers that JSON has no word for."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): _without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    return value
