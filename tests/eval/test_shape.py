"""Shape evaluated end to end on tiny runs: numbers, notes, pictures, the report's section, exported meshes."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from spacesim.data.errors import InputError
from spacesim.data.images import read_png
from spacesim.data.mesh import SignedDistance, load_mesh, read_mesh, write_mesh
from spacesim.data.store import read_dataset
from spacesim.eval.metrics.exterior import ExteriorView
from spacesim.eval.metrics.geometry import COMPARED, GeometryConfig, compare_geometry, compare_shape
from spacesim.eval.objects import compare_object_shapes, object_names
from spacesim.eval.report.surfaces import value_of
from spacesim.eval.report.write import write_report
from spacesim.eval.shape import BACKGROUND, COLORS, cameras_around_mesh, draw_distances, write_shapes
from spacesim.splat.compose import ComposedRun, GaussianComposition, PlacedRun, Pose
from spacesim.splat.compose.pose import rotation_about
from spacesim.splat.export.mesh import MeshConfig, cameras_around
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.run import load_run
from spacesim.splat.train.start import initial_gaussians

SMALL = GeometryConfig(samples=3000, voxels=40, mesh=MeshConfig(voxels=48, views=6))


def sphere(radius, subdivisions=4):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return np.array(mesh.vertices), np.array(mesh.faces, np.int64)


@pytest.fixture(scope="module")
def tiny(tiny_run, tiny_data):
    return load_run(tiny_run), read_dataset(tiny_data)


def test_a_trained_run_has_numbers(tiny):
    found = compare_geometry(*tiny, SMALL)
    assert found.note == ""
    values = found.values
    assert json.loads(json.dumps(values, allow_nan=False)) == values
    assert set(COMPARED) <= set(values)
    assert values["size"] == pytest.approx(6.19, abs=0.01)
    assert 0 < values["chamfer"] < 1  # square metres, of an object of 6 m: it is there, roughly
    assert 0 < values["precision_recall"]["f"] <= 1
    assert 0.05 < values["iou"] < 1
    assert values["mesh"]["views"] == 6
    assert 0 < values["floaters"]["inside"] < 1
    assert compare_geometry(*tiny, SMALL).values == values  # the same bits


def test_better_shapes_have_better_numbers(tiny):
    run, dataset = tiny
    arrays = initial_gaussians(dataset, "mesh", 30_000, 0, seed=0).to_numpy()
    arrays["logit_opacities"][:] = 4  # opaque, thin, on the true surface
    arrays["log_scales"] -= 0.4
    worse = {**arrays, "means": arrays["means"] * np.float32(1.2)}
    models = (Gaussians.from_numpy(one) for one in (arrays, worse))
    good, bad = (compare_geometry(replace(run, gaussians=model), dataset, SMALL).values for model in models)
    assert bad["chamfer"] > 2 * good["chamfer"]
    assert bad["hausdorff99"] > good["hausdorff99"]
    assert bad["iou"] < good["iou"]
    assert good["floaters"]["outside"] < 0.01 < bad["floaters"]["outside"]


# Composed scenes


def placed_pair(run, dataset, folder):
    """Two models of one run, the second turned, moved and twice as large, and data whose true mesh is theirs."""
    poses = Pose(), Pose(rotation_about([0, 0, 1], 90), [9.0, 0, 2], 2.0)
    scene = ComposedRun(
        GaussianComposition([PlacedRun(run, pose, f"model {k}") for k, pose in enumerate(poses)]), folder
    )
    vertices, faces = read_mesh(dataset.root / dataset.mesh_path)
    second = 2 * vertices @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).T + [9, 0, 2]
    write_mesh(folder / "pair.ply", np.concatenate([vertices, second]), np.concatenate([faces, faces + len(vertices)]))
    matrices = [np.eye(4), np.array([[0.0, -2, 0, 9], [2, 0, 0, 0], [0, 0, 2, 2], [0, 0, 0, 1]])]
    described = {
        "objects": [{"id": k + 1, "name": "one", "world_from_object": m.tolist()} for k, m in enumerate(matrices)],
        "mesh": [{"object": k + 1, "vertices": len(vertices), "faces": len(faces)} for k in range(2)],
    }
    return scene, replace(dataset, root=folder, mesh_path="pair.ply", scene={**dataset.scene, **described})


def test_models_of_a_scene_have_the_shapes_of_their_runs(tiny, tmp_path):
    """Twice as large: twice the lengths, four times the areas, all else as before."""
    run, dataset = tiny
    scene, pair = placed_pair(run, dataset, tmp_path)
    names = object_names(pair, [part.name for part in scene.parts])
    assert list(names.values()) == ["model 0", "model 1"]
    cameras = cameras_around(run.gaussians, SMALL.mesh.views)
    alone = compare_shape(run.gaussians, run.antialiased, cameras, read_mesh(dataset.root / dataset.mesh_path), SMALL)
    first, second = compare_object_shapes(scene, pair, names, SMALL).values()
    for key in ("chamfer", "hausdorff99", "iou", "size", "accuracy"):
        assert first[key] == pytest.approx(alone.values[key], rel=1e-3)
        factor = {"chamfer": 4, "iou": 1}.get(key, 2)
        # other views and voxels: an IoU of 0.1 and one per cent of the surface change more by them
        within = 0.3 if key in ("hausdorff99", "iou") else 0.15
        assert second[key] == pytest.approx(factor * first[key], rel=within), key
    assert second["floaters"]["inside"] == pytest.approx(first["floaters"]["inside"], abs=1e-3)

    whole = compare_geometry(scene, pair, SMALL)
    assert whole.note == ""
    assert whole.values["mesh"]["views"] == SMALL.mesh.views
    assert whole.values["floaters"]["inside"] == pytest.approx(first["floaters"]["inside"], abs=1e-3)
    moved = replace(scene, composition=scene.composition.moved(1, Pose(translation=[9.0, 6.0, 2.0])))
    assert compare_geometry(moved, pair, SMALL).values["chamfer"] > 10 * whole.values["chamfer"]
    assert compare_object_shapes(moved, pair, names, SMALL)[1] == first


def test_objects_without_a_shape_of_their_own(tiny, tmp_path):
    """A run's Gaussians belong to no object; three models are not two objects; a mesh without a description."""
    run, dataset = tiny
    scene, pair = placed_pair(run, dataset, tmp_path)
    names = object_names(pair)
    three = replace(scene, composition=GaussianComposition([*scene.composition.models, PlacedRun(run)]))
    less = {key: value for key, value in pair.scene.items() if key != "mesh"}
    for who, what, config in (
        (run, pair, SMALL),
        (three, pair, SMALL),
        (scene, replace(pair, scene=less), SMALL),
        (scene, replace(pair, mesh_path=None), SMALL),
        (scene, pair, None),
    ):
        assert compare_object_shapes(who, what, names, config) == {}


