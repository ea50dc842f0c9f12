"""Mesh files of all formats: units, axes, winding, what is dropped and said, and that nothing ends in a traceback."""

import re
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from spacesim.data.errors import InputError
from spacesim.scenes.build import build
from spacesim.scenes.config import UNITS
from spacesim.scenes.generation.generate import plan_views
from spacesim.scenes.meshes.read import read_mesh
from spacesim.scenes.scenefile import read_scene

SHARED = Path(__file__).parents[4] / "shared" / "meshes"
FACES = {"hubble.glb": 19503, "milani.glb": 6018, "bennu.ply": 49152}


def box(*extents: float) -> trimesh.Trimesh:
    return trimesh.creation.box(extents or (1.0, 1.0, 1.0))


def saved(mesh: trimesh.Trimesh | trimesh.Scene, path: Path) -> Path:
    mesh.export(path)
    return path


def ply(path: Path, vertices, faces) -> Path:
    head = f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\nproperty float x\nproperty float y\n"
    head += f"property float z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [" ".join(str(x) for x in v) for v in vertices] + [" ".join(map(str, (len(f), *f))) for f in faces]
    path.write_text(head + "\n".join(rows) + "\n")
    return path


def only_mesh(path: Path, **options) -> trimesh.Trimesh:
    craft, _ = read_mesh(path, **options)
    assert len(craft.parts) == 1
    return craft.parts[0].mesh


@pytest.mark.parametrize("suffix", ["glb", "gltf", "obj", "stl", "ply", "off"])
def test_a_box_comes_out_of_every_format(tmp_path, suffix):
    path = tmp_path / f"crate.{suffix}"
    if suffix == "gltf":
        for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(box(1, 2, 3))).items():
            (tmp_path / name).write_bytes(data)
        path = tmp_path / "model.gltf"
    else:
        saved(box(1, 2, 3), path)
    craft, report = read_mesh(path, up="z")
    mesh = craft.parts[0].mesh
    assert (len(mesh.vertices), len(mesh.faces)) == (8, 12)
    assert mesh.volume == pytest.approx(6.0)
    np.testing.assert_allclose(report.bounds, [[-0.5, -1, -1.5], [0.5, 1, 1.5]])
    assert report.watertight
    assert (report.parts, report.faces, report.textures) == (1, 12, 0)


@pytest.mark.parametrize("unit", UNITS)
def test_units_and_scale(tmp_path, unit):
    path = saved(box(1, 2, 3), tmp_path / "crate.stl")
    metres = {"m": 1, "cm": 0.01, "mm": 0.001, "km": 1000, "in": 0.0254, "ft": 0.3048}[unit]
    np.testing.assert_allclose(only_mesh(path, units=unit, scale=2.0).extents, np.array([1, 2, 3]) * 2 * metres)


