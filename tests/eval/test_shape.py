"""Shape judged end to end on tiny runs: numbers, notes, pictures, the report's section, exported meshes."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from spacesim.data.errors import InputError
from spacesim.data.images import read_png
from spacesim.data.mesh import SignedDistance, read_mesh, write_mesh
from spacesim.data.store import read_dataset
from spacesim.eval.exterior import Sight
from spacesim.eval.geometry import COMPARED, GeometryConfig, judge_geometry
from spacesim.eval.report import write_report
from spacesim.eval.shape import BACKGROUND, COLOURS, cameras_of, coloured, write_shapes
from spacesim.eval.surfaces import value_of
from spacesim.splat.gaussians import Gaussians
from spacesim.splat.meshing import MeshConfig
from spacesim.splat.run import load_run
from spacesim.splat.train.initialise import initial_gaussians

SMALL = GeometryConfig(samples=3000, voxels=40, mesh=MeshConfig(voxels=48, views=6))


def sphere(radius, subdivisions=4):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return np.array(mesh.vertices), np.array(mesh.faces, np.int64)


@pytest.fixture(scope="module")
def tiny(tiny_run, tiny_data):
    return load_run(tiny_run), read_dataset(tiny_data)


def test_a_trained_run_has_numbers(tiny):
    found = judge_geometry(*tiny, SMALL)
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
    assert judge_geometry(*tiny, SMALL).values == values  # the same bits


def test_better_shapes_have_better_numbers(tiny):
    run, dataset = tiny
    arrays = initial_gaussians(dataset, "mesh", 30_000, 0, seed=0).to_numpy()
    arrays["logit_opacities"][:] = 4  # opaque, thin, on the true surface
    arrays["log_scales"] -= 0.4
    worse = {**arrays, "means": arrays["means"] * np.float32(1.2)}
    models = (Gaussians.from_numpy(one) for one in (arrays, worse))
    good, bad = (judge_geometry(replace(run, model=model), dataset, SMALL).values for model in models)
    assert bad["chamfer"] > 2 * good["chamfer"]
    assert bad["hausdorff99"] > good["hausdorff99"]
    assert bad["iou"] < good["iou"]
    assert good["floaters"]["outside"] < 0.01 < bad["floaters"]["outside"]


def test_runs_without_a_surface_have_a_sentence(tiny):
    run, dataset = tiny
    arrays = run.model.to_numpy()
    faint = Gaussians.from_numpy({**arrays, "logit_opacities": np.full(run.gaussians, -12.0)})
    one = Gaussians.from_numpy({name: values[:1] for name, values in arrays.items()})
    none = Gaussians.from_numpy({name: values[:0] for name, values in arrays.items()})
    for model in (faint, one, none):
        found = judge_geometry(replace(run, model=model), dataset, SMALL)
        assert (found.values["chamfer"] is None) == (found.note != "")
        assert (found.values["floaters"] is None) == (model.count == 0)
        json.dumps(found.values, allow_nan=False)
    assert found.note.startswith("Geometry is null but for its floaters: no view")


def test_what_cannot_be_judged_is_null_and_why(tiny, tmp_path):
    run, dataset = tiny
    assert judge_geometry(run, dataset, None).note == "Geometry is null: it was not asked for."
    without = judge_geometry(run, replace(dataset, mesh_path=None), SMALL)
    assert (without.values, without.note) == (None, "Geometry is null: the data has no true mesh.")
    gone = replace(dataset, mesh_path="gone.ply")
    with pytest.raises(InputError, match=r"gone.ply: expected a mesh, found no such file"):
        judge_geometry(run, gone, SMALL)
    (tmp_path / "broken.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\nend_header\n0 0")
    with pytest.raises(InputError, match=r"broken.ply: expected a mesh"):
        judge_geometry(run, replace(dataset, root=tmp_path, mesh_path="broken.ply"), SMALL)
    write_mesh(tmp_path / "point.ply", np.zeros((3, 3)), np.array([[0, 1, 2]]))
    with pytest.raises(InputError, match=r"point.ply: mesh: expected one of some extent"):
        judge_geometry(run, replace(dataset, root=tmp_path, mesh_path="point.ply"), SMALL)


def test_colours_are_those_of_the_distance():
    inner, outer = sphere(1.0), sphere(1.1)
    camera = cameras_of(inner)[0]
    for scale, expected in ((0.1, COLOURS[-1]), (0.2, COLOURS[2]), (1e9, COLOURS[0])):
        image = coloured(inner, Sight(*inner), SignedDistance(*outer), camera, scale)
        middle = image[camera.height // 2, camera.width // 2]  # it faces the camera: full light
        assert np.abs(middle.astype(int) - expected).max() <= 4
        assert tuple(image[0, 0]) == BACKGROUND


def test_pictures_are_filled_by_the_object():
    vertices, faces = sphere(3.0)
    vertices = vertices * [1, 0.2, 0.5] + [100, 0, -7]
    for camera in cameras_of((vertices, faces)):
        image = coloured((vertices, faces), Sight(vertices, faces), SignedDistance(vertices, faces), camera, 1.0)
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
    _, faces = read_mesh(tiny_eval / "geometry" / "reconstruction.ply")
    assert len(faces) == geometry["mesh"]["faces"]
    page = (tiny_eval / "report.html").read_text()
    for words in ("<h2>Shape</h2>", "Hausdorff-99", "what is missing", "what is too much", "61.9 mm, 1 %"):
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
    write_shapes(tmp_path / "geometry", judge_geometry(*tiny, None))
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
        ("--mesh OUT/a.ply --truncation 0", ("truncation",)),
        ("--mesh OUT/a.ply --views 0", ("view",)),
        ("--mesh OUT/a.ply --data OUT", ("transforms.json",)),
        ("--ply OUT/a.ply --voxel 1", ("--voxel", "--mesh")),
    ],
)
def test_wrong_options_of_export_end_in_a_sentence(spacesim, tiny_run, tmp_path, arguments, names):
    done = spacesim("export", tiny_run, *arguments.replace("OUT", str(tmp_path)).split())
    assert done.is_refusal(*names), done
    assert not list(tmp_path.iterdir())
