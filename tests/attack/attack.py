"""Attacks on the program: damaged inputs, wrong command lines, kills, flipped bits. Each returns what was found.

A find is a traceback, an abort, an exit code outside of 0, 1 and 2, a computation that failed without a reason, more
than HEADROOM of memory beyond what honest input takes, more than PATIENCE, a write outside of the output, or a changed
byte that `verify` calls whole.
"""

import hashlib
import json
import os
import random
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import corpus
import mutations
from forks import Forked

HEADROOM = 2 << 30  #: bytes that damaged input may take beyond what the honest one does
PATIENCE = 60.0  #: seconds
RESTART_AFTER = 2000  #: commands of one process
HERE = Path(__file__).parent
ROOT = HERE.parents[1]
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (ROOT, HERE, HERE.parent)))}


@dataclass
class Tally:
    """How an attack went. finds: a line each, with what makes it happen again"""

    tried: int = 0
    finds: list[str] = field(default_factory=list)

    def add(self, find: str | None, tell: "Tell | None" = None) -> None:
        """Count a trial. tell: hears of every one"""
        self.tried += 1
        if find is not None:
            self.finds.append(find)
        if tell is not None:
            tell(self)

    @property
    def held(self) -> int:
        """Trials without a find."""
        return self.tried - len(self.finds)


Tell = Callable[[Tally], None]


class Worker:
    """A process that runs commands, and is started anew when it dies or hangs. warm_up: honest commands, whose memory
    is what others are compared with;  headroom: bytes beyond that"""

    def __init__(self, folder: Path, warm_up: Sequence[Sequence[str]] = (), headroom: int = HEADROOM) -> None:
        self.folder, self.warm_up, self.headroom = folder, warm_up, headroom
        self.honest = 0  #: bytes that the warm-up took at most
        self._process: subprocess.Popen[bytes] | None = None
        self._log = folder / "worker.log"
        self._done = 0

    def run(self, arguments: Sequence[str], folder: Path) -> dict[str, Any]:
        """What a command answers: as `worker.run`, or {"died": how} or {"hung": seconds}."""
        if self._process is None or self._done >= RESTART_AFTER:
            self.stop()
            self._start()
        self._done += 1
        answer = self._ask({"arguments": list(arguments), "folder": str(folder)})
        if self.honest and answer.get("peak", 0) > self.honest + self.headroom:
            answer["beyond"] = answer["peak"] - self.honest
        return answer

    def stop(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def _start(self) -> None:
        self._done = 0
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, str(HERE / "worker.py")],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env=ENVIRONMENT,
            )
        self.honest = 0
        for number, arguments in enumerate(self.warm_up):
            out = str(self.folder / f"warm{number}")
            answer = self._ask({"arguments": [word.format(out=out) for word in arguments], "folder": str(self.folder)})
            assert answer.get("code") == 0, (arguments, answer)
            for path in self.folder.glob(f"warm{number}*"):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
            self.honest = max(self.honest, answer["peak"])

    def _ask(self, request: Any) -> dict[str, Any]:
        process = self._process
        assert process is not None
        assert process.stdin is not None
        assert process.stdout is not None
        start = time.monotonic()
        process.stdin.write(json.dumps(request).encode() + b"\n")
        process.stdin.flush()
        answer = b""
        while not answer.endswith(b"\n"):
            left = PATIENCE - (time.monotonic() - start)
            if left <= 0 or not select.select([process.stdout], [], [], left)[0]:
                self.stop()
                return {"hung": PATIENCE}
            piece = os.read(process.stdout.fileno(), 1 << 16)
            if not piece:
                code = process.wait()
                self._process = None
                last = self._log.read_bytes()[-300:].decode("utf-8", "replace").strip()
                return {"died": f"signal {-code}" if code < 0 else f"code {code}", "errors": last}
            answer += piece
        found: dict[str, Any] = json.loads(answer)
        return found


def verdict(answer: dict[str, Any]) -> str | None:
    """What is wrong with how a command ended; None where nothing is."""
    errors = str(answer.get("errors", ""))
    if "hung" in answer:
        return f"took more than {answer['hung']:.0f} s"
    if "died" in answer:
        return f"the process died ({answer['died']}): {' '.join(errors.split())[-200:]}"
    code = answer["code"]
    if code is None or "Traceback (most recent call last)" in errors:
        return f"traceback: {' / '.join(errors.strip().splitlines()[-4:])}"
    if code not in (0, 1, 2):
        return f"exit code {code}"
    if "beyond" in answer:
        return f"took {answer['beyond'] / 1e9:.1f} GB more than honest input"
    if "the memory is short" in errors:
        return f"asked for more memory than there is: {errors.strip().splitlines()[-1]}"
    if "the computation failed" in errors:
        return f"unexplained: {errors.strip().splitlines()[-1]}"
    if code != 0 and not any(line.startswith("spacesim") for line in errors.splitlines()):
        return f"exit code {code} without a sentence: {errors[-200:]!r}"
    return None


