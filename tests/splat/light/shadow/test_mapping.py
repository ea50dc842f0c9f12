"""Shadow mapping: hand-placed blockers, the float64 reference, walls under every Sun, hostile input, repeatability."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from splats import random_splats
from walls import BIASES, SHIPPED, acne, plate, plate_occlusion, screen_shadow, way

from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.geometry import fibonacci_sphere, look_at, quaternion_from_rotation
from spacesim.splat.light.shadow import mapping
from spacesim.splat.light.shadow.light_camera import fit_camera, light_rows
from spacesim.splat.light.shadow.mapping import MappingConfig, occlusion_by_mapping
from spacesim.splat.raster.cameras import Orthographic, OrthographicCamera
from spacesim.splat.raster.gaussians import Gaussians
from spacesim.splat.reference.shadow_mapping import camera_record, reference_bias, reference_occlusion

CONFIGS = {
    "bilinear": MappingConfig(),
    "closer": MappingConfig("percentage-closer", radius=1.3),
    "variance": MappingConfig("variance", radius=1.0),
    "median": MappingConfig("median"),
    "dilated": MappingConfig(antialiased=False),
}
SOFTNESS = 1e-3


def splats(means, scales, opacities=0.99, quaternions=(1, 0, 0, 0)):
    means = np.atleast_2d(np.asarray(means, dtype=float))
    count = len(means)
    opacities = np.broadcast_to(np.asarray(opacities, dtype=float), count)
    return {
        "means": means,
        "log_scales": np.log(np.broadcast_to(np.asarray(scales, dtype=float), (count, 3))),
        "quaternions": np.broadcast_to(np.asarray(quaternions, dtype=float), (count, 4)).copy(),
        "logit_opacities": np.log(opacities / (1 - opacities)),
        "sh": np.zeros((count, 1, 3)),
    }


def joined(*sets):
    return {name: np.concatenate([one[name] for one in sets]) for name in sets[0]}


def from_above(size=64, metres=2.0):
    """A light camera for a Sun overhead, centred on the origin."""
    pose = look_at([0, 0, 0], [0, 0, -1])
    return Orthographic.of(OrthographicCamera.from_extent(pose, size, size, metres))


def occlusion(arrays, camera, bias=None, softness=SOFTNESS, config=None):
    bias = np.zeros(len(arrays["means"])) if bias is None else bias
    found = occlusion_by_mapping(Gaussians.from_numpy(arrays), camera, upload(bias), softness, config)
    return np.array(found)


@pytest.mark.parametrize("name", CONFIGS)
@pytest.mark.parametrize("sun", [[0.3, -0.5, 0.8], [0, 0, -1]], ids=str)
def test_equals_the_twin(name, sun):
    """Softness as wide as gaps are: no test may flip by rounding."""
    arrays = random_splats(80, seed=1)
    camera = fit_camera(Gaussians.from_numpy(arrays), light_rows(sun), 32)
    bias = 0.1 * reference_bias(arrays, np.asarray(sun) / np.linalg.norm(sun))["bias"]
    found = occlusion(arrays, camera, bias, 0.05, CONFIGS[name])
    expected = reference_occlusion(arrays, camera_record(camera), bias, 0.05, CONFIGS[name])
    assert found == pytest.approx(expected, abs=2e-4)
    assert 0.1 < expected.mean() < 0.9


@pytest.mark.parametrize("name", CONFIGS)
def test_full_and_none(name):
    """A plate of 0.3 m half a metre above one of two receivers."""
    arrays = joined(splats([[-0.6, 0, 0.5]], [0.3, 0.3, 0.001]), splats([[-0.6, 0, 0], [0.6, 0, 0]], 0.02))
    plate, shadowed, lit = occlusion(arrays, from_above(), [0.01] * 3, config=CONFIGS[name])
    assert shadowed > 0.97
    assert lit < 0.01
    assert plate < 0.01


@pytest.mark.parametrize("gap", [-0.002, -0.0005, 0.0, 0.0005, 0.002])
def test_softness_by_hand(gap):
    """Below a wide opaque plate at z = 0.4, D is its depth but for the receiver's own share of the pixel's light."""
    arrays = joined(splats([[0, 0, 0.4]], [5, 5, 0.001], 0.999), splats([[0, 0, 0]], 0.01, 0.006))
    found = occlusion(arrays, from_above(), [0, 0.4 + gap], softness=1e-3, config=CONFIGS["dilated"])
    behind = 0.4 * 0.001 * 0.006 / 0.999  # metres: the receiver's own share, 0.001 of the light passes the plate
    assert found[1] == pytest.approx(1 / (1 + np.exp((gap + behind) / 1e-3)), abs=2e-3)


def test_half_of_the_window_half_dark():
    """The edge of a row of opaque discs through the middle of a window that is wide against the edge's blur."""
    row = splats([[x, y, 0.5] for x in np.arange(0.02, 0.9, 0.02) for y in np.arange(-0.9, 0.9, 0.02)], 0.01, 0.999)
    places = np.linspace(-0.3, 0.3, 25)
    arrays = joined(row, splats([[x, 0, 0] for x in places], 0.001, 0.01))
    config = MappingConfig("percentage-closer", radius=6, antialiased=False)
    found = occlusion(arrays, from_above(128, 2.0), [0.02] * len(arrays["means"]), config=config)[-25:]
    assert np.all(np.diff(found) > -1e-3)
    half = np.interp(0.5, found, places)
    assert half == pytest.approx(0, abs=2 / 64)  # within two pixels of the edge at x = 0
    ramp = np.interp(0.9, found, places) - np.interp(0.1, found, places)
    assert ramp == pytest.approx(0.8 * 12 / 64, abs=2 / 64)  # a box of 12 pixels climbs by 0.8 over 0.8 of its width


