"""Every command that the documents show is understood by the program that it calls, and runs where this machine can."""

import argparse
import ast
import importlib.util
import json
import re
import shlex
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass, replace
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
import trimesh
from test_benchmarks import RUNS
from tiny import Outcome, call, outcome

from spacesim.cli.program import parser

ROOT = Path(__file__).parents[1]
TUTORIALS = [*sorted(ROOT.glob("docs/tutorials/*.md")), ROOT / "docs/how-to/trajectory.md"]  #: run as a whole
PAGES = [path for path in sorted(ROOT.glob("docs/**/*.md")) if path not in TUTORIALS]
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES]
SCRIPTS = sorted([*ROOT.glob("benchmarks/*.py"), *ROOT.glob("examples/*.py")])
PROGRAM = re.compile(
    r"(?:\.venv/bin/)?(spacesim) |(?:python )?((?:benchmarks|examples|scripts|tests)/[\w/]+\.py)(?: |$)"
)
HAS_VISER = importlib.util.find_spec("viser") is not None
HAS_ZMQ = importlib.util.find_spec("zmq") is not None

VALUES = {  # what stands in a command for a value
    **{"N": "2", "PX": "24", "K": "1", "NAME": "boxsat", "FILE": "boxsat", "AZ,EL": "40,25", "NAME=RUN": "none=RUN"},
    **{"KEY=VALUE": "seed=3", "KIND": "nerfstudio", "SRC": "DATA"},
    **{"GAUSSIANSxPIXELS,...": "300x32", "GAUSSIANSxPIXELS": "300x32", "PATH": "opensplat"},
}
FILES = {"DATA", "RUN", "RUNS", "EVAL", "DIR", "OUT", "PAIR", "BOXSAT", "URL"}
OUTPUTS = ("--out", "--ply", "--mesh", "--speedplus", "--bop", "--coco", "--yolo", "--webdataset")

SMALL = {  # options that a command gets, so that it is as small as can be
    "generate": {"--views": "2", "--test-views": "1", "--resolution": "24", "--spp": "1"},
    "train": {"--preset": "demo", "--iterations": "8", "--max-gaussians": "150"},
    "sweep": {"--frames": "2", "--size": "24"},
    "compose": {"--size": "24"},
    "view": {"--port": "0"},
    "serve": {"--port": "0"},
}
SMALLER = {  # and other values of those that it has
    **{"--suns": "2", "--known-test-views": "1", "--test-spp": "2", "--workers": "2"},
    **{"--max-gaussians": "150", "--frame": "0"},
}
NOT_RUN = {  # commands with these words: why they do not run here
    "--ray auto": "needs a Ray cluster; tests/scenes/generation/test_workers.py starts one",
    "spacesim reproduce": "minutes with --quick, else a day; tests/test_reproduce.py does all of it at its smallest",
    "tests/scenes/truth.py": "a minute; tests/scenes/test_truth.py bounds its figures",
    "tests/scenes/generation/kills.py": "minutes; test_workers.py beside it kills and interrupts smaller runs",
    "tests/splat/accuracy.py": "12 seconds; test_accuracy.py beside it bounds its figures",
    "tests/splat/raster/disc_outlines.py": "asks for a trained run with discs; the tests beside it hold its numbers",
    "tests/splat/light/shadow/acne.py": "a minute; the tests beside it bound its figures",
    "tests/splat/light/shadow/against_truth.py": "asks for a run that has been trained to the end",
}
LIT = {"relight", "shadow-map", "shadow-splat", "baseline-park"}  #: methods that take the Sun as input


def name_of(path: Path) -> str:
    """How a document is called in these tests: by its path under docs, or its own name."""
    return str(path.relative_to(ROOT / "docs")) if path.is_relative_to(ROOT / "docs") else path.name


@dataclass(frozen=True)
class Command:
    """A command of a document.

    document: where it stands
    text: as it stands there
    program: "spacesim" or a script
    words: its arguments
    target: the file that its output goes to
    whole: not just named in a sentence, without what it needs
    """

    document: str
    text: str
    program: str
    words: tuple[str, ...]
    target: str | None
    whole: bool

    def __str__(self) -> str:
        return f"{self.document}: {self.program} {' '.join(self.words)}"


