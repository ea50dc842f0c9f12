"""An attack on the viewer: pages of other sites, nonsense, floods and slow sockets, all on loopback.

`attack` starts a viewer of its own in another process, so that its memory can be read, and tells what got
through. After each part, while its sockets are still there, somebody who looks as people do must get a picture.
"""

import contextlib
import json
import math
import os
import random
import select
import socket
import struct
import subprocess
import sys
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

PATIENCE = 60.0  #: seconds for a picture, or for the viewer to start
ANSWER = 10.0  #: seconds for the answer to a request
MAX_MEMORY_MB = 500.0  #: MB that the viewer may take at any time, all that it needs by itself included
MEBI = 2**20

# Two balls without training. On any line of input it prints how the scene stands and which controls all clients share.
VIEWER = """
import json, sys
from pathlib import Path
import numpy as np
import spacesim
from spacesim.data.records import Sun
from spacesim.splat.compose import GaussianComposition, PlacedRun, Pose
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.run import Run
exec(sys.argv[2])
from spacesim.viewer.server import ViewerSetup, Viewer
from spacesim.viewer.drawing.scene_renderer import SceneRenderer
from spacesim.viewer.state import SceneState

rng = np.random.default_rng(0)
ways = rng.normal(size=(300, 3))
ways /= np.linalg.norm(ways, axis=1, keepdims=True)
arrays = {
    "means": 0.5 * ways,
    "log_scales": np.full((300, 3), np.log(0.06)),
    "quaternions": np.tile([1.0, 0, 0, 0], (300, 1)),
    "logit_opacities": np.full(300, 6.0),
    "sh": np.zeros((300, 1, 3), np.float32),
}
run = Run(Path("ball"), {"method": "vanilla", "data": {"path": ""}}, {}, Gaussians.from_numpy(arrays), 0)
models = [PlacedRun(run, Pose(translation=np.array([0.0, side, 0])), str(side)) for side in (-1, 1)]
state = SceneState(tuple(placed.pose for placed in models), Sun(np.array([0.0, 0, 1])))
renderer = SceneRenderer(GaussianComposition(models))
viewer = Viewer(ViewerSetup(renderer, state, (None, None), None, Path(sys.argv[1])), port=0)
viewer.start()
print(viewer.port, flush=True)
for line in sys.stdin:
    state = viewer.shared.state
    labels = {handle.label: uuid for uuid, handle in viewer._server.gui._gui_input_handle_from_uuid.items()}
    printed = {"poses": [pose.matrix.tolist() for pose in state.poses], "sun": state.sun.direction.tolist()}
    print(json.dumps({**printed, "shared": labels}), flush=True)
"""


@dataclass(frozen=True)
class AttackResult:
    """Results of an attack."""

    tried: dict[str, int]  #: attempts of each kind
    finds: list[str]  #: a sentence for each that got through
    peak: float | None  #: MB of memory that the viewer took at most, None where the system does not tell


