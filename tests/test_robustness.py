"""Interruption, full disks, broken files and foreign data: nothing is lost, and what is wrong is said in a sentence."""

import copy
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from forks import Forked
from PIL import Image
from safetensors.numpy import save
from tiny import GENERATE, PROGRAM, PROGRESS, SPARING, contents, outcome

from spacesim.backend import select
from spacesim.data.errors import InputError, WorkError
from spacesim.data.store import find_unreadable_files, load_truth, read_dataset, write_points
from spacesim.scenes.generation.generate import generate
from spacesim.scenes.scenefile import read_scene
from spacesim.splat.run import load_run
from spacesim.splat.train.checkpoint import read_tensors, write_tensors
from spacesim.splat.train.config import TrainConfig
from spacesim.splat.train.train import train
from spacesim.splat.train.trainer import Trainer

CONFIG = TrainConfig(preset="demo", iterations=40, init_count=200, checkpoint_every=10, sh_every=20)
FEW = ("--preset", "demo", "--iterations", "8", "--set", "init_count=100")

KILLED = """
import os, signal, sys
moment, after = int(sys.argv[1]), sys.argv[2] == "after"
done, put = 0, os.replace

def dying(*paths):
    global done
    done += 1
    if done == moment and not after:
        os.kill(os.getpid(), signal.SIGKILL)
    put(*paths)
    if done == moment:
        os.kill(os.getpid(), signal.SIGKILL)

os.replace = dying
"""
GENERATING = f"{SPARING}from spacesim.cli import main; main(sys.argv[3:])"
TRAINING = f"""
from pathlib import Path
from spacesim.data.store import read_dataset
from spacesim.splat.train.config import *
from spacesim.splat.train.train import train
train(read_dataset(sys.argv[3]), Path(sys.argv[4]), {CONFIG!r})
"""


def kill(program: str, moment: int, after: bool, *arguments: object) -> None:
    """Run a program that gets SIGKILL before or after it has put its file number `moment` in place."""
    process = Forked(["-c", KILLED + program, moment, "after" if after else "before", *arguments])
    _, errors = process.communicate()
    assert process.returncode == -signal.SIGKILL, errors


# --- kill -9 ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("moment", "after"), [(1, False), (5, False), (30, True), (53, False), (55, False)])
def test_generate_completes_what_a_kill_has_left(spacesim, tiny_data, tmp_path, moment, after):
    """Before scene.json; amid the first frame; amid a later one; before an overview; before transforms.json."""
    out = tmp_path / "data"
    arguments = ("generate", "boxsat", "--out", out, *GENERATE)
    kill(GENERATING, moment, after, *arguments)
    left = {name: content for name, content in contents(out).items() if not name.endswith(".part")}
    assert len(left) == (moment if after else moment - 1)
    assert spacesim("train", out, "--out", tmp_path / "run").is_refusal(out)
    done = spacesim(*arguments, "--resume")
    assert done.code == 0, done.errors
    found = contents(out)
    assert found == contents(tiny_data)
    assert {name: found[name] for name in left} == left


@pytest.fixture(scope="module")
def uninterrupted(tiny_data, tmp_path_factory) -> Path:
    return train(read_dataset(tiny_data), tmp_path_factory.mktemp("straight") / "run", CONFIG).path


@pytest.mark.parametrize(("moment", "after"), [(1, False), (2, False), (3, True), (7, False), (9, False)])
def test_train_completes_what_a_kill_has_left(tiny_data, uninterrupted, tmp_path, moment, after):
    """Before config.json; before the first checkpoint; after a later one; before training.json; before the model."""
    out = tmp_path / "run"
    kill(TRAINING, moment, after, tiny_data, out)
    assert not (out / "model.safetensors").exists()
    with pytest.raises(InputError, match=f"{out}"):
        load_run(out)
    run = train(read_dataset(tiny_data), out, CONFIG, resume=True)
    assert (out / "model.safetensors").read_bytes() == (uninterrupted / "model.safetensors").read_bytes()
    assert run.training["history"] == load_run(uninterrupted).training["history"]


def test_an_unfinished_run_is_refused(spacesim, tiny_run, tiny_data, tmp_path):
    shutil.copytree(tiny_run, tmp_path / "run")
    (tmp_path / "run/model.safetensors").unlink()
    for arguments in (
        ("eval", tmp_path / "run", "--data", tiny_data, "--out", tmp_path / "out"),
        ("render", tmp_path / "run", "--out", tmp_path / "a.png"),
        ("export", tmp_path / "run", "--ply", tmp_path / "a.ply"),
    ):
        assert spacesim(*arguments).is_refusal(tmp_path / "run", "--resume")


# --- Ctrl-C ----------------------------------------------------------------------------------------------------------


# What batch scripts start with `&` ignores SIGINT.
@pytest.mark.parametrize(
    ("program", "number", "ignored"),
    [
        ("spacesim.cli", signal.SIGINT, ()),
        ("spacesim", signal.SIGINT, ()),
        ("spacesim", signal.SIGTERM, (signal.SIGINT,)),
    ],
)
def test_ctrl_c_during_training(spacesim, tiny_data, tmp_path, program, number, ignored):
    arguments = ("train", tiny_data, "--out", tmp_path / "run", "--preset", "demo", "--set", "init_count=200")
    command = [sys.executable, "-m", program, *map(str, arguments), "--iterations", "150"]
    before = {one: signal.signal(one, signal.SIG_IGN) for one in ignored}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    for one, handler in before.items():
        signal.signal(one, handler)
    first = process.stderr.readline()
    assert PROGRESS.match(first), first
    process.send_signal(number)
    output, errors = process.communicate(timeout=60)
    stopped = outcome(process.returncode, output, errors)
    assert stopped.code == 128 + number, stopped
    assert list((tmp_path / "run/checkpoints").iterdir())
    assert len(stopped.errors) == 1
    assert "--resume" in stopped.errors[0]
    done = spacesim(*arguments, "--iterations", 150, "--resume")
    assert done.code == 0, done.errors


