"""Scene files: what they say, what is wrong with them, that a saved scene is the same one; keyframes and orbits."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from posed import disc_run, made_run, seen_from

from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera, Sun
from spacesim.splat.compose import (
    CameraView,
    ComposeConfig,
    GaussianComposition,
    Keyframe,
    Orbit,
    PlacedRun,
    Pose,
    PosedScene,
    load_scene,
    save_scene,
    scenefile,
)
from spacesim.splat.compose.path import KeyframeTrack, interpolate_view
from spacesim.splat.compose.pose import rotation_about
from spacesim.splat.run import Run

RUNS = {"map": lambda: made_run("map", 1), "old": lambda: made_run("vanilla", 2), "disc": lambda: disc_run(0.5)}
HEAD = '[[models]]\nrun = "runs/map"\n'
EYE = "[camera]\nposition = [4, 0, 1]\nlook_at = [0, 0, 0]\nresolution = [40, 32]\n"
SUN = "[sun]\nazimuth_deg = 40\nelevation_deg = 30\n"


@pytest.fixture(autouse=True)
def runs(monkeypatch):
    """Runs by the names of their folders, in place of what is on the disk."""
    made: dict[str, Run] = {}

    def load(path: Path) -> Run:
        name = Path(path).name
        if name not in RUNS:
            raise InputError(f"{path}: expected a run of `spacesim train`, found no config.json in it")
        if name not in made:
            run = RUNS[name]()
            made[name] = Run(Path(path), run.config, run.training, run.gaussians, run.model_bytes, run.light)
        return made[name]

    monkeypatch.setattr(scenefile, "load_run", load)


def read(tmp_path: Path, text: str) -> PosedScene:
    (tmp_path / "scene.toml").write_text(text)
    return load_scene(tmp_path / "scene.toml")


def test_a_whole_scene(tmp_path):
    scene = read(
        tmp_path,
        f'{HEAD}name = "target"\nposition = [1, 2, 3]\naxis = [0, 0, 2]\nangle_deg = 90\nscale = 0.5\n'
        '[[models]]\nrun = "runs/old"\nrotation_wxyz = [0, 0, 0, 2]\n[[models]]\nrun = "runs/old"\n'
        f"{SUN}{EYE}fov_deg = 60\n",
    )
    assert scene.names == ["target", "old", "old-2"]
    target, old, again = scene.composition.models
    assert old.run is again.run
    np.testing.assert_allclose(target.pose.rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(old.pose.rotation, np.diag([-1, -1, 1]), atol=1e-12)
    assert (target.pose.translation.tolist(), target.pose.scale) == ([1, 2, 3], 0.5)
    np.testing.assert_allclose(scene.sun.angles, (40, 30))
    assert (scene.camera.width, scene.camera.height) == (40, 32)
    assert scene.camera.fx == pytest.approx(20 / np.tan(np.radians(30)))
    np.testing.assert_allclose(scene.camera.world_from_camera, look_at([4, 0, 1], [0, 0, 0]))
    assert (scene.frames, scene.fps) == (1, 24)
    shot = scene.frame(0)
    assert shot.camera is scene.camera
    assert shot.composition.predict(shot.camera, shot.sun).rgb.shape == (32, 40, 3)


def test_cameras_of_other_kinds(tmp_path, small_dataset):
    camera = small_dataset.frames[3].camera
    scene = read(tmp_path, f'{HEAD}[camera]\ndata = "{small_dataset.root}"\nframe = 3\n')
    np.testing.assert_array_equal(scene.camera.world_from_camera, camera.world_from_camera)
    values = {"transform_matrix": camera.opengl.tolist(), "w": 20, "h": 10, "fl_x": 25.0, "cx": 9.0}
    (tmp_path / "camera.json").write_text(json.dumps(values))
    scene = read(tmp_path, f'{HEAD}[camera]\nfile = "camera.json"\n')
    assert (scene.camera.width, scene.camera.fx, scene.camera.cx) == (20, 25, 9)
    scene = read(
        tmp_path, f"{HEAD}[camera]\nresolution = 30\norbit = {{radius = 5, turns = -0.5, centre = [0, 0, 1]}}\n"
    )
    assert scene.frames == 120
    for k, azimuth in ((0, 0.0), (60, -90.0)):
        place = scene.frame(k).camera
        offset = place.position - [0, 0, 1]
        expected = 5 * Sun.from_angles(azimuth, 20).direction
        np.testing.assert_allclose(offset, expected, atol=1e-9)
        np.testing.assert_allclose(place.world_from_camera[:3, 2], -offset / 5, atol=1e-9)
    assert read(tmp_path, HEAD).camera is None


def test_keyframes(tmp_path):
    scene = read(
        tmp_path,
        f'{HEAD}[[models]]\nrun = "runs/old"\n{SUN}{EYE}\n'
        "[[keyframes]]\ntime = 0\n[keyframes.models.old]\nposition = [0, 0, 0]\n"
        "[[keyframes]]\ntime = 0.5\n[keyframes.sun]\nazimuth_deg = 0\nelevation_deg = 0\n"
        "[[keyframes]]\ntime = 1\n[keyframes.camera]\nposition = [8, 0, 1]\nlook_at = [0, 0, 1]\n"
        "[keyframes.models.old]\nposition = [2, 0, 0]\naxis = [0, 0, 1]\nangle_deg = 90\nscale = 4\n"
        "[[keyframes]]\ntime = 1.5\n[keyframes.sun]\nazimuth_deg = 90\nelevation_deg = 0\n",
    )
    assert scene.frames == 37  # 1.5 s at 24 a second, both ends
    half = scene.frame(12)
    old = half.composition.models[1].pose
    np.testing.assert_allclose(old.translation, [1, 0, 0])
    np.testing.assert_allclose(old.rotation, rotation_about([0, 0, 1], 45), atol=1e-12)
    assert old.scale == pytest.approx(2)
    np.testing.assert_allclose(half.sun.angles, (0, 0), atol=1e-9)
    np.testing.assert_allclose(scene.frame(24).sun.angles, (45, 0), atol=1e-9)
    np.testing.assert_allclose(half.camera.position, [8, 0, 1])  # the only keyframe with a camera
    assert half.composition.models[0].pose.translation.tolist() == [0, 0, 0]
    assert scene.posed_at(1.0).models[1].pose.scale == pytest.approx(4)
    late = scene.at(100.0)
    np.testing.assert_allclose(late.composition.models[1].pose.translation, [2, 0, 0])


def test_keyframes_zoom_as_the_camera_is_resized():
    """A field of view is one of the picture, however many pixels it has; between none and one it changes evenly."""
    camera = Camera.from_fov(look_at([5, 0, 0], [0, 0, 0]), 64, 48, 40)
    near = CameraView(camera.world_from_camera, None, (4 * camera.fx, 4 * camera.fy))
    keys = [Keyframe(0.0, view=CameraView(camera.world_from_camera)), Keyframe(1.0, view=near)]
    scene = PosedScene(GaussianComposition([PlacedRun(made_run("vanilla", 0), name="one")]), None, camera, keys)
    small = scene.seen_by(Camera.from_fov(camera.world_from_camera, 16, 12, 40))
    for time, zoom in ((0.0, 1), (0.5, 2), (1.0, 4)):
        assert scene.at(time).camera.fx == pytest.approx(zoom * camera.fx)
        assert small.at(time).camera.fx == pytest.approx(zoom * camera.fx / 4)


def test_a_camera_between_two_keeps_its_target_in_the_middle():
    one = CameraView(look_at([4, 0, 0], [0, 0, 0]), np.zeros(3), (100, 100))
    other = CameraView(look_at([0, 4, 2], [0, 0, 1]), np.array([0, 0, 1.0]), (400, 400))
    middle = interpolate_view(one, other, 0.5)
    np.testing.assert_allclose(middle.world_from_camera, look_at([2, 2, 1], [0, 0, 0.5]))
    assert middle.focal == pytest.approx((200, 200))
    free = interpolate_view(CameraView(one.world_from_camera), other, 0.5)
    np.testing.assert_allclose(free.world_from_camera[:3, 3], [2, 2, 1])
    assert np.linalg.det(free.world_from_camera[:3, :3]) == pytest.approx(1)
    for share, end in ((0.0, one), (1.0, other)):
        np.testing.assert_allclose(
            interpolate_view(one, other, share).world_from_camera, end.world_from_camera, atol=1e-12
        )


def test_a_camera_between_two_keeps_its_target_where_other_things_are_up():
    one = CameraView.towards(np.array([4.0, 0, 0]), np.zeros(3), [0.0, 0, 2])
    other = CameraView.towards(np.array([0.0, 4, 2]), np.array([0.0, 0, 1]), [1.0, 0, 0])
    for share in (0.25, 0.5, 0.75):
        middle = interpolate_view(one, other, share)
        angle = 0.5 * np.pi * share  # from z to x, evenly
        expected = look_at([4 - 4 * share, 4 * share, 2 * share], [0, 0, share], [np.sin(angle), 0, np.cos(angle)])
        np.testing.assert_allclose(middle.world_from_camera, expected, atol=1e-12)
    for share, end in ((0.0, one), (1.0, other)):
        np.testing.assert_allclose(
            interpolate_view(one, other, share).world_from_camera, end.world_from_camera, atol=1e-12
        )


def test_the_up_direction_is_read_and_saved(tmp_path):
    keys = (
        "[[keyframes]]\ntime = 0\ncamera = {position = [4, 0, 0], look_at = [0, 0, 0]}\n"
        "[[keyframes]]\ntime = 1\ncamera = {position = [0, 4, 2], look_at = [0, 0, 1], up = [2, 0, 0]}\n"
    )
    scene = read(tmp_path, f"{HEAD}{SUN}{EYE}{keys}")
    half = scene.frame(12).camera
    np.testing.assert_allclose(half.world_from_camera, look_at([2, 2, 1], [0, 0, 0.5], [1, 0, 1]), atol=1e-12)
    save_scene(tmp_path / "saved.toml", scene)
    loaded = load_scene(tmp_path / "saved.toml")
    for k in (0, 5, 12, 24):
        assert np.array_equal(loaded.frame(k).camera.world_from_camera, scene.frame(k).camera.world_from_camera)


def test_a_track_is_exact_at_its_keys():
    track = KeyframeTrack([0.0, 0.1, 0.3], [1.0, 2.0, 7.0], lambda a, b, share: a + share * (b - a))
    assert [track.at(t) for t in (-1, 0, 0.1, 0.3, 9)] == [1, 1, 2, 7, 7]
    assert track.at(0.2) == pytest.approx(4.5)


def whole_scene(tmp_path: Path) -> PosedScene:
    run = tmp_path / "runs"
    models = [
        PlacedRun(
            scenefile.load_run(run / "map"), Pose(rotation_about([1, 2, 3], 50), [0.1, 0.2, 0.3], 1.1), "first one"
        ),
        PlacedRun(scenefile.load_run(run / "disc"), Pose([0.1, 0.7, -0.3, 0.2], [0.0, 0.4, 1.3], 0.7), "b.c"),
    ]
    camera = Camera(seen_from([3, 1, 0.5]).world_from_camera, 33, 21, 40.25, 41.5, 16.1, 10.7)
    keys = [
        Keyframe(0.0, Sun.from_angles(40, 30), CameraView(camera.world_from_camera), {"b.c": models[1].pose}),
        Keyframe(
            1 / 3, Sun(np.array([0.3, 0.2, 0.4])), CameraView(look_at([0, 3, 0.2], [0, 0, 0]), np.zeros(3), (50.5, 51))
        ),
    ]
    composition = GaussianComposition(models, ComposeConfig("ratio"))
    return PosedScene(composition, Sun.from_angles(41.5, -12.25), camera, keys, None, 5, 12.5)


def test_a_scene_is_seen_as_arrays(tmp_path):
    scene = whole_scene(tmp_path)
    view, there = scene.render(time=0.2), scene.at(0.2)
    drawn = there.composition.predict(there.camera, there.sun, normals=True)
    for name in ("rgb", "alpha", "depth", "visibility", "normal"):
        np.testing.assert_array_equal(getattr(view, name), getattr(drawn, name))
    other = scene.render(there.camera, sun=(10, 80), time=0.2)
    assert not np.array_equal(other.rgb, view.rgb)
    np.testing.assert_array_equal(other.alpha, view.alpha)
    dark = PosedScene(scene.composition, None, scene.camera)
    with pytest.raises(InputError, match=r"sun: expected its direction for .*, found none"):
        dark.render()
    with pytest.raises(InputError, match="expected a camera, found none"):
        PosedScene(scene.composition).render()


def test_arrays_show_no_more_than_all_of_the_sun(monkeypatch):
    run, camera = made_run("map"), seen_from([4, 0, 1])
    drawn = run.predict(camera, Sun(np.array([0.3, 0.2, 0.9])))
    rounded = replace(drawn, visibility=drawn.visibility + 0.01)
    monkeypatch.setattr(Run, "predict", lambda *_, **__: rounded)
    assert rounded.visibility.max() > 1
    assert run.render(camera, sun=[0.3, 0.2, 0.9]).visibility.max() == 1


def test_a_saved_scene_gives_the_same_pictures_to_the_bit(tmp_path):
    scene = whole_scene(tmp_path)
    save_scene(tmp_path / "saved.toml", scene)
    loaded = load_scene(tmp_path / "saved.toml")
    assert loaded.names == scene.names
    assert 'run = "runs/map"' in (tmp_path / "saved.toml").read_text()
    assert (loaded.frames, loaded.fps, loaded.composition.config) == (5, 12.5, ComposeConfig("ratio"))
    for index in range(5):
        one, other = scene.frame(index), loaded.frame(index)
        a, b = (shot.composition.predict(shot.camera, shot.sun) for shot in (one, other))
        for name in ("rgb", "depth", "visibility", "id"):
            assert np.array_equal(getattr(a, name), getattr(b, name)), (index, name)


def test_a_saved_orbit_and_a_scene_without_camera_and_sun(tmp_path):
    scene = whole_scene(tmp_path)
    orbit = PosedScene(scene.composition, scene.sun, scene.camera, (), Orbit(4.5, (0, 0, 1), 10, 20, 2), 7)
    save_scene(tmp_path / "orbit.toml", orbit)
    loaded = load_scene(tmp_path / "orbit.toml")
    assert loaded.orbit == orbit.orbit
    for still in (replace(orbit, frames=1), replace(whole_scene(tmp_path), frames=1)):
        save_scene(tmp_path / "still.toml", still)
        assert load_scene(tmp_path / "still.toml").frames == 1
    for index in (0, 3):
        pair = orbit.frame(index).camera, loaded.frame(index).camera
        assert np.array_equal(*(camera.world_from_camera for camera in pair))
        assert pair[0].cx == pair[1].cx
    save_scene(tmp_path / "bare.toml", PosedScene(scene.composition))
    bare = load_scene(tmp_path / "bare.toml")
    assert (bare.camera, bare.sun) == (None, None)
    with pytest.raises(InputError, match=r"bare.toml: expected a camera"):
        bare.frame(0)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "models"),
        ("models = []", "models"),
        (
            "seed = 1\n[[objects]]\nspacecraft = 'boxsat'",
            "line 2: objects: expected [[models]], found [[objects]], which generate takes",
        ),
        ('[[models]]\nname = "a"', "line 1: models[0].run: expected the folder of a run, found none"),
        (f'{HEAD}[[models]]\nrun = "runs/none"', "line 4: models[1].run: "),
        (f'{HEAD}name = "a"\n[[models]]\nrun = "runs/old"\nname = "a"', "line 6: models[1].name"),
        (f"{HEAD}scale = 0", "line 3: models[0].scale"),
        (f"{HEAD}rotation_wxyz = [0, 0, 0, 0]", "line 3: models[0].rotation_wxyz"),
        (f"{HEAD}axis = [0, 0, 1]", "models[0].axis: expected with angle_deg"),
        (f"{HEAD}angle_deg = 5", "models[0].angle_deg: expected with axis"),
        (f"{HEAD}axis = [0, 0, 0]\nangle_deg = 1", "line 3: models[0].axis"),
        (f"{HEAD}positon = [0, 0, 1]", "did you mean models[0].position?"),
        (f"{HEAD}position = [0, 1]", "line 3: models[0].position"),
        (f"{HEAD}position = [0, 1, 1e12]", "line 3: models[0].position"),
        (f"{HEAD}[sun]\nazimuth_deg = 3", "sun.elevation_deg"),
        (f"{HEAD}[sun]\nazimuth_deg = 3\nelevation_deg = 100", "line 5: sun.elevation_deg"),
        (f"{HEAD}[sun]\ndirection = [0, 0, 0]", "line 4: sun.direction"),
        (f"{HEAD}[sun]\ndirection = [0, 0, 1]\nazimuth_deg = 1", "sun.azimuth_deg"),
        (f"shadows = 'some'\n{HEAD}", "line 1: shadows"),
        (f"frames = 0\n{HEAD}", "line 1: frames"),
        (f"fps = 0\n{HEAD}", "line 1: fps"),
        (f"fps = 1e-7\n{HEAD}", "line 1: fps: expected 0.001 to 1000"),
        (f"{HEAD}[camera]\nposition = [0, 0, 1]", "camera.position: expected with look_at"),
        (f"{HEAD}[camera]\nposition = [0, 0, 1]\nlook_at = [0, 0, 1]", "camera.look_at"),
        (f"{HEAD}{EYE}fov_deg = 180", "camera.fov_deg"),
        (f"{HEAD}{EYE}focal = [0, 1]", "camera.focal"),
        (f"{HEAD}{EYE}file = 'a.json'", "camera.file"),
        (f"{HEAD}[camera]\nfile = 'a.json'", "line 4: camera.file: "),
        (f"{HEAD}[camera]\nfile = 'a.json'\nfov_deg = 3", "camera.fov_deg"),
        (f"{HEAD}[camera]\ndata = 'nowhere'", "line 4: camera.data: "),
        (f"{HEAD}[camera]\norbit = {{radius = 0}}", "camera.orbit.radius"),
        (f"{HEAD}[camera]\norbit = {{elevation_deg = 3}}", "camera.orbit.radius"),
        (f"{HEAD}[camera]\nresolution = 0", "camera.resolution"),
        (f"{HEAD}[camera]\nresolution = 100_000", "line 4: camera.resolution: expected at most"),
        (f"{HEAD}[camera]\ntransform_matrix = [[1,0,0,0],[0,1,0,0],[0,0,2,0],[0,0,0,1]]", "camera.transform_matrix"),
        (f"{HEAD}{EYE}[[keyframes]]\ntime = 1\n[[keyframes]]\ntime = 1", "line 10: keyframes[1].time"),
        (f"{HEAD}{EYE}[[keyframes]]\ntime = 1e300", "line 8: keyframes[0].time: expected a time within 100,000"),
        (f"{HEAD}{EYE}[[keyframes]]\nmodels.map.scale = 2", "keyframes[0].time"),
        (f"{HEAD}{EYE}[[keyframes]]\ntime = 1\nmodels.mapp.scale = 2", "line 9: keyframes[0].models.mapp"),
        (f"{HEAD}{EYE}[[keyframes]]\ntime = 1\ncamera = {{fov_deg = 3}}", "line 9: keyframes[0].camera"),
        (f"{HEAD}[[keyframes]]\ntime = 1\ncamera = {{position = [1,0,0], look_at = [0,0,0]}}", "keyframes[0].camera"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_with_its_line(tmp_path, text, named):
    with pytest.raises(InputError) as caught:
        read(tmp_path, text)
    assert "scene.toml" in str(caught.value)
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)
