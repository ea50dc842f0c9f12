"""Masks and keypoints in pictures, against the path tracer's depth and another ray caster."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from pycocotools import mask as coco_mask

from spacesim.data.errors import InputError
from spacesim.data.exporters.labels import HIDDEN, OUTSIDE, VISIBLE, DatasetLabeller, project
from spacesim.data.exporters.masks import outline, run_lengths
from spacesim.data.images import read_exr, undistort_points
from spacesim.data.records import Camera, Frame


@pytest.fixture(scope="module")
def labeller(labelled) -> DatasetLabeller:
    return DatasetLabeller(labelled, 40)


def masks() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    one = np.zeros((5, 7), bool)
    one[2, 3] = True
    ring = np.ones((6, 8), bool)
    ring[2:4, 3:5] = False
    apart = np.zeros((9, 9), bool)
    apart[1:3, 1:3] = apart[3:6, 3:8] = apart[8, 0] = True
    wide = np.zeros((40, 300), bool)
    wide[3:30, 100:] = True
    return [one, ring, apart, wide, np.ones((3, 4), bool), *(rng.random((23, 31)) < share for share in (0.1, 0.6))]


@pytest.mark.parametrize("mask", masks())
def test_run_lengths_are_those_of_pycocotools(mask):
    theirs = coco_mask.encode(np.asfortranarray(mask.astype(np.uint8)))
    assert run_lengths(mask) == {"size": theirs["size"], "counts": theirs["counts"].decode()}


@pytest.mark.parametrize("mask", masks())
def test_an_outline_is_the_mask_by_even_odd_and_by_its_area(mask):
    polygon = outline(mask)
    x, y = polygon.T
    assert 0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() == pytest.approx(mask.sum())
    ends = np.roll(polygon, -1, axis=0)
    rows, columns = np.indices(mask.shape) + 0.5
    crossings = np.zeros(mask.shape, int)
    for (x0, y0), (x1, y1) in zip(polygon, ends, strict=True):
        if y0 != y1:
            between = (rows > min(y0, y1)) & (rows < max(y0, y1))
            crossings += between & (columns < x0 + (rows - y0) * (x1 - x0) / (y1 - y0))
    np.testing.assert_array_equal(crossings % 2 == 1, mask)


def test_the_path_tracers_depth_agrees_on_what_is_seen(labelled, labeller):
    """Of a keypoint that is seen, its picture shows a surface at its place; of a hidden one, something nearer."""
    counts, agreed = {OUTSIDE: 0, HIDDEN: 0, VISIBLE: 0}, []
    for frame in labelled.frames:
        depth, camera = read_exr(labelled.root / frame.gt_path)["depth"], frame.camera
        columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        x, y = undistort_points((columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, frame.distortion)
        surface = np.dstack([x * depth, y * depth, depth])
        for instance, body in zip(labeller.instances(frame), labeller.bodies, strict=True):
            points = body.points @ (pose := instance.target.camera_from_object(camera))[:3, :3].T + pose[:3, 3]
            for point, (u, v, state) in zip(points, instance.keypoints, strict=True):
                counts[int(state)] += 1
                if state == OUTSIDE:
                    assert (u, v) == (0, 0)
                    continue
                near = np.s_[max(int(v) - 1, 0) : int(v) + 2, max(int(u) - 1, 0) : int(u) + 2]
                seen, pixel = surface[near].reshape(-1, 3), point[2] / camera.fx
                here = seen[:, 2] > 0
                if state == VISIBLE:  # within pixels that lie beside it, on a surface that may be steep
                    agreed.append(np.linalg.norm(seen[here] - point, axis=1).min(initial=np.inf) < 6 * pixel)
                else:
                    agreed.append((seen[here, 2] < point[2] + 2 * pixel).any())
    assert min(counts.values()) > 30, counts
    assert np.mean(agreed) > 0.93  # what is thinner than a pixel may fall between their centres


def test_another_ray_caster_agrees_on_what_is_hidden(labelled, labeller):
    placed = [
        trimesh.Trimesh(t.vertices @ t.world_from_object[:3, :3].T + t.world_from_object[:3, 3], t.faces, process=False)
        for t in labeller.targets
    ]
    scene = trimesh.util.concatenate(placed)
    frame = labelled.train[1]
    checked = wrong = 0
    for instance, body in zip(labeller.instances(frame), labeller.bodies, strict=True):
        pose = instance.target.world_from_object
        world = body.points @ pose[:3, :3].T + pose[:3, 3]
        towards = frame.camera.position - world
        away = towards / np.linalg.norm(towards, axis=1, keepdims=True)
        size = np.ptp(instance.target.vertices, axis=0).max()
        blocked = scene.ray.intersects_any(world + 1e-3 * size * away, away)
        inside = instance.keypoints[:, 2] != OUTSIDE
        checked += inside.sum()
        wrong += (blocked != (instance.keypoints[:, 2] == HIDDEN))[inside].sum()
    assert checked > 30
    assert wrong == 0


def test_masks_and_boxes_are_those_of_the_object_numbers(labelled, labeller):
    for frame in labelled.frames:
        numbers = read_exr(labelled.root / frame.gt_path)["object_id"]
        for instance in labeller.instances(frame):
            np.testing.assert_array_equal(instance.mask, numbers == instance.target.id)
            rows, columns = np.nonzero(instance.mask)
            if len(rows):
                low, high = (columns.min(), rows.min()), (columns.max() + 1, rows.max() + 1)
                assert instance.box == (*low, high[0] - low[0], high[1] - low[1])
    assert [category.name for category in labeller.categories] == ["boxsat", "cubesat"]
    with pytest.raises(InputError, match=r"expected object numbers of .*, found no id_path"):
        labeller.instances(replace(labelled.train[0], id_path=None))


def test_points_behind_the_camera_and_beyond_the_lens_are_outside():
    camera = Camera(np.eye(4), 100, 100, 50.0, 50.0, 50.0, 50.0)
    points = np.array([[0, 0, 1], [0, 0, -1], [0.99, 0, 1], [1.01, 0, 1], [3, 0, 1.0]])
    plain = project(points, Frame("a.png", camera))
    np.testing.assert_array_equal(plain[1], [True, False, True, False, False])
    np.testing.assert_allclose(plain[0][2], [99.5, 50])
    barrel = project(points, Frame("a.png", camera, distortion=(-0.1, 0.0, 0.0, 0.0, 0.0)))
    np.testing.assert_array_equal(barrel[1], [True, False, True, True, False])  # at 3 its model folds back to 0.3
