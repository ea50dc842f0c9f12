"""TOML 1.0 with the line of every key, for messages, and back to text.

Python's own parser (tomllib, before 3.11 the same code as tomli) says what the values are but not where they stand. A
scanner goes over the same text once more, only to count lines; it relies on the text being valid.
"""

import json
import math
import re
import sys
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from spacesim.data.errors import InputError
from spacesim.data.files import JsonMapping, read_bytes

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Keys = tuple[str | int, ...]  #: where a value is: names of tables and keys, numbers of what is in a list

MAX_FILE_BYTES = 1 << 20  #: bytes: far more than is written by hand
_MAX_KEY_PARTS = 16  # parts of a key, nested tables that lines are kept of


@dataclass(frozen=True)
class Document:
    """A TOML file."""

    name: str  #: of the file, for messages
    values: JsonMapping  #: the file's tables, as plain values
    lines: Mapping[Keys, int]  #: of keys, tables and what is in lists, counted from 1

    def place(self, keys: Keys) -> str:
        """File and line of a value or, where it is not there, of the table that it belongs into."""
        for end in range(len(keys), 0, -1):
            if keys[:end] in self.lines:
                return f"{self.name}, line {self.lines[keys[:end]]}"
        return self.name

    def label(self, keys: Keys) -> str:
        """File, line and key."""
        return ": ".join(filter(None, (self.place(keys), dotted(keys))))


def dotted(keys: Keys) -> str:
    """A place in words of TOML: objects[1].position."""
    parts = (f"[{key}]" if isinstance(key, int) else f".{_quoted_key(key)}" for key in keys)
    return "".join(parts).removeprefix(".")


