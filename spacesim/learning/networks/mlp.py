"""Small fully connected networks over N items at once: forward, and the adjoint of that by hand.

Items are the columns of B matrices [rows, m] in memory (`PaddedBatch`): N = B m. What all items share, such as the
direction of the Sun, enters the first layer as one vector: its products are made once instead of N times.
"""

import drjit as dr

from spacesim.backend import ad, select
from spacesim.backend.arrays import Float, TensorXf
from spacesim.learning.networks import warps
from spacesim.learning.networks.network import (
    InputLayer,
    Launched,
    MlpShape,
    MlpTape,
    PartialLayer,
    WayBack,
    columns_of,
    product,
    round_up_rows,
    rows_of,
)
from spacesim.learning.networks.packets import activated, masked


def first_layer_part(shape: MlpShape, weights: list[Float], items: TensorXf, inputs: int) -> PartialLayer:
    """Of the first `inputs` inputs, items: TensorXf [B, `round_up_rows(inputs)`, m], 0 in the rows that fill them
    up."""
    rows, stored = shape.sizes[0]
    matrix = columns_of(weights[1], rows, stored, round_up_rows(inputs), inputs)
    return PartialLayer(product(ad.TensorXf(matrix, (rows, round_up_rows(inputs))), items), inputs)


def forward(
    shape: MlpShape,
    weights: list[Float],
    items: TensorXf,
    shared: Float,
    first_layer: PartialLayer | None = None,
    input_layer: InputLayer | None = None,
    launched: Launched | None = None,
) -> tuple[list[Float], MlpTape]:
    """(outputs, [N] each, the tape that `backward` wants): ReLU between layers, nothing after the last.

    weights: as `initial_weights` orders them, Float each;  items: TensorXf [B, `shape.rows`, m], finite everywhere, m a
    multiple of 8, on CUDA of 128;
    shared: Float [shared];  first_layer: where there is some, items are the other inputs alone, and the tape is of no
    use;  input_layer: of the tape of other items with the same weights, and what they share;  launched: of these items,
    if some is
    """
    tape = [items]
    if launched is not None:
        if launched.outputs is not None:
            return rows_of(launched.outputs), launched.tape
        tape, input_layer = [*launched.tape.values], launched.tape.input_layer
    if input_layer is None:
        input_layer = make_input_layer(shape, weights, shared, first_layer.inputs if first_layer else 0)
    by_warps = select() == "cuda" and first_layer is None
    for i in range(len(tape) - 1, shape.layers):
        rows, columns = shape.sizes[i]
        matrix, bias = weights[1 + 2 * i : 3 + 2 * i]
        is_last = i == shape.layers - 1
        if i == 0:
            value, bias = product(input_layer.matrix, items), input_layer.bias
        elif is_last and by_warps and warps.is_few(rows):
            return warps.outputs_of_few(matrix, bias, tape[-1]), MlpTape(tape, input_layer)
        else:
            value = product(ad.TensorXf(matrix, (rows, columns)), tape[-1])
        if first_layer is None and not is_last:
            tape.append(activated(value, bias))
            continue
        value += ad.TensorXf(bias, (rows, 1))
        if first_layer and i == 0:
            value += first_layer.values
        if not is_last:
            tape.append(dr.maximum(value, 0))
    return rows_of(value), MlpTape(tape, input_layer)


def backward(
    shape: MlpShape, weights: list[Float], tape: MlpTape, shared: Float, grad_output: TensorXf
) -> tuple[list[Float], TensorXf]:
    """(gradients of the weights, gradient of the items [B, `shape.rows`, m]) from grad_output: TensorXf
    [B, outputs, m].

    Sums over N are sums over the columns of each matrix, all at once, then over the matrices, each in a fixed order:
    the same bits in every run.
    """
    return backward_together([WayBack(shape, weights, tape, shared, grad_output)])[0]


def backward_together(
    ways: list[WayBack], hidden: warps.HiddenGradients | None = None
) -> list[tuple[list[Float], TensorXf]]:
    """`backward` of networks whose items are the columns of as many matrices: they share the kernels that are small.
    hidden: of the first network, if its hidden layers were gone through elsewhere, on CUDA"""
    if hidden is None and select() == "llvm":
        return [_backward(way) for way in ways]
    matrices, _, m = ways[0].grad_output.shape
    rows = sum(warps.rows_summed(way.shape, hidden is not None and way is ways[0]) for way in ways)
    sums = warps.WarpSums(matrices, m, rows)
    passed = [warps.through_hidden(ways[0], hidden, sums)] if hidden else []
    passed += [warps.backward(way, sums) for way in ways[len(passed) :]]
    parts, grad_items = zip(*passed, strict=True)
    own_and_last = [sums.of_matrices(), *([hidden.last] if hidden else [])]
    return list(zip(warps.totals(ways, list(parts), own_and_last), grad_items, strict=True))


def _backward(way: WayBack) -> tuple[list[Float], TensorXf]:
    """`backward` on LLVM."""
    shape, values, gradient = way.shape, way.tape.values, way.grad_output
    parts: list[Float] = []  # of the last layer first
    for i in reversed(range(shape.layers)):
        parts.append(dr.block_reduce(dr.ReduceOp.Add, gradient.array, gradient.shape[2]))
        parts.append(product(gradient, values[i], Bt=True).array)
        matrix = way.input_matrix() if i == 0 else ad.TensorXf(way.weights[1 + 2 * i], shape.sizes[i])
        gradient = product(matrix, gradient, At=True)
        if i > 0:
            gradient = masked(gradient, values[i])
    return _totals(way, parts[::-1]), gradient


def shared_gradient(shape: MlpShape, weights: list[Float], gradients: list[Float]) -> Float:
    """Float [shared]: gradient of what all items share, from the gradients of the weights that `backward` gives: it
    enters where the bias of the first layer does."""
    rows = shape.sizes[0][0]
    grad_bias = ad.TensorXf(gradients[2], (rows, 1))
    by_shared = product(ad.TensorXf(weights[0], (rows, shape.shared)), grad_bias, At=True)
    return by_shared.array


def make_input_layer(shape: MlpShape, weights: list[Float], shared: Float, first: int = 0) -> InputLayer:
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
    return InputLayer(ad.TensorXf(matrix, (rows, columns)), bias)


def _totals(way: WayBack, parts: list[Float]) -> list[Float]:
    """Gradients of the weights from those of each matrix, by products on LLVM."""
    matrices = way.grad_output.shape[0]
    ones = dr.full(ad.TensorXf, 1, (1, matrices))
    dr.make_opaque(ones)  # once for all products
    sizes = [dr.width(part) // matrices for part in parts]
    sums = [product(ones, ad.TensorXf(part, (matrices, size))).array for part, size in zip(parts, sizes, strict=True)]
    rows, columns = way.shape.sizes[0]
    outer = ad.TensorXf(sums[1], (rows, 1)) * ad.TensorXf(way.shared, (1, way.shape.shared))
    sums[0] = columns_of(sums[0], rows, way.shape.rows, columns, columns)
    return [outer.array, *sums]
