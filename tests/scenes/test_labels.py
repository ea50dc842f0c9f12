"""Labels against trimesh's ray caster (numpy and rtree, float64), which shares no code with Mitsuba."""

from dataclasses import replace

import numpy as np
import pytest
from trimesh.ray.ray_triangle import RayMeshIntersector

from spacesim.data.records import Camera, Sun
from spacesim.scenes import Renderer, Scene, build, read_scene
from spacesim.scenes.generate import plan_views
from spacesim.scenes.sun import SunConfig


class RayCaster:
    """Casts rays at all parts of a scene."""

    def __init__(self, scene: Scene) -> None:
        sizes = [len(placed.mesh.faces) for placed in scene.parts]
        self.normals = scene.mesh.face_normals
        self.part_of_face = np.repeat([placed.part_id for placed in scene.parts], sizes)
        self.object_of_face = np.repeat([placed.object_id for placed in scene.parts], sizes)
        self.intersector = RayMeshIntersector(scene.mesh)

    def first_hits(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(face [N], -1 for none; distance [N], 0 for none) of rays [N, 3]."""
        faces, rays, points = self.intersector.intersects_id(
            origins, directions, multiple_hits=False, return_locations=True
        )
        face, distance = np.full(len(origins), -1), np.zeros(len(origins))
        face[rays] = faces
        distance[rays] = np.linalg.norm(points.reshape(-1, 3) - origins[rays], axis=1)
        return face, distance

    def labels(self, camera: Camera, sun: Sun, at: np.ndarray) -> dict[str, np.ndarray]:
        """Labels at the image positions `at` [N, 2] (x, y)."""
        x, y = (at[:, 0] - camera.cx) / camera.fx, (at[:, 1] - camera.cy) / camera.fy
        directions = np.stack([x, y, np.ones_like(x)], axis=1)
        along_axis = 1 / np.linalg.norm(directions, axis=1)
        directions = (directions * along_axis[:, None]) @ camera.world_from_camera[:3, :3].T
        face, distance = self.first_hits(np.tile(camera.position, (len(at), 1)), directions)
        hit = face >= 0
        normals = self.normals[face] * hit[:, None]
        cosine = normals @ sun.direction
        shadow = np.where(hit, np.where(cosine > 0, 255, 85), 0)
        lit = np.flatnonzero(cosine > 0)
        points = camera.position + distance[lit, None] * directions[lit] + 2e-4 * normals[lit]
        blocker, _ = self.first_hits(points, np.tile(sun.direction, (len(lit), 1)))
        by, own = self.object_of_face[blocker], self.object_of_face[face[lit]]
        shadow[lit] = np.where(blocker >= 0, np.where(by == own, 170, 170 + by), 255)
        return {
            "depth": distance * along_axis,
            "distance": distance,
            "normal": normals,
            "object_id": np.where(hit, self.object_of_face[face], 0),
            "part_id": np.where(hit, self.part_of_face[face], 0),
            "sun_cosine": cosine,
            "sun_visibility": (shadow == 255).astype(float),
            "shadow": shadow,
        }


def _differs(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> np.ndarray:
    """[N] bool: labels that are not the same, up to 1 mm and 0.001 of a normal or cosine."""
    return np.any(
        [np.abs(found[k].astype(float) - expected[k]).reshape(len(found[k]), -1).max(1) > 1e-3 for k in expected],
        axis=0,
    )


@pytest.mark.parametrize(
    ("name", "view", "classes"),
    [
        ("boxsat", 0, {0, 85, 170, 255}),
        ("boxsat", 3, {0, 85, 170, 255}),
        ("boxsat-pair", 1, {0, 85, 170, 171, 255}),
        ("telescope", 0, {0, 85, 170, 255}),
        ("upper-stage", 1, {0, 85, 170, 255}),
    ],
)
def test_labels_agree_with_another_ray_caster(name, view, classes):
    """At most 0.5 % of the pixels differ, all on edges: within 0.02 pixels the other answer is found."""
    config = read_scene(name, sun=((45.0, 35.0),), test_views=4, resolution=128)
    scene = replace(build(config), sun=SunConfig("directional"))
    _, test = plan_views(scene, config)
    camera, sun = test[view][1].camera, test[view][1].sun
    truth = Renderer(scene, spp=1).render(camera, sun, seed=(0,))
    rng = np.random.default_rng(view)
    surface = np.flatnonzero(truth.object_id)
    pixels = np.concatenate([rng.choice(surface, 200), rng.integers(0, 128 * 128, 60)])
    if name == "boxsat-pair":
        pixels = np.concatenate([pixels, rng.choice(np.flatnonzero(truth.shadow == 171), 20)])
    centres = np.stack([pixels % 128, pixels // 128], axis=1) + 0.5

    caster = RayCaster(scene)
    expected = caster.labels(camera, sun, centres)
    found = {key: getattr(truth, key).reshape(128 * 128, -1)[pixels].squeeze().astype(float) for key in expected}
    different = np.flatnonzero(_differs(found, expected))

    assert set(np.unique(truth.shadow)) == classes
    assert len(different) <= 0.005 * len(pixels)
    for k in different:
        near = centres[k] + rng.uniform(-0.02, 0.02, (64, 2))
        answer = {key: np.repeat(values[k : k + 1], 64, axis=0) for key, values in found.items()}
        same = ~_differs(answer, caster.labels(camera, sun, near))
        assert same.any(), f"pixel {pixels[k]} is wrong and on no edge"


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
