"""`spacesim locate`."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from spacesim import interrupts
from spacesim.cli.parser import Parser, angles

SUMMARY, NEEDS_BACKEND = "poses of pictures against a trained run", True


def add_options(parser: Parser, arguments: Sequence[str]) -> None:
    parser.add_argument("path", type=Path, metavar="RUN")
    parser.add_argument("images", type=Path, metavar="IMAGES", help="a dataset, a folder of pictures or one picture")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.json")
    parser.add_argument("--start", type=Path, metavar="FILE", help="a transforms.json with rough poses (searched for)")
    parser.add_argument(
        "--camera", type=Path, metavar="FILE", help="intrinsics, as transforms.json has them (run's data)"
    )
    parser.add_argument("--sun", type=angles, metavar="AZ,EL", help="of all pictures (those of their dataset)")
    parser.add_argument("--within", type=_within, metavar="DEG,SHARE", help="how far off rough poses may be (5,0.05)")
    parser.add_argument("--resume", action="store_true", help="keep what an interrupted call has found")


def run(options: argparse.Namespace) -> None:
    from spacesim.data.errors import WorkError
    from spacesim.data.records import Sun
    from spacesim.methods import load_run
    from spacesim.progress import show_progress
    from spacesim.splat.locate import locate
    from spacesim.splat.run import check_gaussians

    run = check_gaussians(load_run(options.path))
    sun = Sun.from_angles(*options.sun) if options.sun else None
    more = {} if options.within is None else {"within": options.within}
    with show_progress("locate", "pictures") as report:
        done = locate(
            run,
            options.images,
            options.out,
            options.start,
            options.camera,
            sun,
            resume=options.resume,
            progress=report,
            **more,
        )
    failed = f", {done.failed} without a pose" if done.failed else ""
    interrupts.print_output(f"{options.out}: {done.pictures} pictures, {done.converged} converged{failed}")
    if done.failed == done.pictures:
        others = "" if done.failed == 1 else f"; {options.out} says why of the others"
        raise WorkError(f"expected a picture with a pose to be found, found none: {done.reason}{others}")


def _within(text: str) -> tuple[float, float]:
    try:
        degrees, share = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected DEG,SHARE such as 5,0.05, found {text!r}") from None
    return degrees, share