def test_two_half_transparent_blockers():
    """The depth test knows one depth: behind both it is dark. Filters weight it with what they cover, 1 - (1 - a)^2.
    The receiver is as wide so faint that its own share of a pixel does not count."""
    blockers = splats([[0, 0, 0.6], [0, 0, 0.3]], [5, 5, 0.001], 0.5)
    arrays = joined(blockers, splats([[0, 0, 0]], 0.001, 0.004))
    expected = {"bilinear": 1, "closer": 0.75}
    for name, value in expected.items():
        found = occlusion(arrays, from_above(), [0.01] * 3, config=CONFIGS[name])
        assert found[2] == pytest.approx(value, abs=0.003), name
        assert found[0] < 0.01
    # Chebyshev: mean and variance of depths 0.6 and 0.3 with weights 2/3 and 1/3, and the receiver's 0.001
    found = occlusion(arrays, from_above(), [0.01] * 3, config=dataclasses.replace(CONFIGS["variance"], bleeding=0.0))
    behind, variance = 0.5 - 0.01, 0.02
    assert found[2] == pytest.approx(0.75 * behind**2 / (variance + behind**2), abs=0.01)


@pytest.mark.parametrize("antialiased", [False, True])
def test_blockers_smaller_than_a_pixel_blend(antialiased):
    """One of a tenth of a pixel darkens its pixel as its dilated splat covers it, or, anti-aliased, by the area that it
    has of that, and no more."""
    pixel, width = 2 / 64, 0.3
    kept = width**2 / (width**2 + 1 / 12) if antialiased else 1
    arrays = joined(
        splats([[pixel / 2, pixel / 2, 0.5]], width * pixel, 0.9), splats([[pixel / 2, pixel / 2, 0]], 1e-4, 0.004)
    )
    config = MappingConfig("percentage-closer", radius=0.5, antialiased=antialiased)
    found = occlusion(arrays, from_above(), [0.01, 0.01], config=config)
    assert found[1] == pytest.approx(0.9 * kept, abs=0.01)
    arrays["means"][1, 0] += 4 * pixel
    assert occlusion(arrays, from_above(), [0.01, 0.01])[1] < 1e-3


