"""`train`: a dataset and a configuration to a run on disk, resumable at any time."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.files import read_json, write_json
from spacesim.data.images.tone import tone_and_exposure
from spacesim.data.mesh import write_points
from spacesim.data.records import Dataset
from spacesim.data.transforms import check_still
from spacesim.learning.cameras import farthest_camera, focus_point
from spacesim.learning.folder import (
    TrainingProgress,
    check_folder,
    describe_data,
    holds_training,
    is_finished,
    open_folder,
)
from spacesim.splat.run import Run, load_run, read_config
from spacesim.splat.train.checkpoint import read_tensors, write_tensors
from spacesim.splat.train.config import TrainConfig
from spacesim.splat.train.old_config import not_trained_any_more
from spacesim.splat.train.pictures.poses import pose_config, pose_warning
from spacesim.splat.train.pictures.suns import FirstSuns, check_pictures, first_suns, shape_config, surface_points
from spacesim.splat.train.start import (
    distance_warning,
    few_left_warning,
    scale_warning,
    sky_warning,
    sun_warning,
)
from spacesim.splat.train.trainer import Trainer

log = logging.getLogger(__name__)


def train(
    dataset: Dataset,
    out: Path,
    config: TrainConfig,
    resume: bool = False,
    on_progress: Callable[[TrainingProgress], None] = lambda progress: None,
    command: Sequence[str] = (),
) -> Run:
    """Train and write RUN (see `spacesim.splat.run`). With `resume`, go on from the newest checkpoint, with the
    same result to the bit; a finished run is returned as it is. command: the command line, for the report.

    Ctrl-C on the command line leaves a checkpoint of the step that it arrives in. Raises InputError where `out` holds a
    run and `resume` is not asked for, or one of another configuration, or where another training is at work in it.
    """
    out, config = Path(out), _with_light_of(config, check_still(dataset))
    described = {**config.to_json(), "data": describe_data(dataset)}
    if is_finished(out, described, resume, read_config):
        return load_run(out)
    if holds_training(out) and (what := not_trained_any_more(read_json(out / "config.json"))):
        raise InputError(f"{out}: expected a run that this version has begun, found one that {what}; train it anew")
    if config.warm_start is not None and (remark := config.warm_start.remark(config.iterations)):
        log.warning(remark)
    if config.sun == "given" and not config.refine_poses:
        trainer = Trainer(dataset, config)
    elif config.sun == "unknown":
        check_pictures(dataset)
    of_sun = sun_warning(dataset, config.iterations) if config.sun == "unknown" else ""
    of_sky = "" if of_sun else sky_warning(dataset)
    for remark in filter(None, (of_sun, of_sky, scale_warning(dataset), distance_warning(dataset))):
        log.warning(remark)
    with open_folder(out, described, resume, read_config):
        if config.sun == "unknown":
            trainer = _trainer_from_shape(dataset, config, out, on_progress)
        elif config.refine_poses:
            trainer = _trainer_of_poses(dataset, config, out, on_progress)
        trainer.complete(out, on_progress, command)
    if remark := few_left_warning(trainer.history):
        log.warning(remark)
    return load_run(out)


def _trainer_from_shape(
    dataset: Dataset, config: TrainConfig, out: Path, on_progress: Callable[[TrainingProgress], None]
) -> Trainer:
    """Of Suns that are unknown: a run without light, RUN/shape, is trained first. It gives the first Suns, kept in
    RUN/suns.safetensors, and the points to start from, RUN/points.ply, where `init` is not to be another one."""
    path, points = out / "suns.safetensors", out / "points.ply"
    if not path.exists():
        run = train(dataset, out / "shape", shape_config(config), resume=True, on_progress=on_progress)
        log.info("looking for the Suns of %d pictures by shape and shading", len(dataset.train))
        write_points(points, *surface_points(run.gaussians))
        distance = farthest_camera(dataset, focus_point(dataset))
        write_tensors(path, first_suns(dataset, run.gaussians, distance).tensors(), {})
    suns = FirstSuns.of(read_tensors(path)[0], len(dataset.train), path)
    if config.init in (None, "random"):
        dataset = replace(dataset, ply_file_path=str(points.absolute()))
        config = replace(config, init="points", init_box=None, warm_start=None)
    if config.refine_poses:
        return _trainer_of_poses(dataset, config, out, on_progress, suns)
    return Trainer(dataset, config, suns)


def _trainer_of_poses(
    dataset: Dataset,
    config: TrainConfig,
    out: Path,
    on_progress: Callable[[TrainingProgress], None],
    suns: FirstSuns | None = None,
) -> Trainer:
    """Of poses that are refined: a run that learns them, RUN/poses, is trained first. What it finds is kept in
    RUN/poses.safetensors; the model starts anew, and poses stay. suns: where unknown ones start"""
    path, folder, learning = out / "poses.safetensors", out / "poses", pose_config(config)
    described = {**learning.to_json(), "data": describe_data(dataset)}
    check_folder(folder, described, True, read_config)
    if not path.exists():
        first = Trainer(dataset, learning, suns)
        write_json(folder / "config.json", described)
        log.info("learning the poses of %d pictures, %d iterations", len(dataset.train), learning.iterations)
        if remark := pose_warning(len(dataset.train), learning):
            log.warning(remark)
        first.complete(folder, on_progress)
        assert first.pictures.poses is not None
        write_tensors(path, {"values": first.pictures.poses.numbers.values}, {})
    log.info("training with the poses found")
    values = read_tensors(path)[0].get("values", np.empty(0))
    if values.shape != (len(dataset.train), 6) or not np.isfinite(values).all():
        raise InputError(f"{path}: expected the poses of {len(dataset.train)} pictures, found others; delete it")
    return Trainer(dataset, config, suns, values)


def _with_light_of(config: TrainConfig, dataset: Dataset) -> TrainConfig:
    """What the configuration leaves to the dataset: whether the Earth is a part of the light; the tone curve and the
    exposure of linear colours. Raises InputError where the Earth is asked for and a frame names none that gives
    light."""
    light = config.light
    if light is None:
        return config
    earths = ((frame.file_path, frame.sun.earth if frame.sun else None) for frame in dataset.train)
    dark = [path for path, earth in earths if earth is None or earth.albedo == 0]
    if light.earth and dark:
        expected = "expected earth_direction in every training frame (light.earth = true), with earth_albedo above 0"
        raise InputError(f"{dataset.root}: {expected}, found none in {dark[0]}")
    if light.field.surface and light.earth is None:
        if not dark:
            light = replace(light, earth=True)
        elif len(dark) < len(dataset.train):
            log.warning("training without the Earth's light: %s names no Earth that gives some, others do", dark[0])
    if light.linear:
        tone, exposure = tone_and_exposure(dataset.scene) or ("srgb", 0.0)
        exposure = exposure if light.exposure is None else light.exposure
        light = replace(light, tone=light.tone or tone, exposure=exposure)
    return replace(config, light=light)
