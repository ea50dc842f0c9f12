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


def first_layer_part(shape: MlpShape, weights: list[Float], items: TensorXf, inputs: int) -> PartialLayer:
    """Of the first `inputs` inputs, items: TensorXf [B, `round_up_rows(inputs)`, m], 0 in the rows that fill them
    up."""
    return PartialLayer(_product(_matrix(shape, weights, 0, 0, inputs), items), inputs)


def forward(
    shape: MlpShape, weights: list[Float], items: TensorXf, shared: Float, first_layer: PartialLayer | None = None
) -> tuple[TensorXf, list[TensorXf]]:
    """(outputs [B, outputs, m], the tape that `backward` wants): ReLU between layers, nothing after the last.

    weights: as `initial_weights` orders them, Float each;  items: TensorXf [B, `shape.rows`, m], finite everywhere;
    shared: Float [shared];  first_layer: where there is some, items are the other inputs alone, and the tape is of no
    use
    """
    first = first_layer.inputs if first_layer else 0
    tape = [items]
    value = items
    for i, (rows, _) in enumerate(shape.sizes):
        bias = ad.TensorXf(weights[2 + 2 * i], (rows, 1))
        if i == 0:
            common = ad.TensorXf(weights[0], (rows, shape.shared))
            bias = bias + _product(common, ad.TensorXf(shared, (shape.shared, 1)))
        if i > 0 and _is_few(rows):
            value = _product_of_few(weights[1 + 2 * i], rows, value) + bias
        else:
            value = _product(_matrix(shape, weights, i, first if i == 0 else 0), value) + bias
        if first_layer and i == 0:
            value += first_layer.values
        if i < shape.layers - 1:
            value = dr.maximum(value, 0)
            tape.append(value)
    return value, tape


def backward(
    shape: MlpShape, weights: list[Float], tape: list[TensorXf], shared: Float, grad_output: TensorXf
) -> tuple[list[Float], TensorXf]:
    """(gradients of the weights, gradient of the items [B, `shape.rows`, m]) from grad_output: TensorXf
    [B, outputs, m].

    Sums over N are sums over the columns of each matrix, all at once, then over the matrices, each in a fixed order:
    the same bits in every run.
    """
    parts: list[Float] = []  # of each matrix, of the last layer first: gradients of the bias, of the weights
    grad_values, by_bias = grad_output, _sums_of_rows(grad_output)
    for i in reversed(range(shape.layers)):
        rows, columns = shape.sizes[i]
        parts.append(by_bias)
        is_few = i > 0 and _is_few(rows)
        if is_few:
            by_weights = _outer_of_few(grad_values, tape[i])
            grad_values = _adjoint_of_few(weights[1 + 2 * i], columns, grad_values)
        else:
            by_weights = _product(grad_values, tape[i], Bt=True).array
            grad_values = _product(_matrix(shape, weights, i), grad_values, At=True)
        if i > 0:
            grad_values = dr.select(tape[i] > 0, grad_values, 0)
            by_bias = _sums_of_rows(grad_values)  # of few rows one kernel with `_outer_of_few`
        parts.append(_sums_of_warps(by_weights, tape[i].shape[2]) if is_few else by_weights)
    sums = _over_matrices(parts, grad_output.shape[0])[::-1]
    grad_bias = sums[1]
    sums[0] = _columns(sums[0], rows, tape[0].shape[1], columns)
    outer = ad.TensorXf(grad_bias, (rows, 1)) * ad.TensorXf(shared, (1, shape.shared))
    return [outer.array, *sums], grad_values


def shared_gradient(shape: MlpShape, weights: list[Float], gradients: list[Float]) -> Float:
    """Float [shared]: gradient of what all items share, from the gradients of the weights that `backward` gives: it
    enters where the bias of the first layer does."""
    rows = shape.sizes[0][0]
    grad_bias = ad.TensorXf(gradients[2], (rows, 1))
    by_shared = _product(ad.TensorXf(weights[0], (rows, shape.shared)), grad_bias, At=True)
    return by_shared.array


def _matrix(shape: MlpShape, weights: list[Float], i: int, first: int = 0, count: int | None = None) -> TensorXf:
    """[rows, columns] of layer i, or of `count` of its columns from `first` on; that of the first layer has
    columns of 0, too, where rows fill the items up."""
    rows, columns = shape.sizes[i]
    count = columns - first if count is None else count
    row_count = round_up_rows(count) if i == 0 else count
    return ad.TensorXf(_columns(weights[1 + 2 * i], rows, columns, row_count, first, count), (rows, row_count))


def _columns(matrix: Float, rows: int, stored: int, row_count: int, first: int = 0, count: int | None = None) -> Float:
    """Float [rows * wanted] of [rows * stored]: `count` columns from `first` on, all by default, then columns of 0."""
    count = stored if count is None else count
    if stored == row_count == count:
        return matrix
    place = dr.arange(ad.UInt32, rows * row_count)
    row, column = place // row_count, place % row_count
    return dr.gather(ad.Float, matrix, row * stored + first + column, column < count)


def _product(left: TensorXf, right: TensorXf, At: bool = False, Bt: bool = False) -> TensorXf:
    """`dr.matmul` of two tensors, which it says to give an object."""
    return cast(TensorXf, dr.matmul(left, right, At=At, Bt=Bt))


