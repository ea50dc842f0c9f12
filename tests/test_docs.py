"""The book: its links and blocks, what the code says of it, its size, the pages that are generated, the site."""

import ast
import importlib.util
import inspect
import re
import subprocess
import sys
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest

import spacesim as ss
from spacesim.serve import protocol

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.glob("**/*.md"))
DOCUMENTS = [*sorted(ROOT.glob("*.md")), *PAGES]
MODULES = sorted(path for path in ROOT.glob("spacesim/**/*.py") if path.name != "__init__.py")
FOLDERS = sorted({path.parent for path in MODULES} - {ROOT / "spacesim"})
PLACES = ("spacesim", "tests", "examples", "benchmarks", "scripts")
SOURCES = sorted(
    path for place in PLACES for path in ROOT.glob(f"{place}/**/*") if path.suffix in (".py", ".toml", ".sh")
)
MAX_WORDS, MAX_MEASURED, MAX_LINES = 20_000, 6_000, 80  #: of the book with README; of docs/research; of README
ARCHITECTURE = DOCS / "explanation" / "architecture.md"


def of(path: Path) -> str:
    return str(path.relative_to(ROOT))


@cache
def generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("generate_docs", DOCS / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@cache
def generated() -> dict[str, str]:
    """{path under docs: text}."""
    pages: dict[str, str] = generator().pages()
    return pages


def without_blocks(text: str) -> str:
    return re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)


def anchors(text: str) -> set[str]:
    """Of the headings, as the site makes them."""
    found = re.findall(r"^#+ (.+)$", without_blocks(text), re.MULTILINE)
    return {re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower()) for heading in found}


def text_of(path: Path) -> str | None:
    """Of a page, which may be a generated one; None where there is none."""
    if path.is_relative_to(DOCS) and str(path.relative_to(DOCS)) in generated():
        return generated()[str(path.relative_to(DOCS))]
    return path.read_text(encoding="utf-8") if path.is_file() else None


@pytest.mark.parametrize("folder", FOLDERS, ids=of)
def test_architecture_names_every_folder(folder):
    assert f"{folder.name}/" in ARCHITECTURE.read_text(encoding="utf-8")


@pytest.mark.parametrize("document", DOCUMENTS, ids=of)
def test_documents_name_no_module_that_is_gone(document):
    known = {path.name for place in (*PLACES, "docs") for path in ROOT.glob(f"{place}/**/*.py")}
    named = re.findall(r"`[\w/]+\.py\b", document.read_text(encoding="utf-8"))
    assert {Path(name.strip("`")).name for name in named} - known == set()
    whole = {name.strip("`") for name in named if "/" in name and name.strip("`").split("/")[0] in PLACES}
    assert {name for name in whole if not (ROOT / name).exists()} == set()


@pytest.mark.parametrize("document", DOCUMENTS, ids=of)
def test_links_and_anchors_lead_somewhere(document):
    links = re.findall(r"\]\(([^)\s]+)\)", without_blocks(document.read_text(encoding="utf-8")))
    dead = []
    for link in links:
        if link.startswith("https://"):
            continue
        name, _, anchor = link.partition("#")
        place = (document.parent / name).resolve() if name else document
        text = text_of(place) if place.suffix == ".md" else None
        if (text is None and (place.suffix == ".md" or not place.exists())) or (
            anchor and text is not None and anchor not in anchors(text)
        ):
            dead.append(link)
    assert dead == []


def test_pictures_are_shown():
    shown = {Path(name).name for page in DOCUMENTS for name in re.findall(r"!\[[^]]*\]\(([^)]+)\)", page.read_text())}
    assert {path.name for path in DOCS.glob("pictures/*") if path.suffix in (".png", ".svg", ".webp")} == shown


@pytest.mark.parametrize("source", SOURCES, ids=of)
def test_documents_that_the_code_names_are_there(source):
    named = re.findall(r"\bdocs/[\w/.-]+\.(?:md|py|png|svg|webp)\b", source.read_text(encoding="utf-8"))
    assert [name for name in named if name not in KNOWN and not (ROOT / name).exists()] == []


