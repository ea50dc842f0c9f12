"""The camera density is a density, its map has things where they are, the contact sheet shows the frames."""

from dataclasses import replace

import numpy as np
import pytest

from spacesim.data.errors import InputError
from spacesim.data.geometry import direction_from_angles, fibonacci_sphere
from spacesim.data.images import read_png, write_png
from spacesim.data.records import Camera, Dataset, Frame, Sun
from spacesim.data.store import write_points
from spacesim.scenes.generation.overview import (
    BANDWIDTH_DEG,
    MOST_TILES,
    camera_density,
    contact_sheet,
    density,
    target_of,
    write_overview,
)

SPHERE = fibonacci_sphere(20_000)  # each point stands for 4 pi / 20,000 sr


@pytest.mark.parametrize("count", [1, 300, 9000])
def test_density_integrates_to_the_number_of_views(count):
    directions = fibonacci_sphere(count, seed=3)
    assert density(directions, SPHERE).mean() * 4 * np.pi == pytest.approx(count, rel=1e-3)


def test_density_of_an_even_lattice_is_even():
    values = density(fibonacci_sphere(9000, seed=3), SPHERE)  # gathered on a lattice first
    np.testing.assert_allclose(values, 9000 / (4 * np.pi), rtol=0.2)
    values = density(fibonacci_sphere(3000, seed=3), SPHERE)
    np.testing.assert_allclose(values, 3000 / (4 * np.pi), rtol=0.03)


def test_density_of_one_view_falls_as_a_bell_of_its_bandwidth():
    at = direction_from_angles([0, BANDWIDTH_DEG, 0, 180], [60, 60, 60 + BANDWIDTH_DEG, -60])
    peak, east, north, behind = density(at[:1], at)
    assert north / peak == pytest.approx(np.exp(-0.5), rel=0.01)
    assert east / peak == pytest.approx(np.exp(-0.5 * 0.25), rel=0.01)  # half as far on the sphere as at the equator
    assert behind < 1e-9


def column_row(azimuth, elevation):
    """Pixel of a direction in the map: +x in the middle, 3 pixels a degree."""
    return round(92 + 3 * ((azimuth + 180) % 360)), round(58 + 3 * (90 - elevation))


def test_map_shows_cameras_and_suns_where_they_are():
    target = np.array([3.0, 1, -2])
    positions = target + 7 * direction_from_angles([310.0, 310.5], [-40.0, -40.0])
    suns, test_suns = direction_from_angles([[45.0]], [[35.0]])[0], direction_from_angles([[200.0]], [[10.0]])[0]
    picture = camera_density(positions, target, suns, test_suns)
    x, y = column_row(310, -40)
    assert picture[y, x, :2].min() > 200  # viridis ends in yellow
    assert picture[y, x, 2] < 90
    x, y = column_row(310, 40)
    assert np.abs(picture[y, x].astype(int) - [0x44, 0x01, 0x54]).max() <= 2  # and begins with violet
    x, y = column_row(45, 35)
    np.testing.assert_array_equal(picture[y, x], [255, 150, 30])
    x, y = column_row(200, 10)
    np.testing.assert_array_equal(picture[y, x], [255, 255, 255])
    np.testing.assert_array_equal(picture, camera_density(positions, target, suns, test_suns))


def test_colour_tells_even_coverage():
    picture = camera_density(5 * fibonacci_sphere(3000), np.zeros(3))
    inside = picture[70:590, 100:1160].reshape(-1, 3).astype(int)
    assert np.ptp(inside, axis=0).max() < 12
    bar = picture[58:598, 1210].astype(int)  # top to bottom, twice the even density to none
    np.testing.assert_allclose(inside.mean(axis=0), bar[270 - 6 : 270 - 3].mean(axis=0), atol=6)


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
    values = np.array(list(tiles(picture, MOST_TILES, 10, 176, 141)))[:, 0] // 2
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


def test_target_is_the_mesh_or_where_cameras_look(tmp_path):
    dataset = make_dataset(tmp_path, 9)
    aimed = []
    for frame in dataset.train:
        position = frame.camera.position
        forward = np.array([0.5, 0.2, -0.3]) - position
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.1, 0.2, 0.9])
        right /= np.linalg.norm(right)
        pose = frame.camera.world_from_camera.copy()
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        aimed.append(replace(frame, camera=Camera.from_fov(pose, 20, 16, 30.0)))
    dataset = replace(dataset, train=tuple(aimed))
    np.testing.assert_allclose(target_of(dataset), [0.5, 0.2, -0.3], atol=1e-9)
    write_points(tmp_path / "mesh.ply", [[0, 0, 0], [2, 4, 6], [1, 1, 1]], np.zeros((3, 3)))
    np.testing.assert_allclose(target_of(replace(dataset, mesh_path="mesh.ply")), [1, 2, 3])


def test_overview_is_written_with_the_same_bytes(tmp_path):
    dataset = make_dataset(tmp_path, 6, 2)
    write_overview(tmp_path, dataset)
    names = ("camera_density.png", "contact_sheet.png")
    first = [(tmp_path / name).read_bytes() for name in names]
    write_overview(tmp_path, dataset)
    assert [(tmp_path / name).read_bytes() for name in names] == first
    density_map = read_png(tmp_path / names[0])
    x, y = column_row(45, 35)
    np.testing.assert_array_equal(density_map[y, x], [255, 150, 30])
    x, y = column_row(45, -35)
    np.testing.assert_array_equal(density_map[y, x], [255, 255, 255])
    (tmp_path / "images" / "train_00003.png").unlink()
    with pytest.raises(InputError, match=r"train_00003\.png"):
        write_overview(tmp_path, dataset)
