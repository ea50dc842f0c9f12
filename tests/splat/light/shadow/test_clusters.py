"""Algorithm 3 line by line on small sets; cameras that cover their clusters; shadows that know of no other model."""

import numpy as np
import pytest

from spacesim.backend.upload import upload
from spacesim.data.geometry import direction_from_angles, rotation_from_quaternion
from spacesim.splat.light.shadow.bias import receiver_bias
from spacesim.splat.light.shadow.clusters import (
    Supports,
    assign_cameras,
    clusters,
    light_cameras,
    light_supports,
    occlusion_in_clusters,
)
from spacesim.splat.light.shadow.light_camera import fit_camera, light_axes, light_rows, towards_sun
from spacesim.splat.light.shadow.mapping import occlusion_by_mapping
from spacesim.splat.light.shadow.splatting import occlusion_by_splatting
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.raster.project import project

SIZE = 102  # 100 pixels and the margins
SUN = direction_from_angles(40, 35)


def points(*values):
    """[N, 2] places on the x axis, of no extent."""
    return np.array([[value, 0.0] for value in values]), np.zeros((len(values), 2))


def parts(found):
    return [part.tolist() for part in found]


def blob(count, centre, spread=0.5, seed=0, sigma=0.02):
    """Opaque Gaussians around `centre` [3], numpy arrays."""
    rng = np.random.default_rng(seed)
    return {
        "means": np.asarray(centre) + spread * rng.uniform(-1, 1, (count, 3)),
        "log_scales": np.log(sigma) + rng.uniform(-0.5, 0.5, (count, 3)),
        "quaternions": rng.normal(size=(count, 4)),
        "logit_opacities": np.full(count, 4.0),
        "sh": np.zeros((count, 1, 3)),
    }


def join(*sets):
    return {name: np.concatenate([one[name] for one in sets]) for name in sets[0]}


class Recorder:
    """An `occlude` that keeps the cameras it was given and returns the number of what it was called for: the one
    camera of a compact set is tried first, and counts where it stays alone."""

    def __init__(self):
        self.tried = []

    @property
    def cameras(self):
        return self.tried[1:] or self.tried

    def __call__(self, gaussians, camera):
        self.tried.append(camera)
        return upload(np.full(gaussians.count, len(self.cameras), np.float32))


def screen(camera, means):
    """[N, 2] pixels of points in the picture of an `Orthographic`, in float64 from its own numbers."""
    numbers = np.array(camera.values, np.float64)
    pose = numbers[:12].reshape(3, 4)
    across = means @ pose[:2, :3].T + pose[:2, 3]
    return across * numbers[12:14] + numbers[14:16]


# Lines 5 to 19.


def test_a_set_that_fits_is_one_cluster():
    assert parts(clusters(*points(0, 4, 9.9), SIZE, least_scale=10)) == [[0, 1, 2]]


def test_the_footprint_is_the_image_without_its_margin():
    assert len(clusters(*points(0, 4, 10), SIZE, least_scale=10)) == 1  # 100 pixels at 10 a metre
    assert len(clusters(*points(0, 4, 10.001), SIZE, least_scale=10)) == 2


def test_supports_count_not_centres():
    centres, radii = points(0, 9.5)
    radii[1, 0] = 0.6
    assert len(clusters(centres, radii, SIZE, least_scale=10)) == 2
    radii[1] = 0, 0.6  # across the other axis
    assert len(clusters(centres, radii, SIZE, least_scale=10)) == 1


def test_the_split_is_at_the_widest_gap():
    assert parts(clusters(*points(0, 1, 2, 9, 12), SIZE, least_scale=10)) == [[0, 1, 2], [3, 4]]


def test_a_gap_is_one_between_supports():
    centres, radii = points(0, 1, 5, 12, 14)
    radii[3, 0] = 6.5  # reaches over to 5.5: what is left are gaps of 4 and 0.5
    assert parts(clusters(centres, radii, SIZE, least_scale=6, most=2)) == [[2, 3, 4], [0, 1]]
    centres, radii = points(0, 1, 5, 11, 12, 14)
    radii[4, 0] = 6.5  # over the place before it, too
    assert parts(clusters(centres, radii, SIZE, least_scale=6, most=2)) == [[2, 3, 4, 5], [0, 1]]
    assert parts(clusters(14 - centres[::-1], radii[::-1], SIZE, least_scale=6, most=2)) == [[0, 1, 2, 3], [4, 5]]


