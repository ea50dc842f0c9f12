"""Composes two boxsats that were trained apart in several ways and evaluates them against the path-traced pair.

    python benchmarks/composition.py --out RUNS [--preset fast] [--iterations N] [--rows thesis,ours]
    python benchmarks/composition.py --out RUNS --data BOXSAT --pair PAIR

Trains each method on one boxsat under many Suns, unless RUNS/NAME/run is there already (the folders are those of
shadows.py, so its runs serve, too), stands it twice into one scene, at the origin and at (-3, -3, -3) m as in the
thesis, and compares the scene with path-traced pictures of both under the Sun at azimuth 45, elevation 35, where the
first hides the Sun from the second. Metrics are over the pixels of each; `spacesim reproduce` shows tables 4.6 and 4.7
themselves. Without BOXSAT and PAIR it makes them first, in RUNS/data and RUNS/pair. An interrupted call goes on where
it stopped. Every row's scene is RUNS/pairs/NAME.toml, its report RUNS/pairs/NAME/report.html; all rows on one page:
RUNS/pairs/report.html.
"""

import argparse
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import shadows
from support import common

from spacesim import backend
from spacesim.data.records import Dataset
from spacesim.data.store import read_dataset
from spacesim.eval.evaluate import EvaluateConfig
from spacesim.eval.report.write import write_report
from spacesim.progress import show_progress
from spacesim.reproduce.experiments import PLACES, SUN
from spacesim.reproduce.perform import composed, evaluated, trained
from spacesim.splat.run import Run, load_run
from spacesim.splat.train.config import TrainConfig, preset, with_options

ROWS = ("thesis", "ours")
COLUMNS = shadows.COLUMNS[:9]  #: those of both tables


@dataclass(frozen=True)
class Row:
    """A row of the tables."""

    name: str  #: of the row
    run: str  #: of the run, a folder of RUNS
    config: TrainConfig  #: of its training
    shadows: str  #: between the models


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", choices=backend.NAMES, default="auto")
    parser.add_argument("--out", type=Path, required=True, metavar="RUNS")
    parser.add_argument("--data", type=Path, metavar="BOXSAT", help="what is trained on; made where it is not named")
    parser.add_argument(
        "--pair", type=Path, metavar="PAIR", help="what is evaluated against; made where it is not named"
    )
    parser.add_argument("--resolution", type=int, default=256, metavar="PX", help="of what is made (256)")
    parser.add_argument("--views", type=int, default=50, metavar="N", help="of the pair (50)")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--iterations", type=int, metavar="N")
    parser.add_argument("--rows", default=",".join(ROWS), help="of thesis,ours, or names of single rows")
    parser.add_argument("--run", action="append", default=[], metavar="NAME=RUN", help="take this run; repeatable")
    parser.add_argument("--no-geometry", action="store_true", help="do not evaluate shapes")
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
            data = data or shadows.make_data(options.out / "data", resolution=options.resolution)
            config = with_options(row.config, iterations=options.iterations)
            result = trained(options.out / row.run / "run", read_dataset(data), config, row.run, show_progress)
            assert isinstance(result, Run)
            run = result
        results[row.name] = evaluated_twice(row, run, pair, options.out / "pairs", not options.no_geometry)
    write_report([options.out / "pairs" / name for name in results], options.out / "pairs/report.html")
    tables = {
        f"The {which} boxsat, Sun ({SUN[0]:g}, {SUN[1]:g})": [
            table_row(row.name, results[row.name], which) for row in rows
        ]
        for which in PLACES
    }
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
        yield Row("none", "none", configs["none"], "none")
        for name in ("map", "splat", "baseline-park"):
            yield Row(name, name, configs[name], "others")
        for name in ("map", "splat"):
            yield Row(f"{name}-ratio", name, configs[name], "ratio")
        yield Row("none-shaded", "none", configs["none"], "others")
        return
    yield Row("none-surface", "none, surface", preset(size, "relight"), "none")
    for name, method in (("map", "shadow-map"), ("splat", "shadow-splat")):
        yield Row(f"{name}-surface", f"{name}, surface", preset(size, method), "others")


def make_pair(out: Path, resolution: int, views: int) -> Path:
    """Both boxsats under one Sun."""
    size = {"views": 1, "test_suns": 0, "test_views": views, "resolution": resolution, "test_spp": 1024}
    return common.generated("boxsat-pair", out, sun=[SUN], **size)


def evaluated_twice(row: Row, run: Run, pair: Dataset, out: Path, shapes: bool) -> dict[str, Any]:
    """metrics.json of the scene with this run twice."""
    measures = EvaluateConfig() if shapes else EvaluateConfig(geometry=None)
    scene = composed(run, out / f"{row.name}.toml", row.shadows)
    return evaluated(scene, pair, out / row.name, measures, row.name, show_progress)


def table_row(name: str, metrics: Mapping[str, Any], which: str) -> common.Row:
    """Means over one boxsat's pixels."""
    summaries = [_of(metrics, which, group, metric) for _, group, metric in COLUMNS]
    cells = dict(zip((heading for heading, _, _ in COLUMNS), shown(summaries), strict=True))
    error = _of(metrics, which, "shadow_mask", "error_rate")
    return {"row": name, **cells, "mask error": "" if error is None else f"{error:.4f}"}


def shown(values: Any) -> list[str]:
    """As cells; COLUMNS says of what."""
    metrics = [metric for _, _, metric in COLUMNS]
    return [
        "" if value is None else f"{value:.{2 if metric == 'psnr' else 4}f}"
        for metric, value in zip(metrics, values, strict=True)
    ]


def _of(metrics: Mapping[str, Any], which: str, group: str, metric: str) -> float | None:
    """Mean over the frames that show the boxsat."""
    one: Mapping[str, Any] = next((entry for entry in metrics["objects"] or [] if entry["name"] == which), {})
    value = (one.get(group) or {}).get(metric)
    return None if value is None else float(value["mean"])


if __name__ == "__main__":
    common.run_main(main)
