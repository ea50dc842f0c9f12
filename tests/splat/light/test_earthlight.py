"""The Earth as a source of the model: what training takes from a dataset, and the layers that it draws. The adjoint is
in test_light.py."""

from dataclasses import replace

import numpy as np
import pytest

from spacesim.cli.printing import NO_EARTH
from spacesim.data.earth import Earth
from spacesim.data.errors import InputError
from spacesim.data.files import read_json
from spacesim.data.images import linear_from_srgb, read_png
from spacesim.data.records import Dataset, Sun
from spacesim.data.store import load_truth
from spacesim.learning.lights import added_light
from spacesim.scenes.build import build
from spacesim.scenes.generation.generate import generate
from spacesim.scenes.lights.earth import EarthConfig
from spacesim.scenes.lights.sun import SunConfig
from spacesim.scenes.render import Renderer
from spacesim.scenes.scenefile import read_scene
from spacesim.serve.draw import load_served
from spacesim.splat.compose.aligned import AlignedRun, moved_frame
from spacesim.splat.compose.plain import bake_scene
from spacesim.splat.compose.pose import Pose
from spacesim.splat.compose.scene import GaussianComposition, PlacedRun
from spacesim.splat.light.config import LightConfig
from spacesim.splat.light.field import FieldConfig, ViewAloneConfig
from spacesim.splat.pose.picture import SunlitRun
from spacesim.splat.raster.project import Pinhole
from spacesim.splat.raster.render import render
from spacesim.splat.run import Run, load_run
from spacesim.splat.train.config import preset, with_settings
from spacesim.splat.train.train import train
from spacesim.splat.train.views import TrainingViews

CONFIG = with_settings(replace(preset("demo", "relight"), iterations=400, init_count=1500), {"checkpoint_every": 300})


@pytest.fixture(scope="module")
def earthlit(tmp_path_factory) -> Dataset:
    """Pictures under two Suns and a bright Earth."""
    size = {"resolution": (32, 32), "spp": 16, "points": 400}
    scene = read_scene("boxsat", sun=((20, 40), (200, 60)), views=8, test_views=2, **size)
    scene = replace(scene, earth=EarthConfig(altitude_km=600.0, albedo=0.9))
    return generate(scene, tmp_path_factory.mktemp("earth") / "data")


@pytest.fixture(scope="module")
def run(earthlit, tmp_path_factory) -> Run:
    return train(earthlit, tmp_path_factory.mktemp("run") / "run", CONFIG)


