"""Whole networks as text for LLVM: a thread takes columns through all layers, which stay in its core's cache.

Columns are gone through in panels of 64. What hidden layers say of a panel stands together in memory, row by row, each
64 numbers: rows of a chunk of 512 columns are 2 KB apart, and a cache has room for few lines so far apart.
"""

from collections.abc import Callable, Sequence
from functools import partial

from spacesim.backend.kernels.llvm_text import LANES, Text, Value
from spacesim.learning.networks.network import CHUNK, MlpShape

PANEL = 64  #: columns that go through all layers together
PER_CHUNK = CHUNK // PANEL
BLOCK, SMALL_BLOCK = (4, 4), (6, 1)  #: rows and vectors that registers sum up at once, of 16 and of fewer numbers

Entry = Callable[[Value, Value], Value]
"""A matrix's number by row and column."""


def full(rows: int) -> int:
    """Rows of a panel in memory, so that it can be turned on its side by vectors."""
    return -(-rows // LANES) * LANES


class FusedText:
    """Functions of a network's kernels, for a CPU whose registers hold `width` numbers.

    wanted: rows of the items of which gradients are wanted

    Arrays: `items` [B, rows, m], `output` [B, outputs, m] and `known` [B, width, m] in chunks; `matrix0`, ... and
    `bias0`, ... of the layers, the first as `network.InputLayer` has it; `hidden0`, ... by panels; of the way back
    `by_output`, `by_items` as what they are gradients of, `parts` [tasks, `part`], `by_matrix0`, ..., `by_bias0`, ...,
    `by_shared`, and `shared`.
    """

    def __init__(self, shape: MlpShape, wanted: int, width: int) -> None:
        self.shape, self.wanted = shape, wanted
        self._rows, self._vectors = BLOCK if width >= LANES else SMALL_BLOCK
        stored = [full(shape.rows), *[full(shape.width)] * (shape.layers - 1)]
        #: of each layer: rows, and columns of its gradient's parts
        self._sizes = [(rows, columns) for (rows, _), columns in zip(shape.sizes, stored, strict=True)]
        self._starts = [sum(rows * (columns + LANES) for rows, columns in self._sizes[:i]) for i in range(shape.layers)]
        rows, columns = self._sizes[-1]
        #: numbers of a part: of each layer the gradient of its matrix, then that of its bias in vectors to be added up
        self.part = self._starts[-1] + rows * (columns + LANES)

    def forward(self, text: Text) -> None:
        """A panel: what all layers say of it."""
        hidden = text.index * (full(self.shape.width) * PANEL)
        self._forward(text, self.shape.rows, [(f"hidden{i}", hidden) for i in range(self.shape.layers - 1)])

    def outputs(self, rows: int, is_known: bool, text: Text) -> None:
        """A panel of items of so many rows: what the last layer says of it. is_known: a part of the first layer is, in
        the array `known`"""
        for name in ("hidden0", "hidden1"):
            text.room(name, self.shape.width * PANEL)
        hidden = [(f"hidden{i % 2}", text.integer(0)) for i in range(self.shape.layers - 1)]
        self._forward(text, rows, hidden, is_known)

    def _forward(self, text: Text, rows: int, hidden: list[tuple[str, Value]], is_known: bool = False) -> None:
        """rows: of the items;  hidden: arrays and places of what hidden layers say;  is_known: as in `outputs`"""
        chunk, within = text.index // text.integer(PER_CHUNK), text.index % text.integer(PER_CHUNK) * PANEL
        text.room("panel", rows * PANEL)
        self._take(text, "panel", "items", rows, chunk, within)
        source, columns = ("panel", text.integer(0)), rows
        for i in range(self.shape.layers - 1):
            known = chunk * (self.shape.width * CHUNK) + within if is_known and i == 0 else None
            self._layer(text, i, columns, source, (*hidden[i], PANEL), known)
            source, columns = hidden[i], self.shape.width
        last, start = self.shape.layers - 1, chunk * (self.shape.outputs * CHUNK) + within
        self._layer(text, last, columns, source, ("output", start, CHUNK), start if is_known and last == 0 else None)

    def _layer(
        self,
        text: Text,
        i: int,
        columns: int,
        source: tuple[str, Value],
        to: tuple[str, Value, int],
        known: Value | None,
    ) -> None:
        """What layer i says of a panel. source: array and place of what it reads;  to: those of what it says, and the
        stride of its rows;  known: place of what it says of other inputs, if it does"""
        (target, start, stride), nothing = to, text.zeros(LANES)

        def begin(row: Value, vector: int) -> Value:
            bias = text.spread(text.load_floats(f"bias{i}", row), LANES)
            if known is None:
                return bias
            return bias + text.load_floats("known", known + row * CHUNK + vector * LANES, LANES)

        def end(row: Value, vector: int, value: Value) -> None:
            said = value if target == "output" else (value < nothing).choose(nothing, value)  # NaN stays
            text.store(target, start + row * stride + vector * LANES, said)

        size, left = (self.shape.sizes[i][0], columns), self._matrix(text, f"matrix{i}", columns)
        self._product(text, size, left, _panel(text, *source), begin, end)

    def backward(self, text: Text) -> None:
        """Chunks, one behind the other, each `tasks` further: gradients of their items, and a part of the sums."""
        shape, base = self.shape, text.index * self.part
        tallest = max(shape.width, shape.outputs)
        text.room("panel", full(shape.rows) * PANEL)
        text.room("turned", max(full(shape.width), full(shape.rows)) * PANEL)
        for name in ("gradient0", "gradient1"):
            text.room(name, tallest * PANEL)
        _fill_zeros(text, "parts", base, base + self.part)
        _fill_zeros(text, "panel", text.integer(shape.rows * PANEL), text.integer(full(shape.rows) * PANEL))
        with (
            text.loop(text.index, text.number("chunks"), step=text.number("tasks")) as chunks,
            text.loop(text.integer(0), text.integer(PER_CHUNK)) as panels,
        ):
            chunk, within = chunks.at, panels.at * PANEL
            self._take(text, "panel", "items", shape.rows, chunk, within)
            self._take(text, "gradient0", "by_output", shape.outputs, chunk, within)
            gradient, other = "gradient0", "gradient1"
            for i in reversed(range(shape.layers)):
                values, first = "panel", text.integer(0)
                if i > 0:
                    values = f"hidden{i - 1}"
                    first = (chunk * PER_CHUNK + panels.at) * (full(shape.width) * PANEL)
                self._add_to_part(text, i, gradient, (values, first), base)
                if i > 0:
                    self._through(text, i, gradient, other, (values, first))
                else:
                    self._to_items(text, gradient, chunk * (self.wanted * CHUNK) + within)
                gradient, other = other, gradient

    def sums(self) -> list[tuple[str, Callable[[Text], None]]]:
        """Stages of a kernel, one for each layer, a call for each of its rows: parts to gradients."""
        return [(f"sum{i}", partial(self._sum, i)) for i in range(self.shape.layers)]

    def _add_to_part(self, text: Text, i: int, gradient: str, values: tuple[str, Value], base: Value) -> None:
        """The gradient of layer i, of that of what it says of a panel and its inputs."""
        (rows, columns), start = self._sizes[i], base + self._starts[i]
        source, first = values
        with (
            text.loop(text.integer(0), text.integer(columns), step=LANES) as row,
            text.loop(text.integer(0), text.integer(PANEL), step=LANES) as column,
        ):
            places = [first + (row.at + k) * PANEL + column.at for k in range(LANES)]
            turned = text.transposed([text.load_floats(source, place, LANES) for place in places])
            for k, value in enumerate(turned):
                text.store("turned", (column.at + k) * columns + row.at, value)

        def place(row: Value, vector: int) -> Value:
            return start + row * columns + vector * LANES

        def begin(row: Value, vector: int) -> Value:
            return text.load_floats("parts", place(row, vector), LANES)

        def end(row: Value, vector: int, value: Value) -> None:
            text.store("parts", place(row, vector), value)

        left = self._matrix(text, gradient, PANEL)
        self._product(text, (rows, PANEL), left, _panel(text, "turned", text.integer(0), columns), begin, end, columns)
        with text.loop(text.integer(0), text.integer(rows)) as loop:
            of_row = [text.load_floats(gradient, loop.at * PANEL + k, LANES) for k in range(0, PANEL, LANES)]
            at = start + rows * columns + loop.at * LANES
            text.store("parts", at, sum(of_row[1:], of_row[0]) + text.load_floats("parts", at, LANES))

    def _through(self, text: Text, i: int, gradient: str, target: str, values: tuple[str, Value]) -> None:
        """From the gradient of what layer i says to that of what the layer before says, before its ReLU."""
        rows, columns = self.shape.sizes[i]
        source, first = values

        def end(row: Value, vector: int, value: Value) -> None:
            said = text.load_floats(source, first + row * PANEL + vector * LANES, LANES)
            text.store(target, row * PANEL + vector * LANES, _positive(text, said, value))

        self._back(text, i, (columns, rows), columns, gradient, end)

    def _to_items(self, text: Text, gradient: str, start: Value) -> None:
        """From the gradient of what the first layer says to that of the items. start: of the panel's first row"""

        def end(row: Value, vector: int, value: Value) -> None:
            text.store("by_items", start + row * CHUNK + vector * LANES, value)

        self._back(text, 0, (self.wanted, self.shape.sizes[0][0]), self.shape.rows, gradient, end)

    def _back(
        self,
        text: Text,
        i: int,
        size: tuple[int, int],
        stride: int,
        gradient: str,
        end: Callable[[Value, int, Value], None],
    ) -> None:
        """Product of the matrix of layer i on its side with a gradient. size: of it on its side;  stride: its rows'"""

        def left(row: Value, k: Value) -> Value:
            return text.load_floats(f"matrix{i}", k * stride + row)

        self._product(text, size, left, _panel(text, gradient, text.integer(0)), lambda *_: text.zeros(LANES), end)

    def _sum(self, i: int, text: Text) -> None:
        """A row of the gradients of layer i."""
        (rows, columns), row, tasks = self._sizes[i], text.index, text.number("tasks")

        def total(start: Value) -> Value:
            with text.loop(text.integer(0), tasks, [text.zeros(LANES)]) as loop:
                loop.following = [loop.state[0] + text.load_floats("parts", loop.at * self.part + start, LANES)]
            return loop.state[0]

        given = self.shape.sizes[i][1]
        with text.loop(text.integer(0), text.integer(given), step=LANES) as vectors:
            value = total(row * columns + vectors.at + self._starts[i])
            lanes = text.lanes(LANES, vectors.at, text.integer(given))
            text.store_lanes(f"by_matrix{i}", row * given + vectors.at, value, lanes)
        by_bias = text.sum(total(row * LANES + (self._starts[i] + rows * columns)))
        text.store(f"by_bias{i}", row, by_bias)
        if i == 0:
            with text.loop(text.integer(0), text.integer(self.shape.shared)) as loop:
                by_weight = by_bias * text.load_floats("shared", loop.at)
                text.store("by_shared", row * self.shape.shared + loop.at, by_weight)

    def _product(
        self,
        text: Text,
        size: tuple[int, int],
        left: Entry,
        right: Callable[[Value, int], Value],
        begin: Callable[[Value, int], Value],
        end: Callable[[Value, int, Value], None],
        columns: int = PANEL,
    ) -> None:
        """A product of matrices, by blocks of some rows and vectors.

        size: rows, and products of a sum;  left: a number by row and column;  right: a vector by row and its place;
        begin, end: of a row and a vector's place, what it starts with, and what becomes of the sum
        """
        rows, depth = size

        def block(row: Value, count: int, vectors: Sequence[int]) -> None:
            places = [(row + k, vector) for k in range(count) for vector in vectors]
            with text.loop(text.integer(0), text.integer(depth), [begin(*at) for at in places]) as loop:
                beside = [right(loop.at, vector) for vector in vectors]
                factors = [text.spread(left(row + k, loop.at), LANES) for k in range(count)]
                pairs = [(factor, value) for factor in factors for value in beside]
                loop.following = [text.fma(*pair, total) for pair, total in zip(pairs, loop.state, strict=True)]
            for at, total in zip(places, loop.state, strict=True):
                end(*at, total)

        across, whole = columns // LANES, rows // self._rows * self._rows
        for first in range(0, across, self._vectors):
            vectors = range(first, min(first + self._vectors, across))
            if whole:
                with text.loop(text.integer(0), text.integer(whole), step=self._rows) as loop:
                    block(loop.at, self._rows, vectors)
            if rows > whole:
                block(text.integer(whole), rows - whole, vectors)

    @staticmethod
    def _take(text: Text, room: str, array: str, rows: int, chunk: Value, within: Value) -> None:
        """A panel of an array in chunks to a room."""
        with text.loop(text.integer(0), text.integer(rows)) as loop:
            place = (chunk * rows + loop.at) * CHUNK + within
            for vector in range(0, PANEL, LANES):
                value = text.load_floats(array, place + vector, LANES)
                text.store(room, loop.at * PANEL + vector, value)

    @staticmethod
    def _matrix(text: Text, array: str, columns: int) -> Entry:
        return lambda row, column: text.load_floats(array, row * columns + column)


def _panel(text: Text, array: str, first: Value, columns: int = PANEL) -> Callable[[Value, int], Value]:
    """Vectors of a matrix in memory from `first` on, by row and place."""
    return lambda row, vector: text.load_floats(array, first + row * columns + vector * LANES, LANES)


def _positive(text: Text, said: Value, value: Value) -> Value:
    """A value where what was said is above 0, else 0."""
    return (text.zeros(LANES) < said).choose(value, text.zeros(LANES))


def _fill_zeros(text: Text, array: str, start: Value, end: Value) -> None:
    with text.loop(start, end, step=LANES) as loop:
        text.store(array, loop.at, text.zeros(LANES))
