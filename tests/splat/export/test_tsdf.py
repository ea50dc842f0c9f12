"""Fused depth and the meshes taken from it, against closed forms; the depth of Gaussians against float64."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from spacesim import backend
from spacesim.data.errors import InputError
from spacesim.data.geometry import fibonacci_sphere, look_at, rotation_from_quaternion
from spacesim.data.records import Camera
from spacesim.data.store import load_truth, read_dataset
from spacesim.splat.export import fusion
from spacesim.splat.export.fusion import DepthView, DistanceField, Grid, fuse
from spacesim.splat.export.mesh import (
    MeshConfig,
    bounds,
    cameras_around,
    depth_of,
    mesh_of,
    mesh_of_depths,
    select_views,
    surface,
)
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.train.start import gaussians_at

SIDE = 96


def cameras(count=40, distance=3.0, side=SIDE, centre=(0, 0, 0)):
    centre = np.asarray(centre, float)
    return [
        Camera.from_fov(look_at(centre + distance * direction, centre), side, side, 50.0)
        for direction in fibonacci_sphere(count)
    ]


def rays(camera):
    """[H, W, 3] world directions of depth 1."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    own = np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], axis=-1)
    return own @ camera.world_from_camera[:3, :3].T


def sphere_view(camera, radius=1.0):
    """Depth of a sphere at the origin: the nearer root of |o + t d| = r."""
    d, o = rays(camera), camera.position
    a, b, c = (d * d).sum(-1), d @ o, o @ o - radius**2
    root = b * b - a * c
    depth = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0)
    return DepthView(camera, depth.astype(np.float32))


def box_view(camera, half):
    """Depth of the box |x| <= half, by slabs."""
    d, o = rays(camera), camera.position
    with np.errstate(divide="ignore"):
        one, other = (-half - o) / d, (half - o) / d
    near, far = np.minimum(one, other).max(-1), np.maximum(one, other).min(-1)
    return DepthView(camera, np.where((near < far) & (near > 0), near, 0).astype(np.float32))


def test_sphere_within_half_a_voxel():
    grid = Grid.around(-np.ones(3), np.ones(3), 1 / 32, 0.2)
    vertices, faces = surface(fuse([sphere_view(camera) for camera in cameras()], grid))
    error = (np.linalg.norm(vertices, axis=1) - 1) / grid.voxel
    assert np.abs(error).max() < 0.5
    assert abs(error.mean()) < 0.05
    mesh = trimesh.Trimesh(vertices, faces)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(4 / 3 * np.pi, rel=0.01)  # faces turn outwards


@pytest.mark.parametrize("side", [48, 200])
def test_sphere_from_pictures_of_other_sizes(side):
    grid = Grid.around(-np.ones(3), np.ones(3), 1 / 24, 0.2)
    vertices, _ = surface(fuse([sphere_view(camera) for camera in cameras(side=side)], grid))
    pixel = 2 * np.tan(np.radians(25)) * 2 / side  # metres, at the sphere's front
    assert np.abs(np.linalg.norm(vertices, axis=1) - 1).max() < 0.5 * grid.voxel + 0.5 * pixel


def test_a_thin_plate_has_both_its_sides():
    half = np.array([0.8, 0.6, 0.04])  # 2.6 voxels thick, less than the truncation
    grid = Grid.around(-half, half, 1 / 32, 0.25)
    vertices, _ = surface(fuse([box_view(camera, half) for camera in cameras(80)], grid))
    middle = np.abs(vertices[:, :2]).max(axis=1) < 0.5
    thickness = np.abs(vertices[middle, 2]) / 0.04
    assert middle.sum() > 1000
    assert abs(np.median(thickness) - 1) * 0.04 < 0.5 * grid.voxel
    assert np.sign(vertices[middle, 2]).mean() == pytest.approx(0, abs=0.05)


