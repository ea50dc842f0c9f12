"""The documents name what is there: every module, every file that they link to."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
MODULES = sorted(path for path in ROOT.glob("spacesim/**/*.py") if path.name != "__init__.py")


ROOMS = sorted({path.parent for path in MODULES} - {ROOT / "spacesim"})


@pytest.mark.parametrize("room", ROOMS, ids=lambda path: path.name)
def test_architecture_names_every_room(room):
    assert f"{room.name}/" in (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_documents_name_no_module_that_is_gone(document):
    known = {
        path.name
        for place in ("spacesim", "tests", "examples", "benchmarks", "docs")
        for path in ROOT.glob(f"{place}/**/*.py")
    }
    named = re.findall(r"`[\w/]+\.py\b", document.read_text(encoding="utf-8"))
    assert {Path(name.strip("`")).name for name in named} - known == set()
    whole = {name.strip("`") for name in named if name.startswith("`spacesim/")}
    assert {name for name in whole if not (ROOT / name).exists()} == set()


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(document):
    links = re.findall(r"\]\(([^)#\s]+)", document.read_text(encoding="utf-8"))
    local = [link for link in links if not link.startswith("https://")]
    assert [link for link in local if not (document.parent / link).exists()] == []


@pytest.mark.parametrize("module", MODULES, ids=lambda path: path.name)
def test_documents_that_the_code_names_are_there(module):
    named = re.findall(r"\bdocs/[\w-]+\.md\b", module.read_text(encoding="utf-8"))
    assert [name for name in named if not (ROOT / name).exists()] == []
