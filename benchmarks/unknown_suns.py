"""Pictures like SPEED+'s that do not name their Suns: what estimating these is worth (`train --sun unknown`).

    python benchmarks/unknown_suns.py --out OUT [--frames 600] [--height 300] [--iterations 7000] [--json]

Data as of speedplus_data.py, silhouettes known. Trained: "known", with the true Suns; "unknown", with estimated ones;
without Suns, the field of view alone with embeddings of pictures, and vanilla. PSNR is over the silhouette of test
views, which have Suns of their own: "known" is given these, and the others are not. What they do not know of a test
picture, Sun or embedding, is fitted on one half of it and scored on the other; "PSNR, told" is "unknown" given the true
Suns of test views. Errors of Suns are against the true ones: of all training pictures, and of those whose Sun the
estimate calls sure (sigma below its median).
"""

import argparse
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import speedplus_data
from support import common

from spacesim import backend
from spacesim.data.files import read_json
from spacesim.data.geometry import degrees_between
from spacesim.data.importers.writing import ImportedFrame, write_dataset
from spacesim.data.records import Dataset, Frame
from spacesim.data.store import read_dataset
from spacesim.eval.evaluate import EvaluateConfig, evaluate
from spacesim.progress import show_progress
from spacesim.splat.run import load_run
from spacesim.splat.train.config import TrainConfig, preset, warm_start, with_options, with_settings

METHOD = "shadow-map"
EMBEDDINGS = 16  #: numbers of a picture


def main() -> None:
    parser = common.arguments(__doc__)
    parser.add_argument("--out", type=Path, required=True, help="where data and runs are, or are made")
    parser.add_argument("--frames", type=common.positive, default=600, help="training pictures")
    parser.add_argument("--height", type=common.positive, default=300, help="pixels")
    parser.add_argument("--spp", type=common.positive, default=64)
    parser.add_argument("--iterations", type=common.positive, default=7000)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--rows", default="known,unknown,embeddings,vanilla", help="what to train, commas between")
    options = parser.parse_args()
    backend.select(options.backend)
    data = speedplus_data.make(options.out, options.frames, options.height, spp=options.spp)
    rows = list(rows_of(data, options))
    common.emit({"rows": rows}, {"Suns unknown, preset " + options.preset: rows}, options)


def rows_of(data: speedplus_data.SpeedplusData, options: argparse.Namespace) -> Iterator[common.Row]:
    without = without_suns(data.labelled, options.out / "without-suns")
    evaluation = EvaluateConfig(geometry=None)
    for name, config in configurations(options).items():
        if name not in common.row_names(options.rows):
            continue
        folder = options.out / name
        metrics = common.measured(name, config, evaluation, data.labelled if name == "known" else without, folder)
        if "note" in metrics:
            yield {"Suns": name, **metrics}
            continue
        row = {"Suns": name, "PSNR, dB": metrics["image"]["psnr"]["mean"], "SSIM": metrics["image"]["ssim"]["mean"]}
        row |= {"Gaussians": metrics["model"]["gaussians"], "s": metrics["training"]["seconds"]}
        if name == "unknown":
            row |= {"PSNR, told": psnr_under_told_suns(folder, data.labelled, evaluation)}
            row |= sun_errors(folder / "run" / "cameras.json", data.made)
        yield row


def configurations(options: argparse.Namespace) -> dict[str, TrainConfig]:
    """By the names of rows."""

    def of(method: str) -> TrainConfig:
        config = with_options(preset(options.preset, method), warm_start=warm_start(options.preset))
        return with_options(config, iterations=options.iterations)

    view = {"light.field.inputs": "view", "light.field.embeddings": EMBEDDINGS, "surfels": False}
    return {
        "known": of(METHOD),
        "unknown": with_settings(of(METHOD), {"sun": "unknown"}),
        "embeddings": with_settings(of("relight"), view),
        "vanilla": of("vanilla"),
    }


def without_suns(data: Dataset, out: Path) -> Dataset:
    """The same pictures and silhouettes without Suns."""
    if not (out / "transforms.json").exists():
        shutil.rmtree(out, ignore_errors=True)

        def without_sun(frame: Frame) -> ImportedFrame:
            assert frame.silhouette_path is not None
            paths = data.root / frame.file_path, data.root / frame.silhouette_path
            return ImportedFrame(
                Path(frame.file_path).stem, paths[0], frame.camera, frame.distortion, silhouette=paths[1]
            )

        train, test = (list(map(without_sun, group)) for group in (data.train, data.test))
        write_dataset(out, train, test, {"kind": "untold", "source": str(data.root)})
    return read_dataset(out)


def psnr_under_told_suns(folder: Path, labelled: Dataset, evaluation: EvaluateConfig) -> float:
    """Of FOLDER/run, each test picture drawn under its true Sun."""
    with show_progress("evaluate under the true Suns", "frames") as report:
        metrics = evaluate(load_run(folder / "run"), labelled, folder / "told", evaluation, report)
    told: float = metrics["image"]["psnr"]["mean"]
    return told


def sun_errors(path: Path, made: Dataset) -> common.Row:
    """Of a run's estimates (cameras.json), degrees."""
    frames = read_json(path)["frames"]
    directions = np.array([frame["sun_direction"] for frame in frames])
    sigmas = np.array([frame["sun_sigma_deg"] for frame in frames])
    true = np.array([frame.sun.direction for frame in made.train if frame.sun is not None])
    errors = degrees_between((directions * true).sum(axis=1))
    return {
        "Sun off, deg": float(np.median(errors)),
        "mean": float(errors.mean()),
        "at most 8 deg, %": float(100 * (errors <= 8).mean()),
        "over 60 deg, %": float(100 * (errors > 60).mean()),
        "of the surer half, deg": float(np.median(errors[sigmas <= np.median(sigmas)])),
        "sigma, deg": float(np.median(sigmas)),
    }


if __name__ == "__main__":
    common.run_main(main)