def test_the_up_axis_becomes_z_and_nothing_is_mirrored(tmp_path):
    arms = [np.eye(3)[i] * (i + 1) for i in range(3)]
    path = ply(tmp_path / "arms.ply", [[0, 0, 0], *arms], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    ups = {"z": arms[2], "y": arms[1], "x": arms[0]}
    for up, arm in ups.items():
        mesh = only_mesh(path, up=up)
        assert mesh.volume == pytest.approx(1.0)  # a mirrored tetrahedron would have -1
        assert any(np.allclose(v, [0, 0, np.linalg.norm(arm)]) for v in mesh.vertices)
    np.testing.assert_allclose(only_mesh(path, up="y").vertices, [[0, 0, 0], [1, 0, 0], [0, 0, 2], [0, -3, 0]])
    glb = saved(trimesh.Scene(trimesh.load(path)), tmp_path / "arms.glb")
    np.testing.assert_allclose(only_mesh(glb).vertices, only_mesh(path, up="y").vertices)


def test_a_box_inside_out_is_turned_and_said(tmp_path):
    mesh = box()
    mesh.invert()
    craft, report = read_mesh(saved(mesh, tmp_path / "inverted.ply"))
    assert craft.parts[0].mesh.volume == pytest.approx(1.0)
    assert any("inside out" in line and "12 faces" in line for line in report.changed)


@pytest.mark.parametrize("seed", range(5))
def test_mixed_winding_is_mended(tmp_path, seed):
    mesh = trimesh.creation.icosphere(2)
    turn = np.random.default_rng(seed).random(len(mesh.faces)) < 0.4
    mesh.faces[turn] = mesh.faces[turn][:, ::-1]
    craft, report = read_mesh(saved(mesh, tmp_path / "mixed.off"))
    mended = craft.parts[0].mesh
    assert mended.is_winding_consistent
    assert mended.volume > 0
    assert any("neighbours" in line for line in report.changed)


def test_a_cavity_stays_a_cavity_and_a_bolt_is_turned(tmp_path):
    inner, bolt = box(0.5, 0.5, 0.5), box(0.2, 0.2, 0.2)
    inner.invert()
    bolt.invert()
    bolt.apply_translation([0.65, 0, 0])
    whole = trimesh.util.concatenate([box(), inner, bolt])
    craft, report = read_mesh(saved(whole, tmp_path / "tank.ply"))
    assert craft.parts[0].mesh.volume == pytest.approx(1.0 - 0.125 + 0.008)
    assert any("12 faces" in line for line in report.changed)


def test_open_surfaces_keep_their_winding_unless_asked(tmp_path):
    sheet = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    path = ply(tmp_path / "sheet.ply", sheet, [[0, 1, 2], [0, 3, 2]])
    left, report = read_mesh(path)
    np.testing.assert_allclose(left.parts[0].mesh.face_normals[:, 2], [1, -1])
    assert any("mixed winding" in line for line in report.changed)
    assert abs(read_mesh(path, two_sided=False)[0].parts[0].mesh.face_normals[:, 2].sum()) == pytest.approx(2)


def test_two_sided_wraps_what_is_closed(tmp_path):
    path = saved(box(), tmp_path / "crate.stl")
    assert read_mesh(path)[0].parts[0].material.bsdf["type"] != "twosided"
    assert read_mesh(path, two_sided=True)[0].parts[0].material.bsdf["type"] == "twosided"


def test_broken_faces_are_dropped_and_counted(tmp_path):
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], ["nan", 0, 0], ["inf", 1, 1], [1e20, 0, 0], [0.5, 0, 0], [0, 0, 1]]
    faces = [[0, 1, 2], [0, 1, 3], [0, 1, 4], [0, 1, 5], [0, 1, 6], [0, 0, 2], [2, 0, 1], [0, 1, 7], [0, 1, 99]]
    craft, report = read_mesh(ply(tmp_path / "broken.ply", vertices, faces))
    mesh = craft.parts[0].mesh
    assert (len(mesh.vertices), len(mesh.faces)) == (4, 2)
    text = "\n".join(report.dropped)
    assert "3 of broken" in text  # not finite or far away
    assert "2 of broken" in text  # no area
    assert text.count("1 of broken") == 2  # lies on another; names a vertex that is not there


OBJ_CORNERS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\n"


@pytest.mark.parametrize("broken", ["1 2 99", "0 1 2", "-4 -1 -2", "1/1/1 2/1/1 4/1/1"])
def test_faces_of_an_obj_that_name_what_is_not_there_are_dropped(tmp_path, broken):
    path = tmp_path / "idx.obj"
    for lines in (f"f {broken}\nf 1 2 3\n", f"f 1 2 3\nf {broken}\n", f"f -3 -2 -1\nf {broken}\n"):
        path.write_text(OBJ_CORNERS + lines)
        craft, report = read_mesh(path)
        np.testing.assert_array_equal(craft.parts[0].mesh.triangles, [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]])
        assert "faces that name vertices which are not there are dropped: 1 of idx" in report.dropped
    path.write_text(OBJ_CORNERS + f"f {broken}\n")
    with pytest.raises(InputError, match=r"expected faces, found none; faces that name .* are dropped: 1 of idx"):
        read_mesh(path)


@pytest.mark.parametrize("broken", ["1/1 2/9 3/1", "1//1 2//7 3//1", "1/0/1 2/1/1 3/1/1", "1/1/-9 2/1/1 3/1/1"])
def test_texture_coordinates_and_normals_of_an_obj_that_are_not_there_cost_no_face(tmp_path, broken):
    path = tmp_path / "idx.obj"
    sound = "v 0 0 1\nf 1/1/1 2/1/1 4/1/1\n"
    for lines in (f"f {broken}\n", f"{sound}f {broken}\n", f"f {broken}\n{sound}"):
        path.write_text(OBJ_CORNERS + lines)
        assert read_mesh(path)[1].faces == lines.count("f")


