"""Networks on CUDA: kernels that read and write four columns at once, and sum up what they compute."""

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


class WarpSums:
    """Sums over the columns of each of B matrices, of any number of rows: the threads of a warp sum up what they
    compute, in the kernel that does, and one reduction sums up the warps of all rows."""

    def __init__(self, matrices: int, m: int, rows: int) -> None:
        self.rows, self._warps_a_row, self._taken = rows, m // COLUMNS, 0
        self._warps = dr.zeros(ad.Float, matrices * rows * self._warps_a_row)

    def take(self, rows: int) -> int:
        """The first of so many rows that nothing else adds to."""
        self._taken += rows
        return self._taken - rows

    def add(self, values: Array4f, at: Packets, row: UInt32, active: Bool | bool = True) -> None:
        """What stands `at` to a row of its matrix."""
        warp = (at.matrix * self.rows + row) * self._warps_a_row + at.within // WARP
        four = (values[0] + values[1]) + (values[2] + values[3])
        dr.scatter_reduce(dr.ReduceOp.Add, self._warps, four, warp, active, dr.ReduceMode.Local)

    def evaluate(self, values: TensorXf) -> None:
        """With values of which sums were added, in one kernel."""
        dr.eval(values, self._warps)

    def of_rows(self, values: TensorXf) -> int:
        """The first of the rows that are those of an evaluated TensorXf [B, C, m]."""
        at, first = Packets(values.shape, PACKET), self.take(values.shape[1])
        self.add(at.load(values), at, first + at.row)
        return first

    def of_matrices(self) -> Float:
        """Float [B * rows]."""
        assert self._taken == self.rows, "each row was taken"
        return dr.block_reduce(dr.ReduceOp.Add, self._warps, self._warps_a_row)


Part = Float | int
"""Gradients of each matrix or bias but for the sum over B matrices: [B * size], or the first row of `WarpSums`."""


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


def rows_summed(shape: MlpShape) -> int:
    """Rows that `backward` takes of `WarpSums`."""
    return sum(rows * (1 + columns * (i > 0 and is_few(rows))) for i, (rows, columns) in enumerate(shape.sizes))


def backward(way: WayBack, sums: WarpSums) -> tuple[list[Part], TensorXf]:
    """(gradients of each matrix and bias in the order of the weights, gradient of the items)."""
    shape, values, gradient = way.shape, way.tape.values, way.grad_output
    parts: list[Part] = []  # of the last layer first
    by_bias: int | None = None
    for i in reversed(range(1, shape.layers)):
        rows, columns = shape.sizes[i]
        at, weights = Packets(values[i].shape, PACKET), way.weights[1 + 2 * i]
        if is_few(rows):
            few, first = [at.load_row(gradient, row) for row in range(rows)], sums.take(rows * columns)
            before = ad.Array4f(0)
            for row, of_row in enumerate(few):
                sums.add(of_row * at.load(values[i]), at, first + row * columns + at.row)
                before = dr.fma(dr.gather(ad.Float, weights, row * columns + at.row), of_row, before)
            if by_bias is None:
                by_bias = sums.take(rows)
                for row, of_row in enumerate(few):
                    sums.add(of_row, at, ad.UInt32(by_bias + row), at.row == 0)
            parts += [by_bias, first]
        else:
            parts += [sums.of_rows(gradient) if by_bias is None else by_bias]
            parts.append(product(gradient, values[i], Bt=True).array)
            before = at.load(product(ad.TensorXf(weights, (rows, columns)), gradient, At=True))
        masked, by_bias = dr.select(at.load(values[i]) > 0, before, 0), sums.take(columns)
        sums.add(masked, at, by_bias + at.row)
        gradient = at.store(masked)
        sums.evaluate(gradient)
    parts += [sums.of_rows(gradient) if by_bias is None else by_bias]
    parts.append(product(gradient, values[0], Bt=True).array)
    return parts[::-1], product(way.input_matrix(), gradient, At=True)


def totals(ways: list[WayBack], parts: list[list[Part]], sums: WarpSums) -> list[list[Float]]:
    """Gradients of the weights of each way from those of each matrix, all in two kernels."""
    matrices = ways[0].grad_output.shape[0]
    products = [part for of_way in parts for part in of_way if not isinstance(part, int)]
    joined = Joined([sums.rows, *[dr.width(part) // matrices for part in products]])
    arrays, end = [sums.of_matrices(), *products], dr.opaque(ad.UInt32, matrices)  # no number of a kernel's text
    entry = dr.arange(ad.UInt32, GROUPS * joined.size)
    place, group = entry % joined.size, entry // joined.size

    def has_more(k: UInt32, _total: Float) -> Bool:
        return k < end

    def add(k: UInt32, total: Float) -> tuple[UInt32, Float]:
        return k + GROUPS, total + joined.load(arrays, place, k)

    state = group, dr.zeros(ad.Float, GROUPS * joined.size)
    _, of_groups = dr.while_loop(state, has_more, add, mode="symbolic", label="sum over matrices")
    dr.eval(of_groups)
    place = dr.arange(ad.UInt32, joined.size)
    groups = [dr.gather(ad.Float, of_groups, i * joined.size + place) for i in range(GROUPS)]
    total, first_of_product = sum(groups[1:], groups[0]), iter(joined.starts[1:])
    gradients = []
    for way, of_way in zip(ways, parts, strict=True):
        starts = [part if isinstance(part, int) else next(first_of_product) for part in of_way]
        gradients.append(_gradients(way, total, place, starts))
    dr.eval(gradients)
    return gradients


def _gradients(way: WayBack, total: Float, place: UInt32, starts: list[int]) -> list[Float]:
    """Of the weights of a network, whose matrices' and biases' begin at `starts` of a row. total: at `place` of it"""
    shape = way.shape
    (width, columns), stored = shape.sizes[0], shape.rows
    outer, gradients = dr.empty(ad.Float, width * shape.shared), []
    for i, start in enumerate(starts):
        rows, count = shape.sizes[i // 2]
        size = rows if i % 2 else rows * count
        index, active = place - start, is_within(place, start, width * stored if i == 0 else size)
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
