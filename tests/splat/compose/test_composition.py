"""Composed pictures: of one model, in any order, moved, scaled, turned; shadows between models."""

import logging
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from posed import METHODS, disc_run, made_run, seen_from

from spacesim import backend
from spacesim.backend import ad
from spacesim.data.errors import InputError
from spacesim.data.images import linear_from_srgb, srgb_from_linear
from spacesim.data.images.tone import Curve
from spacesim.data.records import Camera, Sun
from spacesim.splat.compose import ComposeConfig, GaussianComposition, PlacedRun, Pose
from spacesim.splat.compose.members import display_colors
from spacesim.splat.compose.pose import rotation_about
from spacesim.splat.light.encoding import Encoding
from spacesim.splat.light.model import LightModel
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.run import Run

SUN = Sun.from_angles(40, 35)
EYE = seen_from([3.0, -2.0, 1.5])
PLANES = ("rgb", "alpha", "depth", "visibility", "normal")
TURN = Pose(rotation_about([1, -2, 0.5], 71), [0.7, -0.2, 0.4], 1.0)


def same(one, other, names=PLANES) -> None:
    for name in names:
        a, b = getattr(one, name), getattr(other, name)
        assert (a is None) == (b is None), name
        assert a is None or np.array_equal(a, b), name


def near(one, other, tolerance=2e-3, scale=1.0, names=("rgb", "alpha", "visibility", "depth")) -> None:
    """But for a hundredth of the pixels, where a rounding decides whether a Gaussian is before or behind another."""
    for name in names:
        a, b = (np.asarray(getattr(p, name), float) for p in (one, other))
        off = np.abs(a * (scale if name == "depth" else 1) - b) > tolerance * (scale if name == "depth" else 1)
        assert off.mean() < 0.01, (name, off.mean())


def moved_camera(camera: Camera, pose: Pose) -> Camera:
    """The camera that stands to the moved world as `camera` to the world."""
    place = np.eye(4)
    place[:3, :3] = pose.rotation @ camera.world_from_camera[:3, :3]
    place[:3, 3] = pose.points(camera.position)
    return Camera(place, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)


@pytest.mark.parametrize("method", METHODS)
def test_alone_and_not_posed_a_model_is_what_its_run_gives_to_the_bit(method):
    for antialiased in (False, True):
        run = made_run(method, antialiased=antialiased)
        alone = run.predict(EYE, SUN, normals=True)
        scene = GaussianComposition([PlacedRun(run)])
        composed = scene.predict(EYE, SUN, normals=True)
        same(alone, composed)
        assert run.has_shadows == scene.has_shadows == (alone.visibility is not None)
        assert np.array_equal(composed.id, (alone.alpha >= 0.5).astype(np.int32))


@pytest.mark.parametrize("shadows", ["others", "ratio", "none"])
def test_the_order_of_models_changes_nothing(shadows):
    runs = [made_run("vanilla", 3, 70), made_run("map", 1), made_run("splat", 2, 50)]
    poses = [Pose(), Pose(rotation_about([0, 1, 1], 30), [0.9, 0.6, 0.5], 0.7), Pose(translation=[-0.8, -0.4, -0.6])]
    models = [PlacedRun(run, pose) for run, pose in zip(runs, poses, strict=True)]
    models.append(PlacedRun(runs[1], Pose(translation=[0.2, 0.9, -0.7])))  # a run twice
    first = GaussianComposition(models, ComposeConfig(shadows)).predict(EYE, SUN, normals=True)
    order = [2, 3, 0, 1]
    second = GaussianComposition([models[i] for i in order], ComposeConfig(shadows)).predict(EYE, SUN, normals=True)
    same(first, second)
    numbers = np.array([0, *(1 + np.argsort(order))])
    assert np.array_equal(numbers[first.id], second.id)
    assert set(np.unique(first.id)) >= {1, 2}


