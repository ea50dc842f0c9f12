"""`spacesim export`."""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from spacesim import backend, interrupts
from spacesim.cli.parser import Parser, angles, angles_or_none
from spacesim.cli.printing import KNOWS_ONE_LIGHT, NO_EARTH, RELATIVE, WANTS_FILTER
from spacesim.data.errors import InputError, WorkError
from spacesim.data.integrity.outputs import check_output

if TYPE_CHECKING:
    from spacesim.data.earth import Earth
    from spacesim.learning.lights import CanPredict
    from spacesim.splat.export.splats import Form

SUMMARY, NEEDS_BACKEND = "a run or a dataset as files for other tools", False
SPLATS: "tuple[Form, ...]" = ("ply", "glb", "spz", "usd")  #: forms of a run's Gaussians
LABELS = "speedplus", "bop", "coco", "yolo", "webdataset"  #: forms of a dataset


def add_options(parser: Parser, arguments: Sequence[str]) -> None:
    parser.add_argument("path", type=Path, metavar="RUN|DATA")
    parser.add_argument("--backend", choices=backend.NAMES, default="auto", help="default: CUDA, else LLVM")
    form = parser.add_mutually_exclusive_group(required=True)
    form.add_argument("--ply", type=Path, metavar="FILE", help="Gaussians: INRIA layout, the dataset's frame and scale")
    form.add_argument("--glb", type=Path, metavar="FILE", help="Gaussians: glTF with KHR_gaussian_splatting")
    form.add_argument("--spz", type=Path, metavar="FILE", help="Gaussians: SPZ, a sixth of the size")
    form.add_argument("--usd", type=Path, metavar="FILE", help="Gaussians: OpenUSD text, .usda")
    form.add_argument("--mesh", type=Path, metavar="FILE", help="the surface of a run: .ply, .obj, .glb or .stl")
    form.add_argument(
        "--html", type=Path, metavar="FILE", help="a run as one page for any browser: orbit, drag the Sun"
    )
    form.add_argument("--speedplus", type=Path, metavar="DIR", help="a dataset's images and poses as SPEED+ has them")
    form.add_argument("--bop", type=Path, metavar="DIR", help="a dataset's images, depth, masks, poses, models for BOP")
    form.add_argument(
        "--coco", type=Path, metavar="DIR", help="a dataset's masks, boxes and keypoints as COCO has them"
    )
    form.add_argument("--yolo", type=Path, metavar="DIR", help="the same for Ultralytics: detect, segment and pose")
    form.add_argument("--webdataset", type=Path, metavar="DIR", help="a dataset with its labels as shards")
    parser.add_argument(
        "--keypoints", metavar="N|FILE", help="for a dataset: how many are found (11), or which they are"
    )
    parser.add_argument(
        "--sun",
        type=angles,
        metavar="AZ,EL",
        help="for a relightable run: whose colours Gaussians or --mesh have (--mesh: albedo)",
    )
    of_earth = "with --sun and for --html: where the Earth is, for a run that has learned its light (none)"
    parser.add_argument("--earth", type=angles_or_none, metavar="AZ,EL|none", help=of_earth)
    parser.add_argument(
        "--up", metavar="z|y|-y", help="the file's axis that the dataset's +z becomes (y in glTF and SPZ)"
    )
    parser.add_argument(
        "--scale", type=float, metavar="N", help="for Gaussians and --mesh: units of the file a metre (1)"
    )
    parser.add_argument(
        "--recentre", action="store_true", help="for Gaussians and --mesh: put the middle at the origin"
    )
    parser.add_argument("--spz-version", type=int, choices=(3, 4), help="3 (default), or 4, which fewer programs read")
    parser.add_argument("--object", metavar="K", help="for SPEED+: whose poses, by number or name (the first)")
    parser.add_argument("--data", type=Path, metavar="DATA", help="for --mesh: the dataset, where it has moved")
    parser.add_argument("--views", type=int, metavar="N", help="for --mesh: how many are fused, at most (64)")
    parser.add_argument("--voxel", type=float, metavar="M", help="for --mesh: metres (1/192 of the object's size)")
    parser.add_argument("--truncation", type=float, metavar="N", help="for --mesh: voxels behind the surface (2)")


