"""Work that many machines or GPUs share, by Ray: all of them see the folder that it is done in at the same path.

The machine that the command runs on plans and does what is left at the end; tasks go to processes of the cluster and
can be repeated. Those of `generate` are a few frames each, of which whole ones are skipped; scene and meshes travel by
value.
"""

import hashlib
import logging
import os
import pickle
import re
import socket
import sys
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from types import ModuleType
from typing import Any

from spacesim import backend
from spacesim.data.errors import InputError, WorkError
from spacesim.data.store import WrittenFrame
from spacesim.scenes.generation.frames import FrameMaker, FrameSpec, Job, cores, versions

MAX_FRAMES = 16  #: of a task
RETRIES = 3  #: times that a task is repeated after its process or its machine has died
CPUS, GPUS = 4, 0.25  #: of a task, at most: encoding keeps a GPU busy, and scenes are seldom loaded
WINDOW = 4  #: tasks handed to the cluster ahead for each that can run
REPORT_EVERY = 5.0  #: seconds between two calls of `waiting`, at most

Load = Callable[[Any, int], Callable[[Any], Any]]
"""(what all tasks need, threads) to what does a task: called once in each process of the cluster."""

_TOKEN = uuid.uuid4().hex
_loaded: dict[str, Callable[[Any], Any]] = {}
"""In a process of the cluster: what does the tasks of the work that is under way."""


@dataclass(frozen=True, eq=False)
class ClusterWork:
    """Work for processes of the cluster."""

    load: Load  #: a function of a module
    needed: Any  #: what all tasks need
    shared: Path  #: a file in the folder, by which machines know that they share it
    gpus: float = GPUS  #: of a task, with CUDA
    reuse: bool = True  #: a process does several tasks; one that holds a whole GPU may be given another for the next


@dataclass(frozen=True, eq=False)
class _WorkerSetup:
    """The setup that processes of the cluster receive."""

    work: ClusterWork
    backend: str
    threads: int
    versions: dict[str, str]
    digest: str  #: of the shared file


@contextmanager
def join_cluster(address: str) -> Iterator[None]:
    """Within it this process belongs to a Ray cluster, and `run_on_cluster` works; within another `join_cluster` it
    stays in that one.

    address: "auto" or host:port of a running one, "local" to start one on this machine. Raises InputError where there
    is none.
    """
    ray = _load_ray(address)
    if ray.is_initialized():
        yield
        return
    started = {"num_cpus": cores(), "include_dashboard": False} if address == "local" else {}
    try:
        _check_reachable(address)
        ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False, **started)
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"ray: expected a Ray cluster at {address!r}, found none ({_first_line(error)})") from None
    try:
        yield
    finally:
        ray.shutdown()