# --- a full disk -----------------------------------------------------------------------------------------------------


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 256 KiB, which can be made larger."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(place)]
    if not sys.platform.startswith("linux") or os.geteuid() != 0:
        pytest.skip("only root on Linux can mount a small file system")
    if subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("mounting a small file system is not permitted here")

    def enlarge() -> None:
        subprocess.run(["mount", "-o", "remount,size=64m", str(place)], check=True)

    yield place, enlarge
    subprocess.run(["umount", str(place)], check=True)


def test_a_full_disk_while_generating(spacesim, tiny_data, small_disk):
    place, enlarge = small_disk
    arguments = ("generate", "boxsat", "--out", place / "data", *GENERATE)
    failed = spacesim(*arguments)
    assert failed.code == 1
    assert len(failed.errors) == 1
    assert "disk is full" in failed.errors[0]
    whole, expected = contents(place / "data"), contents(tiny_data)
    assert whole.items() <= expected.items()
    assert len(whole) > 6
    enlarge()
    assert spacesim(*arguments, "--resume").code == 0
    assert contents(place / "data") == expected


def test_a_full_disk_while_training(spacesim, tiny_data, uninterrupted, small_disk):
    place, enlarge = small_disk
    (place / "ballast").write_bytes(bytes(100_000))
    with pytest.raises(WorkError, match="disk is full"):
        train(read_dataset(tiny_data), place / "run", CONFIG)
    whole = contents(place / "run")
    assert "config.json" in whole
    assert not any(name.endswith(".part") for name in whole)
    enlarge()
    train(read_dataset(tiny_data), place / "run", CONFIG, resume=True)
    assert (place / "run/model.safetensors").read_bytes() == (uninterrupted / "model.safetensors").read_bytes()


# --- two runs at once ------------------------------------------------------------------------------------------------


def test_a_second_run_in_the_same_folder_is_refused_and_harms_nothing(spacesim, tiny_data, tmp_path):
    """The first is stopped amid its frames, then killed: its lock goes with it."""
    out = tmp_path / "data"
    arguments = ["generate", "boxsat", "--out", str(out), *GENERATE]
    first = subprocess.Popen([sys.executable, "-c", PROGRAM, *arguments], stderr=subprocess.DEVNULL)
    try:
        while not list(out.glob("gt/*.exr")):
            assert first.poll() is None, "it should have been stopped before its end"
            time.sleep(0.002)
        first.send_signal(signal.SIGSTOP)
        os.waitpid(first.pid, os.WUNTRACED)  # until all its threads stand still
        found = set(contents(out))
        who = f"(process {first.pid})" if Path("/proc/locks").exists() else "found one"
        for more in ([], ["--resume"], ["--resume", "--workers", "2"]):
            assert spacesim(*arguments, *more).is_refusal(f"{out}: expected no other run at work", who)
        assert set(contents(out)) == found
    finally:
        first.kill()
        first.wait()
    assert spacesim(*arguments, "--resume").code == 0
    assert contents(out) == contents(tiny_data)


# --- the same seed ---------------------------------------------------------------------------------------------------


def test_same_seed_same_bits(spacesim, tiny_data, uninterrupted, tmp_path):
    dataset = read_dataset(tiny_data)
    again = train(dataset, tmp_path / "again", CONFIG).path / "model.safetensors"
    other = train(dataset, tmp_path / "other", replace(CONFIG, seed=1)).path / "model.safetensors"
    assert again.read_bytes() == (uninterrupted / "model.safetensors").read_bytes()
    assert other.read_bytes() != again.read_bytes()
    assert spacesim("generate", "boxsat", "--out", tmp_path / "data", *GENERATE).code == 0
    assert contents(tmp_path / "data") == contents(tiny_data)


# --- broken files ----------------------------------------------------------------------------------------------------


@pytest.fixture
def broken(tiny_data, tmp_path) -> Path:
    """A copy of the dataset, to be broken."""
    return Path(shutil.copytree(tiny_data, tmp_path / "broken"))


def cut(path: Path, fraction: float = 0.5) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(fraction * len(content))])


def edit(path: Path, change) -> None:
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


BREAKAGES = {
    "transforms.json": ("transforms.json", lambda root: cut(root / "transforms.json")),
    "no transforms.json": ("--resume", lambda root: (root / "transforms.json").unlink()),
    "no list": ("transforms.json", lambda root: (root / "transforms.json").write_text("[]")),
    "no frames": ("transforms.json", lambda root: edit(root / "transforms.json", lambda m: m.update(frames=[]))),
    "no training frames": (
        "transforms.json",
        lambda root: edit(
            root / "transforms.json",
            lambda m: m.update(train_filenames=[], test_filenames=[f["file_path"] for f in m["frames"]]),
        ),
    ),
    "pose": (
        "train_00002.png",
        lambda root: edit(
            root / "transforms.json", lambda m: m["frames"][2]["transform_matrix"][0].__setitem__(3, float("nan"))
        ),
    ),
    "mirror": (
        "train_00001.png",
        lambda root: edit(
            root / "transforms.json",
            lambda m: m["frames"][1].update(transform_matrix=np.diag([1, 1, -1, 1]).tolist()),
        ),
    ),
    "size": ("41x40", lambda root: edit(root / "transforms.json", lambda m: m.update(w=41))),
    "picture's size": (
        "train_00003.png",
        lambda root: Image.new("RGBA", (39, 40)).save(root / "images/train_00003.png"),
    ),
    "picture": ("train_00003.png", lambda root: cut(root / "images/train_00003.png")),
    "empty picture": ("train_00003.png", lambda root: cut(root / "images/train_00003.png", 0)),
    "no picture": ("train_00003.png", lambda root: (root / "images/train_00003.png").unlink()),
    "points": ("points.ply", lambda root: cut(root / "points.ply")),
    "no points": ("points.ply", lambda root: (root / "points.ply").unlink()),
    "scene": ("scene.json", lambda root: cut(root / "scene.json")),
}