GENERATED = "api", "options", "scene-fields", "materials", "command-line", "serve-protocol"
KNOWN = {f"docs/reference/{name}.md" for name in GENERATED}


def test_names_of_generated_pages():
    assert {f"docs/{name}" for name in generated()} == KNOWN


@pytest.mark.parametrize("document", DOCUMENTS, ids=of)
def test_documents_import_only_what_is_public(document):
    """Of spacesim: itself, and gsplat's function from its torch."""
    imported = re.findall(r"^((?:import|from) spacesim.*)$", document.read_text(encoding="utf-8"), re.MULTILINE)
    imports = {line.partition("#")[0].strip() for line in imported}
    assert imports <= {"import spacesim as ss", "from spacesim.torch import rasterization"}


@pytest.mark.parametrize("document", DOCUMENTS, ids=of)
def test_python_blocks_parse(document):
    for block in re.findall(r"^```python\n(.*?)^```$", document.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL):
        ast.parse(block)


def test_the_book_is_short():
    research = DOCS / "research"
    words = {path: len(path.read_text(encoding="utf-8").split()) for path in (ROOT / "README.md", *PAGES)}
    assert sum(count for path, count in words.items() if path.parent != research) <= MAX_WORDS
    assert sum(count for path, count in words.items() if path.parent == research) <= MAX_MEASURED
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= MAX_LINES


TABLES = ("choose.md",)  #: how-to pages that are longer: to look things up in


@pytest.mark.parametrize("page", sorted(DOCS.glob("how-to/*.md")), ids=of)
def test_how_to_pages_have_forty_lines(page):
    lines = page.read_text(encoding="utf-8").splitlines()
    assert (len(lines) > 40) == (page.name in TABLES)


@pytest.mark.parametrize("page", PAGES, ids=of)
def test_pages_tell_no_history(page):
    text = page.read_text(encoding="utf-8").lower()
    journal = "before that", "before this", "used to", "no longer", "| goal |"
    assert [words for words in journal if words in text] == []


def test_every_page_is_in_the_navigation():
    listed = set(re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text(encoding="utf-8")))
    assert listed == {str(page.relative_to(DOCS)) for page in PAGES} | set(generated())


@pytest.mark.parametrize("name", ss.__all__)
def test_the_reference_has_every_public_name(name):
    entry = re.search(rf"^### ss\.{name}\n(.*?)(?=^##|\Z)", generated()["reference/api.md"], re.MULTILINE | re.DOTALL)
    assert entry is not None
    docstring = inspect.getdoc(getattr(ss, name))
    assert docstring
    assert docstring in entry[1]


def test_the_reference_has_what_public_names_take_and_give():
    """Whoever adds a class here may make it public, or have the signature name one that is."""
    named = {cls.__name__: cls for cls in generator().named_by(ss)}
    assert set(named) == {
        *("ComposedModel", "Curve", "FittedMaterial", "GaussianComposition", "Keyframe", "LightModel", "MaterialView"),
        *("ModelViews", "Networks", "Orbit"),
        *("PlannedView", "Prediction", "Predictor", "Projection", "Rig", "SceneBox", "SceneFrame", "Screen"),
        *("Spacecraft", "TargetSphere"),
    }
    for name, cls in named.items():
        entry = re.search(
            rf"^### {cls.__module__}\.{name}\n(.*?)(?=^##|\Z)", generated()["reference/api.md"], re.M | re.S
        )
        assert entry is not None, name
        assert inspect.getdoc(cls) in entry[1]


@pytest.mark.parametrize("name", [name for name in ss.__all__ if is_dataclass(getattr(ss, name))])
def test_the_reference_explains_every_field(name):
    """Each has a comment, beside it or above."""
    lines = {}
    for line in generator().all_field_lines(getattr(ss, name)):
        *above, text = line.splitlines()
        lines[text.partition(":")[0]] = above or re.findall(r"#: \S", text)
    assert list(lines) == [field.name for field in fields(getattr(ss, name)) if not field.name.startswith("_")]
    assert [field for field, comments in lines.items() if not comments] == []


