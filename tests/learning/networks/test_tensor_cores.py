"""Products on tensor cores beside float64, of sizes around the tiles' borders; when they are taken."""

import re

import drjit as dr
import numpy as np
import pytest

from spacesim.backend import ad, launch, select
from spacesim.backend.upload import upload
from spacesim.learning.networks import ptx, tensor_cores
from spacesim.learning.networks.network import MlpShape

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
    items, gradient = case(batch, columns, ptx.CHUNK), case(batch, rows, ptx.CHUNK)
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
def test_products_repeat_to_the_bit_and_are_timed_when_that_is_asked_for():
    gradient, items = tensor(case(70, 256, ptx.CHUNK)), tensor(case(70, 156, ptx.CHUNK))
    launch.take_times()
    first = np.array(tensor_cores._outer(gradient, items))
    assert launch.take_times() == []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        again = [np.array(tensor_cores._outer(gradient, items)) for _ in range(5)]
    times = launch.take_times()
    assert len(times) == 5
    assert all(0 < time < 100 for time in times)
    assert all(other.tobytes() == first.tobytes() for other in again)


@pytest.mark.usefixtures("_cuda")
def test_text_that_the_driver_does_not_take_is_named():
    with pytest.raises(RuntimeError, match="cuModuleLoadData failed"):
        launch.PtxKernel("no text", "entry", 1, 1, 0, 32)


def test_wide_networks_of_few_outputs_take_them_where_kernels_can_be_launched(monkeypatch):
    monkeypatch.setattr(tensor_cores, "select", lambda: "cuda")
    monkeypatch.setattr(tensor_cores, "is_usable", lambda: True)
    assert tensor_cores.takes(WIDE, 2 * ptx.CHUNK)
    for shape in (
        MlpShape(17, 1, 3, 64, 3),  # narrow
        MlpShape(17, 1, 3, 256, 2),  # one hidden layer
        MlpShape(17, 1, 9, 256, 3),  # many outputs
        MlpShape(17, 1, 3, 255, 3),  # rows that are not copied by fours
    ):
        assert not tensor_cores.takes(shape, 2 * ptx.CHUNK)
    assert not tensor_cores.takes(WIDE, ptx.CHUNK + 128)
    assert not tensor_cores.takes(WIDE, 2**24)
    with dr.scoped_set_flag(dr.JitFlag.FreezingScope):
        assert not tensor_cores.takes(WIDE, 2 * ptx.CHUNK)
    monkeypatch.setattr(tensor_cores, "is_usable", lambda: False)
    assert not tensor_cores.takes(WIDE, 2 * ptx.CHUNK)


def test_products_that_are_wrong_or_do_not_run_are_not_used(monkeypatch, caplog):
    monkeypatch.setattr(dr.detail, "cuda_compute_capability", lambda: 90)
    for error in (0.5, float("nan")):
        monkeypatch.setattr(tensor_cores, "_largest_error", lambda error=error: error)
        assert not tensor_cores.is_usable.__wrapped__()
        assert "not used" in caplog.text
    monkeypatch.setattr(tensor_cores, "_largest_error", lambda: 1e-7)
    assert tensor_cores.is_usable.__wrapped__()
    monkeypatch.setattr(dr.detail, "cuda_compute_capability", lambda: 75)
    assert not tensor_cores.is_usable.__wrapped__()

    def fails() -> float:
        raise RuntimeError("no such function")

    monkeypatch.setattr(dr.detail, "cuda_compute_capability", lambda: 90)
    monkeypatch.setattr(tensor_cores, "_largest_error", fails)
    assert not tensor_cores.is_usable.__wrapped__()


@pytest.mark.parametrize(("kind", "masked"), [("hidden", False), ("back", False), ("back", True), ("outer", False)])
def test_text_declares_what_it_uses(kind, masked):
    kernel = ptx.ProductText(kind, masked)
    text = kernel.text
    for letter, most in re.findall(r"\.reg \.\w+ %(\w+)<(\d+)>", text):
        numbers = {int(number) for number in re.findall(rf"%{letter}(\d+)\b", text)}
        assert numbers == set(range(int(most)))
    assert text.count("mma.sync") == 3 * ptx.DEPTH // 8 * (ptx.WARP_ROWS // 16) * (ptx.WARP_COLUMNS // 8)
    assert kernel.shared <= 99 * 1024, "what a block may have on all devices of capability 8"
    assert f".entry {kernel.entry}(" in text