def pictures(run, frame) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of both sources, of the Sun alone, and linear light of the Earth alone."""
    both, alone = (run.predict(frame.camera, sun) for sun in (frame.sun, replace(frame.sun, earth=None)))
    return both.rgb, alone.rgb, linear_from_srgb(added_light(both, alone).rgb)


def test_frames_name_the_earth_that_lights_them(earthlit):
    for frame in earthlit.frames:
        np.testing.assert_allclose(frame.sun.earth.direction, [0, 0, -1], atol=1e-12)
        assert frame.sun.earth.angular_radius_deg == pytest.approx(np.degrees(np.arcsin(6378.137 / 6978.137)))
        assert frame.sun.earth.albedo == 0.9


def test_frames_whose_sun_the_earth_hides_are_not_trained_on(earthlit, caplog):
    earth = earthlit.train[0].sun.earth
    limb = np.radians(-90 + earth.angular_radius_deg)
    for angle, hidden in ((limb - 0.01, True), (limb + 0.01, False)):
        assert Sun(np.array([np.cos(angle), 0, np.sin(angle)]), earth).is_hidden == hidden
    night = replace(earthlit.train[3], sun=Sun(earth.direction, earth))
    dataset = replace(earthlit, train=(*earthlit.train[:3], night, *earthlit.train[4:]))
    count = len(dataset.train)
    views = TrainingViews(dataset, seed=0, suns=True)
    seen = [views.at_step(step).index for step in range(2 * (count - 1))]
    every = [k for k in range(count) if k != 3]
    assert sorted(seen[: count - 1]) == sorted(seen[count - 1 :]) == every
    assert f"1 of {count} training frames are left out" in caplog.text
    assert sorted(TrainingViews(dataset, seed=0).at_step(step).index for step in range(count)) == list(range(count))


def test_training_takes_the_earth_where_frames_name_one(earthlit, run, tmp_path):
    assert run.light.config.earth is True
    assert CONFIG.light.earth is None
    without = train(earthlit, tmp_path / "without", with_settings(CONFIG, {"light.earth": False}))
    assert without.gaussians.feature_count == run.gaussians.feature_count - 3
    both, alone, _ = pictures(without, earthlit.test[0])
    np.testing.assert_array_equal(both, alone)
    by_directions = with_settings(replace(CONFIG, iterations=1), {"light.field.inputs": "directions"})
    assert train(earthlit, tmp_path / "directions", by_directions).light.config.earth is None


def test_it_repeats_to_the_bit_and_resumes(earthlit, run, tmp_path):
    train(earthlit, tmp_path / "again", CONFIG)
    (tmp_path / "again/model.safetensors").unlink()  # as if stopped at the last checkpoint
    (tmp_path / "again/checkpoints/step_00000400.safetensors").unlink(missing_ok=True)
    resumed = train(earthlit, tmp_path / "again", CONFIG, resume=True)
    assert (resumed.path / "model.safetensors").read_bytes() == (run.path / "model.safetensors").read_bytes()


def test_the_layers_are_those_of_the_truth(earthlit, run):
    """Near enough that each is told from the other: the Earth gives two fifths of the light here."""
    layers: list[tuple[np.ndarray, ...]] = []
    for frame in earthlit.test:
        truth = load_truth(earthlit, frame)
        both, alone, earth = pictures(run, frame)
        traced = [np.pi / 1361 * layer for layer in (truth.radiance - truth.radiance_earth, truth.radiance_earth)]
        shown = (linear_from_srgb(both), linear_from_srgb(alone), earth, *traced)
        layers.append(tuple(layer[truth.object_id > 0] for layer in shown))
    both, sun, earth, true_sun, true_earth = (np.concatenate(layer).mean(axis=1) for layer in zip(*layers, strict=True))
    assert true_earth.mean() > 0.3 * (true_earth + true_sun).mean()
    assert earth.mean() == pytest.approx(true_earth.mean(), rel=0.25)
    assert sun.mean() == pytest.approx(true_sun.mean(), rel=0.25)
    assert np.corrcoef(earth, true_earth)[0, 1] > 0.4
    assert np.mean((sun - true_sun) ** 2) < 0.9 * np.mean((both - true_sun) ** 2)


def test_where_no_earth_is_given_there_is_none(run, earthlit):
    """A run that is turned sees it where it stands in the world, aligned or in a composition."""
    frame = earthlit.test[0]
    both, alone, earth = pictures(run, frame)
    assert (both >= alone - 1e-5).all()
    assert earth.max() > 0.02
    composed = GaussianComposition([PlacedRun(run)])
    np.testing.assert_array_equal(composed.predict(frame.camera, frame.sun).rgb, both)
    np.testing.assert_array_equal(composed.predict(frame.camera, replace(frame.sun, earth=None)).rgb, alone)
    half = np.sqrt(0.5)
    pose = Pose(np.array([[half, 0, half], [0, 1, 0], [-half, 0, half]]), [0.4, -0.2, 0.1], 1.0)
    there = moved_frame(frame, pose)
    assert np.abs(there.sun.earth.direction - frame.sun.earth.direction).max() > 0.5
    for turned in (AlignedRun(run, pose), GaussianComposition([PlacedRun(run, pose)])):
        np.testing.assert_allclose(turned.predict(there.camera, there.sun).rgb, both, atol=5e-3)  # by other beams
    drawn = SunlitRun.of(run, frame.sun)
    np.testing.assert_allclose(drawn.draw(frame.camera, drawn.shade(frame.camera))[..., :3], both, atol=1e-5)


def beside_the_limb(frame, radii: float) -> Sun:
    """The frame's Earth, and a Sun above its limb by so many radii of the Sun."""
    earth = frame.sun.earth
    angle = np.radians(earth.angular_radius_deg - 90) + radii * SunConfig().angular_radius
    return Sun(np.array([0.8 * np.cos(angle), 0.6 * np.cos(angle), np.sin(angle)]), earth)


def light_seen(prediction) -> float:
    """Where it is opaque: what is not is blended as sRGB values."""
    return float(linear_from_srgb(prediction.rgb[prediction.alpha > 0.9]).sum())


@pytest.fixture(scope="module")
def shadowed(earthlit, tmp_path_factory) -> Run:
    """One that casts shadows and has not learned the Earth's light."""
    config = with_settings(preset("demo", "shadow-map"), {"light.earth": False, "init_count": 1500})
    return train(earthlit, tmp_path_factory.mktemp("shadowed") / "run", replace(config, iterations=200))