@dataclass
class AttackedViewer:
    """A viewer in another process."""

    process: subprocess.Popen[str]
    port: int
    tried: Counter[str] = field(default_factory=Counter)
    through: dict[str, list[str]] = field(default_factory=dict)

    def state(self) -> dict[str, Any]:
        """Where models and Sun are."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write("state\n")
        self.process.stdin.flush()
        if not select.select([self.process.stdout], [], [], PATIENCE)[0]:
            raise TimeoutError("the viewer's process does not answer")
        line = self.process.stdout.readline()
        if not line:
            raise ConnectionError("the viewer's process ended")
        return json.loads(line)

    def memory(self) -> tuple[float, float] | None:
        """MB now and at most, None where the system does not tell."""
        try:
            lines = Path(f"/proc/{self.process.pid}/status").read_text().splitlines()
        except OSError:
            return None
        status = dict(line.split(":", 1) for line in lines)
        return tuple(int(status[name].split()[0]) * 1024 / 1e6 for name in ("VmRSS", "VmHWM"))

    def found(self, sentence: str, example: str = "") -> None:
        """Something got through. example: one of several that share a sentence"""
        self.through.setdefault(sentence, []).append(example)

    @property
    def finds(self) -> list[str]:
        """A sentence for each kind of thing that got through."""
        times = {
            sentence: f" ({len(all_)} times, such as {all_[0]})" for sentence, all_ in self.through.items() if all_[0]
        }
        return [sentence + times.get(sentence, "") for sentence in self.through]


@contextlib.contextmanager
def attacked_viewer(folder: Path, weakened: str = "") -> Iterator[AttackedViewer]:
    """A viewer that is up. weakened: Python that its process runs first, to see that an attack can succeed"""
    process = subprocess.Popen(
        [sys.executable, "-c", VIEWER, str(folder), weakened],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.strip().isdigit(), f"the viewer did not start: {line!r}"
        yield AttackedViewer(process, int(line))
    finally:
        process.kill()
        process.communicate()


def attack(
    seed: int, scale: float, folder: Path, parts: Sequence[Callable[..., None]] | None = None, weakened: str = ""
) -> AttackResult:
    """Parts of the attack in turn, all by default.

    scale: 1 for a run of a quarter of a minute, more for more of everything, at least 0.1;  folder: an empty one, where
    the viewer may save;  weakened: as `attacked_viewer` has it
    """
    rng = random.Random(seed)
    with attacked_viewer(folder, weakened) as one:
        honest(one, "before the attack")
        for part in PARTS if parts is None else parts:
            if one.process.poll() is not None:
                break
            with contextlib.ExitStack() as held:
                try:
                    part(one, rng, scale, held)
                except (OSError, ValueError) as error:
                    one.found(f"{part.__name__}: the viewer does not answer ({type(error).__name__}: {error})")
                honest(one, part.__name__)
        memory = one.memory()
        return AttackResult(dict(one.tried), one.finds, memory[1] if memory else None)


def honest(one: AttackedViewer, part: str) -> None:
    """Somebody looks from two places and gets pictures; memory is in bounds, the scene is one."""
    try:
        pictures(one.port)
    except Exception as error:
        one.found(f"{part}: somebody else got no picture any more ({type(error).__name__}: {error})")
    try:
        state = one.state()
    except ConnectionError:  # BrokenPipeError is one, too
        one.found(f"{part}: the viewer ended, code {one.process.wait(PATIENCE)}")
        return
    numbers = [number for pose in state["poses"] for row in pose for number in row] + state["sun"]
    if not all(map(math.isfinite, numbers)):
        one.found(f"{part}: the scene has numbers that are none")
    memory = one.memory()
    if memory is not None and memory[1] > MAX_MEMORY_MB:
        one.found(f"{part}: the viewer took {memory[1]:.0f} MB and has {memory[0]:.0f}, more than {MAX_MEMORY_MB:.0f}")


# ---- what the other end speaks ----


def version() -> str:
    """What viser's page asks for."""
    import viser

    return f"viser-v{viser.__version__}"


def request(port: int, *lines: str, upgrade: bool = True, path: str = "/", host: str | None = "") -> bytes:
    """A request of a page. lines: more headers;  host: "" for the one that is right, None for none"""
    hosts = [] if host is None else [f"Host: {host or f'127.0.0.1:{port}'}"]
    socketed = ("Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13")
    key = ("Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", f"Sec-WebSocket-Protocol: {version()}")
    head = [f"GET {path} HTTP/1.1", *hosts, *(socketed + key if upgrade else ()), *lines]
    return "\r\n".join([*head, "", ""]).encode("utf-8", "surrogateescape")


def frame(payload: bytes, opcode: int = 2, fin: bool = True, bits: int = 0, masked: bool = True) -> bytes:
    """A frame of RFC 6455. bits: the reserved ones"""
    size = len(payload)
    length = bytes([size]) if size < 126 else struct.pack("!BH", 126, size) if size < 65536 else b""
    length = length or struct.pack("!BQ", 127, size)
    first = bytes([fin << 7 | bits << 4 | opcode])
    if not masked:
        return first + length + payload
    return first + bytes([length[0] | 128]) + length[1:] + bytes(4) + payload  # a mask of zeros


def encoded(message: Any) -> bytes:
    """As msgpack."""
    import msgspec

    return msgspec.msgpack.encode(message)


def camera(angle: float = 0.0, **changes: Any) -> dict[str, Any]:
    """That of somebody who looks along +x, a bit aside."""
    half = math.sqrt(0.5)
    message = {"type": "ViewerCameraMessage", "wxyz": [0.5, -0.5, 0.5, -0.5], "position": [-5.0, angle, 0.0]}
    message |= {"fov": 0.7, "near": 0.01, "far": 1000.0, "image_height": 240, "image_width": 320}
    return message | {"look_at": [0.0, 0.0, 0.0], "up_direction": [0.0, half, half]} | changes


