"""`spacesim compose`."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from spacesim import interrupts
from spacesim.cli.parser import Parser, resolution
from spacesim.cli.printing import WANTS_FILTER
from spacesim.data.errors import InputError
from spacesim.data.integrity.outputs import check_output

SUMMARY, NEEDS_BACKEND = "several runs in one scene: pictures, depth, object numbers, shadows, a video", True


def add_options(parser: Parser, arguments: Sequence[str]) -> None:
    parser.add_argument("scene", type=Path, metavar="SCENE.toml", help="see docs/reference/composed-scenes.md")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--size", type=resolution, metavar="PX", help="pixels of the longer side, or WIDTHxHEIGHT")
    parser.add_argument("--exposure", type=float, metavar="EV", help="of runs in linear light (that of their pictures)")
    parser.add_argument("--ply", type=Path, metavar="FILE", help="write the scene as plain Gaussians, too")


def run(options: argparse.Namespace) -> None:
    from spacesim.methods import load_scene
    from spacesim.progress import show_progress
    from spacesim.splat.compose.output import compose
    from spacesim.splat.compose.plain import bake_scene
    from spacesim.splat.compose.scene import GaussianComposition
    from spacesim.splat.export.ply import write_ply

    if options.ply is not None:
        check_output(options.ply, "ply")
    interrupts.set_resume_command("the same command")
    scene = load_scene(options.scene)
    if options.ply is not None and not isinstance(scene.composition, GaussianComposition):
        raise InputError(f"ply: expected a scene of Gaussians, found {options.scene}, with radiance fields")
    with show_progress("compose", "frames") as report:
        done = compose(scene, options.out, options.size, report, options.exposure)
    written = [done.sheet, done.video]
    if options.ply is not None:
        first = scene.frame(0)
        write_ply(bake_scene(first.composition, first.sun), options.ply)
        written.append(options.ply)
        for model in scene.composition.models:
            if model.run.antialiased:
                print(f"{model.name}: {WANTS_FILTER}", file=sys.stderr)
    if done.note is not None:
        print(done.note, file=sys.stderr)
    interrupts.print_output(" ".join(str(path) for path in written if path is not None))
