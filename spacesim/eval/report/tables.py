"""The report's tables of numbers: a row for each run, the best of each column in bold."""

from collections.abc import Sequence

from spacesim.data.files import JsonDict
from spacesim.eval.labels import (
    DEPTH,
    GROUPS,
    IMAGE,
    MATERIAL,
    RECALL,
    SHADOW,
    SHADOW_KIND,
    SHADOW_MASK,
    Metric,
    metric_of,
)
from spacesim.eval.metrics.shadow import KINDS
from spacesim.eval.report.html import escape, table
from spacesim.eval.report.read import Evaluation

Cell = tuple[float | None, str, str]
"""A mean, its HTML, and the HTML of its spread."""

_NONE = '<span class="none" title="null: see the notes">–</span>'

_TABLES: tuple[tuple[str, tuple[Metric, ...], tuple[str, ...], tuple[Metric, ...]], ...] = (
    ("Image", IMAGE, ("image", "image_full"), IMAGE),
    ("Shadow by luminance", SHADOW, ("shadow", "shadow_full"), SHADOW),
    ("Shadow by predicted visibility", SHADOW_MASK, ("shadow_mask",), SHADOW_MASK),
    ("Each kind of shadow by predicted visibility", SHADOW_KIND, tuple(KINDS), (RECALL,)),
    ("Depth", DEPTH, ("depth",), DEPTH),
    ("Materials", MATERIAL, ("material",), MATERIAL),
)
"""Caption, columns, groups, and the columns that are explained."""

_OBJECT_TABLES: tuple[tuple[str, str, tuple[Metric, ...]], ...] = (
    ("image", "image", IMAGE),
    ("shadow by luminance", "shadow", SHADOW),
    ("shadow by predicted visibility", "shadow_mask", SHADOW_MASK),
    ("depth", "depth", DEPTH),
)
"""Of each object: caption, group, columns."""


def results(runs: Sequence[Evaluation]) -> str:
    """HTML of every group's table with what its metrics mean; groups and metrics that no run has are left out."""
    parts = []
    whole = all(run.whole_pictures for run in runs)
    titles = {group: _sentence_case(where) for group, (where, _) in GROUPS.items()}
    titles["material"] = "Over the object's pixels"
    if whole:
        titles |= {group: "Over whole pictures; no silhouette is known" for group in ("image", "shadow")}
    for caption, metrics, groups, described in _TABLES:
        shown = groups[:1] if whole else groups  # "image_full" is "image" there
        present = [group for group in shown if any(run.metrics.get(group) is not None for run in runs)]
        metrics, described = (
            tuple(m for m in some if any(run.mean(group, m.key) is not None for run in runs for group in present))
            for some in (metrics, described)
        )
        if not metrics:
            continue
        head = ["", *(_heading(metric) for metric in metrics)]
        columns = {group: [(group, metric) for metric in metrics] for group in present}
        bodies = [(titles[group], _rows(runs, columns[group])) for group in present]
        parts += [table(caption, head, bodies), _meanings(described)]
    return "".join(parts)


def results_by_suns(runs: Sequence[Evaluation]) -> str:
    """HTML of two tables: views of known Suns, and views of Suns never seen; "" where no run distinguishes them."""
    if not any(run.metrics.get(suns) for run in runs for suns in ("known_suns", "unseen_suns")):
        return ""
    psnr, ssim, lpips, flip = (metric_of(key, IMAGE) for key in ("psnr", "ssim", "lpips", "flip"))
    perceived = lpips if any(run.mean("image", "lpips") is not None for run in runs) else flip
    columns = [("image", metric) for metric in (psnr, ssim, perceived)]
    if any(run.metrics["shadow"] is not None for run in runs):
        columns += [("shadow", SHADOW[0]), ("shadow", SHADOW[2])]
    if any(run.metrics["shadow_mask"] for run in runs):
        columns.append(("shadow_mask", SHADOW_MASK[0]))
    head = ["", *(_heading(metric, "Mask " * (group == "shadow_mask")) for group, metric in columns)]
    parts = []
    for suns, what in (("known_suns", "Known Suns"), ("unseen_suns", "Suns never seen in training")):
        counts = {(part["frames"], part["suns"]) for run in runs if (part := run.metrics.get(suns))}
        if not counts:
            parts.append(f'<p class="lead">{what}: no evaluated frame has one.</p>')
            continue
        size = "views and Suns of each run's own"
        if len(counts) == 1:
            views, number = counts.pop()
            size = f"{views} view{'s' * (views != 1)}, {number} Sun{'s' * (number != 1)}"
        parts.append(table(f"{what}: {size}", head, [("", _rows(runs, columns, suns))]))
    return "".join(parts)