def test_the_report_has_the_shape_of_each_object(tiny_eval, tmp_path):
    metrics = json.loads((tiny_eval / "metrics.json").read_text())
    shutil.copytree(tiny_eval, tmp_path / "pair")
    entry = {"frames": 2, "image": None, "shadow": None, "shadow_mask": None}
    shapes = [{**metrics["geometry"], "iou": iou} for iou in (0.1234, 0.4321)]
    objects = [{"id": k, "name": f"model <{k}>", **entry, "geometry": shapes[k]} for k in range(2)]
    (tmp_path / "pair" / "metrics.json").write_text(json.dumps({**metrics, "objects": objects}))
    write_report([tmp_path / "pair"], tmp_path / "pair.html")
    page = (tmp_path / "pair.html").read_text()
    for words in ("All models", "model &lt;0&gt; alone", "model &lt;1&gt; alone", "0.1234", "0.4321"):
        assert words in page


# What cannot be evaluated


def test_runs_without_a_surface_have_a_sentence(tiny):
    run, dataset = tiny
    arrays = run.gaussians.to_numpy()
    faint = Gaussians.from_numpy({**arrays, "logit_opacities": np.full(run.gaussian_count, -12.0)})
    one = Gaussians.from_numpy({name: values[:1] for name, values in arrays.items()})
    none = Gaussians.from_numpy({name: values[:0] for name, values in arrays.items()})
    for model in (faint, one, none):
        found = compare_geometry(replace(run, gaussians=model), dataset, SMALL)
        assert (found.values["chamfer"] is None) == (found.note != "")
        assert (found.values["floaters"] is None) == (model.count == 0)
        json.dumps(found.values, allow_nan=False)
    assert found.note.startswith("Geometry is null but for its floaters: no view")


