"""Kernels of LLVM's text: what they compute, when they run, and that Dr.Jit's give the same lists and gradients, to the
bit. The loss is in tests/splat/train/loss/."""

import drjit as dr
import numpy as np
import pytest
from splat.splats import random_splats
from splat.twin import record

from spacesim.backend import ad, recorded
from spacesim.backend.kernels import llvm
from spacesim.backend.kernels.llvm import LlvmKernel, empty, is_usable
from spacesim.backend.kernels.llvm_text import Text
from spacesim.backend.upload import upload
from spacesim.splat.raster import adjoint, blend, slot_sums
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.lists import bin as binning
from spacesim.splat.raster.lists import pair_sort, record_copy
from spacesim.splat.raster.project import Pinhole, project
from spacesim.splat.train.loss import photometric_llvm

pytestmark = [pytest.mark.threads, pytest.mark.usefixtures("kernels_of_text")]


def numbers(count: int) -> np.ndarray:
    return np.random.default_rng(count).integers(0, 1000, count).astype(np.uint32)


def test_stages_follow_each_other_with_all_indices():
    """The second stage reads what all threads of the first have written; a loop's state goes on from turn to turn."""

    def square(text: Text) -> None:
        value = text.load("values", text.index)
        text.store("squares", text.index, value * value)

    def add_up(text: Text) -> None:
        with text.loop(text.integer(0), text.number("count"), [text.integer(text_start)]) as loop:
            loop.following = [loop.state[0] + text.load("squares", loop.at)]
        text.store("sum", text.integer(0), loop.state[0])

    text_start, values = 7, numbers(500)
    kernel = LlvmKernel(["values", "squares", "sum"], ["count"], ("square", square), ("add_up", add_up))
    squares, total = empty(ad.UInt32, len(values)), empty(ad.UInt32, 1)
    kernel([len(values), 1], [upload(values, ad.UInt32), squares, total], [len(values)])
    np.testing.assert_array_equal(np.array(squares), values**2)
    assert total[0] == (values.astype(np.int64) ** 2).sum() + text_start


def test_numbers_are_rounded_as_float32():
    def write(text: Text) -> None:
        pair = text.load_floats("values", text.integer(0), 2)
        x, y = pair.entry(0), pair.entry(1)
        results = [
            x + y,
            x - y,
            x * y,
            x / y,
            text.fma(x, y, text.one_float(-0.1)),
            text.maximum(x, y),
            text.maximum(y, x),
        ]
        for i, result in enumerate([*results, text.one_float(1 / 3)]):
            text.store("results", text.integer(i), result)
        text.store("results", text.integer(8), pair + pair)

    x, y, results = np.float32(1.1), np.float32(0.3), empty(ad.Float, 10)
    LlvmKernel(["values", "results"], [], ("write", write))([1], [upload(np.array([x, y])), results], [])
    fused = np.float32(np.float64(x) * np.float64(y) + np.float64(np.float32(-0.1)))
    expected = [x + y, x - y, x * y, x / y, fused, x, x, np.float32(1 / 3), x + x, y + y]
    np.testing.assert_array_equal(np.array(results), np.array(expected, np.float32))


