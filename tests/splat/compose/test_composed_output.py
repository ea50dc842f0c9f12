"""Frames of a scene on disk: what they hold, what is kept and what is made anew; the command."""

import json
import shutil
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from posed import made_run, seen_from

from spacesim.data.errors import InputError
from spacesim.data.images import linear_from_srgb, read_exr, read_png
from spacesim.data.lock import lock_folder
from spacesim.data.records import Sun
from spacesim.splat.compose import GaussianComposition, Keyframe, PlacedRun, Pose, PosedScene
from spacesim.splat.compose import output as module
from spacesim.splat.compose.output import compose
from spacesim.splat.export.video import encoder

with_video = pytest.mark.skipif(encoder() is None, reason="PyAV, the extra video, is not installed")
SUN = Sun.from_angles(40, 35)


def scene(frames: int = 3, away: float = 1.0, last: float = 0.2, methods=("map", "vanilla")) -> PosedScene:
    models = [
        PlacedRun(made_run(method, k), Pose(translation=[k * away, 0, 0]), f"m{k}") for k, method in enumerate(methods)
    ]
    keys = [
        Keyframe(0.0, poses={"m0": models[0].pose}),
        Keyframe(frames / 24, poses={"m0": Pose(translation=[0, last, 0])}),
    ]
    return PosedScene(GaussianComposition(models), SUN, seen_from([4, -1, 2], pixels=24), keys, None, frames)


def test_pictures_that_are_no_longer_written_go(tmp_path):
    compose(scene(), tmp_path / "out")
    assert (tmp_path / "out/visibility/0000.png").exists()
    compose(scene(methods=("vanilla",)), tmp_path / "out")
    assert (tmp_path / "out/rgb/0000.png").exists()
    assert not (tmp_path / "out/visibility/0000.png").exists()


def test_frames_hold_what_the_scene_predicts(tmp_path):
    reported: list[tuple[int, int]] = []
    done = compose(scene(), tmp_path / "out", report=lambda *numbers: reported.append(numbers))
    assert (done.frames, done.rendered) == (3, 3)
    assert reported == [(1, 3), (2, 3), (3, 3)]
    for index in range(3):
        shot, name = scene().frame(index), f"{index:04d}"
        seen = shot.composition.predict(shot.camera, shot.sun)
        picture = read_png(tmp_path / f"out/rgb/{name}.png").astype(float) / 255
        np.testing.assert_allclose(picture[..., 3], seen.alpha, atol=0.5 / 255 + 1e-6)
        np.testing.assert_allclose(picture[..., :3] * picture[..., 3:], np.clip(seen.rgb, 0, 1), atol=1.5 / 255)
        assert np.array_equal(read_exr(tmp_path / f"out/depth/{name}.exr")["depth"], seen.depth)
        assert np.array_equal(read_png(tmp_path / f"out/id/{name}.png"), seen.id)
        visible = read_png(tmp_path / f"out/visibility/{name}.png") / 255
        np.testing.assert_allclose(visible, np.clip(seen.visibility, 0, 1), atol=0.5 / 255 + 1e-6)
        record = json.loads((tmp_path / f"out/shots/{name}.json").read_text())
        assert record["time"] == pytest.approx(index / 24)
        np.testing.assert_allclose(record["models"][0]["position"], shot.composition.models[0].pose.translation)
        np.testing.assert_allclose(record["sun_direction"], SUN.direction)
    assert read_png(done.sheet).shape[1] >= 560


def test_only_what_is_missing_or_changed_is_rendered(tmp_path, monkeypatch):
    out = tmp_path / "out"
    compose(scene(), out)
    assert compose(scene(), out).rendered == 0
    (out / "rgb/0001.png").write_bytes((out / "rgb/0001.png").read_bytes()[:100])  # cut off
    (out / "depth/0002.exr").unlink()
    assert compose(scene(), out).rendered == 2
    (out / "shots/0000.json").write_text("{")
    assert compose(scene(), out).rendered == 1
    assert compose(scene(last=0.3), out).rendered == 2  # the first frame is the same
    assert compose(scene(away=1.1), out).rendered == 3
    whole = compose(scene(5, away=1.1), out)
    assert whole.rendered == 4
    compose(scene(2), out)
    assert sorted(path.name for path in (out / "rgb").iterdir()) == ["0000.png", "0001.png"]
    assert sorted(path.name for path in (out / "shots").iterdir()) == ["0000.json", "0001.json"]


