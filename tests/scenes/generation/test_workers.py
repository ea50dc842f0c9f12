"""Several processes, and Ray where it is installed, write the same bytes as one, whatever happens to them."""

import importlib.util
import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from forks import Forked
from tiny import contents

from spacesim.data.errors import InputError, WorkError
from spacesim.data.records import Sun
from spacesim.data.store import WrittenFrame
from spacesim.scenes.generation import frames, workers
from spacesim.scenes.generation.frames import FrameMaker, FrameSpec, Job, writing_threads
from spacesim.scenes.generation.generate import _DatasetPlan, generate
from spacesim.scenes.generation.workers import make_in_processes
from spacesim.scenes.scenefile import read_scene

OPTIONS = {"views": 30, "test_views": 0, "resolution": (24, 24), "spp": 4, "points": 100}
CONFIG = read_scene("boxsat", **OPTIONS)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> dict[str, bytes]:
    """What one undisturbed process writes."""
    root = tmp_path_factory.mktemp("one") / "data"
    generate(CONFIG, root)
    return contents(root)


@pytest.fixture
def job(tmp_path) -> tuple[Job, list[FrameSpec]]:
    sweep = _DatasetPlan(read_scene("boxsat", **{**OPTIONS, "views": 6}))
    return replace(sweep.job, root=tmp_path), sweep.specs


def names_of(made: Iterable[WrittenFrame]) -> list[str]:
    return [frame.name for frame in made]


