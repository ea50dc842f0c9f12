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
import threading
import traceback
import weakref
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from spacesim.backend import BackendError
from spacesim.backend.memory import keep_freed_memory
from spacesim.data.errors import InputError, WorkError

ALIGNMENT = 64  #: bytes, of arrays in shared memory
ATTEMPTS = 3  #: processes that may end over the same work
PATIENCE = 5.0  #: seconds in which processes end after they are asked to
CRASH = 60.0  #: seconds in which they end where they are not: what was in memory may be written to a file
_ROOT = str(Path(__file__).parents[1])


class ChildProcess:
    """A process that runs `main` of a module.

    module: its name; lends: messages are lent to it (Linux alone); environment: variables that it has besides
    """

    def __init__(self, module: str, lends: bool = False, environment: Mapping[str, str] = MappingProxyType({})) -> None:
        self._memory = _SharedMemory() if lends else None
        self._socket, theirs = socket.socketpair()
        files = [theirs.fileno(), *([self._memory.file] if self._memory else [])]
        # without the folder in which the user is, where a file may have the name of a module
        code = f"import sys; sys.path.remove(''); from {module} import main; main(int(sys.argv[1]))"
        paths = [_ROOT, *filter(None, [os.environ.get("PYTHONPATH")])]
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-c", code, str(theirs.fileno())],
                pass_fds=files,
                stdin=subprocess.DEVNULL,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(paths), **environment},
                start_new_session=True,  # Ctrl-C reaches the parent alone, which then ends it
            )
        self.connection = Connection(os.dup(self._socket.fileno()))

    def send(self, message: object) -> None:
        """Raises OSError where it has gone."""
        self.connection.send(message)

    def lend(self, message: object) -> None:
        """Send a message whose arrays lie in memory that both share, until the next one is lent: a socket takes 30
        times as long for them. Raises OSError where it has gone, WorkError where memory is short."""
        assert self._memory is not None, "started without memory to lend"
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
        if self._memory is not None:
            self._memory.close()

    def wait(self, patience: float = PATIENCE) -> bool:
        """Until it has ended; after so many seconds it is killed. Whether it ended by itself."""
        try:
            self._process.wait(patience)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            return False
        return True

    def ending(self) -> str:
        """How it ended, in words, once it does so by itself, for which it has `CRASH` seconds."""
        self.close()
        if not self.wait(CRASH):
            return "closed its connection and did not end"
        code = self._process.returncode
        return f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"


class _SharedMemory:
    """Memory that a process shares with one that it starts; it is gone with both."""

    def __init__(self) -> None:
        self.file = os.memfd_create(__name__)
        self._bytes = np.empty(0, np.uint8)
        self.close = weakref.finalize(self, os.close, self.file)

    def store(self, buffers: Iterable[pickle.PickleBuffer]) -> list[slice]:
        """Where each of the buffers lies now, instead of those before."""
        arrays = [np.frombuffer(buffer.raw(), np.uint8) for buffer in buffers]
        ends = np.cumsum([-(-array.size // ALIGNMENT) * ALIGNMENT for array in arrays], dtype=int).tolist()
        if ends and ends[-1] > self._bytes.size:
            try:
                os.ftruncate(self.file, ends[-1])
                self._bytes = np.frombuffer(mmap.mmap(self.file, ends[-1]), np.uint8)
            except OSError as error:
                raise WorkError(f"{ends[-1] / 1e6:.0f} MB of memory cannot be had ({error.strerror})") from None
        places = [slice(start, start + array.size) for start, array in zip([0, *ends], arrays, strict=False)]
        for place, array in zip(places, arrays, strict=True):
            self._bytes[place] = array
        return places


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
    has gone, whatever it is doing. What it frees it keeps."""
    keep_freed_memory()
    connection = Connection(socket)
    inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def listen() -> None:
        memory = memoryview(b"")
        while True:
            try:
                message = connection.recv()
            except (EOFError, OSError):
                os._exit(0)
            if isinstance(message, _Loan):
                if message.places and message.places[-1].stop > len(memory):
                    memory = memoryview(mmap.mmap(message.file, 0))
                message = pickle.loads(message.content, buffers=[memory[place] for place in message.places])
            inbox.put(message)

    def listen_or_end() -> None:
        try:
            listen()
        except BaseException:
            traceback.print_exc()
            os._exit(1)

    def tell(message: object) -> None:
        try:
            connection.send(message)
        except OSError:
            os._exit(0)

    threading.Thread(target=listen_or_end, daemon=True).start()
    return inbox, tell


def as_raisable(error: Exception) -> Exception:
    """`error`, if the parent can raise it as it is; else its text."""
    if isinstance(error, InputError | WorkError | MemoryError | BackendError):
        with suppress(Exception):
            return pickle.loads(pickle.dumps(error))
    return RuntimeError(f"{type(error).__name__}: {error}")
