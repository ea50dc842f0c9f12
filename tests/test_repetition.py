"""No run of ten lines stands twice in the sources: what two places need has a name."""

import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = ("spacesim", "tests", "benchmarks")
SUFFIXES = (".py", ".toml", ".js", ".css")
LEAST = 10  #: lines of a run
IMPORT = re.compile(r"^[ \t]*(?:from [\w.]+ import (?:\([^)]*\)|.*)|import .*)$", re.MULTILINE)


def numbered_lines(text: str) -> list[tuple[int, str]]:
    """(number, line without indentation) of the lines that are neither blank nor an import."""
    kept = IMPORT.sub(lambda match: "\n" * match.group().count("\n"), text)
    return [(number, line.strip()) for number, line in enumerate(kept.split("\n"), 1) if line.strip()]


def repeated_runs(texts: Mapping[str, str]) -> Iterator[list[str]]:
    """Places, "name:line", of each run of LEAST lines that stands more than once."""
    files = {name: numbered_lines(text) for name, text in texts.items()}
    count = Counter(line for lines in files.values() for _, line in lines)
    places = defaultdict(list)
    for name, lines in files.items():
        length = 0  # of the run up to here whose lines, each by itself, stand elsewhere, too
        for index, (_, line) in enumerate(lines):
            length = length + 1 if count[line] > 1 else 0
            if length >= LEAST:
                run = lines[index + 1 - LEAST : index + 1]
                places[tuple(line for _, line in run)].append(f"{name}:{run[0][0]}")
    yield from (where for where in places.values() if len(where) > 1)


def test_no_ten_lines_stand_twice():
    paths = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if path.suffix in SUFFIXES]
    assert len(paths) > 400
    assert list(repeated_runs({str(path.relative_to(ROOT)): path.read_text("utf-8") for path in paths})) == []


def test_repeated_runs_by_hand():
    run = "\n".join(f"    x{k} = {k}" for k in range(LEAST))
    short = "\n".join(run.split("\n")[:-1])
    imports = "from a import (\n    b,\n    c,\n)\n" + "\n".join(f"import d{k}" for k in range(LEAST))
    assert list(repeated_runs({"a": f"{run}\ny = 1\n\n{run}"})) == [["a:1", "a:13"]]
    spaced = run.replace("\n", "\n\n").replace("    ", "")
    assert list(repeated_runs({"a": f"# a\n{run}", "b": spaced})) == [["a:2", "b:1"]]
    assert list(repeated_runs({"a": f"{short}\ny = 1", "b": f"{short}\ny = 2"})) == []
    assert list(repeated_runs({"a": f"{imports}\ny = 1", "b": f"{imports}\ny = 2"})) == []
    assert list(repeated_runs({"a": f"{imports}\n{run}", "b": run})) == [["a:15", "b:1"]]
