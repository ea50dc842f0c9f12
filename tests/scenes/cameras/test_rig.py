import json

import numpy as np
import pytest

from spacesim.data.errors import InputError
from spacesim.data.geometry import fibonacci_sphere, normalize
from spacesim.scenes.build import build
from spacesim.scenes.cameras.camera import CameraConfig
from spacesim.scenes.cameras.orbit import mean_motion
from spacesim.scenes.cameras.path_rigs import ApproachRig, FlyAroundRig
from spacesim.scenes.cameras.rig import (
    SINGLE_SUN,
    RigConfig,
    TargetSphere,
    fitting_distance,
    held_out_suns,
    intermediate_steps,
    plan,
    training_suns,
)
from spacesim.scenes.cameras.sphere_rigs import FibonacciRig, PolarArcRig, RandomRig
from spacesim.scenes.generation.generate import plan_views
from spacesim.scenes.lights.earth import EarthConfig
from spacesim.scenes.rigs import RIGS
from spacesim.scenes.scenefile import read_scene

ARRANGED = [kind for kind, rig in RIGS.items() if issubclass(rig, RigConfig)]
SCENE = build(read_scene("boxsat"))
TARGET = TargetSphere(np.array([1.0, -2.0, 0.5]), 2.0)
CAMERA = CameraConfig((96, 64), fov_deg=40.0)


def views_of(**options):
    return plan_views(SCENE, read_scene("boxsat", **options))


def positions(views):
    return np.array([view.camera.position for view in views])


def sun_directions(views):
    return np.array([view.sun.direction for view in views])


def in_camera(view, point=TARGET.centre):
    """[3] a world point in camera axes."""
    return (view.camera.camera_from_world @ [*point, 1])[:3]


def nearest(views, others):
    """Metres between the two nearest cameras of two sets."""
    return np.linalg.norm(positions(views)[:, None] - positions(others)[None], axis=2).min()


def test_all_of_the_object_is_in_every_frame():
    train, test = views_of(views=40, test_views=10, resolution=(256, 192))
    points = np.c_[SCENE.mesh.convex_hull.vertices, np.ones(len(SCENE.mesh.convex_hull.vertices))]
    largest = 0.0
    for _, view in train + test:
        camera = view.camera
        x, y, z = (camera.camera_from_world @ points.T)[:3]
        assert z.min() > 0
        image = np.stack(
            [(camera.fx * x / z + camera.cx) / camera.width, (camera.fy * y / z + camera.cy) / camera.height]
        )
        assert image.min() > 0
        assert image.max() < 1
        largest = max(largest, np.abs(2 * image[1] - 1).max())
    assert largest > 0.8, "the object should fill the frame in some view"


def test_no_camera_is_in_both_sets():
    train, test = views_of(suns=3, views=30, test_views=30, test_suns=2)
    assert [name for name, _ in train] == [f"train_{i:05d}" for i in range(90)]
    assert [name for name, _ in test] == [f"test_{i:05d}" for i in range(60)]
    places = positions([view for _, view in train + test])
    apart = np.linalg.norm(places[:, None] - places[None], axis=2) + 1e9 * np.eye(len(places))
    assert apart.min() > 1e-3


def test_views_are_spread_evenly():
    train, _ = plan(FibonacciRig(views=200), TARGET, CAMERA, 0)
    offsets = positions(train) - TARGET.centre
    directions = offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
    assert np.linalg.norm(directions.mean(axis=0)) < 0.02
    np.testing.assert_allclose(directions.T @ directions / 200, np.eye(3) / 3, atol=0.02)


def test_suns():
    assert training_suns(1)[0].angles == pytest.approx(SINGLE_SUN)
    assert [sun.angles for sun in training_suns(1, [(10, 20), (30, -40)])] == [
        pytest.approx((10, 20)),
        pytest.approx((30, -40)),
    ]
    known = np.array([sun.direction for sun in training_suns(24)])
    held_out = np.array([sun.direction for sun in held_out_suns(24, seed=0)])
    np.testing.assert_allclose(np.linalg.norm(known, axis=1), 1)
    assert (known @ held_out.T).max() < np.cos(np.radians(0.5))


