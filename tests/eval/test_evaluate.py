"""A run evaluated end to end on a tiny dataset."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spacesim.data.density import write_camera_density
from spacesim.data.errors import InputError, WorkError
from spacesim.data.geometry import look_at
from spacesim.data.images import (
    linear_from_srgb,
    load_image,
    luminance,
    read_png,
    srgb_from_linear,
    write_png,
)
from spacesim.data.records import Camera, Frame
from spacesim.eval import pictures
from spacesim.eval.evaluate import EvaluateConfig, evaluate, frame_names, summary
from spacesim.eval.labels import GROUPS
from spacesim.eval.metrics import image, lpips, shadow
from spacesim.eval.report.write import write_report
from spacesim.scenes.cameras.camera import CameraConfig
from spacesim.scenes.cameras.sensor import SensorConfig
from spacesim.scenes.scenefile import read_scene
from spacesim.splat.raster.gaussians import Gaussians

SIZE = 40


@pytest.fixture(autouse=True)
def no_weights(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "nowhere"))


def shifted(rgb):
    return np.roll(rgb, 2, axis=1)


def test_perfect_prediction(make_run, dataset, tmp_path):
    metrics = evaluate(make_run(), dataset, tmp_path / "eval")
    assert metrics == json.loads((tmp_path / "eval" / "metrics.json").read_text())
    for group in ("image", "image_full"):
        assert metrics[group]["psnr"] == {"mean": 100, "std": 0, "count": 4}
        assert metrics[group]["mae"] == {"mean": 0, "std": 0, "count": 4}
        assert metrics[group]["ssim"]["mean"] == pytest.approx(1)
        assert metrics[group]["flip"]["mean"] == 0
    assert metrics["shadow"]["ber"]["mean"] == 0
    assert metrics["shadow"]["sharpness_ratio"]["mean"] == 1
    assert not any("PSNR" in note for note in metrics["notes"])
    assert not read_png(tmp_path / "eval/frames/test_00000/error.png").any()


def test_frames_that_are_equal_count_in_the_mean(make_run, dataset, tmp_path):
    """Of four frames all but the last are equal to the truth; that one is off by 0.1, which is 20 dB."""
    shown = []

    def last_is_off(rgb):
        shown.append(rgb)  # the first is predicted once more, before the frames
        return rgb + np.float32(0.1) * (len(shown) == 5)

    metrics = evaluate(make_run(last_is_off), dataset, tmp_path / "eval")
    assert [frame["psnr"] for frame in metrics["frames"]] == pytest.approx([100, 100, 100, 20], abs=0.2)
    assert metrics["image"]["psnr"]["count"] == 4
    assert metrics["image"]["psnr"]["mean"] == pytest.approx(80, abs=0.1)


def test_map_of_the_training_cameras(relightable, tmp_path):
    run, dataset = relightable()
    moved = Camera.from_fov(look_at([0, 0, 9], [0, 0, 0]), 8, 8, 40)
    dataset = replace(dataset, train=(replace(dataset.train[0], camera=moved),), ply_file_path=None)
    out = tmp_path / "eval"
    evaluate(run, dataset, out)
    picture = read_png(out / "camera_density.png")
    write_camera_density(tmp_path / "map.png", dataset)
    np.testing.assert_array_equal(picture, read_png(tmp_path / "map.png"))
    lost = evaluate(run, replace(dataset, mesh_path="mesh.ply"), out)
    assert any(note.startswith("There is no map of the training cameras") for note in lost["notes"])
    assert not (out / "camera_density.png").exists()


def test_shifted_prediction_is_worse(make_run, dataset, tmp_path):
    good = evaluate(make_run(lambda rgb: rgb + 0.01), dataset, tmp_path / "good")
    bad = evaluate(make_run(shifted), dataset, tmp_path / "bad")
    for group in ("image", "image_full"):
        assert bad[group]["psnr"]["mean"] < good[group]["psnr"]["mean"]
        assert bad[group]["ssim"]["mean"] < good[group]["ssim"]["mean"]
        for metric in ("mae", "rmse", "flip"):
            assert bad[group][metric]["mean"] > good[group][metric]["mean"]
    assert bad["shadow"]["ber"]["mean"] > good["shadow"]["ber"]["mean"]


def test_values_are_those_of_the_metrics(make_run, dataset, tmp_path):
    metrics = evaluate(make_run(shifted), dataset, tmp_path / "eval")
    decibels = []
    for frame, evaluated in zip(dataset.test, metrics["frames"], strict=True):
        truth = load_image(dataset, frame).over(np.zeros(3))
        silhouette = read_png(dataset.root / frame.silhouette_path) == 255
        decibels.append(image.psnr(shifted(truth), truth, silhouette))
        assert evaluated["file_path"] == frame.file_path
        assert evaluated["sun"] == pytest.approx(frame.sun.angles)
        assert evaluated["psnr"] == decibels[-1]
        assert evaluated["image_full"]["ssim"] == pytest.approx(image.ssim(shifted(truth), truth))
        expected = shadow.luminance_metrics(luminance(shifted(truth)), luminance(truth), silhouette)
        assert {key: evaluated[key] for key in expected} == expected
    assert metrics["image"]["psnr"] == {"mean": np.mean(decibels), "std": np.std(decibels), "count": 4}


def test_predictions_are_clipped(make_run, dataset, tmp_path):
    def blinding(rgb):
        return np.where(rgb > 0.5, 7.0, np.where(rgb < 0.1, -3.0, rgb))

    def shown(rgb):
        return np.clip(blinding(rgb), 0, 1)

    metrics = [evaluate(make_run(change), dataset, tmp_path / "eval") for change in (blinding, shown)]
    assert metrics[0]["frames"] == metrics[1]["frames"]


def test_layout(make_run, dataset, tmp_path):
    seen = []
    metrics = evaluate(make_run(shifted), dataset, tmp_path / "eval", progress=lambda *step: seen.append(step))
    assert [step[:2] for step in seen] == [(0, 4), (1, 4), (2, 4), (3, 4), (4, 4)]
    assert metrics["schema"] == 1
    assert metrics["split"] == "test"
    assert metrics["model"]["gaussians"] == 123
    assert metrics["model"]["bytes"] == 45678
    assert metrics["model"]["render_ms"] > 0
    assert metrics["geometry"] is None
    assert metrics["shadow_mask"] is None
    assert metrics["image"]["lpips"] is None
    assert metrics["config"]["seed"] == 7
    assert metrics["dataset"]["suns"] == 2
    assert metrics["dataset"]["scene"] == "sphere"
    assert metrics["dataset"]["sizes"] == 1
    assert metrics["dataset"]["config"] == {"spp": 16, "seed": 1}
    for word in ("Geometry", "LPIPS", "Visibility"):
        assert sum(note.startswith(word) for note in metrics["notes"]) == 1
    for frame in metrics["frames"]:
        folder = tmp_path / "eval" / "frames" / frame["name"]
        names = {"truth", "prediction", "error", "shadow_truth", "shadow_prediction", "depth_truth", "depth"}
        assert {path.stem for path in folder.glob("*.png")} == names


def test_what_a_killed_call_left_behind_goes(make_run, dataset, tmp_path):
    left = tmp_path / "eval" / "frames" / "test_00000" / ".0123.part"
    left.parent.mkdir(parents=True)
    left.write_bytes(b"half a picture")
    evaluate(make_run(shifted), dataset, tmp_path / "eval")
    assert left.parent.is_dir()
    assert not left.exists()


def test_nothing_of_an_earlier_evaluation_stays_but_what_is_not_its_own(make_run, dataset, tmp_path):
    out = tmp_path / "eval"
    evaluate(make_run(shifted), dataset, out)
    own = ["report.html", "geometry/reconstruction.ply", "relight/truth_07.png", "frames/other/albedo.png"]
    foreign = ["notes.txt", "relight/model.safetensors", "frames/test_00000/mine.png"]
    for name in (*own, *foreign):
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).touch()
    kept = replace(dataset, test=dataset.test[:1])
    evaluate(make_run(shifted), kept, out)
    assert [name for name in own if (out / name).exists()] == []
    assert [name for name in foreign if not (out / name).exists()] == []
    assert [path.name for path in (out / "frames").iterdir()] == ["test_00000"]
    assert not (out / "geometry").exists()


@pytest.mark.parametrize(
    "files", [{"report.html": "mine", "metrics.json": "{}"}, {"report.html": "mine", "frames/0/note.txt": "mine"}]
)
def test_a_folder_with_another_report_is_refused_and_left_alone(make_run, dataset, tmp_path, files):
    out = tmp_path / "eval"
    for name, text in files.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(text)
    with pytest.raises(InputError, match="eval: expected a new folder, or one of an earlier evaluation, found another"):
        evaluate(make_run(shifted), dataset, out)
    assert {str(path.relative_to(out)): path.read_text() for path in out.rglob("*.*")} == files


def test_an_interrupted_evaluation_leaves_the_one_before_it(make_run, dataset, tmp_path):
    out = tmp_path / "eval"
    out.mkdir()
    (out / "log.txt").write_text("mine")
    evaluate(make_run(shifted), dataset, out)

    def stop(done: int, _all: int, _file: str) -> None:
        if done == 1:
            raise KeyboardInterrupt

    before = {path: path.read_bytes() for path in out.rglob("*.*")}
    with pytest.raises(KeyboardInterrupt):
        evaluate(make_run(), dataset, out, progress=stop)
    assert {path: path.read_bytes() for path in out.rglob("*.*")} == before
    evaluate(make_run(), dataset, out)
    assert (out / "log.txt").read_text() == "mine"
    assert (out / "metrics.json").read_bytes() != before[out / "metrics.json"]


def test_two_evaluations_into_one_folder_keep_out_of_each_others_way(make_run, dataset, tmp_path):
    out = tmp_path / "eval"

    def another(_done: int, _all: int, _file: str) -> None:
        with pytest.raises(InputError, match="eval: expected no other run at work in the folder, found one"):
            evaluate(make_run(), dataset, out)

    evaluate(make_run(shifted), dataset, out, progress=another)
    assert (out / "metrics.json").exists()


def test_a_broken_picture_is_found_before_an_earlier_evaluation_goes(make_run, dataset, tmp_path):
    out, copied = tmp_path / "eval", replace(dataset, root=Path(shutil.copytree(dataset.root, tmp_path / "copy")))
    evaluate(make_run(shifted), copied, out)
    before = {path: path.read_bytes() for path in out.rglob("*.*")}
    picture = copied.root / copied.test[-1].file_path
    picture.write_bytes(picture.read_bytes()[:-20])
    with pytest.raises(InputError, match=picture.name):
        evaluate(make_run(shifted), copied, out)
    assert {path: path.read_bytes() for path in out.rglob("*.*")} == before


def test_same_run_same_bytes(make_run, dataset, tmp_path):
    def written():
        metrics = evaluate(make_run(shifted), dataset, tmp_path / "eval")
        metrics["model"]["render_ms"] = 0
        files = sorted((tmp_path / "eval" / "frames").rglob("*.png"))
        return json.dumps(metrics), [path.read_bytes() for path in files]

    assert written() == written()


def test_lpips_where_there_are_weights(make_run, dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(lpips, "load", lambda path: (lambda a, b: float(np.abs(a - b).max()), "weights are here"))
    metrics = evaluate(make_run(shifted), dataset, tmp_path / "eval")
    assert metrics["image_full"]["lpips"]["mean"] >= metrics["image"]["lpips"]["mean"] > 0
    assert not any("LPIPS" in note for note in metrics["notes"])


def test_predicted_visibility(make_run, dataset, tmp_path):
    columns = np.arange(40)[None] * np.ones((40, 1))
    exact = evaluate(make_run(visibility=(columns >= 20).astype(float)), dataset, tmp_path / "exact")
    assert exact["shadow_mask"]["iou"]["mean"] == 1
    assert exact["shadow_mask"]["error_rate"]["mean"] == 0
    off = evaluate(make_run(visibility=(columns >= 25).astype(float)), dataset, tmp_path / "off")
    silhouette = read_png(dataset.root / dataset.test[0].silhouette_path) == 255
    wrong = silhouette[:, 20:25].sum()
    assert off["shadow_mask"]["error_rate"]["mean"] == pytest.approx(wrong / silhouette.sum())
    assert off["shadow_mask"]["visibility_mae"]["mean"] == pytest.approx(wrong / silhouette.sum())


def test_known_and_unseen_suns_are_kept_apart(relightable, tmp_path):
    run, dataset = relightable(edge=25)
    metrics = evaluate(run, dataset, tmp_path / "eval")
    assert [frame["known_sun"] for frame in metrics["frames"]] == [True, False, True, False]
    for split, first in (("known_suns", 0), ("unseen_suns", 1)):
        part = metrics[split]
        alone = evaluate(run, replace(dataset, test=dataset.test[first::2]), tmp_path / split)
        assert (part["frames"], part["suns"]) == (2, 1)
        for group in (*GROUPS, "by_grazing_angle"):
            assert part[group] == alone[group]
        assert part["shadow_mask"] is not None
        assert alone[split] is not None
        assert alone["known_suns" if split == "unseen_suns" else "unseen_suns"] is None
        other = "known_suns" if split == "unseen_suns" else "unseen_suns"
        assert sum(note.startswith(f"{other} is null") for note in alone["notes"]) == 1


def test_suns_of_no_training_frame_are_neither(make_run, dataset, tmp_path):
    metrics = evaluate(make_run(), dataset, tmp_path / "eval")
    assert metrics["known_suns"] is metrics["unseen_suns"] is None
    assert {frame["known_sun"] for frame in metrics["frames"]} == {None}
    assert any(note.startswith("known_suns and unseen_suns are null") for note in metrics["notes"])


def test_light_of_a_relightable_run(relightable, tmp_path):
    run, dataset = relightable(edge=25)
    metrics = evaluate(run, dataset, tmp_path / "eval")
    silhouette = read_png(dataset.root / dataset.test[0].silhouette_path) == 255
    wrong, lit, cast = (silhouette[:, part].sum() for part in (slice(20, 25), slice(20, 40), slice(20)))
    own = metrics["shadow_self_cast"]
    assert own["recall"] == {"mean": 1, "std": 0, "count": 4}
    assert own["error_rate"] == metrics["shadow_mask"]["error_rate"]
    assert metrics["shadow_attached"] is metrics["shadow_other_cast"] is None
    for kind in ("shadow_attached", "shadow_other_cast"):
        assert sum(note.startswith(f"{kind} is null") for note in metrics["notes"]) == 1
    *grazing, steep = metrics["by_grazing_angle"]  # the truth says that the Sun stands upright over all of it
    assert {one["pixels"] for one in grazing} == {0}
    assert steep["pixels"] == 4 * (lit + cast)
    assert steep["false_shadow"] == pytest.approx(wrong / lit)
    assert steep["missed_shadow"] == 0
    assert steep["luminance_mae"] == pytest.approx(0, abs=0.01)
    assert len(metrics["relight"]["suns"]) == 2
    folder = tmp_path / "eval" / "frames" / "test_00000"
    shown = {name: read_png(folder / f"{name}.png") for name in ("mask_truth", "mask_prediction", "visibility")}
    assert np.all(shown["mask_truth"][20, 21] == pictures.LIT)
    assert np.all(shown["mask_truth"][20, 19] == pictures.SELF_CAST)
    assert np.all(shown["mask_prediction"][20, 21] == pictures.WRONGLY_SHADOWED)
    assert np.all(shown["visibility"][20, 21] == pictures.SHADOWED)


def test_methods_without_visibility_have_errors_by_grazing_angle(make_run, dataset, tmp_path):
    metrics = evaluate(make_run(lambda rgb: rgb * 0.5), dataset, tmp_path / "eval")
    steep = metrics["by_grazing_angle"][-1]
    assert steep["luminance_mae"] > 0.1
    assert steep["visibility_mae"] is None
    assert metrics["relight"] is None
    poorer = evaluate(make_run(), elsewhere(dataset, gt_path=None), tmp_path / "poorer")
    assert poorer["by_grazing_angle"] is None
    assert any(note.startswith("depth and by_grazing_angle are null") for note in poorer["notes"])


def test_visibility_that_is_not_finite_names_the_frame(make_run, dataset, tmp_path):
    with pytest.raises(WorkError, match=r"images/test_00000\.png: the prediction"):
        evaluate(make_run(visibility=np.full((40, 40), np.nan)), dataset, tmp_path / "eval")


def test_nan_names_the_frame(make_run, dataset, tmp_path):
    def broken(rgb):
        return np.where(rgb > 0.5, np.nan, rgb)

    with pytest.raises(WorkError, match=r"images/test_00000\.png: the prediction"):
        evaluate(make_run(broken), dataset, tmp_path / "eval")
    assert not (tmp_path / "eval" / "metrics.json").exists()


def test_a_mesh_that_is_missing_costs_the_shape_alone(make_run, dataset, tmp_path):
    run = make_run()
    run.gaussians, run.antialiased = Gaussians.random(3, 1.0, 0.1), False
    metrics = evaluate(run, replace(dataset, mesh_path="gone.ply"), tmp_path / "eval")
    assert metrics["geometry"] is None
    assert metrics["image"]["ssim"]
    assert any("gone.ply" in note for note in metrics["notes"])


def test_no_frames(make_run, dataset, tmp_path):
    with pytest.raises(InputError, match="expected frames in the split train, found none; test has some"):
        evaluate(make_run(), dataset, tmp_path / "eval", EvaluateConfig(split="train"))
    with pytest.raises(InputError, match="split"):
        EvaluateConfig(split="validation")


def test_a_frame_without_a_sun_is_named(relightable, tmp_path):
    run, dataset = relightable()
    first, second, *others = dataset.test
    lacking = replace(dataset, test=(first, replace(second, sun=None), *others))
    with pytest.raises(InputError, match=r"expected the Sun of every frame .*, images/test_00001\.png has none"):
        evaluate(run, lacking, tmp_path / "eval")


def test_a_failed_evaluation_leaves_the_pictures_and_numbers_of_the_one_before(make_run, dataset, tmp_path):
    out = tmp_path / "eval"
    evaluate(make_run(), dataset, out)
    before = {path: path.read_bytes() for path in out.rglob("*.*")}
    with pytest.raises(WorkError):
        evaluate(make_run(lambda rgb: rgb + np.inf), dataset, out)
    assert {path: path.read_bytes() for path in out.rglob("*.*")} == before
    with pytest.raises(WorkError):
        evaluate(make_run(lambda rgb: rgb + np.inf), dataset, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_out_is_a_file(make_run, dataset, tmp_path):
    (tmp_path / "eval").write_text("")
    with pytest.raises(InputError, match="eval: expected a folder"):
        evaluate(make_run(), dataset, tmp_path / "eval")


def elsewhere(dataset, **changes):
    return replace(dataset, test=tuple(replace(frame, **changes) for frame in dataset.test))


def test_data_without_truth_is_scored_over_alpha(make_run, dataset, tmp_path):
    poorer = elsewhere(dataset, sun=None, gt_path=None, silhouette_path=None)
    expected = evaluate(make_run(shifted), dataset, tmp_path / "eval")
    metrics = evaluate(make_run(shifted), poorer, tmp_path / "eval")
    assert metrics["image"] == expected["image"]
    assert metrics["frames"][0]["sun"] is None
    assert "In 4 of 4 frames the silhouette is where the image's alpha is at least one half." in metrics["notes"]


def test_silhouettes_of_a_lens_are_no_alpha(make_run, dataset, tmp_path):
    bent = elsewhere(dataset, gt_path=None, distortion=(0.01, 0.0, 0.0, 0.0, 0.0))
    alpha = "In 4 of 4 frames the silhouette is where the image's alpha is at least one half."
    assert alpha in evaluate(make_run(shifted), bent, tmp_path / "alpha")["notes"]
    for frame in bent.test:
        path = bent.root / frame.file_path
        write_png(path, np.ascontiguousarray(read_png(path)[..., :3]))
    metrics = evaluate(make_run(shifted), bent, tmp_path / "eval")
    assert metrics["image_region"] == "silhouette"
    assert not any("alpha" in note for note in metrics["notes"])


def test_data_without_alpha_is_scored_over_whole_frames(make_run, dataset, tmp_path):
    for frame in dataset.test:
        path = dataset.root / frame.file_path
        write_png(path, np.ascontiguousarray(read_png(path)[..., :3]))
    metrics = evaluate(make_run(shifted), elsewhere(dataset, silhouette_path=None), tmp_path / "eval")
    assert metrics["image"]["mae"] == metrics["image_full"]["mae"]
    assert metrics["image"] == metrics["image_full"]
    assert metrics["image_region"] == "frame"
    assert any("image is over whole pictures" in note for note in metrics["notes"])
    photographs, config = elsewhere(dataset, silhouette_path=None), EvaluateConfig(fit_gain=True)
    notes = evaluate(make_run(shifted), photographs, tmp_path / "fitted", config)["notes"]
    assert any("On the left half of it, scored on the right half" in note for note in notes)
    write_report([tmp_path / "fitted"], tmp_path / "report.html")
    assert "on one half and scored on the other (gain)" in (tmp_path / "report.html").read_text()


def test_ignored_pixels_do_not_count(make_run, dataset, tmp_path):
    mask = np.full((40, 40), 255, np.uint8)
    mask[:, 15:] = 0
    write_png(dataset.root / "mask.png", mask)

    def spoiled(rgb):
        return np.where(mask[..., None] > 0, rgb, 1 - rgb)

    metrics = evaluate(make_run(spoiled), elsewhere(dataset, mask_path="mask.png"), tmp_path / "eval")
    assert metrics["image"]["mae"]["mean"] == metrics["image_full"]["mae"]["mean"] == 0
    assert metrics["image_full"]["flip"]["mean"] == 0
    assert metrics["dataset"]["ignored"] == pytest.approx(25 / 40)
    assert any(note.startswith("62.5 % of the pixels count nowhere") for note in metrics["notes"])
    for group in ("", "_full"):  # windows and slopes beside the mask read none of them either
        assert metrics[f"image{group}"]["ssim"]["mean"] == pytest.approx(1)
        assert metrics[f"shadow{group}"]["sharpness_ratio"]["mean"] == pytest.approx(1)


def test_ignored_pixels_count_in_no_group(make_run, dataset, tmp_path):
    """Whatever is predicted there, of colour and visibility, and with a gain that is fitted."""
    rows = np.arange(SIZE)[:, None] * np.ones(SIZE)
    write_png(dataset.root / "mask.png", np.where(rows < 25, 255, 0).astype(np.uint8))
    masked = elsewhere(dataset, mask_path="mask.png")
    found = []
    for ignored in (0.0, 1.0):
        run = make_run(
            lambda rgb, ignored=ignored: np.where(rows[..., None] < 25, 0.8 * rgb, ignored).astype(np.float32),
            visibility=np.where(rows < 25, rows / 25, ignored),
            depth=np.where(rows < 25, 1.25, 5 * ignored),
        )
        metrics = evaluate(run, masked, tmp_path / "eval", EvaluateConfig(fit_gain=True))
        found.append({name: metrics[name] for name in (*GROUPS, "by_grazing_angle", "frames")})
    assert found[0] == found[1]
    assert found[0]["shadow_mask"]["error_rate"]["count"] == 4


def test_frame_that_shows_nothing(make_run, dataset, tmp_path):
    frame = dataset.test[1]
    for path in (frame.file_path, frame.silhouette_path):
        write_png(dataset.root / path, np.zeros_like(read_png(dataset.root / path)))
    metrics = evaluate(make_run(lambda rgb: rgb + 0.1), dataset, tmp_path / "eval")
    assert metrics["frames"][1]["psnr"] is None
    assert metrics["frames"][1]["bias"] is None
    assert metrics["frames"][1]["image_full"]["psnr"] == pytest.approx(20, abs=1e-4)
    assert metrics["image"]["psnr"]["count"] == 3
    assert any(note.startswith("1 of 4 frames show no object") for note in metrics["notes"])


def test_silhouette_of_another_size(make_run, dataset, tmp_path):
    write_png(dataset.root / dataset.test[0].silhouette_path, np.zeros((8, 8), np.uint8))
    with pytest.raises(InputError, match=r"silhouette.*expected"):
        evaluate(make_run(), dataset, tmp_path / "eval")


def test_frame_names_are_unique_and_tame():
    camera = Camera.from_fov(np.eye(4), 4, 4, 40)
    paths = [
        "images/a.png",
        "images/a.jpg",
        "../../etc/pass wd.png",
        "<b>&.png",
        "left/1.png",
        "right/1.png",
        ".png",
    ]
    names = frame_names([Frame(path, camera) for path in paths])
    assert names == ["a", "a_2", "etc_pass_wd", "b_", "left_1", "right_1", "png"]
    assert all(Path(name).name == name for name in names)


def test_summary():
    assert summary([{"a": 1.0, "b": None}, {"a": 3.0, "b": None}, None]) == {
        "a": {"mean": 2, "std": 1, "count": 2},
        "b": None,
    }
    assert summary([None, None]) is None


def test_a_frame_of_one_pixel_hardly_moves_what_is_pooled():
    frames = [{"error_rate": 1.0, "iou": 0.0, "pixels": 1}, {"error_rate": 0.1, "iou": 0.5, "pixels": 99}]
    means = summary([*frames, {"error_rate": None, "iou": None, "pixels": 0}])
    assert means["error_rate"] == {"mean": 0.55, "std": 0.45, "count": 2, "pooled": pytest.approx(0.109)}
    assert means["iou"] == {"mean": 0.25, "std": 0.25, "count": 2}


def photographs(dataset):
    """The dataset as a camera on Earth would give it: opaque pictures, no Sun, no truth."""
    for frame in dataset.test:
        path = dataset.root / frame.file_path
        write_png(path, np.ascontiguousarray(read_png(path)[..., :3]))
    return elsewhere(dataset, sun=None, gt_path=None, silhouette_path=None)


def test_photographs_have_no_shadow_metrics(make_run, dataset, tmp_path):
    out = tmp_path / "eval"
    metrics = evaluate(make_run(shifted), photographs(dataset), out)
    assert metrics["image_region"] == "frame"
    assert metrics["image"] == metrics["image_full"]
    assert metrics["shadow"] is metrics["shadow_full"] is metrics["geometry"] is metrics["shadow_mask"] is None
    assert metrics["dataset"]["truth"] is False
    assert all(frame["ber"] is None for frame in metrics["frames"])
    assert not list(out.glob("frames/*/shadow_*.png"))
    assert any(
        note.startswith("shadow and shadow_full are null: the pictures say neither") for note in metrics["notes"]
    )
    assert not any("the silhouette is" in note for note in metrics["notes"])


def test_silhouettes_without_suns_keep_luminance_and_lose_groups_by_sun(make_run, dataset, tmp_path):
    metrics = evaluate(make_run(shifted), elsewhere(dataset, sun=None, gt_path=None), tmp_path / "eval")
    assert metrics["image_region"] == "silhouette"
    assert metrics["shadow"]["ber"]["count"] == 4
    assert metrics["known_suns"] is metrics["unseen_suns"] is metrics["by_grazing_angle"] is None


def test_the_same_frames_have_the_same_digest(make_run, dataset, tmp_path):
    def digest(data):
        return evaluate(make_run(), data, tmp_path / "eval")["dataset"]["digest"]

    assert digest(dataset) != digest(replace(dataset, test=dataset.test[:1]))


def test_the_gain_of_each_half_is_scored_on_the_other(make_run, dataset, tmp_path):
    """The truth's left half is half as bright as shown, its right half as bright: each is drawn with the other's."""
    left = np.arange(SIZE) < SIZE // 2

    def brighter(rgb):
        linear = linear_from_srgb(np.clip(rgb, 0, 1))
        return srgb_from_linear(np.where(left[None, :, None], 2 * np.minimum(linear, 0.5), linear))

    dimmed = {frame.file_path for frame in dataset.test}
    for name in dimmed:
        rgba = read_png(dataset.root / name)
        half = np.rint(255 * srgb_from_linear(0.4 * linear_from_srgb(rgba[..., :3] / 255))).astype(np.uint8)
        write_png(dataset.root / name, np.dstack([half, rgba[..., 3]]))
    run, out = make_run(brighter), tmp_path / "eval"
    plain = evaluate(run, dataset, out)
    assert plain["fitted"] is None
    assert "fitted" not in plain["frames"][0]
    metrics = evaluate(run, dataset, out, EvaluateConfig(fit_gain=True))
    assert [part["name"] for part in metrics["fitted"]] == ["gain"]
    assert any("no pixel is scored with numbers that were fitted on it" in note for note in metrics["notes"])
    for frame in metrics["frames"]:
        assert frame["fitted"]["from_column"] == SIZE // 2
        assert frame["fitted"]["gain"] == pytest.approx([0.5, 1.0], rel=0.02)
    shown = read_png(out / "frames" / "test_00000" / "prediction.png") / 255
    truth = read_png(out / "frames" / "test_00000" / "truth.png") / 255
    expected = linear_from_srgb(truth) * np.where(left, 2.0, 0.5)[None, :, None]
    np.testing.assert_allclose(shown, srgb_from_linear(expected), atol=0.02)


def test_a_gain_that_is_missing_costs_nothing_once_it_is_fitted(make_run, dataset, tmp_path):
    def darker(rgb):
        return srgb_from_linear(0.5 * linear_from_srgb(np.clip(rgb, 0, 1)))

    plain, fitted = (
        evaluate(make_run(darker), dataset, tmp_path / "eval", EvaluateConfig(fit_gain=gain)) for gain in (False, True)
    )
    assert plain["image"]["psnr"]["mean"] < 27
    assert fitted["image"]["psnr"]["mean"] > 55


def test_frames_without_an_object_are_not_fitted(make_run, dataset, tmp_path):
    frame = dataset.test[0]
    write_png(dataset.root / frame.silhouette_path, np.zeros((SIZE, SIZE), np.uint8))
    metrics = evaluate(make_run(), dataset, tmp_path / "eval", EvaluateConfig(fit_gain=True))
    assert metrics["frames"][0]["fitted"] is None
    assert any(note.startswith("In 1 of 4 frames nothing was fitted") for note in metrics["notes"])


def test_a_sensor_with_noise_is_noted(make_run, dataset, tmp_path):
    """By scene.json, as `generate` writes it."""

    def notes(sensor, name):
        config = replace(read_scene("boxsat"), camera=CameraConfig(sensor=sensor)).to_json()
        noisy = replace(dataset, scene=json.loads(json.dumps({"scene": "boxsat", "config": config})))
        written = evaluate(make_run(shifted), noisy, tmp_path / name, EvaluateConfig(geometry=None))["notes"]
        return [note for note in written if "sensor's noise" in note]

    (note,) = notes(SensorConfig(full_well_e=9_000, read_noise_e=3.5), "noisy")
    assert "shot noise of a full well of 9000 electrons and read noise of 3.5 electrons" in note
    assert notes(SensorConfig(shot_noise=False, read_noise_e=0), "noiseless") == []
    assert notes(None, "none") == []
