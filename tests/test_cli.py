"""The commands of the contract: what they print and write, and how they refuse bad usage and bad input."""

import json
import re
import shutil
import subprocess
import sys
import warnings
from argparse import Namespace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from tiny import GENERATE, PROGRAM, TRAIN, contents

from spacesim.cli.parser import view_of
from spacesim.cli.printing import RELATIVE, print_headline
from spacesim.cli.program import COMMANDS as ALL_COMMANDS
from spacesim.cli.program import in_flags, parser
from spacesim.data.errors import InputError
from spacesim.data.images import read_exr, read_png, srgb_from_linear
from spacesim.data.importers.kinds import KINDS
from spacesim.data.mesh import read_mesh
from spacesim.data.store import find_unreadable_files, read_dataset
from spacesim.splat.export.ply import read_ply
from spacesim.splat.run import load_run

THESIS = {"kind": "directions"} | {name: {"kind": "harmonics", "degree": 4} for name in ("sun", "view")}
A_FIELD = "expected a field that spacesim train --fields lists"
WITHOUT_NUMBERS = ("doctor", "demo", "eval", "report", "locate", "verify", "import")
COMMANDS = ("doctor", "demo", "generate", "train", "eval", "report", "render", "sweep", "export", "reproduce")


def test_help_names_every_command(spacesim):
    shown = spacesim("--help")
    assert shown.code == 0
    assert all(re.search(rf"^ +{name}\b", shown.output, re.MULTILINE) for name in COMMANDS)
    assert spacesim("--version").output.startswith("spacesim ")


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(spacesim, command):
    shown = spacesim(command, "--help")
    assert shown.code == 0
    assert shown.output.startswith(f"usage: spacesim {command}")


def test_the_module_is_a_program_too():
    done = subprocess.run([sys.executable, "-m", "spacesim.cli", "--version"], capture_output=True, text=True)
    assert done.returncode == 0
    assert done.stdout.startswith("spacesim ")


@pytest.mark.parametrize(
    ("words", "keys", "value"),
    [
        ("--method shadow-map --set light.shadow.bias=0", "light shadow bias", 0),
        ("--method shadow-map --set light.linear=true", "light linear", True),
        ("--method shadow-map --set light.tone=filmic --set light.linear=true", "light tone", "filmic"),
        ("--method shadow-map --set light.linear=true --set light.exposure=-1.5", "light exposure", -1.5),
        ("--method shadow-map --set light.shadow.method.filter=bilinear", "light shadow method filter", "bilinear"),
        ("--method shadow-map --set light.field.inputs=directions --set light.bounce=0", "light field inputs", THESIS),
        ("--method park --set light.field.inputs=directions", "light field inputs view kind", "positional"),
        ("--method baseline-park", "method", "baseline-park"),
        ("--method park", "method", "baseline-park"),
        ("--method shadow-map --set light.shadow.grazing=none", "light shadow grazing", "none"),
        ("--method shadow-map --set light.shadow.size=24", "light shadow size", 24),
        (
            "--method shadow-map --set light.shadow.method={filter='percentage-closer',radius=2.5}",
            "light shadow method radius",
            2.5,
        ),
        ("--method shadow-map --set light.shadow.refine=none", "light shadow refine", None),
        ("--method shadow-splat --set light.shadow.method.beta_min=0.1", "light shadow method beta_min", 0.1),
        ("--method shadow-splat --set visibility_weight=0.3", "visibility_weight", 0.3),
        ("--method relight --set light.bounce=7", "light bounce", 7),
        ("--method vanilla --set supersample=3", "supersample", 3),
        ("--set antialiased=true --set antialiased=false", "antialiased", False),
        ("--set seed=30", "seed", 30),
        ("--strategy mesh-aware --set strategy.cull_every=77", "strategy cull_every", 77),
        ("--set strategy.growth=0.5 --set strategy=mcmc", "strategy growth", 0.5),
        ("--max-gaussians 99", "refinement max_gaussians", 99),
        ("--warm-start --set warm_start.steps=1", "warm_start steps", 1),
        ("--set warm_start={}", "warm_start steps", 2000),
    ],
)
def test_settings_reach_the_run(spacesim, tiny_data, tmp_path, words, keys, value):
    small = "--preset", "demo", "--iterations", 1, "--set", "init_count=50"
    shadowed = re.search("shadow|park", words) and "shadow.size" not in words
    size = ("--set", "light.shadow.size=16") if shadowed else ()
    assert spacesim("train", tiny_data, "--out", tmp_path / "run", *small, *size, *words.split()).code == 0
    found = json.loads((tmp_path / "run/config.json").read_text())
    for key in keys.split():
        found = found[key]
    assert found == value


