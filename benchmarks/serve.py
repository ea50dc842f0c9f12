"""How soon and how often `spacesim serve` answers, and whether many requests leave its memory as it was.

    python benchmarks/serve.py [RUN|SCENE.toml] [--gaussians 15000] [--side 512] [--spp 16] [--requests 10000]

Without a run the splats are the sphere of the other benchmarks, relit and with shadows. The scene is boxsat, path-
traced. Each is served by a thread of this process; the camera goes round, and the Sun too where it "moves". "latency"
is from a request to its picture, one at a time; "pictures/s" is with four requests on their way, and "CPU" what each of
these takes of all cores together, client included, which other work on the machine changes least. Then --requests small
pictures of the splats are asked for by four clients at once: how many came back, in order, and by how much the memory
of the process grew from a tenth of them on, free memory given back before each reading.
"""

import gc
import json
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from support import common

from spacesim import backend
from spacesim.data.errors import WorkError
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera, Sun
from spacesim.serve.client import CameraClient
from spacesim.serve.draw import PredictedRun, Served, load_served
from spacesim.serve.protocol import import_zmq
from spacesim.serve.server import serving
from spacesim.viewer.drawing.memory import give_back

SUN = Sun.from_angles(40, 25)
AHEAD, CLIENTS, SMALL = 4, 4, 16
PATIENCE = 120_000  #: milliseconds


def main() -> None:
    parser = common.arguments(__doc__, "repeats")
    parser.add_argument("path", nargs="?", metavar="RUN|SCENE.toml")
    parser.add_argument("--gaussians", type=common.positive, default=15_000, help="of the sphere (15000)")
    parser.add_argument("--side", type=common.positive, default=512, help="pixels of the pictures (512)")
    parser.add_argument("--spp", type=common.positive, default=16, help="samples a pixel of the path-traced ones (16)")
    parser.add_argument("--requests", type=common.natural, default=10_000, help="small pictures, 0 for none (10000)")
    options = parser.parse_args()
    import_zmq()
    backend.select(options.backend)
    splats, reach = served_splats(options.path, options.gaussians)
    traced = load_served("boxsat", options.spp)
    side, repeats = options.side, options.repeats
    rows = [
        {"served": name, "the Sun": "moves" if moves else "stays", **speed(what, away, side, repeats, moves)}
        for name, what, away, moves in (
            (splats.names[0], splats, reach, False),
            (splats.names[0], splats, reach, True),
            (f"boxsat, {options.spp} samples", traced, 10.0, False),
        )
    ]
    many = [lasting(splats, reach, options.requests)] if options.requests else []
    title = f"Pictures of {options.side} x {options.side}"
    common.emit({"rows": rows, "many": many}, {title: rows, "Many requests": many}, options)


def served_splats(path: str | None, count: int) -> tuple[Served, float]:
    """(what is served, metres from which it is seen whole)."""
    if path is None:
        return PredictedRun(common.sphere_run(count)), 1.2 * common.DISTANCE
    served = load_served(path)
    assert isinstance(served, PredictedRun)
    gaussians = served.run.gaussians
    if gaussians is None:
        raise WorkError(f"{path}: expected a run of Gaussians, found one without")
    places = np.linalg.norm(gaussians.to_numpy()["means"], axis=1)
    return served, 3.0 * float(np.percentile(places, 99))


def views(reach: float, side: int, sun_moves: bool = False) -> Iterator[tuple[Camera, Sun]]:
    """Round and round, never the same twice; the Sun stays or moves."""
    k = 0
    while True:
        angle = 0.1 * k
        place = reach * np.array([np.cos(angle), np.sin(angle), 0.3])
        sun = Sun.from_angles(7.0 * k % 360, 25) if sun_moves else SUN
        yield Camera.from_fov(look_at(place, np.zeros(3)), side, side, 30.0), sun
        k += 1


def speed(served: Served, reach: float, side: int, repeats: int, sun_moves: bool) -> dict[str, Any]:
    """Latency and rate."""
    asked, waits = views(reach, side, sun_moves), []
    with serving(served) as address:
        with CameraClient(address, timeout=PATIENCE / 1e3) as client:
            for _ in range(common.WARM_UP + repeats):
                (camera, sun), start = next(asked), time.perf_counter()
                client.picture(camera, sun)
                waits.append(time.perf_counter() - start)
        start, busy = time.perf_counter(), time.process_time()
        asked_together(address, asked, repeats, clients=1)
        rate, cpu = repeats / (time.perf_counter() - start), (time.process_time() - busy) / repeats
    return {"latency, ms": str(common.Timing.of(waits[common.WARM_UP :])), "pictures/s": rate, "CPU, ms": 1e3 * cpu}


def lasting(served: Served, reach: float, requests: int) -> dict[str, Any]:
    """How many of so many requests were answered in order, how fast, and by how much memory grew."""
    asked = views(reach, SMALL)
    with serving(served) as address:
        asked_together(address, asked, max(1, requests // 10), CLIENTS)
        before, start = settled(), time.perf_counter()
        answered = asked_together(address, asked, requests, CLIENTS)
        rate, grown = answered / (time.perf_counter() - start), settled() - before
    return {"requests": requests, "answered": answered, "a second": rate, "memory grew, MB": grown / 1e6}


def settled() -> float:
    """Bytes of this process when what is free has gone back to the system."""
    gc.collect()
    give_back()
    return common.resident()


def asked_together(address: str, asked: Iterator[tuple[Camera, Sun]], requests: int, clients: int) -> int:
    """Requests of several clients, each with AHEAD on their way; how many were answered in order. Raises WorkError
    where an answer stays out or is an error."""
    zmq, answered = import_zmq(), 0
    with zmq.Context() as context:
        sockets = [context.socket(zmq.DEALER) for _ in range(clients)]
        for socket in sockets:
            socket.setsockopt(zmq.LINGER, 0)
            socket.connect(address)
        for k in range(requests + AHEAD * clients):
            socket = sockets[k % clients]
            if k >= AHEAD * clients:
                if not socket.poll(PATIENCE):
                    raise WorkError(f"request {k - AHEAD * clients}: expected an answer, found none")
                header, *arrays = socket.recv_multipart()
                answer = json.loads(header)
                if "error" in answer:
                    raise WorkError(answer["error"])
                answered += answer["id"] == k - AHEAD * clients and len(arrays) == 1
            if k < requests:
                socket.send(request(k, *next(asked)))
        for socket in sockets:
            socket.close()
    return answered


def request(number: int, camera: Camera, sun: Sun) -> bytes:
    """As clients write it."""
    lens = {name: getattr(camera, name) for name in ("width", "height", "fx")}
    fields = {"camera": {"world_from_camera": camera.world_from_camera.tolist(), **lens}}
    return json.dumps({"version": 1, "id": number, "sun": sun.direction.tolist(), **fields}).encode()


if __name__ == "__main__":
    common.run_main(main)