@pytest.mark.parametrize("breakage", BREAKAGES)
def test_training_on_broken_data_ends_in_a_sentence(spacesim, broken, tmp_path, breakage):
    name, damage = BREAKAGES[breakage]
    damage(broken)
    refused = spacesim("train", broken, "--out", tmp_path / "run", *FEW)
    assert refused.is_refusal(broken, name), refused


def test_a_broken_mesh_ends_in_a_sentence(spacesim, broken, tmp_path):
    cut(broken / "mesh.ply", 0.3)
    refused = spacesim("train", broken, "--out", tmp_path / "run", *FEW, "--init", "mesh")
    assert refused.is_refusal(broken / "mesh.ply"), refused


@pytest.mark.parametrize("fraction", [0, 0.01, 0.5, 0.999])
def test_a_truncated_exr_is_found(broken, fraction):
    dataset = read_dataset(broken)
    path = broken / dataset.test[0].gt_path
    cut(path, fraction)
    with pytest.raises(InputError, match=path.name):
        load_truth(dataset, dataset.test[0])
    (problem,) = find_unreadable_files(broken)
    assert str(path) in problem


@pytest.mark.parametrize("name", ["scene.json", "transforms.json"])
def test_a_truncated_json_file_is_refused_with_a_remedy(spacesim, broken, tiny_data, name):
    """`verify` and `--resume` say: delete scene.json, resume. That works, and gives the same bytes."""
    cut(broken / name)
    arguments = ("generate", "boxsat", "--out", broken, *GENERATE, "--resume")
    found = spacesim("verify", broken)
    assert found.is_refusal(broken / name, "of the same scene with --resume makes it again")
    assert ("delete it" in found.errors[0]) == (name == "scene.json")
    if name == "scene.json":
        assert spacesim(*arguments).is_refusal(broken / name, "delete this file and resume again")
        (broken / name).unlink()
    (broken / "gt/train_00001.exr").unlink()
    done = spacesim(*arguments)
    assert done.code == 0, done.errors
    assert contents(broken) == contents(tiny_data)


@pytest.mark.parametrize(("name", "text"), [("scene.json", '{"config": {}}'), ("SHA256SUMS", "x"), ("points.ply", "x")])
def test_what_verify_says_to_delete_is_what_resume_needs(spacesim, broken, tiny_data, name, text):
    (broken / name).write_text(text)
    found, arguments = spacesim("verify", broken), ("generate", "boxsat", "--out", broken, *GENERATE, "--resume")
    assert found.errors[-1].endswith("1 faulty file; generate of the same scene with --resume makes them again")
    if name != "points.ply":
        assert found.errors[0].endswith("; delete it")
        assert spacesim(*arguments).is_refusal(broken)
        (broken / name).unlink()
    else:
        assert "delete" not in " ".join(found.errors)
    assert spacesim(*arguments).code == 0
    assert contents(broken) == contents(tiny_data)


def test_frames_of_unknown_origin_are_not_resumed(spacesim, broken):
    """Without scene.json, frames that the scene asked for does not have make the folder a foreign one."""
    (broken / "scene.json").unlink()
    fewer = ("--views", 5, *GENERATE[2:])
    before = contents(broken)
    assert spacesim("generate", "boxsat", "--out", broken, *fewer, "--resume").is_refusal(broken, "new or empty folder")
    assert spacesim("generate", "boxsat", "--out", broken, *GENERATE).is_refusal(broken, "new or empty folder")
    assert contents(broken) == before


@pytest.mark.parametrize("name", ["contact_sheet.png", "camera_density.png"])
def test_verify_looks_at_overviews(spacesim, broken, name):
    cut(broken / name)
    found = spacesim("verify", broken)
    assert found.code == 1
    assert len(found.errors) == 2
    assert str(broken / name) in found.errors[0]
    for one in (name, "SHA256SUMS"):  # other tools' datasets have none
        (broken / one).unlink()
    assert spacesim("verify", broken).code == 0


@pytest.mark.parametrize("monochrome", ["true", "false"])
def test_verify_looks_at_a_sensors_pictures(spacesim, tmp_path, monochrome):
    scene = tmp_path / "noisy.toml"
    scene.write_text(f"[[objects]]\nspacecraft = 'boxsat'\n[camera.sensor]\nmonochrome = {monochrome}\n")
    small = ("--views", "2", "--test-views", "0", "--resolution", "16", "--spp", "1", "--out", tmp_path / "data")
    assert spacesim("generate", scene, *small).code == 0
    assert spacesim("verify", tmp_path / "data").code == 0
    first, *_, last = sorted((tmp_path / "data/raw").iterdir())
    first.unlink()
    cut(last)
    found = spacesim("verify", tmp_path / "data")
    assert found.code == 1
    assert [str(first) in found.errors[0], str(last) in found.errors[1], "2 faulty" in found.errors[2]] == [True] * 3
    last.unlink()
    assert spacesim("generate", scene, *small, "--resume").code == 0
    assert spacesim("verify", tmp_path / "data").code == 0


def test_evaluating_on_broken_data_ends_in_a_sentence(spacesim, broken, tiny_run, tmp_path):
    cut(broken / "images/test_00001.png")
    refused = spacesim("eval", tiny_run, "--data", broken, "--out", tmp_path / "eval")
    assert refused.is_refusal(broken / "images/test_00001.png"), refused
    assert not (tmp_path / "eval/metrics.json").exists()