def test_the_help_of_train_fits_on_a_screen(spacesim, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    shown = spacesim("train", "--help").output
    assert shown.count("\n") <= 40
    assert re.search(r"--iterations N +steps of training \(default: of the preset\)", shown)
    assert "docs/how-to/choose.md" in shown
    options = re.findall(r"^  (--[a-z-]+)", shown, re.MULTILINE)
    assert len(options) <= 16
    assert options == [
        *("--out", "--method", "--strategy", "--preset", "--iterations", "--seed", "--init"),
        *(
            "--max-gaussians",
            "--warm-start",
            "--sun",
            "--refine-poses",
            "--resume",
            "--set",
            "--fields",
            "--backend",
            "--debug",
        ),
    ]


def test_fields_are_listed_with_the_defaults_of_a_preset(spacesim):
    def listed(*words: str) -> dict[str, list[str]]:
        done = spacesim("train", "--fields", "--method", "shadow-map", *words)
        assert done.code == 0
        return {line.split()[0]: line.split()[1:] for line in done.output.splitlines()}

    fast, fine = listed(), listed("--preset", "fine", "--set", "seed=8")
    some = "light.shadow.method.filter", "views_per_step", "seed"
    assert [fast[name][0] for name in some] == ["median", "1", "0"]
    assert [fine[name][0] for name in some] == ["variance", "2", "8"]
    assert "strategy.cull_every" in listed("--strategy", "mesh-aware")
    assert "strategy.cull_every" not in fast
    meaning = "Gaussians at the start, at most, and no more than refinement.max_gaussians"
    assert " ".join(fast["init_count"]) == f"20000 {meaning} [whole number]"


@pytest.mark.parametrize(
    ("option", "setting"),
    [
        (("--iterations", 0), "iterations=4"),
        (("--seed", 4), "seed=4"),
        (("--init", "random"), "init='mesh'"),
        (("--max-gaussians", 5), "refinement.max_gaussians=4"),
        (("--strategy", "default"), "strategy='mcmc'"),
        (("--sun", "given"), "sun='unknown'"),
        (("--refine-poses",), "refine_poses=False"),
        (("--warm-start",), "warm_start='none'"),
    ],
)
def test_an_option_and_a_setting_of_the_same_field_are_refused(spacesim, option, setting):
    key, _, value = setting.partition("=")
    done = spacesim("train", "--fields", *option, "--set", setting.replace("False", "false"))
    assert done.is_refusal(f"--set {key}: expected none beside {option[0]}, found {value}")


@pytest.mark.parametrize("strategy", ["mesh-aware", "support-aware"])
def test_backfill_keeps_to_the_most_gaussians(spacesim, tiny_data, tmp_path, strategy):
    words = "--preset", "demo", "--iterations", 420, "--set", "init_count=100", "--max-gaussians", 150
    assert spacesim("train", tiny_data, "--out", tmp_path / "run", "--strategy", strategy, *words).code == 0
    assert 100 <= json.loads((tmp_path / "run/training.json").read_text())["gaussians"] <= 150


def test_demo_is_importable():
    from spacesim.demo import DATA, SCENE, demo
    from spacesim.scenes.scenefile import read_scene

    assert callable(demo)
    assert read_scene(SCENE, **DATA).name == SCENE


def test_doctor(spacesim):
    spoken, parsed = spacesim("doctor"), spacesim("doctor", "--json")
    assert spoken.code == parsed.code == 0
    findings = json.loads(parsed.output)
    assert findings["backend"] in ("cuda", "llvm", None)
    assert spoken.output.splitlines()[-1].startswith(("Ready:", "Nothing can be rendered"))


def test_generate_writes_a_whole_dataset(tiny_data):
    assert find_unreadable_files(tiny_data) == []
    dataset = read_dataset(tiny_data)
    assert (len(dataset.train), len(dataset.test)) == (6, 2)
    assert json.loads((tiny_data / "scene.json").read_text())["config"]["quality"]["spp"] == 4


def test_verify_draws_where_cameras_look_from(spacesim, tiny_data, tmp_path):
    done = spacesim("verify", tiny_data, "--camera-density", tmp_path / "map.png")
    assert done.code == 0
    assert (tmp_path / "map.png").read_bytes() == (tiny_data / "camera_density.png").read_bytes()


def test_verify_says_how_to_mend_what_was_imported(spacesim, tiny_data, tmp_path):
    assert spacesim("import", "nerfstudio", tiny_data, "--out", tmp_path / "data").code == 0
    picture = next((tmp_path / "data/images").iterdir())
    picture.write_bytes(picture.read_bytes()[:-40])
    done = spacesim("verify", tmp_path / "data")
    assert done.code == 1
    assert done.errors[-1].endswith("1 faulty file; import it again, into a new folder")
    assert "generate" not in "".join(done.errors)


def test_suns_are_given_by_azimuth_and_elevation(spacesim, tmp_path):
    small = ("--views", "1", "--test-views", "0", "--resolution", "8", "--spp", "1")
    done = spacesim("generate", "boxsat", "--out", tmp_path / "data", *small, "--sun", "200,-10", "--sun", "5.5,80")
    assert done.code == 0, done.errors
    angles = [frame.sun.angles for frame in read_dataset(tmp_path / "data").train]
    assert np.allclose(angles, [(200, -10), (5.5, 80)])


def test_help_lists_the_built_in_scenes(spacesim):
    from spacesim.scenes.scenefile import BUILT_IN_SCENES

    shown = "".join(spacesim("generate", "--help").output.split())  # lines may break at hyphens
    assert f"({','.join(BUILT_IN_SCENES)})" in shown


def test_a_printed_scene_makes_the_same_dataset(spacesim, tmp_path):
    small = (
        "--views",
        "1",
        "--test-views",
        "0",
        "--resolution",
        "12x8",
        "--spp",
        "1",
        "--fov",
        "20",
        "--distance",
        "9",
    )
    options = (*small, "--exposure", "0.001", "--seed", "5", "--sun", "200,-10")
    printed = spacesim("generate", "boxsat", *options, "--print")
    assert printed.code == 0, printed.errors
    (tmp_path / "boxsat.toml").write_text(printed.output, encoding="utf-8")
    assert spacesim("generate", "boxsat", *options, "--out", tmp_path / "a").code == 0
    done = spacesim("generate", tmp_path / "boxsat.toml", "--out", tmp_path / "b")
    assert done.code == 0, done.errors
    assert done.output == f"{tmp_path / 'b'}: 1 training and 0 test frames of boxsat\n"
    made = [
        {p.relative_to(root): p.read_bytes() for p in root.rglob("*.*")} for root in (tmp_path / "a", tmp_path / "b")
    ]
    assert made[0] == made[1]
    camera = read_dataset(tmp_path / "a").train[0].camera
    assert (camera.width, camera.height) == (12, 8)
    assert np.isclose(camera.fx, 6 / np.tan(np.radians(10)))
    assert np.isclose(json.loads((tmp_path / "a/scene.json").read_text())["exposure"], 0.001)


def test_a_broken_scene_file_ends_in_a_sentence_with_its_line(spacesim, tmp_path):
    (tmp_path / "my.toml").write_text('[[objects]]\nspacecraft = "boxsat"\n\n[rig]\nveiws = 3\n', encoding="utf-8")
    refused = spacesim("generate", tmp_path / "my.toml", "--out", tmp_path / "out")
    assert refused.is_refusal(f"{tmp_path / 'my.toml'}, line 5: rig.veiws:", "did you mean rig.views?")
    assert not (tmp_path / "out").exists()


def test_train_leaves_a_run(tiny_run, tiny_data):
    run = load_run(tiny_run)
    assert run.config["iterations"] == 50
    assert run.config["data"]["path"] == str(tiny_data.resolve())
    assert run.training["history"][-1]["iteration"] == 50
    assert run.gaussian_count == 300


def test_training_again_needs_resume_and_resuming_a_finished_run_changes_nothing(spacesim, tiny_run, tiny_data):
    before = {path: path.read_bytes() for path in tiny_run.rglob("*") if path.is_file()}
    assert spacesim("train", tiny_data, "--out", tiny_run, *TRAIN).is_refusal(tiny_run, "--resume")
    done = spacesim("train", tiny_data, "--out", tiny_run, *TRAIN, "--resume")
    assert done.code == 0
    assert {path: path.read_bytes() for path in tiny_run.rglob("*") if path.is_file()} == before


def test_resuming_with_another_configuration_is_refused(spacesim, tiny_run, tiny_data):
    other = spacesim("train", tiny_data, "--out", tiny_run, *TRAIN, "--seed", 3, "--resume")
    assert other.is_refusal(tiny_run, "seed 0", "3")


LIT = ("--method", "shadow-map", "--strategy", "mesh-aware", "--warm-start")
FIELD = ("--method", "nerf-relight", "--set=rays=512", "--set=samples=12", "--set=chunk=2048", "--set=width=16")
SHORT = ("--preset", "demo", "--iterations", "6", "--seed", "3", "--set=checkpoint_every=4")
SMALL = ("--set=light.shadow.size=16", "--set=init_count=60")


@pytest.mark.parametrize("words", [LIT + SMALL, FIELD], ids=["Gaussians", "field"])
def test_what_is_not_given_is_resumed_as_it_was_started(spacesim, tiny_data, tmp_path, words):
    """The model is that of an uninterrupted training, to the bit; what is given must be what the run has."""
    run = tmp_path / "run"
    assert spacesim("train", tiny_data, "--out", run, *SHORT, *words).code == 0
    resume, files = ("train", tiny_data, "--out", run, "--resume"), ("model.safetensors", "config.json")
    whole = {name: (run / name).read_bytes() for name in files}
    for given in (), ("--seed", 3), words[:2], (*SHORT, *words):
        (run / "model.safetensors").unlink()
        done = spacesim(*resume, *given)
        assert done.code == 0, done.errors
        assert {name: (run / name).read_bytes() for name in files} == whole
        assert "after 6 iterations" in done.output
        assert (run / "checkpoints/step_00000004.safetensors").exists()
    others = [
        ("--seed 4", "seed 3, expected the same to resume it, found 4"),
        ("--iterations 5", "iterations 6, expected the same to resume it, found 5"),
        ("--method relight", f"method {words[1]!r}, expected the same to resume it, found 'relight'"),
        ("--preset fast", "preset 'demo', expected the same to resume it, found 'fast'"),
        ("--set checkpoint_every=5", "checkpoint_every 4, expected the same to resume it, found 5"),
    ]
    if "shadow-map" in words:
        others.append(("--strategy mcmc", "strategy 'mesh-aware', expected the same to resume it, found 'mcmc'"))
        others.append(("--set light.shadow.bias=3", "light.shadow.bias 5.0, expected the same to resume it, found 3.0"))
    else:
        others.append(("--strategy mcmc", "strategy None, expected the same to resume it, found 'mcmc'"))
        assert spacesim(*resume, "--warm-start").is_refusal("--warm-start: expected with a method of Gaussians, found")
    for given, said in others:
        assert spacesim(*resume, *given.split()).is_refusal(f"spacesim: {run}: was started with {said}")
    assert spacesim(*resume, "--method", "magic").is_refusal("--method: expected one of vanilla")


def test_a_run_without_a_checkpoint_is_begun_as_it_was(spacesim, tiny_data, tmp_path):
    run, words = tmp_path / "run", ("--iterations", 2, "--set", "init_count=50")
    first = ("train", tiny_data, "--out", run, "--preset", "demo", "--method", "relight", *words)
    for given, found in ([], ("relight", "demo")), (["--preset", "fast"], ("relight", "fast")):
        assert spacesim(*first).code == 0
        (run / "model.safetensors").unlink()
        assert spacesim("train", tiny_data, "--out", run, "--resume", *words, *given).code == 0
        config = json.loads((run / "config.json").read_text())
        assert (config["method"], config["preset"], config["iterations"]) == (*found, 2)
        shutil.rmtree(run)
    assert spacesim(*first).code == 0
    (run / "model.safetensors").unlink()
    (run / "config.json").write_text("{")
    assert spacesim("train", tiny_data, "--out", run, "--resume", "--preset", "demo", *words).code == 0
    (run / "config.json").write_text("{")
    assert spacesim("train", tiny_data, "--out", run, "--resume").is_refusal(run / "config.json")


def test_generating_again_needs_resume(spacesim, tiny_data):
    assert spacesim("generate", "boxsat", "--out", tiny_data, *GENERATE).is_refusal(tiny_data, "--resume")
    assert spacesim("generate", "boxsat", "--out", tiny_data, *GENERATE, "--seed", 1, "--resume").is_refusal("seed")
    done = spacesim("generate", "boxsat", "--out", tiny_data, *GENERATE, "--resume")
    assert done.code == 0


def test_eval_writes_numbers_pictures_and_a_page(tiny_eval):
    metrics = json.loads((tiny_eval / "metrics.json").read_text())
    assert metrics["schema"] == 1
    assert metrics["split"] == "test"
    assert metrics["model"]["gaussians"] == 300
    assert len(metrics["frames"]) == 2
    assert metrics["image"]["psnr"]["mean"] > 5
    assert (tiny_eval / "report.html").read_text().startswith("<!")
    assert read_png(tiny_eval / "frames" / metrics["frames"][0]["name"] / "truth.png").shape == (40, 40, 3)


def test_json_of_eval_stands_alone(tiny_run, tiny_data, tmp_path):
    program = PROGRAM.replace("spare_datasets", "spare_shapes")
    command = [sys.executable, "-c", program, "eval", tiny_run, "--data", tiny_data, "--out", tmp_path / "eval"]
    done = subprocess.run([*command, "--json", "--split", "train"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == json.loads((tmp_path / "eval/metrics.json").read_text())
    assert "Traceback" not in done.stderr


def test_report_shows_runs_side_by_side(spacesim, tiny_eval, tmp_path):
    other = tmp_path / "<script>alert(1)<"
    shutil.copytree(tiny_eval, other)
    metrics = json.loads((other / "metrics.json").read_text())
    (other / "metrics.json").write_text(json.dumps({**metrics, "run": "<script>alert(2)</script>", "data": str(other)}))
    done = spacesim("report", tiny_eval, other, "--out", tmp_path / "both.html")
    assert done.code == 0, done.errors
    page = (tmp_path / "both.html").read_text()
    assert "2 reconstructions" in page
    assert "<script>alert" not in page
    assert not re.search(r"""(src|href)=["']?(https?:|//|file:)""", page)


@pytest.mark.parametrize("kind", ["rgb", "depth", "alpha", "normal"])
def test_render_a_frame(spacesim, tiny_run, tiny_data, tmp_path, kind):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for suffix in ("png", "exr"):
            out = tmp_path / f"{kind}.{suffix}"
            done = spacesim("render", tiny_run, "--frame", 3, "--kind", kind, "--out", out)
            assert (done.code, done.output) == (0, f"{out}\n"), done.errors
    layer = read_exr(tmp_path / f"{kind}.exr")[kind]
    picture = read_png(tmp_path / f"{kind}.png")
    assert picture.shape == {"rgb": (40, 40, 4), "normal": (40, 40, 3)}.get(kind, (40, 40))
    assert layer.shape == ((40, 40, 3) if kind in ("rgb", "normal") else (40, 40))
    predicted = load_run(tiny_run).predict(read_dataset(tiny_data).frames[3].camera, None, normals=True)
    assert np.array_equal(layer, getattr(predicted, kind))


def test_render_a_camera_file(spacesim, tiny_run, tiny_data, tmp_path):
    meta = json.loads((tiny_data / "transforms.json").read_text())
    frame = next(frame for frame in meta["frames"] if frame["file_path"] == "images/test_00001.png")
    camera = {key: meta[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")}
    (tmp_path / "camera.json").write_text(json.dumps({**camera, "transform_matrix": frame["transform_matrix"]}))
    assert spacesim("render", tiny_run, "--camera", tmp_path / "camera.json", "--out", tmp_path / "a.png").code == 0
    assert spacesim("render", tiny_run, "--frame", 7, "--out", tmp_path / "b.png").code == 0
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_a_view_that_was_not_chosen_is_named(spacesim, tiny_run, tiny_data, tmp_path, caplog):
    common = ("render", tiny_run, "--out", tmp_path / "a.png")
    first = read_dataset(tiny_data).frames[0].file_path
    assert spacesim(*common).errors == [f"seen from frame 0, {first}; --frame K or --camera FILE takes another view"]
    assert spacesim(*common, "--frame", 0).errors == []
    whole = tiny_data / "transforms.json"
    with caplog.at_level("INFO", "spacesim"):
        assert spacesim(*common, "--camera", whole).code == 0
    file_path = json.loads(whole.read_text())["frames"][0]["file_path"]
    assert f"{whole}: the camera is its first frame's, {file_path}" in caplog.messages


def test_a_frame_is_seen_under_the_sun_that_was_estimated(tiny_data, tmp_path):
    meta = json.loads((tiny_data / "transforms.json").read_text())
    for entry in meta["frames"]:
        for key in ("sun_direction", "sun_azimuth_deg", "sun_elevation_deg"):
            del entry[key]
    shutil.copytree(tiny_data, tmp_path / "data")
    (tmp_path / "data/transforms.json").write_text(json.dumps(meta))
    run = SimpleNamespace(path=tmp_path, config={"data": {"path": str(tmp_path / "data")}})
    options = Namespace(camera=None, data=None, frame=1)
    assert view_of(options, run)[1] is None
    names = [frame.file_path for frame in read_dataset(tiny_data).train]
    entries = [{"file_path": name, "sun_direction": [k, 0, 1]} for k, name in enumerate(names)]
    (tmp_path / "cameras.json").write_text(json.dumps({"frames": entries}))
    assert view_of(options, run)[1].angles == pytest.approx((0, 45))
    options.data = tiny_data
    assert view_of(options, run)[1].direction == pytest.approx(read_dataset(tiny_data).train[1].sun.direction)
    options.data, entries[1]["sun_direction"] = None, "noon"
    (tmp_path / "cameras.json").write_text(json.dumps({"frames": entries}))
    with pytest.raises(InputError, match=r"cameras\.json: frame .*: expected 3 finite numbers"):
        view_of(options, run)


def test_materials_of_a_run(spacesim, tiny_data, tmp_path):
    """As pictures, on the vertices of a mesh, and without the data that says how bright the Sun was."""
    shutil.copytree(tiny_data, tmp_path / "data")
    short = ("--iterations", 40, "--set", "init_count=300", "--preset", "demo", "--method", "relight")
    assert spacesim("train", tmp_path / "data", "--out", tmp_path / "run", *short).code == 0
    view = load_run(tmp_path / "run").draw_material(read_dataset(tmp_path / "data").frames[3].camera)
    shapes = {"albedo": (40, 40, 3), "specular": (40, 40, 3), "roughness": (40, 40), "metallic": (40, 40)}
    for kind, shape in shapes.items():
        for suffix in ("png", "exr"):
            out = tmp_path / f"{kind}.{suffix}"
            done = spacesim("render", tmp_path / "run", "--frame", 3, "--kind", kind, "--out", out)
            assert (done.code, done.output, done.errors) == (0, f"{out}\n", [])
        layer = read_exr(tmp_path / f"{kind}.exr")[kind]
        assert layer.shape == shape
        assert np.array_equal(layer, getattr(view, kind))
    picture = read_png(tmp_path / "albedo.png")
    assert np.array_equal(picture[..., :3], np.rint(255 * srgb_from_linear(view.albedo)))
    assert np.array_equal(picture[..., 3], np.rint(255 * np.clip(view.alpha, 0, 1)))

    few = "--views", 3, "--voxel", 0.1
    done = spacesim("export", tmp_path / "run", "--mesh", tmp_path / "a.glb", *few)
    assert (done.code, done.output.endswith(" m, with albedo\n")) == (0, True), done
    for mesh in trimesh.load(tmp_path / "a.glb", process=False).geometry.values():
        assert mesh.visual.vertex_attributes["color"].shape == (len(mesh.vertices), 4)
    shutil.move(tmp_path / "data", tmp_path / "elsewhere")
    done = spacesim("export", tmp_path / "run", "--mesh", tmp_path / "b.glb", *few, "--data", tmp_path / "elsewhere")
    assert done.errors == [RELATIVE]
    done = spacesim("export", tmp_path / "run", "--mesh", tmp_path / "c.stl", *few, "--data", tmp_path / "elsewhere")
    assert (done.code, done.output.endswith(" m\n"), done.errors) == (0, True, [])


def test_a_radiance_field_has_no_materials(spacesim, tiny_field, tmp_path):
    done = spacesim("render", tiny_field, "--frame", 3, "--kind", "roughness", "--out", tmp_path / "a.png")
    assert done.is_refusal(tiny_field, "to read materials, found a radiance field")


def test_render_where_the_data_has_moved(spacesim, tiny_data, tmp_path):
    shutil.copytree(tiny_data, tmp_path / "data")
    short = ("--iterations", 5, "--set", "init_count=50", "--preset", "demo")
    assert spacesim("train", tmp_path / "data", "--out", tmp_path / "run", *short).code == 0
    (tmp_path / "data").rename(tmp_path / "moved")
    out = tmp_path / "a.png"
    assert spacesim("render", tmp_path / "run", "--out", out).is_refusal(tmp_path / "data")
    assert spacesim("render", tmp_path / "run", "--data", tmp_path / "moved", "--out", out).code == 0
    done = spacesim("train", tmp_path / "moved", "--out", tmp_path / "run", *short, "--resume")
    assert done.code == 0, done.errors


def test_export(spacesim, tiny_run, tmp_path):
    out = tmp_path / "model.ply"
    done = spacesim("export", tiny_run, "--ply", out)
    assert (done.code, done.output) == (0, f"{out}: 300 Gaussians\n")
    means = read_ply(out).to_numpy()["means"]
    assert np.array_equal(means, load_run(tiny_run).gaussians.to_numpy()["means"])


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (("export", "--ply"), "mesh.ply"),
        (("export", "--mesh"), "points.ply"),
        (("render", "--out"), "images/test_00000.png"),
        (("verify", "--camera-density"), "images/test_00000.png"),
    ],
)
def test_files_of_a_dataset_are_not_overwritten_and_others_are(spacesim, tiny_run, tiny_data, tmp_path, words, name):
    data = tmp_path / "data"
    shutil.copytree(tiny_data, data)
    (tmp_path / "link").symlink_to(data)
    command, option = words
    few = ("--views", 3, "--voxel", 0.1) if option == "--mesh" else ()
    before = contents(data)
    what = tiny_data if command == "verify" else tiny_run
    for path in (data / name, tmp_path / "link" / name):
        assert spacesim(command, what, option, path, *few).is_refusal(path, "no dataset's own")
    assert contents(data) == before
    other = data / f"of_mine{Path(name).suffix}"
    other.write_bytes(b"old")
    assert spacesim(command, what, option, other, *few).code == 0
    assert len(other.read_bytes()) > 100


@pytest.mark.parametrize(
    "words",
    [
        *(f"export RUN --{form} OUT" for form in ("ply", "glb", "spz", "usd", "mesh", "html")),
        "compose SCENE --out made --ply OUT",
        "report EVAL --out OUT",
        "verify DATA --camera-density OUT",
        "render RUN --out OUT",
        "render RUN --kind albedo --out OUT",
        "locate RUN DATA --out OUT",
    ],
)
def test_a_file_is_written_to_no_name_of_another_kind(
    spacesim, tiny_run, tiny_data, tiny_eval, tmp_path, monkeypatch, words
):
    monkeypatch.chdir(tmp_path)
    run = Path(shutil.copytree(tiny_run, tmp_path / "run"))
    (tmp_path / "scene.toml").write_text('models = [{run = "run"}]\n')
    before = contents(tmp_path)
    places = {"RUN": run, "DATA": tiny_data, "EVAL": tiny_eval, "SCENE": "scene.toml"}
    for out in ("run/model.safetensors", "scene.toml", "lit.txt"):
        command = [str({**places, "OUT": out}.get(word, word)) for word in words.split()]
        assert spacesim(*command).is_refusal(f"{out}: expected a file name that ends in .")
    assert contents(tmp_path) == before


@pytest.mark.parametrize("form", ["glb", "spz", "usd"])
def test_export_for_other_viewers(spacesim, tiny_run, tmp_path, form):
    out = tmp_path / {"usd": "model.usda"}.get(form, f"model.{form}")
    done = spacesim("export", tiny_run, f"--{form}", out, "--scale", 2, "--recentre", "--up", "y")
    assert (done.code, done.output) == (0, f"{out}: 300 Gaussians\n")
    assert [line[:22] for line in done.errors] == ([] if form == "spz" else ["the run is antialiased"])
    assert out.stat().st_size > 300 * 15


def test_export_of_a_mesh_with_colors(spacesim, tiny_run, tmp_path):
    few = "--views", 3, "--voxel", 0.1
    done = spacesim("export", tiny_run, "--mesh", tmp_path / "a.ply", *few)
    assert (done.code, done.output.endswith(" m, coloured\n")) == (0, True), done
    assert b"property uchar red" in (tmp_path / "a.ply").read_bytes()
    done = spacesim("export", tiny_run, "--mesh", tmp_path / "b.ply", *few, "--scale", 10, "--recentre", "--up", "-y")
    one, other = (read_mesh(tmp_path / name)[0] for name in ("a.ply", "b.ply"))
    np.testing.assert_allclose(np.ptp(other, axis=0), 10 * np.ptp(one, axis=0)[[0, 2, 1]], rtol=1e-4)
    middle = np.quantile(other, (0.005, 0.995), axis=0).mean(axis=0)
    np.testing.assert_allclose(middle, 0, atol=1e-3)


def test_paths_with_spaces_and_other_letters(spacesim, tiny_data, tmp_path):
    root = tmp_path / "Größe & Maß <1>"
    shutil.copytree(tiny_data, root / "данные")
    short = ("--iterations", 3, "--set", "init_count=20", "--preset", "demo")
    assert spacesim("train", root / "данные", "--out", root / "run 1", *short).code == 0
    assert spacesim("eval", root / "run 1", "--data", root / "данные", "--out", root / "e %20").code == 0
    assert "Größe &amp; Maß &lt;1&gt;" in (root / "e %20/report.html").read_text()


def test_an_existing_empty_folder_is_taken(spacesim, tiny_data, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "data").mkdir()
    small = ("--views", "1", "--test-views", "0", "--resolution", "8", "--spp", "1")
    assert spacesim("generate", "boxsat", "--out", tmp_path / "data", *small).code == 0
    short = ("--iterations", 2, "--set", "init_count=20", "--preset", "demo")
    assert spacesim("train", tiny_data, "--out", tmp_path / "run", *short).code == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--set supersample=9", ["--set supersample: expected 1 to 4, found 9"]),
        (
            "--set light.bounce=9",
            ["--set light.bounce: expected light", "vanilla; try --method shadow-map"],
        ),
        ("--method relight --set light.shadow.bias=5", ["expected light.shadow to be", "; try --method shadow-map"]),
        ("--set nonsense=1", [f"--set nonsense: {A_FIELD}, found 'nonsense'"]),
        ("--set bias=5", [f"--set bias: {A_FIELD}, found 'bias'; did you mean light.shadow.bias?"]),
        ("--set max_gaussians=5", [f"{A_FIELD}, found 'max_gaussians'; did you mean refinement.max_gaussians?"]),
        ("--set maxgaussians=5", [f"{A_FIELD}, found 'maxgaussians'; did you mean refinement.max_gaussians?"]),
        ("--set shadow.bias=5", [f"--set shadow.bias: {A_FIELD}, found 'shadow'; did you mean light.shadow.bias?"]),
        ("--method nerf --set bias=5", [f"--set bias: {A_FIELD}, found 'bias'; did you mean shadow.bias?"]),
        (
            "--method shadow-map --set light.field.inputs=directions",
            ["--set light.bounce: expected 0 or --set light.field.inputs=surface,"],
        ),
        ("--set seed", ["--set: expected KEY=VALUE, found 'seed'"]),
        ("--set =3", ["--set: expected KEY=VALUE, found '=3'"]),
        ("--set seed=three", ["--set seed: expected a whole number, found 'three'"]),
        ("--set seed.x=3", ["--set seed.x: expected seed alone, which has no fields"]),
        ("--set method=relight", ["--set: expected --method, which sets all that goes with it"]),
        ("--set lihgt.bounce=9", ["--set lihgt", A_FIELD, "mean light?"]),
        ("--method relight --set light.bounse=9", ["--set light.bounse", "did you mean light.bounce?"]),
        ("--set cull_every=9", ["--set cull_every", "did you mean strategy.cull_every?"]),
        ("--set prune_opcity=1", ["--set prune_opcity", "did you mean refinement.prune_opacity?"]),
        ("--set refinement.opacity=1", ["--set refinement.opacity", "did you mean refinement.prune_opacity?"]),
        (
            "--method nerf --set strategy=default",
            ["--set strategy: expected with a method of Gaussians, found with nerf"],
        ),
        ("--max-gaussians 99999999999", ["--max-gaussians: expected at most 100000000, found 99999999999"]),
        ("--strategy mcmc --set strategy.kind=mcmd", ["--set strategy.kind: expected one of", "mean mcmc?"]),
        ("--set antialiased=1", ["--set antialiased: expected true or false, found 1"]),
        ("--set strategy=mcmd", ["--set strategy", "default, mesh-aware", "did you mean mcmc?"]),
        ("--set warm_start.steps=9", ["--set warm_start.steps", "expected warm_start to be there"]),
        (
            "--method relight --set light.shadow.bias=3",
            ["--set light.shadow.bias", "expected light.shadow to be there, found none", "relight"],
        ),
        (
            "--preset demo --method shadow-map --set light.shadow.refine.width=32",
            ["expected light.shadow.refine to be there, found none; light.shadow.refine={} puts it there with its"],
        ),
        ("--method relight --set visibility_weight=1", ["--set visibility_weight", "shadows", "relight"]),
        ("--method shadow-splat --set light.shadow.bias=-1", ["--set light.shadow.bias: expected 0 or more, found -1"]),
        (
            "--method shadow-splat --set light.shadow.method.filter=median",
            [
                "light.shadow.method.filter: expected one of kind, beta_min, found 'filter'",
                "; kind mapping knows it",
            ],
        ),
        (
            "--method shadow-map --set light.shadow.method.beta_min=0.1",
            ["light.shadow.method.beta_min", "kind splatting knows it"],
        ),
        (
            "--method shadow-map --set light.shadow.method=splatting",
            ["--set light: expected shadow mapping", "found shadow splatting"],
        ),
        (
            "--method shadow-map --set light.shadow.bias=inf",
            ["--set light.shadow.bias: expected a finite number, found inf"],
        ),
        (
            "--method shadow-map --set light.shadow.size=0",
            ["--set light.shadow.size: expected 4 to 8192 pixels, found 0"],
        ),
        ("--method shadow-map --set light.shadow.size=100000", ["--set light.shadow.size", "found 100000"]),
        (
            "--method shadow-map --set light.shadow.method.radius=0",
            ["method.radius: expected 0.5 to 16 pixels, found 0"],
        ),
        (
            "--method shadow-map --set light.shadow.grazing=never",
            ["shadow.grazing: expected one of none, bias, lift, both"],
        ),
        (
            "--method relight --set light.tone=filmic",
            ["--set light.tone: expected linear colours (light.linear = true)"],
        ),
        (
            "--method relight --set light.linear=true --set light.exposure=1e9",
            ["--set light.exposure: expected -40 to 40 EV"],
        ),
    ],
)
def test_a_setting_that_cannot_be_is_named(spacesim, tiny_data, tmp_path, words, said):
    refused = spacesim("train", tiny_data, "--out", tmp_path / "out", *words.split())
    assert refused.is_refusal(*said), refused
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        ("", ["COMMAND"]),
        ("fly", ["fly"]),
        ("generate teapot --out OUT", ["scene", "boxsat", "teapot"]),
        ("generate boxsat", ["--out"]),
        ("generate boxsta --print", ["scene", "boxsta", "did you mean boxsat?"]),
        ("generate ABSENT.toml --out OUT", ["absent.toml"]),
        ("generate ABSENT.glb --out OUT", ["scene", "absent.glb"]),
        ("generate DATA --out OUT", ["scene", "DATA"]),
        ("generate boxsat --out OUT --units mm", ["units", "mesh file", "boxsat"]),
        ("generate boxsat --out OUT --resolution 8x8x8", ["--resolution", "8x8x8"]),
        ("generate boxsat --out OUT --resolution 8x0", ["resolution", "found 0"]),
        ("generate boxsat --out OUT --fov 180", ["--fov: expected", "found 180"]),
        ("generate boxsat --out OUT --exposure nan", ["exposure", "found nan"]),
        ("generate boxsat --out OUT --distance 0", ["distance", "found 0"]),
        ("generate upper-stage --out OUT --distance 9", ["distance", "upper-stage"]),
        ("generate boxsat --out OUT --views 0", ["views", "at least 1", "found 0"]),
        ("generate boxsat --out OUT --views two", ["--views", "two"]),
        ("generate boxsat --out OUT --suns 0", ["suns", "found 0"]),
        ("generate boxsat --out OUT --test-views -1", ["--test-views: expected"]),
        ("generate boxsat --out OUT --resolution 0", ["resolution", "found 0"]),
        ("generate boxsat --out OUT --spp 0", ["spp", "found 0"]),
        ("generate boxsat --out OUT --seed -1", ["seed", "found -1"]),
        ("generate boxsat --out OUT --sun 10", ["--sun", "AZ,EL", "10"]),
        ("generate boxsat --out OUT --sun 10,north", ["--sun", "10,north"]),
        ("generate boxsat --out OUT --sun 1,2,3", ["--sun", "1,2,3"]),
        ("generate boxsat --out OUT --sun 10,91", ["sun", "91"]),
        ("generate boxsat --out OUT --sun nan,0", ["sun", "nan"]),
        ("generate boxsat --out OUT --backend metal", ["--backend", "metal"]),
        ("train ABSENT --out OUT", ["ABSENT", "found nothing"]),
        ("train RUN --out OUT", ["RUN", "transforms.json"]),
        ("train DATA --out OUT --iterations 0", ["--iterations", "at least 1", "found 0"]),
        ("train DATA --out OUT --iterations 1e3", ["--iterations", "1e3"]),
        ("train DATA --out OUT --strategy none", ["--strategy", "default", "none"]),
        ("train DATA --out OUT --preset huge", ["--preset", "thesis", "huge"]),
        ("train DATA --out OUT --preset huge --method shadow-map", ["--preset", "fine, thesis", "huge"]),
        ("train DATA --out OUT --max-gaussians 0", ["--max-gaussians: expected at least 1, found 0"]),
        ("train DATA --out OUT --init sphere", ["--init", "points", "sphere"]),
        ("train DATA --out OUT --set init_count=0", ["--set init_count: expected at least 1", "found 0"]),
        (
            "train DATA --out OUT --set warm_start=true",
            ["--set warm_start: expected a table", "add --warm-start"],
        ),
        ("train DATA --out OUT --set warm_start.steps=4", ["found none; add --warm-start"]),
        ("train DATA --out RUN", ["expected a new folder, found a run; --resume goes on with it"]),
        ("generate boxsat --out DATA", ["expected a new folder, found a dataset; --resume goes on with it"]),
        ("generate boxsat --out OUT --sun 1,2 --suns 2", ["--suns: expected 1, one for each direction given, found 2"]),
        (
            "generate boxsat --out OUT --known-test-views 2 --test-suns 0",
            ["--known-test-views: expected 0 without --test-suns, where --test-views are of"],
        ),
        ("train DATA --out OUT --method magic", ["--method", "vanilla, relight, shadow-map", "magic"]),
        ("train DATA --out OUT --seed -1", ["--seed", "found -1"]),
        ("train DATA --out OUT --backend vulkan", ["--backend", "vulkan"]),
        ("train DATA --out DATA", ["DATA", "empty or new folder"]),
        ("eval ABSENT --data DATA --out OUT", ["ABSENT", "config.json"]),
        ("eval DATA --data DATA --out OUT", ["DATA", "config.json"]),
        ("eval RUN --data RUN --out OUT", ["RUN", "transforms.json"]),
        ("eval RUN --data ABSENT --out OUT", ["ABSENT"]),
        ("eval RUN --data DATA --out OUT --split some", ["--split: expected test, train or all", "some"]),
        ("eval RUN --data DATA --out OUT --lpips-weights ABSENT", ["ABSENT"]),
        ("eval RUN --data DATA --out OUT --align ABSENT", ["ABSENT"]),
        ("report ABSENT --out OUT.html", ["ABSENT"]),
        ("report RUN --out OUT.html", ["RUN", "metrics.json"]),
        ("report --out OUT.html", ["EVAL"]),
        ("render RUN --out OUT.png --frame 8", ["--frame", "0 to 7", "found 8"]),
        ("render RUN --out OUT.png --frame -1", ["--frame", "found -1"]),
        ("render RUN --out OUT.png --frame 0 --camera X", ["--camera", "--frame"]),
        ("render RUN --out OUT.png --camera ABSENT", ["ABSENT"]),
        ("render RUN --out OUT.png --camera DATA/scene.json", ["scene.json", "w and h"]),
        ("render RUN --out OUT.png --kind shade", ["--kind", "shade"]),
        ("render RUN --out OUT.png --kind shadow", ["--kind: expected another than shadow"]),
        ("render RUN --out OUT.png --kind albedo --exposure 1", ["--exposure: expected none with --kind albedo"]),
        ("render RUN --out OUT.png --kind albedo", ["RUN", "to read materials, found one of vanilla"]),
        ("sweep RUN --out OUT", ["RUN", "vanilla"]),
        ("render RUN --out OUT.png --sun 5", ["--sun", "5"]),
        ("render RUN --out OUT.jpg", ["OUT.jpg", ".png"]),
        ("render RUN --out OUT", [".png", ".exr"]),
        ("render DATA --out OUT.png", ["DATA", "config.json"]),
        ("trian DATA --out OUT", ["COMMAND", "found 'trian'", "did you mean train?"]),
        ("export RUN", ["--ply"]),
        ("export DATA --ply OUT.ply", ["DATA", "config.json"]),
        ("export RUN --glb OUT.ply", ["OUT.ply", ".glb"]),
        ("export RUN --usd OUT.usdc", ["OUT.usdc", ".usda or .usd"]),
        ("export RUN --usd OUT.usda --up -y", ["--up: expected z or y in USD"]),
        ("export RUN --spz OUT.spz --up x", ["--up", "z, y, -y"]),
        ("export RUN --ply OUT.ply --scale 0", ["--scale", "1e+06"]),
        ("export RUN --glb OUT.glb --spz-version 4", ["--spz-version: expected with --spz, found without it"]),
        ("export RUN --html OUT.html --recentre", ["--recentre: expected with --ply"]),
        ("export RUN --html OUT.html --up y", ["--up: expected with --ply"]),
        ("export RUN --mesh OUT.stl --sun 1,2", ["--sun", "hold colours"]),
    ],
)
def test_bad_usage_ends_in_a_sentence(spacesim, tiny_data, tiny_run, tmp_path, arguments, names):
    places = {"DATA": tiny_data, "RUN": tiny_run, "ABSENT": tmp_path / "absent", "OUT": tmp_path / "out"}
    words = [re.sub("|".join(places), lambda match: str(places[match.group()]), word) for word in arguments.split()]
    names = [str(places.get(name, name)).replace("OUT", "out") for name in names]
    refused = spacesim(*words)
    assert refused.is_refusal(*names), refused
    assert not (tmp_path / "out").exists()


