"""A client's requests: coarse while it moves, in full at rest, truth on request as long as it is that of the view."""

import numpy as np
import pytest
from browser import wait_for

from spacesim.data.geometry import look_at
from spacesim.data.records import Sun
from spacesim.viewer.drawing.frames import draw_frame
from spacesim.viewer.drawing.loop import RenderLoop
from spacesim.viewer.drawing.paint import Planes
from spacesim.viewer.session import Session
from spacesim.viewer.state import SceneState, SharedScene, ViewerCamera
from spacesim.viewer.truth.tracer import TraceResult
from spacesim.viewer.truth.truth import ViewerTruth


class Screen:
    def __init__(self):
        self.pictures, self.statistics = [], []

    def show(self, picture, sharp):
        self.pictures.append((picture, sharp))

    def show_statistics(self, statistics):
        self.statistics.append(statistics)


class Source:
    """Truth that is white, or a number to wait for, or a reason."""

    def __init__(self):
        self.found, self.asked, self.dropped = 7, [], 0

    def request_truth(self, session, view, state, look):
        self.asked.append(look.mode)
        return self.found

    def cancel_truth(self, session):
        self.dropped += 1


@pytest.fixture
def made(renderer, state):
    loop, screen, source, shared = RenderLoop(rest=0.1), Screen(), Source(), SharedScene(state)
    session = Session(renderer, shared, loop, screen, source)
    shared.listen(lambda _: session.on_scene_changed())
    loop.start()
    session.change_settings(side=256)
    yield session, screen, source, shared
    loop.stop()


def view_from(x, y, width=256, height=256):
    return ViewerCamera(look_at([x, y, 0.0], [0.0, 0, 0]), np.radians(40), width, height)


def at_rest(screen, count=1):
    wait_for(lambda: sum(sharp for _, sharp in screen.pictures) >= count, "a picture at rest")
    return screen.pictures[-1][0]


def test_a_move_gives_a_coarse_picture_and_then_a_sharp_one(made):
    session, screen, _, _ = made
    session.on_camera_moved(view_from(-5, 0))
    picture = at_rest(screen)
    assert [sharp for _, sharp in screen.pictures] == [False, True]
    assert picture.max() > 150
    session.on_camera_moved(view_from(-5, 0))  # the same: nothing is drawn
    session.on_camera_moved(view_from(-5, 1e-9))
    assert len(screen.pictures) == 2
    session.on_camera_moved(view_from(0, 5))
    assert (at_rest(screen, 2) != picture).any()
    assert screen.statistics[-1].width == 256
    assert session._last_frame[3].picture.shape == (256, 256, 3)
    assert session._last_frame[3].planes is None  # memory that each client would take


def test_a_change_of_the_scene_is_drawn(made):
    session, screen, _, shared = made
    session.on_camera_moved(view_from(-5, 0))
    before = at_rest(screen)
    shared.change(lambda state: SceneState(state.poses[::-1], state.sun))
    after = at_rest(screen, 2)
    assert before[128, 60].argmax() == 0  # red on the left
    assert after[128, 60].argmax() == 1
    shared.change(lambda state: SceneState(state.poses, Sun(state.sun.direction)))  # no other scene
    assert len(screen.pictures) == 4


def test_truth_is_asked_for_once_and_shown_as_it_comes(made):
    session, screen, source, _ = made
    session.on_camera_moved(view_from(-5, 0))
    plain = at_rest(screen)
    session.change_settings(compare="wipe", wipe=0.5)
    wait_for(lambda: source.asked, "the request")
    wait_for(lambda: "starting" in screen.statistics[-1].status, "a word about it")
    white = Planes(np.ones((64, 64), np.float32), rgb=np.ones((64, 64, 3), np.float32))
    session.on_trace_result(TraceResult(6, white, 4, False))  # to an older request
    session.on_trace_result(TraceResult(7, white, 4, False))
    wait_for(lambda: screen.pictures[-1][0][20, 20].min() == 255, "the truth")
    picture = screen.pictures[-1][0]
    assert (picture[:, 140:] == plain[:, 140:]).all()
    wait_for(lambda: "4 samples a pixel, more to come" in screen.statistics[-1].status, "a word about it")
    session.change_settings(wipe=0.0)
    wait_for(lambda: (screen.pictures[-1][0] == plain).all(), "no truth")
    assert source.asked == ["colour"]
    assert source.dropped == 0


