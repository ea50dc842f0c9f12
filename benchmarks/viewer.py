"""How fast the viewer draws, and whether hours of looking around leave its memory as it was.

    python benchmarks/viewer.py [RUN|SCENE.toml] [--gaussians 30000] [--side 512] [--seconds 600] [--clients 2]

Without a run the scene is the sphere of random splats of the other benchmarks, relightable and with shadows. "draw" is
a picture in full resolution under another camera, or another Sun or pose, numpy and colour map included; "frames/s" is
what a client over a websocket gets that moves its camera as soon as a picture has come, and the resolution that the
viewer has chosen by then. Of scenes with radiance fields, after a movement: when the first picture comes, and the one
in full resolution. Then, for --seconds, clients of another process (`visitor.py`) use every control, turn round the
scene, leave without a word and come back. Memory is what the viewer's process has in memory, files apart: the most of
all, and after each tenth of the time what is left when free memory has gone back to the system; growth is by a line
through the second half of these. Recordings are Dr.Jit's, one for each size of picture and of its lists. `--seconds 0`
leaves all that out.
"""

import gc
import io
import itertools
import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import visitor
from PIL import Image
from support import common

from spacesim import backend
from spacesim.data.errors import InputError, WorkError
from spacesim.data.records import Sun
from spacesim.progress import show_progress
from spacesim.splat.compose import GaussianComposition, PlacedRun, Pose
from spacesim.viewer.drawing.frames import draw_frame, picture_size
from spacesim.viewer.drawing.memory import give_back
from spacesim.viewer.drawing.scene_renderer import SceneRenderer
from spacesim.viewer.load import load_setup
from spacesim.viewer.server import Viewer, ViewerSetup
from spacesim.viewer.state import SIDES, DisplaySettings, SceneState, ViewerCamera

EVERY = 2.0  #: seconds between two readings of the memory
PATIENCE = 90.0  #: seconds that clients may take beyond their time


def main() -> None:
    parser = common.arguments(__doc__, "repeats")
    parser.add_argument("path", type=Path, nargs="?", metavar="RUN|SCENE.toml")
    parser.add_argument("--gaussians", type=int, default=30_000, help="of the sphere (30000)")
    parser.add_argument("--side", type=int, default=512, help="pixels of the picture (512)")
    parser.add_argument("--moving", type=float, default=6, metavar="SECONDS", help="that each rate is taken over (6)")
    parser.add_argument("--seconds", type=float, default=600, help="of looking around (600)")
    parser.add_argument("--clients", type=int, default=2, help="that look around at once (2)")
    options = parser.parse_args()
    for name, least, most in (
        ("gaussians", 2, 10**8),
        ("side", 16, SIDES[-1]),
        ("clients", 1, 100),
        ("moving", 0.1, 1e6),
        ("seconds", 0, 1e6),
    ):
        if not least <= getattr(options, name) <= most:
            sys.exit(f"--{name}: expected {least} to {most:g}, found {getattr(options, name)}")
    backend.select(options.backend)
    show = load_setup(options.path) if options.path else spheres(options.gaussians)
    rows = draws(show, options.side, options.repeats)
    viewer = Viewer(show, port=0)
    viewer.start()
    modes = ("colour", "depth", "ellipsoids")
    try:
        rates = [rate(viewer, mode, options.side, options.moving) for mode in modes if mode in show.renderer.modes]
        at_rest = [rest(viewer, options.side, options.repeats)] if show.renderer.progressive else []
        soak = look_around(viewer, options.seconds, options.clients, options.side) if options.seconds > 0 else {}
    finally:
        viewer.stop()
    report = {
        "gaussians": show.renderer.gaussian_count,
        "side": options.side,
        "draw": rows,
        "rates": rates,
        "at_rest": at_rest,
        "soak": soak,
    }
    tables = {"Pictures in full resolution, ms": rows, "Frames a client gets while it moves": rates}
    tables |= {"Pictures after a movement, ms": at_rest, "Looking around": [soak] if soak else []}
    common.emit(report, tables, options)


