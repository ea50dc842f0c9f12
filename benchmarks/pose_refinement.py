"""What poses cost that are a little wrong, and what refining them in training gives back (`--refine-poses`).

    python benchmarks/pose_refinement.py --out OUT [--degrees 1,3] [--iterations 4000] [--backend auto] [--json]

boxsat of 128 pixels under one Sun, 60 training views, the preset fast. Each training camera is turned by so many
degrees about an axis through itself and moved by as many % of its distance, both at random and each for itself; test
cameras stay. Trained with the true cameras, the disturbed ones, and these refined. PSNR is over the silhouette of the
test views. Pose errors are medians over the training cameras against the true ones. Both are reported as they are and
"aligned", after the turn, shift and growth that fit all training cameras best to the true ones; that common motion is
the gauge, which pictures do not fix: turn in degrees, shift in % of the distance, growth in %.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from support import common

from spacesim import backend
from spacesim.data.files import read_json
from spacesim.data.geometry import OPENCV_FROM_OPENGL
from spacesim.data.records import Camera, Dataset, Frame
from spacesim.data.store import read_dataset
from spacesim.eval.evaluate import EvaluateConfig
from spacesim.progress import show_progress
from spacesim.reproduce.perform import evaluated
from spacesim.splat.run import load_run
from spacesim.splat.train.config import preset, with_options, with_settings

SCENE = {"sun": [(40.0, 25.0)], "test_suns": 1, "test_views": 0, "spp": 64}
TEST_VIEWS = 20


def main() -> None:
    parser = common.arguments(__doc__)
    parser.add_argument("--out", type=Path, required=True, help="where data and runs are, or are made")
    parser.add_argument("--views", type=common.positive, default=60)
    parser.add_argument("--resolution", type=common.positive, default=128, help="pixels of a side")
    parser.add_argument("--degrees", default="1,3", help="of the errors, and %% of the distance: numbers with commas")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--method", default="vanilla")
    parser.add_argument("--iterations", type=common.positive, default=4000)
    parser.add_argument("--seed", type=common.natural, default=0, help="of the errors")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of refined trainings")
    options = parser.parse_args()
    backend.select(options.backend)
    sizes = {
        "views": options.views,
        "resolution": options.resolution,
        "known_test_views": min(TEST_VIEWS, options.views),
    }
    data = read_dataset(common.generated("boxsat", options.out / "data", **SCENE, **sizes))
    rows = list(rows_of(data, options))
    common.emit({"rows": rows}, {"Errors of poses, preset " + options.preset: rows}, options)


def rows_of(data: Dataset, options: argparse.Namespace) -> Iterator[common.Row]:
    """Of the true cameras; of each error, refined and not; of the true cameras, refined."""
    from spacesim.cli.train import parse_setting

    plain = with_options(preset(options.preset, options.method), iterations=options.iterations)
    refined = with_settings(replace(plain, refine_poses=True), dict(map(parse_setting, options.set)))
    evaluation = EvaluateConfig(geometry=None)
    cases = [("true", 0.0, plain)]
    for degrees in map(float, filter(None, options.degrees.split(","))):
        cases += [(f"off by {degrees:g}, refined", degrees, refined), (f"off by {degrees:g}", degrees, plain)]
    cases.append(("true, refined", 0.0, refined))
    for name, degrees, config in cases:
        given = disturbed(data, degrees, options.seed)
        folder = options.out / name.replace(", ", "-").replace(" ", "-")
        metrics = common.measured(name, config, evaluation, given, folder)
        psnr = metrics["image"]["psnr"]["mean"] if "image" in metrics else float("nan")
        row = {"cameras": name, "PSNR, dB": psnr, "aligned, dB": psnr, "SSIM": metrics["image"]["ssim"]["mean"]}
        cameras = [frame.camera for frame in given.train]
        if config.refine_poses:
            cameras = list(cameras_of(folder / "run" / "cameras.json"))
            row["aligned, dB"] = aligned_psnr(data, cameras, folder, evaluation)
        seconds = metrics["training"]["seconds"]
        if config.refine_poses:
            seconds += read_json(folder / "run" / "poses" / "training.json")["seconds"]
        yield row | errors(cameras, [frame.camera for frame in data.train]) | {"s": seconds}


def aligned_psnr(data: Dataset, cameras: list[Camera], folder: Path, evaluation: EvaluateConfig) -> float:
    """Of the run in a folder, whose world is aligned with the true one by its training cameras."""
    frames = zip(data.train, cameras, strict=True)
    own = replace(data, train=tuple(replace(frame, camera=camera) for frame, camera in frames), test=())
    evaluation, run = replace(evaluation, align=own), load_run(folder / "run")
    metrics = evaluated(run, data, folder / "eval-aligned", evaluation, f"{folder.name}, aligned", show_progress)
    return float(metrics["image"]["psnr"]["mean"])


def disturbed(data: Dataset, degrees: float, seed: int) -> Dataset:
    """The training cameras turned by so many degrees and moved by so many % of their distance from the origin."""
    rng = np.random.default_rng(seed)

    def off(frame: Frame) -> Frame:
        axis, way = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
        pose = frame.camera.world_from_camera.copy()
        pose[:3, 3] += 0.01 * degrees * np.linalg.norm(pose[:3, 3]) * way
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(degrees * axis, degrees=True).as_matrix()
        return replace(frame, camera=replace(frame.camera, world_from_camera=pose))

    return replace(data, train=tuple(map(off, data.train))) if degrees else data


def cameras_of(path: Path) -> Iterator[Camera]:
    """Of RUN/cameras.json."""
    for frame in read_json(path)["frames"]:
        numbers = (frame[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy"))
        yield Camera(np.array(frame["transform_matrix"]) @ OPENCV_FROM_OPENGL, *numbers)


def errors(cameras: list[Camera], true: list[Camera]) -> common.Row:
    """Medians of what cameras are off, degrees and % of the distance, as they are and aligned, and the gauge."""
    turns = Rotation.from_matrix(np.array([c.world_from_camera[:3, :3] for c in cameras]))
    true_turns = Rotation.from_matrix(np.array([c.world_from_camera[:3, :3] for c in true]))
    places, true_places = (np.array([c.position for c in group]) for group in (cameras, true))
    distances = np.linalg.norm(true_places, axis=1)
    middle, true_middle = places.mean(axis=0), true_places.mean(axis=0)
    turn = (true_turns * turns.inv()).mean()  # what takes cameras to the true ones
    arms = turn.apply(places - middle)
    growth = float((arms * (true_places - true_middle)).sum() / (arms * arms).sum())
    aligned = growth * arms + true_middle
    shift = true_middle - growth * turn.apply(middle)  # of the origin, where the object is

    def off(there: Rotation, at: np.ndarray) -> tuple[float, float]:
        apart = np.linalg.norm(at - true_places, axis=1) / distances
        return float(np.median(np.degrees((there.inv() * true_turns).magnitude()))), float(100 * np.median(apart))

    (deg, percent), (aligned_deg, aligned_percent) = off(turns, places), off(turn * turns, aligned)
    return {
        "off, deg": deg,
        "off, %": percent,
        "aligned, deg": aligned_deg,
        "aligned, %": aligned_percent,
        "gauge, deg": float(np.degrees(turn.magnitude())),
        "gauge shift, %": float(100 * np.linalg.norm(shift) / distances.mean()),
        "gauge growth, %": 100 * abs(growth - 1),
    }


if __name__ == "__main__":
    common.run_main(main)
