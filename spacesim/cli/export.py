"""`spacesim export`."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from spacesim import backend, interrupts
from spacesim.cli.parser import Parser, angles
from spacesim.cli.printing import KNOWS_ONE_LIGHT, WANTS_FILTER
from spacesim.data.errors import InputError, WorkError

SUMMARY, NEEDS_BACKEND = "a run or a dataset as files for other tools", False
LABELS = "speedplus", "bop", "coco", "yolo", "webdataset"  #: forms of a dataset


def add_options(parser: Parser, arguments: Sequence[str]) -> None:
    parser.add_argument("path", type=Path, metavar="RUN|DATA")
    parser.add_argument("--backend", choices=backend.NAMES, default="auto", help="default: CUDA, else LLVM")
    form = parser.add_mutually_exclusive_group(required=True)
    form.add_argument("--ply", type=Path, metavar="FILE", help="Gaussians: INRIA layout, the dataset's frame and scale")
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
    parser.add_argument("--sun", type=angles, metavar="AZ,EL", help="for --ply of a relightable run: whose colours")
    parser.add_argument("--object", metavar="K", help="for SPEED+: whose poses, by number or name (the first)")
    parser.add_argument("--data", type=Path, metavar="DATA", help="for --mesh: the dataset, where it has moved")
    parser.add_argument("--views", type=int, metavar="N", help="for --mesh: how many are fused, at most (64)")
    parser.add_argument("--voxel", type=float, metavar="M", help="for --mesh: metres (1/192 of the object's size)")
    parser.add_argument("--truncation", type=float, metavar="N", help="for --mesh: voxels behind the surface (2)")


def run(options: argparse.Namespace) -> None:
    if options.object is not None and options.speedplus is None:
        raise InputError("object: expected with --speedplus, found without it")
    if options.sun is not None and options.ply is None:
        raise InputError("sun: expected with --ply, found without it")
    labels = next((name for name in LABELS if getattr(options, name) is not None), None)
    if options.keypoints is not None and labels is None:
        raise InputError(f"keypoints: expected with --{', --'.join(LABELS)}, found without one")
    for name in ("data", "views", "voxel", "truncation"):
        if getattr(options, name) is not None and options.mesh is None:
            raise InputError(f"{name}: expected with --mesh, found without it")
    if labels is not None:
        _export_labels(options, labels)
    elif options.mesh is not None:
        _export_mesh(options)
    elif options.html is not None:
        _export_html(options)
    else:
        _export_ply(options)


def _export_ply(options: argparse.Namespace) -> None:
    from spacesim.data.records import Sun
    from spacesim.methods import load_run
    from spacesim.splat.export.bake import bake
    from spacesim.splat.export.ply import write_ply

    backend.select(options.backend)
    run = load_run(options.path).gaussian_run
    if run is None:
        raise InputError(f"ply: expected a run of Gaussians, found {options.path}, a radiance field; --mesh takes it")
    model = run.gaussians
    if options.sun is None and run.relightable:
        raise InputError("sun: expected AZ,EL, under which a relightable run is to be exported, found none")
    if options.sun is not None and not run.relightable:
        print(KNOWS_ONE_LIGHT, file=sys.stderr)
    if run.light is not None:
        model = bake(model, run.light, Sun.from_angles(*options.sun).direction if options.sun else None)
    write_ply(model, options.ply)
    if run.antialiased:
        print(WANTS_FILTER, file=sys.stderr)
    interrupts.print_output(f"{options.ply}: {run.gaussian_count} Gaussians")


def _export_mesh(options: argparse.Namespace) -> None:
    from spacesim.data.mesh import mesh_suffix, write_mesh
    from spacesim.data.store import read_dataset
    from spacesim.methods import load_run
    from spacesim.nerf.run import NerfRun
    from spacesim.progress import show_progress
    from spacesim.splat.export.mesh import MeshConfig, cameras_around, mesh_of, mesh_of_depths

    mesh_suffix(options.mesh)
    settings = {"voxel": options.voxel, "truncation": options.truncation, "views": options.views}
    config = MeshConfig(**{name: value for name, value in settings.items() if value is not None})
    backend.select(options.backend)
    run = load_run(options.path)
    data = options.data or Path(run.config["data"]["path"])
    if options.data or data.exists():
        cameras = [frame.camera for frame in read_dataset(data).train]
    elif isinstance(run, NerfRun):
        raise InputError(f"{data}: expected the data that the run was trained on, found nothing; name it with --data")
    else:
        print(f"{data}: is gone; {config.views} cameras around the model take the place of its views", file=sys.stderr)
        cameras = cameras_around(run.gaussians, config.views)
    with show_progress("export", "steps") as report:
        if isinstance(run, NerfRun):
            surface = mesh_of_depths(run.surface_depth, cameras, config, report)
        else:
            surface = mesh_of(run.gaussians, cameras, config, run.antialiased, report)
    if len(surface.faces) == 0:
        raise WorkError(f"{options.path}: no view of the run shows an opaque surface, so there is no mesh to write")
    write_mesh(options.mesh, surface.vertices, surface.faces)
    interrupts.print_output(
        f"{options.mesh}: {len(surface.faces)} faces from {surface.views} views, voxels of {surface.voxel:.4g} m"
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
        write_page(run, options.html, report)
    size = options.html.stat().st_size / 1e6
    interrupts.print_output(f"{options.html}: {run.gaussian_count} Gaussians, {size:.1f} MB")


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
    """How many, or the file that tells them."""
    if text is None:
        return None
    try:
        return int(text)
    except ValueError:
        return Path(text)
