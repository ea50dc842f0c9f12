"""Objects evaluated one by one, and a composed scene in the place of a run."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from spacesim.data.images import load_image, luminance, read_exr, write_exr
from spacesim.data.store import read_dataset
from spacesim.eval.evaluate import EvaluateConfig, evaluate
from spacesim.eval.metrics import image, shadow
from spacesim.eval.metrics.geometry import GeometryConfig
from spacesim.eval.notes import explain_objects
from spacesim.eval.objects import GROUPS, object_names, swapped_order
from spacesim.eval.report.write import write_report
from spacesim.splat.compose import ComposedRun, load_scene
from spacesim.splat.export.mesh import MeshConfig

CUT = 24  #: column at which the second object begins


@pytest.fixture(autouse=True)
def no_weights(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "nowhere"))


@pytest.fixture
def pair(dataset):
    """The spheres cut in two objects; the last frame shows the first alone."""
    for index, frame in enumerate(dataset.test):
        path = dataset.root / frame.gt_path
        layers = read_exr(path)
        second = (np.arange(layers["alpha"].shape[1]) >= CUT) & (index < 3)
        ids = np.where(layers["alpha"] > 0, 1 + second, 0).astype(np.float32)
        write_exr(path, layers | {"object_id": ids, "depth": layers["depth"] * (1 + 2 * second).astype(np.float32)})
    objects = [{"id": 1, "name": "ball"}, {"id": 2, "name": "ball"}]
    return replace(dataset, scene={**dataset.scene, "objects": objects})


class FakeScene:
    """What `ComposedRun` asks a composition for."""

    def __init__(self, run, names):
        self.run, self.gaussian_count, self.model_bytes, self.backend, self.relightable = run, 7, 8, "llvm", False
        self.names = names

    def predict(self, camera, sun, normals=False, exposure=None):
        return self.run.predict(camera, sun)

    def draw_material(self, camera):
        return self.run.draw_material(camera)


class Scene(ComposedRun):
    """With names and a configuration as the test wants."""

    @property
    def parts(self):
        return tuple(SimpleNamespace(name=name) for name in self.composition.names)

    @property
    def config(self):
        return {"method": "shadow-map and vanilla"}


def shifted(rgb):
    return np.roll(rgb, 2, axis=1)


def test_values_are_those_of_each_objects_pixels(make_run, pair, tmp_path):
    columns = np.arange(40)[None] * np.ones((40, 1))
    metrics = evaluate(make_run(shifted, (columns >= 22).astype(float)), pair, tmp_path / "eval")
    assert [(one["id"], one["name"], one["frames"]) for one in metrics["objects"]] == [
        (1, "ball 1", 4),
        (2, "ball 2", 3),
    ]
    for number, one in enumerate(metrics["objects"], start=1):
        found = []
        for index, frame in enumerate(pair.test):
            truth = load_image(pair, frame).over(np.zeros(3))
            mask = read_exr(pair.root / frame.gt_path)["object_id"] == number
            evaluated = metrics["frames"][index]["objects"].get(one["name"])
            assert (evaluated is None) == (not mask.any())
            if evaluated is None:
                continue
            found.append(image.psnr(shifted(truth), truth, mask))
            assert evaluated["image"]["psnr"] == found[-1]
            assert evaluated["image"]["ssim"] == pytest.approx(image.ssim(shifted(truth), truth, mask))
            expected = shadow.luminance_metrics(luminance(shifted(truth)), luminance(truth), mask)
            assert evaluated["shadow"] == expected
        found = [value for value in found if value is not None]  # where all is black, all is right
        assert one["image"]["psnr"] == {"mean": np.mean(found), "std": np.std(found), "count": len(found)}
        assert len(found) >= 2
        assert set(one) == {"id", "name", "frames", "geometry", *GROUPS}
    first, second = (one["shadow_mask"]["error_rate"]["mean"] for one in metrics["objects"])
    assert first > 0  # columns 20 and 21 are lit, and predicted dark
    assert second == 0
    assert [one["depth"]["mae"]["mean"] for one in metrics["objects"]] == [0, 2]
    assert any("ball 2 is in 3 of 4 frames" in note for note in metrics["notes"])


def test_one_object_is_no_list(make_run, dataset, tmp_path):
    metrics = evaluate(make_run(), dataset, tmp_path / "eval")
    assert metrics["objects"] is None
    assert "objects" not in metrics["frames"][0]
    assert sum(note.startswith("objects is null") for note in metrics["notes"]) == 1
    assert object_names(replace(dataset, scene={})) == {}


def test_a_scene_in_the_place_of_a_run(make_run, pair, tmp_path):
    trained = replace(pair, train=pair.test[:1])  # other data than the models were trained on
    scene = Scene(FakeScene(make_run(shifted), ["left", "right"]), Path("pair.toml"))
    metrics = evaluate(scene, trained, tmp_path / "eval")
    assert [one["name"] for one in metrics["objects"]] == ["left", "right"]
    assert (metrics["known_suns"], metrics["unseen_suns"]) == (None, None)
    assert (metrics["run"], metrics["model"]["gaussians"]) == ("pair.toml", 7)
    alone = evaluate(make_run(shifted), trained, tmp_path / "alone")
    assert metrics["image"] == alone["image"]
    three = Scene(FakeScene(make_run(shifted), ["a", "b", "c"]), Path("three.toml"))
    other = evaluate(three, trained, tmp_path / "three")
    assert [one["name"] for one in other["objects"]] == ["ball 1", "ball 2"]
    assert any("3 models" in note and "2 objects" in note for note in other["notes"])


def test_the_report_has_both_tables_of_each_object(make_run, pair, tmp_path):
    for name, change in (("good", lambda rgb: rgb + 0.01), ("bad", shifted)):
        evaluate(make_run(change, path=Path(name)), pair, tmp_path / name)
    write_report([tmp_path / "good", tmp_path / "bad"], tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    assert "Object by object" in text
    for caption in ("ball 1: image", "ball 2: image", "ball 1: shadow by luminance", "ball 2: depth"):
        assert caption in text
    assert "ball 1: shadow by predicted visibility" not in text  # these runs predict none
    write_report([tmp_path / "good"], tmp_path / "one.html")
    assert "Object by object" in (tmp_path / "one.html").read_text()


def test_old_evaluations_have_no_objects(make_run, dataset, tmp_path):
    evaluate(make_run(), dataset, tmp_path / "eval")
    write_report([tmp_path / "eval"], tmp_path / "report.html")
    assert "Object by object" not in (tmp_path / "report.html").read_text()


def test_eval_of_a_composed_scene(spacesim, tiny_run, tmp_path):
    """Two runs against a path-traced pair: from TOML to report."""
    done = spacesim(
        "generate", "boxsat-pair", "--out", tmp_path / "pair", "--sun", "45,35", "--views", 1, "--test-suns", 0,
        "--test-views", 2, "--resolution", 40, "--spp", 4,
    )  # fmt: skip
    assert done.code == 0, done.errors
    model = f'[[models]]\nrun = "{tiny_run}"\n'
    text = f'{model}name = "a"\n{model}name = "b"\nposition = [-3, -3, -3]\n'
    (tmp_path / "pair.toml").write_text(text)
    line = ["eval", tmp_path / "pair.toml", "--data", tmp_path / "pair", "--out", tmp_path / "eval"]
    evaluated = spacesim(*line, "--no-geometry", "--json")
    assert evaluated.code == 0, evaluated.errors
    assert '"name": "b"' in evaluated.output
    assert "Object by object" in (tmp_path / "eval" / "report.html").read_text()
    refused = spacesim("eval", tmp_path / "no.toml", "--data", tmp_path / "pair", "--out", tmp_path / "eval")
    assert refused.is_refusal("no.toml")

    scene = ComposedRun(load_scene(tmp_path / "pair.toml").posed_at(0.0), tmp_path / "pair.toml")
    small = GeometryConfig(samples=2000, voxels=32, mesh=MeshConfig(voxels=32, views=4))
    metrics = evaluate(scene, read_dataset(tmp_path / "pair"), tmp_path / "shaped", EvaluateConfig(geometry=small))
    assert metrics["geometry"]["chamfer"] > 0
    assert [one["geometry"]["size"] for one in metrics["objects"]] == pytest.approx([6.19, 6.19], abs=0.01)
    assert not any(note.startswith("Geometry") or "order" in note for note in metrics["notes"])
    swapped = ComposedRun(scene.composition.posed([one.pose for one in scene.composition.models[::-1]]), scene.path)
    assert swapped_order(swapped, read_dataset(tmp_path / "pair")) == [2, 1]
    (note,) = explain_objects({1: "a", 2: "b"}, [], ["a", "b"], [2, 1])[:1]
    assert note.startswith("a, b stand where objects 2, 1 of the data are and are evaluated as objects 1, 2")
    assert (tmp_path / "shaped" / "geometry" / "reconstruction.ply").exists()
