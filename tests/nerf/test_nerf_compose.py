"""Algorithm 1: exact where fields are constant in intervals; scenes of runs; scene files."""

import json
from dataclasses import replace

import drjit as dr
import nerf_twin as twin
import numpy as np
import pytest
from small_field import CONFIG
from tiny import pair_scene

from spacesim.backend import ad
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at
from spacesim.data.images import read_png
from spacesim.data.records import Camera
from spacesim.methods import load_scene
from spacesim.nerf.compose import FieldComposition
from spacesim.nerf.draw import RaySamples
from spacesim.nerf.fields.model import Networks
from spacesim.nerf.partition import merge, partition
from spacesim.nerf.run import NerfRun
from spacesim.nerf.sampling.render import sum_rays, volume_weights
from spacesim.splat.compose.pose import Pose, rotation_about
from spacesim.splat.compose.scene import ComposeConfig, PlacedRun

RED, GREEN, BLUE = np.eye(3)


def samples_of(edges: np.ndarray, density: np.ndarray, color: np.ndarray) -> tuple[RaySamples, int]:
    """Of edges [R, S + 1], densities [R, S] and colours [R, S, 3]."""
    planes = [upload(color[..., i]) for i in range(3)]
    return RaySamples(upload(edges[:, :-1]), upload(edges[:, 1:]), upload(density), planes), density.shape[1]


