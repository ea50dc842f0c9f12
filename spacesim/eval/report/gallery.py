"""The report's pictures: best, median and worst frames as truth, prediction, error and shadow masks."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from spacesim.data.files import JsonMapping
from spacesim.eval.metrics.shadow import THRESHOLD
from spacesim.eval.pictures import (
    ERROR_SCALE,
    LIT,
    SHADOWED,
    WRONGLY_LIT,
    WRONGLY_SHADOWED,
    depth_colors,
    error_colors,
)
from spacesim.eval.report.html import escape, picture
from spacesim.eval.report.read import Evaluation

Panels = Mapping[str, str]
"""Captions of a frame's pictures by their names."""

_PANELS: Panels = {
    "truth": "Truth",
    "prediction": "Prediction",
    "error": "Error",
    "shadow_truth": "Dark pixels, truth",
    "shadow_prediction": "Dark pixels, prediction",
}
_DEPTHS: Panels = {"depth_truth": "Truth", "depth": "Prediction"}
_ALBEDOS: Panels = {"albedo_truth": "Truth", "albedo": "Prediction"}
_DARK = {
    "bright": LIT,
    "dark": SHADOWED,
    "wrongly dark": WRONGLY_SHADOWED,
    "wrongly bright": WRONGLY_LIT,
}
MISTAKES = {
    "lit": LIT,
    "shadowed": SHADOWED,
    "wrongly shadowed": WRONGLY_SHADOWED,
    "wrongly lit": WRONGLY_LIT,
}


def gallery(runs: Sequence[Evaluation]) -> str:
    """HTML of the frames chosen by PSNR."""

    def words(frame: JsonMapping) -> str:
        return "" if frame["psnr"] is None else f"PSNR {frame['psnr']:.2f} dB"

    bar = color_bar(error_colors(np.linspace(0, 1, 17)))
    keys = f'<p class="key"><span>Error, mean of the channels: 0 {bar} {ERROR_SCALE} and more</span></p>'
    panels = dict(_PANELS)
    if all(run.metrics["dataset"].get("truth") is False for run in runs):
        panels["truth"] = "Picture"
    if all(run.metrics["shadow"] is not None for run in runs):
        keys += f'<p class="key"><span>Luminance, dark below {THRESHOLD}:</span>{swatches(_DARK)}</p>'
        panels |= {"shadow_truth": f"Dark pixels, {panels['truth'].lower()}"}
    else:
        panels = {name: label for name, label in panels.items() if not name.startswith("shadow")}
    return keys + strips(runs, panels, "prediction", _psnr, words)


def depths(runs: Sequence[Evaluation]) -> str:
    """HTML of the depth of frames that have one, each with its scale; "" where a run has no such pictures."""

    def score(frame: JsonMapping) -> float | None:
        return _psnr(frame) if frame.get("depth_range") else None

    if not _have_scores(runs, score):
        return ""

    def words(frame: JsonMapping) -> str:
        error = (frame.get("depth") or {}).get("mae")
        return "" if error is None else f"mean error {error:.3g} m"

    truth = all(_has_pictures(run, "depth_truth") for run in runs)
    panels = _DEPTHS if truth else {"depth": _DEPTHS["depth"]}
    return strips(runs, panels, "depth", score, words)


def albedos(runs: Sequence[Evaluation]) -> str:
    """HTML of the albedo of frames, of the runs from which it can be read; "" where there are none."""
    reading = [run for run in runs if any(_albedo_error(frame) is not None for frame in run.frames.values())]

    def score(frame: JsonMapping) -> float | None:
        return None if _albedo_error(frame) is None else _psnr(frame)

    def words(frame: JsonMapping) -> str:
        error = _albedo_error(frame)
        return "" if error is None else f"error {error:.3f}"

    return strips(reading, _ALBEDOS, "albedo", score, words) if reading and _have_scores(reading, score) else ""


def _have_scores(runs: Sequence[Evaluation], score: Callable[[JsonMapping], float | None]) -> bool:
    """Whether there is a frame to choose wherever `strips` chooses."""
    for group in _comparable(runs):
        frames = ([run.frames.get(name) for run in group] for name in group[0].frames)
        if not any(all(frame and score(frame) is not None for frame in same) for same in frames):
            return False
    return True


def _albedo_error(frame: JsonMapping) -> float | None:
    value: float | None = (frame.get("material") or {}).get("albedo_error")
    return value


def _psnr(frame: JsonMapping) -> float | None:
    value: float | None = frame["psnr"]
    return value


