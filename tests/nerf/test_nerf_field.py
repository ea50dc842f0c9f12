"""Hash grids and fields: against the twin, gradients against finite differences, sums that do not depend on threads."""

from dataclasses import replace

import drjit as dr
import nerf_twin as twin
import numpy as np
import pytest

from spacesim.backend import ad
from spacesim.backend.upload import upload, upload_rows
from spacesim.nerf.config import CHUNK, GridConfig, NerfConfig, ProposalConfig
from spacesim.nerf.fields.field import DensityField, RadianceField
from spacesim.nerf.fields.hashgrid import PRIMES, HashGrid
from spacesim.nerf.fields.model import Networks
from spacesim.nerf.sampling.losses import normal_slope
from spacesim.nerf.sampling.occupancy import Occupancy
from spacesim.nerf.sampling.rays import Rays
from spacesim.nerf.sampling.sampler import step_key
from spacesim.nerf.train.pixels import Pixels
from spacesim.nerf.train.step import StepNumbers, loss_and_gradients

GRID = GridConfig(levels=3, coarsest=3, finest=20, log2_size=8)
TINY = NerfConfig(
    rays=CHUNK,
    samples=6,
    width=8,
    features=3,
    harmonics=1,
    grid=GRID,
    coarse=ProposalConfig(8, 8, GridConfig(2, 4, 8, 8)),
    fine=ProposalConfig(5, 8, GridConfig(2, 4, 8, 8)),
    occupancy=8,
    distortion_weight=0.0,
    interlevel_weight=0.0,
    normal_weight=0.0,
    chunk=CHUNK,
)


@pytest.fixture
def points() -> np.ndarray:
    points = np.random.default_rng(1).uniform(size=(3, CHUNK)).astype(np.float32)
    points[:, :3] = 0, 1, 0.5
    return points


def moved(parameters: list[np.ndarray], number: int, step: np.ndarray) -> list[np.ndarray]:
    """The parameters with `step` added to one of them."""
    return [values + step if i == number else values for i, values in enumerate(parameters)]


def test_levels_grow_by_one_factor_and_share_only_where_they_must():
    levels = HashGrid(GRID).levels
    assert [level.cells for level in levels] == [3, 7, 20]
    assert [level.hashed for level in levels] == [False, True, True]
    assert [level.first for level in levels] == [0, 64, 64 + 256]
    assert HashGrid(GRID).parameters == 2 * (64 + 2 * 256)


