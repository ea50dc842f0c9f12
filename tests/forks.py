"""Processes that have imported what takes a second before they begin, for tests of what a command leaves behind when it
is killed: forked from one process that has done that and no more, they are as good as new. CUDA survives no fork: where
there is one, they are new."""

import os
import runpy
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from multiprocessing import get_context
from pathlib import Path

from spacesim.backend import available

IMPORTED = (
    *("spacesim.scenes.generation.generate", "spacesim.eval.evaluate", "spacesim.splat.train.train", "sooner"),
    *("spacesim.splat.compose.output", "spacesim.cli.program", "mitsuba", "trimesh", "scipy.spatial", "igl"),
)
_CONTEXT = get_context("spawn" if available()["cuda"] is None else "forkserver")
_CONTEXT.set_forkserver_preload(["__main__", *IMPORTED])


class Forked:
    """A process in a session of its own, as `python WORDS` would be: "-m", a module, or "-c", a program, and arguments.
    What it prints is lost, but for its errors.

    folder: where it works
    environment: added to this process's
    """

    def __init__(self, words: Sequence[object], folder: Path | None = None, **environment: str) -> None:
        errors, name = tempfile.mkstemp()
        os.close(errors)
        self._file: Path | None = Path(name)  #: of the errors
        self._errors = b""
        arguments = [str(word) for word in words], folder or Path.cwd(), name, {**os.environ, **environment}
        self._process = _CONTEXT.Process(target=_run, args=arguments)
        self._process.start()
        assert self._process.pid is not None
        self.pid = self._process.pid
        while self.poll() is None and os.getpgid(self.pid) != self.pid:
            time.sleep(0.001)

    def poll(self) -> int | None:
        """As subprocess has it: None, a code, or minus the number of a signal."""
        return self._process.exitcode

    @property
    def returncode(self) -> int | None:
        """As `poll`."""
        return self.poll()

    def communicate(self, timeout: float = 100.0) -> tuple[None, bytes]:
        """(None, what it wrote as errors) once it has ended. Raises subprocess.TimeoutExpired where it has not."""
        self._process.join(timeout)
        if self.poll() is None:
            raise subprocess.TimeoutExpired("a forked process", timeout)
        if self._file is not None:
            self._errors = self._file.read_bytes()
            self._file.unlink()
            self._file = None
        return None, self._errors


def _run(words: Sequence[str], folder: Path, errors: str, environment: Mapping[str, str]) -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(os.open(errors, os.O_WRONLY), 2)
    os.environ.update(environment)
    os.chdir(folder)
    os.setsid()
    kind, program, *rest = words
    if kind == "-m":
        sys.argv = [program, *rest]
        runpy.run_module(program, run_name="__main__", alter_sys=True)
    else:
        sys.argv = [kind, *rest]
        exec(compile(program, "<string>", "exec"), {"__name__": "__main__"})