def test_scores_that_cannot_be_computed_are_null_with_a_reason(tiny, tmp_path):
    run, dataset = tiny
    assert compare_geometry(run, dataset, None).note == "Geometry is null: it was not asked for."
    without = compare_geometry(run, replace(dataset, mesh_path=None), SMALL)
    assert (without.values, without.note) == (None, "Geometry is null: the data has no true mesh.")
    gone = replace(dataset, mesh_path="gone.ply")
    with pytest.raises(InputError, match=r"gone.ply: expected a mesh, found none"):
        compare_geometry(run, gone, SMALL)
    (tmp_path / "broken.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\nend_header\n0 0")
    with pytest.raises(InputError, match=r"broken.ply: expected a mesh"):
        compare_geometry(run, replace(dataset, root=tmp_path, mesh_path="broken.ply"), SMALL)
    write_mesh(tmp_path / "point.ply", np.zeros((3, 3)), np.array([[0, 1, 2]]))
    with pytest.raises(InputError, match=r"point.ply: expected a mesh, found no face with an area"):
        compare_geometry(run, replace(dataset, root=tmp_path, mesh_path="point.ply"), SMALL)


def test_colors_are_those_of_the_distance():
    inner, outer = sphere(1.0), sphere(1.1)
    camera = cameras_around_mesh(inner)[0]
    for scale, expected in ((0.1, COLORS[-1]), (0.2, COLORS[2]), (1e9, COLORS[0])):
        image = draw_distances(inner, ExteriorView(*inner), SignedDistance(*outer), camera, scale)
        middle = image[camera.height // 2, camera.width // 2]  # it faces the camera: full light
        assert np.abs(middle.astype(int) - expected).max() <= 4
        assert tuple(image[0, 0]) == BACKGROUND


def test_pictures_are_filled_by_the_object():
    vertices, faces = sphere(3.0)
    vertices = vertices * [1, 0.2, 0.5] + [100, 0, -7]
    for camera in cameras_around_mesh((vertices, faces)):
        image = draw_distances(
            (vertices, faces), ExteriorView(vertices, faces), SignedDistance(vertices, faces), camera, 1.0
        )
        rows, columns = np.nonzero((image != BACKGROUND).any(axis=2))
        fill = max(np.ptp(rows) / image.shape[0], np.ptp(columns) / image.shape[1])
        assert 0.9 < fill < 0.96
        assert min(rows.min(), columns.min()) > 0


def test_eval_and_report_show_the_shape(tiny_eval, tmp_path):
    metrics = json.loads((tiny_eval / "metrics.json").read_text())
    geometry = metrics["geometry"]
    assert geometry["chamfer"] > 0
    assert value_of(geometry, "f") == geometry["precision_recall"]["f"]
    assert not any(note.startswith("Geometry") for note in metrics["notes"])
    for name in ("truth", "reconstruction"):
        assert (read_png(tiny_eval / "geometry" / f"{name}_2.png") != BACKGROUND).any()
    written = load_mesh(tiny_eval / "geometry" / "reconstruction.ply")
    assert len(written.faces) == geometry["mesh"]["faces"]
    page = (tiny_eval / "report.html").read_text()
    for words in (
        "<h2>Shape</h2>",
        "<dt>Hausdorff</dt>",
        "Hausdorff-99",
        "what is missing",
        "what is too much",
        "61.9 mm, 1 %",
    ):
        assert words in page

    other = tmp_path / "without"
    shutil.copytree(tiny_eval, other)
    shutil.rmtree(other / "geometry")
    (other / "metrics.json").write_text(json.dumps({**metrics, "geometry": None}))
    write_report([other], tmp_path / "one.html")
    assert "<h2>Shape</h2>" not in (tmp_path / "one.html").read_text()
    write_report([tiny_eval, other], tmp_path / "two.html")
    assert (tmp_path / "two.html").read_text().count("what is missing") == 4  # a heading, three views, of one run
    empty = {**geometry, **dict.fromkeys(COMPARED)}
    (other / "metrics.json").write_text(json.dumps({**metrics, "geometry": empty}))
    write_report([other], tmp_path / "three.html")
    assert "Floaters" in (tmp_path / "three.html").read_text()


def test_nothing_is_written_without_a_comparison(tiny, tmp_path):
    write_shapes(tmp_path / "geometry", compare_geometry(*tiny, None))
    assert not (tmp_path / "geometry").exists()


def test_eval_without_geometry(spacesim, tiny_run, tiny_data, tmp_path):
    done = spacesim("eval", tiny_run, "--data", tiny_data, "--out", tmp_path / "eval", "--no-geometry", "--json")
    metrics = json.loads(done.output)
    assert metrics["geometry"] is None
    assert "Geometry is null: it was not asked for." in metrics["notes"]


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_export_of_a_mesh(spacesim, tiny_run, tmp_path, suffix):
    out = tmp_path / f"run{suffix}"
    done = spacesim("export", tiny_run, "--mesh", out, "--voxel", "0.1", "--views", "4")
    assert (done.code, done.errors) == (0, [])
    assert "from 4 views, voxels of 0.1 m" in done.output
    vertices, faces = read_mesh(out)
    assert len(faces) > 500
    assert np.ptp(vertices, axis=0).max() == pytest.approx(4.7, abs=0.6)


def test_export_where_the_data_is_gone(spacesim, tiny_run, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(tiny_run, run)
    config = json.loads((run / "config.json").read_text())
    config["data"]["path"] = str(tmp_path / "gone")
    (run / "config.json").write_text(json.dumps(config))
    done = spacesim("export", run, "--mesh", tmp_path / "a.stl", "--voxel", "0.1", "--views", "5")
    assert done.code == 0
    assert done.errors == [f"{tmp_path / 'gone'}: is gone; 5 cameras around the model take the place of its views"]
    assert len(read_mesh(tmp_path / "a.stl")[1]) > 500


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        ("--mesh OUT/a.xyz", ("a.xyz", ".glb")),
        ("--mesh OUT/a.ply --voxel 0", ("voxel",)),
        ("--mesh OUT/a.ply --voxel 1e-5", ("voxel", "GB")),
        ("--mesh OUT/a.ply --voxel 1e-9", ("voxel", "GB")),
        ("--mesh OUT/a.ply --truncation 0", ("truncation",)),
        ("--mesh OUT/a.ply --truncation 1e9", ("truncation", "100")),
        ("--mesh OUT/a.stl --sun 1,2", ("--sun", ".glb")),
        ("--mesh OUT/a.ply --views 0", ("views: expected at least 1",)),
        ("--mesh OUT/a.ply --data OUT", ("transforms.json",)),
        ("--ply OUT/a.ply --voxel 1", ("--voxel", "--mesh")),
    ],
)
def test_wrong_options_of_export_end_in_a_sentence(spacesim, tiny_run, tmp_path, arguments, names):
    done = spacesim("export", tiny_run, *arguments.replace("OUT", str(tmp_path)).split())
    assert done.is_refusal(*names), done
    assert not list(tmp_path.iterdir())
