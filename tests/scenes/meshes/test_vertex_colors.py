"""Colours of vertices are rendered as they are, in all formats that have them."""

import numpy as np
import pytest
import trimesh
from scenes.meshes.test_gltf import CORNERS, QUAD, SQUARE, Document, looked_up, png

from spacesim.data.images import srgb_from_linear
from spacesim.data.mesh import VertexSurface, write_mesh
from spacesim.scenes.meshes import vertex_colors
from spacesim.scenes.meshes.parts import is_closed_mesh
from spacesim.scenes.meshes.read import read_mesh

SLOPE = np.array([[0.8, 0, 0], [0, 0.8, 0]])  # of the colour along x and y
POINTS = np.random.default_rng(0).uniform(0.02, 0.98, (50, 2))


def colored(points: np.ndarray) -> np.ndarray:
    """Linear colours of the square's points."""
    return points[:, :2] @ SLOPE + [0.05, 0.05, 0.3]


def square(tmp_path, colors: np.ndarray, **material):
    document = Document(materials=[{"name": "skin", "pbrMetallicRoughness": {"metallicFactor": 0.0, **material}}])
    primitive = document.square(material=0)
    primitive["attributes"]["COLOR_0"] = document.add(colors)
    return document, document.mesh(primitive).write(tmp_path / "plate.gltf")


def test_colors_between_vertices_are_linear_in_light(tmp_path):
    _, path = square(tmp_path, colored(SQUARE).astype("<f4"), baseColorFactor=[1, 0.5, 1, 1])
    np.testing.assert_allclose(looked_up(path, POINTS), colored(POINTS) * [1, 0.5, 1], atol=0.01)
    assert not read_mesh(path)[1].changed


def test_colors_of_a_ply(tmp_path):
    plate = trimesh.Trimesh(SQUARE, QUAD.reshape(2, 3), process=False)
    plate.visual.vertex_colors = np.round(255 * srgb_from_linear(colored(SQUARE))).astype(np.uint8)
    plate.export(tmp_path / "plate.ply")
    np.testing.assert_allclose(looked_up(tmp_path / "plate.ply", POINTS), colored(POINTS), atol=0.01)


def test_faces_of_four_corners_become_their_mean(tmp_path):
    """trimesh has one colour for each of them, and two triangles."""
    head = "ply\nformat ascii 1.0\nelement vertex 6\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 2\nproperty list uchar int vertex_indices\n"
    head += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue")) + "end_header\n"
    places = "".join(f"{x} {y} 0\n" for y in (0, 1) for x in (0, 1, 2))
    (tmp_path / "a.ply").write_text(head + places + "4 0 1 4 3 255 0 0\n4 1 2 5 4 0 0 255\n")
    craft, report = read_mesh(tmp_path / "a.ply")
    assert len(craft.parts[0].mesh.faces) == 4
    assert any("mean colour" in line for line in report.changed)


def test_closed_parts_stay_closed_and_their_mean_is_that_of_their_colors(tmp_path):
    sphere = trimesh.creation.icosphere(subdivisions=1)
    colors = np.random.default_rng(0).uniform(0.1, 0.8, (len(sphere.vertices), 3))
    write_mesh(tmp_path / "a.ply", sphere.vertices, sphere.faces, srgb_from_linear(colors))
    part = read_mesh(tmp_path / "a.ply")[0].parts[0]
    assert not part.mesh.is_watertight
    assert is_closed_mesh(part.mesh)
    np.testing.assert_allclose(part.material.albedo, colors[sphere.faces].mean(axis=(0, 1)), rtol=0.05)


def test_colors_of_faces_end_at_edges(tmp_path):
    plate = trimesh.Trimesh(SQUARE, QUAD.reshape(2, 3), process=False)
    plate.visual.face_colors = [[255, 0, 0, 255], [0, 0, 255, 255]]
    plate.export(tmp_path / "plate.ply")
    seen = looked_up(tmp_path / "plate.ply", [[0.6, 0.55], [0.55, 0.6], [0.9, 0.1], [0.1, 0.9]])
    np.testing.assert_allclose(seen, [[1, 0, 0], [0, 0, 1]] * 2, atol=1e-6)


def test_a_mesh_of_a_run_comes_back_with_its_materials(tmp_path):
    sphere = trimesh.creation.icosphere(subdivisions=2)
    x, y, z = (0.5 + 0.45 * np.array(sphere.vertices)).T
    surface = VertexSurface(roughness=(0.3 + 0.5 * y) ** 2, metallic=z)
    albedo = 0.8 * np.stack([x, y, z], axis=1)
    write_mesh(tmp_path / "a.glb", sphere.vertices, sphere.faces, srgb_from_linear(albedo), surface=surface)
    part = read_mesh(tmp_path / "a.glb")[0].parts[0]
    images, uv = part.material.images, np.asarray(part.mesh.visual.uv)
    places = np.array(part.mesh.vertices)
    assert len(places) == 3 * len(sphere.faces)
    for name, true in (("roughness", 0.3 + 0.5 * (0.5 + 0.45 * places[:, 1])), ("metallic", 0.5 + 0.45 * places[:, 2])):
        found = vertex_colors._read(images[name], uv, "clamp") / 255
        np.testing.assert_allclose(found, true, atol=0.005, err_msg=name)
    for i in range(3):
        found = vertex_colors._read(images["base_color"][..., i], uv, "clamp") / 255
        np.testing.assert_allclose(found, srgb_from_linear(0.8 * (0.5 + 0.45 * places[:, i])), atol=0.005)


def test_one_color_needs_no_picture(tmp_path):
    _, path = square(tmp_path, np.full((4, 3), 0.25, "<f4"))
    craft, report = read_mesh(path)
    assert not craft.parts[0].material.images
    np.testing.assert_allclose(craft.parts[0].material.albedo, 0.25, atol=1e-6)
    assert not report.changed


def test_beside_another_picture_colors_become_their_mean(tmp_path):
    document, path = square(tmp_path, colored(SQUARE).astype("<f4"), baseColorTexture={"index": 0})
    document.json |= {"textures": [{"source": 0}], "images": [{"uri": png(CORNERS)}]}
    document.write(path)
    assert any("mean colour" in line for line in read_mesh(path)[1].changed)


def test_vertices_that_are_not_there_have_no_color(tmp_path):
    document, path = square(tmp_path, colored(SQUARE).astype("<f4"))
    faces = document.add(np.array([0, 1, 2, 0, 2, 9], "<u2"))
    document.json["meshes"][0]["primitives"][0]["indices"] = faces
    craft, report = read_mesh(document.write(path))
    assert len(craft.parts[0].mesh.faces) == 1
    assert any("mean colour" in line for line in report.changed)


@pytest.mark.parametrize(("name", "value"), [("MAX_FACES", 1), ("MAX_TEXTURE_PIXELS", 17), ("MAX_TEXTURE_PIXELS", -1)])
def test_many_faces_become_their_mean(tmp_path, monkeypatch, name, value):
    monkeypatch.setattr(vertex_colors, name, value)
    _, path = square(tmp_path, colored(SQUARE).astype("<f4"))
    assert any("mean colour" in line for line in read_mesh(path)[1].changed)
