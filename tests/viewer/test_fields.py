"""Radiance fields in the viewer: coarse while something moves, in steps at rest, given up for what is newer."""

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import wait_for
from test_session import Screen, Source, view_from

from spacesim import backend
from spacesim.backend import ad
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.records import Sun
from spacesim.nerf.compose import FieldComposition
from spacesim.nerf.config import GridConfig, NerfConfig, ProposalConfig
from spacesim.nerf.fields.model import Networks
from spacesim.nerf.run import NerfRun
from spacesim.nerf.sampling.box import SceneBox
from spacesim.splat.compose import PlacedRun, Pose
from spacesim.splat.compose.scene import ComposeConfig
from spacesim.viewer.drawing.frames import FIELD_SHARES, STEPS, draw_frame
from spacesim.viewer.drawing.loop import AbandonedError, RenderLoop, RenderRequest
from spacesim.viewer.drawing.scene_renderer import SceneRenderer
from spacesim.viewer.load import load_setup
from spacesim.viewer.session import Session
from spacesim.viewer.state import MATERIALS, MODES, DisplaySettings, SceneState, SharedScene

SMALL = GridConfig(2, 4, 8, 8)
CONFIG = NerfConfig(
    samples=6,
    width=8,
    features=3,
    harmonics=1,
    grid=SMALL,
    coarse=ProposalConfig(6, 8, SMALL),
    fine=ProposalConfig(6, 8, SMALL),
    occupancy=8,
    chunk=1024,
)


def field_run() -> NerfRun:
    """A fog in a cube about the origin, 1 m wide: what a field is before it has learned."""
    backend.select()
    networks = Networks(CONFIG)
    parameters = [upload(values) for values in networks.initial(0)]
    box = SceneBox(np.full(3, -0.5), np.ones(3))
    filled = upload(np.ones(CONFIG.occupancy**3))
    return NerfRun(Path("fog"), CONFIG.to_json(), {}, networks, parameters, ad.Float(filled), box, 0)


@pytest.fixture(scope="module")
def fields() -> SceneRenderer:
    run = field_run()
    poses = (Pose(translation=np.array([0.0, 1, 0])), Pose(translation=np.array([0.0, -1, 0]), scale=0.5))
    placed = [PlacedRun(run, pose, f"fog {k}") for k, pose in enumerate(poses)]
    return SceneRenderer(FieldComposition(placed, ComposeConfig()))


@pytest.fixture
def state(fields) -> SceneState:
    return SceneState(tuple(placed.pose for placed in fields.composition.models), Sun(np.array([0.0, 0, 1])))


@pytest.fixture
def made(fields, state):
    loop, screen, shared = RenderLoop(rest=0.1), Screen(), SharedScene(state)
    session = Session(fields, shared, loop, screen, Source())
    shared.listen(lambda _: session.on_scene_changed())
    session.change_settings(side=256)
    loop.start()
    yield session, screen, shared, loop
    loop.stop()


def test_what_a_scene_of_fields_has(fields, state):
    assert (fields.progressive, fields.content, fields.gaussian_count) == (True, "2 radiance fields", 0)
    assert fields.modes == tuple(mode for mode in MODES if mode not in (*MATERIALS, "ellipsoids"))
    centre, radius = fields.bounds(state)
    with pytest.raises(InputError, match="expected Gaussians alone, to read materials, found a radiance field"):
        fields.composition.draw_material(view_from(-5, 0).camera(16, 16))
    assert fields.models[0].radius == pytest.approx(np.sqrt(0.75))
    assert radius > 1.5
    assert abs(centre[0]) < 1e-9


@pytest.mark.parametrize("mode", MODES)
def test_modes(fields, state, mode):
    frame = draw_frame(fields, state, view_from(-5, 0), DisplaySettings(mode, side=256), 0.25)
    if mode == "visibility":
        single = SceneRenderer(
            FieldComposition(fields.composition.models[:1], ComposeConfig())
        )  # nothing else shades it
        alone = replace(state, poses=state.poses[:1])
        assert frame.picture.any()
        frame = draw_frame(single, alone, view_from(-5, 0), DisplaySettings(mode, side=256), 0.25)
    if mode in ("visibility", *MATERIALS, "ellipsoids"):
        assert frame.note.startswith(f"no {mode} to be seen: ")
        assert not frame.picture.any()
    elif mode != "object id":  # fog covers less than half
        assert frame.note == ""
        assert frame.picture.any()


def test_a_movement_gives_a_coarse_picture_and_rest_all_steps(made):
    session, screen, shared, loop = made
    session.on_camera_moved(view_from(-5, 0))
    wait_for(lambda: loop.idle, "all to be drawn")
    sizes = [picture.shape[1] for picture, _ in screen.pictures]
    assert sizes == sorted(sizes)
    assert sizes[-1] == 256
    assert [full for _, full in screen.pictures] == [False, *[True] * (len(sizes) - 1)]
    assert screen.statistics[-1].share == 1
    drawn = len(sizes)
    session.change_settings(compare="wipe")  # nothing is drawn again
    wait_for(lambda: loop.idle, "the comparison")
    assert len(screen.pictures) == drawn + 1
    for pose in (Pose(translation=np.array([0.0, 1, 1])), Pose(translation=np.array([0.0, 1, 2]))):
        shared.change(lambda state, pose=pose: state.with_pose(0, pose))
    wait_for(lambda: loop.idle, "the moved model")
    assert screen.pictures[-1][0].shape[1] == 256
    assert (screen.pictures[-1][0] != screen.pictures[drawn - 1][0]).any()


