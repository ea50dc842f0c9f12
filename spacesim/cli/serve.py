"""`spacesim serve`."""

import argparse
from collections.abc import Sequence

from spacesim import interrupts
from spacesim.cli.parser import Parser

SUMMARY, NEEDS_BACKEND = "a camera that answers: pose and Sun in, pictures and truth out", True


def add_options(parser: Parser, arguments: Sequence[str]) -> None:
    parser.add_argument("what", metavar="SCENE|RUN|SCENE.toml", help="path-traced; or predicted, also of several runs")
    parser.add_argument("--host", default="127.0.0.1", metavar="ADDRESS", help="to listen at (this machine alone)")
    parser.add_argument("--port", type=int, default=5556, metavar="N", help="to listen at (5556, Vizard's; 0: any)")
    parser.add_argument("--spp", type=int, metavar="N", help="samples a pixel of a scene (as the scene says)")
    # Promised to scripts, and without effect: it speaks to Basilisk, too, whether it is given or not.
    parser.add_argument("--vizard", action="store_true", help=argparse.SUPPRESS)


def run(options: argparse.Namespace) -> None:
    from spacesim.serve.draw import load_served
    from spacesim.serve.protocol import import_zmq
    from spacesim.serve.server import serve

    import_zmq()
    serve(load_served(options.what, options.spp), options.host, options.port, interrupts.print_output)
