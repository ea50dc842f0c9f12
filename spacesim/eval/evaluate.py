"""Judge a trained run against a dataset: metrics.json and pictures of every frame (contract: metrics.json).

Predictions are clipped to [0, 1] as a display would; both pictures lie over black. Means and
population standard deviations are over the frames, without those where a metric is null. Only `render_ms`
differs from one call to the next.
"""

import math
import re
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spacesim.data.errors import InputError, WorkError
from spacesim.data.files import write_json
from spacesim.data.images import load_image, luminance, read_png, write_png
from spacesim.data.records import Dataset, Frame
from spacesim.data.store import SHADOW_SELF_CAST, load_truth
from spacesim.eval import image, lpips, pictures, shadow
from spacesim.eval.image import Mask
from spacesim.eval.labels import GROUPS
from spacesim.eval.notes import explain

if TYPE_CHECKING:
    from spacesim.splat.run import Prediction, Run

SCHEMA = 1
_PACKAGES = ("spacesim", "mitsuba", "drjit", "numpy", "scipy", "flip-evaluator", "torch")

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class EvaluateConfig:
    """split: "test", "train" or "all";  lpips_weights: see `spacesim.eval.lpips.find_weights`."""

    split: str = "test"
    lpips_weights: Path | None = None

    def __post_init__(self) -> None:
        if self.split not in ("test", "train", "all"):
            raise InputError(f"split: expected test, train or all, found {self.split!r}")


@dataclass(frozen=True, eq=False)
class View:
    """A frame's pictures. prediction, truth: [H, W, 3] sRGB values in [0, 1] over black
    valid: [H, W] bool, pixels that are not to be ignored;  silhouette: [H, W] bool, the object's among them
    """

    prediction: np.ndarray
    truth: np.ndarray
    silhouette: Mask
    valid: Mask


