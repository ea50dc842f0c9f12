"""`spacesim import`. Kinds of source and their options stand in tables beside the importers."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from spacesim import interrupts
from spacesim.cli.parser import Parser

SUMMARY, NEEDS_BACKEND = "pictures from elsewhere as a dataset", False


def add_options(parser: Parser, arguments: Sequence[str]) -> None:
    from spacesim.data.importers.kinds import KINDS

    parser.usage = "spacesim import KIND SRC --out DATA [options]"
    parser.epilog = "The options of a kind: spacesim import KIND --help"
    kinds = parser.add_subparsers(required=True, metavar="KIND", dest="kind", parser_class=Parser)
    for name, importer in KINDS.items():
        of_kind: Parser = kinds.add_parser(
            name, prog=f"spacesim import {name}", help=importer.summary, description=importer.summary
        )
        of_kind.add_argument("src", type=Path, metavar="SRC", help=importer.source)
        of_kind.add_argument("--out", type=Path, required=True, metavar="DATA", help="new folder of the dataset")
        for option in importer.options:
            flag = f"--{option.name.replace('_', '-')}"
            if option.type is bool:
                of_kind.add_argument(flag, action="store_true", default=None, help=option.help.replace("%", "%%"))
            else:
                of_kind.add_argument(
                    flag,
                    type=option.type,
                    metavar=option.value,
                    choices=option.choices or None,
                    help=option.help.replace("%", "%%"),
                )
        of_kind.add_argument("--debug", action="store_true", default=argparse.SUPPRESS, help=argparse.SUPPRESS)
        of_kind.set_defaults(flags=of_kind.flags())


def run(options: argparse.Namespace) -> None:
    from spacesim.data.importers.kinds import KINDS, import_dataset
    from spacesim.progress import show_progress

    chosen = {option.name: getattr(options, option.name) for option in KINDS[options.kind].options}
    given = {name: value for name, value in chosen.items() if value is not None}
    with show_progress("import", "steps") as report:
        dataset = import_dataset(options.kind, options.src, options.out, report, **given)
    points = "" if dataset.ply_file_path is None else ", with points to start from"
    interrupts.print_output(
        f"{options.out}: {len(dataset.train)} frames to train on, {len(dataset.test)} to test with{points}"
    )
