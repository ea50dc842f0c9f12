"""One view under many Suns: what a relightable run shows of it, beside the truth where the dataset has it.

EVAL/relight/prediction_KK.png, visibility_KK.png where the method predicts it, truth_KK.png where there is one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from spacesim.data.files import JsonDict
from spacesim.data.geometry import degrees_between
from spacesim.data.images import write_png
from spacesim.data.records import Camera, Dataset, Frame
from spacesim.eval import pictures
from spacesim.eval.frame_metrics import frame_images
from spacesim.eval.metrics import image
from spacesim.eval.suns import known_suns, rounded_angles

if TYPE_CHECKING:
    from spacesim.splat.run import Prediction, Predictor

MAX_SUNS = 8
"""Of a strip (what a page shows side by side)."""


@dataclass(frozen=True, eq=False)
class Sweep:
    """A view and the frames that name its Suns, by rising phase angle."""

    view: Frame  #: whose camera every picture is seen from
    lit_as: tuple[Frame, ...]  #: frames whose Suns are taken, one for each Sun
    truths: tuple[Frame | None, ...]  #: the frame of this view under the Sun, None where the dataset has none


def plan_sweep(frames: Sequence[Frame], every: Sequence[Frame]) -> Sweep | None:
    """The evaluated view with the most Suns of its own, of several the one with the Sun most behind the camera, under
    up to `MAX_SUNS` of the Suns of all frames: those with truth, then others, spread over the phase angles.

    None where the frames have fewer than two Suns.
    """
    suns = {tuple(angles): frame for frame in (*frames, *every) if (angles := rounded_angles(frame)) is not None}
    if len(suns) < 2:
        return None
    groups: dict[tuple[float, ...], dict[tuple[float, ...], Frame]] = {}
    for frame in frames:
        if (angles := rounded_angles(frame)) is not None:
            groups.setdefault(_place(frame.camera), {}).setdefault(tuple(angles), frame)
    if not groups:
        return None

    def rank(group: dict[tuple[float, ...], Frame]) -> tuple[int, float]:
        return -len(group), min(phase_deg(frame.camera, frame) for frame in group.values())

    view_suns = min(groups.values(), key=rank)
    view = min(view_suns.values(), key=lambda frame: phase_deg(frame.camera, frame))

    def spread(names: list[tuple[float, ...]], count: int) -> list[tuple[float, ...]]:
        ordered = sorted(names, key=lambda name: (phase_deg(view.camera, suns[name]), name))
        places = np.linspace(0, len(ordered) - 1, min(count, len(ordered))).round().astype(int)
        return [ordered[place] for place in places]

    with_truth = spread(list(view_suns), MAX_SUNS)
    others = spread([name for name in suns if name not in view_suns], MAX_SUNS - len(with_truth))
    chosen = spread(with_truth + others, MAX_SUNS)
    return Sweep(view, tuple(suns[name] for name in chosen), tuple(view_suns.get(name) for name in chosen))


def phase_deg(camera: Camera, lit_as: Frame) -> float:
    """Degrees between the Sun and the way back along the optical axis: 0 the Sun is behind the camera, 180 ahead."""
    assert lit_as.sun is not None, "only frames with a Sun are asked about"
    return float(degrees_between(lit_as.sun.direction @ -camera.world_from_camera[:3, 2]))


def write_sweep(
    run: "Predictor", dataset: Dataset, frames: Sequence[Frame], trained: Sequence[Frame], out: Path
) -> tuple[JsonDict | None, str]:
    """Write the pictures below `out`. What metrics.json says of them, None where there are none, and then a sentence
    why. trained: the frames that the run was trained on"""
    sweep = plan_sweep(frames, dataset.frames)
    if sweep is None:
        return None, "relight is null: the data has fewer than two Suns."
    predictions = [run.predict(sweep.view.camera, frame.sun) for frame in sweep.lit_as]
    if all(np.array_equal(predictions[0].rgb, picture.rgb) for picture in predictions[1:]):
        return None, "relight is null: the run shows the same picture under every Sun."
    known_sun = known_suns(sweep.lit_as, trained)
    steps = []
    for index, frame in enumerate(sweep.lit_as):
        truth, prediction = sweep.truths[index], predictions[index]
        step: JsonDict = {
            "sun": rounded_angles(frame),
            "phase_deg": round(phase_deg(sweep.view.camera, frame), 2),
            "known_sun": known_sun[index],
            "truth": None if truth is None else truth.file_path,
            "psnr": None,
        }
        if truth is not None:
            view, _ = frame_images(dataset, truth, prediction)
            step["psnr"] = image.psnr(view.prediction, view.truth, view.silhouette)
            write_png(out / "relight" / f"truth_{index:02d}.png", pictures.as_bytes(view.truth))
        _write_prediction(out / "relight", index, prediction)
        steps.append(step)
    visible = predictions[0].visibility is not None
    return {"view": sweep.view.file_path, "visibility": visible, "suns": steps}, ""


def _write_prediction(folder: Path, index: int, prediction: "Prediction") -> None:
    write_png(folder / f"prediction_{index:02d}.png", pictures.as_bytes(prediction.rgb))
    if prediction.visibility is not None:
        shown = pictures.visibility_picture(prediction.visibility, prediction.alpha)
        write_png(folder / f"visibility_{index:02d}.png", shown)


def _place(camera: Camera) -> tuple[float, ...]:
    """Equal for equal cameras; rounded, as files may have been rounded."""
    inner = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return tuple(np.round([*camera.world_from_camera.ravel(), *inner], 6) + 0.0)
