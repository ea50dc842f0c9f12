"""Pictures in every mode, how fast they are wanted, and what nonsense does to them."""

from dataclasses import replace

import numpy as np
import pytest
from posed import made_run

from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at
from spacesim.data.images import linear_from_srgb, srgb_from_linear
from spacesim.data.records import Camera
from spacesim.eval.pictures import error_colors
from spacesim.learning.pictures import LIT, SHADOWED
from spacesim.splat.compose import GaussianComposition, PlacedRun, Pose
from spacesim.viewer.drawing.frames import (
    BUDGET,
    MIN_SIDE,
    SHARES,
    STEP,
    WARM,
    ResolutionControl,
    draw_frame,
    picture_size,
)
from spacesim.viewer.drawing.paint import (
    NEEDED,
    PALETTE,
    Planes,
    add_color_bar,
    compare_pictures,
    depth_range,
    paint,
)
from spacesim.viewer.drawing.scene_renderer import SceneRenderer
from spacesim.viewer.state import (
    MODES,
    DisplaySettings,
    SceneState,
    ViewerCamera,
    clamp,
    parse_viewer_camera,
    pose_from_handle,
)


def pixel(frame, view, point):
    """Colour [3] of the pixel that shows a point of the world."""
    height, width = frame.picture.shape[:2]
    camera = view.camera(width, height)
    x, y, z = camera.camera_from_world[:3, :3] @ point + camera.camera_from_world[:3, 3]
    return frame.picture[int(camera.fy * y / z + camera.cy), int(camera.fx * x / z + camera.cx)].astype(int)


def test_colours_in_linear_light_are_exposed(renderer, state, view):
    below = SceneRenderer(GaussianComposition([PlacedRun(made_run("linear"), Pose())]))
    stand = SceneState((Pose(),), state.sun)
    assert (below.is_linear, renderer.is_linear) == (True, False)
    camera = view.camera(64, 48)
    dark, light = (below.draw(stand, camera, "colour", exposure=exposure).rgb for exposure in (-1.0, 0.0))
    assert light.max() > 0.2
    np.testing.assert_allclose(linear_from_srgb(dark), linear_from_srgb(light) / 2, atol=1e-5)
    pictures = [draw_frame(below, stand, view, DisplaySettings(side=256, exposure=ev)).picture for ev in (-1.0, 0.0)]
    assert pictures[0].mean() < 0.9 * pictures[1].mean()
    depths = [draw_frame(below, stand, view, DisplaySettings("depth", side=256, exposure=ev)) for ev in (-1.0, 0.0)]
    assert np.array_equal(depths[0].picture, depths[1].picture)


def test_colors_are_where_the_models_are(renderer, state, view):
    frame = draw_frame(renderer, state, view, DisplaySettings(side=256))
    red, green, _ = pixel(frame, view, np.array([0.0, 1, 0]))
    assert red > 150 > 60 > green
    red, green, _ = pixel(frame, view, np.array([0.0, -1, 0]))
    assert green > 150 > 60 > red
    assert not frame.picture[:5].any()  # the background is black
    assert frame.note == ""


def test_a_pixel_is_one_place_whatever_runs_were_trained_with(renderer, state, view):
    models = [
        replace(model, run=replace(model.run, config={**model.run.config, "supersample": 2}))
        for model in renderer.composition.models
    ]
    finer = SceneRenderer(GaussianComposition(models))
    assert finer.composition.supersample == 2
    pictures = [draw_frame(of, state, view, DisplaySettings(side=128)).picture for of in (renderer, finer)]
    np.testing.assert_array_equal(*pictures)


def test_a_moved_model_is_somewhere_else(renderer, state, view):
    moved = state.with_pose(0, Pose(translation=np.array([0.0, 1, 0.9])))
    frame = draw_frame(renderer, moved, view, DisplaySettings(side=256))
    assert pixel(frame, view, np.array([0.0, 1, 0])).max() < 90
    assert pixel(frame, view, np.array([0.0, 1, 0.9]))[0] > 150


def test_a_scaled_model_is_larger(renderer, state, view):
    edge = np.array([0.0, 1, 0.8])
    assert pixel(draw_frame(renderer, state, view, DisplaySettings(side=256)), view, edge).max() == 0
    scaled = state.with_pose(0, Pose(translation=np.array([0.0, 1, 0]), scale=2.0))
    assert pixel(draw_frame(renderer, scaled, view, DisplaySettings(side=256)), view, edge)[0] > 150


