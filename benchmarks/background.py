"""What training against alpha is worth: the same data, once over random backgrounds, once over black.

    python benchmarks/background.py DATA [--preset demo] [--iterations N] [--backend auto] [--json]

Over the test views: mean alpha of the pixels that the object covers and of those that it does not, the share of
covered pixels that are less than half opaque (holes), and the PSNR of whole frames over black and over white.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from support import common

from spacesim import backend
from spacesim.data.images import load_image
from spacesim.data.records import Dataset
from spacesim.data.store import read_dataset
from spacesim.eval.metrics.image import psnr
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.project import Pinhole
from spacesim.splat.raster.render import render
from spacesim.splat.train.config import preset, with_options
from spacesim.splat.train.trainer import Trainer


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--backend", choices=backend.NAMES, default="auto")
    parser.add_argument("--preset", default="demo")
    parser.add_argument("--iterations", type=int)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    backend.select(options.backend)
    dataset = read_dataset(options.data)
    config = with_options(preset(options.preset), iterations=options.iterations)
    columns = ("alpha inside", "alpha outside", "holes", "psnr over black", "psnr over white")
    rows: dict[str, dict[str, float]] = {}
    for name, against_alpha in (("random", True), ("black", False)):
        trainer = Trainer(dataset, replace(config, random_background=against_alpha))
        trainer.run(lambda progress: None, lambda: None)
        rows[name] = dict(zip(columns, measured_errors(trainer.gaussians, dataset).tolist(), strict=True))
        rows[name]["gaussians"] = trainer.gaussians.count
    if options.json:
        print(json.dumps(rows, indent=1))
        return
    print("background  alpha inside  alpha outside  holes [%]  PSNR over black [dB]  over white  Gaussians")
    for name, row in rows.items():
        inside, outside, holes, black, white, count = row.values()
        print(
            f"{name:<10}  {inside:12.4f}  {outside:13.5f}  {100 * holes:9.2f}  {black:20.2f}  {white:10.2f}  {count:9}"
        )


def measured_errors(gaussians: Gaussians, dataset: Dataset) -> np.ndarray:
    """Means over the test views of the five figures that `main` prints."""
    rows = []
    for frame in dataset.test:
        color, alpha, _ = render(gaussians, Pinhole.of(frame.camera)).to_numpy()
        truth = load_image(dataset, frame)
        covered, empty = truth.alpha > 0.999, truth.alpha < 0.001
        errors = []
        for background in (0.0, 1.0):
            picture = np.clip(color + (1 - alpha[..., None]) * background, 0, 1)
            errors.append(psnr(picture, truth.over(np.full(3, background))))
        rows.append([alpha[covered].mean(), alpha[empty].mean(), (alpha[covered] < 0.5).mean(), *errors])
    return np.mean(rows, axis=0)


if __name__ == "__main__":
    common.run_main(main)
