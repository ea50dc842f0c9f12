"""What is drawn behind objects: geometry of the limb and the terminator by hand, stars by their law, bits, masks."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny import call, contents

from spacesim import backend
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.geometry import fibonacci_sphere, look_at
from spacesim.data.images import load_image, read_exr, read_png
from spacesim.data.images.tone import as_bytes, display_values
from spacesim.data.records import Camera, Sun
from spacesim.data.store import find_unreadable_files, load_truth, read_dataset
from spacesim.scenes.background import globe as globe_module
from spacesim.scenes.background.config import BackgroundConfig
from spacesim.scenes.background.draw import Background
from spacesim.scenes.background.globe import Globe, Placement, albedo
from spacesim.scenes.background.stars import FAINTEST, Stars, stars_brighter_than
from spacesim.scenes.build import build
from spacesim.scenes.cameras.kernel_camera import Units
from spacesim.scenes.cameras.sensor import SensorConfig
from spacesim.scenes.generation.generate import generate
from spacesim.scenes.lights.earth import EarthConfig
from spacesim.scenes.scenefile import read_scene, scene_text
from spacesim.scenes.steps import completed

SMALL = {"views": 4, "test_views": 2, "resolution": (24, 20), "spp": 4, "points": 50}
BOTH = BackgroundConfig(star_gain=1e5)
SUNLIGHT = np.full(3, 1361.0)


def boxsat(**changes):
    return read_scene("boxsat", **{**SMALL, **changes})


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("background") / "data"
    generate(boxsat(background=BOTH), root)
    return root


@pytest.fixture(scope="module")
def globe() -> Globe:
    backend.mitsuba()
    return Globe(Units(np.zeros(3), 1.0), (), SUNLIGHT, seed=5)


def camera_towards(direction, size: int = 200, fov: float = 40.0) -> Camera:
    return Camera.from_fov(look_at(np.zeros(3), np.asarray(direction, float)), size, size, fov)


def rays(camera: Camera) -> np.ndarray:
    """[H, W, 3] unit, world frame, through the pixels' centres."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    local = np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], axis=-1)
    directions = local @ camera.world_from_camera[:3, :3].T
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def test_pictures_are_opaque_and_truth_is_of_the_object_alone(made, tmp_path):
    assert find_unreadable_files(made) == []
    generate(boxsat(), tmp_path / "plain")
    with_it, without = read_dataset(made), read_dataset(tmp_path / "plain")
    for frame, alone in zip(with_it.frames, without.frames, strict=True):
        picture = read_png(made / frame.file_path)
        assert picture.shape == (20, 24, 3)
        for kind in ("silhouette", "shadow", "id", "depth"):
            name = f"{kind}/{Path(frame.file_path).name}"
            assert (made / name).read_bytes() == (tmp_path / "plain" / name).read_bytes()
        layers, plain = (read_exr(data.root / f.gt_path) for data, f in ((with_it, frame), (without, alone)))
        behind = layers.pop("radiance_background")
        assert layers.keys() == plain.keys()
        for name, layer in plain.items():
            np.testing.assert_array_equal(layers[name], layer)
        assert behind.max() > 0
        light = layers["radiance"] + (1 - layers["alpha"])[..., None] * behind  # mixed before the tone curve
        np.testing.assert_array_equal(picture, as_bytes(display_values(with_it.scene["exposure"] * light, "srgb")))
        np.testing.assert_array_equal(load_truth(with_it, frame).radiance_background, behind)


def test_training_sees_the_object_cut_out(made):
    data = read_dataset(made)
    for frame in data.frames:
        silhouette = read_png(made / frame.silhouette_path) > 0
        np.testing.assert_array_equal(load_image(data, frame).alpha > 0, silhouette)
        assert 0 < silhouette.mean() < 1


def test_without_a_background_nothing_changes():
    scene = boxsat()
    assert "background" not in scene.to_json()
    assert "max_phase_deg" not in scene.to_json()["rig"]
    assert boxsat(background="earth").to_json()["background"]["stars"] is False


