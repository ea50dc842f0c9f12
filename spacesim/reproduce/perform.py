"""One experiment: trained, evaluated, drawn. What is finished is not done again; what was interrupted goes on."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spacesim import methods
from spacesim.data.errors import InputError, WorkError
from spacesim.data.files import JsonDict, read_json, write_json
from spacesim.data.geometry import angles_from_direction
from spacesim.data.images import write_png
from spacesim.data.images.tone import as_bytes
from spacesim.data.mesh import SignedDistance
from spacesim.data.records import Dataset, Frame
from spacesim.data.store import load_truth, read_dataset
from spacesim.eval import pictures
from spacesim.eval.evaluate import EvaluateConfig, evaluate
from spacesim.eval.frame_metrics import frame_images
from spacesim.eval.metrics import image
from spacesim.eval.relight import phase_deg, plan_sweep
from spacesim.eval.report.write import write_report
from spacesim.eval.suns import known_suns, rounded_angles
from spacesim.progress import report_training
from spacesim.reproduce.experiments import PLACES, Curve, Experiment, Work
from spacesim.reproduce.frames import time_frames
from spacesim.reproduce.size import Size
from spacesim.splat.compose import (
    ComposeConfig,
    ComposedRun,
    GaussianComposition,
    PlacedRun,
    Pose,
    PosedScene,
    load_scene,
    save_scene,
)
from spacesim.splat.run import Run
from spacesim.splat.train.config import TrainConfig
from spacesim.splat.train.prior import known_mesh
from spacesim.splat.train.trainer import Trainer

if TYPE_CHECKING:
    from spacesim.nerf.run import NerfRun
    from spacesim.splat.run import Predictor

ReportCallback = Callable[..., None]  #: takes how much is done, of how much, and details, as `progress.Reporter` does
Reporting = Callable[[str, str], AbstractContextManager[Any]]  #: (title, unit) to a `ReportCallback` for the work

MARKS = 20  #: places of figure 5.5
OPAQUE = 0.5  #: alpha from which on pictures of depth show a surface
DARKEST = 0.2  #: brightness of the farthest surface in pictures of depth, the nearest has 1


def folder_of(root: Path, name: str) -> Path:
    """Where an experiment lies."""
    return root / "experiments" / name


def data_folder(root: Path, name: str) -> Path:
    """Where a dataset lies."""
    return root / "data" / name


def is_done(root: Path, work: Work) -> bool:
    """Nothing is left of an experiment."""
    folder = folder_of(root, work.name)
    if isinstance(work, Curve):
        return (folder / "curve.json").exists()
    return all((folder / _last_file(part)).exists() for part in work.parts)


def perform(root: Path, size: Size, work: Work, reporting: Reporting) -> None:
    """Do what is left of an experiment. A training that fails leaves failed.json, which says why, and is tried again by
    the next call."""
    folder = folder_of(root, work.name)
    (folder / "failed.json").unlink(missing_ok=True)
    try:
        if isinstance(work, Curve):
            dataset = read_dataset(data_folder(root, work.data))
            with reporting(work.name, "steps") as tell:
                curve = follow(folder, dataset, work.config, size.figure_steps, tell)
            write_json(folder / "curve.json", curve)
        else:
            _perform(root, size, work, reporting)
    except (WorkError, MemoryError) as error:
        write_json(folder / "failed.json", {"reason": str(error)})


def _perform(root: Path, size: Size, work: Experiment, reporting: Reporting) -> None:
    folder, dataset = folder_of(root, work.name), read_dataset(data_folder(root, work.data))
    if work.fully_lit:
        dataset = fully_lit_alone(dataset, size.fully_lit_deg)
    run = trained(folder / "run", dataset, work.config, work.name, reporting)
    measures = EvaluateConfig(geometry=size.geometry)
    for part in work.parts:
        title = f"{work.name}, {part}"
        if (folder / _last_file(part)).exists():
            continue
        if part == "own":
            evaluated(run, dataset, folder / part, measures, title, reporting)
        elif part == "pair":
            assert isinstance(run, Run)
            assert isinstance(work.config, TrainConfig)
            pair = read_dataset(data_folder(root, part))
            scene = composed(run, folder / "pair.toml", shadows_between(work.config))
            evaluated(scene, pair, folder / part, replace(measures, geometry=None), title, reporting)
        elif part == "one-sun":
            other = read_dataset(data_folder(root, part))
            _draw_depth(run, other, folder / part, size.fully_lit_deg)
            evaluated(run, other, folder / part, measures, title, reporting)
        elif part == "frames":
            with reporting(title, "scenes") as tell:
                write_json(folder / _last_file(part), time_frames(run, dataset, tell))
        else:
            draw_suns(run, dataset, folder / part)


def _last_file(part: str) -> str:
    """What a part of an experiment writes when all else of it is there."""
    return f"{part}/{part}.json" if part in ("suns", "frames") else f"{part}/report.html"


def trained(folder: Path, dataset: Dataset, config: methods.Config, name: str, reporting: Reporting) -> "Run | NerfRun":
    """The run in a folder, trained to its end."""
    with reporting(f"train {name}", "iterations") as report:
        return methods.train(dataset, folder, config, resume=True, on_progress=report_training(report))


def evaluated(
    run: "Predictor", dataset: Dataset, folder: Path, measures: EvaluateConfig, name: str, reporting: Reporting
) -> JsonDict:
    """What metrics.json of an evaluation and its report hold."""
    if (folder / "report.html").exists():
        known: JsonDict = read_json(folder / "metrics.json")
        return known
    with reporting(f"evaluate {name}", "frames") as report:
        metrics = evaluate(run, dataset, folder, measures, report)
    write_report([folder], folder / "report.html")
    return metrics


def composed(run: Run, file: Path, shadows: str) -> ComposedRun:
    """The pair of tables 4.6 and 4.7, as a scene in a file; shadows: between the models, see `ComposeConfig`."""
    models = [PlacedRun(run, Pose(translation=np.array(place)), which) for which, place in PLACES.items()]
    save_scene(file, PosedScene(GaussianComposition(models, ComposeConfig(shadows))))
    return ComposedRun(load_scene(file).composition, file)


def shadows_between(config: TrainConfig) -> str:
    """How models shade each other: by the ratio of 4.15 as the thesis has it, else by what the others let through."""
    if config.light is None or config.light.shadow is None:
        return "none"
    return "ratio" if config.preset == "thesis" else "others"


def is_fully_lit(frame: Frame, tolerance: tuple[float, float]) -> bool:
    """The camera stands within so many degrees of azimuth and elevation of the Sun's direction (section 4.2)."""
    if frame.sun is None:
        return False
    camera = angles_from_direction(-frame.camera.world_from_camera[:3, 2])
    azimuth, elevation = np.subtract(camera, frame.sun.angles)
    return abs((azimuth + 180) % 360 - 180) <= tolerance[0] and abs(elevation) <= tolerance[1]


