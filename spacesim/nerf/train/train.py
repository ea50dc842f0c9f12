"""`train`: a dataset and a configuration to a run on disk, resumable at any time."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from spacesim.data.records import Dataset
from spacesim.data.transforms import check_still
from spacesim.learning.folder import TrainingProgress, describe_data, is_finished, open_folder
from spacesim.nerf.config import MAX_CELLS, NerfConfig
from spacesim.nerf.run import NerfRun, load_run, read_config
from spacesim.nerf.sampling.box import pixels_across, scene_box
from spacesim.nerf.train.trainer import NerfTrainer


def train(
    dataset: Dataset,
    out: Path,
    config: NerfConfig,
    resume: bool = False,
    on_progress: Callable[[TrainingProgress], None] = lambda progress: None,
    command: Sequence[str] = (),
) -> NerfRun:
    """Train and write RUN (see `spacesim.nerf.run`); as `spacesim.splat.train.train.train` of Gaussians."""
    config = fit_grid(config, check_still(dataset))
    out, described = Path(out), {**config.to_json(), "data": describe_data(dataset)}
    if not is_finished(out, described, resume, read_config):
        trainer = NerfTrainer(dataset, config)
        with open_folder(out, described, resume, read_config):
            trainer.complete(out, on_progress, command)
    return load_run(out)


def fit_grid(config: NerfConfig, dataset: Dataset) -> NerfConfig:
    """With as many cells along the box as training pictures have pixels there, where `grid.finest` does not say."""
    if config.grid.finest is not None or not dataset.train:
        return config
    pixels = pixels_across(scene_box(dataset, config.margin), dataset)
    cells = min(max(round(pixels), config.grid.coarsest), MAX_CELLS)
    return replace(config, grid=replace(config.grid, finest=cells))
