"""Truth in the right place: of the recorded scene, posed as the models are, on the pixels of the view."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from spacesim.data.earth import Earth
from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at, rotation_from_quaternion
from spacesim.data.images import linear_from_srgb
from spacesim.data.records import Camera, Sun
from spacesim.data.store import read_dataset
from spacesim.splat.compose import Pose
from spacesim.viewer.drawing.paint import paint
from spacesim.viewer.state import DisplaySettings, SceneState, ViewerCamera
from spacesim.viewer.truth.scene import compose_scene, load_recorded_scene
from spacesim.viewer.truth.source import TruthService
from spacesim.viewer.truth.tracer import PASS, Tracer, TraceRequest
from spacesim.viewer.truth.truth import matching_frame, resample, stored_truth

TURN = Pose(np.array([0.8, 0.0, 0.0, 0.6]), np.array([1.0, -2.0, 0.5]), 1.5)


@pytest.fixture(scope="module")
def scene(tiny_data):
    return load_recorded_scene(tiny_data)


def view_of_frame(dataset, number):
    camera = dataset.frames[number].camera
    return ViewerCamera(camera.world_from_camera, 2 * np.arctan(0.5 * camera.height / camera.fy), 400, 300)


def test_a_view_that_stands_at_a_frame_is_found(tiny_data):
    dataset = read_dataset(tiny_data)
    frame = dataset.frames[2]
    state = SceneState((Pose(),), frame.sun)
    assert matching_frame(dataset, view_of_frame(dataset, 2), state) == 2
    assert matching_frame(dataset, view_of_frame(dataset, 2), SceneState((Pose(),), Sun(np.array([1.0, 0, 0])))) is None
    moved = view_of_frame(dataset, 2)
    pose = moved.world_from_camera.copy()
    pose[0, 3] += 0.05
    assert matching_frame(dataset, replace(moved, world_from_camera=pose), state) is None


def test_what_is_stored_is_what_is_in_the_files(tiny_data):
    from PIL import Image

    dataset = read_dataset(tiny_data)
    truth = stored_truth(dataset, 1, "colour")
    with Image.open(tiny_data / dataset.frames[1].file_path) as image:
        pixels = np.asarray(image.convert("RGBA")).astype(float)
    over_black = pixels[..., :3] * pixels[..., 3:] / 255
    assert np.abs(paint(truth.planes, "colour") - over_black).max() <= 1
    for mode in ("depth", "visibility", "normals", "object id"):
        planes = stored_truth(dataset, 1, mode).planes
        assert paint(planes, mode).any()
    assert (
        stored_truth(SimpleNamespace(frames=[replace(dataset.frames[1], gt_path=None)], root=tiny_data), 0, "depth")
        is None
    )


def test_the_tracer_renders_what_the_data_hold(tiny_data, scene):
    """Of a frame, at its own size: labels exactly, colours but for noise."""
    dataset = read_dataset(tiny_data)
    frame, tracer = dataset.frames[0], Tracer()
    (labels,) = tracer.answers(TraceRequest(1, scene, frame.camera, frame.sun, 1, "normals"))
    assert labels.done
    stored = stored_truth(dataset, 0, "normals").planes
    assert np.allclose(labels.planes.normal, stored.normal, atol=1e-5)
    assert np.allclose(labels.planes.depth, stored.depth, atol=1e-4)
    answers = list(tracer.answers(TraceRequest(2, scene, frame.camera, frame.sun, 3 * PASS, "colour")))
    assert [(a.samples, a.done) for a in answers] == [(PASS, False), (2 * PASS, False), (3 * PASS, True)]
    colors = stored_truth(dataset, 0, "colour").planes.rgb
    assert np.abs(answers[0].planes.rgb - colors).max() < 0.6 / 255  # as many samples, the same seed
    dark, light = linear_from_srgb(answers[0].planes.rgb), []
    for exposure in (-1.0, 0.5):
        asked = TraceRequest(3, scene, frame.camera, frame.sun, PASS, "colour", exposure=exposure)
        light.append(linear_from_srgb(next(tracer.answers(asked)).planes.rgb))
    below_white = (answers[0].planes.alpha[..., None] == 1) & (light[1] < 0.99)
    assert below_white.sum() > 100
    np.testing.assert_allclose(light[0][below_white], dark[below_white] / 2, atol=1e-4)
    np.testing.assert_allclose(light[1][below_white], dark[below_white] * 2**0.5, atol=1e-4)
    *_, many = tracer.answers(TraceRequest(4, scene, frame.camera, frame.sun, 16 * PASS, "colour"))
    errors = [np.abs(a.planes.rgb - many.planes.rgb).mean() for a in answers]
    assert 0 < errors[2] < errors[1] < errors[0]


def test_an_earth_that_the_scene_does_not_have_dims_what_is_traced(tiny_data, scene):
    """As it dims the pictures of a trajectory's frames."""
    frame, tracer = read_dataset(tiny_data).frames[0], Tracer()
    across = Earth(np.cross(frame.sun.direction, [0, 0, 1]), 89.9)
    dim, light, seen = replace(frame.sun, earth=across), [], []
    assert 0.2 < dim.visible_share < 0.9
    for sun in (frame.sun, dim):
        (labels,) = tracer.answers(TraceRequest(1, scene, frame.camera, sun, 1, "visibility"))
        (paths,) = tracer.answers(TraceRequest(2, scene, frame.camera, sun, PASS, "colour"))
        seen.append(labels.planes.visibility)
        light.append(linear_from_srgb(paths.planes.rgb)[paths.planes.alpha == 1])
    np.testing.assert_allclose(seen[1], dim.visible_share * seen[0], rtol=1e-6)
    below_white = light[0] < 0.99
    np.testing.assert_allclose(light[1][below_white], dim.visible_share * light[0][below_white], atol=1e-4)
    assert light[0].max() > 0.5