# ---- damaged inputs and command lines ----


Listing = dict[str, tuple[int, int, int]]
"""Of all below a folder, by its path in it: size of what is a file or leads to one, kind and permissions, inode."""


@dataclass(frozen=True)
class Trial:
    """One damaged input."""

    folder: Path
    words: tuple[str, ...]  #: the command
    what: str  #: in words, how to make it again
    path: Path | None = None  #: what is damaged


class Copy:
    """A copy of the corpus in which one file after the other is damaged and mended again. It is made anew where a
    command has changed what is in it."""

    def __init__(self, root: Path, folder: Path) -> None:
        self.root, self.folder = root, folder
        self._honest: Listing = {}

    def restored(self) -> Path:
        """The folder, with nothing damaged."""
        if not self._honest:
            shutil.rmtree(self.folder, ignore_errors=True)
            self._honest = _listing(corpus.linked_copy(self.root, self.folder))
        return self.folder

    def strange(self, trial: Trial) -> list[str]:
        """What lies there after a trial and did not before, the damage aside. Mends the damage."""
        name = str(trial.path.relative_to(self.folder)) if trial.path else ""
        before, after = dict(self._honest), _listing(self.folder)
        if trial.path:
            before[name] = after.pop(name, before[name])
            after[name] = before[name]
        if trial.path and after == before:
            _remove(trial.path)
            os.link(self.root / name, trial.path)
        elif after != before:
            self._honest = {}
        return sorted(name for name, found in after.items() if before.get(name, (0, 0, 0))[:2] != found[:2])


