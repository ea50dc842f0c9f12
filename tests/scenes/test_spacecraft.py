"""What is built in: closed parts, real dimensions, the same bytes every time."""

import re

import numpy as np
import pytest
import trimesh
from trimesh.ray.ray_triangle import RayMeshIntersector

from spacesim.data.errors import InputError
from spacesim.scenes.build import build
from spacesim.scenes.materials.table import SOLAR_CELL, material
from spacesim.scenes.scene import Scene, SceneObject, box_projection
from spacesim.scenes.scenefile import read_scene
from spacesim.scenes.spacecraft import SPACECRAFT, boxsat, spacecraft
from spacesim.scenes.spacecraft.catalogue import _make
from spacesim.scenes.spacecraft.cubesat import SIZE
from spacesim.scenes.spacecraft.small_body import DIAMETER, crater_profile, noise, power_law

MAX_PARTS, MAX_FACES = 120, 120_000


def _mesh(name, *parts):
    """The named parts as one mesh; all of them where none is named."""
    return trimesh.util.concatenate([part.mesh for part in spacecraft(name).parts if not parts or part.name in parts])


def _part(name, part):
    return next(item.mesh for item in spacecraft(name).parts if item.name == part)


def _size(mesh):
    return np.ptp(mesh.bounds, axis=0)


@pytest.mark.parametrize("name", SPACECRAFT)
def test_parts_are_closed_and_face_outward(name):
    for part in spacecraft(name).parts:
        mesh = part.mesh
        assert mesh.is_watertight, part.name
        assert mesh.is_winding_consistent, part.name
        assert mesh.area_faces.min() > 0, part.name
        labels = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
        a, b, c = np.moveaxis(mesh.triangles - mesh.bounds[0], 1, 0)
        volumes = np.bincount(labels, weights=np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0)
        assert volumes.min() > 0, part.name


@pytest.mark.parametrize("name", SPACECRAFT)
def test_counts_and_names(name):
    craft = spacecraft(name)
    names = [part.name for part in craft.parts]
    assert craft.name == name
    assert len(set(names)) == len(names) <= MAX_PARTS
    assert all(re.fullmatch(r"[a-z][a-z0-9_]*", item) for item in names)
    assert len(_mesh(name).faces) <= MAX_FACES


@pytest.mark.parametrize("name", SPACECRAFT)
def test_same_bytes_every_time(name):
    again = _make.__wrapped__(name)  # made anew
    for first, second in zip(spacecraft(name).parts, again.parts, strict=True):
        assert first.mesh.vertices.tobytes() == second.mesh.vertices.tobytes()
        assert first.mesh.faces.tobytes() == second.mesh.faces.tobytes()


@pytest.mark.parametrize("name", SPACECRAFT)
def test_materials_name_their_source_and_reflect_less_than_they_get(name):
    surfaces = {part.material.name: part.material for part in spacecraft(name).parts}
    for key, surface in surfaces.items():
        assert surface.source
        assert all(0 <= channel < 1 for channel in surface.albedo)
        if key == "coarse-regolith":
            assert (surface.source, surface.albedo) == (material("regolith").source, material("regolith").albedo)
            assert 30 < surface.tile < 0.5 * DIAMETER, "neither as fine as a pixel nor as large as the body"
        elif key not in ("foam-insulation", "handrail-yellow"):
            assert surface is material(key), "a preset of the table"


def test_all_fit_into_one_scene():
    scene = Scene("all", tuple(SceneObject(spacecraft(name)) for name in SPACECRAFT))
    assert len(scene.parts) <= 255


def test_pair_is_two_boxsats_three_metres_apart_on_each_axis():
    scene = build(read_scene("boxsat-pair"))
    count = len(spacecraft("boxsat").parts)
    first, second = (scene.parts[i * count].mesh.vertices for i in (0, 1))
    np.testing.assert_allclose(second - first, np.full_like(first, -3.0), atol=1e-12)
    assert [placed.part_id for placed in scene.parts] == list(range(1, 2 * count + 1))
    assert {placed.object_id for placed in scene.parts} == {1, 2}


@pytest.mark.parametrize("name", SPACECRAFT)
def test_bounding_sphere_holds_all_and_is_nearly_smallest(name):
    scene = Scene(name, (SceneObject(spacecraft(name)),))
    centre, radius = scene.bounding_sphere
    distances = np.linalg.norm(scene.mesh.vertices - centre, axis=1)
    assert distances.max() == pytest.approx(radius)
    low, high = scene.mesh.bounds
    assert radius >= 0.5 * (high - low).max()
    if name == "boxsat":  # the exact search takes long on large meshes
        assert radius <= 1.01 * trimesh.nsphere.minimum_nsphere(scene.mesh)[1]


def test_unknown_name_lists_the_known_ones():
    with pytest.raises(InputError, match=r"upper-stage, small-body, found 'bixsat'; did you mean boxsat\?$"):
        spacecraft("bixsat")


def test_boxsat_is_as_large_as_a_small_satellite():
    x, y, z = _size(_mesh("boxsat"))
    assert 4.0 < y < 5.0
    assert y > max(x, z)