def test_a_scene_file_says_it(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(scene_text(boxsat(background=replace(BOTH, share=0.5, placement="behind"))), encoding="utf-8")
    assert read_scene(path).background == replace(BOTH, share=0.5, placement="behind")
    path.write_text('[[objects]]\nspacecraft = "boxsat"\n[background]\nplacement = "fixed"\n', encoding="utf-8")
    with pytest.raises(InputError, match=r"background: expected an \[earth\] in the scene"):
        read_scene(path)


@pytest.mark.parametrize("wrong", [{"share": 1.5}, {"placement": "above"}, {"star_gain": -1.0}])
def test_wrong_values_are_refused(wrong):
    with pytest.raises(InputError, match=f"{next(iter(wrong))}: expected"):
        BackgroundConfig(**wrong)
    with pytest.raises(InputError, match="background: expected one or more of earth, stars, found 'moon'"):
        boxsat(background="moon")


def test_a_share_of_pictures_has_no_earth_that_is_fixed():
    some = BackgroundConfig(share=0.5)
    for placement in (None, "fixed"):
        with pytest.raises(InputError, match="background: expected placement behind for a share of the pictures"):
            replace(boxsat(), background=replace(some, placement=placement), earth=EarthConfig())
    replace(boxsat(), background=some)
    replace(boxsat(), background=replace(some, placement="behind"), earth=EarthConfig())


@pytest.mark.parametrize(
    ("background", "earth", "is_another"),
    [
        (BackgroundConfig(placement="behind", share=0.5), EarthConfig(), True),
        (BackgroundConfig(), EarthConfig(), False),
        (BackgroundConfig(placement="behind", share=0.0), EarthConfig(), False),
        (BackgroundConfig(earth=False, placement="behind"), EarthConfig(), False),
        (BackgroundConfig(), None, False),
    ],
)
def test_an_earth_that_is_not_where_labels_say_is_noted(tmp_path, caplog, background, earth, is_another):
    small = {"views": 1, "test_views": 0, "resolution": 8, "spp": 1}
    generate(replace(boxsat(**small, background=background), earth=earth), tmp_path / "data")
    assert ("the Earth drawn behind the objects is not that of earth_direction" in caplog.text) == is_another


def test_same_seed_gives_the_same_bytes_in_any_number_of_processes(made, tmp_path):
    generate(boxsat(background=BOTH), tmp_path / "again", workers=2)
    generate(boxsat(background=BOTH, seed=1), tmp_path / "other")
    first, again, other = contents(made), contents(tmp_path / "again"), contents(tmp_path / "other")
    assert again == first
    layers = [read_exr(root / "gt/train_00000.exr")["radiance_background"] for root in (made, tmp_path / "other")]
    assert (layers[0] != layers[1]).mean() > 0.5
    assert other.keys() == first.keys()


def test_a_sensor_records_object_and_background(tmp_path):
    scene = boxsat(background=BackgroundConfig(), views=1, test_views=0)
    quiet = SensorConfig(shot_noise=False, read_noise_e=0.0, black_level_dn=0, monochrome=True, bits=16)
    generate(replace(scene, camera=replace(scene.camera, sensor=quiet)), tmp_path / "data")
    layers = read_exr(tmp_path / "data/gt/train_00000.exr")
    light = layers["radiance"] + (1 - layers["alpha"])[..., None] * layers["radiance_background"]
    expected = np.clip(scene.camera.exposure * light.astype(np.float64), 0, None).mean(axis=-1)
    raw = read_png(tmp_path / "data/raw/train_00000.png").astype(np.float64)
    np.testing.assert_allclose(raw / 65535, np.minimum(expected, 1), atol=2e-4)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.5, 1.0])
def test_the_earth_is_behind_its_share_of_frames(share):
    scene = build(boxsat())
    background = Background(BackgroundConfig(share=share, stars=False), scene, (), seed=4)
    random = np.random.default_rng(0)
    seen, lit = [], 0
    for index in range(200):
        place = 9 * random.normal(size=3)
        camera = Camera.look_at(place, scene.bounding_sphere[0], 16, 16, 20.0)
        sun = Sun(random.normal(size=3))
        placed = background.placement(camera, sun, index)
        seen.append(placed is not None)
        if placed is not None:  # the middle of the objects stands before the ground
            towards = scene.bounding_sphere[0] - place
            normal = placed.normal_behind(towards / np.linalg.norm(towards))
            assert normal is not None
            assert np.linalg.norm(normal) == pytest.approx(1)
            lit += normal @ sun.direction > 0.2
    assert abs(sum(seen) - 200 * share) <= 2
    assert abs(sum(seen[60:120]) - 60 * share) <= 2
    assert lit >= 0.75 * sum(seen)  # where the Sun is ahead of the camera there is no such ground