@pytest.mark.parametrize("name", CONFIGS)
def test_order_does_not_matter(name):
    arrays = random_splats(300, seed=2)
    camera = fit_camera(Gaussians.from_numpy(arrays), light_rows([1, 2, 2]), 48)
    found = occlusion(arrays, camera, config=CONFIGS[name])
    order = np.random.default_rng(0).permutation(300)
    shuffled = occlusion({key: values[order] for key, values in arrays.items()}, camera, config=CONFIGS[name])
    assert shuffled == pytest.approx(found[order], abs=1e-5)


@pytest.mark.parametrize("name", CONFIGS)
def test_the_same_to_the_bit(name):
    arrays = random_splats(3000, seed=3)
    sets = [Gaussians.from_numpy(arrays) for _ in range(2)]
    results = []
    for gaussians in (*sets, sets[0]):
        camera = fit_camera(gaussians, light_rows([1, -2, 0.5]), 100)
        found = occlusion_by_mapping(gaussians, camera, upload(np.full(3000, 0.01)), 1e-5, CONFIGS[name])
        results.append(np.array(found))
    assert np.array_equal(results[0], results[1])
    assert np.array_equal(results[0], results[2])


@pytest.mark.parametrize("name", CONFIGS)
def test_turns_and_moves_with_the_scene(name):
    """Scene, Sun and light camera turned and moved together."""
    arrays, sun = random_splats(200, seed=4), np.array([0.36, 0.48, 0.8])
    turn, shift = Rotation.from_rotvec([0.3, -1.2, 2.0]), np.array([3.0, -2.0, 5.0])
    axes = Rotation.from_quat(arrays["quaternions"][:, [1, 2, 3, 0]]).as_matrix()
    moved = {
        **arrays,
        "means": turn.apply(arrays["means"]) + shift,
        "quaternions": np.array([quaternion_from_rotation(turn.as_matrix() @ R) for R in axes]),
    }
    record = camera_record(fit_camera(Gaussians.from_numpy(arrays), light_rows(sun), 48))
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn.as_matrix(), shift
    cameras = record, dataclasses.replace(record, world_from_camera=motion @ record.world_from_camera)
    suns = sun, turn.apply(sun)
    found = [
        occlusion(one, Orthographic.of(camera), 0.3 * reference_bias(one, s)["bias"], 0.02, CONFIGS[name])
        for one, camera, s in zip((arrays, moved), cameras, suns, strict=True)
    ]
    assert found[1] == pytest.approx(found[0], abs=2e-3)
    # the fitted camera's own frame rolls about the Sun's direction: other pixels, the same shadows
    fitted = fit_camera(Gaussians.from_numpy(moved), light_rows(suns[1]), 48)
    rolled = occlusion(moved, fitted, 0.3 * reference_bias(moved, suns[1])["bias"], 0.02, CONFIGS[name])
    assert np.abs(rolled - found[0]).mean() < 0.05


@pytest.mark.parametrize("distance", [20.0, 1000.0])
def test_two_models_far_apart_are_as_each_alone(distance):
    arrays = random_splats(200, seed=5), random_splats(150, seed=6)
    arrays[1]["means"] += [distance, 0, 0]
    for own in (0, 1):
        light = light_rows([0.2, 0.5, 0.8])
        camera = fit_camera(Gaussians.from_numpy(arrays[own]), light, 48)
        alone = occlusion(arrays[own], camera, softness=0.01)
        both = occlusion(joined(*arrays), camera, softness=0.01)
        parts = np.split(both, [200])
        assert parts[own] == pytest.approx(alone, abs=1e-5)
        assert np.all(parts[1 - own] == 0)
        assert alone.max() > 0.9


