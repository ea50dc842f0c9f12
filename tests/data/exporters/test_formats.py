"""COCO, YOLO, WebDataset, SPEED+'s labels and BOP's models, read back by others' readers and by documented rules."""

import contextlib
import io
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image as PillowImage
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from scipy.spatial.distance import cdist
from tiny import contents

from spacesim.data.exporters import LabelledObject, write_coco, write_speedplus, write_webdataset, write_yolo
from spacesim.data.exporters.bop import _spread, _write_models
from spacesim.data.exporters.keypoints import BodyLabels
from spacesim.data.exporters.labels import DatasetLabeller
from spacesim.data.exporters.objects import opaque_picture
from spacesim.data.exporters.symmetries import find_symmetries
from spacesim.data.images import read_png
from spacesim.data.importers.speedplus import import_speedplus
from spacesim.data.store import load_depth


@pytest.fixture(scope="module")
def truth(labelled) -> dict[str, list]:
    """Instances that are seen, by the names of frames."""
    labeller = DatasetLabeller(labelled)
    return {
        Path(frame.file_path).stem: [one for one in labeller.instances(frame) if one.area] for frame in labelled.frames
    }


@pytest.fixture(scope="module")
def coco(labelled, tmp_path_factory) -> Path:
    out: Path = tmp_path_factory.mktemp("coco") / "coco"
    write_coco(labelled, out)
    return out


def read(path: Path) -> COCO:
    with contextlib.redirect_stdout(io.StringIO()):
        return COCO(str(path))


def test_coco_reads_back_by_pycocotools(labelled, coco, truth):
    seen = 0
    for split, frames in (("train", labelled.train), ("val", labelled.test)):
        api = read(coco / f"annotations/{split}.json")
        names = {category["id"]: category["name"] for category in api.loadCats(api.getCatIds())}
        assert names == {1: "boxsat", 2: "cubesat"}
        assert len(api.imgs) == len(frames)
        for image in api.imgs.values():
            expected = truth[Path(image["file_name"]).stem]
            picture = PillowImage.open(coco / split / image["file_name"])
            assert picture.size == (image["width"], image["height"])
            found = api.loadAnns(api.getAnnIds(image["id"]))
            assert len(found) == len(expected)
            for annotation, instance in zip(found, expected, strict=True):
                np.testing.assert_array_equal(api.annToMask(annotation), instance.mask)
                rows, columns = np.nonzero(instance.mask)
                corner = columns.min(), rows.min()
                assert annotation["bbox"] == [*corner, np.ptp(columns) + 1, np.ptp(rows) + 1]
                assert annotation["area"] == instance.mask.sum()
                x, y, v = np.reshape(annotation["keypoints"], (-1, 3)).T
                inside = instance.keypoints[:, 2] > 0
                np.testing.assert_array_equal(v, instance.keypoints[:, 2])
                np.testing.assert_allclose(x[inside], instance.keypoints[inside, 0] - 0.5)
                np.testing.assert_allclose(y[inside], instance.keypoints[inside, 1] - 0.5)
                assert annotation["num_keypoints"] == inside.sum()
                seen += 1
    assert seen >= 6


@pytest.mark.parametrize("kind", ["bbox", "segm", "keypoints"])
def test_cocos_own_evaluation_takes_the_labels_for_perfect(coco, kind):
    with contextlib.redirect_stdout(io.StringIO()):
        api = read(coco / "annotations/train.json")
        results = [{**annotation, "score": 1.0} for annotation in api.dataset["annotations"]]
        evaluation = COCOeval(api, api.loadRes(results), kind)
        if kind == "keypoints":
            evaluation.params.kpt_oks_sigmas = np.full(11, 0.05)
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
    assert evaluation.stats[0] == pytest.approx(1)


