"""Camera paths from views, and scenes that are saved with them."""

from dataclasses import replace
from pathlib import Path as FilePath
from types import SimpleNamespace

import numpy as np
import pytest
from browser import PATIENCE

from spacesim.data.earth import Earth
from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera, Sun
from spacesim.splat.compose import Keyframe, Orbit, Pose, scenefile
from spacesim.splat.compose.posed_scene import PosedScene
from spacesim.viewer.load import load_setup
from spacesim.viewer.panels.paths import PathControls, file_for
from spacesim.viewer.path import (
    REFERENCE,
    CameraPath,
    Player,
    keyframe_view,
    orbit_from_view,
    path_from_scene,
    scene_to_save,
    vertical_fov,
)
from spacesim.viewer.state import SceneState, SharedScene, ViewerCamera

CENTRE = np.zeros(3)


def view_from(place, fov=0.6):
    return ViewerCamera(look_at(place, [0.0, 0, 0]), fov, 400, 300)


@pytest.fixture
def path(renderer, state):
    names = [placed.name for placed in renderer.composition.models]
    one = CameraPath().with_keyframe(keyframe_view(view_from([-5.0, 0, 1]), CENTRE), None, names, 2.0)
    return one.with_keyframe(keyframe_view(view_from([0.0, -5, 1], 0.9), CENTRE), state, names, 3.0)


def test_keyframes_are_passed_exactly(renderer, path):
    assert [key.time for key in path.keyframes] == [0.0, 3.0]
    for when, place, fov in ((0.0, [-5.0, 0, 1], 0.6), (3.0, [0.0, -5, 1], 0.9)):
        camera = path.at(renderer.composition, when).camera
        assert np.allclose(camera.world_from_camera, look_at(place, [0.0, 0, 0]), atol=1e-9)
        assert vertical_fov(camera) == pytest.approx(fov)


def test_between_keyframes_the_middle_stays_in_the_middle(renderer, path):
    for when in (0.5, 1.5, 2.5):
        camera = path.at(renderer.composition, when).camera
        x, y, z = camera.camera_from_world[:3, 3]  # of the origin
        assert z > 0
        assert abs(x) + abs(y) < 1e-9
        assert 0.6 < vertical_fov(camera) < 0.9


def test_keyframes_may_hold_the_scene(renderer, state, path):
    assert path.moves_camera
    assert path.moves_scene
    names = [placed.name for placed in renderer.composition.models]
    other = SceneState((Pose(translation=np.array([0.0, 0, 2])), state.poses[1]), Sun(np.array([1.0, 0, 0])))
    longer = path.with_keyframe(keyframe_view(view_from([-5.0, 0, 1]), CENTRE), other, names, 2.0)
    middle = longer.at(renderer.composition, 4.0)
    assert middle.composition.models[0].pose.translation == pytest.approx([0, 0.5, 1])
    assert middle.sun.direction == pytest.approx([np.sqrt(0.5), 0, np.sqrt(0.5)])
    assert longer.without_last().keyframes == path.keyframes
    lit = replace(other, sun=replace(other.sun, earth=Earth([0.0, 1, 0], 60.0)))
    longer = longer.with_keyframe(keyframe_view(view_from([-5.0, 0, 1]), CENTRE), lit, names, 1.0)
    assert longer.at(renderer.composition, 6.0).sun.earth == lit.sun.earth
    only = CameraPath((Keyframe(0.0, earth=lit.sun.earth),))
    assert only.moves_scene
    shown = only.at(renderer.composition, 0.0, state.sun).sun
    assert (shown.direction.tolist(), shown.earth) == (state.sun.direction.tolist(), lit.sun.earth)
    assert not CameraPath(path.keyframes[:1]).moves_scene


def test_a_path_that_is_played_moves_the_earth_where_there_is_one(renderer, state):
    """Not where its box is off."""
    moved, shown = Earth([0.0, 1, 0], 60.0), list[SceneState]()
    path = CameraPath((Keyframe(0.0, earth=moved),))
    for earth in (Earth([0, 0, -1.0]), None):
        shared = SharedScene(replace(state, sun=replace(state.sun, earth=earth)))
        controls = SimpleNamespace(_renderer=renderer, _shared=shared, _put=shown.append)
        PathControls._show(controls, path, None, 0.0)
    assert [one.sun.earth for one in shown] == [moved, None]
    assert [one.sun.direction.tolist() for one in shown] == [state.sun.direction.tolist()] * 2


