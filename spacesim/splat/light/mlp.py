"""Small fully connected networks over N items at once: forward, and the adjoint of that by hand.

Items are the columns of B matrices [rows, m] in memory (`lanes`): N = B m. What all items share, such as the direction
of the Sun, enters the first layer as one vector: its products are made once instead of N times.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.splat.light.columns import aligned

MOST_FEATURES, MOST_WIDTH, MOST_LAYERS = 1024, 4096, 32
"""Of a network: numbers a Gaussian, units of a layer, layers; chosen, far above any that pays."""


@dataclass(frozen=True)
class MlpShape:
    """inputs: numbers of each item;  shared: numbers that all items have in common;  width: units of a hidden layer;
    layers: matrix products, so `layers` - 1 hidden layers;  outputs: numbers"""

    inputs: int
    shared: int
    outputs: int
    width: int
    layers: int

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """(outputs, inputs) of each layer, without what is shared."""
        ends = [self.inputs, *[self.width] * (self.layers - 1), self.outputs]
        return list(zip(ends[1:], ends[:-1], strict=True))

    @property
    def rows(self) -> int:
        """Rows of a matrix of items: `inputs` and what fills them up to a size at which products are fast."""
        return aligned(self.inputs)

    @property
    def parameters(self) -> int:
        """Numbers to train."""
        return sum(rows * columns + rows for rows, columns in self.sizes) + self.sizes[0][0] * self.shared


def sigmoid(value: Any) -> Any:
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
class Known:
    """What the first layer makes of the first `inputs` inputs, values: TensorXf [B, width, m]: where only the others
    change from call to call, it is computed once."""

    values: Any
    inputs: int


def known(shape: MlpShape, weights: list[Any], items: Any, inputs: int) -> Known:
    """Of the first `inputs` inputs, items: TensorXf [B, `aligned(inputs)`, m], 0 in the rows that fill them up."""
    return Known(dr.matmul(_matrix(shape, weights, 0, 0, inputs), items), inputs)


def forward(
    shape: MlpShape, weights: list[Any], items: Any, shared: Any, known: Known | None = None
) -> tuple[Any, list[Any]]:
    """(outputs [B, outputs, m], the tape that `backward` wants): ReLU between layers, nothing after the last.

    weights: as `initial_weights` orders them, Float each;  items: TensorXf [B, `shape.rows`, m], finite everywhere;
    shared: Float [shared];  known: where there is some, items are the other inputs alone, and the tape is of no use
    """
    first = known.inputs if known else 0
    tape = [items]
    value = items
    for i, (rows, _) in enumerate(shape.sizes):
        bias = ad.TensorXf(weights[2 + 2 * i], (rows, 1))
        if i == 0:
            common = ad.TensorXf(weights[0], (rows, shape.shared))
            bias = bias + dr.matmul(common, ad.TensorXf(shared, (shape.shared, 1)))
        value = dr.matmul(_matrix(shape, weights, i, first if i == 0 else 0), value) + bias
        if known and i == 0:
            value += known.values
        if i < shape.layers - 1:
            value = dr.maximum(value, 0)
            tape.append(value)
    return value, tape


def backward(
    shape: MlpShape, weights: list[Any], tape: list[Any], shared: Any, by_output: Any
) -> tuple[list[Any], Any]:
    """(gradients of the weights, gradient of the items [B, `shape.rows`, m]) from by_output: TensorXf [B, outputs, m].

    Sums over N are sums over the columns of each matrix, all at once, then over the matrices, each in a fixed order:
    the same bits in every run.
    """
    gradients: list[Any] = [None] * len(weights)
    by_value = by_output
    for i in reversed(range(shape.layers)):
        rows, columns = shape.sizes[i]
        by_bias = _over_matrices(dr.block_reduce(dr.ReduceOp.Add, by_value.array, by_value.shape[2]), rows)
        products: Any = dr.matmul(by_value, tape[i], Bt=True)
        by_matrix = _over_matrices(products.array, rows * tape[i].shape[1])
        gradients[1 + 2 * i] = _columns(by_matrix, rows, tape[i].shape[1], columns)
        gradients[2 + 2 * i] = by_bias
        if i == 0:
            outer: Any = ad.TensorXf(by_bias, (rows, 1)) * ad.TensorXf(shared, (1, shape.shared))
            gradients[0] = outer.array
        by_value = dr.matmul(_matrix(shape, weights, i), by_value, At=True)
        if i > 0:
            by_value = dr.select(tape[i] > 0, by_value, 0)
    return gradients, by_value


def _matrix(shape: MlpShape, weights: list[Any], i: int, first: int = 0, count: int | None = None) -> Any:
    """TensorXf [rows, columns] of layer i, or of `count` of its columns from `first` on; that of the first layer has
    columns of 0, too, where rows fill the items up."""
    rows, columns = shape.sizes[i]
    count = columns - first if count is None else count
    wanted = aligned(count) if i == 0 else count
    return ad.TensorXf(_columns(weights[1 + 2 * i], rows, columns, wanted, first, count), (rows, wanted))


def _columns(matrix: Any, rows: int, stored: int, wanted: int, first: int = 0, count: int | None = None) -> Any:
    """Float [rows * wanted] of [rows * stored]: `count` columns from `first` on, all by default, then columns of 0."""
    count = stored if count is None else count
    if stored == wanted == count:
        return matrix
    place = dr.arange(ad.UInt32, rows * wanted)
    row, column = place // wanted, place % wanted
    return dr.gather(ad.Float, matrix, row * stored + first + column, column < count)


def _over_matrices(numbers: Any, size: int) -> Any:
    """Float [size]: sum of B times `size` numbers."""
    count = dr.width(numbers) // size
    total: Any = dr.matmul(dr.full(ad.TensorXf, 1, (1, count)), ad.TensorXf(numbers, (count, size)))
    return total.array
