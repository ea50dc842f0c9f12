"""Processes that work beside this one: started with a socket to it, they end as soon as it has gone.

Dr.Jit must not be forked, and a spawned multiprocessing worker would import the user's script again. A module that
works so has `main(socket)`, which is given the number of the socket.
"""

import os
import pickle
import queue
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from spacesim.backend import BackendError
from spacesim.data.errors import InputError, WorkError

PATIENCE = 5.0  #: seconds in which processes end after they are asked to
_ROOT = str(Path(__file__).parents[1])


class ChildProcess:
    """A process that runs `main` of a module.

    module: its name; environment: variables that the process has besides
    """

    def __init__(self, module: str, **environment: str) -> None:
        ours, theirs = socket.socketpair()
        code = f"import sys; from {module} import main; main(int(sys.argv[1]))"
        paths = [_ROOT, *filter(None, [os.environ.get("PYTHONPATH")])]
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-c", code, str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(paths), **environment},
                start_new_session=True,  # Ctrl-C reaches the parent alone, which then ends it
            )
        self._socket, self.connection = ours, Connection(os.dup(ours.fileno()))

    def send(self, message: object) -> None:
        """Raises OSError where it has gone."""
        send(self.connection, message)

    def receive(self) -> Any:
        """Its next message. Raises EOFError or OSError where it has gone."""
        return receive(self.connection)

    def close(self) -> None:
        """The connection, which ends the process; who waits for a message is told that it has gone."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self.connection.close()

    def wait(self, patience: float = PATIENCE) -> None:
        """Until it has ended; after so many seconds it is killed."""
        try:
            self._process.wait(patience)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def ending(self) -> str:
        """How it ended, in words, once it does so by itself."""
        self.close()
        code = self._process.wait()
        return f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"


def end(children: Iterable[ChildProcess]) -> None:
    """End processes, all at once."""
    children = list(children)
    for child in children:
        child.close()
    for child in children:
        child.wait()


def connect_to_parent(socket: int) -> tuple[queue.SimpleQueue[Any], Callable[[Any], None]]:
    """(what the parent has sent, a function that sends it a message). Ends this process as soon as the parent
    has gone, whatever it is doing."""
    connection = Connection(socket)
    inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def listen() -> None:
        while True:
            try:
                inbox.put(receive(connection))
            except (EOFError, OSError):
                os._exit(0)

    def tell(message: object) -> None:
        try:
            send(connection, message)
        except OSError:
            os._exit(0)

    threading.Thread(target=listen, daemon=True).start()
    return inbox, tell


def send(connection: Connection, message: object) -> None:
    """To the other end, which `receive`s it; arrays go as they lie in memory. Raises OSError where it has gone."""
    buffers: list[pickle.PickleBuffer] = []
    content = pickle.dumps(message, 5, buffer_callback=buffers.append)
    connection.send((content, len(buffers)))
    for buffer in buffers:
        connection.send_bytes(buffer.raw())


def receive(connection: Connection) -> Any:
    """What the other end has sent. Raises EOFError or OSError where it has gone."""
    content, count = connection.recv()
    return pickle.loads(content, buffers=[bytearray(connection.recv_bytes()) for _ in range(count)])


def as_raisable(error: Exception) -> Exception:
    """`error`, if the parent can raise it as it is; else its text."""
    if isinstance(error, InputError | WorkError | MemoryError | BackendError):
        with suppress(Exception):
            return pickle.loads(pickle.dumps(error))
    return RuntimeError(f"{type(error).__name__}: {error}")
