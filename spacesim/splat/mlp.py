"""Small fully connected networks over N items at once: forward, and the adjoint of that by hand.

Items are the columns of B matrices [rows, m] in memory (`lanes`): N = B m. What all items share, such as the direction
of the Sun, enters the first layer as one vector: its products are made once instead of N times.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.splat.lanes import aligned


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


def forward(shape: MlpShape, weights: list[Any], items: Any, shared: Any) -> tuple[Any, list[Any]]:
    """(outputs [B, outputs, m], the tape that `backward` wants): ReLU between layers, nothing after the last.

    weights: as `initial_weights` orders them, Float each;  items: TensorXf [B, `shape.rows`, m], finite everywhere;
    shared: Float [shared]
    """
    tape = [items]
    value = items
    for i, (rows, _) in enumerate(shape.sizes):
        bias = ad.TensorXf(weights[2 + 2 * i], (rows, 1))
        if i == 0:
            common = ad.TensorXf(weights[0], (rows, shape.shared))
            bias = bias + dr.matmul(common, ad.TensorXf(shared, (shape.shared, 1)))
        value = dr.matmul(_matrix(shape, weights, i), value) + bias
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


def _matrix(shape: MlpShape, weights: list[Any], i: int) -> Any:
    """TensorXf [rows, columns] of layer i; that of the first has the columns of what fills the items up, 0."""
    rows, columns = shape.sizes[i]
    wanted = shape.rows if i == 0 else columns
    return ad.TensorXf(_columns(weights[1 + 2 * i], rows, columns, wanted), (rows, wanted))


def _columns(matrix: Any, rows: int, stored: int, wanted: int) -> Any:
    """Float [rows * wanted] of [rows * stored]: without its last columns, or with more of 0."""
    if stored == wanted:
        return matrix
    place = dr.arange(ad.UInt32, rows * wanted)
    row, column = place // wanted, place % wanted
    return dr.gather(ad.Float, matrix, row * stored + column, column < stored)


def _over_matrices(numbers: Any, size: int) -> Any:
    """Float [size]: sum of B times `size` numbers."""
    count = dr.width(numbers) // size
    total: Any = dr.matmul(dr.full(ad.TensorXf, 1, (1, count)), ad.TensorXf(numbers, (count, size)))
    return total.array