def test_boxsats_barrel_is_hollow_and_light_passes_between_the_struts():
    caster = RayMeshIntersector(_mesh("boxsat"))
    rim = max(part.mesh.bounds[1][0] for part in boxsat().parts if part.name == "camera_barrel")
    into_barrel, _, _ = caster.intersects_location([[3.0, 0.05, -0.1]], [[-1.0, 0.0, 0.0]], multiple_hits=False)
    assert rim - into_barrel[0][0] > 0.3
    turn = trimesh.transformations.rotation_matrix(np.radians(25.0), [0, 1, 0])[:3, :3]
    between, towards = turn @ [0.0, 0.9, 3.0], turn @ [0.0, 0.0, -1.0]
    assert not caster.intersects_any([between], [towards])[0]
    on_strut = turn @ [0.33, 0.9, 3.0]
    assert caster.intersects_any([on_strut], [towards])[0]


def test_telescope_has_hubbles_dimensions():
    tube = _mesh("telescope", "light_shield", "forward_shell", "equipment_section", "aft_shroud")
    assert _size(tube)[0] == pytest.approx(13.2, abs=0.01)
    assert _size(_mesh("telescope", "aft_shroud", "shroud_bands"))[1:] == pytest.approx([4.2, 4.2], abs=0.01)
    assert _size(_part("telescope", "light_shield")) == pytest.approx([4.0, 3.1, 3.1], abs=0.01)
    assert _size(_part("telescope", "aft_shroud"))[0] == pytest.approx(3.5, abs=0.01)
    assert _size(_part("telescope", "primary_mirror"))[1:] == pytest.approx([2.4, 2.4], abs=0.01)
    assert _size(_part("telescope", "secondary_mirror"))[1:] == pytest.approx([0.3, 0.3], abs=0.01)
    for side in ("left", "right"):
        array = _part("telescope", f"array_frames_{side}").bounding_box_oriented.primitive.extents
        assert sorted(array)[1:] == pytest.approx([2.6, 7.1], abs=0.01)


def test_telescopes_door_is_open_by_105_degrees():
    door = _part("telescope", "door")
    thin = np.linalg.eigh(np.cov(door.vertices.T))[1][:, 0]  # across the plate
    outward = thin * np.sign(thin[2])  # closed, it faced +x; the hinge on +z turns that towards +z and on to -x
    assert np.degrees(np.arccos(outward[0])) == pytest.approx(105.0, abs=0.1)
    assert door.bounds[0][0] > 6.6, "in front of the tube"


def test_starlight_reaches_the_telescopes_primary_mirror():
    """Parallel rays down the tube land on the mirror, but for those that the secondary's hub stops."""
    craft = _mesh("telescope")
    sizes = [len(part.mesh.faces) for part in spacecraft("telescope").parts]
    owner = np.repeat([part.name for part in spacecraft("telescope").parts], sizes)
    y = np.array([0.6, 0.9, -0.6, -0.9, 0.0, 0.0, 0.0])
    z = np.array([0.0, 0.0, 0.0, 0.0, -0.6, -0.9, -0.2])
    origins = np.stack([np.full(7, 9.9), y, z], axis=-1)
    faces = RayMeshIntersector(craft).intersects_first(origins, np.tile([-1.0, 0, 0], (7, 1)))
    assert list(owner[faces]) == ["primary_mirror"] * 6 + ["secondary_hub"]


def test_cubesat_has_the_size_of_the_standard_and_whole_cells():
    assert _size(_mesh("cubesat", "rails")) == pytest.approx([0.366, 0.2263, 0.1])
    assert _size(_mesh("cubesat", "structure", "end_frames")) == pytest.approx(SIZE, abs=0.01)
    for side in ("left", "right"):
        for board in _part("cubesat", f"wing_cells_{side}").split():
            assert (board.bounds[:, 0] / SOLAR_CELL[0]) % 1.0 == pytest.approx([0, 0], abs=1e-9)
            rows = board.bounds[:, 1] / SOLAR_CELL[1]
            assert rows == pytest.approx(np.round(rows), abs=1e-9)


def test_upper_stage_has_the_dimensions_of_an_h2a_second_stage():
    assert _size(_mesh("upper-stage"))[0] == pytest.approx(11.0)
    assert _size(_part("upper-stage", "hydrogen_tank"))[1:] == pytest.approx([4.0, 4.0], abs=0.07)
    assert _size(_part("upper-stage", "front_skirt"))[1:] == pytest.approx([4.0, 4.0])
    assert _size(_part("upper-stage", "adapter_ring"))[1:] == pytest.approx([1.194, 1.194])
    engine = _mesh("upper-stage", "nozzle", "chamber")
    assert _size(engine)[0] == pytest.approx(2.79, abs=0.01)


def test_upper_stages_tanks_do_not_meet():
    hydrogen, oxygen = _part("upper-stage", "hydrogen_tank"), _part("upper-stage", "oxygen_tank")
    assert hydrogen.bounds[0][0] >= oxygen.bounds[1][0]


