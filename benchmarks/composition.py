"""Composes two boxsats that were trained apart and judges them against the path-traced pair (tables 4.6 and 4.7).

    python benchmarks/composition.py --out RUNS [--preset fast] [--iterations N] [--rows thesis,ours]
    python benchmarks/composition.py --out RUNS --data BOXSAT --pair PAIR

Trains each method on one boxsat under many Suns, unless RUNS/NAME/run is there already (the folders are those of
shadows.py, so its runs serve, too), stands it twice into one scene, at the origin and at (-3, -3, -3) m as in the
thesis, and compares the scene with path-traced pictures of both under the Sun at azimuth 45, elevation 35, where the
first hides the Sun from the second. Metrics are over the pixels of each. Without BOXSAT and PAIR it makes them first,
in RUNS/data and RUNS/pair. An interrupted call goes on where it stopped. Every row's scene is RUNS/pairs/NAME.toml, its
report RUNS/pairs/NAME/report.html; all rows on one page: RUNS/pairs/report.html.
"""

import argparse
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import common
import shadows

from spacesim import backend
from spacesim.data.store import read_dataset
from spacesim.eval.composition import ComposedRun
from spacesim.eval.evaluate import EvaluateConfig, evaluate
from spacesim.eval.report.write import write_report
from spacesim.progress import reporting, tell_training
from spacesim.splat.compose import ComposeConfig, Composition, Placed, Pose, PosedScene, load_scene, save_scene
from spacesim.splat.run import Run, load_run
from spacesim.splat.train.config import TrainConfig, preset, with_options
from spacesim.splat.train.train import train

SUN = (45.0, 35.0)  #: azimuth and elevation, degrees, of tables 4.6 and 4.7
PLACES = {"first": (0.0, 0.0, 0.0), "second": (-3.0, -3.0, -3.0)}  #: metres
ROWS = ("thesis", "ours")
COLUMNS = shadows.COLUMNS[:9]  #: those of both tables

THESIS = {  # of the second boxsat: tables 4.6 and 4.7, means
    "none": (0.0398, 0.0694, 26.3320, 0.8507, 0.2018, 0.1505, 0.0392, 0.0351, 1.6572),
    "map": (0.0015, 0.0139, 40.5382, 0.9809, 0.1468, 0.0030, -0.000702, 0.0156, 0.0254),
    "park": (0.0017, 0.0131, 41.2144, 0.9857, 0.1217, 0.0030, -0.0000949, 0.0150, 0.2027),
    "splat": (0.0015, 0.0129, 41.3919, 0.9866, 0.1147, 0.0030, -0.000214, 0.0147, 0.2436),
}
GAIN_DB, ERROR_SHARE = 10.0, 0.1  #: wanted of shadows over the second: PSNR gained at least, error rate left at most


