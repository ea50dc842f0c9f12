"""Metrics of shapes against brute force, closed forms and known shifts; odd meshes give numbers or a sentence."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.distance import directed_hausdorff

from spacesim.data.mesh import SignedDistance
from spacesim.eval.metrics import solid
from spacesim.eval.metrics.exterior import ExteriorView, exterior_samples
from spacesim.eval.metrics.geometry import (
    Comparison,
    GeometryConfig,
    angles,
    chamfer,
    compare_meshes,
    floaters,
    hausdorff,
    overlap,
    precision_recall,
    size_of,
)
from spacesim.eval.metrics.solid import filled_voxels
from spacesim.splat.export.fusion import Grid

CONFIG = GeometryConfig(samples=8000, voxels=60)


def parts(mesh):
    return np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)


def cube(side=1.0, at=(0, 0, 0)):
    return parts(trimesh.creation.box((side,) * 3, transform=trimesh.transformations.translation_matrix(at)))


def joined(*meshes):
    firsts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    faces = [faces + first for (_, faces), first in zip(meshes, firsts, strict=False)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces)


def test_distances_are_those_of_brute_force():
    one, other = parts(trimesh.creation.icosphere(subdivisions=2)), cube(1.4)
    found = compare_meshes(one, other, replace(CONFIG, samples=900))
    assert isinstance(found, Comparison)
    p, q = found.truth.samples.points, found.predicted.samples.points
    square = ((p[:, None] - q[None]) ** 2).sum(axis=2)
    there, back = np.sqrt(square.min(axis=1)), np.sqrt(square.min(axis=0))
    assert found.values["chamfer"] == pytest.approx(square.min(axis=1).mean() + square.min(axis=0).mean(), rel=1e-12)
    farthest = max(directed_hausdorff(p, q)[0], directed_hausdorff(q, p)[0])
    assert found.values["hausdorff"] == pytest.approx(farthest, rel=1e-12)
    worst = max(np.quantile(there, 0.99), np.quantile(back, 0.99))
    assert found.values["hausdorff99"] == pytest.approx(worst, rel=1e-12)
    assert found.values["accuracy"] == pytest.approx(back.mean(), rel=1e-12)
    within = 0.01 * size_of(*one)
    assert found.values["precision_recall"]["precision"] == np.mean(back < within)
    assert found.values["precision_recall"]["recall"] == np.mean(there < within)
    turned = [
        np.degrees(np.arccos(np.abs(n @ m)))
        for n, m in zip(
            found.truth.samples.normals, found.predicted.samples.normals[square.argmin(axis=1)], strict=True
        )
    ]
    assert angles(found.truth.samples.normals, found.predicted.samples.normals[square.argmin(axis=1)]) == pytest.approx(
        np.nan_to_num(turned), abs=1e-5
    )


def test_hausdorff_is_the_largest_distance_of_either_way():
    """A cube of side 1 beside itself with a thin spike: its sides are 0.4 % of the area."""
    spike = parts(trimesh.creation.box((0.6, 0.01, 0.01)))
    spiked = joined(cube(), (spike[0] + [0.8, 0, 0], spike[1]))  # ends at x = 1.1
    for pair in ((cube(), spiked), (spiked, cube())):
        found = compare_meshes(*pair, replace(CONFIG, samples=40_000)).values
        assert 0.58 < found["hausdorff"] <= 0.6 + 1e-3
        assert found["hausdorff99"] < 0.05
    assert hausdorff(np.array([1.0, 2.0]), np.array([3.0, 0.5])) == 3
    assert hausdorff(np.array([4.0, 2.0]), np.array([3.0, 0.5])) == 4


@pytest.mark.parametrize("shift", [0.1, 0.3])
def test_a_cube_moved_by_a_known_way(shift):
    found = compare_meshes(cube(), cube(at=(shift, 0, 0)), replace(CONFIG, samples=60_000, voxels=100))
    assert isinstance(found, Comparison)
    # On average over a cube: the face left behind is `shift` away; the opposite one lies inside the other cube, nearest
    # to its counterpart or to a side; of the four sides a strip sticks out.
    ahead = shift**2 - 8 * shift**3 / 3 + 2 * shift**4
    expected = 2 * (shift**2 + ahead + 4 * shift**3 / 3) / 6
    assert found.values["chamfer"] == pytest.approx(expected, rel=0.02)
    assert found.values["hausdorff99"] == pytest.approx(shift, rel=0.02)
    assert found.values["iou"] == pytest.approx((1 - shift) / (1 + shift), abs=0.02)


def test_equal_surfaces_leave_only_the_noise_of_sampling():
    found = compare_meshes(cube(), cube(), replace(CONFIG, samples=20_000))
    spacing = np.sqrt(6 / 20_000)  # of a square lattice with as many points
    assert found.values["hausdorff99"] < 2 * spacing
    assert found.values["chamfer"] < 2 * spacing**2
    assert found.values["iou"] == 1
    assert found.values["precision_recall"]["f"] > 0.9  # 0.01 of the size is the mean distance of so few points
    assert found.values["normals_deg"] < 3  # at the edges the nearest point may be round the corner


def test_same_input_same_bits():
    one, other = cube(), cube(at=(0.2, 0.1, 0))
    assert compare_meshes(one, other, CONFIG).values == compare_meshes(one, other, CONFIG).values


def test_normals_of_a_tilted_plate():
    flat = parts(trimesh.creation.box((1, 1, 1e-4)))
    turn = trimesh.transformations.rotation_matrix(np.radians(10), (1, 0, 0))
    tilted = parts(trimesh.creation.box((1, 1, 1e-4), transform=turn))
    assert compare_meshes(flat, tilted, CONFIG).values["normals_deg"] == pytest.approx(10, abs=0.5)


def test_exterior_of_a_closed_box_with_content():
    content = joined(cube(0.3), parts(trimesh.creation.icosphere(radius=0.2).apply_translation((0.3, 0.2, 0))))
    shell, inner = cube(1.0), cube(0.9)
    whole = joined(shell, (inner[0], inner[1][:, ::-1]), content)
    for faces in (whole[1], whole[1][:, ::-1]):
        samples = exterior_samples(whole[0], faces, 5000, 0)
        assert len(samples.points) == 5000
        assert np.abs(samples.points).max(axis=1) == pytest.approx(0.5)
        assert np.all(np.einsum("nc,nc->n", samples.points, samples.normals) > 0)  # outwards, however faces turn
        assert set(samples.faces) <= set(range(12))
    counts = np.bincount(samples.faces, minlength=12)[:12]
    assert counts == pytest.approx(5000 / 12, rel=0.25)


@pytest.mark.parametrize("opened", [False, True])
def test_hidden_faces_are_seldom_sampled(monkeypatch, opened):
    """A cube with 20 balls in each other has 12 % of its area outside; what half of an open side shows stays."""
    asked, sides = [], ExteriorView.visible_sides
    monkeypatch.setattr(
        ExteriorView, "visible_sides", lambda self, *points: asked.append(len(points[0])) or sides(self, *points)
    )
    balls = [parts(trimesh.creation.icosphere(subdivisions=2, radius=r)) for r in np.linspace(0.35, 0.45, 20)]
    vertices, faces = cube()
    found = exterior_samples(*joined((vertices, faces[opened:]), *balls), 8000, 0)
    assert sum(asked) < 3 * 8000  # all at random, 66,000 would be needed
    on_hull = np.abs(found.points).max(axis=1) > 0.4999
    balls_seen = np.linalg.norm(found.points[~on_hull], axis=1)
    if opened:
        assert 0.02 < np.mean(~on_hull) < 0.5
        assert balls_seen[balls_seen < 0.49].min() > 0.44  # the outermost one, and the sides of the cube within
    else:
        assert on_hull.all()
        sides_hit = np.bincount(np.abs(found.points).argmax(axis=1), minlength=3)
        assert sides_hit / 8000 == pytest.approx(1 / 3, abs=0.02)


def test_what_a_hole_shows_is_exterior():
    vertices, faces = joined(cube(1.0), cube(0.4))
    top = np.flatnonzero(np.all(vertices[faces][..., 2] == 0.5, axis=1))
    opened = np.delete(faces, top, axis=0)
    samples = exterior_samples(vertices, opened, 5000, 0)
    assert np.any(np.abs(samples.points).max(axis=1) < 0.3)  # the content's top
    lowest = samples.points[np.abs(samples.points).max(axis=1) < 0.3]
    assert np.all(lowest[:, 2] > -0.2 + 1e-9)  # its bottom faces the closed floor


def test_samples_are_even_over_the_visible_area():
    long = parts(trimesh.creation.box((4, 1, 1)))
    samples = exterior_samples(*long, 40_000, 3)
    ends = np.mean(np.abs(np.abs(samples.points[:, 0]) - 2) < 1e-9)
    assert ends == pytest.approx(2 / 18, abs=0.006)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_size_and_place_do_not_matter(scale):
    sphere, moved = (parts(trimesh.creation.icosphere(radius=r)) for r in (1.0, 1.1))
    offset = np.array([7.0, -3.0, 2.0])
    found = [
        compare_meshes(*(((v + o) * s, f) for v, f in (sphere, moved)), CONFIG).values
        for o, s in ((0, 1), (offset, scale))
    ]
    assert found[1]["hausdorff99"] == pytest.approx(scale * found[0]["hausdorff99"], rel=1e-3)
    assert found[1]["iou"] == pytest.approx(found[0]["iou"], abs=0.02)


def test_filled_voxels():
    vertices, faces = cube()
    grid = Grid.around(vertices.min(axis=0), vertices.max(axis=0), 0.0213, 0.1)
    z, y, x = np.indices(grid.shape[::-1])
    centres = np.stack([x, y, z], axis=-1) * grid.voxel + grid.origin
    inside = np.abs(centres).max(axis=-1) < 0.5
    assert np.array_equal(filled_voxels(vertices, faces, grid), inside)
    assert np.array_equal(filled_voxels(vertices, faces[:, ::-1], grid), inside)
    inner = cube(0.8)
    hollow = joined((vertices, faces), (inner[0], inner[1][:, ::-1]))
    assert np.array_equal(filled_voxels(*hollow, grid), inside)  # full, whatever is in it
    mixed = np.concatenate([faces[:6], faces[6:, ::-1]])
    assert np.mean(filled_voxels(vertices, mixed, grid) == inside) > 0.98
    opened = filled_voxels(vertices, faces[1:], grid)
    assert 0.8 < opened.sum() / inside.sum() <= 1
    assert not np.any(opened & ~inside & (np.abs(centres).max(axis=-1) > 0.6))
    sheet = faces[np.all(vertices[faces][..., 2] == 0.5, axis=1)]
    assert filled_voxels(vertices, sheet, grid).sum() <= 0.02 * inside.sum()


def test_a_cup_is_not_full():
    outer = trimesh.creation.cylinder(radius=0.5, height=1.0)
    walls = trimesh.creation.annulus(r_min=0.4, r_max=0.5, height=1.0)
    bottom = trimesh.creation.cylinder(radius=0.45, height=0.1).apply_translation((0, 0, -0.45))
    vertices, faces = joined(parts(walls), parts(bottom))
    grid = Grid.around(vertices.min(axis=0), vertices.max(axis=0), 0.021, 0.1)
    volume = filled_voxels(vertices, faces, grid).sum() * grid.voxel**3
    assert volume == pytest.approx(walls.volume + np.pi * 0.4**2 * 0.1, rel=0.06)
    assert volume < 0.6 * outer.volume


def test_a_small_open_ball_in_a_large_grid_is_full():
    vertices, faces = parts(trimesh.creation.icosphere(subdivisions=3, radius=0.3))
    opened = vertices, faces[vertices[faces].mean(axis=1)[:, 2] < 0.28]  # 0.9 % of the grid, all of it open to outside
    rods = [
        (cube()[0] * sides + at, cube()[1])
        for sides, at in (((2, 0.02, 0.02), (0, 3, 0)), ((0.02, 2, 0.02), (2, 0, 0)))
    ]
    mesh = joined(opened, *rods)
    grid = Grid.around(mesh[0].min(axis=0), mesh[0].max(axis=0), 0.039, 0.1)
    volume = filled_voxels(*mesh, grid).sum() * grid.voxel**3
    assert volume == pytest.approx(4 / 3 * np.pi * 0.3**3, rel=0.04)


VOXEL = 1 / 20.3  #: of the overlaps below: no centre of one is on a face


def voxels_inside(truth, predicted):
    """How many centres of the common grid are in the unit cube `truth`, beside which `predicted` lies."""
    low, high = truth[0].min(axis=0), truth[0].max(axis=0)
    around = np.maximum(predicted[0].min(axis=0), low - 1), np.minimum(predicted[0].max(axis=0), high + 1)
    grid = Grid.around(*around, VOXEL, 3 * VOXEL)
    axes = [grid.origin[k] + grid.voxel * np.arange(grid.shape[k]) for k in range(3)]
    return np.prod([np.sum(np.abs(axis) < 0.5) for axis in axes])


@pytest.mark.parametrize(
    "places",
    [
        [(1e5, 3.3, -7.7)],
        [(-40, 0.1, 0.2), (-40, 2.1, 0.2), (7.03, -1e3, 1e4)],
        [(1.31, 0.1, 0)],  # across the common grid's end
        [(0.3, -0.2, 2.4), (0.3, -0.2, 2.4 + 9 * VOXEL)],  # two that are less than `APART` apart
    ],
)
def test_floaters_lower_the_overlap_by_their_volume(places):
    """Cubes of exactly 8 x 8 x 8 voxels, wherever they are."""
    floating = joined(cube(), *(cube(8 * VOXEL, at=at) for at in places))
    n = voxels_inside(cube(), floating)
    assert n in (20**3, 20**2 * 21, 20 * 21**2, 21**3)
    assert overlap(cube(), floating, VOXEL) == pytest.approx(n / (n + len(places) * 8**3), rel=1e-12)


def test_hollow_floaters_are_full():
    inner = cube(6 * VOXEL, at=(30, 0.1, 0))
    floating = joined(cube(), cube(8 * VOXEL, at=(30, 0.1, 0)), (inner[0], inner[1][:, ::-1]))
    n = voxels_inside(cube(), floating)
    assert overlap(cube(), floating, VOXEL) == pytest.approx(n / (n + 8**3), rel=1e-12)


def test_large_floaters_are_counted_in_few_voxels(monkeypatch):
    counts = []

    def counted(vertices, faces, grid):
        counts.append(grid.count)
        return filled_voxels(vertices, faces, grid)

    monkeypatch.setattr(solid, "filled_voxels", counted)
    monkeypatch.setattr(solid, "MAX_VOXELS", 2**20)
    floating = joined(cube(), cube(50, at=(90, 0, 3)), cube(8 * VOXEL, at=(-9, 0.1, 0)))
    expected = 1 / (1 + 50**3 + (8 * VOXEL) ** 3)
    assert overlap(cube(), floating, VOXEL) == pytest.approx(expected, rel=0.05)
    assert len(counts) == 2
    assert 2**17 < max(counts) <= 2**20
    around = cube(8), cube()  # the truth within the prediction, all of one part
    assert overlap(around[1], around[0], VOXEL) == pytest.approx(1 / 512, rel=0.1)


def test_a_far_point_is_no_floater():
    point = np.full((3, 3), 70.0), np.array([[0, 1, 2]])
    assert overlap(cube(), joined(cube(), point), VOXEL) == 1


def test_precision_and_recall():
    found = precision_recall(np.array([0.0, 0.2, 0.3]), np.array([0.05, 0.5]), 0.1)
    assert found == {"distance": 0.1, "precision": 0.5, "recall": pytest.approx(1 / 3), "f": pytest.approx(0.4)}
    assert precision_recall(np.ones(2), np.ones(2), 0.1)["f"] == 0
    assert chamfer(np.array([1.0, 2.0]), np.array([3.0])) == pytest.approx(2.5 + 9)


def test_floaters():
    model = {
        "means": np.array([[0, 0, 0], [0, 0, 0.505], [0, 0, 0.6], [3, 0, 0]], np.float32),
        "logit_opacities": np.log(np.array([0.5, 0.25, 0.5, 0.75]) / (1 - np.array([0.5, 0.25, 0.5, 0.75]))),
    }
    found = floaters(model, SignedDistance(*cube()), 0.05)
    assert found == {"distance": 0.05, "outside": pytest.approx(1.25 / 2.0), "inside": 0.25}
    one = {name: values[:1] for name, values in model.items()}
    assert floaters(one, SignedDistance(*cube()), 0.05) == {"distance": 0.05, "outside": 0, "inside": 1}
    assert floaters({name: values[:0] for name, values in model.items()}, SignedDistance(*cube()), 0.05) is None


def test_odd_meshes():
    vertices, faces = cube()
    point = np.zeros((3, 3)), np.array([[0, 1, 2]])
    assert (
        compare_meshes((vertices, faces), point, CONFIG)
        == "nothing of the reconstructed surface can be seen from outside"
    )
    none = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    assert "reconstructed" in compare_meshes((vertices, faces), none, CONFIG)
    holes = compare_meshes((vertices, faces), (vertices, faces[3:]), CONFIG)
    assert np.isfinite(holes.values["chamfer"])
    inverted = compare_meshes((vertices, faces[:, ::-1]), (vertices, faces), CONFIG)
    assert inverted.values["iou"] == 1
    triangle = compare_meshes((vertices, faces), (vertices, faces[:1]), CONFIG)
    assert triangle.values["iou"] < 0.05
    assert triangle.values["accuracy"] < 0.03
    assert triangle.values["precision_recall"]["recall"] < 0.2
    degenerate = joined((vertices, faces), (np.zeros((1, 3)), np.zeros((1, 3), np.int64)))
    assert compare_meshes((vertices, faces), degenerate, CONFIG).values["iou"] == 1


def test_points_in_a_closed_box_are_not_seen():
    sight = ExteriorView(*cube())
    assert sight.is_seen(np.array([[0, 0, 0], [0.4, 0.4, -0.4], [0.6, 0, 0], [0, 0, -5.0]])).tolist() == [
        False,
        False,
        True,
        True,
    ]
