"""Names of frames from elsewhere."""

import numpy as np
import pytest

from spacesim.data.errors import InputError
from spacesim.data.importers.writing import ImportedFrame, frame_names, write_dataset
from spacesim.data.records import Camera


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["images/a.png", "./b.JPG", "c"], ["a", "b", "c"]),
        (["left/a.png", "right/a.png"], ["left/a", "right/a"]),
        (["a.png", "a.jpg", "b.png"], ["a_png", "a_jpg", "b"]),
        (["a.png", "a.jpg", "a_png.png"], ["a_png", "a_jpg", "a_png_png"]),
        (["images/a.png", "a.png"], ["images/a_png", "a_png"]),
    ],
)
def test_names_are_short_and_differ(paths, names):
    assert frame_names(paths) == names


@pytest.mark.parametrize("path", ["/etc/a.png", "../a.png", "a/../../b.png", ""])
def test_names_stay_below_their_folder(path):
    with pytest.raises(InputError, match="expected a name of a picture below its folder"):
        frame_names([path])


def test_no_file_is_written_twice(tmp_path):
    frame = ImportedFrame("a", lambda: np.zeros((2, 2), np.uint8), Camera.from_fov(np.eye(4), 2, 2, 40))
    with pytest.raises(InputError, match=r"somewhere: expected each image once, found 2 of the name images/a\.png"):
        write_dataset(tmp_path / "out", [frame], [frame], {"source": "somewhere"})
    assert not (tmp_path / "out").exists()
