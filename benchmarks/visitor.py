"""A client of the viewer without a browser: it knows controls by their labels, as a user does, and does what users do.

    python benchmarks/visitor.py URL [--seconds 600] [--clients 2] [--side 512]

So many clients turn round the scene for so long, change Sun, poses, scales, modes, the window's size and resolution,
ask for the truth and for PNGs, make and play camera paths, show cameras, jump to frames, leave without a word and come
back. Prints how many pictures they got. It is a process of its own, so that the viewer's memory is the viewer's alone.
"""

import argparse
import itertools
import json
import logging
import socket
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any

import msgspec
import numpy as np
import viser
import zstandard
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.sync.client import ClientConnection, connect

from spacesim.data.geometry import look_at, quaternion_from_rotation
from spacesim.viewer.panels.handles import HANDLES

FOV = float(np.radians(35))
STAY = 20.0  #: seconds until a client leaves and comes back
SHARE = 0.05  #: of the pictures, after which a client does something else than look
PATIENCE = 60.0  #: seconds that a picture may take
SIDES = (256, 512)  #: of "Resolution" that are chosen
SILENT = logging.getLogger("visitor")  #: of websockets, which is alarmed by a client that leaves without a word
SILENT.addHandler(logging.NullHandler())
SILENT.propagate = False


