"""What is read out of a run beside its light, against what was path-traced: albedo and normals.

EVAL/frames/NAME/albedo.png, albedo_truth.png   reflectance as sRGB values, the run's times its scale, over black
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.images import load_image, srgb_from_linear, write_png
from spacesim.data.images.tone import as_bytes
from spacesim.data.records import Camera, Dataset, Frame, Truth
from spacesim.data.store import load_truth
from spacesim.eval.metrics import material
from spacesim.eval.metrics.image import Mask
from spacesim.eval.metrics.material import AlbedoSums
from spacesim.eval.metrics.shadow import Metrics
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.render import render

if TYPE_CHECKING:
    from spacesim.learning.prediction import MaterialView
    from spacesim.splat.run import Predictor


@dataclass(frozen=True, eq=False)
class MaterialScores:
    """Of the frames of an evaluation."""

    records: list[Metrics | None]  #: values of each frame, None of one without truth
    scale: float | None  #: by which the run's albedo is multiplied; None where none can be read
    notes: list[str]  #: why there is none


def compare_materials(
    run: "Predictor", dataset: Dataset, frames: Sequence[Frame], folders: Sequence[Path]
) -> MaterialScores:
    """Over the pixels whose centre shows an object. One scale for all frames, so these are drawn twice: for the scale,
    then for errors and pictures, into the frames' `folders`."""
    traced = [frame for frame in frames if frame.gt_path is not None]
    if not traced:
        return MaterialScores([None] * len(frames), None, ["material is null: the data has no path-traced truth."])
    why = _why_no_albedo(run, traced[0].camera)
    gaussians, records, sums = run.gaussians, list[Metrics | None](), list[AlbedoSums]()
    for frame in frames:
        if frame.gt_path is None:
            records.append(None)
            continue
        truth, mask = _truth(dataset, frame)
        record: Metrics = dict.fromkeys(("albedo_error", "normals_deg", "learned_normals_deg"))
        if gaussians is not None:
            drawn = render(gaussians, Pinhole.of(frame.camera), outputs=("normal",), antialiased=run.antialiased)
            record["normals_deg"] = material.normals_deg(drawn.image("normal"), truth.normal, mask)
        if not why:
            view = run.draw_material(frame.camera)
            record["learned_normals_deg"] = material.normals_deg(view.normal, truth.normal, mask)
            sums.append(AlbedoSums.of(view.albedo, truth.albedo, mask))
        records.append({**record, "pixels": int(mask.sum())})
    total = AlbedoSums.total(sums)
    scale = total.scale
    if scale is not None:
        mean = total.true / total.values
        for frame, record_of_frame, folder in zip(frames, records, folders, strict=True):
            if record_of_frame is not None:
                truth, mask = _truth(dataset, frame)
                view = run.draw_material(frame.camera)
                record_of_frame["albedo_error"] = material.albedo_error(view.albedo, truth.albedo, mask, scale, mean)
                _write_pictures(folder, view, truth, scale)
    return MaterialScores(records, scale, [f"albedo_error is null: {why}."] if why else [])


def _why_no_albedo(run: "Predictor", camera: Camera) -> str:
    """In words; "" where there is one."""
    try:
        run.draw_material(camera)
    except InputError as error:
        return str(error)
    return ""


def _truth(dataset: Dataset, frame: Frame) -> tuple[Truth, Mask]:
    """A frame's truth, and [H, W] bool which pixels show an object and are not to be ignored."""
    truth = load_truth(dataset, frame)
    return truth, (truth.object_id > 0) & load_image(dataset, frame).valid


def _write_pictures(folder: Path, view: "MaterialView", truth: Truth, scale: float) -> None:
    covered = np.clip(view.alpha, 0, 1)[..., None]
    write_png(folder / "albedo.png", as_bytes(srgb_from_linear(view.albedo * scale) * covered))
    write_png(folder / "albedo_truth.png", as_bytes(srgb_from_linear(truth.albedo)))