def test_comments_of_fields_are_read_wherever_they_stand(tmp_path, monkeypatch):
    source = """
        class Record:
            #: above
            #: it
            first: int = 1
            second: tuple[
                str, ...
            ] = ()  #: behind
            third: str | None = (
                None  #: # within "(brackets)"
            )
            long: int = 2  #: {words}
            bare: str = "#: no comment"
    """
    long = " ".join(["word"] * 25)
    monkeypatch.setattr(inspect, "getsource", lambda cls: source.replace("{words}", long).lstrip("\n"))
    assert list(generator().field_lines(int)) == [
        "first: int = 1  #: above it",
        "second: tuple[str, ...] = ()  #: behind",
        'third: str | None = None  #: # within "(brackets)"',
        f"#: {' '.join(['word'] * 23)}\n#: word word\nlong: int = 2",
        'bare: str = "#: no comment"',
    ]


def test_the_reference_has_rasterization():
    torch_door = pytest.importorskip("spacesim.torch", reason="torch is not installed", exc_type=ImportError)
    page = generated()["reference/api.md"]
    for argument in inspect.signature(torch_door.rasterization).parameters:
        assert f"    {argument}: " in page
    assert inspect.getdoc(torch_door.rasterization) in page


def test_the_reference_has_every_field_and_command():
    options, commands = (generated()[f"reference/{name}.md"] for name in ("options", "command-line"))
    assert [f.name for f in fields(ss.TrainConfig) if f.name not in options] == []
    for name in (
        "generate",
        "import",
        "import colmap",
        "train",
        "eval",
        "report",
        "render",
        "sweep",
        "view",
        "compose",
        "verify",
        "export",
    ):
        assert f"## spacesim {name}\n" in commands
    assert "--iterations" in commands
    rows = re.findall(
        r"^\[(\S+)\]$", (ROOT / "spacesim/assets/materials.toml").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert len(rows) >= 16
    assert [name for name in rows if f"\n| `{name}` | " not in generated()["reference/materials.md"]] == []


def test_the_reference_has_every_field_of_the_protocol():
    """With its type and its meaning."""
    page = generated()["reference/serve-protocol.md"]
    for record in (protocol.PictureRequest, protocol.CameraFields):
        entry = page.partition(f"{inspect.getdoc(record)}\n")[2].partition("\n## ")[0]
        for f in fields(record):
            assert re.search(rf"^(#: .+\n)?{f.name}: \w.*", entry, re.MULTILINE), f.name
            found = re.search(rf"(?:^#: (.+)\n)?^{f.name}: .*?(?:  #: (.+))?$", entry, re.MULTILINE)
            assert any(found.groups()), f.name
    for name in protocol.OUTPUTS:
        assert re.search(rf'^"{name}",  # \[H, W.*\] (uint8|float32|int32)', page, re.MULTILINE), name


def named_in_docstrings() -> set[str]:
    """Numbers of equations. Those of scenes are sections of glTF's specification."""
    found: set[str] = set()
    for path in MODULES:
        if path.is_relative_to(ROOT / "spacesim" / "scenes"):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                said = ast.get_docstring(node) or ""
                for match in re.finditer(r"\((\d)\.(\d{1,2})(?: to \1\.(\d{1,2}))?[);,]", said):
                    numbers = range(int(match[2]), int(match[3] or match[2]) + 1)
                    found |= {f"{match[1]}.{number}" for number in numbers}
    return found


def test_every_equation_that_is_named_is_explained():
    explained = set(re.findall(r"\((\d\.\d+)\)", (DOCS / "explanation/equations.md").read_text(encoding="utf-8")))
    pages = "".join(page.read_text(encoding="utf-8") for page in PAGES if page.parent.name != "research")
    assert len(named_in_docstrings()) > 30
    assert named_in_docstrings() - explained == set()
    assert set(re.findall(r"\(([2-5]\.\d{1,2})\)", pages)) - explained == set()


@pytest.mark.skipif(importlib.util.find_spec("material") is None, reason="mkdocs-material is not installed (make docs)")
def test_the_site_is_built_without_warnings(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    page = (tmp_path / "site/reference/api/index.html").read_text(encoding="utf-8")
    assert "ss.generate" in page
    assert re.findall(r'(?:src|href)="https?://(?!squidfunk)[^"]*\.(?:js|css|woff2?)"', page) == []
