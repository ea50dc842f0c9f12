"""`spacesim render`."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from spacesim import interrupts
from spacesim.cli.parser import Parser, add_view, angles, view_of
from spacesim.cli.printing import KNOWS_ONE_LIGHT, RELATIVE
from spacesim.data.errors import InputError
from spacesim.data.integrity.manifest import check_unlisted
from spacesim.learning.prediction import KINDS, MATERIAL_KINDS

SUMMARY, NEEDS_BACKEND = "one picture of a run", True


def add_options(parser: Parser, arguments: Sequence[str]) -> None:
    parser.add_argument("path", type=Path, metavar="RUN")
    of_exr = "EXR: numbers; rgb sRGB values, of light.radiance linear ones"
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.png|.exr", help=of_exr)
    add_view(parser)
    parser.add_argument("--sun", type=angles, metavar="AZ,EL", help="degrees; a vanilla run knows one light only")
    parser.add_argument("--kind", choices=(*KINDS, *MATERIAL_KINDS), default="rgb")
    parser.add_argument("--exposure", type=float, metavar="EV", help="of a run in linear light (that of its pictures)")


def run(options: argparse.Namespace) -> None:
    from spacesim.data.records import Sun
    from spacesim.learning.pictures import write_material, write_picture
    from spacesim.methods import load_run
    from spacesim.nerf.run import NerfRun

    check_unlisted(options.out)
    run = load_run(options.path)
    sun = Sun.from_angles(*options.sun) if options.sun else None
    if sun is not None and not run.relightable:
        print(KNOWS_ONE_LIGHT, file=sys.stderr)
    camera, sun_of_frame = view_of(options, run)
    if options.kind in MATERIAL_KINDS:
        write_material(run.draw_material(camera), options.kind, options.out)
        if not isinstance(run, NerfRun) and run.albedo_is_relative:
            print(RELATIVE, file=sys.stderr)
        interrupts.print_output(options.out)
        return
    sun = sun or sun_of_frame
    if sun is None and run.relightable:
        raise InputError("sun: expected AZ,EL for a run that can be relit and a camera without a Sun, found none")
    seen = run.predict(camera, sun, normals=options.kind == "normal", exposure=options.exposure)
    write_picture(seen, options.kind, options.out)
    surface = seen.depth[seen.depth > 0]
    if options.kind == "depth" and options.out.suffix == ".png" and surface.size:
        print(f"depth: {surface.min():.4g} m is white, {surface.max():.4g} m darkest; .exr has metres", file=sys.stderr)
    interrupts.print_output(options.out)