@pytest.mark.parametrize("kind", ARRANGED)
def test_test_views_are_of_the_training_suns_unless_others_are_asked_for(kind):
    train, test = plan(RIGS[kind](suns=4, views=2, test_views=3), TARGET, CAMERA, 0)
    directions = {view.sun.angles for view in train}
    assert len(directions) == 4
    assert (len(train), len(test)) == (8, 12)
    assert {view.sun.angles for view in test} == directions
    _, test = plan(RIGS[kind](suns=4, views=2, test_views=3, test_suns=5), TARGET, CAMERA, 0)
    assert len({view.sun.angles for view in test} - directions) == 5
    assert len(test) == 15


@pytest.mark.parametrize("kind", ARRANGED)
def test_test_views_of_known_suns_beside_those_of_others(kind):
    options = {"suns": 4, "views": 2, "test_suns": 5, "test_views": 3}
    before = plan(RIGS[kind](**options), TARGET, CAMERA, 0)
    train, test = plan(RIGS[kind](**options, known_test_views=2), TARGET, CAMERA, 0)
    known = {view.sun.angles for view in train}
    assert len(test) == 5 * 3 + 4 * 2
    assert [view.sun.angles in known for view in test] == [False] * 15 + [True] * 8
    assert {view.sun.angles for view in test[15:]} == known
    assert nearest(train, test) > 1e-3
    for now, then in zip((train, test), before, strict=True):
        np.testing.assert_array_equal(positions(now[: len(then)]), positions(then))
        np.testing.assert_array_equal(sun_directions(now[: len(then)]), sun_directions(then))


@pytest.mark.parametrize(
    "rig",
    [FibonacciRig, RandomRig, lambda **options: ApproachRig(jitter=0.3, **options)],
    ids=["fibonacci", "random", "approach"],
)
def test_shared_test_views_differ_by_their_light_alone(rig):
    options = {"suns": 2, "views": 4, "test_suns": 3, "test_views": 4, "known_test_views": 4}
    apart, (train, test) = (plan(rig(**options, shared_test_views=on), TARGET, CAMERA, 1) for on in (False, True))
    poses = np.array([view.camera.world_from_camera for view in test]).reshape(5, 4, 4, 4)
    np.testing.assert_array_equal(poses, np.broadcast_to(poses[:1], poses.shape))
    assert len({view.sun.angles for view in test}) == 5
    assert len(np.unique(positions(apart[1]).round(9), axis=0)) == 20
    np.testing.assert_array_equal(positions(train), positions(apart[0]))
    assert nearest(train, test) > 1e-3


@pytest.mark.parametrize(("of_test", "of_known"), [(5, 2), (2, 5), (5, 1), (3, 3)])
def test_shared_test_views_of_two_numbers_are_of_the_same_cameras(of_test, of_known):
    """So known and unseen Suns are compared on the same views: the fewer are spread among the more."""
    options = {"suns": 2, "views": 4, "test_suns": 3, "shared_test_views": True}
    rig = FibonacciRig(**options, test_views=of_test, known_test_views=of_known)
    assert rig.shared_cameras == (None if of_test == of_known else 5)
    _, test = plan(rig, TARGET, CAMERA, 1)
    unseen, known = positions(test)[: 3 * of_test].round(9), positions(test)[3 * of_test :].round(9)
    assert len(known) == 2 * of_known
    few, many = sorted((unseen[:of_test], known[:of_known]), key=len)
    places = [np.flatnonzero((many == one).all(axis=1)).tolist() for one in few]
    assert places == {5: [[k] for k in range(5)], 3: [[k] for k in range(3)], 2: [[1], [3]], 1: [[2]]}[len(few)]
    _, whole = plan(FibonacciRig(**options, test_views=len(many), known_test_views=len(many)), TARGET, CAMERA, 1)
    np.testing.assert_array_equal(positions(whole)[: len(many)].round(9), many)


