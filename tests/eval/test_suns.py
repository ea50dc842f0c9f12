"""Known and unseen Suns, errors by grazing angle, one view under many Suns."""

import json
import math
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from spacesim.data.geometry import look_at
from spacesim.data.identity import training_digest
from spacesim.data.images import read_png, write_png
from spacesim.data.records import Camera, Frame, Sun
from spacesim.data.store import read_dataset
from spacesim.eval import relight
from spacesim.eval.metrics import grazing
from spacesim.eval.suns import count_suns, known_suns, training_frames

FAR = Camera.from_fov(look_at([10.0, 0, 0], [0, 0, 0]), 16, 12, 30)
"""Looks along -x."""


def frame(sun=None, camera=FAR, name="a.png"):
    return Frame(name, camera, None if sun is None else Sun.from_angles(*sun))


def test_a_sun_is_known_within_a_hundredth_of_a_degree():
    training = [frame((30, 20)), frame((200, -40)), frame()]
    suns = [(30, 20), (30, 20.009), (30, 20.011), (30 + 0.009 / math.cos(math.radians(20)), 20), (-160, -40), (20, 30)]
    evaluated = [*map(frame, suns), frame()]
    assert known_suns(evaluated, training) == [True, True, False, True, True, False, None]
    assert known_suns(evaluated, [frame()]) == [None] * 7
    assert known_suns(evaluated, []) == [None] * 7
    assert count_suns([frame((30, 20)), frame((390, 20)), frame((30, 20.01)), frame()]) == 2


def lit_by(root, *suns):
    """A dataset of one training frame for each Sun."""
    frames = [
        {
            "file_path": f"{k}.png",
            "transform_matrix": np.eye(4).tolist(),
            "sun_direction": Sun.from_angles(*sun).direction,
        }
        for k, sun in enumerate(suns)
    ]
    for one in frames:
        write_png(root / one["file_path"], np.zeros((2, 2, 3), np.uint8))
        one["sun_direction"] = one["sun_direction"].tolist()
    names = [one["file_path"] for one in frames]
    record = {"w": 2, "h": 2, "fl_x": 2.0, "train_filenames": names, "test_filenames": [], "frames": frames}
    (root / "transforms.json").write_text(json.dumps(record))
    return read_dataset(root)


def test_known_suns_are_those_of_the_runs_own_data(tmp_path):
    own, other = lit_by(tmp_path / "own", (30, 20)), lit_by(tmp_path / "other", (200, -40))
    config = {"data": {"path": str(own.root.resolve()), "digest": training_digest(own)}}

    def known(dataset):
        trained = training_frames(config, dataset)
        is_own = dataset.root.name in ("own", "moved") and not trained.why_unknown
        assert trained.other == (None if is_own else own.root)
        return known_suns([frame((30, 20)), frame((200, -40))], trained.frames), trained.why_unknown

    assert known(own) == ([True, False], "")
    assert known(other) == ([True, False], "")  # not what the evaluated data would say
    shutil.copytree(own.root, tmp_path / "moved")
    shutil.rmtree(own.root)
    assert known(read_dataset(tmp_path / "moved")) == ([True, False], "")
    assert known(other) == ([None, None], f"the run was trained on other data, {own.root.resolve()}, which is gone")
    changed = lit_by(own.root, (30, 20), (1, 2))
    assert known(other)[0] == known(changed)[0] == [None, None]
    assert "has changed since" in known(changed)[1]
    assert training_frames({"method": "vanilla"}, other).frames == other.train


def by_hand(truth, predicted, true, visibility, mask):
    """The bins, pixel by pixel."""
    bins = [[] for _ in grazing.EDGES_DEG[1:]]
    for at in np.argwhere(mask & (truth.shadow >= 170)):
        y, x = at
        angle = math.degrees(math.asin(truth.sun_cosine[y, x]))
        index = next(i for i, edge in enumerate(grazing.EDGES_DEG[1:]) if angle < edge or edge == 90)
        bins[index].append(
            (
                abs(predicted[y, x] - true[y, x]),
                abs(visibility[y, x] - truth.sun_visibility[y, x]),
                visibility[y, x] < 0.5,
                truth.sun_visibility[y, x] >= 0.5,
            )
        )
    return bins


def some_truth(seed, size=(30, 40)):
    random = np.random.default_rng(seed)
    classes = random.choice([0, 85, 170, 171, 255], size).astype(np.uint8)
    visible = np.where(classes == 255, random.uniform(0.5, 1, size), random.uniform(0, 0.49, size)) * (classes > 85)
    truth = SimpleNamespace(shadow=classes, sun_visibility=visible, sun_cosine=random.uniform(0, 1, size) ** 2)
    return truth, *random.random((3, *size)), random.random(size) < 0.8


def test_grazing_bins_are_those_counted_by_hand():
    frames = [some_truth(seed) for seed in (1, 2)]
    pooled = [first + second for first, second in zip(*(by_hand(*one) for one in frames), strict=True)]
    bins = grazing.summary([grazing.tally(*one) for one in frames] + [None])
    assert [(one["from_deg"], one["to_deg"]) for one in bins] == [(0, 5), (5, 10), (10, 20), (20, 40), (40, 90)]
    for one, pixels in zip(bins, pooled, strict=True):
        luminance, seen, dark, lit = (np.array(column) for column in zip(*pixels, strict=True))
        assert one["pixels"] == len(pixels) > 10
        assert one["luminance_mae"] == pytest.approx(luminance.mean())
        assert one["visibility_mae"] == pytest.approx(seen.mean())
        assert one["error_rate"] == pytest.approx((dark == lit).mean())
        assert one["false_shadow"] == pytest.approx(dark[lit].mean())
        assert one["missed_shadow"] == pytest.approx((~dark[~lit]).mean())


