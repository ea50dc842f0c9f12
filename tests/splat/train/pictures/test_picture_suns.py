"""Suns estimated in training: resume to the bit, what a run tells of them, time order, sentences."""

import json
from dataclasses import replace

import numpy as np
import pytest
from tiny import REFINED

from spacesim.data.errors import InputError
from spacesim.data.geometry import degrees_between, fibonacci_sphere
from spacesim.data.images import write_png
from spacesim.data.records import Camera, Dataset, Frame, Sun
from spacesim.splat import sun_search
from spacesim.splat.fit import estimate_sun, find_unknowns
from spacesim.splat.run import load_run
from spacesim.splat.sun_search import SPHERE, SmallPicture, SunFinder
from spacesim.splat.train.checkpoint import read_tensors
from spacesim.splat.train.config import preset, with_settings
from spacesim.splat.train.pictures import suns
from spacesim.splat.train.pictures.learned import LearnedPictures
from spacesim.splat.train.pictures.suns import CHANCE, CHOICES, FirstSuns, SunEstimation, time_order
from spacesim.splat.train.start import MANY_PICTURES, MANY_STEPS, sun_warning
from spacesim.splat.train.train import train
from spacesim.splat.train.views import TrainingViews

SHADOWS = with_settings(preset("demo", "shadow-map"), REFINED)
CONFIG = replace(SHADOWS, sun="unknown", init_count=150, iterations=20, checkpoint_every=6)


@pytest.fixture
def sunless(small_dataset):
    """The training pictures under unknown Suns, each three times, so that there are enough."""
    frames = tuple(replace(frame, sun=None) for frame in small_dataset.train)
    return replace(small_dataset, train=tuple(frames * 3)[: max(8, len(frames))])


@pytest.fixture
def quick(monkeypatch):
    """Few comparisons, with few Suns: one in training, one at its end."""
    monkeypatch.setattr(sun_search, "SPHERE", 60)
    monkeypatch.setattr(suns, "SPHERE", 60)
    monkeypatch.setattr(suns, "SEARCHES", (0.5,))
    monkeypatch.setattr(suns, "SHAPE_STEPS", 12)
    monkeypatch.setattr(suns, "LOOKED_AT", 16)


class StoppedError(Exception):
    pass


