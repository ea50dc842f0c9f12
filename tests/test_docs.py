"""The documents name what is there: every module, every file that they link to."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
MODULES = sorted(path for path in ROOT.glob("spacesim/**/*.py") if path.name != "__init__.py")


def test_architecture_names_every_module():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    assert [path.name for path in MODULES if path.name not in text] == []


def test_architecture_names_no_module_that_is_gone():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    known = {path.name for path in [*MODULES, *ROOT.glob("tests/**/*.py"), *ROOT.glob("examples/*.py")]}
    named = {Path(name).name for name in re.findall(r"[\w/]+\.py\b", text)}
    assert named - known == set()


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(document):
    links = re.findall(r"\]\(([^)#\s]+)", document.read_text(encoding="utf-8"))
    local = [link for link in links if not link.startswith("https://")]
    assert [link for link in local if not (document.parent / link).exists()] == []


@pytest.mark.parametrize("module", MODULES, ids=lambda path: path.name)
def test_documents_that_the_code_names_are_there(module):
    named = re.findall(r"\bdocs/[\w-]+\.md\b", module.read_text(encoding="utf-8"))
    assert [name for name in named if not (ROOT / name).exists()] == []
