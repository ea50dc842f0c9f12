"""Small fully connected networks over N items at once: forward, and the adjoint of that by hand.

Items are columns ([inputs, N] in memory, as Dr.Jit's matrix products like it). What all items share, such as the
direction of the Sun, enters the first layer as one vector: its products are made once instead of N times.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad


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
    """(outputs [outputs, N], the tape that `backward` wants): ReLU between layers, nothing after the last.

    weights: as `initial_weights` orders them, Float each;  items: TensorXf [inputs, N];  shared: Float [shared]
    """
    tape = [items]
    value = items
    for i, (rows, columns) in enumerate(shape.sizes):
        matrix, bias = ad.TensorXf(weights[1 + 2 * i], (rows, columns)), ad.TensorXf(weights[2 + 2 * i], (rows, 1))
        if i == 0:
            common = ad.TensorXf(weights[0], (rows, shape.shared))
            bias = bias + dr.matmul(common, ad.TensorXf(shared, (shape.shared, 1)))
        value = dr.matmul(matrix, value) + bias
        if i < shape.layers - 1:
            value = dr.maximum(value, 0)
            tape.append(value)
    return value, tape


def backward(
    shape: MlpShape, weights: list[Any], tape: list[Any], shared: Any, by_output: Any
) -> tuple[list[Any], Any]:
    """(gradients of the weights, gradient of the items [inputs, N]) from by_output: TensorXf [outputs, N].

    The sums over N are matrix products with a fixed order: the same bits in every run.
    """
    gradients: list[Any] = [None] * len(weights)
    ones = dr.full(ad.TensorXf, 1, (by_output.shape[1], 1))
    by_value = by_output
    for i in reversed(range(shape.layers)):
        by_bias: Any = dr.matmul(by_value, ones)
        by_matrix: Any = dr.matmul(by_value, tape[i], Bt=True)
        gradients[1 + 2 * i] = by_matrix.array
        gradients[2 + 2 * i] = by_bias.array
        if i == 0:
            gradients[0] = (by_bias * ad.TensorXf(shared, (1, shape.shared))).array
        by_value = dr.matmul(ad.TensorXf(weights[1 + 2 * i], shape.sizes[i]), by_value, At=True)
        if i > 0:
            by_value = dr.select(tape[i] > 0, by_value, 0)
    return gradients, by_value