def test_training_estimates_and_resumes_to_the_bit(sunless, quick, tmp_path):
    whole = train(sunless, tmp_path / "whole", CONFIG)

    def stop(progress) -> None:
        if progress.iteration == progress.iterations == CONFIG.iterations:
            raise StoppedError

    with pytest.raises(StoppedError):  # after the last checkpoint at 18, before the model is written
        train(sunless, tmp_path / "again", CONFIG, on_progress=stop)
    assert (tmp_path / "again" / "suns.safetensors").exists()
    again = train(sunless, tmp_path / "again", CONFIG, resume=True)
    names = "model.safetensors", "cameras.json"
    for name in names:
        assert (whole.path / name).read_bytes() == (again.path / name).read_bytes(), name
    frames = json.loads((whole.path / "cameras.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == [frame.file_path for frame in sunless.train]
    found = np.array([frame["sun_direction"] for frame in frames])
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1)
    assert all(0 <= frame["sun_sigma_deg"] <= 180 for frame in frames)
    assert whole.training["suns"]["sigma_deg"] == pytest.approx(np.median([frame["sun_sigma_deg"] for frame in frames]))
    assert (whole.path / "shape" / "model.safetensors").exists()
    assert [unknown.name for unknown in find_unknowns(whole)] == ["sun"]


def test_a_run_tells_the_sun_of_a_new_picture(small_dataset, quick, tmp_path):
    """Of any method that takes the Sun; here only that it is one, the same each time, and what is refused."""
    config = replace(CONFIG, sun="given", iterations=10)
    lit = tuple(replace(frame, sun=Sun.from_angles(30, 40)) for frame in small_dataset.train)
    run = train(replace(small_dataset, train=lit), tmp_path / "run", config)
    frame = small_dataset.train[0]
    picture = np.full((frame.camera.height, frame.camera.width, 4), 0.5)
    estimate = estimate_sun(run, picture, frame.camera)
    assert np.linalg.norm(estimate.direction) == pytest.approx(1)
    black = np.concatenate([0 * picture[..., :3], picture[..., 3:]], axis=-1)
    with pytest.raises(InputError, match="image: expected light on the object, found none"):
        estimate_sun(run, black, frame.camera)
    with pytest.raises(InputError, match="no pixel that counts"):
        estimate_sun(run, np.zeros_like(picture), frame.camera)
    with pytest.raises(InputError, match=r"image: expected \["):
        estimate_sun(run, picture[1:], frame.camera)
    plain = train(small_dataset, tmp_path / "plain", replace(preset("demo"), init_count=100, iterations=3))
    with pytest.raises(InputError, match="run: expected one of a method that takes the Sun, found vanilla"):
        estimate_sun(plain, picture, frame.camera)


def test_shadows_of_a_run_are_cast_for_its_first_picture_and_kept(small_dataset, quick, tmp_path, monkeypatch):
    """But for those of rings about the best Sun. Where they take too much, they are cast again, to the same bits."""
    lit = tuple(replace(frame, sun=Sun.from_angles(30, 40)) for frame in small_dataset.train)
    data = replace(small_dataset, train=lit)
    run = train(data, tmp_path / "run", replace(CONFIG, sun="given", iterations=10))
    cast: list[int] = []
    sunlight = type(run.light).sunlight
    monkeypatch.setattr(type(run.light), "sunlight", lambda *args: (cast.append(1), sunlight(*args))[1])

    def asked(picture: int) -> tuple[int, bytes]:
        frame, before = lit[picture], len(cast)
        pixels = np.full((frame.camera.height, frame.camera.width, 4), 0.5)
        found = estimate_sun(run, pixels, frame.camera)
        return len(cast) - before, found.direction.tobytes() + np.float64(found.sigma_deg).tobytes()

    of_rings = 2 * (sun_search.RING + 1)
    first, second, again = asked(0), asked(1), asked(0)
    assert first[0] >= sun_search.SPHERE / 2 + of_rings
    assert second[0] < sun_search.SPHERE / 2
    assert again == (of_rings, first[1])
    monkeypatch.setattr(sun_search, "KEPT_BYTES", 0)
    run = load_run(run.path)
    assert asked(0) == first
    found = asked(1)
    assert found[0] >= sun_search.SPHERE / 2 + of_rings
    assert found[1] == second[1]


def test_the_lowest_of_several_valleys_is_found_by_half_the_lattice(small_dataset, tmp_path, monkeypatch):
    """Wherever it is, and 10 degrees across."""
    lit = tuple(replace(frame, sun=Sun.from_angles(30, 40)) for frame in small_dataset.train)
    run = train(replace(small_dataset, train=lit), tmp_path / "run", replace(CONFIG, sun="given", iterations=2))
    picture = SmallPicture(lit[0].camera, np.zeros((32, 32, 3)), np.ones((32, 32), bool))
    finder = SunFinder(run.gaussians, run.light, run.antialiased, run.curve)
    for true in np.random.default_rng(3).normal(size=(20, 3)):
        valleys = np.stack([true, *np.random.default_rng(4).normal(size=(3, 3))])
        valleys /= np.linalg.norm(valleys, axis=1, keepdims=True)
        looked: list[int] = []

        def losses(_seen, directions, _numbers, valleys=valleys, looked=looked):
            looked.append(len(directions))
            angles = degrees_between(np.reshape(directions, (-1, 3)) @ valleys.T)
            return 200 - np.exp(-0.5 * (angles / 10) ** 2) @ [100, 80, 80, 80]

        monkeypatch.setattr(finder, "_losses", losses)
        assert finder.estimate(picture).loss < losses(None, valleys[:1], [], looked=[])[0] + 2
        assert sum(looked) < 0.65 * SPHERE


def test_a_sun_stays_on_the_sphere_and_follows_its_gradient(sunless):
    start = fibonacci_sphere(len(sunless.train))
    first = FirstSuns(start, np.zeros((len(start), CHOICES), int))
    estimation = SunEstimation(sunless, first, 0.01, 100)
    way = np.cross(start[2], [0.6, 0.0, 0.8])
    for step in range(5):
        estimation.learn(2, step, -way - 3 * estimation.direction(2))  # what points outwards does not count
    moved = estimation.direction(2)
    assert np.linalg.norm(moved) == pytest.approx(1)
    assert 0.02 < np.arccos(moved @ start[2]) < 0.1
    assert (moved - start[2]) @ way > 0.99 * np.linalg.norm(moved - start[2]) * np.linalg.norm(way) * 0.9
    np.testing.assert_array_equal(estimation.direction(1), start[1])


def test_some_pictures_are_held_out_at_first(sunless):
    """Until the search that looks for their Suns by halves; the next picture is drawn in place of each."""
    estimation = SunEstimation(sunless, FirstSuns(fibonacci_sphere(8), np.zeros((8, CHOICES), int)), 0.01, 100)
    assert [picture for picture in range(8) if estimation.waits(picture, 59)] == [0, 5]
    assert not any(estimation.waits(picture, 60) for picture in range(8))
    pictures = LearnedPictures(
        sunless, replace(CONFIG, iterations=100), FirstSuns(fibonacci_sphere(8), np.zeros((8, CHOICES), int))
    )
    views = TrainingViews(sunless, 0)
    drawn = {step: [pictures.taught(views, number, step).index for number in range(8)] for step in (0, 60)}
    assert sorted(drawn[0]) == [1, 1, 2, 3, 4, 6, 6, 7]
    assert sorted(drawn[60]) == list(range(8))


def test_what_is_told_of_suns_is_what_pictures_held_out_say(sunless):
    estimation = SunEstimation(sunless, FirstSuns(fibonacci_sphere(8), np.zeros((8, CHOICES), int)), 0.01, 100)
    estimation.sigmas = np.array([1.0, 2, 2, 2, 2, 2, 4, 60])
    assert (estimation.told() == CHANCE).all()  # nothing is known of it
    assert "no picture held out shows enough of an object" in estimation.sentence()
    estimation.apart = np.array([20.0, np.nan])
    np.testing.assert_array_equal(estimation.told(), [20.0] * 7 + [60.0])
    assert (
        "estimated to 20.0 degrees (median), unless the model is wrong as a whole: two halves of 1 "
        in estimation.sentence()
    )
    estimation.apart = np.array([0.5, 0.5])  # never less than their own
    np.testing.assert_array_equal(estimation.told(), estimation.sigmas)
    estimation.apart = np.array([100.0, 170.0])
    assert np.median(estimation.told()) == CHANCE
    assert "Suns are hardly known" in estimation.sentence()


def test_frames_that_tell_their_time_are_in_order(sunless):
    frames = [replace(frame, time=float(time)) for frame, time in zip(sunless.train, range(9, 0, -1), strict=False)]
    np.testing.assert_array_equal(time_order(frames), np.arange(len(frames))[::-1])
    assert time_order(sunless.train) is None
    assert time_order([replace(frame, time=1.0) for frame in sunless.train]) is None


@pytest.mark.parametrize(
    "damage",
    [
        lambda tensors: {**tensors, "directions": tensors["directions"][1:]},
        lambda tensors: {**tensors, "directions": np.nan * tensors["directions"]},
        lambda tensors: {**tensors, "choices": tensors["choices"] + SPHERE},
        lambda tensors: {"directions": tensors["directions"]},
    ],
)
def test_invalid_first_suns_are_refused(damage, tmp_path):
    whole = FirstSuns(fibonacci_sphere(9), np.zeros((9, CHOICES), int)).tensors()
    np.testing.assert_array_equal(FirstSuns.of(whole, 9, tmp_path).directions, whole["directions"])
    with pytest.raises(InputError, match="expected the Suns of 9 pictures"):
        FirstSuns.of(damage(whole), 9, tmp_path)


def test_configurations_that_cannot_estimate_suns_are_refused(small_dataset, tmp_path):
    with pytest.raises(InputError, match="sun: expected a method that takes the Sun, as shadow-map, found vanilla"):
        with_settings(preset("demo"), {"sun": "unknown"})
    few = replace(small_dataset, train=small_dataset.train[:3])
    with pytest.raises(InputError, match="sun: expected at least 8 training pictures to estimate it, found 3"):
        train(few, tmp_path / "run", CONFIG)
    assert not (tmp_path / "run").exists()


def test_poses_are_learned_under_suns_that_are_estimated(sunless, tmp_path, quick):
    run = train(sunless, tmp_path / "run", replace(CONFIG, refine_poses=True))
    values = read_tensors(run.path / "poses.safetensors")[0]["values"]
    assert values.shape == (len(sunless.train), 6)
    assert np.abs(values).max() > 0
    assert {"poses", "suns"} <= set(json.loads((run.path / "training.json").read_text()))


def test_data_that_cannot_determine_suns_are_warned_of(tmp_path):
    """By their pixels: alpha of ones, or a mask that hides nothing, cuts nothing out."""
    half, whole = np.full((4, 4), 255, np.uint8), np.full((4, 4), 255, np.uint8)
    half[:2] = 0
    for name, alpha in (("alpha", half), ("ones", whole)):
        write_png(tmp_path / f"{name}.png", np.dstack([np.zeros((4, 4, 3), np.uint8), alpha]))
        write_png(tmp_path / f"{name}_mask.png", alpha)
    write_png(tmp_path / "opaque.png", np.zeros((4, 4, 3), np.uint8))
    camera = Camera.from_fov(np.eye(4), 4, 4, 40)
    opaque = Frame("opaque.png", camera)

    def remark(*frames, steps=MANY_STEPS):
        return sun_warning(Dataset(tmp_path, frames, ()), steps)

    few, bare = "12 training pictures", "no silhouette, mask or alpha"
    for frame in (opaque, replace(opaque, file_path="ones.png"), replace(opaque, mask_path="ones_mask.png")):
        assert few in remark(*[frame] * 12)
        assert bare in remark(*[frame] * 12)
        assert bare in remark(*[frame] * MANY_PICTURES)
        assert few not in remark(*[frame] * MANY_PICTURES)
    masks = ({"silhouette_path": "alpha_mask.png"}, {"mask_path": "alpha_mask.png"})
    for cut_out in (replace(opaque, file_path="alpha.png"), *(replace(opaque, **mask) for mask in masks)):
        assert few in remark(*[cut_out] * 12)
        assert bare not in remark(*[cut_out] * 12)
        assert remark(*[cut_out] * MANY_PICTURES) == ""
        assert f"found 400 iterations where it takes {MANY_STEPS}" in remark(*[cut_out] * MANY_PICTURES, steps=400)
        assert bare in remark(*[cut_out] * 20, *[opaque] * 60)  # of most


def test_training_warns_of_suns_that_may_be_far_off(sunless, quick, tmp_path, caplog):
    def stop(progress) -> None:
        raise StoppedError

    with pytest.raises(StoppedError):
        train(sunless, tmp_path / "run", CONFIG, on_progress=stop)
    assert any("they may be far off" in record.getMessage() for record in caplog.records)


def test_the_shape_comes_by_the_trainings_own_decay():
    """Runs from before presets had another one go on."""
    for decay in ("exponential", "quadratic"):
        config = with_settings(preset("demo", "shadow-map"), {"sun": "unknown", "rates.decay": decay})
        assert suns.shape_config(config).rates.decay == decay


def test_first_suns_are_looked_for_with_the_anti_aliasing_filter(sunless, monkeypatch):
    """Small pictures of a model that was trained on large ones: 22.7 degrees off without it, 17.3 with it."""
    filters = []

    class Search:
        sphere = fibonacci_sphere(SPHERE)

        def __init__(self, gaussians, antialiased, distance):
            filters.append(antialiased)

        def losses(self, pictures):
            return np.tile(np.arange(SPHERE, dtype=float), (len(pictures), 1))

    monkeypatch.setattr(suns, "ShapeSearch", Search)
    found = suns.first_suns(sunless, None, 5.0)
    assert filters == [True]
    np.testing.assert_array_equal(found.directions, np.tile(Search.sphere[0], (len(sunless.train), 1)))
