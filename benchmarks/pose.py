"""How well `refine_pose` finds cameras that are off by 5 degrees and by 5 % of the distance.

    python benchmarks/pose.py --out OUT [--views 50]
    python benchmarks/pose.py --out OUT --data DATA --run RUN

Without DATA and RUN it makes them first: boxsat of 128 pixels under two Suns, the method shadow-map of the preset demo;
half of the test views are under these Suns. Each view's camera is turned by 5 degrees about an axis through itself and
moved by 5 % of its distance, both at random, then refined against the path-traced picture, with its alpha and over a
black sky without, and against the model's own picture: what is left there is the method's own error, the rest is the
model's. "lit" are the views with a tenth of the craft brighter than 0.1: of the others a black sky leaves nothing.
Errors over sigma: the median of sqrt(e^T C^-1 e / 6), 0.94 of a covariance C that is right. "converged": the share of
views of which the method says so; "wrong of these": what of them is off by more than 2 degrees or 2 %.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from support import common

from spacesim import backend
from spacesim.data.errors import InputError
from spacesim.data.images import load_image
from spacesim.data.records import Camera, Dataset, Frame
from spacesim.data.store import read_dataset
from spacesim.progress import report_training, show_progress
from spacesim.splat.pose import refine_pose, twist_between
from spacesim.splat.run import Run, load_run
from spacesim.splat.train.config import preset
from spacesim.splat.train.train import train

SCENE = {"sun": [(40.0, 25.0), (130.0, 10.0)], "views": 60, "test_suns": 2, "resolution": 128, "spp": 64}
TEST = {"test_views": 10, "known_test_views": 15}  # 50 in all
DEGREES, SHARE = 5.0, 0.05  #: by which cameras are off
GOOD_DEGREES, GOOD_PERCENT = 0.5, 0.5  #: of a pose that counts as found
WRONG = 2.0  #: degrees or %: of one that should not count as converged
LIT = 0.1  #: sRGB value that is not dark, and share of a craft that must be lit

Picture = Callable[[Run, Dataset, Frame], Any]


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--views", type=common.positive, default=50, help="test views, evenly taken (default 50)")
    parser.add_argument("--starts", type=common.positive, default=4)
    options = parser.parse_args()
    backend.select(options.backend)
    data, run = data_and_run(options)
    chosen = np.unique(np.linspace(0, len(data.test) - 1, min(options.views, len(data.test))).astype(int))
    views: dict[str, list[common.Row]] = {
        name: list(measured(run, data, [data.test[k] for k in chosen], picture, options.starts, options.seed))
        for name, picture in PICTURES.items()
    }
    rows = [summary(name, group, some) for name, results in views.items() for group, some in groups(results)]
    title = f"From {DEGREES:g} degrees and {100 * SHARE:g} % of the distance off, {options.starts} starts"
    common.emit({"rows": rows, "views": views}, {title: rows}, options)


def arguments(description: str | None) -> argparse.ArgumentParser:
    """With where data and run are, for `data_and_run`."""
    parser = common.arguments(description)
    parser.add_argument("--out", type=Path, required=True, help="where data and run are, or are made")
    parser.add_argument("--data", type=Path, help="a dataset with Suns and test views")
    parser.add_argument("--run", type=Path, help="a run trained on it")
    parser.add_argument("--seed", type=common.natural, default=0, help="of the data, of training and of what is tried")
    return parser


def data_and_run(options: argparse.Namespace) -> tuple[Dataset, Run]:
    """Those that are named, or made. Raises InputError where only one is named."""
    if (options.data is None) != (options.run is None):
        raise InputError("--data, --run: expected both or none, found one")
    data = read_dataset(options.data) if options.data else make_data(options.out / "data", options.seed)
    return data, load_run(options.run) if options.run else make_run(data, options.out / "run", options.seed)


def make_data(out: Path, seed: int = 0) -> Dataset:
    from spacesim.scenes.generation.generate import generate
    from spacesim.scenes.scenefile import read_scene

    with show_progress("generate", "frames") as report:
        return generate(read_scene("boxsat", **SCENE, **TEST, seed=seed), out, resume=True, progress=report)


def make_run(data: Dataset, out: Path, seed: int = 0) -> Run:
    config = replace(preset("demo", "shadow-map"), seed=seed)
    with show_progress("train", "iterations") as report:
        return train(data, out, config, resume=True, on_progress=report_training(report))


def displaced(camera: Camera, rng: np.random.Generator) -> Camera:
    """The camera turned about itself and moved, in random directions, by as much as is asked."""
    axis, way = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    pose = camera.world_from_camera.copy()
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(DEGREES * axis, degrees=True).as_matrix()
    pose[:3, 3] += SHARE * np.linalg.norm(camera.position) * way
    return replace(camera, world_from_camera=pose)


def errors(camera: Camera, true: Camera) -> tuple[float, float]:
    """Degrees, and the distance between the two cameras in % of the true one's from the origin."""
    turn = Rotation.from_matrix(camera.world_from_camera[:3, :3].T @ true.world_from_camera[:3, :3]).magnitude()
    apart = np.linalg.norm(camera.position - true.position) / np.linalg.norm(true.position)
    return float(np.degrees(turn)), float(100 * apart)


