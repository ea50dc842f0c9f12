"""The report's pictures: best, median and worst frames as truth, prediction, error and shadow masks."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from spacesim.eval.judged import Judged
from spacesim.eval.page import escape, picture
from spacesim.eval.pictures import (
    ERROR_SCALE,
    LIT,
    SHADOWED,
    WRONGLY_LIT,
    WRONGLY_SHADOWED,
    error_colours,
)

_PANELS = {
    "truth": "Truth",
    "prediction": "Prediction",
    "error": "Error",
    "shadow_truth": "Shadow, truth",
    "shadow_prediction": "Shadow, prediction",
}
_SWATCHES = {
    "lit": LIT,
    "shadowed": SHADOWED,
    "wrongly shadowed": WRONGLY_SHADOWED,
    "wrongly lit": WRONGLY_LIT,
}


def gallery(runs: Sequence[Judged]) -> str:
    """HTML of the chosen frames: the same ones for all runs where these share frames, else each run's own."""
    limit = 480 if len(runs) <= 2 else 320  # pixels a side; keeps the page small
    parts = [_keys()]
    for group in _comparable(runs):
        shared = set.intersection(*(set(run.frames) for run in group))
        rank = {
            name: np.mean(values)
            for name in group[0].frames
            if name in shared and None not in (values := [run.frames[name]["psnr"] for run in group])
        }
        for title, name in _chosen(rank or dict.fromkeys(sorted(shared), 0.0)):
            frame = group[0].frames[name]
            parts.append(f"<h3>{title} <small>{escape(frame['file_path'])}{_sun(frame)}</small></h3>")
            parts += [_strip(run, name, limit, named=len(runs) > 1) for run in group]
    return "".join(parts)


def _comparable(runs: Sequence[Judged]) -> list[list[Judged]]:
    """All runs as one group if they share frames of the same data, else each on its own."""
    shared = set.intersection(*(set(run.frames) for run in runs))
    if shared and len({run.metrics["data"] for run in runs}) == 1:
        return [list(runs)]
    return [[run] for run in runs]


def _chosen(rank: Mapping[str, float]) -> list[tuple[str, str]]:
    """(what it is, frame) of the best, the median and the worst frame; fewer where there are fewer frames."""
    ordered = sorted(rank, key=lambda name: (-rank[name], name))
    picks = {"Best": ordered[0], "Worst": ordered[-1], "Median": ordered[len(ordered) // 2]}
    unique = {name: title for title, name in picks.items()}
    titles = {title: name for name, title in unique.items()}
    return [(title, titles[title]) for title in ("Best", "Median", "Worst") if title in titles]


def _strip(run: Judged, name: str, limit: int, named: bool) -> str:
    """HTML of one run's five pictures of a frame."""
    frame = run.frames[name]
    quality = "" if frame["psnr"] is None else f"PSNR {frame['psnr']:.2f} dB"
    heading = f"<h4>{run.label} <small>{quality}</small></h4>" if named else ""
    captions = dict(_PANELS)
    if not named and quality:
        captions["prediction"] += f", {quality}"
    small = "small " if max(run.metrics["dataset"]["resolution"]) < 200 else ""
    figures = [
        picture(
            run.folder / "frames" / name / f"{panel}.png",
            f"{label} of {frame['file_path']}, {run.name}",
            escape(captions[panel]),
            limit,
        )
        for panel, label in _PANELS.items()
    ]
    return f'{heading}<div class="{small}strip">{"".join(figures)}</div>'


def _keys() -> str:
    """HTML of the error's colour bar and the colours of the shadow masks."""
    stops = ", ".join(_css(colour) for colour in error_colours(np.linspace(0, 1, 17)))
    bar = f'<span class="bar" style="background: linear-gradient(90deg, {stops})"></span>'
    swatches = "".join(
        f'<span><b style="background: {_css(colour)}"></b>{label}</span>' for label, colour in _SWATCHES.items()
    )
    return (
        f'<p class="key"><span>Error, mean of the channels: 0 {bar} {ERROR_SCALE} and more</span></p>'
        f'<p class="key">{swatches}</p>'
    )


def _css(colour: Sequence[int] | np.ndarray) -> str:
    return "rgb({}, {}, {})".format(*map(int, colour))


def _sun(frame: Mapping[str, Any]) -> str:
    if frame["sun"] is None:
        return ""
    azimuth, elevation = frame["sun"]
    return f" · Sun {azimuth:.1f}°, {elevation:.1f}°"
