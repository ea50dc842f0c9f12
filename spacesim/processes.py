"""Processes that work beside this one: started with a socket to it, they end as soon as it has gone.

Dr.Jit must not be forked, and a spawned multiprocessing worker would import the user's script again. A module that
works so has `main(socket)`, which is given the number of the socket.
"""

import mmap
import os
import pickle
import queue
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from spacesim.backend import BackendError
from spacesim.data.errors import InputError, WorkError

ALIGNMENT = 64  #: bytes, of arrays in shared memory
PATIENCE = 5.0  #: seconds in which processes end after they are asked to
_ROOT = str(Path(__file__).parents[1])


class ChildProcess:
    """A process that runs `main` of a module.

    module: its name; environment: variables that the process has besides
    """

    def __init__(self, module: str, **environment: str) -> None:
        self._memory = _SharedMemory()
        ours, theirs = socket.socketpair()
        code = f"import sys; from {module} import main; main(int(sys.argv[1]))"
        paths = [_ROOT, *filter(None, [os.environ.get("PYTHONPATH")])]
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-c", code, str(theirs.fileno())],
                pass_fds=[theirs.fileno(), self._memory.file],
                stdin=subprocess.DEVNULL,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(paths), **environment},
                start_new_session=True,  # Ctrl-C reaches the parent alone, which then ends it
            )
        self._socket, self.connection = ours, Connection(os.dup(ours.fileno()))

    def send(self, message: object) -> None:
        """Raises OSError where it has gone."""
        self.connection.send(message)

    def lend(self, message: object) -> None:
        """Send a message whose arrays lie in memory that both share, until the next one is lent: a socket takes 30
        times as long for them. Raises OSError where it has gone."""
        buffers: list[pickle.PickleBuffer] = []
        content = pickle.dumps(message, 5, buffer_callback=buffers.append)
        self.connection.send(_Loan(content, self._memory.file, self._memory.store(buffers)))

    def receive(self) -> Any:
        """Its next message. Raises EOFError or OSError where it has gone."""
        return self.connection.recv()

    def close(self) -> None:
        """The connection, which ends the process; who waits for a message is told that it has gone."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self.connection.close()
        self._memory.close()

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


class _SharedMemory:
    """Memory that a process shares with one that it starts; it is gone with both."""

    def __init__(self) -> None:
        if hasattr(os, "memfd_create"):
            self.file = os.memfd_create(__name__)
        else:
            self.file, path = tempfile.mkstemp()
            os.unlink(path)
        self._bytes = np.empty(0, np.uint8)

    def store(self, buffers: Iterable[pickle.PickleBuffer]) -> list[slice]:
        """Where each of the buffers lies now, instead of those before."""
        arrays = [np.frombuffer(buffer.raw(), np.uint8) for buffer in buffers]
        ends = np.cumsum([-(-array.size // ALIGNMENT) * ALIGNMENT for array in arrays], dtype=int).tolist()
        if ends and ends[-1] > self._bytes.size:
            os.ftruncate(self.file, ends[-1])
            self._bytes = np.frombuffer(mmap.mmap(self.file, ends[-1]), np.uint8)
        places = [slice(start, start + array.size) for start, array in zip([0, *ends], arrays, strict=False)]
        for place, array in zip(places, arrays, strict=True):
            self._bytes[place] = array
        return places

    def close(self) -> None:
        """Give this process's part of it back."""
        if self.file >= 0:
            os.close(self.file)
        self.file, self._bytes = -1, np.empty(0, np.uint8)


@dataclass(frozen=True)
class _Loan:
    """A message whose arrays lie in shared memory."""

    content: bytes
    file: int
    places: list[slice]


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
        memory = memoryview(b"")
        while True:
            try:
                message = connection.recv()
                if isinstance(message, _Loan):
                    if message.places and message.places[-1].stop > len(memory):
                        memory = memoryview(mmap.mmap(message.file, 0))
                    message = pickle.loads(message.content, buffers=[memory[place] for place in message.places])
                inbox.put(message)
            except (EOFError, OSError):
                os._exit(0)

    def tell(message: object) -> None:
        try:
            connection.send(message)
        except OSError:
            os._exit(0)

    threading.Thread(target=listen, daemon=True).start()
    return inbox, tell


def as_raisable(error: Exception) -> Exception:
    """`error`, if the parent can raise it as it is; else its text."""
    if isinstance(error, InputError | WorkError | MemoryError | BackendError):
        with suppress(Exception):
            return pickle.loads(pickle.dumps(error))
    return RuntimeError(f"{type(error).__name__}: {error}")