def evaluate(
    run: "Run",
    dataset: Dataset,
    out: Path,
    config: EvaluateConfig | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Judge every frame of the split and return what EVAL/metrics.json, written last, then holds.

    progress: called with (frames done, frames in all, the next one's file) before each frame and at the end.
    Raises InputError where there is no frame to judge or the dataset is broken, WorkError where a prediction
    is not finite.
    """
    config = config or EvaluateConfig()
    frames = {"test": dataset.test, "train": dataset.train, "all": dataset.frames}[config.split]
    if not frames:
        raise InputError(f"{dataset.root}: expected frames in the split {config.split}, found none")
    network, lpips_sentence = lpips.load(config.lpips_weights)
    _prepare(out)
    run.predict(frames[0].camera, frames[0].sun)  # compiles the kernels
    seconds: list[float] = []
    records: list[dict[str, Any]] = []
    sources: list[str] = []
    for name, frame in zip(frame_names(frames), frames, strict=True):
        if progress:
            progress(len(records), len(frames), frame.file_path)
        start = time.perf_counter()
        prediction = run.predict(frame.camera, frame.sun)
        seconds.append(time.perf_counter() - start)
        view, source = _view(dataset, frame, prediction)
        sources.append(source)
        records.append(
            {"file_path": frame.file_path, "name": name, "sun": _rounded_angles(frame)}
            | _judge(view, network)
            | {"shadow_mask": _judge_visibility(dataset, frame, prediction, view)}
        )
        _write_pictures(out / "frames" / name, view)
    if progress:
        progress(len(frames), len(frames), "")

    metrics = {
        "schema": SCHEMA,
        "run": str(run.path),
        "data": str(dataset.root),
        "split": config.split,
        "model": {
            "gaussians": run.gaussians,
            "bytes": run.bytes,
            "render_ms": 1e3 * statistics.median(seconds),
            "backend": run.backend,
        },
        **{group: summary(record[group] for record in records) for group in GROUPS},
        "geometry": None,
        "notes": explain(records, sources, None if network else lpips_sentence, str(run.config.get("method"))),
        "dataset": _describe(dataset, frames),
        "config": dict(run.config),
        "training": dict(run.training),
        "versions": _versions(),
        "frames": [_flattened(record) for record in records],
    }
    write_json(out / "metrics.json", metrics := _finite(metrics))
    return metrics


def _prepare(out: Path) -> None:
    """Make the folder and take away the numbers of an earlier call: a folder that has them is complete."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "metrics.json").unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{out}: expected a folder to write to, found none ({error.strerror})") from None


def frame_names(frames: Sequence[Frame]) -> list[str]:
    """A unique folder name for each frame, from its file's: letters, digits, dots, dashes and underscores."""
    names: list[str] = []
    for frame in frames:
        stem = str(Path(frame.file_path).with_suffix("")).removeprefix("./").removeprefix("images/")
        stem = re.sub(r"[^A-Za-z0-9._-]+", "_", stem).lstrip("._") or "frame"
        name, count = stem, 1
        while name in names:
            count += 1
            name = f"{stem}_{count}"
        names.append(name)
    return names


def summary(records: Iterable[Mapping[str, float | None] | None]) -> dict[str, Any] | None:
    """{metric: {"mean", "std" of the population, "count" of frames that have it}, None if no frame has}.

    None where every record is None: the group was not measured at all.
    """
    present = [record for record in records if record is not None]
    if not present:
        return None
    result: dict[str, Any] = {}
    for metric in present[0]:
        values = [value for record in present if (value := record[metric]) is not None]
        result[metric] = (
            {"mean": float(np.mean(values)), "std": float(np.std(values)), "count": len(values)} if values else None
        )
    return result


def _view(dataset: Dataset, frame: Frame, prediction: "Prediction") -> tuple[View, str]:
    """The pictures to compare, and where the silhouette is from: "truth", "alpha" or "frame"."""
    if not all(np.all(np.isfinite(p)) for p in (prediction.rgb, prediction.alpha)):
        raise WorkError(f"{frame.file_path}: the prediction has values that are not finite; train the run again")
    loaded = load_image(dataset, frame)
    if frame.silhouette_path is not None and not any(frame.distortion):
        silhouette, source = read_png(dataset.root / frame.silhouette_path) > 0, "truth"
        if silhouette.shape != loaded.alpha.shape:
            raise InputError(
                f"{dataset.root / frame.silhouette_path}: expected {loaded.alpha.shape} pixels, "
                f"found {silhouette.shape}"
            )
    else:
        silhouette = loaded.alpha >= 0.5
        source = "frame" if np.all(loaded.alpha == 1) else "alpha"
    shown = np.clip(prediction.rgb, 0, 1), loaded.over(np.zeros(3))
    return View(*shown, silhouette & loaded.valid, loaded.valid), source


def _judge(view: View, network: lpips.Lpips | None) -> dict[str, dict[str, float | None]]:
    """The frame's values of all groups but "shadow_mask"."""
    inside = image.interior(view.valid.shape)
    levels = luminance(view.prediction), luminance(view.truth)
    return {
        "image": _image_metrics(view, view.silhouette, view.silhouette, network),
        "image_full": _image_metrics(view, view.valid, view.valid & inside, network),
        "shadow": shadow.luminance_metrics(*levels, view.silhouette),
        "shadow_full": shadow.luminance_metrics(*levels, view.valid),
    }


def _image_metrics(view: View, mask: Mask, windows: Mask, network: lpips.Lpips | None) -> shadow.Metrics:
    """Metrics over `mask`; SSIM over `windows`, the centres of its windows."""
    pair = view.prediction, view.truth
    crops = [image.cropped(picture, mask) for picture in pair] if network and mask.any() else []
    return {
        "psnr": image.psnr(*pair, mask),
        "ssim": image.ssim(*pair, windows),
        "lpips": network(*crops) if network and crops else None,
        "mae": image.mae(*pair, mask),
        "rmse": image.rmse(*pair, mask),
        "flip": image.flip(*pair, mask),
    }


def _judge_visibility(dataset: Dataset, frame: Frame, prediction: "Prediction", view: View) -> shadow.Metrics | None:
    """Predicted sun visibility (already divided by alpha) against the truth; None where either is missing."""
    if prediction.visibility is None or frame.gt_path is None:
        return None
    truth = load_truth(dataset, frame)
    sees_the_sun_or_a_caster = truth.shadow >= SHADOW_SELF_CAST
    return shadow.visibility_metrics(prediction.visibility, truth.sun_visibility, view.valid & sees_the_sun_or_a_caster)


def _write_pictures(folder: Path, view: View) -> None:
    dark, truly_dark = (shadow.is_shadowed(luminance(p)) for p in (view.prediction, view.truth))
    for name, picture in {
        "truth": pictures.as_bytes(view.truth),
        "prediction": pictures.as_bytes(view.prediction),
        "error": pictures.error_picture(view.prediction, view.truth, view.valid),
        "shadow_truth": pictures.shadow_picture(truly_dark, truly_dark, view.silhouette),
        "shadow_prediction": pictures.shadow_picture(dark, truly_dark, view.silhouette),
    }.items():
        write_png(folder / f"{name}.png", picture)


def _describe(dataset: Dataset, frames: Sequence[Frame]) -> dict[str, Any]:
    """What the report says about the data: its size, and from scene.json how it was made."""
    suns = {tuple(angles) for frame in frames if (angles := _rounded_angles(frame)) is not None}
    return {
        "frames": len(frames),
        "train_frames": len(dataset.train),
        "suns": len(suns),
        "resolution": [frames[0].camera.width, frames[0].camera.height],
        **{key: dataset.scene.get(key) for key in ("scene", "config", "versions")},
    }


def _flattened(record: dict[str, Any]) -> dict[str, Any]:
    """A frame as the contract has it: values over the silhouette beside the name, others in their groups."""
    rest = {key: value for key, value in record.items() if key not in ("image", "shadow")}
    return {**rest, **record["image"], **record["shadow"]}


def _rounded_angles(frame: Frame) -> list[float] | None:
    """[azimuth, elevation] of the Sun, degrees, to 1e-4."""
    return None if frame.sun is None else [round(angle, 4) for angle in frame.sun.angles]


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
