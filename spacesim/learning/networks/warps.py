"""Networks on CUDA: kernels that read and write four columns at once, and sum up what they compute."""

from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Array4f, Bool, Float, TensorXf, UInt32
from spacesim.learning.networks.joined import Joined, is_within
from spacesim.learning.networks.network import MlpShape, WayBack, product
from spacesim.learning.networks.packets import SIZE, Packets

WARP = 32  #: threads that sum up together
PACKET = SIZE["cuda"]
COLUMNS = PACKET * WARP  #: of a matrix that they sum up, of which there are a multiple
GROUPS = 8  #: of matrices that are summed up at the same time
FEW = 4  #: rows of a matrix at which products by tiles are slow
OWN, LAST = 0, 1  #: `WarpSums`; `LastGradient.sums`


class Row(NamedTuple):
    """Where a gradient's numbers stand in sums over the columns of each of B matrices, Float [B * rows]."""

    which: int  #: of the sums: `OWN`, or `LAST` of a network whose hidden layers are gone through elsewhere
    row: int  #: the first of as many as the gradient has numbers


Part = Float | Row
"""Gradients of each matrix or bias but for the sum over B matrices or parts: Float [B * size], or rows."""


class WarpSums:
    """Sums over the columns of each of B matrices, of any number of rows: the threads of a warp sum up what they
    compute, in the kernel that does, and one reduction sums up the warps of all rows."""

    def __init__(self, matrices: int, m: int, rows: int) -> None:
        self.rows, self._warps_a_row, self._taken = rows, m // COLUMNS, 0
        self._warps = dr.zeros(ad.Float, matrices * rows * self._warps_a_row)

    def take(self, rows: int) -> Row:
        """The first of so many rows that nothing else adds to."""
        self._taken += rows
        return Row(OWN, self._taken - rows)

    def add(self, values: Array4f, at: Packets, row: UInt32, active: Bool | bool = True) -> None:
        """What stands `at` to a row of its matrix."""
        warp = (at.matrix * self.rows + row) * self._warps_a_row + at.within // WARP
        four = (values[0] + values[1]) + (values[2] + values[3])
        dr.scatter_reduce(dr.ReduceOp.Add, self._warps, four, warp, active, dr.ReduceMode.Local)

    def evaluate(self, values: TensorXf) -> None:
        """With values of which sums were added, in one kernel."""
        dr.eval(values, self._warps)

    def of_rows(self, values: TensorXf) -> Row:
        """The first of the rows that are those of an evaluated TensorXf [B, C, m]."""
        at, first = Packets(values.shape, PACKET), self.take(values.shape[1])
        self.add(at.load(values), at, first.row + at.row)
        return first

    def of_matrices(self) -> Float:
        """Float [B * rows]."""
        assert self._taken == self.rows, "each row was taken"
        return dr.block_reduce(dr.ReduceOp.Add, self._warps, self._warps_a_row)


@dataclass
class LastGradient:
    """What goes back through the last layer of a network of few outputs."""

    gradient: TensorXf  #: of what the last hidden layer says, before its ReLU, [B, C, m]
    sums: Float  #: Float [B * rows], for the gradients of matrix and bias, and of the last hidden layer's bias
    input_matrix: TensorXf  #: of `WayBack.input_matrix`


@dataclass
class HiddenGradients:
    """What goes back through the hidden layers of a network elsewhere (`tensor_cores`)."""

    last: Float  #: of `LastGradient.sums`
    gradients: list[TensorXf]  #: of what hidden layers but the last say, before their ReLU, [B, C, m] each
    products: list[Float]  #: of their matrices and the last hidden layer's, in parts
    grad_items: TensorXf  #: of the items


def is_few(rows: int) -> bool:
    """Whether so many outputs are computed without products by tiles."""
    return rows <= FEW