def test_scene_json_names_such_views_only_where_asked_for():
    plain = read_scene("boxsat").to_json()["rig"]
    asked = read_scene("boxsat", test_suns=2, known_test_views=3, shared_test_views=True).to_json()["rig"]
    assert set(asked) - set(plain) == {"known_test_views", "shared_test_views"}
    with pytest.raises(InputError, match=r"^known_test_views: expected 0 without test_suns, .*, found 3$"):
        FibonacciRig(known_test_views=3)


@pytest.mark.parametrize("kind", ARRANGED)
def test_given_suns_take_the_place_of_the_rigs_own(kind):
    rig = RIGS[kind](sun=((10.0, 20.0), (200.0, -60.0)), views=3, test_views=2)
    train, _ = plan(rig, TARGET, CAMERA, 0)
    expected = np.repeat([training_suns(1, [angles])[0].direction for angles in rig.sun], 3, axis=0)
    np.testing.assert_allclose(sun_directions(train), expected, atol=1e-12)


@pytest.mark.parametrize("kind", ARRANGED)
@pytest.mark.parametrize("views", [1, 2, 7])
def test_frames_held_out_are_none_of_training(kind, views):
    train, test = plan(RIGS[kind](suns=1, views=views, test_views=9), TARGET, CAMERA, 3)
    assert nearest(train, test) > 1e-3
    assert len(np.unique(positions(test).round(6), axis=0)) == 9


@pytest.mark.parametrize(
    "rig", [FibonacciRig(views=8), RandomRig(views=8, random_suns=True), ApproachRig(views=8, jitter=0.2)]
)
def test_seed_decides_what_is_random(rig):
    first, again, other = (plan(rig, TARGET, CAMERA, seed)[0] for seed in (4, 4, 5))
    np.testing.assert_array_equal(positions(first), positions(again))
    assert np.linalg.norm(positions(first) - positions(other), axis=1).min() > 1e-3


def test_seed_turns_the_lattice_and_nothing_else():
    first, other = (positions(plan(FibonacciRig(views=8), TARGET, CAMERA, seed)[0]) for seed in (4, 5))
    radii = [np.linalg.norm(places - TARGET.centre, axis=1) for places in (first, other)]
    np.testing.assert_allclose(radii, fitting_distance(TARGET.radius, CAMERA), rtol=1e-12)


def test_intermediate_steps():
    np.testing.assert_allclose(intermediate_steps(5, 4, closed=False), [0.5, 1.5, 2.5, 3.5])
    np.testing.assert_allclose(intermediate_steps(4, 4, closed=True), [0.5, 1.5, 2.5, 3.5])
    np.testing.assert_allclose(intermediate_steps(101, 2, closed=False), [25.5, 75.5])
    np.testing.assert_allclose(intermediate_steps(2, 3, closed=False), [0.25, 0.5, 0.75])
    assert len(intermediate_steps(9, 0, closed=False)) == 0
    for count in (1, 2, 3, 10, 37):
        for wanted in (1, 5, 36, 100):
            steps = intermediate_steps(count, wanted, closed=False)
            assert len(np.unique(steps)) == wanted
            assert 0 < steps.min() <= steps.max() < max(count - 1, 1)
            assert np.abs(steps - np.rint(steps)).min() > 1e-3


