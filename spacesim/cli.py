"""The command line: parse, call one function, print. Exit codes: 0 done, 1 the work failed, 2 bad usage or input."""

from spacesim import ending  # first: from here on Ctrl-C is told in a sentence

# isort: split

import argparse
import errno
import json
import logging
import sys
import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from spacesim import backend
from spacesim.data.errors import InputError, WorkError
from spacesim.options import parser, with_light

if TYPE_CHECKING:
    from spacesim.data.records import Camera, Sun
    from spacesim.splat.run import Run

KNOWS_ONE_LIGHT = "a vanilla run knows the light that it was trained under only; --sun changes nothing"
_OF_PATHS = (
    *(errno.ENOENT, errno.EACCES, errno.EPERM, errno.EROFS, errno.ENAMETOOLONG, errno.ENOTDIR, errno.EISDIR),
    *(errno.ELOOP, errno.EEXIST, errno.EILSEQ),
)
"""Errors that speak of the path that the user named, not of the work."""
WANTS_FILTER = "the run is --antialiased: viewers without Mip-Splatting's 2D filter draw thin splats wider"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    try:
        with ending.working():
            _run(sys.argv[1:] if arguments is None else arguments)
    except (InputError, WorkError, backend.BackendError) as error:
        ending.tell(str(error))
        return 2 if isinstance(error, InputError) else 1
    except MemoryError as error:
        ending.tell(f"the memory is short ({error})")
        return 1
    except BrokenPipeError:
        return 1
    except (KeyboardInterrupt, Exception) as error:
        if ending.is_interrupt(error):
            ending.tell(ending.stopped())
            return ending.exit_code()
        logging.getLogger("spacesim").debug("traceback", exc_info=error)
        if isinstance(error, OSError) and error.filename is not None and error.errno in _OF_PATHS:
            ending.tell(f"{error.filename}: cannot be read or written ({error.strerror})")
            return 2
        if not isinstance(error, RuntimeError | OSError):
            raise
        reason = " ".join(str(error).split())
        ending.tell(f"the computation failed ({reason}); --debug shows where")
        return 1
    return 0


def _run(arguments: Sequence[str]) -> None:
    ending.speak_any_name()
    logging.basicConfig(format="%(message)s", level=logging.INFO, stream=sys.stderr)
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # its tracebacks: what matters of them is told
    options = parser(_COMMANDS).parse_args(arguments)
    if not options.debug:
        warnings.simplefilter("ignore")  # of libraries, about numbers that are told in sentences where they matter
    options.command = ("spacesim", *arguments)
    ending.resumed_by("--resume" if hasattr(options, "resume") else "")
    if options.debug:
        logging.getLogger("spacesim").setLevel(logging.DEBUG)
    if options.needs_backend:
        backend.select(options.backend)
    options.run(options)


def _doctor(options: argparse.Namespace) -> None:
    from spacesim import doctor

    findings = doctor.report()
    ending.say(json.dumps(findings, indent=1) if options.json else doctor.describe(findings))


def _demo(options: argparse.Namespace) -> None:
    from spacesim.demo import demo
    from spacesim.progress import reporting

    ending.resumed_by("the same command")
    done = demo(options.out, reporting)
    _print_headline(done["metrics"])
    parts = ", ".join(f"{part} {seconds:.0f} s" for part, seconds in done["seconds"].items())
    ending.say(f"{parts}\nreport: {done['report'].resolve()}")


_SCENE_OPTIONS = (
    *("suns", "views", "test_suns", "test_views", "known_test_views", "shared_test_views", "sun", "distance"),
    *("resolution", "exposure", "spp", "test_spp", "seed", "units", "up"),
)


def _generate(options: argparse.Namespace) -> None:
    from spacesim.progress import reporting
    from spacesim.scenes import generate, read_scene
    from spacesim.scenes.generation.generate import estimate
    from spacesim.scenes.scenefile import scene_text

    changes = {name: getattr(options, name) for name in _SCENE_OPTIONS}
    scene = read_scene(options.scene, **changes, fov_deg=options.fov)
    if options.print:
        ending.say(scene_text(scene), end="")
        return
    if options.estimate:
        backend.select(options.backend)
        ending.say(estimate(scene, options.out or Path()))
        return
    if options.out is None:
        raise InputError("--out: expected a folder for the dataset, found none")
    backend.select(options.backend)
    with reporting("generate", "frames") as report:
        dataset = generate(scene, options.out, options.resume, report, options.workers, options.ray)
    ending.say(f"{options.out}: {len(dataset.train)} training and {len(dataset.test)} test frames of {scene.name}")