def workers_of(parent: int, module: str = "workers") -> list[int]:
    """Process ids of the workers, or the encoders, that a process has started."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
            name = f"spacesim.scenes.generation.{module}".encode()
            if int(fields[1]) == parent and name in (folder / "cmdline").read_bytes():
                found.append(int(folder.name))
        except OSError:
            continue
    return found


def alive(process: int) -> bool:
    try:
        return (Path("/proc") / str(process) / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


needs_proc = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")


@needs_proc
def test_killed_workers_are_replaced_and_the_bytes_are_those_of_one_process(whole, tmp_path):
    """After every fifth frame one of two workers is killed, four in all."""
    root, killed = tmp_path / "data", []

    def kill(done: int, *_: object) -> None:
        if done % 5 == 0 and len(killed) < 4:
            victim = min(workers_of(os.getpid()))
            os.kill(victim, signal.SIGKILL)
            killed.append(victim)

    generate(CONFIG, root, workers=2, progress=kill)
    assert len(set(killed)) == 4
    assert contents(root) == whole
    assert workers_of(os.getpid()) == []


@needs_proc
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGINT])
@pytest.mark.parametrize("module", ["workers", "encoders"])
def test_processes_end_with_their_parent_and_resume_completes(whole, tmp_path, module, end):
    """kill -9 leaves no orphans; Ctrl-C leaves no half-written file either."""
    root = tmp_path / "data"
    code = (
        "import sys; from pathlib import Path; from spacesim.scenes.scenefile import read_scene;"
        "from spacesim.scenes.generation.generate import generate;"
        "from spacesim.scenes.generation import frames; frames.PROCESSES_FROM = {'cuda': 0, 'llvm': 0};"
        "frames.cores = lambda: 4;"
        f"generate(read_scene('boxsat', **{OPTIONS!r}), Path(sys.argv[1]), True, workers={1 + (module == 'workers')})"
    )
    process = Forked(["-c", code, root])
    while len(list(root.glob("gt/*.exr"))) < 8:
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.002)
    workers = workers_of(process.pid, module)
    os.kill(process.pid, end)
    process.communicate(timeout=20)
    assert len(workers) >= 2
    deadline = time.monotonic() + 3
    while any(alive(worker) for worker in workers):
        assert time.monotonic() < deadline, "workers outlive their parent"
        time.sleep(0.01)
    assert not (root / "transforms.json").exists(), "it should have been stopped before its end"
    if end == signal.SIGINT:
        assert not list(root.rglob("*.part"))
    generate(CONFIG, root, resume=True)
    assert contents(root) == whole


def test_frames_that_kill_every_process_end_in_a_sentence(job, monkeypatch):
    work, specs = job
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(WorkError, match=r"train_00000 to train_00000: 3 processes ended .* code 1.* fewer workers"):
        list(make_in_processes(work, specs, 1))


def test_the_sentence_names_frames_that_are_not_made(job):
    specs = job[1]
    task, later = workers._Task(specs[:3], deaths=2), workers._Task(specs[3:5])
    worker = workers._Worker(_Ended(), deque([task, later]), [])
    for made in (specs[0], specs[4]):
        worker.has_made(made.name)
    with pytest.raises(WorkError, match=f"^{specs[1].name} to {specs[3].name}: 3 processes ended .* ended with code 7"):
        workers._requeue(worker, deque())


class _Ended:
    """A process that has ended by itself."""

    def ending(self) -> str:
        return "ended with code 7"


def test_an_error_in_a_worker_is_raised_unchanged(job, tmp_path):
    work, specs = job
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(InputError, match=r"file/data/.*cannot be written"):
        list(make_in_processes(replace(work, root=tmp_path / "file/data"), specs, 2))


def test_frames_that_are_whole_are_not_rendered_again(job, monkeypatch):
    work, specs = job
    maker = FrameMaker(work)
    assert names_of(maker.make(specs)) == [spec.name for spec in specs]
    monkeypatch.setattr(maker, "_renderer", None)
    assert names_of(maker.make(specs)) == [spec.name for spec in specs]


@pytest.mark.parametrize("at_once", [0, 1, 3])
def test_frames_are_the_same_however_many_are_under_way(job, tmp_path, monkeypatch, at_once):
    """Some of them whole already; under another Sun each."""
    work, specs = job
    specs = [replace(spec, sun=Sun.from_angles(70 * spec.index, 20)) for spec in specs]
    one = replace(work, root=tmp_path / "one")
    assert names_of(FrameMaker(one).make(specs)) == [spec.name for spec in specs]
    monkeypatch.setattr(frames, "AT_ONCE", dict.fromkeys(frames.AT_ONCE, at_once))
    again = FrameMaker(replace(work, root=tmp_path / "again"))
    assert names_of(again.make(specs[1:3])) == [spec.name for spec in specs[1:3]]
    assert names_of(again.make(specs)) == [spec.name for spec in specs]
    assert contents(tmp_path / "again") == contents(one.root)


@pytest.mark.parametrize("step", [0, 1])
def test_an_error_comes_after_the_frames_before_it(job, monkeypatch, step):
    """In a frame's first step, or while later ones have been started."""
    work, specs = job
    monkeypatch.setattr(frames, "AT_ONCE", dict.fromkeys(frames.AT_ONCE, 3))
    maker, whole = FrameMaker(work), FrameMaker._steps

    def failing(self, spec):
        if spec.index != 2:
            return (yield from whole(self, spec))
        yield from [None] * step
        raise WorkError("no memory is left")

    monkeypatch.setattr(FrameMaker, "_steps", failing)
    made = []
    with pytest.raises(WorkError, match="no memory is left"):
        made.extend(spec.index for spec, _ in maker._rendered(specs))
    assert made == [0, 1]


@pytest.fixture
def encoding(job, monkeypatch) -> tuple[Job, list[FrameSpec]]:
    """A job whose frames are encoded in two processes."""
    monkeypatch.setattr(frames, "PROCESSES_FROM", dict.fromkeys(frames.PROCESSES_FROM, 0))
    work, specs = job
    return replace(work, threads=2), specs