def test_yolo_lines_say_masks_boxes_and_keypoints(labelled, truth, tmp_path):
    """By Ultralytics' rules: labels lie where images/ is labels/; numbers are shares of the picture."""
    assert write_yolo(labelled, tmp_path / "yolo") == sum(map(len, truth.values()))
    size = np.array([160, 120])
    for task in ("detect", "segment", "pose"):
        root = tmp_path / "yolo" / task
        described = (root / "data.yaml").read_text()
        assert "train: images/train\nval: images/val\n" in described
        assert "names:\n  0: 'boxsat'\n  1: 'cubesat'\n" in described
        assert ("kpt_shape: [11, 3]\n" in described) == (task == "pose")
        pictures = sorted(root.glob("images/*/*.png"))
        assert {path.parent.name for path in pictures} == {"train", "val"}
        assert {path.stem for path in pictures} == set(truth)
        for path in pictures:
            lines = Path(str(path.with_suffix(".txt")).replace("/images/", "/labels/")).read_text().splitlines()
            assert len(lines) == len(truth[path.stem])
            for line, instance in zip(lines, truth[path.stem], strict=True):
                category, *numbers = map(float, line.split())
                assert category == instance.category - 1
                assert min(numbers) >= 0
                if task == "segment":
                    x, y = np.reshape(numbers, (-1, 2)).T * size[:, None]
                    area = 0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum()
                    assert area == pytest.approx(instance.area, abs=0.05)
                    continue
                middle, extent = np.array(numbers[:2]) * size, np.array(numbers[2:4]) * size
                np.testing.assert_allclose([*(middle - extent / 2), *extent], instance.box, atol=1e-3)
                if task == "pose":
                    found = np.reshape(numbers[4:], (11, 3)) * [*size, 1]
                    np.testing.assert_allclose(found, instance.keypoints, atol=1e-4)


def test_webdataset_reads_back_by_the_real_library(labelled, truth, tmp_path):
    webdataset = pytest.importorskip("webdataset", reason="webdataset (extra: readers) is not installed")
    assert write_webdataset(labelled, tmp_path / "shards") == 2
    write_webdataset(labelled, tmp_path / "again")
    assert contents(tmp_path / "again") == contents(tmp_path / "shards")
    frames = {Path(frame.file_path).stem: frame for frame in labelled.frames}
    for split, count in (("train", 3), ("val", 1)):
        shards = webdataset.WebDataset(str(tmp_path / f"shards/{split}-000000.tar"), shardshuffle=False)
        samples = list(shards.decode("rgb8"))
        assert len(samples) == count
        for sample in samples:
            frame, described = frames[sample["__key__"]], sample["json"]
            np.testing.assert_array_equal(sample["png"], opaque_picture(labelled, frame))
            numbers = sample["id.png"][..., 0]
            np.testing.assert_allclose(described["world_from_camera"], frame.camera.world_from_camera)
            for written, instance in zip(described["objects"], truth[sample["__key__"]], strict=True):
                assert written["area"] == (numbers == written["id"]).sum() == instance.area
                np.testing.assert_allclose(written["keypoints"], instance.keypoints)
                expected = frame.camera.camera_from_world @ instance.target.world_from_object
                np.testing.assert_allclose(written["camera_from_object"], expected)
        raw = next(iter(webdataset.WebDataset(str(tmp_path / f"shards/{split}-000000.tar"), shardshuffle=False)))
        stored = np.asarray(PillowImage.open(io.BytesIO(raw["depth.png"])))
        unit = json.loads(raw["json"])["depth_unit"]
        np.testing.assert_array_equal((stored * unit).astype(np.float32), load_depth(labelled, frames[raw["__key__"]]))


def test_shards_are_divided(labelled, tmp_path, monkeypatch):
    monkeypatch.setattr("spacesim.data.exporters.webdataset.MOST", 2)
    assert write_webdataset(labelled, tmp_path / "shards") == 3
    assert {path.name for path in tmp_path.glob("shards/*.tar")} == {
        "train-000000.tar",
        "train-000001.tar",
        "val-000000.tar",
    }


def test_speedplus_masks_come_back_as_silhouettes(labelled, tmp_path):
    target = write_speedplus(labelled, tmp_path / "plus", "twin")
    keypoints = json.loads((tmp_path / "plus/synthetic/keypoints.json").read_text())
    body = json.loads((tmp_path / "plus/keypoints.json").read_text())["objects"]
    assert [entry["name"] for entry in body] == ["twin"]
    camera = json.loads((tmp_path / "plus/camera.json").read_text())
    labels = json.loads((tmp_path / "plus/synthetic/train.json").read_text())
    k1, k2, p1, p2, k3 = camera["distCoeffs"]
    for label in labels:
        w, x, y, z = label["q_vbs2tango_true"]
        turn = trimesh.transformations.quaternion_matrix([w, x, y, z])[:3, :3]
        points = np.array(list(body[0]["keypoints"].values())) @ turn.T + label["r_Vo2To_vbs_true"]
        a, b = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
        r2 = a * a + b * b
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        u = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
        v = b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
        pixels = np.stack([u, v, np.ones_like(u)], axis=1) @ np.transpose(camera["cameraMatrix"])
        written = np.array(keypoints[label["filename"]])
        inside = written[:, 2] > 0
        np.testing.assert_allclose(written[inside, :2], pixels[inside, :2], atol=1e-9)
    dataset = import_speedplus(tmp_path / "plus", tmp_path / "back")
    for frame in dataset.train:
        name = Path(frame.file_path).name
        ids = read_png(labelled.root / "id" / name)
        np.testing.assert_array_equal(read_png(dataset.root / frame.silhouette_path) > 0, ids == target.id)


