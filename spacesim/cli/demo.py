"""`spacesim demo`."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from spacesim import interrupts
from spacesim.cli.parser import Parser
from spacesim.cli.printing import print_headline

SUMMARY, NEEDS_BACKEND = "generate, train, evaluate, report: a few minutes on two cores", True


def add_options(parser: Parser, arguments: Sequence[str]) -> None:
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")


def run(options: argparse.Namespace) -> None:
    from spacesim.demo import demo
    from spacesim.progress import show_progress

    interrupts.set_resume_command("the same command")
    done = demo(options.out, show_progress)
    print_headline(done["metrics"])
    parts = ", ".join(f"{part} {seconds:.0f} s" for part, seconds in done["seconds"].items())
    interrupts.print_output(
        f"{parts}\nreport: {done['report'].resolve()}\nto turn and relight: {done['page'].resolve()}"
    )
