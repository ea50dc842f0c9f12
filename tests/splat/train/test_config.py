"""Digests of presets, settings by name, and config.json in its older form."""

import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from tiny import REFINED

import spacesim as ss
from spacesim.data.errors import InputError
from spacesim.splat.light.field import DirectionsConfig
from spacesim.splat.light.shadow.cast import SplattingConfig
from spacesim.splat.train.config import (
    METHODS,
    PRESETS,
    TrainConfig,
    preset,
    shortened,
    warm_start,
    with_options,
    with_settings,
)
from spacesim.splat.train.strategies.factory import make_strategy
from spacesim.splat.train.strategies.mcmc import McmcConfig
from spacesim.splat.train.strategies.mesh_aware import MeshAwareConfig
from spacesim.splat.train.train import train

OLD = json.loads((Path(__file__).parent / "older_configs.json").read_text(encoding="utf-8"))
"""{preset, method and strategy: its config.json} in the older form, with the settings of all strategies."""
DIGESTS = {
    "demo": "e185fb91b60c0661",
    "fast": "0622e29fc4e49ddc",
    "fine": "52f07651ec4c2360",
    "thesis": "edb72c435b0398fb",
}
"""Of these methods and strategies of a preset: a change here changes trained models."""
HASHED = (
    ("vanilla", "relight", "shadow-map", "shadow-splat", "baseline-park"),
    ("default", "mesh-aware", "support-aware", "mcmc"),
)


def as_it_was(config: TrainConfig) -> TrainConfig:
    """What that run has, and the preset has not."""
    if config.preset == "thesis":
        return thesis_as_it_was(config)
    config = replace(config, sh_every=600 if config.preset == "demo" else 1_000)
    if config.method == "vanilla":
        rates = {"rates.sh_rest": 1.25e-4, "rates.sh_constant": 2.5e-3, "rates.decay": "exponential"}
        return with_settings(config, {**rates, "antialiased": False, "surfels": False})
    if config.method == "baseline-park":
        return with_settings(config, {"light.shadow.method.beta_min": 0.05})
    features = 16 if config.preset == "demo" else 32
    settings = {"light.field.features": features, "rates.features_final": config.rates.features, "surfels": False}
    settings["hidden_weight"] = 0.0
    if config.method in ("shadow-map", "shadow-splat"):
        fine = {"supersample": 2, "light.bounce": 1024, "iterations": 20_000, "refinement.prune_opacity": 0.005}
        settings |= {"views_per_step": 1, "light.gloss": False, "refinement.max_gaussians": 250_000}
        settings["rates.surface_start"] = 1.0
        settings |= fine if config.preset == "fine" else {"supersample": 1, "light.bounce": 256}
        if config.preset == "fast":
            settings["refinement.split_screen_size"] = 0.03
    if (config.preset, config.method) == ("demo", "shadow-map"):
        settings |= {**REFINED, "iterations": 3000, "init_count": 8000, "rates.decay": "exponential"}
        settings |= {"refinement.refine_start": 300, "refinement.refine_stop": 2000}
        settings["refinement.split_screen_size"] = 0.06
    if config.method == "shadow-splat":  # of these the one of `fine`
        settings |= {"refinement.split_screen": "all", "refinement.split_screen_size": 0.015}
        settings |= {"light.shadow.bias": 5.0, "light.shadow.size": 1024, "light.shadow.method.beta_min": 0.05}
    return with_settings(config, settings)


def thesis_as_it_was(config: TrainConfig) -> TrainConfig:
    shadow = {"method": {"beta_min": 0.05}, "crop": True, "between": "others", "refine": {"residual": True}}
    return replace(
        with_settings(config, {"light.shadow": shadow}),
        splatfacto_start=False,
        means_steps=None,
        random_behind_opaque=False,
        num_downscales=0,
        isotropy_weight=0.01,
        refinement=replace(config.refinement, screen_size_stop=150_000),
    )