def test_polar_arc_is_the_thesiss_hubble_dataset():
    rig = PolarArcRig(arc_azimuth_deg=30.0, test_suns=23, test_views=1)
    assert (rig.suns, rig.views) == (24, 614)
    train, test = plan(rig, TARGET, CAMERA, 0)
    assert len(train) == 24 * 614
    suns, others = sun_directions(train[::614]), sun_directions(test)
    normal = np.array([-np.sin(np.radians(30)), np.cos(np.radians(30)), 0])
    np.testing.assert_allclose(suns @ normal, 0, atol=1e-12)
    assert train[0].sun.angles == pytest.approx((30, 3.75))
    assert train[-1].sun.angles == pytest.approx((210, 3.75))
    steps = np.degrees(np.arccos((suns[1:] * suns[:-1]).sum(axis=1)))
    np.testing.assert_allclose(steps, 7.5)
    np.testing.assert_allclose(np.degrees(np.arccos((others * suns[:-1]).sum(axis=1))), 3.75)


def test_polar_arc_can_be_a_circle_or_one_sun():
    circle, _ = plan(PolarArcRig(suns=8, views=1, arc_deg=360.0), TARGET, CAMERA, 0)
    gram = sun_directions(circle) @ sun_directions(circle).T
    np.testing.assert_allclose(gram.sum(axis=1), 0, atol=1e-12)
    one, _ = plan(PolarArcRig(suns=1, views=1), TARGET, CAMERA, 0)
    np.testing.assert_allclose(one[0].sun.direction, [0, 0, 1], atol=1e-12)


def test_random_attitudes_are_uniform():
    train, _ = plan(RandomRig(views=4000), TARGET, CAMERA, 1)
    rotations = np.array([view.camera.world_from_camera[:3, :3] for view in train])
    # Of a uniform rotation, the mean is 0, elements have variance 1/3, and the angle t has density (1 - cos t) / pi.
    np.testing.assert_allclose(rotations.mean(axis=0), 0, atol=5 / np.sqrt(3 * 4000))
    np.testing.assert_allclose((rotations**2).mean(axis=0), 1 / 3, atol=0.03)
    angles = np.sort(np.arccos((np.trace(rotations, axis1=1, axis2=2) - 1) / 2))
    expected = (angles - np.sin(angles)) / np.pi
    assert np.abs(expected - np.linspace(0, 1, 4000)).max() < 1.63 / np.sqrt(4000)  # Kolmogorov and Smirnov, 1 %


def test_random_poses_keep_the_target_in_the_image():
    train, _ = plan(RandomRig(views=400, near=9.0, far=30.0), TARGET, CAMERA, 2)
    shell = TARGET.centre + TARGET.radius * fibonacci_sphere(600)
    reached = 0.0
    for view in train:
        camera = view.camera
        x, y, z = (camera.camera_from_world[:3, :3] @ shell.T) + camera.camera_from_world[:3, 3:]
        u, v = camera.fx * x / z / camera.width, camera.fy * y / z / camera.height
        assert z.min() > 0
        assert max(np.abs(u).max(), np.abs(v).max()) <= 0.5
        reached = max(reached, np.abs(u).max())
    assert reached > 0.49
    depths = np.array([in_camera(view)[2] for view in train])
    assert 9 <= depths.min() < 9.5
    assert 29.5 < depths.max() <= 30
    assert depths.mean() == pytest.approx(19.5, abs=1)


def test_random_poses_can_crop_and_prefer_to_be_near():
    cropped, _ = plan(RandomRig(views=300, near=6.0, far=7.0, cropped=True), TARGET, CAMERA, 2)
    centres = np.array([in_camera(view) for view in cropped])
    u = np.abs(centres[:, 0] / centres[:, 2]) / np.tan(np.radians(20))
    assert 0.97 < u.max() <= 1
    close, _ = plan(RandomRig(views=500, near=8.0, far=30.0, sigma=4.0), TARGET, CAMERA, 2)
    depths = np.array([in_camera(view)[2] for view in close])
    assert depths.min() >= 8
    assert np.mean(depths < 12) == pytest.approx(0.683, abs=0.06)  # one sigma


