"""Where a scene is not traced, there is nothing to see."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
import trimesh
import truth

from spacesim import backend
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera, Sun
from spacesim.scenes.cameras.kernel_camera import KernelCamera, Units
from spacesim.scenes.coverage import Coverage, Tiles
from spacesim.scenes.generation.generate import _DatasetPlan
from spacesim.scenes.lights.earth import EarthConfig
from spacesim.scenes.scene import load
from spacesim.scenes.scenefile import read_scene

SIZE = 96
ACROSS = 16  #: rays along a pixel's side


def hits_and_coverage(
    mesh: trimesh.Trimesh, camera: Camera, distortion: tuple[float, ...] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """[H, W] bool each: pixels through which one of many rays meets the mesh, and pixels through which all are traced.
    Those that meet it are."""
    mi = backend.mitsuba()
    scene = truth.scene_of(mesh)
    units = Units.of(scene.bounding_sphere)
    view = KernelCamera.of(camera, units)
    loaded = load(scene).labelled
    index = dr.arange(mi.UInt32, ACROSS**2 * camera.width * camera.height)
    pixel, sample = index // ACROSS**2, index % ACROSS**2
    offset = mi.Point2f(mi.Float(sample % ACROSS), mi.Float(sample // ACROSS)) / (ACROSS - 1)
    x, y = view.directions(pixel, offset, distortion)
    hit = loaded.ray_test(view.rays_to(x, y)[0]).numpy()
    covered = Coverage(scene, units, distortion).tiles(camera, view).may_show(view, x, y).numpy()
    assert not (hit & ~covered).any()
    shape = camera.height, camera.width, ACROSS**2
    return hit.reshape(shape).any(axis=2), covered.reshape(shape).all(axis=2)


def soup(seed: int, count: int, size: float) -> trimesh.Trimesh:
    """Triangles of any shape within a ball of radius 1, slivers among them."""
    random = np.random.default_rng(seed)
    centres = random.normal(size=(count, 1, 3))
    centres /= np.maximum(np.linalg.norm(centres, axis=-1, keepdims=True), 1)
    corners = centres + size * random.normal(size=(count, 3, 3)) * random.choice([1, 0.01, 1e-4], (count, 1, 1))
    corners[::5, 2] = corners[::5, 1] + 1e-5 * random.normal(size=corners[::5, 2].shape)
    return trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), process=False)


@pytest.mark.parametrize("distance", [0.0, 0.7, 1.5, 4.0, 400.0, 1e6])
@pytest.mark.parametrize(("count", "size"), [(3, 2.0), (40, 0.3), (400, 0.03)])
def test_all_that_rays_meet_is_covered(distance, count, size):
    """From within the triangles, from beside them and from so far away that they fill a picture of a narrow view."""
    for seed in range(12):
        mesh = soup(seed, count, size)
        pose = look_at(np.array([0.9, -0.3, 0.3]) * distance, [0.1, 0.2, 0.0 if distance else 1.0])
        camera = Camera.from_fov(pose, SIZE, SIZE - 22, 2 * np.degrees(np.arctan(1.2 / max(distance, 1.2))))
        hits_and_coverage(mesh, camera)


def test_a_cameras_axes_need_not_stand_upright_on_each_other():
    """As long as `Camera` takes them: a pose rounded to three decimals."""
    focal, limb = 30_000.0, (1.3**2 - 1) ** -0.5
    for skew in (4.5e-4, -4.5e-4):
        pose = look_at(np.array([0.0, -1.3, 0.0]), [0.0, 0.0, 0.0])
        pose[:3, 2] += skew * pose[:3, 0]
        camera = Camera(pose, 128, 64, focal, focal, 64 - focal * (limb - skew), 32.0)
        hit, _ = hits_and_coverage(trimesh.creation.icosphere(6), camera)
        assert 0.2 < hit.mean() < 0.8


def test_close_above_a_plain_the_sky_is_not_traced():
    """Most triangles are beside or behind the camera, or reach to both sides of its plane."""
    side = np.linspace(-1, 1, 151)
    points = np.stack([*np.meshgrid(side, side), np.zeros((151, 151))], axis=-1).reshape(-1, 3)
    corner = (np.arange(150)[:, None] * 151 + np.arange(150)).ravel()
    faces = np.concatenate([corner[:, None] + [0, 1, 151], corner[:, None] + [1, 152, 151]])
    plain = trimesh.Trimesh(points, faces, process=False)
    for fov_deg in (60.0, 5.0, 1.0):
        camera = Camera.from_fov(look_at(np.array([0.1, 0.0, 0.03]), [0.1, 1.0, 0.03]), SIZE, SIZE, fov_deg)
        hit, covered = hits_and_coverage(plain, camera)
        assert covered.mean() < hit.mean() + 0.1 < 0.65


def test_a_triangle_that_begins_behind_the_camera_is_covered():
    """Its corner there would be seen in the middle, its surface is seen at the right."""
    mesh = trimesh.Trimesh([[0, -1, 0], [0.8, 5, 0.3], [0.8, 5, -0.3]], [[0, 1, 2]], process=False)
    camera = Camera.from_fov(look_at(np.array([0.0, 0.0, 0.0]), [0.0, 1.0, 0.0]), SIZE, SIZE, 90.0)
    hit, _ = hits_and_coverage(mesh, camera)
    assert hit[:, -1].any()


def test_little_more_is_covered():
    """Than the pixels next to the tiles that a sphere, and a thin plate across the picture, are seen in."""
    turn = trimesh.transformations.rotation_matrix(0.6, [0, 1, 0])
    thin = trimesh.creation.box((3.0, 0.01, 0.01), transform=turn)
    for mesh in (trimesh.creation.icosphere(3), thin):
        camera = Camera.from_fov(look_at(np.array([0.0, -8.0, 0.0]), [0.0, 0.0, 0.0]), SIZE, SIZE, 30.0)
        hit, covered = hits_and_coverage(mesh, camera)
        assert 0.005 < hit.mean() < 0.5
        reached = np.zeros_like(hit)
        for row, column in np.argwhere(hit):
            reached[max(0, row - 6) : row + 7, max(0, column - 6) : column + 7] = True
        assert not (covered & ~reached).any()
    camera = Camera.from_fov(look_at(np.array([0.0, -8.0, 0.0]), [0.0, -16.0, 0.0]), SIZE, SIZE, 30.0)
    hit, covered = hits_and_coverage(trimesh.creation.icosphere(3), camera)
    assert not covered.any(), "it is behind"


LENSES = {  # of SPEED+'s camera (T. H. Park et al. 2022), a barrel, a cushion, and one that is not centred
    "speed+": (-0.22383, 0.51409, -0.00066, -0.00021, -0.13124),
    "barrel": (-0.3, 0.05, 0.0, 0.0, 0.0),
    "cushion": (0.4, 0.1, 0.0, 0.0, 0.0),
    "tangential": (-0.1, 0.0, 0.02, -0.03, 0.0),
}


@pytest.mark.parametrize("lens", LENSES)
def test_what_a_lens_that_distorts_shows_is_covered(lens):
    """Triangles in all parts of a picture, and beyond its border."""
    for seed in range(6):
        for distance in (0.7, 1.5, 4.0):
            pose = look_at(np.array([0.9, -0.3, 0.3]) * distance, [0.1, 0.2, 0.0])
            camera = Camera.from_fov(pose, SIZE, SIZE - 22, 60.0)
            hits_and_coverage(soup(seed, 400, 0.03), replace(camera, cx=camera.cx + 9 * (seed % 2)), LENSES[lens])
    camera = Camera.from_fov(look_at(np.array([0.0, -8.0, 0.0]), [0.0, 0.0, 0.0]), SIZE, SIZE, 50.0)
    hit, covered = hits_and_coverage(trimesh.creation.icosphere(3), camera, LENSES[lens])
    assert 0 < hit.mean() < covered.mean() < 0.25


@pytest.mark.parametrize(("scene", "lens"), [("boxsat", None), ("cubesat", None), ("boxsat", "barrel")])
def test_pictures_are_those_of_all_pixels_to_the_bit(scene, lens, monkeypatch):
    config = read_scene(scene, views=3, test_views=0, resolution=(70, 50), spp=16)
    lit = replace(config, earth=EarthConfig(20.0, 30.0))
    plan = _DatasetPlan(replace(lit, camera=replace(lit.camera, distortion=LENSES[lens] if lens else ())))
    distant = [replace(spec.camera, fx=0.1 * spec.camera.fx, fy=0.1 * spec.camera.fy) for spec in plan.specs]
    close = [replace(spec.camera, fx=6 * spec.camera.fx, fy=6 * spec.camera.fy) for spec in plan.specs]
    cameras = [*(spec.camera for spec in plan.specs), *([] if lens else distant), *close]
    some = [plan.renderer.render(camera, Sun.from_angles(30, 20), (0, 1)) for camera in cameras]
    views = [KernelCamera.of(camera, plan.renderer._loaded.units) for camera in cameras]
    tiles = [plan.renderer._coverage.tiles(camera, view) for camera, view in zip(cameras, views, strict=True)]
    shares = [float(some_tiles.marks.numpy().mean()) for some_tiles in tiles]
    assert 0 < min(shares) < (0.7 if lens else 0.1)
    monkeypatch.setattr(Tiles, "may_show", lambda _tiles, _view, _x, _y: backend.mitsuba().Bool(True))
    monkeypatch.setattr(Tiles, "pixels", lambda _tiles, _view: None)
    for camera, truth_of_some in zip(cameras, some, strict=True):
        whole = plan.renderer.render(camera, Sun.from_angles(30, 20), (0, 1))
        for name in ("radiance", "alpha", "radiance_earth"):
            np.testing.assert_array_equal(getattr(whole, name), getattr(truth_of_some, name))
