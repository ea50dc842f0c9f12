"""The report about shape: the numbers and what they mean, both surfaces coloured by their distance from each other."""

from collections.abc import Sequence

import numpy as np

from spacesim.data.files import JsonMapping
from spacesim.eval.labels import HIGHER, LOWER, Metric
from spacesim.eval.report.gallery import color_bar
from spacesim.eval.report.html import escape, picture, table
from spacesim.eval.report.read import Evaluation
from spacesim.eval.report.tables import Cell, best_in_bold
from spacesim.eval.shape import DIRECTIONS, SCALE, WIDTH, colors

NUMBERS: tuple[Metric, ...] = (
    Metric(
        "chamfer", "Chamfer", "m²", LOWER, 2,
        "Mean squared distance to the nearest point of the other surface, both ways added (2.27).",
    ),
    Metric(
        "hausdorff", "Hausdorff", "", LOWER, 1,
        "Largest distance of a point to the other surface, the worse way (2.28): one stray point decides.",
    ),
    Metric(
        "hausdorff99", "Hausdorff-99", "", LOWER, 1,
        "What 99 % of the points keep within of the other surface, the worse way (5.2.3).",
    ),
    Metric("iou", "IoU", "", HIGHER, 4, "Overlap of what both fill: voxels of both by voxels of either (2.29)."),
    Metric(
        "precision", "Precision", "", HIGHER, 4,
        "Share of the reconstruction within the named distance of the truth.",
    ),
    Metric("recall", "Recall", "", HIGHER, 4, "Share of the truth within the named distance of the reconstruction."),
    Metric("f", "F", "", HIGHER, 4, "Harmonic mean of precision and recall."),
    Metric("accuracy", "Accuracy", "", LOWER, 1, "Mean distance of the reconstruction's points from the truth."),
    Metric(
        "completeness", "Completeness", "", LOWER, 1,
        "Mean distance of the truth's points from the reconstruction.",
    ),
    Metric("normals_deg", "Normals", "°", LOWER, 1, "Mean angle between the normals of nearest points, 0 to 90."),
    Metric(
        "outside", "Floaters", "%", LOWER, 2,
        "Share of the opacity outside the truth by more than the named distance.",
    ),
)  # fmt: skip
_TABLES = {
    "Distances": ("chamfer", "hausdorff", "hausdorff99", "accuracy", "completeness", "normals_deg"),
    "Overlap": ("iou", "precision", "recall", "f", "outside"),
}
_LENGTHS = ("hausdorff", "hausdorff99", "accuracy", "completeness")


def shapes(runs: Sequence[Evaluation]) -> str:
    """HTML of the numbers and the pictures, of the runs whose shape was evaluated; "" where none was."""
    with_shape = [run for run in runs if run.metrics.get("geometry")]
    if not with_shape:
        return ""
    compared = [run for run in with_shape if run.metrics["geometry"]["chamfer"] is not None]
    return _table(with_shape) + "".join(_pictures(run, named=len(runs) > 1) for run in compared)


def _table(runs: Sequence[Evaluation]) -> str:
    """Two tables, a row a run, over the whole and then over each object of a composed scene, and what the columns
    mean."""
    factor, unit = _unit(max(run.metrics["geometry"]["size"] for run in runs))
    groups = _groups(runs)
    named = dict.fromkeys(_distance(geometry, factor, unit) for _, group in groups for _, geometry in group)
    parts = [f'<p class="lead">The named distance is {escape(" or ".join(named))}.</p>']
    for caption, keys in _TABLES.items():
        metrics = [metric for metric in NUMBERS if metric.key in keys]
        head = ["", *(_heading(metric, unit) for metric in metrics)]
        bodies = [(title, _rows(group, metrics, factor)) for title, group in groups]
        meanings = "".join(f"<dt>{escape(m.label)}</dt><dd>{escape(m.meaning)}</dd>" for m in metrics)
        parts.append(f"{table(caption, head, bodies)}<dl>{meanings}</dl>")
    return "".join(parts)


