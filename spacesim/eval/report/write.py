"""The report: one self-contained HTML page about one or several evaluated runs, side by side."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from spacesim.data import density
from spacesim.data.errors import InputError
from spacesim.data.files import JsonDict, JsonMapping, read_bytes, write_bytes
from spacesim.data.integrity.outputs import check_output
from spacesim.eval.labels import IMAGE, LOWER, SHADOW, SHADOW_MASK, Metric, metric_of
from spacesim.eval.report.charts import column_histograms, histogram, line_chart, shared_edges
from spacesim.eval.report.gallery import albedos, depths, gallery
from spacesim.eval.report.headings import aligned_words, common_header, data_header, fitted_words, header, page_links
from spacesim.eval.report.html import escape, page, picture, section, table
from spacesim.eval.report.lighting import by_grazing_angle, relighting, shadow_masks
from spacesim.eval.report.read import Evaluation, by_data, legend, read_evals
from spacesim.eval.report.surfaces import shapes
from spacesim.eval.report.tables import Cell, best_in_bold, by_object, results, results_by_suns, summary_cell

MANY_SUNS = 12
"""With more Suns than this, histograms become columns of one chart."""

MAP_WIDTH = 1340  #: pixels of the map of training cameras

_GAUSSIANS = Metric("gaussians", "Gaussians", "", LOWER, 0, "")
_RENDER = Metric("render_ms", "Render time", "ms", LOWER, 1, "")


def write_report(evals: Sequence[Path], out: Path) -> None:
    """Write the page about the EVAL folders `evals` to the file `out`.

    Raises InputError where a folder holds no evaluation or `out` cannot be written, see `check_output`.
    """
    check_output(Path(out), "report")
    try:
        content = _content(read_evals(evals), Path(out).absolute().parent)
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        named = ", ".join(str(Path(folder) / "metrics.json") for folder in evals)
        raise InputError(f"{named}: expected metrics of this version, found a damaged file ({error!r})") from error
    write_bytes(Path(out), content.encode("utf-8", "backslashreplace"))


def _content(runs: Sequence[Evaluation], folder: Path) -> str:
    """The page: runs are compared where they were evaluated on the same frames, one part of it for each such data.
    folder: where it will be"""
    groups = by_data(runs)
    scenes = " and ".join(sorted({run.scene for run in runs}))
    if len(groups) == 1:
        body = [header(groups[0], scenes), page_links(runs, folder), *_sections(groups[0])]
    else:
        body = [common_header(groups, scenes), page_links(runs, folder)]
        for number, group in enumerate(groups, start=1):
            body += [data_header(number, group), *_sections(group)]
    body.append("<footer>Written by spacesim. Equation numbers: the thesis that defines the metrics.</footer>")
    return page(f"{scenes} · reconstruction report", "\n".join(body))


def _sections(runs: Sequence[Evaluation]) -> list[str]:
    """What is said of runs that were evaluated on the same frames."""
    over = "" if all(run.whole_pictures for run in runs) else " over the silhouette"
    known = any(run.metrics["dataset"]["suns"] for run in runs)
    return [
        _headlines(runs),
        section("Frames", gallery(runs), f"Best, median and worst by PSNR{over}."),
        _section("Depth", depths(runs), "The same frames: metres along the optical axis."),
        _section(
            "Albedo",
            albedos(runs),
            "The same frames: reflectance as sRGB values, of a run what its field answers, times one scale.",
        ),
        _section(
            "One view, many Suns",
            relighting(runs),
            "Each column is a Sun: its azimuth and elevation, and whether training has seen it.",
        ),
        _section(
            "Shadow masks",
            shadow_masks(runs),
            "Where the Sun is seen, by the path tracer and by the run: best, median and worst by balanced error rate "
            "over lit and cast-shadow pixels, of the frames that show enough of these. Half of the solar disc or "
            "more is lit.",
        ),
        _section("Results", results(runs), "Mean ± population standard deviation over the frames."),
        _section(
            "Object by object",
            by_object(runs),
            "Over the pixels that show the object in the true picture: what models that were trained apart do to each "
            "other (tables 4.6 and 4.7). Mean ± population standard deviation over the frames that show it.",
        ),
        _section(
            "Known and unseen Suns",
            results_by_suns(runs),
            "Views of Suns of training and of Suns never seen, apart. "
            f"{over.strip().capitalize() or 'Whole pictures'}; the mask's error rate over lit and cast-shadow pixels.",
        ),
        _section(
            "By grazing angle",
            by_grazing_angle(runs),
            "How high the Sun stands over the surface itself: at 0° it brushes it. Pixels of all frames that face the "
            "Sun, lit or in cast shadow. False shadow: share of lit pixels predicted dark; missed shadow: of cast "
            "shadow predicted lit.",
        ),
        _section(
            "Shape",
            shapes(runs),
            "The surface of each run, fused from its depth, against the true one: equally many points of what can be "
            "seen of both from outside.",
        ),
        section(
            "By Sun" if known else "All frames",
            _histograms(runs),
            f"How many frames reach which PSNR [dB]{over}{', by azimuth and elevation' * known}.",
        ),
        _section(
            "Training cameras",
            _camera_density(runs),
            f"From where the training cameras look at {'what they show' if not over else 'the object'}, in views per "
            "steradian: of sides that none has seen a run knows nothing.",
        ),
        _training(runs),
        section("How it was made", _making(runs)),
        section("Notes", _notes(runs)),
    ]


def _section(title: str, body: str, lead: str) -> str:
    """A section, "" where there is nothing to show."""
    return section(title, body, lead) if body else ""


def _headlines(runs: Sequence[Evaluation]) -> str:
    """A card for each number that people ask for first."""
    psnr, ssim, lpips, flip = (metric_of(key, IMAGE) for key in ("psnr", "ssim", "lpips", "flip"))
    perceived = lpips if any(run.mean("image", "lpips") is not None for run in runs) else flip
    chosen = [("image", psnr), ("image", ssim), ("image", perceived)]
    shadows = any(run.metrics["shadow"] is not None for run in runs)
    if shadows:
        chosen.append(("shadow", SHADOW[0]))
    if any(run.metrics["shadow_mask"] is not None for run in runs):
        chosen.append(("shadow_mask", replace(SHADOW_MASK[0], label="Shadow mask error")))
    cards = [_card(metric, runs, [summary_cell(run, group, metric) for run in runs]) for group, metric in chosen]
    if any(run.metrics.get("unseen_suns") for run in runs):
        unseen = replace(psnr, label="PSNR, unseen Suns")
        cards.append(_card(unseen, runs, [summary_cell(run, "image", psnr, "unseen_suns") for run in runs]))
    for metric in (_GAUSSIANS, _RENDER):
        cards.append(_card(metric, runs, [_model_cell(run, metric) for run in runs]))
    many = " many" if len(runs) > 1 else " more" if len(cards) > 6 else ""
    whole = all(run.whole_pictures for run in runs)
    lead = f"Image{' and shadow' * shadows} numbers are means over the frames, taken over "
    lead += "whole pictures: no silhouette is known" if whole else "the object's silhouette"
    masks = any(group == "shadow_mask" for group, _ in chosen)
    lead += "; shadow masks over all frames' lit and cast-shadow pixels." if masks else "."
    lead += fitted_words(runs) + aligned_words(runs)
    return f'<div class="cards{many}">{"".join(cards)}</div><p class="lead">{lead}</p>'


def _card(metric: Metric, runs: Sequence[Evaluation], cells: Sequence[Cell]) -> str:
    goal = f" {metric.goal}" if metric is not _GAUSSIANS else ""
    unit = f" <small>{escape(metric.unit)}</small>" if metric.unit else ""
    if len(runs) == 1:
        value, number, spread = cells[0]
        body = f'<p class="big">{number}{"" if value is None else unit}</p><p class="std">{spread}</p>'
        return f'<div class="card"><h2>{escape(metric.label + goal)}</h2>{body}</div>'
    rows = zip(runs, _card_numbers(metric, cells), strict=True)
    body = "".join(f'<p class="row"><span>{run.label}</span><span>{number}</span></p>' for run, number in rows)
    return f'<div class="card"><h2>{escape(metric.label + goal)}{unit}</h2>{body}</div>'


def _card_numbers(metric: Metric, cells: Sequence[Cell]) -> list[str]:
    """As a table has them; more Gaussians are not better, nor fewer."""
    return [number for _, number, _ in cells] if metric is _GAUSSIANS else best_in_bold(metric, cells)


def _model_cell(run: Evaluation, metric: Metric) -> Cell:
    value = run.metrics["model"][metric.key]
    return value, "–" if value is None else f"{value:,.{metric.digits}f}", ""


def _histograms(runs: Sequence[Evaluation]) -> str:
    by_sun = [_by_sun(run) for run in runs]
    every = [value for suns in by_sun for values in suns.values() for value in values]
    if not every:
        return "<p>No frame has a PSNR.</p>"
    edges = shared_edges(every)
    suns = sorted({sun for groups in by_sun for sun in groups})
    if len(suns) > MANY_SUNS:
        return legend(runs) + "".join(
            column_histograms(
                f"{run.name}: PSNR [dB] of the frames under each Sun, by azimuth",
                [(_sun_name(sun), groups.get(sun, [])) for sun in suns],
                edges,
                run.index,
            )
            for run, groups in zip(runs, by_sun, strict=True)
        )
    tallest = max(int(np.histogram(values, edges)[0].max()) for groups in by_sun for values in groups.values())
    unseen = {_sun_key(frame) for run in runs for frame in run.metrics["frames"] if frame.get("known_sun") is False}
    charts = [
        histogram(
            _sun_name(sun) + " · unseen" * (sun in unseen) if any(suns) else "PSNR [dB]",
            [groups.get(sun, []) for groups in by_sun],
            edges,
            tallest,
        )
        for sun in suns
    ]
    return legend(runs) + f'<div class="multiples">{"".join(charts)}</div>'


def _by_sun(run: Evaluation) -> dict[tuple[float, ...], list[float]]:
    """PSNR of the frames by the Sun's (azimuth, elevation), () where there is none."""
    groups: dict[tuple[float, ...], list[float]] = {}
    for frame in run.metrics["frames"]:
        if frame["psnr"] is not None:
            groups.setdefault(_sun_key(frame), []).append(frame["psnr"])
    return groups


