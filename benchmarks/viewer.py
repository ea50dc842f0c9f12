"""How fast the viewer draws, and whether hours of looking around leave its memory as it was.

    python benchmarks/viewer.py [RUN|SCENE.toml] [--gaussians 30000] [--side 512] [--seconds 600] [--clients 2]

Without a run the scene is the sphere of random splats of the other benchmarks, relightable and with shadows. "draw" is
a picture in full resolution under another camera, or another Sun or pose, numpy and colour map included; "frames/s" is
what a client over a websocket gets that moves its camera as soon as a picture has come, and the resolution that the
viewer has chosen by then. Then, for --seconds, clients turn round the scene, move models and the Sun, change modes and
the window's size, leave without a word and come back; all kernels are compiled before. Memory is that of the process,
and its growth a line through the second half. `--seconds 0` leaves that out.
"""

import itertools
import socket
import threading
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import common
import msgspec
import numpy as np
import viser
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from spacesim import backend
from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at, quaternion_from_rotation
from spacesim.data.records import Sun
from spacesim.progress import reporting
from spacesim.splat.compose import Composition, Placed, Pose
from spacesim.splat.gaussians import Gaussians
from spacesim.splat.light import LightModel, TrainingFrame
from spacesim.splat.run import Run
from spacesim.splat.train.config import preset
from spacesim.viewer.frames import SHARES, draw
from spacesim.viewer.opened import opened
from spacesim.viewer.server import Show, Viewer
from spacesim.viewer.stage import Stage
from spacesim.viewer.state import MODES, Look, Stand, View

FOV = np.radians(35)
WINDOWS = ((512, 512), (512, 384), (384, 512))  #: of clients that look around
STAY = 20.0  #: seconds until a client leaves and comes back
EVERY = 2.0  #: seconds between two readings of the memory


def main() -> None:
    parser = common.arguments(__doc__)
    parser.add_argument("path", type=Path, nargs="?", metavar="RUN|SCENE.toml")
    parser.add_argument("--gaussians", type=int, default=30_000, help="of the sphere (30000)")
    parser.add_argument("--side", type=int, default=512, help="pixels of the picture (512)")
    parser.add_argument("--seconds", type=float, default=600, help="of looking around (600)")
    parser.add_argument("--clients", type=int, default=2, help="that look around at once (2)")
    options = parser.parse_args()
    backend.select(options.backend)
    show = opened(options.path) if options.path else spheres(options.gaussians)
    rows = draws(show, options.side, options.repeats)
    if options.seconds > 0:
        warm(show)
    viewer = Viewer(show, port=0)
    viewer.start()
    try:
        rates = [rate(viewer, mode, options.side) for mode in ("colour", "depth", "ellipsoids")]
        soak = look_around(viewer, options.seconds, options.clients) if options.seconds > 0 else {}
    finally:
        viewer.stop()
    report = {"gaussians": show.stage.gaussians, "side": options.side, "draw": rows, "rates": rates, "soak": soak}
    tables = {"Pictures in full resolution, ms": rows, "Frames a client gets while it moves": rates}
    common.emit(report, {**tables, "Looking around": [soak] if soak else []}, options)