def test_depth_is_scaled_between_what_is_seen(renderer, state, view):
    frame = draw_frame(renderer, state, view, DisplaySettings("depth", side=256))
    near, far = frame.depths
    assert 4.3 < near < 4.6  # 5 m to the middle, radius 0.5
    assert 4.8 < far < 5.3
    middle = pixel(frame, view, np.array([0.0, 1, 0]))
    rim = pixel(frame, view, np.array([0.0, 1, 0.46]))
    assert middle.sum() > rim.sum() > 0  # near is bright
    assert depth_range(Planes(np.zeros((4, 4)), depth=np.zeros((4, 4)))) is None


def test_ids_have_a_color_each(renderer, state, view):
    frame = draw_frame(renderer, state, view, DisplaySettings("object id", side=256))
    assert tuple(pixel(frame, view, np.array([0.0, 1, 0]))) == PALETTE[0]
    assert tuple(pixel(frame, view, np.array([0.0, -1, 0]))) == PALETTE[1]
    found = {tuple(color) for color in frame.picture.reshape(-1, 3)}
    assert found == {(0, 0, 0), PALETTE[0], PALETTE[1]}


def test_normals_look_at_the_camera(renderer, state, view):
    frame = draw_frame(renderer, state, view, DisplaySettings("normals", side=256))
    normal = 2 * pixel(frame, view, np.array([0.0, 1, 0])) / 255 - 1
    assert normal[0] < 0.1  # the camera is on the -x side


def test_accumulation_is_white_where_it_is_opaque(renderer, state, view):
    frame = draw_frame(renderer, state, view, DisplaySettings("accumulation", side=256))
    assert pixel(frame, view, np.array([0.0, 1, 0])).min() > 240
    assert frame.picture[0, 0].max() == 0


def test_models_shade_each_other_in_visibility(renderer, state, view):
    """One ball above the other under a Sun overhead."""
    above = state.with_pose(1, Pose(translation=np.array([0.0, 1, 1.4])))
    frame = draw_frame(renderer, above, view, DisplaySettings("visibility", side=256))
    lit, shaded = (pixel(frame, view, np.array([0.0, 1, z])) for z in (1.7, 0.3))
    assert lit.sum() > 2 * shaded.sum() > 0


def test_ellipsoids_have_dark_edges_and_hard_rims(renderer, state, view):
    soft = draw_frame(renderer, state, view, DisplaySettings("accumulation", side=512)).planes.alpha
    frame = draw_frame(renderer, state, view, DisplaySettings("ellipsoids", side=512))
    alpha = frame.planes.alpha
    between = (alpha > 0.02) & (alpha < 0.98)
    assert between.sum() < 0.3 * ((soft > 0.02) & (soft < 0.98)).sum()
    red = frame.picture[..., 0][(alpha > 0.99) & (frame.picture[..., 1] < 60)].astype(int)
    assert (red > 120).sum() > 500
    assert (red < 60).sum() > 200  # edges between neighbours


@pytest.mark.parametrize("mode", MODES)
def test_every_mode_has_a_picture_from_anywhere(renderer, state, mode):
    """Also from within a model, and where nothing is to be seen."""
    within = ViewerCamera(look_at([0.0, 1, 0], [1.0, 1, 0]), np.radians(90), 100, 80)
    away = ViewerCamera(look_at([50.0, 0, 0], [100.0, 0, 0]), np.radians(40), 100, 80)
    for one in (within, away):
        frame = draw_frame(renderer, state, one, DisplaySettings(mode, side=256))
        assert frame.picture.shape == (96, 128, 3)
        assert frame.picture.dtype == np.uint8


def test_what_no_model_predicts_is_reported(renderer, state, view):
    alone = SceneRenderer(GaussianComposition(renderer.composition.models[:1]))
    frame = draw_frame(alone, SceneState(state.poses[:1], state.sun), view, DisplaySettings("visibility", side=256))
    assert "no visibility" in frame.note
    assert not frame.picture.any()


@pytest.mark.parametrize(("width", "height"), [(640, 480), (1, 1), (8192, 1), (1921, 1079), (17, 4000)])
@pytest.mark.parametrize("share", SHARES)
def test_sides_are_bounded_and_few(width, height, share):
    pose = np.eye(4)
    found = picture_size(ViewerCamera(pose, 1.0, width, height), 1024, share)
    assert all(MIN_SIDE <= side <= 1024 and side % STEP == 0 for side in found)


