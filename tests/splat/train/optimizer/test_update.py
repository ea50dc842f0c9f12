"""Adam in parts: against numpy, with gradients of whole pictures; what it leaves alone; what it holds."""

import gc

import drjit as dr
import numpy as np
import pytest
from splats import random_splats

from spacesim.backend import ad, select
from spacesim.backend.upload import upload
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera
from spacesim.learning.adam import BETA1, BETA2, EPSILON
from spacesim.splat.raster.blend import backward, forward
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.lists.bin import bin_splats
from spacesim.splat.raster.project import Pinhole
from spacesim.splat.raster.render import render
from spacesim.splat.train.optimizer import update as update_module
from spacesim.splat.train.optimizer.adam import Adam
from spacesim.splat.train.optimizer.update import Update, ViewGradients
from spacesim.splat.train.stages import project_views

SIZE = 40, 28


def camera(side: float) -> Camera:
    return Camera(look_at([2.5, side, 0.6], [0.0, 0.0, 0.0]), *SIZE, 50.0, 48.0, 20.5, 13.5)


def view_gradients(gaussians: Gaussians, view: Pinhole, weights: list, degree: int) -> ViewGradients:
    """By hand, as the trainer goes: of sum(weights * (r, g, b, transmittance))."""
    splats, footprints, values, _ = project_views(gaussians.rows(), view, degree, False, (), 1.0)
    lists = bin_splats(splats, footprints, *SIZE)
    blended = forward(splats, values["color"], lists, *SIZE, adjoint=True)
    found = backward(splats, blended, lists, SIZE, weights[:3], weights[3])
    return ViewGradients(view, found.splats, {"color": found.features})


def picture_gradients(arrays: dict, views: list[Pinhole], weights: list, degree: int) -> list[np.ndarray]:
    """By Dr.Jit through `render`: of the mean over the views of the same sum, a row each."""
    gaussians = Gaussians.from_numpy(arrays)
    rows = [ad.Float(row) for row in gaussians.rows()]
    dr.enable_grad(rows)
    total = ad.Float(0)
    for view in views:
        output = render(Gaussians.from_rows(list(rows)), view, sh_degree=degree)
        for weight, plane in zip(weights, [*output.color, 1 - output.alpha], strict=True):
            total += dr.sum(weight * plane) / len(views)
    dr.backward(total)
    return [np.array(dr.grad(row), np.float64) * np.ones(len(arrays["means"])) for row in rows]


@pytest.mark.parametrize(("degree", "sides"), [(0, [0.8]), (1, [0.8]), (2, [0.8, -1.5]), (3, [0.8]), (3, [0.8, -1.5])])
def test_a_step_is_adams_by_the_gradient_of_the_mean_picture(degree, sides):
    arrays, views = random_splats(150, seed=3), [Pinhole.of(camera(side)) for side in sides]
    arrays["sh"][:40] -= 1.0  # colours of some are cut off at black
    rng, gaussians = np.random.default_rng(1), Gaussians.from_numpy(arrays)
    weights = [upload(row) for row in rng.normal(size=(4, SIZE[0] * SIZE[1])).astype(np.float32)]
    optimizer, before = Adam(gaussians.rows()), [np.array(row, np.float64) for row in gaussians.rows()]
    live = [row < 11 + 3 * (degree + 1) ** 2 for row in range(len(before))]
    first = [scale * rng.normal(size=150) for scale in live]
    second = [scale * rng.uniform(0.1, 1, 150) for scale in live]
    optimizer.put([row.astype(np.float32) for row in first], [row.astype(np.float32) for row in second])
    gradients = [view_gradients(gaussians, view, weights, degree) for view in views]
    rates = rng.uniform(0.01, 0.1, len(before))
    Update(False, 1.0)(gaussians, optimizer, degree, gradients, ad.Float([1.5, 1.2, *rates]), {})
    found = optimizer.moments()
    for row, grad_rows in enumerate(picture_gradients(arrays, views, weights, degree)):
        m = BETA1 * first[row] + (1 - BETA1) * grad_rows
        v = BETA2 * second[row] + (1 - BETA2) * grad_rows**2
        moved = before[row] - rates[row] * 1.5 * m / (np.sqrt(1.2 * v) + EPSILON)
        scale = np.abs(grad_rows).max() + 1
        np.testing.assert_allclose(found[0][row], m, atol=1e-4 * scale, err_msg=str(row))
        np.testing.assert_allclose(found[1][row], v, atol=1e-4 * scale**2, err_msg=str(row))
        np.testing.assert_allclose(np.array(gaussians.rows()[row]), moved, atol=2e-4, err_msg=str(row))
    assert any(np.abs(row).max() > 0.1 for row in picture_gradients(arrays, views, weights, degree)[11:])


