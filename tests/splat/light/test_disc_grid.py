"""The first disc that a ray meets, against all pairs in float64."""

import drjit as dr
import numpy as np
import pytest

from spacesim.backend import ad
from spacesim.backend.upload import upload_rows
from spacesim.splat.light.disc_grid import MISSED, DiscGrid

RAYS = 4000


def discs(rng: np.random.Generator, count: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    """(centres, semi-axes), turned at random."""
    turns = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    lengths = size * rng.uniform(0.3, 1, (count, 2, 1))
    return rng.uniform(-1, 1, (count, 3)), np.swapaxes(turns, 1, 2)[:, :2] * lengths


def plane(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """All in the plane z = 0, over each other."""
    centers = np.column_stack([rng.uniform(-1, 1, (count, 2)), np.zeros(count)])
    return centers, np.tile([[0.1, 0, 0], [0, 0.1, 0]], (count, 1, 1))


def scene(name: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    if name == "some large":
        centers, axes = discs(rng, 1500, 0.02)
        axes[::300] *= 60
        return centers, axes
    if name == "one plane":
        return plane(rng, 400)
    if name == "all one":
        return np.zeros((5, 3)), np.tile([[0.5, 0, 0], [0, 0.3, 0]], (5, 1, 1))
    return discs(rng, 1 if name == "one" else 300, 0.7 if name == "one" else 0.2)


def first_met(centers: np.ndarray, axes: np.ndarray, start: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """[M] numbers, MISSED for none."""
    nearest, met = np.full(len(start), np.inf), np.full(len(start), MISSED)
    for k, (center, (first, second)) in enumerate(zip(centers, axes, strict=True)):
        normal = np.cross(first, second)
        with np.errstate(all="ignore"):
            distance = ((center - start) @ normal) / (towards @ normal)
            place = start + distance[:, None] * towards - center
            inside = (place @ first / (first @ first)) ** 2 + (place @ second / (second @ second)) ** 2 < 1
        closer = inside & (distance > 0) & (distance < nearest)
        nearest[closer], met[closer] = distance[closer], k
    return met


@pytest.mark.parametrize("rays", ["all ways", "along an axis", "from outside"])
@pytest.mark.parametrize("name", ["random", "some large", "one plane", "all one", "one"])
def test_the_nearest_is_met_and_of_equally_near_ones_the_first(name, rays):
    rng = np.random.default_rng(0)
    centers, axes = scene(name, rng)
    start, towards = rng.uniform(-1.2, 1.2, (RAYS, 3)), rng.normal(size=(RAYS, 3))
    if rays == "along an axis":
        towards = np.eye(3)[rng.integers(0, 3, RAYS)] * rng.choice([-1.0, 1.0], RAYS)[:, None]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    if rays == "from outside":
        start -= 5 * towards
    start, towards = (np.float32(rows).astype(np.float64) for rows in (start, towards))
    place, direction = (upload_rows(rows.T) for rows in (start, towards))
    grid = DiscGrid.of(upload_rows(centers.T), [upload_rows(axis.T) for axis in np.moveaxis(axes, 1, 0)])
    found = np.array(grid.first_met(place, direction, dr.arange(ad.UInt32, RAYS) % 50 != 0))
    expected = first_met(centers, axes, start, towards)
    expected[::50] = MISSED  # rays that are not asked about
    assert (expected != MISSED).sum() > 20
    assert (found == expected).mean() > 0.999, "rays within rounding of an edge may differ"
