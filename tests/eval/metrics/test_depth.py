"""Errors of depth: by hand, and through an evaluation."""

import json
from dataclasses import replace

import numpy as np
import pytest

from spacesim.cli.printing import print_headline
from spacesim.data.images import read_exr, write_exr
from spacesim.eval.evaluate import evaluate
from spacesim.eval.metrics.depth import depth_metrics
from spacesim.eval.report.write import write_report


def test_errors_by_hand():
    truth = np.array([[2.0, 2.0, 4.0, 4.0, 0.0]], np.float32)
    predicted = np.array([[2.5, 2.0, 3.0, 0.0, 7.0]], np.float32)
    found = depth_metrics(predicted, truth, truth > 0)
    assert found == pytest.approx({"mae": 1.5 / 3, "rmse": np.sqrt(1.25 / 3), "missing": 0.25})


def test_what_is_nowhere_has_no_error():
    truth = np.full((2, 2), 3.0)
    assert depth_metrics(np.zeros((2, 2)), truth, truth > 0) == {"mae": None, "rmse": None, "missing": 1.0}
    assert set(depth_metrics(truth, truth, np.zeros((2, 2), bool)).values()) == {None}


@pytest.fixture
def shifted(make_run, dataset):
    """A run that is half a metre too near in the fourth frame, and sees nothing, or infinitely far, in the third."""
    run = make_run()
    predict = run.predict

    def shifted_predict(camera, sun, exposure=None):
        index = next(i for i, frame in enumerate(dataset.test) if frame.camera is camera)
        prediction = predict(camera, sun, exposure)
        depth = prediction.depth - 0.5 * (index == 3)
        if index == 2:
            depth[:, :20], prediction.alpha[:, 20:] = np.inf, 0
        return replace(prediction, depth=depth)

    run.predict = shifted_predict
    return run


def test_frames_say_their_depth_and_the_report_shows_it(shifted, dataset, tmp_path, capsys):
    metrics = evaluate(shifted, dataset, tmp_path / "eval")
    assert [frame["depth"]["mae"] for frame in metrics["frames"]] == [0, 0, None, 0.5]
    assert [frame["depth"]["missing"] for frame in metrics["frames"]] == [0, 0, 1, 0]
    assert metrics["depth"]["mae"] == pytest.approx({"mean": 1 / 6, "std": np.std([0, 0.5, 0]), "count": 3})
    assert metrics["depth"]["missing"]["mean"] == 0.25
    note = "Depth MAE over the object's pixels is null in 1 of 4 frames: no pixel of an object has a predicted depth"
    assert any(sentence.startswith(note) for sentence in metrics["notes"])
    print_headline(metrics)
    assert "depth: mean error 0.167 m, missing 0.2500 of the pixels" in capsys.readouterr().out
    write_report([tmp_path / "eval"], tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "Depth MAE <small>[m]</small> ↓" in page
    assert "0.167 <small>± 0.236</small>" in page
    assert "mean error 0.5 m" in page


def test_lengths_have_digits_that_count(shifted, dataset, tmp_path):
    """However small an object is."""
    evaluate(shifted, dataset, tmp_path / "eval")
    metrics = json.loads((tmp_path / "eval/metrics.json").read_text())
    metrics["depth"]["mae"] = {"mean": 2.345e-5, "std": 1.2e-6, "count": 3}
    (tmp_path / "eval/metrics.json").write_text(json.dumps(metrics))
    write_report([tmp_path / "eval"], tmp_path / "report.html")
    assert "2.35e-05 <small>± 1.2e-06</small>" in (tmp_path / "report.html").read_text()


def test_pixels_that_show_no_object_count_nowhere(make_run, dataset, tmp_path):
    """A truth that is a metre off where no object is, in one frame; others have none at all."""
    path = dataset.root / dataset.test[0].gt_path
    layers = read_exr(path)
    ids, depth = layers["object_id"].copy(), layers["depth"].copy()
    ids[20, 10:20], depth[20, 10:20] = 0, 2
    write_exr(path, layers | {"object_id": ids, "depth": depth})
    frames = dataset.test[0], *(replace(frame, gt_path=None) for frame in dataset.test[1:])
    metrics = evaluate(make_run(), replace(dataset, test=frames), tmp_path / "eval")
    assert metrics["depth"]["mae"] == {"mean": 0, "std": 0, "count": 1}
    assert [frame["depth"] is None for frame in metrics["frames"]] == [False, True, True, True]


def test_data_without_truth_has_none_and_says_so(make_run, dataset, tmp_path):
    poorer = replace(dataset, test=tuple(replace(frame, gt_path=None) for frame in dataset.test))
    metrics = evaluate(make_run(), poorer, tmp_path / "eval")
    assert metrics["depth"] is None
    assert "depth and by_grazing_angle are null: the data has no path-traced truth." in metrics["notes"]
