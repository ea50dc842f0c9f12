"""The Earth as a light of composed scenes: what it reaches, what scene files say of it."""

from dataclasses import replace

import numpy as np
import pytest
from posed import disc_run, made_run, seen_from

from spacesim.data.earth import Earth
from spacesim.data.errors import InputError
from spacesim.data.files import read_json
from spacesim.data.images import linear_from_srgb
from spacesim.data.records import Sun
from spacesim.splat.compose import (
    GaussianComposition,
    Keyframe,
    PlacedRun,
    Pose,
    PosedScene,
    load_scene,
    save_scene,
    scenefile,
)
from spacesim.splat.compose.output import compose
from spacesim.splat.compose.plain import bake_scene
from spacesim.splat.compose.pose import rotation_about
from spacesim.splat.raster.cameras import Pinhole
from spacesim.splat.raster.render import render
from spacesim.splat.run import Run

EARTH = Earth([0.3, -0.2, -1.0], 60.0, 0.9)
SUN = Sun.from_angles(40, 35)
BOTH = replace(SUN, earth=EARTH)
EYE = seen_from([3, -2, 1.5])
SCENE = """[[models]]
run = "runs/map"
name = "one"
[sun]
azimuth_deg = 40
elevation_deg = 35
[earth]
direction = [0.3, -0.2, -1.0]
angular_radius_deg = 60.0
albedo = 0.9
[camera]
position = [4, 0, 1]
look_at = [0, 0, 0]
resolution = [40, 32]
"""


@pytest.fixture
def run() -> Run:
    """Made with an albedo, a bounce and shadows."""
    return made_run("bounce", 3)


@pytest.fixture
def scene_file(tmp_path, monkeypatch, run):
    """The scene of that run."""
    monkeypatch.setattr(scenefile, "load_run", lambda _path: run)
    (tmp_path / "scene.toml").write_text(SCENE)
    return tmp_path / "scene.toml"


def light_of(scene: GaussianComposition, sun: Sun) -> np.ndarray:
    """[3, N] of the first model's Gaussians, linear."""
    lit, count = scene.lit(EYE, sun), scene.models[0].run.gaussian_count
    start = sum(placed.run.gaussian_count for placed in scene.placed[: scene.placed.index(scene.models[0])])
    return linear_from_srgb(np.stack([np.array(color) for color in lit.colors])[:, start : start + count])


@pytest.mark.parametrize("shadows", [True, False])
def test_it_reaches_into_shadows_of_others(run, shadows):
    if not shadows:
        run.light.config = replace(run.light.config, shadow=None, bounce=0)
    alone = GaussianComposition([PlacedRun(run)])
    earth = light_of(alone, BOTH) - light_of(alone, SUN)
    facing = Pose(rotation_about(np.cross([0, 0, 1], SUN.direction), 55), 50 * SUN.direction)
    behind = GaussianComposition([PlacedRun(run), PlacedRun(disc_run(3.0), facing)])
    assert light_of(behind, SUN).max() < 3e-3  # an opaque one lets through 1/1000 of sunlight, which bounces, too
    assert earth.max() > 0.05
    np.testing.assert_allclose(light_of(behind, BOTH), earth, atol=2e-3)
    shown = behind.predict(EYE, BOTH)
    np.testing.assert_allclose(shown.visibility, behind.predict(EYE, SUN).visibility, atol=1e-5)


@pytest.mark.parametrize("name", ["bounce", "gloss"])
def test_a_black_one_that_hides_nothing_changes_nothing(name):
    """In the shadow of another model, whose edge lies on this one."""
    half = Pose(rotation_about(np.cross([0, 0, 1], SUN.direction), 55), 3 * SUN.direction + [0.7, 0, 0])
    scene = GaussianComposition([PlacedRun(made_run(name, 3)), PlacedRun(disc_run(0.7), half)])
    black = replace(SUN, earth=Earth([0.3, -0.2, -1.0], 60.0, 0.0))
    found, expected = light_of(scene, black), light_of(scene, SUN)
    assert expected.max() > 0.1
    np.testing.assert_allclose(found, expected, atol=0.02)