@pytest.mark.parametrize("method", METHODS)
def test_moved_and_scaled_together_with_camera_and_sun_nothing_changes(method):
    run = made_run(method)
    alone = run.predict(EYE, SUN)
    names = ("rgb", "alpha", "depth") if alone.visibility is None else ("rgb", "alpha", "depth", "visibility")
    for scale in (1.0, 0.02, 30.0):
        pose = Pose(TURN.rotation, TURN.translation, scale)
        sun = Sun(pose.rotation @ SUN.direction)
        moved = GaussianComposition([PlacedRun(run, pose)]).predict(moved_camera(EYE, pose), sun)
        near(alone, moved, scale=scale, names=names)
        still = GaussianComposition([PlacedRun(run, pose)]).predict(EYE, sun)
        assert np.abs(still.rgb - alone.rgb).max() > 0.05  # the test can fail


def test_a_whole_scene_moved_and_scaled_looks_the_same():
    models = [PlacedRun(made_run("map", 1)), PlacedRun(made_run("splat", 2), Pose(TURN.rotation, [0.9, 0.8, 0.7], 0.6))]
    scene = GaussianComposition([*models, PlacedRun(made_run("vanilla", 3), Pose(translation=[-0.7, -0.6, -0.7]))])
    before = scene.predict(EYE, SUN)
    assert np.abs(before.rgb - scene.shaded(ComposeConfig("none")).predict(EYE, SUN).rgb).max() > 0.05  # shadows matter
    whole = Pose(rotation_about([2, 1, -1], 130), [5.0, -3.0, 2.0], 2.5)
    after = scene.posed([whole.after(model.pose) for model in scene.models])
    near(before, after.predict(moved_camera(EYE, whole), Sun(whole.rotation @ SUN.direction)), scale=2.5)


def test_a_scaled_model_looks_as_large_as_it_is():
    """Depth and silhouette of a disc of radius 0.5, made twice as large."""
    disc, eye = disc_run(0.5), seen_from([0, 0, 6], pixels=200)
    small, large = (GaussianComposition([PlacedRun(disc, Pose(scale=s))]).predict(eye) for s in (1.0, 2.0))
    area = [(picture.alpha > 0.5).sum() for picture in (small, large)]
    assert area[1] / area[0] == pytest.approx(4, rel=0.1)
    assert small.depth[100, 100] == pytest.approx(6, abs=1e-3)
    assert large.depth[100, 100] == pytest.approx(6, abs=1e-3)
    raised = GaussianComposition([PlacedRun(disc, Pose(translation=[0, 0, 2]))]).predict(eye)
    assert raised.depth[100, 100] == pytest.approx(4, abs=1e-3)


# ---- shadows between models ----


def discs(gap: float, small: float = 0.5, sideways: float = 0.0) -> GaussianComposition:
    """A disc of radius 1 in the plane z = 0, and a smaller one over it."""
    over = Pose(translation=[sideways, 0, gap], scale=small)
    return GaussianComposition(
        [PlacedRun(disc_run(1.0), name="below"), PlacedRun(disc_run(1.0, 1), over, name="above")]
    )


def test_a_disc_casts_its_round_shadow():
    """Parallel light from elevation 60: the shadow of a disc of radius 0.5, 1 above, is a disc whose centre is
    1 / tan 60 away; nothing else is dark, and nothing of the upper disc."""
    eye, sun = seen_from([0, 0.0, 40], pixels=160, fov=3.4), Sun.from_angles(180, 60)
    scene = discs(1.0)
    lit = scene.predict(eye, sun)
    x = (np.arange(160) + 0.5 - 80) / eye.fx * 40
    across, along = np.meshgrid(x, -x)  # look_at from above: rows go down
    right, up = eye.world_from_camera[:3, 0], -eye.world_from_camera[:3, 1]
    place = across[..., None] * right + along[..., None] * up
    from_centre = np.linalg.norm(place[..., :2] - [1 / np.tan(np.radians(60)), 0], axis=-1)
    away = np.linalg.norm(place[..., :2], axis=-1)
    below, upper = (lit.id == 1) & (away > 0.6) & (away < 0.9), (lit.id == 2) & (away < 0.44)
    assert (lit.visibility[below & (from_centre < 0.44)] < 0.1).all()
    assert (lit.visibility[below & (from_centre > 0.6)] > 0.9).all()
    assert (below & (from_centre < 0.44)).sum() > 200
    assert upper.sum() > 200
    np.testing.assert_allclose(lit.visibility[upper], 1, atol=1e-3)
    np.testing.assert_allclose(lit.rgb[below & (from_centre < 0.44)], 0, atol=0.12)
    assert lit.rgb[below & (from_centre > 0.6)].min() > 0.85


