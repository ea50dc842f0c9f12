"""A film's cameras on a smooth path: what is pulled to it, what is left alone, and slopes against differences."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spacesim.data.geometry import fibonacci_sphere, look_at
from spacesim.data.importers.video import path
from spacesim.data.importers.video.model import SfmModel
from spacesim.data.importers.video.path import Features, begun_anew, is_smooth, on_path, strays, without_strays

SOFT = 0.3


def film_path(shake: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Times and positions [60, 3] of a camera that flies around and, after a cut, comes nearer, at a distance of about
    one, shaken by `shake` of that."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.integers(1, 4, 60)).astype(float)
    angles = np.radians(0.5 * times)
    around = np.stack([np.cos(angles), np.sin(angles), 0.2 * angles], axis=1)
    nearer = np.array([[0.0, 0.0, 1.3]]) - np.outer(times - times[40], [0.0, 0.0, 0.01])
    path = np.where((np.arange(60) < 40)[:, None], around, nearer)
    return times, path + rng.normal(0, shake / np.sqrt(3), path.shape)


def filmed(positions: np.ndarray, halves: bool = False) -> tuple[SfmModel, Features]:
    """Cameras at `positions` [N, 3] that look at points about the origin, and what they see; with halves only eight
    points are seen by both the first and the second half of them."""
    poses = np.array([look_at(position, (0.0, 0.0, 0.0)) for position in positions])
    points = 0.2 * fibonacci_sphere(80)
    half = (np.arange(len(poses)) >= len(poses) // 2)[:, None] == (np.arange(80) % 2 == 1)
    half |= np.arange(80) % 10 == 0
    pictures, seen = np.nonzero(half if halves else np.ones((len(poses), 80), bool))
    model = SfmModel(
        names=tuple(f"{k:03d}" for k in range(len(poses))),
        world_from_camera=poses,
        focal=800.0,
        centre=(320.0, 240.0),
        k1=0.05,
        width=640,
        height=480,
        points=points,
        colors=np.zeros((80, 3), np.uint8),
        errors=np.zeros(80),
        seen_by=tuple(tuple(pictures[seen == k].tolist()) for k in range(80)),
        sizes=(len(poses),),
    )
    return model, Features(pictures, seen, pixels_of(model, pictures, seen))


def pixels_of(model: SfmModel, pictures: np.ndarray, points: np.ndarray) -> np.ndarray:
    poses = model.world_from_camera[pictures]
    local = np.einsum("nji,nj->ni", poses[:, :3, :3], model.points[points] - poses[:, :3, 3])
    flat = local[:, :2] / local[:, 2:]
    return model.focal * (1 + model.k1 * np.square(flat).sum(axis=1, keepdims=True)) * flat + model.centre


def arc(count: int, degrees: float = 1.2) -> np.ndarray:
    angles = np.radians(degrees) * np.arange(count)
    return np.stack([np.cos(angles), np.sin(angles), 0.3 + 0.1 * angles], axis=1)


def test_a_film_whose_halves_stand_askew_is_put_straight():
    """They are tied by a few points whose features in one half are three pixels off."""
    true = arc(40)
    model, features = filmed(true, halves=True)
    turn = Rotation.from_rotvec([0.0, 0.01, 0.005]).as_matrix()
    poses, points, pixels = model.world_from_camera.copy(), model.points.copy(), features.pixels.copy()
    poses[:20, :3] = turn @ poses[:20, :3]
    points[::2] = points[::2] @ turn.T
    askew = replace(model, world_from_camera=poses, points=points)
    late = (features.pictures >= 20) & (features.points % 10 == 0)
    pixels[late] += 3 * np.random.default_rng(0).normal(size=pixels[late].shape)
    straight = on_path(askew, replace(features, pixels=pixels), np.arange(40.0), SOFT)

    def step(model: SfmModel) -> float:
        """Between the halves, beside what the camera moves there."""
        return float(np.linalg.norm(np.diff(model.positions[18:22], n=3, axis=0)))

    assert step(askew) > 0.01
    assert step(straight) < 0.05 * step(askew)


def test_what_is_seen_well_stays_and_a_frame_begun_wrong_is_found():
    true = arc(30)
    model, features = filmed(true)
    poses = model.world_from_camera.copy()
    poses[7] = look_at(true[7] + [0.0, 0.03, 0.02], (0.0, 0.02, 0.0))
    found = on_path(replace(model, world_from_camera=poses), features, np.arange(30.0), SOFT)
    np.testing.assert_allclose(found.positions, true, atol=1e-3)
    assert found.errors.max() < 0.05  # pixels
    broken = replace(features, pixels=np.where(features.points[:, None] == 3, np.nan, features.pixels))
    assert on_path(model, broken, np.arange(30.0), SOFT) is model
    few = replace(model, names=model.names[:5])
    assert on_path(few, features, np.arange(5.0), SOFT) is few


def with_noise(features: Features, pixels: float, seed: int) -> Features:
    noise = np.random.default_rng(seed).normal(0, pixels, features.pixels.shape)
    return replace(features, pixels=features.pixels + noise)


def by_features(model: SfmModel, features: Features, times: np.ndarray) -> SfmModel:
    """The model adjusted to its features alone."""
    return path._adjusted(model, path._Problem(model, features, times, SOFT, np.inf))


@pytest.mark.parametrize("pixels", [0.1, 0.3])
@pytest.mark.parametrize("seed", range(3))
def test_a_smooth_film_is_told_from_a_shaking_hand(pixels, seed):
    for shake in (0.0, 0.005):
        times, positions = film_path(shake, seed)
        model, features = filmed(positions)
        features = with_noise(features, pixels, seed)
        found = by_features(model, features, times)
        assert is_smooth(found, features, times, SOFT) == (shake == 0)


def test_a_camera_in_the_mirrored_pose_of_a_flat_object_is_begun_anew():
    """Seen from far, a disc that tilts to the left looks like one that tilts to the right."""
    angles = np.radians(np.linspace(-12, 12, 25))
    true = 6 * np.stack([np.sin(angles), np.full(25, 0.05), np.cos(angles)], axis=1)
    model, _ = filmed(true)
    flat = replace(model, points=model.points * [1.5, 1.5, 0.01], focal=4000.0, k1=0.0)
    pictures, points = np.repeat(np.arange(25), 80), np.tile(np.arange(80), 25)
    features = with_noise(Features(pictures, points, pixels_of(flat, pictures, points)), 0.1, 0)
    flat = by_features(flat, features, np.arange(25.0))
    assert begun_anew(flat, features, np.arange(25.0), SOFT) is flat
    poses = flat.world_from_camera.copy()
    poses[20] = look_at(true[20] * [-1, 1, 1], (0.0, 0.0, 0.0))
    wrong = by_features(replace(flat, world_from_camera=poses), features, np.arange(25.0))
    assert np.linalg.norm(wrong.positions[20] - true[20]) > 0.5  # an optimum of its own
    found = begun_anew(wrong, features, np.arange(25.0), SOFT)
    assert np.linalg.norm(found.positions[20] - true[20]) < 0.1


@pytest.mark.parametrize("count", [3, 4, 5, 12])
def test_few_pictures_and_features_that_say_nothing_end_as_they_were(count):
    model, features = filmed(arc(count))
    times = np.arange(float(count))
    assert begun_anew(model, features, times, SOFT) is model
    bare = features.pictures != 1
    without = Features(features.pictures[bare], features.points[bare], features.pixels[bare])
    assert begun_anew(model, without, times, SOFT) is model
    broken = replace(features, pixels=np.where(features.points[:, None] == 3, np.nan, features.pixels))
    assert begun_anew(model, broken, times, SOFT) is model
    still = replace(model, world_from_camera=np.repeat(model.world_from_camera[:1], count, axis=0))
    assert np.isfinite(begun_anew(still, features, times, SOFT).positions).all()
    assert not is_smooth(filmed(arc(5))[0], filmed(arc(5))[1], np.arange(5.0), SOFT)


def test_a_smooth_film_is_better_on_its_path_and_its_cut_stays():
    times, positions = film_path(0.0, 0)
    model, features = filmed(positions)
    features = with_noise(features, 0.3, 0)
    loose = by_features(model, features, times)
    found = on_path(loose, features, times, SOFT)
    off = [np.linalg.norm(one.positions - positions, axis=1) for one in (found, loose)]
    assert off[0].mean() < 0.7 * off[1].mean()
    assert np.linalg.norm(found.positions[40] - found.positions[39]) == pytest.approx(
        np.linalg.norm(positions[40] - positions[39]), rel=0.01
    )


def test_a_point_behind_a_camera_that_shows_it_has_no_error_that_is_believed():
    model, features = filmed(arc(14))
    behind = model.points.copy()
    behind[5] = 40.0 * model.positions[0]
    found = on_path(replace(model, points=behind), features, np.arange(14.0), SOFT)
    assert np.isfinite(np.delete(found.errors, 5)).all()
    assert found.errors[5] > 2 or np.linalg.norm(found.points[5] - model.points[5]) < 0.01


def test_a_frame_whose_features_are_elsewhere_is_left_out(caplog):
    places = arc(20)
    places[12] *= 1.03
    model, features = filmed(places)
    found = without_strays(on_path(model, features, np.arange(20.0), SOFT), np.arange(20.0))
    assert found.names == model.names[:12] + model.names[13:]
    assert len(found.world_from_camera) == 19
    assert {k for frames in found.seen_by for k in frames} == set(range(19))
    assert [record.getMessage() for record in caplog.records] == ["left out, off the camera's smooth path: 012"]


def test_slopes_are_those_of_differences():
    model, features = filmed(arc(14), halves=True)
    rng = np.random.default_rng(0)
    features = replace(features, pixels=features.pixels + rng.normal(0, 0.5, features.pixels.shape))
    problem = path._Problem(model, features, np.cumsum(rng.integers(1, 4, 14)).astype(float), SOFT, 1e-3)
    state = model.world_from_camera[:, :3, :3], model.positions, model.points
    slopes, residuals = problem.linearized(*state)
    step = rng.normal(0, 1e-7, slopes.shape[1])
    costs = [problem.cost(*path._moved(state, sign * step)) for sign in (1, -1)]
    assert costs[0] - costs[1] == pytest.approx(2 * 2 * residuals @ (slopes @ step), rel=1e-5)  # of log(1 + r^2)
    normal, right = (slopes.T @ slopes + np.eye(len(step))), rng.normal(size=len(step))
    solved = path._solved(path.sparse.csr_array(normal), right, len(model.points))
    np.testing.assert_allclose(normal @ solved, right, atol=1e-6)


@pytest.mark.parametrize("shake", [0.0, 0.001, 0.003])
def test_a_frame_off_the_path_of_a_film_is_found(shake):
    times, positions = film_path(shake, 1)
    assert strays(positions, times, np.ones(60)) == []
    positions[[20, 23]] += [[0.03, 0.0, 0.0], [0.0, 0.03, 0.0]]
    assert strays(positions, times, np.ones(60)) == [20, 23]


@pytest.mark.parametrize("seed", range(5))
def test_a_shaking_hand_is_no_error(seed):
    times, positions = film_path(0.02, seed)
    assert strays(positions, times, np.ones(60)) == []
    few = np.arange(8)
    assert strays(positions[few], times[few], np.ones(8)) == []
