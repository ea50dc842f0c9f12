"""The report's headings: what was evaluated on what, what was fitted to it, where each part of the page begins."""

import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from spacesim.eval.notes import explain_ignored
from spacesim.eval.report.html import escape, table
from spacesim.eval.report.read import Evaluation

PAGE = "page.html"  #: in a run's folder: what the report leads to, of `spacesim export RUN --html RUN/page.html`


def page_links(runs: Sequence[Evaluation], folder: Path) -> str:
    """HTML: links to the runs' pages, relative to the report's folder; "" where there are none."""
    links = []
    for run in runs:
        page = Path(run.metrics["run"]) / PAGE
        if page.is_file():
            address = Path(os.path.relpath(page.resolve(), folder.resolve())).as_posix()
            links.append(f'<a href="{escape(quote(address))}">{escape(run.name)}</a>')
    return f'<p class="lead">To turn round, under a Sun to drag: {", ".join(links)}.</p>' if links else ""


def header(runs: Sequence[Evaluation], scenes: str) -> str:
    """Of a page about runs on the same frames. scenes: what they show"""
    return (
        f'<header><p class="eyebrow">Reconstruction report</p><h1>{escape(scenes)}</h1>'
        f'<p class="lead">{escape(_about(runs))}</p></header>'
    )


def common_header(groups: Sequence[Sequence[Evaluation]], scenes: str) -> str:
    """Of runs that were evaluated on several data."""
    count = sum(map(len, groups))
    lead = f"{count} reconstructions, evaluated on {len(groups)} sets of frames. Numbers on different frames cannot be "
    lead += "compared: each set has a part of this page to itself."
    rows = [
        [f"{number}. {_data_name(group)}", "".join(f"<span>{run.label}</span> " for run in group)]
        for number, group in enumerate(groups, start=1)
    ]
    return (
        f'<header><p class="eyebrow">Reconstruction report</p><h1>{escape(scenes)}</h1>'
        f'<p class="lead">{escape(lead)}</p></header><div class="facts contents">'
        f"{table('Parts', ['Frames', 'Runs'], [('', rows)])}</div>"
    )


def data_header(number: int, runs: Sequence[Evaluation]) -> str:
    """Where the part about one set of frames begins."""
    return (
        f'<div class="data" id="data-{number}"><p class="eyebrow">Part {number}</p><h1>{_data_name(runs)}</h1>'
        f'<p class="lead">{escape(_about(runs))}</p></div>'
    )


def _data_name(runs: Sequence[Evaluation]) -> str:
    """HTML."""
    data = runs[0].metrics
    return f"{escape(runs[0].scene)} <small>{escape(data['split'])} frames of {escape(data['data'])}</small>"


def _about(runs: Sequence[Evaluation]) -> str:
    """What was evaluated on what, in a sentence or two."""
    metrics = runs[0].metrics
    data = metrics["dataset"]
    what = "One reconstruction" if len(runs) == 1 else f"{len(runs)} reconstructions"
    against = "the pictures themselves; there is no other truth" if data.get("truth") is False else "the truth"
    width, height = data["resolution"]
    others = data.get("sizes", 1) - 1
    also = "" if not others else f" and {others} other size{'s' * (others > 1)}"
    facts = [f"{width} × {height} pixels{also}"]
    if suns := data["suns"]:
        unseen = (metrics.get("unseen_suns") or {}).get("suns", 0)
        share = "" if unseen == suns else f"{unseen} of them "
        never = f", {share}never seen in training" if unseen else ""
        facts.append(("one Sun" if suns == 1 else f"{suns} Suns") + never)
    elif data.get("truth") is False:
        facts.append("no Sun is named")
    about = f"{what}, evaluated on {data['frames']} {metrics['split']} frames against {against}. {', '.join(facts)}."
    return " ".join([about, *explain_ignored(data.get("ignored") or 0)])


def fitted_words(runs: Sequence[Evaluation]) -> str:
    """What was fitted to the pictures that runs are evaluated on."""
    fitting = {run.name: [part["name"] for part in run.metrics.get("fitted") or []] for run in runs}
    parts = [(name, ", ".join(names)) for name, names in fitting.items() if names]
    if not parts:
        return ""
    what = parts[0][1] if len(runs) == 1 else "; ".join(f"{name}: {names}" for name, names in parts)
    half = "one half" if all(run.whole_pictures for run in runs) else "one half of the object"
    return f" Fitted to each picture on {half} and scored on the other ({escape(what)})."


def aligned_words(runs: Sequence[Evaluation]) -> str:
    """How runs were brought into the axes of the data."""
    words = ""
    for run in runs:
        if fit := run.metrics.get("alignment"):
            who = "Moved" if len(runs) == 1 else f"{run.name} was moved"
            words += f" {escape(who)} into the axes and scale of the data by {fit['inliers']} of {fit['cameras']} "
            words += f"matching cameras, which then differ by {100 * fit['rms_over_distance']:.2g} % of the distance."
    return words