@pytest.mark.parametrize("radii", [-3.0, -0.5, 0.4, 3.0])
def test_the_earth_hides_the_sun_as_it_does_from_the_path_tracer(run, shadowed, earthlit, radii):
    """Behind it there is nothing left: the side of it that is seen is dark, too."""
    frame = earthlit.test[0]
    free, sun = (beside_the_limb(frame, one) for one in (3.0, radii))
    scene = replace(read_scene("boxsat"), earth=EarthConfig(altitude_km=600.0, albedo=0.9))
    tracer = Renderer(build(scene), 256)
    traced = [tracer.render(frame.camera, one, (1,)).radiance.sum() for one in (free, sun)]
    for model in (run, shadowed):
        seen = [model.predict(frame.camera, one) for one in (free, sun)]
        assert light_seen(seen[0]) > 1
        share = light_seen(seen[1]) / light_seen(seen[0])
        assert share == pytest.approx(traced[1] / traced[0], abs=0.05)
        assert share == pytest.approx(sun.visible_share, abs=0.03)
    unhidden = shadowed.predict(frame.camera, replace(sun, earth=None))
    np.testing.assert_allclose(seen[1].visibility, sun.visible_share * unhidden.visibility, atol=1e-5)


def test_all_that_draw_know_the_eclipse(run, shadowed, earthlit):
    """Behind the Earth all is black; in the penumbra they agree, and the layers add up to the whole."""
    frame = earthlit.test[0]
    night, dim = (beside_the_limb(frame, radii) for radii in (-2.0, 0.2))
    turned = Pose(np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]), [0.4, -0.2, 0.1], 1.0)
    for model in (run, shadowed):
        alone = model.predict(frame.camera, dim)
        pair = GaussianComposition([PlacedRun(model), PlacedRun(model, Pose(np.eye(3), [0, 0, 50.0], 1.0))])
        drawn = SunlitRun.of(model, dim)
        for rgb in (
            GaussianComposition([PlacedRun(model)]).predict(frame.camera, dim).rgb,
            pair.predict(frame.camera, dim).rgb,
            drawn.draw(frame.camera, drawn.shade(frame.camera))[..., :3],
        ):
            np.testing.assert_allclose(rgb, alone.rgb, atol=1e-4)
        there = moved_frame(replace(frame, sun=dim), turned)
        np.testing.assert_allclose(AlignedRun(model, turned).predict(there.camera, there.sun).rgb, alone.rgb, atol=5e-3)
        assert model.predict(frame.camera, night).rgb.max() == 0
        assert pair.predict(frame.camera, night).rgb.max() == 0
        baked = bake_scene(pair, night)
        assert render(baked, Pinhole.of(frame.camera)).image("color").max() < 0.01
    both = linear_from_srgb(run.predict(frame.camera, dim).rgb)
    layers = [linear_from_srgb(run.render(frame.camera, dim, light=light).rgb) for light in ("sun", "earth")]
    np.testing.assert_allclose(sum(layers), both, atol=1e-5)
    assert run.render(frame.camera, night, light="earth").rgb.max() == 0


def test_what_is_seen_of_the_sun_in_a_scene_without_own_shadows(run, shadowed, earthlit):
    frame = earthlit.test[0]
    dim = beside_the_limb(frame, 0.2)
    away = Pose(np.eye(3), [0, 0, 50.0], 1.0)
    seen = GaussianComposition([PlacedRun(run), PlacedRun(shadowed, away)]).predict(frame.camera, dim)
    assert seen.visibility[seen.alpha > 0.9] == pytest.approx(dim.visible_share, abs=1e-3)


def test_render_hides_the_sun_behind_a_named_earth(spacesim, run, shadowed, tmp_path, caplog):
    """A sentence says where that is all that it does."""
    for model in (run, shadowed):
        done = spacesim(
            "render", model.path, "--frame", 16, "--sun", "10,-60", "--earth", "0,-80", "--out", tmp_path / "a.png"
        )
        assert done.code == 0, done.errors
        assert read_png(tmp_path / "a.png")[..., :3].max() == 0
        assert ("has not learned the Earth's light" in caplog.text) == (model is shadowed)


def test_a_model_of_one_light_has_no_eclipse(earthlit, tmp_path):
    run = train(earthlit, tmp_path / "run", replace(preset("demo", "vanilla"), iterations=1, init_count=300))
    frame = earthlit.test[0]
    night = run.predict(frame.camera, beside_the_limb(frame, -2.0)).rgb
    np.testing.assert_array_equal(night, run.predict(frame.camera, frame.sun).rgb)
    assert night.max() > 0.1


def test_training_needs_a_sun_that_is_seen(earthlit, tmp_path):
    dark = [replace(frame, sun=beside_the_limb(frame, -2.0)) for frame in earthlit.train]
    with pytest.raises(InputError, match="expected a training frame whose Sun the Earth does not hide, found none"):
        train(replace(earthlit, train=tuple(dark)), tmp_path / "run", CONFIG)


