"""The report about light: one view under many Suns, true and predicted shadow masks, errors by grazing angle."""

from collections.abc import Sequence

import numpy as np

from spacesim.data.files import JsonDict, JsonMapping
from spacesim.eval.labels import LOWER
from spacesim.eval.pictures import ATTACHED, ATTACHED_LIT, LIT, OTHER_CAST, SELF_CAST, SHADOWED
from spacesim.eval.report.charts import bar_chart
from spacesim.eval.report.gallery import MISTAKES, Panels, color_bar, strips, sun_of, swatches
from spacesim.eval.report.html import escape, picture, table
from spacesim.eval.report.read import Evaluation, legend

MAX_SUN_PAIRS = 24
"""Frames whose masks stand side by side in small; of more, evenly chosen ones."""

MIN_PIXEL_SHARE = 0.1
"""Lit and cast-shadow pixels of a frame that can be best or worst, as a share of the median frame's."""

_PANELS: Panels = {
    "truth": "Truth",
    "prediction": "Prediction",
    "mask_truth": "Shadow mask, truth",
    "mask_prediction": "Shadow mask, prediction",
    "visibility": "Predicted visibility",
}
_KINDS = {"lit": LIT, "faces away": ATTACHED, "cast by itself": SELF_CAST, "cast by another": OTHER_CAST}
_PREDICTED = {**MISTAKES, "faces away: dark": ATTACHED, "faces away, but lit": ATTACHED_LIT}
_BIN_COLUMNS = {
    "luminance_mae": "Luminance MAE",
    "visibility_mae": "Visibility MAE",
    "error_rate": "Error rate",
    "false_shadow": "False shadow",
    "missed_shadow": "Missed shadow",
}
_NULL = '<span class="none">–</span>'


def relighting(runs: Sequence[Evaluation]) -> str:
    """HTML of the strips: a column a Sun; runs with the same view and Suns below one row of truth. "" without any."""
    groups: dict[tuple[object, ...], list[Evaluation]] = {}
    for run in runs:
        if sweep := run.metrics.get("relight"):
            suns = tuple((*step["sun"], step["truth"]) for step in sweep["suns"])
            groups.setdefault((run.metrics["data"], sweep["view"], suns), []).append(run)
    return "".join(_sweep(group, titled=len(groups) > 1 or len(group) < len(runs)) for group in groups.values())


def _sweep(runs: Sequence[Evaluation], titled: bool) -> str:
    """titled: whether the runs are named though there is only one."""
    sweep = runs[0].metrics["relight"]
    steps = sweep["suns"]
    true = sum(step["truth"] is not None for step in steps)
    many = len(runs) > 1 or titled
    cells = ['<div class="side"></div>', *(f'<div class="sun">{_sun_words(step)}</div>' for step in steps)]
    cells += ['<div class="side">Truth</div>']
    for index, step in enumerate(steps):
        if step["truth"] is None:
            cells.append('<div class="hole">no truth</div>')
        else:
            cells.append(_cell(runs[0], "truth", index, step, ""))
    for run in runs:
        name = run.label if many else "Prediction"
        cells.append(f'<div class="side">{name}</div>')
        for index, step in enumerate(run.metrics["relight"]["suns"]):
            quality = "" if step["psnr"] is None else f"{step['psnr']:.1f} dB"
            cells.append(_cell(run, "prediction", index, step, quality))
        if run.metrics["relight"]["visibility"]:
            cells.append('<div class="side">Predicted visibility</div>')
            cells += [_cell(run, "visibility", index, step, "") for index, step in enumerate(steps)]
    lead = f"The view of {sweep['view']}, from the Sun behind the camera to the Sun ahead of it. "
    if true == len(steps):
        lead += "The data shows the truth of this very view under each of these Suns."
    else:
        lead += f"The data shows the truth of this very view under {true} of these {len(steps)} Suns; data that is "
        lead += "generated with shared test views does so under every test Sun."
    return (
        f'<p class="lead">{escape(lead)}</p><div class="scroll" tabindex="0" role="region" aria-label="One view under '
        f'many Suns"><div class="sweep" style="--suns: {len(steps)}">{"".join(cells)}</div></div>'
    )


def _sun_words(step: JsonMapping) -> str:
    azimuth, elevation = step["sun"]
    kind = {True: "known", False: "unseen", None: ""}[step["known_sun"]]
    return f"{azimuth:.0f}°, {elevation:.0f}°<br><small>{kind}</small>"


def _cell(run: Evaluation, name: str, index: int, step: JsonMapping, caption: str) -> str:
    azimuth, elevation = step["sun"]
    alt = f"{name} under the Sun at {azimuth:.1f}°, {elevation:.1f}°, {run.name}"
    return picture(run.folder / "relight" / f"{name}_{index:02d}.png", alt, caption, 240)


