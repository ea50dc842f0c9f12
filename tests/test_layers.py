"""Imports only go down: the floors of docs/architecture.md, read off the source with `ast`."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "spacesim"
SOURCES = sorted(PACKAGE.rglob("*.py"))

# What a file may not import at all, by the folder or module in which it stands.
TOP = ("cli", "options", "demo", "doctor", "api")  #: over all folders
FORBIDDEN = {
    "backend": (*(f"spacesim.{top}" for top in ("data", "scenes", "splat", "nerf", "eval", "viewer", *TOP)), "numpy"),
    "doctor": ("spacesim.scenes", "spacesim.splat", "spacesim.viewer", "spacesim.cli"),
    "data": (
        "mitsuba",
        "drjit",
        *(f"spacesim.backend.{name}" for name in ("ad", "selection", "llvm", "recording", "select", "mitsuba")),
        *(f"spacesim.{top}" for top in ("scenes", "splat", "nerf", "eval", "viewer", *TOP)),
    ),
    "scenes": tuple(f"spacesim.{top}" for top in ("splat", "nerf", "eval", "viewer", *TOP)),
    "splat": tuple(f"spacesim.{top}" for top in ("scenes", "nerf", "eval", "viewer", *TOP)),
    "nerf": tuple(f"spacesim.{top}" for top in ("scenes", "splat", "eval", "viewer", *TOP)),
    "eval": tuple(f"spacesim.{top}" for top in ("viewer", *TOP)),
    "viewer": ("spacesim.cli", "spacesim.demo", "spacesim.doctor"),
}
OF_RASTER = tuple(f"spacesim.splat.{room}" for room in ("light", "train", "compose", "export", "run"))
OF_LIGHT = tuple(f"spacesim.splat.{room}" for room in ("train", "compose", "export", "run"))
MOST_MODULES = 22  #: of a folder


def name_of(path: Path) -> str:
    """Dotted name below `spacesim` of a source file: "splat.train.losses"."""
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__")


def imports(path: Path, lazy: bool = True) -> Iterator[str]:
    """Modules and names that a file imports, in full; without `lazy` ones only those at import time."""
    package = ["spacesim", *path.relative_to(PACKAGE).parts[:-1]]
    pending: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
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
    roots = tuple(name.rstrip(".") for name in forbidden)
    found = imports(path, lazy)
    return [name for name in found if any(name == root or name.startswith(f"{root}.") for root in roots)]


@pytest.mark.parametrize("path", SOURCES, ids=name_of)
def test_imports_go_down(path):
    top = name_of(path).split(".")[0]
    assert offences(path, FORBIDDEN.get(top, ())) == []


@pytest.mark.parametrize("path", sorted((PACKAGE / "eval").rglob("*.py")), ids=name_of)
def test_eval_touches_scenes_only_to_render_a_reference(path):
    assert offences(path, ("spacesim.scenes",), lazy=False) == []


@pytest.mark.parametrize(("room", "forbidden"), [("raster", OF_RASTER), ("light", OF_LIGHT)])
def test_rooms_of_splat_know_nothing_of_what_is_built_on_them(room, forbidden):
    paths = sorted((PACKAGE / "splat" / room).rglob("*.py"))
    assert len(paths) > 5
    assert [(path.name, found) for path in paths if (found := offences(path, forbidden))] == []


def modules_imported(path: Path, known: set[str]) -> set[str]:
    """Modules of the package, "splat.run", that a file imports when it is imported itself."""
    found = set()
    for name in imports(path, lazy=False):
        parts = name.removeprefix("spacesim.").split(".") if name.startswith("spacesim.") else []
        found |= {".".join(parts[:n]) for n in range(1, len(parts) + 1)} & known
    return found


def graph() -> dict[str, set[str]]:
    """{module: modules that it imports}, without packages, which only re-export."""
    paths = {name_of(path): path for path in SOURCES if path.name != "__init__.py"}
    return {name: modules_imported(path, set(paths)) - {name} for name, path in paths.items()}


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
    longest_path(graph())
    with pytest.raises(ValueError, match="b imports c imports b"):
        longest_path({"a": {"b"}, "b": {"c"}, "c": {"b"}})


def test_folders_are_small():
    rooms = {path.parent for path in SOURCES}
    sizes = {str(room.relative_to(PACKAGE)): sum(p.name != "__init__.py" for p in room.glob("*.py")) for room in rooms}
    assert {room: size for room, size in sizes.items() if size > MOST_MODULES} == {}


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