def _sun_key(frame: JsonMapping) -> tuple[float, ...]:
    return tuple(round(angle, 1) for angle in frame["sun"] or ())


def _sun_name(sun: tuple[float, ...]) -> str:
    return "{:.0f}°, {:.0f}°".format(*sun) if sun else "Sun not known"


def _training(runs: Sequence[Evaluation]) -> str:
    histories = [run.metrics["training"].get("history") or [] for run in runs]
    if not any(histories):
        return ""

    def curves(key: str, lowest: float) -> list[list[tuple[float, float]]]:
        return [
            [(step["iteration"], step[key]) for step in history if step.get(key) is not None and step[key] > lowest]
            for history in histories
        ]

    charts = [
        line_chart("Loss", "iteration", curves("loss", 0.0), log=True),
        *([line_chart("Gaussians", "iteration", counts)] if any(counts := curves("gaussians", -1.0)) else []),
    ]
    return section("Training", legend(runs) + f'<div class="charts">{"".join(charts)}</div>')


def _camera_density(runs: Sequence[Evaluation]) -> str:
    """The maps that evaluating has written, each once, with the runs that it is of."""
    of_map: dict[bytes, list[Evaluation]] = {}
    for run in runs:
        path = run.folder / density.NAME
        if path.is_file():
            of_map.setdefault(read_bytes(path, "a picture"), []).append(run)
    figures = []
    for group in of_map.values():
        names = ", ".join(run.name for run in group)
        caption = " ".join(run.label for run in group) if len(runs) > 1 else ""
        figures.append(picture(group[0].folder / density.NAME, f"Camera density, {names}", caption, MAP_WIDTH))
    return "".join(figures)