def traced(run: Run, data: Dataset, frame: Frame) -> Any:
    return load_image(data, frame)


def over_black(run: Run, data: Dataset, frame: Frame) -> Any:
    return load_image(data, frame).over(np.zeros(3))


def own(run: Run, data: Dataset, frame: Frame) -> Any:
    drawn = run.predict(frame.camera, frame.sun)
    alpha = np.clip(drawn.alpha, 0, 1)[..., None]
    return np.dstack([np.clip(drawn.rgb / np.maximum(alpha, 1e-6), 0, 1), alpha])


PICTURES: dict[str, Picture] = {"traced, alpha": traced, "traced, black sky": over_black, "the model's own": own}


def measured(
    run: Run, data: Dataset, frames: list[Frame], picture: Picture, starts: int, seed: int
) -> Iterator[common.Row]:
    """Of each view what it was off before and after, and what the covariance says."""
    for k, frame in enumerate(frames):
        off = displaced(frame.camera, np.random.default_rng([seed, k]))
        image, seen = picture(run, data, frame), load_image(data, frame)
        surface = seen.rgb[seen.alpha > 0.5]
        start = time.perf_counter()
        pose = refine_pose(run, image, off, frame.sun, starts=starts, seed=seed)
        seconds = time.perf_counter() - start
        twist = twist_between(pose.camera, frame.camera)
        yield {
            "view": frame.file_path,
            "lit": bool(len(surface) and (surface.max(axis=-1) > LIT).mean() > LIT),
            "before": errors(off, frame.camera),
            "after": errors(pose.camera, frame.camera),
            "error over sigma": float(np.sqrt(twist @ np.linalg.solve(pose.covariance, twist) / 6)),
            "converged": pose.converged,
            "seconds": seconds,
        }


def groups(views: list[common.Row]) -> list[tuple[str, list[common.Row]]]:
    lit = [view for view in views if view["lit"]]
    return [("all", views), *([("lit", lit)] if lit and len(lit) < len(views) else [])]


def summary(name: str, group: str, views: list[common.Row]) -> common.Row:
    """Medians and 90th percentiles."""
    before, after = (np.array([view[when] for view in views]) for when in ("before", "after"))
    good = (after[:, 0] < GOOD_DEGREES) & (after[:, 1] < GOOD_PERCENT)
    row: common.Row = {"picture": name, "views": f"{len(views)} {group}"}
    row["before, deg"], row["before, %"] = np.median(before, axis=0).tolist()
    for title, share in ("median", 50), ("90th", 90):
        row[f"{title}, deg"], row[f"{title}, %"] = np.percentile(after, share, axis=0).tolist()
    row["within 0.5 deg, 0.5 %"] = float(good.mean())
    converged = np.array([view["converged"] for view in views])
    row["converged"] = float(converged.mean())
    row["wrong of these"] = float((after[converged].max(axis=1) > WRONG).mean()) if converged.any() else 0.0
    row["error / sigma"] = float(np.median([view["error over sigma"] for view in views]))
    row["s a view"] = float(np.mean([view["seconds"] for view in views]))
    return row


if __name__ == "__main__":
    common.run_main(main)
