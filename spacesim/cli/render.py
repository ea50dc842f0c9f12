"""`spacesim render`."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from spacesim import interrupts
from spacesim.cli.parser import Parser, add_view, angles_or_none, view_of
from spacesim.cli.printing import KNOWS_ONE_LIGHT, RELATIVE, print_note
from spacesim.data.errors import InputError
from spacesim.data.integrity.outputs import check_output
from spacesim.learning.prediction import KINDS, MATERIAL_KINDS

SUMMARY, NEEDS_BACKEND = "one picture of a run", True


def add_options(parser: Parser, arguments: Sequence[str]) -> None:
    parser.add_argument("path", type=Path, metavar="RUN")
    of_exr = "EXR: numbers; rgb sRGB values, of light.linear linear ones"
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.png|.exr", help=of_exr)
    add_view(parser)
    of_sun = "degrees; none: the Earth's light alone; a vanilla run knows one light only"
    parser.add_argument("--sun", type=angles_or_none, metavar="AZ,EL|none", help=of_sun)
    of_earth = "where the Earth is; none: sunlight alone (as the frame says)"
    parser.add_argument("--earth", type=angles_or_none, metavar="AZ,EL|none", help=of_earth)
    parser.add_argument("--kind", choices=(*KINDS, *MATERIAL_KINDS), default="rgb")
    parser.add_argument("--exposure", type=float, metavar="EV", help="of a run in linear light (that of its pictures)")


def run(options: argparse.Namespace) -> None:
    from spacesim.learning.lights import named_sources, predict_light
    from spacesim.learning.pictures import write_material, write_picture
    from spacesim.methods import load_run

    check_output(options.out, "picture")
    run = load_run(options.path)
    lit = run.gaussian_run
    if options.sun and not run.relightable:
        print(KNOWS_ONE_LIGHT, file=sys.stderr)
    camera, of_frame, note = view_of(options, run)
    if options.kind in MATERIAL_KINDS:
        if options.exposure is not None:
            raise InputError(f"--exposure: expected none with --kind {options.kind}, which no light changes")
        write_material(run.draw_material(camera), options.kind, options.out)
        if lit and lit.albedo_is_relative:
            print(RELATIVE, file=sys.stderr)
        print_note(note)
        interrupts.print_output(options.out)
        return
    sun, light = named_sources(run, options.sun, options.earth, of_frame)
    seen = predict_light(run, camera, sun, light, options.kind == "normal", options.exposure)
    write_picture(seen, options.kind, options.out)
    surface = seen.depth[seen.depth > 0]
    if options.kind == "depth" and options.out.suffix.lower() == ".png" and surface.size:
        print(f"depth: {surface.min():.4g} m is white, {surface.max():.4g} m darkest; .exr has metres", file=sys.stderr)
    print_note(note)
    interrupts.print_output(options.out)
