"""What a run does not know of a picture, fitted on one half of the object in it and scored on the other half, and the
other way round: every pixel is scored with numbers that were fitted without it."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from spacesim.data.files import JsonDict
from spacesim.data.records import Dataset, Frame, Sun
from spacesim.eval.frame_metrics import frame_target
from spacesim.splat.fit import Picture, PictureLight, Unknown, draw

if TYPE_CHECKING:
    from spacesim.splat.run import Prediction, Predictor

ANY_SUN = Sun(np.array([0.0, 0.0, 1.0]))  #: of a frame that shows no object to find its Sun by


@dataclass(frozen=True, eq=False)
class HalvesFit:
    """A frame's fit."""

    prediction: "Prediction"  #: each half drawn with what was fitted on the other
    record: JsonDict | None  #: as metrics.json has it, None where a half shows nothing to fit to
    seconds: float  #: that drawing it once took


def predict_by_halves(run: "Predictor", dataset: Dataset, frame: Frame, unknowns: Sequence[Unknown]) -> HalvesFit:
    """The frame as `run` shows it with its `unknowns` fitted. The halves are the silhouette's pixels left and right of
    their median column, and what lies beside the silhouette there."""
    target = frame_target(dataset, frame)
    columns = np.nonzero(target.silhouette)[1]
    start = PictureLight(frame.sun)
    middle = math.ceil(np.median(columns)) if len(columns) else 0
    is_left = np.broadcast_to(np.arange(target.silhouette.shape[1]) < middle, target.silhouette.shape)
    masks = [target.silhouette & is_left, target.silhouette & ~is_left]
    if not all(mask.any() for mask in masks):
        alone = PictureLight(ANY_SUN) if frame.sun is None and run.relightable else start
        begun = time.perf_counter()
        return HalvesFit(draw(run, frame.camera, alone), None, time.perf_counter() - begun)
    lights = [start, start]
    for unknown in unknowns:
        lights = unknown.fit(run, Picture(target.image.over(np.zeros(3)), frame.camera), masks, lights)
    begun = time.perf_counter()
    by_left, by_right = (draw(run, frame.camera, light) for light in lights)
    seconds = 0.5 * (time.perf_counter() - begun)
    return HalvesFit(_joined(by_right, by_left, is_left), _record(unknowns, middle, lights), seconds)


def _joined(left: "Prediction", right: "Prediction", is_left: np.ndarray) -> "Prediction":
    """The left of one picture, the right of another."""

    def join(one: Any, other: Any) -> Any:
        return None if one is None else np.where(is_left.reshape(*is_left.shape, *[1] * (one.ndim - 2)), one, other)

    names = "rgb", "alpha", "depth", "visibility", "linear"
    return replace(left, **{name: join(getattr(left, name), getattr(right, name)) for name in names})


def _record(unknowns: Sequence[Unknown], middle: int, lights: Sequence[PictureLight]) -> JsonDict:
    """What was found on the left half, then on the right half; embeddings are left out."""
    names = {unknown.name for unknown in unknowns}
    record: JsonDict = {"from_column": middle}
    if "gain" in names:
        record["gain"] = [light.gain for light in lights]
    if "sun" in names:
        suns = [light.sun for light in lights]
        record["sun"] = [None if sun is None else [round(angle, 4) for angle in sun.angles] for sun in suns]
    return record