def test_pictures_of_linear_models_are_exposed_as_asked_for(tmp_path):
    linear = scene(1, methods=("linear", "linear"))
    shot = linear.frame(0)
    once, doubled = (shot.composition.predict(shot.camera, SUN, exposure=ev).rgb for ev in (None, 1.0))
    np.testing.assert_allclose(linear_from_srgb(doubled), np.minimum(2 * linear_from_srgb(once), 1), atol=1e-4)
    compose(linear, tmp_path / "out")
    light, seen = read_exr(tmp_path / "out/linear/0000.exr"), shot.composition.predict(shot.camera, shot.sun)
    assert np.array_equal(light["linear"], seen.linear)
    assert np.array_equal(light["alpha"], seen.alpha)
    before = read_png(tmp_path / "out/rgb/0000.png")
    assert compose(linear, tmp_path / "out", exposure=1.0).rendered == 1
    assert compose(linear, tmp_path / "out", exposure=1.0).rendered == 0
    assert read_png(tmp_path / "out/rgb/0000.png")[..., :3].mean() > 1.1 * before[..., :3].mean()
    for methods, named in ((("map",), "linear light"), (("linear", "map"), "of one tone curve")):
        with pytest.raises(InputError, match=f"exposure: expected .*{named}"):
            compose(scene(1, methods=methods), tmp_path / "none", exposure=1.0)
    with pytest.raises(InputError, match="-40 to 40 EV"):
        compose(linear, tmp_path / "none", exposure=float("inf"))
    assert not (tmp_path / "none").exists()


def test_an_interrupted_call_goes_on(tmp_path):
    def stop(done, _frames):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compose(scene(), tmp_path / "out", report=stop)
    assert compose(scene(), tmp_path / "out").rendered == 1
    compose(scene(), tmp_path / "at once")
    for path in (tmp_path / "at once").rglob("*.*"):
        assert path.read_bytes() == (tmp_path / "out" / path.relative_to(tmp_path / "at once")).read_bytes(), path


def test_no_visibility_where_nothing_knows_any(tmp_path):
    done = compose(scene(1, methods=("vanilla",)), tmp_path / "out")
    assert not (tmp_path / "out/visibility").exists()
    assert (done.video, done.note) == (None, None)
    assert compose(scene(1, methods=("vanilla",)), tmp_path / "out").rendered == 0


@with_video
def test_the_video_shows_the_frames(tmp_path):
    import av

    done = compose(scene(), tmp_path / "out", size=(64, 48))
    assert done.note is None
    with av.open(str(done.video)) as file:
        frames = [frame.to_ndarray(format="rgb24").astype(float) / 255 for frame in file.decode(video=0)]
    assert len(frames) == 3
    for index, frame in enumerate(frames):
        picture = read_png(tmp_path / f"out/rgb/{index:04d}.png").astype(float) / 255
        assert frame.shape == (48, 64, 3)
        assert np.abs(frame - picture[..., :3] * picture[..., 3:]).mean() < 0.03


@with_video
def test_the_video_has_the_scenes_pictures_a_second(tmp_path):
    import av

    done = compose(replace(scene(4, methods=("vanilla",)), fps=24000 / 1001), tmp_path / "out")
    with av.open(str(done.video)) as file:
        assert file.streams.video[0].average_rate == Fraction(24000, 1001)
        assert [frame.pts * frame.time_base for frame in file.decode(video=0)][3] == Fraction(3 * 1001, 24000)


