"""Materials out of answers: known ones come back; the closed form against another solver; what the field is asked."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear
from splats import random_splats, srgb_of

from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at
from spacesim.data.images.tone import Curve
from spacesim.data.records import Camera
from spacesim.scenes.materials.table import material, material_names
from spacesim.splat.compose import GaussianComposition, PlacedRun, Pose
from spacesim.splat.compose.aligned import AlignedRun
from spacesim.splat.light.config import LightConfig
from spacesim.splat.light.encoding import Encoding
from spacesim.splat.light.field import FieldConfig, SurfaceConfig
from spacesim.splat.light.material import (
    LEAST_METAL,
    MOST_COAT,
    ROUGHNESSES,
    SATURATED,
    FittedMaterial,
    SunAndView,
    _fit_lobes,
    fit_material,
    read_material,
)
from spacesim.splat.light.model import LightModel, TrainingFrame
from spacesim.splat.material import SunlitWhite
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.run import Run

FIELD = FieldConfig(features=4, width=8, layers=2, inputs=SurfaceConfig())
WHITE = np.array([0.5, 0.4, 0.3])  #: linear display value of a sunlit white surface
CAMERA = Camera.from_fov(look_at((0, -4, 0), (0, 0, 0)), 40, 32, 40)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def reflected(sun, view, normal, diffuse, specular, alpha) -> np.ndarray:
    """[3] pi f cos of the model, by its papers' formulas: D of Walter et al. (33), G of Heitz (99), Schlick's F."""
    half = unit(sun + view)
    cosines = [normal @ sun, normal @ view]
    tangents = [1 / c**2 - 1 for c in cosines]
    tilt = 1 / (normal @ half) ** 2 - 1
    facing = alpha**2 / (np.pi * (normal @ half) ** 4 * (alpha**2 + tilt) ** 2)
    masked = 1 / (1 + sum((np.sqrt(1 + alpha**2 * t) - 1) / 2 for t in tangents))
    fresnel = specular + (1 - specular) * (1 - view @ half) ** 5
    lobe = 0 if not np.any(specular) else facing * masked * fresnel / (4 * cosines[0] * cosines[1])
    return (diffuse / np.pi + lobe) * cosines[0] * np.pi


def answers(angles: SunAndView, materials) -> np.ndarray:
    """[K, 3, N]"""
    up = np.array([0.0, 0, 1])
    pairs = zip(angles.suns, angles.views, strict=True)
    return np.array([np.array([reflected(s, v, up, *each) for each in materials]).T for s, v in pairs])


def light_model(field: FieldConfig = FIELD, **options) -> LightModel:
    return LightModel.initial(LightConfig(field, **options), TrainingFrame(np.zeros(3), 1.0, 5.0, 3.0), 0)


def splats(count: int = 30, seed: int = 0) -> dict[str, np.ndarray]:
    arrays = random_splats(count, seed, 0)
    features = np.random.default_rng(seed).normal(size=(count, FIELD.stored))
    return arrays | {"sh": np.zeros((count, 0, 3)), "features": features, "logit_opacities": np.full(count, 3.0)}


@pytest.fixture
def run(tmp_path) -> Run:
    return Run(tmp_path / "run", {"method": "relight"}, {}, Gaussians.from_numpy(splats()), 1000, light_model())


KNOWN = [  # diffuse, specular, alpha
    (np.array([0.1, 0.2, 0.3]), np.full(3, 0.04), 0.2),  # paint with a gloss
    (np.zeros(3), np.array([0.8, 0.45, 0.05]), 0.4),  # gold
    (np.array([0.02, 0.02, 0.1]), np.array([0.08, 0.05, 0.0]), 0.07),  # a solar cell
]


def test_known_materials_come_back():
    angles = SunAndView.spread()
    light = answers(angles, KNOWN)
    found = fit_material(angles, light, np.ones_like(light, bool))
    np.testing.assert_allclose(found.albedo, [KNOWN[0][0], KNOWN[1][1], KNOWN[2][0]], atol=2e-4)
    np.testing.assert_allclose(found.specular, [known[1] for known in KNOWN], atol=2e-4)
    assert found.metallic.tolist() == [0, 1, 0]
    np.testing.assert_allclose(found.roughness, [known[2] for known in KNOWN])


def test_a_roughness_between_those_that_are_tried_gets_a_neighbour():
    angles = SunAndView.spread()
    light = answers(angles, [(np.full(3, 0.3), np.full(3, 0.06), 0.24), (np.zeros(3), np.full(3, 0.6), 0.24)])
    found = fit_material(angles, light, np.ones_like(light, bool))
    assert np.isin(found.roughness, np.float32([0.2, 0.28])).all()
    assert found.metallic.tolist() == [0, 1]
    np.testing.assert_allclose(found.albedo, [[0.3] * 3, [0.6] * 3], rtol=0.1)


def test_a_lambertian_surface_has_no_gloss():
    angles = SunAndView.spread()
    light = answers(angles, [(np.full(3, rho), np.zeros(3), 1.0) for rho in (0.02, 0.5, 0.95)])
    found = fit_material(angles, light, np.ones_like(light, bool))
    np.testing.assert_allclose(found.albedo, np.tile([[0.02], [0.5], [0.95]], 3), rtol=1e-6)
    assert not found.metallic.any()
    assert not found.specular.any()
    assert (found.roughness == 1).all()


def test_a_dark_sheen_is_no_metal():
    """Facets alone that reflect a tenth: less than any metal of the table, so paint, whatever else fits better."""
    table = [material(name) for name in material_names()]
    metals = [row.albedo for row in table if row.bsdf["type"] == "roughconductor"]
    assert len(metals) >= 3
    assert min(max(albedo) for albedo in metals) >= LEAST_METAL
    angles = SunAndView.spread()
    light = answers(
        angles, [(np.zeros(3), np.full(3, 0.1), 0.4), (np.zeros(3), np.array([LEAST_METAL, 0.1, 0.1]), 0.4)]
    )
    found = fit_material(angles, light, np.ones_like(light, bool))
    assert found.metallic.tolist() == [0, 1]
    assert 0 < found.albedo[0].max() < 0.1


def test_what_is_saturated_says_nothing():
    """A glint cut off: its flanks tell."""
    angles = SunAndView.spread()
    light = answers(angles, KNOWN[1:2])
    clipped = np.minimum(light, 0.5)
    assert (clipped < light).any()
    np.testing.assert_allclose(fit_material(angles, clipped, clipped == light).albedo, [KNOWN[1][1]], atol=1e-3)
    assert fit_material(angles, clipped, np.ones_like(light, bool)).albedo[0, 0] < 0.7


@pytest.mark.parametrize("most", [1.0, MOST_COAT])
def test_the_closed_form_is_the_bounded_minimum(most):
    """Of any numbers, also where reflectances reach their bounds."""
    rng = np.random.default_rng(1)
    lambert, facets = rng.uniform(0.2, 1, 9), rng.uniform(0, 3, 9)
    mixed = np.outer(rng.uniform(0, 1, 20), lambert) + np.outer(rng.uniform(0, 2 * most, 20), facets)
    light = np.concatenate([rng.normal(0, 2, (40, 9)), mixed + rng.normal(0, 0.1 * most, (20, 9))])
    weights = rng.uniform(0, 2, light.shape)
    errors, diffuse, specular = _fit_lobes(light, weights, lambert, facets, most)
    reached = set()
    for row in range(len(light)):
        root = np.sqrt(weights[row])
        best = lsq_linear(
            root[:, None] * np.stack([lambert, facets], axis=1), root * light[row], ([0, 0], [np.inf, most]), tol=1e-14
        )
        np.testing.assert_allclose([diffuse[row], specular[row]], best.x, atol=1e-5)
        assert errors[row] == pytest.approx(2 * best.cost, rel=1e-6, abs=1e-6)
        reached.add((diffuse[row] > 0, specular[row] > 0, specular[row] < most))
    assert len(reached) >= 5
    alone = _fit_lobes(light, weights, np.zeros(9), facets, most)  # a metal
    assert not alone[1].any()
    for row in range(len(light)):
        root = np.sqrt(weights[row])
        best = lsq_linear((root * facets)[:, None], root * light[row], (0, most), tol=1e-14)
        assert alone[2][row] == pytest.approx(best.x[0], abs=1e-5)
        assert alone[0][row] == pytest.approx(2 * best.cost, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("linear", [False, True])
def test_the_field_is_asked_about_its_normals(monkeypatch, linear):
    """A field that answers as a known material does about whatever normals its Gaussians have."""

    def answer(self, gaussians, camera, sun, sunlight=None, embedding=None):
        assert sunlight.visibility is None
        assert sunlight.bounced == []
        normals = unit(gaussians.to_numpy()["features"][:, 4:7].astype(float))
        view = -np.array(camera.directions_to(gaussians.means)).T[0].astype(float)
        light = np.array([WHITE * reflected(sun, view, normal, *KNOWN[0]) for normal in normals])
        shown = np.minimum(light, 1) if linear else srgb_of(np.minimum(light, 1))
        return [upload(column) for column in shown.T], None

    monkeypatch.setattr(LightModel, "shade_picture", answer)
    model = light_model(linear=linear)
    found = read_material(Gaussians.from_numpy(splats(5)), model, WHITE, "srgb")
    np.testing.assert_allclose(found.albedo, np.tile(KNOWN[0][0], (5, 1)), atol=2e-3)
    assert not found.metallic.any()
    np.testing.assert_allclose(found.roughness, 0.2)
    assert 0.2 in ROUGHNESSES
    assert 0 < SATURATED < 1


def test_materials_do_not_depend_on_where_normals_point(run):
    turned = run.gaussians.to_numpy()
    turned["features"][:, 4:7] = np.random.default_rng(8).normal(size=(30, 3))
    other = read_material(Gaussians.from_numpy(turned), run.light, np.ones(3), "srgb")
    for name in ("albedo", "metallic", "roughness", "specular"):
        assert np.array_equal(getattr(run.material, name), getattr(other, name))
    assert np.ptp(other.albedo) > 0
    assert run.albedo_is_relative


def test_a_picture_of_one_material_shows_it_wherever_there_is_something(run):
    albedo = np.tile(np.float32([0.5, 0.4, 0.3]), (30, 1))
    run.__dict__["material"] = FittedMaterial(
        albedo, np.ones(30, np.float32), np.full(30, 0.25, np.float32), albedo / 2
    )
    view = run.draw_material(CAMERA)
    seen = view.alpha > 0
    assert seen.any()
    assert not seen.all()
    np.testing.assert_allclose(view.albedo[seen], np.tile([0.5, 0.4, 0.3], (seen.sum(), 1)), atol=1e-5)
    np.testing.assert_allclose(view.specular[seen], view.albedo[seen] / 2, atol=1e-5)
    np.testing.assert_allclose(view.metallic[seen], 1, atol=1e-5)
    np.testing.assert_allclose(view.roughness[seen], 0.25, atol=1e-5)
    assert not view.albedo[~seen].any()
    np.testing.assert_allclose(np.linalg.norm(view.normal[seen], axis=-1), 1, atol=1e-4)
    rendering = run.render(CAMERA, sun=(0, 0))
    assert np.array_equal(rendering.albedo, view.albedo)
    assert np.array_equal(rendering.specular, view.specular)
    assert np.array_equal(rendering.roughness, view.roughness)
    assert np.array_equal(rendering.metallic, view.metallic)


def test_learned_normals_are_those_of_the_side_that_is_seen(tmp_path):
    one = splats(1) | {"means": np.zeros((1, 3)), "log_scales": np.full((1, 3), -1.0)}
    one["features"] = np.array([[0, 0, 0, 0, 0, 3.0, 4.0]])  # away from the camera at -y
    alone = Run(tmp_path / "run", {"method": "relight"}, {}, Gaussians.from_numpy(one), 1000, light_model())
    view = alone.draw_material(CAMERA)
    np.testing.assert_allclose(view.normal[view.alpha > 0.5], [[0, -0.6, -0.8]] * (view.alpha > 0.5).sum(), atol=1e-5)


def test_a_composed_scene_shows_what_each_of_its_models_is_made_of(run, tmp_path):
    alone = run.draw_material(CAMERA)
    scene = GaussianComposition([PlacedRun(run, name="here")])
    assert np.array_equal(scene.draw_material(CAMERA).albedo, alone.albedo)
    half_turn = Pose(rotation=np.diag([-1.0, -1.0, 1.0]))
    turned = GaussianComposition([PlacedRun(run, half_turn)])
    behind = Camera.from_fov(look_at((0, 4, 0), (0, 0, 0)), 40, 32, 40)
    view = turned.draw_material(behind)
    np.testing.assert_allclose(view.albedo, alone.albedo, atol=2e-3)
    np.testing.assert_allclose(view.normal @ half_turn.rotation, alone.normal, atol=2e-3)
    vanilla = Run(tmp_path / "plain", {"method": "vanilla"}, {}, Gaussians.from_numpy(random_splats(20)), 1000)
    with pytest.raises(InputError, match=r"plain: expected a run .*, found one of vanilla, which has no light"):
        GaussianComposition([PlacedRun(run), PlacedRun(vanilla, Pose(translation=[3, 0, 0]))]).draw_material(CAMERA)


def test_a_moved_run_shows_the_same_materials_and_turns_their_normals(run):
    quarter = Pose(
        rotation=np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), translation=np.array([1.0, 2, 3]), scale=2.0
    )
    aligned = AlignedRun(run, quarter)
    pose = np.eye(4)
    pose[:3, :3] = quarter.rotation @ CAMERA.world_from_camera[:3, :3]
    pose[:3, 3] = quarter.points(CAMERA.position[None])[0]
    seen, alone = aligned.draw_material(replace(CAMERA, world_from_camera=pose)), run.draw_material(CAMERA)
    np.testing.assert_allclose(seen.albedo, alone.albedo, atol=1e-3)
    np.testing.assert_allclose(seen.normal, alone.normal @ quarter.rotation.T, atol=1e-3)


def test_runs_without_materials_say_why(tmp_path):
    directions = FieldConfig(features=7, width=8, layers=2)
    both = FieldConfig(features=4, width=8, layers=2, inputs=SurfaceConfig(view=Encoding("harmonics", 2)))
    for field in (directions, both):
        model = Gaussians.from_numpy(splats())
        taught = Run(tmp_path / "run", {"method": "park"}, {}, model, 1000, light_model(field))
        assert not taught.has_material
        with pytest.raises(InputError, match=r"light.field.inputs=surface.*one of park, whose light takes directions"):
            taught.render(CAMERA, sun=(0, 0)).save(tmp_path / "a.png", "albedo")


def test_a_sunlit_white_surface_is_that_of_the_data(tmp_path):
    unknown = SunlitWhite.of(tmp_path, None)
    assert (unknown.is_known, unknown.tone) == (False, "srgb")
    np.testing.assert_allclose(unknown.display, 1)
    scene = {"sun_irradiance": [340.25, 680.5, 1361], "exposure": 0.001, "config": {"camera": {"tone": "filmic"}}}
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    known = SunlitWhite.of(tmp_path, None)
    assert (known.is_known, known.tone) == (True, "filmic")
    np.testing.assert_allclose(known.display, np.array([340.25, 680.5, 1361]) * 0.001 / np.pi)
    linear = SunlitWhite.of(tmp_path, Curve("srgb", 1.0, 1.0))  # which was trained at +1 EV
    np.testing.assert_allclose(linear.display, [0.5, 1, 2])
    for broken in ({"exposure": 0.001}, {**scene, "sun_irradiance": [1, 2]}, []):
        (tmp_path / "scene.json").write_text(json.dumps(broken))
        assert not SunlitWhite.of(tmp_path, None).is_known