@needs_proc
def test_processes_encode_the_same_bytes_and_may_die(encoding, tmp_path, monkeypatch):
    work, specs = encoding
    maker = FrameMaker(work)
    made = maker.make(specs)
    first = [next(made), next(made)]
    started = workers_of(os.getpid(), "encoders")
    assert len(started) == 2
    os.kill(started[0], signal.SIGKILL)
    assert names_of([*first, *made]) == [spec.name for spec in specs]
    assert started[0] not in workers_of(os.getpid(), "encoders")
    del maker, made
    assert not any(alive(process) for process in workers_of(os.getpid(), "encoders"))
    monkeypatch.undo()
    one = replace(work, root=tmp_path / "one")
    list(FrameMaker(one).make(specs))
    written = contents(tmp_path)
    assert {key: value for key, value in written.items() if not key.startswith("one/")} == contents(one.root)


def test_an_error_in_an_encoder_is_raised_unchanged(encoding, tmp_path):
    work, specs = encoding
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(InputError, match=r"file/data/.*cannot be written"):
        list(FrameMaker(replace(work, root=tmp_path / "file/data")).make(specs))


def test_a_frame_that_kills_every_encoder_ends_in_a_sentence(encoding, monkeypatch):
    work, specs = encoding
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(WorkError, match=r"train_0000\d: 3 processes ended while they wrote it, the last ended with"):
        list(FrameMaker(work).make(specs))


class _Obliging:
    """A process that makes all that it is given at once, and its connection."""

    def __init__(self) -> None:
        self.answers: list[WrittenFrame | None] = [None]

    @property
    def connection(self) -> "_Obliging":
        return self

    def send(self, specs: list[FrameSpec]) -> None:
        self.answers += [*(WrittenFrame(spec.name, (), (), None) for spec in specs), None]

    def receive(self) -> WrittenFrame | None:
        return self.answers.pop(0)


@pytest.mark.parametrize("count", [2, 3, 5])
def test_several_processes_may_ask_at_once_when_few_tasks_are_left(job, monkeypatch, count):
    def start(_job: Job, task: Any, *_: int) -> workers._Worker:
        return workers._Worker(_Obliging(), deque([task]), [task.specs])

    def all_that_spoke(connections: list[_Obliging]) -> list[_Obliging]:
        spoke = [connection for connection in connections if connection.answers]
        assert spoke, "nobody is asked and nobody answers: it would wait for ever"
        return spoke

    monkeypatch.setattr(workers, "_start", start)
    monkeypatch.setattr(workers, "end", lambda _processes: None)
    monkeypatch.setattr(workers, "wait", all_that_spoke)
    work, specs = job
    assert sorted(names_of(make_in_processes(work, specs, count))) == sorted(spec.name for spec in specs)


def test_threads_are_shared_among_processes(monkeypatch):
    monkeypatch.setattr("spacesim.scenes.generation.frames.cores", lambda: 16)
    assert [writing_threads(count) for count in (1, 4, 16, 40)] == [16, 4, 1, 1]


def test_ray_writes_the_same_bytes(whole, tmp_path):
    if importlib.util.find_spec("ray") is None:
        pytest.skip("the extra 'cluster' is not installed")
    generate(CONFIG, tmp_path / "data", ray="local")
    assert contents(tmp_path / "data") == whole


def test_a_missing_ray_is_reported_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"pip install 'spacesim\[cluster\]'"):
        generate(CONFIG, tmp_path / "data", ray="auto")
    assert not list(tmp_path.iterdir())


def test_processes_that_have_nothing_left_to_do(tmp_path):
    """All frames are there, transforms.json is not: what a kill at the end leaves."""
    config = read_scene("boxsat", **{**OPTIONS, "views": 4})
    root = tmp_path / "data"
    generate(config, root, workers=2)
    first = contents(root)
    generate(config, root, resume=True, workers=2)
    (root / "transforms.json").unlink()
    generate(config, root, resume=True, workers=2)
    assert contents(root) == first


def test_encoders_start_without_what_renders():
    """There is one for each core of a machine."""
    code = "import sys; import spacesim.scenes.generation.encoders; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"drjit", "mitsuba", "trimesh", "scipy"} & set(done.stdout.split())
