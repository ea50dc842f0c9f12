"""Fully fused networks (Müller et al. 2021) on a CPU: one kernel for all layers, one for the whole way back.

Dr.Jit's products take each layer through memory: two cores with AVX-512 take these in half of its time or less. They
are launched between recordings, as `splat/light/shading/` does.
"""

from functools import cache, partial
from math import prod

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Float, TensorXf
from spacesim.backend.kernels.llvm import LlvmKernel, empty, is_usable, vector_width
from spacesim.learning.networks.fused_text import PANEL, PER_CHUNK, FusedText, full
from spacesim.learning.networks.network import (
    CHUNK,
    InputLayer,
    Launched,
    MlpShape,
    MlpTape,
    PartialLayer,
    WayBack,
    round_up_rows,
)

WIDEST = 256  #: units of a layer, or numbers of an item: panels of these have room on a thread's stack
PARTS = 64  #: sums over columns are made in so many parts, one for each task: the same bits for any number of threads


def takes(shape: MlpShape) -> bool:
    """Whether a network is computed here, outside recordings."""
    return max(shape.width, shape.rows, shape.outputs) <= WIDEST and is_usable()


def has_made(tape: MlpTape) -> bool:
    """Whether a tape is of `forward`, of a network that has hidden layers."""
    return any(values.shape[2] == PANEL for values in tape.values[1:])


def forward(shape: MlpShape, weights: list[Float], items: TensorXf, first: InputLayer) -> Launched:
    """All layers, of the items [B, `shape.rows`, m]; of hidden ones the tape has [B', width rounded up, 64]. first: the
    first layer"""
    chunks = items.shape[0]
    sizes = [(chunks * PER_CHUNK, full(shape.width), PANEL)] * (shape.layers - 1)
    hidden, output = [_tensor(size) for size in sizes], _tensor((chunks, shape.outputs, CHUNK))
    arrays = [items.array, *_layers(shape, weights, first), *[values.array for values in hidden], output.array]
    _forward_kernel(shape)([chunks * PER_CHUNK], arrays, [])
    return Launched(MlpTape([items, *hidden], first), output)


def outputs(
    shape: MlpShape, weights: list[Float], items: TensorXf, first: InputLayer, known: PartialLayer | None = None
) -> TensorXf:
    """[B, outputs, m] of the items [B, C, m], for no way back. first: the first layer;  known: what it makes of first
    inputs, where items are the others alone"""
    chunks, rows, _ = items.shape
    output = _tensor((chunks, shape.outputs, CHUNK))
    arrays = [items.array, *_layers(shape, weights, first), output.array, *([known.values.array] if known else [])]
    _outputs_kernel(shape, rows, known is not None)([chunks * PER_CHUNK], arrays, [])
    return output


def backward(way: WayBack) -> tuple[list[Float], TensorXf]:
    """(gradients of the weights, gradient of the items [B, `way.wanted` or all, m]), as `mlp.backward` has it, of a
    tape of `forward`."""
    shape, (items, *hidden) = way.shape, way.tape.values
    chunks, wanted = items.shape[0], shape.rows if way.wanted is None else round_up_rows(way.wanted)
    tasks, by_items = min(chunks, PARTS), _tensor((chunks, wanted, CHUNK))
    text, kernel = _backward_kernel(shape, wanted)
    gradients = [empty(ad.Float, dr.width(weight)) for weight in way.weights]
    kernel(
        [tasks, *[rows for rows, _ in shape.sizes]],
        [
            items.array,
            *_layers(shape, way.weights, way.tape.input_layer)[: shape.layers],
            *[values.array for values in hidden],
            way.grad_output.array,
            by_items.array,
            empty(ad.Float, tasks * text.part),
            way.shared,
            *gradients,
        ],
        [chunks, tasks],
    )
    return gradients, by_items


def _layers(shape: MlpShape, weights: list[Float], first: InputLayer) -> list[Float]:
    """Matrices of all layers, then their biases."""
    later = range(1, shape.layers)
    matrices = [first.matrix.array, *[weights[1 + 2 * i] for i in later]]
    return [*matrices, first.bias, *[weights[2 + 2 * i] for i in later]]


def _tensor(shape: tuple[int, int, int]) -> TensorXf:
    """For a kernel to write."""
    return ad.TensorXf(empty(ad.Float, prod(shape)), shape)


@cache
def _forward_kernel(shape: MlpShape) -> LlvmKernel:
    text, layers = FusedText(shape, shape.rows, vector_width()), range(shape.layers)
    names = ["items", *[f"{kind}{i}" for kind in ("matrix", "bias") for i in layers]]
    return LlvmKernel([*names, *[f"hidden{i}" for i in layers[:-1]], "output"], [], ("forward", text.forward))


@cache
def _outputs_kernel(shape: MlpShape, rows: int, is_known: bool) -> LlvmKernel:
    text, layers = FusedText(shape, shape.rows, vector_width()), range(shape.layers)
    names = ["items", *[f"{kind}{i}" for kind in ("matrix", "bias") for i in layers], "output", *["known"][:is_known]]
    return LlvmKernel(names, [], ("outputs", partial(text.outputs, rows, is_known)))


@cache
def _backward_kernel(shape: MlpShape, wanted: int) -> tuple[FusedText, LlvmKernel]:
    text, layers = FusedText(shape, wanted, vector_width()), range(shape.layers)
    read = ["items", *[f"matrix{i}" for i in layers], *[f"hidden{i}" for i in layers[:-1]], "by_output"]
    written = ["by_shared", *[f"by_{kind}{i}" for i in layers for kind in ("matrix", "bias")]]
    names = [*read, "by_items", "parts", "shared", *written]
    return text, LlvmKernel(names, ["chunks", "tasks"], ("backward", text.backward), *text.sums())
