"""Small fully connected networks over N items at once: forward, and the adjoint of that by hand.

Items are the columns of B matrices [rows, m] in memory (`PaddedBatch`): N = B m. What all items share, such as the
direction of the Sun, enters the first layer as one vector: its products are made once instead of N times.
"""

from dataclasses import dataclass
from typing import cast

import drjit as dr
import numpy as np

from spacesim.backend import ad, select
from spacesim.backend.arrays import Bool, Float, TensorXf, UInt32
from spacesim.learning.joined import Joined

MAX_FEATURES, MAX_WIDTH, MAX_LAYERS = 1024, 4096, 32
"""Of a network: numbers a Gaussian, units of a layer, layers, far above any that pays."""
WARP = 32  #: threads that sum up together on CUDA, of which columns are a multiple
GROUPS = 8  #: of matrices that are summed up at the same time, on CUDA
FEW = 4  #: rows of a matrix at which products by tiles are slow, on CUDA
ALIGNED = 4  #: rows of matrices are a multiple of it


@dataclass(frozen=True)
class MlpShape:
    """Sizes of a network."""

    inputs: int  #: numbers of each item
    shared: int  #: numbers that all items have in common
    outputs: int  #: numbers
    width: int  #: units of a hidden layer
    layers: int  #: matrix products, so `layers` - 1 hidden layers

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """(outputs, inputs) of each layer, without what is shared."""
        ends = [self.inputs, *[self.width] * (self.layers - 1), self.outputs]
        return list(zip(ends[1:], ends[:-1], strict=True))

    @property
    def rows(self) -> int:
        """Rows of a matrix of items: `inputs` and what fills them up to a size at which products are fast."""
        return round_up_rows(self.inputs)

    @property
    def parameters(self) -> int:
        """Numbers to train."""
        return sum(rows * columns + rows for rows, columns in self.sizes) + self.sizes[0][0] * self.shared


def sigmoid(value: Float) -> Float:
    """1 / (1 + e^-x)."""
    return dr.rcp(1 + dr.exp(-value))


def initial_weights(shape: MlpShape, rng: np.random.Generator, last: float = 1.0) -> list[np.ndarray]:
    """Uniform within 1 / sqrt(inputs) of a layer (LeCun et al. 1998, as PyTorch has it), float32, flat: the part of the
    first layer that reads what is shared, then matrix and bias of each layer. last: factor of the last layer's."""
    first = shape.sizes[0][0]
    reach = (shape.inputs + shape.shared) ** -0.5
    weights = [rng.uniform(-reach, reach, first * shape.shared)]
    for i, (rows, columns) in enumerate(shape.sizes):
        if i > 0:
            reach = columns**-0.5
        factor = last if i == shape.layers - 1 else 1.0
        weights += [factor * rng.uniform(-reach, reach, rows * columns), factor * rng.uniform(-reach, reach, rows)]
    return [weight.astype(np.float32) for weight in weights]


@dataclass
class PartialLayer:
    """What the first layer makes of the first `inputs` inputs, values: TensorXf [B, width, m]: where only the others
    change from call to call, it is computed once."""

    values: TensorXf
    inputs: int


@dataclass
class InputLayer:
    """The first layer, as items are read: all that do not change with them."""

    matrix: TensorXf  #: [width, rows of the items], 0 in the columns that fill these up
    bias: TensorXf  #: [width, 1], with what the layer makes of what is shared


@dataclass
class MlpTape:
    """What `backward` wants of `forward`."""

    values: list[TensorXf]  #: the items, then what each hidden layer says of them, [B, C, m] each
    input_layer: InputLayer  #: as the items were read


@dataclass
class WayBack:
    """A network and the gradient by what it says, as `backward` takes them."""

    shape: MlpShape
    weights: list[Float]
    tape: MlpTape
    shared: Float
    grad_output: TensorXf


def first_layer_part(shape: MlpShape, weights: list[Float], items: TensorXf, inputs: int) -> PartialLayer:
    """Of the first `inputs` inputs, items: TensorXf [B, `round_up_rows(inputs)`, m], 0 in the rows that fill them
    up."""
    rows, stored = shape.sizes[0]
    matrix = _columns(weights[1], rows, stored, round_up_rows(inputs), inputs)
    return PartialLayer(_product(ad.TensorXf(matrix, (rows, round_up_rows(inputs))), items), inputs)