def test_random_suns_are_everywhere():
    train, test = plan(RandomRig(views=600, test_views=3, random_suns=True), TARGET, CAMERA, 2)
    suns = sun_directions(train)
    assert len(np.unique(suns, axis=0)) == 600
    assert np.linalg.norm(suns.mean(axis=0)) < 0.1
    assert len(np.unique(sun_directions(test), axis=0)) == 3


def test_random_suns_stay_on_the_cameras_side():
    rig = RandomRig(views=400, test_views=100, random_suns=True, max_phase_deg=70.0)
    train, test = plan(rig, TARGET, CAMERA, 2)
    towards = normalize(positions(train + test) - TARGET.centre)
    cosines = np.einsum("ni,ni->n", towards, sun_directions(train + test))
    assert cosines.min() >= np.cos(np.radians(70)) - 1e-12
    shares = (1 - cosines) / (1 - np.cos(np.radians(70)))  # uniform over the cap
    np.testing.assert_allclose(np.quantile(shares, [0.25, 0.5, 0.75]), [0.25, 0.5, 0.75], atol=0.08)
    known = {tuple(sun) for sun in sun_directions(train)}
    assert known.isdisjoint(tuple(sun) for sun in sun_directions(test))
    unlimited = plan(RandomRig(views=9, random_suns=True), TARGET, CAMERA, 2)[0]
    whole = plan(RandomRig(views=9, random_suns=True, max_phase_deg=180.0), TARGET, CAMERA, 2)[0]
    np.testing.assert_array_equal(sun_directions(unlimited), sun_directions(whole))


def phases(views):
    towards = normalize(positions(views) - TARGET.centre)
    return np.degrees(np.arccos(np.einsum("ni,ni->n", towards, sun_directions(views))))


@pytest.mark.parametrize("suns", [{"random_suns": True}, {"sun": ((10.0, -70.0), (40.0, 25.0))}])
def test_phase_angles_stay_in_a_range(suns):
    options = {"views": 300, "cropped": True, **suns}
    train, test = plan(RandomRig(**options, test_views=20, min_phase_deg=50.0, max_phase_deg=80.0), TARGET, CAMERA, 2)
    found = phases(train + test)
    assert 50 - 1e-9 <= found.min() < 52
    assert 78 < found.max() <= 80 + 1e-9
    free = plan(RandomRig(**options), TARGET, CAMERA, 2)[0]
    assert phases(free).max() > 160
    for view, other in zip(train, free, strict=True):  # the target stays where it is in the picture
        np.testing.assert_allclose(in_camera(view), in_camera(other), atol=1e-12)
    attitudes = np.array([view.camera.world_from_camera[:3, 0] for view in train])
    assert np.linalg.norm(attitudes.mean(axis=0)) < 0.2  # any roll
    assert plan(RandomRig(**options), TARGET, CAMERA, 2)[0][0].sun.angles == free[0].sun.angles


def test_random_suns_keep_clear_of_the_earth_where_phase_angles_are_limited():
    earth = EarthConfig(elevation_deg=-90.0, altitude_km=500.0)
    over = TargetSphere(TARGET.centre, TARGET.radius, earth)
    rig = RandomRig(views=400, random_suns=True, max_phase_deg=120.0)
    found = sun_directions(plan(rig, over, CAMERA, 2)[0]) @ earth.direction
    assert np.degrees(np.arccos(found.max())) > np.degrees(earth.angular_radius) + 0.59
    unlimited = plan(RandomRig(views=400, random_suns=True), over, CAMERA, 2)[0]
    assert np.mean(sun_directions(unlimited) @ earth.direction > np.cos(earth.angular_radius)) > 0.2


def test_a_lattice_of_suns_with_a_view_each():
    """--suns 20 --views 1: every picture, of testing too, has a Sun of its own."""
    train, test = plan(RandomRig(suns=20, views=1, test_suns=4, test_views=1), TARGET, CAMERA, 2)
    assert (len(train), len(test)) == (20, 4)
    assert len(np.unique(np.concatenate([sun_directions(train), sun_directions(test)]), axis=0)) == 24


