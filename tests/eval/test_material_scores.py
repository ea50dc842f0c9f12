"""Albedo and normals against the truth: sums by hand, null and why, what reports show of them."""

import json
from dataclasses import replace

import numpy as np
import pytest

from spacesim.data.images import read_exr, read_png, srgb_from_linear, write_exr
from spacesim.eval.evaluate import evaluate
from spacesim.eval.metrics.material import AlbedoSums, albedo_error, normals_deg
from spacesim.eval.report.write import write_report
from spacesim.learning.prediction import MaterialView
from spacesim.splat.raster.gaussians import Gaussians


@pytest.fixture(autouse=True)
def no_weights(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "nowhere"))


@pytest.fixture
def painted(dataset):
    """True albedo 0.2 where columns are below 20, else 0.6, half of that in the last frame; normals along z."""
    for frame in dataset.test:
        layers = read_exr(dataset.root / frame.gt_path)
        columns = np.where(np.arange(40) < 20, 0.2, 0.6) * (0.5 if frame is dataset.test[-1] else 1)
        inside = layers["object_id"] > 0
        layers["albedo"] = (inside * columns)[..., None].repeat(3, axis=-1).astype(np.float32)
        layers["normal"] = (inside[..., None] * np.array([0, 0, 1.0])).astype(np.float32)
        write_exr(dataset.root / frame.gt_path, layers)
    return dataset


def reading(make_run, albedo: float = 0.1):
    """A run that says of everything that its albedo is 0.1, and that it faces 60 degrees away from z."""
    run = make_run()

    def draw_material(camera):
        size = camera.height, camera.width
        normal = np.tile([np.sqrt(0.75), 0, 0.5], (*size, 1))
        colors = np.full((*size, 3), albedo)
        return MaterialView(colors, np.ones(size), np.zeros(size), normal, np.ones(size), 0 * colors)

    run.draw_material = draw_material
    return run


def test_the_error_is_relative_and_has_one_scale(make_run, painted, tmp_path):
    metrics = evaluate(reading(make_run), painted, tmp_path / "eval")
    truths = [read_exr(painted.root / frame.gt_path) for frame in painted.test]
    true = [layers["albedo"][layers["object_id"] > 0].astype(float) for layers in truths]
    mean = np.concatenate(true).mean()  # the best constant in the sense of squares
    assert metrics["albedo_scale"] == pytest.approx(mean / 0.1)
    errors = [np.abs(values - mean).mean() / mean for values in true]
    assert [frame["material"]["albedo_error"] for frame in metrics["frames"]] == pytest.approx(errors)
    every = np.concatenate(true)
    assert metrics["material"]["albedo_error"]["pooled"] == pytest.approx(np.abs(every - mean).sum() / every.sum())
    assert metrics["material"]["albedo_error"]["mean"] == pytest.approx(np.mean(errors))
    assert metrics["material"]["learned_normals_deg"]["mean"] == pytest.approx(60)
    assert metrics["material"]["normals_deg"] is None  # it has no Gaussians
    folder = tmp_path / "eval/frames/test_00000"
    shown = read_png(folder / "albedo.png")[20, 20]
    assert np.abs(shown - 255 * srgb_from_linear(np.array([mean]))).max() <= 0.5
    assert np.abs(read_png(folder / "albedo_truth.png")[20, 25] - 255 * srgb_from_linear(np.array([0.6]))).max() <= 0.5
    assert not read_png(folder / "albedo_truth.png")[0, 0].any()


