"""Plain values of a file to frozen dataclasses: the fields and their annotations are all that says what is allowed."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass
from difflib import get_close_matches
from functools import cache, wraps
from inspect import signature
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, NoReturn, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

from spacesim.data.errors import InputError
from spacesim.data.files import MAX_JSON_BYTES, JsonDict, JsonMapping, read_json
from spacesim.data.toml import Document, Keys, dotted

P = ParamSpec("P")
T = TypeVar("T")
_NOUNS = {int: "a whole number", float: "a finite number", bool: "true or false", str: "text in quotes"}


@dataclass(frozen=True)
class Rules:
    """What annotations alone do not say."""

    #: classes that the key `kind` chooses among, the first is the default
    kinds: Mapping[type, Mapping[str, type]] = field(default_factory=dict)
    hidden: Sequence[tuple[type, str]] = ()  #: fields that are no keys
    spread: Sequence[str] = ()  #: fields of which one number stands for all
    #: classes whose unknown keys are passed over, where files of other programs or versions may have more
    open: Sequence[type] = ()
    none: str | None = None  #: the word that stands for None, where annotations have it


def structure(cls: type[T], document: Document, rules: Rules, defaults: JsonMapping | None = None) -> T:
    """The `cls` that `document` says; defaults: of keys of the outermost table.

    Raises InputError with file, line and key for a key that is not known, a value of a wrong type or an impossible one.
    """
    return _Reader(document, rules, cls).table(cls, document.values, (), defaults or {})


def read_record(path: Path, cls: type[T], rules: Rules | None = None, most: int = MAX_JSON_BYTES) -> tuple[T, JsonDict]:
    """(the `cls` that a JSON file says, its values as they stand there). null is allowed where an annotation has None.

    Raises InputError where the file cannot be read, is no JSON object, or as `structure` does.
    """
    values = read_json(path, most)
    if not isinstance(values, dict):
        raise InputError(f"{path}: expected a JSON object, found {shortened(values)}")
    return structure(cls, Document(str(path), values, {}), rules or Rules()), values


def plain(record: object) -> Any:
    """The inverse of `structure`: a record as tables, lists and values that JSON has. The alternatives of a union say
    which one they are under the key `kind`."""
    if is_dataclass(record) and not isinstance(record, type):
        kind = {"kind": tag} if (tag := kind_of(type(record))) else {}
        return {**kind, **{f.name: plain(getattr(record, f.name)) for f in fields(record)}}
    if isinstance(record, Mapping):
        return {key: plain(value) for key, value in record.items()}
    return [plain(value) for value in record] if isinstance(record, list | tuple) else record


def kind_of(cls: Any) -> str | None:
    """The word that chooses this class among the alternatives of a union: its class variable `kind`."""
    return _kind_of(cls)


@cache  # behind a function whose argument type checkers take to be any class
def _kind_of(cls: Any) -> str | None:
    tag = cls.__dict__.get("kind")
    return tag if isinstance(tag, str) and all(f.name != "kind" for f in fields(cls)) else None


def alternatives(hint: object) -> dict[str, type]:
    """{kind: class} of an annotation that is a union of records, each with a class variable `kind`; {} of another."""
    inner = get_args(hint) if get_origin(hint) in (Union, UnionType) else ()
    return {
        tag: member
        for member in inner
        if isinstance(member, type) and is_dataclass(member) and (tag := kind_of(member))
    }


def choices(hint: object) -> tuple[str, ...]:
    """What an annotation `Literal[...]`, or one with None beside it, allows; () of another."""
    return next((get_args(member) for member in members_of(hint) if get_origin(member) is Literal), ())


def check_fields(record: object) -> None:
    """Raise InputError "field: expected ..., found ..." unless every field of `record` holds what its annotation says,
    where that is a record or what a file can say."""
    cls: Any = type(record)
    for name, types, words in _taken_by(cls):
        value = getattr(record, name)
        if type(value) not in types and not (isinstance(value, str) and value in words):
            field_value(cls, name, value)


@cache
def _taken_by(cls: type) -> list[tuple[str, set[Any], tuple[str, ...]]]:
    """(field, types and words that need no closer look) of each field of a dataclass."""
    return [
        (name, {*members_of(hint), *([int] if float in members_of(hint) else [])}, choices(hint))
        for name, hint in _hints(cls).items()
    ]


@cache
def _hints(cls: Any) -> dict[str, Any]:
    """Annotations of the fields of a dataclass."""
    hints = get_type_hints(cls)
    return {f.name: hints[f.name] for f in fields(cls)}


def keys_of(cls: type, rules: Rules) -> dict[str, Any]:
    """The keys of a table that gives a `cls`, with their annotations."""
    hidden = {name for owner, name in rules.hidden if issubclass(cls, owner)}
    return {name: hint for name, hint in _hints(cls).items() if name not in hidden}


def options_in(cls: Any) -> list[Field[Any]]:
    """The fields of a dataclass that can be set: not those whose metadata say `"option": False`."""
    return [f for f in fields(cls) if f.metadata.get("option", True)]


def check_first_key(cls: type, name: str) -> None:
    """Raise InputError "name: expected a field of ..., found ..." unless a dotted name begins with a field of the
    dataclass `cls`. It says where a field within is called so, or nearly so."""
    keys, known = tuple(name.split(".")), keys_of(cls, Rules())
    if keys[0] not in known:
        ends = (place for place in places_of(cls, Rules()) if place[-len(keys) :] == keys)
        close = next(ends, None) or _close_place(cls, Rules(), (), keys[0], [*known])
        hint = f"; did you mean {dotted(close)}?" if close else ""
        raise InputError(f"{name}: expected a field of {cls.__name__}, found {keys[0]!r:.60}{hint}")


def field_value(cls: type, name: str, value: object) -> Any:
    """`value`, given in Python, as the field `name` of a dataclass wants it: numpy's numbers and arrays as Python's,
    lists as tuples, records and what no file can say as they are. Raises InputError "name: expected ..., found ..."."""
    return _python_value(_hints(cls)[name], name, value)


def checked(function: Callable[P, T]) -> Callable[P, T]:
    """`function`, which raises InputError "name: expected ..., found ..." for an argument that its annotation says to
    be a number, several, true or false, or a function, and that is none."""
    names = list(signature(function).parameters)

    @cache
    def hints() -> list[tuple[int, str, Any]]:
        """(place, name, annotation) of each argument that is looked at."""
        found = get_type_hints(function)
        return [(i, name, found[name]) for i, name in enumerate(names) if name in found and _is_checked(found[name])]

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        for place, name, hint in hints():
            if place < len(args):
                _python_value(hint, name, args[place])
            elif name in kwargs:
                _python_value(hint, name, kwargs[name])
        return function(*args, **kwargs)

    return call


def _is_checked(hint: object) -> bool:
    """Whether `checked` looks at arguments of an annotation. Words are left to functions, which know them."""
    members = [member for member in members_of(hint) if member is not NoneType]
    if len(members) != 1 or members[0] is str or get_origin(members[0]) is Literal:
        return False
    return _is_plain(members[0]) or get_origin(members[0]) is Callable


def _python_value(hint: Any, name: str, value: object) -> Any:
    """As `field_value`, of any annotation."""
    members = [member for member in members_of(hint) if member is not NoneType]
    if value is None and NoneType in members_of(hint):
        return None
    records = tuple(member for member in members if isinstance(member, type) and is_dataclass(member))
    if records:
        expected, fits = f"a {' or '.join(sorted(record.__name__ for record in records))}", isinstance(value, records)
    elif get_origin(members[0]) is Callable:
        expected, fits = "a function", callable(value)
    elif len(members) == 1 and _is_plain(members[0]):
        return _Reader(Document("", {}, {}), Rules(), object).value(hint, _as_in_files(value), (name,))
    else:
        return value
    if not fits:
        raise InputError(f"{name}: expected {expected}, found {shortened(value)}")
    return value


def members_of(hint: object) -> tuple[Any, ...]:
    """The members of an annotation that is a union, another annotation alone."""
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


def _is_plain(hint: object) -> bool:
    """Whether a file can say all values of an annotation."""
    origin, inner = get_origin(hint), [member for member in get_args(hint) if member not in (NoneType, Ellipsis)]
    holds = origin in (tuple, Mapping, Union, UnionType) and all(map(_is_plain, inner))
    return hint in list(_NOUNS) or origin is Literal or holds


def _as_in_files(value: object) -> object:
    value = value.tolist() if hasattr(value, "tolist") else value
    return [_as_in_files(item) for item in value] if isinstance(value, list | tuple) else value


def places_of(cls: type, rules: Rules, at: Keys = ()) -> Iterator[Keys]:
    """Where keys are in a document that gives a `cls`, but for those in lists and in tables with free names."""
    for kind in dict.fromkeys([cls, *rules.kinds.get(cls, {}).values()]):
        options = {f.name for f in options_in(kind)}
        for key, hint in keys_of(kind, rules).items():
            if key not in options:
                continue
            yield (*at, key)
            for table in (member for member in members_of(hint) if isinstance(member, type) and is_dataclass(member)):
                yield from places_of(table, rules, (*at, key))


def _close_place(root: type, rules: Rules, at: Keys, key: str, expected: Sequence[str]) -> Keys | None:
    """Where a key is that is called `key`, or nearly so: one of the `expected` in the table `at`, else any of the
    document that gives a `root`; None where there is none."""
    places = {str(place[-1]): place for place in reversed([*places_of(root, rules)])}  # the first
    places |= {name: (*at, name) for name in expected}
    close = [key] if key in places else get_close_matches(key, expected, 1)
    close = close or get_close_matches(key, places, 1, 0.8)  # elsewhere: only what is nearly it
    return places[close[0]] if close else None


def did_you_mean(word: object, words: Iterable[str]) -> str:
    """ "; did you mean ...?" where one of the `words` is close to `word`, else nothing."""
    close = get_close_matches(str(word), list(words), n=1)
    return f"; did you mean {close[0]}?" if close else ""


class _Reader:
    def __init__(self, document: Document, rules: Rules, root: type) -> None:
        self._document = document
        self._rules = rules
        self._root = root

    def table(self, cls: Any, values: Any, at: Keys, defaults: JsonMapping | None = None) -> Any:
        """The dataclass `cls`, or the one that `kind` chooses, from a table."""
        return self._read_record(cls, self._rules.kinds.get(cls, {}), values, at, defaults)

    def _read_record(
        self, cls: Any, kinds: Mapping[str, type], values: Any, at: Keys, defaults: JsonMapping | None = None
    ) -> Any:
        if not isinstance(values, Mapping):
            self._refuse(at, "a table", values)
        values = dict(values)
        if kinds:
            kind = values.pop("kind", next(iter(kinds)))
            if not isinstance(kind, str) or kind not in kinds:
                self._refuse((*at, "kind"), f"one of {', '.join(kinds)}", kind, did_you_mean(kind, kinds))
            cls = kinds[kind]
        hints = keys_of(cls, self._rules)
        is_open = any(issubclass(cls, open_class) for open_class in self._rules.open)
        values = {key: value for key, value in values.items() if key in hints or not is_open}
        for key in values:
            if key not in hints:
                options = [f.name for f in options_in(cls) if f.name in hints]
                self._refuse_key(key, at, [*(["kind"] if kinds else []), *options], kinds)
        settings = {key: self.value(hints[key], value, (*at, key)) for key, value in values.items()}
        settings = {**(defaults or {}), **settings}
        for f in fields(cls):
            if f.default is MISSING and f.default_factory is MISSING and f.name not in settings:
                self._refuse((*at, f.name), _noun(hints[f.name]), None)
        return self._construct(cls, settings, at)

    def value(self, hint: object, value: object, at: Keys) -> Any:
        """`value` as its annotation `hint` wants it."""
        origin, inner = get_origin(hint), get_args(hint)
        if hint is Any:
            return value
        if origin in (Union, UnionType):
            if NoneType in inner and (value is None or (value == self._rules.none and isinstance(value, str))):
                return None
            if kinds := alternatives(hint):
                if isinstance(value, str):
                    if value not in kinds:
                        self._refuse(at, f"one of {', '.join(kinds)}", value, did_you_mean(value, kinds))
                    value = {"kind": value}
                return self._read_record(None, kinds, value, at)
            (hint,) = (member for member in inner if member is not NoneType)
            return self.value(hint, value, at)
        if origin is tuple:
            return self._read_list(hint, value, at)
        if origin is Literal:
            if not isinstance(value, str) or value not in inner:
                self._refuse(at, _noun(hint), value, did_you_mean(value, inner))
            return value
        if origin is not None and issubclass(origin, Mapping):
            if not isinstance(value, Mapping):
                self._refuse(at, "a table", value)
            return {key: self.value(inner[1], item, (*at, key)) for key, item in value.items()}
        if is_dataclass(hint):
            return self.table(hint, value, at)
        return self._plain(hint, value, at)

    def _read_list(self, hint: object, value: object, at: Keys) -> tuple[object, ...]:
        inner = get_args(hint)
        is_open, may_spread = inner[-1] is Ellipsis, at[-1] in self._rules.spread
        if may_spread and type(value) in (int, float):
            value = [value] * len(inner)
        if not isinstance(value, list) or (not is_open and len(value) != len(inner)):
            self._refuse(at, _noun(hint) + (" or one for all" if may_spread else ""), value)
        hints = [inner[0]] * len(value) if is_open else inner
        return tuple(
            self.value(item_hint, item, (*at, i)) for i, (item_hint, item) in enumerate(zip(hints, value, strict=True))
        )

    def _plain(self, hint: Any, value: Any, at: Keys) -> Any:
        if hint not in _NOUNS:
            raise TypeError(f"{dotted(at)}: expected an annotation that a file can fill, found {hint!r}")
        number = float(value) if hint is float and type(value) is int and abs(value) < 1e300 else value
        if type(number) is not hint or (hint is float and not math.isfinite(number)):
            self._refuse(at, _noun(hint), value)
        if isinstance(value, str) and "\0" in value:  # no file has such a name
            self._refuse(at, "text without a null character", value)
        return number

    def _construct(self, cls: Any, settings: JsonMapping, at: Keys) -> Any:
        """`cls` with the fields `settings`; its own InputError, which begins with a field's name, gets file and
        line."""
        try:
            return cls(**settings)
        except InputError as error:
            words, _, rest = str(error).partition(": ")
            where = (*at, words) if any(words == f.name for f in fields(cls)) else at
            label = self._document.label(where)
            raise InputError(f"{label}: {rest}" if label else str(error)) from None

    def _refuse_key(self, key: str, at: Keys, expected: Sequence[str], kinds: Mapping[str, type]) -> NoReturn:
        others = [kind for kind, cls in kinds.items() if key in keys_of(cls, self._rules)]
        close = _close_place(self._root, self._rules, at, key, expected)
        hint = f"; did you mean {dotted(close)}?" if close else ""
        if others:
            hint = f"; kind {' and '.join(others)} know{'s' * (len(others) == 1)} it"
        self._refuse((*at, key), f"one of {', '.join(expected)}", key, hint)

    def _refuse(self, at: Keys, expected: str, found: object, hint: str = "") -> NoReturn:
        what = "none" if found is None else shortened(found)
        raise InputError(f"{self._document.label(at)}: expected {expected}, found {what}{hint}")


def shortened(value: object) -> str:
    """A value as sentences name it, in 60 characters at most."""
    if isinstance(value, Mapping):
        return "a table"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _noun(hint: Any) -> str:
    """What an annotation asks for, in words."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return _noun(next(member for member in inner if member is not NoneType))
    if origin is Literal:
        return f"one of {', '.join(inner)}"
    if origin is tuple and inner[-1] is Ellipsis:
        return "tables in double brackets" if is_dataclass(inner[0]) else f"a list, each item {_noun(inner[0])}"
    if origin is tuple:
        return f"a list of {len(inner)} {'whole numbers' if set(inner) == {int} else 'numbers'}"
    return _NOUNS.get(hint, "a table")
