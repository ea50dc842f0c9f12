"""`spacesim view`."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from spacesim import interrupts
from spacesim.cli.parser import Parser

SUMMARY, NEEDS_BACKEND = "look at a run or a composed scene in the browser", True


def add_options(parser: Parser, arguments: Sequence[str]) -> None:
    parser.add_argument("path", type=Path, metavar="RUN|SCENE.toml")
    parser.add_argument("--data", type=Path, metavar="DATA", help="whose cameras and truth (of a run: its own)")
    parser.add_argument("--host", default="127.0.0.1", metavar="ADDRESS", help="to listen at (this machine alone)")
    parser.add_argument("--port", type=int, default=8080, metavar="N", help="to listen at, or the next free one (8080)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where scenes are saved (the working directory)")


def run(options: argparse.Namespace) -> None:
    from spacesim.viewer.load import load_setup
    from spacesim.viewer.server import serve

    serve(load_setup(options.path, options.data, options.out), options.host, options.port, interrupts.print_output)