def test_without_a_meaningful_gap_the_median_splits():
    even = np.arange(41) * 0.5  # gaps of a fortieth of the extent
    assert parts(clusters(*points(*even), SIZE, least_scale=9)) == [list(range(20, 41)), list(range(20))]
    centres, radii = points(0, 1, 2, 3, 20)
    radii[:, 0] = 10  # no gap at all
    assert sorted(map(len, clusters(centres, radii, SIZE, least_scale=3, most=2))) == [2, 3]


def test_the_axis_is_the_one_of_the_largest_extent():
    centres = np.array([[0, 0], [8, 0], [0, 30], [8, 30.0]])
    assert parts(clusters(centres, np.zeros((4, 2)), SIZE, least_scale=10)) == [[0, 1], [2, 3]]
    assert parts(clusters(centres[:, ::-1], np.zeros((4, 2)), SIZE, least_scale=10)) == [[0, 1], [2, 3]]


def test_splitting_goes_on_until_all_fit():
    centres = np.array([[x, y] for x in (0, 50, 100) for y in (0, 50)], float).repeat(3, axis=0)
    centres += np.tile([[0, 0], [1, 0], [0, 1]], (6, 1))
    found = clusters(centres, np.full((18, 2), 0.1), SIZE, least_scale=50)
    assert sorted(parts(found)) == [[3 * k, 3 * k + 1, 3 * k + 2] for k in range(6)]


def test_the_primary_cluster_has_most_members():
    found = clusters(*points(100, 0, 200, 0.5, 100.5, 0.2), SIZE, least_scale=50)
    assert parts(found) == [[1, 3, 5], [0, 4], [2]]


@pytest.mark.parametrize("most", [1, 2, 3, 5])
def test_the_budget_ends_splitting_and_leaves_nobody_out(most):
    rng = np.random.default_rng(5)
    centres, radii = rng.uniform(-1e3, 1e3, (300, 2)), rng.uniform(0, 1, (300, 2))
    found = clusters(centres, radii, SIZE, least_scale=50, most=most)
    assert len(found) == most
    assert sorted(np.concatenate(found)) == list(range(300))


def test_no_more_clusters_than_needed_and_all_fit_where_the_budget_allows():
    rng = np.random.default_rng(6)
    centres = rng.uniform(-10, 10, (500, 2))
    radii = rng.uniform(0, 0.2, (500, 2))
    found = clusters(centres, radii, SIZE, least_scale=10, most=64)
    assert 4 <= len(found) <= 16
    assert sorted(np.concatenate(found)) == list(range(500))
    for part in found:
        assert (np.ptp(np.concatenate([centres[part] - radii[part], centres[part] + radii[part]]), axis=0) <= 10).all()


def test_order_does_not_matter():
    rng = np.random.default_rng(7)
    centres, radii = rng.integers(-40, 40, (200, 2)).astype(float), rng.integers(0, 3, (200, 2)) * 0.1  # many ties
    order = rng.permutation(200)

    def content(centres, radii):
        found = clusters(centres, radii, SIZE, least_scale=5, most=6)
        return [sorted(map(tuple, np.hstack([centres[part], radii[part]]))) for part in found]

    assert content(centres, radii) == content(centres[order], radii[order])


def test_members_at_the_same_place_along_the_axis_are_ordered_by_the_other():
    centres = np.array([[0, 0], [5, 3], [5, 1], [5, 2], [5, 0], [10, 0.0]])
    low, high = [4, 2, 0], [3, 1, 5]
    found = clusters(centres, np.full((6, 2), 2.6), SIZE, least_scale=8, most=2)
    assert sorted(parts(found)) == sorted([sorted(low), sorted(high)])


def test_clusters_of_one_of_equal_and_of_no_points():
    assert parts(clusters([[3.0, 4]], [[1e6, 1e6]], SIZE, least_scale=10)) == [[0]]
    assert clusters(np.zeros((0, 2)), np.zeros((0, 2)), SIZE, least_scale=10) == []
    alike = clusters(np.ones((5, 2)), np.full((5, 2), 100.0), SIZE, least_scale=10)
    assert sorted(np.concatenate(alike)) == [0, 1, 2, 3, 4]


def test_what_is_not_finite_is_in_no_cluster():
    centres = np.array([[0, 0], [np.nan, 0], [1, np.inf], [2, 0], [1, 1.0]])
    radii = np.array([[0.1, 0.1]] * 4 + [[np.inf, 0]])
    assert parts(clusters(centres, radii, SIZE, least_scale=10)) == [[0, 3]]


@pytest.mark.parametrize("wrong", [{"size": 0}, {"least_scale": 0.0}, {"least_scale": np.nan}, {"most": 0}])
def test_wrong_numbers_are_named(wrong):
    arguments = {"size": SIZE, "least_scale": 10.0, "most": 8} | wrong
    with pytest.raises(ValueError, match=next(iter(wrong))):
        clusters(*points(0, 1), **arguments)


