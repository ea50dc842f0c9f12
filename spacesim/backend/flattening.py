"""Code for one structure that takes the arrays out of a call's arguments, or makes its result of arrays.

Recorded functions are called with dozens of arrays in lists and records. To look at each thing for what it is takes as
long as to launch the kernels; straight code for what is expected takes a third of that.
"""

from collections.abc import Callable, Collection, Mapping
from typing import Any

FEW = 6  #: numbers of a constant that is looked into: what recordings give is an equal one each time, not the same
Flatten = Callable[[tuple[Any, ...], dict[str, Any]], "tuple[list[Any], tuple[int, ...]] | None"]
"""(arguments, named arguments) to their arrays and whole numbers in order, None where all else is not as expected."""
FieldNames = Callable[[type], tuple[str, ...] | None]
"""Names of a record's fields; None of what is none."""


def flattener(
    arguments: tuple[Any, ...],
    named: dict[str, Any],
    leaves: set[type],
    constants: Mapping[int, tuple[Any, Any]],
    names_of_fields: FieldNames,
) -> Flatten:
    """For calls of the structure of this one, to which `recording._split` gives the same key, and for no others.

    leaves: types of arrays, as known when called;  constants: objects whose second entry says all of them, by `id`
    """
    code = _Code(leaves, constants, names_of_fields)
    code.expect(arguments, "arguments")
    code.expect(named, "named")
    return code.function()


class _Code:
    def __init__(
        self,
        leaves: set[type],
        constants: Mapping[int, tuple[Any, Any]],
        names_of_fields: FieldNames,
    ) -> None:
        self.constants, self.names_of_fields = constants, names_of_fields
        self.scope: dict[str, Any] = {"leaves": leaves, "known": constants.get, "unknown": (None, None)}
        self.lines: list[str] = []
        self.last: list[str] = []  # conditions that take long, and hold where the others do
        self.arrays: list[str] = []
        self.whole: list[str] = []

    def expect(self, value: Any, name: str) -> None:
        """That the variable `name` is of the structure of `value`."""
        kind = type(value)
        if kind is list or kind is tuple:
            self._require(f"type({name}) is {kind.__name__} and len({name}) == {len(value)}")
            if value and all(map(self._is_array, value)):
                self.last.append(f"leaves.issuperset(map(type, {name}))")
                self.arrays.append(f"*{name}")
            else:
                self._expect_each(value, name)
        elif kind is dict:
            self._require(f"type({name}) is dict and [*{name}] == {self._object([*value])}")
            self._expect_each(value.values(), f"{name}.values()")
        elif kind is int:
            self._require(f"type({name}) is int")
            self.whole.append(name)
        elif id(value) in self.constants:
            self._require(f"known(id({name}), unknown)[1] == {self._object(self.constants[id(value)][1])}")
        elif (fields := self.names_of_fields(kind)) is not None:
            self._require(f"type({name}) is {self._object(kind)}")
            values = "".join(f"{name}.{field}, " for field in fields)
            self._expect_each([getattr(value, field) for field in fields], f"({values})")
        elif self._is_array(value):
            self.last.append(f"type({name}) in leaves")
            self.arrays.append(name)
        else:
            what, wanted = (f"repr({name})", repr(value)) if kind is float else (name, value)  # 0.0 and -0.0 are two
            self._require(f"type({name}) is {self._object(kind)} and {what} == {self._object(wanted)}")

    def function(self) -> Flatten:
        """All that was expected."""
        tests = f"    if not ({' and '.join(self.last)}): return None" if self.last else ""
        whole = "".join(f"{name}, " for name in self.whole)
        found = f"    return [{', '.join(self.arrays)}], ({whole})"
        lines = ["def flatten(arguments, named):", *self.lines, tests, found]
        exec("\n".join(lines), self.scope)
        flatten: Flatten = self.scope["flatten"]
        return flatten

    def _is_array(self, value: object) -> bool:
        return type(value) in self.scope["leaves"]

    def _require(self, condition: str) -> None:
        self.lines.append(f"    if not ({condition}): return None")

    def _expect_each(self, values: Collection[Any], source: str) -> None:
        """source: what gives all of them"""
        names = [f"x{len(self.lines)}_{i}" for i, _ in enumerate(values)]
        if names:
            self.lines.append(f"    {', '.join(names)}, = {source}")
        for value, name in zip(values, names, strict=True):
            self.expect(value, name)

    def _object(self, value: Any) -> str:
        """A name for it in the code."""
        name = f"c{len(self.scope)}"
        self.scope[name] = value
        return name


class Joining:
    """Code that makes what is like a value of other arrays, its own being those of `arrays`, in order."""

    def __init__(self, value: Any, plain: Collection[type], names_of_fields: FieldNames) -> None:
        """plain: types of what stays as it is"""
        self.plain, self.names_of_fields = plain, names_of_fields
        self.arrays: list[Any] = []
        self._constants: list[Any] = []
        self._code = self._expression(value)

    def function(self) -> Callable[[list[Any]], Any]:
        """Of as many arrays as there are in `arrays`."""
        joined: Callable[[list[Any]], Any] = eval(
            f"lambda arrays: {self._code}", {f"c{i}": value for i, value in enumerate(self._constants)}
        )
        return joined

    def _expression(self, value: Any) -> str:
        kind = type(value)
        if kind in self.plain:
            return self._constant(value)
        if kind is list or kind is tuple:
            parts = "".join(f"{self._expression(part)}, " for part in value)
            return f"[{parts}]" if kind is list else f"({parts})"
        if kind is dict:
            parts = "".join(f"{self._constant(key)}: {self._expression(part)}, " for key, part in value.items())
            return f"{{{parts}}}"
        names = self.names_of_fields(kind)
        if names is None:
            self.arrays.append(value)
            return f"arrays[{len(self.arrays) - 1}]"
        parts = "".join(f"{name}={self._expression(getattr(value, name))}, " for name in names)
        return f"{self._constant(kind)}({parts})"

    def _constant(self, value: Any) -> str:
        """A name for it in the code."""
        self._constants.append(value)
        return f"c{len(self._constants) - 1}"


def size_of(value: object, names_of_fields: FieldNames) -> int:
    """How many numbers and texts it is made of."""
    fields = names_of_fields(type(value)) or ()
    parts = value if isinstance(value, tuple) else [getattr(value, field) for field in fields]
    return sum(size_of(part, names_of_fields) for part in parts) if parts or fields else 1
