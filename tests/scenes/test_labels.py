"""Labels against a second ray caster (`raycast.py`), and that one against trimesh's."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
import raycast
import trimesh
from raycast import RayCaster
from trimesh.ray.ray_triangle import RayMeshIntersector
from truth import scene_of

from spacesim import backend
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera, Sun
from spacesim.data.store import SHADOW_ATTACHED, SHADOW_LIT
from spacesim.scenes.build import build
from spacesim.scenes.generation.generate import plan_views
from spacesim.scenes.lights.sun import SunConfig
from spacesim.scenes.render import Renderer
from spacesim.scenes.scene import Scene
from spacesim.scenes.scenefile import read_scene
from spacesim.scenes.visibility import SolarDirections


@pytest.mark.parametrize(
    ("name", "view", "classes"),
    [
        ("boxsat", 0, {0, 85, 170, 255}),
        ("boxsat", 6, {0, 85, 170, 255}),
        ("boxsat-pair", 1, {0, 85, 170, 171, 255}),
        ("telescope", 6, {0, 85, 170, 255}),
        ("upper-stage", 4, {0, 85, 170, 255}),
        ("cubesat", 2, {0, 85, 170, 255}),
        ("cubesat", 4, {0, 85, 170, 255}),
        ("small-body", 0, {0, 85, 170, 255}),
    ],
)
def test_labels_agree_with_another_ray_caster(name, view, classes):
    """Every pixel has the other's labels, or those that lie within 0.02 pixels of its centre: at most 0.2 % do."""
    found = raycast.labels_agree(name, first=view, views=1)
    assert not found.wrong, found
    assert found.edge + found.offset <= 0.002 * found.surface + 2, found
    assert set(found.classes) == classes
    assert all(found.classes[one] >= 20 for one in classes), "each shadow class is seen"


@pytest.fixture
def odd_glb(tmp_path) -> Path:
    """A mast on an open sheet half of whose faces are turned over, and one mesh twice: turned, mirrored and scaled."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-2, 2, 6), np.linspace(-2, 2, 6)))
    corner = np.arange(30)[np.arange(30) % 6 < 5]
    one, other = corner[:, None] + [0, 1, 7], corner[:, None] + [0, 6, 7]  # wound differently
    sheet = trimesh.Trimesh(np.stack([x, y, 0.1 * np.sin(x)], axis=1), np.concatenate([one, other]), process=False)
    knob = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
    turned = trimesh.transformations.euler_matrix(0.3, 0.7, -0.2)
    turned[:3, 3] = 0.8, -0.9, 0.7
    mirrored = np.diag([-1.5, 1.0, 2.0, 1.0])
    mirrored[:3, 3] = -0.9, 1.0, 0.6
    scene = trimesh.Scene()
    scene.add_geometry(sheet, node_name="sheet", geom_name="sheet")
    scene.add_geometry(trimesh.creation.cylinder(0.2, 1.4), node_name="mast", geom_name="mast")
    for name, place in (("knob", turned), ("other_knob", mirrored)):
        scene.add_geometry(knob, node_name=name, geom_name="knob", transform=place)
    path = tmp_path / "odd.glb"
    path.write_bytes(scene.export(file_type="glb"))
    return path


@pytest.mark.parametrize("up", ["z", "y"])
def test_labels_of_a_mesh_file_agree_with_another_ray_caster(odd_glb, up):
    """What `python tests/scenes/truth.py --labels FILE ...` does."""
    found = raycast.labels_agree(odd_glb, views=3, resolution=96, sun=(45.0, 60.0), up=up)
    assert not found.wrong, found
    assert found.edge + found.offset <= 0.002 * found.surface + 2, found
    assert all(found.classes[one] > 100 for one in (0, 85, 170, 255)), found


def one_view(source: str, resolution: int = 64) -> tuple[Scene, Camera, Sun]:
    config = read_scene(source, sun=((45.0, 35.0),), test_views=1, resolution=resolution)
    scene = replace(build(config), sun=SunConfig("directional"))
    view = plan_views(scene, config)[1][0][1]
    return scene, view.camera, view.sun


@pytest.mark.parametrize("source", ["boxsat", "cubesat"])
def test_the_other_ray_caster_agrees_with_trimesh(source):
    """First hits of camera and shadow rays; trimesh asks an R-tree of boxes, in float64."""
    scene, camera, sun = one_view(source)
    caster, other = RayCaster(scene), RayMeshIntersector(scene.mesh)
    rng = np.random.default_rng(0)
    centres = np.stack(np.meshgrid(np.arange(64) + 0.5, np.arange(64) + 0.5), axis=-1).reshape(-1, 2)
    centres = centres[rng.permutation(len(centres))]
    face, depth, ray = caster.seen(camera, centres)
    chosen = np.concatenate([np.flatnonzero(face >= 0)[:150], np.flatnonzero(face < 0)[:50]])
    face, depth, ray = face[chosen], depth[chosen], ray[chosen]

    def first(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        hits, rays, points = other.intersects_id(origins, directions, multiple_hits=False, return_locations=True)
        met, at = np.full(len(origins), -1), np.zeros((len(origins), 3))
        met[rays], at[rays] = hits, points
        return met, at

    met, at = first(np.tile(camera.position, (len(ray), 1)), ray)
    np.testing.assert_array_equal(met, face)
    hit = face >= 0
    points = (camera.position + depth[:, None] * ray)[hit]
    np.testing.assert_allclose(points, at[hit], atol=1e-9)
    normals = caster.normals[face[hit]]
    above = points[normals @ sun.direction > 0] + 1e-4 * normals[normals @ sun.direction > 0]
    blocked, _ = first(above, np.tile(sun.direction, (len(above), 1)))
    assert {True, False} == set((blocked >= 0).tolist())
    np.testing.assert_array_equal(caster.towards(sun.direction, above), blocked)


@pytest.mark.parametrize(
    ("label", "change"),
    [
        ("depth", lambda x: x * 1.00002),
        ("distance", lambda x: x * 1.00002),
        ("normal", lambda x: x + 0.002),
        ("object_id", lambda x: x + 1),
        ("part_id", lambda x: x + 1),
        ("sun_cosine", lambda x: x - 0.002),
        ("sun_visibility", lambda x: 1 - x),
        ("shadow", lambda x: x - 1),
    ],
)
def test_the_comparison_notices_a_wrong_label(label, change):
    scene, camera, sun = one_view("boxsat", 48)
    truth = Renderer(scene, spp=1).render(camera, sun, seed=(0,))
    values = getattr(truth, label).copy()
    row, column = np.argwhere(truth.shadow == 255)[7]
    values[row, column] = change(values[row, column])
    found = raycast.compare(replace(truth, **{label: values}), RayCaster(scene), camera, sun)
    assert found.wrong == Counter({label: 1})


def test_rays_and_triangles_by_hand():
    """Two stacked triangles and a hole: least depth above the floor, edges belong to triangles."""
    corners = np.array([[[0, 0], [1, 0], [0, 1]], [[0, 0], [0, 2], [2, 0]]], float)  # of either winding
    depths = np.array([[2.0, 3.0, 4.0], [1.0, 1.0, 1.0]])
    points = np.array([[0.25, 0.25], [0.25, 0.25], [0.25, 0.25], [0.9, 0.9], [1.1, 1.1], [0.0, 0.5]])
    floor = np.array([-np.inf, 1.5, 3.0, -np.inf, -np.inf, 1.5])
    face, depth = raycast.first_below(points, corners, depths, floor)
    assert face.tolist() == [1, 0, -1, 1, -1, 0]
    np.testing.assert_allclose(depth, [1.0, 2.75, np.inf, 1.0, np.inf, 3.0])


@pytest.mark.parametrize("azimuth_deg", [0.0, 90.0, 33.0])
def test_neighbouring_rays_to_the_sun_meet_what_each_alone_does(azimuth_deg):
    """Beside a direction that has a component of some 1e-19 Embree's coherent rays would miss much."""
    mi = backend.mitsuba()
    scene = build(read_scene("telescope"))
    renderer, sun = Renderer(scene, spp=1), Sun.from_angles(azimuth_deg, 3.75)
    disc = SolarDirections(scene.sun).few(sun, None)
    start = renderer._loaded.units.points(scene.mesh.triangles_center + 1e-3 * scene.mesh.face_normals)
    start = start[scene.mesh.face_normals @ sun.direction > 0].astype(np.float32)
    normal, asked = mi.Vector3f(np.tile(sun.direction[:, None], len(start))), dr.full(mi.Bool, True, len(start))
    _, hidden, _ = disc.seen(renderer._loaded.labelled, mi.Vector3f(start.T), normal, asked)
    each = np.repeat(start, disc.count, 0), np.tile(np.array(disc.directions).T, (len(start), 1))
    alone = renderer._loaded.labelled.ray_test(mi.Ray3f(mi.Point3f(each[0].T), mi.Vector3f(each[1].T))).numpy()
    assert 0.1 < alone.mean() < 0.9
    assert (hidden.numpy() != alone).mean() < 1e-5  # rays along edges


