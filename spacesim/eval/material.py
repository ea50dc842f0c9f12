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


class MaterialComparison:
    """Frame after frame, over the pixels whose centre shows an object. One scale for all frames: where there is albedo
    these are read and drawn again in the end, for errors and pictures."""

    def __init__(self, run: "Predictor", dataset: Dataset, frames: Sequence[Frame]) -> None:
        self._run, self._dataset, self._frames = run, dataset, frames
        traced = [frame for frame in frames if frame.gt_path is not None]
        self._notes = ["material is null: the data has no path-traced truth."]
        if traced:
            why = _why_no_albedo(run, traced[0].camera)
            self._notes = [f"albedo_error is null: {why}."] if why else []
        self._records: list[Metrics | None] = []
        self._sums: list[AlbedoSums] = []

    def add(self, frame: Frame, truth: Truth | None, valid: Mask) -> None:
        """The next of the frames. truth: None where it has none;  valid: [H, W] bool, pixels that are not to be
        ignored"""
        if truth is None:
            self._records.append(None)
            return
        mask, gaussians = _shown(truth, valid), self._run.gaussians
        record: Metrics = dict.fromkeys(("albedo_error", "normals_deg", "learned_normals_deg"))
        if gaussians is not None:
            drawn = render(gaussians, Pinhole.of(frame.camera), outputs=("normal",), antialiased=self._run.antialiased)
            record["normals_deg"] = material.normals_deg(drawn.image("normal"), truth.normal, mask)
        if not self._notes:
            view = self._run.draw_material(frame.camera)
            record["learned_normals_deg"] = material.normals_deg(view.normal, truth.normal, mask)
            self._sums.append(AlbedoSums.of(view.albedo, truth.albedo, mask))
        self._records.append({**record, "pixels": int(mask.sum())})

    def scores(self, folders: Sequence[Path]) -> MaterialScores:
        """Of all frames, once these are added, with pictures in their `folders`."""
        total = AlbedoSums.total(self._sums)
        scale = total.scale
        if scale is not None:
            mean = total.true / total.values
            for frame, record, folder in zip(self._frames, self._records, folders, strict=True):
                if record is not None:
                    truth = load_truth(self._dataset, frame)
                    mask = _shown(truth, load_image(self._dataset, frame).valid)
                    view = self._run.draw_material(frame.camera)
                    record["albedo_error"] = material.albedo_error(view.albedo, truth.albedo, mask, scale, mean)
                    _write_pictures(folder, view, truth, scale)
        return MaterialScores(self._records, scale, self._notes)


def _why_no_albedo(run: "Predictor", camera: Camera) -> str:
    """In words; "" where there is one."""
    try:
        run.draw_material(camera)
    except InputError as error:
        return str(error)
    return ""


def _shown(truth: Truth, valid: Mask) -> Mask:
    mask: Mask = (truth.object_id > 0) & valid
    return mask


def _write_pictures(folder: Path, view: "MaterialView", truth: Truth, scale: float) -> None:
    covered = np.clip(view.alpha, 0, 1)[..., None]
    write_png(folder / "albedo.png", as_bytes(srgb_from_linear(view.albedo * scale) * covered))
    write_png(folder / "albedo_truth.png", as_bytes(srgb_from_linear(truth.albedo)))
