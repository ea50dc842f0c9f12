"""Every field of a record says what it is: in a comment `#:` beside it or above it, or in the record's docstring,
which names it `so`, or so: ..."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "spacesim"


def is_record(node: ast.AST) -> bool:
    return isinstance(node, ast.ClassDef) and any("dataclass" in ast.unparse(one) for one in node.decorator_list)


def fields_in(record: ast.ClassDef) -> Iterator[ast.AnnAssign]:
    """But for class variables and private fields."""
    for node in record.body:
        if isinstance(node, ast.AnnAssign) and "ClassVar" not in ast.unparse(node.annotation):
            assert isinstance(node.target, ast.Name)
            if not node.target.id.startswith("_"):
                yield node


def explained(record: ast.ClassDef, lines: list[str]) -> tuple[set[str], set[str]]:
    """Names of its fields that are explained, and of those that are not."""
    named = re.findall(r"`(\w+)(?:\[\w+\])?`|(\w+): ", ast.get_docstring(record) or "")
    words = {word for pair in named for word in pair}
    documented, undocumented = set(), set()
    for node in fields_in(record):
        name = ast.unparse(node.target)
        end = node.end_lineno or node.lineno
        beside = any("  #: " in line for line in lines[node.lineno - 1 : end])
        above = lines[node.lineno - 2].lstrip().startswith("#: ")
        below = any(line.lstrip().startswith('"""') for line in lines[end : end + 1])
        (documented if beside or above or below or name in words else undocumented).add(name)
    return documented, undocumented


def unexplained(sources: dict[str, str]) -> list[str]:
    """ "module.py: Record.field" of public records' fields that neither they nor what they extend explains."""
    classes = [
        (path, node, text.splitlines())
        for path, text in sources.items()
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.ClassDef)
    ]
    records = [(path, node, explained(node, lines)) for path, node, lines in classes if is_record(node)]
    documented = {node.name: names for _, node, (names, _) in records}
    bases = {node.name: [ast.unparse(base) for base in node.bases] for _, node, _ in classes}

    def inherited(name: str) -> set[str]:
        return set().union(*(documented.get(base, set()) | inherited(base) for base in bases.get(name, ())))

    return [
        f"{path}: {node.name}.{name}"
        for path, node, (_, undocumented) in records
        if not node.name.startswith("_")
        for name in sorted(undocumented - inherited(node.name))
    ]


def test_every_field_of_a_record_says_what_it_is():
    sources = {str(path.relative_to(PACKAGE)): path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")}
    assert len(sources) > 300
    assert unexplained(dict(sorted(sources.items()))) == []


def test_what_explains_a_field_is_found():
    source = '''
@dataclass(frozen=True)
class Base:
    """`named` is explained here, and bare is not. called: so

    `given[i]` is, too."""

    kind: ClassVar[str] = "base"
    named: int
    called: int
    given: list[int]
    beside: int = 1  #: metres
    #: metres
    above: int = 2
    spread: tuple[
        int, ...
    ] = ()  #: metres
    _private: int = 0
    bare: int = 0  # metres
    last: int = 0

@dataclass
class Heir(Base):
    beside: int = 3
    bare: int = 3

class Between(Base):
    pass

@dataclass
class Later(Between):
    beside: int = 4
    new: int = 4

@dataclass
class _Private:
    bare: int

class Other:
    bare: int
'''
    assert unexplained({"a.py": source}) == [
        "a.py: Base.bare",
        "a.py: Base.last",
        "a.py: Heir.bare",
        "a.py: Later.new",
    ]