# Light space and cameras.


def test_supports_in_light_space_against_covariances():
    arrays = blob(50, (3, -2, 1), seed=1)
    found = light_supports(Gaussians.from_numpy(arrays), SUN)
    axes = light_axes(SUN)
    np.testing.assert_allclose(found.positions, arrays["means"] @ axes, atol=1e-6)
    turned = rotation_from_quaternion(arrays["quaternions"]) * np.exp(arrays["log_scales"])[:, None, :]
    covariance = axes.T @ (turned @ turned.transpose(0, 2, 1)) @ axes  # 4.30
    np.testing.assert_allclose(found.radii, 3 * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)[:, :2]), rtol=1e-5)


def test_a_camera_covers_its_cluster_to_the_margin():
    supports = light_supports(Gaussians.from_numpy(blob(80, (300, 200, -500), seed=2)), SUN)
    axes = light_axes(SUN)
    (camera,) = light_cameras(supports, [np.arange(80)], axes, SIZE)
    x, y, z = (supports.positions @ axes.T @ camera.world_from_camera[:3, :3]).T - (
        camera.world_from_camera[:3, 3] @ camera.world_from_camera[:3, :3]
    )[:, None]
    assert abs(z.mean()) < 1e-6
    for along, scale, middle, radius in ((x, camera.scale_x, camera.cx, 0), (y, camera.scale_y, camera.cy, 1)):
        pixels = along * scale + middle
        reach = scale * supports.radii[:, radius]
        assert (pixels - reach).min() == pytest.approx(1, abs=1e-6)
        assert (pixels + reach).max() == pytest.approx(SIZE - 1, abs=1e-6)


def test_a_camera_of_a_point_is_finite():
    supports = Supports(np.array([[1.0, 2, 3]]), np.zeros((1, 2)))
    (camera,) = light_cameras(supports, [np.array([0])], np.eye(3), SIZE)
    np.testing.assert_allclose(camera.world_from_camera[:3, 3], [1, 2, 3])


def test_gaussians_covered_by_the_primary_image_use_it():
    centres, radii = points(*np.arange(31) * 0.5)  # no gap is meaningful: 15 to the left, 16 to the right of 7.25
    radii[15, 0] = 2  # at 7.5, so that the primary image begins at 5.5
    supports = Supports(np.column_stack([centres, np.zeros(31)]), radii)
    assert parts(clusters(centres, radii, SIZE, least_scale=10)) == [list(range(15, 31)), list(range(15))]
    cameras, receivers = assign_cameras(supports, np.eye(3), SIZE, least_scale=10)
    assert parts(receivers) == [list(range(11, 31)), list(range(11))]
    assert [camera.scale_x for camera in cameras] == pytest.approx([100 / 9.5, 100 / 5])  # the second of the rest alone
    # An image below the wanted scale, which the budget has forced, serves its own cluster only.
    cameras, receivers = assign_cameras(supports, np.eye(3), SIZE, least_scale=12, most=2)
    assert parts(receivers) == [list(range(15, 31)), list(range(15))]


def test_a_veil_over_the_model_does_not_cut_it_to_pieces():
    centres, radii = points(*np.linspace(-2, 2, 200))
    radii[100] = 50
    supports = Supports(np.column_stack([centres, np.zeros(200)]), radii)
    assert len(clusters(centres, radii, SIZE, least_scale=10)) == 8
    cameras, receivers = assign_cameras(supports, np.eye(3), SIZE, least_scale=10)
    assert len(cameras) == 1
    assert len(receivers[0]) == 200


# Whole sets.


def test_a_compact_set_has_the_camera_of_training_alone():
    gaussians, recorder = Gaussians.from_numpy(blob(200, (5, 1, 2))), Recorder()
    found = occlusion_in_clusters(gaussians, SUN, SIZE, 10.0, recorder)
    assert np.array(found).tolist() == [1] * 200
    (camera,) = recorder.cameras
    expected = fit_camera(gaussians, light_rows(SUN), SIZE)
    np.testing.assert_allclose(np.array(camera.values), np.array(expected.values), rtol=1e-6, atol=1e-6)