def by_object(runs: Sequence[Evaluation]) -> str:
    """HTML: of each object the tables 4.6 and 4.7, a row for each run; "" where no run distinguishes objects."""
    every = [entry for run in runs for entry in run.metrics.get("objects") or []]
    numbers = sorted({entry["id"] for entry in every})
    parts = []
    for number in numbers:
        names = " or ".join(dict.fromkeys(entry["name"] for entry in every if entry["id"] == number))
        for what, group, metrics in _OBJECT_TABLES:
            rows = _object_rows(runs, number, group, metrics)
            if rows:
                parts.append(table(f"{escape(names)}: {what}", ["", *map(_heading, metrics)], [("", rows)]))
    return "".join(parts)


def summary_cell(run: Evaluation, group: str, metric: Metric, suns: str = "") -> Cell:
    """A metric's cell; suns: as `Evaluation.summary` takes it."""
    return _cell(run.summary(group, metric.key, suns), metric)


def _cell(value: JsonDict | None, metric: Metric) -> Cell:
    if value is None:
        return None, _NONE, ""
    digits = ".3g" if metric.unit == "m" else f".{metric.digits}f"  # lengths: of a millimetre or of an asteroid
    mean, spread = f"{value['mean']:{digits}}", f"± {value['std']:{digits}}"
    if "pooled" in value:  # a frame of few such pixels counts little
        return value["pooled"], f"{value['pooled']:{digits}}", f"mean of frames {mean}<br>{spread}"
    return value["mean"], mean, spread


def best_in_bold(metric: Metric, cells: Sequence[Cell]) -> list[str]:
    """The cells' numbers as HTML, the best in bold where there is something to choose from."""
    distances = [metric.distance(value) for value, _, _ in cells if value is not None]
    if len(distances) < 2:
        return [number for _, number, _ in cells]
    return [
        f'<span class="best">{number}</span>'
        if value is not None and metric.distance(value) == min(distances)
        else number
        for value, number, _ in cells
    ]


def _rows(runs: Sequence[Evaluation], columns: Sequence[tuple[str, Metric]], suns: str = "") -> list[list[str]]:
    """A row for each run; columns: (group, metric)."""
    cells_by_column = []
    for group, metric in columns:
        cells = [summary_cell(run, group, metric, suns) for run in runs]
        numbers = best_in_bold(metric, cells)
        cells_by_column.append([f"{n} <small>{cell[2]}</small>" for n, cell in zip(numbers, cells, strict=True)])
    return [[run.label + run.tag, *row] for run, *row in zip(runs, *cells_by_column, strict=True)]


def _object_rows(runs: Sequence[Evaluation], number: int, group: str, metrics: Sequence[Metric]) -> list[list[str]]:
    """A row for each run; [] where none has the group."""
    summaries = [
        next((entry.get(group) for entry in run.metrics.get("objects") or [] if entry["id"] == number), None)
        for run in runs
    ]
    if all(summary is None for summary in summaries):
        return []
    columns = []
    for metric in metrics:
        cells = [_cell((summary or {}).get(metric.key), metric) for summary in summaries]
        bold = best_in_bold(metric, cells)
        columns.append([f"{n} <small>{cell[2]}</small>" for n, cell in zip(bold, cells, strict=True)])
    return [[run.label, *row] for run, *row in zip(runs, *columns, strict=True)]


def _heading(metric: Metric, prefix: str = "") -> str:
    """A column's heading; with a prefix the label goes on in lower case, unless it is an abbreviation."""
    label = metric.label if not prefix or metric.label[-1:].isupper() else metric.label[0].lower() + metric.label[1:]
    unit = f" <small>[{escape(metric.unit)}]</small>" if metric.unit else ""
    return f"{escape(prefix + label)}{unit} {escape(metric.goal)}"


def _sentence_case(text: str) -> str:
    return text[0].upper() + text[1:]


def _meanings(metrics: Sequence[Metric]) -> str:
    items = "".join(f"<dt>{escape(m.label)}</dt><dd>{escape(m.meaning)}</dd>" for m in metrics)
    return f"<dl>{items}</dl>"