@pytest.mark.parametrize("name", ["model.safetensors", "config.json", "training.json"])
@pytest.mark.parametrize("fraction", [0, 0.4])
def test_a_broken_run_ends_in_a_sentence(spacesim, tiny_run, tiny_data, tmp_path, name, fraction):
    run = Path(shutil.copytree(tiny_run, tmp_path / "run"))
    cut(run / name, fraction)
    refused = spacesim("eval", run, "--data", tiny_data, "--out", tmp_path / "eval")
    assert refused.is_refusal(run / name), refused


def test_a_broken_evaluation_ends_in_a_sentence(spacesim, tiny_eval, tmp_path):
    for name in ("metrics.json", "frames/test_00000/truth.png"):
        folder = Path(shutil.copytree(tiny_eval, tmp_path / Path(name).stem))
        cut(folder / name)
        assert spacesim("report", folder, "--out", tmp_path / "a.html").is_refusal(folder / name)


def test_a_broken_checkpoint_ends_in_a_sentence(tiny_data, tmp_path):
    kill(TRAINING, 5, True, tiny_data, tmp_path / "run")
    newest = max((tmp_path / "run/checkpoints").glob("*.safetensors"))
    cut(newest)
    with pytest.raises(InputError, match=f"{newest.name}: .*; without this file training goes on from an earlier one"):
        train(read_dataset(tiny_data), tmp_path / "run", CONFIG, resume=True)


def test_a_camera_within_the_object_is_refused(tmp_path):
    with pytest.raises(InputError, match="distance: expected cameras outside of boxsat"):
        generate(read_scene("boxsat", views=3, test_views=0, resolution=16, distance=0.2), tmp_path / "data")
    assert not (tmp_path / "data").exists()


# --- data from elsewhere ---------------------------------------------------------------------------------------------


