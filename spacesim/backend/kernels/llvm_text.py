"""Functions of a kernel as text for LLVM, written instruction by instruction."""

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

INT, FLOAT = "i64", "float"  #: numbers of kernels; arrays hold 32 bits an entry
FIRST = 4  #: of the addresses among the parameters, 8 bytes each, behind what launches of `LlvmKernel` use


@dataclass(frozen=True)
class Value:
    """A result of an instruction, or a constant: an integer, a float32 or a vector of these."""

    text: "Text" = field(repr=False)
    kind: str  #: of LLVM
    name: str  #: of LLVM, "%v1" or a constant's

    def __add__(self, other: "Value | int") -> "Value":
        return self._with("add", other)

    def __sub__(self, other: "Value | int") -> "Value":
        return self._with("sub", other)

    def __mul__(self, other: "Value | int") -> "Value":
        return self._with("mul", other)

    def __truediv__(self, other: "Value") -> "Value":
        return self._with("div", other)

    def _with(self, operation: str, other: "Value | int") -> "Value":
        second = other.name if isinstance(other, Value) else str(other)
        prefix = "" if self.kind == INT else "f"
        return self.text.value(self.kind, f"{prefix}{operation} {self.kind} {self.name}, {second}")

    def least(self, other: "Value") -> "Value":
        """The smaller of two integers that are not negative."""
        return self.text.value(INT, f"call {INT} @llvm.umin.i64({INT} {self.name}, {INT} {other.name})")

    def entry(self, index: int) -> "Value":
        """Of a vector of float32."""
        return self.text.value(FLOAT, f"extractelement {self.kind} {self.name}, i32 {index}")


class Text:
    """One function, which a kernel's threads call with indices from 0 on.

    name: of LLVM, "@count";  arrays, numbers: names of what the kernel is launched with
    """

    def __init__(self, name: str, arrays: Sequence[str], numbers: Sequence[str]) -> None:
        self._lines = [f"define internal void {name}(i32 %index, ptr %parameters) nounwind {{", "entry:"]
        self._count, self._block = 0, "entry"
        self.index = self.value(INT, f"zext i32 %index to {INT}")  #: of the call
        self._addresses = {name: self._parameter("ptr", FIRST + i) for i, name in enumerate(arrays)}
        self._numbers = {name: self._parameter(INT, FIRST + len(arrays) + i) for i, name in enumerate(numbers)}

    def _parameter(self, kind: str, place: int) -> Value:
        where = self.value("ptr", f"getelementptr i64, ptr %parameters, i64 {place}")
        return self.value(kind, f"load {kind}, ptr {where.name}")

    def number(self, name: str) -> Value:
        """One that the kernel is launched with."""
        return self._numbers[name]

    def value(self, kind: str, instruction: str) -> Value:
        """Result of an instruction."""
        self._count += 1
        result = Value(self, kind, f"%v{self._count}")
        self.do(f"{result.name} = {instruction}")
        return result

    def do(self, instruction: str) -> None:
        """Add an instruction."""
        self._lines.append(f"  {instruction}")

    def integer(self, number: int) -> Value:
        """A constant."""
        return Value(self, INT, str(number))

    def float(self, number: float) -> Value:
        """A constant float32."""
        rounded = struct.unpack("<f", struct.pack("<f", number))[0]
        return Value(self, FLOAT, f"0x{struct.unpack('<Q', struct.pack('<d', rounded))[0]:016X}")

    def zeros(self, size: int) -> Value:
        """A vector of float32."""
        return Value(self, vector(size), "zeroinitializer")

    def load(self, array: str, index: Value) -> Value:
        """An unsigned integer of 32 bits."""
        loaded = self.value("i32", f"load i32, ptr {self._place(array, index, 'i32')}, align 4")
        return self.value(INT, f"zext i32 {loaded.name} to {INT}")

    def load_floats(self, array: str, index: Value, size: int = 0) -> Value:
        """A float32, or a vector of `size` numbers from entry `index` on."""
        kind = vector(size) if size else FLOAT
        return self.value(kind, f"load {kind}, ptr {self._place(array, index, FLOAT)}, align 4")

    def store(self, array: str, index: Value, value: Value) -> None:
        """Write a number, integers in 32 bits, or a vector from entry `index` on."""
        kind, name = value.kind, value.name
        if kind == INT:
            kind, name = "i32", self.value("i32", f"trunc {INT} {name} to i32").name
        self.do(f"store {kind} {name}, ptr {self._place(array, index, 'i32')}, align 4")

    def prefetch(self, array: str, index: Value) -> None:
        """Ask the memory for an entry that will be loaded."""
        self.do(f"call void @llvm.prefetch.p0(ptr {self._place(array, index, FLOAT)}, i32 0, i32 3, i32 1)")

    def _place(self, array: str, index: Value, kind: str) -> str:
        address = self._addresses[array].name
        return self.value("ptr", f"getelementptr {kind}, ptr {address}, {INT} {index.name}").name

    def fma(self, x: Value, y: Value, z: Value) -> Value:
        """x y + z, rounded once."""
        return self.value(FLOAT, f"call float @llvm.fma.f32(float {x.name}, float {y.name}, float {z.name})")

    def largest(self, x: Value, y: Value) -> Value:
        """The larger of two float32; the second where one is no number."""
        is_larger = self.value("i1", f"fcmp ogt float {x.name}, {y.name}")
        return self.value(FLOAT, f"select i1 {is_larger.name}, float {x.name}, float {y.name}")

    @contextmanager
    def loop(self, start: Value, end: Value, state: Sequence[Value] = ()) -> Iterator["Loop"]:
        """What is written within is done for integers from `start` to `end` - 1."""
        self._count += 1
        name, before = f"loop{self._count}", self._block
        self.do(f"br label %{name}")
        self._begin(name)
        place = len(self._lines)
        loop = Loop(
            Value(self, INT, f"%{name}.at"), [Value(self, s.kind, f"%{name}.s{i}") for i, s in enumerate(state)]
        )
        self.do(f"%{name}.more = icmp ult {INT} {loop.at.name}, {end.name}")
        self.do(f"br i1 %{name}.more, label %{name}.body, label %{name}.end")
        self._begin(f"{name}.body")
        yield loop
        following = loop.at + 1
        firsts, nexts = [start, *state], [following, *loop.following]
        assert len(firsts) == len(nexts), "a loop says what its state becomes"
        self._lines[place:place] = [
            f"  {value.name} = phi {value.kind} [ {first.name}, %{before} ], [ {nxt.name}, %{self._block} ]"
            for value, first, nxt in zip([loop.at, *loop.state], firsts, nexts, strict=True)
        ]
        self.do(f"br label %{name}")
        self._begin(f"{name}.end")

    def _begin(self, block: str) -> None:
        self._lines.append(f"{block}:")
        self._block = block

    def finish(self) -> str:
        """All of it."""
        return "\n".join([*self._lines, "  ret void", "}", ""])


@dataclass
class Loop:
    """A loop within its `with`, and what is left behind it."""

    at: Value  #: the integer
    state: list[Value]  #: at the beginning of a turn; behind the loop, at its end
    following: list[Value] = field(default_factory=list)  #: to be set: the state of the next turn


def vector(size: int) -> str:
    """Kind of vectors of float32."""
    return f"<{size} x float>"


DECLARED = """
declare i64 @llvm.umin.i64(i64, i64)
declare void @llvm.prefetch.p0(ptr, i32, i32, i32)
declare float @llvm.fma.f32(float, float, float)
"""
