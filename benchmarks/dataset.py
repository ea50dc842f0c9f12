"""How fast datasets are made, beside Mitsuba's own rendering, and whether memory stays level.

    python benchmarks/dataset.py [--backend auto] [--scene boxsat] [--resolution PX] [--spp 64] [--workers 1,4]
                                 [--views 40] [--json] [--markdown]
    python benchmarks/dataset.py --frames 10000       memory after 100, 1,000, ... tiny frames in one process

Rows: `mi.render` of the same scene, views, samples and depth with a box filter as ours, frame by frame in turn with it;
our radiance alone (it sums pixel by pixel in a fixed order and comes back as numpy); radiance with all labels, part of
which are prepared while paths are traced; the labels alone; and whole frames with everything on the disk, in one
process and in several. Medians and quartiles over frames; those on the disk come in bursts, and are timed by rounds, in
each of which every way of one process has its turn. Several processes, which take long to start, are timed once, after
them. Start-up and compilation do not count: what is timed begins after the first frames.
"""

import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import islice
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
from spacesim.scenes.scene import MitsubaScene, load
from spacesim.scenes.scenefile import read_scene

WARM = 3  #: frames before the clock starts
ROUNDS = 4  #: parts of the frames; each way has its turn in each


def main() -> None:
    parser = common.arguments(__doc__)
    parser.add_argument("--scene", default="boxsat")
    parser.add_argument("--resolution", type=common.positive, help="default: 256 on LLVM, 512 on CUDA")
    parser.add_argument("--spp", type=common.positive, default=64)
    parser.add_argument("--views", type=common.positive, default=40, help="frames of each measurement (40)")
    parser.add_argument("--workers", type=counts, default=[1], help="numbers of processes, as 1,2,4 (1)")
    parser.add_argument("--frames", type=common.positive, help="measure memory over so many tiny frames instead")
    options = parser.parse_args()
    name = backend.select(options.backend)
    keep_freed_memory()  # as the command does
    if options.frames:
        rows = memory(options.scene, options.frames)
        return common.emit({"memory": rows}, {"Resident memory": rows}, options)
    size = options.resolution or {"llvm": 256, "cuda": 512}[name]
    found = speed(options.scene, size, options.spp, options.views, options.workers)
    written, labels = (f"{found[name]:.0%}" for name in ("written_to_raw", "labels_to_radiance"))
    ratios = [
        {"ratio": "written, of mi.render's speed", "found": written},
        {"ratio": "labels, of radiance's time", "found": labels},
    ]
    report = {"cores": cores(), "scene": options.scene, "pixels": size, "spp": options.spp, **found}
    title = f"{options.scene}, {size} x {size} pixels, {options.spp} samples, {cores()} cores: median (quartiles)"
    common.emit(report, {title: found["rows"], "Ratios": ratios}, options)


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
    rounds = min(ROUNDS, views)
    count = views + 2 * WARM * rounds
    renderer, job, shots = planned(scene, views=count, resolution=(size, size), spp=spp)
    counted, around, loaded = shots[:views], iter(shots[views:count]), load(job.scene)
    first = list(islice(around, WARM))
    seconds = dict[str, list[float]]()
    written, raw = list[float](), list[float]()  # of each round, seconds a frame
    with tempfile.TemporaryDirectory() as folder:
        maker = FrameMaker(replace(job, root=Path(folder)), renderer)
        for shot in first:
            common.seconds(ways(shot, renderer, loaded, job), 1, warm_up=0)
        for k in range(rounds):
            own = counted[k::rounds]
            found = [common.seconds(ways(shot, renderer, loaded, job), 1, warm_up=0) for shot in own]
            for way in found[0]:
                seconds.setdefault(way, []).extend(frame[way][0] for frame in found)
            raw.append(float(np.mean([frame["mi.render"] for frame in found])))
            if 1 in workers:
                before, after = list(islice(around, WARM)) if k else first, list(islice(around, WARM))
                written.append(seconds_a_frame(maker.make([*before, *own, *after]), WARM, WARM))
    timings = {way: common.Timing.of(values) for way, values in seconds.items()}
    rows = [{"way": way, "ms a frame": timing, "frames/s": 1e3 / timing.median} for way, timing in timings.items()]
    shares = []
    if written:
        timing = common.Timing.of(written)
        rows.append({"way": "written", "ms a frame": timing, "frames/s": 1e3 / timing.median})
        shares.append(np.median(np.divide(raw, written)))
    for processes in filter(lambda number: number > 1, workers):
        with tempfile.TemporaryDirectory() as folder:
            made = make_in_processes(replace(job, root=Path(folder)), first + counted, processes)
            taken = seconds_a_frame(made, 4 * processes)
        rows.append({"way": f"written, {processes} processes", "ms a frame": 1e3 * taken, "frames/s": 1 / taken})
        shares.append(np.mean(raw) / taken)
    labels = timings["radiance and labels"].median / timings["radiance"].median - 1
    return {"rows": rows, "written_to_raw": float(max(shares)), "labels_to_radiance": labels}


def ways(shot: FrameSpec, renderer: Renderer, loaded: MitsubaScene, job: Job) -> dict[str, common.Work]:
    """What renders a frame in one way and another; `loaded` is where the frame has the Sun."""
    mi = backend.mitsuba()
    integrator = mi.load_dict({"type": "path", "max_depth": job.quality.max_depth, "hide_emitters": True})
    view, what, seed = sensor(shot.camera, loaded.units), (shot.camera, shot.sun), (job.seed, shot.index)
    loaded.point(shot.sun)

    def raw() -> None:
        for source in filter(None, (loaded.sunlit, loaded.earthlit)):
            dr.eval(mi.render(source, sensor=view, integrator=integrator, spp=job.quality.spp, seed=shot.index))

    return {
        "mi.render": raw,
        "radiance": partial(renderer.radiance, *what, seed),
        "radiance and labels": partial(renderer.render, *what, seed),
        "labels": partial(renderer.labels, *what),
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


def seconds_a_frame(frames: Iterator[WrittenFrame], before: int, after: int = 0) -> float:
    """Of frames as they come, without so many before and after those that count: the last ones come sooner."""
    moments = [time.perf_counter() for _ in frames]
    counted = len(moments) - before - after
    if counted < 1:
        raise InputError(f"--views: expected at least {before + 1 - WARM} with so many processes")
    return (moments[before + counted - 1] - moments[before - 1]) / counted


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


if __name__ == "__main__":
    common.run_main(main)