@pytest.mark.parametrize("method", ["vanilla", "map", "splat"])
def test_a_kilometre_apart_each_keeps_its_own_shadows_to_the_bit_and_aligned_they_get_shadows_of_each_other(method):
    run, disc = made_run(method), disc_run(3.0)
    alone = run.predict(EYE, SUN)
    aside = Pose(translation=np.cross(SUN.direction, [0, 0, 1]) * 1000)
    apart = GaussianComposition([PlacedRun(run), PlacedRun(disc, aside)]).predict(EYE, SUN)
    assert np.array_equal(apart.rgb, alone.rgb)
    assert alone.visibility is None or np.array_equal(apart.visibility, alone.visibility)
    behind = GaussianComposition([PlacedRun(run), PlacedRun(disc, Pose(translation=-1000 * SUN.direction))]).predict(
        EYE, SUN
    )
    assert np.array_equal(behind.rgb, alone.rgb)
    # The disc faces the Sun, a kilometre ahead.
    facing = Pose(rotation_about(np.cross([0, 0, 1], SUN.direction), 55), 1000 * SUN.direction)
    assert np.allclose(facing.rotation @ [0, 0, 1], SUN.direction)
    dark = GaussianComposition([PlacedRun(run), PlacedRun(disc, facing)]).predict(EYE, SUN)
    assert dark.visibility.max() < 0.02
    assert dark.rgb.max() < 0.02 * max(1, alone.rgb.max())
    assert alone.rgb.max() > 0.5
    assert np.array_equal(dark.alpha, alone.alpha)
    # Half of it: a disc whose edge goes through the middle.
    across = np.cross(SUN.direction, [0, 0, 1])
    half = replace_translation(facing, 1000 * SUN.direction + 3.0 * across / np.linalg.norm(across))
    from_sun = seen_from(4 * SUN.direction)
    covered = run.predict(from_sun, SUN).alpha > 0.5
    partly = GaussianComposition([PlacedRun(run), PlacedRun(disc, half)]).predict(from_sun, SUN)
    apart = GaussianComposition([PlacedRun(run), PlacedRun(disc, aside)]).predict(from_sun, SUN)
    assert 0.3 < partly.visibility[covered].sum() / apart.visibility[covered].sum() < 0.6


@pytest.mark.parametrize("method", ["vanilla", "map", "surface"])
def test_shadows_of_others_end_where_they_end_whatever_is_done_against_acne(method):
    """A disc whose edge cuts the model in half: each Gaussian's centre is dark or lit by its side of the edge alone."""
    run, across = made_run(method, 5, count=300), np.cross(SUN.direction, [0, 0, 1])
    across /= np.linalg.norm(across)
    facing = rotation_about(np.cross([0, 0, 1], SUN.direction), 55)
    edge = Pose(facing, 50 * SUN.direction + 3.0 * across)
    scene = GaussianComposition([PlacedRun(run, name="cut"), PlacedRun(disc_run(3.0), edge, "disc")])
    lights = dict(zip((model.name for model in scene.placed), scene.cross_visibility(SUN), strict=True))
    visible, side = np.array(lights["cut"]), run.gaussians.to_numpy()["means"] @ across  # < 0 is beyond the disc
    assert (visible[side > 0.1] < 0.1).all()
    assert (visible[side < -0.2] > 0.9).all()
    assert min((side > 0.1).sum(), (side < -0.2).sum()) > 50
    assert lights["disc"] is None