def move(x: float) -> dict[str, Any]:
    """What moves the first model."""
    handle = {"type": "TransformControlsUpdateMessage", "name": "/handles/models/0", "owner": ""}
    return {**handle, "wxyz": [1.0, 0.0, 0.0, 0.0], "position": [x, 0.0, 0.0]}


def use(uuid: str, value: Any = True) -> dict[str, Any]:
    """What uses a control."""
    return {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}}


def opened(port: int, data: bytes, buffer: int | None = None) -> socket.socket:
    """A socket that has sent this. buffer: bytes that the system keeps of what is not read"""
    one = socket.socket()
    if buffer is not None:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
    one.settimeout(ANSWER)
    one.connect(("127.0.0.1", port))
    with contextlib.suppress(OSError):
        one.sendall(data)
    return one


def sent(one: socket.socket, data: bytes, times: int = 1, seconds: float | None = None) -> int:
    """Bytes sent until all are, the other end has had enough, or time (ANSWER) is over."""
    done, deadline = 0, time.monotonic() + (ANSWER if seconds is None else seconds)
    view = memoryview(data)
    with contextlib.suppress(OSError):
        for _ in range(times):
            rest = view
            while rest:
                one.settimeout(max(deadline - time.monotonic(), 0.01))
                count = one.send(rest)
                done, rest = done + count, rest[count:]
    return done


def status(one: socket.socket) -> int:
    """That the answer to a request begins with, 0 for none."""
    head = b""
    with contextlib.suppress(OSError):
        while b"\r\n" not in head and len(head) < 10_000:
            more = one.recv(4096)
            if not more:
                break
            head += more
    words = head.split(b" ", 2)
    return int(words[1]) if len(words) > 1 and words[1].isdigit() else 0


def ended(one: socket.socket) -> bool:
    """Whether the other end closes the connection in time."""
    deadline = time.monotonic() + ANSWER
    try:
        while time.monotonic() < deadline:
            one.settimeout(max(deadline - time.monotonic(), 0.01))
            if not one.recv(65536):
                return True
    except TimeoutError:
        return False
    except OSError:
        return True
    return False


@contextlib.contextmanager
def client(port: int) -> Iterator[Any]:
    """A connection that speaks as viser's page does."""
    from websockets.sync.client import connect

    named: dict[str, Any] = {"compression": None, "max_size": None, "ping_interval": None, "close_timeout": 0.2}
    with connect(f"ws://127.0.0.1:{port}", subprotocols=[version()], open_timeout=PATIENCE, **named) as one:
        yield one


def messages(data: bytes) -> list[dict[str, Any]]:
    """Of one frame that the viewer has sent."""
    import msgspec
    import zstandard

    size = int.from_bytes(data[8:16], "little")
    return msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(data[16 : 16 + size]))["messages"]


def pictures(port: int, count: int = 2) -> None:
    """Look from places until so many pictures have come. Raises TimeoutError after PATIENCE seconds."""
    deadline = time.monotonic() + PATIENCE
    with client(port) as one:
        for k in range(count):
            one.send(encoded(camera(0.1 * k)))
            seen = False
            while not seen:
                left = deadline - time.monotonic()
                if left <= 0:
                    raise TimeoutError(f"{k} of {count} pictures in {PATIENCE:.0f} s")
                received = messages(one.recv(timeout=left))
                seen = any(message["type"] == "BackgroundImageMessage" and message["rgb_data"] for message in received)


# ---- the parts ----


