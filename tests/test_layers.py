"""Imports only go down: the layers of docs/explanation/architecture.md, read off the source with `ast`."""

import ast
import re
from collections.abc import Container, Iterator
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "spacesim"
SOURCES = sorted(PACKAGE.rglob("*.py"))

# What a file may not import at all, by the folder or module in which it stands.
TOP = ("cli", "demo", "doctor", "api", "methods", "reproduce")  #: over all folders
ABOVE = ("data", "learning", "scenes", "splat", "nerf", "mixed", "eval", "viewer", "serve", *TOP)  #: over `backend`
FORBIDDEN = {
    "backend": (*(f"spacesim.{top}" for top in ABOVE), "numpy"),
    # arrays of numpy's to the device and back; what else the package does goes without numpy
    **dict.fromkeys(("backend.upload", "backend.readback"), tuple(f"spacesim.{top}" for top in ABOVE)),
    "doctor": ("spacesim.scenes", "spacesim.splat", "spacesim.viewer", "spacesim.serve", "spacesim.cli"),
    "data": (
        "mitsuba",
        "drjit",
        *(
            f"spacesim.{top}"
            for top in ("learning", "scenes", "splat", "nerf", "mixed", "eval", "viewer", "serve", *TOP)
        ),
    ),
    "learning": tuple(
        f"spacesim.{top}" for top in ("scenes", "splat", "nerf", "mixed", "eval", "viewer", "serve", *TOP)
    ),
    "scenes": tuple(
        f"spacesim.{top}" for top in ("learning", "splat", "nerf", "mixed", "eval", "viewer", "serve", *TOP)
    ),
    "splat": tuple(f"spacesim.{top}" for top in ("scenes", "nerf", "mixed", "eval", "viewer", "serve", *TOP)),
    "nerf": tuple(f"spacesim.{top}" for top in ("scenes", "splat", "mixed", "eval", "viewer", "serve", *TOP)),
    "mixed": tuple(f"spacesim.{top}" for top in ("scenes", "eval", "viewer", "serve", *TOP)),
    "eval": tuple(f"spacesim.{top}" for top in ("viewer", "serve", *TOP)),
    "serve": tuple(f"spacesim.{name}" for name in ("viewer", "cli", "demo", "doctor", "reproduce", "api")),
    "viewer": ("spacesim.serve", "spacesim.cli", "spacesim.demo", "spacesim.doctor", "spacesim.reproduce"),
    "reproduce": (
        "spacesim.viewer",
        "spacesim.serve",
        "spacesim.cli",
        "spacesim.demo",
        "spacesim.doctor",
        "spacesim.api",
    ),
}
# All that a folder may import of a package: (folder, package, what of it).
ALONE = (
    ("data", "spacesim.backend", ("spacesim.backend.memory",)),  # the one module of `backend` that goes without Dr.Jit
    ("splat/raster", "spacesim.splat", ("spacesim.splat.raster",)),
    ("splat/light", "spacesim.splat", ("spacesim.splat.raster", "spacesim.splat.light")),
    ("torch", "spacesim", ("spacesim.backend", "spacesim.splat.raster", "spacesim.torch")),
)
MAX_MODULES = 14  #: of a folder, but of `cli`, which has a file a command
MAX_LEVELS = 6  #: modules of the longest chain of imports within a folder


def name_of(path: Path) -> str:
    """Dotted name below `spacesim` of a source file: "splat.train.losses"."""
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__")


_parsed = cache(ast.parse)


def imports(path: Path, lazy: bool = True) -> Iterator[str]:
    """Modules and names that a file imports, in full; without `lazy` ones only those at import time."""
    package = ["spacesim", *path.relative_to(PACKAGE).parts[:-1]]
    pending: list[ast.AST] = [_parsed(path.read_text(encoding="utf-8"))]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*parents, *([node.module] if node.module else [])])
            yield from (f"{base}.{alias.name}" for alias in node.names)
        elif lazy or not isinstance(node, ast.FunctionDef | ast.Lambda):
            pending.extend(ast.iter_child_nodes(node))