def shadow_masks(runs: Sequence[Evaluation]) -> str:
    """HTML of masks side by side, of the runs that predict visibility; "" where none does."""
    predicting = [run for run in runs if run.metrics["shadow_mask"] is not None]
    if not predicting:
        return ""

    frames = [frame for run in predicting for frame in run.frames.values() if frame["shadow_mask"] is not None]
    least = MIN_PIXEL_SHARE * float(np.median([_rate(frame, "pixels") or 0 for frame in frames]))

    def score(frame: JsonMapping) -> float | None:
        value = _rate(frame, "balanced_error_rate")
        return None if value is None or (_rate(frame, "pixels") or 0) < least else -value

    def words(frame: JsonMapping) -> str:
        value = _rate(frame, "balanced_error_rate")
        return "" if value is None else f"balanced error rate {value:.4f}"

    keys = f'<p class="key"><span>Truth:</span>{swatches(_KINDS)}</p>'
    keys += f'<p class="key"><span>Prediction:</span>{swatches(_PREDICTED)}</p>{_visibility_bar()}'
    shown = strips(predicting, _PANELS, "mask_prediction", score, words)
    return keys + shown + "".join(_pairs(run, named=len(runs) > 1) for run in predicting)


def _rate(frame: JsonMapping, key: str) -> float | None:
    """Of a frame's shadow mask; None where it has none."""
    value: float | None = (frame["shadow_mask"] or {}).get(key)
    return value


def _pairs(run: Evaluation, named: bool) -> str:
    """HTML of the run's masks in small, truth left and prediction right."""
    names = [name for name, frame in run.frames.items() if frame["shadow_mask"] is not None]
    places = np.unique(np.linspace(0, len(names) - 1, min(MAX_SUN_PAIRS, len(names))).round().astype(int))
    small = " small" if max(run.metrics["dataset"]["resolution"]) < 200 else ""
    parts = []
    for name in (names[place] for place in places):
        frame = run.frames[name]
        alt = f"shadow mask of {frame['file_path']}, {run.name}"
        images = "".join(
            picture(run.folder / "frames" / name / f"mask_{side}.png", f"{side}, {alt}", "", 160)
            for side in ("truth", "prediction")
        )
        rate = _rate(frame, "error_rate")
        summary = "no lit or cast-shadow pixel" if rate is None else f"error rate {rate:.4f}"
        parts.append(f'<div class="pair{small}">{images}<p>{escape(name + sun_of(frame))}<br>{summary}</p></div>')
    which = "Every frame" if len(places) == len(names) else f"{len(places)} of {len(names)} frames"
    title = (
        f"{run.label} <small>{which}, truth left, prediction right</small>"
        if named
        else (f"{which} <small>truth left, prediction right</small>")
    )
    return f'<h3>{title}</h3><div class="pairs">{"".join(parts)}</div>'


def _visibility_bar() -> str:
    bar = color_bar(np.array([SHADOWED, LIT]))
    return f'<p class="key"><span>Predicted visibility: 0 {bar} 1</span></p>'


def by_grazing_angle(runs: Sequence[Evaluation]) -> str:
    """HTML of charts and tables of the error by grazing angle; "" where no run has them."""
    with_bins = [run for run in runs if run.metrics.get("by_grazing_angle")]
    if not with_bins:
        return ""
    bins: list[list[JsonDict]] = [run.metrics["by_grazing_angle"] for run in with_bins]
    present = [key for key in _BIN_COLUMNS if any(entry[key] is not None for part in bins for entry in part)]
    labels = [_range(entry) for entry in bins[0]]
    charts = [
        bar_chart(
            f"{_BIN_COLUMNS[key]} {LOWER}",
            "grazing angle",
            labels,
            [(run.index, [entry[key] for entry in part]) for run, part in zip(with_bins, bins, strict=True)],
        )
        for key in ("luminance_mae", "false_shadow", "missed_shadow")
        if key in present
    ]
    head = ["Grazing angle", "Pixels", *(f"{_BIN_COLUMNS[key]} {LOWER}" for key in present)]
    names = [run.name if len(runs) > 1 else "" for run in with_bins]
    bodies = [(name, [_bin_row(entry, present) for entry in part]) for name, part in zip(names, bins, strict=True)]
    return f'{legend(runs)}<div class="charts three">{"".join(charts)}</div>{table("By grazing angle", head, bodies)}'


def _bin_row(entry: JsonMapping, columns: Sequence[str]) -> list[str]:
    values = [_NULL if entry[key] is None else f"{entry[key]:.4f}" for key in columns]
    return [_range(entry), f"{entry['pixels']:,}", *values]


def _range(entry: JsonMapping) -> str:
    return f"{entry['from_deg']:g}–{entry['to_deg']:g}°"
