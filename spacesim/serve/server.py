"""The socket: requests in, answers out, one after another on the thread that draws.

One ROUTER socket speaks to clients of our own protocol (protocol.py) and to Basilisk (vizard.py): the first frame shows
which. ZeroMQ takes in the next requests and sends answers meanwhile, on a thread of its own; there it drops what is not
its protocol, and of a message whose sender hangs up nothing arrives.
"""

import errno
import ipaddress
import logging
import socket as sockets
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import Any

from spacesim import interrupts
from spacesim.data.errors import InputError, WorkError
from spacesim.serve import protocol, vizard
from spacesim.serve.draw import Served, draw

PORT = 5556  #: where Basilisk looks for Vizard
MAX_PORT = 65535
MAX_FRAME_BYTES = 1 << 22  #: of a message that comes in
MAX_FRAMES = 8  #: of a message that comes in; what is more is dropped
WAITING = 16  #: answers that wait for one client
PATIENCE = 5.0  #: seconds that a client's full queue is waited for
SIMULATIONS = 64  #: that are remembered, the last ones heard
ASK = 0.2  #: seconds between two looks at whether to stop

_log = logging.getLogger(__name__)


class CameraServer:
    """Answers clients at an address from `run` to `close`. port: 0 for any that is free. Raises InputError where pyzmq
    is not installed or the address cannot be had."""

    def __init__(self, served: Served, host: str = "127.0.0.1", port: int = PORT) -> None:
        zmq = self._zmq = protocol.import_zmq()
        self._served = served
        self._simulations: OrderedDict[bytes, vizard.Simulation] = OrderedDict()
        self._stalled: set[bytes] = set()  # clients that take no answers
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.ROUTER)
        options = {"LINGER": 1000, "MAXMSGSIZE": MAX_FRAME_BYTES, "SNDHWM": WAITING, "SNDTIMEO": round(1e3 * PATIENCE)}
        options |= {"ROUTER_MANDATORY": 1, "TCP_KEEPALIVE": 1, "TCP_KEEPALIVE_IDLE": 60}
        for name, value in options.items():
            self._socket.setsockopt(getattr(zmq, name), value)
        try:
            self.address = _bind(zmq, self._socket, host, port)
        except BaseException:
            self.close()
            raise

    def run(self, stopped: Callable[[], bool] = lambda: False) -> None:
        """Answer until `stopped` says so, which is asked between requests, or KeyboardInterrupt is raised."""
        while not stopped():
            if self._socket.poll(round(1e3 * ASK)):
                self._answer_next()

    def close(self) -> None:
        """Release the address; answers that were given are still sent for a second."""
        self._socket.close()
        self._context.term()

    def _answer_next(self) -> None:
        sender, *rest = self._receive()
        # A REQ socket puts an empty frame before what it says, after a number of its own where it has REQ_CORRELATE.
        start = rest.index(b"") + 1 if b"" in rest[:2] else 0
        envelope, frames = rest[:start], rest[start:]
        answer = self._answer(sender, frames)
        flags = self._zmq.NOBLOCK if sender in self._stalled else 0  # waited for once
        try:
            self._socket.send_multipart([sender, *envelope, *answer], flags, copy=False)
            self._stalled.discard(sender)
        except self._zmq.Again:
            if sender not in self._stalled:
                _log.warning("serve: a client takes no answers; what it asks for is dropped")
            self._stalled.add(sender)
        except self._zmq.ZMQError as error:  # it has hung up
            _log.debug("serve: an answer was lost: %s", error)
            self._simulations.pop(sender, None)
            self._stalled.discard(sender)

    def _receive(self) -> list[bytes]:
        """Frames of one message, of which no more than MAX_FRAMES are kept."""
        frames = [self._socket.recv()]
        while self._socket.getsockopt(self._zmq.RCVMORE):
            frame = self._socket.recv()
            if len(frames) < MAX_FRAMES:
                frames.append(frame)
        return frames

    def _answer(self, sender: bytes, frames: Sequence[bytes]) -> list[bytes]:
        if not frames:
            return protocol.error_answer(None, "request: expected a JSON object, found nothing")
        simulation = self._simulations.get(sender) or vizard.Simulation(self._served)
        answer = simulation.answer(frames)
        if answer is None:
            return self._picture(frames[0])
        self._simulations[sender] = simulation
        self._simulations.move_to_end(sender)
        if len(self._simulations) > SIMULATIONS:
            self._simulations.popitem(last=False)
        return answer

    def _picture(self, frame: bytes) -> list[bytes]:
        number, request = protocol.read_request(frame)
        if isinstance(request, InputError):
            return protocol.error_answer(number, str(request))
        if request.camera is None:
            return protocol.facts_answer(number, self._served.facts)
        start = time.perf_counter()
        try:
            camera, sun = request.camera.camera(), request.direction
            arrays = draw(self._served, camera, sun, request.exposure, request.outputs, request.seed)
        except (InputError, WorkError, MemoryError) as error:
            return protocol.error_answer(number, " ".join(str(error).split()))
        except (ArithmeticError, ValueError) as error:  # an unforeseen error ends this request alone
            _log.exception("serve: a request failed")
            return protocol.error_answer(number, f"request: it failed ({' '.join(str(error).split())})")
        return protocol.picture_answer(number, arrays, time.perf_counter() - start)