def test_truth_goes_where_the_view_or_the_scene_changes(made):
    session, screen, source, shared = made
    session.on_camera_moved(view_from(-5, 0))
    at_rest(screen)
    session.change_settings(compare="wipe")
    wait_for(lambda: len(source.asked) == 1, "the request")
    session.on_camera_moved(view_from(-6, 0))
    assert source.dropped == 1
    wait_for(lambda: len(source.asked) == 2, "the request of the new view")
    shared.change(lambda state: SceneState(state.poses[::-1], state.sun))
    wait_for(lambda: len(source.asked) == 3, "the request of the new scene")
    session.change_settings(compare="off")
    assert source.dropped == 3
    session.on_trace_result(TraceResult(7, Planes(np.ones((8, 8)), rgb=np.ones((8, 8, 3))), 4, True))
    assert at_rest(screen)[20, 20].max() < 255


@pytest.mark.parametrize("change", ["view", "scene", "mode"])
def test_a_change_while_a_picture_is_drawn_gets_a_truth_of_its_own(made, state, monkeypatch, change):
    session, screen, source, shared = made
    session.on_camera_moved(view_from(-5, 0))
    at_rest(screen)
    source.request_truth = lambda _session, view, state, look: source.asked.append((view, state, look.mode)) or 7
    changes = {
        "view": lambda: session.on_camera_moved(view_from(-6, 0)),
        "scene": lambda: shared.change(lambda state: SceneState(state.poses[::-1], state.sun)),
        "mode": lambda: session.change_settings(mode="depth"),
    }
    during = [changes[change]]

    def slow(*arguments):
        frame = draw_frame(*arguments)
        if during:
            during.pop()()
        return frame

    monkeypatch.setattr("spacesim.viewer.session.draw_frame", slow)
    session.change_settings(compare="wipe", side=512)
    wait_for(lambda: source.asked and session._loop.idle, "the request")
    assert not during
    assert [(view is session.view, now is shared.state, mode) for view, now, mode in source.asked] == [
        (True, True, session.settings.mode)
    ]


def test_why_there_is_no_truth_is_said(made):
    session, screen, source, _ = made
    session.on_camera_moved(view_from(-5, 0))
    at_rest(screen)
    source.found = "the scene is not known"
    session.change_settings(compare="difference")
    wait_for(lambda: screen.statistics[-1].status == "no truth: the scene is not known", "the reason")
    session.change_settings(exposure=1.0)  # asks again
    wait_for(lambda: source.asked == ["colour", "colour"], "the request")
    session.change_settings(mode="depth")  # likewise
    wait_for(lambda: source.asked == ["colour", "colour", "depth"], "the request")
    source.found = 7
    session.change_settings(mode="normals")
    wait_for(lambda: len(source.asked) == 4, "the request")
    session.on_trace_result(TraceResult(7, None, 0, True, "the process that traces ended"))
    wait_for(lambda: "no truth: the process that traces ended" in screen.statistics[-1].status, "the reason")


def test_stored_truth_is_shown_at_once(made):
    session, screen, source, _ = made
    view = view_from(-5, 0)
    session.on_camera_moved(view)
    at_rest(screen)
    white = Planes(np.ones((64, 64), np.float32), rgb=np.ones((64, 64, 3), np.float32))
    source.found = ViewerTruth(white, view.camera(64, 64), "the dataset's frame 3")
    session.change_settings(compare="wipe", wipe=1.0)
    wait_for(lambda: screen.pictures[-1][0].min() == 255, "the truth")
    wait_for(lambda: screen.statistics[-1].status == "truth: the dataset's frame 3", "a word about it")
    session.change_settings(compare="difference")
    wait_for(lambda: "white 0.25 of 1" in screen.statistics[-1].status, "the scale")


def test_a_session_that_is_closed_draws_no_more(made):
    session, screen, _, shared = made
    session.on_camera_moved(view_from(-5, 0))
    at_rest(screen)
    session.close()
    count = len(screen.pictures)
    session.on_camera_moved(view_from(0, 5))
    shared.change(lambda state: SceneState(state.poses[::-1], state.sun))
    session.change_settings(mode="depth")
    wait_for(lambda: not session._loop._requests and not session._loop._resting, "nothing to do")
    assert len(screen.pictures) == count
