"""Camera paths from views, and scenes that are saved with them."""

import numpy as np
import pytest

from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at
from spacesim.data.records import Sun
from spacesim.splat.compose import Pose
from spacesim.splat.compose.path import PosedScene
from spacesim.viewer.path import REFERENCE, Path, Player, fov_of, orbit_of, path_of, place_of, scene_to_save
from spacesim.viewer.pathcontrols import file_for
from spacesim.viewer.state import Stand, View

CENTRE = np.zeros(3)


def view_from(place, fov=0.6):
    return View(look_at(place, [0.0, 0, 0]), fov, 400, 300)


@pytest.fixture
def path(stage, stand):
    names = [placed.name for placed in stage.composition.models]
    one = Path().added(place_of(view_from([-5.0, 0, 1]), CENTRE), None, names, 2.0)
    return one.added(place_of(view_from([0.0, -5, 1], 0.9), CENTRE), stand, names, 3.0)


def test_keyframes_are_passed_exactly(stage, path):
    assert [key.time for key in path.keyframes] == [0.0, 3.0]
    for when, place, fov in ((0.0, [-5.0, 0, 1], 0.6), (3.0, [0.0, -5, 1], 0.9)):
        camera = path.at(stage.composition, when).camera
        assert np.allclose(camera.world_from_camera, look_at(place, [0.0, 0, 0]), atol=1e-9)
        assert fov_of(camera) == pytest.approx(fov)


def test_between_keyframes_the_middle_stays_in_the_middle(stage, path):
    for when in (0.5, 1.5, 2.5):
        camera = path.at(stage.composition, when).camera
        x, y, z = camera.camera_from_world[:3, 3]  # of the origin
        assert z > 0
        assert abs(x) + abs(y) < 1e-9
        assert 0.6 < fov_of(camera) < 0.9


def test_keyframes_may_hold_the_scene(stage, stand, path):
    assert path.moves_camera
    assert path.moves_scene
    names = [placed.name for placed in stage.composition.models]
    other = Stand((Pose(translation=np.array([0.0, 0, 2])), stand.poses[1]), Sun(np.array([1.0, 0, 0])))
    longer = path.added(place_of(view_from([-5.0, 0, 1]), CENTRE), other, names, 2.0)
    middle = longer.at(stage.composition, 4.0)
    assert middle.composition.models[0].pose.translation == pytest.approx([0, 0.5, 1])
    assert middle.sun.direction == pytest.approx([np.sqrt(0.5), 0, np.sqrt(0.5)])
    assert longer.shorter().keyframes == path.keyframes
    assert not Path(path.keyframes[:1]).moves_scene


def test_what_is_saved_has_the_same_path_for_another_image(stage, stand, path):
    view = view_from([-5.0, 0, 1])
    scene = scene_to_save(stage.composition, stand, view, path)
    assert scene.frames == 73  # 3 s, 24 a second
    assert (scene.camera.width, scene.camera.height) == (400, 300)
    for when in (0.0, 1.3, 3.0):
        saved, shown = scene.at(when).camera, path.at(stage.composition, when).camera
        assert np.allclose(saved.world_from_camera, shown.world_from_camera)
        assert fov_of(saved) == pytest.approx(fov_of(shown))
    back = path_of(scene)
    assert fov_of(back.at(stage.composition, 1.3).camera) == pytest.approx(fov_of(scene.at(1.3).camera))
    assert path_of(PosedScene(stage.composition)).keyframes == ()


def test_a_tilted_view_keeps_its_tilt(stage):
    pose = look_at([-5.0, 0, 0], [0.0, 0, 0], up=[0.0, 1, 1])
    place = place_of(View(pose, 0.6, 400, 300), CENTRE)
    assert place.target is None
    camera = Path().added(place, None, [], 1.0).at(stage.composition, 0.0).camera
    assert np.allclose(camera.world_from_camera, pose)
    assert camera.width == REFERENCE.width


def test_an_orbit_starts_where_the_view_is():
    view = view_from([3.0, -4.0, 2.0])
    orbit = orbit_of(view, CENTRE)
    assert np.allclose(orbit.view(0).world_from_camera, view.world_from_camera, atol=1e-9)
    assert np.allclose(orbit.view(1).world_from_camera, view.world_from_camera, atol=1e-9)
    half = orbit.view(0.5).world_from_camera[:3, 3]
    assert half == pytest.approx([-3, 4, 2])
    assert orbit_of(view_from([0.0, 0, 5]), CENTRE).elevation_deg <= 89


def test_a_player_ends_at_the_end_and_when_it_is_told():
    seen, ended = [], []
    player = Player(seen.append, 0.3, lambda: ended.append(True))
    player._thread.join(5)
    assert ended == [True]
    assert seen[-1] == 0.3
    assert seen == sorted(seen)
    long = Player(seen.append, 60.0, lambda: ended.append(True))
    long.stop()
    long._thread.join(5)
    assert ended == [True, True]


@pytest.mark.parametrize(
    "name", ["", "a", "../a.toml", "/etc/a.toml", "a\0.toml", "a/b.toml", ".toml", "x" * 200 + ".toml"]
)
def test_only_plain_names_are_saved_under(tmp_path, name):
    with pytest.raises(InputError, match="name"):
        file_for(tmp_path, name, ())


def test_files_of_others_are_left_alone(tmp_path):
    (tmp_path / "a.toml").write_text("")
    with pytest.raises(InputError, match=r"a\.toml"):
        file_for(tmp_path, "a.toml", ())
    assert file_for(tmp_path, "a.toml", (tmp_path / "a.toml",)) == tmp_path / "a.toml"
    assert file_for(tmp_path, "b-2.toml", ()) == tmp_path / "b-2.toml"