def _train(options: argparse.Namespace) -> None:
    from spacesim.data.store import read_dataset
    from spacesim.progress import reporting, tell_training
    from spacesim.splat.train.config import preset, warm_start, with_options
    from spacesim.splat.train.train import train

    names = (
        *("init", "init_count", "init_box", "views_per_step", "iterations", "seed", "visibility_weight"),
        *("flatten_weight", "depth_weight", "normal_weight", "prior", "antialiased", "supersample"),
    )
    config = preset(options.preset, options.method, options.strategy)
    config = with_options(config, **{name: getattr(options, name) for name in names})
    if options.prior is not None and not config.shape_terms:
        expected = "--depth-weight or --normal-weight above 0, which say how much of it counts"
        raise InputError(f"--prior {options.prior}: expected {expected}, found neither")
    if options.black_background:
        config = with_options(config, random_background=False)
    if options.warm_start:
        config = with_options(config, warm_start=warm_start(options.preset))
    if options.prune_opacity is not None and config.strategy == "mcmc":
        raise InputError("--prune-opacity: expected a strategy that prunes, found mcmc, which moves what is faint")
    if options.split_screen_size is not None and config.strategy == "mcmc":
        raise InputError("--split-screen-size: expected a strategy that splits, found mcmc, which copies")
    bounds = "max_gaussians", "prune_opacity", "split_screen_size"
    told = {name: getattr(options, name) for name in bounds if getattr(options, name) is not None}
    config = replace(config, refinement=replace(config.refinement, **told))
    config = with_light(config, options)
    dataset = read_dataset(options.data)
    with reporting("train", "iterations") as report:
        run = train(dataset, options.out, config, options.resume, tell_training(report), options.command)
    history = run.training["history"]
    ending.say(
        f"{options.out}: {run.gaussians} Gaussians after {config.iterations} iterations in "
        f"{run.training['seconds']:.0f} s on {run.training['backend']}, final loss {history[-1]['loss']:.4f}"
    )


def _eval(options: argparse.Namespace) -> None:
    from spacesim.data.store import read_dataset
    from spacesim.eval.evaluate import EvaluateConfig, evaluate
    from spacesim.eval.report.write import write_report
    from spacesim.progress import reporting

    config = EvaluateConfig(options.split, options.lpips_weights)
    if options.no_geometry:
        config = replace(config, geometry=None)
    run, dataset = _judged(options.path), read_dataset(options.data)
    with reporting("evaluate", "frames", quiet=options.json) as report:
        metrics = evaluate(run, dataset, options.out, config, report)
    write_report([options.out], options.out / "report.html")
    if options.json:
        ending.say(json.dumps(metrics, indent=1))
    else:
        _print_headline(metrics)
        ending.say(f"report: {(options.out / 'report.html').resolve()}")


def _judged(path: Path) -> "Run":
    """A run, or a scene of several in the place of one."""
    from spacesim.splat.run import load_run

    if path.suffix != ".toml":
        return load_run(path)
    from spacesim.eval.composition import ComposedRun
    from spacesim.splat.compose.scenefile import load_scene

    return cast("Run", ComposedRun(load_scene(path).posed_at(0.0), path))


def _report(options: argparse.Namespace) -> None:
    from spacesim.eval.report.write import write_report

    write_report(options.evals, options.out)
    ending.say(f"report: {options.out.resolve()}")


def _render(options: argparse.Namespace) -> None:
    from spacesim.data.records import Sun
    from spacesim.splat.export.pictures import write_picture
    from spacesim.splat.run import load_run

    run = load_run(options.path)
    sun = Sun.from_angles(*options.sun) if options.sun else None
    if sun is not None and not run.relightable:
        print(KNOWS_ONE_LIGHT, file=sys.stderr)
    camera, sun_of_frame = _view_of(options, run.config)
    sun = sun or sun_of_frame
    if sun is None and run.relightable:
        raise InputError("--sun: expected AZ,EL for a run that can be relit and a camera without a Sun, found none")
    seen = run.predict(camera, sun, normals=options.kind == "normal", exposure=options.exposure)
    write_picture(seen, options.kind, options.out)
    ending.say(options.out)


def _sweep(options: argparse.Namespace) -> None:
    from spacesim.progress import reporting
    from spacesim.splat.export.sweep import FRAMES, resized, suns_around, sweep
    from spacesim.splat.run import load_run

    suns = suns_around(FRAMES if options.frames is None else options.frames, options.elevation, options.azimuth)
    run = load_run(options.path)
    camera, _ = _view_of(options, run.config)
    if options.size is not None:
        camera = resized(camera, options.size)
    with reporting("sweep", "frames") as report:
        done = sweep(run, camera, suns, options.out, options.kind, options.keep_frames, report, options.exposure)
    if done.note is not None:
        print(done.note, file=sys.stderr)
    ending.say(" ".join(str(path) for path in (done.sheet, done.video) if path is not None))