def foreign_pages(one: AttackedViewer, rng: random.Random, scale: float, held: contextlib.ExitStack) -> None:
    """Pages of other sites connect and, at once, move a model: before an answer, and after it."""
    port, before = one.port, one.state()
    own = f"http://127.0.0.1:{port}"
    origins = ["https://evil.example", "null", "", f"http://127.0.0.1:{port % 65000 + 1}", f"http://localhost:{port}"]
    origins += [f"{own}.evil.example", f"http://evil@127.0.0.1:{port}", f"{own}/", f"ftp://127.0.0.1:{port}", "file://"]
    origins += [f"{own}, https://evil.example", f"https://evil.example\r\nOrigin: {own}", "http://127.0.0.1", "*"]
    origins += [f"http://{rng.randbytes(6).hex()}.example:{port}" for _ in range(round(6 * scale))]
    moves = b"".join(frame(encoded(move(float(k)))) for k in range(1, 31))
    for origin in origins:
        for early in (True, False):
            one.tried["foreign page"] += 1
            head = request(port, f"Origin: {origin}")
            with opened(port, head + (frame(encoded(camera())) + moves if early else b"")) as page:
                code = status(page)
                sent(page, frame(encoded(camera())) + moves, seconds=0.2)
                if code == 101:
                    one.found("a page of another site got a connection", repr(origin))
    if one.state() != before:
        one.found("a page of another site changed the scene")
    one.tried["own page"] += 1
    with opened(port, request(port, f"Origin: {own}") + frame(encoded(camera())) + moves) as page:
        if status(page) != 101:
            one.found("the viewer's own page got no connection")
        deadline = time.monotonic() + ANSWER
        while one.state() == before and time.monotonic() < deadline:
            time.sleep(0.05)
    if one.state() == before:
        one.found("the viewer's own page could move nothing, so that it proves nothing that others could not")


def rebinding(one: AttackedViewer, rng: random.Random, scale: float, held: contextlib.ExitStack) -> None:
    """Names of others that lead to this machine, for the page and for the connection; and the viewer's own names."""
    port, before = one.port, one.state()
    names = [
        "evil.example",
        "127.0.0.1.evil.example",
        "localhost.evil.example",
        "evil@127.0.0.1",
        "10.0.0.1",
        "0.0.0.0",
    ]
    names += [
        "[::1",
        "[fe80::1]",
        "2130706433",
        "0x7f.1",
        "127.1",
        "localhost/",
        "localhost evil.example",
        "[::1]x",
        "::1",
    ]
    names += ["localhost,evil.example", "local\udcffhost", "128.0.0.1", "[::ffff:10.0.0.1]", "evillocalhost", "."]
    names += [f"{rng.randbytes(5).hex()}.example" for _ in range(round(4 * scale))]
    hosts: list[str | None] = [None, "127.0.0.1:99999999", "localhost:", f"localhost\r\nHost: evil.example:{port}"]
    for host in [*names, *(f"{name}:{port}" for name in names), *hosts]:
        origin = [f"Origin: http://{host}"] if host is not None and "\r" not in host else []
        for upgrade, lines in ((True, origin), (True, []), (False, [])):
            one.tried["name of another"] += 1
            more = frame(encoded(camera())) + frame(encoded(move(3.0))) if upgrade else b""
            with opened(port, request(port, *lines, upgrade=upgrade, host=host) + more) as page:
                code = status(page)
                if code in (101, 200):
                    what = "a connection" if upgrade else "the page"
                    one.found(f"asked under a name of another, the viewer gave {what}", repr(host))
    for query in ("websocket=ws://evil.example", "a=1&%77ebsocket=", "playbackPath=https://evil.example/x"):
        one.tried["page that obeys another server"] += 1
        with opened(port, request(port, upgrade=False, path=f"/?{query}")) as page:
            if status(page) == 200:
                one.found("the page was given that obeys another server", query)
    if one.state() != before:
        one.found("under a name of another the scene was changed")
    for host in ("localhost", "LocalHost.", "127.0.0.1", "127.9.9.9", "[::1]", "[0:0::1]", "[::ffff:127.0.0.1]"):
        for upgrade in (True, False):
            one.tried["own name"] += 1
            lines = [f"Origin: https://{host.lower()}:77"] if upgrade else []
            with opened(port, request(port, *lines, upgrade=upgrade, host=f"{host}:77")) as page:
                if status(page) not in (101, 200):
                    one.found("asked under its own name, the viewer gave nothing", host)


