"""`spacesim eval`."""

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from spacesim import interrupts
from spacesim.cli.parser import Parser
from spacesim.cli.printing import print_headline

SUMMARY, NEEDS_BACKEND = "evaluate a run, or a scene of several: EVAL/metrics.json, EVAL/report.html, EVAL/frames", True


def add_options(parser: Parser, arguments: Sequence[str]) -> None:
    parser.add_argument("path", type=Path, metavar="RUN|SCENE.toml")
    parser.add_argument("--data", type=Path, required=True, metavar="DATA")
    parser.add_argument("--out", type=Path, required=True, metavar="EVAL")
    parser.add_argument("--split", default="test", help="test (default), train or all")
    parser.add_argument(
        "--lpips-weights", type=Path, metavar="PATH", help="AlexNet and linear weights for LPIPS, a file or a folder"
    )
    parser.add_argument(
        "--no-geometry", action="store_true", help="do not evaluate the shape (docs/how-to/geometry.md)"
    )
    parser.add_argument(
        "--fit-gain", action="store_true", help="fit each picture's exposure on one half of it, score it on the other"
    )
    parser.add_argument(
        "--align",
        type=Path,
        metavar="DATA",
        help="the dataset that the run is in the axes and scale of, where --data has others: match their cameras",
    )
    parser.add_argument("--json", action="store_true", help="print metrics.json alone")


def run(options: argparse.Namespace) -> None:
    from spacesim.data.store import read_dataset
    from spacesim.eval.evaluate import EvaluateConfig, evaluate
    from spacesim.eval.report.write import write_report
    from spacesim.methods import load_predictor
    from spacesim.progress import show_progress

    own = None if options.align is None else read_dataset(options.align)
    config = EvaluateConfig(options.split, options.lpips_weights, fit_gain=options.fit_gain, align=own)
    if options.no_geometry:
        config = replace(config, geometry=None)
    evaluated, dataset = load_predictor(options.path), read_dataset(options.data)
    with show_progress("evaluate", "frames", quiet=options.json) as report:
        metrics = evaluate(evaluated, dataset, options.out, config, report)
    write_report([options.out], options.out / "report.html")
    if options.json:
        interrupts.print_output(json.dumps(metrics, indent=1))
    else:
        print_headline(metrics)
        interrupts.print_output(f"report: {(options.out / 'report.html').resolve()}")
