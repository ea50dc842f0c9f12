"""The contact sheet shows the frames, and the overview has it and the map of the cameras."""

import numpy as np
import pytest

from spacesim.data.density import write_camera_density
from spacesim.data.errors import InputError
from spacesim.data.geometry import fibonacci_sphere
from spacesim.data.images import write_png
from spacesim.data.records import Camera, Dataset, Frame, Sun
from spacesim.scenes.generation.overview import (
    MAX_TILES,
    contact_sheet,
    write_overview,
)


def make_dataset(root, train, test=0, size=(20, 16)):
    """Frames of one grey each: 2 k."""
    (root / "images").mkdir(parents=True)
    frames = []
    for k, direction in enumerate(fibonacci_sphere(train + test)):
        pose = np.eye(4)
        pose[:3, 3] = 5 * direction
        name = f"images/{'train' if k < train else 'test'}_{k:05d}.png"
        write_png(root / name, np.full((*size[::-1], 3), 2 * k, np.uint8))
        frames.append(Frame(name, Camera.from_fov(pose, *size, 30.0), Sun.from_angles(45, 35 if k < train else -35)))
    return Dataset(root, tuple(frames[:train]), tuple(frames[train:]))


def tiles(picture, count, columns, wide, high):
    """Middle pixels of the tiles."""
    for k in range(count):
        yield picture[52 + k // columns * (high + 48) + high // 2, 8 + k % columns * (wide + 8) + wide // 2]


def test_contact_sheet_shows_all_of_few_frames(tmp_path):
    dataset = make_dataset(tmp_path, 5, 2)
    picture = contact_sheet(dataset)
    found = list(tiles(picture, 7, 4, 176, 141))
    np.testing.assert_array_equal(found, [[2 * k] * 3 for k in range(7)])


def test_contact_sheet_shows_some_of_many_frames(tmp_path):
    dataset = make_dataset(tmp_path, 100, 20)
    picture = contact_sheet(dataset)
    values = np.array(list(tiles(picture, MAX_TILES, 10, 176, 141)))[:, 0] // 2
    assert values[0] == 0
    assert values[-1] == 119
    assert set(np.diff(values)) == {2, 3} or set(np.diff(values)) == {2}


def test_transparent_and_tall_pictures(tmp_path):
    dataset = make_dataset(tmp_path, 1, size=(16, 64))
    pixels = np.full((64, 16, 4), 200, np.uint8)
    pixels[..., 3] = 51
    write_png(tmp_path / dataset.train[0].file_path, pixels)
    picture = contact_sheet(dataset)
    assert picture[52 + 88, 8 + 55, 0] == 40  # a fifth of 200, over black
    assert picture[52 + 88, 8 + 10, 0] == 0  # beside the picture
    write_png(tmp_path / dataset.train[0].file_path, np.full((64, 16), 0x3210, np.uint16))
    assert contact_sheet(dataset)[52 + 88, 8 + 55, 0] == 0x32


def test_overview_is_written_with_the_same_bytes(tmp_path):
    dataset = make_dataset(tmp_path, 6, 2)
    write_overview(tmp_path, dataset)
    names = ("camera_density.png", "contact_sheet.png")
    first = [(tmp_path / name).read_bytes() for name in names]
    write_overview(tmp_path, dataset)
    assert [(tmp_path / name).read_bytes() for name in names] == first
    write_camera_density(tmp_path / "map.png", dataset)
    assert (tmp_path / "map.png").read_bytes() == first[0]
    (tmp_path / "images" / "train_00003.png").unlink()
    with pytest.raises(InputError, match=r"train_00003\.png"):
        write_overview(tmp_path, dataset)
