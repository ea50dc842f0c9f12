"""The limits of a scene, its materials by name, and its renderer's life."""

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera, Sun
from spacesim.scenes.build import build
from spacesim.scenes.config import MaterialConfig, ObjectConfig, SceneConfig
from spacesim.scenes.materials.table import lambertian
from spacesim.scenes.render import Renderer
from spacesim.scenes.scene import Scene, SceneObject, load
from spacesim.scenes.spacecraft import Part, Spacecraft, boxsat


def test_more_than_the_labels_can_tell_apart_is_refused():
    craft = boxsat()
    with pytest.raises(InputError, match="84 objects and 255 parts"):
        Scene("crowd", tuple(SceneObject(craft) for _ in range(255 // len(craft.parts) + 1)))


def named_materials(scene: Scene) -> list[tuple[str, list[float]]]:
    """(name, albedo) of each part, as scene.json says them."""
    described = scene.describe()
    names = [part["material"] for part in described["parts"]]
    return [(name, described["materials"][name]["albedo"]) for name in names]


def test_mesh_files_of_one_name_keep_their_materials_apart(tmp_path):
    """Two files hull.obj, each with a material "paint": named apart in scene.json, and each seen in its own colour."""
    colors = {"a": [0.7, 0.2, 0.1], "b": [0.1, 0.2, 0.7]}
    for folder, color in colors.items():
        (tmp_path / folder).mkdir()
        box = trimesh.creation.box((1, 1, 1))
        lines = [f"v {x} {y} {z}" for x, y, z in box.vertices] + [f"f {i + 1} {j + 1} {k + 1}" for i, j, k in box.faces]
        (tmp_path / folder / "hull.obj").write_text("\n".join(["mtllib hull.mtl", "o Hull", "usemtl paint", *lines]))
        (tmp_path / folder / "hull.mtl").write_text(f"newmtl paint\nKd {' '.join(map(str, color))}\n")
    places = {"a": (0.0, -1.0, 0.0), "b": (0.0, 1.0, 0.0)}
    objects = [ObjectConfig(mesh=f"{key}/hull.obj", position=place) for key, place in places.items()]
    objects.append(ObjectConfig(mesh="a/hull.obj", position=(0.0, 5.0, 0.0)))
    scene = build(SceneConfig("pair", tuple(objects), folder=tmp_path))
    (first, red), (second, blue), again = named_materials(scene)
    assert first != second
    assert again == (first, red)
    np.testing.assert_allclose([red, blue], list(colors.values()), atol=1e-6)

    camera = Camera.from_fov(look_at(np.array([10.0, 0, 0]), np.zeros(3)), 32, 32, 25.0)
    truth = Renderer(scene, spp=4).render(camera, Sun(np.array([1.0, 0, 0])), (0,))
    for number, color in enumerate(colors.values(), start=1):
        at = truth.object_id == number
        assert at.sum() > 20
        np.testing.assert_allclose(truth.albedo[at], np.broadcast_to(color, (at.sum(), 3)), atol=1e-6)
        seen = np.median(truth.radiance[at], axis=0)
        np.testing.assert_allclose(seen / seen.sum(), color, rtol=1e-3)


def test_a_material_of_the_scene_may_have_a_presets_name():
    """Its parts have it; parts that nobody named keep the preset."""
    white = {"white-paint": MaterialConfig("white-paint", albedo=(0.3, 0.3, 0.3))}
    objects = (ObjectConfig("boxsat", materials={"radiator": "white-paint"}),)
    scene = build(SceneConfig("dull", objects, materials=white))
    albedo = {p.part.name: p.part.material.albedo for p in scene.parts}
    assert albedo["radiator"] == (0.3, 0.3, 0.3)
    assert albedo["camera_barrel"][0] > 0.7
    described = scene.describe()
    names = {part["name"]: part["material"] for part in described["parts"]}
    for part in ("radiator", "camera_barrel"):
        assert described["materials"][names[part]]["albedo"] == list(albedo[part])


def test_numbers_do_not_meet_names_that_are_there():
    paints = [lambertian("p", (0.1,) * 3, "x"), lambertian("p_2", (0.2,) * 3, "x"), lambertian("p", (0.3,) * 3, "x")]
    paints += [replace(paints[0]), replace(paints[2])]
    parts = tuple(Part(f"part{i}", trimesh.creation.box(), paint) for i, paint in enumerate(paints))
    found = named_materials(Scene("paints", (SceneObject(Spacecraft("craft", parts)),)))
    assert [name for name, _ in found] == ["p", "p_2", "p_3", "p", "p_3"]
    assert [albedo[0] for _, albedo in found] == [0.1, 0.2, 0.3, 0.1, 0.3]


def test_parts_that_look_alike_are_one_mesh_and_keep_their_numbers():
    """Closed and open, flat and smooth, of two materials, in a row across the picture."""
    red, blue = lambertian("red", (0.7, 0.1, 0.1), "x"), lambertian("blue", (0.1, 0.1, 0.7), "x")
    parts = []
    for i in range(12):
        mesh = trimesh.creation.box((0.6, 0.6, 0.6)).apply_translation([0, i - 5.5, 0])
        is_open, is_smooth, paint = i % 3 == 1, i % 4 == 2, (red, blue)[i % 2]
        if is_open:
            mesh.update_faces(np.arange(12) != np.argmin(mesh.face_normals[:, 0]))  # far from the camera
        normals = mesh.face_normals[np.repeat(np.arange(len(mesh.faces)), 3)] if is_smooth else None
        parts.append(Part(f"part{i}", mesh, paint, normals=normals))
    halves = {"left": tuple(parts[:6]), "right": tuple(parts[6:])}
    scene = Scene("row", tuple(SceneObject(Spacecraft(name, half)) for name, half in halves.items()))
    loaded = load(scene)
    shapes = loaded.labelled.shapes()
    assert len(shapes) < len(parts)
    faces = np.concatenate([loaded.parts_of[shape.id()] for shape in shapes])
    assert [np.sum(faces == i + 1) for i in range(12)] == [len(part.mesh.faces) for part in parts]
    for shape in shapes:
        of_faces = loaded.parts_of[shape.id()]
        assert len(of_faces) == shape.face_count()
        assert len({(number % 2, number % 3 == 2) for number in of_faces.tolist()}) == 1  # a paint; open or not
        assert {number % 4 == 3 for number in of_faces.tolist()} == {shape.has_vertex_normals()}

    camera = Camera.from_fov(look_at(np.array([20.0, 0, 0]), np.zeros(3)), 240, 16, 40.0)
    truth = Renderer(scene, spp=1).render(camera, Sun(np.array([1.0, 0, 0])), (0,))
    fronts = np.array([[0.3, i - 5.5, 0.0, 1.0] for i in range(12)]) @ camera.camera_from_world.T
    column = np.floor(camera.fx * fronts[:, 0] / fronts[:, 2] + camera.cx).astype(int)
    row = np.floor(camera.fy * fronts[:, 1] / fronts[:, 2] + camera.cy).astype(int)
    assert truth.part_id[row, column].tolist() == list(range(1, 13))
    assert truth.object_id[row, column].tolist() == [1] * 6 + [2] * 6
    np.testing.assert_allclose(truth.albedo[row, column], [part.material.albedo for part in parts], atol=1e-6)


def test_a_renderer_is_let_go_of_at_once():
    """A scene that moves is loaded for each frame: kernels grow with all the scenes that are still there."""
    renderer = Renderer(build(SceneConfig("box", (ObjectConfig("boxsat"),))), spp=1)
    camera = Camera.from_fov(look_at(np.array([10.0, 0, 0]), np.zeros(3)), 8, 8, 25.0)
    renderer.render(camera, Sun(np.array([1.0, 0, 0])), (0,))
    there = weakref.ref(renderer._loaded)
    gc.disable()
    try:
        del renderer
        assert there() is None
    finally:
        gc.enable()
