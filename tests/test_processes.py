"""Processes beside this one: how they ended is told in words, and nobody waits for one for ever."""

import os
import signal
import time

import pytest

from spacesim import processes
from spacesim.processes import ChildProcess


def child(body: str, tmp_path, monkeypatch) -> ChildProcess:
    """One whose `main` is so."""
    (tmp_path / "odd_child.py").write_text(f"def main(socket):\n    import os, signal, time\n    {body}\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    return ChildProcess("odd_child")


@pytest.mark.parametrize(
    ("body", "ending"),
    [
        ("os._exit(3)", "ended with code 3"),
        ("os.kill(os.getpid(), signal.SIGKILL)", "was killed by signal 9"),
        ("os.close(socket); time.sleep(600)", "closed its connection and did not end"),
    ],
)
def test_how_a_process_ended_is_told(body, ending, tmp_path, monkeypatch):
    monkeypatch.setattr(processes, "CRASH", 0.5 if "sleep" in body else 60.0)
    process, start = child(body, tmp_path, monkeypatch), time.monotonic()
    with pytest.raises((EOFError, OSError)):
        process.receive()
    assert process.ending() == ending
    assert time.monotonic() - start < 30
    assert process._process.returncode in (3, -signal.SIGKILL)
