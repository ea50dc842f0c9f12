"""Sampling against its twin; unbiased; the same numbers whatever computes them."""

import drjit as dr
import nerf_twin as twin
import numpy as np
import pytest

from spacesim.backend import ad
from spacesim.backend.upload import upload
from spacesim.nerf.sampling import sampler


def key(number: int = 7):
    return dr.opaque(ad.UInt32, sampler.step_key(number, 0))


def random_histograms(rng, rays: int, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """(edges [R, S + 1] within 0 to 1, weights [R, S], some of them 0)."""
    edges = np.sort(rng.uniform(size=(rays, samples + 1)), axis=1)
    edges[:, 0], edges[:, -1] = 0, 1
    weights = rng.uniform(size=(rays, samples)) * (rng.uniform(size=(rays, samples)) > 0.4)
    return edges, weights / np.maximum(weights.sum(axis=1, keepdims=True), 1)


@pytest.mark.parametrize(("samples", "wanted"), [(1, 3), (7, 12), (32, 16), (33, 5)])
def test_resampling_is_its_twin(samples, wanted):
    rng = np.random.default_rng(0)
    edges, weights = random_histograms(rng, 40, samples)
    weights[0] = 0
    jitter = rng.uniform(size=40)
    found = sampler.resample(upload(edges), upload(weights), 40, samples, wanted, upload(jitter))
    expected = [twin.resample(*ray, sampler.PADDING) for ray in zip(edges, weights, [wanted] * 40, jitter, strict=True)]
    np.testing.assert_allclose(np.array(found).reshape(40, -1), expected, atol=3e-6)
    assert (np.diff(np.array(found).reshape(40, -1)) >= 0).all()


def test_resampling_is_unbiased():
    """Over the jitter, the mean number of edges in an interval is its share of all."""
    rng, rays, samples, wanted = np.random.default_rng(1), 20_000, 6, 9
    edges, weights = random_histograms(rng, 1, samples)
    jitter = sampler.random(key(), dr.arange(ad.UInt32, rays), 0)
    many = upload(np.repeat(edges, rays, axis=0)), upload(np.repeat(weights, rays, axis=0))
    found = np.array(sampler.resample(*many, rays, samples, wanted, jitter))
    counts, _ = np.histogram(found, edges[0])
    share = (weights[0] + sampler.PADDING / samples) / (weights[0] + sampler.PADDING / samples).sum()
    np.testing.assert_allclose(counts / rays, (wanted + 1) * share, atol=0.02)


def test_even_edges_cover_the_ray():
    jitter = upload(np.array([0.0, 0.5, 0.999]))
    edges = np.array(sampler.uniform_edges(3, 4, jitter)).reshape(3, 5)
    np.testing.assert_allclose(edges[1], [0, 0.25, 0.5, 0.75, 1])
    np.testing.assert_allclose(edges[:, [0, -1]], [[0, 1]] * 3)
    assert (np.diff(edges) > 0).all()
    np.testing.assert_allclose(edges[0, 1:4], [0.125, 0.375, 0.625])


def test_random_numbers_are_even_and_apart():
    index = dr.arange(ad.UInt32, 100_000)
    one, other, later = (
        np.array(sampler.random(*how)) for how in ((key(), index, 0), (key(), index, 1), (key(8), index, 0))
    )
    for values in (one, other, later):
        assert values.min() >= 0
        assert values.max() < 1
        np.testing.assert_allclose(np.histogram(values, 20, (0, 1))[0] / 5000, 1, atol=0.06)
    for a, b in ((one, other), (one, later), (one[1:], one[:-1])):
        assert abs(np.corrcoef(a, b)[0, 1]) < 0.015
    counts = np.bincount(np.array(sampler.random_below(key(), index, 3, ad.UInt32(7))), minlength=7)
    assert len(counts) == 7
    np.testing.assert_allclose(counts / len(one), 1 / 7, atol=0.01)
    assert sampler.step_key(0, 1) != sampler.step_key(1, 0)


def test_places_in_rising_values():
    values = np.array([0.0, 1.0, 1.0, 2.0, 5.0])
    target = np.array([-1.0, 0.0, 0.5, 1.0, 2.0, 4.0, 5.0, 9.0])
    first = dr.zeros(ad.UInt32, len(target))
    below = sampler.count_below(upload(values), first, 5, upload(target))
    np.testing.assert_array_equal(np.array(below), np.searchsorted(values, target, "left"))
    at_most = sampler.count_below(upload(values), first, 5, upload(target), equal=True)
    np.testing.assert_array_equal(np.array(at_most), np.searchsorted(values, target, "right"))