def test_objects_have_the_numbers_of_their_models(tiny_data, scene):
    frame = read_dataset(tiny_data).frames[0]
    both = compose_scene([scene, scene], [Pose(), Pose(translation=[0.5, 0.5, 2.0])])
    traced = [
        next(Tracer().answers(TraceRequest(1, both, frame.camera, frame.sun, 1, "object id", models))).planes.object_id
        for models in ((), (1, 1), (2, 1))
    ]
    assert set(np.unique(traced[0])) == {0, 1, 2}
    assert np.array_equal(traced[1], np.minimum(traced[0], 1))
    assert np.array_equal(traced[2], np.where(traced[0] > 0, 3 - traced[0], 0))


def test_a_posed_scene_shows_what_a_posed_camera_sees(tiny_data, scene):
    """The object moved, turned and scaled, against the camera moved the other way."""
    frame = read_dataset(tiny_data).frames[0]
    tracer = Tracer()
    camera = TURN.camera_in_model(frame.camera)
    sun = Sun(TURN.direction_in_model(frame.sun.direction))
    (posed,) = tracer.answers(TraceRequest(1, compose_scene([scene], [TURN]), frame.camera, frame.sun, 1, "depth"))
    (alone,) = tracer.answers(TraceRequest(2, scene, camera, sun, 1, "depth"))
    same = (posed.planes.alpha == alone.planes.alpha).mean()
    assert same > 0.99
    both = (posed.planes.alpha > 0) & (alone.planes.alpha > 0)
    assert both.any()
    assert np.abs(posed.planes.depth - TURN.scale * alone.planes.depth)[both].mean() < 0.01
    assert np.abs(posed.planes.visibility - alone.planes.visibility)[both].mean() < 0.03


def test_scenes_of_models_become_one(scene):
    from spacesim.scenes.config import MaterialConfig

    name = next(iter(__import__("spacesim.scenes.materials.table", fromlist=["material_names"]).material_names()))
    painted_scene = replace(
        scene,
        materials={"own": MaterialConfig(name)},
        objects=(replace(scene.objects[0], materials={"bus": "own"}, position=(1.0, 0.0, 0.0)),),
    )
    both = compose_scene([painted_scene, painted_scene], [Pose(), TURN])
    assert [one.materials for one in both.objects] == [{"bus": "own"}, {"bus": "own@1"}]
    assert set(both.materials) == {"own", "own@1"}
    turned = rotation_from_quaternion([0.8, 0, 0, 0.6]) @ [1.5, 0, 0] + [1.0, -2.0, 0.5]
    assert both.objects[1].position == pytest.approx(tuple(turned))
    assert both.objects[1].scale == pytest.approx(1.5)
    other = replace(scene, camera=replace(scene.camera, exposure=0.5))
    with pytest.raises(InputError, match="exposure"):
        compose_scene([scene, other], [Pose(), Pose()])