def test_one_view_of_a_wall():
    """Closed form: a voxel's value is its distance along the axis by the truncation, within it."""
    camera = Camera.from_fov(look_at([0, 0, 5], [0, 0, 0], up=(0, 1, 0)), 64, 64, 40)
    depth = np.full((64, 64), 5.0, np.float32)  # the wall z = 0
    grid = Grid.around([-0.5, -0.5, -0.5], [0.5, 0.5, 0.5], 0.1, 0.0)
    field = fuse([DepthView(camera, depth)], grid, truncation=2.5)
    z = grid.origin[2] + grid.voxel * np.arange(grid.shape[2])
    expected = np.clip(z / 0.25, -1, 1)
    seen = z > -0.25
    assert np.array_equal(field.observed, np.broadcast_to(seen[:, None, None], field.observed.shape))
    assert np.abs(field.distance - expected[:, None, None])[seen].max() < 1e-4
    vertices, _ = surface(field)
    assert np.abs(vertices[:, 2]).max() < 1e-4


def test_rays_without_surface_are_empty_and_what_no_view_sees_has_no_surface():
    camera = Camera.from_fov(look_at([0, 0, 5], [0, 0, 0], up=(0, 1, 0)), 16, 16, 2)  # sees 0.17 m
    grid = Grid.around([-0.5] * 3, [0.5] * 3, 0.05, 0.0)
    field = fuse([DepthView(camera, np.zeros((16, 16), np.float32))], grid)
    assert 0 < field.observed.mean() < 0.2
    assert np.all(field.distance == 1)
    assert len(surface(field)[1]) == 0


def test_same_bits_however_often_and_in_whichever_batches(monkeypatch):
    views = [sphere_view(camera) for camera in cameras(10)]
    grid = Grid.around(-np.ones(3), np.ones(3), 1 / 16, 0.2)
    first = fuse(views, grid)
    monkeypatch.setattr(fusion, "BATCH", 3)
    again = fuse(iter(views), grid)
    assert np.array_equal(first.distance, again.distance)
    assert np.array_equal(first.observed, again.observed)


def test_pictures_of_different_sizes():
    views = [sphere_view(camera) for side in (64, 31) for camera in cameras(20, side=side)]
    grid = Grid.around(-np.ones(3), np.ones(3), 1 / 16, 0.2)
    vertices, _ = surface(fuse(views, grid))
    assert np.abs(np.linalg.norm(vertices, axis=1) - 1).max() < 1 / 16


def test_pictures_of_one_pixel():
    views = [DepthView(camera, np.full((1, 1), 2.0, np.float32)) for camera in cameras(12, side=1)]
    field = fuse(views, Grid.around(-np.ones(3), np.ones(3), 1 / 16, 0.2))
    assert np.isfinite(field.distance).all()
    assert np.any(field.distance < 0)  # just behind the fronts that the views see
    assert not field.observed[19, 19, 19]  # far behind all of them


def test_depth_that_is_not_finite_counts_as_none():
    views = [sphere_view(camera) for camera in cameras(30)]
    views[0].depth[:] = np.nan
    grid = Grid.around(-np.ones(3), np.ones(3), 1 / 16, 0.2)
    assert np.isfinite(fuse(views, grid).distance).all()


def test_surface_of_any_field_is_closed():
    rng = np.random.default_rng(0)
    distance = np.ones((14, 15, 16), np.float32)
    distance[1:-1, 1:-1, 1:-1] = rng.normal(size=(12, 13, 14))
    grid = Grid(np.zeros(3), 0.5, (16, 15, 14))
    vertices, faces = surface(DistanceField(grid, distance, np.ones_like(distance, bool)))
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    holes = surface(DistanceField(grid, distance, rng.random(distance.shape) > 0.02))
    assert 0 < len(holes[1]) < len(faces)