@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), [(90.0, 0.0), (180.0, 0.0), (90.0, 45.0), (180.0, -45.0)])
def test_a_face_that_the_sun_grazes_is_lit_as_its_cosine_says(azimuth_deg, elevation_deg):
    """Directions of such Suns have components of 1e-16: no part hides a convex one."""
    scene = scene_of(trimesh.creation.box((2, 2, 2)), sun=SunConfig("directional"))
    for corner in ([5, 4, 3], [-5, -4, -3]):
        camera = Camera.from_fov(look_at(np.array(corner, float), [0, 0, 0]), 48, 48, 30.0)
        truth = Renderer(scene, spp=1).render(camera, Sun.from_angles(azimuth_deg, elevation_deg), seed=(1,))
        surface = truth.object_id > 0
        lit = truth.sun_cosine > 0
        np.testing.assert_array_equal(truth.sun_visibility[surface], lit[surface])
        assert set(np.unique(truth.shadow[surface])) <= {SHADOW_ATTACHED, SHADOW_LIT}


def test_labels_are_zero_where_there_is_no_surface():
    config = read_scene("boxsat", views=1, resolution=64)
    scene = build(config)
    camera = plan_views(scene, config)[0][0][1].camera
    truth = Renderer(scene, spp=1).render(camera, Sun.from_angles(45, 35), seed=(0,))
    background = truth.object_id == 0
    assert background.any()
    for name in (
        "depth",
        "distance",
        "normal",
        "albedo",
        "part_id",
        "sun_visibility",
        "sun_cosine",
        "shadow",
    ):
        assert not getattr(truth, name)[background].any(), name
        assert getattr(truth, name)[~background].any(), name


def test_albedo_is_that_of_the_parts_material():
    config = read_scene("boxsat", views=1, resolution=64)
    scene = build(config)
    camera = plan_views(scene, config)[0][0][1].camera
    truth = Renderer(scene, spp=1).render(camera, Sun.from_angles(45, 35), seed=(0,))
    for placed in scene.parts:
        seen, material = truth.part_id == placed.part_id, placed.part.material
        if not material.images:
            np.testing.assert_allclose(truth.albedo[seen], np.tile(material.albedo, (seen.sum(), 1)), rtol=1e-6)