def same_path(one, other, atol=1e-12):
    """Both scenes: as many pictures, at the same times, of the same cameras, Suns and poses."""
    assert (one.frames, one.fps) == (other.frames, other.fps)
    for k in range(one.frames):
        a, b = one.frame(k), other.frame(k)
        assert a.time == b.time
        assert np.allclose(a.camera.world_from_camera, b.camera.world_from_camera, rtol=0, atol=atol)
        assert vertical_fov(a.camera) == pytest.approx(vertical_fov(b.camera), rel=1e-12)
        assert a.sun.direction == pytest.approx(b.sun.direction, abs=atol)
        for p, q in zip(a.composition.models, b.composition.models, strict=True):
            assert np.allclose(p.pose.matrix, q.pose.matrix, rtol=0, atol=atol)


def test_what_is_saved_has_the_same_path_for_another_image(renderer, state, path):
    view = view_from([-5.0, 0, 1])
    scene = scene_to_save(renderer.composition, state, view, path)
    assert scene.frames == 73  # 3 s, 24 a second
    assert (scene.camera.width, scene.camera.height) == (400, 300)
    for when in (0.0, 1.3, 3.0):
        saved, shown = scene.at(when).camera, path.at(renderer.composition, when).camera
        assert np.allclose(saved.world_from_camera, shown.world_from_camera)
        assert vertical_fov(saved) == pytest.approx(vertical_fov(shown))
    back = path_from_scene(scene)
    assert vertical_fov(back.at(renderer.composition, 1.3).camera) == pytest.approx(vertical_fov(scene.at(1.3).camera))
    assert path_from_scene(PosedScene(renderer.composition)).keyframes == ()
    again = scene_to_save(renderer.composition, state, view_from([9.0, 9, 9], 1.2), back)
    same_path(again, scene)  # from wherever it is saved
    assert (again.camera.width, again.camera.height) == (400, 300)


def loaded(tmp_path, monkeypatch, renderer, scene):
    """The scene, written and read."""
    runs = {placed.run.path.name: placed.run for placed in renderer.composition.models}
    monkeypatch.setattr(scenefile, "load_run", lambda folder: runs[FilePath(folder).name])
    scenefile.save_scene(tmp_path / "scene.toml", scene)
    return scenefile.load_scene(tmp_path / "scene.toml")


def test_a_file_has_the_path_that_was_played(tmp_path, monkeypatch, renderer, state, path):
    """Views of the viewer, upright and tilted, come back from the file as they went between keyframes."""
    tilted = ViewerCamera(look_at([-3.0, 2, 0.5], [0.0, 0, 0], up=[0.3, 0.2, 1]), 0.7, 400, 300)
    longer = path.with_keyframe(keyframe_view(tilted, CENTRE), None, [], 1.0)
    scene = scene_to_save(renderer.composition, state, view_from([-5.0, 0, 1]), longer)
    same_path(loaded(tmp_path, monkeypatch, renderer, scene), scene, atol=0)


def test_an_orbit_of_a_file_is_played_and_saved_again(tmp_path, monkeypatch, renderer, state):
    camera = Camera.from_fov(look_at([0.0, -6, 0], [0.0, 0, 0]), 96, 64, 30.0)
    keys = (Keyframe(0.5, Sun(np.array([1.0, 0, 0]))), Keyframe(1.0, Sun(np.array([0.0, 1, 0]))))
    orbit = Orbit(6.0, (0.0, 0.0, 0.2), 15.0, 30.0, -1.0)
    scene = PosedScene(renderer.composition, state.sun, camera, keys, orbit, 36, 18.0)
    path = path_from_scene(scene)
    assert path.seconds == 2.0
    assert path.description == "an orbit and 2 keyframes, 2 s"
    for when, azimuth in ((0.0, 30.0), (0.5, -60.0), (1.5, -240.0), (2.0, -330.0)):
        shot = path.at(renderer.composition, when)
        away = shot.camera.world_from_camera[:3, 3] - [0, 0, 0.2]
        assert away == pytest.approx(6 * Sun.from_angles(azimuth, 15).direction)
        assert vertical_fov(shot.camera) == pytest.approx(vertical_fov(camera))
    saved = scene_to_save(renderer.composition, state, view_from([1.0, 2, 3], 1.1), path)
    back = loaded(tmp_path, monkeypatch, renderer, saved)
    same_path(back, scene, atol=0)
    assert (back.camera.width, back.camera.height, back.orbit) == (96, 64, orbit)
    assert path.without_last().without_last().orbit == orbit
    assert path.without_last().without_last().without_last().description == "0 keyframes, 0 s"
    other = path.with_keyframe(keyframe_view(view_from([-5.0, 0, 1]), CENTRE, path.image), None, [], 1.0)
    assert (other.orbit, other.seconds, other.fps, other.picture_count) == (None, 2.0, 18.0, 37)
    assert vertical_fov(other.at(renderer.composition, 2.0).camera) == pytest.approx(0.6)