def prose(path: Path) -> str:
    """A document without its fenced blocks but those of commands, which are indented in their place; a script's
    docstring."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        return ast.get_docstring(ast.parse(text)) or ""

    def instead(match: re.Match[str]) -> str:
        return textwrap.indent(match[3], "    ") if match[1] == "bash" else ""

    return FENCE.sub(instead, text)


FENCE = re.compile(r'^```(\w*)(?: title="([^"]+)")?\n(.*?)^```$', re.MULTILINE | re.DOTALL)
"""A fenced block: its language, the file that it is, its text."""


def blocks(path: Path, language: str) -> list[str]:
    """The fenced ones."""
    return [match[3] for match in FENCE.finditer(path.read_text(encoding="utf-8")) if match[1] == language]


def shown(path: Path) -> Iterator[tuple[str, bool]]:
    """(text, whether it stands on a line of its own) of all that could be a command, from the top down."""
    for match in re.finditer(r"^(?: {4}|(?=python ))(\S.*)$|`([^`]+)`", prose(path), re.MULTILINE):
        if match[2] is not None:
            yield " ".join(match[2].split()), False
        else:
            yield re.split(r"\s+#|\s{2,}", match[1])[0], True


def variants(text: str) -> list[str]:
    """Of a usage: with all that is in brackets, with each of the alternatives "a|b|c", and, last, as plain as it is."""
    plain = re.sub(r"\s*\[[^][]*\]", "", text)
    found = []
    for one in (plain, re.sub(r"[][]", "", text)):
        words = [word.split("|") for word in one.split(" ")]
        first = [word[0] for word in words]
        found.append(" ".join(first))
        for place, (base, *others) in enumerate(words):
            for other in others:
                whole = base[: base.index(".")] + other if other.startswith(".") else other
                found.append(" ".join([*first[:place], whole, *first[place + 1 :]]))
    return list(dict.fromkeys(found))[::-1]


def value(word: str) -> str:
    """`word`, or what takes its place if it stands for a value."""
    word = VALUES.get(word, word)
    assert word in FILES or not re.fullmatch("[A-Z]+", word), f"{word}: neither a file nor a value that is known here"
    return word


def commands(path: Path) -> Iterator[Command]:
    for text, alone in shown(path):
        match = PROGRAM.match(text)
        if match is None or text == match[2]:  # a file that a sentence names
            continue
        for one in variants(text):
            rest, _, target = one[match.end() :].partition(" > ")
            words = tuple(value(word) for word in shlex.split(rest) if word != "...")
            whole = alone or is_whole(words) or match[1] is None
            yield Command(name_of(path), text, match[1] or match[2], words, target or None, whole)


def is_whole(words: tuple[str, ...]) -> bool:
    """Whether spacesim has all that it needs to do something."""
    with redirect_stderr(StringIO()):
        try:
            parser(words).parse_args(words)
        except SystemExit:
            return False
    return words[0] != "generate" or "--out" in words


EVERY = [command for path in (*DOCUMENTS, *TUTORIALS, *SCRIPTS) for command in commands(path)]


class Parsed(BaseException):
    """A script has read its arguments."""


@cache
def module_of(script: str) -> Any:
    """A script's module, without running it."""
    path = ROOT / script
    spec = importlib.util.spec_from_file_location(f"documented_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look themselves up
    sys.path.insert(0, str(path.parent))
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(path.parent))
    return module


def takes_arguments(script: str) -> bool:
    return "parse_args(" in (ROOT / script).read_text(encoding="utf-8")


def can_be_read(script: str) -> bool:
    return HAS_VISER or script not in ("benchmarks/viewer.py", "benchmarks/visitor.py")


def read_by_script(script: str, words: list[str], monkeypatch: pytest.MonkeyPatch) -> argparse.Namespace:
    """What a script reads of its arguments. Raises SystemExit where they are wrong."""
    if not can_be_read(script):
        pytest.skip("viser is not installed")
    if not takes_arguments(script):
        assert words == [], f"{script} takes no arguments"
        return argparse.Namespace()
    main, read = module_of(script).main, argparse.ArgumentParser.parse_args

    def parse(self: argparse.ArgumentParser) -> None:
        raise Parsed(read(self))

    with monkeypatch.context() as patch:
        patch.setattr(argparse.ArgumentParser, "parse_args", parse)
        patch.setattr(sys, "argv", [script, *words])
        with pytest.raises(Parsed) as ended:
            main()
    found: argparse.Namespace = ended.value.args[0]
    return found