def forward(
    shape: MlpShape,
    weights: list[Float],
    items: TensorXf,
    shared: Float,
    first_layer: PartialLayer | None = None,
    input_layer: InputLayer | None = None,
) -> tuple[list[Float], MlpTape]:
    """(outputs, [N] each, the tape that `backward` wants): ReLU between layers, nothing after the last.

    weights: as `initial_weights` orders them, Float each;  items: TensorXf [B, `shape.rows`, m], finite everywhere;
    shared: Float [shared];  first_layer: where there is some, items are the other inputs alone, and the tape is of no
    use;  input_layer: of the tape of other items with the same weights, and what they share
    """
    if input_layer is None:
        input_layer = _input_layer(shape, weights, shared, first_layer.inputs if first_layer else 0)
    tape = [items]
    value = items
    for i, (rows, columns) in enumerate(shape.sizes):
        matrix, bias = weights[1 + 2 * i : 3 + 2 * i]
        if i == 0:
            value = _product(input_layer.matrix, value) + input_layer.bias
        elif _is_few(rows) and i == shape.layers - 1:
            return _outputs_of_few(matrix, bias, value), MlpTape(tape, input_layer)
        else:
            value = _product(ad.TensorXf(matrix, (rows, columns)), value) + ad.TensorXf(bias, (rows, 1))
        if first_layer and i == 0:
            value += first_layer.values
        if i < shape.layers - 1:
            value = dr.maximum(value, 0)
            tape.append(value)
    return [_row(value, i) for i in range(shape.outputs)], MlpTape(tape, input_layer)


def backward(
    shape: MlpShape, weights: list[Float], tape: MlpTape, shared: Float, grad_output: TensorXf
) -> tuple[list[Float], TensorXf]:
    """(gradients of the weights, gradient of the items [B, `shape.rows`, m]) from grad_output: TensorXf
    [B, outputs, m].

    Sums over N are sums over the columns of each matrix, all at once, then over the matrices, each in a fixed order:
    the same bits in every run.
    """
    return backward_together([WayBack(shape, weights, tape, shared, grad_output)])[0]


def backward_together(ways: list[WayBack]) -> list[tuple[list[Float], TensorXf]]:
    """`backward` of networks whose items are the columns of as many matrices: they share the kernels that are small."""
    matrices, _, m = ways[0].grad_output.shape
    sums = _WarpSums(matrices, m, sum(_rows_summed(way.shape) for way in ways)) if select() == "cuda" else None
    parts, grad_items = [], []
    for way in ways:
        parts_of_way, by_items = _backward(way, sums)
        parts.append(parts_of_way)
        grad_items.append(by_items)
    if sums is None:
        of_weights = [_totals(way, of_way) for way, of_way in zip(ways, parts, strict=True)]
    else:
        of_weights = _totals_of_warps(ways, parts, sums)
    return list(zip(of_weights, grad_items, strict=True))


def _backward(way: WayBack, sums: "_WarpSums | None") -> tuple[list[Float | int], TensorXf]:
    """(gradients of each matrix and bias in the order of the weights, but for the sums over matrices; gradient of the
    items). A gradient is a Float [B * size], or the number of its first row among those of `sums`."""
    shape, values, grad_values = way.shape, way.tape.values, way.grad_output
    parts: list[Float | int] = []  # of the last layer first
    by_bias: Float | int
    if shape.layers > 1 and sums and _is_few(shape.outputs):
        by_bias = _sums_of_few_rows(grad_values, shape.width, sums)
    else:
        by_bias = _sums_of_rows(grad_values, sums)
    for i in reversed(range(shape.layers)):
        rows, columns = shape.sizes[i]
        parts.append(by_bias)
        if i > 0 and sums and _is_few(rows):
            parts.append(_outer_of_few(grad_values, values[i], sums))
            grad_values = _adjoint_of_few(way.weights[1 + 2 * i], columns, grad_values)
        else:
            parts.append(_product(grad_values, values[i], Bt=True).array)
            matrix = way.tape.input_layer.matrix if i == 0 else ad.TensorXf(way.weights[1 + 2 * i], (rows, columns))
            grad_values = _product(matrix, grad_values, At=True)
        if i > 0:
            grad_values = dr.select(values[i] > 0, grad_values, 0)
            by_bias = _sums_of_rows(grad_values, sums)  # of few rows one kernel with `_outer_of_few`
    return parts[::-1], grad_values