def test_frames_that_end_before_the_last_keyframe_are_warned_of(tmp_path, caplog):
    whole = scene(3, methods=("vanilla",))  # its last keyframe is where the last picture ends
    compose(whole, tmp_path / "out")
    assert caplog.records == []
    compose(replace(whole, frames=2), tmp_path / "out")
    assert [record.getMessage() for record in caplog.records] == [
        "scene: 2 frames at 24 a second end at 0.08333 s, before the last keyframe at 0.125 s"
    ]
    caplog.clear()
    compose(replace(whole, frames=1), tmp_path / "still")
    assert caplog.records == []


def test_without_an_encoder_a_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "encoder", lambda: None)
    done = compose(scene(), tmp_path / "out")
    assert done.video is None
    assert "spacesim[video]" in done.note


def test_what_cannot_be_rendered_is_refused_before_the_work(tmp_path):
    one = scene()
    with pytest.raises(InputError, match="expected the Sun"):
        compose(PosedScene(one.composition, None, one.camera), tmp_path / "a")
    with pytest.raises(InputError, match="expected a camera"):
        compose(PosedScene(one.composition, SUN), tmp_path / "a")
    assert not (tmp_path / "a").exists()
    (tmp_path / "b").mkdir()
    (tmp_path / "b/notes.txt").write_text("mine")
    with pytest.raises(InputError, match="b: expected an empty or new folder"):
        compose(one, tmp_path / "b")
    with pytest.raises(InputError, match=r"notes\.txt"):
        compose(one, tmp_path / "b/notes.txt")
    with lock_folder(tmp_path / "c"), pytest.raises(InputError, match=r"no other run at work"):
        compose(one, tmp_path / "c")


# ---- the command ----


@pytest.fixture
def scene_file(tiny_run, tmp_path):
    shutil.copytree(tiny_run, tmp_path / "runs/tiny")
    text = (
        '[[models]]\nrun = "runs/tiny"\n[[models]]\nrun = "runs/tiny"\nname = "second"\nposition = [-3, -3, -3]\n'
        "[sun]\nazimuth_deg = 45\nelevation_deg = 35\n"
        "[camera]\nposition = [9, -9, 3]\nlook_at = [-1.5, -1.5, -1.5]\nresolution = 32\n"
    )
    (tmp_path / "pair.toml").write_text(text)
    return tmp_path / "pair.toml"


def test_the_command(spacesim, scene_file, tmp_path):
    config = tmp_path / "runs/tiny/config.json"
    config.write_text(json.dumps({**json.loads(config.read_text()), "antialiased": False}))
    done = spacesim("compose", scene_file, "--out", tmp_path / "out", "--size", 20, "--ply", tmp_path / "pair.ply")
    assert done.code == 0, done.errors
    assert str(tmp_path / "out" / "sheet.png") in done.output
    assert read_png(tmp_path / "out/rgb/0000.png").shape == (20, 20, 4)
    assert set(np.unique(read_png(tmp_path / "out/id/0000.png"))) <= {0, 1, 2}
    assert (tmp_path / "pair.ply").stat().st_size > 1000
    assert not any("2D filter" in line for line in done.errors)
    config.write_text(json.dumps({**json.loads(config.read_text()), "antialiased": True}))
    done = spacesim("compose", scene_file, "--out", tmp_path / "out", "--size", 20, "--ply", tmp_path / "pair.ply")
    assert any(line.startswith("second: the run is antialiased") for line in done.errors)


def test_the_command_refuses(spacesim, scene_file, tmp_path):
    assert spacesim("compose", tmp_path / "none.toml", "--out", tmp_path / "out").is_refusal("none.toml")
    text = scene_file.read_text()
    scene_file.write_text(text.replace('name = "second"', "scale = -1"))
    assert spacesim("compose", scene_file, "--out", tmp_path / "out").is_refusal("pair.toml, line 5", "scale")
    scene_file.write_text(text.replace('"runs/tiny"', '"runs/other"', 1))
    assert spacesim("compose", scene_file, "--out", tmp_path / "out").is_refusal("line 2", "runs/other")
    assert not (tmp_path / "out").exists()