@pytest.mark.parametrize("name", CONFIGS)
@pytest.mark.parametrize("sun", [*np.eye(3), *-np.eye(3), *fibonacci_sphere(5)], ids=lambda s: str(np.round(s, 2)))
def test_sides_of_a_box_under_every_sun(sun, name):
    """Sides that face the Sun by more than 25 degrees are lit, those that face away are dark, and nothing is odd."""
    count, normals, corners = 500, [], []
    rng, parts = np.random.default_rng(7), []
    for axis in range(3):
        for side in (-1.0, 1.0):
            normal = side * np.eye(3)[axis]
            along, across = 2 * np.eye(3)[(axis + 1) % 3], 2 * np.eye(3)[(axis + 2) % 3]
            places = normal - 0.5 * along - 0.5 * across + rng.uniform(size=(count, 2)) @ np.stack([along, across])
            flat = np.full(3, 0.07)
            flat[axis] = 0.002
            parts.append(splats(places, flat))
            normals += [normal] * count
            corners.append(np.abs(places - normal).max(axis=1) > 0.75)
    arrays, cosine, inner = joined(*parts), np.array(normals) @ sun, ~np.concatenate(corners)
    camera = fit_camera(Gaussians.from_numpy(arrays), light_rows(sun), 64)
    found = occlusion(arrays, camera, reference_bias(arrays, sun)["bias"], 1e-5, CONFIGS[name])
    assert np.all((found >= 0) & (found <= 1))
    assert (found[inner & (cosine > 0.42)] > 0.5).mean() < 0.02
    assert (found[inner & (cosine < -0.42)] < 0.5).mean() < 0.02


@pytest.mark.parametrize("name", CONFIGS)
def test_hostile_gaussians_get_none_and_spoil_nothing(name):
    arrays, good = random_splats(60, seed=8), random_splats(60, seed=8)
    arrays["means"][0] = np.nan
    arrays["means"][1, 1] = np.inf
    arrays["log_scales"][2] = np.nan
    arrays["log_scales"][3] = 50
    arrays["quaternions"][4] = 0
    arrays["logit_opacities"][5] = np.nan
    arrays["means"][6] = 1e12
    bias = np.full(60, 0.01)
    camera = fit_camera(Gaussians.from_numpy(arrays), light_rows([0, 1, 1]), 32)
    found = occlusion(arrays, camera, bias, config=CONFIGS[name])
    alone = occlusion({key: values[7:] for key, values in good.items()}, camera, bias[7:], config=CONFIGS[name])
    assert np.all(found[:7] == 0)
    assert found[7:] == pytest.approx(alone, abs=1e-5)
    strange = occlusion(good, camera, np.where(np.arange(60) % 2, np.nan, np.inf), config=CONFIGS[name])
    assert np.all((strange >= 0) & (strange <= 1))


@pytest.mark.parametrize(("name", "most"), [("median", 0.96), ("bilinear", 0.99)])
def test_models_of_any_size(name, most, monkeypatch):
    """Few recordings serve them all, and say what is computed without them."""
    counts, suns = (700, 90, 2100, 700, 1), ([0.3, -0.5, 0.8], [0, 0, -1])

    def found():
        return [
            occlusion(arrays, fit_camera(Gaussians.from_numpy(arrays), light_rows(sun), 32), config=CONFIGS[name])
            for arrays in (random_splats(count, seed=count) for count in counts)
            for sun in suns
        ]

    recorded = found()
    monkeypatch.setattr(mapping, "occlusion_in_map", mapping.occlusion_in_map.traced)
    for one, other in zip(recorded, found(), strict=True):
        np.testing.assert_array_equal(one, other)
    assert 0.05 < recorded[0].mean() < most


@pytest.mark.parametrize("softness", [1e-30, 1e-6, 1e6])
def test_any_softness_is_finite(softness):
    arrays = random_splats(50, seed=9)
    found = occlusion(arrays, from_above(), softness=softness)
    assert np.all((found >= 0) & (found <= 1))


