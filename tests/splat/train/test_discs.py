"""Discs and the normals that light has learned turn towards each other."""

from dataclasses import replace

import numpy as np
import pytest
from splats import random_splats

from spacesim.data.geometry import rotation_from_quaternion
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.train import discs, trainer
from spacesim.splat.train.config import preset
from spacesim.splat.train.discs import SHARE, turn_discs
from spacesim.splat.train.trainer import Trainer

FIRST = 2  #: feature at which normals stand


def between(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """[N] degrees between lines."""
    cosine = np.einsum("nc,nc->n", one, other) / np.linalg.norm(one, axis=1) / np.linalg.norm(other, axis=1)
    return np.degrees(np.arccos(np.clip(np.abs(cosine), 0, 1)))


def test_discs_and_normals_turn_a_share_of_the_way():
    """Along the great circle, whichever way the normal points, the rest of the disc with it."""
    rng = np.random.default_rng(2)
    arrays = random_splats(200, 3, 0) | {"sh": np.zeros((200, 0, 3)), "features": rng.normal(size=(200, 6))}
    arrays["quaternions"] *= rng.uniform(0.5, 2, (200, 1))
    arrays["features"][0, FIRST : FIRST + 3] = 0
    gaussians = Gaussians.from_numpy(arrays)
    start = gaussians.to_numpy()
    turn_discs(gaussians, FIRST)
    after = gaussians.to_numpy()
    before, turned = (np.float64([rotation_from_quaternion(q) for q in a["quaternions"]]) for a in (start, after))
    np.testing.assert_allclose(turned[0], before[0], atol=1e-6)
    assert not after["features"][0, FIRST : FIRST + 3].any()
    axes, new_axes = before[1:, :, 0], turned[1:, :, 0]
    normals, new_normals = (a["features"][1:, FIRST : FIRST + 3] for a in (start, after))
    away = between(axes, normals)
    across, along = (1 - SHARE) * np.sin(np.radians(away)), (1 - SHARE) * np.cos(np.radians(away)) + SHARE
    left = np.degrees(np.arctan2(across, along))
    np.testing.assert_allclose(between(new_axes, normals), left, atol=2e-2)
    np.testing.assert_allclose(between(axes, new_normals), left, atol=2e-2)
    assert (np.einsum("nc,nc->n", normals, new_normals) > 0).all()
    np.testing.assert_allclose(between(new_axes, new_normals), 2 * left - away, atol=5e-2)
    turn = turned[1:] @ before[1:].transpose(0, 2, 1)  # of the least angle: no more than the axis needs
    angle = np.degrees(np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    np.testing.assert_allclose(angle, away - left, atol=0.1)
    normal = slice(FIRST, FIRST + 3)
    np.testing.assert_array_equal(*(np.delete(a["features"], normal, axis=1) for a in (start, after)))
    for vectors in ([a["features"][:, normal] for a in (start, after)], [a["quaternions"] for a in (start, after)]):
        np.testing.assert_allclose(*(np.linalg.norm(each, axis=1) for each in vectors), rtol=1e-5)
    for name in ("means", "log_scales", "logit_opacities"):
        np.testing.assert_array_equal(after[name], start[name])
    alone = Gaussians.from_numpy(arrays)
    turn_discs(alone, FIRST, both=False)
    turned = alone.to_numpy()
    np.testing.assert_array_equal(turned["quaternions"], after["quaternions"])
    np.testing.assert_array_equal(turned["features"], start["features"])


def test_the_last_turns_are_of_discs_alone():
    for steps, last in ((20_000, 2_500), (7_000, 2_500), (3_000, 2_500), (2_000, 1_600), (60, 0)):
        turns = range(0, steps + 1, discs.EVERY)
        assert max(turn for turn in turns if discs.turns_normals(turn, steps)) == last


@pytest.mark.parametrize(("method", "surfels"), [("shadow-map", True), ("relight", True), ("shadow-map", False)])
def test_training_draws_shape_and_light_together(small_lit_dataset, monkeypatch, method, surfels):
    """Discs end nearer to the learned normals than where nothing turns them. What is no disc is left alone, and so is
    light without shadows, for which its normals stand in."""
    config = replace(preset("demo", method), iterations=60, init_count=300, surfels=surfels)
    ends = []
    for every, both_until in ((10, 60), (10, 0), (100, 60)):
        monkeypatch.setattr(trainer, "EVERY", every)
        monkeypatch.setattr(discs, "BOTH_UNTIL", both_until)
        trained = Trainer(small_lit_dataset, config)
        trained.run(lambda progress: None, lambda: None)
        arrays = trained.gaussians.to_numpy()
        first = config.light.field.features
        axes = np.float64([rotation_from_quaternion(q) for q in arrays["quaternions"]])[:, :, 0]
        ends.append(np.median(between(axes, arrays["features"][:, first : first + 3])))
    *turned, free = ends
    turns = surfels and method == "shadow-map"
    assert all(end < 0.8 * free if turns else end == free for end in turned)