def outputs_of_few(matrix: Float, bias: Float, items: TensorXf) -> list[Float]:
    """[B * m] each: `product` of a matrix of few rows, Float [rows * C], with items [B, C, m], and the bias [rows], in
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


def rows_summed(shape: MlpShape, hidden: bool = False) -> int:
    """Rows that `backward` takes of `WarpSums`. hidden: with `HiddenGradients`"""
    if hidden:
        return shape.width * (shape.layers - 2)
    return sum(rows * (1 + columns * (i > 0 and is_few(rows))) for i, (rows, columns) in enumerate(shape.sizes))


def backward(way: WayBack, sums: WarpSums) -> tuple[list[Part], TensorXf]:
    """(gradients of each matrix and bias in the order of the weights, gradient of the items)."""
    gradient, by_bias = way.grad_output, None
    parts: list[Part] = []  # of the last layer first
    for i in reversed(range(1, way.shape.layers)):
        of_layer, gradient, by_bias = _through(way, i, gradient, by_bias, sums)
        parts += of_layer
    parts += [sums.of_rows(gradient) if by_bias is None else by_bias]
    parts.append(product(gradient, way.tape.values[0], Bt=True).array)
    return parts[::-1], product(way.input_matrix(), gradient, At=True)


def through_last(way: WayBack) -> LastGradient:
    """The first step back of a network of few outputs."""
    (matrices, rows, m), columns = way.grad_output.shape, way.shape.width
    sums = WarpSums(matrices, m, rows * columns + rows + columns)
    _, gradient, _ = _through(way, way.shape.layers - 1, way.grad_output, None, sums)
    return LastGradient(gradient, sums.of_matrices(), way.input_matrix())


def through_hidden(way: WayBack, hidden: HiddenGradients, sums: WarpSums) -> tuple[list[Part], TensorXf]:
    """What `backward` gives."""
    rows, columns = way.shape.outputs, way.shape.width
    parts: list[Part] = []
    for i, matrix in enumerate(hidden.products):
        is_last = i == len(hidden.products) - 1
        bias = Row(LAST, rows * columns + rows) if is_last else sums.of_rows(hidden.gradients[i])
        parts += [matrix, bias]
    return [*parts, Row(LAST, 0), Row(LAST, rows * columns)], hidden.grad_items


def totals(ways: list[WayBack], parts: list[list[Part]], sums: list[Float]) -> list[list[Float]]:
    """Gradients of the weights of each way from those of each matrix or part, all in two kernels. sums: [B * rows]
    each, by `Row.which`"""
    matrices = ways[0].grad_output.shape[0]
    pairs = [(part, _size(way, i)) for way, of_way in zip(ways, parts, strict=True) for i, part in enumerate(of_way)]
    products = [(part, size) for part, size in pairs if not isinstance(part, Row)]
    arrays = [*sums, *[part for part, _ in products]]
    joined = Joined([*[dr.width(row) // matrices for row in sums], *[size for _, size in products]])
    counts = [matrices] * len(sums) + [dr.width(part) // size for part, size in products]
    ends = {count: dr.opaque(ad.UInt32, count) for count in counts}  # no numbers of a kernel's text
    entry = dr.arange(ad.UInt32, GROUPS * joined.size)
    place, group = entry % joined.size, entry // joined.size
    end = joined.repeat([ends[count] for count in counts], place)

    def has_more(k: UInt32, _total: Float) -> Bool:
        return k < end

    def add(k: UInt32, total: Float) -> tuple[UInt32, Float]:
        return k + GROUPS, total + joined.load(arrays, place, k)

    state = group, dr.zeros(ad.Float, GROUPS * joined.size)
    _, of_groups = dr.while_loop(state, has_more, add, mode="symbolic", label="sum over matrices")
    dr.eval(of_groups)
    place = dr.arange(ad.UInt32, joined.size)
    groups = [dr.gather(ad.Float, of_groups, i * joined.size + place) for i in range(GROUPS)]
    total, first_of_product = sum(groups[1:], groups[0]), iter(joined.starts[len(sums) :])
    gradients = []
    for way, of_way in zip(ways, parts, strict=True):
        starts = [
            joined.starts[part.which] + part.row if isinstance(part, Row) else next(first_of_product) for part in of_way
        ]
        gradients.append(_gradients(way, total, place, starts))
    dr.eval(gradients)
    return gradients


def _through(
    way: WayBack, i: int, gradient: TensorXf, by_bias: Row | None, sums: WarpSums
) -> tuple[list[Part], TensorXf, Row]:
    """(gradients of the bias and the matrix of layer i, of what the hidden layer before says, before its ReLU, and of
    that one's bias) from that of what layer i says. by_bias: of layer i, if it is known"""
    values, (rows, columns) = way.tape.values[i], way.shape.sizes[i]
    at, weights = Packets(values.shape, PACKET), way.weights[1 + 2 * i]
    if is_few(rows):
        few, first = [at.load_row(gradient, row) for row in range(rows)], sums.take(rows * columns)
        before = ad.Array4f(0)
        for row, of_row in enumerate(few):
            sums.add(of_row * at.load(values), at, first.row + row * columns + at.row)
            before = dr.fma(dr.gather(ad.Float, weights, row * columns + at.row), of_row, before)
        if by_bias is None:
            by_bias = sums.take(rows)
            for row, of_row in enumerate(few):
                sums.add(of_row, at, ad.UInt32(by_bias.row + row), at.row == 0)
        parts: list[Part] = [by_bias, first]
    else:
        parts = [sums.of_rows(gradient) if by_bias is None else by_bias]
        parts.append(product(gradient, values, Bt=True).array)
        before = at.load(product(ad.TensorXf(weights, (rows, columns)), gradient, At=True))
    masked, by_hidden = dr.select(at.load(values) > 0, before, 0), sums.take(columns)
    sums.add(masked, at, by_hidden.row + at.row)
    gradient = at.store(masked)
    sums.evaluate(gradient)
    return parts, gradient, by_hidden


def _size(way: WayBack, i: int) -> int:
    """Numbers of matrix or bias i as `backward` has them: the first matrix with the columns that items fill up."""
    rows, columns = way.shape.sizes[i // 2]
    return rows if i % 2 else rows * (way.shape.rows if i == 0 else columns)


def _gradients(way: WayBack, total: Float, place: UInt32, starts: list[int]) -> list[Float]:
    """Of the weights of a network, whose matrices' and biases' begin at `starts` of a row. total: at `place` of it"""
    shape = way.shape
    (width, columns), stored = shape.sizes[0], shape.rows
    outer, gradients = dr.empty(ad.Float, width * shape.shared), []
    for i, start in enumerate(starts):
        index, size, active = place - start, dr.width(way.weights[1 + i]), is_within(place, start, _size(way, i))
        if i == 0:  # without the columns that items fill up
            index, active = index // stored * columns + index % stored, active & (index % stored < columns)
        gradient = dr.empty(ad.Float, size)
        dr.scatter(gradient, total, index, active, dr.ReduceMode.NoConflicts)
        gradients.append(gradient)
        if i == 1:
            for k in range(shape.shared):
                by_weight = total * dr.gather(ad.Float, way.shared, ad.UInt32(k))
                dr.scatter(outer, by_weight, index * shape.shared + k, active, dr.ReduceMode.NoConflicts)
    return [outer, *gradients]


def _turn(count: int) -> int:
    """How many of `count` numbers a loop takes a turn."""
    return next(turn for turn in (8, 4, 2, 1) if count % turn == 0)