def _groups(runs: Sequence[Evaluation]) -> list[tuple[str, list[tuple[str, JsonMapping]]]]:
    """(title, rows), rows: (a run's label, its numbers), first of the whole, then of each object that has a shape."""
    scene_rows = [(run.label, run.metrics["geometry"]) for run in runs]
    entries = [
        (run.label, entry) for run in runs for entry in run.metrics.get("objects") or [] if entry.get("geometry")
    ]
    objects = []
    for number in sorted({entry["id"] for _, entry in entries}):
        rows = [(label, entry) for label, entry in entries if entry["id"] == number]
        title = f"{' or '.join(dict.fromkeys(entry['name'] for _, entry in rows))} alone"
        objects.append((title, [(label, entry["geometry"]) for label, entry in rows]))
    return [("All models" if objects else "", scene_rows), *objects]


def _rows(group: Sequence[tuple[str, JsonMapping]], metrics: Sequence[Metric], factor: float) -> list[list[str]]:
    """A row of HTML for each (label, numbers)."""
    columns = [best_in_bold(metric, [_cell(geometry, metric, factor) for _, geometry in group]) for metric in metrics]
    return [[label, *row] for (label, _), *row in zip(group, *columns, strict=True)]


def _heading(metric: Metric, unit: str) -> str:
    """A column's heading. unit: of lengths."""
    unit = unit if metric.key in _LENGTHS else metric.unit
    return f"{escape(metric.label)}{f' <small>[{escape(unit)}]</small>' if unit else ''} {metric.goal}"


def _cell(geometry: JsonMapping, metric: Metric, factor: float) -> Cell:
    value = value_of(geometry, metric.key)
    if value is None:
        return None, '<span class="none" title="null: see the notes">–</span>', ""
    if metric.key == "chamfer":
        mantissa, exponent = f"{value:.{metric.digits}e}".split("e")
        return value, f"{mantissa} × 10<sup>{int(exponent)}</sup>" if value else "0", ""
    shown = value * (factor if metric.key in _LENGTHS else 100 if metric.key == "outside" else 1)
    return value, f"{shown:.{metric.digits}f}", ""


def value_of(geometry: JsonMapping, key: str) -> float | None:
    """A number of metrics.json's "geometry", also of the groups in it; None where it is null."""
    group = {"precision": "precision_recall", "recall": "precision_recall", "f": "precision_recall"}.get(key)
    group = "floaters" if key in ("outside", "inside") else group
    value: float | None = (geometry.get(group) or {}).get(key) if group else geometry.get(key)
    return value


def _pictures(run: Evaluation, named: bool) -> str:
    """HTML of both surfaces from all sides, with the colours' scale."""
    geometry = run.metrics["geometry"]
    factor, unit = _unit(geometry["size"])
    within = geometry["precision_recall"]["distance"]
    share = 100 * within / geometry["size"]
    gradient = color_bar(np.rint(colors(np.linspace(0, 1, 17))))
    bar = (
        f'<p class="key"><span>Distance: 0 {gradient} '
        f"{SCALE * within * factor:.3g} {unit} and more: {SCALE * share:.2g} % of the object's size; the middle is the "
        "named distance</span></p>"
    )
    captions = {
        "truth": ("Truth", "by its distance from the reconstruction: what is missing"),
        "reconstruction": ("Reconstruction", "by its distance from the truth: what is too much"),
    }
    parts = [f"<h3>{run.label}</h3>" if named else "", bar]
    for name, (label, meaning) in captions.items():
        figures = [
            picture(
                run.folder / "geometry" / f"{name}_{view}.png", f"{label} {meaning}, view {view}, {run.name}", "", WIDTH
            )
            for view in range(len(DIRECTIONS))
        ]
        parts.append(f'<h4>{label} <small>{meaning}</small></h4><div class="thirds">{"".join(figures)}</div>')
    return "".join(parts)


def _distance(geometry: JsonMapping, factor: float, unit: str) -> str:
    """The named distance in words."""
    within = (geometry["precision_recall"] or geometry["floaters"] or {"distance": 0.0})["distance"]
    return f"{within * factor:.3g} {unit}, {100 * within / geometry['size']:.2g} % of the object's size"


def _unit(size: float) -> tuple[float, str]:
    """The unit for lengths of an object of `size` metres: a factor and its name."""
    return (1e3, "mm") if size < 50 else (1.0, "m")
