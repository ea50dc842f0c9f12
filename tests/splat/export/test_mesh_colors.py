"""Colours of vertices, against surfaces whose colours are known at every point; files of them, by trimesh."""

import base64
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.ndimage import map_coordinates
from splat_readers import glb_array, glb_chunks
from splats import light_of, srgb_of
from test_tsdf import cameras, rays

from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at
from spacesim.data.images.png import read_png
from spacesim.data.mesh import VertexSurface, write_mesh
from spacesim.data.records import Camera
from spacesim.learning.prediction import MaterialView, Prediction
from spacesim.splat.export.colors import color_of_material, color_vertices
from spacesim.splat.export.mesh import RunMesh

AWAY = np.array([-3.0, 0, 0])  #: centre of the second sphere


def seen(camera: Camera, centres: list) -> tuple[np.ndarray, np.ndarray]:
    """(depth [H, W], place [H, W, 3]) of the nearest of some unit spheres; depth is 0 where there is none."""
    d, o = rays(camera), camera.position
    nearest = np.full(d.shape[:2], np.inf)
    for centre in centres:
        away = o - np.asarray(centre)
        a, b, c = (d * d).sum(-1), d @ away, away @ away - 1
        root = b * b - a * c
        nearest = np.where(root > 0, np.minimum(nearest, (-b - np.sqrt(np.maximum(root, 0))) / a), nearest)
    depth = np.where(np.isfinite(nearest), nearest, 0)
    return depth.astype(np.float32), o + depth[..., None] * d


def paint(places: np.ndarray) -> np.ndarray:
    """Red about the origin, blue about AWAY, brighter upwards."""
    first = places[..., :1] > -1.5
    return np.where(first, [0.9, 0.1, 0.1], [0.1, 0.1, 0.9]) * (0.6 + 0.4 * places[..., 2:])


def shown(camera: Camera, centres: list) -> Prediction:
    depth, places = seen(camera, centres)
    alpha = 0.8 * (depth > 0)
    return Prediction(alpha[..., None] * paint(places), alpha, depth, None)


def spheres(*centres) -> RunMesh:
    parts = [trimesh.creation.icosphere(4).apply_translation(centre) for centre in centres]
    both = trimesh.util.concatenate(parts)
    return RunMesh(np.array(both.vertices), np.array(both.faces), 0.03, 0)


def test_vertices_have_the_colors_of_what_is_there():
    centres = [np.zeros(3)]
    mesh, reported = spheres(*centres), []
    colors = color_vertices(
        mesh,
        cameras(30, 4.0, 128),
        lambda c: seen(c, centres)[0],
        lambda c: shown(c, centres),
        20,
        lambda *step: reported.append(step),
    )
    assert np.abs(colors - paint(mesh.vertices)).max() < 0.02
    assert reported == [(k, 20) for k in range(21)]


def test_what_stands_before_a_vertex_does_not_color_it():
    centres = [np.zeros(3), AWAY]
    mesh = spheres(*centres)
    views = [
        Camera.from_fov(look_at(np.array(eye, float), at), 128, 128, 50.0)
        for eye, at in (((6, 0, 0), [0, 0, 0]), ((-3, 6, 0), AWAY))
    ]
    colors = color_vertices(mesh, views, lambda c: seen(c, centres)[0], lambda c: shown(c, centres), 9)
    facing = mesh.vertices - AWAY
    hidden = (np.linalg.norm(facing, axis=1) < 1.01) & (facing[:, 0] > 0.9)  # the first camera would see them
    assert hidden.sum() > 20
    assert (colors[hidden, 2] > 3 * colors[hidden, 0]).all()


def test_vertices_that_no_view_sees_take_the_nearest_color():
    centres, mesh = [np.zeros(3)], spheres(np.zeros(3))
    view = Camera.from_fov(look_at(np.array([4.0, 0, 0]), np.zeros(3)), 96, 96, 40.0)
    colors = color_vertices(mesh, [view], lambda c: seen(c, centres)[0], lambda c: shown(c, centres), 9)
    behind, before = mesh.vertices[:, 0] < 0, mesh.vertices[:, 0] > 0.5
    assert np.abs(colors[before] - paint(mesh.vertices[before])).max() < 0.05
    assert colors[behind, 0].min() > 0.15
    nothing = lambda c: Prediction(np.zeros((96, 96, 3)), np.zeros((96, 96)), np.zeros((96, 96)), None)  # noqa: E731
    assert (color_vertices(mesh, [view], lambda c: seen(c, centres)[0], nothing, 9) == 0).all()


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb"])
def test_colors_in_files(tmp_path, suffix):
    mesh = trimesh.creation.icosphere(2)
    colors = paint(np.array(mesh.vertices))
    write_mesh(tmp_path / f"a{suffix}", np.array(mesh.vertices), np.array(mesh.faces), colors)
    found = trimesh.load(tmp_path / f"a{suffix}", process=False)
    if suffix == ".glb":  # linear, to the standard; y is up
        (found,) = found.geometry.values()
        np.testing.assert_allclose(found.visual.vertex_attributes["color"][:, :3], light_of(colors), atol=1e-6)
        np.testing.assert_allclose(found.vertices[:, 1], mesh.vertices[:, 2], atol=1e-6)
    else:
        np.testing.assert_allclose(found.visual.vertex_colors[:, :3] / 255, colors, atol=0.51 / 255)
    assert (found.faces == mesh.faces).all()


