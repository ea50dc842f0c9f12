"""Networks on columns in chunks against numpy in float64: sizes around the borders of chunks, and to the bit twice."""

import drjit as dr
import numpy as np
import pytest

from spacesim.backend import ad, recorded
from spacesim.backend.upload import upload
from spacesim.learning.networks import mlp, network
from spacesim.learning.networks.network import CHUNK, MlpShape, round_up_rows
from spacesim.splat.light import cooperative
from spacesim.splat.light.padded_batch import PaddedBatch

SHAPES = {
    "filled up": MlpShape(5, 3, 2, 12, 3),
    "as it is": MlpShape(8, 2, 1, 16, 2),
    "one layer": MlpShape(7, 1, 3, 4, 1),
    "narrow": MlpShape(6, 2, 4, 3, 4),
    "many outputs": MlpShape(5, 1, 6, 8, 2),
}
COUNTS = [1, CHUNK - 1, CHUNK, CHUNK + 1, 2 * CHUNK - 1, 2 * CHUNK, 2 * CHUNK + 1, 5 * CHUNK + 77]


def numbers(values) -> np.ndarray:
    return np.array(values, dtype=np.float64)


def columns(tensor, count: int) -> np.ndarray:
    """[C, N] of [B, C, m], or of rows [B * m]."""
    array = numbers(tensor)
    if isinstance(tensor, list):
        return array[:, :count]
    return array.transpose(1, 0, 2).reshape(array.shape[1], -1)[:, :count]


def twin(shape, weights, items, shared, grad_output):
    """(outputs [outputs, N], gradients of the weights, of the items [inputs, N]) in float64."""
    matrices = [weight.reshape(size) for weight, size in zip(weights[1::2], shape.sizes, strict=True)]
    biases = [bias[:, None] for bias in weights[2::2]]
    biases[0] = biases[0] + weights[0].reshape(-1, shape.shared) @ shared[:, None]
    values = [items]
    for i, (matrix, bias) in enumerate(zip(matrices, biases, strict=True)):
        value = matrix @ values[-1] + bias
        values.append(value if i == shape.layers - 1 else np.maximum(value, 0))
    gradients, grad_values = [np.zeros(0)] * len(weights), grad_output
    for i in reversed(range(shape.layers)):
        gradients[1 + 2 * i] = (grad_values @ values[i].T).ravel()
        gradients[2 + 2 * i] = grad_values.sum(axis=1)
        if i == 0:
            gradients[0] = np.outer(grad_values.sum(axis=1), shared).ravel()
        grad_values = matrices[i].T @ grad_values
        if i > 0:
            grad_values = grad_values * (values[i] > 0)
    return values[-1], gradients, grad_values


class Case:
    """A network of random weights, items of N Gaussians and gradients of what it says of them."""

    def __init__(self, shape: MlpShape, count: int) -> None:
        rng = np.random.default_rng(count)
        self.shape, self.count = shape, count
        self.weights = network.initial_weights(shape, rng)
        self.shared = rng.normal(size=shape.shared).astype(np.float32)
        self.items = rng.normal(size=(shape.inputs, count)).astype(np.float32)
        self.grad_output = rng.normal(size=(shape.outputs, count)).astype(np.float32)

    def device(self) -> list:
        """Weights, items, shared, gradients: as the networks read them."""
        floats = [[upload(v) for v in values] for values in (self.weights, self.items, self.grad_output)]
        return [floats[0], floats[1], upload(self.shared), floats[2], PaddedBatch.of(self.count)]

    def exact(self):
        doubles = [np.float64(weight) for weight in self.weights]
        return twin(self.shape, doubles, *map(np.float64, (self.items, self.shared, self.grad_output)))

    def check(self, output, gradients: list, grad_items) -> None:
        """Both passes beside float64."""
        exact, exact_gradients, exact_by_items = self.exact()
        np.testing.assert_allclose(columns(output, self.count), exact, atol=2e-6)
        np.testing.assert_allclose(columns(grad_items, self.count)[: self.shape.inputs], exact_by_items, atol=5e-6)
        assert len(gradients) == len(self.weights)
        for one, other, weight in zip(gradients, exact_gradients, self.weights, strict=True):
            assert dr.width(one) == len(weight)
            np.testing.assert_allclose(numbers(one), other, rtol=1e-4, atol=1e-6 * (100 + self.count))


def passes(shape, weights, rows, shared, grad_rows, batch):
    items = batch.matrix([batch.pad_zeros(row) for row in rows], shape.rows)
    output, tape = mlp.forward(shape, weights, items, shared)
    grad_output = batch.matrix([batch.pad_zeros(row) for row in grad_rows])
    gradients, grad_items = mlp.backward(shape, weights, tape, shared, grad_output)
    return output, gradients, grad_items


