"""Signed distance against closed forms, against exact winding numbers, and for meshes that are not whole."""

import sys

import numpy as np
import pytest
import trimesh

from spacesim.data.errors import InputError
from spacesim.data.integrity.outputs import SUFFIXES
from spacesim.data.mesh import SignedDistance, _plain_ply, load_mesh, read_mesh, write_mesh, write_points


def queries(count: int = 4000, reach: float = 2.0) -> np.ndarray:
    return np.random.default_rng(0).uniform(-reach, reach, (count, 3))


def of(mesh: trimesh.Trimesh) -> SignedDistance:
    return SignedDistance(mesh.vertices, mesh.faces)


def to_box(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Exact signed distance to the box |x| <= half."""
    beyond = np.abs(points) - half
    return np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)


def test_box_is_exact():
    half = np.array([0.5, 0.8, 1.1])
    points = queries()
    found = of(trimesh.creation.box(2 * half))(points)
    np.testing.assert_allclose(found, to_box(points, half), atol=1e-12)
    assert 100 < (found < 0).sum() < 3900


def test_sphere_and_torus_up_to_their_facets():
    points = queries()
    sphere = trimesh.creation.icosphere(5, 1.0)
    facets = 1 - np.linalg.norm(sphere.triangles_center, axis=1).min()  # how far facets lie below the sphere
    exact = np.linalg.norm(points, axis=1) - 1
    found = of(sphere)(points)
    assert (found - exact >= -1e-9).all()
    assert (found - exact <= 1.01 * facets).all()

    torus = trimesh.creation.torus(1.0, 0.4, major_sections=256, minor_sections=128)
    around = np.hypot(points[:, 0], points[:, 1]) - 1.0
    exact = np.hypot(around, points[:, 2]) - 0.4
    np.testing.assert_allclose(of(torus)(points), exact, atol=5e-4)


def solid_angle_sum(points: np.ndarray, mesh: trimesh.Trimesh) -> np.ndarray:
    """Winding numbers by the exact sum over all faces (van Oosterom & Strackee 1983)."""
    total = np.zeros(len(points))
    for corners in mesh.triangles:
        a, b, c = (corner - points for corner in corners)
        la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
        top = np.einsum("ni,ni->n", a, np.cross(b, c))
        dot_ab, dot_bc, dot_ca = ((x * y).sum(axis=1) for x, y in ((a, b), (b, c), (c, a)))
        total += 2 * np.arctan2(top, la * lb * lc + dot_ab * lc + dot_bc * la + dot_ca * lb)
    return total / (4 * np.pi)


@pytest.mark.parametrize("kind", ["whole", "overlapping", "holed", "inverted", "partly inverted"])
def test_sign_is_that_of_exact_winding_numbers(kind):
    ball, box = trimesh.creation.icosphere(2, 0.9), trimesh.creation.box((1.0, 1.0, 2.6))
    mesh = trimesh.util.concatenate([ball, box]) if "overlapping" in kind else ball
    if kind == "holed":
        mesh = trimesh.Trimesh(ball.vertices, ball.faces[:-30], process=False)
    if kind == "inverted":
        mesh = trimesh.Trimesh(ball.vertices, ball.faces[:, ::-1], process=False)
    if kind == "partly inverted":
        other = trimesh.Trimesh(box.vertices + np.array([0, 3, 0]), box.faces[:, ::-1], process=False)
        mesh = trimesh.util.concatenate([ball, other])
    points = queries(1500)
    winding = np.abs(solid_angle_sum(points, mesh))
    clear = np.abs(winding - 0.5) > 0.02  # the fast sum is good to about 0.01
    found = of(mesh)(points)
    np.testing.assert_array_equal(found[clear] < 0, winding[clear] > 0.5)
    assert clear.mean() > 0.95
    assert (found < 0).sum() > 50


@pytest.mark.parametrize("share", [0.05, 0.3, 0.8])
@pytest.mark.parametrize("apart", [False, True])
def test_faces_that_turn_the_wrong_way_change_nothing(share, apart):
    """As winding numbers alone would. apart: no corners are shared."""
    ball, cavity = trimesh.creation.icosphere(2, 1.5), trimesh.creation.icosphere(2, 0.7)
    hollow = trimesh.util.concatenate([ball, trimesh.Trimesh(cavity.vertices, cavity.faces[:, ::-1], process=False)])
    turned = np.random.default_rng(1).random(len(hollow.faces)) < share
    faces = np.where(turned[:, None], hollow.faces[:, ::-1], hollow.faces)
    places = hollow.vertices
    if apart:
        places, faces = places[faces.ravel()], np.arange(3 * len(faces)).reshape(-1, 3)
    points = queries(1500)
    found = SignedDistance(places, faces).inside(points)
    assert 0.1 < found.mean() < 0.3
    np.testing.assert_array_equal(found, of(hollow).inside(points))


def test_faces_without_area_turn_nothing():
    box = trimesh.creation.box((2, 2, 2))
    faces = np.concatenate([box.faces, [[0, 0, 0], [0, 0, 1], [3, 1, 3]], box.faces[:1], box.faces[:1, ::-1]])
    points = queries(500)
    np.testing.assert_array_equal(SignedDistance(box.vertices, faces).inside(points), np.abs(points).max(axis=1) < 1)


def test_a_mesh_far_from_the_origin_has_the_same_inside():
    ball, far = trimesh.creation.icosphere(subdivisions=3), np.array([1e7, -1e7, 5e6])
    points = np.random.default_rng(0).uniform(-1.2, 1.2, (2000, 3)) + far
    near = SignedDistance(ball.vertices, ball.faces)(points - far)
    np.testing.assert_allclose(SignedDistance(ball.vertices + far, ball.faces)(points), near, atol=1e-7)


def test_nested_and_missing_points():
    distance = of(trimesh.creation.box((1, 1, 1)))
    assert len(distance(np.zeros((0, 3)))) == 0
    found = distance(np.array([[0, 0, 0], [np.nan, 0, 0], [0, np.inf, 0], [2, 0, 0]]))
    np.testing.assert_allclose(found, [-0.5, np.inf, np.inf, 1.5])


def test_a_sheet_has_no_inside():
    sheet = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    points = np.array([[0.5, 0.5, 0.2], [0.5, 0.5, -0.2], [2, 0.5, 0]])
    np.testing.assert_allclose(of(sheet)(points), [0.2, 0.2, 1.0])


def test_files_that_are_no_meshes_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"gone\.ply"):
        read_mesh(tmp_path / "gone.ply")
    (tmp_path / "broken.ply").write_bytes(b"nonsense")
    with pytest.raises(InputError, match=r"broken\.ply"):
        SignedDistance.of(tmp_path / "broken.ply")
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "points.ply")
    with pytest.raises(InputError, match=r"points\.ply"):
        SignedDistance.of(tmp_path / "points.ply")
    with pytest.raises(InputError, match="finite corners"):
        SignedDistance(np.full((3, 3), np.nan), np.array([[0, 1, 2]]))


def test_read_mesh_reads_what_was_written(tmp_path):
    box = trimesh.creation.box((1, 2, 3))
    box.export(tmp_path / "box.ply")
    vertices, faces = read_mesh(tmp_path / "box.ply")
    np.testing.assert_allclose(np.sort(vertices, axis=0), np.sort(box.vertices, axis=0))
    assert faces.shape == (12, 3)


@pytest.mark.parametrize("suffix", SUFFIXES["mesh"])
def test_written_meshes_read_back(tmp_path, suffix):
    mesh = trimesh.creation.box((1, 2, 3)).apply_translation((5, -6, 7))
    path = tmp_path / f"box{suffix}"
    write_mesh(path, np.array(mesh.vertices), np.array(mesh.faces))
    vertices, faces = read_mesh(path)
    if suffix == ".glb":  # y is up there
        vertices = np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], axis=1)
    back = trimesh.Trimesh(vertices, faces)
    assert back.bounds == pytest.approx(mesh.bounds, abs=1e-5)
    assert back.volume == pytest.approx(6, rel=1e-5)  # faces turn as before


def test_a_mesh_of_unknown_kind_is_not_written(tmp_path):
    for name in ("mesh.xyz", "mesh"):
        with pytest.raises(InputError, match=r"expected a file name that ends in .ply"):
            write_mesh(tmp_path / name, np.zeros((3, 3)), np.array([[0, 1, 2]]))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["one place", "one line", "far away", "not finite"])
def test_faces_without_an_area_are_no_mesh(tmp_path, kind):
    """However many: a tracer's tree over twenty thousand faces in one place took 13 GB."""
    vertices = np.random.default_rng(0).normal(size=(300, 3))
    if kind == "one place":
        vertices[:] = 1.25
    elif kind == "one line":
        vertices = vertices[:, :1] * np.array([1.0, 2.0, -4.0])
    else:
        vertices = vertices * (1e30 if kind == "far away" else np.nan)
    faces = np.arange(300).reshape(-1, 3)
    write_mesh(tmp_path / "a.ply", vertices, faces)
    with pytest.raises(InputError, match=r"a\.ply: expected a mesh, found no face with an area and corners within"):
        read_mesh(tmp_path / "a.ply")
    write_mesh(tmp_path / "b.ply", np.concatenate([vertices, np.eye(3)]), np.concatenate([faces, [[300, 301, 302]]]))
    assert len(read_mesh(tmp_path / "b.ply")[1]) == 1


def test_textures_that_a_ply_names_are_not_looked_for(tmp_path, caplog):
    write_mesh(tmp_path / "a.ply", np.eye(3), np.array([[0, 1, 2]]))
    content = (tmp_path / "a.ply").read_bytes()
    named = content.replace(b"element vertex", b"comment TextureFile nope.png\nelement vertex", 1)
    (tmp_path / "a.ply").write_bytes(named)
    assert len(read_mesh(tmp_path / "a.ply")[1]) == 1
    assert caplog.text == ""


def test_headers_that_promise_more_than_there_is(tmp_path):
    write_mesh(tmp_path / "a.ply", np.eye(3), np.array([[0, 1, 2]]))
    content = (tmp_path / "a.ply").read_bytes()
    for number in (b"2", b"4", b"4000000000"):
        (tmp_path / "a.ply").write_bytes(content.replace(b"element vertex 3", b"element vertex " + number))
        with pytest.raises(InputError, match=r"a\.ply: expected a mesh"):
            read_mesh(tmp_path / "a.ply")
    (tmp_path / "a.xyz").write_bytes(content)
    with pytest.raises(
        InputError, match=r"expected a mesh in \.ply, \.obj, \.glb, \.gltf, \.stl, \.off, found '\.xyz'"
    ):
        read_mesh(tmp_path / "a.xyz")


def test_a_file_of_no_points_is_said_to_be_empty(tmp_path):
    lines = ["ply", "format ascii 1.0", "element vertex 0", *(f"property float {axis}" for axis in "xyz"), "end_header"]
    (tmp_path / "a.ply").write_text("\n".join([*lines, ""]))
    with pytest.raises(InputError, match=r"a\.ply: expected a mesh, found a file .* \(there is nothing in it\)"):
        load_mesh(tmp_path / "a.ply")


@pytest.mark.parametrize("kind", ["mesh", "points", "colored points"])
def test_plain_ply_is_read_as_trimesh_reads_it(tmp_path, monkeypatch, kind):
    """And without importing that, which takes longer than all else that small commands do."""
    path, sphere = tmp_path / "a.ply", trimesh.creation.icosphere(2)
    if kind == "mesh":
        write_mesh(path, sphere.vertices, sphere.faces)
    else:
        write_points(path, sphere.vertices, np.random.default_rng(0).integers(0, 256, sphere.vertices.shape, np.uint8))
    if kind == "points":
        head, body = path.read_bytes().split(b"property uchar red")[0], sphere.vertices.astype("<f4").tobytes()
        path.write_bytes(head + b"end_header\n" + body)
    with monkeypatch.context() as patch:
        patch.setattr("spacesim.data.mesh._plain_ply", lambda content: None)
        theirs = load_mesh(path)
    monkeypatch.setitem(sys.modules, "trimesh", None)
    ours = load_mesh(path)
    for name in ("vertices", "faces", "colors"):
        mine, other = getattr(ours, name), getattr(theirs, name)
        assert (mine is None) == (other is None)
        if mine is not None:
            assert mine.dtype == other.dtype
            np.testing.assert_array_equal(mine, other)
    assert (len(ours.vertices), len(ours.faces)) == (162, 320 if kind == "mesh" else 0)


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[:-1],
        lambda data: data + b"\0",
        lambda data: data[:-13] + b"\4" + data[-12:],
        lambda data: data.replace(b"vertex 162", b"vertex 163"),
        lambda data: data.replace(b"face 320", b"face 319"),
    ],
)
def test_plain_ply_that_is_not_whole_is_left_to_trimesh(tmp_path, damage):
    sphere = trimesh.creation.icosphere(2)
    write_mesh(tmp_path / "a.ply", sphere.vertices, sphere.faces)
    content = (tmp_path / "a.ply").read_bytes()
    assert _plain_ply(content) is not None
    assert _plain_ply(damage(content)) is None


def test_faces_of_corners_that_are_not_there_are_left_to_trimesh():
    for corner in (-1, 3):
        data = b"".join(
            [
                b"ply\nformat binary_little_endian 1.0\nelement vertex 3\n",
                b"property float x\nproperty float y\nproperty float z\n",
                b"element face 1\nproperty list uchar int vertex_indices\nend_header\n",
                np.eye(3, dtype="<f4").tobytes(),
                b"\3" + np.array([0, 1, corner], "<i4").tobytes(),
            ]
        )
        assert _plain_ply(data) is None