def test_where_it_moves_pictures_change(run):
    scene = GaussianComposition([PlacedRun(run), PlacedRun(disc_run(0.3), Pose(translation=[0, 0, 2]))])
    first = scene.predict(EYE, BOTH).rgb
    other = scene.predict(EYE, replace(SUN, earth=replace(EARTH, direction=-EARTH.direction))).rgb
    assert np.abs(other - first).max() > 0.02
    again = scene.predict(EYE, replace(SUN, earth=Earth([0.3, -0.2, -1.0], 60.0, 0.9))).rgb
    np.testing.assert_array_equal(again, first)


def test_a_scene_made_plain_has_it(run):
    turned = Pose(rotation_about([1, 2, 0], 70), [0.2, 0, 0], 0.8)
    scene = GaussianComposition([PlacedRun(run, turned), PlacedRun(disc_run(0.3), Pose(translation=[0, 0, 2]))])
    both, alone = (render(bake_scene(scene, sun), Pinhole.of(EYE)).image("color") for sun in (BOTH, SUN))
    picture = scene.predict(EYE, BOTH).rgb
    assert np.abs(both - picture).mean() < 0.5 * np.abs(alone - picture).mean()


def test_a_scene_file_names_it(scene_file, tmp_path):
    scene = load_scene(scene_file)
    assert scene.earth == EARTH
    shot = scene.frame(0)
    both = shot.composition.predict(shot.camera, shot.sun).rgb
    np.testing.assert_array_equal(scene.render().rgb, both)
    np.testing.assert_array_equal(scene.render(sun=(40, 35)).rgb, both)
    assert np.abs(scene.render(sun=SUN).rgb - both).max() > 0.02
    np.testing.assert_array_equal(scene.render(light="sun").rgb, scene.render(sun=SUN).rgb)
    keys = [Keyframe(0.0, SUN), Keyframe(1.0, Sun.from_angles(90, 0))]
    moving = PosedScene(scene.composition, None, scene.camera, keys, frames=3, fps=2.0, earth=EARTH)
    assert [moving.frame(k).sun.earth for k in range(3)] == [EARTH] * 3
    for saved in (scene, PosedScene(scene.composition, BOTH, scene.camera)):
        save_scene(tmp_path / "again.toml", saved)
        assert load_scene(tmp_path / "again.toml").sun_at(0.0).earth == EARTH


def test_keyframes_move_it(scene_file, tmp_path, monkeypatch):
    """On a great circle between those that name it, beside a Sun that stands still; what they do not say of it is as
    [earth] has it, if there is one."""
    sunwards = SUN.direction.tolist()
    keys = (
        "[[keyframes]]\ntime = 0\nearth = { azimuth_deg = 40, elevation_deg = -55 }\n"
        f"[[keyframes]]\ntime = 2\n[keyframes.earth]\ndirection = {sunwards}\nangular_radius_deg = 40\nalbedo = 0\n"
    )
    scene_file.write_text(f"fps = 1\n{SCENE}{keys}")
    scene = load_scene(scene_file)
    shots = [scene.frame(k).sun for k in range(3)]
    assert [sun.direction.tolist() for sun in shots] == [sunwards] * 3
    earths = [sun.earth for sun in shots]
    assert earths[0] == Earth(Sun.from_angles(40, -55).direction, 60.0, 0.9)
    assert earths[2] == Earth(SUN.direction, 40.0, 0.0)
    np.testing.assert_allclose(earths[1].direction, Sun.from_angles(40, -10).direction, atol=1e-12)
    assert (earths[1].angular_radius_deg, earths[1].albedo) == (50, 0.45)
    assert [sun.visible_share for sun in shots] == [1, 0, 0]  # 90, 45 and 0 degrees beside radii of 60, 50 and 40
    assert scene.render(time=2.0).rgb.max() == 0 < scene.render(time=0.0).rgb.max()
    save_scene(tmp_path / "again.toml", scene)
    again = load_scene(tmp_path / "again.toml")
    assert [again.frame(k).sun.earth for k in range(3)] == earths
    own = [Keyframe(0.0, BOTH), Keyframe(1.0, replace(SUN, earth=earths[0]))]
    moving = PosedScene(scene.composition, None, scene.camera, own, frames=3, fps=2.0)
    assert [moving.frame(k).sun.earth for k in (0, 2)] == [EARTH, earths[0]]
    assert moving.frame(1).sun.earth.albedo == 0.9
    before, _, after = SCENE.partition("[earth]")
    scene_file.write_text(before + after[after.index("[camera]") :] + keys)
    assert load_scene(scene_file).earth_at(0.0) == Earth(earths[0].direction)
    monkeypatch.setattr(scenefile, "load_run", lambda _path: disc_run(1.0))
    with pytest.raises(InputError, match=r"keyframes\[0\].earth: expected a model that the Sun relights, found none"):
        load_scene(scene_file)