def test_pixels_may_be_oblong_but_the_picture_is_the_windows():
    view = ViewerCamera(np.eye(4), np.radians(40), 1000, 300)
    wide, squeezed = view.camera(1000, 300), view.camera(512, 512)
    assert wide.fx == pytest.approx(wide.fy)
    for camera in (wide, squeezed):
        assert 0.5 * camera.height / camera.fy == pytest.approx(np.tan(np.radians(20)))
        assert 0.5 * camera.width / camera.fx == pytest.approx(np.tan(np.radians(20)) * 1000 / 300)


def test_pace_slows_down_and_recovers():
    pace = ResolutionControl()
    for _ in range(WARM):
        pace.record_time(1.0, (512, 512), 10 * BUDGET)  # compiling
    assert pace.share == 1.0
    pace.record_time(1.0, (512, 512), 1.5 * BUDGET)
    assert pace.share == SHARES[1]
    for _ in range(WARM + 1):
        pace.record_time(SHARES[1], (384, 384), 0.6 * BUDGET)
    assert pace.share == SHARES[1]  # the larger one would take 1.07 of the budget
    pace.record_time(SHARES[1], (384, 384), 0.3 * BUDGET)
    assert pace.share == 1.0
    for size, share in zip(((9, 9), (8, 8), (7, 7), (6, 6), (5, 5), (4, 4)), (*SHARES, SHARES[-1]), strict=True):
        for _ in range(WARM + 1):
            pace.record_time(share, size, 100.0)
    assert pace.share == SHARES[-1]


GOOD = ([1.0, 0, 0, 0], [0.0, 0, -3], 0.7, 640, 480)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        (0, [0, 0, 0, 0]),
        (0, [1, 0, 0]),
        (0, "abcd"),
        (0, [float("nan")] * 4),
        (0, [1e300] * 4),
        (0, None),
        (1, [float("inf"), 0, 0]),
        (1, [1e30, 0, 0]),
        (1, [[1], [2], [3]]),
        (1, {"x": 1}),
        (2, 0.0),
        (2, -1),
        (2, 4.0),
        (2, "wide"),
        (2, float("nan")),
        (3, 0),
        (3, -5),
        (3, 10**9),
        (3, float("inf")),
        (4, None),
        (4, 10**40),
    ],
)
def test_invalid_views_are_dropped(field, value):
    assert parse_viewer_camera(*GOOD) is not None
    bad = list(GOOD)
    bad[field] = value
    assert parse_viewer_camera(*bad) is None


def test_invalid_display_settings_become_valid():
    settings = DisplaySettings("no such mode", "sideways", float("nan"), 10**9, "many", 99)
    assert settings == DisplaySettings("colour", "off", 0.5, 2048, 32, 8.0)
    assert DisplaySettings(wipe=7).wipe == 1
    assert DisplaySettings(side=-4).side == 256
    assert clamp("x", 0, 1, 0.25) == 0.25
    assert clamp(float("inf"), 0, 1, 0.25) == 1


@pytest.mark.parametrize("wxyz", [[0, 0, 0, 0], [1, 0, 0], "abcd", [float("nan"), 0, 0, 0], None])
def test_a_pose_survives_nonsense(wxyz):
    pose = Pose(translation=np.array([1.0, 2, 3]), scale=2.0)
    assert pose_from_handle(pose, wxyz, [0, 0, 0]) is pose
    assert pose_from_handle(pose, [1, 0, 0, 0], [float("inf"), 0, 0]) is pose
    moved = pose_from_handle(pose, [1, 0, 0, 0], [4, 5, 6])
    assert moved.scale == 2.0
    assert list(moved.translation) == [4, 5, 6]


def test_a_view_must_be_a_camera():
    with pytest.raises(InputError):
        ViewerCamera(np.diag([1.0, 1, -1, 1]), 1.0, 100, 100)  # no rotation


def test_comparisons():
    picture, truth = np.full((40, 60, 3), 100, np.uint8), np.full((40, 60, 3), 200, np.uint8)
    known = np.ones((40, 60), bool)
    known[:, :10] = False
    wiped = compare_pictures(picture, truth, known, "wipe", 0.5)
    assert wiped[0, 40, 0] == 100
    assert wiped[0, 20, 0] == 200
    assert wiped[0, 5, 0] not in (100, 200)  # nothing is known there
    assert (compare_pictures(picture, truth, known, "wipe", 0.0) == picture).all()
    beside = compare_pictures(picture, truth, known, "beside", 0.5)
    assert beside[20, 15, 0] == 200
    assert beside[20, 45, 0] == 100
    assert not beside[:9].any()
    same = compare_pictures(picture, picture, known, "difference", 0.5)
    assert not same[:, 10:].any()
    other = compare_pictures(picture, truth, known, "difference", 0.5)
    assert other[:, 10:].min() > 200  # 0.39 is beyond the bright end
    assert (other[:, :10] == same[:, :10]).all()


