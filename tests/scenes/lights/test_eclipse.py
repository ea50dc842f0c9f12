"""How much of the Sun the Earth hides: closed form, samples of the disc, and what the path tracer finds."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spacesim.data.geometry import normalize
from spacesim.data.records import Camera, Sun
from spacesim.data.store import load_truth
from spacesim.data.transforms import read_dataset
from spacesim.scenes.build import build
from spacesim.scenes.generation.generate import generate
from spacesim.scenes.lights.earth import EARTH_RADIUS_KM, EarthConfig
from spacesim.scenes.lights.eclipse import visible_fraction
from spacesim.scenes.lights.sun import SunConfig
from spacesim.scenes.render import Renderer
from spacesim.scenes.scenefile import read_scene

SUN_RADIUS = SunConfig().angular_radius
DISTANCE = 6_878_137.0
LIMB = np.arcsin(1e3 * EARTH_RADIUS_KM / DISTANCE)


def sun_at(angle):
    """[3] a direction `angle` radians from the Earth's centre, which is along -z."""
    return np.array([np.sin(angle), 0, -np.cos(angle)])


def sampled(sun, earth, radius):
    """The visible fraction, by a million points of the disc and a ray to each."""
    k = np.arange(1_000_000)
    r, turn = np.sin(radius) * np.sqrt((k + 0.5) / len(k)), k * np.pi * (3 - 5**0.5)
    axis = normalize(sun)
    side = normalize(np.cross(axis, [0.3, 0.9, 0.1]))
    rays = np.sqrt(1 - r**2)[:, None] * axis + (r * np.cos(turn))[:, None] * side
    rays = rays + (r * np.sin(turn))[:, None] * np.cross(axis, side)
    along = rays @ earth
    miss = np.linalg.norm(earth - along[:, None] * rays, axis=1)
    return float(np.mean((along < 0) | (miss > 1e3 * EARTH_RADIUS_KM)))


@pytest.mark.parametrize("offset", [-0.9, -0.5, -0.1, 0.0, 0.3, 0.8])
@pytest.mark.parametrize("distance", [6_878_137.0, 42_164e3, 4e8])
def test_the_penumbra_is_what_samples_of_the_disc_find(offset, distance):
    limb = np.arcsin(1e3 * EARTH_RADIUS_KM / distance)
    earth = np.array([0, 0, -distance])
    sun = sun_at(limb + offset * SUN_RADIUS)
    found = visible_fraction(sun, earth, SUN_RADIUS)
    assert found == pytest.approx(sampled(sun, earth, SUN_RADIUS), abs=1e-3)
    assert 0 < found < 1


def test_umbra_sunlight_and_annular_eclipse():
    earth = np.array([0, 0, -DISTANCE])
    assert visible_fraction(sun_at(0.0), earth, SUN_RADIUS) == 0
    assert visible_fraction(sun_at(LIMB - 1.001 * SUN_RADIUS), earth, SUN_RADIUS) == 0
    assert visible_fraction(sun_at(LIMB + 1.001 * SUN_RADIUS), earth, SUN_RADIUS) == 1
    assert visible_fraction(sun_at(np.pi), earth, SUN_RADIUS) == 1
    assert visible_fraction(sun_at(LIMB), earth, SUN_RADIUS) == pytest.approx(0.5, abs=2e-3)
    far = np.array([0, 0, -3e9])  # the Earth in the middle of the Sun's disc
    assert visible_fraction(sun_at(0.0), far, SUN_RADIUS) == pytest.approx(
        sampled(sun_at(0.0), far, SUN_RADIUS), abs=1e-4
    )
    assert [visible_fraction(sun_at(LIMB + d), earth, 0.0) for d in (-1e-6, 1e-6)] == [0, 1]  # parallel light
    assert visible_fraction(sun_at(np.pi), np.array([0, 0, -6e6]), SUN_RADIUS) == 0  # underground


@pytest.mark.parametrize("offset", [-2.0, -0.4, 0.5, 2.0])
def test_the_path_tracers_earth_hides_as_much(offset):
    """A scene with an Earth, which moves with the frame."""
    scene = build(read_scene("boxsat"))
    sun = Sun(sun_at(LIMB + offset * SUN_RADIUS))
    camera = Camera.look_at(9 * sun.direction, [0, 0, 0], 16, 16, 30)
    lit = Renderer(scene, spp=512).render(camera, sun, (1,)).radiance.sum()
    elsewhere = EarthConfig(elevation_deg=80.0, albedo=0.0)
    dark = Renderer(build(read_scene("boxsat")).__class__(scene.name, scene.objects, scene.sun, elsewhere), spp=512)
    expected = visible_fraction(sun.direction, np.array([0, 0, -DISTANCE]), SUN_RADIUS)
    found = dark.render(camera, sun, (1,), earth=EarthConfig(albedo=0.0))
    assert found.radiance.sum() / lit == pytest.approx(expected, abs=0.02)
    seen = found.sun_visibility[found.sun_visibility > 0]
    assert np.median(seen) == pytest.approx(expected, abs=0.015) if expected else not len(seen)  # of 256 points
    assert dark.render(camera, sun, (1,)).radiance.sum() == pytest.approx(lit, rel=1e-6)  # back where the scene says