def test_render_draws_the_layers(spacesim, run, earthlit, tmp_path):
    from spacesim.data.images import read_exr

    def rendered(*options) -> np.ndarray:
        done = spacesim("render", run.path, "--frame", 16, "--out", tmp_path / "a.exr", *options)
        assert done.code == 0, done.errors
        return linear_from_srgb(read_exr(tmp_path / "a.exr")["rgb"])

    both, sun, earth = rendered(), rendered("--earth", "none"), rendered("--sun", "none")
    np.testing.assert_allclose(both, sun + earth, atol=1e-5)
    np.testing.assert_array_equal(rendered("--earth", "0,-90"), both)
    other = rendered("--earth", "90,-60", "--sun", "none")
    assert np.abs(other - earth).max() > 0.01
    frame = earthlit.test[0]
    np.testing.assert_allclose(linear_from_srgb(load_run(run.path).predict(frame.camera, frame.sun).rgb), both)
    for light, layer in (("sun", sun), ("earth", earth)):
        shown = run.render(frame.camera, frame.sun, light=light).rgb
        np.testing.assert_allclose(linear_from_srgb(shown), layer, atol=1e-6)
    refused = spacesim(
        "render", run.path, "--frame", 16, "--earth", "none", "--sun", "none", "--out", tmp_path / "b.png"
    )
    assert refused.is_refusal("--sun", "where the Earth gives no light")


def test_a_scene_is_evaluated_in_the_light_of_its_data(spacesim, run, earthlit, tmp_path):
    """As the run alone is."""
    (tmp_path / "scene.toml").write_text(f'[[models]]\nrun = "{run.path}"\n')
    scores = []
    for number, what in enumerate([run.path, tmp_path / "scene.toml"]):
        done = spacesim("eval", what, "--data", earthlit.root, "--out", tmp_path / str(number))
        assert done.code == 0, done.errors
        scores.append(read_json(tmp_path / str(number) / "metrics.json")["image"]["psnr"]["mean"])
    assert scores[0] == scores[1]


@pytest.mark.parametrize("form", ["ply", "mesh", "html"])
def test_exports_have_it_where_it_is_named(spacesim, run, tmp_path, form):
    """Else a sentence says that it is left out."""
    sun = () if form == "html" else ("--sun", "20,40")
    contents = []
    for number, earth in enumerate([(), ("--earth", "none"), ("--earth", "0,-90")]):
        out = tmp_path / f"{number}.{form.replace('mesh', 'ply')}"
        done = spacesim("export", run.path, f"--{form}", out, *sun, *earth)
        assert done.code == 0, done.errors
        assert (NO_EARTH in done.errors) == (earth == ())
        contents.append(out.read_bytes())
    assert contents[0] == contents[1] != contents[2]


@pytest.mark.parametrize("model", ["run", "shadowed"])
def test_a_sweep_keeps_the_earth_of_its_frame(spacesim, request, model, earthlit, tmp_path):
    """Whose shadow falls on models that have not learned its light, too."""
    run = request.getfixturevalue(model)
    options = "--frame", 16, "--frames", 1, "--keep-frames", "--out", tmp_path / "sweep"
    done = spacesim("sweep", run.path, *options)
    assert done.code == 0, done.errors
    frame = earthlit.test[0]
    sun = Sun(Sun.from_angles(0, 30).direction, frame.sun.earth)
    (picture,) = (tmp_path / "sweep/frames").iterdir()
    np.testing.assert_allclose(read_png(picture)[..., :3] / 255, run.predict(frame.camera, sun).rgb, atol=1 / 255)
    night = "--frame", 16, "--frames", 1, "--elevation", -80, "--keep-frames", "--out", tmp_path / "night"
    assert spacesim("sweep", run.path, *night).code == 0
    (picture,) = (tmp_path / "night/frames").iterdir()
    assert read_png(picture)[..., :3].max() == 0


def test_a_served_run_has_the_earth_of_its_data_or_scene(run, shadowed, earthlit, tmp_path, caplog):
    frame = earthlit.test[0]
    elsewhere = replace(frame.sun, earth=Earth(np.array([0.0, 1, 0.3]), 40.0))
    scene = tmp_path / "scene.toml"
    scene.write_text(
        f'[[models]]\nrun = "{run.path}"\n[earth]\ndirection = [0, 1, 0.3]\nangular_radius_deg = 40\n'
        "[sun]\nazimuth_deg = 0\nelevation_deg = 0\n"
    )
    for what, sun in ((run.path, frame.sun), (scene, elsewhere), (shadowed.path, beside_the_limb(frame, -2.0))):
        served = load_served(what)
        (seen,) = served.draw(frame.camera, Sun(sun.direction), None, ("rgb",), 0).values()
        np.testing.assert_allclose(seen / 255, np.clip(served.run.predict(frame.camera, sun).rgb, 0, 1), atol=1 / 255)
    assert seen.max() == 0
    assert "left out" not in caplog.text