def garbage(one: AttackedViewer, rng: random.Random, scale: float, held: contextlib.ExitStack) -> None:
    """Bytes and messages that are none, ones with wrong values, frames that break the protocol."""
    from viser import _messages

    known = [kind for kind in _messages.Message.get_subclasses() if hasattr(kind, "__dataclass_fields__")]
    uuids = list(one.state()["shared"].values())
    simple = [
        None,
        True,
        -1,
        1e308,
        math.nan,
        math.inf,
        -math.inf,
        2**64 - 1,
        -(2**63),
        "",
        "x" * 500,
        b"\0\xff",
        [],
        {},
    ]

    def value(depth: int = 0) -> Any:
        kinds: list[Callable[[], Any]] = [lambda: rng.choice(simple)]
        if depth < 3:
            kinds += [lambda: [value(depth + 1) for _ in range(rng.randrange(5))], lambda: {"value": value(depth + 1)}]
        return rng.choice(kinds)()

    def wild() -> bytes:
        kind = rng.choice(known)
        return encoded({"type": kind.__name__, **{name: value() for name in kind.__dataclass_fields__}})

    def near() -> bytes:
        message = rng.choice([camera(), move(0.5), use(rng.choice(uuids))])
        return encoded(message | {rng.choice(list(message)): value()})

    def broken() -> bytes:
        whole = encoded(rng.choice([camera(), move(0.5), use(rng.choice(uuids))]))
        place = rng.randrange(len(whole))
        return rng.choice([whole[:place], whole[:place] + rng.randbytes(3) + whole[place + 3 :]])

    def lies() -> bytes:
        size = struct.pack("!I", rng.choice([2**32 - 1, 2**31, 2**24]))
        return rng.choice([b"\xdd" + size, b"\xdf" + size, b"\xc6" + size, b"\x91" * 8000, b"\xc9" + size + b"\x01"])

    sources = (lambda: rng.randbytes(rng.randrange(300)), wild, near, broken, lies, lambda: encoded({"type": "None"}))
    at = None
    for k in range(round(300 * scale)):
        one.tried["nonsense"] += 1
        if at is None or k % 10 == 0:
            if at is not None:
                at.close()
            at = opened(one.port, request(one.port) + frame(encoded(camera())))
        if sent(at, frame(sources[k % len(sources)](), opcode=1 if k % 17 == 0 else 2)) == 0:
            at.close()
            at = None
    if at is not None:
        at.close()
    against = [frame(b"x", bits=4), frame(b"x", opcode=3), frame(b"x", masked=False), frame(b"x", opcode=0)]
    against += [
        frame(b"x" * 126, opcode=9),
        frame(b"x", opcode=9, fin=False),
        frame(b"\x03", opcode=8),
        b"\x82\xff" + b"\xff" * 8,
    ]
    for bad in against * max(1, round(scale)):
        for head in (request(one.port), b""):
            one.tried["broken frame"] += 1
            with opened(one.port, head + bad + rng.randbytes(20)) as at:
                if head and not ended(at):
                    one.found("a connection went on after a frame that breaks the protocol", bad[:12].hex())
    one.tried["request that is none"] += 4
    for raw in (
        b"\0" * 100,
        b"GET\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"\x16\x03\x01" + rng.randbytes(200),
    ):
        opened(one.port, raw).close()


def floods(one: AttackedViewer, rng: random.Random, scale: float, held: contextlib.ExitStack) -> None:
    """More than anybody can need: messages, large ones, ones that swell, pieces without end, pings."""
    port, shared = one.port, one.state()["shared"]

    def start(**named: Any) -> socket.socket:
        return held.enter_context(opened(port, request(port) + frame(encoded(camera())), **named))

    size = 49 * MEBI
    numbers = encoded(use("a", None))[:-1] + b"\xdd" + struct.pack("!I", size) + bytes(size)  # a list, as valid msgpack
    for way in ("whole", "in pieces", "announced as larger")[: max(1, round(30 * scale))]:
        one.tried["message of 49 MB"] += 5
        at = start()
        if way == "whole":
            sent(at, frame(numbers), times=5)
        elif way == "in pieces":
            sent(at, frame(numbers[:MEBI], fin=False) + frame(numbers[:MEBI], opcode=0, fin=False) * 49)
        else:
            sent(at, b"\x82\xff" + struct.pack("!Q", 2**62) + bytes(4) + numbers, times=5)
        if not ended(at):
            one.found("a connection went on after messages of 49 MB", way)
    for offer in ("permessage-deflate", "permessage-deflate; client_max_window_bits", ""):
        one.tried["message that swells"] += 1
        lines = [f"Sec-WebSocket-Extensions: {offer}"] if offer else []
        at = held.enter_context(opened(port, request(port, *lines) + frame(encoded(camera()))))
        squeezed = zlib.compressobj(9, wbits=-15)
        bomb = squeezed.compress(bytes(48 * MEBI)) + squeezed.flush(zlib.Z_SYNC_FLUSH)
        sent(at, frame(bomb[:-4], bits=4), times=5)
        if not ended(at):
            one.found("a connection went on after a message that swells to 48 MB")
    one.tried["pieces without end"] += 1
    at = start()
    sent(at, frame(b"", fin=False))
    size = sent(at, frame(b"", opcode=0, fin=False) * 10_000, times=round(60 * scale) + 1)
    if not ended(at):
        one.found(f"a connection went on after {size:,} bytes of empty pieces of one message")
    one.tried["pings of one who does not read"] += 1
    at = start(buffer=4096)
    size = sent(at, frame(bytes(125), opcode=9) * 1000, times=200 + round(300 * scale))
    if size > 16 * MEBI and not ended(at):
        one.found(f"a connection went on after {size:,} bytes of pings whose answers nobody read")
    uses = [use(uuid) for label, uuid in shared.items() if label and "Save" not in label and "Play" not in label]
    cheap = [move(0.1), move(0.2), *(camera(0.01 * k) for k in range(20)), {"type": "ShareUrlRequest"}, *uses]
    many = b"".join(frame(encoded(rng.choice(cheap))) for _ in range(2000))
    ats = [start() for _ in range(3)]
    for at in ats:
        one.tried["message in a flood"] += sent(at, many, times=max(1, round(2 * scale)), seconds=2.0) // 100
    for _ in range(round(150 * scale)):
        one.tried["connection in a flood"] += 1
        opened(port, request(port) if rng.random() < 0.5 else b"").close()


