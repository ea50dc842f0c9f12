"""The thesis's figures with our pictures and curves, as HTML."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from spacesim.data.files import JsonMapping
from spacesim.eval.report.charts import line_chart
from spacesim.eval.report.html import SERIES, escape, picture, swatch, table
from spacesim.reproduce.experiments import FIELD
from spacesim.reproduce.perform import data_folder
from spacesim.reproduce.thesis import thesis

SIDE = 240  #: pixels of small pictures
NOT_RUN = '<p class="lead">Not run.</p>'
NAMES = {
    "thesis-relight": "relightable, as the thesis",
    "vanilla": "vanilla",
    "vanilla-fully-lit": "vanilla, fully lit views only",
    "one-sun": "fixed Sun",
    "telescope": "telescope, as the thesis",
    "figure-5.5-nominal": "nominal",
    "figure-5.5-warm-start-thesis": "warm start, as the thesis",
    "figure-5.5-warm-start-improved": "warm start, improved",
}
_LABELS = {"psnr": "PSNR ↑", "ssim": "SSIM ↑", "lpips": "LPIPS ↓", "mae": "MAE ↓"}
_SHAPE = {"chamfer": "Chamfer [m²] ↓", "hausdorff99": "Hausdorff-99 [m] ↓", "iou": "IoU ↑"}


def name_of(experiment: str) -> str:
    """What the page calls an experiment."""
    return NAMES.get(experiment, f"relightable, improved ({experiment.removesuffix('-relight')})")


def relighting(root: Path, rows: Sequence[JsonMapping]) -> str:
    """Figures 4.2 and 6.2: a row a model, a column a Sun, the truth above; how many Gaussians are left."""
    drawn = [row for row in rows if row["sweep"]]
    if not drawn:
        return NOT_RUN
    suns = drawn[0]["sweep"]["suns"]
    cells = ['<div class="side"></div>']
    for one in suns:
        azimuth, elevation = one["sun"]
        words = "known" if one["known"] else "unseen"
        cells.append(f'<div class="sun">{azimuth:.0f}°, {elevation:.0f}°<br><small>{words}</small></div>')
    cells.append('<div class="side">Truth</div>')
    for index, one in enumerate(suns):
        there = one["psnr"] is not None
        cells.append(_sun_cell(root, drawn[0], "truth", index, "") if there else '<div class="hole">no truth</div>')
    for row in drawn:
        cells.append(f'<div class="side">{escape(name_of(row["name"]))}</div>')
        for index, one in enumerate(row["sweep"]["suns"]):
            quality = "" if one["psnr"] is None else f"{one['psnr']:.1f} dB"
            cells.append(_sun_cell(root, row, "prediction", index, quality))
    strip = (
        '<div class="scroll" tabindex="0" role="region" aria-label="One view under many Suns">'
        f'<div class="sweep" style="--suns: {len(suns)}">{"".join(cells)}</div></div>'
    )
    lines = []
    for row in rows:
        counts = "–" if row["gaussians"] is None else f"{row['gaussians'][0]:,}, {row['gaussians'][1]:,}"
        image = row["image"] or {}
        numbers = [_number(image.get(name)) for name in _LABELS]
        lines.append([escape(name_of(row["name"])), escape(row["state"]), counts, *numbers])
    head = ["", "State", "Gaussians, most and at the end", *_LABELS.values()]
    return strip + table("Test views under all Suns; a model that collapses loses its Gaussians", head, [("", lines)])


def _sun_cell(root: Path, row: JsonMapping, kind: str, index: int, caption: str) -> str:
    path = root / "experiments" / row["name"] / "suns" / f"{kind}_{index:02d}.png"
    return picture(path, f"{kind}, Sun {index + 1}, {row['name']}", caption, SIDE)


def fixed_sun(root: Path, rows: Sequence[JsonMapping]) -> str:
    """Figures 4.3 and 4.4: metrics over fully lit and over all views, shapes, depth of a lit and a shadowed side."""
    there = [row for row in rows if "all" in row]
    waiting = [[escape(name_of(row["name"])), escape(row["state"])] for row in rows if row not in there]
    if not there:
        return NOT_RUN
    lit, every = there[0]["frames"]
    azimuth, elevation = there[0]["views"]["tolerance_deg"]
    near = f"{lit} fully lit test views, whose camera is within {azimuth:g}° of azimuth and {elevation:g}° of elevation"
    blocks = (("fully_lit", f"{near} of the Sun"), ("all", f"all {every} test views under this Sun"))
    parts = []
    for group, title in blocks:
        body = [[escape(name_of(row["name"])), *(_summary(row[group][name]) for name in _LABELS)] for row in there]
        parts.append(table(f"Over {title}", ["", *_LABELS.values()], [("", body)]))
    shapes = [[escape(name_of(row["name"])), *(_number(row["shape"][name]) for name in _SHAPE)] for row in there]
    parts.append(table("Shape", ["", *_SHAPE.values()], [("", shapes)]))
    if waiting:
        parts.append(f'<p class="lead">{"; ".join(f"{name}: {state}" for name, state in waiting)}.</p>')
    for side, title in (("lit", "The Sun behind the camera"), ("shadowed", "The Sun ahead of it")):
        parts.append(f"<h3>{title}</h3>{_strip(root, there, side)}")
    return "".join(parts)


def _strip(root: Path, rows: Sequence[JsonMapping], side: str) -> str:
    """Truth and models of a view: pictures, then depth."""
    view = Path(rows[0]["views"]["chosen"][side]).stem
    figures: list[str] = []
    for kind in ("rgb", "depth"):
        for row in (rows[0], *rows):
            truth = not figures or (kind == "depth" and len(figures) == len(rows) + 1)
            folder = root / "experiments" / row["name"] / "one-sun"
            if kind == "rgb":
                path = folder / "frames" / view / ("truth.png" if truth else "prediction.png")
            else:
                path = folder / f"{side}_{'truth' if truth else 'depth'}.png"
            label = ("Truth" if truth else name_of(row["name"])) + (", depth" if kind == "depth" else "")
            figures.append(picture(path, label, escape(label), 320))
    return f'<div class="strip" style="grid-template-columns: repeat({len(rows) + 1}, 1fr)">{"".join(figures)}</div>'


def frame_times(_root: Path, rows: Sequence[JsonMapping]) -> str:
    """Figure 3.2: a frame's time against the number of models, Gaussians and radiance field, and their ratio."""
    there = [row for row in rows if row["frames"]]
    if not there:
        return NOT_RUN
    names = {row["name"]: "radiance field" if row["name"] == FIELD else "Gaussians" for row in rows}
    legend = "".join(f"<span>{swatch(i % SERIES)}{names[row['name']]}</span>" for i, row in enumerate(there))
    series = [list(zip(row["frames"]["models"], row["frames"]["ms"], strict=True)) for row in there]
    chart = line_chart("Time of a frame, ms", "models", series, log=True)
    counts = there[0]["frames"]["models"]
    lines = [[names[row["name"]], *(f"{ms:,.1f} ms" for ms in row["frames"]["ms"])] for row in there]
    if rows[-1]["times"]:
        lines.append(["radiance field / Gaussians", *(f"{times:,.0f} ×" for times in rows[-1]["times"])])
    lines.append(["the thesis's ratio", *([f"around {thesis().nerf_times:,.0f} ×"] * len(counts))])
    conditions = [
        f"{frames['pixels'][0]} × {frames['pixels'][1]} pixels, median of {frames['views']} views, {frames['device']}"
        for frames in (row["frames"] for row in there)
    ]
    if len(set(conditions)) > 1:
        conditions = [f"{names[row['name']]}: {words}" for row, words in zip(there, conditions, strict=True)]
    missing = [f"{names[row['name']]}: {row['state']}" for row in rows if row not in there]
    note = f'<p class="lead">{escape("; ".join(missing))}.</p>' if missing else ""
    head = ["", *("1 model" if count == 1 else f"{count} models" for count in counts)]
    return (
        f'<p class="key">{legend}</p><div class="charts" style="max-width: 36rem">{chart}</div>'
        f"{table('; '.join(dict.fromkeys(conditions)), head, [('', lines)])}{note}"
    )