def _view_of(options: argparse.Namespace, config: dict[str, Any]) -> "tuple[Camera, Sun | None]":
    """The camera that --camera or --frame names, and the Sun of a frame."""
    from spacesim.data.transforms import read_camera, read_dataset

    if options.camera:
        return read_camera(options.camera), None
    frames = read_dataset(options.data or _data_of(config)).frames
    index = options.frame or 0
    if not 0 <= index < len(frames):
        raise InputError(f"--frame: expected 0 to {len(frames) - 1}, found {index}")
    return frames[index].camera, frames[index].sun


def _data_of(config: dict[str, Any]) -> Path:
    path = Path(config["data"]["path"])
    if not path.exists():
        raise InputError(f"{path}: expected the data that the run was trained on, found nothing; name it with --data")
    return path


def _view(options: argparse.Namespace) -> None:
    from spacesim.viewer.opened import opened
    from spacesim.viewer.server import serve

    serve(opened(options.path, options.data, options.out), options.host, options.port, ending.say)


def _compose(options: argparse.Namespace) -> None:
    from spacesim.progress import reporting
    from spacesim.splat.compose.output import compose
    from spacesim.splat.compose.plain import gathered
    from spacesim.splat.compose.scenefile import load_scene
    from spacesim.splat.export.ply import write_ply

    scene = load_scene(options.scene)
    with reporting("compose", "frames") as report:
        done = compose(scene, options.out, options.size, report, options.exposure)
    written = [done.sheet, done.video]
    if options.ply is not None:
        first = scene.shot(0)
        write_ply(gathered(first.composition, first.sun), options.ply)
        written.append(options.ply)
        for model in scene.composition.models:
            if model.run.antialiased:
                print(f"{model.name}: {WANTS_FILTER}", file=sys.stderr)
    if done.note is not None:
        print(done.note, file=sys.stderr)
    ending.say(" ".join(str(path) for path in written if path is not None))


def _verify(options: argparse.Namespace) -> None:
    from spacesim.data.manifest import NAME
    from spacesim.data.verify import has_digests, verify

    dataset, problems = verify(options.data)
    for problem in problems:
        print(problem, file=sys.stderr)
    if problems:
        raise WorkError(
            f"{options.data}: {len(problems)} faulty files; delete them, generate --resume makes them again"
        )
    ending.say(f"{options.data}: {len(dataset.frames)} frames, every file is there and whole")
    if not has_digests(dataset):
        print(f"no {NAME} lies beside them: a changed byte may go unseen", file=sys.stderr)


def _export(options: argparse.Namespace) -> None:
    if options.object is not None and options.speedplus is None:
        raise InputError("--object: expected with --speedplus, found without it")
    if options.sun is not None and options.ply is None:
        raise InputError("--sun: expected with --ply, found without it")
    for name in ("data", "views", "voxel", "truncation"):
        if getattr(options, name) is not None and options.mesh is None:
            raise InputError(f"--{name}: expected with --mesh, found without it")
    if options.speedplus is not None:
        _export_speedplus(options)
    elif options.bop is not None:
        _export_bop(options)
    elif options.mesh is not None:
        _export_mesh(options)
    else:
        _export_ply(options)


def _export_ply(options: argparse.Namespace) -> None:
    from spacesim.data.records import Sun
    from spacesim.splat.export.bake import baked
    from spacesim.splat.export.ply import write_ply
    from spacesim.splat.run import load_run

    backend.select(options.backend)
    run = load_run(options.path)
    model = run.model
    if run.light is not None:
        if options.sun is None:
            raise InputError("--sun: expected AZ,EL, under which a relightable run is to be exported, found none")
        model = baked(model, run.light, Sun.from_angles(*options.sun).direction)
    elif options.sun is not None:
        print(KNOWS_ONE_LIGHT, file=sys.stderr)
    write_ply(model, options.ply)
    if run.antialiased:
        print(WANTS_FILTER, file=sys.stderr)
    ending.say(f"{options.ply}: {run.gaussians} Gaussians")