def run(options: argparse.Namespace) -> None:
    if options.object is not None and options.speedplus is None:
        raise InputError("object: expected with --speedplus, found without it")
    splats = next((form for form in SPLATS if getattr(options, form) is not None), None)
    if splats is None and options.mesh is None:
        for name, given in (("sun", options.sun), ("up", options.up), ("scale", options.scale)):
            _check_absent(name, given, (*SPLATS, "mesh"))
        _check_absent("recentre", options.recentre or None, (*SPLATS, "mesh"))
    if options.html is None and options.sun is None:
        _check_absent("earth", options.earth, ("sun", "html"))
    if splats != "spz":
        _check_absent("spz_version", options.spz_version, ("spz",))
    labels = next((name for name in LABELS if getattr(options, name) is not None), None)
    if labels is None:
        _check_absent("keypoints", options.keypoints, LABELS)
    if options.mesh is None:
        for name in ("data", "views", "voxel", "truncation"):
            _check_absent(name, getattr(options, name), ("mesh",))
    for name in (*SPLATS, "mesh", "html"):
        if getattr(options, name) is not None:
            check_output(getattr(options, name), name)
    if labels is not None:
        _export_labels(options, labels)
    elif options.mesh is not None:
        _export_mesh(options)
    elif options.html is not None:
        _export_html(options)
    elif splats is not None:
        _export_splats(options, splats)


def _check_absent(name: str, value: object, forms: Sequence[str]) -> None:
    """An option of other forms."""
    if value is not None:
        found = "it" if len(forms) == 1 else "one"
        raise InputError(f"{name}: expected with --{', --'.join(forms)}, found without {found}")


def _export_splats(options: argparse.Namespace, form: "Form") -> None:
    from spacesim.data.records import Sun
    from spacesim.methods import load_run
    from spacesim.splat.export.bake import bake
    from spacesim.splat.export.frame import FileFrame
    from spacesim.splat.export.splats import Y_UP, write_splats

    out: Path = getattr(options, form)
    frame = FileFrame(options.up or ("y" if form in Y_UP else "z"), _scale(options), options.recentre)
    backend.select(options.backend)
    run = load_run(options.path).gaussian_run
    if run is None:
        raise InputError(
            f"{form}: expected a run of Gaussians, found {options.path}, a radiance field; --mesh takes it"
        )
    model = run.gaussians
    if options.sun is None and run.relightable:
        raise InputError("sun: expected AZ,EL, under which a relightable run is to be exported, found none")
    if options.sun is not None and not run.relightable:
        print(KNOWS_ONE_LIGHT, file=sys.stderr)
    if run.light is not None:
        sun = Sun.from_angles(*options.sun).direction if options.sun else None
        model = bake(model, run.light, sun, earth=_earth(options, run))
    write_splats(model, out, form, frame, run.antialiased, options.spz_version or 3)
    if run.antialiased and form != "spz":  # which records it
        print(WANTS_FILTER, file=sys.stderr)
    interrupts.print_output(f"{out}: {run.gaussian_count} Gaussians")


def _scale(options: argparse.Namespace) -> float:
    return 1.0 if options.scale is None else float(options.scale)