def inside(_root: Path, rows: Sequence[JsonMapping]) -> str:
    """Figure 5.5: the share of Gaussians inside the true mesh."""
    there = [row for row in rows if "inside" in row]
    if not there:
        return NOT_RUN
    series = [[(step, 100 * share) for step, share in row["inside"]] for row in there]
    legend = "".join(f"<span>{swatch(i % SERIES)}{escape(name_of(row['name']))}</span>" for i, row in enumerate(there))
    chart = line_chart("Gaussians inside the true mesh, %", "step", series)
    lines = [
        [
            escape(name_of(row["name"])),
            f"{row['gaussians']:,}",
            *(f"{100 * row['inside'][k][1]:.2f} %" for k in (0, len(row["inside"]) // 2, -1)),
        ]
        for row in there
    ]
    missing = [f"{name_of(row['name'])}: {row['state']}" for row in rows if row not in there]
    note = f'<p class="lead">{escape("; ".join(missing))}.</p>' if missing else ""
    head = ["", "Gaussians", "at the start", "half way", "at the end"]
    return (
        f'<p class="key">{legend}</p><div class="charts" style="max-width: 36rem">{chart}</div>'
        f"{table('Without culling and densification, from a cube of ten times the size', head, [('', lines)])}{note}"
    )


def density(root: Path) -> str:
    """Figure 6.1: from where the training cameras look."""
    path = data_folder(root, "telescope") / "camera_density.png"
    return picture(path, "Density of cameras by direction", "", 1080) if path.exists() else NOT_RUN


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4f}"


def _summary(value: Mapping[str, float] | None) -> str:
    return "–" if value is None else f"{value['mean']:.4f} ± {value['std']:.4f}"