def test_a_served_run_says_that_it_is_left_out(run, earthlit, caplog):
    moved = replace(earthlit.train[0].sun, earth=Earth(np.array([0.0, 1, 0])))
    several = replace(earthlit, root=run.path, train=(replace(earthlit.train[0], sun=moved), *earthlit.train[1:]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("spacesim.data.store.read_dataset", lambda _: several)
        served = load_served(run.path)
    assert served.earth is None
    assert f"{run.path} has learned the Earth's light, which is left out" in caplog.text
    assert "several Earths" not in caplog.text


def test_an_earth_that_gives_no_light_is_not_learned(small_lit_dataset, tmp_path, caplog):
    """That of a trajectory; it hides the Sun."""
    dark = [replace(f, sun=replace(f.sun, earth=Earth(-f.sun.direction, albedo=0.0))) for f in small_lit_dataset.train]
    dataset, short = replace(small_lit_dataset, train=tuple(dark)), replace(CONFIG, iterations=1)
    run = train(dataset, tmp_path / "run", short)
    assert not run.knows_earth
    assert "without the Earth's light" not in caplog.text, "none of the others gives some either"
    frame = small_lit_dataset.test[0]
    sun = replace(frame.sun, earth=Earth(frame.sun.direction, albedo=0.0))
    assert run.predict(frame.camera, sun).rgb.max() == 0 < run.predict(frame.camera, frame.sun).rgb.max()
    with pytest.raises(InputError, match=r"expected earth_direction .*, with earth_albedo above 0, found none in"):
        train(dataset, tmp_path / "asked", with_settings(short, {"light.earth": True}))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("spacesim.data.store.read_dataset", lambda _: dataset)  # two Suns, each with an Earth opposite
        assert load_served(run.path).earth is None
    assert f"the frames of {dataset.root} name several Earths, none of which hides the Sun here" in caplog.text


def test_frames_that_name_no_earth_among_others_are_named(small_lit_dataset, tmp_path, caplog):
    """One that names none leaves the Earth out of the model, which is said."""
    first, *others = small_lit_dataset.train
    lit = [replace(frame, sun=replace(frame.sun, earth=Earth(-frame.sun.direction))) for frame in others]
    run = train(replace(small_lit_dataset, train=(first, *lit)), tmp_path / "run", replace(CONFIG, iterations=1))
    assert not run.knows_earth
    assert f"without the Earth's light: {first.file_path} names no Earth that gives some, others do" in caplog.text


def test_what_cannot_be_is_named(spacesim, small_lit_dataset, tmp_path):
    with pytest.raises(InputError, match=r"earth: expected false or light\.field\.inputs=surface.*, found directions"):
        LightConfig(FieldConfig(), earth=True)
    with pytest.raises(InputError, match=r"bounce: expected 0 or light\.field\.inputs=surface.*, found view"):
        LightConfig(FieldConfig(inputs=ViewAloneConfig()), bounce=64)
    needed = with_settings(CONFIG, {"light.earth": True})
    with pytest.raises(InputError, match=r"expected earth_direction in every training frame .*, found none in images/"):
        train(small_lit_dataset, tmp_path / "run", needed)
    blind = train(small_lit_dataset, tmp_path / "blind", replace(CONFIG, iterations=1))
    done = spacesim("render", blind.path, "--sun", "none", "--out", tmp_path / "a.png")
    assert done.is_refusal("--sun", "light.earth", f"found {blind.path}, trained without it")
    plain = train(small_lit_dataset, tmp_path / "plain", replace(preset("demo", "vanilla"), iterations=1))
    refused = spacesim("render", plain.path, "--earth", "0,0", "--out", tmp_path / "a.png")
    assert refused.is_refusal("--earth", "expected a run that the Sun relights", plain.path)
    refused = spacesim("export", blind.path, "--mesh", tmp_path / "a.ply", "--earth", "0,0")
    assert refused.is_refusal("--earth", "expected with --sun, --html, found without one")
    frame = small_lit_dataset.test[0]
    with pytest.raises(InputError, match=r"light: expected a run that has learned the Earth's light .*, found .*blind"):
        blind.render(frame.camera, frame.sun, light="earth")
