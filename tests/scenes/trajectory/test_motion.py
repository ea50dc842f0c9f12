"""Camera, target, Sun and Earth that move in a world, against the same geometry reckoned in that world."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny import contents

from spacesim.cli.program import main
from spacesim.data.errors import InputError
from spacesim.data.images import read_png
from spacesim.data.store import load_truth
from spacesim.data.transforms import read_dataset
from spacesim.scenes.background.config import BackgroundConfig
from spacesim.scenes.background.draw import Background
from spacesim.scenes.background.stars import Stars
from spacesim.scenes.build import build
from spacesim.scenes.cameras.camera import CameraConfig
from spacesim.scenes.cameras.exposure import record_image
from spacesim.scenes.cameras.rig import TargetSphere, plan
from spacesim.scenes.generation.generate import generate, plan_views
from spacesim.scenes.lights.earth import EarthConfig
from spacesim.scenes.scenefile import read_scene
from spacesim.scenes.trajectory.motion import Motion, merge
from spacesim.scenes.trajectory.rig import FileRig
from spacesim.scenes.trajectory.tracks import Attitude, Direction, Track

CAMERA = CameraConfig((64, 48), fov_deg=30.0)
TARGET = TargetSphere(np.zeros(3), 2.0)
SMALL = {"resolution": (16, 16), "spp": 1, "points": 50}
ALL = [
    "time_s",
    *(f"camera_{axis}_m" for axis in "xyz"),
    *(f"world_from_camera_q{axis}" for axis in "wxyz"),
    *(f"target_{axis}_m" for axis in "xyz"),
    *(f"world_from_target_q{axis}" for axis in "wxyz"),
    *("sun_x", "sun_y", "sun_z"),
    *(f"earth_{axis}_m" for axis in "xyz"),
]
SPIN = np.array([0.02, -0.03, 0.05])  # radians a second, of the target
VELOCITY = np.array([7000.0, 2000.0, -1000.0])
APPROACH = np.array([-0.1, 0.02, 0.0])  # metres a second, of the camera towards the target


def wxyz(rotation):
    return np.roll(rotation.as_quat(), 1, axis=-1)


def state(t):
    """(camera position, attitude; target position, attitude) in the world at time t."""
    target = np.array([7e6, 1e6, 2e6]) + VELOCITY * t
    turn = Rotation.from_rotvec(SPIN * t) * Rotation.from_euler("xyz", [0.3, 0.4, 0.5])
    away = np.array([12.0, 3.0, -2.0]) + APPROACH * t
    z = -away / np.linalg.norm(away)
    x = np.cross(z, [0, 0, 1])
    x /= np.linalg.norm(x)
    return target + away, Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=1)), target, turn


SUN = np.array([0.3, -0.8, 0.4]) / np.linalg.norm([0.3, -0.8, 0.4])


def row(t, common=None):
    """A row of ALL. common: (rotation, shift) that moves the whole world"""
    rotation, shift = common or (Rotation.identity(), np.zeros(3))
    camera, looks, target, turn = state(t)
    places = [rotation.apply(p) + shift for p in (camera, target, np.zeros(3))]
    turns = [wxyz(rotation * r) for r in (looks, turn)]
    return [t, *places[0], *turns[0], *places[1], *turns[1], *rotation.apply(SUN), *places[2]]


def write(path, rows, names=ALL):
    lines = [",".join(names), *(",".join(repr(float(value)) for value in one) for one in rows)]
    path.write_text("# made for a test\n" + "\n".join(lines) + "\n")
    return path


@pytest.fixture
def table(tmp_path):
    return write(tmp_path / "path.csv", [row(float(t)) for t in range(0, 50, 5)])


def pixel(camera, point):
    x, y, z = (camera.camera_from_world @ [*point, 1])[:3]
    return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])


def pixel_in_world(t, point):
    """Where a point of the target's body is in the picture, reckoned in the world."""
    place, looks, target, turn = state(t)
    x, y, z = looks.inv().apply(turn.apply(point) + target - place)
    focal = 32 / np.tan(np.radians(15))
    return np.array([focal * x / z + 32, focal * y / z + 24])