def test_one_none_and_invisible():
    one = splats([[0, 0, 0]], 0.1)
    camera = fit_camera(Gaussians.from_numpy(one), light_rows([0, 0, 1]), 16)
    assert occlusion(one, camera)[0] == pytest.approx(0.5)  # it is its own reference
    assert occlusion(one, camera, [0.01])[0] < 1e-4
    assert len(occlusion({key: values[:0] for key, values in one.items()}, camera)) == 0
    for name in ("bilinear", "median"):
        assert occlusion(splats([[0, 0, 0]], 0.1, 0.001), camera, config=CONFIGS[name])[0] == 0
        assert occlusion(splats([[50, 0, 0]], 0.1), camera, config=CONFIGS[name])[0] == 0


@pytest.mark.parametrize("elevation", [30, 60, 90])
def test_bias_clears_a_wall_and_keeps_its_shadow(elevation):
    assert share(elevation, "none") > 0.5
    assert share(elevation, "thesis") < 0.02
    if elevation < 90:
        foot, _ = screen_shadow(elevation, way("thesis"), 3000)
        assert foot < 4 * 0.031  # standard deviations of a disc


@pytest.mark.parametrize(("elevation", "most"), [(10, 0.05), (5, 0.2)])
def test_grazing_suns(elevation, most):
    """Where the thesis's bias leaves a wall dark, offset points clear it, and a real shadow stays."""
    assert share(elevation, "thesis") > 0.4
    assert share(elevation, "lift") < most
    assert share(elevation, "grazing bias") < 0.85 * share(elevation, "thesis")
    foot, _ = screen_shadow(elevation, way("lift"), 3000)
    assert foot < 3 * 0.031


def share(elevation: float, name: str) -> float:
    """Of a wall of 3,000 discs, what is dark."""
    return acne(elevation, way(name), 3000)[1]


@pytest.mark.parametrize("shipped", ["fast", "fine"])
@pytest.mark.parametrize("method", SHIPPED)
@pytest.mark.parametrize(
    ("elevation", "most"), [(90, 0.001), (60, 0.001), (30, 0.001), (15, 0.005), (10, 0.01), (5, 0.1)]
)
def test_a_wall_as_shipped(shipped, method, elevation, most):
    """With the shadows of the presets a wall is lit under every Sun, and keeps the shadow of what stands on it. At 5
    degrees the plate's own bumps, of 1.2 mm and 3.4 degrees, have shadows."""
    config = way(shipped, method)
    assert acne(elevation, config, 20_000)[1] < most
    if elevation < 90:
        foot, tip = screen_shadow(elevation, config, 20_000)
        assert foot < 0.04  # a little over three standard deviations of a disc
        assert not tip > 0.03


def test_a_face_along_the_light_stays_finite():
    for config in (*map(way, BIASES), *(way("fine", method) for method in SHIPPED)):
        found = plate_occlusion(plate(500), 0.0, dataclasses.replace(config, size=64))
        assert np.all((found >= 0) & (found <= 1))


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"filter": "soft"}, "filter: expected one of bilinear, percentage-closer, variance, median, found 'soft'"),
        ({"radius": 0.2}, "radius: expected 0.5 to 16 pixels, found 0.2"),
        ({"radius": 99}, "radius: expected 0.5 to 16 pixels, found 99"),
        ({"bleeding": 1.0}, "bleeding: expected a share from 0 to below 1, found 1.0"),
    ],
)
def test_wrong_configurations_are_one_sentence(wrong, sentence):
    with pytest.raises(InputError, match=sentence):
        MappingConfig(**wrong)


def test_no_softness_is_refused():
    with pytest.raises(ValueError, match="softness: expected a positive number of metres, found 0"):
        occlusion(splats([[0, 0, 0]], 0.1), from_above(), softness=0)
