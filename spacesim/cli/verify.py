"""`spacesim verify`."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from spacesim import interrupts
from spacesim.cli.parser import Parser
from spacesim.data.errors import WorkError

SUMMARY, NEEDS_BACKEND = "whether every file of a dataset is there and can be read", False


def add_options(parser: Parser, arguments: Sequence[str]) -> None:
    parser.add_argument("data", type=Path, metavar="DATA")
    parser.add_argument("--camera-density", type=Path, metavar="FILE.png", help="draw from where its cameras look, too")


def run(options: argparse.Namespace) -> None:
    from spacesim.data.integrity.manifest import NAME
    from spacesim.data.integrity.outputs import check_output
    from spacesim.data.integrity.verify import has_digests, repair_hint, verify_files

    if options.camera_density is not None:
        check_output(options.camera_density, "camera density")
    dataset, problems = verify_files(options.data)
    for problem in problems:
        print(problem, file=sys.stderr)
    if problems:
        files = "faulty file" if len(problems) == 1 else "faulty files"
        raise WorkError(f"{options.data}: {len(problems)} {files}{repair_hint(dataset)}")
    interrupts.print_output(f"{options.data}: {len(dataset.frames)} frames, every file is there and whole")
    if options.camera_density is not None:
        from spacesim.data.density import write_camera_density

        write_camera_density(options.camera_density, dataset)
    if not has_digests(dataset):
        print(f"no {NAME} lies beside them: a changed byte may go unseen", file=sys.stderr)