def replace_translation(pose: Pose, translation) -> Pose:
    return Pose(pose.rotation, translation, pose.scale)


def test_a_half_transparent_model_lets_half_of_the_light_through():
    """Against the closed form: the light that passes a Gaussian's centre line is 1 - opacity."""
    disc = disc_run(1.0)
    veil_arrays = disc_run(1.0, 4).gaussians.to_numpy()
    one = {name: values[:1].copy() for name, values in veil_arrays.items()}
    one["means"][:], one["log_scales"][:], one["logit_opacities"][:] = 0, np.log([2.0, 2.0, 0.01]), 0.0
    veil = replace(disc, gaussians=type(disc.gaussians).from_numpy(one))
    scene = GaussianComposition([PlacedRun(disc), PlacedRun(veil, Pose(translation=[0, 0, 2]))])
    centre = scene.predict(seen_from([0, 0.3, -6]), Sun(np.array([0, 0, 1.0]))).visibility[22:26, 22:26]
    np.testing.assert_allclose(centre, 0.5, atol=0.05)


def test_the_ratio_of_the_thesis_and_what_it_estimates_agree_where_a_model_has_no_shadow_of_its_own():
    eye, sun = seen_from([3, 1, 5], pixels=64), Sun.from_angles(180, 60)
    direct = discs(0.8).predict(eye, sun)
    ratio = discs(0.8).shaded(ComposeConfig("ratio")).predict(eye, sun)
    off = np.abs(direct.visibility - ratio.visibility)[direct.alpha > 0.9]
    assert (off > 0.2).mean() < 0.05
    assert (direct.visibility[direct.alpha > 0.9] < 0.5).mean() > 0.03


def test_shadows_between_models_are_as_the_run_in_the_shadow_was_configured():
    models = [PlacedRun(made_run("map", 1)), PlacedRun(made_run("splat", 2), Pose(translation=[0.5, 0.4, 0.3]))]
    others, ratio = (GaussianComposition(models, ComposeConfig(name)).predict(EYE, SUN) for name in ("others", "ratio"))
    assert np.abs(others.rgb - ratio.rgb).max() > 0.05
    same(others, GaussianComposition(models).predict(EYE, SUN))
    for model in models:
        light = model.run.light
        light.config = replace(light.config, shadow=replace(light.config.shadow, between="ratio"))
    same(ratio, GaussianComposition(models).predict(EYE, SUN))


def test_shadows_off_are_off():
    scene = discs(1.0).shaded(ComposeConfig("none"))
    assert scene.predict(EYE).visibility is None
    assert not scene.relightable
    assert not scene.has_shadows
    assert discs(1.0).relightable
    assert discs(1.0).has_shadows


# ---- runs that differ ----