def spheres(count: int) -> Show:
    """Two relightable spheres of half the Gaussians each, one above the other."""
    config = preset("demo", "shadow-map").light
    assert config is not None
    placed = []
    for k, height in enumerate((-0.9, 0.9)):
        arrays = {**common.sphere_arrays(count // 2, k), "sh": np.zeros((count // 2, 0, 3))}
        rng = np.random.default_rng(k)
        arrays["features"] = rng.normal(size=(count // 2, config.features)).astype(np.float32)
        light = LightModel.initial(config, TrainingFrame(np.zeros(3), 1.0, common.DISTANCE, 1.0), k)
        run = Run(Path(f"sphere{k}"), {"method": "shadow-map"}, {}, Gaussians.from_numpy(arrays), 0, light)
        placed.append(Placed(run, Pose(translation=np.array([0.0, 0, height]), scale=0.8), f"sphere {k}"))
    stage = Stage(Composition(placed))
    poses = tuple(one.pose for one in placed)
    return Show(stage, Stand(poses, Sun.from_angles(45, 60)), (None, None), None, Path())


def places(show: Show) -> Any:
    """Poses [4, 4] of a camera that goes round the scene for ever."""
    centre, radius = show.stage.bounds(show.stand)
    for k in itertools.count():
        angle = 0.05 * k
        offset = np.array([np.cos(angle), np.sin(angle), 0.4])
        yield look_at(centre + 3.5 * radius * offset, centre)


def suns() -> Any:
    for k in itertools.count():
        yield Sun.from_angles(7.0 * k % 360, 40)


def draws(show: Show, side: int, repeats: int) -> list[common.Row]:
    """Milliseconds of a picture."""
    camera, sun = places(show), suns()
    still = View(next(places(show)), float(FOV), side, side)

    def turned() -> Stand:
        pose = show.stand.poses[0]
        angle = 0.05 * next(counter)
        rotation = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        return show.stand.placed(0, Pose(rotation @ pose.rotation, pose.translation, pose.scale))

    counter = itertools.count()
    look = Look(side=side)
    works: dict[str, common.Work] = {
        f"{mode}, another camera": lambda mode=mode: draw(
            show.stage, show.stand, replace(still, world_from_camera=next(camera)), replace(look, mode=mode)
        )
        for mode in MODES
    }
    works["colour, another Sun"] = lambda: draw(show.stage, replace(show.stand, sun=next(sun)), still, look)
    works["colour, another pose"] = lambda: draw(show.stage, turned(), still, look)
    found: dict[str, common.Timing] = {}
    for name, work in works.items():  # one after another: what a change leaves as it was is not computed again
        found |= common.interleaved({name: work}, repeats)
    return [
        {"picture": name, "ms": str(timing), "frames/s": f"{1e3 / timing.median:.1f}"} for name, timing in found.items()
    ]


def warm(show: Show) -> None:
    """Compile every kernel that looking around needs: memory shall tell of what is lost, not of these."""
    camera = places(show)
    for (width, height), mode, share in itertools.product(WINDOWS, MODES, SHARES):
        view = View(next(camera), float(FOV), width, height)
        draw(show.stage, show.stand, view, Look(mode), share)


class Visitor:
    """A client without a browser."""

    def __init__(self, viewer: Viewer, window: tuple[int, int]) -> None:
        url = viewer.url.replace("http", "ws")
        versions = [f"viser-v{viser.__version__}"]
        self.socket: ClientConnection = connect(url, subprotocols=versions, compression=None, max_size=None)  # type: ignore[arg-type]
        self.window, self.unzip = window, zstandard.ZstdDecompressor()

    def look(self, pose: np.ndarray) -> None:
        """Look from a pose [4, 4]."""
        place, turn = pose[:3, 3], quaternion_from_rotation(pose[:3, :3])
        width, height = self.window
        self.tell(
            "ViewerCameraMessage",
            wxyz=turn.tolist(),
            position=place.tolist(),
            fov=float(FOV),
            near=0.01,
            far=1000.0,
            image_width=width,
            image_height=height,
            look_at=(place + pose[:3, 2]).tolist(),
            up_direction=[0.0, 0.0, 1.0],
        )

    def tell(self, kind: str, **values: Any) -> None:
        self.socket.send(msgspec.msgpack.encode({"type": kind, **values}))

    def picture(self) -> None:
        """Wait for the next one."""
        while True:
            data = self.socket.recv(timeout=60)
            size = int.from_bytes(data[8:16], "little")
            messages = msgspec.msgpack.decode(self.unzip.decompress(data[16 : 16 + size]))["messages"]
            if any(message["type"] == "BackgroundImageMessage" and message["rgb_data"] for message in messages):
                return


def rate(viewer: Viewer, mode: str, side: int, lasts: float = 6.0) -> common.Row:
    """Frames a second of a client that moves all the time; the first half does not count."""
    visitor, camera = Visitor(viewer, (side, side)), places(viewer.show)
    visitor.look(next(camera))
    visitor.picture()
    session = next(iter(viewer.clients.values())).session
    session.set(mode=mode, side=side)
    start, count, shares = time.monotonic(), 0, []
    while (now := time.monotonic()) < start + lasts:
        visitor.look(next(camera))
        visitor.picture()
        if now > start + lasts / 2:
            count += 1
            shares.append(session._pace.share)
    visitor.socket.close()
    while viewer.clients:
        time.sleep(0.01)
    return {"mode": mode, "frames/s": f"{count / (lasts / 2):.1f}", "of full resolution": f"{np.mean(shares):.2f}"}


def look_around(viewer: Viewer, lasts: float, clients: int) -> common.Row:
    """Memory and frames a second of clients that do all that can be done."""
    counts, stop = [0] * clients, threading.Event()
    visitors = [threading.Thread(target=_visit, args=(viewer, k, counts, stop), daemon=True) for k in range(clients)]
    for visitor in visitors:
        visitor.start()
    start, moments, sizes = time.monotonic(), [], []
    with reporting("look around", "seconds") as report:
        while (now := time.monotonic() - start) < lasts:
            moments.append(now)
            sizes.append(_resident())
            report(int(now), int(lasts), f"{sizes[-1]:.0f} MiB")
            time.sleep(min(EVERY, lasts / 20))
    stop.set()
    for visitor in visitors:
        visitor.join(30)
    half = len(moments) // 2
    slope = float(np.polyfit(moments[half:], sizes[half:], 1)[0]) * 60
    return {
        "seconds": round(lasts),
        "clients": clients,
        "frames": sum(counts),
        "frames/s": f"{sum(counts) / lasts:.1f}",
        "MiB at first": round(sizes[0]),
        "MiB at half time": round(float(np.median(sizes[half : half + 5]))),
        "MiB at the end": round(float(np.median(sizes[-5:]))),
        "MiB a minute": round(slope, 2),
    }


def _visit(viewer: Viewer, number: int, counts: list[int], stop: threading.Event) -> None:
    rng, camera = np.random.default_rng(number), places(viewer.show)
    while not stop.is_set():
        window = WINDOWS[int(rng.integers(len(WINDOWS)))]
        visitor = Visitor(viewer, window)
        leave = time.monotonic() + STAY
        try:
            while time.monotonic() < leave and not stop.is_set():
                visitor.look(next(camera))
                visitor.picture()
                counts[number] += 1
                if rng.random() < 0.05:
                    _act(viewer, visitor, rng)
        except (ConnectionClosed, TimeoutError, OSError):
            pass
        with suppress(OSError):
            visitor.socket.socket.shutdown(socket.SHUT_RDWR)  # without a word
        visitor.socket.close()


def _act(viewer: Viewer, visitor: Visitor, rng: np.random.Generator) -> None:
    """Something that a user does."""
    kind = int(rng.integers(4))
    if kind == 0 and viewer._sun is not None:
        slider = viewer._sun.azimuth if rng.random() < 0.5 else viewer._sun.elevation
        visitor.tell("GuiUpdateMessage", uuid=slider._impl.uuid, updates={"value": float(rng.uniform(0, 90))})
    elif kind == 1:
        position = (0.3 * rng.normal(size=3) + viewer.show.stand.poses[0].translation).tolist()
        visitor.tell(
            "TransformControlsUpdateMessage", name="/models/0", wxyz=[1.0, 0, 0, 0], position=position, owner=""
        )
    elif kind == 2:
        for client in list(viewer.clients.values()):
            control = client.controls.mode
            visitor.tell(
                "GuiUpdateMessage", uuid=control._impl.uuid, updates={"value": MODES[int(rng.integers(len(MODES)))]}
            )
    else:
        visitor.window = WINDOWS[int(rng.integers(len(WINDOWS)))]


def _resident() -> float:
    """MiB of this process that are in memory."""
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * 4096 / 2**20
    except OSError:
        raise InputError("--seconds: expected 0 where there is no /proc to read the memory from") from None


if __name__ == "__main__":
    main()
