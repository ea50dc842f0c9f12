"""`reproduce`: all data, trainings and evaluations behind the thesis's tables, in one folder, and the page about them.

DIR/size.json         what was asked for: a folder of another size or version is refused
DIR/data/NAME         datasets
DIR/experiments/NAME  a run, its evaluations and what else tables and figures need
DIR/reproduce.json    every number; DIR/reproduce.html shows them. Both are written after each experiment
"""

import hashlib
import json
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial
from pathlib import Path

from spacesim import backend
from spacesim.data.errors import InputError, WorkError, expect
from spacesim.data.files import holds_files, read_json, write_bytes, write_json
from spacesim.data.lock import lock_folder
from spacesim.data.structure import plain
from spacesim.reproduce.experiments import (
    Curve,
    Work,
    check_parts,
    data_of,
    datasets_for,
    experiments_for,
    parts_known,
)
from spacesim.reproduce.page import write_page
from spacesim.reproduce.perform import ReportCallback, Reporting, data_folder, folder_of, is_done, perform
from spacesim.reproduce.results import Results, Values
from spacesim.reproduce.size import FULL, Size
from spacesim.scenes.generation.cluster import ClusterWork, join_cluster, run_on_cluster
from spacesim.scenes.generation.estimate import duration
from spacesim.scenes.generation.frames import versions
from spacesim.scenes.generation.generate import generate
from spacesim.scenes.scenefile import read_scene

SCHEMA = 1  #: of reproduce.json
MOST_SEEDS = 100
PROGRESS_EVERY = 5.0  #: seconds between two words of an experiment on a cluster

log = logging.getLogger(__name__)


def reproduce(
    out: Path,
    reporting: Reporting,
    parts: Sequence[str] = (),
    size: Size = FULL,
    resume: bool = False,
    ray: str | None = None,
    seeds: int = 1,
) -> Path:
    """Do what the tables and figures need, as far as it is not done yet; returns the page.

    parts: numbers of tables and names of figures, none for all; resume: go on in a folder of the same size and version,
    with the same tables or others; ray: address of a Ray cluster that shares the folder, a GPU for each training;
    seeds: trainings of each row of a table. Raises InputError for parts or a folder that cannot be, WorkError, at the
    end, where experiments have failed.
    """
    parts = check_parts(parts)
    expect(1 <= seeds <= MOST_SEEDS, "seeds", f"1 to {MOST_SEEDS}", seeds)
    out = Path(out).absolute()
    experiments = experiments_for(size, parts, seeds)
    with ExitStack() as within:
        if ray is not None:
            within.enter_context(join_cluster(ray))
        within.enter_context(lock_folder(out))
        _open(out, size, resume)
        write = partial(_write, out, size, parts, experiments, seeds)
        page = write()
        _make_data(out, size, datasets_for(size, parts, experiments), reporting, ray)
        page = write()
        left = [one for one in experiments if not is_done(out, one)]
        work = _on_cluster if ray is not None else _here
        for _ in work(out, size, left, len(experiments), reporting):
            page = write()
        page = write()
    failed = [one.name for one in experiments if not is_done(out, one)]
    if failed:
        reason = read_json(folder_of(out, failed[0]) / "failed.json")["reason"]
        raise WorkError(f"{page}: {len(failed)} experiments failed, {failed[0]} the first ({reason})")
    return page


def _open(out: Path, size: Size, resume: bool) -> None:
    """Make the folder, or check that it is one to go on in."""
    marker, this = out / "size.json", json.loads(json.dumps(_described(size)))
    if not marker.exists():
        if holds_files(out):
            raise InputError(f"{out}: expected an empty or new folder, or a reproduction, found other files in it")
        write_json(marker, this)
        return
    if not resume:
        raise InputError(f"{out}: expected a new folder, found a reproduction; resume=True goes on with it")
    there = read_json(marker)
    there = there if isinstance(there, dict) else {}
    for key, value in this.items():
        if there.get(key) != value:
            difference = f"of the {key} {value!r:.60}, found {there.get(key)!r:.60}"
            if key == "configurations":
                difference = "with the scenes and trainings of this version, found one with others"
            raise InputError(f"{out}: expected a folder {difference}; choose another")