@pytest.mark.parametrize("name", PRESETS)
def test_presets_keep_their_digests(name):
    every = [preset(name, method, strategy).to_json() for method in HASHED[0] for strategy in HASHED[1]]
    text = json.dumps([*every, replace(preset(name), warm_start=warm_start(name)).to_json()], sort_keys=True)
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == DIGESTS[name]


@pytest.mark.parametrize("name", OLD)
def test_a_configuration_of_an_older_run_is_the_same_one(name):
    config = TrainConfig.from_json({**OLD[name], "data": {}})
    assert config == as_it_was(preset(*name.split()))
    assert TrainConfig.from_json(json.loads(json.dumps(config.to_json()))) == config


@pytest.mark.parametrize("gradients", [False, True])
def test_an_older_run_may_have_had_gradients_through_shadows(gradients):
    """In the older form, and in the one that names a kind."""
    older = json.loads(json.dumps(OLD["fine shadow-splat support-aware"]))
    config = TrainConfig.from_json(older)
    newer = config.to_json()
    older["light"]["shadow"]["gradients"] = newer["light"]["shadow"]["method"]["gradients"] = gradients
    assert TrainConfig.from_json(older) == TrainConfig.from_json(newer) == config


def test_older_runs_in_linear_light_gave_colors_as_they_are():
    config = with_settings(preset("fast", "shadow-splat"), {"light.linear": True})
    assert config.light.encoded
    values = config.to_json()
    assert TrainConfig.from_json(values) == config
    del values["light"]["encoded"]
    assert not TrainConfig.from_json(values).light.encoded


@pytest.mark.parametrize("method", ["shadow-map", "shadow-splat", "baseline-park"])
def test_the_thesis_has_the_light_of_its_text(method):
    shadow = preset("thesis", method).light.shadow
    assert (shadow.crop, shadow.between, shadow.grazing) == (False, "ratio", "none")  # 4.32, 4.15, 4.26
    assert not shadow.refine.residual  # 4.13
    if method == "shadow-map":
        assert (shadow.method.filter, shadow.method.antialiased) == ("bilinear", False)  # 4.4, 4.5
    else:
        assert shadow.method.beta_min == 0.004  # 4.10
    assert shadow.bias == (0 if method == "baseline-park" else 10)  # table 4.3
    ours = preset("fine", method).light.shadow
    assert (ours.crop, ours.between, ours.refine.residual) == (True, "others", True)


@pytest.mark.parametrize(("changed", "said"), [("radiance", "by the mu-law"), ("gradients", "through their shadows")])
def test_what_training_does_no_longer_is_not_resumed(small_lit_dataset, tmp_path, changed, said):
    small = {"iterations": 2, "checkpoint_every": 1, "init_count": 40, "light.shadow.size": 16}
    config = with_settings(preset("demo", "shadow-splat"), small)
    if changed == "radiance":
        config = with_settings(config, {"light.linear": True, "light.radiance": True})
    train(small_lit_dataset, tmp_path / "run", config)
    (tmp_path / "run/model.safetensors").unlink()
    values = json.loads((tmp_path / "run/config.json").read_text())
    if changed == "radiance":
        del values["light"]["encoded"]
        config = replace(config, light=replace(config.light, encoded=False))
    else:
        values["light"]["shadow"]["method"]["gradients"] = True
    (tmp_path / "run/config.json").write_text(json.dumps(values))
    with pytest.raises(InputError, match=f"run: expected a run that this version has begun, .*{said}; train it anew"):
        train(small_lit_dataset, tmp_path / "run", config, resume=True)
    assert json.loads((tmp_path / "run/config.json").read_text()) == values