@pytest.mark.parametrize("corners", [OBJ_CORNERS + "f 1 2 3\n", OBJ_CORNERS + "v 1 1 0\nf 1 2 4 3\n"])
def test_a_single_triangle_and_a_flat_plate_are_scenes(tmp_path, corners):
    path = tmp_path / "flat.obj"
    path.write_text(corners)
    config = read_scene(path, views=2, test_views=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = build(config)
    centre, radius = scene.bounding_sphere
    np.testing.assert_allclose(centre, [0.5, 0.5, 0.0], atol=0.01)
    assert radius == pytest.approx(0.5**0.5, rel=0.01)
    assert len(plan_views(scene, config)[0]) == 2


def test_a_mesh_too_small_for_single_precision_is_named(tmp_path):
    path = saved(box(1e-12, 1e-12, 1e-12), tmp_path / "tiny.ply")
    with pytest.raises(InputError, match=r"^object tiny: expected a size from 1e-06 to 1e\+10 m, found 1e-12 m$"):
        build(read_scene(path))


def test_sides_and_materials_of_a_scene_file(tmp_path, caplog):
    """two_sided is a key of objects, and the report is silent about materials that the file replaces."""
    saved(box(), tmp_path / "crate.stl")
    (tmp_path / "sat.obj").write_text(OBJ)
    (tmp_path / "paint.mtl").write_text("newmtl cells\nKd 1 1 1\nKs 1 1 1\nnewmtl paint\nKd 1 1 1\nKs 1 1 1\nNs 20\n")

    def built(text):
        (tmp_path / "my.toml").write_text(f"[[objects]]\n{text}\n")
        caplog.clear()
        with caplog.at_level("INFO"):
            parts = build(read_scene(tmp_path / "my.toml")).objects[0].spacecraft.parts
        return [part.material for part in parts], caplog.text

    (plain,), said = built("mesh = 'crate.stl'")
    assert (plain.name, plain.bsdf["type"]) == ("grey-paint", "diffuse")
    assert "parts without a material get the preset grey-paint" in said
    (gold,), said = built("mesh = 'crate.stl'\nmaterials = { '*' = 'gold-mli' }\ntwo_sided = true")
    assert (gold.name, gold.bsdf["type"]) == ("gold-mli/two-sided", "twosided")
    assert "crate.stl" in said
    assert "grey-paint" not in said
    assert built("mesh = 'crate.stl'\ntwo_sided = true")[0][0].bsdf["type"] == "twosided"
    assert built("mesh = 'crate.stl'\ntwo_sided = false")[0][0].bsdf["type"] == "diffuse"
    names = [part.name for part in read_mesh(tmp_path / "sat.obj")[0].parts]
    both, said = built("mesh = 'sat.obj'")
    assert len(both) == len(names) == 2
    assert "2 materials" in said
    assert {"cells", "paint"} <= set(re.split(r"\W+", said.split("base colours")[1].split("\n")[0]))
    some, said = built(f"mesh = 'sat.obj'\nmaterials = {{ '{names[0]}' = 'kapton' }}")
    assert (some[0].name, some[1].name) == ("kapton", both[1].name)
    evaluated = said.split("base colours")[1].split("\n")[0]
    assert both[1].name.split("/")[1] in evaluated
    assert both[0].name.split("/")[1] not in evaluated
    assert "base colours" not in built("mesh = 'sat.obj'\nmaterials = { '*' = 'kapton' }")[1]


def test_no_material_gives_grey_paint_and_a_sentence(tmp_path):
    craft, report = read_mesh(saved(box(), tmp_path / "crate.stl"))
    assert craft.parts[0].material.name == "grey-paint"
    assert any("grey-paint" in line for line in report.lines())


OBJ = """mtllib paint.mtl
o Panel
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl cells
f -4/-4 -3/-3 -2/-2 -1/-1
o Bus
v 0 0 1
v 1 0 1
v 0 1 1
usemtl paint
f -3 -2 -1
"""


def write_obj(folder: Path, mtl: str) -> Path:
    (folder / "sat.obj").write_text(OBJ)
    (folder / "paint.mtl").write_text(mtl)
    return folder / "sat.obj"


def test_obj_objects_materials_and_relative_indices(tmp_path):
    picture = np.zeros((4, 4, 3), dtype=np.uint8)
    picture[:2, :2] = [255, 0, 0]
    Image.fromarray(picture).save(tmp_path / "cells.png")
    mtl = "newmtl cells\nKd 1 1 1\nmap_Kd cells.png\nnewmtl paint\nKd 0.2 0.4 0.6\nKs 1 1 1\nNs 98\nd 0.5\n"
    craft, report = read_mesh(write_obj(tmp_path, mtl))
    parts = {part.name.split("_")[0]: part for part in craft.parts}
    assert set(parts) == {"Panel", "Bus"}
    np.testing.assert_allclose(parts["Bus"].mesh.vertices[:, 2], 1.0)
    assert parts["Panel"].mesh.area == pytest.approx(1.0)
    paint = parts["Bus"].material
    np.testing.assert_allclose(paint.albedo, [0.2, 0.4, 0.6])
    assert paint.bsdf["roughness"] == pytest.approx(0.02**0.25)  # alpha^2 = 2 / (98 + 2)
    assert not any("opaque" in line for line in report.dropped)
    assert report.opaque == ("transparent surfaces: paint",)
    assert "rendered opaque: transparent surfaces: paint" in report.lines()
    cells = parts["Panel"].material
    assert cells.bsdf["type"] == "diffuse"
    np.testing.assert_array_equal(cells.images["base_color"], picture)
    np.testing.assert_allclose(cells.albedo, [0.25, 0, 0])
    corner = parts["Panel"].mesh.vertices[np.argmin(np.abs(parts["Panel"].mesh.visual.uv).sum(axis=1))]
    np.testing.assert_allclose(corner, [0, 1, 0])  # uv (0, 0), the picture's top row, is obj's vt (0, 1)


def test_latin_1_is_read_as_well_as_utf_8(tmp_path):
    path = write_obj(tmp_path, "")
    (tmp_path / "paint.mtl").write_bytes("# Farbe für Bézier\nnewmtl paint\nKd 0.25 0.5 1\n".encode("latin-1"))
    for encoding in ("latin-1", "utf-8"):
        path.write_bytes(OBJ.replace("Bus", "Bézier").encode(encoding))
        craft, _ = read_mesh(path)
        assert (0.25, 0.5, 1.0) in {part.material.albedo for part in craft.parts}


@pytest.mark.parametrize(
    ("mtl", "said"),
    [
        ("newmtl cells\nKd 1 0 0\nmap_Kd lost.png\nnewmtl paint\nKd 0 0 1\n", "lost.png"),
        ("newmtl cells\nKd 1 0 0\nmap_Kd ../secret.png\nnewmtl paint\nKd 0 0 1\n", "outside"),
        ("newmtl cells\nKd 1 0 0\nmap_Kd words.png\nnewmtl paint\nKd 0 0 1\n", "decoded"),
    ],
)
def test_obj_without_its_texture_keeps_the_color_and_says_so(tmp_path, mtl, said):
    (tmp_path / "sat").mkdir()
    (tmp_path / "sat" / "words.png").write_text("no picture")
    Image.new("RGB", (2, 2)).save(tmp_path / "secret.png")
    craft, report = read_mesh(write_obj(tmp_path / "sat", mtl))
    assert {part.material.albedo for part in craft.parts} == {(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)}
    assert not any(part.material.images for part in craft.parts)
    assert any(said in line for line in report.dropped)


def test_a_picture_that_breaks_off_is_named(tmp_path):
    Image.effect_noise((64, 64), 90).save(tmp_path / "half.png")
    (tmp_path / "half.png").write_bytes((tmp_path / "half.png").read_bytes()[:2000])
    _, report = read_mesh(write_obj(tmp_path, "newmtl cells\nmap_Kd half.png\nnewmtl paint\nKd 0 0 1\n"))
    assert "textures that cannot be decoded are not used: half.png" in report.dropped


def test_obj_without_its_mtl_gets_grey_paint_and_says_so(tmp_path):
    path = write_obj(tmp_path, "")
    (tmp_path / "paint.mtl").unlink()
    craft, report = read_mesh(path)
    assert {part.material.name for part in craft.parts} == {"grey-paint"}
    assert any("paint.mtl" in line for line in report.dropped)


def test_more_parts_than_ids_are_joined_by_material(tmp_path):
    scene = trimesh.Scene()
    for i in range(300):
        crate = box()
        crate.apply_translation([2 * i, 0, 0])
        color = [255, 0, 0, 255] if i % 2 else [0, 0, 255, 255]
        crate.visual = trimesh.visual.TextureVisuals(
            material=trimesh.visual.material.PBRMaterial(name=f"paint {i % 2}", baseColorFactor=color)
        )
        scene.add_geometry(crate, node_name=f"crate {i}")
    path = tmp_path / "many.gltf"
    files = trimesh.exchange.gltf.export_gltf(scene)
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    craft, report = read_mesh(tmp_path / "model.gltf" if "model.gltf" in files else path)
    assert sorted(part.name for part in craft.parts) == ["paint_0", "paint_1"]
    assert report.faces == 300 * 12
    assert any("300 parts" in line for line in report.changed)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("none.glb", None, "nothing there"),
        ("folder.obj", "folder", "a folder"),
        ("empty.ply", b"", "an empty one"),
        ("scan.xyz", b"0 0 0\n", "expected one of .glb"),
        ("scan", b"0 0 0\n", "no suffix"),
        ("words.glb", b"This is no mesh but a sentence of some length.\n", "begins with"),
        ("words.gltf", b"This is no mesh.\n", "damage"),
        ("words.ply", b"This is no mesh.\n", "expected a ply file"),
        ("words.stl", b"This is no mesh.\n", "found none"),
        ("words.obj", b"This is no mesh.\n", "found none"),
        ("words.off", b"This is no mesh.\n", "damage"),
        ("json.gltf", b"[1, 2]", "other JSON"),
        ("old.gltf", b'{"asset": {"version": "1.0"}}', "version 1.0"),
        ("bare.gltf", b'{"asset": {"version": "2.0"}}', "expected faces, found none"),
        ("deep.gltf", b"[" * 100_000, "damage"),
        ("big.stl", bytes(80) + struct.pack("<I", 4_000_000_000) + bytes(100), "4,000,000,000 faces"),
        ("points.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
         b"property float z\nend_header\n0 0 0\n", "expected faces, found none"),
        ("big.ply", b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float x\n"
         b"property float y\nproperty float z\nend_header\n" + bytes(36), "4,000,000,000 elements vertex"),
    ],
)  # fmt: skip
def test_what_is_no_mesh_ends_in_one_sentence(tmp_path, name, content, said):
    path = tmp_path / name
    if content == "folder":
        path.mkdir()
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=said) as caught:
        read_mesh(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_vertex_that_can_be_used_ends_in_one_sentence(tmp_path):
    path = ply(tmp_path / "nan.ply", [["nan"] * 3] * 3, [[0, 1, 2]])
    with pytest.raises(InputError, match="finite vertices"):
        read_mesh(path)
    path = tmp_path / "far.obj"
    path.write_text("v 0 0 0\nv 1e30 0 0\nv 0 1e30 0\nf 1 2 3\n")
    with pytest.raises(
        InputError, match=r"finite vertices within 1e\+09 m, found none; .* beyond 1e\+09 m are dropped"
    ):
        read_mesh(path)


def test_ten_gigabytes_by_mistake_are_refused_unread(tmp_path):
    path = tmp_path / "huge.stl"
    with path.open("wb") as file:
        file.truncate(10 * 2**30)
    with pytest.raises(InputError, match="10,737,418,240"):
        read_mesh(path)


@pytest.mark.parametrize(
    ("options", "said"),
    [({"units": "mile"}, "units"), ({"up": "w"}, "up"), ({"scale": 0.0}, "scale"), ({"scale": float("nan")}, "scale")],
)
def test_impossible_options_are_named(tmp_path, options, said):
    with pytest.raises(InputError, match=said):
        read_mesh(saved(box(), tmp_path / "crate.stl"), **options)


def small_files() -> dict[str, bytes]:
    """A textured plate or box in each format, a few hundred bytes to a few kilobytes."""
    picture = Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3))
    plate = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture, roughnessFactor=0.5)
    plate.visual = trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1], [0, 1]], material=material)
    scene = trimesh.Scene(plate)
    files = {"glb": trimesh.exchange.gltf.export_glb(scene)}
    files["gltf"] = trimesh.exchange.gltf.export_gltf(scene, embed_buffers=True)["model.gltf"]
    for kind in ("stl", "ply", "off", "obj"):
        data = box().export(file_type=kind)
        files[kind] = data.encode() if isinstance(data, str) else data
    files["ply_ascii.ply"] = box().export(file_type="ply", encoding="ascii")
    return files


