import numpy as np
import pytest
import trimesh
from trimesh.ray.ray_triangle import RayMeshIntersector

from spacesim.data.errors import InputError
from spacesim.scenes import boxsat, built_in_scene, shapes

PARTS = boxsat().parts


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.name)
def test_parts_are_closed_and_face_outward(part):
    assert part.mesh.is_watertight
    assert part.mesh.is_winding_consistent
    assert all(body.volume > 0 for body in part.mesh.split(only_watertight=False))
    assert part.mesh.area_faces.min() > 0


def test_names_are_unique_and_ids_fit_a_byte():
    scene = built_in_scene("boxsat-pair")
    assert len({part.name for part in PARTS}) == len(PARTS)
    assert [placed.part_id for placed in scene.parts] == list(range(1, 2 * len(PARTS) + 1))
    assert {placed.object_id for placed in scene.parts} == {1, 2}
    assert len(scene.parts) < 256


def test_size_is_that_of_a_small_satellite():
    low, high = built_in_scene("boxsat").mesh.bounds
    assert 4.0 < high[1] - low[1] < 5.0
    assert (high - low).max() == high[1] - low[1]


def test_pair_is_two_boxsats_three_metres_apart_on_each_axis():
    scene = built_in_scene("boxsat-pair")
    first, second = (scene.parts[i * len(PARTS)].mesh.vertices for i in (0, 1))
    np.testing.assert_allclose(second - first, np.full_like(first, -3.0), atol=1e-12)


def test_barrel_is_hollow_and_light_passes_between_the_struts():
    caster = RayMeshIntersector(built_in_scene("boxsat").mesh)
    rim = max(part.mesh.bounds[1][0] for part in PARTS if part.name == "camera_barrel")
    into_barrel, _, _ = caster.intersects_location([[3.0, 0.05, -0.1]], [[-1.0, 0.0, 0.0]], multiple_hits=False)
    assert rim - into_barrel[0][0] > 0.3
    turn = trimesh.transformations.rotation_matrix(np.radians(25.0), [0, 1, 0])[:3, :3]
    between, towards = turn @ [0.0, 0.9, 3.0], turn @ [0.0, 0.0, -1.0]
    assert not caster.intersects_any([between], [towards])[0]
    on_strut = turn @ [0.33, 0.9, 3.0]
    assert caster.intersects_any([on_strut], [towards])[0]


def test_bounding_sphere_holds_all_and_is_nearly_smallest():
    scene = built_in_scene("boxsat")
    centre, radius = scene.bounding_sphere
    distances = np.linalg.norm(scene.mesh.vertices - centre, axis=1)
    assert distances.max() == pytest.approx(radius)
    assert radius <= 1.01 * trimesh.nsphere.minimum_nsphere(scene.mesh)[1]


def test_materials_name_their_source_and_reflect_less_than_they_get():
    for part in PARTS:
        assert part.material.source
        assert all(0 < channel <= 1 for channel in part.material.albedo)
        assert part.material.bsdf.get("alpha", 1.0) >= 0.1, "a mirror never meets a directional Sun"


def test_revolved_square_has_the_volume_of_pappus():
    tube = shapes.tube([0, 0, 0], [0, 0, 2], inner=1.0, outer=1.5, segments=2000)
    assert tube.is_watertight
    assert tube.volume == pytest.approx(np.pi * (1.5**2 - 1.0) * 2, rel=1e-4)
    rod = shapes.rod([1, 2, 3], [2, 4, 5], radius=0.5, segments=2000)
    assert rod.volume == pytest.approx(np.pi * 0.25 * 3, rel=1e-4)
    np.testing.assert_allclose(rod.center_mass, [1.5, 3, 4], atol=1e-9)


def test_unknown_scene_lists_the_known_ones():
    with pytest.raises(InputError, match="boxsat, boxsat-pair, found 'bixsat'"):
        built_in_scene("bixsat")
