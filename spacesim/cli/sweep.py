"""`spacesim sweep`."""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from spacesim import interrupts
from spacesim.cli.parser import Parser, add_view, resolution, view_of
from spacesim.cli.printing import print_note

SUMMARY, NEEDS_BACKEND = "the Sun goes round a run: a contact sheet and a video", True


def add_options(parser: Parser, arguments: Sequence[str]) -> None:
    parser.add_argument("path", type=Path, metavar="RUN")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    add_view(parser)
    path = parser.add_mutually_exclusive_group()
    path.add_argument("--elevation", type=float, metavar="DEG", help="the Sun goes round at this elevation (30)")
    path.add_argument(
        "--azimuth", type=float, metavar="DEG", help="the Sun goes over the zenith, from the horizon at this azimuth"
    )
    parser.add_argument("--frames", type=int, metavar="N", help="Suns, evenly around the circle (72)")
    parser.add_argument("--kind", choices=("rgb", "shadow"), default="rgb")
    parser.add_argument("--exposure", type=float, metavar="EV", help="of a run in linear light (that of its pictures)")
    parser.add_argument("--size", type=resolution, metavar="PX", help="pixels of the longer side, or WIDTHxHEIGHT")
    kept = "write every picture into DIR/frames, too, of light.linear as EXR beside PNG"
    parser.add_argument("--keep-frames", action="store_true", help=kept)


def run(options: argparse.Namespace) -> None:
    from spacesim.methods import load_run
    from spacesim.progress import show_progress
    from spacesim.splat.export.sweep import FRAMES, resize_camera, suns_around, sweep

    suns = suns_around(FRAMES if options.frames is None else options.frames, options.elevation, options.azimuth)
    run = load_run(options.path)
    camera, of_frame, note = view_of(options, run)
    if of_frame is not None:
        suns = [replace(sun, earth=of_frame.earth) for sun in suns]
    if options.size is not None:
        camera = resize_camera(camera, options.size)
    with show_progress("sweep", "frames") as report:
        done = sweep(run, camera, suns, options.out, options.kind, options.keep_frames, report, options.exposure)
    print_note(note)
    print_note(done.note)
    interrupts.print_output(" ".join(str(path) for path in (done.sheet, done.video) if path is not None))
