"""A way to call the command line in a test, and options that keep its work tiny."""

import contextlib
import io
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from spacesim.cli import main

GENERATE = ("--views", "6", "--test-views", "2", "--resolution", "40", "--spp", "4")
TRAIN = ("--preset", "demo", "--iterations", "50", "--set", "init_count=300")
#: settings: shadows are refined by a network, which `demo` has for shadow splatting alone
REFINED = {"light.shadow.refine": {"width": 32, "sun": {"kind": "harmonics", "degree": 0}, "positions": "world"}}
TRAIN_FIELD = ("--preset", "demo", "--iterations", "60", "--set=rays=512", "--set=samples=12", "--set=chunk=2048")
SPARING = f"""import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from sooner import spare_datasets
spare_datasets()
"""
#: the command line in a process of its own, for `python -c`, which makes the same datasets as tests in theirs
PROGRAM = f"{SPARING}import runpy; runpy.run_module('spacesim.cli', run_name='__main__', alter_sys=True)"
PROGRESS = re.compile(r"(generate|train|evaluate|sweep|compose|export): \d+/\d+ ")


def contents(root: Path) -> dict[str, bytes]:
    """What the files under a folder hold, by their paths in it."""
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def pair_scene(one: Path, other: Path, place=(3, 0, 0), sun=(0, 10), eye=(0, -16, 3), size=(48, 32)) -> str:
    """A scene file of two runs: one at the origin, the other half as large at `place`, under a Sun at (azimuth,
    elevation), seen from `eye` between both."""
    return f"""
[[models]]
name = "one"
run = "{one}"

[[models]]
name = "other"
run = "{other}"
position = {list(place)}
scale = 0.5

[sun]
azimuth_deg = {sun[0]}
elevation_deg = {sun[1]}

[camera]
position = {list(eye)}
look_at = {[0.5 * x for x in place]}
resolution = {list(size)}
"""


@dataclass(frozen=True)
class Outcome:
    """What a command left behind. errors: lines of standard error that are no progress."""

    code: int
    output: str
    errors: list[str]

    def is_refusal(self, *names: object) -> bool:
        """Exit code 2, nothing but one sentence, and that names the file or option."""
        return (
            self.code == 2
            and self.output == ""
            and len(self.errors) == 1
            and self.errors[0].startswith("spacesim")
            and all(str(name) in self.errors[0] for name in names)
        )


def outcome(code: int, output: str, errors: str) -> Outcome:
    """Of a command that has ended."""
    return Outcome(code, output, [line for line in errors.splitlines() if not PROGRESS.match(line)])


def captured(run: Callable[[list[str]], int | None], arguments: list[str]) -> Outcome:
    """Of a program that runs in this process, and returns its exit code or raises SystemExit."""
    output, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
        try:
            code = run(arguments) or 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
            if isinstance(end.code, str):
                print(end.code, file=sys.stderr)
    return outcome(code, output.getvalue(), errors.getvalue())


def call(*arguments: object) -> Outcome:
    """Run a command in this process."""
    return captured(main, [str(argument) for argument in arguments])