def windows(side: int) -> tuple[tuple[int, int], ...]:
    """(width, height) of windows of clients that look around, pixels."""
    return (side, side), (side, side * 3 // 4), (side * 3 // 4, side)


def places(centre: np.ndarray, distance: float, start: int = 0) -> Iterator[np.ndarray]:
    """Poses [4, 4] of a camera that goes round `centre`, metres, for ever."""
    for k in itertools.count(start):
        angle = 0.05 * k
        yield look_at(centre + distance * np.array([np.cos(angle), np.sin(angle), 0.4]), centre)


class Visitor:
    """One client. window: (width, height), pixels

    controls: what the panel holds, by label: messages of viser
    handles: names of gizmos
    first: (position, what it looks at) that the viewer proposes
    """

    def __init__(self, url: str, window: tuple[int, int]) -> None:
        url = url.replace("http", "ws", 1)
        version: Any = [f"viser-v{viser.__version__}"]
        self.socket: ClientConnection = connect(
            url, subprotocols=version, compression=None, max_size=None, logger=SILENT
        )
        self.window, self._unzip = window, zstandard.ZstdDecompressor()
        self.controls: dict[str, dict[str, Any]] = {}
        self.handles: dict[str, list[float]] = {}
        self.first: dict[str, np.ndarray] = {}
        self.files = 0  # that were sent whole
        self.shown = b""  # the last picture, a file

    def look_from(self, pose: np.ndarray) -> None:
        """Look from a pose [4, 4]."""
        place, turn = pose[:3, 3], quaternion_from_rotation(pose[:3, :3])
        width, height = self.window
        self.tell(
            "ViewerCameraMessage",
            wxyz=turn.tolist(),
            position=place.tolist(),
            fov=FOV,
            near=0.01,
            far=1000.0,
            image_width=width,
            image_height=height,
            look_at=(place + pose[:3, 2]).tolist(),
            up_direction=[0.0, 0.0, 1.0],
        )

    def begin(self) -> tuple[np.ndarray, np.ndarray]:
        """Look from where the viewer proposes, until there is a picture and a panel: (position, what is looked at)."""
        self.picture(lambda: len(self.first) == 2)
        place, centre = self.first["position"], self.first["look_at"]
        self.look_from(look_at(place, centre))
        while "Mode" not in self.controls:
            self.picture(lambda: "Mode" in self.controls)
        return place, centre

    def tell(self, kind: str, **values: Any) -> None:
        """Send a message of viser's."""
        self.socket.send(msgspec.msgpack.encode({"type": kind, **values}))

    def use(self, label: str, value: Any = True) -> None:
        """Use a control, if there is one of that label."""
        control = self.controls.get(label)
        if control is not None:
            self.tell("GuiUpdateMessage", uuid=control["uuid"], updates={"value": value})

    def drag(self, name: str, offset: np.ndarray) -> None:
        """Put a gizmo `offset` [3] metres from where it was at first."""
        position = (np.array(self.handles[name]) + offset).tolist()
        self.tell("TransformControlsUpdateMessage", name=name, wxyz=[1.0, 0, 0, 0], position=position, owner="")

    def picture(self, until: Callable[[], bool] | None = None, patience: float = PATIENCE) -> None:
        """Wait for the next one, or until something else is so. Raises TimeoutError after so many seconds."""
        while True:
            data = self.socket.recv(timeout=patience)
            assert isinstance(data, bytes)
            size = int.from_bytes(data[8:16], "little")
            messages = msgspec.msgpack.decode(self._unzip.decompress(data[16 : 16 + size]))["messages"]
            seen = [self._take(message) for message in messages]
            if any(seen) or (until is not None and until()):
                return

    def _take(self, message: dict[str, Any]) -> bool:
        """Whether it is a picture."""
        kind = message["type"]
        label = message.get("props", {}).get("label") if kind.startswith("Gui") else None
        if label is not None:
            self.controls[label] = message
        elif kind == "SetPositionMessage" and message["name"].startswith(f"{HANDLES}/models/"):
            self.handles.setdefault(message["name"], message["position"])
        elif kind in ("SetCameraPositionMessage", "SetCameraLookAtMessage") and message["initial"]:
            key = "position" if "position" in message else "look_at"
            self.first[key] = np.array(message[key])
        elif kind == "FileTransferStartDownload":
            self.files += 1
        is_picture = kind == "BackgroundImageMessage" and bool(message["rgb_data"])
        self.shown = message["rgb_data"] if is_picture else self.shown
        return is_picture

    def leave(self) -> None:
        """Without a word."""
        with suppress(OSError):
            self.socket.socket.shutdown(socket.SHUT_RDWR)
        with suppress(OSError, ConnectionClosed):
            self.socket.close()


def act(visitor: Visitor, rng: np.random.Generator, side: int) -> None:
    """Something that a user does."""
    controls = visitor.controls

    def number(label: str, low: float, high: float) -> None:
        visitor.use(label, float(rng.uniform(low, high)))

    def choice(label: str, options: Any) -> None:
        visitor.use(label, options[int(rng.integers(len(options)))])

    def scale() -> None:
        fields = [label for label in controls if label.startswith("Scale of ")]
        if fields:  # one model alone has none
            label = fields[int(rng.integers(len(fields)))]
            visitor.use(label, float(controls[label]["value"]) * float(rng.uniform(0.7, 1.4)))

    def shift() -> None:
        names = sorted(visitor.handles)
        reach = 0.1 * float(np.linalg.norm(visitor.first["position"] - visitor.first["look_at"]))
        if names:
            visitor.drag(names[int(rng.integers(len(names)))], reach * rng.normal(size=3))

    def window() -> None:
        visitor.window = windows(side)[int(rng.integers(3))]

    def frame() -> None:
        if "Frame" in controls:
            visitor.use("Frame", int(rng.integers(controls["Frame"]["props"]["max"] + 1)))
            visitor.use("Go to frame")

    actions: list[Callable[[], None]] = [
        *2 * [lambda: number("Azimuth", 0, 360), lambda: number("Elevation", -30, 90)],
        *4 * [shift],
        *2 * [scale, window, frame],
        *4 * [lambda: choice("Mode", controls["Mode"]["props"]["options"])],
        lambda: choice("Resolution", [str(one) for one in SIDES]),
        lambda: visitor.use("Reset poses"),
        lambda: choice("Cameras", [True, False]),
        lambda: visitor.use("Add this view"),
        lambda: choice("With Sun and poses", [True, False]),
        lambda: number("Time", 0, 1),
        lambda: visitor.use("Play / stop"),
        lambda: visitor.use("Orbit / stop"),
        lambda: visitor.use("Remove all"),
        lambda: visitor.use("Picture (PNG)"),
        lambda: choice("Compare", ["off", "off", "wipe", "beside", "difference"]),
        lambda: number("Wipe", 0, 1),
    ]
    actions[int(rng.integers(len(actions)))]()


def visit(url: str, number: int, side: int, until: float) -> int:
    """Pictures that client `number` got until a moment of time.monotonic()."""
    rng, count = np.random.default_rng(number), 0
    while time.monotonic() < until:
        visitor = Visitor(url, windows(side)[int(rng.integers(3))])
        leave = min(until, time.monotonic() + STAY)
        try:
            place, centre = visitor.begin()
            camera = places(centre, float(np.linalg.norm(place - centre)), int(rng.integers(1000)))
            while time.monotonic() < leave:
                visitor.look_from(next(camera))
                visitor.picture()
                count += 1
                if rng.random() < SHARE:
                    act(visitor, rng, side)
        except (ConnectionClosed, TimeoutError):
            pass
        visitor.leave()
    return count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("url")
    parser.add_argument("--seconds", type=float, default=600)
    parser.add_argument("--clients", type=int, default=2)
    parser.add_argument("--side", type=int, default=512, help="pixels of the windows' longer side (512)")
    options = parser.parse_args()
    try:
        Visitor(options.url, windows(options.side)[0]).leave()
    except (OSError, WebSocketException) as error:
        print(f"{options.url}: expected the address of a viewer, found none ({error})", file=sys.stderr)
        sys.exit(2)
    until = time.monotonic() + options.seconds
    with ThreadPoolExecutor(options.clients) as pool:
        visits = [pool.submit(visit, options.url, number, options.side, until) for number in range(options.clients)]
    print(json.dumps({"pictures": [one.result() for one in visits]}))


if __name__ == "__main__":
    main()
