"""The `photometric_loss` and its gradient on a CPU, as text for LLVM.

A task takes strips of rows one after another: what it makes of them, moments under the window and SSIM's derivatives by
these, stays in its core's cache. Dr.Jit's kernels write all of that to memory, and turn it around.
"""

from collections.abc import Sequence
from functools import cache

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Float
from spacesim.backend.kernels.llvm import LlvmKernel, empty
from spacesim.backend.kernels.llvm_text import Text, Value, float_bits
from spacesim.splat.train.loss.window import C1, C2, RADIUS, WINDOW

LANES = 16  #: pixels of a vector
ROWS = 32  #: of a strip
_FAR, _NEAR = ROWS + 4 * RADIUS, ROWS + 2 * RADIUS  # rows whose moments, whose derivatives a strip needs
# Rows of a task's room, one behind the other: of the pictures and their products; of the moments, blurred along rows,
# later the derivatives, blurred along columns; of the derivatives.
_MOMENTS, _DERIVATIVES = 4, 3  # x, y, x^2 + y^2, x y; by the means of x, of x^2 and of x y
_BLURRED = _MOMENTS
_PARTIALS = _BLURRED + _MOMENTS * _FAR
_ROOM = _PARTIALS + _DERIVATIVES * _NEAR
_PLANES = [[f"{name}{channel}" for channel in range(3)] for name in ("x", "y", "gradient")]
_NUMBERS = "width", "height", "vectors", "strips", "tasks", "l1", "ssim"