def _export_mesh(options: argparse.Namespace) -> None:
    from spacesim.data.mesh import mesh_suffix, write_mesh
    from spacesim.data.store import read_dataset
    from spacesim.progress import reporting
    from spacesim.splat.export.mesh import MeshConfig, cameras_around, mesh_of
    from spacesim.splat.run import load_run

    mesh_suffix(options.mesh)
    given = {"voxel": options.voxel, "truncation": options.truncation, "views": options.views}
    config = MeshConfig(**{name: value for name, value in given.items() if value is not None})
    backend.select(options.backend)
    run = load_run(options.path)
    data = options.data or Path(run.config["data"]["path"])
    if options.data or data.exists():
        cameras = [frame.camera for frame in read_dataset(data).train]
    else:
        print(f"{data}: is gone; {config.views} cameras around the model take the place of its views", file=sys.stderr)
        cameras = cameras_around(run.model, config.views)
    with reporting("export", "steps") as report:
        found = mesh_of(run.model, cameras, config, run.antialiased, report)
    if len(found.faces) == 0:
        raise WorkError(f"{options.path}: no view of the run shows an opaque surface, so there is no mesh to write")
    write_mesh(options.mesh, found.vertices, found.faces)
    ending.say(f"{options.mesh}: {len(found.faces)} faces from {found.views} views, voxels of {found.voxel:.4g} m")


def _export_speedplus(options: argparse.Namespace) -> None:
    from spacesim.data.exporters import write_speedplus
    from spacesim.data.store import read_dataset
    from spacesim.progress import reporting

    dataset = read_dataset(options.path)
    with reporting("export", "frames") as report:
        target = write_speedplus(dataset, options.speedplus, options.object, report)
    ending.say(f"{options.speedplus}: {len(dataset.frames)} images with the pose of {target.name}")


def _export_bop(options: argparse.Namespace) -> None:
    from spacesim.data.exporters import write_bop
    from spacesim.data.store import read_dataset
    from spacesim.progress import reporting
    from spacesim.scenes.silhouette import outline

    backend.select(options.backend)
    dataset = read_dataset(options.path)
    with reporting("export", "frames") as report:
        targets = write_bop(dataset, options.bop, outline, report)
    ending.say(f"{options.bop}: {len(dataset.frames)} images with the poses of {', '.join(t.name for t in targets)}")


def _print_headline(metrics: dict[str, Any]) -> None:
    """PSNR, SSIM and shadow errors in a line each."""
    show = partial(_mean, metrics)
    ending.say(f"silhouette: PSNR {show('image', 'psnr', 2)} dB, SSIM {show('image', 'ssim', 4)}", end="")
    ending.say(f", FLIP {show('image', 'flip', 4)}; full frame: PSNR {show('image_full', 'psnr', 2)} dB")
    ending.say(f"shadows: BER {show('shadow', 'ber', 4)}, boundary MAE {show('shadow', 'boundary_mae', 4)}")
    if metrics.get("shadow_mask"):
        share, balanced = show("shadow_mask", "error_rate", 4), show("shadow_mask", "balanced_error_rate", 4)
        pooled = metrics["shadow_mask"]["error_rate"]
        whole = "" if pooled is None else f" ({pooled['pooled']:.4f} over the pixels of all frames)"
        ending.say(f"shadow masks: error rate {share}{whole}, balanced {balanced}")
    if metrics.get("known_suns") and metrics.get("unseen_suns"):
        known, unseen = (_mean(metrics[part], "image", "psnr", 2) for part in ("known_suns", "unseen_suns"))
        ending.say(f"silhouette PSNR: {known} dB under known Suns, {unseen} dB under Suns never seen")
    if (metrics.get("geometry") or {}).get("chamfer") is not None:
        ending.say(_shape_words(metrics["geometry"]))
    for note in metrics.get("notes", []):
        ending.say(f"note: {note}")


def _shape_words(geometry: dict[str, Any]) -> str:
    """The headline of metrics.json's "geometry"."""
    near, overlap = geometry["precision_recall"], geometry["iou"]
    words = f"shape: Chamfer {geometry['chamfer']:.3g} m2, Hausdorff-99 {geometry['hausdorff99']:.3g} m"
    words += f", IoU {'null' if overlap is None else f'{overlap:.4f}'}, F {near['f']:.4f} at {near['distance']:.3g} m"
    floating = (geometry["floaters"] or {}).get("outside")
    return words if floating is None else f"{words}, floaters {100 * floating:.2f} %"


def _mean(metrics: dict[str, Any], group: str, name: str, digits: int) -> str:
    value = ((metrics.get(group) or {}).get(name) or {}).get("mean")
    return "null" if value is None else f"{value:.{digits}f}"


_COMMANDS = {
    "doctor": _doctor,
    "demo": _demo,
    "generate": _generate,
    "train": _train,
    "eval": _eval,
    "report": _report,
    "render": _render,
    "sweep": _sweep,
    "view": _view,
    "compose": _compose,
    "verify": _verify,
    "export": _export,
}


if __name__ == "__main__":
    sys.exit(main())