def test_small_body_has_its_volume_and_centre():
    surface = _part("small-body", "surface")
    assert surface.volume == pytest.approx(np.pi / 6.0 * 500.0**3, rel=1e-6)
    np.testing.assert_allclose(surface.center_mass, 0.0, atol=0.1)
    x, y, z = _size(surface)
    assert x > y > z
    assert 40_000 <= len(surface.faces) <= 90_000


def test_small_bodys_surface_hides_nothing_from_its_centre():
    """Each direction has one height: no facet is folded over."""
    surface = _part("small-body", "surface")
    assert np.einsum("ij,ij->i", surface.face_normals, surface.triangles_center).min() > 0


def test_boulders_lie_on_the_small_body():
    surface, boulders = _part("small-body", "surface"), _part("small-body", "boulders")
    rocks = boulders.split()
    tree = trimesh.proximity.ProximityQuery(surface)
    for rock in rocks[::20]:
        heights = -tree.signed_distance(rock.vertices)
        assert heights.min() < 0 < heights.max()


def test_crater_is_as_deep_as_pikes():
    distance = np.linspace(0.0, 3.0, 3001)
    height = crater_profile(distance)
    assert height.max() - height[0] == pytest.approx(0.196, abs=0.01)
    assert distance[height.argmax()] == pytest.approx(1.0, abs=0.05)
    assert height[-1] < 0.05 * height.max()


def test_power_law_has_its_slope_and_limits():
    sizes = power_law(np.random.default_rng(0), 200_000, (2.0, 50.0), 2.5)
    assert sizes.min() >= 2.0
    assert sizes.max() <= 50.0
    larger = [(sizes > limit).mean() + 50.0**-2.5 / (2.0**-2.5 - 50.0**-2.5) for limit in (3.0, 6.0)]
    assert np.log(larger[0] / larger[1]) / np.log(2.0) == pytest.approx(2.5, abs=0.03)


def test_noise_has_its_amplitude():
    points = np.random.default_rng(1).uniform(-50.0, 50.0, (20_000, 3))
    field = noise(points, np.random.default_rng(2), octaves=1, lowest=3.0, amplitude=0.2)
    assert field.std() == pytest.approx(0.2, rel=0.05)
    assert field.mean() == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("name", ["telescope", "cubesat", "upper-stage"])
def test_no_two_parts_share_a_surface(name):
    """Where faces of two parts lay in one plane and looked the same way, the part that a ray meets, and with it
    the truth, would be a matter of rounding."""
    parts = spacecraft(name).parts
    owner = np.repeat(np.arange(len(parts)), [len(part.mesh.faces) for part in parts])
    triangles = np.concatenate([part.mesh.triangles for part in parts])
    normals = np.concatenate([part.mesh.face_normals for part in parts])
    scale = np.ptp(triangles.reshape(-1, 3), axis=0).max()
    planes = np.round(np.c_[200 * normals, np.einsum("ij,ij->i", triangles[:, 0], normals) / (2e-6 * scale)])
    _, plane = np.unique(planes, axis=0, return_inverse=True)
    shared = set()
    for faces in np.split(np.argsort(plane.ravel(), kind="stable"), np.cumsum(np.bincount(plane.ravel()))[:-1]):
        if len(np.unique(owner[faces])) > 1:
            flat = np.delete(triangles[faces], np.abs(normals[faces[0]]).argmax(), axis=2)
            for i, j in zip(*np.triu_indices(len(faces), 1), strict=True):
                a, b = owner[faces[i]], owner[faces[j]]
                if a != b and _overlap(flat[i], flat[j], 1e-5 * scale):
                    shared.add((parts[a].name, parts[b].name))
    assert shared == set()


def _overlap(first, second, margin):
    """Whether two triangles [3, 2] overlap by more than `margin`: no side of either separates them."""
    for corners in (first, second):
        side = np.roll(corners, -1, axis=0) - corners
        across = np.stack([-side[:, 1], side[:, 0]]) / np.maximum(np.linalg.norm(side, axis=1), 1e-12)
        a, b = first @ across, second @ across
        if (np.minimum(a.max(0), b.max(0)) - np.maximum(a.min(0), b.min(0)) <= margin).any():
            return False
    return True


@pytest.mark.parametrize("name", ["boxsat", "telescope", "cubesat"])
def test_panels_begin_and_end_at_the_border_of_a_cell(name):
    """Every broad face of cells, laid flat, spans whole cells of the pattern, up to 10 % stretched."""
    found = 0
    for part in spacecraft(name).parts:
        if part.material.name != "solar-cell":
            continue
        flat = box_projection(part.mesh) if part.flat is None else part.flat
        broad = part.mesh.area_faces > 0.2 * part.mesh.area_faces.max()
        corners = flat.reshape(-1, 3, 2)[broad]
        cells = corners / SOLAR_CELL
        np.testing.assert_allclose(cells, np.round(cells), atol=1e-6)
        drawn = 0.5 * np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))
        np.testing.assert_allclose(drawn, part.mesh.area_faces[broad], rtol=0.1)
        found += len(corners)
    assert found >= 16