@pytest.mark.parametrize(
    ("axis", "away", "up"),
    [
        ("v-bar", [1, 0, 0], [0, 0, 1]),
        ("-v-bar", [-1, 0, 0], [0, 0, 1]),
        ("r-bar", [0, 0, -1], [1, 0, 0]),  # from below
        ("-r-bar", [0, 0, 1], [1, 0, 0]),
    ],
)
def test_approach_is_straight(axis, away, up):
    train, test = plan(ApproachRig(views=9, test_views=8, axis=axis, start=50.0, end=10.0), TARGET, CAMERA, 0)
    expected = TARGET.centre + np.linspace(50, 10, 9)[:, None] * away
    np.testing.assert_allclose(positions(train), expected, atol=1e-12)
    np.testing.assert_allclose(positions(test), (expected[1:] + expected[:-1]) / 2, atol=1e-12)
    for view in train:
        np.testing.assert_allclose(view.camera.world_from_camera[:3, 2], -np.array(away), atol=1e-12)
        np.testing.assert_allclose(view.camera.world_from_camera[:3, 1], -np.array(up), atol=1e-12)


def test_jitter_is_lateral_and_the_target_stays_in_the_middle():
    train, _ = plan(ApproachRig(views=400, axis="r-bar", start=60.0, end=20.0, jitter=0.3), TARGET, CAMERA, 0)
    offsets = positions(train) - TARGET.centre
    np.testing.assert_allclose(-offsets[:, 2], np.linspace(60, 20, 400))
    assert offsets[:, :2].std(axis=0) == pytest.approx([0.3, 0.3], rel=0.12)
    for view in train:
        assert np.abs(in_camera(view)[:2]).max() < 1e-9
        assert view.camera.world_from_camera[:3, 1] @ [-1, 0, 0] > 0.99  # no sudden roll


def test_fly_around_is_a_two_to_one_ellipse_of_one_revolution():
    train, test = plan(FlyAroundRig(views=36, test_views=36, size=12.0, across=3.0), TARGET, CAMERA, 0)
    x, y, z = (positions(train) - TARGET.centre).T
    np.testing.assert_allclose((x / 24) ** 2 + (z / 12) ** 2, 1)
    assert np.abs(y).max() == pytest.approx(3)
    np.testing.assert_allclose([x[0], z[0]], [0, -12], atol=1e-12)  # below
    assert x[9] == pytest.approx(24)  # a quarter later ahead
    steps = np.linalg.norm(np.diff(positions(train + train[:1]), axis=0), axis=1)
    assert steps.max() < 5
    middles = np.linalg.norm(positions(test) - positions(train), axis=1)
    np.testing.assert_allclose(middles, steps / 2, rtol=0.05)
    for view in train + test:
        assert np.abs(in_camera(view)[:2]).max() < 1e-9
        assert view.camera.world_from_camera[1, 1] < -0.9  # the orbit's normal is up
    assert np.linalg.norm(np.diff([v.camera.world_from_camera[:3, 0] for v in train], axis=0), axis=1).max() < 0.4


def test_fly_around_for_a_while():
    quarter = np.pi / 2 / mean_motion(700)
    rig = FlyAroundRig(views=5, size=12.0, phase_deg=90.0, altitude_km=700.0, duration_s=quarter)
    places = positions(plan(rig, TARGET, CAMERA, 0)[0]) - TARGET.centre
    np.testing.assert_allclose(places[0], [24, 0, 0], atol=1e-9)
    np.testing.assert_allclose(places[-1], [0, 0, 12], atol=1e-9)