def test_too_large_a_volume_is_refused_in_one_sentence(monkeypatch):
    monkeypatch.setattr(backend, "free_memory", lambda _: 10_000_000)
    with pytest.raises(InputError, match=r"voxel: .* 101x101x101 voxels take .* GB; take at least 0\.0\d+ m"):
        fuse([], Grid.around(np.zeros(3), np.ones(3), 0.01, 0))


def ball(count=6000, radius=1.0, seed=0):
    """Opaque Gaussians, flat along the normal, all over a sphere."""
    normals = fibonacci_sphere(count, seed)
    model = gaussians_at(radius * normals, np.full((count, 3), 0.5), 0)
    arrays = model.to_numpy()
    helper = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    x = np.cross(normals, helper)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    rotation = np.stack([x, np.cross(normals, x), normals], axis=2)
    w = np.sqrt(np.maximum(1 + np.trace(rotation, axis1=1, axis2=2), 1e-9)) / 2
    q = np.stack(
        [
            w,
            *((rotation[:, i, j] - rotation[:, j, i]) / (4 * w) for i, j in ((2, 1), (0, 2), (1, 0))),
        ],
        axis=1,
    )
    arrays["quaternions"] = q.astype(np.float32)
    arrays["log_scales"][:, 2] -= 3
    arrays["logit_opacities"][:] = 4
    return Gaussians.from_numpy(arrays)


def test_a_ball_of_gaussians():
    found = mesh_of(ball(), cameras(30), MeshConfig(voxels=48))
    radii = np.linalg.norm(found.vertices, axis=1)
    assert found.voxel == pytest.approx(12**0.5 / 48, rel=0.05)
    assert found.views == 30
    assert abs(np.median(radii) - 1) < 0.25 * found.voxel
    assert np.quantile(np.abs(radii - 1), 0.99) < found.voxel
    again = mesh_of(ball(), cameras(30), MeshConfig(voxels=48))
    assert np.array_equal(found.vertices, again.vertices)
    assert np.array_equal(found.faces, again.faces)


def test_voxels_too_coarse_for_the_shape_are_warned_of(caplog):
    views = [sphere_view(camera) for camera in cameras(8)]
    shown = {view.camera.world_from_camera.tobytes(): view.depth for view in views}
    size = float(np.linalg.norm(np.subtract(*bounds(views)[::-1])))
    for share, warned in ((0.09, False), (0.11, True)):
        caplog.clear()
        config = MeshConfig(voxel=share * size)
        mesh_of_depths(lambda camera: shown[camera.world_from_camera.tobytes()], cameras(8), config)
        assert any("is too coarse for an object of" in message for message in caplog.messages) == warned


def test_floaters_far_away_do_not_make_the_grid_large():
    arrays = ball().to_numpy()
    arrays["means"][:3] *= 1.7
    found = mesh_of(Gaussians.from_numpy(arrays), cameras(20, distance=5.0), MeshConfig(voxels=48))
    assert found.voxel < 1.3 * 12**0.5 / 48


def test_depth_of_one_gaussian_is_where_the_ray_is_deepest_in_it():
    """Against the exact z = d'P m / d'P d in float64, near the centre, where it is linear in the pixel."""
    q = np.array([0.9, 0.3, -0.25, 0.1])
    mean, scales = np.array([0.1, -0.05, 0.2]), np.array([0.12, 0.1, 0.01])
    model = Gaussians.from_numpy(
        {
            "means": mean[None],
            "log_scales": np.log(scales)[None],
            "quaternions": q[None],
            "logit_opacities": np.array([6.0]),
            "sh": np.zeros((1, 1, 3)),
        }
    )
    camera = Camera.from_fov(look_at([2, 0.5, 1], mean), 128, 128, 12)
    depth = depth_of(model, camera)
    rotation = rotation_from_quaternion(q)
    turned = camera.world_from_camera[:3, :3].T @ rotation
    precision = turned @ np.diag(scales**-2.0) @ turned.T
    centre = camera.camera_from_world[:3] @ np.append(mean, 1)
    x = (np.arange(128) + 0.5 - 64) / camera.fx
    d = np.stack([*np.meshgrid(x, x), np.ones((128, 128))], axis=-1)
    exact = (d @ precision @ centre) / np.einsum("hwi,ij,hwj->hw", d, precision, d)
    near = (depth > 0) & (np.hypot(*np.meshgrid(x, x)) < 0.03)
    assert near.sum() > 300
    assert np.ptp(exact[near]) > 0.03  # it is tilted: the centre's depth would not do
    assert np.abs(depth - exact)[near].max() < 0.12 * np.ptp(exact[near])
    assert np.abs(np.where(depth > 0, depth - centre[2], 0)).max() <= 2 * scales.max() + 1e-5
    flat = depth_of(model, camera, "median")
    assert np.abs(flat[near] - centre[2]).max() < 1e-5


