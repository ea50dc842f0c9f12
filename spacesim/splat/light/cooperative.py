"""Networks of `mlp` for pictures: forward alone, a whole network in one kernel, by Dr.Jit's cooperative vectors.

On CUDA these are OptiX's: products of half precision on tensor cores, and nothing between two layers goes to memory. On
LLVM they compute the same more slowly. Not everywhere where CUDA is there is OptiX, so `is_usable` tries it.
"""

import logging
from dataclasses import dataclass
from functools import cache
from typing import Any

import drjit as dr
import numpy as np
from drjit import nn

from spacesim.backend import ad, recorded, select
from spacesim.backend.arrays import Float
from spacesim.backend.upload import upload
from spacesim.learning.networks import mlp, network
from spacesim.learning.networks.network import MlpShape
from spacesim.splat.light.padded_batch import PaddedBatch

AGREES = 2e-3  #: difference to single precision up to which `is_usable` accepts a network's sigmoid

PLACE = "layout", "shape", "offset", "size", "stride", "transpose"  #: what a view has beside numbers and their type

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Places:
    """Where the matrices and biases of a network stand, a record that recordings know as a whole."""

    views: tuple[tuple[Any, ...], ...]  #: of matrix, bias, matrix, bias, ...: each its `PLACE`


@dataclass(frozen=True, eq=False)
class PackedNetwork:
    """See `pack`. Not `nn.MatrixView`s, whose type of numbers is an `Enum`: see `Recorded`."""

    numbers: Any  #: Float16, of all matrices and biases
    places: Places  #: in them

    def views(self) -> list["nn.MatrixView"]:
        """Matrix, bias, matrix, bias, ..."""
        found = []
        for place in self.places.views:
            view = nn.MatrixView()
            view.buffer, view.dtype = self.numbers, dr.type_v(self.numbers)
            for name, value in zip(PLACE, place, strict=True):
                setattr(view, name, value)
            found.append(view)
        return found


def pack(shape: MlpShape, weights: list[Float]) -> PackedNetwork:
    """Matrix and bias of each layer as `forward` reads them, half precision in the device's order, from weights as
    `network.initial_weights` orders them. What is shared stands before the other inputs."""
    parts = []
    for i, (rows, columns) in enumerate(shape.sizes):
        matrix, bias = (np.array(weight) for weight in weights[1 + 2 * i : 3 + 2 * i])
        matrix = matrix.reshape(rows, columns)
        if i == 0:
            matrix = np.concatenate([np.array(weights[0]).reshape(rows, shape.shared), matrix], axis=1)
        parts += [ad.TensorXf16(matrix.astype(np.float16)), ad.Float16(bias.astype(np.float16))]
    views: Any = nn.pack(parts, layout="inference")
    places = tuple(tuple(getattr(view, name) for name in PLACE) for view in views)
    return PackedNetwork(views[0].buffer, Places(places))


def forward(shape: MlpShape, packed: PackedNetwork, rows: list[Float], shared: Float) -> list[Float]:
    """Outputs, Floats [M], of inputs `rows`, Floats [M] or of width 1.  packed: see `pack`;  shared: Float [shared]"""
    shared_inputs = [dr.gather(ad.Float, shared, ad.UInt32(i)) for i in range(shape.shared)]
    views = packed.views()
    value: Any = nn.CoopVec([ad.Float16(row) for row in [*shared_inputs, *rows]])
    for i in range(shape.layers):
        value = nn.matvec(views[2 * i], value, views[2 * i + 1])
        if i < shape.layers - 1:
            value = dr.maximum(value, 0)
    return [ad.Float(output) for output in value]


@cache
def is_usable() -> bool:
    """Whether cooperative vectors work here and give what `mlp.forward` gives: tried once in a process, with a small
    network, in a recording."""
    try:
        difference = _largest_difference()
    except Exception as error:  # whatever OptiX, driver or Dr.Jit say: pictures can be drawn without
        reason = str(error.__cause__ or error).strip().splitlines()
        log.warning("networks: no cooperative vectors on %s (%s)", select(), reason[-1] if reason else type(error))
        return False
    if not difference < AGREES:
        log.warning("networks: cooperative vectors on %s are wrong by %.2g, not used", select(), difference)
    return difference < AGREES


def _largest_difference() -> float:
    """Largest difference between sigmoids of a network's outputs."""
    shape, rng, count = MlpShape(19, 5, 3, 32, 3), np.random.default_rng(0), 300
    weights = [upload(weight) for weight in network.initial_weights(shape, rng)]
    shared, rows = upload(rng.normal(size=5)), upload(rng.normal(size=19 * count))
    batch = PaddedBatch.of(count)
    run = recorded(
        lambda packed, rows, shared, batch: forward(shape, packed, batch.block(rows, 0, 19), shared),
        limit=2,
        elements=None,
    )
    packed = pack(shape, weights)
    outputs = [run(packed, rows, shared, batch) for _ in range(2)][1]
    exact, _ = mlp.forward(shape, weights, batch.matrix(batch.block(rows, 0, 19), shape.rows), shared)
    sigmoids = [[1 / (1 + np.exp(-np.array(row))) for row in pair] for pair in zip(outputs, exact, strict=True)]
    return max(float(np.abs(ours - other).max()) for ours, other in sigmoids)