def completed(words: list[str], read: Callable[[list[str]], Any], capsys: pytest.CaptureFixture[str]) -> list[str]:
    """A command that a sentence names, with the arguments that it cannot do without."""
    for _ in range(3):
        try:
            read(words)
            return words
        except SystemExit:
            said = capsys.readouterr().err
        missing = re.search(r"arguments are required: ([^;\n]*)|one of the arguments (\S+)", said)
        assert missing is not None, said
        for name in (missing[1] or missing[2]).split(", "):
            words = [*words, name, "file"] if name.startswith("--") else [*words, name.split("|")[0]]
    raise AssertionError(words)


@pytest.mark.parametrize("command", EVERY, ids=str)
def test_a_command_is_understood(command, monkeypatch, capsys):
    def read(words: list[str]) -> argparse.Namespace:
        if command.program == "spacesim":
            return parser(words).parse_args(words)
        return read_by_script(command.program, words, monkeypatch)

    words = list(command.words)
    try:
        read(words if command.whole else completed(words, read, capsys))
    except SystemExit:
        pytest.fail(capsys.readouterr().err)


def test_commands_are_found():
    """In each of the ways that they are written in."""
    found = {(command.document, command.text) for command in EVERY}
    assert ("README.md", "spacesim view run") in found  # a fenced block, with a comment
    assert ("how-to/trouble.md", "spacesim doctor") in found  # a sentence
    assert ("research/viewer.md", "python benchmarks/viewer.py") in found  # an indented block
    assert ("research/memory.md", "python benchmarks/training.py --memory --markdown") in found
    assert ("tutorials/relight.md", "spacesim render run --sun 40,25 --out relit.png") in found
    assert ("dataset.py", "python benchmarks/dataset.py --frames 10000") in found  # a docstring
    assert ("01_simulate.py", "python examples/01_simulate.py") in found
    assert [command.words for command in EVERY if command.target == "my.toml"] == [("generate", "boxsat", "--print")]


def test_usages_are_expanded():
    assert variants("a b [--c D] [--e f|g]") == ["a b --c D --e g", "a b --c D --e f", "a b"]
    assert variants("a FILE.ply|.obj") == ["a FILE.obj", "a FILE.ply"]


def test_options_that_sentences_name_exist(monkeypatch, capsys):
    names = re.findall(r"^    ([a-z]+)\b", call("--help").output, re.MULTILINE)
    helps = [call(name, "--help").output for name in names]
    kinds = re.findall(r"^    ([a-z]+)\b", call("import", "--help").output, re.MULTILINE)
    helps += [call("import", kind, "--help").output for kind in kinds]
    for script in sorted({command.program for command in EVERY} - {"spacesim"}):
        if takes_arguments(script) and can_be_read(script):
            with pytest.raises(SystemExit):
                read_by_script(script, ["--help"], monkeypatch)
            helps.append(capsys.readouterr().out)
    known = set(re.findall(r"--[a-z][\w-]*", "".join(helps)))
    assert len(names) >= 12
    for path in (*DOCUMENTS, *TUTORIALS):
        named = set(re.findall(r"`(--[a-z][\w-]*)", prose(path)))
        assert named - known == set(), path


def test_fields_that_sentences_name_exist():
    """Each `--set KEY=VALUE` is taken, and each `light.shadow.bias` is a field, of some method of light."""
    methods = "shadow-map", "shadow-splat", "relight", "nerf-relight"
    listed = " ".join(call("train", "--fields", "--method", method).output for method in methods).split()
    named: set[str] = set()
    for path in (*DOCUMENTS, *TUTORIALS):
        text = prose(path)
        named |= set(re.findall(r"`((?:light|refinement)\.[\w.]+)`", text))
        for span in re.findall(r"`([^`]*--set [^`]*)`|^ {4}(.*--set .*)$", text, re.MULTILINE):
            pairs = re.findall(r"--set [\w.]+=[^\s`]+", "".join(span))
            words = " ".join(pairs).split()
            ended = [call("train", "--fields", "--method", method, *words) for method in methods]
            assert 0 in [one.code for one in ended], (name_of(path), ended[0].errors)
    assert len(named) >= 5
    assert named - set(listed) == set()


@pytest.mark.parametrize("path", [*DOCUMENTS, *TUTORIALS], ids=name_of)
def test_other_programs_find_their_inputs(path):
    makefile, project = ((ROOT / name).read_text(encoding="utf-8") for name in ("Makefile", "pyproject.toml"))
    for text, _ in shown(path):
        if match := re.fullmatch(r"make (\w+)", text):
            assert re.search(rf"^{match[1]}:", makefile, re.MULTILINE), text
        for name in re.findall(r"pip install .*\[(\w+)\]", text):
            assert re.search(rf"^{name} = \[", project, re.MULTILINE), text
        if match := re.match(r"\.venv/bin/pytest (\S+)", text):
            assert (ROOT / match[1]).exists(), text