def test_a_fixed_earth_stands_where_the_scene_says():
    earth = EarthConfig(azimuth_deg=20.0, elevation_deg=-40.0, altitude_km=2000.0)
    background = Background(BackgroundConfig(), build(replace(boxsat(), earth=earth)), (), seed=4)
    towards, away = (camera_towards(sign * earth.direction, 32) for sign in (1, -1))
    sun = Sun(-earth.direction)
    np.testing.assert_array_equal(background.placement(towards, sun, 0).direction, earth.direction)
    assert background.radiance(towards, sun, 0).min() > 1
    assert background.radiance(away, sun, 0).max() < 1  # stars alone


@pytest.mark.parametrize("altitude_km", [300.0, 36_000.0])
def test_the_limb_is_where_geometry_has_it(globe, altitude_km):
    """The ground fills what lies within asin(R / (R + h)) of the Earth's centre; the share of pixels on the limb is
    that of their areas."""
    earth = EarthConfig(altitude_km=altitude_km)
    limb: np.ndarray = np.array([math.cos(earth.angular_radius), 0.0, math.sin(earth.angular_radius)])
    camera = camera_towards([0.98, 0.1, 0.15] if altitude_km > 1e4 else limb)
    place = Placement(np.array([1.0, 0.0, 0.0]), earth.distance, np.eye(3))
    _, cover = completed(globe.draw(camera, Sun(np.array([1.0, 1.0, 1.0])), place))
    fine = replace(camera, width=1600, height=1600, fx=8 * camera.fx, fy=8 * camera.fy, cx=800.0, cy=800.0)
    inside = np.arccos(np.clip(rays(fine)[..., 0], -1, 1)) < earth.angular_radius
    expected = inside.reshape(200, 8, 200, 8).mean(axis=(1, 3))
    assert 0.05 < expected.mean() < 0.95
    np.testing.assert_allclose(cover, expected, atol=0.15)
    assert abs(cover.mean() - expected.mean()) < 2e-4
    assert np.count_nonzero((cover > 0) & (cover < 1)) > 100  # smooth


def test_the_terminator_is_where_the_sun_sets(globe):
    """Ground is lit where n . s > 0 and as bright as an albedo of 1 makes it at most; beyond it is dark, but for air
    that the Sun still reaches, 3 degrees on."""
    place = Placement(np.array([1.0, 0.0, 0.0]), EarthConfig(altitude_km=20_000.0).distance, np.eye(3))
    camera, sun = camera_towards([1.0, 0.0, 0.0]), Sun(np.array([-0.3, 1.0, 0.2]))
    light, cover = completed(globe.draw(camera, sun, place))
    directions = rays(camera)
    along = place.distance * directions[..., 0]
    depth = along - np.sqrt(np.maximum(along**2 - place.distance**2 + 1, 0))
    cosine = (depth[..., None] * directions - place.distance * place.direction) @ sun.direction
    ground, brightest = cover == 1, light.max(axis=-1)
    assert brightest[ground & (cosine < -0.06)].max() == 0
    assert brightest[ground & (cosine > 0.02)].min() > 0
    bound = 1361 / math.pi * np.maximum(cosine, 0) + 1361 / (4 * math.pi) * 1.5
    assert (brightest <= bound)[ground].all()
    day = ground & (cosine > 0.5)
    assert 0.15 < (light.mean(axis=-1) * math.pi / 1361 / np.maximum(cosine, 1e-3))[day].mean() < 0.55


@pytest.mark.parametrize("seed", [3, 77])
def test_the_globe_has_land_clouds_and_a_mean_albedo_like_the_earths(seed, monkeypatch):
    mi = backend.mitsuba()
    points = fibonacci_sphere(20_000)
    where = mi.Point3f(*map(upload, points.T.astype(np.float32)))
    values = albedo(where, mi.Float(0.002), mi.UInt32(seed)).numpy()
    assert values.min() > 0
    assert values.max() < 1
    assert 0.25 < values.mean() < 0.33  # the Earth's is 0.29
    poles = np.abs(points[:, 2]) > 0.985
    assert values[:, poles].mean() > 0.7

    def share(name: str) -> np.ndarray:
        """[N] of what is seen at each point."""
        for other in ("OCEAN", "FOREST", "STEPPE", "DESERT", "ICE", "CLOUD"):
            monkeypatch.setattr(globe_module, other, (float(other == name),) * 3)
        return albedo(where, mi.Float(0.002), mi.UInt32(seed)).numpy()[0]

    clouds = share("CLOUD")
    assert np.mean(clouds > 0.1) == pytest.approx(0.67, abs=0.06)
    clear = clouds < 0.9
    water = ((share("OCEAN") + share("ICE"))[clear] / (1 - clouds[clear])).mean()
    assert 1 - water == pytest.approx(0.29, abs=0.08)


