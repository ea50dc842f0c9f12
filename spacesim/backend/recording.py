"""Functions that are traced once and replayed afterwards, by `dr.freeze`: the decorator `recorded`."""

import gc
import itertools
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields, is_dataclass
from functools import cache, update_wrapper
from operator import attrgetter
from typing import Any, Generic, ParamSpec, TypeVar, overload

from spacesim.backend.flattening import FEW, Flatten, Joining, flattener, size_of

P = ParamSpec("P")
R = TypeVar("R")
RECENT = 4  #: structures that a call's arguments may have, before it is walked through for what it has
RECORDINGS = 256  #: of a function that are kept: one for each size of picture, of the lists, and of the model

_PLAIN: frozenset[type] = frozenset((int, float, bool, str, type(None)))
_EQUAL_TO_INTEGERS = frozenset((float, bool))  # 1, 1.0 and True are one key of a dictionary, 0.0 and -0.0 too
MAX_KEYS = 2**14  # that are remembered of what is not an array
_constants: dict[int, tuple[Any, Any]] = {}  # frozen dataclasses without arrays, by `id`: what `_split` gave for them
_leaves: set[type] = set()  # types of arguments that Dr.Jit is left to look into


def elements_of_first(arrays: list[Any], *_: object, **__: object) -> int:
    """How many elements the first of a call's arrays has; 1 where it has no arrays."""
    import drjit as dr

    return int(dr.width(arrays[0])) if arrays else 1


Elements = Callable[..., int]
"""(arrays of a call in order, its arguments) to how many elements, Gaussians or pixels say, the call is about."""


@overload
def recorded(
    function: Callable[P, R], /, limit: int = RECORDINGS, *, elements: Elements | None = elements_of_first
) -> "Recorded[P, R]": ...


@overload
def recorded(
    *, limit: int = RECORDINGS, elements: Elements | None = elements_of_first
) -> "Callable[[Callable[P, R]], Recorded[P, R]]": ...


def recorded(
    function: Callable[..., Any] | None = None,
    /,
    limit: int = RECORDINGS,
    *,
    elements: Elements | None = elements_of_first,
) -> Any:
    """Decorator, bare or with options: the function is traced once and replayed afterwards, see `Recorded`.

    limit: recordings that are kept, the latest used
    elements: how many elements a call is about, by default those of its first array. A call about one is traced, since
        a recording takes an array of one element for a number, and gives a plane of one pixel another size. None: never
    """
    if function is None:
        return lambda function: Recorded(function, limit, elements)
    return Recorded(function, limit, elements)


