"""The attack at its smallest: nothing is found. And it would find what it looks for."""

import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import attack
import corpus
import pytest
from attack import Worker, attack_bits, attack_inputs, attack_kills, verdict
from tiny import contents

SEED = 20261122


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return corpus.build(tmp_path_factory.mktemp("attack") / "corpus")


def test_damaged_inputs_and_wrong_command_lines(root, tmp_path):
    found = attack_inputs(root, tmp_path, SEED, 2000, processes=len(os.sched_getaffinity(0)))
    assert found.finds == []
    assert (found.tried, found.held) == (2000, 2000)


def test_kills(root, tmp_path):
    assert attack_kills(root, tmp_path, SEED, 10).finds == []


def test_flipped_bits(root, tmp_path):
    assert attack_bits(root, tmp_path, SEED, 150).finds == []


# --- the attack itself -----------------------------------------------------------------------------------------------

WEAK = """
import os, time
import numpy as np
import spacesim.cli as cli
from spacesim.cli import doctor
WAYS = {
    "traceback": lambda: [][1],
    "code": lambda: 7,
    "abort": lambda: os.abort(),
    "sleep": lambda: time.sleep(9),
    "memory": lambda: float(np.ones(3 << 26).sum()) and 0,
    "short": lambda: (_ for _ in ()).throw(MemoryError("a picture needs about 40 GB")),
    "runtime": lambda: (_ for _ in ()).throw(RuntimeError("of no known reason")),
}
honest = cli.main
doctor.run = lambda options, known=doctor.run: WAYS[way]() if way else known(options)
way = ""

def main(arguments):
    global way
    way = arguments[0] if arguments[0] in WAYS else ""
    if way in ("short", "runtime"):  # through the real one
        return honest(["doctor"])
    return WAYS[way]() if way else honest(arguments)

cli.main = main
"""


@pytest.fixture(scope="module")
def weak(tmp_path_factory) -> Iterator[Worker]:
    """A worker whose program fails in each of WAYS."""
    folder = tmp_path_factory.mktemp("weak")
    (folder / "sitecustomize.py").write_text(WEAK)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(attack.ENVIRONMENT, "PYTHONPATH", f"{folder}:{attack.ENVIRONMENT['PYTHONPATH']}")
        worker = Worker(folder, [["doctor"]], headroom=1 << 30)
        yield worker
        worker.stop()


@pytest.mark.parametrize(
    ("way", "words"),
    [
        ("traceback", "traceback: .*IndexError"),
        ("code", "exit code 7"),
        ("abort", "the process died .signal 6"),
        ("sleep", "took more than 2 s"),
        ("memory", r"took 1\.[0-9] GB more than honest input"),
        ("short", "asked for more memory than there is"),
        ("runtime", "unexplained: .*of no known reason"),
    ],
)
def test_failures_of_a_program_are_found(weak, tmp_path, monkeypatch, way, words):
    assert verdict(weak.run(["doctor"], tmp_path)) is None
    if way == "sleep":
        monkeypatch.setattr(attack, "PATIENCE", 2.0)
    found = verdict(weak.run([way], tmp_path))
    monkeypatch.setattr(attack, "PATIENCE", 60.0)
    assert verdict(weak.run(["doctor"], tmp_path)) is None, "it is started anew"
    assert found is not None
    assert re.search(words, found), found


@pytest.mark.parametrize(
    ("answer", "wrong"),
    [
        ({"code": 0, "errors": ""}, False),
        ({"code": 2, "errors": "spacesim: --out: expected a folder\n"}, False),
        ({"code": 2, "errors": "train: 1/2\n"}, True),
        ({"code": 1, "errors": "spacesim: the computation failed (x); --debug shows where\n"}, True),
        ({"code": 0, "errors": "Traceback (most recent call last):\n"}, True),
    ],
)
def test_verdicts(answer, wrong):
    assert (verdict(answer) is not None) == wrong


def test_it_finds_bytes_that_are_called_whole(root, tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text(
        "import spacesim.data.integrity.verify as v\n"
        "v.differences = lambda root: {}\n"
        "v.find_unreadable_files = lambda path: []\n"
    )
    path = attack.ENVIRONMENT["PYTHONPATH"]
    monkeypatch.setitem(attack.ENVIRONMENT, "PYTHONPATH", f"{tmp_path}:{path}")
    found = attack_bits(root, tmp_path, SEED, 12)
    assert any("verify calls it whole" in find for find in found.finds)


def test_it_finds_what_a_kill_has_spoilt(root, tmp_path, monkeypatch):
    """A command whose output depends on how often it was started."""
    counting = "import os, sys; out = sys.argv[1]; os.makedirs(out, exist_ok=True); open(out + '/a', 'a').write('x')"
    slow = f"{counting}; import time; time.sleep(0.5)"
    monkeypatch.setattr(attack, "KILLED", (attack.Killed("counting", ("-c", slow, "{out}")),))
    found = attack_kills(root, tmp_path, SEED, 3)
    assert len(found.finds) == 3
    assert "1 files differ, a the first" in found.finds[0]


def test_it_finds_writes_outside_of_the_output(root, tmp_path, monkeypatch):
    copy = attack.Copy(root, tmp_path / "in")

    class Writing:
        def run(self, words, folder):
            (folder / "data/images/new.png").write_bytes(b"")
            return {"code": 0, "errors": ""}

    monkeypatch.setattr(corpus, "command_line", lambda rng: ["doctor"])
    finds = [attack.one_trial(copy, tmp_path / "out", Writing(), SEED, n) for n in range(5)]  # type: ignore[arg-type]
    assert all(find is not None and "a write outside of the output: data/images/new.png" in find for find in finds)


def test_a_copy_is_mended_after_each_trial(root, tmp_path):
    """Whatever was damaged, and whatever a command left, replaced or took away."""
    copy, honest = attack.Copy(root, tmp_path / "in"), contents(root)

    def replace(folder):
        path = folder / "camera.json"
        data = bytes(reversed(path.read_bytes()))
        path.unlink()
        path.write_bytes(data)  # of the same size

    deeds = (lambda folder: None, lambda folder: (folder / "run/new").touch(), replace)
    deeds += (lambda folder: (folder / "boat.obj").unlink(), lambda folder: shutil.rmtree(folder / "run"))
    for number in range(60):
        trial = attack.prepared(copy, tmp_path / "out", SEED, number)
        deeds[number % len(deeds)](trial.folder)
        strange = copy.strange(trial)
        assert ("run/new" in strange) == (number % len(deeds) == 1)
        assert contents(copy.restored()) == honest
    assert contents(root) == honest
