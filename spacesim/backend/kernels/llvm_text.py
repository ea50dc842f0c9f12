"""Functions of a kernel as text for LLVM, written instruction by instruction."""

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

INT, FLOAT = "i64", "float"  #: numbers of kernels; arrays hold 32 bits an entry
LANES = 16  #: numbers of vectors whose functions are `DECLARED`
FIRST = 4  #: of the addresses among the parameters, 8 bytes each, behind what launches of `LlvmKernel` use


@dataclass(frozen=True)
class Value:
    """A result of an instruction, or a constant: an integer, a float32 or a vector of these."""

    text: "Text" = field(repr=False)  #: that has the instruction
    kind: str  #: of LLVM
    name: str  #: of LLVM, "%v1" or a constant's

    def __add__(self, other: "Value | float") -> "Value":
        return self._with("add", other)

    def __sub__(self, other: "Value | float") -> "Value":
        return self._with("sub", other)

    def __mul__(self, other: "Value | float") -> "Value":
        return self._with("mul", other)

    def __truediv__(self, other: "Value") -> "Value":
        return self._with("div", other)

    def __rmul__(self, other: float) -> "Value":
        return self * other

    def __rsub__(self, other: float) -> "Value":
        return self.like(other) - self

    def __neg__(self) -> "Value":
        return self.text.value(self.kind, f"fneg {self.kind} {self.name}")

    def __floordiv__(self, other: "Value") -> "Value":
        return self.text.value(INT, f"udiv {INT} {self.name}, {other.name}")

    def __mod__(self, other: "Value") -> "Value":
        return self.text.value(INT, f"urem {INT} {self.name}, {other.name}")

    def __lt__(self, other: "Value") -> "Value":
        """Integers as unsigned: one below 0 is beyond all others."""
        operation, entry = ("icmp ult", INT) if self.kind == INT else ("fcmp olt", FLOAT)
        return self.text.value(self.kind.replace(entry, "i1"), f"{operation} {self.kind} {self.name}, {other.name}")

    def choose(self, yes: "Value", no: "Value") -> "Value":
        """Of a condition, or one for each entry of a vector."""
        return self.text.value(yes.kind, f"select {self.kind} {self.name}, {yes.kind} {yes.name}, {no.kind} {no.name}")

    def _with(self, operation: str, other: "Value | float") -> "Value":
        prefix = "" if self.kind == INT else "f"
        return self.text.value(self.kind, f"{prefix}{operation} {self.kind} {self.name}, {self.like(other).name}")

    def like(self, other: "Value | float") -> "Value":
        """A number as a constant of this kind."""
        if isinstance(other, Value):
            return other
        if self.kind == INT:
            return self.text.integer(int(other))
        return self.text.one_float(other) if self.kind == FLOAT else self.text.floats(_size(self.kind), other)

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

    def choose_array(self, name: str, names: Sequence[str], index: Value) -> None:
        """From here on `name` is the array `index` of `names`."""
        address = self._addresses[names[-1]]
        for place in reversed(range(len(names) - 1)):
            address = (index < self.integer(place + 1)).choose(self._addresses[names[place]], address)
        self._addresses[name] = address

    def _parameter(self, kind: str, place: int) -> Value:
        where = self.value("ptr", f"getelementptr i64, ptr %parameters, i64 {place}")
        return self.value(kind, f"load {kind}, ptr {where.name}")

    def number(self, name: str) -> Value:
        """One that the kernel is launched with."""
        return self._numbers[name]

    def float_number(self, name: str) -> Value:
        """One that the kernel is launched with, of `float_bits`."""
        bits = self.value("i32", f"trunc {INT} {self._numbers[name].name} to i32")
        return self.value(FLOAT, f"bitcast i32 {bits.name} to float")

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

    def one_float(self, number: float) -> Value:
        """A constant float32."""
        return Value(self, FLOAT, _constant(number))

    def floats(self, size: int, number: float) -> Value:
        """A constant vector of one float32."""
        return Value(self, vector(size), f"<{', '.join([f'float {_constant(number)}'] * size)}>")

    def spread(self, number: Value, size: int) -> Value:
        """A vector of one float32."""
        kind = vector(size)
        first = self.value(kind, f"insertelement {kind} poison, float {number.name}, i32 0")
        zeros = f"<{size} x i32> zeroinitializer"
        return self.value(kind, f"shufflevector {kind} {first.name}, {kind} poison, {zeros}")

    def zeros(self, size: int) -> Value:
        """A vector of float32."""
        return Value(self, vector(size), "zeroinitializer")

    def lanes(self, size: int, first: Value, end: Value) -> Value:
        """Of a vector whose first entry has a number, whether each is below another."""
        call = f"@llvm.get.active.lane.mask.v{size}i1.i64(i64 {first.name}, i64 {end.name})"
        return self.value(f"<{size} x i1>", f"call <{size} x i1> {call}")

    def no_lanes(self, size: int) -> Value:
        """Of a vector, none."""
        return Value(self, f"<{size} x i1>", "zeroinitializer")

    def load(self, array: str, index: Value) -> Value:
        """An unsigned integer of 32 bits."""
        loaded = self.value("i32", f"load i32, ptr {self._place(array, index, 'i32')}, align 4")
        return self.value(INT, f"zext i32 {loaded.name} to {INT}")

    def load_floats(self, array: str, index: Value, size: int = 0) -> Value:
        """A float32, or a vector of `size` numbers from entry `index` on."""
        kind = vector(size) if size else FLOAT
        return self.value(kind, f"load {kind}, ptr {self._place(array, index, FLOAT)}, align 4")

    def load_lanes(self, array: str, index: Value, lanes: Value) -> Value:
        """A vector of float32 from entry `index` on, 0 but for `lanes`, the others of which need not be there."""
        kind = lanes.kind.replace("i1", FLOAT)
        arguments = f"ptr {self._place(array, index, FLOAT)}, i32 4, {lanes.kind} {lanes.name}, {kind} zeroinitializer"
        return self.value(kind, f"call {kind} @llvm.masked.load.v{_size(kind)}f32.p0({arguments})")

    def store_lanes(self, array: str, index: Value, value: Value, lanes: Value) -> None:
        """Write entries of a vector, those of `lanes`."""
        place, kind = self._place(array, index, FLOAT), value.kind
        arguments = f"{kind} {value.name}, ptr {place}, i32 4, {lanes.kind} {lanes.name}"
        self.do(f"call void @llvm.masked.store.v{_size(kind)}f32.p0({arguments})")

    def store(self, array: str, index: Value, value: Value) -> None:
        """Write a number, integers in 32 bits, or a vector from entry `index` on."""
        kind, name = value.kind, value.name
        if kind == INT:
            kind, name = "i32", self.value("i32", f"trunc {INT} {name} to i32").name
        self.do(f"store {kind} {name}, ptr {self._place(array, index, 'i32')}, align 4")

    def room(self, name: str, size: int) -> None:
        """From here on `name` is an array of so many float32 of this call's own, on the stack."""
        assert self._block == "entry", "taken once, not in each turn of a loop"
        self._addresses[name] = self.value("ptr", f"alloca [{size} x {FLOAT}], align 64")

    def transposed(self, rows: Sequence[Value]) -> list[Value]:
        """Vectors of float32, as many as a power of two, as a matrix on its side; of longer vectors each part that is
        as long as they are many."""
        count, size, vectors = len(rows), _size(rows[0].kind), list(rows)
        first = [part + k // 2 + k % 2 * size for part in range(0, size, count) for k in range(count)]
        halves = first, [lane + count // 2 for lane in first]  # entries of two vectors by turns
        for _ in range(count.bit_length() - 1):
            pairs = zip(vectors[: count // 2], vectors[count // 2 :], strict=True)
            vectors = [self._shuffled(*pair, lanes) for pair in pairs for lanes in halves]
        return vectors

    def _shuffled(self, x: Value, y: Value, lanes: Sequence[int]) -> Value:
        """A vector of entries of two, numbered one after the other."""
        places = f"<{len(lanes)} x i32> <{', '.join(f'i32 {lane}' for lane in lanes)}>"
        return self.value(vector(len(lanes)), f"shufflevector {x.kind} {x.name}, {y.kind} {y.name}, {places}")

    def prefetch(self, array: str, index: Value) -> None:
        """Ask the memory for an entry that will be loaded."""
        self.do(f"call void @llvm.prefetch.p0(ptr {self._place(array, index, FLOAT)}, i32 0, i32 3, i32 1)")

    def _place(self, array: str, index: Value, kind: str) -> str:
        address = self._addresses[array].name
        return self.value("ptr", f"getelementptr {kind}, ptr {address}, {INT} {index.name}").name

    def fma(self, x: Value, y: Value | float, z: Value | float) -> Value:
        """x y + z, rounded once."""
        name = f"v{_size(x.kind)}f32" if x.kind != FLOAT else "f32"
        arguments = ", ".join(f"{value.kind} {value.name}" for value in (x, x.like(y), x.like(z)))
        return self.value(x.kind, f"call {x.kind} @llvm.fma.{name}({arguments})")

    def sum(self, value: Value) -> Value:
        """Of a vector's entries, the first first."""
        call = f"@llvm.vector.reduce.fadd.v{_size(value.kind)}f32(float {_constant(-0.0)}, {value.kind} {value.name})"
        return self.value(FLOAT, f"call float {call}")

    def maximum(self, x: Value, y: Value | float) -> Value:
        """The larger of two float32, or of each pair of two vectors; the first where one is no number."""
        other = x.like(y)
        return (x < other).choose(other, x)

    def rcp(self, x: Value) -> Value:
        """1 / x."""
        return x.like(1) / x

    def sqrt(self, x: Value) -> Value:
        """Square root of a vector."""
        return self.value(x.kind, f"call {x.kind} @llvm.sqrt.v{_size(x.kind)}f32({x.kind} {x.name})")

    def load_threes(self, array: str, places: Sequence[Value]) -> list[Value]:
        """The first three of the four numbers from each of `LANES` places on, as three vectors."""
        fours = [self.load_floats(array, place, 4) for place in places]
        return self.transposed([self._joined(fours[i::4]) for i in range(4)])[:3]

    def _joined(self, parts: Sequence[Value]) -> Value:
        """Vectors of one size, as many as a power of two, one behind the other."""
        while len(parts) > 1:
            lanes = range(2 * _size(parts[0].kind))
            parts = [self._shuffled(parts[i], parts[i + 1], lanes) for i in range(0, len(parts), 2)]
        return parts[0]

    @contextmanager
    def loop(self, start: Value, end: Value, state: Sequence[Value] = (), step: Value | int = 1) -> Iterator["Loop"]:
        """What is written within is done for integers from `start` to `end` - 1, every one or each `step`."""
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
        following = loop.at + step
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


def _size(kind: str) -> int:
    """Of a vector."""
    return int(kind[1:].split()[0])


def float_bits(number: float) -> int:
    """A float32 as kernels are launched with it."""
    return int(struct.unpack("<I", struct.pack("<f", number))[0])


def _constant(number: float) -> str:
    """Of float32, as LLVM reads it: the bits of the float64 that is equal."""
    rounded = struct.unpack("<f", struct.pack("<f", number))[0]
    return f"0x{struct.unpack('<Q', struct.pack('<d', rounded))[0]:016X}"


DECLARED = """
declare i64 @llvm.umin.i64(i64, i64)
declare void @llvm.prefetch.p0(ptr, i32, i32, i32)
declare float @llvm.fma.f32(float, float, float)
declare <16 x float> @llvm.fma.v16f32(<16 x float>, <16 x float>, <16 x float>)
declare <16 x float> @llvm.sqrt.v16f32(<16 x float>)
declare float @llvm.vector.reduce.fadd.v16f32(float, <16 x float>)
declare <16 x i1> @llvm.get.active.lane.mask.v16i1.i64(i64, i64)
declare <16 x float> @llvm.masked.load.v16f32.p0(ptr, i32, <16 x i1>, <16 x float>)
declare void @llvm.masked.store.v16f32.p0(<16 x float>, ptr, i32, <16 x i1>)
"""