@pytest.mark.parametrize("options", [{}, {"views": 19}, {"step_s": 2.5}, {"views": 4, "test_views": 7}])
def test_what_the_camera_sees_of_a_target_that_moves(table, options):
    train, test = plan(FileRig(path=str(table), **options), TARGET, CAMERA, 0)
    count = 19 if "step_s" in options else options.get("views", 10)
    assert (len(train), len(test)) == (count, options.get("test_views", 0))
    assert [view.time for view in train] == pytest.approx(np.linspace(0, 45, count))
    assert {view.time for view in train}.isdisjoint(view.time for view in test)
    for view in train + test:
        *_, turn = state(view.time)
        np.testing.assert_allclose(view.sun.direction, turn.inv().apply(SUN), atol=1e-9)
        np.testing.assert_allclose(view.earth, turn.inv().apply(-state(view.time)[2]), atol=1e-6)
        np.testing.assert_allclose(view.sky_from_world, turn.as_matrix(), atol=1e-9)
        exact = view.time % 5 == 0  # else the camera's own attitude, which no slerp is, is a little off
        for point in ([0, 0, 0], [1, 2, -1], [-2, 0.5, 0.3]):
            error = np.abs(pixel(view.camera, point) - pixel_in_world(view.time, point)).max()
            assert error < (1e-6 if exact else 0.1)


def test_a_world_that_is_moved_as_a_whole_changes_nothing(table, tmp_path):
    common = Rotation.from_euler("zyx", [1.0, -0.4, 2.0]), np.array([1e5, -3e5, 2e4])
    moved = write(tmp_path / "moved.csv", [row(float(t), common) for t in range(0, 50, 5)])
    first, second = (plan(FileRig(path=str(path), views=7), TARGET, CAMERA, 0)[0] for path in (table, moved))
    for one, other in zip(first, second, strict=True):
        np.testing.assert_allclose(other.camera.world_from_camera, one.camera.world_from_camera, atol=2e-8)
        np.testing.assert_allclose(other.sun.direction, one.sun.direction, atol=1e-12)
        np.testing.assert_allclose(other.earth, one.earth, rtol=1e-12)


def test_stars_and_ground_stand_still_in_the_world(table):
    """What is behind the target is what a camera with the same attitude sees in the world."""
    scene = replace(build(read_scene("boxsat")), earth=EarthConfig())
    background = Background(BackgroundConfig(star_gain=1e6), scene, (), seed=4)
    stars = Stars(int(np.random.SeedSequence([4, 102]).generate_state(1)[0]))
    earth = EarthConfig(elevation_deg=89.0, altitude_km=1e6)  # out of the way
    globes = []
    for view in plan(FileRig(path=str(table)), TARGET, CAMERA, 0)[0][:3]:
        _, looks, *_ = state(view.time)
        pose = np.eye(4)
        pose[:3, :3] = looks.as_matrix()
        behind = background.radiance(view.camera, view.sun, 0, earth, view.sky_from_world)
        alone = stars.draw(replace(view.camera, world_from_camera=pose))
        np.testing.assert_allclose(behind[..., 1], 1e6 * alone, rtol=1e-3, atol=1e-3 * 1e6 * alone.max())
        assert alone.max() > 0
        place = background.placement(view.camera, view.sun, 0, earth, view.sky_from_world)
        globes.append(place.globe_from_world @ view.sky_from_world.T)
    np.testing.assert_allclose(globes[1:], [globes[0]] * 2, atol=1e-9)


def test_positions_between_rows_are_cubic_where_velocities_are_given():
    times = np.array([0.0, 2.0, 5.0])
    cubic = np.stack([times**3, 1 - times**2, 4 * times], axis=1)
    rates = np.stack([3 * times**2, -2 * times, 0 * times + 4], axis=1)
    asked = np.linspace(0, 5, 11)
    expected = np.stack([asked**3, 1 - asked**2, 4 * asked], axis=1)
    np.testing.assert_allclose(Track("a", times, cubic, rates).at(asked), expected, atol=1e-12)
    straight = Track("a", times, cubic).at(np.array([1.0]))
    np.testing.assert_allclose(straight, [[4, -1, 4]])


def test_attitudes_between_rows_turn_evenly_the_shorter_way():
    turns = Rotation.from_rotvec(np.radians([[0, 0, 10], [0, 0, 50]]))
    quaternions = wxyz(turns) * [[1], [-1]]  # the same rotations
    found = Attitude("a", np.array([0.0, 4.0]), quaternions).at(np.array([0.0, 1.0, 4.0]))
    angles = Rotation.from_matrix(found).as_rotvec(degrees=True)
    np.testing.assert_allclose(angles, [[0, 0, 10], [0, 0, 20], [0, 0, 50]], atol=1e-10)


