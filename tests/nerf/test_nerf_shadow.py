"""Visibility of the Sun through a radiance field: closed forms, the twin, and what a trained field casts."""

import nerf_twin as twin
import numpy as np
import pytest

from spacesim.backend.upload import upload
from spacesim.nerf.config import CHUNK, GridConfig, NerfConfig, NerfShadowConfig, ProposalConfig
from spacesim.nerf.fields.hashgrid import PRIMES
from spacesim.nerf.fields.model import Networks
from spacesim.nerf.sampling.box import SceneBox
from spacesim.nerf.shadow import sun_visibility

CONFIG = NerfConfig(
    method="nerf-relight",
    shadow=NerfShadowConfig(64, 0.02),
    width=8,
    features=3,
    grid=GridConfig(2, 3, 8, 8),
    coarse=ProposalConfig(32, 8, GridConfig(2, 3, 6, 8)),
    fine=ProposalConfig(32, 8, GridConfig(2, 3, 6, 8)),
    occupancy=16,
    chunk=CHUNK,
)
BOX = SceneBox(np.array([-1.0, 2.0, 0.5]), np.array([4.0, 2.0, 3.0]))  #: metres


def parameters(networks: Networks, log_density: float, noise: float) -> list[np.ndarray]:
    """Of a field, and of its proposals, whose density is constant but for `noise`."""
    rng, result = np.random.default_rng(5), []
    for density in (*networks.proposals, networks.field.density):
        own = [noise * rng.normal(size=values.shape) for values in density.initial(rng)]
        own[-1][0] += log_density
        result += own
    color = networks.initial(0)[networks.bounds[1] + networks.field.split :]
    return [values.astype(np.float32) for values in (*result, *color)]


def seen(networks, values, filled, points, sun, **changed) -> np.ndarray:
    on_device = [upload(one) for one in values]
    return sun_visibility(networks, on_device, upload(filled.astype(np.float32)), BOX, points, sun, **changed)


def leaving(points: np.ndarray, sun: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """[N] metres from points in a box to where a ray towards the Sun leaves it."""
    return np.where(sun > 0, (high - points) / sun, np.where(sun < 0, (low - points) / sun, np.inf)).min(axis=1)


@pytest.mark.parametrize("density", [0.1, 1.5])
def test_through_a_box_of_constant_density(density):
    """exp(-density length), from anywhere in the box, and from behind it; 1 beside it."""
    networks = Networks(CONFIG)
    values, filled = parameters(networks, np.log(density * BOX.side), 0.0), np.ones(16**3)
    rng, sun = np.random.default_rng(1), np.array([0.48, -0.6, 0.64])
    points = BOX.low + rng.uniform(0.05, 0.95, (700, 3)) * BOX.size  # no multiple of a chunk
    length = leaving(points, sun, BOX.low, BOX.low + BOX.size)
    bias = 0.02 * BOX.side
    found = seen(networks, values, filled, points, sun)
    np.testing.assert_allclose(found, np.exp(-density * np.maximum(length - bias, 0)), atol=1e-4)
    again = seen(networks, values, filled, points, sun, bias=0.0, samples=8)
    np.testing.assert_allclose(again, np.exp(-density * length), atol=1e-4)
    behind = points - sun * 20
    through = length + leaving(points, -sun, BOX.low, BOX.low + BOX.size)
    np.testing.assert_allclose(seen(networks, values, filled, behind, sun), np.exp(-density * through), atol=2e-4)
    np.testing.assert_array_equal(seen(networks, values, filled, points + sun * 20, sun), 1)


def test_through_a_slab_that_the_filled_cells_bound():
    """What is empty is left out; the slab is as thick as the filled cells, within half a cell on each side."""
    networks = Networks(CONFIG)
    values, filled = parameters(networks, 1.0, 0.0), np.zeros((16, 16, 16))
    filled[6:9] = 1  # z
    points = BOX.low + np.array([[0.3, 0.2, 0.1], [0.3, 0.2, 0.7]]) * BOX.side
    found = seen(networks, values, filled, points, np.array([0.0, 0.0, 1.0]))
    assert np.exp(-np.e * 4 / 16) <= found[0] <= np.exp(-np.e * 2 / 16)
    assert found[1] == 1


def test_through_a_field_that_varies_is_the_twins():
    networks = Networks(CONFIG)
    values = parameters(networks, 0.5, 0.6)
    own = values[networks.bounds[1] :][: networks.field.split]
    shape, levels = networks.field.density.shape, networks.field.density.grid.levels
    table = own[0].reshape(-1, 2).astype(float)

    def density(points: np.ndarray) -> np.ndarray:
        items = np.array([twin.look_up(table, levels, PRIMES, point) for point in points])
        return np.exp(twin.network(shape, [one.astype(float) for one in own[1:]], items)[:, 0])

    rng, sun = np.random.default_rng(2), np.array([-0.6, 0.0, 0.8])
    points = BOX.low + rng.uniform(0.1, 0.9, (6, 3)) * BOX.size
    found = seen(networks, values, np.ones(16**3), points, sun, samples=256)
    expected = [
        twin.transmittance(density, BOX.extent, point, sun, 0.02, 300) for point in (points - BOX.low) / BOX.side
    ]
    assert np.ptp(expected) > 0.1
    np.testing.assert_allclose(found, expected, atol=5e-3)


def test_visibility_is_finite_and_the_same_each_time():
    """Also of points and fields that are none."""
    networks = Networks(CONFIG)
    values = parameters(networks, 60.0, 1.0)
    points = np.concatenate(
        [np.full((1, 3), np.nan), np.full((1, 3), 1e30), BOX.low + 0.5 * BOX.size + np.zeros((4, 3))]
    )
    first, second = (seen(networks, values, np.ones(16**3), points, np.array([0.0, 0.0, 1.0])) for _ in range(2))
    assert np.isfinite(first).all()
    assert (first[2:] == 0).all()
    np.testing.assert_array_equal(first, second)