def test_normals_of_gaussians_are_those_of_the_pictures(make_run, painted, tmp_path):
    """One flat Gaussian before the camera that looks along z, turned by 30 degrees."""
    run, half = make_run(), np.radians(15)
    run.antialiased = False
    run.gaussians = Gaussians.from_numpy(
        {
            "means": np.array([[0, 0, 1.0]]),
            "log_scales": np.log([[2.0, 2.0, 1e-3]]),
            "quaternions": np.array([[np.cos(half), np.sin(half), 0, 0]]),
            "logit_opacities": np.array([9.0]),
            "sh": np.zeros((1, 0, 3)),
        }
    )
    towards = [replace(frame, gt_path=None) for frame in painted.test[:3]] + [painted.test[3]]
    layers = read_exr(painted.root / painted.test[3].gt_path)
    write_exr(painted.root / painted.test[3].gt_path, layers | {"normal": -layers["normal"]})
    metrics = evaluate(run, replace(painted, test=tuple(towards)), tmp_path / "eval")
    assert metrics["material"]["normals_deg"] == pytest.approx(
        {"mean": 30, "std": 0, "count": 1, "pooled": 30}, abs=1e-3
    )
    assert [frame["material"] is None for frame in metrics["frames"]] == [True, True, True, False]
    assert metrics["material"]["albedo_error"] is metrics["albedo_scale"] is None
    assert "albedo_error is null: runs/fake: expected a run with materials, found none." in metrics["notes"]
    assert not list((tmp_path / "eval").rglob("albedo*.png"))


def test_data_without_truth_has_none_and_says_so(make_run, painted, tmp_path):
    poorer = replace(painted, test=tuple(replace(frame, gt_path=None) for frame in painted.test))
    metrics = evaluate(reading(make_run), poorer, tmp_path / "eval")
    assert metrics["material"] is None
    assert "material is null: the data has no path-traced truth." in metrics["notes"]


def test_a_black_run_has_no_scale(make_run, painted, tmp_path):
    metrics = evaluate(reading(make_run, 0.0), painted, tmp_path / "eval")
    assert metrics["albedo_scale"] is metrics["material"]["albedo_error"] is None
    assert metrics["material"]["learned_normals_deg"]["count"] == 4


def test_reports_show_the_numbers_and_both_albedos(make_run, painted, tmp_path):
    evaluate(reading(make_run), painted, tmp_path / "read")
    evaluate(make_run(), painted, tmp_path / "other")
    metrics = json.loads((tmp_path / "read/metrics.json").read_text())
    write_report([tmp_path / "read", tmp_path / "other"], tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "<h2>Albedo</h2>" in page
    assert page.count('alt="Prediction of images/test_') > page.count('alt="Error of images/test_')
    assert f"{metrics['material']['albedo_error']['mean']:.4f}" in page
    assert "Learned normals" in page
    write_report([tmp_path / "other"], tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "<h2>Albedo</h2>" not in page
    assert "Learned normals" not in page


def test_measures_by_hand():
    predicted = np.array([[[1.0, 2, 0], [0, 0, 0]], [[9, 9, 9], [1, 1, 1]]])
    truth = np.array([[[2.0, 2, 1], [0, 0, 1]], [[0, 0, 0], [3, 1, 2]]])
    mask = np.array([[True, True], [False, True]])
    sums = AlbedoSums.of(predicted, truth, mask)
    assert sums == AlbedoSums(6 + 6, 5 + 3, 12, 9)
    assert AlbedoSums.total([sums, sums]) == AlbedoSums(24, 16, 24, 18)
    assert sums.scale == 1.5
    assert albedo_error(predicted, truth, mask, 1.5, 12 / 9) == pytest.approx(
        (0.5 + 1 + 1 + 0 + 0 + 1 + 1.5 + 0.5 + 0.5) / 12
    )
    assert AlbedoSums.total([]).scale is None
    up, ahead = np.array([[[0, 0, 1.0], [0, 1.0, 0]]]), np.array([[[0, 0, 1.0], [0, 0, 0]]])
    assert normals_deg(ahead, up, np.ones((1, 2), bool)) == pytest.approx(45)  # 0 and, where there is none, 90
    assert normals_deg(ahead, up, np.zeros((1, 2), bool)) is None
    assert albedo_error(predicted, truth, np.zeros((2, 2), bool), 1, 1) is None