def test_an_ambiguous_half_turn_is_warned_of(caplog):
    turns = Attitude("a", np.array([0.0, 4.0]), wxyz(Rotation.from_rotvec(np.radians([[0, 0, 0], [0, 0, 150]]))))
    turns.at(np.array([0.0, 4.0]))
    assert caplog.records == []
    turns.at(np.array([0.0, 1.0]))
    assert [one.message for one in caplog.records] == ["a: turns by 150 degrees between two rows; which way is a guess"]


def test_directions_between_rows_turn_evenly_along_a_great_circle(caplog):
    suns = np.array([[1.0, 0, 0], [0, 1, 0], [0, 1, 0], [0, 0.6, 0.8]])
    found = Direction("sun", np.array([0.0, 9.0, 10.0, 12.0]), suns).at(np.array([0.0, 3.0, 9.0, 9.5, 11.0, 12.0]))
    half = np.array([0, 1.6, 0.8]) / np.hypot(1.6, 0.8)
    expected = [suns[0], [np.cos(np.pi / 6), np.sin(np.pi / 6), 0], suns[1], suns[1], half, suns[3]]
    np.testing.assert_allclose(found, expected, atol=1e-12)
    assert caplog.records == []


@pytest.mark.parametrize("sun", np.concatenate([np.eye(3), [[0.6, 0, -0.8]]]))
def test_a_sun_that_changes_sides_is_interpolated_with_a_warning(caplog, sun):
    found = Direction("sun", np.array([0.0, 10.0]), np.array([sun, -sun])).at(np.linspace(0, 10, 5))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1)
    np.testing.assert_allclose(found @ sun, np.cos(np.linspace(0, np.pi, 5)), atol=1e-12)
    assert "turns by 180 degrees between two rows" in caplog.text


def test_rows_that_another_track_does_not_cover_are_warned_of(caplog):
    camera = Track("camera", np.arange(5.0), np.ones((5, 3)))
    sun = Direction("sun", np.array([0.0, 2.5]), np.eye(3)[:2])
    assert Motion(camera=camera, sun=sun).times().tolist() == [0, 1, 2]
    expected = "camera: 2 of 5 rows are left out, as sun does not cover them; what is left is from 0 to 2 s"
    assert [one.message for one in caplog.records] == [expected]
    caplog.clear()
    assert len(Motion(camera=camera).times()) == 5
    assert caplog.records == []


def test_a_camera_that_looks_at_a_target_that_tumbles_does_not_roll_with_it(table):
    text = table.read_text().splitlines()
    names = text[1].split(",")
    kept = [k for k, name in enumerate(names) if not name.startswith("world_from_camera")]
    table.write_text("\n".join(",".join(line.split(",")[k] for k in kept) for line in text[1:]))
    for view in plan(FileRig(path=str(table)), TARGET, CAMERA, 0)[0]:
        turn = state(view.time)[3].as_matrix() @ view.camera.world_from_camera[:3, :3]
        assert abs(turn[2, 0]) < 1e-9  # the picture's rows lie level in the world
        assert turn[2, 1] < 0  # and its top is up


def test_a_table_without_a_pose(tmp_path):
    path = write(tmp_path / "p.csv", [[0, 1, 0, 0]], ["time_s", "sun_x", "sun_y", "sun_z"])
    with pytest.raises(InputError, match=r"p.csv: expected a pose of the camera or of the target, found no column"):
        plan(FileRig(path=str(path)), TARGET, CAMERA, 0)


def test_an_earth_that_is_too_near(tmp_path):
    names = ["camera_x_m", "camera_y_m", "camera_z_m", "earth_x_m", "earth_y_m", "earth_z_m"]
    path = write(tmp_path / "p.csv", [[9, 0, 0, 0, 0, 6e6]], names)
    with pytest.raises(InputError, match=r"earth: expected the Earth's centre beyond its radius .* 6000 km in train_0"):
        generate(read_scene("boxsat", **SMALL, trajectory=path), tmp_path / "data")