def serve(served: Served, host: str, port: int, say: Callable[[str], None]) -> None:
    """Answer until Ctrl-C or SIGTERM; the picture that is being drawn is finished first, and a second one ends that,
    too. say: called with the address. Raises InputError as `CameraServer` does."""
    server = CameraServer(served, host, port)
    try:
        if not ipaddress.ip_address(host_of(server.address)).is_loopback:
            say(f"any machine that can reach {host} can ask for pictures; at 127.0.0.1 only this machine can")
        say(f"serve: {served.names[0]} at {server.address} (Ctrl-C ends it)")
        with interrupts.defer_interrupts() as stopped:
            server.run(stopped)
    except KeyboardInterrupt:
        pass
    finally:
        server.close()


@contextmanager
def serving(served: Served) -> Iterator[str]:
    """The address of a server on a free port that draws on a thread of its own, while the block runs; nothing else may
    draw before it has answered."""
    server, ended = CameraServer(served, port=0), threading.Event()
    thread = threading.Thread(target=server.run, args=(ended.is_set,))
    thread.start()
    try:
        yield server.address
    finally:
        ended.set()
        thread.join()
        server.close()


def host_of(address: str) -> str:
    """The numeric host of "tcp://HOST:PORT"."""
    return address.removeprefix("tcp://").rpartition(":")[0].strip("[]")


def _bind(zmq: ModuleType, socket: Any, host: str, port: int) -> str:
    """The address that the socket listens at: "tcp://127.0.0.1:5556"."""
    if not 0 <= port <= MAX_PORT:
        raise InputError(f"port: expected 0 to {MAX_PORT}, found {port}")
    try:
        number = str(sockets.getaddrinfo(host, port, type=sockets.SOCK_STREAM)[0][4][0])
        socket.setsockopt(zmq.IPV6, ":" in number)
        socket.bind(f"tcp://[{number}]:{port or '*'}" if ":" in number else f"tcp://{number}:{port or '*'}")
    except (OSError, UnicodeError, zmq.ZMQError) as error:
        if getattr(error, "errno", None) == errno.EADDRINUSE:
            raise InputError(f"port: expected a free port, found {port} taken") from None
        if getattr(error, "errno", None) == errno.EACCES:
            raise InputError(f"port: expected a port that you may open, found {port}; try {PORT}") from None
        raise InputError(f"host: expected a name or address of this machine, found {host!r} ({error})") from None
    return str(socket.getsockopt_string(zmq.LAST_ENDPOINT))
