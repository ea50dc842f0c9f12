"""Solids against closed forms."""

import numpy as np
import pytest
import trimesh

from spacesim.scenes import shapes


def _is_solid(mesh):
    return mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0 and mesh.area_faces.min() > 0


def test_revolved_square_has_the_volume_of_pappus():
    tube = shapes.tube([0, 0, 0], [0, 0, 2], inner=1.0, outer=1.5, segments=2000)
    assert tube.is_watertight
    assert tube.volume == pytest.approx(np.pi * (1.5**2 - 1.0) * 2, rel=1e-4)
    rod = shapes.rod([1, 2, 3], [2, 4, 5], radius=0.5, segments=2000)
    assert rod.volume == pytest.approx(np.pi * 0.25 * 3, rel=1e-4)
    np.testing.assert_allclose(rod.center_mass, [1.5, 3, 4], atol=1e-9)


def test_sector_is_its_share_of_the_ring():
    ring = [(1.0, -1.0), (1.5, -1.0), (1.5, 2.0), (1.0, 2.0)]
    sector = shapes.sector(ring, 20.0, 110.0, segments=500)
    assert _is_solid(sector)
    assert sector.volume == pytest.approx(0.25 * np.pi * (1.5**2 - 1.0) * 3.0, rel=1e-4)
    azimuth = np.degrees(np.arctan2(sector.vertices[:, 1], sector.vertices[:, 0]))
    assert (azimuth.min(), azimuth.max()) == pytest.approx((20.0, 110.0))


def test_dome_is_half_an_ellipsoid():
    profile = shapes.dome(2.0, 0.5, rings=400)
    half = shapes.revolve([(0.0, 0.0), *profile], segments=800)
    assert _is_solid(half)
    assert half.volume == pytest.approx(2.0 / 3.0 * np.pi * 2.0**2 * 0.5, rel=1e-4)


@pytest.mark.parametrize(
    "points",
    [
        [[0, 0, 0], [0, 3, 4]],
        [[0, 0, 0], [0, 0, 1], [1, 0, 1], [1, 2, 1]],
        [[1, 0, 0], [1, 0.5, 2], [0, 0, 3], [0.5, -1, 5], [0.5, -1, 6]],
    ],
    ids=["straight", "right angles", "oblique"],
)
def test_mitred_pipe_has_the_volume_of_its_centre_line(points):
    """Cutting prisms through their centres moves as much volume to one side as away from the other."""
    pipe = shapes.pipe(points, 0.1, segments=12)
    length = np.linalg.norm(np.diff(np.array(points, float), axis=0), axis=1).sum()
    polygon = 0.5 * 12 * 0.1**2 * np.sin(2 * np.pi / 12)
    assert _is_solid(pipe)
    assert pipe.volume == pytest.approx(polygon * length, rel=1e-9)


def test_handrail_stands_off_and_comes_back():
    rail = shapes.handrail([1, 0, 0], [1, 0, 2], [1, 0, 0], height=0.2, radius=0.01)
    assert _is_solid(rail)
    low, high = rail.bounds
    assert low[0] == pytest.approx(1.0)
    assert high[0] == pytest.approx(1.2, abs=0.011)
    assert (low[2], high[2]) == pytest.approx((0.0, 2.0), abs=0.011)


def test_turned_and_moved_leave_the_original():
    box = shapes.box([1, 2, 3])
    turned = shapes.rotate_mesh(box, 90.0, [0, 0, 1], about=[1, 0, 0])
    np.testing.assert_allclose(turned.bounds, [[0, -1.5, -1.5], [2, -0.5, 1.5]], atol=1e-12)
    moved = shapes.translate_mesh(box, [1, 2, 3])
    np.testing.assert_allclose(moved.bounds, [[0.5, 1, 1.5], [1.5, 3, 4.5]])
    np.testing.assert_allclose(box.bounds, [[-0.5, -1, -1.5], [0.5, 1, 1.5]])


def test_joined_keeps_every_solid():
    both = shapes.join_meshes((shapes.box([1, 1, 1]), shapes.box([1, 1, 1], [3, 0, 0])))
    assert isinstance(both, trimesh.Trimesh)
    assert both.volume == pytest.approx(2.0)


def test_whole_cells_begin_and_end_at_borders():
    """Of boxes turned and moved: broad faces are whole numbers of cells, in the proportions of the face."""
    boxes = [shapes.box([0.5, 0.01, 0.33], [1, 2, 3]), shapes.box([0.19, 0.11, 0.02])]
    mesh = shapes.rotate_mesh(shapes.join_meshes(boxes), 40.0, [1, 2, 3], [5, 6, 7])
    flat = shapes.whole_cells(mesh, (0.08, 0.04)).reshape(2, 12, 3, 2)
    broad = np.sort(mesh.area_faces.reshape(2, 12).argsort(axis=1)[:, -4:])  # the two largest sides, two facets each
    for corners, faces, (columns, rows) in zip(flat, broad, [(6, 8), (2, 3)], strict=True):
        found = corners[faces].reshape(-1, 2) / (0.08, 0.04)
        assert {tuple(corner) for corner in np.round(found, 9)} == {(i, j) for i in (0, columns) for j in (0, rows)}
    for corners, extent in zip(flat, ([0.48, 0.01, 0.32], [0.16, 0.12, 0.02]), strict=True):
        assert np.ptp(corners, axis=(0, 1)).max() <= max(extent) + 1e-9
        assert (np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) > 1e-5).all(), "no face is laid edge-on"