def test_keyframes_of_a_scene_without_a_camera_are_played(tmp_path, monkeypatch, renderer, state):
    """Poses and the Sun move, the browser's camera stays; saved, it is that of the view."""
    away = Pose(translation=np.array([0.0, 3, 0]))
    keys = (
        Keyframe(0.0, Sun(np.array([1.0, 0, 0])), poses={"red": state.poses[0]}),
        Keyframe(2.0, poses={"red": away}),
    )
    scene = PosedScene(renderer.composition, None, None, keys, None, 49)
    path = path_from_scene(scene)
    assert (path.moves_camera, path.moves_scene, path.seconds) == (False, True, 2.0)
    middle = path.at(renderer.composition, 1.0)
    assert middle.composition.models[0].pose.translation == pytest.approx([0, 2, 0])
    assert middle.sun.direction == pytest.approx([1, 0, 0])
    saved = scene_to_save(renderer.composition, state, view_from([-5.0, 0, 1]), path)
    back = loaded(tmp_path, monkeypatch, renderer, saved)
    assert np.allclose(back.camera.world_from_camera, look_at([-5.0, 0, 1], [0.0, 0, 0]))
    same_path(back, replace(scene, camera=back.camera), atol=0)


def test_a_tilted_view_keeps_its_tilt_and_its_target(renderer):
    pose = look_at([-5.0, 0, 0], [0.0, 0, 0], up=[0.0, 1, 1])
    place = keyframe_view(ViewerCamera(pose, 0.6, 400, 300), CENTRE)
    assert np.allclose(place.target, 0)
    path = CameraPath().with_keyframe(place, None, [], 1.0)
    camera = path.at(renderer.composition, 0.0).camera
    assert np.allclose(camera.world_from_camera, pose)
    assert camera.width == REFERENCE.width
    upright = path.with_keyframe(keyframe_view(view_from([0.0, -5, 1]), CENTRE), None, [], 1.0)
    middle = upright.at(renderer.composition, 0.5).camera.camera_from_world[:3, 3]  # of the origin
    assert middle[:2] == pytest.approx([0, 0], abs=1e-9)
    turned = ViewerCamera(np.diag([1.0, -1, -1, 1]) @ view_from([-5.0, 0, 1]).world_from_camera, 0.6, 400, 300)
    kept = keyframe_view(turned, CENTRE)  # upside down: z is not up
    assert np.allclose(kept.world_from_camera, turned.world_from_camera)
    behind = keyframe_view(ViewerCamera(look_at([-5.0, 0, 0], [-9.0, 0, 0]), 0.6, 400, 300), CENTRE)
    assert behind.target is None


def test_an_orbit_starts_where_the_view_is():
    view = view_from([3.0, -4.0, 2.0])
    orbit = orbit_from_view(view, CENTRE)
    assert np.allclose(orbit.view(0).world_from_camera, view.world_from_camera, atol=1e-9)
    assert np.allclose(orbit.view(1).world_from_camera, view.world_from_camera, atol=1e-9)
    half = orbit.view(0.5).world_from_camera[:3, 3]
    assert half == pytest.approx([-3, 4, 2])
    assert orbit_from_view(view_from([0.0, 0, 5]), CENTRE).elevation_deg <= 89


def test_a_player_stops_at_the_end_and_on_request():
    seen, ended = [], []
    player = Player(seen.append, 0.3, lambda: ended.append(True))
    player._thread.join(PATIENCE)
    assert ended == [True]
    assert seen[-1] == 0.3
    assert seen == sorted(seen)
    long = Player(seen.append, 60.0, lambda: ended.append(True))
    long.stop()
    long._thread.join(PATIENCE)
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


def test_a_scene_that_is_opened_stands_as_at_its_start(tmp_path, tiny_run):
    pytest.importorskip("viser", reason="viser is not installed")
    text = f'''fps = 12.5
    [[models]]
    run = "{tiny_run}"
    name = "a"
    [[keyframes]]
    time = 0
    sun = {{azimuth_deg = 10, elevation_deg = 20}}
    models.a = {{position = [1, 0, 0]}}
    [[keyframes]]
    time = 2
    models.a = {{position = [3, 0, 0]}}
    '''
    (tmp_path / "bare.toml").write_text(text)
    show = load_setup(tmp_path / "bare.toml")
    assert show.camera is None
    assert show.state.poses[0].translation.tolist() == [1, 0, 0]
    assert show.state.sun.angles == pytest.approx((10, 20))
    assert (show.path.description, show.path.fps, show.path.picture_count) == ("2 keyframes, 2 s", 12.5, 26)
    orbit = "[camera]\nresolution = 32\norbit = {radius = 4, elevation_deg = 0, azimuth_deg = 90}\n"
    (tmp_path / "orbit.toml").write_text(text + orbit)
    show = load_setup(tmp_path / "orbit.toml")
    assert show.camera.position == pytest.approx([0, 4, 0])
    assert show.path.description == "an orbit and 2 keyframes, 2.08 s"