@pytest.mark.parametrize("seed", range(50))
def test_damage_ends_in_a_mesh_or_in_one_sentence(tmp_path, seed):
    rng = np.random.default_rng(seed)
    for kind, data in small_files().items():
        path = tmp_path / f"x.{kind}"
        path.write_bytes(data)
        assert read_mesh(path)[1].faces > 0
        damaged = bytearray(data[: rng.integers(1, len(data))] if seed % 2 else data)
        for _ in range(rng.integers(1, 12)):
            damaged[rng.integers(len(damaged))] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            craft, report = read_mesh(path)
        except InputError as error:
            assert "\n" not in str(error)  # noqa: PT017
        else:
            assert np.isfinite(report.bounds).all()
            assert all(len(part.mesh.faces) for part in craft.parts)


@pytest.mark.parametrize("name", FACES)
def test_real_files_agree_with_trimesh(name):
    path = SHARED / name
    if not path.exists():
        pytest.skip(f"{path} is not here")
    craft, report = read_mesh(path, up="z")
    reference = trimesh.load(path, process=False, force="scene").to_geometry()
    assert report.faces == FACES[name] == len(reference.faces)
    np.testing.assert_allclose(report.bounds, reference.bounds, atol=1e-9)
    assert sum(part.mesh.area for part in craft.parts) == pytest.approx(reference.area, rel=1e-9)
    assert report.watertight == (name != "hubble.glb")
    reference.merge_vertices(merge_tex=True, merge_norm=True)
    assert report.watertight == reference.is_watertight
    assert all(part.name.isascii() for part in craft.parts)
    assert len({part.name for part in craft.parts}) == len(craft.parts)
    assert all(line.isascii() for line in report.lines())