def test_stars_follow_the_law_of_counts():
    stars = Stars(seed=2)
    assert len(stars.magnitudes) == round(stars_brighter_than(FAINTEST))
    assert np.abs(np.mean(stars.directions, axis=0)).max() < 0.03  # all over the sky
    for magnitude, catalogue in {3: 172, 4: 511, 5: 1600, 6: 4968}.items():
        assert np.count_nonzero(stars.magnitudes < magnitude) == pytest.approx(catalogue, rel=0.25)
    first = stars.irradiance[np.argmin(np.abs(stars.magnitudes - 1))]
    sixth = stars.irradiance[np.argmin(np.abs(stars.magnitudes - 6))]
    assert first / sixth == pytest.approx(100, rel=0.1)  # Pogson


@pytest.mark.parametrize("distortion", [(), (-0.2, 0.1, 0.0, 0.0, 0.0)])
def test_stars_keep_their_light_and_place_in_the_picture(distortion):
    """All light of a star falls within the picture, spread about where the lens images its direction."""
    stars = Stars(seed=2)
    camera = camera_towards(stars.directions[np.argmin(stars.magnitudes)], 301, 40.0)
    picture, (places, numbers) = stars.draw(camera, distortion), stars.pixels(camera, distortion)
    inner = ((places > 10) & (places < 291)).all(axis=1)
    assert inner.sum() > 200
    light = picture.astype(np.float64).sum() / (camera.fx * camera.fy)
    assert light == pytest.approx(stars.irradiance[numbers].sum(), rel=0.1)
    row, column = np.unravel_index(picture.argmax(), picture.shape)
    assert (abs(row - 150), abs(column - 150)) <= (1, 1)  # the brightest is on the axis
    if not distortion:  # as many as the picture has of the sky's solid angle, a square pyramid's
        half = math.tan(math.radians(20))
        solid_angle = 4 * math.asin(half**2 / (1 + half**2))
        assert len(numbers) == pytest.approx(stars_brighter_than(FAINTEST) * solid_angle / (4 * math.pi), rel=0.15)


def test_stars_are_not_seen_through_the_ground(globe):
    place = EarthConfig(altitude_km=500.0)
    scene = build(replace(boxsat(), earth=place))
    dark = Sun(place.direction)  # behind the Earth: its night side
    camera = camera_towards(place.direction, 64)
    only = Background(BackgroundConfig(earth=False, star_gain=1e6), scene, (), seed=4)
    both = Background(BackgroundConfig(star_gain=1e6), scene, (), seed=4)
    assert only.radiance(camera, dark, 0).max() > 0
    assert both.radiance(camera, dark, 0).max() == 0


def test_scene_json_keeps_the_background(made):
    scene = json.loads((made / "scene.json").read_text())
    assert scene["config"]["background"] == {
        "earth": True,
        "stars": True,
        "placement": None,
        "share": 1.0,
        "star_gain": 1e5,
    }


def test_the_command_line_says_it(tmp_path):
    small = ("--views", 1, "--test-views", 0, "--resolution", 16, "--spp", 1)
    done = call("generate", "boxsat", "--out", tmp_path / "data", "--background", "earth", *small)
    assert done.code == 0, done.errors
    assert read_png(tmp_path / "data/images/train_00000.png").shape == (16, 16, 3)
    assert call("generate", "boxsat", "--print", "--background", "moon").is_refusal("--background", "earth, stars")


def test_the_command_line_leaves_the_rest_of_the_table_as_it_is(tmp_path):
    path = tmp_path / "two.toml"
    table = '[background]\nplacement = "behind"\nshare = 0.5\nstar_gain = 3.0\n'
    path.write_text(f'[[objects]]\nspacecraft = "boxsat"\n{table}', encoding="utf-8")
    told = BackgroundConfig(placement="behind", share=0.5, star_gain=3.0)
    assert read_scene(path, background="earth,stars").background == told
    assert read_scene(path, background="stars").background == replace(told, earth=False)
    assert read_scene("boxsat", background="earth").background == BackgroundConfig(stars=False)
