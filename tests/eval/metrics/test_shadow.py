"""Shadow metrics on cases small enough to work out by hand."""

import numpy as np
import pytest

from spacesim.eval.metrics import shadow

EVERYWHERE = np.ones((6, 10), bool)


def step(edge, dark=0.05, bright=0.6):
    """[6, 10] luminance: dark left of column `edge`, bright from there on."""
    luminance = np.full((6, 10), bright)
    luminance[:, :edge] = dark
    return luminance


def test_perfect_prediction():
    metrics = shadow.luminance_metrics(step(4), step(4), EVERYWHERE)
    assert metrics == {"ber": 0, "bias": 0, "boundary_mae": 0, "sharpness_ratio": 1}


def test_band_is_two_pixels_to_each_side():
    band = shadow.boundary_band(step(4) < 0.1, EVERYWHERE)
    assert band.all(axis=0).tolist() == [False, False, True, True, True, True, False, False, False, False]
    assert (band.any(axis=0) == band.all(axis=0)).all()


def test_shifted_edge():
    metrics = shadow.luminance_metrics(step(6), step(4), EVERYWHERE)
    assert metrics["ber"] == pytest.approx(2 / 10)
    assert metrics["bias"] == pytest.approx(0)
    assert metrics["boundary_mae"] == pytest.approx(0.55 * 2 / 4)
    # central differences put slope 0.275 on the two columns beside an edge; the band is columns 2 to 5
    assert metrics["sharpness_ratio"] == pytest.approx((1 * 0.275) / (2 * 0.275))


def test_bias_has_a_sign():
    assert shadow.luminance_metrics(step(4, dark=0.07), step(4), EVERYWHERE)["bias"] == pytest.approx(0.02)
    assert shadow.luminance_metrics(step(4, dark=0.0), step(4), EVERYWHERE)["bias"] == pytest.approx(-0.05)


def test_softer_edge_is_less_sharp():
    soft = np.broadcast_to(np.linspace(0.05, 0.6, 10), (6, 10))
    assert shadow.luminance_metrics(soft, step(4), EVERYWHERE)["sharpness_ratio"] < 0.9


def test_threshold_is_exclusive():
    assert shadow.is_shadowed(np.array([0.0, 0.0999, 0.1, 0.5])).tolist() == [True, True, False, False]


def test_only_the_mask_counts():
    mask = EVERYWHERE.copy()
    mask[:, 5:] = False
    wrong_outside = np.where(mask, step(4), 0.0)
    metrics = shadow.luminance_metrics(wrong_outside, step(4), mask)
    assert (metrics["ber"], metrics["bias"], metrics["boundary_mae"]) == (0, 0, 0)


def test_outline_of_the_silhouette_is_no_shadow_boundary():
    lit = np.zeros((6, 10))
    lit[:, 3:7] = 0.6
    assert not shadow.boundary_band(lit < 0.1, lit > 0).any()
    assert not shadow.boundary_band(lit < 0.1, lit == 0).any()
    assert shadow.boundary_band(lit < 0.1, EVERYWHERE).any()


def test_nothing_to_measure_is_none():
    empty = np.zeros_like(EVERYWHERE)
    assert set(shadow.luminance_metrics(step(4), step(4), empty).values()) == {None}
    no_shadow = shadow.luminance_metrics(step(4), step(0), EVERYWHERE)
    assert no_shadow == {
        "ber": pytest.approx(0.4),
        "bias": None,
        "boundary_mae": None,
        "sharpness_ratio": None,
    }
    assert set(shadow.visibility_metrics(step(4), step(4), empty).values()) == {None, 0}


def test_one_row_has_metrics():
    metrics = shadow.luminance_metrics(step(6)[:1], step(4)[:1], EVERYWHERE[:1])
    assert metrics["ber"] == pytest.approx(0.2)


def test_visibility():
    truth = step(4, dark=0.0, bright=1.0)  # 24 shadowed, 36 lit pixels
    prediction = step(7, dark=0.25, bright=1.0)
    metrics = shadow.visibility_metrics(prediction, truth, EVERYWHERE)
    assert metrics["error_rate"] == pytest.approx(18 / 60)
    assert metrics["balanced_error_rate"] == pytest.approx(0.5 * (0 / 24 + 18 / 36))
    assert metrics["iou"] == pytest.approx(24 / 42)
    assert metrics["visibility_mae"] == pytest.approx((24 * 0.25 + 18 * 0.75) / 60)


def test_visibility_of_one_half_is_lit():
    half = np.full((6, 10), 0.5)
    assert shadow.visibility_metrics(half, np.ones((6, 10)), EVERYWHERE)["error_rate"] == 0


def test_visibility_without_shadows():
    lit = np.ones((6, 10))
    metrics = shadow.visibility_metrics(lit, lit, EVERYWHERE)
    assert metrics == {"error_rate": 0, "balanced_error_rate": None, "iou": None, "visibility_mae": 0, "pixels": 60}


def test_kinds_of_shadow_are_scored_separately():
    classes = np.array([[0, 85, 85, 85, 170, 170, 171, 254, 255, 255, 255, 255, 255, 255]], np.uint8)
    truth = (classes == 255).astype(float)
    dark = np.array([[1, 1, 1, 0, 1, 0, 1, 1, 1, 0, 0, 0, 0, 0]], bool)
    valid = np.ones_like(dark)
    valid[0, -1] = False  # five lit pixels are left, of which one is predicted dark
    kinds = {kind: shadow.kind_metrics(1.0 - dark, truth, classes, kind, valid) for kind in shadow.KINDS}
    assert kinds["shadow_attached"] == {
        "recall": pytest.approx(2 / 3),
        "error_rate": pytest.approx(2 / 8),
        "balanced_error_rate": pytest.approx(0.5 * (1 / 3 + 1 / 5)),
        "iou": pytest.approx(2 / 4),
        "visibility_mae": pytest.approx(2 / 8),
        "pixels": 8,
    }
    assert kinds["shadow_self_cast"]["recall"] == pytest.approx(1 / 2)
    assert kinds["shadow_self_cast"]["error_rate"] == pytest.approx(2 / 7)
    assert kinds["shadow_other_cast"]["recall"] == 1
    assert kinds["shadow_other_cast"]["iou"] == pytest.approx(2 / 3)


def test_a_kind_that_is_not_there_is_none():
    classes = np.full((6, 10), 255, np.uint8)
    lit = np.ones((6, 10))
    assert {shadow.kind_metrics(lit, lit, classes, kind, EVERYWHERE) for kind in shadow.KINDS} == {None}
    classes[:, :5] = 170
    assert shadow.kind_metrics(lit, lit, classes, "shadow_self_cast", classes == 255) is None
