"""Scenes of Gaussians and radiance fields: neither changes the other where it is not, order, shadows both ways."""

import json
from dataclasses import replace

import numpy as np
import pytest
from made_field import box_field, made_field
from posed import disc_run, made_run, seen_from
from tiny import pair_scene

from spacesim.data.errors import InputError
from spacesim.data.images import read_png
from spacesim.data.records import Sun
from spacesim.methods import compose, load_scene
from spacesim.mixed.scene import MixedComposition
from spacesim.splat.compose import ComposeConfig, PlacedRun, Pose, save_scene
from spacesim.splat.compose.pose import rotation_about

EYE = seen_from([3.0, -2.0, 1.5])
SUN = Sun.from_angles(40, 60)
PLANES = ("rgb", "alpha", "depth", "visibility", "normal", "id")
RED = (0.9, 0.2, 0.1)


@pytest.fixture(scope="module")
def box():
    return box_field((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5), color=RED)


@pytest.fixture(scope="module")
def empty():
    return made_field(lambda points: np.zeros(len(points), bool), name="empty")


def scene(*models, shadows: str = "none"):
    placed = [PlacedRun(run, pose, f"model-{k}") for k, (run, pose) in enumerate(models)]
    return compose(placed, ComposeConfig(shadows))


def near(one, other, tolerance=1e-5, names=PLANES) -> None:
    for name in names:
        a, b = getattr(one, name), getattr(other, name)
        assert (a is None) == (b is None), name
        if a is not None:
            if name == "normal":  # of what is hardly there it is rounding
                solid = one.alpha > 1e-2
                a, b = a[solid], b[solid]
            np.testing.assert_allclose(a, b, atol=5 * tolerance if name == "normal" else tolerance, err_msg=name)


@pytest.mark.parametrize("method", ["vanilla", "map", "linear"])
def test_an_empty_field_changes_nothing(empty, method):
    for antialiased in (False, True):
        run = made_run(method, antialiased=antialiased)
        mixed = scene((run, Pose()), (empty, Pose()))
        assert isinstance(mixed, MixedComposition)
        found, alone = mixed.predict(EYE, SUN, normals=True), run.predict(EYE, SUN, normals=True)
        if method == "linear":  # blended as sRGB values beside a field
            alone = scene((run, Pose()), (made_run("vanilla", 7, count=0), Pose())).predict(EYE, SUN, normals=True)
            near(found, alone, 2e-5, ("alpha", "depth", "visibility", "normal"))
            continue
        near(found, alone, 1e-5, PLANES[:-1])
        np.testing.assert_array_equal(found.id, alone.alpha >= 0.5)


def test_gaussians_out_of_sight_change_nothing(box):
    away = (made_run("vanilla"), Pose(translation=[30.0, -20.0, 15.0]))
    mixed, alone = scene((box, Pose()), away), scene((box, Pose()))
    near(mixed.predict(EYE, normals=True), alone.predict(EYE, normals=True))
    assert alone.predict(EYE).alpha.mean() > 0.1
    none = (made_run("vanilla", 7, count=0), Pose())
    near(scene((box, Pose()), none).predict(EYE, normals=True), alone.predict(EYE, normals=True))


def test_order_by_depth_follows_the_camera(box):
    """An opaque disc beside the box hides it from one side and is hidden from the other; cut through by it, each shows
    where it is nearer."""
    disc = disc_run(0.9)
    beside = scene((disc, Pose(rotation_about([0, 1, 0], 90), [1.5, 0.0, 0.0])), (box, Pose()))
    front, back = (beside.predict(seen_from([x, 0.0, 0.0])) for x in (5.0, -5.0))
    assert (front.id[24, 24], back.id[24, 24]) == (1, 2)
    np.testing.assert_allclose(back.rgb[24, 24], RED, atol=0.01)
    assert front.rgb[24, 24].min() > 0.9
    np.testing.assert_allclose([front.depth[24, 24], back.depth[24, 24]], [3.5, 4.5], atol=0.05)

    across = scene((disc, Pose()), (box, Pose())).predict(seen_from([5.0, 0.0, 3.0], pixels=96))
    assert set(np.unique(across.id)) == {0, 1, 2}
    middle = across.id[:, 48]
    order = [number for k, number in enumerate(middle) if number and (k == 0 or middle[k - 1] != number)]
    assert order == [1, 2, 1] or order == [2, 1, 2] or order == [1, 2, 1, 2], order  # disc, box, disc, box below it


