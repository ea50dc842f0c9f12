"""Volume rendering and losses against their twins, closed forms and finite differences."""

import drjit as dr
import nerf_twin as twin
import numpy as np
import pytest

from spacesim.backend import ad
from spacesim.backend.upload import upload
from spacesim.nerf.sampling import losses, render, sampler
from spacesim.nerf.sampling.rays import Rays, box_interval

RAYS, SAMPLES = 30, 13


@pytest.fixture
def tau() -> np.ndarray:
    rng = np.random.default_rng(3)
    return rng.exponential(0.4, (RAYS, SAMPLES)) * (rng.uniform(size=(RAYS, SAMPLES)) > 0.3)


def differences(function, values: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """Gradient of a scalar function of an array, by central differences."""
    result = np.zeros_like(values)
    for i in np.ndindex(values.shape):
        moved = values.copy()
        moved[i] += step
        above = function(moved)
        moved[i] -= 2 * step
        result[i] = (above - function(moved)) / (2 * step)
    return result


def test_weights_are_the_twins_and_sum_to_the_accumulation(tau):
    made = render.volume_weights(upload(tau), SAMPLES)
    weights = np.array(made.weights).reshape(RAYS, SAMPLES)
    color = np.random.default_rng(0).uniform(size=(RAYS, SAMPLES, 3))
    expected = [twin.volume(*ray) for ray in zip(tau, color, strict=True)]
    np.testing.assert_allclose(weights, [ray[0] for ray in expected], atol=1e-6)
    sums = np.array(render.sum_rays(made.weights, SAMPLES))
    np.testing.assert_allclose(sums, [ray[2] for ray in expected], atol=1e-6)
    np.testing.assert_allclose(sums, 1 - np.array(made.behind).reshape(RAYS, SAMPLES)[:, -1], atol=1e-6)
    red = np.array(render.sum_rays(made.weights * upload(color[..., 0]), SAMPLES))
    np.testing.assert_allclose(red, [ray[1][0] for ray in expected], atol=1e-6)


def test_the_adjoint_of_weights(tau):
    gradient = np.random.default_rng(4).normal(size=tau.shape)
    made = render.volume_weights(upload(tau), SAMPLES)
    found = np.array(render.weights_adjoint(made, upload(gradient), SAMPLES)).reshape(tau.shape)
    black = np.zeros((SAMPLES, 3))
    for ray in range(5):
        expected = differences(lambda t, ray=ray: float(twin.volume(t, black)[0] @ gradient[ray]), tau[ray])
        np.testing.assert_allclose(found[ray], expected, atol=2e-5)


@pytest.mark.parametrize("density", [0.3, 4.0, 60.0])
def test_a_sphere_of_constant_density(density):
    """Opacity 1 - exp(-density chord); depths of the light that stays, and where half of it is gone."""
    radius, samples = 0.4, 2000
    offsets = np.array([0.0, 0.2, 0.39, 0.45])
    origin = ad.Array3f(upload(0.5 + offsets), 0.5, -1.0)
    direction = ad.Array3f(0.0, 0.0, dr.full(ad.Float, 1, 4))
    near, far = box_interval(origin, direction, ad.Float([1.0, 1.0, 1.0]))
    np.testing.assert_allclose(np.array(near), 1)
    np.testing.assert_allclose(np.array(far), 2)
    rays = Rays(origin, direction, near, far, dr.full(ad.Float, 1, 4))
    edges = sampler.uniform_edges(4, samples, dr.full(ad.Float, 0.5, 4))
    low, high, ray = sampler.intervals(edges, 4, samples)
    point, _ = rays.at(ray, 1 + 0.5 * (low + high))
    inside = dr.norm(point - 0.5) < radius
    made = render.volume_weights(dr.select(inside, density, 0) * (high - low), samples)
    chord = 2 * np.sqrt(np.maximum(radius**2 - offsets**2, 0))
    opacity = 1 - np.exp(-density * chord)
    np.testing.assert_allclose(np.array(render.sum_rays(made.weights, samples)), opacity, atol=0.002 * density + 1e-4)
    entry = 1.5 - chord / 2
    hit = opacity > 0
    mean = entry[hit] + (1 - np.exp(-density * chord[hit]) * (1 + density * chord[hit])) / (density * opacity[hit])
    depth = np.array(render.expected_depth(made.weights, 1 + 0.5 * (low + high), samples))
    np.testing.assert_allclose(depth[hit], mean, atol=2e-3)
    assert depth[~hit] == 0
    median = np.array(render.median_depth(made, 1 + low, 1 + high, samples))
    expected = np.where(opacity > 0.5, entry + np.log(2) / density, 0)
    np.testing.assert_allclose(median, expected, atol=2e-3)


def test_the_part_of_a_ray_in_the_box():
    """Beside the box, from within, away from it, through it, along an axis and not; the box is 1 x 0.5 x 1."""
    origins = [(2, 0.2, -1), (0.5, 0.2, 0.5), (-1, 0.2, 0.5), (0.25, 0.25, -1), (-1, 0.25, -1)]
    directions = [(0, 0, 1), (0, 1, 0), (-1, 0, 0), (0, 0, 1), (0.6, 0, 0.8)]
    rows = (ad.Array3f(*map(upload, np.array(group, float).T)) for group in (origins, directions))
    near, far = (np.array(t) for t in box_interval(*rows, ad.Float([1.0, 0.5, 1.0])))
    np.testing.assert_allclose(far - near, [0, 0.3, 0, 1, 2.5 - 5 / 3], atol=1e-6)
    np.testing.assert_allclose(near[[1, 3, 4]], [0, 1, 5 / 3], atol=1e-6)


def histograms(rng, samples: int, proposals: int):
    edges, finer = (np.sort(rng.uniform(size=(RAYS, n + 1)), axis=1) for n in (samples, proposals))
    finer[:, 0], finer[:, -1] = 0, 1
    weights = rng.uniform(size=(RAYS, samples)) * 2 / samples
    proposal = rng.uniform(size=(RAYS, proposals)) * (rng.uniform(size=(RAYS, proposals)) > 0.5) / proposals
    return edges, weights, finer, proposal


@pytest.mark.parametrize(("samples", "proposals"), [(6, 9), (16, 5)])
def test_interlevel_loss(samples, proposals):
    edges, weights, finer, proposal = histograms(np.random.default_rng(5), samples, proposals)
    loss, gradient = losses.interlevel(
        upload(edges), upload(weights), RAYS, samples, upload(finer), upload(proposal), proposals
    )
    edges, weights, finer, proposal = (a.astype(np.float32).astype(float) for a in (edges, weights, finer, proposal))
    expected = [twin.interlevel(*ray, losses.EPSILON) for ray in zip(edges, weights, finer, proposal, strict=True)]
    assert max(expected) > 0.01
    np.testing.assert_allclose(np.array(loss), expected, atol=1e-5)
    gradient = np.array(gradient).reshape(RAYS, proposals)
    for i in range(6):
        there = differences(
            lambda p, i=i: twin.interlevel(edges[i], weights[i], finer[i], p, losses.EPSILON), proposal[i], 1e-7
        )
        np.testing.assert_allclose(gradient[i], there, atol=1e-4)


def test_distortion_loss():
    edges, weights, _, _ = histograms(np.random.default_rng(6), 8, 3)
    loss, gradient = losses.distortion(upload(edges), upload(weights), RAYS, 8)
    expected = [twin.distortion(*ray) for ray in zip(edges, weights, strict=True)]
    np.testing.assert_allclose(np.array(loss), expected, atol=1e-6)
    gradient = np.array(gradient).reshape(RAYS, 8)
    for i in range(6):
        np.testing.assert_allclose(
            gradient[i], differences(lambda w, i=i: twin.distortion(edges[i], w), weights[i]), atol=1e-5
        )