EVERY = [(name,) for name in ALL_COMMANDS if name != "import"] + [("import", kind) for kind in KINDS]


@pytest.mark.parametrize("command", EVERY, ids=" ".join)
def test_a_wrong_number_is_named_in_every_command(spacesim, command):
    own = parser(command)
    for name in command:
        (chosen,) = (action.choices for action in own._actions if isinstance(action.choices, dict))
        own = chosen[name]
    numbers = {action.option_strings[-1]: action.type for action in own._actions if action.type in (int, float)}
    for option, kind in numbers.items():
        expected = f"spacesim {' '.join(command)}: {option}: expected a {'whole ' if kind is int else ''}number, found"
        for text in ("x", "1e3" if kind is int else "1,5"):
            assert spacesim(*command, option, text).is_refusal(f"{expected} {text!r}; see spacesim")
    assert numbers or command[0] in WITHOUT_NUMBERS


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("train DATA --out OUT --sed 5", "train: unknown option --sed; did you mean --seed? see spacesim train --help"),
        ("train DATA --out OUT --sed=5", "train: unknown option --sed; did you mean --seed? see spacesim train --help"),
        ("train DATA --ouut OUT", "train: unknown option --ouut; did you mean --out? see spacesim train --help"),
        ("export RUN --plyy OUT", "export: unknown option --plyy; did you mean --ply? see spacesim export --help"),
        ("import speedplus A --out B --frames 9", "speedplus: unknown option --frames; did you mean --count? see"),
        ("train DATA --out OUT -q", "train: unknown option -q; see spacesim train --help"),
        (
            "import video A --out B --hight 9",
            "video: unknown option --hight; did you mean --height? see spacesim import",
        ),
        (
            "eval RUN other --data A --out B",
            "eval: expected no more arguments, found 'other'; see spacesim eval --help",
        ),
    ],
)
def test_an_unknown_option_is_answered_with_the_closest(spacesim, words, said):
    assert spacesim(*words.split()).is_refusal(said)


