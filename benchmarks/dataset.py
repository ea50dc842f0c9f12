"""How fast datasets are made, beside Mitsuba's own rendering, and whether memory stays level.

    python benchmarks/dataset.py [--backend auto] [--scene boxsat] [--resolution PX] [--workers 1,4] [--views 40]
    python benchmarks/dataset.py --frames 10000       memory after 100, 1,000, ... tiny frames in one process

Rows: `mi.render` of the same scene, views, samples and depth with a box filter as ours, frame by frame in turn with it;
our radiance alone (it sums pixel by pixel in a fixed order and comes back as numpy); radiance with all labels, part of
which are prepared while paths are traced; the labels alone; and whole frames with everything on the disk, in one
process and in several. Start-up and compilation do not count: what is timed begins after the first frames.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
from support import common

from spacesim import backend
from spacesim.backend.memory import keep_freed_memory
from spacesim.data.errors import InputError
from spacesim.data.geometry import OPENCV_FROM_MITSUBA
from spacesim.data.records import Camera
from spacesim.data.store import WrittenFrame
from spacesim.scenes.build import build
from spacesim.scenes.cameras.kernel_camera import Units
from spacesim.scenes.generation.frames import FrameMaker, FrameSpec, Job, cores, writing_threads
from spacesim.scenes.generation.generate import plan_views
from spacesim.scenes.generation.workers import make_in_processes
from spacesim.scenes.render import Renderer
from spacesim.scenes.scene import load
from spacesim.scenes.scenefile import read_scene

WARM = 3  #: frames before the clock starts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--backend", choices=backend.NAMES, default="auto")
    parser.add_argument("--scene", default="boxsat")
    parser.add_argument("--resolution", type=common.positive, help="default: 256 on LLVM, 512 on CUDA")
    parser.add_argument("--spp", type=common.positive, default=64)
    parser.add_argument("--views", type=common.positive, default=40, help="frames of each measurement (40)")
    parser.add_argument("--workers", type=counts, default=[1], help="numbers of processes, as 1,2,4 (1)")
    parser.add_argument("--frames", type=common.positive, help="measure memory over so many tiny frames instead")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    name = backend.select(options.backend)
    keep_freed_memory()  # as the command does
    if options.frames:
        report: dict[str, Any] = {"backend": name, "memory": memory(options.scene, options.frames)}
    else:
        size = options.resolution or {"llvm": 256, "cuda": 512}[name]
        report = {"backend": name, "cores": cores(), "scene": options.scene, "pixels": size, "spp": options.spp}
        report |= speed(options.scene, size, options.spp, options.views, options.workers)
    print(json.dumps(report, indent=1) if options.json else describe(report))


def counts(text: str) -> list[int]:
    """Whole numbers of at least 1, as "1,2,4", for argparse."""
    return [common.positive(count) for count in text.split(",")]


def planned(scene: str, **changes: Any) -> tuple[Renderer, Job, list[FrameSpec]]:
    """The renderer of a scene, what a process that makes its frames has to know, and its training frames."""
    config = read_scene(scene, **changes, test_views=0)
    built, quality = build(config), config.quality
    renderer = Renderer(built, quality.spp, quality.max_depth, config.camera.distortion)
    views, _ = plan_views(built, config)
    shots = [FrameSpec(i, name, view.camera, view.sun, quality.spp) for i, (name, view) in enumerate(views)]
    return renderer, Job(built, config.camera, quality, config.seed, Path(), writing_threads(1)), shots


def speed(scene: str, size: int, spp: int, views: int, workers: list[int]) -> dict[str, Any]:
    """Milliseconds a frame of each way of rendering, and the ratios that are evaluated."""
    renderer, job, shots = planned(scene, views=views + WARM, resolution=(size, size), spp=spp)
    shots, loaded = shots[: views + WARM], load(job.scene)
    mi = backend.mitsuba()
    integrator = mi.load_dict({"type": "path", "max_depth": job.quality.max_depth, "hide_emitters": True})
    times: dict[str, list[float]] = {"mi.render": [], "radiance": [], "radiance and labels": [], "labels": []}
    for shot in shots:
        view, what = sensor(shot.camera, loaded.units), (shot.camera, shot.sun)
        loaded.point(shot.sun)

        def raw(view: Any = view, seed: int = shot.index) -> None:
            for source in filter(None, (loaded.sunlit, loaded.earthlit)):
                dr.eval(mi.render(source, sensor=view, integrator=integrator, spp=spp, seed=seed))

        seed = job.seed, shot.index
        times["mi.render"].append(milliseconds(raw))
        times["radiance"].append(milliseconds(partial(renderer.radiance, *what, seed)))
        times["radiance and labels"].append(milliseconds(partial(renderer.render, *what, seed)))
        times["labels"].append(milliseconds(partial(renderer.labels, *what)))
    mean = {key: float(np.mean(values[WARM:])) for key, values in times.items()}
    for count in workers:
        with tempfile.TemporaryDirectory() as folder:
            job = replace(job, root=Path(folder))
            made = FrameMaker(job, renderer).make(shots) if count == 1 else make_in_processes(job, shots, count)
            key = "written" if count == 1 else f"written, {count} processes"
            mean[key] = milliseconds_a_frame(made, WARM if count == 1 else 4 * count)
    written = min(value for key, value in mean.items() if key.startswith("written"))
    return {
        "milliseconds": mean,
        "frames_per_second": {key: 1e3 / value for key, value in mean.items()},
        "written_to_raw": mean["mi.render"] / written,
        "labels_to_radiance": mean["radiance and labels"] / mean["radiance"] - 1,
    }


def sensor(camera: Camera, units: Units) -> Any:
    """`camera` in Mitsuba. With its default filter, a Gaussian, `mi.render` takes a quarter longer on two cores."""
    mi = backend.mitsuba()
    placed = camera.world_from_camera.copy()
    placed[:3, 3] = units.points(placed[:3, 3])
    fov = float(np.degrees(2 * np.arctan(0.5 * camera.width / camera.fx)))
    pose = mi.ScalarTransform4f((placed @ OPENCV_FROM_MITSUBA).tolist())
    film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}}
    return mi.load_dict({"type": "perspective", "fov": fov, "fov_axis": "x", "to_world": pose, "film": film})


def milliseconds(work: Any) -> float:
    dr.sync_thread()
    start = time.perf_counter()
    work()
    dr.sync_thread()
    return 1e3 * (time.perf_counter() - start)


def milliseconds_a_frame(frames: Iterator[WrittenFrame], skipped: int) -> float:
    """Of frames as they come, without the first ones."""
    moments = [time.perf_counter() for _ in frames]
    if len(moments) <= skipped + 1:
        raise InputError(f"--views: expected at least {skipped + 2 - WARM} with so many processes")
    return 1e3 * (moments[-1] - moments[skipped]) / (len(moments) - 1 - skipped)


def memory(scene: str, frames: int) -> list[dict[str, float]]:
    """Resident memory of this process, MB, on its way through `frames` frames of 16 x 16 pixels."""
    renderer, job, shots = planned(scene, views=frames, resolution=(16, 16), spp=1)
    marks = sorted({100, *(frames * i // 10 for i in range(1, 11))})
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        maker = FrameMaker(replace(job, root=Path(folder)), renderer)
        for done, _ in enumerate(maker.make(shots), start=1):
            if done in marks:
                rows.append({"frames": done, "MB": common.resident() / 1e6, "seconds": time.perf_counter() - start})
    return rows


def describe(report: dict[str, Any]) -> str:
    """As a table."""
    if "memory" in report:
        rows = [f"{row['frames']:>8}{row['MB']:>12.1f}{row['seconds']:>10.1f}" for row in report["memory"]]
        return "\n".join([f"{'frames':>8}{'memory, MB':>12}{'seconds':>10}", *rows])
    head = (
        f"{report['scene']}, {report['pixels']} px, {report['spp']} spp, {report['backend']}, {report['cores']} cores"
    )
    lines = [head, f"{'':<24}{'ms a frame':>12}{'frames/s':>10}"]
    for key, value in report["milliseconds"].items():
        lines.append(f"{key:<24}{value:>12.2f}{1e3 / value:>10.1f}")
    lines.append(f"written, of mi.render's speed: {report['written_to_raw']:.0%} (CPU: at least 70%)")
    lines.append(f"what the labels add to the radiance's time: {report['labels_to_radiance']:.0%} (at most 15%)")
    return "\n".join(lines)


if __name__ == "__main__":
    common.run_main(main)