def test_the_scale_of_depths_names_its_ends():
    black = np.zeros((200, 300, 3), np.uint8)
    drawn = add_color_bar(black, (1.5, 8.25))
    assert drawn[:150].max() == 0
    assert drawn[185].any()
    assert (add_color_bar(black[:20], (1, 2)) == 0).all()


def test_planes_that_are_not_finite_are_painted():
    bad = np.full((8, 8), np.nan, np.float32)
    for mode in MODES:
        rows = np.stack([bad] * 3, -1)
        of_rows = dict.fromkeys(("rgb", "normal", "albedo", "specular"), rows)
        planes = Planes(bad, depth=bad, visibility=bad, roughness=bad, metallic=bad, **of_rows)
        picture = paint(planes, mode)
        assert picture is None or picture.shape == (8, 8, 3)


def test_a_camera_of_the_view_is_the_datas(view):
    camera = view.camera(640, 480)
    assert isinstance(camera, Camera)
    assert np.allclose(camera.position, [-5, 0, 0])


def test_a_scene_that_cannot_be_drawn_is_black_and_says_why(renderer, state, view):
    """Models that shade each other, and no Sun."""
    frame = draw_frame(renderer, SceneState(state.poses, None), view, DisplaySettings(side=256))
    assert not frame.picture.any()
    assert frame.note.startswith("no picture: ")
    assert "Sun" in frame.note


@pytest.mark.parametrize("mode", MODES)
def test_pictures_are_what_their_formulas_say(mode):
    """In double precision, pixel by pixel."""
    rng = np.random.default_rng(3)
    shape = 24, 40
    alpha = np.where(rng.random(shape) < 0.3, 0, rng.uniform(-0.1, 1.1, shape)).astype(np.float32)
    depth = np.where(rng.random(shape) < 0.3, 0, rng.uniform(2, 9, shape)).astype(np.float32)
    normal = rng.normal(size=(*shape, 3)).astype(np.float32)
    normal[rng.random(shape) < 0.3] = 0
    planes = Planes(
        alpha,
        rgb=rng.uniform(-0.2, 1.3, (*shape, 3)).astype(np.float32),
        depth=depth,
        visibility=rng.uniform(-0.2, 1.3, shape).astype(np.float32),
        normal=normal,
        albedo=rng.uniform(-0.2, 1.3, (*shape, 3)).astype(np.float32),
        specular=rng.uniform(-0.2, 1.3, (*shape, 3)).astype(np.float32),
        roughness=rng.uniform(-0.2, 1.3, shape).astype(np.float32),
        metallic=rng.uniform(-0.2, 1.3, shape).astype(np.float32),
        object_id=rng.integers(0, 20, shape).astype(np.int32),
    )
    near, far = 3.0, 7.0
    picture = paint(planes, mode, (near, far))
    assert (picture.shape, picture.dtype) == ((*shape, 3), np.uint8)
    for i, j in np.ndindex(shape):
        cover, value = min(max(float(alpha[i, j]), 0), 1), getattr(planes, NEEDED[mode])[i, j]
        if mode in ("colour", "ellipsoids"):
            expected = 255 * np.clip(value.astype(float), 0, 1)
        elif mode == "accumulation":
            expected = np.full(3, 255 * cover)
        elif mode == "depth":
            share = min(max((float(value) - near) / (far - near), 0), 1)
            expected = cover * (value > 0) * error_colors(np.array(1 - 0.85 * share)).astype(float)
        elif mode == "visibility":
            seen = min(max(float(value), 0), 1)
            expected = cover * (seen * np.array(LIT, float) + (1 - seen) * np.array(SHADOWED, float))
        elif mode == "normals":
            expected = np.clip(255 * cover * (0.5 + 0.5 * value.astype(float)) * value.any(), 0, 255)
        elif mode in ("roughness", "metallic"):
            expected = np.full(3, 255 * cover * min(max(float(value), 0), 1))
        elif mode in ("albedo", "specular"):
            expected = 255 * cover * srgb_from_linear(value.astype(float))
        else:
            expected = np.array(PALETTE[(value - 1) % 7] if value else (0, 0, 0))
        levels = 6 if mode == "depth" else 1  # both colour maps have steps
        assert np.abs(picture[i, j] - expected).max() <= levels, (i, j)