def test_a_few_strays_cost_nothing_and_many_do():
    far = blob(1, (60, -30, 10))
    recorder = Recorder()
    occlusion_in_clusters(Gaussians.from_numpy(join(blob(2000, (0, 0, 0)), far)), SUN, SIZE, 10.0, recorder)
    assert len(recorder.cameras) == 1
    few, recorder = Gaussians.from_numpy(join(blob(2000, (0, 0, 0)), far)), Recorder()
    occlusion_in_clusters(few, SUN, SIZE, 10.0, recorder, crop=False)  # 4.32 leaves none out
    assert len(recorder.cameras) == 2
    far = blob(20, (60, -30, 10))
    occlusion_in_clusters(
        Gaussians.from_numpy(join(blob(2000, (0, 0, 0)), far)), SUN, SIZE, 10.0, recorder := Recorder()
    )
    assert len(recorder.cameras) == 2
    # The one camera would have the scale, but not these: then one image has to hold all.
    gaussians, recorder = Gaussians.from_numpy(join(blob(2000, (0, 0, 0)), far)), Recorder()
    occlusion_in_clusters(gaussians, SUN, SIZE, 1.0, recorder)
    assert len(recorder.cameras) == 1
    place = screen(recorder.cameras[0], gaussians.to_numpy()["means"].astype(float))
    assert place.min() > 0
    assert place.max() < SIZE


def test_what_is_too_faint_to_be_drawn_does_not_count():
    faint = blob(10, (1e4, 0, 0)) | {"logit_opacities": np.full(10, -9.0)}
    recorder = Recorder()
    occlusion_in_clusters(Gaussians.from_numpy(join(blob(50, (0, 0, 0)), faint)), SUN, SIZE, 30.0, recorder)
    assert len(recorder.cameras) == 1


