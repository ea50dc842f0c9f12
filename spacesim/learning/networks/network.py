"""Sizes, weights and records of small fully connected networks."""

from dataclasses import dataclass
from typing import cast

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Float, TensorXf

MAX_FEATURES, MAX_WIDTH, MAX_LAYERS = 1024, 4096, 32
"""Of a network: numbers a Gaussian, units of a layer, layers, far above any that pays."""
ALIGNED = 4  #: rows of matrices are a multiple of it
CHUNK = 512  #: columns of each matrix of many: 100,000 Gaussians in chunks fill a GPU
TILE = 64  #: rows of a product that are computed at once


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
    """The first layer as kernels read it, the same for all items."""

    matrix: TensorXf  #: [width, rows of the items], 0 in the columns that fill these up
    bias: Float  #: [width], with what the layer makes of what is shared


@dataclass
class MlpTape:
    """What `backward` wants of `forward`."""

    values: list[TensorXf]  #: the items, then what each hidden layer says of them, [B, C, m] each
    input_layer: InputLayer  #: as the items were read


@dataclass
class Launched:
    """What kernels launched before a recording (`fused`, `tensor_cores`) have made of items."""

    tape: MlpTape  #: as far as they have come
    outputs: TensorXf | None  #: [B, outputs, m]; None: of hidden layers alone


@dataclass
class WayBack:
    """What `mlp.backward_together` takes of each network."""

    shape: MlpShape  #: its sizes
    weights: list[Float]  #: as `initial_weights` orders them
    tape: MlpTape  #: of `mlp.forward`
    shared: Float  #: [shared], what its items have in common
    grad_output: TensorXf  #: [B, outputs, m], by what it says
    #: gradients of so many first rows of the items are wanted, at least, or all: tiles of others are not computed
    wanted: int | None = None

    def input_matrix(self) -> TensorXf:
        """Of the first layer, as far as gradients of the items want it."""
        rows, columns = self.shape.sizes[0]
        wanted = columns if self.wanted is None else self.wanted
        if -(-wanted // TILE) == -(-columns // TILE):
            return self.tape.input_layer.matrix
        wanted = round_up_rows(wanted)
        return ad.TensorXf(columns_of(self.weights[1], rows, columns, wanted, wanted), (rows, wanted))


def round_up_rows(rows: int) -> int:
    """`rows` rounded up to what matrix products are fast at: Dr.Jit 1.5 reads four numbers at once on CUDA where rows
    of memory allow it, and works in tiles of 64 x 64 instead of 8 x 8."""
    return -(-rows // ALIGNED) * ALIGNED


def product(left: TensorXf, right: TensorXf, At: bool = False, Bt: bool = False) -> TensorXf:
    """`dr.matmul` of two tensors, which it says to give an object."""
    return cast(TensorXf, dr.matmul(left, right, At=At, Bt=Bt))


def columns_of(matrix: Float, rows: int, stored: int, row_count: int, count: int) -> Float:
    """Float [rows * row_count] of [rows * stored]: the first `count` columns, then columns of 0."""
    if stored == row_count == count:
        return matrix
    place = dr.arange(ad.UInt32, rows * row_count)
    row, column = place // row_count, place % row_count
    return dr.gather(ad.Float, matrix, row * stored + column, column < count)


def rows_of(matrices: TensorXf) -> list[Float]:
    """All rows, [B * m] each, of a TensorXf [B, C, m]."""
    return [row_of(matrices, i) for i in range(matrices.shape[1])]


def row_of(matrices: TensorXf, i: int) -> Float:
    """Row i [B * m] of a TensorXf [B, C, m]."""
    count, rows, m = matrices.shape
    column = dr.arange(ad.UInt32, count * m)
    return dr.gather(ad.Float, matrices.array, (column // m * rows + i) * m + column % m)