MEASURED = [c for c in EVERY if c.program.startswith("benchmarks/") and c.document.endswith(".md")]


@pytest.mark.parametrize("command", MEASURED, ids=str)
def test_a_documented_benchmark_runs_in_the_tests(command, monkeypatch):
    """test_benchmarks.py runs the script with these switches and choices, and somewhere with each other option."""
    runs = RUNS[Path(command.program).name]

    def switches(words: list[str]) -> dict[str, Any]:
        read = vars(read_by_script(command.program, words, monkeypatch))
        return {name: found for name, found in read.items() if found is True or (name in ("what", "peers") and found)}

    wanted = switches(list(command.words))
    assert any(wanted.items() <= switches(run).items() for run in runs)
    options = {word for word in command.words if word.startswith("--")}
    assert options <= {word for run in runs for word in run} | {"--backend"}


def smaller(words: tuple[str, ...]) -> list[str]:
    """A command of spacesim at its smallest size."""
    wanted = dict(SMALL.get(words[0], {}))
    if {"nerf", "nerf-relight"} & set(words):  # has no Gaussians
        wanted.pop("--max-gaussians", None)
    if "--mesh" in words:
        wanted |= {"--voxel": "0.2", "--views": "3"}
    found = list(words)
    if words[0] == "eval" and "--no-geometry" not in words:  # seconds each; the fixture tiny_eval is evaluated with it
        found.append("--no-geometry")
    for option, least in wanted.items():
        if option not in found:
            found += [option, least]
    for option, least in (wanted | SMALLER).items():
        if option in found and found[found.index(option) + 1] != "0":
            found[found.index(option) + 1] = least
    if found[0] == "train" and LIT & set(found):  # so few discs leave no opaque surface
        found += ["--set", "surfels=false"]
    if found[0] == "train" and (LIT - {"relight"}) & set(found):  # the last one of a key counts
        found += ["--set", "light.shadow.size=16"]
    return found


class WorkingDirectory:
    """The working directory of a document's commands. What they read, and no command before has made, is `given`.

    made: where results lie; the directory holds links to them, as the same command on the same inputs runs only once.
    """

    def __init__(self, folder: Path, given: dict[str, Path], made: Path, done: dict[Any, tuple[Outcome, Path]]) -> None:
        self.folder, self.given, self.made, self.done = folder, given, made, done

    def run(self, command: Command) -> Outcome:
        """The outcome of a command at its smallest size."""
        words = smaller(command.words)
        outputs = {k: word for k, word in enumerate(words) if words[k - 1] in OUTPUTS}
        for k, word in enumerate(words[1:], start=1):
            if k not in outputs:
                self.put(word)
                words[k] = str((self.folder / word).resolve()) if (self.folder / word).exists() else word
        key = tuple(Path(word).suffix if k in outputs else word for k, word in enumerate(words))
        place = self.done[key][1] if key in self.done else self.made / str(len(self.done))
        if key not in self.done:
            place.mkdir()
            there = [str(place / f"{k}{key[k]}") if k in outputs else word for k, word in enumerate(words)]
            self.done[key] = (stopped(there) if words[0] in LASTING else call(*there)), place
        ended, place = self.done[key]
        for k, name in outputs.items():
            if (place / f"{k}{key[k]}").exists():
                (self.folder / name).unlink(missing_ok=True)
                (self.folder / name).symlink_to(place / f"{k}{key[k]}")
            elif "--estimate" not in words:
                return replace(ended, code=ended.code or 1, errors=[*ended.errors, f"{words[k - 1]}: nothing is there"])
        if command.target is not None:
            (self.folder / command.target).unlink(missing_ok=True)
            (self.folder / command.target).write_text(ended.output, encoding="utf-8")
        return ended

    def put(self, name: str) -> None:
        """Lay out an input."""
        path = self.folder / name
        if name in self.given and not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.symlink_to(self.given[name])


LASTING = {"view": HAS_VISER, "serve": HAS_ZMQ}  #: commands that end by Ctrl-C, and whether they can run


