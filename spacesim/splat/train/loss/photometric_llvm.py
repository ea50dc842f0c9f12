"""The `photometric_loss` and its gradient on a CPU, as text for LLVM.

A task takes blocks of 32 rows and 256 columns one after another: what it makes of them, moments under the window and
SSIM's derivatives by these, stays in its core's cache. Dr.Jit's kernels write all of that to memory, and turn it
around.
"""

from collections.abc import Sequence
from functools import cache

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Float
from spacesim.backend.kernels.llvm import LlvmKernel, empty
from spacesim.backend.kernels.llvm_text import LANES, Text, Value, float_bits
from spacesim.splat.train.loss.window import RADIUS, blurred, similarity

ROWS, COLUMNS = 32, 16  #: of a block; columns are vectors
_MOMENT_ROWS, _DERIVATIVE_ROWS = ROWS + 4 * RADIUS, ROWS + 2 * RADIUS  # that a block needs
# Rows of a task's room, one behind the other: of the pictures and their products; of the moments, blurred along rows,
# later the derivatives, blurred along columns; of the derivatives. To either side of a block's columns each has one
# more, whose pixels beside the block are needed, and one of nothing.
_MOMENTS, _DERIVATIVES = 4, 3  # x, y, x^2 + y^2, x y; by the means of x, of x^2 and of x y
_BLURRED = _MOMENTS
_PARTIALS = _BLURRED + _MOMENTS * _MOMENT_ROWS
_ROOM_ROWS = _PARTIALS + _DERIVATIVES * _DERIVATIVE_ROWS
_STRIDE = (COLUMNS + 4) * LANES
_ROOM = _ROOM_ROWS * _STRIDE
_PLANES = [[f"{name}{channel}" for channel in range(3)] for name in ("x", "y", "gradient")]
_NUMBERS = "width", "height", "vectors", "across", "down", "tasks", "l1", "ssim"


