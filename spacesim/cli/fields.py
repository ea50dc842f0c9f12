"""The fields of the training's records, read off the records themselves: key, type, default, meaning.

What a field means stands in its source, as a comment `#: ...` behind it or above it; nothing says it a second time.
"""

import ast
import inspect
import io
import textwrap
import tokenize
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from types import NoneType
from typing import Any, get_type_hints

from spacesim.data.structure import alternatives, choices, kind_of, members_of, options_in
from spacesim.splat.train.config import TrainConfig

_WORDS: dict[object, str] = {int: "whole number", float: "number", bool: "true or false", str: "text"}


@dataclass(frozen=True)
class ConfigField:
    """A row of a list of fields."""

    key: str  #: dotted, as `--set` takes it
    type: str  #: in words, or the words that it can be
    default: str  #: as TOML has it; none for None, "" for a table
    meaning: str  #: one line


@cache
def meanings(cls: Any) -> dict[str, str]:
    """{field: what it means} of a dataclass: of each the comment `#: ...` on its own lines, or on those above it."""
    source = textwrap.dedent(inspect.getsource(cls))
    comments: dict[int, str] = {}
    alone: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and token.string.startswith("#:"):
            comments[token.start[0]] = token.string[2:].strip()
            if token.line.lstrip().startswith("#:"):
                alone.add(token.start[0])
    (owner,) = ast.parse(source).body
    assert isinstance(owner, ast.ClassDef)
    result = {}
    for node in owner.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            lines = [line for line in range(node.lineno, (node.end_lineno or node.lineno) + 1) if line in comments]
            above = node.lineno - 1
            while above in alone:
                lines.insert(0, above)
                above -= 1
            result[node.target.id] = " ".join(comments[line] for line in lines)
    return {f.name: result.get(f.name, "") for f in fields(cls)}


def fields_of(record: object, at: str = "") -> Iterator[ConfigField]:
    """Every field of a record, and of the records in it, with the values that it has."""
    cls: Any = type(record)
    hints, meaning = get_type_hints(cls), meanings(cls)
    for f in options_in(cls):
        value, key = getattr(record, f.name), f"{at}{f.name}"
        if is_dataclass(value):
            yield ConfigField(key, type_words(hints[f.name]), kind_of(type(value)) or "", meaning[f.name])
            yield from fields_of(value, f"{key}.")
        else:
            yield ConfigField(key, type_words(hints[f.name]), _literal(value), meaning[f.name])


def type_words(hint: object) -> str:
    """An annotation in words."""
    inner = members_of(hint)
    words = [*alternatives(hint)] or [*choices(hint)]
    if not words:
        words = [_WORDS.get(member, "table") for member in inner if member is not NoneType]
    return " | ".join([*words, *(["none"] if NoneType in inner else [])])


def listing(config: object) -> str:
    """A line for each field of a configuration: key, default, type, meaning."""
    rows = list(fields_of(config))
    key, default = max(len(row.key) for row in rows), max(len(row.default) for row in rows)
    lines = []
    for row in rows:
        words = f"{row.meaning} [{row.type}]" if row.meaning else f"[{row.type}]"
        lines.append(f"{row.key:<{key}}  {row.default:<{default}}  {words}")
    return "\n".join(lines)


def reference(config: object = TrainConfig) -> str:
    """Markdown: a table for each record of a configuration, with the defaults of the record itself, and where it is
    found."""
    parts = []
    for cls, places in _records(config).items():
        where = ", ".join(f"`{place}`" for place in places if place)
        kind = f" (`{kind_of(cls)}`)" if kind_of(cls) else ""
        lead = " ".join((inspect.getdoc(cls) or "").split("\n\n")[0].split())
        lines = [f"## {cls.__name__}", "", f"{where}{kind}. {lead}" if where else lead, ""]
        hints, meaning = get_type_hints(cls), meanings(cls)
        if options_in(cls):
            lines += ["| key | type | default | meaning |", "|---|---|---|---|"]
        for f in options_in(cls):
            value = f.default_factory() if f.default_factory is not MISSING else f.default
            default = (kind_of(type(value)) or "") if is_dataclass(value) else _literal(value)
            keys = [f"`{place}.{f.name}`".replace("`.", "`") for place in places]  # as `--set` takes them
            cells = ", ".join(keys), type_words(hints[f.name]), f"`{default}`" if default else "", meaning[f.name]
            lines.append("| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


def _records(cls: object, at: str = "") -> dict[Any, list[str]]:
    """{record: keys under which it stands}, outer ones first."""
    result: dict[Any, list[str]] = {cls: [at]}
    for name, hint in get_type_hints(cls).items():
        for member in members_of(hint):
            if isinstance(member, type) and is_dataclass(member):
                for record, places in _records(member, f"{at}.{name}".removeprefix(".")).items():
                    result[record] = list(dict.fromkeys([*result.get(record, []), *places]))
    return result


def _literal(value: object) -> str:
    if value is None:
        return "none"
    return str(value).lower() if isinstance(value, bool) else f"{value:g}" if isinstance(value, float) else str(value)