@pytest.fixture(params=["the backend's way", "CUDA's way"])
def _ways(request, monkeypatch) -> None:
    """That of CUDA gives the same on a CPU, where it is slower."""
    if request.param == "CUDA's way":
        monkeypatch.setattr(mlp, "select", lambda: "cuda")


@pytest.mark.usefixtures("_ways")
@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("name", SHAPES)
def test_networks_and_their_adjoint_match_float64(name, count):
    case = Case(SHAPES[name], count)
    output, gradients, grad_items = passes(case.shape, *case.device())
    assert len(output) == case.shape.outputs
    assert dr.width(output) == case.device()[-1].capacity
    case.check(output, gradients, grad_items)


@pytest.mark.usefixtures("_ways")
def test_recorded_passes_repeat_to_the_bit_and_serve_other_sizes():
    shape = SHAPES["filled up"]
    record = recorded(passes, limit=16)
    for count in (700, 900, CHUNK + 1, 5000, 700):  # the first three have one capacity
        case = Case(shape, count)
        output, gradients, _ = record(shape, *case.device())
        again, same, _ = record(shape, *case.device())
        assert numbers(output).tobytes() == numbers(again).tobytes()
        for one, other in zip(gradients, same, strict=True):
            assert numbers(one).tobytes() == numbers(other).tobytes()
        exact, exact_gradients, _ = case.exact()
        np.testing.assert_allclose(columns(output, count), exact, atol=2e-6)
        np.testing.assert_allclose(numbers(gradients[1]), exact_gradients[1], rtol=1e-4, atol=1e-2)


def test_recordings_are_as_wide_as_the_columns_whatever_they_read():
    record = recorded(lambda packed, batch: batch.matrix(batch.block(packed, 4, 2)), limit=16)
    for count in (512, 1000, 300):  # 512: the packed rows are a multiple of the columns, and more than the matrix
        packed = np.random.default_rng(count).normal(size=(38, count)).astype(np.float32)
        found = record(upload(packed.ravel()), PaddedBatch.of(count))
        np.testing.assert_array_equal(columns(found, count), packed[4:6])
        np.testing.assert_array_equal(columns(found, 1024)[:, count:], np.repeat(packed[4:6, -1:], 1024 - count, 1))


@pytest.mark.parametrize("first", [1, 4, 7])
def test_a_network_that_knows_first_inputs_says_the_same(first):
    case = Case(MlpShape(9, 3, 2, 12, 3), CHUNK + 1)
    weights, rows, shared, _, batch = case.device()
    rows = [batch.pad_zeros(row) for row in rows]
    known = mlp.first_layer_part(case.shape, weights, batch.matrix(rows[:first], round_up_rows(first)), first)
    output, _ = mlp.forward(case.shape, weights, batch.matrix(rows[first:], round_up_rows(9 - first)), shared, known)
    np.testing.assert_allclose(columns(output, case.count), case.exact()[0], atol=2e-6)


def test_columns_beyond_the_gaussians_change_nothing():
    shape, count = SHAPES["as it is"], 1500
    case = Case(shape, count)
    weights, rows, shared, grad_rows, batch = case.device()
    _, gradients, _ = passes(shape, weights, rows, shared, grad_rows, batch)
    wide = [upload(np.append(row, np.full(9, 7e3))) for row in case.items]  # beyond N: never read
    _, same, _ = passes(shape, weights, wide, shared, grad_rows, batch)
    for one, other in zip(gradients, same, strict=True):
        np.testing.assert_array_equal(numbers(one), numbers(other))


@pytest.mark.parametrize("still", [False, True])
@pytest.mark.parametrize("count", [1, CHUNK - 1, CHUNK, 31622, 100_000])
def test_columns_are_more_than_the_gaussians_and_whole_chunks(count, still):
    batch = PaddedBatch.of(count, still)
    assert numbers(batch.count) == count
    assert count < batch.capacity <= (count + CHUNK if still else 9 / 8 * count + 1024)
    assert batch.capacity % CHUNK == 0


def test_weights_have_the_size_that_the_shape_says():
    for shape in SHAPES.values():
        weights = network.initial_weights(shape, np.random.default_rng(0))
        assert sum(map(len, weights)) == shape.parameters
        assert shape.inputs <= shape.rows < shape.inputs + 4
        assert shape.rows % 4 == 0