def shared_gradient(shape: MlpShape, weights: list[Float], gradients: list[Float]) -> Float:
    """Float [shared]: gradient of what all items share, from the gradients of the weights that `backward` gives: it
    enters where the bias of the first layer does."""
    rows = shape.sizes[0][0]
    grad_bias = ad.TensorXf(gradients[2], (rows, 1))
    by_shared = _product(ad.TensorXf(weights[0], (rows, shape.shared)), grad_bias, At=True)
    return by_shared.array


def _input_layer(shape: MlpShape, weights: list[Float], shared: Float, first: int) -> InputLayer:
    """Without the first `first` inputs, in one kernel."""
    rows, stored = shape.sizes[0]
    count, columns = stored - first, round_up_rows(stored - first)
    place = dr.arange(ad.UInt32, rows * (columns + 1))
    row, column = place // (columns + 1), place % (columns + 1)
    is_bias = column == columns
    value = dr.gather(ad.Float, weights[1], row * stored + first + column, column < count)
    with_shared = ad.Float(0)
    for i in range(shape.shared):
        weight = dr.gather(ad.Float, weights[0], row * shape.shared + i, is_bias)
        with_shared += weight * dr.gather(ad.Float, shared, ad.UInt32(i))
    matrix, bias = dr.empty(ad.Float, rows * columns), dr.empty(ad.Float, rows)
    dr.scatter(matrix, value, row * columns + column, ~is_bias, dr.ReduceMode.NoConflicts)
    of_bias = dr.gather(ad.Float, weights[2], row, is_bias) + with_shared
    dr.scatter(bias, of_bias, row, is_bias, dr.ReduceMode.NoConflicts)
    dr.eval(matrix, bias)
    return InputLayer(ad.TensorXf(matrix, (rows, columns)), ad.TensorXf(bias, (rows, 1)))


def _columns(matrix: Float, rows: int, stored: int, row_count: int, count: int) -> Float:
    """Float [rows * row_count] of [rows * stored]: the first `count` columns, then columns of 0."""
    if stored == row_count == count:
        return matrix
    place = dr.arange(ad.UInt32, rows * row_count)
    row, column = place // row_count, place % row_count
    return dr.gather(ad.Float, matrix, row * stored + column, column < count)


def _product(left: TensorXf, right: TensorXf, At: bool = False, Bt: bool = False) -> TensorXf:
    """`dr.matmul` of two tensors, which it says to give an object."""
    return cast(TensorXf, dr.matmul(left, right, At=At, Bt=Bt))


class _WarpSums:
    """Sums over the columns of each of B matrices on CUDA, of any number of rows: the threads of a warp sum up what
    they compute, in the kernel that does, and one reduction sums up the warps of all rows."""

    def __init__(self, matrices: int, m: int, rows: int) -> None:
        self.rows, self._warps_a_row, self._taken = rows, m // WARP, 0
        self._warps = dr.zeros(ad.Float, matrices * rows * self._warps_a_row)

    def take(self, rows: int) -> int:
        """The first of so many rows that nothing else adds to."""
        self._taken += rows
        return self._taken - rows

    def add(self, values: Float, matrix: UInt32, row: UInt32, within: UInt32, active: Bool | bool = True) -> None:
        """To a row of a matrix what stands in a column of it, `within`."""
        warp = (matrix * self.rows + row) * self._warps_a_row + within // WARP
        dr.scatter_reduce(dr.ReduceOp.Add, self._warps, values, warp, active, dr.ReduceMode.Local)

    def evaluate(self, values: TensorXf) -> None:
        """With values of which sums were added, in one kernel."""
        dr.eval(values, self._warps)

    def of_matrices(self) -> Float:
        """Float [B * rows]."""
        assert self._taken == self.rows, "each row was taken"
        return dr.block_reduce(dr.ReduceOp.Add, self._warps, self._warps_a_row)


def _rows_summed(shape: MlpShape) -> int:
    """Rows that `_backward` takes of `_WarpSums`."""
    return sum(rows * (1 + columns * (i > 0 and _is_few(rows))) for i, (rows, columns) in enumerate(shape.sizes))


