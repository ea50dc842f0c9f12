"""Text of kernels that multiply matrices of float32 on tensor cores, exact as in single precision.

A tensor core multiplies numbers of TF32: 11 bits, and the exponent of float32. So a number a is split into two, a = a1
+ a2 but for its last bits, and a product ab is a1 b1 + a1 b2 + a2 b1 (Ootomo and Yokota 2022); infinity gives NaN. What
it adds up it cuts off rather than rounds, so it adds up `DEPTH` products, and these sums are added up in float32.

A block has a tile of the result (`SIZES`); tiles of both factors come `DEPTH` columns and rows at a time to
shared memory, while the last ones are multiplied. Which thread holds which entries: PTX ISA, "mma.m16n8k8".
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import prod
from typing import Literal

from spacesim.learning.networks.network import CHUNK

_SIDES = 64, 128
SIZES = {"hidden": _SIDES, "back": _SIDES, "outer": _SIDES[::-1]}  #: rows and columns of the result, a block
DEPTH = 32  #: columns of the first factor, rows of the second, that are in shared memory at once
STAGES = 2  #: of them, so many times: some are on their way
WARP_ROWS, WARP_COLUMNS = 64, 32  #: of the result, a warp
THREADS = prod(_SIDES) // (WARP_ROWS * WARP_COLUMNS) * 32  #: of a block
BLOCKS = 2  #: at a time on a multiprocessor, at least
ADDRESSES, NUMBERS = 4, 5  #: parameters
COPIED, BYTES = 4, 4  #: numbers that are copied at once; bytes of a number
ROUND, KEPT = "0x1000", "0xffffe000"  #: half of the last bit that TF32 keeps; the bits that it keeps

Kind = Literal["hidden", "back", "outer"]
"""What a kernel computes of matrices B and vectors, see `ProductText`."""
_TYPES = {"r": ".b32", "d": ".b64", "f": ".f32", "p": ".pred"}


@dataclass
class _Tile:
    """A tile of a factor in shared memory."""

    along_k: bool  #: entries along the sum stand side by side
    size: int  #: rows of the first factor, columns of the second
    start: int  #: byte of a stage

    @property
    def pitch(self) -> int:
        """From a row of the tile to the next, numbers: no two threads of a warp read the same bank."""
        return DEPTH + 4 if self.along_k else self.size + 8

    @property
    def bytes(self) -> int:
        return self.pitch * (self.size if self.along_k else DEPTH) * BYTES

    def at(self, i: int, k: int) -> int:
        """Byte of entry i of the `size`, k of the `DEPTH`, from the first."""
        return BYTES * (i * self.pitch + k if self.along_k else k * self.pitch + i)


@dataclass
class _Copy:
    """Four numbers that a thread copies each step: registers."""

    tile: int  #: 0 of the first factor, 1 of the second
    source: str  #: address
    target: str  #: address in the first stage
    depth: str  #: place along the sum
    end: str  #: of the sum, 0 where the tile reaches beyond the factor


class ProductText:
    """Text of the kernel `entry`, by `kind`, of float32 matrices, row by row, and their sizes M, N, K:

    hidden: [B, M, m] = max(A B + v, 0) of A [M, K], B [B, K, m], v [M]
    back: [B, M, m] = A^T B of A [K, M], B [B, K, m], with `masked` 0 where V [B, M, m] is not above 0
    outer: [G, M, N] = sums of A_b B_b^T over the columns, in G parts, of A [B, M, m], B [B, N, m]

    m = `CHUNK`; M, N and K are multiples of 4. Parameters: addresses of A, B, the result, v or V; M, N, K, B, G.
    Blocks: `grid`.
    """

    def __init__(self, kind: Kind, masked: bool = False) -> None:
        self.kind, self.masked = kind, masked
        self.entry = f"{kind}_masked" if masked else kind
        self._lines: list[str] = []
        self._counts = dict.fromkeys(_TYPES, 0)
        self._height, self._width = SIZES[kind]
        first = _Tile(kind != "back", self._height, 0)
        self._tiles = first, _Tile(kind == "outer", self._width, first.bytes)
        self._stage = sum(tile.bytes for tile in self._tiles)

    @property
    def shared(self) -> int:
        """Bytes of shared memory of a block."""
        return STAGES * self._stage

    def grid(self, rows: int, columns: int, batch: int, parts: int) -> tuple[int, int, int]:
        """Blocks for M, N, B, G."""
        if self.kind == "outer":
            return -(-rows // self._height), -(-columns // self._width), parts
        return -(-rows // self._height) * batch * (CHUNK // self._width), 1, 1

    @cached_property
    def text(self) -> str:
        """For compute capability 8.0 or later."""
        self._write()
        types = ["u64"] * ADDRESSES + ["u32"] * NUMBERS
        parameters = [f".param .{kind} p{i}" for i, kind in enumerate(types)]
        return "\n".join(
            [
                ".version 7.1\n.target sm_80\n.address_size 64",
                ".extern .shared .align 16 .b8 shared[];",
                f".visible .entry {self.entry}({', '.join(parameters)})",
                f".maxntid {THREADS}, 1, 1\n.minnctapersm {BLOCKS}\n{{",
                *[f".reg {_TYPES[kind]} %{kind}<{count}>;" for kind, count in self._counts.items()],
                *self._lines,
                "ret;\n}\n",
            ]
        )

    def _emit(self, line: str) -> None:
        self._lines.append(f"{line};")

    def _new(self, kind: str = "r") -> str:
        number = self._counts[kind]
        self._counts[kind] = number + 1
        return f"%{kind}{number}"

    def _make(self, operation: str, *operands: object, kind: str = "r") -> str:
        """A new register with what the operation gives."""
        register = self._new(kind)
        self._emit(f"{operation} {', '.join(map(str, (register, *operands)))}")
        return register

    def _zero(self) -> str:
        return self._make("mov.f32", "0f00000000", kind="f")

    def _write(self) -> None:
        self._thread = self._make("mov.u32", "%tid.x")
        block = [self._make("mov.u32", f"%ctaid.{axis}") for axis in "xyz"]
        self._first, self._second, self._result, self._beside = (
            self._make("cvta.to.global.u64", self._make("ld.param.u64", f"[p{i}]", kind="d"), kind="d")
            for i in range(ADDRESSES)
        )
        self._rows, self._columns, self._depth, batch, parts = (
            self._make("ld.param.u32", f"[p{i}]") for i in range(ADDRESSES, ADDRESSES + NUMBERS)
        )
        self._shared = self._make("mov.u32", "shared")
        # blocks that read the same columns run at the same time: those are still in the cache
        if self.kind == "outer":
            row, column, self._part = block
            self._split(batch, parts)
        else:
            above = self._make("div.u32", self._make("add.u32", self._rows, self._height - 1), self._height)
            row, place = self._make("rem.u32", block[0], above), self._make("div.u32", block[0], above)
            self._matrix = self._make("div.u32", place, CHUNK // self._width)
            column = self._make("rem.u32", place, CHUNK // self._width)
            self._length, self._start = self._depth, "0"
        self._row = self._make("mul.lo.u32", row, self._height)  # first ones of the block's
        self._column = self._make("mul.lo.u32", column, self._width)
        self._multiply(self._copies())

    def _split(self, batch: str, parts: str) -> None:
        """Which columns of which matrices a part sums up: as many steps as the others, or one less."""
        steps = self._make("mul.lo.u32", batch, CHUNK // DEPTH)
        ends = [self._make("mul.lo.u32", steps, self._part)]
        ends.append(self._make("add.u32", ends[0], steps))
        begin, end = (self._make("div.u32", place, parts) for place in ends)
        self._length = self._make("mul.lo.u32", self._make("sub.u32", end, begin), DEPTH)
        self._matrix = self._make("div.u32", begin, CHUNK // DEPTH)
        self._within = self._make("rem.u32", begin, CHUNK // DEPTH)  # steps from the matrix's first column
        self._start = self._make("mul.lo.u32", self._within, DEPTH)

    def _copies(self) -> list[_Copy]:
        copies = []
        for number, tile in enumerate(self._tiles):
            across = (DEPTH if tile.along_k else tile.size) // COPIED
            for j in range(tile.size * DEPTH // COPIED // THREADS):
                index = self._make("add.u32", self._thread, j * THREADS)
                line, place = self._make("div.u32", index, across), self._make("rem.u32", index, across)
                place = self._make("mul.lo.u32", place, COPIED)
                i, k = (line, place) if tile.along_k else (place, line)
                target = self._make("mad.lo.u32", line, tile.pitch, place)
                target = self._make("mad.lo.u32", target, BYTES, self._shared)
                target = self._make("add.u32", target, tile.start)
                i = self._make("add.u32", i, self._column if number else self._row)
                end = self._make("mov.u32", self._length)
                if number == 0 or tile.along_k:
                    is_inside = self._make("setp.lt.u32", i, self._columns if number else self._rows, kind="p")
                    end = self._make("selp.u32", self._length, 0, is_inside)
                copies.append(_Copy(number, self._source(number, i, k), target, k, end))
        return copies

    def _source(self, number: int, i: str, k: str) -> str:
        """Address of an entry of a factor."""
        base = self._second if number else self._first
        if self.kind == "outer":
            height = self._columns if number else self._rows
            line = self._make("mad.lo.u32", self._matrix, height, i)
            place = self._make("mad.lo.u32", line, CHUNK, self._make("add.u32", k, self._start))
        elif number:
            line = self._make("mad.lo.u32", self._matrix, self._depth, k)
            place = self._make("mad.lo.u32", line, CHUNK, i)
        elif self.kind == "hidden":
            place = self._make("mad.lo.u32", i, self._depth, k)
        else:
            place = self._make("mad.lo.u32", k, self._rows, i)
        return self._make("mad.wide.u32", place, BYTES, base, kind="d")

    def _strides(self) -> list[str]:
        """Bytes from a step's entries of each factor to the next's."""
        beside, below = str(DEPTH * BYTES), str(DEPTH * CHUNK * BYTES)
        if self.kind == "hidden":
            return [beside, below]
        if self.kind == "back":
            return [self._make("mul.wide.u32", self._rows, DEPTH * BYTES, kind="d"), below]
        self._jumps = [  # at the end of a matrix to the next
            self._make(
                "sub.u64",
                self._make("mul.wide.u32", height, CHUNK * BYTES, kind="d"),
                (CHUNK - DEPTH) * BYTES,
                kind="d",
            )
            for height in (self._rows, self._columns)
        ]
        return [beside, beside]

    def _multiply(self, copies: list[_Copy]) -> None:
        tall, wide = WARP_ROWS // 16, WARP_COLUMNS // 8
        strides, stage_filled = self._strides(), self._make("mov.u32", 0)
        stage_read, step = self._make("mov.u32", 0), self._make("mov.u32", 0)
        lane, warp = self._make("and.b32", self._thread, 31), self._make("shr.u32", self._thread, 5)
        group, self._pair = self._make("shr.u32", lane, 2), self._make("and.b32", lane, 3)
        across = self._width // WARP_COLUMNS
        self._warp = [
            self._make("mul.lo.u32", self._make("div.u32", warp, across), WARP_ROWS),
            self._make("mul.lo.u32", self._make("rem.u32", warp, across), WARP_COLUMNS),
        ]
        self._read = [self._make("add.u32", start, group) for start in self._warp]
        starts = [self._fragment_start(number, lane) for number in (0, 1)]
        inner = [[[self._new("f") for _ in range(4)] for _ in range(wide)] for _ in range(tall)]
        total = [[[self._zero() for _ in four] for four in sums] for sums in inner]
        steps = self._make("div.u32", self._make("add.u32", self._length, DEPTH - 1), DEPTH)
        for _ in range(STAGES - 1):
            self._copy(copies, strides, stage_filled)
        self._lines.append("NEXT:")
        self._emit(f"cp.async.wait_group {STAGES - 2}")
        self._emit("bar.sync 0")
        self._copy(copies, strides, stage_filled)
        read = [self._make("add.u32", start, stage_read) for start in starts]
        for k in range(0, DEPTH, 8):
            self._multiply_eight(read, k, inner)
        for sums, sums_of_step in zip(total, inner, strict=True):
            for four, four_of_step in zip(sums, sums_of_step, strict=True):
                for one, other in zip(four, four_of_step, strict=True):
                    self._emit(f"add.rn.f32 {one}, {one}, {other}")
        self._turn(stage_read)
        self._emit(f"add.u32 {step}, {step}, 1")
        again = self._make("setp.lt.u32", step, steps, kind="p")
        self._lines.append(f"@{again} bra NEXT;")
        self._emit("cp.async.wait_all")
        self._store(total)

    def _copy(self, copies: list[_Copy], strides: list[str], stage_filled: str) -> None:
        """Ask for the next step's tiles, zeros beyond the factors."""
        if self.kind == "outer":
            self._emit(f"add.u32 {self._within}, {self._within}, 1")
            is_last = self._make("setp.eq.u32", self._within, CHUNK // DEPTH, kind="p")
            strides = [
                self._make("selp.b64", jump, beside, is_last, kind="d")
                for jump, beside in zip(self._jumps, strides, strict=True)
            ]
            self._emit(f"selp.u32 {self._within}, 0, {self._within}, {is_last}")
        for one in copies:
            is_there = self._make("setp.lt.u32", one.depth, one.end, kind="p")
            size = self._make("selp.u32", COPIED * BYTES, 0, is_there)
            target = self._make("add.u32", one.target, stage_filled)
            self._emit(f"cp.async.cg.shared.global [{target}], [{one.source}], {COPIED * BYTES}, {size}")
            self._emit(f"add.u64 {one.source}, {one.source}, {strides[one.tile]}")
            self._emit(f"add.u32 {one.depth}, {one.depth}, {DEPTH}")
        self._emit("cp.async.commit_group")
        self._turn(stage_filled)

    def _turn(self, stage: str) -> None:
        """To the next stage, and from the last to the first."""
        self._emit(f"add.u32 {stage}, {stage}, {self._stage}")
        is_last = self._make("setp.eq.u32", stage, self.shared, kind="p")
        self._emit(f"selp.u32 {stage}, 0, {stage}, {is_last}")

    def _fragment_start(self, number: int, lane: str) -> str:
        """Address in the first stage from where a thread reads: of ldmatrix along the sum, of its own entry across."""
        tile = self._tiles[number]
        if tile.along_k:  # lane l says where row l % 8 of 8 x 4 matrix l / 8 is
            bits = [self._make("bfe.u32", lane, bit, 1) for bit in (3, 4)]
            lower, right = bits if number == 0 else bits[::-1]
            line = self._make("mad.lo.u32", lower, 8, self._make("and.b32", lane, 7))
            line = self._make("add.u32", line, self._warp[number])
            place = self._make("mad.lo.u32", line, tile.pitch, self._make("mul.lo.u32", right, 4))
        else:
            place = self._make("mad.lo.u32", self._pair, tile.pitch, self._read[number])
        return self._make("add.u32", self._make("mad.lo.u32", place, BYTES, self._shared), tile.start)

    def _multiply_eight(self, read: list[str], k: int, sums: list[list[list[str]]]) -> None:
        """Add the products of eight columns and rows, from k on, to the sums, which begin at k = 0."""
        tall, wide = WARP_ROWS // 16, WARP_COLUMNS // 8
        firsts = [self._fragment(0, read[0], 16 * i, k, ((0, 0), (8, 0), (0, 4), (8, 4))) for i in range(tall)]
        pairs = [self._fragment(1, read[1], 8 * j, k, ((0, 0), (0, 4), (8, 0), (8, 4))) for j in range(0, wide, 2)]
        seconds = [half for four in pairs for half in (four[:2], four[2:])]
        split = [[self._halves(number) for number in numbers] for numbers in firsts]
        for j, numbers in enumerate(seconds):
            high, low = zip(*[self._halves(number) for number in numbers], strict=True)
            for which, other in ((1, high), (0, low), (0, high)):
                for i in range(tall):
                    begins = k == 0 and which == 1
                    self._mma(sums[i][j], [halves[which] for halves in split[i]], other, begins)

    def _fragment(self, number: int, start: str, i: int, k: int, corners: Sequence[tuple[int, int]]) -> list[str]:
        """Four numbers of a factor's tile, from entry i, k on, each of 8 x 4 from its corner."""
        tile, numbers = self._tiles[number], [self._new() for _ in range(4)]
        if tile.along_k:
            four = f"{{{', '.join(numbers)}}}, [{start}+{tile.at(i, k)}]"
            self._emit(f"ldmatrix.sync.aligned.m8n8.x4.shared.b16 {four}")
        else:
            for register, (down, along) in zip(numbers, corners, strict=True):
                self._emit(f"ld.shared.b32 {register}, [{start}+{tile.at(i + down, k + along)}]")
        return numbers

    def _halves(self, number: str) -> tuple[str, str]:
        """(what TF32 keeps of a number, rounded, and of the rest, cut off)."""
        high = self._make("and.b32", self._make("add.u32", number, ROUND), KEPT)
        return high, self._make("and.b32", self._make("sub.f32", number, high), KEPT)

    def _mma(self, sums: list[str], first: list[str], second: tuple[str, ...], begins: bool) -> None:
        before = ["0f00000000"] * 4 if begins else sums
        parts = ", ".join(f"{{{', '.join(part)}}}" for part in (sums, first, second, before))
        self._emit(f"mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 {parts}")

    def _store(self, total: list[list[list[str]]]) -> None:
        """The block's tile of the result."""
        row = self._make("add.u32", self._row, self._read[0])
        column = self._make("mad.lo.u32", self._pair, 2, self._make("add.u32", self._column, self._warp[1]))
        height, width = (self._rows, self._columns) if self.kind == "outer" else (self._rows, str(CHUNK))
        above = self._make("mul.lo.u32", self._part if self.kind == "outer" else self._matrix, height)
        for i, sums in enumerate(total):
            for half in (0, 1):
                line = self._make("add.u32", row, 16 * i + 8 * half)
                is_row = self._make("setp.lt.u32", line, height, kind="p")
                place = self._make("mad.lo.u32", self._make("add.u32", above, line), width, column)
                target = self._make("mad.wide.u32", place, BYTES, self._result, kind="d")
                bias = self._bias(line, is_row)
                beside = self._make("mad.wide.u32", place, BYTES, self._beside, kind="d") if self.masked else ""
                for j, four in enumerate(sums):
                    two, active, offset = four[2 * half : 2 * half + 2], is_row, 8 * j * BYTES
                    if bias:
                        for value in two:
                            self._emit(f"add.f32 {value}, {value}, {bias}")
                            self._emit(f"max.NaN.f32 {value}, {value}, 0f00000000")
                    if beside:
                        self._mask(two, f"[{beside}+{offset}]", is_row)
                    if self.kind == "outer":
                        active = self._make(
                            "setp.lt.and.u32", self._make("add.u32", column, 8 * j), width, is_row, kind="p"
                        )
                    self._lines.append(f"@{active} st.global.v2.f32 [{target}+{offset}], {{{', '.join(two)}}};")

    def _bias(self, line: str, is_row: str) -> str:
        """Register of the row's, of a hidden layer."""
        if self.kind != "hidden":
            return ""
        source = self._make("mad.wide.u32", line, BYTES, self._beside, kind="d")
        bias = self._zero()
        self._lines.append(f"@{is_row} ld.global.nc.f32 {bias}, [{source}];")
        return bias

    def _mask(self, two: list[str], source: str, is_row: str) -> None:
        """0 where what is beside is not above 0."""
        beside = [self._zero() for _ in two]
        self._lines.append(f"@{is_row} ld.global.nc.v2.f32 {{{', '.join(beside)}}}, {source};")
        for value, other in zip(two, beside, strict=True):
            is_on = self._make("setp.gt.f32", other, "0f00000000", kind="p")
            self._emit(f"selp.f32 {value}, {value}, 0f00000000, {is_on}")
