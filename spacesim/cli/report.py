"""`spacesim report`."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from spacesim import interrupts
from spacesim.cli.parser import Parser

SUMMARY, NEEDS_BACKEND = "one page about several evaluations side by side", False


def add_options(parser: Parser, arguments: Sequence[str]) -> None:
    parser.add_argument("evals", type=Path, nargs="+", metavar="EVAL")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.html")


def run(options: argparse.Namespace) -> None:
    from spacesim.eval.report.write import write_report

    write_report(options.evals, options.out)
    interrupts.print_output(f"report: {options.out.resolve()}")
