"""Radiance and alpha against closed-form photometry."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from spacesim import backend
from spacesim.data.geometry import direction_from_angles, look_at
from spacesim.data.records import Camera, Sun
from spacesim.data.store import SHADOW_SELF_CAST
from spacesim.scenes import render
from spacesim.scenes.build import build
from spacesim.scenes.generation.generate import plan_views
from spacesim.scenes.lights.earth import EarthConfig
from spacesim.scenes.lights.sun import EXPOSURE, SOLAR_IRRADIANCE, SunConfig
from spacesim.scenes.materials.table import Material, material
from spacesim.scenes.render import Renderer
from spacesim.scenes.samples import path_sampler
from spacesim.scenes.scene import Scene, SceneObject
from spacesim.scenes.scenefile import read_scene
from spacesim.scenes.spacecraft import Part, Spacecraft, spacecraft

PARALLEL = SunConfig("directional")


def scene_of(mesh: trimesh.Trimesh, surface: Material, sun: SunConfig = PARALLEL) -> Scene:
    return Scene("test", (SceneObject(Spacecraft("test", (Part("part", mesh, surface),))),), sun)


def test_white_surface_that_faces_the_sun_has_display_value_1():
    scene = scene_of(trimesh.creation.box((2, 2, 2)), material("lambertian-white"))
    camera = Camera.from_fov(look_at([5, 0, 0], [0, 0, 0]), 8, 8, 10.0)
    truth = Renderer(scene, spp=4).render(camera, Sun.from_angles(0, 0), seed=(1,))
    np.testing.assert_allclose(truth.radiance * EXPOSURE, 1.0, rtol=1e-5)
    np.testing.assert_array_equal(truth.alpha, 1.0)


def test_faces_of_a_lambertian_box_follow_the_cosine_law():
    sun = Sun.from_angles(30, 50)
    scene = scene_of(trimesh.creation.box((2, 2, 2)), material("lambertian-grey"))
    for normal in np.concatenate([np.eye(3), -np.eye(3)]):
        camera = Camera.from_fov(look_at(6 * normal + [0.1, 0.2, 0.3], [0, 0, 0]), 8, 8, 8.0)
        truth = Renderer(scene, spp=4).render(camera, sun, seed=(1,))
        expected = SOLAR_IRRADIANCE * 0.5 / np.pi * max(0.0, float(normal @ sun.direction))
        np.testing.assert_allclose(truth.radiance, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("phase_deg", [0.0, 60.0, 120.0])
def test_lambertian_sphere_has_its_phase_function_and_size(phase_deg):
    """Flux of a Lambertian sphere (Russell 1916): 2/3 E a r^2 (sin p + (pi - p) cos p) / pi."""
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    distance, size, fov = 1000.0, 32, 0.15
    pose = look_at(distance * direction_from_angles(phase_deg, 0.0), [0, 0, 0])
    camera = Camera.from_fov(pose, size, size, fov)
    truth = Renderer(scene_of(sphere, material("lambertian-grey")), spp=64).render(
        camera, Sun.from_angles(0, 0), seed=(3,)
    )
    pixel = (distance / camera.fx) ** 2  # m^2 at the sphere's centre
    phase = np.radians(phase_deg)
    expected = 2 / 3 * SOLAR_IRRADIANCE * 0.5 * (np.sin(phase) + (np.pi - phase) * np.cos(phase)) / np.pi
    assert truth.radiance[..., 0].sum() * pixel == pytest.approx(expected, rel=0.01)  # facets and noise
    assert truth.alpha.sum() * pixel == pytest.approx(np.pi, rel=0.005)
    j, i = np.mgrid[:size, :size] + 0.5
    centre = [(truth.alpha * i).sum() / truth.alpha.sum(), (truth.alpha * j).sum() / truth.alpha.sum()]
    assert centre == pytest.approx([camera.cx, camera.cy], abs=0.02), "pixel centres are at halves"
    assert truth.alpha.min() == 0.0
    assert truth.alpha.max() == 1.0
    assert not truth.alpha[0].any(), "far from the sphere"


def test_passes_change_the_noise_only(monkeypatch):
    sphere = scene_of(trimesh.creation.icosphere(subdivisions=3), material("white-paint"))
    camera = Camera.from_fov(look_at([6, 0, 0], [0, 0, 0]), 16, 16, 25.0)
    sun = Sun.from_angles(40, 10)
    whole = Renderer(sphere, spp=60).render(camera, sun, seed=(5,))
    monkeypatch.setattr(render, "MAX_WAVEFRONT", 7 * 256)
    parts = Renderer(sphere, spp=60).render(camera, sun, seed=(5,))
    np.testing.assert_array_equal(parts.alpha, whole.alpha)  # sample positions do not depend on the passes
    np.testing.assert_allclose(parts.radiance, whole.radiance, rtol=0.02, atol=2.0)


def test_alpha_is_one_within_and_zero_away_from_the_labels_silhouette():
    config = read_scene("boxsat", views=1, resolution=96)
    scene = build(config)
    camera = plan_views(scene, config)[0][0][1].camera
    truth = Renderer(scene, spp=16).render(camera, Sun.from_angles(45, 35), seed=(0,))
    surface = truth.object_id > 0
    shifts = [np.roll(surface, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    assert np.isfinite(truth.radiance).all()
    assert truth.radiance.min() >= 0
    assert truth.radiance[surface].mean() > 1
    assert not truth.radiance[truth.alpha == 0].any()
    assert truth.alpha[np.all(shifts, axis=0)].min() > 0.7  # a gap can be thinner than a pixel
    assert np.abs(truth.alpha.mean() - surface.mean()) < 0.005
    assert truth.alpha[~np.any(shifts, axis=0)].max() < 0.5  # and so can a boom


def test_paths_have_the_random_numbers_of_mitsubas_independent_sampler():
    mi = backend.mitsuba()
    theirs, count = mi.load_dict({"type": "independent"}).fork(), 1000
    theirs.seed(mi.UInt32(7), count)
    chosen = np.arange(0, count, 3, dtype=np.uint32)
    ours = path_sampler(mi.UInt32(7), mi.UInt32(chosen))
    for _ in range(3):
        for name in ("next_1d", "next_2d"):
            expected, found = (np.array(getattr(sampler, name)()) for sampler in (theirs, ours))
            np.testing.assert_array_equal(found, expected[..., chosen])


def test_more_pixels_than_a_wavefront_holds(monkeypatch):
    monkeypatch.setattr(render, "MAX_WAVEFRONT", 100)
    scene = scene_of(trimesh.creation.box((2, 2, 2)), material("lambertian-white"))
    camera = Camera.from_fov(look_at([5, 0, 0], [0, 0, 0]), 16, 16, 10.0)
    truth = Renderer(scene, spp=3).render(camera, Sun.from_angles(0, 0), seed=(1,))
    np.testing.assert_allclose(truth.radiance * EXPOSURE, 1.0, rtol=1e-5)


def test_sun_can_be_moved_and_moved_back():
    scene = scene_of(trimesh.creation.box((2, 2, 2)), material("lambertian-grey"))
    camera = Camera.from_fov(look_at([5, 4, 3], [0, 0, 0]), 16, 16, 30.0)
    renderer = Renderer(scene, spp=2)
    suns = [Sun.from_angles(0, 0), Sun.from_angles(90, 20), Sun.from_angles(0, 0)]
    first, other, again = (renderer.render(camera, sun, seed=(2,)).radiance for sun in suns)
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 100


def test_no_ray_asks_for_shadow_where_a_closed_surface_faces_away():
    """Which changes no bit; sheets and two-sided materials are lit on either side."""
    scene = replace(build(read_scene("boxsat")), earth=EarthConfig(20.0, 30.0))
    camera, sun = Camera.from_fov(look_at([9, 5, 4], [0, 0, 0]), 48, 48, 40.0), Sun.from_angles(120, 10)
    renderers = Renderer(scene, spp=8), Renderer(scene, spp=8)
    for source in (renderers[0]._loaded.sun, renderers[0]._loaded.earth):
        assert source.outside
        source.outside = False
    every, fewer = (renderer.render(camera, sun, seed=(3,)) for renderer in renderers)
    assert ((every.sun_cosine < 0) & (every.object_id > 0)).sum() > 100
    np.testing.assert_array_equal(every.radiance, fewer.radiance)

    grey, inverted = material("lambertian-grey"), trimesh.creation.box((2, 2, 2))
    inverted.invert()
    twosided = {"type": "twosided", "bsdf": grey.bsdf}
    sheet = trimesh.Trimesh([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], [[0, 2, 1], [0, 3, 2]], process=False)
    looks = [(sheet, grey.bsdf), (inverted, twosided), (inverted, {"type": "mask", "opacity": 0.9, "nested": twosided})]
    for mesh, bsdf in looks:
        above = Camera.from_fov(look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]), 8, 8, 5.0)
        lit = Renderer(scene_of(mesh, replace(grey, bsdf=bsdf)), spp=64)
        seen = lit.render(above, Sun.from_angles(0, 90), seed=(1,))
        assert seen.radiance.min() * EXPOSURE > 0.1, "its normals point down"

    ball = trimesh.creation.icosphere(2)
    smooth = Part("ball", ball, grey, normals=ball.vertex_normals[ball.faces].reshape(-1, 3))
    shaded = Renderer(Scene("smooth", (SceneObject(Spacecraft("smooth", (smooth,))),)), spp=1)
    assert not shaded._loaded.sun.outside, "a shading normal may face the Sun where the surface does not"


def test_inside_and_exposed():
    shell = trimesh.util.concatenate([trimesh.creation.box((2, 2, 2)), trimesh.creation.box((1, 1, 3))])
    renderer = Renderer(scene_of(shell, material("lambertian-grey")), spp=1)
    positions = np.array([[0, 0, 0], [0.9, 0.9, 0.9], [0, 0, 1.4], [0, 0, 1.6], [0.7, 0.7, 1.1], [9, 9, 9]], float)
    np.testing.assert_array_equal(renderer.inside(positions), [True, True, True, False, False, False])
    points = np.array([[0.5, 0, 0.2], [0.5, 0, 1.2], [1, 0, 0]], float)
    normals = np.array([[1, 0, 0], [1, 0, 0], [1, 0, 0]], float)
    np.testing.assert_array_equal(renderer.exposed(points, normals), [False, True, True])


@pytest.mark.parametrize(
    ("position", "size"), [((10_000.0, -3.0, 7.0), 1.0), ((0.0, 0.0, 0.0), 1e-3), ((5.0, 0.0, 0.0), 400.0)]
)
def test_neither_place_nor_size_changes_a_picture(position, size):
    craft = spacecraft("cubesat")
    home = Scene("home", (SceneObject(craft),))
    moved = np.diag([size, size, size, 1.0])
    moved[:3, 3] = position
    away = Scene("away", (SceneObject(craft, moved),))
    camera = Camera.from_fov(look_at([0.6, -0.9, 0.5], [0, 0, 0]), 64, 64, 35.0)
    there = replace(camera, world_from_camera=look_at(size * np.array([0.6, -0.9, 0.5]) + position, position))
    sun = Sun.from_angles(20, 35)
    expected = Renderer(home, spp=4).render(camera, sun, seed=(1,))
    found = Renderer(away, spp=4).render(there, sun, seed=(1,))
    np.testing.assert_array_equal(found.object_id, expected.object_id)
    np.testing.assert_array_equal(found.shadow, expected.shadow)
    assert (expected.shadow == SHADOW_SELF_CAST).sum() > 20
    np.testing.assert_allclose(found.distance, size * expected.distance, rtol=1e-5)
    np.testing.assert_allclose(found.sun_visibility, expected.sun_visibility, atol=0.02)
    assert found.radiance.mean() == pytest.approx(expected.radiance.mean(), rel=1e-3)
