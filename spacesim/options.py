"""The options of every command, and how wrong ones are told."""

import argparse
import math
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from spacesim import __version__, backend, ending
from spacesim.data.errors import InputError

if TYPE_CHECKING:
    from spacesim.splat.train.config import TrainConfig

KINDS = ("rgb", "depth", "alpha", "normal", "shadow")


class _Parser(argparse.ArgumentParser):
    """Says what is wrong with the usage in one sentence, and takes "-40,10" for an argument, not for an option."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._negative_number_matcher = re.compile(r"^-\.?\d")

    def _print_message(self, message: str, file: Any = None) -> None:
        """argparse itself would not say that its help could not be written."""
        if file is sys.stdout:
            ending.say(message, end="")
        else:
            super()._print_message(message, file)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help\n")


def parser(run: Mapping[str, Callable[[argparse.Namespace], None]]) -> argparse.ArgumentParser:
    """The parser of the command line. run: what each command calls with its options, by the command's name;
    `options.run` is the one chosen, `options.needs_backend` whether a backend is to be selected before."""
    parser = _Parser(prog="spacesim", description="Simulate spacecraft images, reconstruct them, judge the result.")
    parser.add_argument("--version", action="version", version=f"spacesim {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)

    def command(name: str, text: str, needs_backend: bool = True) -> _Parser:
        one: _Parser = commands.add_parser(name, help=text, description=text)
        one.set_defaults(run=run[name], needs_backend=needs_backend, backend="auto")
        one.add_argument("--debug", action="store_true", help="log more, and tracebacks of what failed")
        if needs_backend:
            one.add_argument("--backend", choices=backend.NAMES, default="auto", help="default: CUDA, else LLVM")
        return one

    one = command("doctor", "what can run here, and what to type if not", needs_backend=False)
    one.add_argument("--json", action="store_true", help="print the findings as JSON alone")

    one = command("demo", "generate, train, evaluate, report: a few minutes on two cores")
    one.add_argument("--out", type=Path, required=True, metavar="DIR")

    one = command("generate", "path-trace a dataset with its truth", needs_backend=False)
    scenes = f"a built-in scene ({', '.join(_built_in_scenes())}), a scene file (.toml) or a mesh file"
    one.add_argument("scene", metavar="SCENE", help=scenes)
    one.add_argument("--out", type=Path, metavar="DATA")
    one.add_argument("--backend", choices=backend.NAMES, default="auto", help="default: CUDA, else LLVM")
    one.add_argument("--suns", type=int, metavar="N", help="training Suns")
    one.add_argument("--views", type=int, metavar="N", help="training views for each Sun")
    one.add_argument("--test-suns", type=int, metavar="N", help="Suns kept for testing (0: those of training)")
    one.add_argument("--test-views", type=int, metavar="N", help="test views for each test Sun")
    one.add_argument("--known-test-views", type=int, metavar="N", help="test views for each training Sun beside them")
    one.add_argument(
        "--shared-test-views", action="store_true", default=None, help="the same test cameras under every Sun"
    )
    one.add_argument(
        "--sun", type=_angles, action="append", metavar="AZ,EL", help="a training Sun, degrees; repeatable"
    )
    one.add_argument("--distance", type=float, metavar="M", help="metres from the cameras to the target's centre")
    one.add_argument("--resolution", type=_resolution, metavar="PX", help="pixels of each side, or WIDTHxHEIGHT")
    one.add_argument("--fov", type=float, metavar="DEG", help="angle that the image's width covers")
    one.add_argument("--exposure", type=float, metavar="X", help="display value of a radiance of 1 W/m2/sr")
    one.add_argument("--spp", type=int, metavar="N", help="samples a pixel")
    one.add_argument("--test-spp", type=int, metavar="N", help="of test views (four times as many)")
    one.add_argument("--seed", type=int, metavar="N")
    one.add_argument("--units", metavar="UNIT", help="of a mesh file: m (default), cm, mm, km, in or ft")
    one.add_argument("--up", metavar="AXIS", help="of a mesh file: x, y or z (default: the format's own)")
    one.add_argument("--resume", action="store_true", help="complete what an interrupted run left")
    many = one.add_mutually_exclusive_group()
    many.add_argument("--workers", type=int, default=1, metavar="N", help="processes that render (1)")
    many.add_argument(
        "--ray", metavar="ADDRESS", help="render on a Ray cluster: auto, HOST:PORT, or local to start one"
    )
    one.add_argument("--estimate", action="store_true", help="render a few frames, tell time and disk, keep nothing")
    one.add_argument("--print", action="store_true", help="render nothing, print the whole scene as a scene file")

    one = command("train", "reconstruct a dataset with Gaussian splatting")
    one.add_argument("data", type=Path, metavar="DATA")
    one.add_argument("--out", type=Path, required=True, metavar="RUN")
    one.add_argument("--method", default="vanilla", help="vanilla (default), relight, shadow-map, shadow-splat or park")
    one.add_argument("--strategy", default="default", help="default, mesh-aware, support-aware or mcmc")
    one.add_argument("--max-gaussians", type=int, metavar="N", help="refinement makes no more (250,000)")
    one.add_argument(
        "--prune-opacity",
        type=float,
        metavar="O",
        help="refinement prunes what is fainter (0.05; fine, of light, 0.005)",
    )
    one.add_argument(
        "--split-screen-size",
        type=float,
        metavar="S",
        help="refinement splits what is wider, a share of the picture (0.1; of methods of light 0.03, with --preset "
        "demo 0.06, fine 0.015; --preset thesis 0.01): less makes shadows sharper and Gaussians more",
    )
    one.add_argument("--init", help="mesh, points or random (default: points, else mesh, else random)")
    one.add_argument("--init-count", type=int, metavar="N", help="Gaussians at the start, at most")
    one.add_argument("--views-per-step", type=int, metavar="N", help="views whose mean gradient a step follows (1)")
    one.add_argument(
        "--flatten", type=float, dest="flatten_weight", metavar="W", help="weight that makes Gaussians discs (0)"
    )
    one.add_argument(
        "--antialiased",
        action=argparse.BooleanOptionalAction,
        help="Mip-Splatting's 2D filter: sharper edges, pictures that hold at other distances (on for methods of light "
        "but with --preset thesis)",
    )
    one.add_argument(
        "--supersample",
        type=int,
        metavar="N",
        help="draw pictures N times as wide, a pixel is the mean light of N x N: sharper edges, slower steps (1; 2 of "
        "methods of light with --preset fine)",
    )
    one.add_argument(
        "--init-box", type=float, metavar="X", help="--init random in a cube X times as wide as the object"
    )
    one.add_argument("--warm-start", action="store_true", help="pull Gaussians to the foreground before refinement")
    one.add_argument("--depth-weight", type=float, metavar="W", help="learn depth from the truth, too (0)")
    one.add_argument("--normal-weight", type=float, metavar="W", help="learn normals from the truth, too (0)")
    one.add_argument("--prior", choices=("truth", "mesh"), help="whose depth and normals: truth (default) or mesh")
    one.add_argument("--preset", default="fast", help="demo, fast (default), fine or thesis")
    one.add_argument("--iterations", type=int, metavar="N")
    one.add_argument("--seed", type=int, metavar="N")
    one.add_argument(
        "--black-background", action="store_true", help="train over black, as the thesis, not against alpha"
    )
    one.add_argument("--resume", action="store_true", help="go on from the newest checkpoint")
    lit = one.add_argument_group("light", "of the methods that learn it; see docs/relighting.md")
    lit.add_argument("--field", choices=("thesis", "surface"), help="what the appearance field is told")
    lit.add_argument(
        "--bounce",
        type=int,
        metavar="N",
        help="so many Gaussians scatter sunlight onto all (256 of shadow-map and shadow-splat, --preset fine 1024; 0 "
        "with --preset thesis or --field thesis)",
    )
    lit.add_argument("--linear", action="store_true", help="blend colours in linear light, then use a tone curve")
    lit.add_argument("--tone", choices=("srgb", "filmic"), help="curve of --linear (the dataset's own, else srgb)")
    lit.add_argument(
        "--exposure", type=float, metavar="EV", help="of the pictures, of --linear (the dataset's own, else 0)"
    )
    lit.add_argument("--shadow-bias", type=float, metavar="X", help="strength of the receiver-depth bias; 0: none")
    lit.add_argument("--grazing", choices=("none", "bias", "lift", "both"), help="against acne where the Sun grazes")
    lit.add_argument(
        "--shadow-filter", choices=("bilinear", "percentage-closer", "variance", "median"), help="of shadow maps"
    )
    lit.add_argument(
        "--sun-radius", type=float, metavar="DEG", help="penumbrae of such a disc (0.2666 at 1 au), percentage-closer"
    )
    lit.add_argument("--light-size", type=int, metavar="PX", help="sides of the Sun's picture")
    lit.add_argument("--shadow-gradients", action="store_true", help="of shadow splatting move the Gaussians, too")
    lit.add_argument("--no-refinement", action="store_true", help="raw shadows, without the network")
    lit.add_argument(
        "--visibility-weight", type=float, metavar="W", help="learn shadows from path-traced visibility, too (0)"
    )

    one = command("eval", "judge a run, or a scene of several: EVAL/metrics.json, EVAL/report.html, EVAL/frames")
    one.add_argument("path", type=Path, metavar="RUN|SCENE.toml")
    one.add_argument("--data", type=Path, required=True, metavar="DATA")
    one.add_argument("--out", type=Path, required=True, metavar="EVAL")
    one.add_argument("--split", default="test", help="test (default), train or all")
    one.add_argument(
        "--lpips-weights", type=Path, metavar="PATH", help="AlexNet and linear weights for LPIPS, a file or a folder"
    )
    one.add_argument("--no-geometry", action="store_true", help="do not judge the shape (docs/geometry.md)")
    one.add_argument("--json", action="store_true", help="print metrics.json alone")

    one = command("report", "one page about several evaluations side by side", needs_backend=False)
    one.add_argument("evals", type=Path, nargs="+", metavar="EVAL")
    one.add_argument("--out", type=Path, required=True, metavar="FILE.html")

    one = command("render", "one picture of a run")
    one.add_argument("path", type=Path, metavar="RUN")
    one.add_argument("--out", type=Path, required=True, metavar="FILE.png|.exr")
    _add_view(one)
    one.add_argument("--sun", type=_angles, metavar="AZ,EL", help="degrees; a vanilla run knows one light only")
    one.add_argument("--kind", choices=KINDS, default="rgb")
    one.add_argument("--exposure", type=float, metavar="EV", help="of a run of --linear (that of its pictures)")

    one = command("sweep", "the Sun goes round a run: a contact sheet and a video")
    one.add_argument("path", type=Path, metavar="RUN")
    one.add_argument("--out", type=Path, required=True, metavar="DIR")
    _add_view(one)
    path = one.add_mutually_exclusive_group()
    path.add_argument("--elevation", type=float, metavar="DEG", help="the Sun goes round at this elevation (30)")
    path.add_argument("--azimuth", type=float, metavar="DEG", help="the Sun rises at this azimuth and goes overhead")
    one.add_argument("--frames", type=int, metavar="N", help="Suns, evenly around the circle (72)")
    one.add_argument("--kind", choices=("rgb", "shadow"), default="rgb")
    one.add_argument("--exposure", type=float, metavar="EV", help="of a run of --linear (that of its pictures)")
    one.add_argument("--size", type=_resolution, metavar="PX", help="pixels of the longer side, or WIDTHxHEIGHT")
    one.add_argument("--keep-frames", action="store_true", help="write every picture into DIR/frames, too")

    one = command("view", "look at a run or a composed scene in the browser")
    one.add_argument("path", type=Path, metavar="RUN|SCENE.toml")
    one.add_argument("--data", type=Path, metavar="DATA", help="whose cameras and truth (of a run: its own)")
    one.add_argument("--host", default="127.0.0.1", metavar="ADDRESS", help="to listen at (this machine alone)")
    one.add_argument("--port", type=int, default=8080, metavar="N", help="to listen at, or the next free one (8080)")
    one.add_argument("--out", type=Path, metavar="DIR", help="where scenes are saved (the working directory)")

    one = command("compose", "several runs in one scene: pictures, depth, object numbers, shadows, a video")
    one.add_argument("scene", type=Path, metavar="SCENE.toml", help="runs, poses, Sun, camera: docs/composition.md")
    one.add_argument("--out", type=Path, required=True, metavar="DIR")
    one.add_argument("--size", type=_resolution, metavar="PX", help="pixels of the longer side, or WIDTHxHEIGHT")
    one.add_argument("--exposure", type=float, metavar="EV", help="of runs of --linear (that of their pictures)")
    one.add_argument("--ply", type=Path, metavar="FILE", help="write the scene as plain Gaussians, too")
    one.add_argument("--resume", action="store_true", help="go on where an earlier call stopped: it does so anyway")

    one = command("verify", "whether every file of a dataset is there and can be read", needs_backend=False)
    one.add_argument("data", type=Path, metavar="DATA")

    one = command("export", "a run or a dataset as files for other tools", needs_backend=False)
    one.add_argument("path", type=Path, metavar="RUN|DATA")
    one.add_argument("--backend", choices=backend.NAMES, default="auto", help="default: CUDA, else LLVM")
    form = one.add_mutually_exclusive_group(required=True)
    form.add_argument("--ply", type=Path, metavar="FILE", help="Gaussians: INRIA layout, the dataset's frame and scale")
    form.add_argument("--mesh", type=Path, metavar="FILE", help="the surface of a run: .ply, .obj, .glb or .stl")
    form.add_argument("--speedplus", type=Path, metavar="DIR", help="a dataset's images and poses as SPEED+ has them")
    form.add_argument("--bop", type=Path, metavar="DIR", help="a dataset's images, depth, masks, poses, models for BOP")
    one.add_argument("--sun", type=_angles, metavar="AZ,EL", help="for --ply of a relightable run: whose colours")
    one.add_argument("--object", metavar="K", help="for SPEED+: whose poses, by number or name (the first)")
    one.add_argument("--data", type=Path, metavar="DATA", help="for --mesh: the dataset, where it has moved")
    one.add_argument("--views", type=int, metavar="N", help="for --mesh: how many are fused, at most (64)")
    one.add_argument("--voxel", type=float, metavar="M", help="for --mesh: metres (1/192 of the object's size)")
    one.add_argument("--truncation", type=float, metavar="N", help="for --mesh: voxels behind the surface (2)")
    return parser


def _add_view(one: _Parser) -> None:
    """The options that say from where a run is seen."""
    where = one.add_mutually_exclusive_group()
    where.add_argument("--camera", type=Path, metavar="FILE", help="JSON with transform_matrix, w, h, fl_x, ...")
    where.add_argument("--frame", type=int, metavar="K", help="frame K of the dataset, training frames first (0)")
    one.add_argument("--data", type=Path, metavar="DATA", help="the dataset, where it has moved since training")


def _angles(text: str) -> tuple[float, float]:
    try:
        azimuth, elevation = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected AZ,EL in degrees, found {text!r}") from None
    if not (math.isfinite(azimuth) and -90 <= elevation <= 90):
        raise argparse.ArgumentTypeError(f"expected a finite azimuth and an elevation up to 90, found {text!r}")
    return azimuth, elevation


def _resolution(text: str) -> int | tuple[int, int]:
    sides = text.lower().split("x")
    if not all(side.isascii() and side.lstrip("-").isdigit() for side in sides) or len(sides) > 2:
        raise argparse.ArgumentTypeError(f"expected pixels of each side, or WIDTHxHEIGHT, found {text!r}")
    return (int(sides[0]), int(sides[1])) if len(sides) == 2 else int(sides[0])


def _built_in_scenes() -> list[str]:
    """Names, for the help: to import the scenes would take seconds."""
    return sorted(path.stem for path in Path(__file__).parent.glob("assets/scenes/*.toml"))


def with_light(config: "TrainConfig", options: argparse.Namespace) -> "TrainConfig":
    """`config` with what the options say of fields and shadows. Raises InputError where the method has none of them."""
    names = (
        "field",
        "bounce",
        "linear",
        "tone",
        "exposure",
        "shadow_bias",
        "grazing",
        "shadow_filter",
        "sun_radius",
        "light_size",
        "shadow_gradients",
        "no_refinement",
    )
    named = [name for name in names if getattr(options, name) is not None and getattr(options, name) is not False]
    if not named:
        return config
    from spacesim.splat.train.config import with_field

    light = config.light
    of_shadows = [name for name in named if name not in ("field", "bounce", "linear", "tone", "exposure")]
    if light is None or (light.shadow is None and of_shadows):
        option, what = (named[0], "that learns light") if light is None else (of_shadows[0], "with shadows")
        raise InputError(f"--{option.replace('_', '-')}: expected a method {what}, found {config.method}")
    if options.linear or options.tone is not None or options.exposure is not None:
        light = replace(light, linear=options.linear, tone=options.tone, exposure=options.exposure)
    if options.field is not None:
        bounce = light.bounce if options.field == "surface" else 0
        light = replace(light, field=with_field(light.field, options.field), bounce=bounce)
    if options.bounce is not None:
        light = replace(light, bounce=options.bounce)
    shadow = light.shadow
    if shadow is not None:
        given = {"bias": options.shadow_bias, "grazing": options.grazing, "size": options.light_size}
        shadow = replace(shadow, **{name: value for name, value in given.items() if value is not None})
        if options.shadow_filter is not None:
            if shadow.method != "mapping":
                raise InputError(f"--shadow-filter: expected --method shadow-map, found {config.method}")
            shadow = replace(shadow, mapping=replace(shadow.mapping, filter=options.shadow_filter))
        if options.sun_radius is not None:
            if shadow.mapping.filter != "percentage-closer":
                raise InputError(
                    f"--sun-radius: expected --shadow-filter percentage-closer, found {shadow.mapping.filter}"
                )
            shadow = replace(shadow, mapping=replace(shadow.mapping, sun_radius_deg=options.sun_radius))
        shadow = replace(shadow, gradients=True) if options.shadow_gradients else shadow
        shadow = replace(shadow, refine=None) if options.no_refinement else shadow
    return replace(config, light=replace(light, shadow=shadow))
