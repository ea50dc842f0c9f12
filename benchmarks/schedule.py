"""How good a model is, and how large, over the thesis's 200,000 iterations.

    python benchmarks/schedule.py --out OUT [--data DATA] [--methods shadow-map,vanilla] [--strategy default]
                                  [--preset thesis] [--iterations 200000] [--views 40] [--svg FILE] [--json]

boxsat, 100 Suns x 20 views of 256 pixels, test views under these and under 20 Suns never seen; or a dataset of yours.
A run is OUT/METHOD-STRATEGY/run. PSNR over the silhouette, of so many test views under each kind of Sun, and the
number of Gaussians at every 40th of the training. What was interrupted goes on where it was.
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from support import common

from spacesim import backend
from spacesim.data.files import read_json, write_bytes, write_json
from spacesim.data.records import Dataset, Frame
from spacesim.data.store import read_dataset
from spacesim.eval.frame_metrics import frame_images
from spacesim.eval.metrics import image
from spacesim.eval.report.charts import line_chart
from spacesim.eval.suns import known_suns
from spacesim.learning.folder import TrainingProgress
from spacesim.learning.loop import HISTORY_EVERY
from spacesim.progress import report_training, show_progress
from spacesim.splat.run import Run
from spacesim.splat.train.config import STRATEGIES, TrainConfig, preset, with_options
from spacesim.splat.train.train import train
from spacesim.splat.train.trainer import Trainer

SCENE = {"suns": 100, "views": 20, "test_suns": 20, "test_views": 3, "known_test_views": 1, "shared_test_views": True}
SAMPLES = {"resolution": 256, "spp": 64, "test_spp": 1024}
POINTS = 40  #: of a curve
KINDS = {True: "known Suns", False: "unseen Suns"}


def main() -> None:
    parser = common.arguments(__doc__)
    parser.add_argument("--out", type=Path, required=True, help="where data and runs are, or are made")
    parser.add_argument("--data", type=Path, help="a dataset in place of its own")
    parser.add_argument("--methods", default="shadow-map,vanilla", help="commas between")
    parser.add_argument("--strategy", default="default", choices=STRATEGIES)
    parser.add_argument("--preset", default="thesis")
    parser.add_argument("--iterations", type=common.positive, help="default: the preset's")
    parser.add_argument("--views", type=common.positive, default=40, help="test views of each kind of Sun")
    parser.add_argument("--svg", type=Path, help="a chart of the curves")
    options = parser.parse_args()
    backend.select(options.backend)
    data = read_dataset(options.data or common.generated("boxsat", options.out / "data", **SCENE, **SAMPLES))
    rows = []
    for method in common.row_names(options.methods):
        config = with_options(preset(options.preset, method, options.strategy), iterations=options.iterations)
        every = max(config.iterations // POINTS, HISTORY_EVERY)
        folder = options.out / f"{method}-{options.strategy}"
        curve = followed(folder, data, replace(config, checkpoint_every=every), options.views)
        rows += [{"method": method, "strategy": options.strategy, **point} for point in curve]
    if options.svg:
        write_bytes(options.svg, chart(rows).encode())
    common.emit({"rows": rows}, {f"Over the iterations, preset {options.preset}": rows}, options)


def followed(folder: Path, data: Dataset, config: TrainConfig, views: int) -> list[common.Row]:
    """Trains a run; its quality at every checkpoint, and at the end."""
    kept = folder / "kept"
    kept.mkdir(parents=True, exist_ok=True)

    def keep_checkpoints() -> None:
        for path in (folder / "run" / "checkpoints").glob("step_*.safetensors"):
            if not (kept / path.name).exists():
                os.link(path, kept / path.name)

    with show_progress(f"train {config.method}", "iterations") as report:
        tell = report_training(report)

        def follow(progress: TrainingProgress) -> None:
            keep_checkpoints()
            tell(progress)

        run = train(data, folder / "run", config, True, follow)
    chosen = test_views(data, views)
    trainer, points = None, []
    for path in sorted(kept.glob("step_*.safetensors")):
        scores_path = path.with_name(f"{path.stem}_{views}_views.json")
        if not scores_path.exists():
            trainer = trainer or Trainer(data, config)
            trainer.restore(path)
            there = replace(run, gaussians=trainer.gaussians, light=trainer.light)
            write_json(scores_path, {"iteration": trainer.iteration, **quality(there, data, chosen)})
        points.append(read_json(scores_path))
    return [*points, {"iteration": config.iterations, **quality(run, data, chosen)}]


def test_views(data: Dataset, views: int) -> dict[str, list[Frame]]:
    """So many test views, spread over all of them, by the kind of their Sun."""
    known = known_suns(data.test, data.train)
    groups = {
        name: [frame for frame, seen in zip(data.test, known, strict=True) if seen is kind]
        for kind, name in KINDS.items()
    }
    spread = {
        name: np.unique(np.linspace(0, len(all_) - 1, views).astype(int)) for name, all_ in groups.items() if all_
    }
    return {name: [groups[name][i] for i in numbers] for name, numbers in spread.items()}


def quality(run: Run, data: Dataset, chosen: dict[str, list[Frame]]) -> common.Row:
    """Mean PSNR over the silhouettes under each kind of Sun, dB, and Gaussians."""
    means: common.Row = {}
    for name, frames in chosen.items():
        views = [frame_images(data, frame, run.predict(frame.camera, frame.sun))[0] for frame in frames]
        scores = [image.psnr(view.prediction, view.truth, view.silhouette) for view in views]
        means[f"PSNR, {name}"] = float(np.mean([score for score in scores if score is not None]))
    return {**means, "Gaussians": run.gaussian_count}


def chart(rows: Sequence[common.Row]) -> str:
    """SVG that stands alone: PSNR of each method and kind of Sun against iterations."""
    names: dict[tuple[str, str], list[tuple[float, float]]] = {
        (row["method"], key): [] for row in rows for key in row if key.startswith("PSNR")
    }
    for row in rows:
        for (method, key), points in names.items():
            if row["method"] == method:
                points.append((row["iteration"], row[key]))
    drawn = line_chart("PSNR over the silhouette, dB", "iteration", list(names.values()))
    return common.standalone(drawn, [f"{method}, {key.removeprefix('PSNR, ')}" for method, key in names])


if __name__ == "__main__":
    common.run_main(main)