def test_settings_in_a_sentence_are_shown_as_options():
    options = parser(["train"]).parse_args(["train", "a/seed=3", "--out", "OUT"])
    asked = "expected sun_direction in every frame, or sun=unknown, or light.field.inputs=view"
    expected = "expected sun_direction in every frame, or --sun unknown, or --set light.field.inputs=view"
    assert in_flags(f"a/seed=3: {asked}, found none", options) == f"a/seed=3: {expected}, found none"
    assert in_flags("seed: expected refine_poses, found max_gaussians", options).endswith(
        "--refine-poses, found max_gaussians"
    )
    unfinished = "DATA: found an unfinished one; generate with {} completes it"
    asked = parser(["verify"]).parse_args(["verify", "DATA"])  # which has no --resume; generate has
    assert in_flags(unfinished.format("resume=True"), asked) == unfinished.format("--resume")
    others = "OUT/config.json: refine_poses: expected another, found b=True"
    assert in_flags(others, options) == others


def test_a_folder_that_is_called_like_an_option_is_none(spacesim, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert spacesim("train", "seed", "--out", "out").is_refusal("spacesim: seed: expected a dataset folder")
    assert spacesim("train", "absent", "--out", "out", "--seed", -1).is_refusal("spacesim: --seed: expected 0 or more")


UNWRITABLE = ["BELOW_A_FILE/out", *(path for path in ("/proc/out", "/dev/full") if Path(path).parent.is_dir())]


@pytest.mark.parametrize("place", UNWRITABLE)
@pytest.mark.parametrize(
    "arguments",
    [
        "generate boxsat --views 1 --test-views 0 --resolution 8 --spp 1 --out OUT",
        "train DATA --preset demo --iterations 2 --set init_count=10 --out OUT",
        "eval RUN --data DATA --out OUT",
        "report EVAL --out OUT/a.html",
        "render RUN --out OUT/a.png",
        "render RUN --out OUT/a.exr",
        "export RUN --ply OUT/a.ply",
        "export RUN --glb OUT/a.glb",
        "export RUN --spz OUT/a.spz",
        "export RUN --usd OUT/a.usda",
        "export RUN --html OUT/a.html",
    ],
)
def test_unwritable_output_ends_in_a_sentence(spacesim, tiny_data, tiny_run, tiny_eval, tmp_path, arguments, place):
    (tmp_path / "file").write_text("a file, no folder")
    place = place.replace("BELOW_A_FILE", str(tmp_path / "file"))
    places = {"DATA": tiny_data, "RUN": tiny_run, "EVAL": tiny_eval, "OUT": place}
    words = [re.sub("|".join(places), lambda match: str(places[match.group()]), word) for word in arguments.split()]
    refused = spacesim(*words)
    assert refused.is_refusal(place), refused
    assert (tmp_path / "file").read_text() == "a file, no folder"


def test_the_package_is_a_program_too():
    done = subprocess.run(
        [sys.executable, "-m", "spacesim", "--version"], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stdout.split()[:1]) == (0, ["spacesim"]), done.stderr


def test_an_evaluation_is_told_in_few_lines(capsys):
    def mean(value: float) -> dict[str, dict[str, float]]:
        return {"mean": value}

    partly = [f"{what} is null in {count} of 60 frames: the truth lacks it." for what, count in (("A", 2), ("B", 1))]
    metrics = {
        "image": {"psnr": mean(30.0), "ssim": mean(0.9), "flip": mean(0.05)},
        "shadow_other_cast": {"balanced_error_rate": mean(0.078), "iou": mean(0.83)},
        "notes": ["LPIPS is null; torch is not installed.", *partly],
    }
    print_headline(metrics)
    lines = capsys.readouterr().out.splitlines()
    assert lines[1:] == [
        "shadows that another object casts: balanced error rate 0.0780, IoU 0.8300",
        "note: LPIPS is null; torch is not installed.",
        "note: 2 measures are null in some frames; metrics.json says why",
    ]
    print_headline({**metrics, "notes": partly[:1]})
    assert capsys.readouterr().out.splitlines()[-1] == f"note: {partly[0]}"