def _has_pictures(run: Evaluation, panel: str) -> bool:
    """Whether each frame with depth has one of that name, and the data is not known to lack it."""
    if panel == "depth_truth" and run.metrics["dataset"].get("truth") is False:
        return False
    frames = (frame for frame in run.metrics["frames"] if frame.get("depth_range"))
    return all((run.folder / "frames" / frame["name"] / f"{panel}.png").is_file() for frame in frames)


def strips(
    runs: Sequence[Evaluation],
    panels: Panels,
    score_panel: str,
    score: Callable[[JsonMapping], float | None],
    words: Callable[[JsonMapping], str],
) -> str:
    """HTML of the best, the median and the worst frame: the same ones for all runs where these share frames, else each
    run's own.

    score: of a frame, the higher the better, None where it has none; words: what is said of it, beside the
    run's name or below the panel `score_panel`
    """
    limit = 480 if len(runs) <= 2 else 320  # pixels a side; keeps the page small
    parts = []
    for group in _comparable(runs):
        shared = set.intersection(*(set(run.frames) for run in group))
        rank: dict[str, float] = {}
        for name in (name for name in group[0].frames if name in shared):
            scores = [value for run in group if (value := score(run.frames[name])) is not None]
            if len(scores) == len(group):
                rank[name] = sum(scores) / len(scores)
        for title, name in _select_frames(rank or dict.fromkeys(sorted(shared), 0.0)):
            frame = group[0].frames[name]
            parts.append(f"<h3>{title} <small>{escape(frame['file_path'])}{sun_of(frame)}</small></h3>")
            for run in group:
                summary = words(run.frames[name])
                if len(runs) > 1:
                    parts.append(f"<h4>{run.label} <small>{summary}</small></h4>")
                captions = dict(panels)
                if len(runs) == 1 and summary:
                    captions[score_panel] += f", {summary}"
                parts.append(_strip(run, name, panels, captions, limit))
    return "".join(parts)


def sun_of(frame: JsonMapping) -> str:
    """Where a frame's Sun is, and whether training has never seen it; "" where that is not known."""
    if frame["sun"] is None:
        return ""
    azimuth, elevation = frame["sun"]
    return f" · Sun {azimuth:.1f}°, {elevation:.1f}°{', unseen' * (frame.get('known_sun') is False)}"


def swatches(colors: Mapping[str, Sequence[int]]) -> str:
    """HTML of what each colour means."""
    return "".join(
        f'<span><b style="background: {css(color)}"></b>{escape(label)}</span>' for label, color in colors.items()
    )


def color_bar(colors: np.ndarray) -> str:
    """HTML of a scale. colors: [N, 3] from its left end in even steps"""
    stops = ", ".join(css(color) for color in colors)
    return f'<span class="bar" style="background: linear-gradient(90deg, {stops})"></span>'


def css(color: Sequence[int] | np.ndarray) -> str:
    """A colour of three bytes as style sheets write it."""
    return "rgb({}, {}, {})".format(*map(int, color))


def _comparable(runs: Sequence[Evaluation]) -> list[list[Evaluation]]:
    """All runs as one group if they share frames, else each on its own."""
    shared = set.intersection(*(set(run.frames) for run in runs))
    return [list(runs)] if shared else [[run] for run in runs]


def _select_frames(rank: Mapping[str, float]) -> list[tuple[str, str]]:
    """(what it is, frame) of the best, the median and the worst frame; fewer where there are fewer frames."""
    ordered = sorted(rank, key=lambda name: (-rank[name], name))
    picks = {"Best": ordered[0], "Worst": ordered[-1], "Median": ordered[len(ordered) // 2]}
    unique = {name: title for title, name in picks.items()}
    titles = {title: name for name, title in unique.items()}
    return [(title, titles[title]) for title in ("Best", "Median", "Worst") if title in titles]


def _strip(run: Evaluation, name: str, panels: Panels, captions: Panels, limit: int) -> str:
    """HTML of one run's pictures of a frame."""
    frame = run.frames[name]
    small = "small " if max(run.metrics["dataset"]["resolution"]) < 200 else ""
    figures = [
        picture(
            run.folder / "frames" / name / f"{panel}.png",
            f"{label} of {frame['file_path']}, {run.name}",
            escape(captions[panel]) + (_depth_scale(frame) if panel in _DEPTHS else ""),
            limit,
        )
        for panel, label in panels.items()
    ]
    three = " three" if len(panels) <= 3 else ""
    return f'<div class="{small}strip{three}">{"".join(figures)}</div>'


def _depth_scale(frame: JsonMapping) -> str:
    """HTML: the ends of a frame's colours in metres."""
    near, far = (f"{value:.4g}&nbsp;m" for value in frame["depth_range"])
    return f"<br>{near} {color_bar(depth_colors(np.linspace(0, 1, 17)))} {far}"
