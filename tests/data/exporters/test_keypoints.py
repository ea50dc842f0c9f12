"""Corners of meshes and symmetries, against shapes whose corners and symmetries are known."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.distance import cdist, pdist

from spacesim.data.errors import InputError
from spacesim.data.exporters.keypoints import NAME, body_labels, find_keypoints, write_body_labels
from spacesim.data.exporters.objects import labelled_objects
from spacesim.data.exporters.symmetries import find_symmetries
from spacesim.data.store import read_dataset
from spacesim.scenes.spacecraft import spacecraft


def subdivided(mesh: trimesh.Trimesh, times: int = 3) -> trimesh.Trimesh:
    for _ in range(times):
        mesh = mesh.subdivide()
    return mesh


def matched(found: np.ndarray, expected: np.ndarray) -> bool:
    """The same points in any order."""
    distances = cdist(found, expected)
    return len(found) == len(expected) and distances.min(axis=0).max() < 1e-9 and distances.min(axis=1).max() < 1e-9


def test_corners_of_a_box_are_found_among_many_vertices():
    box = subdivided(trimesh.creation.box((1, 2, 3)))
    corners = trimesh.creation.box((1, 2, 3)).vertices
    found = find_keypoints(box.vertices, box.faces, 10)
    assert cdist(corners, found).min(axis=1).max() < 1e-9
    assert matched(find_keypoints(corners, trimesh.creation.box((1, 2, 3)).faces, 11), corners)  # there are no more


def test_the_order_of_vertices_and_faces_does_not_matter_nor_do_copies():
    mesh = trimesh.util.concatenate([part.mesh for part in spacecraft("cubesat").parts])
    rng = np.random.default_rng(1)
    order = rng.permutation(len(mesh.vertices))
    place = np.argsort(order)
    found = find_keypoints(mesh.vertices, mesh.faces)
    again = find_keypoints(mesh.vertices[order], rng.permutation(place[mesh.faces]))
    np.testing.assert_array_equal(found, again)
    soup = mesh.vertices[mesh.faces].reshape(-1, 3)
    np.testing.assert_array_equal(found, find_keypoints(soup, np.arange(len(soup)).reshape(-1, 3)))


def test_what_lies_within_is_no_keypoint():
    inner = trimesh.creation.box((0.5, 0.5, 0.5))
    both = trimesh.util.concatenate([trimesh.creation.box((1, 1, 1)), inner])
    found = find_keypoints(both.vertices, both.faces, 20)
    assert matched(found, trimesh.creation.box((1, 1, 1)).vertices)


def test_a_sheet_and_a_ball_have_keypoints_too():
    sheet = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0], [1, 0.5, 0]])
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    assert matched(find_keypoints(sheet, faces, 4), sheet[:4])
    ball = trimesh.creation.icosphere(4)
    found = find_keypoints(ball.vertices, ball.faces, 12)
    assert len(found) == 12
    assert pdist(found).min() > 0.7  # of 12 points spread evenly, an icosahedron, 1.05


@pytest.mark.parametrize(
    ("mesh", "discrete", "continuous"),
    [
        (trimesh.creation.box((1, 1, 1)), 23, 0),
        (trimesh.creation.box((1, 1, 2)), 7, 0),
        (trimesh.creation.box((1, 2, 3)), 3, 0),
        (trimesh.creation.cylinder(1, 3, sections=64), 1, 1),
        (trimesh.creation.cone(1, 3, sections=64), 0, 1),
        ("boxsat", 0, 0),
    ],
)
def test_symmetries(mesh, discrete, continuous):
    if isinstance(mesh, str):
        mesh = trimesh.util.concatenate([part.mesh for part in spacecraft(mesh).parts])
    mesh = mesh.copy()
    mesh.apply_translation([3, 0, 1])
    matrices, axes = find_symmetries(mesh.vertices, mesh.faces)
    assert (len(matrices), len(axes)) == (discrete, continuous)
    for matrix in matrices:
        pose = np.reshape(matrix, (4, 4))
        turned = mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
        assert np.linalg.norm(trimesh.proximity.closest_point(mesh, turned)[1]) < 0.05
    for axis in axes:
        assert abs(axis.axis[2]) == pytest.approx(1)
        np.testing.assert_allclose(axis.offset[:2], [3, 0], atol=1e-9)


def test_keypoints_are_found_given_and_kept_beside_the_mesh(labelled, tmp_path):
    targets = labelled_objects(labelled)
    found = body_labels(labelled, targets)
    assert [len(body.keypoints) for body in found] == [11, 11, 11]
    assert found[0].is_like(found[2])  # of one shape
    assert not found[0].is_like(found[1])
    assert [len(body.keypoints) for body in body_labels(labelled, targets, 5)] == [5, 5, 5]
    root = Path(shutil.copytree(labelled.root, tmp_path / "data"))
    given = {"id": 2, "keypoints": {"tip": [0, 0, 1], "foot": [0, 0, -1.0]}}
    (root / NAME).write_text(json.dumps({"objects": [given]}))
    beside = body_labels(read_dataset(root), targets)
    assert beside[0].is_like(found[0])
    assert list(beside[1].keypoints) == ["tip", "foot"]
    assert [len(body.keypoints) for body in body_labels(read_dataset(root), targets, 5)] == [5, 5, 5]
    write_body_labels(tmp_path / "again.json", beside)
    assert body_labels(labelled, targets, tmp_path / "again.json") == beside


@pytest.mark.parametrize(
    ("objects", "sentence"),
    [
        ([{"id": 9, "keypoints": {"a": [0, 0, 0]}}], "expected objects of .*, found 9"),
        ([{"id": 1, "keypoints": {}}], "keypoints: expected 1 to 1000, found 0"),
        ([{"id": 1, "keypoints": {"a": [0, 0]}}], "expected a list of 3 numbers"),
        ([{"id": 1, "keypoints": {"a": [0, 0, 1e300]}}], "expected points within 1e"),
        ([{"id": 1, "keypoint": {}}], "expected one of id, keypoints"),
        (
            [{"id": 1, "keypoints": {"a": [0, 0, 0]}}, {"id": 3, "keypoints": {"a": [0, 0, 1]}}],
            "expected the same of objects of one shape, found others of object 3",
        ),
        (
            [{"id": 1, "keypoints": {"a": [0, 0, 0]}, "symmetries_discrete": [[1.0] * 16]}],
            "symmetries_discrete: expected rigid",
        ),
    ],
)
def test_files_that_cannot_be_are_refused_in_a_sentence(labelled, tmp_path, objects, sentence):
    path = tmp_path / "given.json"
    path.write_text(json.dumps({"objects": objects}))
    with pytest.raises(InputError, match=sentence):
        body_labels(labelled, labelled_objects(labelled), path)


def test_keypoints_in_another_unit_are_warned_of(labelled, tmp_path, caplog):
    """In millimetres, say. A place beside the body is none."""
    path, targets = tmp_path / "given.json", labelled_objects(labelled)
    beside = {"id": 1, "keypoints": {"tip": [0, 0, 1], "beside": [0, 0, 4.0]}}
    path.write_text(json.dumps({"objects": [beside]}))
    body_labels(labelled, targets, path)
    assert caplog.messages == []
    path.write_text(json.dumps({"objects": [{"id": 1, "keypoints": {"tip": [0, 0, 1], "far": [0, -1000, 500]}}]}))
    assert body_labels(labelled, targets, path)[0].points[1].tolist() == [0, -1000, 500]
    (warning,) = caplog.messages
    assert warning.startswith(f"{path}: keypoint far is 99")
    assert warning.endswith(" m large; keypoints are in metres")


def test_impossible_meshes_and_counts():
    box = trimesh.creation.box()
    for count in (0, 1001):
        with pytest.raises(InputError, match=f"keypoints: expected 1 to 1000, found {count}"):
            find_keypoints(box.vertices, box.faces, count)
    with pytest.raises(InputError, match="expected a mesh with an area, found none"):
        find_keypoints(np.zeros((3, 3)), np.array([[0, 1, 2]]))