def test_without_an_attitude_the_camera_looks_at_the_target(tmp_path):
    names = ["time_s", "camera_x_km", "camera_y_km", "camera_z_km"]
    path = write(tmp_path / "p.csv", [[0, 0.01, 0, 0], [1, 0, 0.02, 0]], names)
    train, _ = plan(FileRig(path=str(path), sun=((10.0, 20.0),)), TargetSphere(np.array([0, 0, 0.5]), 1.0), CAMERA, 0)
    for view, place in zip(train, ([10, 0, 0], [0, 20, 0]), strict=True):
        np.testing.assert_allclose(view.camera.position, place)
        np.testing.assert_allclose(pixel(view.camera, [0, 0, 0.5]), [32, 24])
        assert view.sun.angles == pytest.approx((10, 20))
        assert (view.earth, view.exposure) == (None, None)


def test_a_trajectory_without_a_sun_says_where_it_stands(table, tmp_path, caplog):
    path = write(tmp_path / "p.csv", [[9, 0, 0]], ["camera_x_m", "camera_y_m", "camera_z_m"])
    train, _ = plan(FileRig(path=str(path)), TARGET, CAMERA, 0)
    assert train[0].sun.angles == pytest.approx((45, 35))
    expected = "rig: no sun is given; it stands at azimuth 45, elevation 35 degrees in the trajectory's world frame"
    assert [record.getMessage() for record in caplog.records] == [expected]
    caplog.clear()
    plan(FileRig(path=str(path), sun=((45.0, 35.0),)), TARGET, CAMERA, 0)
    plan(FileRig(path=str(table)), TARGET, CAMERA, 0)
    assert caplog.records == []


