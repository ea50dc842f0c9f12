"""The viewer in headless Chromium: it opens, handles are dragged, truth appears, what is saved is drawn again; fields
beside Gaussians are refined."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
from browser import PATIENCE, choose, fill, press, wait_for

from spacesim.data.images import read_png
from spacesim.data.records import Sun
from spacesim.splat.compose import Pose
from spacesim.viewer.drawing.frames import draw_mode, picture_size
from spacesim.viewer.drawing.paint import PALETTE
from spacesim.viewer.panels.handles import GIZMO, SUN_AWAY
from spacesim.viewer.state import MATERIALS, MODES


@pytest.fixture(scope="module")
def tab(viewer, browser):
    """A page that shows its first picture: page, client, size of the window."""
    return opened_tab(viewer, browser)


@pytest.fixture(scope="module")
def mixed(serve_pair, tiny_run, tiny_field):
    """Gaussians below, a radiance field above them."""
    return serve_pair(tiny_run, tiny_field)


@pytest.fixture(scope="module")
def mixed_tab(mixed, browser):
    return opened_tab(mixed, browser, 700, 420)


def opened_tab(viewer, browser, width=900, height=560):
    before = set(viewer.clients)
    page = browser.open(f"{viewer.url}/?fixedDpr=1", width, height)  # else viser draws fewer pixels where it is slow
    client = wait_for(lambda: next((c for k, c in viewer.clients.items() if k not in before), None), "a client")
    wait_for(lambda: "ms a picture" in page.text(), "the first picture")
    close = 'document.querySelector("[class*=Notification-closeButton]")'  # of a note that WebGL runs in software
    wait_for(lambda: page.evaluate(f"(() => {{ if ({close}) {close}.click(); return !{close}; }})()"), "the note to go")
    wait_for(lambda: shown(page, client).max() > 40, "a picture that is not black")
    return SimpleNamespace(page=page, client=client)


def shown(page, client):
    """[H, W, 3] int: the part of the page where the scene is."""
    view = client.session.view
    return page.picture()[: view.height, : view.width].astype(int)


def settled(page, client):
    """What is shown once all that was requested is drawn and the page changes no more."""
    deadline, last, same = time.monotonic() + PATIENCE, None, 0
    while same < 2:
        assert time.monotonic() < deadline, "the picture never settles"
        wait_for(lambda: client._loop.idle, "all to be drawn")
        page.frames(4)
        time.sleep(0.2)
        now = shown(page, client)
        same = same + 1 if last is not None and np.abs(now - last).max() < 8 else 0
        last = now
    return last


def choose_mode(tab, mode):
    """In the panel, until the viewer knows."""
    choose(tab.page, tab.client.controls.mode._impl.uuid, mode)
    wait_for(lambda: tab.client.session.settings.mode == mode, mode)


def on_page(client, point):
    """(x, y) of a point of the world on the page."""
    view = client.session.view
    camera = view.camera(view.width, view.height)
    x, y, z = camera.camera_from_world[:3, :3] @ point + camera.camera_from_world[:3, 3]
    return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy


def grey(picture):
    """[H, W] bool: where the colours of visibility are."""
    return (np.ptp(picture, axis=-1) < 40) & (picture.min(axis=-1) > 25)


def test_it_opens_with_the_scene(viewer, tab):
    picture = settled(tab.page, tab.client)
    view = tab.client.session.view
    assert view.width > 300
    camera = viewer.setup.camera
    assert np.allclose(view.world_from_camera, camera.world_from_camera, atol=1e-4)
    assert (picture.max(axis=-1) > 60).mean() > 0.01
    text = tab.page.text()
    for words in ("Mode", "Azimuth", "Scale of other", "Compare", "600 Gaussians", "CPU (LLVM)"):
        assert words.lower() in text.lower() or words == "CPU (LLVM)"


def test_beside_the_truth_nothing_can_be_grabbed(viewer, tab, at_start):
    """Handles fill the window, and both pictures a half of it."""

    def blue() -> int:
        picture = settled(tab.page, tab.client)
        return int(((picture[..., 2] > 180) & (picture[..., 0] < 90)).sum())

    compare = tab.client.controls.compare._impl.uuid
    assert blue() > 50
    choose(tab.page, compare, "beside")
    wait_for(lambda: tab.client.session.settings.compare == "beside", "beside")
    assert blue() == 0
    choose(tab.page, compare, "off")
    wait_for(lambda: tab.client.session.settings.compare == "off", "off")
    assert blue() > 50


def test_a_narrow_window_shows_the_whole_width_at_first(viewer, browser):
    client = opened_tab(viewer, browser, 800, 700).client
    first = viewer._server.initial_camera

    def widened() -> bool:
        view = client.session.view
        return view.width < view.height and np.isclose(
            np.tan(0.5 * view.fov) * view.width / view.height, np.tan(0.5 * first.fov), rtol=1e-3
        )

    wait_for(widened, "a wider view")
    client.look_from(client.session.view.world_from_camera, first.fov)  # whoever moves has the view that was chosen
    wait_for(lambda: np.isclose(client.session.view.fov, first.fov), "that view")
    client.handle.camera.fov = 0.9 * first.fov
    wait_for(lambda: np.isclose(client.session.view.fov, 0.9 * first.fov), "another one")


def test_a_dragged_gizmo_moves_its_model(viewer, tab, at_start):
    choose_mode(tab, "object id")
    before = settled(tab.page, tab.client)
    pose, radius = at_start.poses[1], viewer.setup.renderer.models[1].radius
    up, grab = np.array([0, 0, 1]), 0.3 * GIZMO * pose.scale * radius  # between the other handles
    start, end = (on_page(tab.client, pose.translation + length * up) for length in (grab, grab + 0.5))
    tab.page.drag(start, end)
    wait_for(lambda: viewer.shared.state.poses[1].translation[2] > pose.translation[2] + 0.3, "the model to be moved")
    settled(tab.page, tab.client)
    moved = viewer.shared.state.poses[1].translation
    assert moved[:2] == pytest.approx(pose.translation[:2], abs=0.02)
    assert 0.3 < moved[2] - pose.translation[2] < 0.7
    after = settled(tab.page, tab.client)
    blue = [np.argwhere((p[..., 2] > 180) & (p[..., 0] < 130)) for p in (before, after)]
    top, lower = (rows[:, 0].mean() for rows in (blue[1], blue[0]))
    assert top < lower - 20  # pixels: it has gone up
    viewer.set_state(at_start)


def test_a_dragged_sun_moves_the_shadow(viewer, tab, at_start):
    choose_mode(tab, "visibility")
    before = settled(tab.page, tab.client)
    centre, radius = viewer.setup.renderer.bounds(at_start)
    ball = centre + SUN_AWAY * radius * at_start.sun.direction
    other = centre + SUN_AWAY * radius * Sun.from_angles(320, 20).direction
    tab.page.drag(on_page(tab.client, ball), on_page(tab.client, other), steps=12)
    wait_for(lambda: np.abs(np.subtract(viewer.shared.state.sun.angles, (320, 20))).max() < 8, "the Sun to be there")
    after = settled(tab.page, tab.client)
    azimuth, _ = viewer.shared.state.sun.angles
    model = grey(before) & grey(after)  # handles are coloured
    changed = np.abs(after - before).max(axis=-1)[model] > 20
    assert changed.mean() > 0.03
    sliders = viewer._sun
    assert float(sliders.azimuth.value) == pytest.approx(azimuth, abs=0.1)
    fill(tab.page, sliders.azimuth._impl.uuid, "20")
    fill(tab.page, sliders.elevation._impl.uuid, "60")
    wait_for(lambda: viewer.shared.state.sun.angles == pytest.approx((20, 60), abs=1e-6), "the typed Sun")
    again = settled(tab.page, tab.client)
    model = grey(before) & grey(again)
    assert (np.abs(again - before).max(axis=-1)[model] > 20).mean() < 0.005


def test_the_truth_appears(viewer, tab, at_start):
    controls = tab.client.controls
    choose_mode(tab, "colour")
    plain = settled(tab.page, tab.client)
    tab.client.session.change_settings(samples=8)
    choose(tab.page, controls.compare._impl.uuid, "wipe")
    wait_for(lambda: "path-traced, 8 samples" in tab.page.text(), "the truth")
    wiped = settled(tab.page, tab.client)
    half = plain.shape[1] // 2
    assert np.abs(wiped[:, half + 3 :] - plain[:, half + 3 :]).mean() < 1.5
    assert np.abs(wiped[:, : half - 3] - plain[:, : half - 3]).mean() > 2
    choose(tab.page, controls.compare._impl.uuid, "off")
    wait_for(lambda: tab.client.session.settings.compare == "off", "no comparison")
    back = settled(tab.page, tab.client)
    assert np.abs(back - plain).mean() < 1.5


def test_what_is_saved_is_drawn_by_the_command_line(viewer, tab, at_start, spacesim, tmp_path, monkeypatch):
    monkeypatch.setattr(viewer.loop, "_tidy", lambda: None)  # two threads must not call Dr.Jit
    viewer.set_state(at_start.with_pose(1, at_start.poses[0]))  # something else than what was opened
    viewer.set_state(at_start.with_pose(1, Pose(translation=np.array([0.1, 0.9, 1.0]), scale=0.7)))
    press(tab.page, "Files")
    uuid = viewer.files.name._impl.uuid
    fill(tab.page, uuid, "saved.toml")
    wait_for(lambda: viewer.files.name.value == "saved.toml", "the name")
    press(tab.page, "Save scene")
    path = viewer.setup.out / "saved.toml"
    wait_for(path.exists, "the file")
    settled(tab.page, tab.client)  # nothing is drawn from here on
    done = spacesim("compose", path, "--out", tmp_path / "frames")
    assert done.code == 0, done.errors
    picture = read_png(tmp_path / "frames" / "rgb" / "0000.png").astype(np.float64)
    over_black = np.rint(picture[..., :3] * picture[..., 3:] / 255)
    view, stand = tab.client.session.view, viewer.shared.state
    _, ours, _, _ = draw_mode(viewer.setup.renderer, stand, view.camera(view.width, view.height), "colour")
    assert ours.shape == over_black.shape
    assert np.abs(ours - over_black).max() <= 2  # straight alpha is rounded twice
    viewer.files.status.content = ""
    press(tab.page, "Save scene")  # our own file may be written again, others' not
    wait_for(lambda: viewer.files.status.content.startswith("saved"), "the file again")
    fill(tab.page, uuid, "pair.toml")
    wait_for(lambda: viewer.files.name.value == "pair.toml", "the name")
    press(tab.page, "Save scene")
    wait_for(lambda: "not saved" in viewer.files.status.content, "the refusal")


def test_two_clients_at_once(viewer, browser, tab, at_start):
    """Each has a camera and a mode of its own; the scene is one."""
    other = opened_tab(viewer, browser, 700, 300)
    try:
        choose_mode(other, "object id")
        ids = settled(other.page, other.client)
        mine = settled(tab.page, tab.client)
        assert tab.client.session.settings.mode == "colour"
        palette = np.array([(0, 0, 0), *PALETTE[:2]])
        near = np.abs(ids[:, :, None] - palette).max(axis=-1).min(axis=-1) < 30
        assert near.mean() > 0.9  # but for handles
        x, y = other.client.session.view.width / 2, 60.0
        other.page.drag((x, y), (x + 80, y))
        wait_for(lambda: not other.client.session.view.same(tab.client.session.view), "another view")
        viewer.set_state(at_start.with_pose(1, Pose(translation=np.array([0.0, 1.2, 1.0]))))
        assert np.abs(settled(tab.page, tab.client) - mine).mean() > 1
        assert np.abs(settled(other.page, other.client) - ids).mean() > 1
    finally:
        count = len(viewer.clients)
        other.page.close()
    wait_for(lambda: len(viewer.clients) == count - 1, "the client to go")
    viewer.set_state(at_start)
    assert settled(tab.page, tab.client).max() > 40


def test_a_mixed_scene_is_refined_when_still(mixed, mixed_tab, monkeypatch):
    page, client = mixed_tab.page, mixed_tab.client
    picture = settled(page, client)
    assert "300 Gaussians in 1 model, 1 radiance field" in page.text()
    assert (picture.max(axis=-1) > 60).mean() > 0.01
    sizes, show = [], client.session._screen.show
    monkeypatch.setattr(
        client.session._screen, "show", lambda p, full: (sizes.append((p.shape[1], full)), show(p, full))
    )
    x, y = client.session.view.width / 2, 60.0
    page.drag((x, y), (x + 60, y))
    settled(page, client)
    whole, _ = picture_size(client.session.view, client.session.settings.side)
    assert min(width for width, _ in sizes) <= whole / 2  # while it moves
    assert sizes[-1] == (whole, True)
    assert "(100 % of full resolution)" in page.text()
    page.drag((x + 60, y), (x, y))
    assert np.abs(settled(page, client) - picture).mean() < 2


def test_all_modes_of_a_mixed_scene_can_be_seen(mixed, mixed_tab):
    options = mixed_tab.client.controls.mode.options
    assert set(options) == set(MODES) - {*MATERIALS, "ellipsoids"}
    shown = {}
    for mode in options:
        choose_mode(mixed_tab, mode)
        shown[mode] = settled(mixed_tab.page, mixed_tab.client)
        assert "to be seen" not in mixed_tab.page.text()
        assert (shown[mode].max(axis=-1) > 60).mean() > 0.01, mode
    for mode in options[1:]:
        assert np.abs(shown[mode] - shown[options[0]]).mean() > 1, mode
    for color in PALETTE[:2]:  # both are there
        assert (np.abs(shown["object id"] - np.array(color)).max(axis=-1) < 30).mean() > 0.002


def test_a_dragged_gizmo_moves_the_field_of_a_mixed_scene(mixed, mixed_tab):
    choose_mode(mixed_tab, "object id")
    before = settled(mixed_tab.page, mixed_tab.client)
    pose, model = mixed.setup.state.poses[1], mixed.setup.renderer.models[1]
    up, grab = np.array([0, 0, 1]), 0.3 * GIZMO * pose.scale * model.radius
    start, end = (on_page(mixed_tab.client, pose.translation + length * up) for length in (grab, grab - 0.6))
    mixed_tab.page.drag(start, end)
    wait_for(lambda: mixed.shared.state.poses[1].translation[2] < pose.translation[2] - 0.3, "the field to be moved")
    after = settled(mixed_tab.page, mixed_tab.client)
    assert mixed.shared.state.poses[0].key == mixed.setup.state.poses[0].key
    middle = [np.argwhere(np.abs(p - np.array(PALETTE[1])).max(axis=-1) < 30)[:, 0].mean() for p in (before, after)]
    assert middle[1] > middle[0] + 10  # pixels: it has gone down
