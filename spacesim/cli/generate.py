"""`spacesim generate`."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from spacesim import backend, interrupts
from spacesim.backend.memory import keep_freed_memory
from spacesim.cli.parser import Parser, angles, frame_range, resolution
from spacesim.data.errors import InputError

SUMMARY, NEEDS_BACKEND = "path-trace a dataset with its truth", False
_SCENE_OPTIONS = (
    "suns",
    "views",
    "test_suns",
    "test_views",
    "known_test_views",
    "shared_test_views",
    "sun",
    "distance",
    "resolution",
    "exposure",
    "spp",
    "test_spp",
    "seed",
    "units",
    "up",
    "background",
    "trajectory",
    "min_sunlit",
)


def add_options(parser: Parser, arguments: Sequence[str]) -> None:
    scenes = f"a built-in scene ({', '.join(_built_in_scenes())}), a scene file (.toml) or a mesh file"
    parser.add_argument("scene", metavar="SCENE", help=scenes)
    parser.add_argument("--out", type=Path, metavar="DATA")
    parser.add_argument("--backend", choices=backend.NAMES, default="auto", help="default: CUDA, else LLVM")
    parser.add_argument("--suns", type=int, metavar="N", help="training Suns")
    parser.add_argument("--views", type=int, metavar="N", help="training views for each Sun")
    parser.add_argument("--test-suns", type=int, metavar="N", help="Suns kept for testing (0: those of training)")
    parser.add_argument("--test-views", type=int, metavar="N", help="test views for each test Sun")
    parser.add_argument(
        "--known-test-views", type=int, metavar="N", help="test views for each training Sun beside them"
    )
    parser.add_argument(
        "--shared-test-views", action="store_true", default=None, help="the same test cameras under every Sun"
    )
    parser.add_argument(
        "--sun", type=angles, action="append", metavar="AZ,EL", help="a training Sun, degrees; repeatable"
    )
    parser.add_argument("--trajectory", metavar="FILE", help="follow a table: .csv, .json or .parquet")
    parser.add_argument(
        "--min-sunlit", type=float, metavar="SHARE", help="leave out frames that show less of the object in sunlight"
    )
    parser.add_argument("--distance", type=float, metavar="M", help="metres from the cameras to the target's centre")
    parser.add_argument("--resolution", type=resolution, metavar="PX", help="pixels of each side, or WIDTHxHEIGHT")
    parser.add_argument("--fov", type=float, metavar="DEG", help="angle that the image's width covers")
    parser.add_argument("--exposure", type=float, metavar="X", help="display value of a radiance of 1 W/m2/sr")
    parser.add_argument("--background", metavar="WHAT", help="draw earth, stars or earth,stars behind the objects")
    parser.add_argument("--spp", type=int, metavar="N", help="samples a pixel")
    parser.add_argument("--test-spp", type=int, metavar="N", help="of test views (four times as many)")
    parser.add_argument("--seed", type=int, metavar="N")
    parser.add_argument("--units", metavar="UNIT", help="of a mesh file: m (default), cm, mm, km, in or ft")
    parser.add_argument("--up", metavar="AXIS", help="of a mesh file: x, y or z (default: the format's own)")
    parser.add_argument(
        "--frames", type=frame_range, metavar="A:B", help="make these frames alone; --resume completes the dataset"
    )
    parser.add_argument(
        "--resume", action="store_true", help="complete what the same command left when it was interrupted"
    )
    many = parser.add_mutually_exclusive_group()
    many.add_argument("--workers", type=int, default=1, metavar="N", help="processes that render (1)")
    many.add_argument(
        "--ray", metavar="ADDRESS", help="render on a Ray cluster: auto, HOST:PORT, or local to start one"
    )
    parser.add_argument("--estimate", action="store_true", help="render a few frames, show time and disk, keep nothing")
    parser.add_argument("--print", action="store_true", help="render nothing, print the whole scene as a scene file")


def option_of(field: str, options: argparse.Namespace) -> str | None:
    """The option that sets a field of the scene."""
    return "--fov" if field == "fov_deg" else None


def run(options: argparse.Namespace) -> None:
    from spacesim.progress import show_progress
    from spacesim.scenes.generation.generate import estimate, generate, generate_part
    from spacesim.scenes.scenefile import read_scene, scene_text

    changes = {name: getattr(options, name) for name in _SCENE_OPTIONS}
    scene = read_scene(options.scene, **changes, fov_deg=options.fov)
    if options.print:
        interrupts.print_output(scene_text(scene), end="")
        return
    if options.estimate:
        backend.select(options.backend)
        interrupts.print_output(estimate(scene, options.out or Path()))
        return
    if options.out is None:
        raise InputError("out: expected a folder for the dataset, found none")
    backend.select(options.backend)
    keep_freed_memory()
    with show_progress("generate", "frames") as report:
        if options.frames is not None:
            part = generate_part(scene, options.out, options.frames, report, options.workers, options.ray)
            made, count, complete = part
            first = options.frames[0]
            then = "the dataset is complete" if complete else "--resume completes the dataset"
            interrupts.print_output(f"{options.out}: frames {first}:{first + made} of all {count} are made; {then}")
            return
        dataset = generate(scene, options.out, options.resume, report, options.workers, options.ray)
    interrupts.print_output(
        f"{options.out}: {len(dataset.train)} training and {len(dataset.test)} test frames of {scene.name}"
    )


def _built_in_scenes() -> list[str]:
    """Names, for the help: to import the scenes would take seconds."""
    return sorted(path.stem for path in Path(__file__).parents[1].glob("assets/scenes/*.toml"))
