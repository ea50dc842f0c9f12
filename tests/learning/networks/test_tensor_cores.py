"""Products on tensor cores beside float64, of sizes around the tiles' borders; when they are taken."""

import re

import drjit as dr
import numpy as np
import pytest

from spacesim.backend import ad, select
from spacesim.backend.kernels import ptx
from spacesim.backend.upload import upload
from spacesim.learning.networks import product_text, tensor_cores
from spacesim.learning.networks.network import CHUNK, MlpShape

WIDE = MlpShape(153, 25, 3, 256, 3)  # the thesis's
SIZES = [(4, 4, 1), (64, 60, 1), (128, 64, 2), (132, 68, 3), (256, 156, 5), (260, 132, 67)]  # rows, columns, matrices


@pytest.fixture
def _cuda() -> None:
    if select() != "cuda":
        pytest.skip("tensor cores are an NVIDIA GPU's")
    assert tensor_cores.is_usable()


def case(*shape: int) -> np.ndarray:
    """Numbers of which some are large and some small, float32."""
    rng = np.random.default_rng(sum(shape))
    return (rng.normal(size=shape) * 10.0 ** rng.integers(-4, 3, shape)).astype(np.float32)


def tensor(numbers: np.ndarray):
    return ad.TensorXf(upload(numbers.ravel()), numbers.shape)


def check(found, wanted: np.ndarray, of_sizes: np.ndarray) -> None:
    """As in float32: within the rounding of a few numbers as large as the sum of the products' sizes."""
    error = np.abs(np.array(found, np.float64).reshape(wanted.shape) - wanted)
    assert (error <= 2e-6 * of_sizes).all()
    assert np.abs(wanted).max() > 0


@pytest.mark.usefixtures("_cuda")
@pytest.mark.parametrize(("rows", "columns", "batch"), SIZES)
def test_products_match_float64(rows, columns, batch):
    matrix, bias = case(rows, columns), case(rows)
    items, gradient = case(batch, columns, CHUNK), case(batch, rows, CHUNK)
    a, v, x, g = (numbers.astype(np.float64) for numbers in (matrix, bias, items, gradient))
    flat = upload(matrix.ravel())
    sizes = np.abs(a) @ np.abs(x) + np.abs(v)[:, None]
    check(tensor_cores._hidden(flat, upload(bias), tensor(items)), np.maximum(a @ x + v[:, None], 0), sizes)
    back, sizes = a.T @ g, np.abs(a).T @ np.abs(g)
    check(tensor_cores._back(flat, tensor(gradient), columns), back, sizes)
    check(tensor_cores._back(flat, tensor(gradient), columns, tensor(items)), np.where(x > 0, back, 0), sizes)
    parts = np.array(tensor_cores._outer(tensor(gradient), tensor(items)), np.float64)
    parts = parts.reshape(min(batch, tensor_cores.PARTS), rows, columns)
    sizes = np.einsum("bmk,bnk->mn", np.abs(g), np.abs(x), optimize=True)
    check(parts.sum(axis=0), np.einsum("bmk,bnk->mn", g, x, optimize=True), sizes)


@pytest.mark.usefixtures("_cuda")
def test_of_numbers_of_one_sign_products_are_as_exact_as_in_float32():
    """What tensor cores cut off adds up there."""
    rows, columns, batch = 256, 256, 8
    matrix, bias = np.abs(case(rows, columns)), np.zeros(rows, np.float32)
    items, gradient = np.abs(case(batch, columns, CHUNK)), np.abs(case(batch, rows, CHUNK))
    flat, on_items, on_gradient = upload(matrix.ravel()), tensor(items), tensor(gradient)
    left = ad.TensorXf(flat, (rows, columns))
    exact = matrix.astype(np.float64) @ items
    outer = np.einsum("bmk,bnk->mn", gradient.astype(np.float64), items, optimize=True)
    pairs = [
        (tensor_cores._hidden(flat, upload(bias), on_items), dr.matmul(left, on_items), exact),
        (
            tensor_cores._back(flat, on_gradient, columns),
            dr.matmul(left, on_gradient, At=True),
            matrix.T.astype(np.float64) @ gradient,
        ),
        (tensor_cores._outer(on_gradient, on_items), dr.matmul(on_gradient, on_items, Bt=True), outer),
    ]
    for ours, theirs, wanted in pairs:
        errors = []
        for found in (ours, theirs):
            numbers = np.array(found, np.float64).reshape(-1, *wanted.shape).sum(axis=0)
            errors.append(np.abs(numbers / wanted - 1))
        assert errors[0].mean() < 1.5 * errors[1].mean() < 1e-6
        assert errors[0].max() < 2 * errors[1].max()


