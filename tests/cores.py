"""Test processes side by side, and all that they start, each keep to a share of the cores.

Threads of Dr.Jit, OpenBLAS and others that wait for work keep a core busy, of which the other process has need: there
are no more of them than cores to a process. To be imported before libraries look how many cores there are.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager

ALL = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set[int]()
_WORKER, _PROCESSES = os.environ.get("PYTEST_XDIST_WORKER", ""), int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))

if _WORKER and len(ALL) >= _PROCESSES:
    os.sched_setaffinity(0, sorted(ALL)[int(_WORKER.removeprefix("gw")) % _PROCESSES :: _PROCESSES])


@contextmanager
def all_cores() -> Iterator[None]:
    """This thread, what it starts, and Dr.Jit's threads have all cores."""
    import drjit

    share = os.sched_getaffinity(0) if ALL else ALL
    if share == ALL:
        yield
        return
    os.sched_setaffinity(0, ALL)
    drjit.set_thread_count(len(ALL))
    yield
    drjit.set_thread_count(len(share))
    os.sched_setaffinity(0, share)
