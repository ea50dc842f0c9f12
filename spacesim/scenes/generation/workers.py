"""Several processes of one machine that render one dataset.

Each asks for work: it gets the job, loads the scene once, and is then given a few frames at a time, the next ones while
it still makes the ones before. A process that dies is replaced and its frames are given out again; those that are whole
by then are skipped.
"""

import os
import subprocess
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from multiprocessing.connection import wait
from typing import Any

from spacesim import backend
from spacesim.data.errors import WorkError
from spacesim.data.files import remove_leftovers
from spacesim.data.store import WrittenFrame
from spacesim.processes import ATTEMPTS, ChildProcess, as_raisable, connect_to_parent, end
from spacesim.scenes.generation.frames import FrameMaker, FrameSpec, Job, cores, writing_threads

MAX_FRAMES = 16  #: of a task: what a process that dies has to do again


@dataclass(eq=False)
class _Task:
    specs: list[FrameSpec]
    deaths: int = 0  #: of processes whose oldest task it was
    left: set[str] = field(default_factory=set)  #: names of frames that are not reported yet

    def __post_init__(self) -> None:
        self.left = {spec.name for spec in self.specs}


@dataclass(eq=False)
class _Worker:
    """A process, the tasks that it has, oldest first, and the messages that it has yet to receive."""

    process: ChildProcess
    tasks: deque[_Task]
    outbox: list[Any]
    is_waiting: bool = False  #: for a task

    def answer(self, tasks: deque[_Task]) -> None:
        """Its question "what next?": by a task, by none where it has others to end first, or not yet."""
        self.is_waiting = False
        if self.outbox:
            self._send(self.outbox.pop(0))
        elif tasks:
            self.tasks.append(tasks.popleft())
            self._send(self.tasks[-1].specs)
        elif self.tasks:
            self._send([])
        else:
            self.is_waiting = True

    def has_made(self, name: str) -> None:
        """A frame, which is reported."""
        for task in self.tasks:
            task.left.discard(name)
        while self.tasks and not self.tasks[0].left:
            self.tasks.popleft()

    def _send(self, message: object) -> None:
        """Where the process is dead already, reading from it will fail."""
        with suppress(OSError):
            self.process.send(message)


def make_in_processes(job: Job, specs: Sequence[FrameSpec], count: int) -> Iterator[WrittenFrame]:
    """Make frames in `count` processes; yields each once it is on the disk, in no fixed order.

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
        while tasks or any(worker.tasks for worker in workers):
            for worker in workers:
                if worker.is_waiting and tasks:
                    worker.answer(tasks)
            while tasks and len(workers) < count:
                workers.append(_start(job, tasks.popleft(), len(workers), count))
            for frame in _receive(workers, tasks):
                if frame.name not in reported:
                    reported.add(frame.name)
                    yield frame
    except BaseException:
        end(worker.process for worker in workers)
        if not job.shared:
            remove_leftovers(job.root)
        raise
    finally:
        end(worker.process for worker in workers)


def _receive(workers: list[_Worker], tasks: deque[_Task]) -> Iterator[WrittenFrame]:
    """Wait for messages: a frame that is done, None for "what next?", or an error to raise."""
    for ready in wait([worker.process.connection for worker in workers]):
        worker = next(worker for worker in workers if worker.process.connection is ready)
        try:
            message = worker.process.receive()
        except (EOFError, OSError):
            workers.remove(worker)
            _requeue(worker, tasks)
            continue
        if isinstance(message, BaseException):
            raise message
        if message is None:
            worker.answer(tasks)
        else:
            worker.has_made(message.name)
            yield message


def _start(job: Job, task: _Task, number: int, count: int) -> _Worker:
    """A new process, with its share of the processor and, where there are several, a GPU of its own."""
    devices = cuda_devices() if backend.select() == "cuda" else []
    environment = {"CUDA_VISIBLE_DEVICES": devices[number % len(devices)]} if devices else {}
    start = (backend.select(), max(1, cores() // count), job)
    return _Worker(ChildProcess(__name__, environment=environment), deque([task]), [start, task.specs])


def _requeue(worker: _Worker, tasks: deque[_Task]) -> None:
    """A process has ended by itself: its tasks are for others."""
    ending = worker.process.ending()
    if not worker.tasks:
        return
    worker.tasks[0].deaths += 1
    if worker.tasks[0].deaths < ATTEMPTS:
        tasks.extendleft(reversed(worker.tasks))
        return
    left = [spec.name for task in worker.tasks for spec in task.specs if spec.name in task.left]
    raise WorkError(
        f"{left[0]} to {left[-1]}: {ATTEMPTS} processes ended over these frames, the last {ending}; "
        "where the memory is short, fewer workers help"
    )


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


def select_backend(name: str, threads: int) -> None:
    """Render with backend `name` from now on, on a CPU with so many threads."""
    backend.select(name)
    backend.mitsuba()
    if name == "llvm":
        import drjit

        drjit.set_thread_count(threads)


def main(socket: int) -> None:
    """Make frames of one task after another, until the parent goes."""
    inbox, tell = connect_to_parent(socket)

    def ask() -> Any:
        tell(None)
        return inbox.get()

    def asked() -> Iterator[FrameSpec]:
        """Frames, until there are none but those under way."""
        while specs := ask():
            yield from specs

    name, threads, job = ask()
    try:
        select_backend(name, threads)
        maker = FrameMaker(job)
        while True:
            for done in maker.make(asked()):
                tell(done)
    except Exception as error:
        tell(as_raisable(error))
        threading.Event().wait()  # for the parent to close the connection
