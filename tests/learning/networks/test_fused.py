"""Networks in one kernel on a CPU: beside float64, to the bit for any threads and registers; when they are taken."""

import drjit as dr
import numpy as np
import pytest
from splat.light.test_mlp import COUNTS, SHAPES, Case, columns, numbers

from spacesim.backend import recorded
from spacesim.learning.networks import fused, mlp
from spacesim.learning.networks.network import CHUNK, MlpShape, WayBack, round_up_rows

pytestmark = [pytest.mark.threads, pytest.mark.usefixtures("kernels_of_text")]

ALL = SHAPES | {
    "demo": MlpShape(13, 1, 3, 64, 3),
    "thesis": MlpShape(153, 25, 3, 256, 3),
    "odd": MlpShape(21, 4, 5, 37, 4),
}


def passes(case: Case, wanted: int | None = None) -> tuple:
    """(outputs, gradients of the weights, gradient of the items)."""
    weights, rows, shared, grad_rows, batch = case.device()
    items = batch.matrix([batch.pad_zeros(row) for row in rows], case.shape.rows)
    launched = fused.forward(case.shape, weights, items, mlp.make_input_layer(case.shape, weights, shared))
    grad_output = batch.matrix([batch.pad_zeros(row) for row in grad_rows])
    assert fused.has_made(launched.tape) == (case.shape.layers > 1)
    return launched.outputs, *fused.backward(WayBack(case.shape, weights, launched.tape, shared, grad_output, wanted))


def bits(found: tuple) -> list[bytes]:
    output, gradients, grad_items = found
    return [numbers(array).tobytes() for array in (output, grad_items, *gradients)]


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("name", ALL)
def test_networks_and_their_way_back_match_float64(name, count):
    case = Case(ALL[name], count)
    output, gradients, grad_items = passes(case)
    assert output.shape == (case.device()[-1].capacity // CHUNK, case.shape.outputs, CHUNK)
    case.check(output, gradients, grad_items)


@pytest.mark.parametrize("name", ALL)
def test_outputs_alone_are_the_same(name):
    case = Case(ALL[name], CHUNK + 1)
    weights, rows, shared, _, batch = case.device()
    shape, rows = case.shape, [batch.pad_zeros(row) for row in rows]
    items, first = batch.matrix(rows, shape.rows), mlp.make_input_layer(shape, weights, shared)
    found = fused.outputs(shape, weights, items, first)
    usual = fused.forward(shape, weights, items, first).outputs
    np.testing.assert_array_equal(numbers(found), numbers(usual))
    for count in (1, shape.inputs - 1):  # of inputs whose part in the first layer is known
        known = mlp.first_layer_part(shape, weights, batch.matrix(rows[:count], round_up_rows(count)), count)
        others = batch.matrix(rows[count:], round_up_rows(shape.inputs - count))
        found = fused.outputs(shape, weights, others, mlp.make_input_layer(shape, weights, shared, count), known)
        np.testing.assert_allclose(columns(found, case.count), case.exact()[0], atol=2e-6)


def test_gradients_of_the_first_items_are_those_of_all():
    case = Case(ALL["odd"], 700)
    _, _, grad_items = passes(case)
    for wanted in (1, 8, 13):
        _, _, some = passes(case, wanted)
        assert some.shape == (grad_items.shape[0], round_up_rows(wanted), CHUNK)
        np.testing.assert_array_equal(numbers(some), numbers(grad_items)[:, : some.shape[1]])


@pytest.mark.parametrize("threads", [1, 3])
def test_any_number_of_threads_gives_the_same_bits(threads):
    case = Case(ALL["odd"], 70 * CHUNK)  # more chunks than tasks
    usual, before = bits(passes(case)), dr.thread_count()
    dr.set_thread_count(threads)
    try:
        assert bits(passes(case)) == usual
    finally:
        dr.set_thread_count(before)


@pytest.mark.parametrize("width", [4, 8, 16])
def test_registers_of_any_width_give_the_same_bits(width, monkeypatch):
    case = Case(ALL["odd"], 700)
    kernels = fused._forward_kernel, fused._outputs_kernel, fused._backward_kernel
    weights, rows, shared, _, batch = case.device()
    items = batch.matrix([batch.pad_zeros(row) for row in rows], case.shape.rows)
    first = mlp.make_input_layer(case.shape, weights, shared)

    def outputs() -> bytes:
        return numbers(fused.outputs(case.shape, weights, items, first)).tobytes()

    usual, alone = bits(passes(case)), outputs()
    assert fused.vector_width() in (4, 8, 16)
    monkeypatch.setattr(fused, "vector_width", lambda: width)
    for kernel in kernels:
        kernel.cache_clear()
    try:
        assert bits(passes(case)) == usual
        assert outputs() == alone
    finally:
        for kernel in kernels:
            kernel.cache_clear()


def test_what_is_no_number_stays_so():
    case = Case(ALL["demo"], 3)
    case.items[:, 1] = np.nan
    output, _, _ = passes(case)
    assert np.isnan(columns(output, 3)).tolist() == [[False, True, False]] * 3


def test_what_is_not_taken():
    shape, seen = ALL["demo"], []
    assert fused.takes(shape)
    assert not fused.takes(MlpShape(13, 1, 3, fused.WIDEST + 4, 3))
    assert not fused.takes(MlpShape(fused.WIDEST + 1, 1, 3, 64, 3))

    @recorded
    def within(values: list) -> list:
        seen.append(fused.takes(shape))
        return [2 * values[0]]

    within([Case(shape, 3).device()[1][0]])
    assert seen == [False]