def offences(path: Path, forbidden: tuple[str, ...], lazy: bool = True) -> list[str]:
    """Imports of a file that are, or lie in, one of the forbidden modules."""
    return [name for name in imports(path, lazy) if lies_in(name, forbidden)]


def lies_in(name: str, modules: tuple[str, ...]) -> bool:
    """Whether a dotted name is, or lies in, one of the modules."""
    return any(name == module or name.startswith(f"{module}.") for module in modules)


def strays(path: Path, package: str, allowed: tuple[str, ...]) -> list[str]:
    """Imports of a file that lie in a package, but not in the modules of it that it may import."""
    return [name for name in offences(path, (package,)) if not lies_in(name, allowed)]


@pytest.mark.parametrize("path", SOURCES, ids=name_of)
def test_imports_go_down(path):
    name = name_of(path)
    top = name if name in FORBIDDEN else name.split(".")[0]
    assert offences(path, FORBIDDEN.get(top, ())) == []


@pytest.mark.parametrize("path", sorted((PACKAGE / "eval").rglob("*.py")), ids=name_of)
def test_eval_touches_scenes_only_to_render_a_reference(path):
    assert offences(path, ("spacesim.scenes",), lazy=False) == []


@pytest.mark.parametrize(("folder", "package", "allowed"), ALONE, ids=[folder for folder, *_ in ALONE])
def test_folders_import_of_a_package_only_what_they_may(folder, package, allowed):
    paths = sorted((PACKAGE / folder).rglob("*.py"))
    assert len(paths) >= 5
    assert {name_of(path): names for path in paths if (names := strays(path, package, allowed))} == {}
    used = {module for path in paths for name in imports(path) for module in allowed if lies_in(name, (module,))}
    assert used == set(allowed)  # a rule that allows more than is needed is out of date


def test_what_stands_on_torch_is_for_users_of_torch_alone():
    paths = [path for path in SOURCES if name_of(path).split(".")[0] != "torch"]
    assert {name_of(path): names for path in paths if (names := offences(path, ("spacesim.torch",)))} == {}


def test_references_are_for_tests_alone():
    paths = [path for path in SOURCES if not name_of(path).startswith("splat.reference")]
    assert {name_of(path): names for path in paths if (names := offences(path, ("spacesim.splat.reference",)))} == {}


@cache
def re_exports(package: str) -> dict[str, str]:
    """{name: what it is imported from} of a package's `__init__.py`; {} of a module."""
    path = PACKAGE.joinpath(*package.split("."), "__init__.py")
    return {name.rpartition(".")[2]: name for name in imports(path)} if path.exists() else {}


def module_of(name: str, known: Container[str]) -> str:
    """The module, or the package, that an imported name is defined in: "spacesim.data.images.read_png" is in
    "data.images.png"."""
    parts = name.split(".")[1:]
    count = next(n for n in range(len(parts), -1, -1) if ".".join(parts[:n]) in known)
    module = ".".join(parts[:count])
    origin = re_exports(module).get(parts[count]) if count < len(parts) else None
    return module_of(origin, known) if origin else module


def graph(lazy: bool = True) -> dict[str, set[str]]:
    """{module: modules that it imports}; "" is the package itself. Without `lazy` ones only those at import time."""
    paths = {name_of(path).removeprefix("__init__"): path for path in SOURCES}
    edges = {}
    for name, path in paths.items():
        ours = [one for one in imports(path, lazy) if one.split(".")[0] == "spacesim"]
        edges[name] = {module_of(one, paths) for one in ours} - {name}
    return edges


def longest_path(edges: dict[str, set[str]]) -> int:
    """Modules of the longest chain of imports. Raises ValueError where it is a circle."""
    levels: dict[str, int] = {}

    def level(name: str, above: tuple[str, ...] = ()) -> int:
        if name in above:
            raise ValueError(" imports ".join((*above[above.index(name) :], name)))
        if name not in levels:
            levels[name] = 1 + max((level(one, (*above, name)) for one in edges[name]), default=0)
        return levels[name]

    return max(level(name) for name in edges)