def slow_sockets(one: AttackedViewer, rng: random.Random, scale: float, held: contextlib.ExitStack) -> None:
    """Those who say little, or read nothing, and stay while somebody else looks."""
    port, shared = one.port, one.state()["shared"]

    def hold(data: bytes, **named: Any) -> socket.socket:
        return held.enter_context(opened(port, data, **named))

    silent = [hold(b"") for _ in range(round(60 * scale))]
    half = request(port)[:-2]
    dripping = [hold(half) for _ in range(round(40 * scale))]
    endless = [hold(half + b"X: " + b"x" * 8000 + b"\r\n") for _ in range(round(40 * scale))]
    one.tried["half a request"] += len(silent) + len(dripping) + len(endless)
    for at in dripping:
        sent(at, b"X: y\r\n", seconds=0.1)
    for at in endless:
        sent(at, (b"X: " + b"x" * 8000 + b"\r\n") * 130, seconds=0.2)
    with opened(port, half) as at:
        sent(at, b"x" * 4 * MEBI, seconds=1.0)
        if not ended(at):
            one.found("a connection went on after a line of 4 MB in a request")
    pages = [hold(request(port, upgrade=False), buffer=4096) for _ in range(round(30 * scale))]
    one.tried["page that is not read"] += len(pages)
    deaf = [hold(request(port) + frame(encoded(camera())), buffer=4096) for _ in range(10)]
    one.tried["client that reads nothing"] += len(deaf)
    everything = [use(uuid) for label, uuid in shared.items() if label and "Save" not in label]
    for k in range(max(10, round(30 * scale))):
        large = encoded(camera(0.1 * k, image_width=640, image_height=640))
        more = frame(large) + b"".join(frame(encoded(message)) for message in (move(0.01 * k), *everything))
        for at in deaf:
            sent(at, more, seconds=0.1)
        time.sleep(0.02)
    pictured(one, deaf[0])
    surplus = [hold(request(port) + frame(encoded(camera()))) for _ in range(20)]
    one.tried["client too many"] += len(surplus)
    codes = Counter(status(at) for at in surplus)
    if not codes[503]:
        one.found(f"{len(deaf) + len(surplus)} clients at once were all let in")
    for at in surplus:
        at.close()
    time.sleep(0.2)


def pictured(one: AttackedViewer, deaf: socket.socket) -> None:
    """One more who reads nothing wants the view as a file, again and again."""
    one.tried["file that is not read"] += 1
    with client(one.port) as at:
        at.send(encoded(camera(image_width=640, image_height=640)))
        uuid = None
        deadline = time.monotonic() + PATIENCE
        while uuid is None and time.monotonic() < deadline:
            received = messages(at.recv(timeout=PATIENCE))
            uuid = next((m["uuid"] for m in received if m.get("props", {}).get("label") == "Picture (PNG)"), None)
        press = encoded(use(uuid or ""))
        with contextlib.suppress(Exception):
            for _ in range(300):
                at.send(press)
        time.sleep(0.5)


PARTS = (foreign_pages, rebinding, garbage, floods, slow_sockets)
