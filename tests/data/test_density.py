"""The camera density is a density, its map has things where they are, whatever dataset it is of."""

import json
from dataclasses import replace

import numpy as np
import pytest

from spacesim.data.density import BANDWIDTH_DEG, camera_density, density, target_of, write_camera_density
from spacesim.data.geometry import direction_from_angles, fibonacci_sphere, look_at
from spacesim.data.images import read_png, write_png
from spacesim.data.records import Camera, Dataset, Frame, Sun
from spacesim.data.store import read_dataset, write_points

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


def test_color_tells_even_coverage():
    picture = camera_density(5 * fibonacci_sphere(3000), np.zeros(3))
    inside = picture[70:590, 100:1160].reshape(-1, 3).astype(int)
    assert np.ptp(inside, axis=0).max() < 12
    bar = picture[58:598, 1210].astype(int)  # top to bottom, twice the even density to none
    np.testing.assert_allclose(inside.mean(axis=0), bar[270 - 6 : 270 - 3].mean(axis=0), atol=6)


def frames_looking_at(target, directions, away=5.0):
    """Frames without a Sun or truth: poses alone."""
    poses = [look_at(np.asarray(target) + away * direction, target) for direction in np.asarray(directions)]
    return tuple(Frame(f"images/{k}.png", Camera.from_fov(pose, 20, 16, 30.0)) for k, pose in enumerate(poses))


def test_target_is_the_mesh_or_where_cameras_look(tmp_path):
    aim = [0.5, 0.2, -0.3]
    dataset = Dataset(tmp_path, frames_looking_at(aim, fibonacci_sphere(9)), ())
    np.testing.assert_allclose(target_of(dataset), aim, atol=1e-9)
    arc = direction_from_angles(np.full(6, 20.0), np.linspace(-5, 5, 6))
    np.testing.assert_allclose(target_of(replace(dataset, train=frames_looking_at(aim, arc))), aim, atol=1e-9)
    write_points(tmp_path / "points.ply", [*np.tile([[3.0, 2, 1]], (9, 1)), [1e4, 0, 0]], np.zeros((10, 3)))
    with_points = replace(dataset, ply_file_path="points.ply")
    np.testing.assert_allclose(target_of(with_points), aim, atol=1e-9)
    approach = replace(with_points, train=frames_looking_at(aim, [[0, 0, 1.0]] * 3))  # which say no depth
    np.testing.assert_allclose(target_of(approach), [3, 2, 1])
    np.testing.assert_allclose(target_of(replace(approach, ply_file_path=None))[:2], aim[:2], atol=1e-9)
    write_points(tmp_path / "mesh.ply", [[0, 0, 0], [2, 4, 6], [1, 1, 1]], np.zeros((3, 3)))
    np.testing.assert_allclose(target_of(replace(dataset, mesh_path="mesh.ply")), [1, 2, 3])


def test_map_of_a_foreign_dataset(tmp_path):
    """Nerfstudio's transforms.json with poses and nothing else, about a target far from the origin."""
    directions = direction_from_angles([120.0, 121, 122], [50.0, 50, 50])
    frames = []
    for frame in frames_looking_at([100, -20, 7], directions):
        write_png(tmp_path / frame.file_path, np.zeros((16, 20, 3), np.uint8))
        pose = frame.camera.world_from_camera @ np.diag([1.0, -1, -1, 1])  # OpenGL's axes
        frames.append({"file_path": frame.file_path, "transform_matrix": pose.tolist()})
    inner = {"fl_x": 37.3, "fl_y": 37.3, "cx": 10, "cy": 8, "w": 20, "h": 16}
    (tmp_path / "transforms.json").write_text(json.dumps({**inner, "frames": frames}))
    write_camera_density(tmp_path / "map.png", read_dataset(tmp_path))
    picture = read_png(tmp_path / "map.png").astype(int)
    x, y = column_row(121, 50)
    assert picture[y, x, :2].min() > 200
    x, y = column_row(301, -50)
    assert np.abs(picture[y, x] - [0x44, 0x01, 0x54]).max() <= 2


def test_suns_of_training_and_of_testing_alone(tmp_path):
    def lit(angles):
        return replace(frames_looking_at([0, 0, 0], [[1.0, 0, 0]])[0], sun=Sun.from_angles(*angles))

    dataset = Dataset(tmp_path, (lit((45, 35)),), (lit((45, 35)), lit((45, -35))))
    write_camera_density(tmp_path / "map.png", dataset)
    picture = read_png(tmp_path / "map.png")
    for angles, color in (((45, 35), [255, 150, 30]), ((45, -35), [255, 255, 255])):
        x, y = column_row(*angles)
        np.testing.assert_array_equal(picture[y, x], color)