def foreign(source: Path, root: Path, mode: str = "RGB", suffix: str = "png", views: int | None = None) -> Path:
    """The dataset's pictures and poses alone, as other tools would leave them."""
    meta = json.loads((source / "transforms.json").read_text())
    (root / "images").mkdir(parents=True)
    frames = []
    for index, frame in enumerate(meta["frames"][:views]):
        picture = Image.open(source / frame["file_path"])
        black = Image.new("RGBA", picture.size, (0, 0, 0, 255))
        picture = picture if "A" in mode else Image.alpha_composite(black, picture)
        name = f"images/frame_{index:03d}.{suffix}"
        picture.convert(mode).save(root / name)
        frames.append({"file_path": name, "transform_matrix": copy.deepcopy(frame["transform_matrix"])})
    intrinsics = {key: meta[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_model")}
    (root / "transforms.json").write_text(json.dumps({**intrinsics, "frames": frames}))
    return root


def evaluated(spacesim, root: Path, work: Path, *options: object) -> dict:
    """metrics.json of a short training on a folder."""
    done = spacesim("train", root, "--out", work / "run", *FEW)
    assert done.code == 0, done.errors
    done = spacesim("eval", work / "run", "--data", root, "--out", work / "eval", *options)
    assert done.code == 0, done.errors
    assert (work / "eval/report.html").stat().st_size > 10_000
    return json.loads((work / "eval/metrics.json").read_text())


@pytest.mark.parametrize(
    ("mode", "suffix"), [("RGB", "png"), ("RGB", "jpg"), ("L", "png"), ("LA", "png"), ("RGBA", "png"), ("P", "png")]
)
def test_pictures_of_all_kinds_without_truth(spacesim, tiny_data, tmp_path, mode, suffix):
    metrics = evaluated(spacesim, foreign(tiny_data, tmp_path / "data", mode, suffix), tmp_path)
    assert len(metrics["frames"]) == 1  # every 8th is held out
    assert metrics["frames"][0]["sun"] is None
    assert metrics["shadow_mask"] is None
    assert metrics["geometry"] is None
    assert metrics["image"]["psnr"]["mean"] > 0
    assert metrics["notes"]


def test_pictures_of_different_sizes(spacesim, tiny_data, tmp_path):
    root = foreign(tiny_data, tmp_path / "data", "RGBA")

    def resize(meta: dict) -> None:
        for key in ("w", "h", "fl_x", "fl_y", "cx", "cy"):
            del meta[key]
        for index, frame in enumerate(meta["frames"]):
            width, height = 24 + 6 * (index % 3), 30
            Image.open(root / frame["file_path"]).resize((width, height)).save(root / frame["file_path"])
            frame.update(w=width, h=height, fl_x=1.87 * width, fl_y=1.87 * height, cx=0.5 * width, cy=0.5 * height)

    edit(root / "transforms.json", resize)
    assert evaluated(spacesim, root, tmp_path, "--split", "all")["image"]["psnr"]["count"] == 8


def test_masked_pixels_take_no_part(spacesim, tiny_data, tmp_path):
    """Whatever stands in pixels that the mask ignores: the same model, the same numbers."""
    numbers = []
    for value in (0, 255):
        root = foreign(tiny_data, tmp_path / f"data_{value}")
        (root / "masks").mkdir()
        mask = np.full((40, 40), 255, np.uint8)
        mask[:15] = 0

        def add(meta: dict, root=root, mask=mask, value=value) -> None:
            for frame in meta["frames"]:
                pixels = np.array(Image.open(root / frame["file_path"]))
                pixels[mask == 0] = value
                Image.fromarray(pixels).save(root / frame["file_path"])
                frame["mask_path"] = frame["file_path"].replace("images", "masks")
                Image.fromarray(mask).save(root / frame["mask_path"])

        edit(root / "transforms.json", add)
        work = tmp_path / f"work_{value}"
        numbers.append(evaluated(spacesim, root, work)["image"]["psnr"])
        numbers.append((work / "run/model.safetensors").read_bytes())
    assert numbers[0] == numbers[2]
    assert numbers[1] == numbers[3]


def test_nothing_but_masked_or_transparent_pixels(spacesim, tiny_data, tmp_path):
    root = foreign(tiny_data, tmp_path / "data")
    for path in (root / "images").iterdir():
        Image.new("RGBA", (40, 40), (0, 0, 0, 0)).save(path)
    metrics = evaluated(spacesim, root, tmp_path)
    assert metrics["image"]["psnr"] is None
    assert metrics["shadow"]["ber"] is None
    assert metrics["image_full"]["psnr"]["mean"] > 0


def test_a_single_picture(spacesim, tiny_data, tmp_path):
    root = foreign(tiny_data, tmp_path / "data", "RGBA", views=1)
    assert evaluated(spacesim, root, tmp_path, "--split", "train")["image"]["psnr"]["count"] == 1
    refused = spacesim("eval", tmp_path / "run", "--data", root, "--out", tmp_path / "other")
    assert refused.is_refusal(root, "test")


def test_blender_style(spacesim, tiny_data, tmp_path):
    root = tmp_path / "data"
    meta = json.loads((tiny_data / "transforms.json").read_text())
    angle = 2 * np.arctan(0.5 * meta["w"] / meta["fl_x"])
    for split in ("train", "test"):
        (root / split).mkdir(parents=True)
        frames = []
        for index, frame in enumerate(f for f in meta["frames"] if split in f["file_path"]):
            shutil.copy(tiny_data / frame["file_path"], root / split / f"r_{index}.png")
            frames.append({"file_path": f"./{split}/r_{index}", "transform_matrix": frame["transform_matrix"]})
        (root / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    metrics = evaluated(spacesim, root, tmp_path)
    assert [frame["file_path"] for frame in metrics["frames"]] == ["test/r_0.png", "test/r_1.png"]


def test_data_without_test_frames(spacesim, tiny_data, tiny_run, tmp_path):
    root = foreign(tiny_data, tmp_path / "data", "RGBA")
    edit(
        root / "transforms.json",
        lambda m: m.update(train_filenames=[f["file_path"] for f in m["frames"]], test_filenames=[]),
    )
    assert spacesim("eval", tiny_run, "--data", root, "--out", tmp_path / "e").is_refusal(root, "test")
    assert evaluated(spacesim, root, tmp_path, "--split", "train")["image"]["psnr"]["count"] == 8


def test_extra_and_empty_keys_are_passed_over(spacesim, tiny_data, tmp_path):
    root = foreign(tiny_data, tmp_path / "data", "RGBA")

    def add(meta: dict) -> None:
        meta.update(k1=None, ply_file_path=None, aabb_scale=16, train_filenames=None, applied_transform=[[1, 0, 0, 0]])
        meta["frames"][0].update(mask_path=None, colmap_im_id=7, sharpness=3.5, sun_direction=None)

    edit(root / "transforms.json", add)
    assert evaluated(spacesim, root, tmp_path)["image"]["psnr"]["mean"] > 0


def test_wide_coordinates(spacesim, tiny_data, tmp_path):
    """Poses in millimetres, far from the origin."""
    root = foreign(tiny_data, tmp_path / "data", "RGBA")

    def move(meta: dict) -> None:
        for frame in meta["frames"]:
            for row, offset in enumerate((1e4, -2e4, 5e3)):
                frame["transform_matrix"][row][3] = 1e3 * frame["transform_matrix"][row][3] + offset

    edit(root / "transforms.json", move)
    model = evaluated(spacesim, root, tmp_path)
    assert model["image_full"]["psnr"]["mean"] > 0
    assert all(np.isfinite(value).all() for value in load_run(tmp_path / "run").gaussians.to_numpy().values())


def points_at(root: Path, *points: tuple[float, float, float]) -> None:
    write_points(root / "points.ply", np.array(points), np.full((len(points), 3), 128, np.uint8))
    edit(root / "transforms.json", lambda meta: meta.update(ply_file_path="points.ply"))


def test_a_view_in_which_nothing_is_seen(spacesim, tiny_data, tmp_path):
    root = foreign(tiny_data, tmp_path / "data", "RGBA")
    points_at(root, (1000, 0, 0), (1000, 1, 0))
    assert evaluated(spacesim, root, tmp_path)["image_full"]["psnr"]["mean"] > 0


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (3, 2)])
def test_pictures_smaller_than_a_window(spacesim, tiny_data, tmp_path, size):
    root = foreign(tiny_data, tmp_path / "data", "RGBA")
    for path in (root / "images").iterdir():
        Image.new("RGBA", size, (200, 50, 20, 255)).save(path)
    edit(root / "transforms.json", lambda m: m.update(w=size[0], h=size[1], cx=0.5 * size[0], cy=0.5 * size[1]))
    assert evaluated(spacesim, root, tmp_path)["image_full"]["psnr"]["mean"] > 0


@pytest.mark.parametrize("points", [[(0, 0, 0)], 5 * [(0, 0, 0)]])
def test_few_points_to_start_from(spacesim, tiny_data, tmp_path, points):
    root = foreign(tiny_data, tmp_path / "data", "RGBA")
    points_at(root, *points)
    assert evaluated(spacesim, root, tmp_path)["model"]["gaussians"] == len(points)


@pytest.mark.parametrize("name", ["config.json", "training.json"])
@pytest.mark.parametrize("content", ["[]", "{}", "null"])
def test_a_run_with_other_json_ends_in_a_sentence(spacesim, tiny_run, tiny_data, tmp_path, name, content):
    run = Path(shutil.copytree(tiny_run, tmp_path / "run"))
    (run / name).write_text(content)
    for arguments in (
        ("render", run, "--out", tmp_path / "a.png"),
        ("eval", run, "--data", tiny_data, "--out", tmp_path / "eval"),
    ):
        refused = spacesim(*arguments)
        assert refused.is_refusal(run / name), refused


def test_resuming_on_other_data_is_refused(tiny_data, tmp_path):
    other = Path(shutil.copytree(tiny_data, tmp_path / "other"))
    edit(other / "transforms.json", lambda m: m["frames"][0]["transform_matrix"][0].__setitem__(3, 0.1))
    kill(TRAINING, 5, True, tiny_data, tmp_path / "run")
    with pytest.raises(InputError, match="data"):
        train(read_dataset(other), tmp_path / "run", CONFIG, resume=True)


def test_more_than_fits_into_memory(spacesim, tiny_data, tmp_path, monkeypatch):
    many = ("--resolution", 8, "--views", 10**17)
    assert spacesim("generate", "boxsat", "--out", tmp_path / "data", *many).is_refusal("views: expected at most")
    start = "spacesim.splat.train.trainer.initial_gaussians"
    monkeypatch.setattr(start, lambda *_, **__: np.zeros(10**15))  # of so many, which no device has
    failed = spacesim("train", tiny_data, "--out", tmp_path / "run")
    assert failed.code == 1
    assert len(failed.errors) == 1
    assert "memory" in failed.errors[0]


def test_a_model_that_is_not_finite_is_refused(spacesim, tiny_run, tmp_path):
    run = Path(shutil.copytree(tiny_run, tmp_path / "run"))
    tensors, header = read_tensors(run / "model.safetensors")
    write_tensors(run / "model.safetensors", {**tensors, "means": np.full_like(tensors["means"], np.nan)}, header)
    refused = spacesim("export", run, "--ply", tmp_path / "a.ply")
    assert refused.is_refusal(run / "model.safetensors"), refused


@pytest.mark.parametrize("part", [0.1, 0.5, 0.99])
def test_a_byte_that_has_changed_in_a_model_is_found(spacesim, tiny_run, tmp_path, part):
    run = Path(shutil.copytree(tiny_run, tmp_path / "run"))
    model = run / "model.safetensors"
    content = bytearray(model.read_bytes())
    start = 8 + int.from_bytes(content[:8], "little")  # of the numbers
    content[start + int(part * (len(content) - start))] ^= 1
    model.write_bytes(content)
    refused = spacesim("export", run, "--ply", tmp_path / "a.ply")
    assert refused.is_refusal(model, "some have changed since"), refused


def test_a_mesh_is_not_written_to_what_says_no_form(spacesim, tiny_run):
    assert spacesim("export", tiny_run, "--mesh", "/dev/null", "--views", "2").is_refusal("/dev/null", "says the form")


def test_a_colmap_project_is_told_from_a_dataset(spacesim, tmp_path):
    refused = spacesim("train", tmp_path, "--out", tmp_path / "run")
    assert refused.is_refusal(tmp_path, "found none in it")
    assert "COLMAP" not in refused.errors[0]
    (tmp_path / "sparse/0").mkdir(parents=True)
    refused = spacesim("train", tmp_path, "--out", tmp_path / "run")
    assert refused.is_refusal(tmp_path, "`spacesim import colmap` makes a dataset of a COLMAP project")


@pytest.mark.parametrize(("options", "told"), [((), True), (("--preset", "fast"), False), (("--resume",), False)])
def test_a_preset_that_takes_long_on_a_cpu_is_told(spacesim, tiny_data, tmp_path, monkeypatch, caplog, options, told):
    monkeypatch.setattr("spacesim.cli.train.MANY", 3)
    done = spacesim("train", tiny_data, "--out", tmp_path / "run", "--iterations", "3", *options)
    assert done.code == 0, done.errors
    assert ("on a CPU --preset demo is far quicker" in caplog.text) == (told and select() == "llvm")


def test_a_digit_that_has_changed_in_a_header_is_found(tmp_path):
    path = tmp_path / "a.safetensors"
    write_tensors(path, {"values": np.ones(3, np.float32)}, {"iteration": 41})
    assert read_tensors(path)[1]["iteration"] == 41
    path.write_bytes(path.read_bytes().replace(b": 41", b": 42"))
    with pytest.raises(InputError, match="some have changed since"):
        read_tensors(path)
    header = json.dumps({"format": "spacesim-gaussians-1", "iteration": 1})
    path.write_bytes(save({"values": np.ones(3, np.float32)}, {"spacesim": header}))  # as older versions wrote it
    assert read_tensors(path)[1]["iteration"] == 1


def test_a_model_that_becomes_infinite_stops_and_keeps_the_last_checkpoint(tiny_data, tmp_path):
    """Where no loss shows it: a Gaussian whose centre is no number is not drawn."""
    dataset = read_dataset(tiny_data)

    def broken(path: Path) -> None:
        checkpoint = max((path / "checkpoints").glob("*.safetensors"))
        tensors, header = read_tensors(checkpoint)
        tensors["means"][0, 0] = np.nan
        write_tensors(checkpoint, tensors, header)

    kill(TRAINING, 5, True, tiny_data, tmp_path / "run")
    broken(tmp_path / "run")
    with pytest.raises(InputError, match="expected finite numbers as means, found others; without this file training"):
        train(dataset, tmp_path / "run", CONFIG, resume=True)
    trainer = Trainer(dataset, replace(CONFIG, iterations=4))
    trainer.gaussians.means[0][0] = np.nan
    with pytest.raises(WorkError, match="means of the model are not finite at iteration 0; the last checkpoint"):
        trainer.save(tmp_path / "step.safetensors")
    with pytest.raises(WorkError, match="means of the model are not finite at iteration 4"):
        trainer.complete(tmp_path / "other", lambda _progress: None)
    assert not list(tmp_path.glob("other/*.safetensors"))


def test_an_azimuth_below_zero(spacesim, tmp_path):
    small = ("--views", "1", "--test-views", "0", "--resolution", "8", "--spp", "1")
    done = spacesim("generate", "boxsat", "--out", tmp_path / "data", *small, "--sun", "-40,10")
    assert done.code == 0, done.errors
    assert np.allclose(read_dataset(tmp_path / "data").train[0].sun.angles, (320, 10))


# --- records that are read from disk ---------------------------------------------------------------------------------


@pytest.fixture
def run(tiny_run, tmp_path) -> Path:
    """A copy of the run, to be broken."""
    return Path(shutil.copytree(tiny_run, tmp_path / "run"))


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("config.json", lambda v: v.update(data=[]), "data: expected a table, found []"),
        ("config.json", lambda v: v["data"].pop("path"), "data: path: expected text in quotes, found none"),
        ("config.json", lambda v: v.update(light={"field": {"layers": 10**7}}), "light.field.layers: expected 1 to 32"),
        ("config.json", lambda v: v.update(light=3), "light: expected a table, found 3"),
        ("config.json", lambda v: v.update(supersample="2"), "supersample: expected a whole number, found '2'"),
        ("config.json", lambda v: v.update(unheard_of=1), "unheard_of: expected one of method, "),
        ("config.json", lambda v: v.update(init="random", init_box=1e308), "init_box: expected a number above 0, at"),
        ("training.json", lambda v: v.update(history=[]), "history: expected at least one entry, found none"),
        ("training.json", lambda v: v.update(history={}), "history: expected tables in double brackets, found a table"),
        ("training.json", lambda v: v.update(backend=7), "backend: expected text in quotes, found 7"),
    ],
)
def test_records_of_a_run_are_checked(spacesim, run, tmp_path, name, change, said):
    edit(run / name, change)
    refused = spacesim("render", run, "--out", tmp_path / "a.png")
    assert refused.is_refusal(f"{run / name}: {said}"), refused


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda v: v["image"]["psnr"].update(mean="high"), "image.psnr.mean: expected a finite number, found 'high'"),
        (lambda v: v["frames"][0].update(name="../x"), "frames[0].name: expected a frame's name without folders"),
        (lambda v: v["dataset"].update(resolution=[1]), "dataset.resolution: expected a list of 2 whole numbers"),
        (lambda v: v.update(training=None), "training: expected a table, found none"),
        (lambda v: v["model"].update(gaussians=1e300), "model.gaussians: expected a whole number"),
    ],
)
def test_metrics_are_checked(spacesim, tiny_eval, tmp_path, change, said):
    folder = Path(shutil.copytree(tiny_eval, tmp_path / "eval"))
    edit(folder / "metrics.json", change)
    refused = spacesim("report", folder, "--out", tmp_path / "a.html")
    assert refused.is_refusal(f"{folder / 'metrics.json'}: {said}"), refused


