"""The figures of docs/research/rasterizer.md (`accuracy.py`), by fewer scenes."""

import accuracy
import numpy as np
import pytest
from twin import KINDS


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_pictures_and_gradients_are_as_near_the_twins_as_the_page_says(kind, antialiased):
    (color, alpha, depth, _, normal), at_cut, pixels = accuracy.pictures(kind, antialiased, scenes=3)
    assert color < 2e-6
    assert alpha < 4e-6
    assert depth < 1e-5
    assert normal < 1e-3
    assert at_cut < 1e-4 * pixels
    assert max(accuracy.gradients(kind, antialiased)) < 5e-6  # of intrinsics; CUDA 4.01e-6


@pytest.mark.parametrize("kind", KINDS)
def test_crops_are_parts_of_the_whole(kind):
    assert np.max(accuracy.crops(kind)) < 1e-5


def test_means_of_small_pictures():
    assert accuracy.zoomed((16,), False)[0] > 2
    assert accuracy.zoomed((16,), True)[0] == pytest.approx(1, abs=0.01)
