"""Many machines or GPUs that render one dataset, by Ray: all of them see the dataset's folder at the same path.

The machine that `generate` runs on plans, writes scene.json and, at the end, everything that is no frame. Tasks are a
few frames each and can be repeated: frames that are whole are skipped. Scene and meshes travel by value.
"""

import hashlib
import logging
import os
import pickle
import socket
import uuid
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from types import ModuleType
from typing import Any

from spacesim import backend
from spacesim.data.errors import InputError, WorkError
from spacesim.scenes.frames import FrameMaker, Job, Shot, cores, versions

MOST_FRAMES = 16  #: of a task
RETRIES = 3  #: times that a task is repeated after its process or its machine has died
CPUS, GPUS = (
    4,
    0.25,
)  #: of a task, at most: chosen, so that encoding keeps a GPU fed and scenes are not loaded too often
WINDOW = 4  #: tasks handed to the cluster ahead for each that can run

_TOKEN = uuid.uuid4().hex
_makers: dict[str, FrameMaker] = {}
"""In a process of the cluster: what has been loaded for the dataset at work."""


@dataclass(frozen=True, eq=False)
class _Order:
    """What processes of the cluster are told. digest: of scene.json, by which they know that the folder is shared."""

    job: Job
    backend: str
    threads: int
    versions: dict[str, str]
    digest: str


def make_on_cluster(job: Job, shots: Sequence[Shot], address: str) -> Iterator[str]:
    """Make frames on the Ray cluster at `address`; yields the name of each once it is on the disk, in no fixed order.

    address: "auto" or host:port of a running one, "local" to start one on this machine. Raises InputError where there
    is none, what a task raises, and WorkError where processes die again and again.
    """
    ray = load_ray(address)
    _join(ray, address)
    try:
        cpus, gpus, places = _shares(ray)
        job = replace(job, threads=max(1, int(cpus)))
        name = backend.select()
        order = ray.put(pickle.dumps(_Order(job, name, max(1, int(cpus)), versions(), _digest(job.root))))
        task = ray.remote(num_cpus=cpus, num_gpus=gpus, max_retries=RETRIES, max_calls=0)(_make)
        key = uuid.uuid4().hex
        size = max(1, min(MOST_FRAMES, len(shots) // (4 * places)))
        tasks = (list(shots[i : i + size]) for i in range(0, len(shots), size))
        running = [task.remote(key, [order], group) for group in islice(tasks, WINDOW * places)]
        while running:
            ready, running = ray.wait(running)
            running += [task.remote(key, [order], group) for group in islice(tasks, len(ready))]
            yield from _result(ray, ready[0])
    finally:
        ray.shutdown()


def load_ray(address: str) -> ModuleType:
    """The package; InputError says what to type where it is missing.

    What it reads from the environment when it is imported: it sends no statistics of use, and a cluster of this machine
    alone listens on loopback, to who has its token.
    """
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_task_oom_retries": str(RETRIES)}
    if address == "local":
        os.environ |= {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": _TOKEN}
    try:
        import ray
    except ImportError:
        raise InputError("--ray: expected the package ray, found none; type: pip install 'spacesim[cluster]'") from None
    return ray


def _join(ray: ModuleType, address: str) -> None:
    started = {"num_cpus": cores(), "include_dashboard": False} if address == "local" else {}
    try:
        ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False, **started)
    except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
        reason = str(error).split("\n")[0]
        raise InputError(f"--ray: expected a Ray cluster at {address!r}, found none ({reason})") from None


def _shares(ray: ModuleType) -> tuple[float, float, int]:
    """(processor cores, GPUs) of a task, and how many tasks run at once."""
    alive = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    cpus = min([CPUS, *(node["CPU"] for node in alive if node.get("CPU"))])
    total = ray.cluster_resources()
    places = int(total.get("CPU", 0) / cpus)
    if backend.select() == "llvm":
        return cpus, 0, max(1, places)
    if not total.get("GPU"):
        raise InputError("--ray: expected GPUs in the cluster, as --backend cuda has been chosen, found none")
    return cpus, GPUS, max(1, min(places, int(total["GPU"] / GPUS)))


def _result(ray: ModuleType, done: Any) -> list[str]:
    """Names of the frames of a task. Raises its error, InputError and WorkError as they are."""
    try:
        names: list[str] = ray.get(done)
        return names
    except ray.exceptions.RayTaskError as error:
        cause = error.cause
        if isinstance(cause, InputError | WorkError | backend.BackendError):
            raise cause from None
        raise WorkError(f"--ray: a task failed ({type(cause).__name__}: {cause})") from error
    except ray.exceptions.RayError as error:
        reason = str(error).strip().split("\n")[0]
        raise WorkError(f"--ray: a task was given up after {RETRIES} repetitions ({reason})") from error


def _make(key: str, order: list[Any], shots: list[Shot]) -> list[str]:
    """A task: runs in a process of the cluster. order: a reference, followed once in each process."""
    if key not in _makers:
        import ray

        found: _Order = pickle.loads(ray.get(order[0]))  # as bytes, or arrays would come back read-only
        _check(found)
        _makers.clear()
        _makers[key] = FrameMaker(found.job)
    return list(_makers[key].make(shots))


def _check(order: _Order) -> None:
    """The machine has our versions, our backend and our folder. Raises InputError where it has not."""
    host = socket.gethostname()
    ours = versions()
    for name, version in order.versions.items():
        if ours.get(name) != version:
            raise InputError(f"{host}: expected {name} {version} as where generate runs, found {ours.get(name)}")
    if _digest(order.job.root) != order.digest:
        raise InputError(
            f"{host}: expected {order.job.root} to be the folder that all machines share, found another or none"
        )
    backend.select(order.backend)
    backend.mitsuba()
    if order.backend == "llvm":
        import drjit

        drjit.set_thread_count(order.threads)


def _digest(root: Path) -> str:
    """Of scene.json, "" where there is none."""
    try:
        return hashlib.sha256((root / "scene.json").read_bytes()).hexdigest()
    except OSError:
        return ""