def test_normals_of_obj_and_ply_files_shade_smoothly(tmp_path):
    """A ball whose normals are its positions, beside a box with its faces' own in the obj; an ascii ply."""
    ball, box = trimesh.creation.icosphere(subdivisions=2), trimesh.creation.box()

    def rows(word, values):
        return [f"{word} {x!r} {y!r} {z!r}" for x, y, z in values.tolist()]

    count = len(ball.vertices)
    lines = ["o Ball", *rows("v", ball.vertices), *rows("vn", ball.vertices)]
    lines += ["f " + " ".join(f"{corner + 1}//{corner + 1}" for corner in face) for face in ball.faces]
    lines += ["o Box", *rows("v", np.add(box.vertices, [3, 0, 0])), *rows("vn", box.face_normals)]
    for i, face in enumerate(box.faces + count + 1, start=count + 1):
        lines.append("f " + " ".join(f"{corner}//{i}" for corner in face))
    (tmp_path / "pair.obj").write_text("\n".join(lines) + "\n")
    craft, report = read_mesh(tmp_path / "pair.obj", up="y")
    parts = {part.name: part for part in craft.parts}
    assert parts["Box"].normals is None
    np.testing.assert_allclose(parts["Ball"].normals, parts["Ball"].mesh.triangles.reshape(-1, 3), atol=1e-9)
    assert parts["Ball"].mesh.is_watertight
    assert not report.dropped

    head = ["ply", "format ascii 1.0", f"element vertex {count}"]
    head += [f"property double {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    head += [f"element face {len(ball.faces)}", "property list uchar int vertex_indices", "end_header"]
    body = [" ".join(map(repr, [*point, *point])) for point in ball.vertices.tolist()]
    body += [f"3 {a} {b} {c}" for a, b, c in ball.faces.tolist()]
    (tmp_path / "ball.ply").write_text("\n".join([*head, *body]) + "\n")
    part = read_mesh(tmp_path / "ball.ply")[0].parts[0]
    np.testing.assert_allclose(part.normals, part.mesh.triangles.reshape(-1, 3), atol=1e-6)
