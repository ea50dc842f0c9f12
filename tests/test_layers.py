"""Imports only go down: the floors of docs/architecture.md, read off the source with `ast`."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "spacesim"
SOURCES = sorted(PACKAGE.rglob("*.py"))

# What a file may not import at all, by the folder or module in which it stands.
TOP = ("cli", "options", "demo", "doctor")  #: over all folders
FORBIDDEN = {
    "memory": ("spacesim.", "numpy"),
    "backend": (*(f"spacesim.{top}" for top in ("data", "scenes", "splat", "nerf", "eval", "viewer", *TOP)), "numpy"),
    "doctor": ("spacesim.scenes", "spacesim.splat", "spacesim.viewer", "spacesim.cli"),
    "data": (
        "mitsuba",
        "drjit",
        "spacesim.backend",
        *(
            f"spacesim.{top}"
            for top in ("scenes", "splat", "nerf", "eval", "viewer", "cli", "options", "demo", "doctor")
        ),
    ),
    "scenes": tuple(
        f"spacesim.{top}" for top in ("splat", "nerf", "eval", "viewer", "cli", "options", "demo", "doctor")
    ),
    "splat": tuple(
        f"spacesim.{top}" for top in ("scenes", "nerf", "eval", "viewer", "cli", "options", "demo", "doctor")
    ),
    "nerf": tuple(
        f"spacesim.{top}" for top in ("scenes", "splat", "eval", "viewer", "cli", "options", "demo", "doctor")
    ),
    "eval": tuple(f"spacesim.{top}" for top in ("viewer", *TOP)),
    "viewer": ("spacesim.cli", "spacesim.demo", "spacesim.doctor"),
}
RENDERER = ("render", "project", "tiles", "rasterize", "sh", "gaussians", "reference")


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


@pytest.mark.parametrize("stage", RENDERER)
def test_renderer_knows_nothing_of_training(stage):
    path = PACKAGE / "splat" / f"{stage}.py"
    if path.exists():
        assert offences(path, ("spacesim.splat.train",)) == []


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