def test_a_target_seen_from_a_camera_that_stands_still(tmp_path):
    """Labels of pose estimation: the target's pose in camera axes; half a turn about x makes OpenGL's OpenCV's."""
    names = ["target_x_m", "target_y_m", "target_z_m", *(f"world_from_target_q{axis}" for axis in "wxyz")]
    turn = Rotation.from_euler("xyz", [20, 30, 40], degrees=True)
    path = write(tmp_path / "p.csv", [[0.3, -0.2, 9.0, *wxyz(turn)]], names)
    view = plan(FileRig(path=str(path)), TARGET, CAMERA, 0)[0][0]
    np.testing.assert_allclose(view.camera.camera_from_world[:3, :3], turn.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(view.camera.camera_from_world[:3, 3], [0.3, -0.2, 9.0], atol=1e-12)
    path = write(tmp_path / "gl.csv", [[0.3, 0.2, -9.0, *wxyz(Rotation.from_euler("x", np.pi) * turn)]], names)
    again = plan(FileRig(path=str(path), body_from_camera_wxyz=(0.0, 1.0, 0.0, 0.0)), TARGET, CAMERA, 0)[0][0]
    np.testing.assert_allclose(again.camera.world_from_camera, view.camera.world_from_camera, atol=1e-12)


def test_rows_without_times_are_frames_and_some_are_held_out(tmp_path):
    names = ["camera_x_m", "camera_y_m", "camera_z_m", "exposure"]
    path = write(tmp_path / "p.csv", [[5 + k, 0, 1, 0.001 * (k + 1)] for k in range(9)], names)
    train, test = plan(FileRig(path=str(path), test_views=3), TARGET, CAMERA, 0)
    assert [view.camera.position[0] for view in test] == [6, 9, 12]
    assert [view.camera.position[0] for view in train] == [5, 7, 8, 10, 11, 13]
    assert train[1].exposure == pytest.approx(0.003)
    assert train[0].time is None
    with pytest.raises(InputError, match="views: expected a trajectory with times to sample it, found one without"):
        plan(FileRig(path=str(path), views=3), TARGET, CAMERA, 0)
    with pytest.raises(InputError, match="test_views: expected fewer than its 9 rows, found 9"):
        plan(FileRig(path=str(path), test_views=9), TARGET, CAMERA, 0)


def test_motions_add_up_on_one_clock():
    place = Track("camera position", np.array([10.0, 20.0, 30.0]), np.ones((3, 3)))
    sun = Track("sun direction", np.array([86_400 + 5.0, 86_400 + 25.0]), np.ones((2, 3)))
    whole = merge([Motion(day=101, camera=place), Motion(day=100, sun=sun)])
    assert whole.sun.times.tolist() == [5, 25]
    assert whole.times().tolist() == [10, 20]
    assert whole.epoch(20.25) == "0001-04-11T00:00:20.250000"
    with pytest.raises(InputError, match="expected one source of each track, found camera position and camera pos"):
        merge([Motion(camera=place), Motion(camera=place)])
    with pytest.raises(
        InputError, match=r"rig: expected one time system in all .* \(a table's is UTC\), found TDB and UTC"
    ):
        merge([Motion(day=101, time_system="TDB", camera=place), Motion(day=100, sun=sun)])
    with pytest.raises(InputError, match="rig: expected calendar times in all of its files"):
        merge([Motion(camera=place), Motion(day=1, sun=sun)])
    with pytest.raises(InputError, match="found that camera position ends before sun direction begins"):
        merge([Motion(camera=place), Motion(sun=sun)]).times()


def test_files_of_a_scene_that_do_not_fit_are_no_option(tmp_path, capsys):
    """The command line names `rig`, not --trajectory, which nobody gave."""
    write(tmp_path / "p.csv", [[0, 9, 0, 0]], ["time_s", "camera_x_m", "camera_y_m", "camera_z_m"])
    meta = "CENTER_NAME = EARTH\nREF_FRAME = GCRF\nTIME_SYSTEM = UTC"
    text = f"CCSDS_OEM_VERS = 2.0\nMETA_START\n{meta}\nMETA_STOP\n2030-03-01T12:00:00 7000 0 0 0 7 0\n"
    (tmp_path / "t.oem").write_text(text)
    rig = 'rig = { kind = "file", path = "p.csv", target = ["t.oem"] }'
    (tmp_path / "s.toml").write_text(f'objects = [{{ spacecraft = "boxsat" }}]\n{rig}\n')
    assert main(["generate", str(tmp_path / "s.toml"), "--out", str(tmp_path / "data")]) == 2
    assert (
        capsys.readouterr()
        .err.splitlines()[-1]
        .endswith("rig: expected calendar times in all of its files (time_utc in a table), or in none, found both")
    )
    assert not (tmp_path / "data").exists()


def test_a_dataset_along_a_table(table, tmp_path):
    """From the command line's option and from a scene file; frames say when, and how much of the Sun is seen."""
    scene = tmp_path / "my.toml"
    scene.write_text('[[objects]]\nspacecraft = "boxsat"\n[rig]\nkind = "file"\npath = "path.csv"\nviews = 3\n')
    generate(read_scene(scene, **SMALL, test_views=1), tmp_path / "a")
    generate(read_scene("boxsat", **SMALL, trajectory=table, views=3, test_views=1), tmp_path / "b")
    first, second = contents(tmp_path / "a"), contents(tmp_path / "b")
    assert [name for name in first if first[name] != second[name] and name not in ("SHA256SUMS", "scene.json")] == [
        "contact_sheet.png"  # which has the scene's name
    ]
    frames = json.loads((tmp_path / "a/transforms.json").read_text())["frames"]
    assert [frame["time"] for frame in frames] == [0.0, 22.5, 45.0, 33.75]
    assert {frame["sun_visibility"] for frame in frames} == {1.0}
    assert all(0 < frame["sunlit_fraction"] <= 1 for frame in frames)
    assert read_dataset(tmp_path / "a").train[1].time == 22.5
    assert [file["name"] for file in json.loads((tmp_path / "a/scene.json").read_text())["files"]] == ["path.csv"]
    table.write_text(table.read_text().replace("0.0,", "0.00,", 1))
    with pytest.raises(InputError, match="was made with files "):
        generate(read_scene(scene, **SMALL, test_views=1), tmp_path / "a", resume=True)


PLACES = [(9, 0, 0), (0, 9, 0), (-9, 0, 0), (0, -9, 0)]  # the Sun in +x: phase angles 0, 90, 180, 90


def circle(path, earth=None):
    names = ["camera_x_m", "camera_y_m", "camera_z_m", "sun_x", "sun_y", "sun_z"]
    names += [f"earth_{axis}_km" for axis in "xyz"] if earth else []
    return write(path, [[*place, 1, 0, 0, *(earth[k] if earth else ())] for k, place in enumerate(PLACES)], names)


@pytest.mark.parametrize(
    ("limits", "kept"),
    [({}, [0, 1, 2, 3]), ({"max_phase_deg": 91}, [0, 1, 3]), ({"min_phase_deg": 89}, [1, 2, 3])],
)
def test_frames_beyond_a_phase_angle_are_left_out(tmp_path, limits, kept, caplog):
    path = circle(tmp_path / "p.csv")
    train, _ = plan(FileRig(path=str(path), **limits), TARGET, CAMERA, 0)
    assert [PLACES.index(tuple(view.camera.position.round(6))) for view in train] == kept
    expected = ["trajectory: 1 of 4 frames are left out, by their phase angle or as the Earth hides the Sun"]
    assert [record.getMessage() for record in caplog.records] == (expected if limits else [])


def test_frames_whose_sun_the_earth_hides_are_left_out(tmp_path, caplog):
    aside, before = (0, 0, -7000), (7000, 10, 0)
    path = circle(tmp_path / "p.csv", [aside, before, aside, aside])
    train, test = plan(FileRig(path=str(path), max_phase_deg=180, test_views=1), TARGET, CAMERA, 0)
    assert len(train) + len(test) == 3
    assert not any(np.allclose(view.camera.position, PLACES[1]) for view in train + test)
    hidden = replace(TARGET, earth=EarthConfig(azimuth_deg=0, elevation_deg=0))
    with pytest.raises(InputError, match=r"max_phase_deg: expected a training frame in range .*, found none of 4"):
        plan(FileRig(path=str(circle(tmp_path / "q.csv")), max_phase_deg=120), hidden, CAMERA, 0)
    with pytest.raises(InputError, match="min_phase_deg: expected an angle from 0 to 29 degrees, found 40"):
        FileRig(path="p.csv", min_phase_deg=40, max_phase_deg=30)


def test_dark_frames_of_a_trajectory_are_counted_with_what_leaves_them_out(tmp_path, caplog):
    generate(read_scene("boxsat", **SMALL, trajectory=circle(tmp_path / "p.csv")), tmp_path / "data")
    warnings = [record.getMessage() for record in caplog.records if "in the dark" in record.getMessage()]
    assert len(warnings) == 1
    assert warnings[0].endswith("max_phase_deg = 90 in [rig] or min_sunlit = 0.05 (--min-sunlit) leaves them out")


def test_an_exposure_for_each_frame(tmp_path):
    names = ["camera_x_m", "camera_y_m", "camera_z_m", "exposure"]
    path = write(tmp_path / "p.csv", [[9, 2, 1, x] for x in (0.0023, 0.0046, 0.00115)], names)
    generate(read_scene("boxsat", **SMALL, trajectory=path), tmp_path / "data")
    data = read_dataset(tmp_path / "data")
    said = [frame["exposure"] for frame in json.loads((tmp_path / "data/transforms.json").read_text())["frames"]]
    assert said == [0.0023, 0.0046, 0.00115]
    for frame, exposure in zip(data.train, said, strict=True):
        truth = load_truth(data, frame)
        expected = record_image(truth.radiance, truth.alpha, CameraConfig((16, 16), exposure=exposure), (0,)).image
        np.testing.assert_array_equal(read_png(data.root / frame.file_path), expected)
        assert expected.max() > 20


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"path": ""}, "path: expected a file with a trajectory, or messages of camera or target, found none"),
        ({"views": -1}, "views: expected 0 to 10,000,000, found -1"),
        ({"step_s": 0.0}, "step_s: expected seconds above 0"),
        ({"step_s": 1.0, "views": 3}, "views: expected none beside step_s, found 3"),
        ({"sun": ((1.0, 2.0), (3.0, 4.0))}, "sun: expected one Sun at most, found 2"),
        ({"body_from_camera_wxyz": (1.0, 1.0, 0.0, 0.0)}, "body_from_camera_wxyz: expected a quaternion of length 1"),
    ],
)
def test_impossible_rigs_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        FileRig(**{"path": "p.csv", **options})


def test_a_sun_beside_the_tables_own_is_refused(table):
    with pytest.raises(InputError, match="sun: expected none beside the trajectory's own"):
        plan(FileRig(path=str(table), sun=((1.0, 2.0),)), TARGET, CAMERA, 0)
    scene = read_scene("boxsat", trajectory=table)
    assert len(plan_views(build(scene), scene)[0]) == 10
    with pytest.raises(InputError, match=r"suns: expected one of the options .* whose rig is of kind file"):
        read_scene("boxsat", trajectory=table, suns=3)
