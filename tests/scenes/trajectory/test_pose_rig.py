"""Rigs from Python: arrays of poses and Suns, and classes of one's own."""

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
from tiny import contents

import spacesim as ss
from spacesim.data.errors import InputError
from spacesim.data.exporters.objects import opaque_picture
from spacesim.data.geometry import fibonacci_sphere, look_at
from spacesim.data.images.tone import as_bytes, display_values
from spacesim.scenes.cameras.rig import PlannedView, Rig
from spacesim.scenes.scenefile import scene_text
from spacesim.viewer.truth.scene import load_recorded_scene

POSES = np.stack([look_at(8 * d, [0, 0, 0]) for d in fibonacci_sphere(4)])
SMALL = {"resolution": (16, 16), "spp": 1}


def test_poses_and_suns_of_ones_own(tmp_path):
    rig = ss.PoseRig(POSES[:3], sun=[(10, 20), (30, 40), (50, -60)], test=POSES[3:], test_sun=(0, 0, 1), time=[0, 1, 4])
    data = ss.generate("boxsat", tmp_path / "data", rig=rig, **SMALL)
    np.testing.assert_allclose([frame.camera.world_from_camera for frame in data.frames], POSES, atol=1e-12)
    assert [frame.sun.angles for frame in data.train] == [
        pytest.approx(angles) for angles in ((10, 20), (30, 40), (50, 300 - 360))
    ]
    assert data.test[0].sun.direction.tolist() == [0, 0, 1]
    assert [frame.time for frame in data.train] == [0, 1, 4]
    recorded = json.loads((tmp_path / "data/scene.json").read_text())["config"]["rig"]
    assert (recorded["kind"], recorded["views"], recorded["test_views"]) == ("PoseRig", 3, 1)
    assert load_recorded_scene(tmp_path / "data").objects[0].spacecraft == "boxsat"  # as the viewer reads it
    again = ss.generate("boxsat", tmp_path / "data", rig=rig, resume=True, **SMALL)
    assert len(again.frames) == 4
    other = ss.PoseRig(POSES[:3] + 0, sun=(10, 20), test=POSES[3:])
    with pytest.raises(InputError, match=r"was made with rig\.sha256 .*, expected the same to resume it"):
        ss.generate("boxsat", tmp_path / "data", rig=other, resume=True, **SMALL)
    with pytest.raises(InputError, match="rig: expected one that a scene file can say, found PoseRig"):
        scene_text(ss.read_scene("boxsat", rig=rig))


def test_suns_are_taken_in_every_form(tmp_path):
    """Angles, a direction, a record, or several of them, in a rig and beside a scene."""
    of_record, direction = ss.Sun.from_angles(40, 25), [0.0, 0.6, 0.8]
    for sun, angles in (((40, 25), (40, 25)), (of_record, (40, 25)), (direction, (90, np.degrees(np.arcsin(0.8))))):
        for one in (sun, [sun] * len(POSES)):
            rig = ss.PoseRig(POSES, sun=one, test=POSES[:1], test_sun=[sun])
            views, tests = rig.views_of(None, ss.read_scene("boxsat").camera, 0)
            assert [view.sun.angles for view in (*views, *tests)] == [pytest.approx(angles)] * 5
        several = ss.read_scene("boxsat", sun=[sun, (10, 20)]).rig
        assert ss.read_scene("boxsat", sun=sun).rig.sun == (pytest.approx(angles),)
        assert several.sun == (pytest.approx(angles), (10, 20))
        assert several.suns == 2
    assert ss.read_scene("boxsat", sun=np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])).rig.sun == (
        (1, 2),
        (3, 4),
        (5, 6),
    )
    with pytest.raises(InputError, match="suns: expected at least 1, found 0"):
        ss.read_scene("boxsat", sun=[])
    with pytest.raises(InputError, match="sun: expected a list"):
        ss.read_scene("boxsat", sun="noon")
    with pytest.raises(InputError, match="sun direction: expected 3 finite numbers"):
        ss.read_scene("boxsat", sun=(0, 0, 0))


def test_poses_without_a_sun_say_where_it_stands(caplog):
    camera = ss.read_scene("boxsat").camera
    views, tests = ss.PoseRig(POSES, test=POSES[:1]).views_of(None, camera, 0)
    assert [view.sun.angles for view in (*views, *tests)] == [pytest.approx((45, 35))] * 5
    expected = "rig: no sun is given; it stands at azimuth 45, elevation 35 degrees in the world frame"
    assert [record.getMessage() for record in caplog.records] == [expected]
    given = ss.PoseRig(POSES, sun=(45, 35), test=POSES[:1])
    assert given.to_json() == ss.PoseRig(POSES, test=POSES[:1]).to_json()
    caplog.clear()
    given.views_of(None, camera, 0)
    assert caplog.records == []


@dataclass(frozen=True)
class Corkscrew(Rig):
    turns: float = 2.0

    def views_of(self, target, camera, seed):
        angles = np.linspace(0, 2 * np.pi * self.turns, 5)
        places = [(9 * np.cos(a), 9 * np.sin(a), a) for a in angles]
        views = [PlannedView(camera.at(look_at(p, target.centre)), ss.Sun.from_angles(40, 25)) for p in places]
        return views[:-1], views[-1:]


