"""`spacesim doctor`."""

import argparse
import json
from collections.abc import Sequence

from spacesim import interrupts
from spacesim.cli.parser import Parser

SUMMARY, NEEDS_BACKEND = "what can run here, and what to type if not", False


def add_options(parser: Parser, arguments: Sequence[str]) -> None:
    parser.add_argument("--json", action="store_true", help="print the findings as JSON alone")


def run(options: argparse.Namespace) -> None:
    from spacesim import doctor

    findings = doctor.report()
    interrupts.print_output(json.dumps(findings, indent=1) if options.json else doctor.describe(findings))