def test_harmonics_of_higher_degrees_stay_as_they_are():
    gaussians = Gaussians.from_numpy(random_splats(50))
    before, view = [np.array(row) for row in gaussians.rows()], Pinhole.of(camera(0.8))
    weights = [dr.ones(ad.Float, SIZE[0] * SIZE[1])] * 4
    optimizer, update = Adam(gaussians.rows()), Update(False, 1.0)
    factors = ad.Float([1.0, 1.0, *[0.1] * len(before)])
    for degree, moved in ((0, 14), (1, 23), (2, 38), (3, 59)):
        update(gaussians, optimizer, degree, [view_gradients(gaussians, view, weights, degree)], factors, {})
        after = [np.array(row) for row in gaussians.rows()]
        assert all((x != y).any() for x, y in zip(before[:moved], after[:moved], strict=True))
        for x, y in zip(before[moved:], after[moved:], strict=True):
            np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize("at_once", [False, True])
def test_what_views_show_and_networks_move_with_the_gaussians(monkeypatch, at_once):
    """A part of the step's recording or one of their own: the state by all views, weights by their mean gradient."""
    monkeypatch.setattr(update_module, "moves_at_once", lambda _gaussians: at_once)

    def observe(state, seen):
        return {"sum": state["sum"] + sum(seen)}

    gaussians, view = Gaussians.from_numpy(random_splats(50)), Pinhole.of(camera(0.8))
    weights = [dr.ones(ad.Float, SIZE[0] * SIZE[1])] * 4
    optimizer, update = Adam(gaussians.rows()), Update(False, 1.0, observe=observe)
    factors, before = ad.Float([1.0, 1.0, *[0.1] * 59]), np.array(gaussians.means)
    state, learned = (
        {"sum": dr.opaque(ad.Float, 0, 50)},
        ([ad.Float([3.0, 4.0])], [ad.Float([0, 0])], [ad.Float([0, 0])]),
    )
    for step in range(1, 4):
        gradients = [view_gradients(gaussians, view, weights, 3) for _ in range(2)]
        for k, one in enumerate(gradients):
            one.seen = dr.opaque(ad.Float, 1.0 + k, 50)
        moved, *moments = learned
        networks = moved, tuple(moments), [[ad.Float([1.0, 0.0])], [ad.Float([3.0, 0.0])]], ad.Float([1.0, 1.0, 0.5])
        state, learned = update(gaussians, optimizer, 3, gradients, factors, {}, (), state, networks)
        assert not gradients
        assert np.array(state["sum"]).tolist() == [3.0 * step] * 50
        assert np.array(learned[1][0])[0] == pytest.approx(2 * (1 - BETA1**step))
    assert (np.array(gaussians.means) != before).any()
    assert np.array(learned[0][0])[0] < 3.0
    assert np.array(learned[0][0])[1] == 4.0
    assert update(gaussians, optimizer, 3, [view_gradients(gaussians, view, weights, 3)], factors, {}) == ({}, None)


@pytest.mark.parametrize("name", ["isotropy", "opacity", "scale"])
def test_a_step_does_not_depend_on_what_was_recorded(name):
    """Nor on how many Gaussians there were when it was: training goes on after a pause with the same bits."""
    view, old, found = Pinhole.of(camera(0.8)), Update(False, 1.0), []
    for update, counts in ((old, (3931, 3997)), (Update(False, 1.0), (3997,))):
        for count in counts:
            gaussians = Gaussians.from_numpy(random_splats(count))
            weights = [dr.ones(ad.Float, SIZE[0] * SIZE[1])] * 4
            optimizer, factors = Adam(gaussians.rows()), ad.Float([1.0, 1.0, *[0.1] * 59])
            penalties = {name: dr.opaque(ad.Float, 300.0 / count)}
            update(gaussians, optimizer, 3, [view_gradients(gaussians, view, weights, 3)], factors, penalties)
        found.append(np.stack(optimizer.moments()[0]))
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize("surfels", [False, True])
def test_no_scale_gets_larger_than_it_may(surfels):
    """Those that are smaller move as they do without a bound."""
    view, scales, bound = Pinhole.of(camera(0.8)), [], float(np.log(0.05))
    for largest in ([], [dr.opaque(ad.Float, bound)]):
        gaussians = Gaussians.from_numpy(random_splats(300))
        weights = [dr.ones(ad.Float, SIZE[0] * SIZE[1])] * 4
        optimizer, factors = Adam(gaussians.rows()), ad.Float([1.0, 1.0, *[0.1] * 59])
        gradients = [view_gradients(gaussians, view, weights, 3)]
        Update(False, 1.0, surfels)(gaussians, optimizer, 3, gradients, factors, {}, largest)
        scales.append(np.array(gaussians.log_scales))
    free, held = scales
    assert (free[1:] > bound).any()
    assert (free[1:] < bound).any()
    np.testing.assert_array_equal(held[1:], np.minimum(free[1:], np.float32(bound)))