@dataclass(frozen=True)
class Row:
    """name: of the row;  run: of the run, a folder of RUNS;  config: of its training;  shadows: between the models;
    baseline: the row without shadows that it is compared with"""

    name: str
    run: str
    config: TrainConfig
    shadows: str
    baseline: str


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", choices=backend.NAMES, default="auto")
    parser.add_argument("--out", type=Path, required=True, metavar="RUNS")
    parser.add_argument("--data", type=Path, metavar="BOXSAT", help="what is trained on; made where it is not named")
    parser.add_argument("--pair", type=Path, metavar="PAIR", help="what is judged against; made where it is not named")
    parser.add_argument("--resolution", type=int, default=256, metavar="PX", help="of what is made (256)")
    parser.add_argument("--views", type=int, default=50, metavar="N", help="of the pair (50)")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--iterations", type=int, metavar="N")
    parser.add_argument("--rows", default=",".join(ROWS), help="of thesis,ours, or names of single rows")
    parser.add_argument("--run", action="append", default=[], metavar="NAME=RUN", help="take this run; repeatable")
    parser.add_argument("--no-geometry", action="store_true", help="do not judge shapes")
    parser.add_argument("--markdown", action="store_true")
    parser.add_argument("--json", nargs="?", const=Path("-"), type=Path, metavar="FILE")
    options = parser.parse_args()
    backend.select(options.backend)
    rows = chosen_rows(options.rows, options.preset)
    given = dict(
        item.split("=", 1) if "=" in item else sys.exit(f"--run: expected NAME=RUN, found {item!r}")
        for item in options.run
    )
    unknown = [name for name in given if name not in {row.run for row in rows}]
    if unknown:
        known = " | ".join(dict.fromkeys(row.run for row in rows))
        sys.exit(f"--run: expected NAME to be one of {known}, found {unknown[0]!r}")
    data = options.data
    pair = read_dataset(options.pair or make_pair(options.out / "pair", options.resolution, options.views))
    results: dict[str, dict[str, Any]] = {}
    for row in rows:
        if row.run in given:
            run = load_run(Path(given[row.run]))
        else:
            data = data or make_data(options.out / "data", options.resolution)
            run = trained(row, with_options(row.config, iterations=options.iterations), data, options.out)
        results[row.name] = judged(row, run, pair, options.out, not options.no_geometry)
    write_report([options.out / "pairs" / name for name in results], options.out / "pairs/report.html")
    tables = {
        f"The {which} boxsat, Sun ({SUN[0]:g}, {SUN[1]:g})": [
            table_row(row.name, results[row.name], which) for row in rows
        ]
        for which in PLACES
    }
    tables["The second boxsat in the thesis"] = [
        {"row": name, **dict(zip((heading for heading, _, _ in COLUMNS), shown(values), strict=True))}
        for name, values in THESIS.items()
    ]
    tables["Targets"] = [targets(row, results) for row in rows if row.baseline in results and row.name != row.baseline]
    common.emit({"rows": tables, "pair": str(pair.root), "data": str(data)}, tables, options)


def chosen_rows(wanted: str, size: str) -> list[Row]:
    """Those of the kinds or names in `wanted`; ends the program with a sentence where there is no such row."""
    table = {kind: list(rows_of(kind, size)) for kind in ROWS}
    names = common.row_names(wanted)
    known = [*ROWS, *(row.name for rows in table.values() for row in rows)]
    unknown = [name for name in names if name not in known]
    if unknown:
        sys.exit(f"--rows: expected some of {', '.join(known)}, found {unknown[0]!r}")
    return [row for kind, rows in table.items() for row in rows if kind in names or row.name in names]


def rows_of(kind: str, size: str) -> Iterator[Row]:
    """The rows of a kind. Models shade each other by what the others let through; rows "ratio" by 4.15 as it stands;
    "none-shaded" asks what that alone gives to a method without shadows."""
    if kind == "thesis":
        configs = dict(shadows.configurations("thesis", size))
        yield Row("none", "none", configs["none"], "none", "none")
        for name in ("map", "splat", "park"):
            yield Row(name, name, configs[name], "others", "none")
        for name in ("map", "splat"):
            yield Row(f"{name}-ratio", name, configs[name], "ratio", "none")
        yield Row("none-shaded", "none", configs["none"], "others", "none")
        return
    yield Row("none-surface", "none, surface", preset(size, "relight"), "none", "none-surface")
    for name, method in (("map", "shadow-map"), ("splat", "shadow-splat")):
        yield Row(f"{name}-surface", f"{name}, surface", preset(size, method), "others", "none-surface")


def make_data(out: Path, resolution: int) -> Path:
    """One boxsat under the Suns of shadows.py."""
    from spacesim.scenes import generate, read_scene

    size = {**shadows.SCENE, "resolution": resolution}
    scene = read_scene("boxsat", **size, known_test_views=2, shared_test_views=True)
    with reporting("generate", "frames") as report:
        generate(scene, out, resume=True, progress=report)
    return out