def loss_and_gradient(
    prediction: Array3f, target: Array3f, width: int, height: int, ssim_weight: float
) -> tuple[Float, Array3f]:
    """`photometric_loss`, in parts to be added up, and its gradient by `prediction`."""
    vectors, strips = -(-width // LANES), -(-height // ROWS)
    tasks = min(dr.thread_count(), 3 * strips)
    gradient = [empty(ad.Float, width * height) for _ in range(3)]
    sums, room = empty(ad.Float, 3 * strips), empty(ad.Float, tasks * _ROOM * LANES * (vectors + 2))
    shares = [float_bits(share / (3 * width * height)) for share in (1 - ssim_weight, ssim_weight)]
    _kernel()(
        [tasks],
        [*prediction, *target, *gradient, sums, room],
        [width, height, vectors, strips, tasks, *shares],
    )
    return sums, ad.Array3f(gradient)


@cache
def _kernel() -> LlvmKernel:
    arrays = [name for names in _PLANES for name in names]
    return LlvmKernel([*arrays, "sums", "room"], _NUMBERS, ("strips", _write))


def _write(text: Text) -> None:
    zero, vectors, strips = text.integer(0), text.number("vectors"), text.number("strips")
    stride = (vectors + 2) * LANES  # of a row: to either side of a picture there is nothing
    room = text.index * stride * _ROOM
    with text.loop(room, room + stride * _ROOM, step=LANES) as loop:
        text.store("room", loop.at, text.zeros(LANES))
    with text.loop(text.index, strips * 3, step=text.number("tasks")) as turn:
        for names in _PLANES:
            text.first_of(names, turn.at // strips, names[0][:-1])
        strip = _Strip(text, room + LANES, stride, (turn.at % strips) * ROWS)
        with text.loop(zero, text.integer(_FAR)) as rows:
            strip.blur_pictures(rows.at)
        with text.loop(zero, vectors, [text.zeros(LANES)]) as columns:
            with text.loop(zero, text.integer(_NEAR), columns.state) as rows:
                rows.following = [strip.compare(columns.at, rows.at, rows.state[0])]
            columns.following = rows.state
            with text.loop(zero, text.integer(ROWS)) as rows:
                strip.blur_derivatives(columns.at, rows.at)
        with text.loop(zero, text.integer(ROWS), [text.zeros(LANES)]) as rows:
            with text.loop(zero, vectors, rows.state) as along:
                along.following = [strip.write_gradient(along.at, rows.at, along.state[0])]
            rows.following = along.state
        dissimilarity = text.sum(columns.state[0]) * text.float_number("ssim")
        text.store("sums", turn.at, text.fma(text.sum(rows.state[0]), text.float_number("l1"), dissimilarity))


class _Strip:
    """One strip; columns are numbered by vectors.

    first: of a row of the room, the picture's first number;  stride: of rows;  top: first row in the picture
    """

    def __init__(self, text: Text, first: Value, stride: Value, top: Value) -> None:
        self.text, self.first, self.stride, self.top = text, first, stride, top

    def blur_pictures(self, row: Value) -> None:
        """Moments blurred along a row, the first 2 RADIUS above the strip."""
        text, zero, vectors = self.text, self.text.integer(0), self.text.number("vectors")
        with text.loop(zero, vectors) as columns:
            _, x, y = self._pixels(columns.at, row - 2 * RADIUS)
            for i, value in enumerate((x, y, text.fma(x, x, y * y), x * y)):
                text.store("room", self._place(text.integer(i), columns.at), value)
        with text.loop(zero, vectors) as columns:
            for i in range(_MOMENTS):
                blurred = self._blurred_along(text.integer(i), columns.at)
                text.store("room", self._place(row + (_BLURRED + i * _FAR), columns.at), blurred)

    def compare(self, column: Value, row: Value, total: Value) -> Value:
        """SSIM's derivatives, the first RADIUS above the strip; 1 - SSIM of the strip's added to `total`."""
        text = self.text
        means = [self._blurred_down(row + (_BLURRED + i * _FAR), column) for i in range(_MOMENTS)]
        value, *derivatives = _similarity(text, means)
        inside, nothing = self._inside(column, row - RADIUS), text.zeros(LANES)
        for i, derivative in enumerate(derivatives):
            place = self._place(row + (_PARTIALS + i * _NEAR), column)
            text.store("room", place, inside.choose(derivative, nothing))
        dissimilarity = inside.choose(text.floats(LANES, 1) - value, nothing)
        return total + ((row - RADIUS) < text.integer(ROWS)).choose(dissimilarity, nothing)

    def blur_derivatives(self, column: Value, row: Value) -> None:
        """Along columns, of a row of the strip; in the place of this column's moments."""
        for i in range(_DERIVATIVES):
            blurred = self._blurred_down(row + (_PARTIALS + i * _NEAR), column)
            self.text.store("room", self._place(row + (_BLURRED + i * _FAR), column), blurred)

    def write_gradient(self, column: Value, row: Value, total: Value) -> Value:
        """Of a row of the strip; |x - y| added to `total`."""
        text = self.text
        inside, x, y = self._pixels(column, row)
        by_mean, by_square, by_product = (
            self._blurred_along(row + (_BLURRED + i * _FAR), column) for i in range(_DERIVATIVES)
        )
        by_ssim = text.fma(y, by_product, text.fma(x + x, by_square, by_mean))
        difference = x - y
        sign = (difference < text.zeros(LANES)).choose(text.floats(LANES, -1), text.floats(LANES, 1))  # as Dr.Jit's
        l1, ssim = (text.spread(text.float_number(name), LANES) for name in ("l1", "ssim"))
        text.store_lanes("gradient", self._pixel(column, row), l1 * sign - ssim * by_ssim, inside)
        return text.fma(difference, sign, total)

    def _pixels(self, column: Value, row: Value) -> tuple[Value, Value, Value]:
        """(which are in the picture, prediction, target) of a row by its number from the strip's first."""
        inside, pixel = self._inside(column, row), self._pixel(column, row)
        x, y = (self.text.load_lanes(name, pixel, inside) for name in ("x", "y"))
        return inside, x, y

    def _pixel(self, column: Value, row: Value) -> Value:
        return (self.top + row) * self.text.number("width") + column * LANES

    def _inside(self, column: Value, row: Value) -> Value:
        """Which pixels of a vector are in the picture."""
        of_picture = (self.top + row) < self.text.number("height")
        end = of_picture.choose(self.text.number("width"), self.text.integer(0))
        return self.text.lanes(LANES, column * LANES, end)

    def _place(self, row: Value, column: Value) -> Value:
        """Of a row of the room."""
        return self.first + row * self.stride + column * LANES

    def _blurred_along(self, row: Value, column: Value) -> Value:
        """Of the room."""
        place = self._place(row, column)
        return self._blurred([place + k if k >= 0 else place - -k for k in range(-RADIUS, RADIUS + 1)])

    def _blurred_down(self, row: Value, column: Value) -> Value:
        """Of the room's rows, 2 RADIUS + 1 from `row` on."""
        return self._blurred([self._place(row + k, column) for k in range(2 * RADIUS + 1)])

    def _blurred(self, places: Sequence[Value]) -> Value:
        """As in `photometric`."""
        values = [self.text.load_floats("room", place, LANES) for place in places]
        weights = [self.text.floats(LANES, weight) for weight in WINDOW]
        total = values[RADIUS] * weights[RADIUS]
        for k in range(1, RADIUS + 1):
            total = self.text.fma(values[RADIUS - k] + values[RADIUS + k], weights[RADIUS + k], total)
        return total


def _similarity(text: Text, means: Sequence[Value]) -> tuple[Value, Value, Value, Value]:
    """As in `photometric`."""
    (mx, my, squares, product), one = means, text.floats(LANES, 1)
    c1, c2 = text.floats(LANES, C1), text.floats(LANES, C2)
    mxy, mm = mx * my, text.fma(mx, mx, my * my)
    rest = product - mxy
    a1, a2 = mxy + mxy + c1, rest + rest + c2
    r1, r2 = one / (mm + c1), one / (squares - mm + c2)
    inverse = r1 * r2
    value = a1 * a2 * inverse
    grad_mean = (my + my) * (a2 - a1) * inverse + (mx + mx) * value * (r2 - r1)
    return value, grad_mean, text.zeros(LANES) - value * r2, (a1 + a1) * inverse