def _remove(path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink(missing_ok=True)


def prepared(copy: Copy, out: Path, seed: int, number: int) -> Trial:
    """Damage the copy as (seed, number) say. out: a new folder for what the command writes"""
    rng, folder = random.Random(f"{seed}/{number}"), copy.restored()
    if rng.random() < 0.15:
        return _named(folder, out, corpus.command_line(rng), f"{number} command line")
    kind = rng.choice(corpus.KINDS)
    at = rng.randrange(len(kind.files))
    path = folder / kind.files[at]
    words = kind.commands[at] if len(kind.commands) == len(kind.files) == 8 else rng.choice(kind.commands)
    if kind.special and rng.random() < 0.03:
        how = _special(rng, path)
    else:
        way = rng.choice(kind.ways)
        how = way.__name__
        data = path.read_bytes()
        path.unlink()
        path.write_bytes(_damaged(rng, way, data))
    return _named(folder, out, list(words), f"{number} {kind.name}: {path.relative_to(folder)} {how}", path)


def _damaged(rng: random.Random, way: mutations.Mutation, data: bytes) -> bytes:
    """Bytes are damaged where a file is not of the format that the way knows."""
    state = rng.getstate()
    try:
        return way(rng, data)
    except (ValueError, IndexError, KeyError, UnicodeError, TypeError, OverflowError, AttributeError, MemoryError):
        rng.setstate(state)
    except Exception as error:
        if type(error).__name__ != "error":  # of struct
            raise
        rng.setstate(state)
    return mutations.of_bytes(rng, data)


def _special(rng: random.Random, path: Path) -> str:
    kind = rng.choice(("pipe", "zero", "null", "folder", "loop", "nothing", "full", "socket"))
    path.unlink()
    if kind == "pipe":
        os.mkfifo(path)
    elif kind in ("zero", "null", "full"):
        path.symlink_to(f"/dev/{kind}")
    elif kind == "folder":
        path.mkdir()
    elif kind == "loop":
        path.symlink_to(path.name)
    elif kind == "socket":
        import socket

        with socket.socket(socket.AF_UNIX) as one, suppress(OSError):
            one.bind(os.path.relpath(path))
    return f"as {kind}"


def _named(folder: Path, out: Path, words: list[str], what: str, path: Path | None = None) -> Trial:
    named = tuple(word.replace("{out}", str(out / "x")) for word in words)
    shown = " ".join(word.replace(str(out.parent), ".") for word in named)
    return Trial(folder, named, f"{what} | {shown}", path)


def _is_quick(words: Sequence[str]) -> bool:
    return "half" not in words and ("eval" not in words or "--no-geometry" in words)


WARM_UP = (
    *dict.fromkeys(words for kind in corpus.KINDS for words in kind.commands if _is_quick(words)),
    ("sweep", "run", "--camera", "camera.json", "--frames", "2", "--size", "1024", "--out", "{out}"),
)


def attack_inputs(root: Path, work: Path, seed: int, count: int, processes: int = 2, tell: Tell | None = None) -> Tally:
    """Damage `count` inputs and command lines, and see how commands end. root: the corpus;  work: a new folder"""
    tally, before = Tally(), _state(root)

    def attacked(worker_number: int) -> Iterator[str | None]:
        place = work / f"worker{worker_number}"
        corpus.linked_copy(root, place / "honest")
        worker, copy = Worker(place / "honest", WARM_UP), Copy(root, place / "in")
        try:
            for number in range(worker_number, count, processes):
                yield one_trial(copy, place / "out", worker, seed, number)
        finally:
            worker.stop()

    def count_up(worker_number: int) -> None:
        for find in attacked(worker_number):
            tally.add(find, tell)

    with ThreadPoolExecutor(processes) as pool:
        list(pool.map(count_up, range(processes)))
    if _state(root) != before:
        tally.finds.append("a file of the corpus was written into: a write outside of the output")
    return tally


def one_trial(copy: Copy, out: Path, worker: Worker, seed: int, number: int) -> str | None:
    """A find, or None. out: a folder that is there for the trial alone"""
    out.mkdir()
    try:
        trial = prepared(copy, out, seed, number)
        wrong = verdict(worker.run(trial.words, trial.folder))
        strange = copy.strange(trial)
        if wrong is None and strange and not _writes_here(trial.words):
            wrong = f"a write outside of the output: {strange[0]}"
        return None if wrong is None else f"{trial.what} -> {wrong}"
    finally:
        shutil.rmtree(out, ignore_errors=True)


def _writes_here(words: Sequence[str]) -> bool:
    """Whether a command's output is among the copies of the corpus: damaged command lines may ask for that."""
    named = [
        words[i + 1]
        for i, word in enumerate(words[:-1])
        if word in ("--out", "--ply", "--mesh", "--speedplus", "--bop")
    ]
    return any(not os.path.isabs(name) for name in named)


def _listing(folder: Path) -> Listing:
    found: Listing = {}

    def visit(place: str, above: str) -> None:
        with os.scandir(place) as entries:
            for entry in entries:
                status = entry.stat(follow_symlinks=False)
                size = status.st_size if os.path.isfile(entry.path) else 0
                found[above + entry.name] = (size, status.st_mode, status.st_ino)
                if entry.is_dir(follow_symlinks=False):
                    visit(entry.path, f"{above}{entry.name}/")

    visit(str(folder), "")
    return found


def _state(folder: Path) -> str:
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            digest.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return digest.hexdigest()


# ---- kills ----

TRAINING = """
import sys
from dataclasses import replace
from pathlib import Path
from spacesim.data.store import read_dataset
from spacesim.splat.train.config import preset
from spacesim.splat.train.train import train
config = replace(preset("demo", "shadow-map"), init_count=40, iterations=60, checkpoint_every=5)
train(read_dataset(Path("data")), Path(sys.argv[1]), config, resume=True)
"""


@dataclass(frozen=True)
class Killed:
    """A command that is killed and done again."""

    name: str
    words: tuple[str, ...]  #: after the interpreter's name
    #: names of files that may differ from an undisturbed run's, as they hold times or the folder's name
    changes: tuple[str, ...] = ()


_SPARING = """
import runpy
import sooner
sooner.{}()
runpy.run_module("spacesim.cli", run_name="__main__", alter_sys=True)
"""
_GENERATE = ("-c", _SPARING.format("spare_datasets"), "generate", "boat.obj", "--out", "{out}", *corpus.TINY)
_EVAL = ("-c", _SPARING.format("spare_shapes"), "eval")
KILLED = (
    Killed("generate", (*_GENERATE, "--views", "12", "--resume")),
    Killed("generate --workers 2", (*_GENERATE, "--views", "12", "--resume", "--workers", "2")),
    Killed("train", ("-c", TRAINING, "{out}"), ("config.json", "training.json", "checkpoints/seconds.json")),
    Killed("eval", (*_EVAL, "run", "--data", "data", "--out", "{out}"), ("metrics.json", "report.html")),
    Killed("compose", ("-m", "spacesim.cli", "compose", "composed.toml", "--out", "{out}")),
)


def attack_kills(root: Path, work: Path, seed: int, count: int, processes: int = 2, tell: Tell | None = None) -> Tally:
    """Kill commands at random moments, do them again, and compare every byte with an undisturbed run's."""
    tally, straight = Tally(), {one.name: _undisturbed(one, root, work / "straight") for one in KILLED[:count]}

    def attacked(number: int) -> None:
        rng, one = random.Random(f"{seed}/kills/{number}"), KILLED[number % len(KILLED)]
        expected, seconds = straight[one.name]
        moments = [rng.uniform(0.3, 1.05) * seconds for _ in range(rng.choice((1, 1, 2, 3)))]
        ends = rng.choices((signal.SIGKILL, signal.SIGINT, signal.SIGTERM), (3, 1, 1), k=len(moments))
        place = work / f"kill{number}"
        folder, out = corpus.linked_copy(root, place / "in"), place / "out"
        found = _end_and_resume(one, folder, out, list(zip(moments, ends, strict=True)), expected)
        signals = ", ".join(f"{end.name} after {moment:.2f} s" for moment, end in zip(moments, ends, strict=True))
        tally.add(None if found is None else f"{number} {one.name}, {signals}: {found}", tell)
        shutil.rmtree(place, ignore_errors=True)

    with ThreadPoolExecutor(processes) as pool:
        list(pool.map(attacked, range(count)))
    return tally


def _undisturbed(one: Killed, root: Path, place: Path) -> tuple[dict[str, bytes], float]:
    """What a command writes, and in how many seconds."""
    folder, out = corpus.linked_copy(root, place / "in"), place / "out"
    start = time.monotonic()
    process = _process(one, folder, out)
    _, errors = process.communicate(timeout=5 * PATIENCE)
    seconds = time.monotonic() - start
    assert process.returncode == 0, (one.name, errors)
    found = _contents(out, one.changes)
    shutil.rmtree(place)
    return found, seconds


def _process(one: Killed, folder: Path, out: Path) -> Forked:
    return Forked([word.replace("{out}", str(out)) for word in one.words], folder, **ENVIRONMENT)


def _end_and_resume(
    one: Killed,
    folder: Path,
    out: Path,
    moments: Sequence[tuple[float, signal.Signals]],
    expected: dict[str, bytes],
) -> str | None:
    for moment, end in moments:
        process = _process(one, folder, out)
        with suppress(subprocess.TimeoutExpired):
            process.communicate(timeout=moment)
        with suppress(ProcessLookupError):
            os.killpg(process.pid, end)
        try:
            process.communicate(timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return f"{end.name} did not end it within {PATIENCE:.0f} s"
    process = _process(one, folder, out)
    try:
        _, errors = process.communicate(timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        return f"the same command took more than {PATIENCE:.0f} s afterwards"
    if process.returncode != 0:
        return f"the same command ended with code {process.returncode}: {errors[-300:].decode('utf-8', 'replace')}"
    found = _contents(out, one.changes)
    different = sorted(name for name in found.keys() | expected.keys() if found.get(name) != expected.get(name))
    return f"{len(different)} files differ, {different[0]} the first" if different else None


def _contents(folder: Path, changes: Sequence[str]) -> dict[str, bytes]:
    paths = (path for path in folder.rglob("*") if path.is_file())
    named = {str(path.relative_to(folder)): path for path in paths}
    return {name: path.read_bytes() for name, path in named.items() if name not in changes}


# ---- flipped bits ----


def attack_bits(root: Path, work: Path, seed: int, count: int, tell: Tell | None = None) -> Tally:
    """Flip single bits of a dataset's files; `verify` must say so, of PNG files without SHA256SUMS, too."""
    rng, tally = random.Random(f"{seed}/bits"), Tally()
    data = Path(shutil.copytree(root / "data", work / "bits" / "data"))
    files = sorted(path for path in data.rglob("*") if path.is_file())
    pictures = [path for path in files if path.suffix == ".png"]
    sums, worker = data / "SHA256SUMS", Worker(data.parent)
    listed = sums.read_bytes()
    try:
        assert worker.run(["verify", "data"], data.parent)["code"] == 0
        for number in range(count):
            alone = number % 3 == 0  # without digests, as data from elsewhere
            path = rng.choice(pictures if alone else files)
            honest = path.read_bytes()
            bit = rng.randrange(8 * len(honest))
            damaged = bytearray(honest)
            damaged[bit // 8] ^= 1 << bit % 8
            if alone:
                sums.unlink()
            path.write_bytes(damaged)
            answer = worker.run(["verify", "data"], data.parent)
            wrong = verdict(answer) or ("verify calls it whole" if answer["code"] == 0 else None)
            how = " without SHA256SUMS" if alone else ""
            tally.add(None if wrong is None else f"{number}: bit {bit} of {path.relative_to(data)}{how}: {wrong}", tell)
            path.write_bytes(honest)
            if alone:
                sums.write_bytes(listed)
    finally:
        worker.stop()
    return tally
