"""Radiance fields: a training step, a whole training, frames of one and of three models; beside nerfacc's instant-ngp.

    python benchmarks/nerf.py --out OUT [--data DATA] [--preset thesis] [--rays 4096] [--iterations N] [--pixels 512]
                              [--splats] [--peers nerfacc] [--json]

boxsat, one Sun, 100 views of 256 pixels, or a dataset of yours. A step is timed once trained, so that rays skip what is
empty. PSNR is of test views, over whole pictures and over the silhouette. Frames are what `predict` returns, in the
computer's memory, of test views drawn at so many pixels. --splats trains `vanilla` of the preset `fast`, too, and puts
it through the field, a tenth of the object's size aside: how far the picture of both, in one walk, is from the two
pictures put together by each pixel's expected depth, over the pixels that they cover. --peers trains the recipe of
nerfacc's train_ngp_nerf_occ.py for as many iterations of as many rays; that needs CUDA, torch, nerfacc and tinycudann.
"""

import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, cast

import drjit as dr
import numpy as np
from rasterizer import load_peer
from support import common

from spacesim import backend, methods
from spacesim.data.records import Dataset, Frame
from spacesim.data.store import read_dataset
from spacesim.eval.frame_metrics import frame_images
from spacesim.eval.metrics import image
from spacesim.learning.prediction import Prediction
from spacesim.nerf.compose import FieldComposition
from spacesim.nerf.run import NerfRun
from spacesim.nerf.train.trainer import NerfTrainer
from spacesim.progress import show_progress
from spacesim.reproduce.frames import places, views
from spacesim.reproduce.perform import trained
from spacesim.splat.compose import ComposeConfig, PlacedRun, Pose

SCENE = {"sun": [(45.0, 35.0)], "test_suns": 0, "views": 100, "test_views": 20, "resolution": 256}
SAMPLES = {"spp": 64, "test_spp": 256}
MODELS = 1, 3  #: of a frame


def main() -> None:
    parser = common.arguments(__doc__, "repeats")
    parser.add_argument("--out", type=Path, required=True, help="where data and runs are, or are made")
    parser.add_argument("--data", type=Path, help="a dataset in place of its own")
    parser.add_argument("--preset", default="thesis")
    parser.add_argument("--rays", type=common.positive, default=4096, help="of a step")
    parser.add_argument("--iterations", type=common.positive, help="default: the preset's")
    parser.add_argument("--pixels", type=common.positive, default=512, help="of a frame's side")
    parser.add_argument("--splats", action="store_true", help="train splats, too; draw both in one scene")
    parser.add_argument("--peers", choices=["nerfacc"], help="measured beside ours; needs CUDA and the peer")
    options = parser.parse_args()
    name = backend.select(options.backend)
    data = read_dataset(options.data or common.generated("boxsat", options.out / "data", **SCENE, **SAMPLES))
    config = methods.shortened(methods.preset(options.preset, "nerf"), options.iterations)
    config = replace(config, rays=options.rays)
    run = cast(NerfRun, trained(options.out / "run", data, config, "nerf", show_progress))
    duration = float(run.training["seconds"])
    rows = [
        {"": f"spacesim, {options.preset}", **trained_row(step_time(data, run, options.repeats), duration, run, data)}
    ]
    if options.peers and load_peer(options.peers, name, "support.peer_nerfacc"):
        rows += measured_apart(data, options.rays, config.iterations, options.repeats)
    frames = list(frame_rows(run, data, options.pixels))
    tables = {"Training": rows, f"A frame of {options.pixels} pixels": frames}
    results = {"training": rows, "frames": frames}
    if options.splats:
        splats = methods.shortened(methods.preset("fast", "vanilla"), options.iterations)
        model = trained(options.out / "splats", data, splats, "splats", show_progress)
        rows.append({"": "splats, fast", "training, s": model.training["seconds"], **quality(model, data)})
        results["mixed"] = tables["Field and splats through each other"] = [mixed_row(run, model, data)]
    common.emit(results, tables, options)