def loss_and_gradient(
    prediction: Array3f, target: Array3f, width: int, height: int, ssim_weight: float
) -> tuple[Float, Array3f]:
    """`photometric_loss`, in parts to be added up, and its gradient by `prediction`."""
    count, vectors = width * height, -(-width // LANES)
    across, down = -(-vectors // COLUMNS), -(-height // ROWS)
    blocks = 3 * across * down
    tasks = min(dr.thread_count(), blocks)
    gradient = [empty(ad.Float, count) for _ in range(3)]
    sums, room = empty(ad.Float, blocks), empty(ad.Float, tasks * _ROOM)
    planes = [
        plane if dr.width(plane) == count else plane + dr.zeros(ad.Float, count) for plane in (*prediction, *target)
    ]
    shares = [float_bits(share / (3 * count)) for share in (1 - ssim_weight, ssim_weight)]
    numbers = [width, height, vectors, across, down, tasks, *shares]
    _kernel()([tasks], [*planes, *gradient, sums, room], numbers)
    return sums, ad.Array3f(gradient)


@cache
def _kernel() -> LlvmKernel:
    arrays = [name for names in _PLANES for name in names]
    return LlvmKernel([*arrays, "sums", "room"], _NUMBERS, ("blocks", _write))


def _write(text: Text) -> None:
    across, blocks = text.number("across"), text.number("across") * text.number("down")
    room = text.index * _ROOM
    with text.loop(room, room + _ROOM, step=LANES) as loop:
        text.store("room", loop.at, text.zeros(LANES))
    with text.loop(text.index, blocks * 3, step=text.number("tasks")) as turn:
        for names in _PLANES:
            text.choose_array(names[0][:-1], names, turn.at // blocks)
        within = turn.at % blocks
        block = _Block(text, room, (within // across) * ROWS, (within % across) * COLUMNS)
        with text.loop(text.integer(0), text.integer(_MOMENT_ROWS)) as rows:
            block.blur_pictures(rows.at)
        with text.loop(block.around, block.around_end, [text.zeros(LANES)]) as columns:
            with text.loop(text.integer(0), text.integer(_DERIVATIVE_ROWS), columns.state) as rows:
                rows.following = [block.compare(columns.at, rows.at, rows.state[0])]
            columns.following = rows.state
            with text.loop(text.integer(0), text.integer(ROWS)) as rows:
                block.blur_derivatives(columns.at, rows.at)
        with text.loop(text.integer(0), text.integer(ROWS), [text.zeros(LANES)]) as rows:
            for i in range(_DERIVATIVES):
                block.end_row(rows.at + (_BLURRED + i * _MOMENT_ROWS))
            with text.loop(block.left, block.right, rows.state) as along:
                along.following = [block.write_gradient(along.at, rows.at, along.state[0])]
            rows.following = along.state
        dissimilarity = text.sum(columns.state[0]) * text.float_number("ssim")
        text.store("sums", turn.at, text.fma(text.sum(rows.state[0]), text.float_number("l1"), dissimilarity))


class _Block:
    """One block. Columns are numbered by vectors, as in the picture.

    room: the task's;  top, left: first row and column
    """

    def __init__(self, text: Text, room: Value, top: Value, left: Value) -> None:
        self.text, self.room, self.top, self.left = text, room, top, left
        vectors = text.number("vectors")
        self.right = (left + COLUMNS).least(vectors)  #: one past the last column
        #: the same with the columns beside the block, as far as there are any
        self.around = left - (text.integer(0) < left).choose(text.integer(1), text.integer(0))
        self.around_end = (left + COLUMNS + 1).least(vectors)

    def end_row(self, row: Value) -> None:
        """Nothing behind a row of the room."""
        self.text.store("room", self._place(row, self.around_end), self.text.zeros(LANES))

    def blur_pictures(self, row: Value) -> None:
        """Moments blurred along a row, the first 2 RADIUS above the block."""
        text = self.text
        with text.loop(self.around, self.around_end) as columns:
            _, x, y = self._pixels(columns.at, row - 2 * RADIUS)
            for i, value in enumerate((x, y, text.fma(x, x, y * y), x * y)):
                text.store("room", self._place(text.integer(i), columns.at), value)
        for i in range(_MOMENTS):
            self.end_row(text.integer(i))
        with text.loop(self.around, self.around_end) as columns:
            for i in range(_MOMENTS):
                moment = self._blurred_along(text.integer(i), columns.at)
                text.store("room", self._place(row + (_BLURRED + i * _MOMENT_ROWS), columns.at), moment)

    def compare(self, column: Value, row: Value, total: Value) -> Value:
        """SSIM's derivatives, the first RADIUS above the block; 1 - SSIM of the block's pixels added to `total`."""
        text = self.text
        means = [self._blurred_down(row + (_BLURRED + i * _MOMENT_ROWS), column) for i in range(_MOMENTS)]
        inside, nothing = self._inside(column, row - RADIUS), text.zeros(LANES)
        value, *derivatives = similarity(
            means, lambda inverse: inside.choose(inverse, nothing), text.fma, lambda x: text.floats(LANES, 1) / x
        )
        for i, derivative in enumerate(derivatives):
            text.store("room", self._place(row + (_PARTIALS + i * _DERIVATIVE_ROWS), column), derivative)
        dissimilarity = inside.choose(1 - value, nothing)
        for place, extent in ((row - RADIUS, text.integer(ROWS)), (column - self.left, text.integer(COLUMNS))):
            dissimilarity = (place < extent).choose(dissimilarity, nothing)  # what is before the block is below 0
        return total + dissimilarity

    def blur_derivatives(self, column: Value, row: Value) -> None:
        """Along columns, of a row of the block; in the place of this column's moments."""
        for i in range(_DERIVATIVES):
            derivative = self._blurred_down(row + (_PARTIALS + i * _DERIVATIVE_ROWS), column)
            self.text.store("room", self._place(row + (_BLURRED + i * _MOMENT_ROWS), column), derivative)

    def write_gradient(self, column: Value, row: Value, total: Value) -> Value:
        """Of a row of the block; |x - y| added to `total`."""
        text = self.text
        inside, x, y = self._pixels(column, row)
        by_mean, by_square, by_product = (
            self._blurred_along(row + (_BLURRED + i * _MOMENT_ROWS), column) for i in range(_DERIVATIVES)
        )
        by_ssim = text.fma(y, by_product, text.fma(2 * x, by_square, by_mean))
        difference = x - y
        sign = (difference < text.zeros(LANES)).choose(text.floats(LANES, -1), text.floats(LANES, 1))  # as Dr.Jit's
        l1, ssim = (text.spread(text.float_number(name), LANES) for name in ("l1", "ssim"))
        text.store_lanes("gradient", self._pixel(column, row), l1 * sign - ssim * by_ssim, inside)
        return text.fma(difference, sign, total)

    def _pixels(self, column: Value, row: Value) -> tuple[Value, Value, Value]:
        """(which are in the picture, prediction, target) of a row by its number from the block's first."""
        inside, pixel = self._inside(column, row), self._pixel(column, row)
        x, y = (self.text.load_lanes(name, pixel, inside) for name in ("x", "y"))
        return inside, x, y

    def _pixel(self, column: Value, row: Value) -> Value:
        return (self.top + row) * self.text.number("width") + column * LANES

    def _inside(self, column: Value, row: Value) -> Value:
        """Which pixels of a vector are in the picture."""
        lanes = self.text.lanes(LANES, column * LANES, self.text.number("width"))
        is_row = (self.top + row) < self.text.number("height")  # rows above the picture are below 0
        return is_row.choose(lanes, self.text.no_lanes(LANES))

    def _place(self, row: Value, column: Value) -> Value:
        """Of a row of the room."""
        return self.room + row * _STRIDE + (column - self.around + 1) * LANES

    def _blurred_along(self, row: Value, column: Value) -> Value:
        """Of the room."""
        place = self._place(row, column)
        return self._blurred([place + k for k in range(-RADIUS, RADIUS + 1)])

    def _blurred_down(self, row: Value, column: Value) -> Value:
        """Of the room's rows, 2 RADIUS + 1 from `row` on."""
        return self._blurred([self._place(row + k, column) for k in range(2 * RADIUS + 1)])

    def _blurred(self, places: Sequence[Value]) -> Value:
        return blurred([self.text.load_floats("room", place, LANES) for place in places], self.text.fma)