@pytest.mark.parametrize("lit", [False, True])
@pytest.mark.parametrize("surfels", [False, True])
def test_parts_move_alike_at_once_and_one_by_one(surfels, lit, monkeypatch):
    view, found, rng = Pinhole.of(camera(0.8)), [], np.random.default_rng(0)
    features, by_features = rng.normal(size=(2, 4 * 300)).astype(np.float32)
    weights = [dr.ones(ad.Float, SIZE[0] * SIZE[1])] * 4
    for at_once in (False, True):
        monkeypatch.setattr(update_module, "moves_at_once", lambda _, at_once=at_once: at_once)
        drawn = Gaussians.from_numpy(random_splats(300))
        gaussians = Gaussians.from_rows([*drawn.shape_rows(), upload(features)]) if lit else drawn
        optimizer, factors = Adam(gaussians.rows()), ad.Float([1.0, 1.0, *[0.1] * 59])
        step = Update(False, 1.0, surfels)
        for degree in (0, 2, 3, 3):
            gradients = view_gradients(drawn, view, weights, degree)
            gradients.grad_features = upload(by_features) if lit else None
            step(gaussians, optimizer, degree, [gradients], factors, {})
        assert (gaussians.features is None) != lit
        found.append([np.array(row) for row in gaussians.rows()] + optimizer.moments()[1])
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)
    assert all(len(np.unique(row)) > 1 for row in found[0])


def test_all_parts_move_at_once_where_rows_fill_their_memory(monkeypatch):
    monkeypatch.setattr(update_module, "select", lambda: "cuda")
    counts = 12_822, 15_564, 15_565, 16_384, 16_385, 31_129, 31_622, 32_768, 32_769, 65_536
    drawn = {count: Gaussians.random(count, 1.0, 0.1) for count in counts}
    at_once = [count for count in counts if update_module.moves_at_once(drawn[count])]
    assert at_once == [15_565, 16_384, 31_622, 32_768]
    lit = Gaussians.from_rows([*drawn[16_385].shape_rows(), dr.zeros(ad.Float, 4 * 16_385)])
    assert update_module.moves_at_once(lit)


def test_a_step_of_many_holds_few_rows_twice(monkeypatch):
    """Beyond the rows and their moments, less than half as much again, where all at once would be as much again."""
    monkeypatch.setattr(update_module, "moves_at_once", lambda _: False)
    count, view = 2**15, Pinhole.of(camera(0.8))
    arrays = random_splats(count)
    arrays["logit_opacities"][100:] = -20
    gaussians = Gaussians.from_numpy(arrays)
    del arrays
    weights = [dr.ones(ad.Float, SIZE[0] * SIZE[1])] * 4
    optimizer, update = Adam(gaussians.rows()), Update(False, 1.0)
    factors = ad.Float([1.0, 1.0, *[0.1] * 59])
    kind = dr.JitBackend.CUDA if select() == "cuda" else dr.JitBackend.LLVM
    for _ in range(3):
        gradients = [view_gradients(gaussians, view, weights, 3)]
        dr.eval(gaussians.rows(), optimizer.arrays)
        dr.sync_thread()
        gc.collect()
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        before = dr.detail.malloc_watermark(kind)
        update(gaussians, optimizer, 3, gradients, factors, {})
        dr.sync_thread()
        needed = (dr.detail.malloc_watermark(kind) - before) / (4 * count)
    assert 33 <= needed < 60