@pytest.mark.parametrize("header", ["[]", "3", "null", '{"format": ["x"]}', "{"])
def test_a_header_of_a_model_that_is_no_object(spacesim, run, tmp_path, header):
    tensors, _ = read_tensors(run / "model.safetensors")
    (run / "model.safetensors").write_bytes(save(tensors, {"spacesim": header}))
    assert spacesim("render", run, "--out", tmp_path / "a.png").is_refusal(run / "model.safetensors")


@pytest.mark.parametrize("content", ["[]", '{"4": "x"}', '{"refinement": 1e400}', "{", '{"40": null}'])
def test_damaged_training_times_are_dropped_with_a_warning(tiny_data, uninterrupted, tmp_path, caplog, content):
    kill(TRAINING, 7, False, tiny_data, tmp_path / "run")
    (tmp_path / "run/checkpoints/seconds.json").write_text(content)
    run = train(read_dataset(tiny_data), tmp_path / "run", CONFIG, resume=True)
    assert "the time that training took before is not known" in caplog.text
    assert (run.path / "model.safetensors").read_bytes() == (uninterrupted / "model.safetensors").read_bytes()


@pytest.mark.parametrize("name", ["config.json", "training.json", "model.safetensors"])
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_special_files_of_a_run_are_refused(spacesim, run, tmp_path, name, kind):
    (run / name).unlink()
    os.mkfifo(run / name) if kind == "pipe" else (run / name).symlink_to("/dev/zero")
    refused = spacesim("render", run, "--out", tmp_path / "a.png")
    assert refused.is_refusal(run / name, "a pipe" if kind == "pipe" else "a device"), refused