def make_on_cluster(job: Job, specs: Sequence[FrameSpec]) -> Iterator[WrittenFrame]:
    """Make frames on the Ray cluster; yields each once it is on the disk, in no fixed order.

    Raises as `run_on_cluster`.
    """

    def parcels(places: int) -> Iterator[list[FrameSpec]]:
        size = max(1, min(MAX_FRAMES, len(specs) // (4 * places)))
        return (list(specs[i : i + size]) for i in range(0, len(specs), size))

    for frames in run_on_cluster(ClusterWork(_load_maker, job, job.root / "scene.json"), parcels):
        yield from frames


def _load_maker(job: Job, threads: int) -> Callable[[list[FrameSpec]], list[WrittenFrame]]:
    maker = FrameMaker(replace(job, threads=threads))
    return lambda specs: list(maker.make(specs))


def run_on_cluster(
    work: ClusterWork, parcels: Callable[[int], Iterable[Any]], waiting: Callable[[], None] = lambda: None
) -> Iterator[Any]:
    """Do tasks on the Ray cluster; yields what each returns, in no fixed order.

    parcels: the tasks, by how many of them run at once; waiting: called every few seconds. Raises what a task raises,
    and WorkError where processes die again and again.
    """
    import ray

    cpus, gpus, places = _task_resources(ray, work.gpus)
    threads = max(1, int(cpus))
    order = _WorkerSetup(work, backend.select(), threads, versions(), _digest(work.shared))
    sent = ray.put(pickle.dumps(order))  # as bytes, or arrays would come back read-only
    task = ray.remote(num_cpus=cpus, num_gpus=gpus, max_retries=RETRIES, max_calls=0 if work.reuse else 1)(_do)
    key = uuid.uuid4().hex
    left = iter(parcels(places))
    running = [task.remote(key, [sent], parcel) for parcel in islice(left, WINDOW * places)]
    while running:
        ready, running = ray.wait(running, timeout=REPORT_EVERY)
        waiting()
        running += [task.remote(key, [sent], parcel) for parcel in islice(left, len(ready))]
        for done in ready:
            yield _result(ray, done)


def _load_ray(address: str) -> ModuleType:
    """The package; InputError says what to type where it is missing.

    What it reads from the environment when it is first imported: it sends no statistics of use; a cluster of this
    machine alone listens on loopback, to who has its token; one that is joined is shown the user's token, if any.
    """
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_task_oom_retries": str(RETRIES)}
    if "ray" not in sys.modules:
        if address == "local":
            os.environ |= {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": _TOKEN}
        elif "RAY_AUTH_TOKEN" in os.environ or (Path.home() / ".ray/auth_token").is_file():
            os.environ.setdefault("RAY_AUTH_MODE", "token")
    try:
        import ray
    except ImportError:
        raise InputError("ray: expected the package ray, found none; type: pip install 'spacesim[cluster]'") from None
    return ray


def _check_reachable(address: str) -> None:
    """Raises OSError where nothing listens at host:port; Ray itself would try for two minutes."""
    host, _, port = address.rpartition(":")
    if host and port.isdigit() and "/" not in host:
        socket.create_connection((host.strip("[]"), int(port)), timeout=5).close()


def _task_resources(ray: ModuleType, share: float) -> tuple[float, float, int]:
    """(processor cores, GPUs) of a task, and how many tasks run at once. share: GPUs of a task, with CUDA"""
    alive = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    cpus = min([CPUS, *(node["CPU"] for node in alive if node.get("CPU"))])
    total = ray.cluster_resources()
    places = int(total.get("CPU", 0) / cpus)
    if backend.select() == "llvm":
        return cpus, 0, max(1, places)
    if not total.get("GPU"):
        raise InputError("ray: expected GPUs in the cluster, as the backend is cuda, found none")
    return cpus, share, max(1, min(places, int(total["GPU"] / share)))


def _result(ray: ModuleType, done: object) -> Any:
    """What a task has returned. Raises its error, InputError and WorkError as they are."""
    try:
        return ray.get(done)
    except ray.exceptions.RayTaskError as error:
        cause = error.cause
        if isinstance(cause, InputError | WorkError | backend.BackendError):
            raise cause from None
        if missing := re.search(r"No module named '[\w.]+'", str(cause)):
            raise InputError(f"ray: expected spacesim on all of the cluster's machines ({missing[0]})") from None
        raise WorkError(f"ray: a task failed ({type(cause).__name__}: {_first_line(cause)})") from error
    except ray.exceptions.RayError as error:
        raise WorkError(f"ray: a task was given up after {RETRIES} repetitions ({_first_line(error)})") from error


def _first_line(error: object) -> str:
    return str(error).strip().split("\n")[0]


def _do(key: str, order: list[Any], parcel: object) -> Any:
    """A task: runs in a process of the cluster. order: a reference, followed once in each process."""
    if key not in _loaded:
        import ray

        setup: _WorkerSetup = pickle.loads(ray.get(order[0]))
        _check(setup)
        _loaded.clear()
        _loaded[key] = setup.work.load(setup.work.needed, setup.threads)
    return _loaded[key](parcel)


def _check(order: _WorkerSetup) -> None:
    """The machine has our versions, our backend and our folder. Raises InputError where it has not."""
    host = socket.gethostname()
    ours = versions()
    for name, version in order.versions.items():
        if ours.get(name) != version:
            raise InputError(f"{host}: expected {name} {version} as where the command runs, found {ours.get(name)}")
    shared = order.work.shared
    if _digest(shared) != order.digest:
        raise InputError(
            f"{host}: expected {shared.parent} to be the folder that all machines share, found another or none"
        )
    backend.select(order.backend)
    backend.mitsuba()
    if order.backend == "llvm":
        import drjit

        drjit.set_thread_count(order.threads)


def _digest(path: Path) -> str:
    """Of a file, "" where there is none."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""