def test_a_class_of_ones_own(tmp_path):
    data = ss.generate("boxsat", tmp_path / "a", rig=Corkscrew(), turns=1.0, **SMALL)
    assert (len(data.train), len(data.test)) == (4, 1)
    recorded = json.loads((tmp_path / "a/scene.json").read_text())["config"]["rig"]
    assert recorded == {"kind": "Corkscrew", "turns": 1.0}
    ss.generate(ss.read_scene("boxsat", rig=Corkscrew(1.0), **SMALL), tmp_path / "b")
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


@dataclass(frozen=True)
class WithArray(Corkscrew):
    extra: object = None


def test_a_class_whose_fields_json_does_not_have(tmp_path):
    with pytest.raises(InputError, match="rig: expected fields that JSON has, or a to_json of its own"):
        ss.generate("boxsat", tmp_path / "data", rig=WithArray(extra=np.eye(2)), **SMALL)


NO_POSE = POSES.copy()
NO_POSE[2, 0, 3] = np.nan


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"world_from_camera": np.eye(3)},
            r"world_from_camera: expected an array \[N, 4, 4\], found one of shape",
        ),
        ({"world_from_camera": []}, "world_from_camera: expected at least one pose, found none"),
        ({"world_from_camera": "x"}, "world_from_camera: expected an array of numbers, found 'x'"),
        (
            {"world_from_camera": NO_POSE},
            r"world_from_camera\[2\]: expected a .* of finite numbers, found NaN or infinity",
        ),
        ({"test": NO_POSE[2]}, r"test\[0\]: expected a \[4, 4\] matrix of finite numbers, found NaN or infinity"),
        ({"sun": [(1, 2), (3, 4)]}, r"sun: expected one Sun, or 4, one for each pose, found \[2, 2\]"),
        ({"sun": (1, 95)}, "sun: expected .azimuth, elevation up to 90"),
        ({"sun": (0, 0, 0)}, "sun direction: expected 3 finite numbers"),
        ({"sun": [(1, 2)] * 4, "test": POSES}, "test_sun: expected Suns of the test poses"),
        ({"time": [0, 1]}, r"time: expected 4 finite numbers, one for each pose, found \[2\]"),
        ({"time": [0, 1, 2, float("nan")]}, "time: expected 4 finite numbers"),
        ({"exposure": [1, 1, 1, 0]}, "exposure: expected numbers from 1e-12 to 1e.12, found 0"),
    ],
)
def test_impossible_arrays_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        ss.PoseRig(**{"world_from_camera": POSES, **options})


def test_exports_develop_each_picture_as_it_was_exposed(tmp_path):
    rig = ss.PoseRig(POSES, sun=(10, 20), exposure=[0.001, 0.004, 0.001, 0.004])
    data = ss.generate("boxsat", tmp_path / "data", rig=rig, **SMALL)
    assert [frame.exposure for frame in data.train] == [0.001, 0.004, 0.001, 0.004]
    for frame in data.train:
        radiance = ss.load_truth(data, frame).radiance
        expected = as_bytes(display_values(frame.exposure * radiance, "srgb"))
        np.testing.assert_array_equal(opaque_picture(data, frame), expected)


def test_what_is_no_rig(tmp_path):
    with pytest.raises(InputError, match="rig: expected a Rig, such as PoseRig, found "):
        ss.generate("boxsat", tmp_path / "data", rig=POSES, **SMALL)
    with pytest.raises(InputError, match="trajectory: expected none beside a rig"):
        ss.generate("boxsat", tmp_path / "data", rig=Corkscrew(), trajectory="a.csv", **SMALL)
    skewed = POSES.copy()
    skewed[1, 0, 0] = 3
    with pytest.raises(InputError, match=r"world_from_camera\[1\]: expected a rotation"):
        ss.generate("boxsat", tmp_path / "data", rig=ss.PoseRig(skewed), **SMALL)


VIEW = PlannedView(ss.Camera(POSES[0], 8, 8, 10, 10, 4, 4), ss.Sun.from_angles(40, 25))


@pytest.mark.parametrize(
    ("views", "message"),
    [
        (([], []), "rig: expected at least one training view, found none"),
        ((POSES, []), "rig: expected two lists, of training and test views, found tuple"),
        ((list(POSES), []), "rig: expected a PlannedView for each frame, found ndarray"),
        ([], "rig: expected two lists, of training and test views, found list"),
        (None, "rig: expected two lists, of training and test views, found NoneType"),
        (([VIEW], [replace(VIEW, sun=(40, 25))]), "rig: expected a Sun in each PlannedView, found tuple"),
        (([replace(VIEW, camera=POSES[0])], []), "rig: expected a Camera in each PlannedView, found ndarray"),
    ],
)
def test_what_a_rig_of_ones_own_must_give(tmp_path, views, message):
    @dataclass(frozen=True)
    class Odd(Rig):
        def views_of(self, target, camera, seed):
            return views

    with pytest.raises(InputError, match=message):
        ss.generate("boxsat", tmp_path / "data", rig=Odd(), **SMALL)