def _export_mesh(options: argparse.Namespace) -> None:
    from spacesim.data.mesh import VertexSurface, write_mesh
    from spacesim.data.records import Sun
    from spacesim.data.store import read_dataset
    from spacesim.methods import load_run
    from spacesim.nerf.run import NerfRun
    from spacesim.progress import show_progress
    from spacesim.splat.export.colors import color_of_material, color_vertices
    from spacesim.splat.export.frame import FileFrame
    from spacesim.splat.export.mesh import MeshConfig, cameras_around, depth_of, mesh_of_depths

    holds_colors = options.mesh.suffix.lower() != ".stl"
    if options.sun is not None and not holds_colors:
        raise InputError(f"sun: expected a .glb, .obj or .ply, which hold colours, found {options.mesh}")
    frame = FileFrame(options.up or "z", _scale(options), options.recentre)
    settings = {"voxel": options.voxel, "truncation": options.truncation, "views": options.views}
    config = MeshConfig(**{name: value for name, value in settings.items() if value is not None})
    backend.select(options.backend)
    run = load_run(options.path)
    lit = run.gaussian_run
    data = options.data or Path(run.config["data"]["path"])
    if options.data or data.exists():
        cameras = [frame.camera for frame in read_dataset(data).train]
    elif isinstance(run, NerfRun):
        raise InputError(f"{data}: expected the data that the run was trained on, found nothing; name it with --data")
    else:
        print(f"{data}: is gone; {config.views} cameras around the model take the place of its views", file=sys.stderr)
        cameras = cameras_around(run.gaussians, config.views)
    if isinstance(run, NerfRun):
        depth = run.surface_depth
    else:
        depth = partial(depth_of, run.gaussians, antialiased=run.antialiased)
    with show_progress("export", "steps") as report:
        surface = mesh_of_depths(depth, cameras, config, report)
    if len(surface.faces) == 0:
        raise WorkError(f"{options.path}: no view of the run shows an opaque surface, so there is no mesh to write")
    sun = replace(Sun.from_angles(*options.sun), earth=_earth(options, run)) if options.sun else None
    colors, material = None, None
    if sun is not None and not run.relightable:
        print(KNOWS_ONE_LIGHT, file=sys.stderr)
    words = "; colours need --sun" if holds_colors else ""
    if holds_colors and (sun is not None or not run.relightable):
        with show_progress("export", "pictures") as report:
            colors = color_vertices(surface, cameras, depth, partial(run.predict, sun=sun), config.views, report)
        words = ", coloured"
    elif holds_colors and lit and lit.has_material:
        if lit.albedo_is_relative:
            print(RELATIVE, file=sys.stderr)
        with show_progress("export", "pictures") as report:
            values = color_vertices(
                surface,
                cameras,
                depth,
                lambda camera: color_of_material(run.draw_material(camera)),
                config.views,
                report,
                channels=5,
            )
        colors, material, words = values[:, :3], VertexSurface(values[:, 3], values[:, 4]), ", with albedo"
    write_mesh(options.mesh, frame.sized(surface.vertices), surface.faces, colors, options.up, material)
    interrupts.print_output(
        f"{options.mesh}: {len(surface.faces)} faces from {surface.views} views, voxels of {surface.voxel:.4g} m{words}"
    )


def _export_html(options: argparse.Namespace) -> None:
    from spacesim.methods import load_run
    from spacesim.progress import show_progress
    from spacesim.splat.export.html.page import write_page

    if options.path.suffix == ".toml":
        raise InputError(f"html: expected a run, found {options.path}, a scene: its runs can be exported one by one")
    backend.select(options.backend)
    run = load_run(options.path).gaussian_run
    if run is None:
        raise InputError(f"html: expected a run of Gaussians, found {options.path}, a radiance field")
    with show_progress("export", "steps") as report:
        write_page(run, options.html, report, _earth(options, run))
    size = options.html.stat().st_size / 1e6
    interrupts.print_output(f"{options.html}: {run.gaussian_count} Gaussians, {size:.1f} MB")


def _earth(options: argparse.Namespace, run: "CanPredict") -> "Earth | None":
    """That `--earth` names; where a run has learned its light and nothing is said, a sentence that it is left out."""
    from spacesim.learning.lights import named_earth

    if run.knows_earth and options.earth is None:
        print(NO_EARTH, file=sys.stderr)
    return named_earth(run, options.earth)


def _export_labels(options: argparse.Namespace, kind: str) -> None:
    from spacesim.data import exporters
    from spacesim.data.store import read_dataset
    from spacesim.progress import show_progress

    out, dataset = getattr(options, kind), read_dataset(options.path)
    keypoints = _keypoints(options.keypoints)
    with show_progress("export", "frames") as report:
        if kind == "speedplus":
            words = f"the pose of {exporters.write_speedplus(dataset, out, options.object, keypoints, report).name}"
        elif kind == "bop":
            from spacesim.scenes.silhouette import silhouette_finder

            backend.select(options.backend)
            targets = exporters.write_bop(dataset, out, silhouette_finder, keypoints, report)
            words = f"the poses of {', '.join(target.name for target in targets)}"
        elif kind == "webdataset":
            words = f"their labels in {exporters.write_webdataset(dataset, out, keypoints, report)} shards"
        else:
            write = exporters.write_coco if kind == "coco" else exporters.write_yolo
            words = f"{write(dataset, out, keypoints, report)} instances"
    interrupts.print_output(f"{out}: {len(dataset.frames)} images with {words}")


def _keypoints(text: str | None) -> int | Path | None:
    """How many, or the file that defines them."""
    if text is None:
        return None
    try:
        return int(text)
    except ValueError:
        return Path(text)