def test_two_fields_and_gaussians_in_front_inside_and_behind(box):
    """Along one ray: a thin fog with a half-transparent disc in it, and a wall behind."""
    fog = box_field((-0.9, -0.9, -0.9), (0.9, 0.9, 0.9), density=1.0, color=(0.2, 0.2, 0.9), name="fog")
    wall = box_field((-0.9, -0.9, -0.9), (0.9, 0.9, 0.9), density=2000.0, color=(0.1, 0.9, 0.1), name="wall")
    disc = disc_run(0.9)
    veil = replace(disc, gaussians=_with_opacity(disc.gaussians, 0.02))
    turn = rotation_about([0, 1, 0], 90)
    camera = seen_from([6.0, 0.0, 0.0])
    both = [(fog, Pose()), (wall, Pose(translation=[-3.0, 0, 0]))]
    for x in (-0.6, 0.0, 0.6, 1.5, -1.5):
        mixed = scene((veil, Pose(turn, [x, 0.0, 0.0])), *both).predict(camera)
        alone = scene((veil, Pose(turn, [x, 0.0, 0.0]))).predict(camera)
        share = alone.alpha[24, 24]
        assert 0.2 < share < 0.95
        length = min(max(0.9 - x, 0), 1.8)  # of fog before the disc; a density per side of the box, of two metres
        before, rest = np.exp(-0.5 * length), np.exp(-0.5 * (1.8 - length))
        expected = (1 - before) * np.array([0.2, 0.2, 0.9]) + before * alone.rgb[24, 24]
        expected += before * (1 - share) * ((1 - rest) * np.array([0.2, 0.2, 0.9]) + rest * np.array([0.1, 0.9, 0.1]))
        np.testing.assert_allclose(mixed.rgb[24, 24], expected, atol=0.03, err_msg=str(x))  # fog's rim


def _with_opacity(gaussians, opacity: float):
    arrays = gaussians.to_numpy()
    arrays["logit_opacities"][:] = np.log(opacity / (1 - opacity))
    return type(gaussians).from_numpy(arrays)


@pytest.fixture(scope="module")
def floor():
    return box_field((-0.9, -0.9, -0.2), (0.9, 0.9, 0.0), density=2000.0, color=(0.8, 0.8, 0.8), name="floor")