def test_no_modules_import_each_other():
    """Neither when they are imported nor later: whoever uses what a package re-exports imports the module behind."""
    edges = graph()
    assert {"api", "version"} <= edges[""]  # of which modules below take the version alone
    assert "data.images.png" in edges["splat.compose.output"]  # by `from spacesim.data.images import read_png`
    longest_path(edges)
    with pytest.raises(ValueError, match="b imports c imports b"):
        longest_path({"a": {"b"}, "b": {"c"}, "c": {"b"}})


def test_imports_within_a_folder_are_few_levels_deep():
    edges = graph(lazy=False)
    folders = {name.rpartition(".")[0] for name in edges}
    for folder in folders:
        inside = {name for name in edges if name.rpartition(".")[0] == folder}
        levels = longest_path({name: edges[name] & inside for name in inside})
        assert levels <= MAX_LEVELS, f"{folder}: {levels} levels"
    assert longest_path({"a": {"b"}, "b": {"c"}, "c": set()}) == 3


def test_folders_are_small():
    folders = {path.parent for path in SOURCES}
    sizes = {str(path.relative_to(PACKAGE)): len({*path.glob("*.py")} - {path / "__init__.py"}) for path in folders}
    assert {name: size for name, size in sizes.items() if size > MAX_MODULES and name != "cli"} == {}


def options_named(text: str) -> list[str]:
    """Words like --seed in what a source raises, or returns: parts of an error are returned, too. Not those of style
    sheets, "--suns: 3" and var(--suns)."""
    ends = [node for node in ast.walk(_parsed(text)) if isinstance(node, ast.Raise | ast.Return)]
    parts = [part.value for end in ends for part in ast.walk(end) if isinstance(part, ast.Constant)]
    option = re.compile(r"""(?<![\w"(-])--[a-z][a-z-]*""")
    return [word for part in parts if isinstance(part, str) for word in option.findall(part)]


def test_libraries_name_fields_not_options():
    paths = [path for path in SOURCES if name_of(path).split(".")[0] != "cli"]
    assert len(paths) > 150
    assert {name_of(path): found for path in paths if (found := options_named(path.read_text(encoding="utf-8")))} == {}
    assert options_named('raise InputError(f"--seed: found {1}")') == ["--seed"]
    assert options_named('raise InputError(f"{out}: found one; " + f"go on with --resume {1}")') == ["--resume"]
    assert options_named('def hint():\n    return "; `generate --resume` makes it again"') == ["--resume"]


def test_the_test_can_fail(tmp_path, monkeypatch):
    monkeypatch.setitem(globals(), "PACKAGE", tmp_path / "spacesim")
    path = tmp_path / "spacesim" / "data" / "bad.py"
    path.parent.mkdir(parents=True)
    path.write_text(
        "import numpy\nimport mitsuba as mi\nfrom spacesim import splat\nfrom ..scenes import sun\n"
        "def f():\n    from drjit.cuda import Float\n    import mitsubaly, spacesim.data.files\n"
    )
    expected = {"mitsuba", "spacesim.splat", "spacesim.scenes.sun", "drjit.cuda.Float"}
    assert set(offences(path, FORBIDDEN["data"])) == expected
    assert set(offences(path, FORBIDDEN["data"], lazy=False)) == expected - {"drjit.cuda.Float"}


@pytest.mark.parametrize(("folder", "package", "allowed"), ALONE, ids=[folder for folder, *_ in ALONE])
def test_what_is_not_named_is_a_stray(tmp_path, monkeypatch, folder, package, allowed):
    monkeypatch.setitem(globals(), "PACKAGE", tmp_path / "spacesim")
    path = tmp_path / "spacesim" / folder / "bad.py"
    path.parent.mkdir(parents=True)
    path.write_text(
        f"import {package}\nfrom {package} import other\nimport {allowed[0]}\nfrom {allowed[-1]} import name\n"
        f"import {allowed[0]}ly\ndef f():\n    from {package}.fit import g\nimport spacesimilar\n"
    )
    assert set(strays(path, package, allowed)) == {package, f"{package}.other", f"{allowed[0]}ly", f"{package}.fit.g"}
