"""The Brown-Conrady lens, end to end: rendered, written, read back as the pinhole camera sees it."""

from dataclasses import replace

import numpy as np
import pytest

from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at
from spacesim.data.images import Undistortion, distort_points, load_image, undistort_points
from spacesim.data.records import Camera, Sun
from spacesim.data.store import load_truth, read_dataset
from spacesim.scenes.build import build
from spacesim.scenes.cameras.camera import CameraConfig
from spacesim.scenes.cameras.sphere_rigs import FibonacciRig
from spacesim.scenes.config import ObjectConfig, QualityConfig
from spacesim.scenes.generation.generate import generate
from spacesim.scenes.render import Renderer
from spacesim.scenes.scenefile import read_scene

BARREL = (-0.35, 0.12, 0.004, -0.003, 0.0)
LENSES = [BARREL, (0.25, 0.0, 0.0, 0.0, 0.0), (-0.3, 0.1, -0.004, 0.002, -0.02)]


def project(camera, points, lens):
    """[N, 2] pixels (x, y) of world points [N, 3]: the model written out."""
    k1, k2, p1, p2, k3 = lens
    pixels = []
    for point in points:
        X, Y, Z = camera.camera_from_world[:3, :3] @ point + camera.camera_from_world[:3, 3]
        x, y = X / Z, Y / Z
        r = np.hypot(x, y)
        factor = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6
        u = x * factor + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2)
        v = y * factor + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y
        pixels.append([camera.fx * u + camera.cx, camera.fy * v + camera.cy])
    return np.array(pixels)


@pytest.mark.parametrize("lens", LENSES)
def test_inverse_undoes_the_lens(lens):
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 41), np.linspace(-0.5, 0.5, 41))
    u, v = undistort_points(*distort_points(x, y, lens), lens)
    np.testing.assert_allclose([u, v], [x, y], atol=1e-12)


def test_inverse_finds_the_solution_near_a_fold():
    lens = (-0.2, 0.0, 0.0, 0.0, 0.0)  # folds at r = sqrt(1 / 0.6) = 1.291
    r = np.linspace(0, 1.25, 100)
    u, v = undistort_points(*distort_points(0.6 * r, 0.8 * r, lens), lens)
    np.testing.assert_allclose([u, v], [0.6 * r, 0.8 * r], atol=1e-6)


@pytest.mark.parametrize("lens", [(-0.2, 0.0, 0.0, 0.0, 0.0), (-0.8, 0.0, 0.0, 0.0, 0.0)])
def test_lenses_that_fold_within_the_image_are_refused(lens):
    # r (1 + k1 r^2) turns back at r = sqrt(-1 / (3 k1)), where the image is at 2/3 of r: the corner must be nearer.
    farthest = 2 / 3 * np.sqrt(-1 / (3 * lens[0]))
    fov = 2 * np.degrees(np.arctan(farthest / np.sqrt(2)))
    CameraConfig((100, 100), fov_deg=fov - 0.5, distortion=lens)
    with pytest.raises(InputError, match=r"one-to-one over the image, found one that folds (70|71) of 71 pixels"):
        CameraConfig((100, 100), fov_deg=fov + 0.5, distortion=lens)
    CameraConfig((100, 100), fov_deg=120.0, distortion=(0.5, 0.0, 0.0, 0.0, 0.0))


def test_labels_are_never_averaged():
    camera = Camera(np.eye(4), 64, 48, 60.0, 60.0, 32.0, 24.0)
    labels = np.random.default_rng(0).choice(np.uint8([0, 85, 170, 255]), (48, 64))
    source = Undistortion(camera, BARREL)
    found = source.nearest(labels)
    assert found.dtype == np.uint8
    assert set(np.unique(found)) <= {0, 85, 170, 255}
    rows, columns = np.mgrid[0:48, 0:64].astype(np.float32)
    moved = source.nearest(rows) - source.linear(rows), source.nearest(columns) - source.linear(columns)
    assert max(np.abs(m[source.inside]).max() for m in moved) <= 0.5 + 1e-4
    vectors = np.stack([rows, columns, rows], axis=-1)
    np.testing.assert_array_equal(source.nearest(vectors)[..., 1], source.nearest(columns))
    beyond = Undistortion(camera, (0.5, 0.0, 0.0, 0.0, 0.0))
    assert not beyond.inside[0, 0]
    assert beyond.nearest(labels + np.uint8(1))[0, 0] == 0
    assert beyond.linear(np.ones((48, 64, 3), np.float32))[0, 0, 0] == 0


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """The same boxsat from the same places through a lens and without one."""
    root = tmp_path_factory.mktemp("lens")
    plain = replace(
        read_scene("boxsat"),
        objects=(
            ObjectConfig(spacecraft="boxsat", materials={"*": "lambertian-grey"}),
        ),  # no glints smaller than pixels
        rig=FibonacciRig(views=3, test_views=1, distance=4.0),
        camera=CameraConfig((128, 96), fov_deg=60.0),
        quality=QualityConfig(spp=32, max_depth=2, points=50),
    )
    lens = replace(plain, camera=replace(plain.camera, distortion=BARREL))
    return [generate(config, root / name) for name, config in (("plain", plain), ("lens", lens))]