def test_commands_take_keypoints(spacesim, labelled, tmp_path):
    done = spacesim("export", labelled.root, "--coco", tmp_path / "coco", "--keypoints", 4)
    assert done.code == 0
    assert "4 images with" in done.output
    given = tmp_path / "coco/keypoints.json"
    assert len(json.loads(given.read_text())["objects"][0]["keypoints"]) == 4
    done = spacesim("export", labelled.root, "--yolo", tmp_path / "yolo", "--keypoints", given)
    assert done.code == 0
    assert (tmp_path / "yolo/keypoints.json").read_text() == given.read_text()
    assert spacesim("export", labelled.root, "--webdataset", tmp_path / "shards", "--keypoints", given).code == 0
    refused = spacesim("export", labelled.root, "--coco", tmp_path / "b", "--keypoints", tmp_path / "none.json")
    assert refused.is_refusal("none.json")
    assert spacesim("export", labelled.root, "--coco", tmp_path / "b", "--keypoints", "0").is_refusal("keypoints")
    assert spacesim("export", labelled.root, "--mesh", "a.ply", "--keypoints", "4").is_refusal("--keypoints")
    assert spacesim("export", labelled.root, "--coco", given).is_refusal(given)
    assert not (tmp_path / "b").exists()


def test_bop_models_have_symmetries_and_vertices_all_over(tmp_path):
    """By bop_toolkit's rules: R p + t in millimetres takes the model to itself; continuous ones turn about an axis
    through an offset."""
    prism, cylinder = trimesh.creation.box((1, 1, 3)), trimesh.creation.cylinder(0.5, 2, sections=64)
    prism.apply_translation([0.2, 0, 0])
    targets, bodies = [], []
    for number, mesh in enumerate((prism, cylinder), start=1):
        vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
        targets.append(LabelledObject(number, f"body {number}", np.eye(4), vertices, faces))
        bodies.append(BodyLabels(number, {"a": (0.0, 0.0, 0.0)}, "", *find_symmetries(vertices, faces)))
    _write_models(tmp_path, targets, [1, 2], bodies)
    infos = json.loads((tmp_path / "models/models_info.json").read_text())
    assert infos == json.loads((tmp_path / "models_eval/models_info.json").read_text())
    assert len(infos["1"]["symmetries_discrete"]) == 7
    assert "symmetries_continuous" not in infos["1"]
    for matrix in infos["1"]["symmetries_discrete"]:
        pose = np.reshape(matrix, (4, 4))
        turned = 1000 * prism.vertices @ pose[:3, :3].T + pose[:3, 3]
        assert cdist(turned, 1000 * prism.vertices).min(axis=1).max() < 1e-6
    (axis,) = infos["2"]["symmetries_continuous"]
    np.testing.assert_allclose(np.abs(axis["axis"]), [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(axis["offset"][:2], 0, atol=1e-9)
    for number, target in enumerate(targets, start=1):
        whole, eval_ = (
            trimesh.load(tmp_path / f"{folder}/obj_{number:06d}.ply", process=False)
            for folder in ("models", "models_eval")
        )
        np.testing.assert_allclose(whole.vertices, 1000 * target.vertices, atol=1e-3)
        assert len(eval_.vertices) > 500
        assert eval_.edges_unique_length.max() <= 0.05 * infos[str(number)]["diameter"] + 1e-6
        assert eval_.area == pytest.approx(whole.area, rel=1e-6)


def test_bop_merges_what_is_fine(tmp_path):
    ball = trimesh.creation.icosphere(6)
    spread = _spread(1000 * ball.vertices, ball.faces, 2000.0)
    assert 2000 < len(spread.vertices) < len(ball.vertices) / 2
    assert abs(spread.area / (1e6 * ball.area) - 1) < 0.01
    np.testing.assert_allclose(np.linalg.norm(spread.vertices, axis=1), 1000, atol=10)
