"""What training reads of a frame, looked at before it begins."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as PillowImage

from spacesim.data.errors import InputError
from spacesim.data.images import write_exr, write_png
from spacesim.data.integrity.whole import check_pictures, check_truth
from spacesim.data.store import read_dataset


@pytest.fixture
def data(tiny_data, tmp_path):
    return read_dataset(shutil.copytree(tiny_data, tmp_path / "data"))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def empty(path: Path) -> None:
    path.write_bytes(b"")


def another_size(path: Path) -> None:
    write_png(path, np.zeros((5, 6, 4), np.uint8))


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (cut, "expected a readable image, found a file that is broken or cut off"),
        (empty, "expected PNG, JPEG or another image"),
        (Path.unlink, "expected a file, found none"),
        (another_size, "expected 40x40 pixels as the camera says, found 6x5"),
        (lambda path: path.write_bytes(b"x\n"), "expected PNG, JPEG or another image"),
    ],
)
def test_a_picture_that_is_not_whole_is_named(data, damage, sentence):
    check_pictures(data, data.train)
    path = data.root / data.train[-1].file_path
    damage(path)
    with pytest.raises(InputError, match=rf"{path.name}: {sentence}"):
        check_pictures(data, data.train)


def test_masks_are_looked_at_and_silhouettes_where_pictures_have_no_alpha(data):
    silhouette = data.root / data.train[0].silhouette_path
    cut(silhouette)
    check_pictures(data, data.train)  # which nobody reads
    picture = data.root / data.train[0].file_path
    with PillowImage.open(picture) as image:
        opaque = image.convert("RGB")
    opaque.save(picture)
    with pytest.raises(InputError, match=rf"silhouette/{silhouette.name}: expected a readable image"):
        check_pictures(data, data.train)


def test_whole_files_with_more_behind_their_end_pass(data):
    path = data.root / data.train[0].file_path
    path.write_bytes(path.read_bytes() + b"more")
    check_pictures(data, data.train)
    with PillowImage.open(path) as image:
        opaque = image.convert("RGB")
    opaque.save(path, format="JPEG")
    path.write_bytes(path.read_bytes() + bytes(100))
    check_pictures(data, data.train)
    path.write_bytes(path.read_bytes()[:-110])
    with pytest.raises(InputError, match=path.name):
        check_pictures(data, data.train)


def test_truth_that_is_not_whole_or_of_another_size_is_named(data):
    check_truth(data, data.train)
    path = data.root / data.train[1].gt_path
    cut(path)
    with pytest.raises(InputError, match=rf"{path.name}: expected an EXR file, found one that is cut off"):
        check_truth(data, data.train)
    write_exr(path, {"alpha": np.zeros((8, 8))})
    with pytest.raises(InputError, match=rf"{path.name}: expected 40x40 pixels as the camera says, found 8x8"):
        check_truth(data, data.train)