def test_an_older_run_is_resumed(small_lit_dataset, tmp_path):
    config = replace(as_it_was(preset("demo", "shadow-map", "mesh-aware")), iterations=2, init_count=40)
    run = train(small_lit_dataset, tmp_path / "run", config)
    path = run.path / "config.json"
    data = json.loads(path.read_text())["data"]
    data["digest"], content = data["digest"].split("-")  # the shorter form is still read
    assert content
    path.write_text(json.dumps({**OLD["demo shadow-map mesh-aware"], "iterations": 2, "init_count": 40, "data": data}))
    assert train(small_lit_dataset, tmp_path / "run", config, resume=True).gaussian_count == run.gaussian_count
    model = run.path / "model.safetensors"
    before = model.read_bytes()
    model.unlink()
    resumed = ss.train(small_lit_dataset, run.path, resume=True)  # whose configuration is that of the older config.json
    assert resumed.config == run.config
    assert model.read_bytes() == before
    with pytest.raises(InputError, match=r"was started with method 'shadow-map', .* found 'vanilla'"):
        ss.train(small_lit_dataset, run.path, method="vanilla", resume=True)
    with pytest.raises(InputError, match=r"was started with seed 0, .* found 7"):
        ss.train(small_lit_dataset, run.path, seed=7, resume=True)
    other = with_settings(config, {"strategy.cull_every": 77})
    with pytest.raises(InputError, match=r"strategy\.cull_every 500, .* found 77"):
        train(small_lit_dataset, tmp_path / "run", other, resume=True)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("strategy", "mesh-awful", "strategy.kind: expected one of default, mesh-aware"),
        ("mesh_aware", {"cull_evry": 3}, "strategy.cull_evry: expected one of kind, cull_every"),
        (
            "light",
            {"shadow": {"method": "mapping", "mapping": {"filter": 3}}},
            "light.shadow.method.filter: expected one",
        ),
        ("light", [], "light: expected a table"),
        ("method", 3, "method: expected one of vanilla"),
    ],
)
def test_wrong_values_of_an_older_configuration_are_named(key, value, said):
    with pytest.raises(InputError, match=f"config.json: {said}"):
        TrainConfig.from_json({**OLD["demo shadow-map mesh-aware"], key: value})


def test_settings_do_not_depend_on_their_order():
    config = preset("fast", "shadow-map")
    settings = {
        "light.tone": "filmic",
        "light.linear": True,
        "strategy.growth": 0.5,
        "strategy": "mcmc",
        "light.field.inputs.view.degree": 2,
        "light.field.inputs": "directions",
        "light.bounce": 0,
        "light.shadow.refine": "none",
        "light.shadow.grazing": "none",
    }
    made = with_settings(config, settings)
    assert made == with_settings(config, dict(reversed(settings.items())))
    assert made.light.tone == "filmic"
    assert made.strategy == McmcConfig(growth=0.5)
    assert made.light.field.inputs == DirectionsConfig(view=replace(DirectionsConfig().view, degree=2))
    assert (made.light.shadow.refine, made.light.shadow.grazing) == (None, "none")
    assert with_settings(config, {}) == config


def test_choosing_the_present_alternative_keeps_its_settings():
    config = preset("fast", "shadow-map")
    assert with_settings(config, {"light.shadow.method": "mapping"}) == config
    bilinear = with_settings(config, {"light.shadow.method": {"filter": "bilinear"}}).light.shadow.method
    assert bilinear == replace(config.light.shadow.method, filter="bilinear")
    splat = replace(config, light=preset("fast", "shadow-splat").light)
    wider = with_settings(splat, {"light.shadow.method": {"kind": "splatting", "beta_min": 0.1}})
    assert wider.light.shadow.method == SplattingConfig(beta_min=0.1)