def interior(truth):
    """[H, W] pixels whose 5 by 5 surroundings show one part without a jump in depth, under one class of shadow."""
    same = np.ones(truth.depth.shape, bool)
    for rows in range(-2, 3):
        for columns in range(-2, 3):
            for layer in (truth.part_id, truth.shadow):
                same &= layer == np.roll(layer, (rows, columns), (0, 1))
            same &= np.abs(np.roll(truth.depth, (rows, columns), (0, 1)) - truth.depth) < 0.1
    same[:2], same[-2:], same[:, :2], same[:, -2:] = False, False, False, False
    return same & (truth.object_id > 0)


def test_undistorted_labels_are_those_of_the_pinhole_camera(pair):
    plain, lens = pair
    assert lens.train[0].distortion == BARREL
    assert plain.train[0].distortion == ()
    checked = 0
    for a, b in zip(plain.frames, lens.frames, strict=True):
        truth, found = load_truth(plain, a), load_truth(lens, b)
        flat = interior(truth)
        checked += flat.sum()
        for name in ("object_id", "part_id", "shadow"):
            assert (getattr(found, name) != getattr(truth, name))[flat].mean() < 0.01, name
        for name, limit in {"depth": 0.03, "distance": 0.03, "normal": 0.05, "sun_cosine": 0.05}.items():
            error = np.abs(getattr(found, name) - getattr(truth, name))[flat]
            assert np.percentile(error, 95) < limit, name
        both = (found.object_id > 0) & (truth.object_id > 0)
        either = (found.object_id > 0) | (truth.object_id > 0)
        assert both.sum() / either.sum() > 0.9
        assert np.abs(found.alpha - truth.alpha).mean() < 0.01
    assert checked > 400


def test_undistorted_images_are_those_of_the_pinhole_camera(pair):
    plain, lens = pair
    left, untreated = 0.0, 0.0
    for a, b in zip(plain.frames, lens.frames, strict=True):
        first, second, raw = load_image(plain, a), load_image(lens, b), load_image(lens, replace(b, distortion=()))
        assert second.valid.all()
        truth, seen, stored = (image.over(np.zeros(3)) for image in (first, second, raw))
        left += np.abs(seen - truth).mean()
        untreated += np.abs(stored - truth).mean()
    assert left < 0.55 * untreated  # what is left are edges, blurred by up to a pixel


def test_rendered_vertices_are_where_the_model_puts_them():
    """Surface points of the distorted labels, put back into space by their depth and the inverse lens, lie on the mesh,
    and corners of the mesh that the camera sees project onto their silhouette."""
    scene = build(read_scene("boxsat"))
    config = CameraConfig((160, 120), fov_deg=45.0, distortion=BARREL)
    camera = config.at(look_at([7.0, 4.0, 3.0], scene.bounding_sphere[0]))
    truth = Renderer(scene, 1, 2, BARREL).render(camera, Sun.from_angles(40, 30), (0,))
    rows, columns = np.nonzero(truth.object_id)
    keep = np.random.default_rng(0).permutation(len(rows))[:150]
    rows, columns = rows[keep], columns[keep]
    u = (columns + 0.5 - camera.cx) / camera.fx
    v = (rows + 0.5 - camera.cy) / camera.fy
    x, y = undistort_points(u, v, BARREL)
    z = truth.depth[rows, columns].astype(np.float64)
    world = np.stack([x * z, y * z, z], axis=1) @ camera.world_from_camera[:3, :3].T + camera.position
    _, distance, _ = scene.mesh.nearest.on_surface(world)
    assert distance.max() < 2e-4  # metres; a pixel is 3 cm
    np.testing.assert_allclose(project(camera, world, BARREL), np.stack([columns + 0.5, rows + 0.5], axis=1), atol=1e-6)
    hull = scene.mesh.convex_hull.vertices
    pixels = project(camera, hull, BARREL)
    rows, columns = np.nonzero(truth.alpha)
    assert pixels[:, 0].min() == pytest.approx(columns.min(), abs=2)
    assert pixels[:, 0].max() == pytest.approx(columns.max() + 1, abs=2)
    assert pixels[:, 1].min() == pytest.approx(rows.min(), abs=2)
    assert pixels[:, 1].max() == pytest.approx(rows.max() + 1, abs=2)


def test_lens_is_written_for_other_trainers(pair):
    again = read_dataset(pair[1].root)
    assert again.train[0].distortion == BARREL