def spheres(count: int) -> ViewerSetup:
    """Two relightable spheres of half the Gaussians each, one above the other."""
    placed = [
        PlacedRun(common.sphere_run(count // 2, k), Pose(np.eye(3), np.array([0.0, 0, height]), 0.8), f"sphere {k}")
        for k, height in enumerate((-0.9, 0.9))
    ]
    renderer = SceneRenderer(GaussianComposition(placed))
    poses = tuple(one.pose for one in placed)
    return ViewerSetup(renderer, SceneState(poses, Sun.from_angles(45, 60)), (None, None), None, Path())


def places(show: ViewerSetup) -> Iterator[np.ndarray]:
    """Poses [4, 4] of a camera that goes round the scene for ever."""
    centre, radius = show.renderer.bounds(show.state)
    return visitor.places(centre, 3.5 * radius)


def suns() -> Iterator[Sun]:
    for k in itertools.count():
        yield Sun.from_angles(7.0 * k % 360, 40)


def draws(show: ViewerSetup, side: int, repeats: int) -> list[common.Row]:
    """Milliseconds of a picture."""
    camera, sun = places(show), suns()
    still = ViewerCamera(next(places(show)), visitor.FOV, side, side)

    def turned() -> SceneState:
        pose = show.state.poses[0]
        angle = 0.05 * next(counter)
        rotation = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        return show.state.with_pose(0, Pose(rotation @ pose.rotation, pose.translation, pose.scale))

    counter = itertools.count()
    settings = DisplaySettings(side=side)

    def draw_elsewhere(mode: str) -> None:
        there = replace(still, world_from_camera=next(camera))
        draw_frame(show.renderer, show.state, there, replace(settings, mode=mode))

    works: dict[str, common.Work] = {
        f"{mode}, another camera": partial(draw_elsewhere, mode) for mode in show.renderer.modes
    }
    works["colour, another Sun"] = lambda: draw_frame(
        show.renderer, replace(show.state, sun=next(sun)), still, settings
    )
    works["colour, another pose"] = lambda: draw_frame(show.renderer, turned(), still, settings)
    timings: dict[str, common.Timing] = {}
    for name, work in works.items():  # one after another: what a change leaves as it was is not computed again
        timings |= common.interleaved({name: work}, repeats)
    return [
        {"picture": name, "ms": str(timing), "frames/s": f"{1e3 / timing.median:.1f}"}
        for name, timing in timings.items()
    ]


def rate(viewer: Viewer, mode: str, side: int, lasts: float) -> common.Row:
    """Frames a second of a client that moves all the time; the first half does not count."""
    client, camera = visitor.Visitor(viewer.url, (side, side)), places(viewer.setup)
    client.begin()
    client.use("Mode", mode)
    client.use("Resolution", str(min((one for one in SIDES if one >= side), default=SIDES[-1])))
    start, count, shares = time.monotonic(), 0, []
    while (now := time.monotonic()) < start + lasts:
        client.look_from(next(camera))
        client.picture()
        if now > start + lasts / 2:
            count += 1
            shares += [one.session._resolution.share for one in list(viewer.clients.values())]
    client.leave()
    while viewer.clients:
        time.sleep(0.01)
    return {"mode": mode, "frames/s": f"{count / (lasts / 2):.1f}", "of full resolution": f"{np.mean(shares):.2f}"}


def rest(viewer: Viewer, side: int, repeats: int) -> common.Row:
    """Milliseconds from a movement to the first picture, and to the one in full resolution."""
    client, camera = visitor.Visitor(viewer.url, (side, side)), places(viewer.setup)
    client.begin()
    most = min((one for one in SIDES if one >= side), default=SIDES[-1])
    client.use("Resolution", str(most))
    full = picture_size(ViewerCamera(next(camera), visitor.FOV, side, side), most)
    first, refined = list[float](), list[float]()
    for _ in range(common.WARM_UP + repeats):
        _finish(viewer, client)
        start = time.perf_counter()
        client.look_from(next(camera))
        client.picture()
        first.append(time.perf_counter() - start)
        while Image.open(io.BytesIO(client.shown)).size != full:
            client.picture()
        refined.append(time.perf_counter() - start)
    client.leave()
    while viewer.clients:
        time.sleep(0.01)
    timings = [str(common.Timing.of(seconds[common.WARM_UP :])) for seconds in (first, refined)]
    return {"first": timings[0], "in full resolution": timings[1]}


def _finish(viewer: Viewer, client: visitor.Visitor) -> None:
    """Take all pictures that are on their way."""
    with suppress(TimeoutError):
        while True:
            while not viewer.loop.idle:
                time.sleep(0.01)
            client.picture(patience=0.3)


def look_around(viewer: Viewer, lasts: float, clients: int, side: int) -> common.Row:
    """Memory and frames a second of clients that do all that can be done, in a process of their own."""
    command = [sys.executable, str(Path(__file__).with_name("visitor.py")), viewer.url]
    command += ["--seconds", str(lasts), "--clients", str(clients), "--side", str(side)]
    start, sizes, kept = time.monotonic(), [], list[tuple[float, float, int]]()
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE) as visitors,
        show_progress("look around", "seconds") as report,
    ):
        while visitors.poll() is None and (now := time.monotonic() - start) < lasts + PATIENCE:
            sizes.append(_megabytes())
            if now >= lasts * (len(kept) + 1) / 10:
                kept.append((now, _cache(viewer), backend.recordings()))
            report(min(int(now), int(lasts)), int(lasts), f"{sizes[-1]:.0f} MiB")
            time.sleep(min(EVERY, lasts / 20))
        output, _ = visitors.communicate(timeout=PATIENCE)
    if visitors.returncode != 0:
        raise WorkError(f"visitor.py ended with code {visitors.returncode}")
    half = kept[len(kept) // 2 :]
    slope = 60 * float(np.polyfit([now for now, _, _ in half], [size for _, size, _ in half], 1)[0])
    return {
        "seconds": round(lasts),
        "clients": clients,
        "frames": sum(json.loads(output)["pictures"]),
        "MiB at most": round(max(sizes)),
        "MiB kept after each tenth": ", ".join(f"{size:.0f}" for _, size, _ in kept),
        "recordings": ", ".join(str(count) for _, _, count in kept),
        "MiB a minute in the second half": round(slope, 2),
    }


def _cache(viewer: Viewer) -> float:
    """MiB once what is free has gone back to the system."""
    sizes, done = [], threading.Event()

    def read() -> None:
        gc.collect()
        give_back()
        sizes.append(_megabytes())
        done.set()

    viewer.loop.submit(read)
    done.wait(PATIENCE)
    return sizes[0]


def _megabytes() -> float:
    """MiB of this process that are in memory, files that it reads apart."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("RssAnon:"))
    except (OSError, StopIteration):
        raise InputError("--seconds: expected 0 where there is no /proc to read the memory from") from None


if __name__ == "__main__":
    common.run_main(main)