@pytest.mark.parametrize("key", ["gt_path", "file_path", "mask_path", "ply_file_path", "mesh_path"])
def test_special_files_of_a_dataset_are_refused(spacesim, broken, key):
    os.mkfifo(broken / "pipe.png")

    def name(meta: dict) -> None:
        (meta if key in meta else meta["frames"][0])[key] = "pipe.png"

    edit(broken / "transforms.json", name)
    refused = spacesim("verify", broken)
    assert refused.code in (1, 2)
    assert "pipe" in "".join(refused.errors)


@pytest.mark.parametrize("direction", [[1e308, 0, 0], [0, 1e-300, 0], [1e200, 1e200, 1e200]])
def test_a_sun_beyond_all_bounds_is_refused(spacesim, broken, direction):
    edit(broken / "transforms.json", lambda m: m["frames"][0].update(sun_direction=direction))
    assert spacesim("verify", broken).is_refusal(
        "expected 3 finite numbers, the largest of 1e-15 to 1e+15, as sun_direction"
    )


# --- names, sizes and what output can say ----------------------------------------------------------------------------


SEVERAL = """
import sys
from spacesim.cli import main
while sys.argv.pop(0) and sys.argv:
    end = sys.argv.index(";")
    if code := main(sys.argv[:end]):
        sys.exit(code)
    del sys.argv[:end]
"""