def _described(size: Size) -> Values:
    """What decides every number; the digest is of the scenes' and trainings' whole configurations."""
    scenes = [read_scene(scene, **options).to_json() for scene, options in data_of(size).values()]
    trainings = [one.config.to_json() for one in experiments_for(size, parts_known(), 1)]
    text = json.dumps([plain(size), scenes, trainings], sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()[:16]
    return {"size": size.name, "backend": backend.select(), "versions": versions(), "configurations": digest}


def _write(out: Path, size: Size, parts: Sequence[str], experiments: Sequence[Work], seeds: int) -> Path:
    """Write reproduce.json and the page about it."""
    values = {
        "schema": SCHEMA,
        "parts": list(parts),
        "seeds": seeds,
        "conditions": plain(size),
        "backend": backend.select(),
        "versions": versions(),
        **Results(out, size, seeds).all(parts, experiments),
    }
    write_json(out / "reproduce.json", values)
    return write_page(out, values)


def _make_data(out: Path, size: Size, names: Sequence[str], reporting: Reporting, ray: str | None) -> None:
    for number, name in enumerate(names, start=1):
        scene, options = data_of(size)[name]
        if not (data_folder(out, name) / "transforms.json").exists():
            with reporting(f"data {number} of {len(names)}, {name}", "frames") as tell:
                generate(read_scene(scene, **options), data_folder(out, name), resume=True, progress=tell, ray=ray)


def _here(out: Path, size: Size, left: Sequence[Work], total: int, reporting: Reporting) -> Iterator[str]:
    """Do experiments one after another; yields the name of each."""
    start, steps = time.monotonic(), [_steps(size, one) for one in left]
    for index, one in enumerate(left):
        number = total - len(left) + index + 1

        def numbered(title: str, unit: str, number: int = number) -> AbstractContextManager[object]:
            return reporting(f"{number} of {total}, {title}", unit)

        perform(out, size, one, numbered)
        yield one.name
        a_step = (time.monotonic() - start) / sum(steps[: index + 1])
        log.info("%d of %d: %s, %s", number, total, one.name, _left(a_step * sum(steps[index + 1 :])))


def _left(seconds: float) -> str:
    return f"about {duration(seconds)} left" if seconds > 0 else "the last"


def _steps(size: Size, work: Work) -> int:
    return size.figure_steps if isinstance(work, Curve) else work.config.iterations


def _on_cluster(out: Path, size: Size, left: Sequence[Work], total: int, reporting: Reporting) -> Iterator[str]:
    """Spread experiments over the cluster; yields the name of each when it is done."""
    done = total - len(left)
    work = ClusterWork(_load_performer, (out, size), out / "size.json", gpus=1.0, reuse=False)
    with reporting("reproduce", "experiments") as tell:

        def waiting() -> None:
            words = [text for one in left if (text := _progress_of(out, one))]
            tell(done, total, ", ".join(words))

        for name in run_on_cluster(work, lambda places: left, waiting):
            done += 1
            tell(done, total, name)
            yield name


def _load_performer(needed: tuple[Path, Size], threads: int) -> Callable[[Work], str]:
    """What does an experiment in a process of the cluster."""
    root, size = needed

    def do(work: Work) -> str:
        path = folder_of(root, work.name) / "progress.json"
        perform(root, size, work, partial(_reporting_to, path))
        path.unlink(missing_ok=True)
        return work.name

    return do


@contextmanager
def _reporting_to(path: Path, title: str, _unit: str) -> Iterator[ReportCallback]:
    """Tells a file how far the work is."""
    last = 0.0

    def tell(done: int, total: int, *_details: object) -> None:
        nonlocal last
        if time.monotonic() - last >= PROGRESS_EVERY:
            last = time.monotonic()
            write_bytes(path, json.dumps(f"{title} {100 * done // max(total, 1)} %").encode(), durable=False)

    yield tell


def _progress_of(out: Path, work: Work) -> str:
    """The progress of an experiment under way on the cluster, "" of another."""
    try:
        return str(read_json(folder_of(out, work.name) / "progress.json"))
    except InputError:
        return ""
