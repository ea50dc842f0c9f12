"""The error's colours and the shadow masks."""

import numpy as np
from skimage.color import rgb2lab

from spacesim.eval import pictures


def test_error_colors_rise_evenly_from_black_to_white():
    colors = pictures.error_colors(np.linspace(0, 1, 33))
    assert colors[0].tolist() == [0, 0, 0]
    assert colors[-1].tolist() == [255, 255, 255]
    lab = rgb2lab(colors / 255)
    assert np.all(np.diff(lab[:, 0]) > 0)
    steps = np.linalg.norm(np.diff(lab, axis=0), axis=1)[2:]  # the first two are near black, where CIELAB is steep
    assert steps.max() / steps.min() < 3


def test_error_picture_has_a_fixed_scale():
    truth = np.zeros((1, 4, 3))
    prediction = np.array([0, 0.5, 1, 7])[None, :, None] * pictures.ERROR_SCALE * np.ones(3)
    picture = pictures.error_picture(prediction, truth, np.ones((1, 4), bool))
    assert picture[0].tolist() == pictures.error_colors(np.array([0, 0.5, 1, 1])).tolist()
    assert not pictures.error_picture(prediction, truth, np.zeros((1, 4), bool)).any()


def test_shadow_picture_tells_mistakes():
    predicted = np.array([[False, True, True, False, True]])
    shadowed = np.array([[False, True, False, True, True]])
    mask = np.array([[True, True, True, True, False]])
    picture = pictures.shadow_picture(predicted, shadowed, mask)
    expected = [pictures.LIT, pictures.SHADOWED, pictures.WRONGLY_SHADOWED, pictures.WRONGLY_LIT, (0, 0, 0)]
    assert picture[0].tolist() == [list(color) for color in expected]


def test_mask_picture_keeps_what_faces_away_apart():
    classes = np.array([[0, 85, 85, 170, 171, 255, 255]], np.uint8)
    predicted = np.array([[True, True, False, True, False, True, False]])
    expected = [(0, 0, 0), pictures.ATTACHED, pictures.ATTACHED_LIT, pictures.SHADOWED, pictures.WRONGLY_LIT]
    expected += [pictures.WRONGLY_SHADOWED, pictures.LIT]
    assert pictures.mask_picture(predicted, classes, classes > 0)[0].tolist() == [list(color) for color in expected]


def test_bytes_are_rounded_and_clipped():
    assert pictures.as_bytes(np.array([-1, 0.4999 / 255, 0.5001 / 255, 1, 2])).tolist() == [0, 0, 1, 255, 255]


def test_kinds_picture_tells_kinds():
    classes = np.array([[0, 85, 170, 171, 254, 255, 255]], np.uint8)
    mask = np.array([[False, True, True, True, True, True, False]])
    black, attached, own, other = (0, 0, 0), pictures.ATTACHED, pictures.SELF_CAST, pictures.OTHER_CAST
    expected = [black, attached, own, other, other, pictures.LIT, black]
    assert pictures.kinds_picture(classes, mask)[0].tolist() == [list(color) for color in expected]


def test_visibility_picture_goes_from_shadow_to_light():
    picture = pictures.visibility_picture(np.array([[0.0, 1.0, 0.5, 1.0, 3.0]]), np.array([[1.0, 1.0, 1.0, 0.0, 1.0]]))
    assert picture[0, :2].tolist() == [list(pictures.SHADOWED), list(pictures.LIT)]
    assert np.abs(picture[0, 2] - (np.add(pictures.SHADOWED, pictures.LIT)) / 2).max() <= 0.5
    assert picture[0, 3:].tolist() == [[0, 0, 0], list(pictures.LIT)]


def test_depth_picture_is_bright_where_it_is_near():
    depth = np.array([[0, 2.0, 3.0, 4.0, 1.0, 9.0]])
    picture = pictures.depth_picture(depth, (2.0, 4.0))
    shades = 1 - np.array([0, 0.5, 1, 0, 1]) * (1 - pictures.FARTHEST_SHADE)  # beyond the ends as at the ends
    assert picture[0, 0].tolist() == [0, 0, 0]
    assert picture[0, 1:].tolist() == pictures.error_colors(shades).tolist()