def test_grazing_without_visibility_or_pixels_is_null():
    truth, predicted, true, _, mask = some_truth(1)
    bins = grazing.summary([grazing.tally(truth, predicted, true, None, mask)])
    assert all(one["luminance_mae"] > 0 for one in bins)
    assert {one[key] for one in bins for key in ("visibility_mae", "error_rate", "false_shadow")} == {None}
    nothing = grazing.summary([grazing.tally(truth, predicted, true, predicted, np.zeros_like(mask))])
    assert {one["luminance_mae"] for one in nothing} == {None}
    assert {one["pixels"] for one in nothing} == {0}
    assert grazing.summary([None, None]) is None
    assert grazing.summary([]) is None


def test_cosines_beyond_one_fall_into_the_last_bin():
    ones = np.ones((1, 2))
    truth = SimpleNamespace(
        shadow=np.full((1, 2), 255), sun_visibility=ones, sun_cosine=np.array([[1.0000001, -1e-9]], np.float32)
    )
    bins = grazing.summary([grazing.tally(truth, ones, ones, ones, ones > 0)])
    assert [one["pixels"] for one in bins] == [1, 0, 0, 0, 1]


def test_phase_angle():
    # the camera stands on +x
    for sun, degrees in {(0, 0): 0, (90, 0): 90, (180, 0): 180, (0, 60): 60}.items():
        assert relight.phase_deg(FAR, frame(sun)) == pytest.approx(degrees, abs=1e-5)


def test_the_sweep_is_of_the_view_with_the_most_suns():
    other = Camera.from_fov(look_at([0.0, 10, 0], [0, 0, 0]), 16, 12, 30)
    evaluated = [frame((90, 0), other), frame((120, 0)), frame((10, 0)), frame((40, 10))]
    sweep = relight.plan_sweep(evaluated, [*evaluated, frame((170, 0)), frame((-60, 0))])
    assert sweep.view is evaluated[2]
    assert [round(one.sun.angles[0]) for one in sweep.lit_as] == [10, 40, 300, 90, 120, 170]
    assert sweep.truths == (evaluated[2], evaluated[3], None, None, evaluated[1], None)


def test_the_sweep_spreads_over_many_suns():
    suns = [(azimuth, 0) for azimuth in range(0, 181)]
    evaluated = [frame((3, 0)), frame((3, 0), name="again.png")]
    sweep = relight.plan_sweep(evaluated, [*evaluated, *map(frame, suns)])
    phases = [relight.phase_deg(FAR, one) for one in sweep.lit_as]
    assert len(phases) == relight.MAX_SUNS
    assert phases == sorted(phases)
    assert sum(truth is not None for truth in sweep.truths) == 1
    assert phases[0] <= 3
    assert phases[-1] == pytest.approx(180)
    assert np.diff(phases[2:]).max() / np.diff(phases[2:]).min() < 1.2
    all_true = relight.plan_sweep(list(map(frame, suns)), [])
    assert None not in all_true.truths
    assert len(all_true.truths) == relight.MAX_SUNS


def test_no_sweep_without_two_suns():
    assert relight.plan_sweep([frame((1, 2)), frame((1, 2)), frame()], [frame((1, 2))]) is None
    assert relight.plan_sweep([frame()], [frame((1, 2)), frame((3, 4))]) is None


def test_write_sweep(relightable, tmp_path):
    run, dataset = relightable(change=lambda rgb: rgb + 0.1)
    found, reason = relight.write_sweep(run, dataset, dataset.test, dataset.train, tmp_path)
    assert reason == ""
    assert found["visibility"]
    assert {tuple(one["sun"]) for one in found["suns"]} == {(30, 20), (200, -10)}
    assert sorted(one["known_sun"] for one in found["suns"]) == [False, True]
    names = {f"{name}_0{k}.png" for name in ("truth", "prediction", "visibility") for k in (0, 1)}
    assert {path.name for path in (tmp_path / "relight").iterdir()} == names
    for index, one in enumerate(found["suns"]):
        truth, prediction = (
            read_png(tmp_path / "relight" / f"{name}_{index:02d}.png") for name in ("truth", "prediction")
        )
        assert np.abs(prediction.astype(float) - np.minimum(truth + 25.5, 255)).max() <= 1.5
        assert one["psnr"] == pytest.approx(20, abs=0.1)


def test_a_run_that_knows_one_light_is_not_swept(make_run, dataset, tmp_path):
    found, reason = relight.write_sweep(make_run(), dataset, dataset.test, (), tmp_path)
    assert found is None
    assert reason == "relight is null: the run shows the same picture under every Sun."
    one = replace(dataset, test=dataset.test[:1])
    assert "fewer than two Suns" in relight.write_sweep(make_run(), one, one.test, (), tmp_path)[1]
    assert not (tmp_path / "relight").exists()