def scene_in_eclipse(tmp_path, offsets, lit_by_earth, **options):
    """(scene, direction of the Sun, places of the Earth), a frame every 10 s with the Earth's limb by so many of the
    Sun's radii beside its centre."""
    angles = LIMB + SUN_RADIUS * np.array(offsets)
    sun = np.array([0, 0, 1.0])
    earths = [DISTANCE * np.array([np.sin(angle), 0, np.cos(angle)]) for angle in angles]
    lines = ["time_s,camera_x_m,camera_y_m,camera_z_m,sun_x,sun_y,sun_z,earth_x_m,earth_y_m,earth_z_m"]
    lines += [",".join(map(str, [10 * k, 3, 2, 9, *sun, *earth])) for k, earth in enumerate(earths)]
    table = tmp_path / "p.csv"
    table.write_text("\n".join(lines))
    path = tmp_path / "s.toml"
    earth = "[earth]\nazimuth_deg = 90.0\nelevation_deg = 80.0\nalbedo = 0.0\n" if lit_by_earth else ""
    path.write_text(f'[[objects]]\nspacecraft = "boxsat"\n{earth}')
    return read_scene(path, resolution=(16, 16), points=50, trajectory=table, **options), sun, earths


@pytest.mark.parametrize("lit_by_earth", [False, True])
def test_frames_in_eclipse_are_left_out(tmp_path, lit_by_earth):
    """Those of whose Sun less than half is seen are lit nowhere, whoever hides it."""
    scene, sun, earths = scene_in_eclipse(tmp_path, [-1.5, 1.5, -0.3, 0.3, -1.5], lit_by_earth, spp=1)
    generate(replace(scene, min_sunlit=0.05), tmp_path / "data")
    frames = json.loads((tmp_path / "data/transforms.json").read_text())["frames"]
    assert [frame["time"] for frame in frames] == [10.0, 30.0]
    expected = [visible_fraction(sun, earths[k], SUN_RADIUS) for k in (1, 3)]
    assert [frame["sun_visibility"] for frame in frames] == pytest.approx(expected, abs=1e-6)
    assert [Path(frame["file_path"]).name for frame in frames] == ["train_00000.png", "train_00001.png"]
    assert all(frame["sunlit_fraction"] > 0.05 for frame in frames)
    left = json.loads((tmp_path / "data/scene.json").read_text())["left_out"]
    assert left == {"train": [0, 2, 4], "test": []}


@pytest.mark.parametrize("lit_by_earth", [False, True])
def test_frames_through_the_penumbra(tmp_path, caplog, lit_by_earth):
    """A scene without an Earth is dimmed by the closed form, one with an Earth by its limb."""
    scene, sun, earths = scene_in_eclipse(tmp_path, [1.5, 0.3, -0.3, -1.5], lit_by_earth, spp=256)
    generate(scene, tmp_path / "data")
    frames = json.loads((tmp_path / "data/transforms.json").read_text())["frames"]
    seen = [frame["sun_visibility"] for frame in frames]
    expected = [visible_fraction(sun, earth, SUN_RADIUS) for earth in earths]
    assert seen == pytest.approx(expected, abs=1e-6)
    assert [seen[0], seen[3]] == [1, 0]
    data = read_dataset(tmp_path / "data")
    assert [frame.sun.visible_share for frame in data.train] == pytest.approx(expected, abs=1e-6)
    assert {frame["earth_albedo"] for frame in frames} == {0.0}
    truths = [load_truth(data, frame) for frame in data.train]
    light = np.array([truth.radiance.sum() for truth in truths])
    np.testing.assert_allclose(light / light[0], seen, atol=0.02)
    assert light[3] == 0
    visibility = [np.median(truth.sun_visibility[truth.sun_cosine > 0.3]) for truth in truths]
    np.testing.assert_allclose(visibility, seen, atol=0.02)
    assert [frame["sunlit_fraction"] > 0 for frame in frames] == [True, True, False, False]
    assert (truths[2].shadow == 255).sum() == 0
    warnings = [record.message for record in caplog.records if "in the dark" in record.message]
    assert warnings == [
        "generate: 2 of 4 frames show the object in the dark (train_00002 first, in 1 of them the Earth hides the Sun)"
        "; max_phase_deg = 90 in [rig] or min_sunlit = 0.05 (--min-sunlit) leaves them out"
    ]
