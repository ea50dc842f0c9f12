"""Harmonics fitted to what is seen; the weights of that fit."""

import numpy as np
import pytest

from spacesim.data.geometry import fibonacci_sphere, look_at
from spacesim.splat.export.bake import FAINT, VIEWS, _fit, _harmonics, blended_weights
from spacesim.splat.raster.cameras import Orthographic, OrthographicCamera
from spacesim.splat.raster.gaussians import Gaussians

DIRECTIONS = fibonacci_sphere(VIEWS)
TERMS = _harmonics(DIRECTIONS, 3)


def errors(weights: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """[V] of one Gaussian, as it is drawn: colours below 0 are 0."""
    harmonics = _fit(TERMS, weights[:, None] + FAINT, np.repeat(colors[:, None, None], 3, axis=1).astype(np.float32))
    return np.abs(np.maximum(TERMS @ harmonics[0, :, 1] + 0.5, 0) - colors)


def test_colors_that_harmonics_can_be_are_kept():
    wanted = np.random.default_rng(0).normal(size=16) * 0.05
    assert errors(np.ones(VIEWS), TERMS @ wanted + 0.5).max() < 1e-6


def test_what_is_hidden_does_not_spoil_what_is_seen():
    seen = DIRECTIONS[:, 2] > 0
    colors = np.where(seen, 0.5 + 0.3 * DIRECTIONS[:, 0], np.random.default_rng(1).uniform(0, 1, VIEWS))
    both = errors(np.ones(VIEWS), colors)[seen].max()
    assert errors(100.0 * seen, colors)[seen].max() < 0.1 * both


@pytest.mark.parametrize("edge", [0.2, 0.4, 0.6])
def test_black_may_be_any_value_below(edge):
    glint = np.clip(DIRECTIONS @ [0.6, 0, 0.8] - edge, 0, 1)
    plain = np.linalg.lstsq(TERMS, glint - 0.5, rcond=None)[0]
    of_plain = np.abs(np.maximum(TERMS @ plain + 0.5, 0) - glint)
    assert np.square(errors(np.ones(VIEWS), glint)).mean() < 0.8 * np.square(of_plain).mean()


def test_weights_are_those_of_the_picture():
    arrays = {
        "means": np.array([[0, 0, 0.5], [0, 0, -0.5], [0.7, 0.7, 0]]),
        "log_scales": np.full((3, 3), np.log(0.1)),
        "quaternions": np.tile([1.0, 0, 0, 0], (3, 1)),
        "logit_opacities": np.array([9.0, 9, 9]),
        "sh": np.zeros((3, 1, 3)),
    }
    camera = OrthographicCamera.from_extent(look_at(np.array([0, 0, 3.0]), np.zeros(3)), 64, 64, 2.0)
    before, behind, beside = blended_weights(Gaussians.from_numpy(arrays), Orthographic.of(camera))
    assert before == pytest.approx(beside, rel=0.01)
    assert behind < 0.5 * before
    area = 2 * np.pi * ((0.1 * 32) ** 2 + 0.3)  # of exp(-r^2 / 2 s^2), with the rasterizer's 0.3 pixels^2
    assert before == pytest.approx(area, rel=0.03)