class Recorded(Generic[P, R]):
    """A function by `dr.freeze`: traced at its first call with arguments of a kind, replayed at the others.

    Traced as they are, and not recorded, are calls about one element (see `recorded`), calls with an array that
    has gradients, so that they can be differentiated, and calls within another recording, of which they are a part.

    Arguments may be arrays, numbers and texts, and tuples, lists, dicts and dataclasses of them. Dr.Jit 1.5 takes
    long to walk through these, knows an argument that occurs twice in a call by identity, and takes f(1, 2, 1) for
    f(1, 2, 2): it gets a flat list of the arrays and one text for all the rest, and gives the like, as it would make
    records while it holds its lock: another thread that Python lets run then would wait for that for ever. So does what
    it looks into and is no array of its own, an `Enum` say: no argument may hold one. No array may stand in two places.
    What Dr.Jit's LLVM backend makes of a numpy array is numpy's own memory, whose kernels and recordings differ by
    whether it happens to begin at a multiple of 64 bytes: make arguments of lists, or copy them (`backend.upload`).
    Python's garbage collector waits during a call: arrays that it frees in the middle of a recording end the process.
    Other threads' calls, of any such function, wait as well: a recording takes in what they do.

    traced: the function itself, without a recording
    """

    traced: Callable[P, R]

    def __init__(self, function: Callable[P, R], limit: int, elements: Elements | None) -> None:
        import drjit as dr

        update_wrapper(self, function)
        self.traced, self._elements = function, elements
        self._structures, self._names = _Names(), _Names()
        self._flatteners: dict[str | None, Flatten] = {}  # by structures, of no more than there are recordings
        self._recent: deque[str] = deque(maxlen=RECENT)  # structures, the latest walked through last
        self._latest: str | None = None  # structure of the latest call
        self._after: dict[str | None, str] = {}  # structures, and what came next the last time
        now = self._now = _Arguments(function)

        # Dr.Jit walks through what a function has from outside at every call, but not through its defaults.
        def replay(_: str, arrays: list[Any], trace: Callable[[list[Any]], Any] = now.trace) -> Any:
            return trace(arrays)

        # who looks around for hours makes more recordings than are kept, and need not hear of it
        self._frozen = dr.freeze(replay, limit=limit, warn_after=2**31 - 1)
        self._has_gradients, self._flag, self._scope = dr.grad_enabled, dr.flag, dr.JitFlag.FreezingScope

    def __call__(self, *arguments: P.args, **named: P.kwargs) -> R:
        with one_at_a_time:
            return self._call(arguments, named)

    def _call(self, arguments: tuple[Any, ...], named: dict[str, Any]) -> R:
        if self._flag(self._scope):
            return self.traced(*arguments, **named)
        name, arrays = self._flat(arguments, named)
        about_one = self._elements is not None and self._elements(arrays, *arguments, **named) == 1
        if about_one or self._has_gradients(arrays):
            return self.traced(*arguments, **named)
        now = self._now
        now.arguments, now.named = arguments, named
        collecting = gc.isenabled()
        gc.disable()
        try:
            join, arrays = self._frozen(name, arrays)
            result: R = join(arrays)
            return result
        finally:
            now.arguments, now.named = (), {}
            if collecting:
                gc.enable()

    def _flat(self, arguments: tuple[Any, ...], named: dict[str, Any]) -> tuple[str, list[Any]]:
        """A text for all that is no array, and the arrays."""
        for structure in (self._after.get(self._latest), *self._recent):  # calls come in the same order step by step
            flatten = self._flatteners.get(structure)
            flat = flatten(arguments, named) if flatten else None
            if flat is not None:
                break
        else:
            arrays: list[Any] = []
            whole: list[int] = []
            kind = _split(arguments, arrays, whole), _split(named, arrays, whole)
            flat, is_known, structure = (arrays, tuple(whole)), kind in self._structures, self._structures[kind]
            if is_known and structure not in self._flatteners:  # what is seen once is not worth code
                if len(self._flatteners) >= RECORDINGS:
                    del self._flatteners[next(iter(self._flatteners))]
                    self._after.clear()
                self._flatteners[structure] = flattener(arguments, named, _leaves, _constants, _field_names)
            if structure in self._flatteners:
                self._recent.append(structure)
        assert structure is not None
        if structure in self._flatteners:
            self._after[self._latest] = self._latest = structure
        return self._names[structure, flat[1]], flat[0]


one_at_a_time = threading.RLock()  #: held by whoever records, replays, or launches kernels in between
_recordings = 0  # that were made


class _Arguments:
    """Of the call of a function that may be traced now."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self.arguments: tuple[Any, ...] = ()
        self.named: dict[str, Any] = {}

    def trace(self, arrays: list[Any]) -> tuple[Callable[[list[Any]], Any], list[Any]]:
        """Call the function with `arrays` in place of the arguments' own. Returns what makes its result of arrays, a
        constant of the recording, and the result's arrays."""
        global _recordings
        _recordings += 1
        rest = iter(arrays)
        result = self.function(*_joined(self.arguments, rest), **_joined(self.named, rest))
        joining = Joining(result, _PLAIN, _field_names)
        return joining.function(), joining.arrays


