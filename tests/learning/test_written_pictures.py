"""A prediction as a file."""

import numpy as np

from spacesim.data.images import read_exr
from spacesim.learning.pictures import write_picture
from spacesim.learning.prediction import Prediction


def test_visibility_is_a_share_in_files_too(tmp_path):
    """A sum of weights over their sum may be a rounding above 1."""
    plane = np.array([[1.000003, 0.25], [0.0, -1e-7]], np.float32)
    ones = np.ones((2, 2), np.float32)
    prediction = Prediction(np.ones((2, 2, 3), np.float32), ones, ones, plane)
    write_picture(prediction, "shadow", tmp_path / "seen.exr")
    assert read_exr(tmp_path / "seen.exr")["shadow"].tolist() == [[1.0, 0.25], [0.0, 0.0]]