@pytest.mark.parametrize("count", COUNTS)
def test_rows_come_back_from_matrices(count):
    rng, batch = np.random.default_rng(1), PaddedBatch.of(count)
    packed = rng.normal(size=(6, count)).astype(np.float32)
    like = upload(np.zeros(count))
    one = batch.matrix([*batch.block(upload(packed.ravel()), 1, 3), ad.Float(2)], round_up_rows(5))
    assert one.shape == (batch.capacity // CHUNK, 8, CHUNK)
    np.testing.assert_array_equal(columns(one, count)[:3], packed[1:4])
    np.testing.assert_array_equal(columns(one, count)[3:], np.repeat([[2.0], [0], [0], [0], [0]], count, axis=1))
    rows = [network.row_of(one, i) for i in (2, 0)]
    dr.eval(rows)
    for row, i in zip(batch.unpad(rows, like), (3, 1), strict=True):
        np.testing.assert_array_equal(numbers(row), packed[i])
    other = batch.matrix([batch.repeat_last(ad.Float(packed[5]))])
    back = batch.pack([(one, 1, 2), (other, 0, 1)], upload(np.zeros(3 * count)))
    np.testing.assert_array_equal(numbers(back).reshape(3, count), packed[[2, 3, 5]])


def test_cooperative_vectors_give_the_same_colors():
    assert cooperative.is_usable()
    shape, count = MlpShape(57, 25, 3, 64, 3), 700
    record = recorded(cooperative.forward, limit=4, elements=None)
    for seed in range(2):  # the second with other weights, by the recording of the first
        case = Case(shape, count + seed)
        weights, rows, shared, _, batch = case.device()
        found = record(shape, cooperative.pack(shape, weights), [batch.repeat_last(row) for row in rows], shared)
        exact, *_ = case.exact()
        for row, other in zip(found, exact, strict=True):
            np.testing.assert_allclose(
                1 / (1 + np.exp(-numbers(row)[: case.count])), 1 / (1 + np.exp(-other)), atol=2e-3
            )


def test_cooperative_vectors_that_fail_or_lie_are_not_used(monkeypatch, caplog):
    def fails() -> float:
        raise RuntimeError("no OptiX here")

    for tried, message in (
        (fails, "no OptiX here"),
        (lambda: 0.1, "wrong by 0.1"),
        (lambda: float("nan"), "wrong by nan"),
    ):
        monkeypatch.setattr(cooperative, "_largest_difference", tried)
        cooperative.is_usable.cache_clear()
        assert not cooperative.is_usable()
        assert message in caplog.records[-1].getMessage()
    cooperative.is_usable.cache_clear()


@pytest.mark.usefixtures("_ways")
def test_networks_that_go_back_together_have_the_same_gradients():
    ways, alone = [], []
    for name in SHAPES:
        case = Case(SHAPES[name], CHUNK + 1)
        weights, rows, shared, grad_rows, batch = case.device()
        items = batch.matrix([batch.pad_zeros(row) for row in rows], case.shape.rows)
        _, tape = mlp.forward(case.shape, weights, items, shared)
        grad_output = batch.matrix([batch.pad_zeros(row) for row in grad_rows])
        ways.append(network.WayBack(case.shape, weights, tape, shared, grad_output))
        alone.append(mlp.backward(case.shape, weights, tape, shared, grad_output))
    for one, other in zip(mlp.backward_together(ways), alone, strict=True):
        np.testing.assert_array_equal(numbers(one[1]), numbers(other[1]))
        for gradient, same in zip(one[0], other[0], strict=True):
            np.testing.assert_array_equal(numbers(gradient), numbers(same))


@pytest.mark.usefixtures("_ways")
@pytest.mark.parametrize(("wanted", "found"), [(59, 60), (65, 68), (129, 132)])
def test_gradients_of_first_items_alone_are_the_same(wanted, found):
    case = Case(MlpShape(130, 2, 3, 12, 3), CHUNK + 1)
    weights, rows, shared, grad_rows, batch = case.device()
    _, tape = mlp.forward(case.shape, weights, batch.matrix([batch.pad_zeros(row) for row in rows], 132), shared)
    grad_output = batch.matrix([batch.pad_zeros(row) for row in grad_rows])
    way = network.WayBack(case.shape, weights, tape, shared, grad_output, wanted)
    [(gradients, some)], (expected, whole) = (
        mlp.backward_together([way]),
        mlp.backward(case.shape, weights, tape, shared, grad_output),
    )
    assert (some.shape[1], whole.shape[1]) == (found, 132)
    np.testing.assert_allclose(numbers(some)[:, :wanted], numbers(whole)[:, :wanted], atol=1e-6)
    for gradient, same in zip(gradients, expected, strict=True):
        np.testing.assert_array_equal(numbers(gradient), numbers(same))