def render_merged(models: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(colours [R, 3], opacities [R], expected depths [R]) of models' (edges, densities, colours)."""
    rays = len(models[0][0])
    merged, segments = merge([samples_of(*model) for model in models], rays)
    made = volume_weights(merged.density * (merged.high - merged.low), segments)
    color = [np.array(sum_rays(made.weights * channel, segments)) for channel in merged.color]
    depth = sum_rays(made.weights * 0.5 * (merged.low + merged.high), segments)
    return np.stack(color, axis=-1), np.array(sum_rays(made.weights, segments)), np.array(depth)


def slab(low: float, high: float, density: float, color: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One ray through one slab, in three intervals."""
    edges = np.linspace(low, high, 4)[None]
    return edges, np.full((1, 3), density), np.broadcast_to(color, (1, 3, 3))


def passed(length: float, density: float) -> float:
    return float(np.exp(-length * density))


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_slabs_that_overlap_abut_coincide_and_lie_apart(order):
    """Against closed forms: where both are, what is seen there has the mean colour by density."""
    cases = {}
    # apart: the nearer one hides the other
    front, back = slab(1, 2, 0.7, RED), slab(3, 5, 2.0, BLUE)
    cases["apart"] = front, back, (1 - passed(1, 0.7)) * RED + passed(1, 0.7) * (1 - passed(2, 2.0)) * BLUE
    front, back = slab(1, 2, 0.7, RED), slab(2, 4, 0.3, BLUE)
    cases["abut"] = front, back, (1 - passed(1, 0.7)) * RED + passed(1, 0.7) * (1 - passed(2, 0.3)) * BLUE
    one, other = slab(1, 2.5, 0.5, RED), slab(1, 2.5, 1.5, BLUE)
    cases["coincide"] = one, other, (1 - passed(1.5, 2.0)) * (0.25 * RED + 0.75 * BLUE)
    one, other = slab(1, 3, 0.5, RED), slab(2, 4, 1.0, GREEN)
    expected = (1 - passed(1, 0.5)) * RED
    expected = expected + passed(1, 0.5) * (1 - passed(1, 1.5)) * (RED / 3 + 2 * GREEN / 3)
    expected = expected + passed(1, 0.5) * passed(1, 1.5) * (1 - passed(1, 1.0)) * GREEN
    cases["overlap"] = one, other, expected
    one, other = slab(1, 4, 0.2, RED), slab(2, 3, 5.0, BLUE)
    expected = (1 - passed(1, 0.2)) * RED + passed(1, 0.2) * (1 - passed(1, 5.2)) * (0.2 * RED + 5 * BLUE) / 5.2
    cases["within"] = one, other, expected + passed(1, 0.2) * passed(1, 5.2) * (1 - passed(1, 0.2)) * RED
    for name, (first, second, color) in cases.items():
        found, opacity, _ = render_merged([(first, second)[i] for i in order])
        np.testing.assert_allclose(found[0], color, atol=1e-6, err_msg=name)
        np.testing.assert_allclose(opacity[0], color.sum(), atol=1e-6, err_msg=name)


def test_merging_is_its_twin():
    """Random intervals of three models, of which some are empty, some without length, some shared."""
    rng, rays = np.random.default_rng(0), 60
    models = []
    for count in (7, 3, 12):
        edges = np.sort(rng.integers(0, 20, (rays, count + 1)) / 4.0, axis=1)
        density = rng.exponential(1, (rays, count)) * (rng.uniform(size=(rays, count)) > 0.3)
        models.append((edges, density, rng.uniform(size=(rays, count, 3))))
    color, opacity, depth = render_merged(models)
    for ray in range(rays):
        rows = [(edges[ray, :-1], edges[ray, 1:], density[ray], c[ray]) for edges, density, c in models]
        boundaries, density, mixed = twin.merge(rows)
        weights, seen, accumulated = twin.volume(density * np.diff(boundaries), mixed)
        np.testing.assert_allclose(color[ray], seen, atol=2e-6)
        np.testing.assert_allclose(opacity[ray], accumulated, atol=2e-6)
        np.testing.assert_allclose(depth[ray], weights @ (0.5 * (boundaries[1:] + boundaries[:-1])), atol=2e-5)


def test_merging_one_model_changes_nothing():
    rng = np.random.default_rng(1)
    edges, density = np.sort(rng.uniform(size=(9, 6)), axis=1), rng.exponential(3, (9, 5))
    color = rng.uniform(size=(9, 5, 3))
    found, opacity, _ = render_merged([(edges, density, color)])
    alone = volume_weights(upload(density * np.diff(edges)), 5)
    np.testing.assert_allclose(opacity, np.array(sum_rays(alone.weights, 5)), atol=1e-6)
    red = np.array(sum_rays(alone.weights * upload(color[..., 0]), 5))
    np.testing.assert_allclose(found[:, 0], red, atol=1e-6)


def test_an_empty_ray_is_black():
    color, opacity, _ = render_merged([slab(1, 1, 5.0, RED), slab(2, 2, 1.0, BLUE)])
    assert not color.any()
    assert not opacity.any()


def scene(*models: tuple[NerfRun, Pose], shadows: str = "none") -> FieldComposition:
    placed = [PlacedRun(run, pose, f"model-{i}") for i, (run, pose) in enumerate(models)]  # type: ignore[arg-type]
    return FieldComposition(placed, ComposeConfig(shadows))


def camera_at(place, towards=(0, 0, 0), size=36) -> Camera:
    return Camera.from_fov(look_at(place, towards), size, size, 45)


def test_one_model_is_its_run(dataset, finished):
    camera = dataset.test[0].camera
    one, alone = scene((finished, Pose())).predict(camera, normals=True), finished.predict(camera, normals=True)
    for plane in ("rgb", "alpha", "depth"):
        np.testing.assert_allclose(getattr(one, plane), getattr(alone, plane), atol=3e-4 * (1 + 9 * (plane == "depth")))
    solid = alone.alpha > 0.5
    assert np.einsum("nc,nc->n", one.normal[solid], alone.normal[solid]).min() > 0.99
    np.testing.assert_array_equal(one.id, solid)


@pytest.mark.parametrize(("aside", "away"), [(0.0, 12), (0.001, 12), (0.3, 12), (0.3, 3000)])
def test_boundaries_of_models_that_stand_in_each_other_rise(finished, aside, away):
    """As drawn, where boundaries are middles and half lengths, rounded: two of one rank would leave one unset."""
    composed = scene((finished, Pose()), (finished, Pose(translation=np.array([aside, 0.0, 0.0]))))
    camera = camera_at((away, away / 5, away / 3), size=32)
    fields, pixel = composed.placed(camera, None), dr.arange(ad.UInt32, 1024)
    merged = partition(fields, pixel, dr.opaque(ad.UInt32, 32), 1024, False).merged
    low, high = (np.array(values).reshape(1024, -1) for values in (merged.low, merged.high))
    assert np.isfinite(low).all()
    assert (high >= low).all()
    np.testing.assert_array_equal(low[:, 1:], high[:, :-1])


def test_a_larger_model_is_not_more_opaque(finished):
    """Twice as large, turned and moved, seen from twice as far: the same picture, depths twice as large."""
    camera, alone = camera_at((9, 2, 4)), finished.predict(camera_at((9, 2, 4)))
    turn = rotation_about((1, 2, 3), 70)
    pose = Pose(turn, np.array([3.0, -20.0, 8.0]), 2.0)
    place = np.eye(4)
    place[:3, :3] = turn @ camera.world_from_camera[:3, :3]
    place[:3, 3] = pose.points(camera.position)
    seen = scene((finished, pose)).predict(replace(camera, world_from_camera=place))
    assert 0.02 < alone.alpha.mean() < 0.9
    np.testing.assert_allclose(seen.alpha, alone.alpha, atol=5e-3)
    np.testing.assert_allclose(seen.rgb, alone.rgb, atol=5e-3)
    solid = alone.alpha > 0.5
    np.testing.assert_allclose(seen.depth[solid], 2 * alone.depth[solid], rtol=5e-3)


def test_the_nearer_model_hides_the_other(finished):
    camera = camera_at((14, 0, 0.5))
    front, back = Pose(translation=np.array([4.0, 0, 0])), Pose(translation=np.array([-4.0, 0, 0]))
    both, other = (
        scene(*models).predict(camera) for models in (((finished, front), (finished, back)), ((finished, front),))
    )
    behind = scene((finished, back)).predict(camera)
    opaque = (other.alpha > 0.97) & (behind.alpha > 0.5)
    assert opaque.any()
    np.testing.assert_allclose(both.rgb[opaque], other.rgb[opaque], atol=0.04)
    assert (both.id[opaque] == 1).all()
    clear = other.alpha < 1e-3
    np.testing.assert_allclose(both.rgb[clear], behind.rgb[clear], atol=5e-3)
    np.testing.assert_allclose(both.alpha, 1 - (1 - other.alpha) * (1 - behind.alpha), atol=5e-3)  # they lie apart
    swapped = scene((finished, back), (finished, front)).predict(camera)
    np.testing.assert_allclose(swapped.rgb, both.rgb, atol=1e-5)
    assert (swapped.id[opaque] == 2).all()


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_memory_of_a_picture_is_bounded_by_the_smallest_chunk_and_the_largest_model(finished, monkeypatch, order):
    config = finished.networks.config
    large = replace(finished, networks=Networks(replace(config, samples=256, chunk=512)))
    runs = [finished, large]
    composed = scene(*((runs[number], Pose(translation=(4.0 * number, 0, 0))) for number in order))
    assert composed.chunk == 512
    asked = []
    monkeypatch.setattr("spacesim.nerf.draw.check_free_memory", lambda needed, what: asked.append((needed, what)))
    composed.crossing(composed.placed(camera_at((0, -20, 0)), None), camera_at((0, -20, 0)))
    needed = 512 * (large.networks.config.ray_bytes // 2 + 300 * (config.samples + 256))
    assert asked == [(needed, "chunk: a picture by 512 rays at once")]


def test_scene_files(spacesim, finished, tmp_path):
    text = pair_scene(finished.path, finished.path)
    (tmp_path / "scene.toml").write_text(text)
    assert isinstance(load_scene(tmp_path / "scene.toml").composition, FieldComposition)
    done = spacesim("compose", tmp_path / "scene.toml", "--out", tmp_path / "out")
    assert done.code == 0, done.errors
    assert set(np.unique(read_png(tmp_path / "out/id/0000.png"))) == {0, 1, 2}
    shot = json.loads((tmp_path / "out/shots/0000.json").read_text())
    assert [model["name"] for model in shot["models"]] == ["one", "other"]
    assert (tmp_path / "out/visibility/0000.png").exists()
    refused = {
        'shadows = "some"\n' + text: "shadows: expected one of",
        text.replace("[sun]\nazimuth_deg = 0\nelevation_deg = 10", ""): "expected the Sun's direction",
    }
    for number, (content, words) in enumerate(refused.items()):
        path = tmp_path / f"refused_{number}.toml"
        path.write_text(content)
        done = spacesim("compose", path, "--out", tmp_path / "none")
        assert done.code == 2
        assert words in done.errors[0]
    done = spacesim("compose", tmp_path / "scene.toml", "--out", tmp_path / "none", "--ply", tmp_path / "none.ply")
    assert (done.code, "expected a scene of Gaussians" in done.errors[0]) == (2, True)
    with pytest.raises(InputError, match="exposure"):
        load_scene(tmp_path / "scene.toml").composition.predict(camera_at((9, 0, 0)), exposure=1.0)
    assert dr.width(finished.filled) == CONFIG.occupancy**3
