"""Hidden layers of wide networks on an NVIDIA GPU's tensor cores, as exact as in float32.

Dr.Jit's own products use none: on an H200 these, with bias, ReLU and its way back, take 0.6 of their time alone. Their
kernels are launched between recordings, as `splat/light/shading/` does.
"""

import logging
from functools import cache
from math import prod

import drjit as dr
import numpy as np

from spacesim.backend import ad, select
from spacesim.backend.arrays import Float, TensorXf
from spacesim.backend.kernels.ptx import PtxKernel
from spacesim.backend.upload import upload
from spacesim.learning.networks import warps
from spacesim.learning.networks.network import ALIGNED, CHUNK, InputLayer, Launched, MlpShape, MlpTape
from spacesim.learning.networks.product_text import ADDRESSES, NUMBERS, THREADS, Kind, ProductText

WIDE = 128  #: units of a hidden layer from which on it pays
PARTS = 64  #: sums over columns are made in so many parts, to fill the device
AGREES = 1e-6  #: error of a product, of its largest number, up to which `is_usable` accepts it
DEVICES = (80, 90, 100, 103)  #: compute capabilities where TF32 is some times as fast as float32: on others it is not
MAX_NUMBERS = 2**32  #: of all matrices, which kernels count in 32 bits

log = logging.getLogger(__name__)


def takes(shape: MlpShape, columns: int) -> bool:
    """Whether the hidden layers of a network are computed here, for so many columns."""
    fits = shape.width % ALIGNED == 0 and columns % CHUNK == 0 and columns * max(shape.width, shape.rows) < MAX_NUMBERS
    wide = shape.width >= WIDE and shape.layers > 2 and warps.is_few(shape.outputs)
    return wide and fits and select() == "cuda" and not dr.flag(dr.JitFlag.FreezingScope) and is_usable()


def forward(shape: MlpShape, weights: list[Float], items: TensorXf, first: InputLayer) -> Launched:
    """Hidden layers, of the items [B, `shape.rows`, m]. first: the first layer"""
    values = [items, _hidden(first.matrix.array, first.bias, items)]
    for i in range(1, shape.layers - 1):
        values.append(_hidden(weights[1 + 2 * i], weights[2 + 2 * i], values[-1]))
    return Launched(MlpTape(values, first), None)


def back_through_hidden(
    shape: MlpShape, weights: list[Float], values: list[TensorXf], by_last: warps.LastGradient
) -> warps.HiddenGradients:
    """The way back from the last hidden layer to the items. values: of the tape;  by_last: of `warps.through_last`"""
    gradients, products = [by_last.gradient], []
    for i in reversed(range(1, shape.layers - 1)):
        products.append(_outer(gradients[-1], values[i]))
        gradients.append(_back(weights[1 + 2 * i], gradients[-1], shape.width, values[i]))
    products.append(_outer(gradients[-1], values[0]))
    grad_items = _back(by_last.input_matrix.array, gradients[-1], by_last.input_matrix.shape[1])
    return warps.HiddenGradients(by_last.sums, gradients[:0:-1], products[::-1], grad_items)


@cache
def is_usable() -> bool:
    """Whether such kernels run here, and give what float64 gives: tried once in a process."""
    if dr.detail.cuda_compute_capability() not in DEVICES:
        return False
    try:
        error = _largest_error()
    except (RuntimeError, OSError) as reason:  # whatever the driver says: Dr.Jit computes the same
        log.info("networks: no products on tensor cores (%s)", reason)
        return False
    if not error < AGREES:
        log.warning("networks: products on tensor cores are wrong by %.2g, not used", error)
    return error < AGREES


def _hidden(matrix: Float, bias: Float, items: TensorXf) -> TensorXf:
    """max(matrix items + bias, 0)."""
    batch, depth, m = items.shape
    rows = dr.width(bias)
    return _launch("hidden", [matrix, items.array], (batch, rows, m), (rows, m, depth, batch, 1), bias)


def _back(matrix: Float, gradient: TensorXf, rows: int, values: TensorXf | None = None) -> TensorXf:
    """matrix^T gradient [B, rows, m], 0 where `values` are not above 0."""
    batch, depth, m = gradient.shape
    beside = None if values is None else values.array
    return _launch("back", [matrix, gradient.array], (batch, rows, m), (rows, m, depth, batch, 1), beside)


def _outer(gradient: TensorXf, values: TensorXf) -> Float:
    """Float [G * rows * columns]: sums of gradient values^T over the columns, in G parts."""
    (batch, rows, m), columns = gradient.shape, values.shape[1]
    parts = min(batch, PARTS)
    shape = parts, rows, columns
    return _launch("outer", [gradient.array, values.array], shape, (rows, columns, m, batch, parts)).array


def _launch(
    kind: Kind,
    factors: list[Float],
    shape: tuple[int, int, int],
    sizes: tuple[int, int, int, int, int],
    beside: Float | None = None,
) -> TensorXf:
    """The result of `ProductText`, of this shape. sizes: M, N, K, B, G"""
    rows, columns, _, batch, parts = sizes
    assert (sizes[2] if kind == "outer" else columns) == CHUNK, "columns come in chunks"
    text, kernel = _kernel(kind, kind == "back" and beside is not None)
    result = dr.empty(ad.Float, prod(shape))
    arrays = [*factors, result, factors[0] if beside is None else beside]
    kernel(text.grid(rows, columns, batch, parts), arrays, sizes)
    return ad.TensorXf(result, shape)


@cache
def _kernel(kind: Kind, masked: bool) -> tuple[ProductText, PtxKernel]:
    text = ProductText(kind, masked)
    return text, PtxKernel(text.text, text.entry, ADDRESSES, NUMBERS, text.shared, THREADS)


def _largest_error() -> float:
    """Of products of each kind, of their largest number, to float64's."""
    rng, rows, depth, batch = np.random.default_rng(0), 132, 36, PARTS + 3
    shapes = (rows, depth), (rows,), (batch, depth, CHUNK), (batch, rows, CHUNK)
    exact = [rng.normal(size=shape).astype(np.float32).astype(np.float64) for shape in shapes]
    matrix, bias, items, gradient = (upload(numbers.ravel()) for numbers in exact)
    columns, back_columns = ad.TensorXf(items, shapes[2]), ad.TensorXf(gradient, shapes[3])
    back = exact[0].T @ exact[3]
    pairs = [
        (_hidden(matrix, bias, columns), np.maximum(exact[0] @ exact[2] + exact[1][:, None], 0)),
        (_back(matrix, back_columns, depth), back),
        (_back(matrix, back_columns, depth, columns), np.where(exact[2] > 0, back, 0)),
        (_outer(back_columns, columns), np.einsum("bmk,bnk->mn", exact[3], exact[2], optimize=True)[None]),
    ]
    errors = []
    for found, wanted in pairs:
        numbers = np.array(found, np.float64).reshape(-1, *wanted.shape).sum(axis=0)  # of the parts
        errors.append(float(np.abs(numbers - wanted).max() / np.abs(wanted).max()))
    return float(np.max(errors))  # NaN where one is