def test_all_methods_stand_together():
    models = [
        PlacedRun(made_run(method, seed, 30 + 10 * seed, degree=seed % 4, antialiased=seed % 2 == 1),
               Pose(translation=1.2 * np.array([seed % 3 - 1, seed // 3 - 1, 0])))
        for seed, method in enumerate(METHODS)
    ]  # fmt: skip
    scene = GaussianComposition(models)
    picture = scene.predict(seen_from([0, -1, 6], pixels=64), SUN, normals=True)
    for name in PLANES:
        assert np.isfinite(getattr(picture, name)).all(), name
    assert len(np.unique(picture.id)) == len(METHODS) + 1
    assert scene.gaussian_count == sum(model.run.gaussian_count for model in models)
    assert scene.model_bytes == 1000 * len(METHODS)


def test_each_model_keeps_its_own_filter():
    """Runs with and without anti-aliasing, beside each other: each as alone."""
    eye = seen_from([0, 0, 60], pixels=40)
    poses = Pose(translation=[-8.0, 0, 0]), Pose(translation=[8.0, 0, 0])
    runs = made_run("vanilla", 1, antialiased=True), made_run("vanilla", 1, antialiased=False)
    both = GaussianComposition(
        [PlacedRun(run, pose) for run, pose in zip(runs, poses, strict=True)], ComposeConfig("none")
    ).predict(eye)
    for run, pose in zip(runs, poses, strict=True):
        alone = GaussianComposition([PlacedRun(run, pose)]).predict(eye)
        mine = alone.alpha > 0
        assert np.array_equal(both.rgb[mine], alone.rgb[mine])
    sums = [
        GaussianComposition([PlacedRun(run, pose)]).predict(eye).alpha.sum()
        for run, pose in zip(runs, poses, strict=True)
    ]
    assert sums[0] < 0.8 * sums[1]


def linear_run(seed: int, radiance: bool) -> Run:
    """The linear run, whose field gives shares of white, or of the peak, as if it had learned radiance."""
    run = made_run("linear", seed)
    light = run.light
    config = replace(light.config, radiance=radiance, encoded=False)
    return replace(run, light=LightModel(config, light.weights, light.frame, light.embeddings))


def test_runs_that_learned_radiance_keep_their_light():
    pose, below = Pose(translation=[0, 2.5, 0]), 1 / 32
    both, plain = (
        GaussianComposition([PlacedRun(linear_run(1, radiance)), PlacedRun(linear_run(2, radiance), pose)])
        for radiance in (True, False)
    )
    seen = both.predict(EYE, SUN, exposure=-5.0)
    assert (seen.linear.max() > 0.1 * 16 * below, seen.id.max()) == (True, 2)
    np.testing.assert_allclose(srgb_from_linear(seen.linear), seen.rgb, atol=1e-5)
    colors = linear_from_srgb(plain.predict(EYE, SUN).rgb)  # the same shares, there of white
    np.testing.assert_allclose(seen.linear, 16 * below * colors, atol=2e-4)
    np.testing.assert_allclose(plain.predict(EYE, SUN).linear, colors, atol=2e-4)  # white is 1
    mixed = GaussianComposition([PlacedRun(linear_run(1, True)), PlacedRun(made_run("vanilla", 2), pose)]).predict(
        EYE, SUN
    )
    assert mixed.linear is None
    light = np.array([0.001, 0.02, 0.3, 1])  # beyond white is white before it is blended with sRGB values
    (shown,) = display_colors([ad.Float(light)], Curve("srgb", 0.0, 16.0), None)
    np.testing.assert_allclose(np.array(shown), srgb_from_linear(16 * light), atol=1e-5)


def test_linear_and_srgb_runs_blend_as_srgb():
    """Coverage is as alone; colours are means of encoded ones, where alone they are encoded means."""
    linear, other = made_run("linear", 1), made_run("vanilla", 2)
    pose = Pose(translation=[100.0, 0, 0])
    alone = linear.predict(EYE, SUN)
    mixed = GaussianComposition([PlacedRun(linear), PlacedRun(other, pose)]).predict(EYE, SUN)
    assert np.array_equal(alone.alpha, mixed.alpha)
    assert not np.array_equal(alone.rgb, mixed.rgb)
    opaque = alone.alpha > 0.99
    # Means of encoded colours are between: at most the encoding of the mean (the curve is concave).
    assert (mixed.rgb[opaque] <= alone.rgb[opaque] + 1e-4).all()
    assert np.abs(mixed.rgb - alone.rgb)[opaque].mean() < 0.1
    np.testing.assert_allclose(srgb_from_linear(linear_from_srgb(alone.rgb)), alone.rgb, atol=1e-5)


def test_objects_are_numbered_and_hide_each_other():
    eye = seen_from([0, 0, 8], pixels=64)
    scene = GaussianComposition(
        [
            PlacedRun(disc_run(1.0), Pose(translation=[0, 0, 1])),
            PlacedRun(disc_run(1.0, 1), Pose(translation=[0.9, 0, 0])),
        ]
    )
    ids = scene.predict(eye, Sun(np.array([0, 0.2, 1]))).id
    swapped = scene.posed([scene.models[1].pose, scene.models[0].pose]).predict(eye, Sun(np.array([0, 0.2, 1]))).id
    assert ids[32, 32] == 1
    assert swapped[32, 32] == 2
    assert (ids[:3] == 0).all()
    assert set(np.unique(ids)) == {0, 1, 2}


# ---- interaction ----


def test_moving_anything_compiles_nothing_and_repeats_to_the_bit():
    models = [PlacedRun(made_run("map", 1)), PlacedRun(made_run("splat", 2), Pose(translation=[0.6, 0.5, 0.5]))]
    scene = GaussianComposition([*models, PlacedRun(made_run("vanilla", 3), Pose(translation=[-0.6, -0.5, -0.5]))])

    def frames():
        for k in range(4):
            turned = Pose(rotation_about([0, 0, 1], 40 * k), [0.6, 0.5 + 0.02 * k, 0.5], 1 + 0.1 * k)
            yield scene.moved(1, turned).predict(EYE, SUN)
            yield scene.predict(EYE, Sun.from_angles(40 + 5 * k, 35))
            yield scene.predict(seen_from([3.0, -2.0 + 0.1 * k, 1.5]), SUN)

    first = list(frames())
    warm = backend.recordings()
    second = list(frames())
    assert backend.recordings() == warm
    for one, other in zip(first, second, strict=True):
        same(one, other)
    fresh = GaussianComposition(scene.models)
    same(fresh.predict(EYE, SUN), scene.predict(EYE, SUN))  # what was kept was right


def test_recordings_serve_numpy_arrays_of_any_alignment():
    """On LLVM one array in four begins at a multiple of 64 bytes, and kernels of such memory are others."""
    scene, kept = GaussianComposition([PlacedRun(made_run("map", 1)), PlacedRun(made_run("vanilla", 3))]), []
    encoding, arrays = Encoding("harmonics", 2), made_run("map", 1).gaussians.to_numpy()
    made = {
        "camera": lambda k: Pinhole.of(seen_from([3.0 + k, 0, 1])).values,
        "crop": lambda k: Pinhole.of(EYE).cropped(k % 8, 1, 8, 8).values,
        "Sun": lambda k: encoding.of_one((0.0, 0.1 * k, 1.0)),
        "poses": lambda k: scene.moved(1, Pose(translation=[0.1 * k, 0, 0])).in_world().means.x,
        "opacities": lambda k: Gaussians.from_numpy(arrays).logit_opacities,
        "features": lambda k: Gaussians.from_numpy(arrays).features,
    }
    for name, make in made.items():
        frozen = dr.freeze(lambda values: values * 2)
        dr.eval([frozen(make(k)) for k in range(2)])
        before = backend.recordings()
        for k in range(2, 60):
            kept.append(make(k))
            dr.eval(frozen(kept[-1]))
        assert frozen.n_recordings == 1, name
        assert backend.recordings() == before, name


@pytest.mark.parametrize("method", ["relight", "map", "linear", "surface"])
def test_colors_are_recorded_once_for_pictures_of_all_sizes(method):
    run = made_run(method, 4)
    camera = Pinhole.of(EYE)
    colors = [np.array(color) for color in run.light.shade_picture(run.gaussians, camera, SUN.direction)[0]]
    warm = backend.recordings()
    for size in (16, 50, 33):
        other = run.light.shade_picture(run.gaussians, replace(camera, width=size, height=size + 9), SUN.direction)[0]
        assert all(np.array_equal(one, np.array(two)) for one, two in zip(colors, other, strict=True))
    assert backend.recordings() == warm


def test_only_what_is_asked_for_is_computed(monkeypatch):
    scene = GaussianComposition(
        [PlacedRun(made_run("map", 1)), PlacedRun(made_run("vanilla", 3), Pose(translation=[0.5, 0.5, 0.5]))]
    )
    monkeypatch.setattr(GaussianComposition, "_shade_members", lambda *_: pytest.fail("computed light for nothing"))
    drawn = scene.draw(EYE, None, ["depth", "id", "normal"])
    assert drawn.image("depth").shape == drawn.image("id").shape == (48, 48)
    assert drawn.image("normal").shape == (48, 48, 3)
    for name in ("rgb", "visibility", "median_depth"):
        with pytest.raises(ValueError, match="asked for"):
            drawn.image(name)
    with pytest.raises(ValueError, match="outputs"):
        scene.draw(EYE, SUN, ["color"])


def test_unchanged_visibility_is_not_computed_again(monkeypatch):
    """A camera that moves leaves all visibility; a model that moves with the world's Sun, that of the others."""
    asked = []
    shadows = LightModel.shadows

    def counted(self, *arguments, **named):
        asked.append(self)
        return shadows(self, *arguments, **named)

    monkeypatch.setattr(LightModel, "shadows", counted)
    one, other = made_run("map", 1), made_run("splat", 2)
    scene = GaussianComposition([PlacedRun(one), PlacedRun(other, Pose(translation=[0.6, 0.5, 0.5]))])
    scene.predict(EYE, SUN)
    assert asked == [one.light, other.light] or asked == [other.light, one.light]
    scene.predict(seen_from([2.0, 2.0, 1.5]), SUN)
    scene.moved(1, Pose(translation=[0.7, 0.5, 0.5])).predict(EYE, SUN)  # the Sun is at infinity
    assert len(asked) == 2
    scene.moved(1, Pose(rotation_about([0, 0, 1], 30), [0.7, 0.5, 0.5])).predict(EYE, SUN)
    assert asked[2:] == [other.light]
    scene.predict(EYE, Sun.from_angles(50, 35))
    assert len(asked) == 5


# ---- what cannot be ----


def test_wrong_scenes_are_refused(caplog):
    with pytest.raises(InputError, match="models: expected at least one"):
        GaussianComposition([])
    with pytest.raises(InputError, match="shadows: expected one of"):
        ComposeConfig("some")
    scene = GaussianComposition([PlacedRun(made_run("map"))])
    with pytest.raises(InputError, match=r"runs/map0: expected the Sun"):
        scene.predict(EYE)
    with caplog.at_level(logging.INFO, "spacesim"):
        GaussianComposition([PlacedRun(made_run("vanilla"), name="old"), PlacedRun(made_run("map"))])
    assert len([line for line in caplog.messages if "old: knows the light" in line]) == 1
    caplog.clear()
    with caplog.at_level(logging.INFO, "spacesim"):
        GaussianComposition([PlacedRun(made_run("linear")), PlacedRun(made_run("map"))])
    assert any("blended as sRGB" in line for line in caplog.messages)


def test_models_of_one_gaussian_and_of_none():
    one, other = made_run("vanilla", 1, count=1), made_run("map", 2, count=1)
    for run in (one, other):
        for k in range(3):
            shifted = GaussianComposition([PlacedRun(run, Pose(translation=[0.1 * k, 0, 0]))]).predict(EYE, SUN)
            back = run.predict(seen_from([3.0 - 0.1 * k, -2.0, 1.5], [-0.1 * k, 0, 0]), SUN)
            np.testing.assert_allclose(shifted.rgb, back.rgb, atol=1e-5)
    empty = replace(one, gaussians=made_run("vanilla", 1, count=0).gaussians)
    assert GaussianComposition([PlacedRun(empty)]).predict(EYE, SUN).alpha.max() == 0
    bare = replace(other, gaussians=empty.gaussians)
    assert GaussianComposition([PlacedRun(bare)]).predict(EYE, SUN).visibility.max() == 0
    beside = GaussianComposition(
        [PlacedRun(empty), PlacedRun(other), PlacedRun(empty, Pose(translation=[0, 0, 1]))]
    ).predict(EYE, SUN)
    assert np.array_equal(beside.rgb, other.predict(EYE, SUN).rgb)
    assert set(np.unique(beside.id)) <= {0, 2}
