"""Code that takes the arrays out of a call's arguments, written for arguments of one structure.

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


def size_of(value: object, names_of_fields: FieldNames) -> int:
    """How many numbers and texts it is made of."""
    fields = names_of_fields(type(value)) or ()
    parts = value if isinstance(value, tuple) else [getattr(value, field) for field in fields]
    return sum(size_of(part, names_of_fields) for part in parts) if parts or fields else 1