@pytest.mark.usefixtures("_cuda")
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_finite_is_not_taken_for_zero(value):
    items = case(1, 8, CHUNK)
    items[0, 3, 100] = value
    found = np.array(tensor_cores._hidden(upload(np.ones(64, np.float32)), upload(np.zeros(8)), tensor(items)))
    assert np.isnan(found[0, :, 100]).all()
    assert np.isfinite(np.delete(found[0], 100, axis=1)).all()


@pytest.mark.usefixtures("_cuda")
def test_products_repeat_to_the_bit_and_are_timed_when_that_is_asked_for():
    gradient, items = tensor(case(70, 256, CHUNK)), tensor(case(70, 156, CHUNK))
    ptx.take_times()
    first = np.array(tensor_cores._outer(gradient, items))
    assert ptx.take_times() == []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        again = [np.array(tensor_cores._outer(gradient, items)) for _ in range(5)]
    times = ptx.take_times()
    assert len(times) == 5
    assert all(0 < time < 100 for time in times)
    assert all(other.tobytes() == first.tobytes() for other in again)


@pytest.mark.usefixtures("_cuda")
def test_text_that_the_driver_does_not_take_is_named():
    with pytest.raises(RuntimeError, match="cuModuleLoadData failed"):
        ptx.PtxKernel("no text", "entry", 1, 1, 0, 32)


def test_wide_networks_of_few_outputs_take_them_where_kernels_can_be_launched(monkeypatch):
    monkeypatch.setattr(tensor_cores, "select", lambda: "cuda")
    monkeypatch.setattr(tensor_cores, "is_usable", lambda: True)
    assert tensor_cores.takes(WIDE, 2 * CHUNK)
    for shape in (
        MlpShape(17, 1, 3, 64, 3),  # narrow
        MlpShape(17, 1, 3, 256, 2),  # one hidden layer
        MlpShape(17, 1, 9, 256, 3),  # many outputs
        MlpShape(17, 1, 3, 255, 3),  # rows that are not copied by fours
    ):
        assert not tensor_cores.takes(shape, 2 * CHUNK)
    assert not tensor_cores.takes(WIDE, CHUNK + 128)
    assert not tensor_cores.takes(WIDE, 2**24)
    with dr.scoped_set_flag(dr.JitFlag.FreezingScope):
        assert not tensor_cores.takes(WIDE, 2 * CHUNK)
    monkeypatch.setattr(tensor_cores, "is_usable", lambda: False)
    assert not tensor_cores.takes(WIDE, 2 * CHUNK)


def test_a_product_that_is_no_number_is_seen(monkeypatch):
    wrong: list[str] = []

    def launched(kind, factors, shape, sizes, beside=None):
        value = float("nan") if kind == wrong[-1] else 0.0
        return ad.TensorXf(dr.full(ad.Float, value, int(np.prod(shape))), shape)

    monkeypatch.setattr(tensor_cores, "_launch", launched)
    for kind in ("hidden", "back", "outer"):
        wrong.append(kind)
        assert np.isnan(tensor_cores._largest_error())


def test_products_that_are_wrong_or_do_not_run_are_not_used(monkeypatch, caplog):
    monkeypatch.setattr(dr.detail, "cuda_compute_capability", lambda: 90)
    for error in (0.5, float("nan")):
        monkeypatch.setattr(tensor_cores, "_largest_error", lambda error=error: error)
        assert not tensor_cores.is_usable.__wrapped__()
        assert "not used" in caplog.text
        caplog.clear()
    monkeypatch.setattr(tensor_cores, "_largest_error", lambda: 1e-7)
    assert tensor_cores.is_usable.__wrapped__()
    for slow in (75, 86, 89, 120):
        monkeypatch.setattr(dr.detail, "cuda_compute_capability", lambda slow=slow: slow)
        assert not tensor_cores.is_usable.__wrapped__()

    def fails() -> float:
        raise RuntimeError("no such function")

    monkeypatch.setattr(dr.detail, "cuda_compute_capability", lambda: 90)
    monkeypatch.setattr(tensor_cores, "_largest_error", fails)
    assert not tensor_cores.is_usable.__wrapped__()


@pytest.mark.parametrize(("kind", "masked"), [("hidden", False), ("back", False), ("back", True), ("outer", False)])
def test_text_declares_what_it_uses(kind, masked):
    kernel = product_text.ProductText(kind, masked)
    text = kernel.text
    for letter, most in re.findall(r"\.reg \.\w+ %(\w+)<(\d+)>", text):
        numbers = {int(number) for number in re.findall(rf"%{letter}(\d+)\b", text)}
        assert numbers == set(range(int(most)))
    assert text.count("mma.sync") == 3 * product_text.DEPTH // 8 * (product_text.WARP_ROWS // 16) * (
        product_text.WARP_COLUMNS // 8
    )
    assert kernel.shared <= 99 * 1024, "what a block may have on all devices of capability 8"
    assert f".entry {kernel.entry}(" in text
