"""Many machines or GPUs that render one dataset, by Ray: all of them see the dataset's folder at the same path.

The machine that `generate` runs on plans, writes scene.json and, at the end, everything that is no frame. Tasks are a
few frames each and can be repeated: frames that are whole are skipped. Scene and meshes travel by value.
"""

import hashlib
import logging
import os
import pickle
import re
import socket
import sys
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from types import ModuleType
from typing import Any

from spacesim import backend
from spacesim.data.errors import InputError, WorkError
from spacesim.scenes.generation.frames import FrameMaker, Job, Shot, cores, versions

MOST_FRAMES = 16  #: of a task
RETRIES = 3  #: times that a task is repeated after its process or its machine has died
CPUS, GPUS = 4, 0.25  #: of a task, at most: chosen, so that encoding keeps a GPU fed and scenes are seldom loaded
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


@contextmanager
def joined(address: str) -> Iterator[None]:
    """Within it this process belongs to a Ray cluster, and `make_on_cluster` works.

    address: "auto" or host:port of a running one, "local" to start one on this machine. Raises InputError where there
    is none.
    """
    ray = _load_ray(address)
    started = {"num_cpus": cores(), "include_dashboard": False} if address == "local" else {}
    try:
        _knock(address)
        ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False, **started)
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"--ray: expected a Ray cluster at {address!r}, found none ({_first_line(error)})") from None
    try:
        yield
    finally:
        ray.shutdown()


def make_on_cluster(job: Job, shots: Sequence[Shot]) -> Iterator[str]:
    """Make frames on the Ray cluster; yields the name of each once it is on the disk, in no fixed order.

    Raises what a task raises, and WorkError where processes die again and again.
    """
    import ray

    cpus, gpus, places = _shares(ray)
    threads = max(1, int(cpus))
    order = _Order(replace(job, threads=threads), backend.select(), threads, versions(), _digest(job.root))
    sent = ray.put(pickle.dumps(order))  # as bytes, or arrays would come back read-only
    task = ray.remote(num_cpus=cpus, num_gpus=gpus, max_retries=RETRIES, max_calls=0)(_make)
    key = uuid.uuid4().hex
    size = max(1, min(MOST_FRAMES, len(shots) // (4 * places)))
    tasks = (list(shots[i : i + size]) for i in range(0, len(shots), size))
    running = [task.remote(key, [sent], group) for group in islice(tasks, WINDOW * places)]
    while running:
        ready, running = ray.wait(running)
        running += [task.remote(key, [sent], group) for group in islice(tasks, len(ready))]
        yield from _result(ray, ready[0])


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
        raise InputError("--ray: expected the package ray, found none; type: pip install 'spacesim[cluster]'") from None
    return ray


def _knock(address: str) -> None:
    """Raises OSError where nothing listens at host:port; Ray itself would try for two minutes."""
    host, _, port = address.rpartition(":")
    if host and port.isdigit() and "/" not in host:
        socket.create_connection((host.strip("[]"), int(port)), timeout=5).close()


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
        if missing := re.search(r"No module named '[\w.]+'", str(cause)):
            raise InputError(f"--ray: expected spacesim on all of the cluster's machines ({missing[0]})") from None
        raise WorkError(f"--ray: a task failed ({type(cause).__name__}: {_first_line(cause)})") from error
    except ray.exceptions.RayError as error:
        raise WorkError(f"--ray: a task was given up after {RETRIES} repetitions ({_first_line(error)})") from error


def _first_line(error: object) -> str:
    return str(error).strip().split("\n")[0]


def _make(key: str, order: list[Any], shots: list[Shot]) -> list[str]:
    """A task: runs in a process of the cluster. order: a reference, followed once in each process."""
    if key not in _makers:
        import ray

        found: _Order = pickle.loads(ray.get(order[0]))
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