def read_document(path: Path) -> Document:
    """Read a TOML file. Raises InputError, with the line where there is one, where it cannot be read or is no TOML."""
    try:
        text = read_bytes(path, "a scene file", MAX_FILE_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected text in UTF-8, found byte {error.object[error.start]:#04x}") from None
    return parse(text, str(path))


def parse(text: str, name: str) -> Document:
    """The document that `text` says; `name` stands in messages. Raises InputError."""
    if _LONG_KEY.search(text):
        raise InputError(f"{name}: expected keys of at most {_MAX_KEY_PARTS} parts, found one of more")
    try:
        values = tomllib.loads(text)
        lines = dict(_lines(text.replace("\r\n", "\n")))
    except RecursionError:
        raise InputError(f"{name}: expected TOML, found lists or tables nested too deeply") from None
    except ValueError as error:
        raise InputError(_syntax_error(str(error), text, name)) from None
    return Document(name, values, lines)


def _syntax_error(message: str, text: str, name: str) -> str:
    """Of tomllib's "what is wrong (at line 3, column 5)"."""
    match = re.fullmatch(r"(?s)(.*?) \(at (?:line (\d+), column \d+|end of document)\)", message)
    if not match:
        return f"{name}: expected TOML, found an error: {message}"
    what, line = match.groups()
    line = line or str(text.rstrip().count("\n") + 1)
    return f"{name}, line {line}: expected TOML, found an error: {what[:1].lower()}{what[1:]}"


_KEY_PART = r"""(?:[A-Za-z0-9_-]+|"(?:[^"\\\n]|\\.)*"|'[^'\n]*')"""
_KEY = re.compile(rf"{_KEY_PART}(?:[ \t]*\.[ \t]*{_KEY_PART})*")
_LONG_KEY = re.compile(rf"""(?<![\w-])(?:(?:[\w-]+|"[^"\\\n]*"|'[^'\n]*')[ \t]*\.[ \t]*){{{_MAX_KEY_PARTS}}}""")
"""Parsers keep every beginning of a dotted key, which takes memory as the square of its length."""

_BLANK = re.compile(r"(?:[ \t\n]|#[^\n]*)*")
_SPACE = re.compile(r"[ \t]*")
_VALUE = re.compile(
    r'"""(?:[^\\]|\\.)*?"{3,5}|' + r"'''.*?'{3,5}|" + r""""(?:[^"\\\n]|\\.)*"|'[^'\n]*'|[^,\]}\n#]+""", re.DOTALL
)
_HEADER_END = re.compile(r"[ \t]*\]\]?")


def _lines(text: str) -> Iterator[tuple[Keys, int]]:
    """(where, line) of all keys, tables and list items of a valid document; of each the first."""
    starts = [0, *(match.end() for match in re.finditer("\n", text))]
    seen: set[Keys] = set()
    for keys, position in _Scanner(text).statements():
        for end in range(1, min(len(keys), _MAX_KEY_PARTS) + 1):
            if keys[:end] not in seen:
                seen.add(keys[:end])
                yield keys[:end], bisect_right(starts, position)


class _Scanner:
    """Walks over the text of a valid document."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._at = 0
        self._lengths: dict[Keys, int] = {}  # of arrays of tables

    def statements(self) -> Iterator[tuple[Keys, int]]:
        """(where, position in the text), in the order of the text."""
        table: Keys = ()
        self._skip(_BLANK)
        while self._at < len(self._text):
            start = self._at
            if self._text[start] == "[":
                is_array = self._text.startswith("[[", start)
                self._at += 2 if is_array else 1
                self._skip(_SPACE)
                table = self._resolved(self._key(), is_array)
                yield table, start
                self._skip(_HEADER_END)
            else:
                yield from self._pair(table)
            self._skip(_BLANK)

    def _resolved(self, names: Sequence[str], is_array: bool) -> Keys:
        """Where a header's table is: names of arrays of tables mean the last of their items."""
        keys: Keys = ()
        for index, name in enumerate(names):
            keys = (*keys, name)
            if is_array and index == len(names) - 1:
                self._lengths[keys] = self._lengths.get(keys, 0) + 1
            if keys in self._lengths:
                keys = (*keys, self._lengths[keys] - 1)
        return keys

    def _pair(self, table: Keys) -> Iterator[tuple[Keys, int]]:
        start = self._at
        keys = (*table, *self._key())
        yield keys, start
        self._skip(_SPACE)
        self._at += 1  # =
        self._skip(_SPACE)
        yield from self._value(keys)

    def _value(self, keys: Keys) -> Iterator[tuple[Keys, int]]:
        opening = self._text[self._at]
        if opening not in "[{":
            self._skip(_VALUE)
            return
        self._at += 1
        index = 0
        self._skip(_BLANK)
        while self._text[self._at] not in "]}":
            if opening == "{":
                yield from self._pair(keys)
            else:
                yield (*keys, index), self._at
                yield from self._value((*keys, index))
                index += 1
            self._skip(_BLANK)
            if self._text[self._at] == ",":
                self._at += 1
                self._skip(_BLANK)
        self._at += 1

    def _key(self) -> list[str]:
        """A key, dotted or not, as its parts."""
        match = _KEY.match(self._text, self._at)
        assert match, "the text is valid TOML"
        self._at = match.end()
        parts = re.findall(_KEY_PART, match.group())
        return [next(iter(tomllib.loads(f"{part}=0"))) if part[0] in "\"'" else part for part in parts]

    def _skip(self, pattern: re.Pattern[str]) -> None:
        match = pattern.match(self._text, self._at)
        assert match, "the text is valid TOML"
        self._at = match.end()


def dump(values: JsonMapping) -> str:
    """`values` as TOML: numbers, strings, booleans, lists, tables and lists of tables. Raises InputError for what TOML
    cannot say."""
    return "\n".join(_dump_lines(values, ())).strip("\n") + "\n"


def _dump_lines(table: JsonMapping, path: tuple[str, ...]) -> Iterator[str]:
    later = {key: value for key, value in table.items() if isinstance(value, Mapping) or _is_tables(value)}
    for key, value in table.items():
        if key not in later:
            yield f"{_quoted_key(key)} = {_literal(value)}"
    for key, value in later.items():
        header = ".".join(map(_quoted_key, (*path, key)))
        for item in [value] if isinstance(value, Mapping) else value:
            if _is_tables(value) or not item or any(not isinstance(inner, Mapping) for inner in item.values()):
                yield ""
                yield f"[[{header}]]" if _is_tables(value) else f"[{header}]"
            yield from _dump_lines(item, (*path, key))


def _is_tables(value: object) -> bool:
    return isinstance(value, list | tuple) and len(value) > 0 and all(isinstance(item, Mapping) for item in value)


def _quoted_key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _literal(key)


def _literal(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        if any("\ud800" <= letter <= "\udfff" for letter in value):
            raise InputError(f"{value!r}: expected text that UTF-8 can say")
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, int) or (isinstance(value, float) and math.isfinite(value)):
        return repr(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_literal, value))}]"
    raise InputError(f"{value!r}: expected a finite number, text, true or false, or a list of them")
