"""`spacesim reproduce`."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from spacesim import interrupts
from spacesim.cli.parser import Parser

SUMMARY, NEEDS_BACKEND = "the thesis's tables and figures with ours beside them, on one page", True


def add_options(parser: Parser, arguments: Sequence[str]) -> None:
    from spacesim.reproduce.experiments import parts_known

    parser.add_argument("tables", nargs="*", metavar="TABLE", help=f"of {', '.join(parts_known())} (all)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    sizes = parser.add_mutually_exclusive_group()
    sizes.add_argument(
        "--reduced", action="store_true", help="a quarter of the pixels, 10,000 iterations: an hour or two on a GPU"
    )
    sizes.add_argument("--quick", action="store_true", help="tiny: minutes on two cores, to see that all of it works")
    parser.add_argument(
        "--seeds", type=int, default=1, metavar="N", help="trainings of each row, whose spread is reported (1)"
    )
    parser.add_argument("--resume", action="store_true", help="go on in DIR, with the same tables or others")
    parser.add_argument("--ray", metavar="ADDRESS", help="on a Ray cluster: auto, HOST:PORT, or local to start one")


def run(options: argparse.Namespace) -> None:
    from spacesim.progress import show_progress
    from spacesim.reproduce.reproduce import reproduce
    from spacesim.reproduce.size import FULL, QUICK, REDUCED

    size = QUICK if options.quick else REDUCED if options.reduced else FULL
    page = reproduce(options.out, show_progress, options.tables, size, options.resume, options.ray, options.seeds)
    interrupts.print_output(page)