@pytest.mark.parametrize(("run", "saved"), [(made_run("map"), True), (disc_run(1.0), False)], ids=("relit", "plain"))
def test_what_changes_no_model_is_not_saved(tmp_path, run, saved):
    """To one that has not learned its light it hides the Sun."""
    save_scene(tmp_path / "scene.toml", PosedScene(GaussianComposition([PlacedRun(run, name="one")]), BOTH))
    text = (tmp_path / "scene.toml").read_text()
    assert "[sun]" in text
    assert ("[earth]" in text) == saved


def test_it_hides_the_sun_from_all_models(scene_file, monkeypatch):
    """In a scene's file, whoever has learned its light."""
    for one in (made_run("bounce", 3), made_run("map")):
        monkeypatch.setattr(scenefile, "load_run", lambda _path, one=one: one)
        scene_file.write_text(SCENE.replace("azimuth_deg = 40\nelevation_deg = 35", "direction = [0.3, 0, -1]"))
        night = load_scene(scene_file).render()
        assert night.rgb.max() == 0 < night.alpha.max()
        assert load_scene(scene_file).render(sun=(40, 35)).rgb.max() > 0.1


def test_the_viewer_begins_with_it(scene_file, monkeypatch):
    load = pytest.importorskip("spacesim.viewer.load")
    pytest.importorskip("viser", reason="viser is not installed")
    monkeypatch.setattr(load, "load_scene", load_scene)
    for text in (SCENE, SCENE.replace("[sun]\nazimuth_deg = 40\nelevation_deg = 35\n", "")):
        scene_file.write_text(text)
        setup = load.load_setup(scene_file)
        assert setup.state.sun.earth == EARTH


def test_composing_anew_where_it_has_moved(scene_file, tmp_path):
    assert [compose(load_scene(scene_file), tmp_path / "out").rendered for _ in range(2)] == [1, 0]
    assert read_json(tmp_path / "out/shots/0000.json")["earth_direction"] == EARTH.direction.tolist()
    scene_file.write_text(SCENE.replace("-1.0]", "1.0]"))
    assert compose(load_scene(scene_file), tmp_path / "out").rendered == 1


@pytest.mark.parametrize(
    "wrong",
    [
        (
            "angular_radius_deg = 60.0",
            "angular_radius_deg = 90",
            r"line 9: earth.angular_radius_deg: expected an angle",
        ),
        ("albedo = 0.9", "albedo = 2", r"line 10: earth.albedo: expected a fraction from 0 to 1, found 2"),
        ("[0.3, -0.2, -1.0]", "[0, 0, 0]", r"line 8: earth.direction: expected a direction, found 0, 0, 0"),
    ],
    ids=("radius", "albedo", "direction"),
)
def test_what_is_wrong_is_said_with_its_line(scene_file, wrong):
    scene_file.write_text(SCENE.replace(wrong[0], wrong[1]))
    with pytest.raises(InputError, match=wrong[2]):
        load_scene(scene_file)


def test_a_scene_of_models_of_one_light_is_refused(scene_file, monkeypatch):
    monkeypatch.setattr(scenefile, "load_run", lambda _path: disc_run(1.0))
    with pytest.raises(InputError, match=r"line 7: earth: expected a model that the Sun relights, found none"):
        load_scene(scene_file)
