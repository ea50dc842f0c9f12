"""Gaussians and segments on one ray against a float64 twin, and what neither may change."""

import drjit as dr
import numpy as np
import pytest
from posed import seen_from
from splats import random_splats, take_cudas

from spacesim.backend import ad
from spacesim.backend.upload import upload
from spacesim.mixed.walk import Segments, blend_segments, listed
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.lists.bin import bin_splats
from spacesim.splat.raster.project import ALPHA_MIN, project
from spacesim.splat.raster.records import ALPHA_MAX

CAMERA = seen_from([3.0, -2.0, 1.5])


def twin(
    x: float, y: float, splats: dict, features: np.ndarray, edges: np.ndarray, density: np.ndarray, own: np.ndarray
):
    """(transmittance, sum of depths, median depth, sums [C]) at a place of the picture: splats one by one, before each
    what of the segments lies before its depth. features: [N, C] of splats;  edges: [K + 1];  own: [K, C]"""
    left, depth, median, sums = 1.0, 0.0, 0.0, np.zeros(features.shape[1])

    def take(share: float, z: float, values: np.ndarray, at_half) -> None:
        nonlocal left, depth, median
        before, taken = left, left * share
        depth, left = depth + taken * z, left - taken
        sums[:] += taken * values
        if before >= 0.5 > left:
            median = at_half(before)

    def take_segments(start: float, stop: float) -> None:
        for k, thickness in enumerate(density):
            low, high = max(edges[k], start), min(edges[k + 1], stop)
            if high > low:
                middle = 0.5 * (low + high)
                share = -np.expm1(-thickness * (high - low))
                take(share, middle, own[k], lambda t, low=low, d=thickness: low + np.log(2 * t) / d)

    reached = -np.inf
    for i in np.argsort(splats["depth"], kind="stable"):
        dx, dy = x - splats["x"][i], y - splats["y"][i]
        form = splats["a"][i] * dx * dx + 2 * splats["b"][i] * dx * dy + splats["c"][i] * dy * dy
        alpha = min(splats["opacity"][i] * np.exp(-0.5 * form), ALPHA_MAX)
        if alpha >= ALPHA_MIN and splats["visible"][i]:
            z = splats["depth"][i]
            take_segments(reached, z)
            take(alpha, z, features[i], lambda _, z=z: z)
            reached = z
    take_segments(reached, np.inf)
    return left, depth, median, sums


def drawn(edges: np.ndarray, density: np.ndarray, own: np.ndarray, count: int = 60):
    """(`Blended` over the whole picture, splats as arrays, their features [N, 3]) of random Gaussians and segments:
    edges [R, K + 1], densities [R, K], features [R, K, 3]"""
    gaussians, rng = Gaussians.from_numpy(random_splats(count, 5, 0)), np.random.default_rng(3)
    splats, footprints = project(gaussians, Pinhole.of(CAMERA))
    lists = bin_splats(splats, footprints, CAMERA.width, CAMERA.height)
    features = rng.uniform(size=(count, 3))
    columns = [upload(column) for column in features.T]
    planes = [upload(np.ascontiguousarray(own[..., c])) for c in range(3)]
    segments = Segments(upload(edges[:, :-1].copy()), upload(edges[:, 1:].copy()), upload(density), planes)
    pixel = dr.arange(ad.UInt32, CAMERA.width * CAMERA.height)
    width = dr.opaque(ad.UInt32, CAMERA.width)
    made = blend_segments(listed(splats, columns, lists), segments, pixel, width, density.shape[1], 2)
    names = ("x", "y", "a", "b", "c", "opacity", "depth")
    arrays = {name: np.array(getattr(splats, name), np.float64) for name in names}
    return made, {**arrays, "visible": np.array(footprints.visible)}, features


@pytest.mark.parametrize("way", ["the backend's", "CUDA's"])
def test_walk_matches_the_twin(monkeypatch, way):
    """Segments before, among and behind the Gaussians, some empty, some without length."""
    if way == "CUDA's":
        take_cudas(monkeypatch)
    rng, rays, segments = np.random.default_rng(4), CAMERA.width * CAMERA.height, 9
    distance = float(np.linalg.norm(CAMERA.position))
    edges = np.sort(rng.uniform(distance - 2, distance + 2, (rays, segments + 1)), axis=1)
    edges[:, 4] = edges[:, 3]
    density = rng.exponential(0.6, (rays, segments)) * (rng.uniform(size=(rays, segments)) > 0.3)
    own = rng.uniform(size=(rays, segments, 3))
    made, splats, features = drawn(edges, density, own)
    found = np.array([*made.common, *made.of_splats, *made.of_segments])
    for pixel in rng.choice(rays, 150, replace=False):
        at = pixel % CAMERA.width + 0.5, pixel // CAMERA.width + 0.5
        left, depth, median, both = twin(*at, splats, features, edges[pixel], density[pixel], own[pixel])
        if left < 2e-4:  # the rest of the list was left out
            continue
        np.testing.assert_allclose(np.array(made.transmittance)[pixel], left, atol=2e-5)
        np.testing.assert_allclose(np.array(made.depth)[pixel], depth, atol=2e-4)
        np.testing.assert_allclose(np.array(made.median_depth)[pixel], median, atol=2e-3)
        np.testing.assert_allclose(found[:2, pixel], both[:2], atol=2e-5)
        np.testing.assert_allclose(found[2, pixel] + found[3, pixel], both[2], atol=2e-5)


@pytest.mark.parametrize(("low", "color"), [(-3.0, "segment"), (3.0, "splats")])
def test_what_lies_before_or_behind_all(low, color):
    """An opaque slab before all Gaussians hides them; behind all of them it fills what they leave."""
    distance, rays = float(np.linalg.norm(CAMERA.position)), CAMERA.width * CAMERA.height
    edges = np.tile(distance + low + np.array([-0.1, 0.0, 0.1]), (rays, 1))
    made, _, _ = drawn(edges, np.full((rays, 2), 500.0), np.ones((rays, 2, 3)))
    empty, _, _ = drawn(edges, np.zeros((rays, 2)), np.ones((rays, 2, 3)))
    assert np.array(made.transmittance).max() < 1e-6
    splats = np.array(made.of_splats[0])
    if color == "segment":
        np.testing.assert_allclose(splats, 0, atol=1e-6)
    else:
        np.testing.assert_array_equal(splats, np.array(empty.of_splats[0]))
        np.testing.assert_allclose(np.array(made.of_segments[0]), np.array(empty.transmittance), atol=1e-5)


def test_a_segment_that_gaussians_cut_lies_where_its_pieces_do():
    """Thin fog from before the Gaussians to far behind them, as one segment and as 400 of them."""
    distance, rays = float(np.linalg.norm(CAMERA.position)), CAMERA.width * CAMERA.height
    depths = []
    for count in (1, 400):
        edges = np.tile(np.linspace(distance - 3, distance + 20, count + 1), (rays, 1))
        made, _, _ = drawn(edges, np.full((rays, count), 0.001), np.ones((rays, count, 3)))
        depths.append(np.array(made.depth))
    np.testing.assert_allclose(depths[0], depths[1], atol=2e-3)