class _Names(dict[Any, str]):
    """A text for each value of `_split`, short and never given twice; the values seen are forgotten when they are
    very many."""

    def __init__(self) -> None:
        self._numbers = itertools.count()

    def __missing__(self, kind: object) -> str:
        if len(self) >= MAX_KEYS:
            self.clear()
        name = self[kind] = str(next(self._numbers))
        return name


_names_of_constants = _Names()


def _split(value: Any, arrays: list[Any], whole: list[int]) -> Any:
    """All of `value` that is no array, as a key of dictionaries, but for its whole numbers: in place of these their
    type; they and the arrays are added to lists. `flattener` writes code that tells the same values apart."""
    kind = type(value)
    if kind is int:
        whole.append(value)
        return kind
    if kind in _EQUAL_TO_INTEGERS:
        return kind, repr(value)
    if kind in _PLAIN:
        return value
    if kind is list and _leaves.issuperset(map(type, value)):
        arrays.extend(value)
        return kind, len(value)
    if kind is list or kind is tuple:
        kinds = _split_each(value, arrays, whole)
        new = kind is list and all(part is ... for part in kinds)  # of a type that is in `_leaves` from now on
        return kind, len(kinds) if new else kinds
    if kind is dict:
        return kind, tuple(value), _split_each(value.values(), arrays, whole)
    constant = _constants.get(id(value))
    if constant is not None:
        return constant[1]
    values_of = _values_of(kind)  # type: ignore[arg-type]
    if values_of is not None:
        before, numbers = len(arrays), len(whole)
        kinds = _split_each(values_of(value), arrays, whole)
        if len(arrays) > before or not _is_constant(value) or size_of(value, _field_names) <= FEW:
            return kind, kinds
        if len(_constants) >= MAX_KEYS:
            _constants.clear()
        _constants[id(value)] = value, (kind, _names_of_constants[kinds, tuple(whole[numbers:])])
        del whole[numbers:]
        return _constants[id(value)][1]
    _leaves.add(kind)
    arrays.append(value)
    return ...


def _is_constant(value: Any) -> bool:
    """A dataclass whose fields stay as they are: frozen, and without lists and dicts."""
    try:
        hash(value)
    except TypeError:
        return False
    return bool(type(value).__dataclass_params__.frozen)


def _split_each(values: Iterable[Any], arrays: list[Any], whole: list[int]) -> tuple[Any, ...]:
    kinds = []
    for value in values:
        if type(value) in _leaves:  # as most are
            arrays.append(value)
            kinds.append(...)
        else:
            kinds.append(_split(value, arrays, whole))
    return tuple(kinds)


def _joined(value: Any, arrays: Iterator[Any]) -> Any:
    """`value` with `arrays` in place of its own, in the order of `_split`."""
    kind = type(value)
    if kind in _PLAIN:
        return value
    if kind is list or kind is tuple:
        return kind(_joined(item, arrays) for item in value)
    if kind is dict:
        return {key: _joined(item, arrays) for key, item in value.items()}
    names = _field_names(kind)  # type: ignore[arg-type]
    if names is None:
        return next(arrays)
    copy = object.__new__(kind)
    for name in names:
        object.__setattr__(copy, name, _joined(getattr(value, name), arrays))
    return copy


@cache
def _field_names(kind: object) -> tuple[str, ...] | None:
    """Of a dataclass's fields; None for any other type."""
    return tuple(field.name for field in fields(kind)) if is_dataclass(kind) else None


@cache
def _values_of(kind: object) -> Callable[[object], tuple[Any, ...]] | None:
    """A getter of the fields of a dataclass, in the order of `_field_names`; None for any other type."""
    names = _field_names(kind)
    if names is None:
        return None
    if len(names) > 1:
        return attrgetter(*names)
    return lambda value: tuple(getattr(value, name) for name in names)


def recordings() -> int:
    """How many recordings the functions of `recorded` have made: once warm, it stands still."""
    return _recordings
