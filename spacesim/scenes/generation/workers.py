"""Several processes of one machine that render one dataset.

`make_in_processes` starts them with `python -m spacesim.scenes.generation.workers`: Dr.Jit must not be forked, and a
spawned multiprocessing worker would import the user's script again. Each asks for work through a socket: it gets the
job, loads the scene once, and is then given a few frames at a time. A process that dies is replaced and its frames are
given out again; those that are whole by then are skipped. Where the parent is gone, whatever killed it, the socket
closes and the worker ends.
"""

import os
import pickle
import queue
import socket
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from spacesim import backend
from spacesim.data.errors import InputError, WorkError
from spacesim.data.files import remove_leftovers
from spacesim.scenes.generation.frames import FrameMaker, FrameSpec, Job, cores, writing_threads

ATTEMPTS = 3  #: times that a task is given out before its death counts as its own fault
MAX_FRAMES = 16  #: of a task: what a process that dies has to do again
PATIENCE = 5.0  #: seconds in which a process ends after it is asked to


@dataclass(eq=False)
class _Task:
    specs: list[FrameSpec]
    attempts: int = 0


@dataclass(eq=False)
class _Worker:
    """A process, the socket to it, the task that it has and the messages that it has yet to receive."""

    process: subprocess.Popen[bytes]
    connection: Connection
    task: _Task | None
    outbox: list[Any]

    def send_next(self) -> None:
        """Send the next message. Where the process is dead already, reading from it will fail."""
        with suppress(OSError):
            self.connection.send(self.outbox.pop(0))


def make_in_processes(job: Job, specs: Sequence[FrameSpec], count: int) -> Iterator[str]:
    """Make frames in `count` processes; yields the name of each once it is on the disk, in no fixed order.

    Raises what a process raises, and WorkError where processes die over the same frames again and again.
    """
    if not specs:
        return
    size = max(1, min(MAX_FRAMES, len(specs) // (4 * count)))
    tasks = deque(_Task(list(specs[i : i + size])) for i in range(0, len(specs), size))
    count = min(count, len(tasks))
    job = replace(job, threads=writing_threads(count))
    reported: set[str] = set()
    workers: list[_Worker] = []
    try:
        while tasks or any(worker.task for worker in workers):
            for worker in workers:
                if worker.task is None and tasks:
                    _assign(worker, tasks.popleft())
            while tasks and len(workers) < count:
                workers.append(_start(job, tasks.popleft(), len(workers), count))
            for name in _receive(workers, tasks):
                if name not in reported:
                    reported.add(name)
                    yield name
    except BaseException:
        _stop(workers)
        if not job.shared:
            remove_leftovers(job.root)
        raise
    finally:
        _stop(workers)


def _receive(workers: list[_Worker], tasks: deque[_Task]) -> Iterator[str]:
    """Wait for messages: the name of a frame that is done, None for "what next?", or an error to raise."""
    for ready in wait([worker.connection for worker in workers]):
        worker = next(worker for worker in workers if worker.connection is ready)
        try:
            message = worker.connection.recv()
        except (EOFError, OSError):
            workers.remove(worker)
            _requeue(worker, tasks)
            continue
        if isinstance(message, BaseException):
            raise message
        if message is not None:
            yield message
        elif worker.outbox:
            worker.send_next()
        else:
            worker.task = None


def _start(job: Job, task: _Task, number: int, count: int) -> _Worker:
    """A new process, with its share of the processor and, where there are several, a GPU of its own."""
    ours, theirs = socket.socketpair()
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([_ROOT, *filter(None, [os.environ.get("PYTHONPATH")])])}
    devices = cuda_devices() if backend.select() == "cuda" else []
    if devices:
        environment["CUDA_VISIBLE_DEVICES"] = devices[number % len(devices)]
    with theirs:
        process = subprocess.Popen(
            [sys.executable, "-m", "spacesim.scenes.generation.workers", str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            env=environment,
            start_new_session=True,  # Ctrl-C reaches the parent alone, which then ends its workers
        )
    task.attempts += 1
    start = (backend.select(), max(1, cores() // count), job)
    return _Worker(process, Connection(ours.detach()), task, [start, task.specs])


def _assign(worker: _Worker, task: _Task) -> None:
    task.attempts += 1
    worker.task, worker.outbox = task, [task.specs]
    worker.send_next()


def _requeue(worker: _Worker, tasks: deque[_Task]) -> None:
    """A process has ended by itself: its task is for another one."""
    worker.connection.close()
    code = worker.process.wait()
    if worker.task is None:
        return
    if worker.task.attempts < ATTEMPTS:
        tasks.appendleft(worker.task)
        return
    first, last = worker.task.specs[0].name, worker.task.specs[-1].name
    how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
    raise WorkError(
        f"{first} to {last}: {ATTEMPTS} processes ended over these frames, the last {how}; where the memory is short, "
        "fewer workers help"
    )


def _stop(workers: list[_Worker]) -> None:
    """End all processes; closing the connection is their signal."""
    for worker in workers:
        worker.connection.close()
    for worker in workers:
        try:
            worker.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            worker.process.kill()
            worker.process.wait()


def cuda_devices() -> list[str]:
    """Names of the CUDA devices of this machine for CUDA_VISIBLE_DEVICES, [] where they cannot be determined."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    if named is not None:
        return [name for name in named.split(",") if name]
    try:
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=20).stdout
    except (OSError, subprocess.TimeoutExpired):
        return []
    return [str(i) for i, line in enumerate(line for line in listed.splitlines() if line.startswith("GPU "))]


_ROOT = str(Path(__file__).parents[3])


def connect_to_parent(connection: Connection) -> tuple[queue.SimpleQueue[Any], Callable[[Any], None]]:
    """(what the parent has sent, a function that sends it a message). Ends this process as soon as the parent
    has gone, whatever it is doing."""
    inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def listen() -> None:
        while True:
            try:
                inbox.put(connection.recv())
            except (EOFError, OSError):
                os._exit(0)

    def tell(message: object) -> None:
        try:
            connection.send(message)
        except OSError:
            os._exit(0)

    threading.Thread(target=listen, daemon=True).start()
    return inbox, tell


def select_backend(name: str, threads: int) -> None:
    """Render with backend `name` from now on, on a CPU with so many threads."""
    backend.select(name)
    backend.mitsuba()
    if name == "llvm":
        import drjit

        drjit.set_thread_count(threads)


def _work(connection: Connection) -> None:
    """What a worker does: frames of each task, until there are no more."""
    inbox, tell = connect_to_parent(connection)

    def ask() -> Any:
        tell(None)
        return inbox.get()

    name, threads, job = ask()
    try:
        select_backend(name, threads)
        maker = FrameMaker(job)
        while True:
            for done in maker.make(ask()):
                tell(done)
    except Exception as error:
        tell(_picklable(error))
        threading.Event().wait()  # for the parent to close the connection


def _picklable(error: Exception) -> Exception:
    """`error`, if the parent can raise it as it is; else its text."""
    if isinstance(error, InputError | WorkError | MemoryError | backend.BackendError):
        with suppress(Exception):
            return pickle.loads(pickle.dumps(error))
    return RuntimeError(f"{type(error).__name__}: {error}")


if __name__ == "__main__":
    _work(Connection(int(sys.argv[1])))