def test_launches_and_dr_jit_take_turns():
    """Each reads what the other has written, many times over, without a wait between; memory of arrays that are gone is
    taken again behind who reads it."""

    def add(text: Text) -> None:
        with text.loop(text.index * 4096, (text.index + 1) * 4096) as loop:
            text.store("target", loop.at, text.load("source", loop.at) + text.number("added"))

    kernel, count = LlvmKernel(["source", "target"], ["added"], ("add", add)), 2**20
    values = dr.zeros(ad.UInt32, count)
    for i in range(50):
        target = empty(ad.UInt32, count)
        kernel([count // 4096], [2 * values, target], [i])
        values = target % 1000 + 1
    expected = 0
    for i in range(50):
        expected = (2 * expected + i) % 1000 + 1
    assert dr.all(values == expected)


def test_text_that_is_none_is_said_to_be_so():
    with pytest.raises(RuntimeError, match=r"LLVM: .*expected instruction opcode"):
        LlvmKernel([], [], ("wrong", lambda text: text.do("no such instruction")))


def test_no_recording_takes_a_launch_in():
    seen = []

    @recorded
    def double(values: list) -> list:
        seen.append(is_usable())
        return [2 * values[0]]

    double([upload(np.ones(3, np.float32))])
    assert seen == [False]
    assert is_usable()
    kernel, result = LlvmKernel(["result"], [], ("write", lambda text: None)), empty(ad.Float, 3)

    @recorded
    def launch(values: list) -> list:
        kernel([1], [result], [])
        return values

    with pytest.raises(RuntimeError, match="while recording") as raised:
        launch([upload(np.ones(3, np.float32))])
    assert "launched between recordings" in str(raised.value.__cause__)


def test_without_the_library_dr_jit_computes(monkeypatch, caplog):
    monkeypatch.setattr(llvm, "dr_library", lambda: None)
    caplog.set_level("INFO")
    for function in (llvm._threads, llvm._runs):
        function.cache_clear()
    try:
        assert not is_usable()
    finally:
        monkeypatch.undo()
        for function in (llvm._threads, llvm._runs):
            function.cache_clear()
    assert "no kernels beside Dr.Jit's, which take longer" in caplog.text
    assert is_usable()


@pytest.mark.parametrize("size", [(61, 45), (8, 8), (1, 1), (200, 150)])
@pytest.mark.parametrize("count", [1, 40, 3000])
@pytest.mark.parametrize(("channels", "absolute"), [(3, True), (1, False), (8, True), (0, False)])
def test_dr_jits_kernels_give_the_same_bits(size, count, channels, absolute, monkeypatch):
    view = record("perspective", *size)
    splats, footprints = project(Gaussians.from_numpy(random_splats(count, seed=count, degree=0)), Pinhole.of(view))
    rng = np.random.default_rng(1)
    features = [upload(row) for row in rng.normal(size=(channels, count)).astype(np.float32)]
    weights = [upload(row) for row in rng.normal(size=(channels + 1, size[0] * size[1])).astype(np.float32)]

    def results() -> list[np.ndarray]:
        lists = binning.bin_splats(splats, footprints, *size)
        assert lists.pairs > 0
        blended = blend.forward(splats, features, lists, *size, adjoint=True)
        found = blend.backward(splats, blended, lists, size, weights[:-1], weights[-1], absolute)
        gradients = [getattr(found.splats, name) for name in slot_sums.SHAPE] + found.features
        gradients += [found.absolute_x, found.absolute_y] if absolute else []
        places = [lists.splat, lists.start, lists.end, lists.place, lists.order, lists.first_slot, lists.slot_count]
        return [np.array(value) for value in [*places, *blended.features, blended.transmittance, *gradients]]

    launched = []
    with monkeypatch.context() as patch:
        for module in (pair_sort, record_copy, slot_sums):
            kernel = module._kernel
            patch.setattr(module, "_kernel", lambda *of, m=module, k=kernel: launched.append(m) or k(*of))
        ours = results()
    assert {*launched} == {pair_sort, record_copy, slot_sums}
    for module in (binning, blend, record_copy, adjoint):
        monkeypatch.setattr(module, "is_usable", lambda: False)
    for value, other in zip(ours, results(), strict=True):
        np.testing.assert_array_equal(value, other)
    gradients = ours[7 + channels + 1 :]
    assert gradients
    assert all(np.abs(value).max() > 0 for value in gradients)


@pytest.mark.parametrize("threads", [1, 16, 64])
def test_no_bit_depends_on_the_number_of_threads(threads):
    """Of lists, gradients and the loss; a picture of several blocks of columns."""
    count, size = 5000, (300, 90)
    view, rng = record("perspective", *size), np.random.default_rng(2)
    splats, footprints = project(Gaussians.from_numpy(random_splats(count, seed=3, degree=0)), Pinhole.of(view))
    features = [upload(row) for row in rng.uniform(size=(3, count)).astype(np.float32)]
    picture = ad.Array3f([upload(row) for row in rng.uniform(size=(3, size[0] * size[1])).astype(np.float32)])

    def results() -> list[np.ndarray]:
        lists = binning.bin_splats(splats, footprints, *size)
        blended = blend.forward(splats, features, lists, *size, adjoint=True)
        sums, gradient = photometric_llvm.loss_and_gradient(ad.Array3f(blended.features), picture, *size, 0.2)
        found = blend.backward(splats, blended, lists, size, list(gradient), blended.transmittance)
        values = [getattr(found.splats, name) for name in slot_sums.SHAPE] + found.features
        return [np.array(value) for value in (lists.splat, lists.place, lists.end, sums, *gradient, *values)]

    before, usual = results(), dr.thread_count()
    dr.set_thread_count(threads)
    try:
        found = results()
    finally:
        dr.set_thread_count(usual)
    for value, other in zip(before, found, strict=True):
        np.testing.assert_array_equal(value, other)


def test_literals_have_memory_of_their_own():
    """Numbers that stand for whole planes are told apart, and made as long as these."""
    rng, (width, height) = np.random.default_rng(3), (40, 30)
    prediction = ad.Array3f([upload(row) for row in rng.uniform(size=(3, width * height)).astype(np.float32)])
    whole = ad.Array3f([upload(np.full(width * height, value, np.float32)) for value in (0.1, 0.5, 0.9)])
    expected, gradient = photometric_llvm.loss_and_gradient(prediction, whole, width, height, 0.2)
    literals = ad.Array3f([dr.full(ad.Float, value, width * height) for value in (0.1, 0.5, 0.9)])
    for target in (literals, ad.Array3f(0.1, 0.5, 0.9)):
        sums, found = photometric_llvm.loss_and_gradient(prediction, target, width, height, 0.2)
        np.testing.assert_array_equal(np.array(sums), np.array(expected))
        np.testing.assert_array_equal(np.array(found), np.array(gradient))