def _making(runs: Sequence[Evaluation]) -> str:
    """Tables of data, configuration and software, a column for each run; rows that differ stand out."""
    tables: list[tuple[str, Callable[[Evaluation], JsonMapping]]] = [
        ("Data", _data_facts),
        ("Model and time", _model_facts),
        ("Training configuration", lambda run: run.metrics["config"]),
        (
            "Software",
            lambda run: {**run.metrics["versions"], **(run.metrics["training"].get("versions") or {})},
        ),
    ]
    bodies = [_facts_table(caption, runs, [_flat(facts(run)) for run in runs]) for caption, facts in tables]
    pair = " pair" if len(runs) == 1 else ""
    parts = [f'<div class="facts{pair}">{"".join(bodies)}</div>']
    for run in runs:
        command = run.metrics["training"].get("command")
        if command:
            text = " ".join(map(str, command)) if isinstance(command, list) else str(command)
            parts.append(f"<h3>{run.label}</h3><pre>{escape(text)}</pre>")
    return "".join(parts)


def _data_facts(run: Evaluation) -> JsonDict:
    data = run.metrics["dataset"]
    width, height = data["resolution"]
    facts = {
        "folder": run.metrics["data"],
        "scene": data.get("scene"),
        "evaluated frames": f"{data['frames']} ({run.metrics['split']})",
        "training frames": data["train_frames"],
        "resolution": f"{width} × {height}",
    }
    return facts | {key: value for key, value in (data.get("config") or {}).items() if key not in facts}