def test_look_up_is_the_twins(points):
    grid = HashGrid(GRID)
    table = np.random.default_rng(0).normal(size=(grid.parameters // 2, 2)).astype(np.float32)
    found = np.array([np.array(row) for row in grid.look_up(upload(table), upload_rows(points))])
    expected = [twin.look_up(table, grid.levels, PRIMES, point) for point in points.T.astype(float)]
    np.testing.assert_allclose(found.T, expected, atol=2e-5)


def test_gradient_by_the_table_is_its_transpose(points):
    """Look-up is linear in the table: <g, look_up(t)> = <adjoint(g), t> for every t."""
    grid, rng = HashGrid(GRID), np.random.default_rng(2)
    gradients = [upload(rng.normal(size=CHUNK)) for _ in range(grid.outputs)]
    adjoint = np.array(grid.adjoint(upload_rows(points), gradients), float)
    for _ in range(3):
        table = rng.normal(size=grid.parameters)
        rows = grid.look_up(upload(table), upload_rows(points))
        there = sum(np.array(g, float) @ np.array(r, float) for g, r in zip(gradients, rows, strict=True))
        np.testing.assert_allclose(adjoint @ table.astype(np.float32), there, rtol=1e-4)


def test_small_gradients_survive_beside_large_ones(points):
    grid = HashGrid(GRID)
    values = np.full(CHUNK, 1e-3)
    values[5] = 1.0
    gradients = [upload(values * (1 + i)) for i in range(grid.outputs)]
    found = np.array(grid.adjoint(upload_rows(points), gradients), float).reshape(-1, 2)
    for i, level in enumerate(grid.levels):  # weights of a point's corners sum to 1
        total = found[level.first : level.first + level.size].sum(axis=0)
        np.testing.assert_allclose(total, values.sum() * np.array([1 + 2 * i, 2 + 2 * i]), rtol=1e-5)


def test_gradient_by_the_table_is_the_same_with_any_threads(points):
    grid, many = HashGrid(replace(GRID, log2_size=4)), 64 * CHUNK  # few vertices: all samples meet
    rng = np.random.default_rng(3)
    spread = upload_rows(rng.uniform(size=(3, many)).astype(np.float32))
    gradients = [upload(rng.normal(size=many)) for _ in range(grid.outputs)]
    before, results = dr.thread_count(), []
    try:
        for threads in (1, 2, 2):
            dr.set_thread_count(threads)
            results.append(np.array(grid.adjoint(spread, gradients)))
    finally:
        dr.set_thread_count(before)
    assert results[0].any()
    assert (results[0] == results[1]).all()
    assert (results[1] == results[2]).all()


def test_slopes_of_density_are_its_differences(points):
    field = DensityField.of(GRID, 8, 2)
    rng = np.random.default_rng(4)
    parameters = [upload(values + 0.3 * rng.normal(size=values.shape)) for values in field.initial(rng)]
    inner = upload_rows(0.05 + 0.9 * points)
    _, _, tape = field.look_up(parameters, inner)
    slopes = np.array([np.array(row) for row in field.slopes(parameters, tape)])
    step = 1e-3
    close = np.ones(CHUNK, bool)
    for axis in range(3):
        ends = [0.05 + 0.9 * points for _ in range(2)]
        ends[0][axis] += step
        ends[1][axis] -= step
        above, below = (np.array(field.look_up(parameters, upload_rows(end))[0], float) for end in ends)
        close &= np.abs(slopes[axis] - (above - below) / (2 * step)) < 0.02 * (1 + np.abs(slopes).max(axis=0))
    assert close.mean() > 0.8  # the rest lie at borders of cells, or of ReLU, where slopes jump


SURFACE = "nerf-relight", "surface"


@pytest.mark.parametrize(("method", "inputs"), [("nerf", "surface"), ("nerf-relight", "directions"), SURFACE])
def test_gradients_of_a_field(points, method, inputs):
    """Along a direction, <gradient, direction> is the difference of the outputs' weighted sum."""
    field, rng = RadianceField.of(replace(TINY, method=method, inputs=inputs)), np.random.default_rng(5)
    start = [values + 0.2 * rng.normal(size=values.shape) for values in field.initial(rng)]
    view = upload_rows((points - 0.4) / np.linalg.norm(points - 0.4, axis=0))
    sun = ad.Array3f(0, 0, 1) + dr.zeros(ad.Array3f, CHUNK)
    weights = [upload(rng.normal(size=CHUNK)) for _ in range(1 + field.color.outputs)]

    def value(parameters: list[np.ndarray]) -> float:
        density, color, _ = field.look_up([upload(p) for p in parameters], upload_rows(points), view, sun)
        rows = zip([density, *color], weights, strict=True)
        return sum(float(np.array(a, float) @ np.array(b, float)) for a, b in rows)

    _, _, tape = field.look_up([upload(p) for p in start], upload_rows(points), view, sun)
    gradients = field.adjoint([upload(p) for p in start], tape, weights[0], weights[1:])
    assert [dr.width(g) for g in gradients] == [len(p) for p in start]
    for number, gradient in enumerate(gradients):
        found = np.array(gradient, float)
        direction = found / max(np.linalg.norm(found), 1e-9)
        there, back = (value(moved(start, number, way * direction)) for way in (5e-4, -5e-4))  # so near no normal turns
        slope = (there - back) / 1e-3
        np.testing.assert_allclose(found @ direction, slope, rtol=0.05, atol=1e-3)


def pixels() -> Pixels:
    """One camera before the box, whose picture is of random colours and alphas."""
    rng, count = np.random.default_rng(6), 900
    camera = [1, 0, 0, 0, 1, 0, 0, 0, 1, 0.5, 0.5, -1.2, 40, 40, 15, 15]
    j, i = np.mgrid[0:30, 0:30]
    return Pixels(
        upload(rng.integers(0, 2**32, count, np.uint32), ad.UInt32),
        upload((i + 65536 * j).ravel().astype(np.uint32), ad.UInt32),
        dr.zeros(ad.UInt32, count),
        dr.opaque(ad.UInt32, count),
        upload(np.array(camera, float)),
        upload(np.array([0.0, 0.0, 1.0])),
        upload(np.ones(3)),
    )


def test_normals_are_pulled_against_the_slope():
    rng = np.random.default_rng(8)
    normal, slope, weights = rng.normal(size=(3, 50)), rng.normal(size=(3, 50)), rng.random(50)

    def loss(normals: np.ndarray) -> np.ndarray:
        apart = normals / np.linalg.norm(normals, axis=0) + slope / np.linalg.norm(slope, axis=0)
        return weights * (apart**2).sum(axis=0)

    found = np.array(normal_slope(upload_rows(normal), upload_rows(slope), upload(weights)))
    for axis in range(3):
        step = 1e-5 * np.eye(3)[:, [axis]]
        np.testing.assert_allclose(found[axis], (loss(normal + step) - loss(normal - step)) / 2e-5, atol=1e-4)


@pytest.mark.parametrize("method", ["nerf", "nerf-relight"])
def test_gradients_of_the_whole_step(method):
    """Of the colours' error by the field, through volume rendering, colours and random backgrounds."""
    networks, rng = Networks(replace(TINY, method=method)), np.random.default_rng(7)
    start = [values + 0.2 * rng.normal(size=values.shape).astype(np.float32) for values in networks.initial(0)]
    numbers = StepNumbers(
        dr.opaque(ad.UInt32, step_key(1, 2)), dr.opaque(ad.Float, 1.0), dr.opaque(ad.Float, 0.0), ad.Float([0.0] * 5)
    )
    filled, seen = dr.full(ad.Float, 1, 8**3), pixels()

    def loss(parameters: list[np.ndarray]) -> tuple[float, list]:
        found = loss_and_gradients(networks, [upload(p) for p in parameters], seen, filled, numbers, False)
        return float(found[0][0]), found[1]

    _, gradients = loss(start)
    checked = 0
    for number in range(networks.bounds[1], len(start)):
        found = np.array(gradients[number], float)
        norm = np.linalg.norm(found)
        if norm > 1e-3:
            direction = found / norm
            there, back = (loss(moved(start, number, way * direction))[0] for way in (0.02, -0.02))
            slope = (there - back) / 0.04
            np.testing.assert_allclose(norm, slope, rtol=0.05)
            checked += 1
    assert checked >= 3


def test_rays_are_clipped_to_what_is_filled():
    occupancy = Occupancy(8)
    density = np.zeros((8, 8, 8))
    density[4, 4, 4] = 50  # z, y, x
    filled = occupancy.filled(upload(density))
    assert np.array(filled).sum() == 27
    count = 2
    origin = ad.Array3f(upload(np.array([0.56, 0.05])), 0.56, dr.full(ad.Float, -1, count))
    direction = ad.Array3f(0.0, 0.0, dr.full(ad.Float, 1, count))
    rays = Rays(
        origin, direction, dr.full(ad.Float, 1, count), dr.full(ad.Float, 2, count), dr.full(ad.Float, 1, count)
    )
    clipped, crosses = occupancy.clip(rays, filled)
    np.testing.assert_array_equal(np.array(crosses), [True, False])
    near, far = np.array(clipped.near), np.array(clipped.far)
    assert 1 + 3 / 8 - 1 / 8 <= near[0] <= 1 + 3 / 8
    assert 1 + 6 / 8 <= far[0] <= 1 + 7 / 8
    assert (near[1], far[1]) == (1, 2)