def test_no_gaussians_and_one():
    empty = Gaussians.from_numpy(
        {
            "means": np.zeros((0, 3)),
            "log_scales": np.zeros((0, 3)),
            "quaternions": np.zeros((0, 4)),
            "logit_opacities": np.zeros(0),
            "sh": np.zeros((0, 1, 3)),
        }
    )
    assert len(mesh_of(empty, cameras(4)).faces) == 0
    assert cameras_around(empty, 5) == []
    assert bounds([]) is None
    assert len(mesh_of(ball(1), cameras(8), MeshConfig(voxels=16)).vertices) >= 0
    for model in (empty, ball(1)):
        assert len(mesh_of(model, []).faces) == 0


def test_views_are_even_and_of_different_places():
    all_of_them = cameras(30, side=1024)
    chosen = select_views([*all_of_them, *all_of_them], 10)
    assert len(chosen) == 10
    assert len({camera.world_from_camera.tobytes() for camera in chosen}) == 10
    assert {camera.width for camera in chosen} == {512}
    near = [replace(camera, fx=9 * camera.fx, fy=9 * camera.fy) for camera in all_of_them]
    assert len(select_views([*all_of_them, *near], 60)) == 60  # one lens does not stand for another


def test_cameras_around_see_all_of_the_model():
    for camera in cameras_around(ball(), 12):
        points = ball().to_numpy()["means"] @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
        pixels = points[:, :2] / points[:, 2:] * camera.fx + camera.cx
        assert pixels.min() > 0
        assert pixels.max() < camera.width


@pytest.mark.parametrize(
    "options", [{"voxel": 0.0}, {"voxel": np.inf}, {"views": 0}, {"voxels": 1}, {"truncation": 0.5}, {"depth": "mean"}]
)
def test_options_out_of_range(options):
    with pytest.raises(InputError, match=f"^{next(iter(options))}: expected"):
        MeshConfig(**options)


def test_a_path_traced_sphere_within_half_a_voxel(spacesim, tmp_path, monkeypatch):
    monkeypatch.setattr("spacesim.data.exporters.keypoints.find_symmetries", lambda *_: ((), ()))  # seconds of a ball
    trimesh.creation.icosphere(subdivisions=5).export(tmp_path / "ball.stl")
    done = spacesim(
        *("generate", tmp_path / "ball.stl", "--out", tmp_path / "data", "--suns", 1, "--views", 30),
        *("--test-views", 1, "--resolution", 72, "--spp", 1),
    )
    assert done.code == 0, done.errors
    dataset = read_dataset(tmp_path / "data")
    views = [DepthView(frame.camera, load_truth(dataset, frame).depth) for frame in dataset.train]
    low, high = bounds(views)
    assert np.abs(np.concatenate([low + 1, high - 1])).max() < 0.05
    grid = Grid.around(low, high, 1 / 24, 0.2)
    vertices, faces = surface(fuse(views, grid))
    assert np.abs(np.linalg.norm(vertices, axis=1) - 1).max() < 0.5 * grid.voxel
    assert trimesh.Trimesh(vertices, faces).is_watertight