def stopped(words: list[str]) -> Outcome:
    """Of a command that lasts, with Ctrl-C once it has printed its address."""
    if not LASTING[words[0]]:
        return Outcome(0, "", [])
    command = [sys.executable, "-u", "-m", "spacesim", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        said = next((line for line in process.stdout if "(Ctrl-C ends it)" in line), "")
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    return outcome(process.returncode if said else 1, said, errors)


@pytest.fixture(scope="module")
def given(tiny_data, tmp_path_factory) -> dict[str, Path]:
    """What commands and blocks read: a dataset, one of two boxsats, a run of linear light with shadows, the scene file
    of docs/reference/composed-scenes.md, others."""
    folder = tmp_path_factory.mktemp("given")
    words = (
        "--method",
        "shadow-map",
        "--preset",
        "demo",
        "--iterations",
        8,
        "--set",
        "init_count=200",
        "--set",
        "surfels=false",
    )
    small = "--set", "light.linear=true", "--set", "light.shadow.size=16"
    trained = call("train", tiny_data, "--out", folder / "runs/boxsat", *words, *small)
    assert trained.code == 0, trained.errors
    small = "--views", 1, "--test-suns", 0, "--test-views", 1, "--resolution", 24, "--spp", 1
    assert call("generate", "boxsat-pair", "--out", folder / "pair", "--sun", "45,35", *small).code == 0
    scene, keyframes = blocks(ROOT / "docs/reference/composed-scenes.md", "toml")[:2]
    (folder / "scene.toml").write_text(f"frames = 2\n{scene}\n{keyframes}", encoding="utf-8")
    (folder / "my.toml").write_text('[[objects]]\nspacecraft = "boxsat"\n', encoding="utf-8")
    trimesh.creation.box((1, 2, 3)).export(folder / "hubble.glb")
    meta = json.loads((tiny_data / "transforms.json").read_text(encoding="utf-8"))
    camera = {key: meta[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")}
    camera["transform_matrix"] = meta["frames"][0]["transform_matrix"]
    (folder / "camera.json").write_text(json.dumps(camera), encoding="utf-8")
    (folder / "pictures").mkdir()
    (folder / "pictures/test_00000.png").symlink_to(tiny_data / "images/test_00000.png")
    run, files = folder / "runs/boxsat", ("my.toml", "hubble.glb", "camera.json", "scene.toml")
    evaluated = call("eval", run, "--data", tiny_data, "--out", folder / "eval", "--no-geometry")
    assert evaluated.code == 0, evaluated.errors
    return {
        **{
            "data": tiny_data,
            "DATA": tiny_data,
            "fox": tiny_data,
            "PAIR": folder / "pair",
            "pictures": folder / "pictures",
            "rough.json": tiny_data / "transforms.json",
            "SCENE.toml": folder / "scene.toml",
        },
        **{name: run for name in ("run", "RUN", "other", "out/demo/run", "runs/boxsat")},
        **{name: folder / "eval" for name in ("eval", "eval-other")},
        **{name: folder / name for name in files},
    }


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """Where results lie."""
    folder: Path = tmp_path_factory.mktemp("made")
    return folder


@pytest.fixture(scope="module")
def done() -> dict[Any, tuple[Outcome, Path]]:
    """What has run already, by its words and inputs."""
    return {}


def is_left_out(command: Command) -> bool:
    return any(words in str(command) for words in NOT_RUN)


OF_TUTORIALS = [name_of(path) for path in TUTORIALS]
WHOLE = [c for c in EVERY if c.whole and c.document.endswith(".md") and c.document not in OF_TUTORIALS]
RUNNABLE = [command for command in WHOLE if command.program == "spacesim" and not is_left_out(command)]


@pytest.mark.parametrize("document", dict.fromkeys(command.document for command in RUNNABLE))
def test_commands_run_from_the_top_down(document, given, made, done, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    directory = WorkingDirectory(tmp_path, given, made, done)
    directory.put("runs/boxsat")
    for command in RUNNABLE:
        if command.document == document:
            ended = directory.run(command)
            assert ended.code == 0, (command.text, ended.errors)


def test_every_command_that_is_not_run_has_a_reason():
    assert [str(one) for one in WHOLE if one not in (*RUNNABLE, *MEASURED) and not is_left_out(one)] == []
    texts = [str(command) for command in WHOLE]
    assert [words for words in NOT_RUN if not any(words in text for text in texts)] == []


SMALL_FACE = {  # of the six lines
    "views=60, resolution=128": "views=2, test_views=1, resolution=24, spp=1",
    'preset="demo"': 'preset="demo", iterations=4, init_count=50',
    '"eval")': '"eval", geometry=False)',
}
SMALL_BLOCKS = {  # in the Python of a document: what takes the place of what
    "README.md": SMALL_FACE,
    "index.md": SMALL_FACE,
    "how-to/closed-loop.md": {"128, 128": "32, 32"},
    "how-to/gradients.md": {"640, 480": "32, 24", "2000": "50", "280, 210, 80, 60": "8, 6, 16, 12"},
    "how-to/rigs.md": {"resolution=64": "resolution=16, spp=1"},
    "tutorials/first-model.md": {"256, 256": "24, 24"},
    "tutorials/torch.md": {"96, 400, 100": "24, 50, 3"},
    "tutorials/video.md": {"[480, 270]": "[384, 216]", "views = 40": "views = 20", "--spp 16": "--spp 4"},
    "tutorials/compose.md": {"frames = 48": "frames = 2", "size=128": "size=24"},
}
PRINTED = {  # by the blocks of a document, among other things
    "README.md": "(24, 24, 3) ",
    "how-to/closed-loop.md": "\n2 ",
    "reference/dataset.md": "(40, 40) (40, 40, 3) 255",
    "reference/models-and-materials.md": "primary_mirror",
    "tutorials/first-model.md": "nearest point ",
    "tutorials/relight.md": "unseen_suns {'mean': ",
    "tutorials/torch.md": "after 3 steps",
    "tutorials/video.md": "data: 17 frames to train on, 3 to test with",
    "tutorials/compose.md": "composed-small/sheet.png",
}


def shrunk(path: Path, text: str) -> str:
    """`text` of a document with smaller numbers."""
    for old, new in SMALL_BLOCKS.get(name_of(path), {}).items():
        assert old in text, f"{name_of(path)} has no {old!r} any more"
        text = text.replace(old, new)
    return text


@pytest.mark.parametrize("path", [path for path in DOCUMENTS if blocks(path, "python")], ids=name_of)
def test_python_runs(path, given, tmp_path, monkeypatch, capsys):
    """The blocks of a document one after the other; only data and runs are given."""
    monkeypatch.chdir(tmp_path)
    directory = WorkingDirectory(tmp_path, given, tmp_path, {})
    for name in ("runs/boxsat", *(("data", "run") if path.name not in ("README.md", "index.md") else ())):
        directory.put(name)
    text = shrunk(path, "\n".join(blocks(path, "python")))
    with answering(text) as asked:
        exec(compile(asked, path.name, "exec"), {})
    assert PRINTED.get(name_of(path), "") in capsys.readouterr().out


@contextmanager
def answering(text: str) -> Iterator[str]:
    """Python that asks a camera, if it does, beside one that answers, at an address of its own."""
    if "tcp://127.0.0.1:5556" not in text:
        yield text
        return
    pytest.importorskip("zmq", reason="pyzmq is not installed")
    from spacesim.serve.draw import load_served
    from spacesim.serve.server import serving

    with serving(load_served("boxsat", spp=1)) as address:
        yield text.replace("tcp://127.0.0.1:5556", address)


@pytest.mark.parametrize("path", TUTORIALS, ids=name_of)
def test_a_tutorial_runs(path, tmp_path, monkeypatch, capsys):
    """All of its blocks from the top down, in an empty folder: files are written, commands and Python run. They are as
    they stand there but for the numbers that `smaller` and SMALL_BLOCKS put in."""
    if path.stem == "torch":
        pytest.importorskip("torch", reason="torch is not installed")
    if path.stem == "video":
        pytest.importorskip("pycolmap", reason="pycolmap is not installed")
        pytest.importorskip("av", reason="PyAV is not installed")
    monkeypatch.chdir(tmp_path)
    known: dict[str, Any] = {}
    ran, said = 0, ""
    for match in FENCE.finditer(shrunk(path, path.read_text(encoding="utf-8"))):
        language, name, text = match.groups()
        if name:
            Path(name).write_text(text, encoding="utf-8")
        elif language == "python":
            exec(compile(text, name_of(path), "exec"), known)
        else:
            assert language == "bash", f"{name_of(path)}: a block of {language!r} that nothing runs"
            for line in filter(None, text.splitlines()):
                program, *words = shlex.split(line, comments=True)
                assert program == "spacesim", line
                filmed = path.stem == "video" and words[0] == "generate"  # smaller, it shows too little for poses
                small = words if filmed else smaller(tuple(words))
                ended = stopped(small) if words[0] in LASTING else call(*small)
                assert ended.code == 0, (line, ended.errors)
                said += ended.output
        ran, said = ran + 1, said + capsys.readouterr().out
    assert ran >= 3
    assert PRINTED.get(name_of(path), "") in said