def _over_matrices(parts: list[Float], matrices: int) -> list[Float]:
    """Sums over all matrices of what each of them gives: of parts [B * size] Floats [size]."""
    sizes = [dr.width(part) // matrices for part in parts]
    if select() == "llvm":
        ones = dr.full(ad.TensorXf, 1, (1, matrices))
        rows = zip(parts, sizes, strict=True)
        return [_product(ones, ad.TensorXf(part, (matrices, size))).array for part, size in rows]
    joined, end = Joined(sizes), dr.opaque(ad.UInt32, matrices)  # no number of a kernel's text
    entry = dr.arange(ad.UInt32, GROUPS * joined.size)
    place, group = entry % joined.size, entry // joined.size

    def has_more(k: UInt32, _total: Float) -> Bool:
        return k < end

    def add(k: UInt32, total: Float) -> tuple[UInt32, Float]:
        return k + GROUPS, total + joined.load(parts, place, k)

    state = group, dr.zeros(ad.Float, GROUPS * joined.size)
    _, totals = dr.while_loop(state, has_more, add, mode="symbolic", label="sum over matrices")
    dr.eval(totals)
    place = dr.arange(ad.UInt32, joined.size)
    of_groups = [dr.gather(ad.Float, totals, i * joined.size + place) for i in range(GROUPS)]
    return joined.split(sum(of_groups[1:], of_groups[0]))


def _sums_of_rows(values: TensorXf) -> Float:
    """Float [B * C] of a TensorXf [B, C, m]."""
    m = values.shape[2]
    if select() == "llvm":
        return dr.block_reduce(dr.ReduceOp.Add, values.array, m)
    warps = dr.zeros(ad.Float, dr.width(values.array) // WARP)  # where values are computed, not in a pass of its own
    warp = dr.arange(ad.UInt32, dr.width(values.array)) // WARP
    dr.scatter_reduce(dr.ReduceOp.Add, warps, values.array, warp, mode=dr.ReduceMode.Local)
    dr.eval(values, warps)
    return _sums_of_warps(warps, m)


def _sums_of_warps(warps: Float, m: int) -> Float:
    """Of sums over `WARP` of m numbers each, those over all m."""
    return dr.block_reduce(dr.ReduceOp.Add, warps, m // WARP)


def _is_few(rows: int) -> bool:
    return rows <= FEW and select() == "cuda"


def _entries(matrices: int, columns: int, m: int) -> tuple[UInt32, UInt32, UInt32]:
    """(first, second, third index) of each number of a TensorXf [matrices, columns, m]."""
    entry = dr.arange(ad.UInt32, matrices * columns * m)
    return entry // (columns * m), (entry // m) % columns, entry % m


def _outer_of_few(gradient: TensorXf, items: TensorXf) -> Float:
    """`_product` of a gradient [B, rows, m] with items [B, C, m] transposed, for `_sums_of_warps`: part of the kernel
    that computes what has as many numbers as the items."""
    (matrices, rows, m), columns = gradient.shape, items.shape[1]
    number, column, within = _entries(matrices, columns, m)
    warps = dr.zeros(ad.Float, rows * matrices * columns * (m // WARP))
    for i in range(rows):
        row = number * rows + i
        product = items.array * dr.gather(ad.Float, gradient.array, row * m + within)
        place = (row * columns + column) * (m // WARP) + within // WARP
        dr.scatter_reduce(dr.ReduceOp.Add, warps, product, place, mode=dr.ReduceMode.Local)
    return warps


def _adjoint_of_few(matrix: Float, columns: int, gradient: TensorXf) -> TensorXf:
    """Adjoint of `_product_of_few` by the items, part of the kernel that reads it. gradient: TensorXf [B, rows, m]"""
    matrices, rows, m = gradient.shape
    number, column, within = _entries(matrices, columns, m)
    total = ad.Float(0)
    for i in range(rows):
        weight = dr.gather(ad.Float, matrix, i * columns + column)
        total = dr.fma(weight, dr.gather(ad.Float, gradient.array, (number * rows + i) * m + within), total)
    return ad.TensorXf(total, (matrices, columns, m))


def _product_of_few(matrix: Float, rows: int, items: TensorXf) -> TensorXf:
    """`_product` of a matrix of so few `rows`, Float [rows * C], with items [B, C, m] in one pass over these."""
    matrices, columns, m = items.shape
    turn = _turn(columns)
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
    _, sums = dr.while_loop(state, has_more, add, mode="symbolic", label="product of few rows")
    result = dr.empty(ad.Float, rows * matrices * m)
    for i, total in enumerate(sums):
        dr.scatter(result, total, (number * rows + i) * m + within, mode=dr.ReduceMode.NoConflicts)
    return ad.TensorXf(result, (matrices, rows, m))


def _turn(count: int) -> int:
    """How many of `count` numbers a loop takes a turn."""
    return next(turn for turn in (8, 4, 2, 1) if count % turn == 0)


def round_up_rows(rows: int) -> int:
    """`rows` rounded up to what matrix products are fast at: Dr.Jit 1.5 reads four numbers at once on CUDA where rows
    of memory allow it, and works in tiles of 64 x 64 instead of 8 x 8."""
    return -(-rows // ALIGNED) * ALIGNED