@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
def test_names_that_output_cannot_encode(tiny_data, tmp_path, encoding):
    """Runs whose names are no text, printed to a terminal that knows ASCII alone."""
    words: list[object] = []
    for number, name in enumerate(("l\u00fcn\u00e4", os.fsdecode(b"l\xff"))):
        words += ["train", tiny_data, "--out", tmp_path / name, *FEW, ";"]
        words += ["eval", tmp_path / name, "--data", tiny_data, "--out", tmp_path / f"e{number}", "--no-geometry", ";"]
    command = [sys.executable, "-c", SEVERAL, *map(os.fsencode, map(str, words))]
    done = subprocess.run(command, capture_output=True, env={**os.environ, "PYTHONIOENCODING": encoding}, timeout=100)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count(b"Gaussians after 8 iterations") == 2
    for number in range(2):
        assert (tmp_path / f"e{number}/report.html").stat().st_size > 10_000


def test_impossible_output_folders_are_refused(spacesim, tiny_run, tiny_data, tmp_path):
    (tmp_path / "file").write_text("")
    for out in (tmp_path / ("x" * 300), tmp_path / "file", tmp_path / "file" / "x"):
        for arguments in (
            ("generate", "boxsat", "--out", out, *GENERATE),
            ("train", tiny_data, "--out", out, *FEW),
            ("eval", tiny_run, "--data", tiny_data, "--out", out, "--no-geometry"),
            ("export", tiny_data, "--speedplus", out),
        ):
            refused = spacesim(*arguments)
            assert refused.code == 2, refused
            assert "computation" not in refused.errors[-1]
            assert str(out)[:40] in refused.errors[-1]


def test_pictures_larger_than_any_is_drawn_are_refused(spacesim, tiny_data, tmp_path):
    done = spacesim("train", tiny_data, "--out", tmp_path / "run", *FEW, "--method", "relight")
    assert done.code == 0, done.errors
    scene = tmp_path / "scene.toml"
    camera = "[camera]\nposition = [9, 0, 0]\nlook_at = [0, 0, 0]\nfov_deg = 30\nresolution = [16, 16]\n"
    scene.write_text(f"{camera}[[models]]\nrun = 'run'\n[sun]\nazimuth_deg = 1\nelevation_deg = 2\n")
    for size in ("16400x16", "16384x8193", "0x5", "99999999999"):
        for command in (("sweep", tmp_path / "run", "--frames", 2), ("compose", scene)):
            refused = spacesim(*command, "--out", tmp_path / "out", "--size", size)
            assert refused.is_refusal("--size: expected"), refused
    for size in ("16x16384", "16x16357"):  # beside the strip below it the video would be too high
        refused = spacesim("sweep", tmp_path / "run", "--frames", 2, "--out", tmp_path / "out", "--size", size)
        assert refused.is_refusal("--size: expected at most 16,356 rows"), refused
    for size in ("16384x16", "16x16356"):
        done = spacesim("sweep", tmp_path / "run", "--out", tmp_path / "s", "--size", size, "--frames", 2)
        assert done.code == 0, done.errors


def test_a_null_character_in_a_name_is_refused(spacesim, tiny_run, broken, tmp_path):
    scene = tmp_path / "scene.toml"
    scene.write_text('[[models]]\nrun = "a\\u0000b"\n')
    assert spacesim("compose", scene, "--out", tmp_path / "c").is_refusal("scene.toml, line 2", "null character")
    edit(broken / "transforms.json", lambda meta: meta.update(ply_file_path="a\0b"))
    assert spacesim("verify", broken).is_refusal("ply_file_path")


@pytest.mark.parametrize("pictures", [5, None, True, [], ["nope"], "rgb", ["rgb", "depth", "id", 5]])
def test_a_damaged_record_of_a_composed_frame_is_made_again(spacesim, tiny_run, tmp_path, pictures):
    scene, out = tmp_path / "scene.toml", tmp_path / "out"
    camera = "[camera]\nposition = [9, 0, 0]\nlook_at = [0, 0, 0]\nfov_deg = 30\nresolution = [16, 16]\n"
    scene.write_text(f"{camera}[[models]]\nrun = '{tiny_run}'\n")
    assert spacesim("compose", scene, "--out", out).code == 0
    honest = contents(out)
    edit(out / "shots/0000.json", lambda record: record.update(pictures=pictures))
    (out / "rgb/0000.png").unlink()
    done = spacesim("compose", scene, "--out", out)
    assert done.code == 0, done.errors
    assert contents(out) == honest


@pytest.mark.parametrize("damage", ["empty", "cut off", "one line less", "a dangling link"])
def test_verify_refuses_an_incomplete_list_of_digests(spacesim, broken, tmp_path, damage):
    sums, victim = broken / "SHA256SUMS", broken / "gt/train_00001.exr"
    lines = sums.read_text().splitlines(keepends=True)
    content = {"empty": "", "cut off": "".join(lines)[:-3]}.get(damage)
    if damage == "a dangling link":
        sums.unlink()
        sums.symlink_to("nowhere")
    else:
        kept = "".join(line for line in lines if victim.name not in line) if content is None else content
        sums.write_text(kept)
    flipped = bytearray(victim.read_bytes())
    flipped[-40] ^= 1
    victim.write_bytes(flipped)
    refused = spacesim("verify", broken)
    assert refused.code == 1, refused
    assert any("SHA256SUMS" in line for line in refused.errors)


def test_frames_that_were_damaged_before_the_end_are_made_again(spacesim, broken, tiny_data):
    """An interrupted run, without SHA256SUMS yet: no damage may get a digest."""
    for name in ("SHA256SUMS", "transforms.json"):
        (broken / name).unlink()
    picture = broken / "id/train_00001.png"
    flipped = bytearray(picture.read_bytes())
    flipped[flipped.index(b"IDAT") + 6] ^= 2
    picture.write_bytes(flipped)
    assert spacesim("generate", "boxsat", "--out", broken, *GENERATE, "--resume").code == 0
    assert contents(broken) == contents(tiny_data)