@pytest.mark.parametrize("sun", [SUN, [0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 0]])
def test_every_gaussian_is_served_by_an_image_that_covers_it(sun):
    sets = [blob(40 + 10 * k, 50 * np.array([k % 3, k // 3, (k * 7) % 5]), seed=k) for k in range(6)]
    gaussians, recorder = Gaussians.from_numpy(join(*sets)), Recorder()
    found = np.array(occlusion_in_clusters(gaussians, sun, SIZE, 30.0, recorder))
    assert set(found) == set(range(1, len(recorder.cameras) + 1))
    means, radii = gaussians.to_numpy()["means"].astype(float), light_supports(gaussians, sun).radii
    for k, camera in enumerate(recorder.cameras, 1):
        mine = found == k
        scale = np.array(camera.values)[12:14]
        assert scale.min() >= 30
        place, reach = screen(camera, means[mine]), radii[mine] * scale
        assert (place - reach).min() > 0.9
        assert (place + reach).max() < SIZE - 0.9


def test_a_blocker_far_towards_the_sun_is_in_the_picture():
    """1 km up the light, in front of the second cluster: its camera must draw it."""
    model, other = blob(300, (0, 0, 0), seed=1), blob(60, (40, 0, 0), seed=2)
    blocker = blob(1, np.array([40, 0, 0]) + 1000 * SUN, spread=0, sigma=0.3)
    gaussians, seen = Gaussians.from_numpy(join(model, other, blocker)), []

    def occlude(gaussians, camera):
        splats, footprints = project(gaussians, camera)
        seen.append((np.array(footprints.visible), np.array(splats.depth)))
        return upload(np.zeros(gaussians.count, np.float32))

    occlusion_in_clusters(gaussians, SUN, SIZE, 30.0, occlude)
    _of_all, _first, (visible, depth) = seen
    assert visible[300:].all()
    assert not visible[:300].any()
    assert (depth[300:360] - depth[360]) == pytest.approx(np.full(60, 1000), abs=1.5)


def test_nothing_one_and_what_is_not_finite():
    empty = {name: value[:0] for name, value in blob(1, (0, 0, 0)).items()}
    assert len(occlusion_in_clusters(Gaussians.from_numpy(empty), SUN, SIZE, 10.0, Recorder())) == 0
    one = Gaussians.from_numpy(blob(1, (1e5, 0, 0)))
    assert np.array(occlusion_in_clusters(one, SUN, SIZE, 1e9, Recorder())).tolist() == [1]
    arrays = join(blob(50, (0, 0, 0)), blob(30, (500, 0, 0)))
    arrays["means"][3], arrays["means"][4, 1] = np.nan, np.inf
    arrays["log_scales"][5], arrays["log_scales"][6] = 200, np.nan
    arrays["logit_opacities"][7], arrays["logit_opacities"][8] = np.nan, -30
    arrays["quaternions"][9] = 0
    gaussians, recorder = Gaussians.from_numpy(arrays), Recorder()
    found = np.array(occlusion_in_clusters(gaussians, SUN, SIZE, 30.0, recorder))
    assert len(recorder.cameras) == 2
    assert found[50:].tolist() == [2] * 30
    assert (found[10:50] == 1).all()
    hopeless = blob(4, (0, 0, 0)) | {"means": np.full((4, 3), np.nan)}
    assert len(np.array(occlusion_in_clusters(Gaussians.from_numpy(hopeless), SUN, SIZE, 10.0, Recorder()))) == 4


def test_same_bits_twice():
    gaussians = Gaussians.from_numpy(join(blob(50, (0, 0, 0)), blob(30, (500, 0, 0))))
    pairs = []
    for _ in range(2):
        recorder = Recorder()
        found = occlusion_in_clusters(gaussians, SUN, SIZE, 30.0, recorder)
        pairs.append([np.array(found), *(np.array(camera.values) for camera in recorder.cameras)])
    assert all(np.array_equal(a, b) for a, b in zip(*pairs, strict=True))


# Shadows.


def by_mapping(gaussians, camera):
    return occlusion_by_mapping(gaussians, camera, receiver_bias(gaussians, towards_sun(light_rows(SUN))).bias, 0.01)


def by_splatting(gaussians, camera):
    return occlusion_by_splatting(gaussians, camera, receiver_bias(gaussians, towards_sun(light_rows(SUN))).bias)


def shadows(arrays, occlude, size=128, least_scale=40.0):
    return np.array(occlusion_in_clusters(Gaussians.from_numpy(arrays), SUN, size, least_scale, occlude))


def moved(arrays, offset):
    return arrays | {"means": arrays["means"] + offset}


def grid_blob(count, seed):
    """A blob whose means, moved by whole metres, stay what they are in single precision."""
    arrays = blob(count, (0, 0, 0), seed=seed)
    return arrays | {"means": np.round(4096 * arrays["means"]) / 4096}


METHODS = [(by_mapping, 0.02), (by_splatting, 0.01)]


@pytest.mark.parametrize(("occlude", "tolerance"), METHODS)
def test_two_models_a_kilometre_apart_have_the_shadows_of_each_alone(occlude, tolerance):
    one, other, offset = grid_blob(600, 1), grid_blob(400, 2), np.array([1024, 256, -512])
    together = join(one, moved(other, offset))
    found = shadows(together, occlude)
    alone = np.concatenate([shadows(one, occlude), shadows(other, occlude)])
    assert alone.std() > 0.3  # there are shadows to keep
    np.testing.assert_allclose(found, alone, atol=tolerance)
    gaussians = Gaussians.from_numpy(together)
    single = np.array(occlude(gaussians, fit_camera(gaussians, light_rows(SUN), 128)))
    assert np.abs(single - alone).mean() > 0.2  # which one camera for both would not


@pytest.mark.parametrize(("occlude", "tolerance"), METHODS)
def test_scattered_models_have_the_shadows_of_each_alone(occlude, tolerance):
    models = [grid_blob(150 + 10 * k, k) for k in range(5)]
    offsets = np.array([[0, 0, 0], [100, 0, 7], [-80, 64, 0], [16, -120, 40], [33, 90, -50]])
    found = shadows(join(*(moved(model, offset) for model, offset in zip(models, offsets, strict=True))), occlude)
    np.testing.assert_allclose(found, np.concatenate([shadows(model, occlude) for model in models]), atol=tolerance)


@pytest.mark.parametrize(("occlude", "tolerance"), METHODS)
def test_a_shield_far_towards_the_sun_shades_the_model_behind_it_alone(occlude, tolerance):
    one, other = grid_blob(600, 1), moved(grid_blob(300, 2), np.array([64, 0, 0]))
    rng = np.random.default_rng(9)
    x, y, _ = light_axes(SUN).T
    spots = rng.uniform(-1.2, 1.2, (3000, 2))
    shield = blob(3000, (0, 0, 0), sigma=0.05)
    shield["means"] = spots @ [x, y] + np.array([64, 0, 0]) + 300 * SUN
    found, without = shadows(join(one, other, shield), occlude), shadows(join(one, other), occlude)
    assert found[600:900].min() > 0.95
    assert without[600:900].mean() < 0.8
    np.testing.assert_allclose(found[:600], without[:600], atol=tolerance)


@pytest.mark.parametrize(("occlude", "tolerance"), METHODS)
def test_shadows_in_clusters_repeat_to_the_bit_and_know_no_order(occlude, tolerance):
    arrays = join(grid_blob(300, 1), moved(grid_blob(200, 2), np.array([64, 0, 0])))
    first = shadows(arrays, occlude)
    assert np.array_equal(first, shadows(arrays, occlude))
    order = np.random.default_rng(3).permutation(500)
    again = shadows({name: value[order] for name, value in arrays.items()}, occlude)
    np.testing.assert_allclose(again, first[order], atol=0.1 * tolerance)