def test_gaussians_cast_shadows_on_a_field(floor):
    """A disc over a floor, the Sun overhead: round, dark, of its own size; none without shadows."""
    models = (disc_run(0.4), Pose(translation=[0, 0, 1.5])), (floor, Pose())
    camera, sun = seen_from([0.01, -4.0, 1.0], pixels=96), Sun(np.array([0.0, 0.0, 1.0]))
    lit, shaded = (scene(*models, shadows=shadows).predict(camera, sun) for shadows in ("none", "others"))
    on_floor = (lit.id == 2) & (lit.alpha > 0.99)
    visible = shaded.visibility[on_floor]
    y, x = np.nonzero(on_floor)
    rays = np.stack([(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, np.ones(len(x))], axis=1)
    points = camera.position + (shaded.depth[on_floor][:, None] * rays) @ camera.world_from_camera[:3, :3].T
    away, top = np.linalg.norm(points[:, :2], axis=1), points[:, 2] > -0.1
    assert (top & (away < 0.3)).sum() > 20
    assert visible[top & (away < 0.3)].max() < 0.05
    assert visible[top & (away > 0.5)].min() > 0.95
    np.testing.assert_allclose(shaded.rgb[on_floor], lit.rgb[on_floor] * visible[:, None], atol=0.02)
    assert lit.visibility is None


def test_a_field_casts_its_shadow_on_gaussians_and_on_a_field(floor):
    """A slab over a disc, and over a floor: dark below, lit beside; half the light through a slab that lets half of it
    through."""
    sun, camera = Sun(np.array([0.0, 0.0, 1.0])), seen_from([0.01, -4.0, 2.5], pixels=64)
    for density, through in ((2000.0, 0.0), (2 * np.log(2) / 0.4, 0.5)):
        slab = box_field((-0.3, -0.3, -0.2), (0.3, 0.3, 0.2), density=density, name="slab")
        for ground in (disc_run(0.9), floor):
            placed = PlacedRun(ground), PlacedRun(slab, Pose(translation=[0, 0, 1.4]))
            seen = compose(placed, ComposeConfig("others")).predict(camera, sun)
            ours = (seen.id == 1) & (seen.alpha > 0.99)
            y, x = np.nonzero(ours)
            rays = np.stack([(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, np.ones(len(x))], 1)
            points = camera.position + (seen.depth[ours][:, None] * rays) @ camera.world_from_camera[:3, :3].T
            far, visible = np.abs(points[:, :2]).max(axis=1), seen.visibility[ours]
            assert (far < 0.2).sum() > 10
            np.testing.assert_allclose(visible[far < 0.2], through, atol=0.12)
            np.testing.assert_allclose(visible[(far > 0.45) & (points[:, 2] > -0.1)], 1, atol=0.02)


def test_the_same_bits_twice_in_any_order_and_after_a_move(box):
    run = made_run("map", 2)
    one = scene((run, Pose()), (box, Pose(translation=[0.3, 0.2, 0.1])), shadows="trained")
    other = scene((box, Pose(translation=[0.3, 0.2, 0.1])), (run, Pose()), shadows="trained")
    first, again, swapped = (s.predict(EYE, SUN, normals=True) for s in (one, one, other))
    near(first, again, 0)
    near(first, swapped, 0, PLANES[:-1])
    np.testing.assert_array_equal(swapped.id, np.array([0, 2, 1])[first.id])
    moved = one.posed([Pose(translation=[0.2, 0, 0]), Pose(translation=[0, 0, 0.4])])
    fresh = scene((run, Pose(translation=[0.2, 0, 0])), (box, Pose(translation=[0, 0, 0.4])), shadows="trained")
    near(moved.predict(EYE, SUN), fresh.predict(EYE, SUN), 0)
    near(one.predict(EYE, SUN, normals=True), first, 0)
    assert moved.gaussian_count == run.gaussian_count
    np.testing.assert_allclose(moved.places[1], [0, 0, 0.4], atol=1e-9)


def test_supersampled_runs_draw_the_whole_picture_so(box):
    """Each pixel is the mean light of four: the same as a picture twice as wide, reduced, where nothing is partly
    covered."""
    run = replace(made_run("vanilla"), config={"method": "vanilla", "supersample": 2})
    models = (made_run("vanilla"), Pose(translation=[0, 0.6, 0])), (box, Pose())
    many = scene((run, models[0][1]), models[1]).predict(EYE, normals=True)
    wide = replace(EYE, width=96, height=96, fx=2 * EYE.fx, fy=2 * EYE.fy, cx=2 * EYE.cx, cy=2 * EYE.cy)
    each = scene(*models).predict(wide)
    np.testing.assert_allclose(many.alpha, each.alpha.reshape(48, 2, 48, 2).mean(axis=(1, 3)), atol=1e-5)
    assert many.rgb.shape == (48, 48, 3)
    assert np.abs(many.rgb - scene(*models).predict(EYE).rgb).max() > 0.01


def test_surface_depth_is_the_nearer_surface(box):
    mixed = scene((disc_run(0.9), Pose(rotation_about([0, 1, 0], 90), [1.5, 0.0, 0.0])), (box, Pose()))
    for x, depth in ((5.0, 3.5), (-5.0, 4.5)):
        found = mixed.surface_depth(seen_from([x, 0.0, 0.0]))
        assert abs(found[24, 24] - depth) < 0.06
        assert found[0, 0] == 0


def test_impossible_predictions_are_refused(box):
    mixed = scene((made_run("vanilla"), Pose()), (box, Pose()), shadows="trained")
    with pytest.raises(InputError, match="expected the Sun's direction"):
        mixed.predict(EYE)
    with pytest.raises(InputError, match="exposure: expected runs trained in linear light"):
        mixed.predict(EYE, SUN, exposure=1.0)
    with pytest.raises(InputError, match="found one family"):
        MixedComposition([PlacedRun(box)])
    assert scene((made_run("vanilla"), Pose()), (box, Pose())).predict(EYE).visibility is None


def test_scene_files_are_composed_and_evaluated(spacesim, tiny_data, tiny_run, tiny_field, tmp_path):
    """Of both families, and of fields: pictures of all kinds, numbers, shapes."""
    kinds = {"mixed": (tiny_run, tiny_field), "fields": (tiny_field, tiny_field)}
    for kind, (one, other) in kinds.items():
        path = tmp_path / f"{kind}.toml"
        path.write_text(pair_scene(one, other))
        done = spacesim("compose", path, "--out", tmp_path / kind)
        assert done.code == 0, done.errors
        assert set(np.unique(read_png(tmp_path / kind / "id/0000.png"))) == {0, 1, 2}
        assert (tmp_path / kind / "visibility/0000.png").exists()
        copy = tmp_path / f"{kind}_copy.toml"
        save_scene(copy, load_scene(path))
        first, second = (load_scene(p).frame(0) for p in (path, copy))
        near(first.composition.predict(first.camera, first.sun), second.composition.predict(second.camera, second.sun))
        wanted = ["--no-geometry"] if kind == "fields" else []
        done = spacesim("eval", path, "--data", tiny_data, "--out", tmp_path / f"{kind}_eval", *wanted)
        assert done.code == 0, done.errors
        metrics = json.loads((tmp_path / f"{kind}_eval/metrics.json").read_text())
        assert (metrics["model"]["gaussians"] is None) == (kind == "fields")
        assert metrics["image"]["psnr"]["mean"] > 3
        assert wanted or metrics["geometry"]["mesh"]["faces"] > 50
        assert metrics["config"]["models"]["other"]["scale"] == 0.5
    done = spacesim("compose", tmp_path / "mixed.toml", "--out", tmp_path / "no", "--ply", tmp_path / "no.ply")
    assert (done.code, "expected a scene of Gaussians" in done.errors[0]) == (2, True)