def fully_lit_alone(dataset: Dataset, tolerance: tuple[float, float]) -> Dataset:
    """The dataset with those of its training views alone. Raises InputError where there is none."""
    kept = tuple(frame for frame in dataset.train if is_fully_lit(frame, tolerance))
    if not kept:
        raise InputError(f"{dataset.root}: expected training views with the Sun behind the camera, found none")
    return replace(dataset, train=kept)


def draw_suns(run: "Predictor", dataset: Dataset, folder: Path) -> None:
    """One view under many Suns, also of a run that does not take the Sun; with the truth where the dataset has it."""
    sweep = plan_sweep(dataset.test, dataset.frames)
    if sweep is None:
        raise WorkError(f"{dataset.root}: expected several Suns, found fewer than two")
    steps = []
    for index, (frame, truth) in enumerate(zip(sweep.lit_as, sweep.truths, strict=True)):
        prediction = run.predict(sweep.view.camera, frame.sun)
        step: JsonDict = {"sun": rounded_angles(frame), "psnr": None}
        if truth is not None:
            view, _ = frame_images(dataset, truth, prediction)
            step["psnr"] = image.psnr(view.prediction, view.truth, view.silhouette)
            write_png(folder / f"truth_{index:02d}.png", pictures.as_bytes(view.truth))
        write_png(folder / f"prediction_{index:02d}.png", pictures.as_bytes(prediction.rgb))
        steps.append(step)
    known = known_suns(sweep.lit_as, dataset.train)
    suns = [{**step, "known": bool(seen)} for step, seen in zip(steps, known, strict=True)]
    write_json(folder / "suns.json", {"view": sweep.view.file_path, "suns": suns})


def _draw_depth(run: "Predictor", dataset: Dataset, folder: Path, tolerance: tuple[float, float]) -> None:
    """Which test views are fully lit, and depth, true and predicted, of the ones with the Sun most behind the camera
    and most ahead of it."""
    phases = {frame.file_path: phase_deg(frame.camera, frame) for frame in dataset.test}
    by_path = {frame.file_path: frame for frame in dataset.test}
    chosen = {"lit": min(phases, key=phases.__getitem__), "shadowed": max(phases, key=phases.__getitem__)}
    for name, path in chosen.items():
        frame = by_path[path]
        true = load_truth(dataset, frame).depth
        near, far = float(true[true > 0].min(initial=np.inf)), float(true.max())
        prediction = run.predict(frame.camera, frame.sun)
        seen = np.where(prediction.alpha >= OPAQUE, prediction.depth, 0)
        for kind, depth in (("truth", true), ("depth", seen)):
            write_png(folder / f"{name}_{kind}.png", depth_picture(depth, near, far))
    lit = [frame.file_path for frame in dataset.test if is_fully_lit(frame, tolerance)]
    write_json(folder / "views.json", {"fully_lit": lit, "tolerance_deg": tolerance, "chosen": chosen})


def depth_picture(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """[H, W] uint8 of depths [H, W], metres: near is bright, 0 is black."""
    bright = 1 - (1 - DARKEST) * (depth - near) / max(far - near, 1e-9)
    return as_bytes(np.where(depth > 0, np.clip(bright, DARKEST, 1), 0))


def follow(folder: Path, dataset: Dataset, config: TrainConfig, steps: int, tell: ReportCallback) -> JsonDict:
    """{"gaussians": N, "inside": [[step, share of their centres inside the true mesh]]} over the first steps of a
    training (figure 5.5); the folder keeps a checkpoint and what was counted until then."""
    surface = SignedDistance.of(dataset.root / known_mesh(dataset, "the figure"))
    trainer = Trainer(dataset, config)
    saved, counted = folder / "checkpoint.safetensors", folder / "counted.json"
    inside: list[Sequence[float]] = []
    if saved.exists() and counted.exists():
        trainer.restore(saved)
        inside = [point for point in read_json(counted) if point[0] < trainer.iteration]
    every = max(steps // MARKS, 1)
    for step in range(trainer.iteration, steps + 1):
        if step % every == 0:
            share = float(surface.inside(np.array(trainer.gaussians.means, np.float64).T).mean())
            inside.append([step, share])
            tell(step, steps, f"{100 * share:.2f} % inside")
        if step % config.checkpoint_every == 0 and 0 < step < steps:
            write_json(counted, inside)
            trainer.save(saved)
        if step < steps:
            trainer.step()
    return {"gaussians": trainer.gaussians.count, "inside": inside}