def test_steps_and_what_moves_are_the_same_picture(fields, state):
    """Of fewer pixels: their means by area are near those of the whole."""
    whole, part = (
        draw_frame(fields, state, view_from(-5, 0), DisplaySettings(side=256), share, on_chunk)
        for share, on_chunk in ((1.0, None), (0.5, lambda: None))
    )
    means = whole.picture.reshape(128, 2, 128, 2, 3).mean(axis=(1, 3))
    assert np.abs(means - part.picture).mean() < 1.0
    assert means.max() > 10


@pytest.mark.parametrize("change", ["view", "scene", "mode", "close"])
def test_a_refinement_is_given_up_within_a_chunk(made, monkeypatch, change):
    session, screen, shared, loop = made
    begun, go, chunks = threading.Event(), threading.Event(), []
    composition = session._renderer.composition
    posed = composition.posed(shared.state.poses)

    def predict(camera, sun, normals=False, exposure=None, on_chunk=None):
        if camera.width == 256 and not begun.is_set():
            begun.set()
            assert go.wait(60)
            for k in range(1000):
                chunks.append(k)
                on_chunk()
            raise AssertionError("nobody gave it up")
        return posed.predict(camera, sun, normals, exposure, on_chunk)

    monkeypatch.setattr(composition, "posed", lambda poses: type("Posed", (), {"predict": staticmethod(predict)}))
    session.on_camera_moved(view_from(-5, 0))
    assert begun.wait(60)
    before = len(screen.pictures)
    changes = {
        "view": lambda: session.on_camera_moved(view_from(-6, 0)),
        "scene": lambda: shared.change(lambda state: SceneState(state.poses, Sun(np.array([0.0, 1, 0])))),
        "mode": lambda: session.change_settings(mode="depth"),
        "close": session.close,
    }
    changes[change]()
    go.set()
    wait_for(lambda: loop.idle, "the newer picture")
    assert chunks == [0]
    if change == "close":
        assert len(screen.pictures) == before
    else:
        assert screen.pictures[before][0].shape[1] < 256  # coarse first
        assert screen.pictures[-1][0].shape[1] == 256


def test_a_long_picture_gives_way_to_others():
    loop, made = RenderLoop(rest=60), []
    rest = iter([True, False])

    def draw_long(full):
        made.append(("a", full))
        loop.request("b", RenderRequest(lambda full: made.append(("b", full))))
        loop.request("a", RenderRequest(lambda full: made.append(("newer a", full))))
        loop.submit(lambda: made.append("work"))
        for _ in range(3):
            loop.give_way("a")
        made.append("a is done")
        return next(rest)

    loop.request("a", RenderRequest(draw_long), moving=False)
    loop.start()
    wait_for(lambda: ("newer a", False) in made, "all")
    loop.stop()
    assert made == [("a", True), "work", ("b", False), "a is done", ("newer a", False)]
    with pytest.raises(AbandonedError):
        loop.give_way("a")  # it has ended


def test_steps_take_turns():
    loop, made = RenderLoop(rest=0.0), []
    left = {"a": 2, "b": 2}

    def request(name):
        def draw(full):
            made.append(name)
            left[name] -= 1
            time.sleep(0.01)
            return left[name] > 0

        return RenderRequest(draw)

    for name in left:
        loop.request(name, request(name), moving=False)
    loop.start()
    wait_for(lambda: loop.idle, "all")
    loop.stop()
    assert made == ["a", "b", "a", "b"]


def test_the_pace_of_fields_begins_with_few_pixels(made):
    session, *_ = made
    pace = session._resolution
    assert pace.share == FIELD_SHARES[-1] < STEPS[0]
    for _ in FIELD_SHARES:
        pace.record_time(pace.share, (64, 64), 0.001)
    assert pace.share == 1
    pace.record_time(1.0, (64, 64), 10.0)
    assert pace.share == FIELD_SHARES[1]


def test_runs_and_scene_files_of_fields_are_opened_and_saved(tmp_path, tiny_data, spacesim):
    pytest.importorskip("viser", reason="viser is not installed")
    from spacesim.splat.compose.scenefile import save_scene
    from spacesim.viewer.path import scene_to_save

    run, sizes = tmp_path / "field", ["--set", "rays=512", "--set", "samples=8", "--iterations", "3"]
    done = spacesim("train", tiny_data, "--out", run, "--method", "nerf-relight", "--preset", "demo", *sizes)
    assert done.code == 0, done.errors
    setup = load_setup(run)
    assert setup.renderer.progressive
    assert setup.renderer.relightable
    assert setup.dataset is not None  # of its training: cameras and truth
    moved = setup.state.with_pose(0, Pose(translation=np.array([0.0, 0, 2]), scale=2.0))
    scene = scene_to_save(setup.renderer.composition, moved, view_from(-9, 0, 64, 64), setup.path)
    save_scene(tmp_path / "saved.toml", scene)
    again = load_setup(tmp_path / "saved.toml")
    assert again.state.poses[0].key == moved.poses[0].key
    assert again.renderer.content == "1 radiance field"
    done = spacesim("compose", tmp_path / "saved.toml", "--out", tmp_path / "frames")
    assert done.code == 0, done.errors