def _totals(way: WayBack, parts: list[Float | int]) -> list[Float]:
    """Gradients of the weights from those of each matrix, by products on LLVM."""
    matrices = way.grad_output.shape[0]
    ones = dr.full(ad.TensorXf, 1, (1, matrices))
    dr.make_opaque(ones)  # once for all products
    sizes = [dr.width(part) // matrices for part in parts]
    sums = [_product(ones, ad.TensorXf(part, (matrices, size))).array for part, size in zip(parts, sizes, strict=True)]
    rows, columns = way.shape.sizes[0]
    outer = ad.TensorXf(sums[1], (rows, 1)) * ad.TensorXf(way.shared, (1, way.shape.shared))
    sums[0] = _columns(sums[0], rows, way.shape.rows, columns, columns)
    return [outer.array, *sums]


def _totals_of_warps(ways: list[WayBack], parts: list[list[Float | int]], sums: _WarpSums) -> list[list[Float]]:
    """Gradients of the weights of each way from those of each matrix, all in two kernels."""
    matrices = ways[0].grad_output.shape[0]
    products = [part for of_way in parts for part in of_way if not isinstance(part, int)]
    joined = Joined([sums.rows, *[dr.width(part) // matrices for part in products]])
    arrays, end = [sums.of_matrices(), *products], dr.opaque(ad.UInt32, matrices)  # no number of a kernel's text
    entry = dr.arange(ad.UInt32, GROUPS * joined.size)
    place, group = entry % joined.size, entry // joined.size

    def has_more(k: UInt32, _total: Float) -> Bool:
        return k < end

    def add(k: UInt32, total: Float) -> tuple[UInt32, Float]:
        return k + GROUPS, total + joined.load(arrays, place, k)

    state = group, dr.zeros(ad.Float, GROUPS * joined.size)
    _, of_groups = dr.while_loop(state, has_more, add, mode="symbolic", label="sum over matrices")
    dr.eval(of_groups)
    place = dr.arange(ad.UInt32, joined.size)
    groups = [dr.gather(ad.Float, of_groups, i * joined.size + place) for i in range(GROUPS)]
    totals, first_of_product = sum(groups[1:], groups[0]), iter(joined.starts[1:])
    gradients = []
    for way, of_way in zip(ways, parts, strict=True):
        starts = [part if isinstance(part, int) else next(first_of_product) for part in of_way]
        gradients.append(_gradients(way, totals, place, starts))
    dr.eval(gradients)
    return gradients


def _gradients(way: WayBack, totals: Float, place: UInt32, starts: list[int]) -> list[Float]:
    """Of the weights of a network, whose matrices' and biases' begin at `starts` of a row. totals: at `place` of it"""
    shape, all_of_row = way.shape, range(way.shape.shared)
    (width, columns), stored = shape.sizes[0], shape.rows
    outer, gradients = dr.empty(ad.Float, width * shape.shared), []
    for i, start in enumerate(starts):
        rows, count = shape.sizes[i // 2]
        size = rows if i % 2 else rows * count
        index, active = place - start, (place >= start) & (place < start + (width * stored if i == 0 else size))
        if i == 0:  # without the columns that items fill up
            index, active = index // stored * columns + index % stored, active & (index % stored < columns)
        gradient = dr.empty(ad.Float, size)
        dr.scatter(gradient, totals, index, active, dr.ReduceMode.NoConflicts)
        gradients.append(gradient)
        for k in all_of_row if i == 1 else ():
            by_weight = totals * dr.gather(ad.Float, way.shared, ad.UInt32(k))
            dr.scatter(outer, by_weight, index * shape.shared + k, active, dr.ReduceMode.NoConflicts)
    return [outer, *gradients]


def _sums_of_rows(values: TensorXf, sums: _WarpSums | None) -> Float | int:
    """Of a TensorXf [B, C, m] over m, as parts of `_backward`."""
    if sums is None:
        return dr.block_reduce(dr.ReduceOp.Add, values.array, values.shape[2])
    first, (matrix, row, within) = sums.take(values.shape[1]), _entries(*values.shape)
    sums.add(values.array, matrix, first + row, within)
    sums.evaluate(values)
    return first


def _is_few(rows: int) -> bool:
    return rows <= FEW and select() == "cuda"


def _entries(matrices: int, columns: int, m: int) -> tuple[UInt32, UInt32, UInt32]:
    """(first, second, third index) of each number of a TensorXf [matrices, columns, m]."""
    entry = dr.arange(ad.UInt32, matrices * columns * m)
    return entry // (columns * m), (entry // m) % columns, entry % m


def _outer_of_few(gradient: TensorXf, items: TensorXf, sums: _WarpSums) -> int:
    """`_product` of a gradient [B, rows, m] with items [B, C, m] transposed, as a part of `_backward`: in the kernel
    that computes what has as many numbers as the items."""
    rows, columns = gradient.shape[1], items.shape[1]
    first, (matrix, column, within) = sums.take(rows * columns), _entries(*items.shape)
    for i in range(rows):
        product = items.array * _few(gradient, i, matrix, within)
        sums.add(product, matrix, first + i * columns + column, within)
    return first


def _sums_of_few_rows(gradient: TensorXf, columns: int, sums: _WarpSums) -> int:
    """`_sums_of_rows` of a gradient [B, rows, m] in the kernel of `_outer_of_few`, whose items have these columns."""
    matrices, rows, m = gradient.shape
    first, (matrix, column, within) = sums.take(rows), _entries(matrices, columns, m)
    for i in range(rows):
        sums.add(_few(gradient, i, matrix, within), matrix, ad.UInt32(first + i), within, column == 0)
    return first


def _few(gradient: TensorXf, i: int, matrix: UInt32, within: UInt32) -> Float:
    """Row i of a TensorXf [B, rows, m]."""
    return dr.gather(ad.Float, gradient.array, (matrix * gradient.shape[1] + i) * gradient.shape[2] + within)


def _adjoint_of_few(matrix: Float, columns: int, gradient: TensorXf) -> TensorXf:
    """Adjoint of `_outputs_of_few` by the items, part of the kernel that reads it. gradient: TensorXf [B, rows, m]"""
    matrices, rows, m = gradient.shape
    number, column, within = _entries(matrices, columns, m)
    total = ad.Float(0)
    for i in range(rows):
        weight = dr.gather(ad.Float, matrix, i * columns + column)
        total = dr.fma(weight, _few(gradient, i, number, within), total)
    return ad.TensorXf(total, (matrices, columns, m))


def _outputs_of_few(matrix: Float, bias: Float, items: TensorXf) -> list[Float]:
    """[B * m] each: `_product` of a matrix of few rows, Float [rows * C], with items [B, C, m], and the bias [rows], in
    one pass over the items, a part of the kernel that reads it."""
    matrices, columns, m = items.shape
    rows, turn = dr.width(bias), _turn(columns)
    column = dr.arange(ad.UInt32, matrices * m)
    number, within = column // m, column % m

    def has_more(k: UInt32, _sums: list[Float]) -> Bool:
        return k < columns

    def add(k: UInt32, sums: list[Float]) -> tuple[UInt32, list[Float]]:
        for u in range(turn):
            value = dr.gather(ad.Float, items.array, (number * columns + k + u) * m + within)
            weights = [dr.gather(ad.Float, matrix, i * columns + k + u) for i in range(rows)]
            sums = [dr.fma(weight, value, total) for weight, total in zip(weights, sums, strict=True)]
        return k + turn, sums

    state = ad.UInt32(0), [ad.Float(0) for _ in range(rows)]
    _, sums = dr.while_loop(state, has_more, add, mode="symbolic", label="outputs of few rows")
    outputs = [total + dr.gather(ad.Float, bias, ad.UInt32(i)) for i, total in enumerate(sums)]
    dr.schedule(outputs)  # by the first kernel that reads them, for all
    return outputs


def _row(matrices: TensorXf, i: int) -> Float:
    """Row i [B * m] of a TensorXf [B, C, m]."""
    count, rows, m = matrices.shape
    column = dr.arange(ad.UInt32, count * m)
    return dr.gather(ad.Float, matrices.array, (column // m * rows + i) * m + column % m)


def _turn(count: int) -> int:
    """How many of `count` numbers a loop takes a turn."""
    return next(turn for turn in (8, 4, 2, 1) if count % turn == 0)


def round_up_rows(rows: int) -> int:
    """`rows` rounded up to what matrix products are fast at: Dr.Jit 1.5 reads four numbers at once on CUDA where rows
    of memory allow it, and works in tiles of 64 x 64 instead of 8 x 8."""
    return -(-rows // ALIGNED) * ALIGNED