def test_sun_that_moves_is_fixed_among_the_stars():
    rig = FlyAroundRig(views=8, sun=((0.0, 0.0),), sun_moves=True)  # in the orbit's plane
    suns = sun_directions(plan(rig, TARGET, CAMERA, 0)[0])
    np.testing.assert_allclose(suns[[0, 2, 4, 6]], [[1, 0, 0], [0, 0, 1], [-1, 0, 0], [0, 0, -1]], atol=1e-12)
    still = sun_directions(plan(FlyAroundRig(views=8, sun=((0.0, 0.0),)), TARGET, CAMERA, 0)[0])
    np.testing.assert_allclose(still, np.tile([1, 0, 0], (8, 1)), atol=1e-12)


def test_scenes_say_their_rig(tmp_path):
    file = tmp_path / "scene.toml"
    file.write_text('[[objects]]\nspacecraft = "boxsat"\n[rig]\nkind = "fly-around"\nsize = 30.0\nviews = 4\n')
    config = read_scene(file)
    assert config.rig == FlyAroundRig(views=4, size=30.0)
    assert json.loads(json.dumps(config.to_json()))["rig"]["kind"] == "fly-around"
    train, _ = plan_views(build(config), config)
    assert len(train) == 4


@pytest.mark.parametrize(
    ("rig", "changes", "message"),
    [
        (FibonacciRig, {"views": 0}, "views: expected at least 1, found 0"),
        (FibonacciRig, {"distance": 0.0}, "distance: expected metres from 1e-09 to 1e\\+12, found 0.0"),
        (FibonacciRig, {"distance": float("nan")}, "distance: "),
        (FibonacciRig, {"sun": ((1.0, 2.0),), "suns": 2}, "suns: expected 1, one for each direction given, found 2"),
        (PolarArcRig, {"arc_deg": 361.0}, "arc_deg: expected an angle above 0, up to 360 degrees, found 361.0"),
        (PolarArcRig, {"arc_azimuth_deg": float("inf")}, "arc_azimuth_deg: "),
        (RandomRig, {"near": -1.0}, "near: expected metres from 1e-09 to 1e\\+12, found -1.0"),
        (RandomRig, {"near": 9.0, "far": 5.0}, "far: expected at least near, 9 m, found 5.0"),
        (RandomRig, {"random_suns": True, "suns": 3}, "random_suns: expected 1 suns .* found 3 suns and 0 test_suns$"),
        (
            RandomRig,
            {"max_phase_deg": 40.0, "min_phase_deg": 40.0},
            "min_phase_deg: expected an angle from 0 to 39 deg",
        ),
        (RandomRig, {"random_suns": True, "max_phase_deg": 0.0}, "max_phase_deg: expected an angle from 1 to 180"),
        (RandomRig, {"random_suns": True, "sun": ((1.0, 2.0),)}, "random_suns: expected false where sun"),
        (ApproachRig, {"axis": "x"}, "axis: expected one of v-bar, -v-bar, r-bar, -r-bar, found 'x'"),
        (ApproachRig, {"start": 5.0, "end": 5.0}, "end: expected less than start, 5 m, found 5.0"),
        (ApproachRig, {"jitter": -0.1}, "jitter: expected metres from 0 to 1e"),
        (FlyAroundRig, {"altitude_km": 10.0}, "altitude_km: expected an altitude from 100 to 100,000 km, found 10.0"),
        (FlyAroundRig, {"duration_s": 6000.0}, "duration_s: expected seconds above 0, up to one revolution of 56"),
        (FlyAroundRig, {"size": 0.0}, "size: "),
        (FlyAroundRig, {"across": float("inf")}, "across: "),
    ],
)
def test_impossible_rigs_are_refused(rig, changes, message):
    with pytest.raises(InputError, match=message):
        rig(**changes)


def test_rigs_that_do_not_suit_the_target_are_refused():
    with pytest.raises(InputError, match=r"start: expected more than end, 8\.91 m, found 3\.0"):
        plan(ApproachRig(start=3.0), TARGET, CAMERA, 0)