def _model_facts(run: Evaluation) -> JsonDict:
    model, training = run.metrics["model"], run.metrics["training"]
    seconds, sigma = training.get("seconds"), (training.get("suns") or {}).get("sigma_deg")
    return {
        "run": run.metrics["run"],
        "Gaussians": None if model["gaussians"] is None else f"{model['gaussians']:,}",
        "file": f"{model['bytes'] / 1e6:.2f} MB",
        "rendering a frame": f"{model['render_ms']:.1f} ms",
        "rendered on": model["backend"],
        "training": None if seconds is None else f"{seconds:.1f} s",
        "estimated Suns off": None if sigma is None else f"{sigma:.0f}° (median, by pictures held out)",
        "trained on": " ".join(str(training[key]) for key in ("backend", "device") if training.get(key)),
    }


def _facts_table(caption: str, runs: Sequence[Evaluation], facts: Sequence[Mapping[str, str]]) -> str:
    keys = list(dict.fromkeys(key for column in facts for key in column))
    if not keys:
        return ""
    rows = []
    for key in keys:
        values = [column.get(key, "–") for column in facts]
        mark = '<span class="differs">{}</span>' if len(set(values)) > 1 else "{}"
        rows.append([re.sub("([._])", r"\1<wbr>", escape(key)), *(mark.format(escape(value)) for value in values)])
    head = ["", *(run.label for run in runs)] if len(runs) > 1 else ["", ""]
    return table(caption, head, [("", rows)])


def _flat(values: JsonMapping, prefix: str = "") -> dict[str, str]:
    """Nested mappings as {"outer.inner": text}; what is None or empty is left out."""
    flat: dict[str, str] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{key}.")
        elif isinstance(value, list) and any(isinstance(item, Mapping) for item in value):
            flat |= _flat({str(number): item for number, item in enumerate(value)}, f"{prefix}{key}.")
        elif value not in (None, "", [], ()):
            flat[f"{prefix}{key}"] = str(value)
    return flat


def _notes(runs: Sequence[Evaluation]) -> str:
    parts = []
    for run in runs:
        items = "".join(f"<li>{escape(note)}</li>" for note in run.metrics["notes"])
        heading = f"<h3>{run.label}</h3>" if len(runs) > 1 else ""
        parts.append(f"{heading}<ul>{items}</ul>")
    return "".join(parts)