def make_pair(out: Path, resolution: int, views: int) -> Path:
    """Both boxsats under one Sun."""
    from spacesim.scenes import generate, read_scene

    size = {"views": 1, "test_suns": 0, "test_views": views, "resolution": resolution, "test_spp": 1024}
    with reporting("generate the pair", "frames") as report:
        generate(read_scene("boxsat-pair", sun=[SUN], **size), out, resume=True, progress=report)
    return out


def trained(row: Row, config: TrainConfig, data: Path, out: Path) -> Run:
    with reporting(f"train {row.run}", "iterations") as report:
        return train(read_dataset(data), out / row.run / "run", config, resume=True, on_progress=tell_training(report))


def judged(row: Row, run: Run, pair: Any, out: Path, shapes: bool) -> dict[str, Any]:
    """metrics.json of the scene with this run twice."""
    config = EvaluateConfig() if shapes else EvaluateConfig(geometry=None)
    file, folder = out / "pairs" / f"{row.name}.toml", out / "pairs" / row.name
    models = [Placed(run, Pose(translation=place), which) for which, place in PLACES.items()]
    save_scene(file, PosedScene(Composition(models, ComposeConfig(row.shadows))))
    scene = ComposedRun(load_scene(file).composition, file)
    with reporting(f"evaluate {row.name}", "frames") as report:
        metrics: dict[str, Any] = evaluate(scene, pair, folder, config, report)  # type: ignore[arg-type]
    write_report([folder], folder / "report.html")
    return metrics


def table_row(name: str, metrics: Mapping[str, Any], which: str) -> common.Row:
    """Means over one boxsat's pixels."""
    summaries = [_of(metrics, which, group, metric) for _, group, metric in COLUMNS]
    found = dict(zip((heading for heading, _, _ in COLUMNS), shown(summaries), strict=True))
    error = _of(metrics, which, "shadow_mask", "error_rate")
    return {"row": name, **found, "mask error": "" if error is None else f"{error:.4f}"}


def shown(values: Any) -> list[str]:
    """As cells; COLUMNS says of what."""
    metrics = [metric for _, _, metric in COLUMNS]
    return [
        "" if value is None else f"{value:.{2 if metric == 'psnr' else 4}f}"
        for metric, value in zip(metrics, values, strict=True)
    ]


def targets(row: Row, results: Mapping[str, Mapping[str, Any]]) -> common.Row:
    """What shadows between the models gain over the row without any."""
    ours, base = results[row.name], results[row.baseline]
    psnr = {which: [_of(one, which, "image", "psnr") for one in (ours, base)] for which in PLACES}
    errors = [_of(one, "second", "shadow", "ber") for one in (ours, base)]
    gains = {which: None if None in pair else pair[0] - pair[1] for which, pair in psnr.items()}
    share = errors[0] / errors[1] if None not in errors and errors[1] else None
    return {
        "row": row.name,
        "over": row.baseline,
        "second, dB": "" if gains["second"] is None else f"{gains['second']:+.2f}",
        f"at least {GAIN_DB:g}": _verdict(gains["second"], lambda gain: gain >= GAIN_DB),
        "error rate, share left": "" if share is None else f"{share:.3f}",
        f"at most {ERROR_SHARE:g}": _verdict(share, lambda left: left <= ERROR_SHARE),
        "first, dB": "" if gains["first"] is None else f"{gains['first']:+.2f}",
        "not worse": _verdict(gains["first"], lambda gain: gain >= 0),
    }


def _verdict(value: float | None, holds: Any) -> str:
    return "" if value is None else "yes" if holds(value) else "no"


def _of(metrics: Mapping[str, Any], which: str, group: str, metric: str) -> float | None:
    """Mean over the frames that show the boxsat."""
    one = next((entry for entry in metrics["objects"] or [] if entry["name"] == which), {})
    value = (one.get(group) or {}).get(metric)
    return None if value is None else float(value["mean"])


if __name__ == "__main__":
    common.told(main)