def test_an_alternative_is_chosen_by_its_name_or_its_kind():
    config = preset("fast", "shadow-map", "mcmc")
    other = with_settings(config, {"strategy.cull_every": 7, "strategy.kind": "mesh-aware"})
    assert other.strategy == MeshAwareConfig(cull_every=7)
    assert with_settings(config, {"strategy.kind": "default"}) == with_settings(config, {"strategy": "default"})
    grown = with_settings(config, {"strategy.growth": 0.5})
    assert with_settings(grown, {"strategy.kind": "mcmc"}) == grown
    with pytest.raises(InputError, match=r"^strategy\.growth: expected one of kind, .* kind mcmc knows it"):
        with_settings(config, {"strategy.kind": "default", "strategy.growth": 0.5})
    with pytest.raises(InputError, match=r"^kind: expected a field of TrainConfig, found 'kind'"):
        with_settings(config, {"kind": "default"})


def test_the_light_tells_the_method():
    for method in METHODS:
        config = preset("fast", method)
        assert config.method == config.to_json()["method"] == method
        assert {replace(preset("fast", other), light=config.light).method for other in METHODS} == {method}


def test_a_file_has_the_light_of_its_method():
    for method in METHODS:
        written = preset("fast", method).to_json()
        for other in METHODS:
            values = {**written, "method": other}
            if {other, method} <= {"shadow-splat", "baseline-park"} or other == method:
                assert TrainConfig.from_json(values).method == other
            else:
                with pytest.raises(InputError, match=f"config.json: light: expected .* the method {other}'s, found"):
                    TrainConfig.from_json(values)
    with pytest.raises(InputError, match=r"light: expected shadow splatting, .*, found shadow splatting as table 4.3"):
        with_settings(preset("fast", "shadow-splat"), {"light.shadow.method.baseline": True})


def test_the_alias_park_of_the_baseline_is_accepted(tiny_data, tmp_path):
    assert preset("fast", "park") == preset("fast", "baseline-park")
    small = {"iterations": 1, "init_count": 40, "settings": {"light.shadow.size": 16}}
    run = ss.train(tiny_data, tmp_path / "run", preset="demo", method="park", **small)
    assert run.config["method"] == "baseline-park"
    assert run.config["light"]["shadow"]["size"] == 16
    with pytest.raises(
        InputError, match=r"light\.shadow\.sise: expected one of method, size, .* mean light.shadow.size"
    ):
        ss.train(tiny_data, tmp_path / "other", method="park", settings={"light.shadow.sise": 16})


@pytest.mark.parametrize("names", [{"preset": "junk"}, {"method": "relight"}, {"strategy": "mcmc"}])
def test_a_configuration_excludes_preset_and_method(tmp_path, names):
    ((name, word),) = names.items()
    with pytest.raises(InputError, match=f"{name}: expected none beside a configuration, found '{word}'"):
        ss.train(tmp_path / "nothing", tmp_path / "run", preset("fast"), **names)


def test_settings_are_checked_before_the_dataset_is_read(tmp_path):
    with pytest.raises(InputError, match=r"^sede: expected"):
        ss.train(tmp_path / "nothing", tmp_path / "run", settings={"sede": 1})
    with pytest.raises(InputError, match=r"^iterations: expected at least 1, found 0"):
        ss.train(tmp_path / "nothing", tmp_path / "run", iterations=0)
    with pytest.raises(InputError, match=r"did you mean settings=\{'refinement.max_gaussians': 5\}\?"):
        ss.train(tmp_path / "nothing", tmp_path / "run", max_gaussians=5)
    for twice in ("iterations", 5), ("strategy", "default"):
        with pytest.raises(InputError, match=rf"^{twice[0]}: expected none beside settings\['{twice[0]}'\], found "):
            ss.train(tmp_path / "nothing", tmp_path / "run", settings=dict([twice]), **dict([twice]))
    with pytest.raises(InputError, match=r"^itertions: .* did you mean iterations\?"):
        ss.train(tmp_path / "nothing", tmp_path / "run", itertions=5)


