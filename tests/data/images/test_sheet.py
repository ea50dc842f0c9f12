"""Contact sheets have every picture where it belongs, whole and over black."""

import numpy as np
import pytest

from spacesim.data.images.sheet import (
    DARK_PAGE,
    GAP,
    LABEL_HEIGHT,
    MIN_TILE_WIDTH,
    Tile,
    columns_for,
    contact_sheet,
    fit_picture,
)

HEAD = 52


@pytest.mark.parametrize(("count", "columns"), [(1, 2), (5, 3), (24, 7), (60, 10), (1000, 10)])
def test_pages_are_wider_than_high(count, columns):
    assert columns_for(count) == columns


def test_tiles_stand_row_by_row_on_the_page():
    tiles = [
        Tile(np.full((50, 100, 3), 40 * k + 10, np.uint8), mark=np.full((30, 20, 3), k, np.uint8)) for k in range(5)
    ]
    picture = contact_sheet("five", iter(tiles), 5, aspect=0.5, columns=2, side=200, page=DARK_PAGE)
    assert picture.shape == (HEAD + 3 * (100 + LABEL_HEIGHT + GAP), 560, 3)
    for k in range(5):
        x, y = GAP + k % 2 * (200 + GAP), HEAD + k // 2 * (100 + LABEL_HEIGHT + GAP)
        assert (picture[y : y + 100, x : x + 200] == 40 * k + 10).all()
        assert (picture[y + 104 : y + 134, x + 180 : x + 200] == k).all()
    assert (picture[-60:, 300:] == DARK_PAGE.paper).all()  # no sixth tile


def test_a_label_is_in_its_colors_below_its_picture():
    picture = contact_sheet("", [Tile(np.zeros((20, 20), np.uint8), "name", "detail")], 1, 1.0, page=DARK_PAGE)
    name, detail = picture[HEAD + 176 + 2 : HEAD + 176 + 20], picture[HEAD + 176 + 21 : HEAD + 176 + LABEL_HEIGHT]
    assert name.max(axis=(0, 1)).tolist() == list(DARK_PAGE.ink)
    assert 100 < detail.max() < 180


def test_titles_and_labels_of_narrow_pictures_are_whole():
    mark = np.full((LABEL_HEIGHT - 4, LABEL_HEIGHT - 4, 3), 99, np.uint8)
    tall = Tile(np.zeros((40, 10), np.uint8), "azimuth 210.5°", "elevation -77.1°", mark)
    picture = contact_sheet(
        "a title as long as a run's name can be " * 3, [tall], 1, 4.0, 1, least=MIN_TILE_WIDTH + LABEL_HEIGHT
    )
    assert (picture[:HEAD, -GAP:] == 255).all()
    gap = picture[-LABEL_HEIGHT - GAP :, GAP + MIN_TILE_WIDTH : GAP + MIN_TILE_WIDTH + 4]
    assert (gap == 255).all()  # between the words and the mark
    assert (
        picture[-LABEL_HEIGHT - GAP + 4 : -GAP, GAP + MIN_TILE_WIDTH + 4 : GAP + MIN_TILE_WIDTH + LABEL_HEIGHT] == 99
    ).all()


def test_fitted_keeps_shape_and_blends_over_black():
    assert fit_picture(np.zeros((100, 400, 3), np.uint8), 200, 200).size == (200, 50)
    assert fit_picture(np.zeros((10, 5, 3), np.uint8), 200, 200).size == (100, 200)
    half = np.full((4, 4, 4), (200, 100, 50, 51), np.uint8)
    assert np.asarray(fit_picture(half, 4, 4))[0, 0].tolist() == [40, 20, 10]
    assert np.asarray(fit_picture(np.full((4, 4), 0x8070, np.uint16), 4, 4))[0, 0].tolist() == [0x80] * 3
