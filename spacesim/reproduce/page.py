"""reproduce.html: the thesis's tables with ours beside them, its figures, how large all of it was."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from spacesim.data.files import JsonMapping, write_bytes
from spacesim.eval.report.html import escape, page, section, table
from spacesim.reproduce.experiments import FIGURES as FIGURE_TITLES
from spacesim.reproduce.figures import density, fixed_sun, frame_times, inside, relighting
from spacesim.reproduce.thesis import Column, Table, best, thesis

QUICK = (
    "A quick run: tiny pictures and a few hundred iterations. It shows that the machinery works, not how good the "
    "methods are; no number below says anything about them."
)
NONE = '<span class="none">{}</span>'
VERDICTS = {True: "holds", False: '<span class="best">fails</span>', None: NONE.format("–")}
FIGURES: Mapping[str, Callable[[Path, Sequence[JsonMapping]], str]] = {
    "figure-3.2": frame_times,
    "figure-4.2": relighting,
    "figure-4.3": fixed_sun,
    "figure-5.5": inside,
    "figure-6.2": relighting,
}


def write_page(root: Path, values: JsonMapping) -> Path:
    """Write the page about what reproduce.json has; returns its path."""
    done = sum(one["state"] == "finished" for one in values["experiments"])
    body = [_header(values, done), section("How large", _conditions(values), "What the thesis had, and what this is.")]
    tables = {known.number: known for known in thesis().tables}
    for one in values["tables"]:
        known = tables[one["number"]]
        body.append(section(f"Table {known.number}", _table(known, one, values["seeds"])))
    figures = values["figures"]
    names = [name for name in values["parts"] if name.startswith("figure")]
    for name in names:
        number = name.removeprefix("figure-")
        if name == "figure-6.1":
            body.append(section(f"Figure {number}", density(root), FIGURE_TITLES[name]))
        elif name == "figure-4.4" and "figure-4.3" in names:
            continue  # which shows both
        else:
            both = name in ("figure-4.3", "figure-4.4")
            made = FIGURES["figure-4.3" if both else name](root, figures[name]["rows"])
            body.append(section("Figures 4.3 and 4.4" if both else f"Figure {number}", made, figures[name]["title"]))
    body.append(section("Experiments", _experiments(values["experiments"])))
    body.append("<footer>Written by spacesim reproduce; every number is in reproduce.json beside this page.</footer>")
    path = root / "reproduce.html"
    write_bytes(path, page("The thesis, reproduced", "\n".join(body)).encode("utf-8", "backslashreplace"))
    return path


def _header(values: JsonMapping, done: int) -> str:
    total = len(values["experiments"])
    failed = sum(one["state"] == "failed" for one in values["experiments"])
    state = f"{done} of {total} experiments are finished" + (f", {failed} failed" if failed else "") + "."
    lead = "Tables and figures of “Illumination-Aware 3D Gaussian Splatting for Spacecraft Reconstruction and Scene "
    lead += "Composition”, its numbers beside ours. "
    warning = f"<p><strong>{escape(QUICK)}</strong></p>" if values["conditions"]["name"] == "quick" else ""
    return (
        f'<header><p class="eyebrow">Reproduction</p><h1>The thesis, table by table</h1>'
        f'<p class="lead">{escape(lead + state)}</p>{warning}</header>'
    )


def _conditions(values: JsonMapping) -> str:
    """What the thesis had and what this run has."""
    size, theirs = values["conditions"], thesis().conditions
    devices = sorted({one["device"] for one in values["experiments"] if one["device"]})
    tests = size["suns"] * size["known_test_views"], size["test_suns"] * size["test_views"]
    rows = {
        "Suns of training": ("suns", f"{size['suns']}"),
        "training views": ("views", f"{size['views']:,} for each Sun, {size['suns'] * size['views']:,} in all"),
        "test views": (
            "test",
            f"{tests[0]:,} under Suns of training, {tests[1]:,} under Suns never seen ({size['test_suns']}); "
            f"{size['pair_views']:,} of the pair",
        ),
        "pixels": ("resolution", f"{size['resolution']} × {size['resolution']}"),
        "cameras' distance": ("distance", "the object just fits into the picture"),
        "iterations, as the thesis": ("iterations", _iterations(values, "thesis")),
        "iterations, improved": ("", _iterations(values, "")),
        "one Sun (figures 4.2 to 4.4)": (
            "one_sun",
            f"{size['one_sun_views']:,} training and {size['one_sun_test_views']:,} test views; fully lit: within "
            "{:g}° of azimuth and {:g}° of elevation of the Sun".format(*size["fully_lit_deg"]),
        ),
        "random start (figure 5.5)": (
            "figure",
            f"{size['figure_steps']:,} steps, {size['figure_gaussians']:,} Gaussians",
        ),
        "telescope (figures 6.1, 6.2)": (
            "telescope",
            f"{size['telescope_suns']} Suns, {size['telescope_views']} views each; "
            f"{size['telescope_iterations']:,} iterations",
        ),
        "seeds": ("seeds", str(values["seeds"])),
        "device": ("device", ", ".join(devices) or "none yet"),
        "settings of all trainings": ("", ", ".join(f"{k} = {v}" for k, v in size["settings"].items()) or "none"),
    }
    cells = [[escape(name), escape(theirs.get(key, "–")), escape(ours)] for name, (key, ours) in rows.items()]
    return f'<div class="facts">{table("Data and trainings", ["", "Thesis", "Here"], [("", cells)])}</div>'


def _iterations(values: JsonMapping, preset: str) -> str:
    """Of the trainings of tables, by preset."""
    iterations = {
        one["preset"]: f"{one['iterations']:,} ({one['preset']})"
        for one in values["experiments"]
        if {"own", "pair"} & set(one["parts"])
        and (one["preset"] == "thesis") == (preset == "thesis")
        and one["data"] == "boxsat"
    }
    return ", ".join(iterations.values()) or "none"


def _table(known: Table, values: JsonMapping, seeds: int) -> str:
    """A table of the thesis, metric by metric; what of its order holds; causes of differences."""
    keys = ["printed", *values["presets"]]
    head = ["", "Thesis", *_headings(values["presets"])]
    notes = [remark.text for remark in known.remarks]
    groups = []
    for column, metric in zip(known.columns, values["metrics"], strict=True):
        marks = [str(i) for i, remark in enumerate(known.remarks, start=1) if remark.metric == column.metric]
        title = f"{column.heading} {column.goal if column.arrow else ''}" + (
            f"  (note {', '.join(marks)})" if marks else ""
        )
        means = {key: {row["name"]: row["cells"][key]["mean"] for row in metric["rows"]} for key in keys}
        leading = {key: best(column, means[key]) if column.arrow else set() for key in keys}
        rows = [
            [
                escape(row["name"]),
                *(_cell(column, row["cells"][key], row["name"] in leading[key], seeds) for key in keys),
            ]
            for row in metric["rows"]
        ]
        groups.append((title, rows))
    parts = [f'<div class="dense">{table(known.title, head, groups)}</div>', _orderings(values)]
    if notes:
        parts.append(f"<ol>{''.join(f'<li>{escape(text)}</li>' for text in notes)}</ol>")
    return "".join(parts)


def _headings(presets: Mapping[str, str]) -> list[str]:
    """HTML above the columns of ours, by their keys."""
    has_unseen = any(key.endswith("_unseen") for key in presets)
    headings = []
    for key, preset in presets.items():
        variant = "as the thesis" if key.startswith("thesis") else "improved"
        suns = ", unseen Suns" if key.endswith("_unseen") else ", known Suns" if has_unseen else ""
        headings.append(f"Ours,<br>{variant}<br><small>{escape(preset)}{suns}</small>")
    return headings


def _cell(column: Column, cell: JsonMapping, is_best: bool, seeds: int) -> str:
    """HTML of a mean and its standard deviation, as the thesis prints them; the spread over seeds below."""
    if cell["mean"] is None:
        return NONE.format({"null": "–"}.get(cell["state"], cell["state"]))
    text = escape(column.cell(cell["mean"], cell.get("std")))
    text = f'<span class="best">{text}</span>' if is_best else text
    if seeds > 1 and len(means := cell.get("seeds", [])) > 1:
        text += f"<br><small>{len(means)} seeds ± {escape(column.printed(float(np.std(means))))}</small>"
    return text


def _orderings(values: JsonMapping) -> str:
    """Whether what the thesis's numbers say holds of ours."""
    presets = values["presets"]
    rows = [[escape(one["text"]), *(VERDICTS[one["holds"][key]] for key in presets)] for one in values["orderings"]]
    shares = [values["in_order"][key] for key in presets]
    counts = [f"{held} of {comparable}" if comparable else VERDICTS[None] for held, comparable in shares]
    rows.append(["All pairs of rows, over all columns, in the thesis's order", *counts])
    head = ["", *_headings(presets)]
    return f'<div class="dense">{table("What the thesis says, and whether ours does", head, [("", rows)])}</div>'


def _experiments(experiments: Sequence[JsonMapping]) -> str:
    head = ["", "State", "Data", "Preset", "Iterations", "Gaussians", "Training", "Reports"]
    rows = []
    for one in experiments:
        links = [
            f'<a href="experiments/{one["name"]}/{part}/report.html">{part}</a>'
            for part in one["parts"]
            if part not in ("suns", "curve", "frames") and one["state"] == "finished"
        ]
        state = one["state"] + (f": {one['reason']}" if one["reason"] else "")
        gaussians = "–" if one["gaussians"] is None else f"{one['gaussians']:,}"
        seconds = "–" if one["seconds"] is None else f"{one['seconds']:,.0f} s"
        texts = [one["name"], state, one["data"], one["preset"], f"{one['iterations']:,}", gaussians, seconds]
        rows.append([*map(escape, texts), ", ".join(links) or "–"])
    return table("Each is trained once and serves all tables that need it", head, [("", rows)])