def test_a_shorter_training_shortens_its_schedule():
    """A tenth of `fast`, whose last refinement comes long before the end; a longer one goes on after it."""
    config = replace(preset("fast", strategy="support-aware"), warm_start=warm_start("fast"))
    short, before = shortened(config, 700), config.refinement
    after = short.refinement
    assert (short.iterations, short.sh_every) == (700, 0)
    assert (after.refine_start, after.pause_after_reset, after.refine_stop) == (50, 100, 500)
    names = ("refine_every", "reset_every", "screen_size_stop", "max_gaussians")
    assert [getattr(after, name) for name in names] == [getattr(before, name) for name in names]
    assert short.strategy == replace(config.strategy, warm_up=50, backfill_start=100)
    assert (short.warm_start.steps, short.warm_start.decay, short.warm_start.conservative) == (100, 100, 50)
    assert shortened(config, 14_000) == replace(config, iterations=14_000)
    assert with_options(config, iterations=700) == short
    by_degrees = replace(config, sh_every=1_000)
    assert [shortened(by_degrees, n).sh_every for n in (700, 1)] == [100, 1]
    assert shortened(config, 1).sh_every == 0


def test_degrees_of_harmonics_join_one_by_one_or_all_at_once():
    assert [TrainConfig(sh_every=20).degree(step) for step in (0, 19, 20, 60, 1000)] == [0, 0, 1, 3, 3]
    assert [TrainConfig(sh_every=0, sh_degree=2).degree(step) for step in (0, 1, 1000)] == [2, 2, 2]


@pytest.mark.parametrize(("name", "shortest"), [("demo", 300), ("fast", 300), ("fine", 1000), ("thesis", 300)])
def test_short_trainings_refine_and_then_go_on(name, shortest):
    """At every length some refinement happens, and its last fifth is for what that leaves."""
    for iterations in range(shortest, 3000, 50):
        refinement = shortened(preset(name), iterations).refinement
        steps = [step for step in range(0, iterations + 1, 50) if refinement.refines_at(step)]
        assert steps
        assert max(steps) <= 0.8 * iterations


def test_refinement_that_would_outlast_the_training_ends_before(small_dataset):
    for iterations, stop in ((20_000, 15_000), (150_000, 112_500), (160_000, 150_000)):
        config = replace(preset("thesis"), iterations=iterations)
        assert make_strategy(config, small_dataset, 1.0, 1).config.refine_stop == stop


def test_beginnings_take_up_to_a_twentieth_of_a_short_training():
    """A tenth of `thesis` has its last refinement in its place, and table 5.1's beginnings as they are."""
    thesis = shortened(preset("thesis", strategy="mesh-aware"), 20_000)
    assert (thesis.refinement.refine_start, thesis.refinement.refine_stop) == (500, 15_000)
    assert (thesis.refinement.pause_after_reset, thesis.refinement.screen_size_stop) == (1_000, 4_000)
    assert (thesis.sh_every, thesis.strategy.cull_every) == (1_000, 1_000)


def test_the_command_line_and_python_shorten_alike(spacesim, tiny_data, tmp_path):
    done = spacesim("train", tiny_data, "--out", tmp_path / "run", "--preset", "demo", "--iterations", "30")
    assert done.code == 0, done.errors
    by_api = ss.train(tiny_data, tmp_path / "api", preset="demo", iterations=30)
    for run in (ss.load_run(tmp_path / "run"), by_api):
        assert run.config["refinement"]["refine_stop"] == 20


def test_iterations_shorten_alike_however_they_are_set(spacesim):
    """As an option and by --set, and before what else is set."""
    config = replace(preset("fast"), warm_start=warm_start("fast"))
    short = shortened(config, 700)
    assert with_settings(config, {"iterations": 700}) == short
    own = with_settings(config, {"refinement.refine_start": 7, "iterations": 700})
    assert own == replace(short, refinement=replace(short.refinement, refine_start=7))
    option = spacesim("train", "--fields", "--iterations", 700).output
    assert spacesim("train", "--fields", "--set", "iterations=700").output == option
    assert re.search(r"^refinement\.refine_start +50 ", option, re.MULTILINE)