def test_frames_are_the_truth_of_what_they_show_alone(tiny_data, tmp_path, scene):
    """Of one model where it was trained, of several where the dataset's objects are; else the scene is traced."""
    dataset = read_dataset(tiny_data)
    view, sun, settings = view_of_frame(dataset, 2), dataset.frames[2].sun, DisplaySettings()

    def source(start, state, folders, data=dataset):
        """Of the truth of a stand, in a scene that was opened as `start`."""
        service = TruthService(folders, data, SceneState(start, sun))
        service._queue = SimpleNamespace(ask=lambda *_: 7)
        found = service.request_truth(None, view, SceneState(state, sun), settings)
        return found if isinstance(found, int) else getattr(found, "source", found)

    assert source((Pose(),), (Pose(),), [tiny_data]) == "the dataset's frame 2"
    assert source((TURN,), (TURN,), [tiny_data]) == 7  # posed by its scene file
    assert source((TURN,), (Pose(),), [tiny_data]) == "the dataset's frame 2"
    assert source((Pose(), TURN), (Pose(), TURN), [tiny_data, tiny_data]) == 7  # data of one of both
    pair = tmp_path / "pair"
    shutil.copytree(tiny_data, pair)
    both = compose_scene([scene, scene], [TURN, Pose()])
    (pair / "scene.json").write_text(json.dumps({**dataset.scene, "config": both.to_json()}))
    for poses, models in (((Pose(), TURN), [2, 1]), ((TURN, Pose()), [1, 2])):
        assert source((Pose(), Pose()), poses, [tiny_data, tiny_data], read_dataset(pair)) == "the dataset's frame 2"
        service = TruthService([tiny_data, tiny_data], read_dataset(pair), SceneState(poses, sun))
        assert service._models(SceneState(poses, sun)) == models
    assert TruthService([pair], read_dataset(pair), SceneState((Pose(),), sun))._models(SceneState((Pose(),), sun)) == [
        1,
        1,
    ]
    reason = "the data that a model was trained on are not where they were; name them when the viewer starts"
    assert source((TURN,), (TURN,), [None]) == reason
    assert source((Pose(), TURN), (Pose(), TURN), [None, None]) == "the dataset's frame 2"


def test_data_of_a_whole_scene_tell_what_its_models_are(tiny_data, tmp_path, scene):
    """Where those of the runs are gone: each object goes where the model of its number goes."""
    dataset, pair, asked = read_dataset(tiny_data), tmp_path / "pair", []
    shutil.copytree(tiny_data, pair)
    whole = compose_scene([scene, scene], [Pose(), TURN])
    (pair / "scene.json").write_text(json.dumps({**dataset.scene, "config": whole.to_json()}))
    view, sun, there = view_of_frame(dataset, 2), dataset.frames[2].sun, (Pose(), TURN)
    service = TruthService([None, tiny_data], read_dataset(pair), SceneState(there, sun))
    service._queue = SimpleNamespace(ask=lambda _, request: asked.append(request) or 7)
    assert (
        service.request_truth(None, view, SceneState(there, sun), DisplaySettings()).source == "the dataset's frame 2"
    )
    moved = Pose(translation=np.array([0.0, 0.0, 3.0])), TURN
    assert service.request_truth(None, view, SceneState(moved, sun), DisplaySettings()) == 7
    expected = compose_scene([scene, scene], moved).objects
    for one, other in zip(asked[0].scene.objects, expected, strict=True):
        assert one.position == pytest.approx(other.position, abs=1e-9)
        assert one.rotation_wxyz == pytest.approx(other.rotation_wxyz)
        assert one.scale == pytest.approx(other.scale)
    service = TruthService([None, None], None, SceneState(there, sun))
    assert "name data of the whole scene" in service.request_truth(
        None, view, SceneState(there, sun), DisplaySettings()
    )


def test_a_dataset_without_a_scene_says_so(tmp_path, scene):
    with pytest.raises(InputError, match=r"scene\.json"):
        load_recorded_scene(tmp_path)
    (tmp_path / "scene.json").write_text("[1]")
    with pytest.raises(InputError, match="config"):
        load_recorded_scene(tmp_path)
    config = scene.to_json()
    config["objects"] = [{**config["objects"][0], "spacecraft": "", "mesh": "gone.obj"}]
    (tmp_path / "scene.json").write_text(json.dumps({"config": config}))
    with pytest.raises(InputError, match=r"gone\.obj"):
        load_recorded_scene(tmp_path)


def test_pictures_are_fitted_to_the_view():
    """A spot in the dataset's picture lies where the view's camera sees that ray."""
    pose = look_at([0.0, -3, 0], [0.0, 0, 0])
    source = Camera(pose, 80, 60, 100.0, 100.0, 44.0, 27.0)
    target = Camera(pose, 256, 128, 90.0, 140.0, 128.0, 64.0)
    picture = np.zeros((60, 80, 3), np.uint8)
    picture[20:23, 50:53] = 255
    shown, known = resample(picture, source, target)
    rows, columns = np.nonzero(shown[..., 0] > 127)
    x, y = columns.mean() + 0.5, rows.mean() + 0.5
    assert (x - 128) / 90 == pytest.approx((51.5 - 44) / 100, abs=0.006)
    assert (y - 64) / 140 == pytest.approx((21.5 - 27) / 100, abs=0.006)
    inside = np.abs(np.argwhere(known).min(axis=0) - [64 - 0.27 * 140, 128 - 0.44 * 90])
    assert inside.max() < 1.5
    assert not known[0].any()
    half = resample(picture[::2, ::2], source, target)[0]  # at half the camera's size
    assert np.nonzero(half[..., 0] > 100)[1].mean() == pytest.approx(columns.mean(), abs=3)