def measured_apart(data: Dataset, *sizes: int) -> list[common.Row]:
    """The peer's row, measured in a process of its own: its libraries may end the process they are in."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        try:
            return [pool.submit(peer_row, data, *sizes).result()]
        except BrokenProcessPool:
            print("nerfacc: not measured here (its process ended without a word)", file=sys.stderr)
            return []


def peer_row(data: Dataset, rays: int, iterations: int, repeats: int) -> common.Row:
    from support.peer_nerfacc import Training

    theirs = Training(data, rays, iterations)
    start = time.perf_counter()
    theirs.run()
    duration = time.perf_counter() - start
    return {"": "nerfacc", **trained_row(step_timing(theirs.step, 2, repeats), duration, theirs, data)}


def step_time(data: Dataset, run: NerfRun, repeats: int) -> common.Timing:
    """Of a step of the trained model, in turns of `proposals_every`, whose steps differ."""
    trainer = NerfTrainer(data, replace(run.networks.config, occupancy_every=10**6))
    trainer.parameters = [value + 0 for value in run.parameters]
    trainer.filled = run.filled + 0
    dr.eval(trainer.parameters, trainer.filled)
    trainer.iteration = trainer.proposal_steps = trainer.config.warm_up
    return step_timing(trainer.step, trainer.config.proposals_every, repeats)


def step_timing(step: Callable[[], Any], turn: int, repeats: int) -> common.Timing:
    """Of `step`, so many a turn."""
    return common.Timing.of(common.in_a_row({"": step}, repeats, turn, common.WARM_UP)[""])


def trained_row(step: common.Timing, duration: float, model: Any, data: Dataset) -> common.Row:
    return {"step, ms": step.median, "training, s": duration, **quality(model, data)}


def quality(model: Any, data: Dataset) -> common.Row:
    """Means over the test views, dB."""
    whole, inside = [], []
    for frame in data.test:
        images, _ = frame_images(data, frame, model.predict(frame.camera))
        whole.append(image.psnr(images.prediction, images.truth))
        inside.append(image.psnr(images.prediction, images.truth, images.silhouette))
    return {"PSNR": _mean(whole), "over the silhouette": _mean(inside)}


def mixed_row(field: NerfRun, splats: Any, data: Dataset) -> common.Row:
    """PSNR over covered pixels, and the share of them that differ by more than a tenth."""
    aside = Pose(translation=np.array([field.box.side / 10, 0.0, 0.0]))
    models = PlacedRun(field, Pose()), PlacedRun(splats, aside)  # type: ignore[arg-type]
    drawers = [methods.compose(some, ComposeConfig("none")) for some in (models, models[:1], models[1:])]
    squares, off, count = 0.0, 0, 0
    for frame in data.test:
        both, *each = (drawer.predict(frame.camera, frame.sun) for drawer in drawers)
        depths = [np.where(one.alpha > 0.01, one.depth, np.inf) for one in each]
        nearer = (depths[0] <= depths[1])[..., None]
        front, back = (np.where(nearer, a, b) for a, b in ((each[0].rgb, each[1].rgb), (each[1].rgb, each[0].rgb)))
        through = 1 - np.where(nearer[..., 0], each[0].alpha, each[1].alpha)[..., None]
        difference = np.abs(both.rgb - front - through * back)[both.alpha > 0.5]
        squares += float(np.square(difference, dtype=np.float64).sum())
        off, count = off + int((difference.max(axis=1) > 0.1).sum()), count + len(difference)
    psnr = -10 * np.log10(max(squares / (3 * max(count, 1)), 1e-12))
    return {"PSNR": float(psnr), "off by a tenth, %": 100 * off / max(count, 1)}


def frame_rows(run: NerfRun, data: Dataset, pixels: int) -> Iterator[common.Row]:
    """Of one model as cameras of the data see it, and of some from where all of them fit."""
    for count in MODELS:
        placed = [PlacedRun(run, Pose(translation=place)) for place in places(data)[:count]]  # type: ignore[arg-type]
        scene = run if count == 1 else FieldComposition(placed, ComposeConfig("none"))
        frames = data.test[:9] if count == 1 else views(data)
        seconds = [_timed(scene, _sized(frame, pixels)) for frame in (*frames[:2], *frames)][2:]
        yield {"models": count, "frame, ms": 1e3 * float(np.median(seconds))}


def _timed(scene: Any, frame: Frame) -> float:
    start = time.perf_counter()
    drawn: Prediction = scene.predict(frame.camera, frame.sun)
    assert np.isfinite(drawn.rgb).all()
    return time.perf_counter() - start


def _sized(frame: Frame, pixels: int) -> Frame:
    camera, scale = frame.camera, pixels / frame.camera.width
    lens = {name: getattr(camera, name) * scale for name in ("fx", "fy", "cx", "cy")}
    return replace(frame, camera=replace(camera, width=pixels, height=round(camera.height * scale), **lens))


def _mean(values: list[float | None]) -> float:
    return float(np.mean([value for value in values if value is not None]))


if __name__ == "__main__":
    common.run_main(main)
