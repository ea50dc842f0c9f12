"""`spacesim render`."""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from spacesim import interrupts
from spacesim.cli.parser import Parser, add_view, angles_or_none, view_of
from spacesim.cli.printing import KNOWS_ONE_LIGHT, RELATIVE
from spacesim.data.errors import InputError
from spacesim.data.integrity.manifest import check_unlisted
from spacesim.learning.prediction import KINDS, MATERIAL_KINDS

if TYPE_CHECKING:
    from spacesim.data.records import Sun

SUMMARY, NEEDS_BACKEND = "one picture of a run", True


def add_options(parser: Parser, arguments: Sequence[str]) -> None:
    parser.add_argument("path", type=Path, metavar="RUN")
    of_exr = "EXR: numbers; rgb sRGB values, of light.radiance linear ones"
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.png|.exr", help=of_exr)
    add_view(parser)
    of_sun = "degrees; none: the Earth's light alone; a vanilla run knows one light only"
    parser.add_argument("--sun", type=angles_or_none, metavar="AZ,EL|none", help=of_sun)
    of_earth = "where the Earth is; none: sunlight alone (as the frame says)"
    parser.add_argument("--earth", type=angles_or_none, metavar="AZ,EL|none", help=of_earth)
    parser.add_argument("--kind", choices=(*KINDS, *MATERIAL_KINDS), default="rgb")
    parser.add_argument("--exposure", type=float, metavar="EV", help="of a run in linear light (that of its pictures)")


def run(options: argparse.Namespace) -> None:
    from spacesim.learning.pictures import write_material, write_picture
    from spacesim.learning.prediction import added_light
    from spacesim.methods import load_run

    check_unlisted(options.out)
    run = load_run(options.path)
    lit = run.gaussian_run
    if options.sun and not run.relightable:
        print(KNOWS_ONE_LIGHT, file=sys.stderr)
    camera, of_frame = view_of(options, run)
    if options.kind in MATERIAL_KINDS:
        write_material(run.draw_material(camera), options.kind, options.out)
        if lit and lit.albedo_is_relative:
            print(RELATIVE, file=sys.stderr)
        interrupts.print_output(options.out)
        return
    sun = _sun(options, of_frame)
    if sun is None and run.relightable:
        raise InputError("sun: expected AZ,EL for a run that can be relit and a camera without a Sun, found none")
    knows_earth = bool(lit and lit.light and lit.light.config.earth)
    for name, wanted in (("sun", options.sun == "none"), ("earth", options.earth not in (None, "none"))):
        if wanted and not knows_earth:
            raise InputError(
                f"{name}: expected a run that has learned the Earth's light (light.earth), found {run.path}"
            )
    if options.sun == "none" and (sun is None or sun.earth is None):
        raise InputError("sun: expected AZ,EL where no frame says which Sun lights which Earth, found none")
    drawn = partial(run.predict, camera, normals=options.kind == "normal", exposure=options.exposure)
    seen = drawn(sun)
    if options.sun == "none" and sun:
        tone = lit.curve.tone if lit and lit.curve else "srgb"
        seen = added_light(seen, drawn(replace(sun, earth=None)), tone)
    write_picture(seen, options.kind, options.out)
    surface = seen.depth[seen.depth > 0]
    if options.kind == "depth" and options.out.suffix == ".png" and surface.size:
        print(f"depth: {surface.min():.4g} m is white, {surface.max():.4g} m darkest; .exr has metres", file=sys.stderr)
    interrupts.print_output(options.out)


def _sun(options: argparse.Namespace, of_frame: "Sun | None") -> "Sun | None":
    """The Sun and the Earth that the options name, else those of the frame."""
    from spacesim.data.earth import Earth
    from spacesim.data.geometry import direction_from_angles
    from spacesim.data.records import Sun

    given = None if options.sun in (None, "none") else Sun.from_angles(*options.sun)
    sun, earth = given or of_frame, of_frame.earth if of_frame else None
    if options.earth == "none":
        earth = None
    elif options.earth:
        towards = direction_from_angles(*options.earth)
        earth = replace(earth, direction=towards) if earth else Earth(towards)
    return replace(sun, earth=earth) if sun else None