def test_materials_in_gltf_are_lit(tmp_path):
    """Base colours a vertex; roughness, a root of alpha, and metallic by their place in a texture."""
    mesh = trimesh.creation.icosphere(2)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    colors, alpha = paint(vertices), np.linspace(0, 1, len(vertices))
    metallic = np.random.default_rng(0).uniform(size=len(vertices)).round(1)
    write_mesh(tmp_path / "a.glb", vertices, faces, colors, surface=VertexSurface(alpha, metallic))
    document, body = glb_chunks(tmp_path / "a.glb")
    assert "extensionsUsed" not in document
    assert document["materials"] == [
        {"doubleSided": True, "pbrMetallicRoughness": {"metallicRoughnessTexture": {"index": 0}}}
    ]
    (primitive,) = document["meshes"][0]["primitives"]
    attributes = {name: glb_array(document, body, index) for name, index in primitive["attributes"].items()}
    np.testing.assert_allclose(attributes["COLOR_0"][:, :3], light_of(colors), atol=1e-6)
    assert np.array_equal(glb_array(document, body, primitive["indices"]).reshape(-1, 3), faces)
    head, _, content = document["images"][0]["uri"].partition(",")
    assert head == "data:image/png;base64"
    texture = read_png(Path("texture"), base64.b64decode(content)) / 255
    places = attributes["TEXCOORD_0"].T[::-1] * 256 - 0.5  # rows from above, along v
    roughness, metal = (map_coordinates(texture[..., k], places, order=1, mode="nearest") for k in (1, 2))
    np.testing.assert_allclose(roughness, np.sqrt(alpha), atol=1e-4)
    np.testing.assert_allclose(metal, metallic, atol=1e-4)


def test_what_is_lit_in_gltf_has_normals(tmp_path):
    """Outwards, in the file's axes, and of unit length where a vertex has no face; what holds its light needs none."""
    mesh = trimesh.creation.icosphere(3)
    vertices, faces = np.concatenate([mesh.vertices, [[5.0, 0, 0]]]), np.array(mesh.faces)
    grey = np.full((len(vertices), 3), 0.5)
    surface = VertexSurface(np.full(len(vertices), 0.5), np.zeros(len(vertices)))
    for name, given in (("lit", (grey, None, surface)), ("plain", ()), ("unlit", (grey,))):
        write_mesh(tmp_path / "a.glb", vertices, faces, *given)
        document, body = glb_chunks(tmp_path / "a.glb")
        (primitive,) = document["meshes"][0]["primitives"]
        arrays = {key: glb_array(document, body, index) for key, index in primitive["attributes"].items()}
        assert ("NORMAL" in arrays) == (name != "unlit")
        if name != "unlit":
            np.testing.assert_allclose(np.linalg.norm(arrays["NORMAL"], axis=1), 1, atol=1e-6)
            assert (np.einsum("vi,vi->v", arrays["NORMAL"], arrays["POSITION"])[:-1] > np.cos(np.radians(1))).all()


def test_trimesh_finds_a_vertex_in_the_texture_of_materials(tmp_path):
    mesh = trimesh.creation.icosphere(2)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    surface = VertexSurface(np.full(len(vertices), 0.25), np.ones(len(vertices)))
    write_mesh(tmp_path / "a.glb", vertices, faces, np.full((len(vertices), 3), 0.5), surface=surface)
    shapes = trimesh.load(tmp_path / "a.glb", process=False).geometry
    (found,) = shapes.values()
    picture = np.array(found.visual.material.metallicRoughnessTexture)
    assert picture.shape == (256, 256, 3)
    column, row = np.rint(found.visual.uv[0] * [256, 256] - 0.5).astype(int)
    assert picture[255 - row, column].tolist() == [0, 128, 255]  # trimesh turns v about


def test_a_picture_of_materials_has_five_channels():
    planes = np.full((2, 3), 0.3), np.full((2, 3), 0.9)
    view = MaterialView(
        np.full((2, 3, 3), 0.5), *planes, np.zeros((2, 3, 3)), np.full((2, 3), 0.5), np.zeros((2, 3, 3))
    )
    shown = color_of_material(view)
    np.testing.assert_allclose(shown.rgb / 0.5, np.tile([*srgb_of(np.full(3, 0.5)), 0.3, 0.9], (2, 3, 1)), atol=1e-6)
    centres, mesh = [np.zeros(3)], spheres(np.zeros(3))
    camera = Camera.from_fov(look_at(np.array([4.0, 0, 0]), np.zeros(3)), 96, 96, 40.0)
    one = lambda c: Prediction(np.tile([0.1, 0.2, 0.3, 0.4], (96, 96, 1)), np.ones((96, 96)), np.ones(1), None)  # noqa: E731
    values = color_vertices(mesh, [camera], lambda c: seen(c, centres)[0], one, 9, channels=4)
    np.testing.assert_allclose(values, np.tile([0.1, 0.2, 0.3, 0.4], (len(mesh.vertices), 1)), atol=1e-6)


def test_stl_holds_no_colors(tmp_path):
    with pytest.raises(InputError, match=r"expected a \.glb, \.obj or \.ply, which hold colours, found STL"):
        write_mesh(tmp_path / "a.stl", np.eye(3), np.array([[0, 1, 2]]), np.ones((3, 3)))


def test_meshes_stand_as_the_file_wants(tmp_path):
    points = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    for name, up, wanted in (
        ("a.glb", None, [0, 1, 0]),
        ("b.glb", "z", [0, 0, 1]),
        ("c.ply", "-y", [0, -1, 0]),
        ("d.obj", None, [0, 0, 1]),
    ):
        write_mesh(tmp_path / name, points, np.array([[0, 1, 2]]), up=up)
        found = trimesh.load(tmp_path / name, process=False, force="mesh")
        np.testing.assert_allclose(found.vertices[0], wanted, atol=1e-7)
        assert np.linalg.det(found.vertices) == pytest.approx(np.linalg.det(points))
