"""The honest files that an attack damages, and the commands that read them. All as small as they can be."""

import json
import os
import random
import shutil
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mutations as m
import numpy as np
import trimesh
from PIL import Image

from spacesim.cli import main
from spacesim.data.store import read_dataset
from spacesim.splat.train.config import preset, warm_start
from spacesim.splat.train.train import train

SIDE = 16  #: pixels of pictures
TINY = ("--views", "3", "--test-views", "1", "--suns", "2", "--resolution", str(SIDE), "--spp", "1")
FEW = ("--preset", "demo", "--set", "init_count=40")
ONE = ("--views", "1", "--test-views", "0", "--resolution", "8", "--spp", "1")
SCENE = """
[[objects]]
mesh = "boat.obj"
position = [0, 0, 0]
scale = 1.0

[objects.materials]
"*" = "old-paint"

[materials.old-paint]
preset = "white-paint"
albedo = [0.7, 0.7, 0.7]

[sun]
shape = "disc"
distance_au = 1.0

[rig]
kind = "fibonacci"
views = 1
test_views = 0
suns = 1

[camera]
resolution = [8, 8]
fov_deg = 30.0
tone = "srgb"

[quality]
spp = 1
max_depth = 3
points = 50
"""
COMPOSED = """
[sun]
azimuth_deg = 40.0
elevation_deg = 25.0

[camera]
resolution = [16, 16]
fov_deg = 40.0
position = [8.0, 3.0, 2.0]
look_at = [0.0, 0.0, 0.0]

[[models]]
run = "run"
name = "first"
position = [0.0, 0.0, 0.0]

[[models]]
run = "run"
name = "second"
position = [1.0, 2.0, 0.0]
rotation_wxyz = [1.0, 0.0, 0.0, 0.0]
scale = 0.5
"""


@dataclass(frozen=True)
class Kind:
    """A kind of input."""

    name: str
    files: tuple[str, ...]  #: of the corpus, one of which is damaged
    ways: tuple[m.Mutation, ...]  #: of damaging it
    commands: tuple[tuple[str, ...], ...]  #: one of which then reads it, with {out} for a new path
    special: bool = True  #: whether a device, a pipe, a folder or a link may stand in its place


def _words(*lines: str) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(line.split()) for line in lines)


_TRAIN = f"train data --out {{out}} --iterations 2 {' '.join(FEW)}"
_LOOK = "render run --camera camera.json --sun 40,25 --out {out}.png"

KINDS = (
    Kind(
        "transforms.json", ("data/transforms.json",), (m.of_json, m.of_json, m.of_json, m.of_bytes, m.other_file),
        _words("verify data", "verify data", _TRAIN, "eval run --data data --out {out} --no-geometry",
               "export data --speedplus {out}", "render run --frame 1 --data data --out {out}.png"),
    ),
    Kind(
        "scene.json", ("data/scene.json",), (m.of_json, m.of_json, m.of_bytes, m.other_file),
        _words("verify data", "export data --speedplus {out}", "export data --bop {out}",
               f"{_TRAIN} --method relight", "eval run --data data --out {out} --no-geometry"),
    ),
    Kind(
        "SHA256SUMS", ("data/SHA256SUMS",), (m.of_bytes, m.other_file), _words("verify data"),
    ),
    Kind(
        "shots", ("composed/shots/0000.json",), (m.of_json, m.of_bytes, m.other_file),
        _words("compose composed.toml --out composed"),
    ),
    Kind(
        "camera.json", ("camera.json",), (m.of_json, m.of_json, m.of_bytes, m.other_file),
        _words(_LOOK, "sweep run --camera camera.json --frames 2 --out {out}"),
    ),
    Kind(
        "config.json", ("run/config.json",), (m.of_json, m.of_json, m.of_json, m.of_bytes, m.other_file),
        _words(_LOOK, _LOOK, _LOOK, _LOOK, "export run --ply {out}.ply --sun 1,2",
               "eval run --data data --out {out} --no-geometry"),
    ),
    Kind(
        "training.json", ("run/training.json",), (m.of_json, m.of_json, m.of_bytes, m.other_file),
        _words(_LOOK, "eval run --data data --out {out} --no-geometry"),
    ),
    Kind(
        "model", ("run/model.safetensors", "plain/model.safetensors"),
        (m.of_safetensors, m.of_safetensors, m.of_bytes, m.of_floats, m.other_file),
        _words(_LOOK, _LOOK, "render plain --camera camera.json --out {out}.png",
               "export plain --ply {out}.ply", "eval run --data data --out {out} --no-geometry"),
    ),
    Kind(
        "checkpoint",
        ("half/checkpoints/step_00000010.safetensors", "half/checkpoints/seconds.json", "half/config.json"),
        (m.of_safetensors, m.of_json, m.of_bytes, m.other_file),
        _words("train data --out half --iterations 12 --resume --warm-start --preset demo --set init_count=40"),
    ),
    Kind(
        "metrics.json", ("eval/metrics.json",), (m.of_json, m.of_json, m.of_json, m.of_bytes, m.other_file),
        _words("report eval --out {out}.html", "report eval eval2 --out {out}.html"),
    ),
    Kind(
        "pictures",
        ("data/images/train_00001.png", "data/shadow/test_00000.png", "data/silhouette/test_00000.png",
         "data/id/test_00000.png", "data/depth/train_00000.png", "other/images/a.jpg", "other/images/b.tif",
         "other/images/c.webp", "other/images/d.avif"),
        (m.of_png, m.of_bytes, m.of_bytes, m.other_file),
        _words("verify data", "verify other", _TRAIN, f"train other --out {{out}} --iterations 2 {' '.join(FEW)}",
               "eval run --data data --out {out} --no-geometry", "export data --speedplus {out}"),
    ),
    Kind(
        "COLMAP", tuple(f"colmap/sparse/0/{part}.bin" for part in ("cameras", "images", "points3D")),
        (m.of_bytes, m.of_bytes, m.of_floats, m.other_file),
        _words("import colmap colmap --out {out}", "import colmap colmap --out {out} --masks colmap/masks"),
    ),
    Kind(
        "COLMAP as text", tuple(f"colmap/text/{part}.txt" for part in ("cameras", "images", "points3D")),
        (m.of_words, m.of_words, m.of_bytes, m.other_file),
        _words("import colmap colmap/text --out {out} --images colmap/images"),
    ),
    Kind(
        "imported",
        ("nerfstudio/transforms.json", "nerfstudio/depth.npy", "colmap/images/a.png", "colmap/masks/b.png"),
        (m.of_json, m.of_json, m.of_png, m.of_bytes, m.other_file),
        _words("import nerfstudio nerfstudio --out {out}", "import colmap colmap --out {out} --masks colmap/masks",
               "import nerfstudio nerfstudio --out {out} --masked empty"),
    ),
    Kind(
        "EXR", ("data/gt/test_00000.exr", "data/gt/train_00001.exr"), (m.of_bytes, m.of_floats, m.other_file),
        _words("verify data", "eval run --data data --out {out} --no-geometry",
               f"{_TRAIN} --set depth_weight=0.1", f"{_TRAIN} --method shadow-map --set visibility_weight=0.1"),
    ),
    Kind(
        "PLY", ("data/points.ply", "data/mesh.ply"), (m.of_ply, m.of_bytes, m.of_floats, m.other_file),
        4 * _words("verify data", f"{_TRAIN} --init points", f"{_TRAIN} --init mesh", "export data --bop {out}",
                   f"{_TRAIN} --set prior=mesh --set depth_weight=0.1", f"{_TRAIN} --strategy mesh-aware")
        + _words("eval run --data data --out {out}"),  # evaluates the shape, which takes seconds
    ),
    Kind(
        "meshes", ("boat.obj", "boat.glb", "boat.gltf", "boat.stl", "words.stl", "boat.off", "boat.ply", "boat.mtl"),
        (m.of_bytes, m.of_glb, m.of_json, m.of_ply, m.of_floats, m.other_file),
        _words(*(f"generate {name} --out {{out}} {' '.join(ONE)}" for name in
                 ("boat.obj", "boat.glb", "boat.gltf", "boat.stl", "words.stl", "boat.off", "boat.ply", "boat.obj"))),
    ),
    Kind(
        "scene.toml", ("scene.toml",), (m.of_toml, m.of_toml, m.of_toml, m.of_bytes, m.other_file),
        _words(f"generate scene.toml --out {{out}} {' '.join(ONE)}", "generate scene.toml --print"),
    ),
    Kind(
        "composed.toml", ("composed.toml",), (m.of_toml, m.of_toml, m.of_toml, m.of_bytes, m.other_file),
        _words("compose composed.toml --out {out}", "eval composed.toml --data data --out {out} --no-geometry"),
    ),
)  # fmt: skip

_ANY = ("-1", "0", "1", "nan", "inf", "1e308", "-0.0", "1e-320", "", "x", "1,2", "400,91", "nan,0", "8x8", "16400x16")
_ANY = (
    *_ANY,
    "0x5",
    "1e9",
    "true",
    "None",
    "/dev/zero",
    "/dev/null",
    "nowhere",
    "data",
    "run",
    ".",
    "é",
    "\udcff",
    "--",
)
_SETTINGS = (
    *("views_per_step", "surfels", "antialiased", "supersample", "init_box", "depth_weight", "normal_weight"),
    *("prior", "random_background", "light.field.inputs", "light.bounce", "light.linear", "light.tone"),
    *("light.exposure", "light.shadow.bias", "light.shadow.grazing", "light.shadow.method"),
    *("light.shadow.method.filter", "light.shadow.method.radius", "light.shadow.size"),
    *(
        "init_count",
        "light.shadow.method.beta_min",
        "light.shadow.refine",
        "visibility_weight",
        "refinement.prune_opacity",
    ),
    *("refinement.split_screen_size", "strategy", "strategy.growth", "warm_start", "light", "rates"),
)
_LINES = (
    ("generate boat.obj --out {out} --views 1 --test-views 0 --resolution 8 --spp 1",
     ("--suns", "--sun", "--distance", "--exposure", "--seed", "--units", "--up", "--fov", "--test-suns",
      "--known-test-views", "--shared-test-views", "--resolution", "--resume", "--estimate", "--print", "--workers")),
    (_TRAIN,
     ("--method", "--strategy", "--init", "--warm-start", "--preset", "--seed", "--resume", "--fields",
      "--max-gaussians", "--method relight", "--method shadow-map", "--method shadow-splat", "--init random", "--set",
      *(f"--set {key}={{}}" for key in _SETTINGS))),
    ("render run --camera camera.json --out {out}.png",
     ("--sun", "--kind", "--exposure", "--frame", "--data", "--out")),
    ("sweep run --camera camera.json --out {out} --frames 2",
     ("--elevation", "--azimuth", "--frames", "--kind", "--exposure", "--size", "--keep-frames")),
    ("compose composed.toml --out {out}", ("--size", "--exposure", "--ply")),
    ("eval run --data data --out {out} --no-geometry", ("--split", "--lpips-weights", "--json")),
    ("report eval --out {out}.html", ("eval2", "data", "run")),
    ("export run --ply {out}.ply --sun 1,2", ("--sun", "--object", "--data", "--views", "--voxel", "--truncation")),
    ("export run --glb {out}.glb --sun 1,2", ("--up", "--scale", "--recentre", "--spz-version", "--spz", "--usd")),
    ("export run --mesh {out}.ply", ("--views", "--voxel", "--truncation", "--sun", "--data", "--mesh")),
    ("export data --speedplus {out}", ("--object", "--bop", "--sun")),
    ("verify data", ("--debug", "data", "--data")),
    ("import colmap colmap --out {out}", ("--images", "--masks", "--masked", "--out", "nerfstudio", "--depth-unit")),
    ("import nerfstudio nerfstudio --out {out}", ("--masked", "--depth-unit", "--masks", "blender", "--debug")),
    ("doctor", ("--json", "--debug", "x")),
)  # fmt: skip


def command_line(rng: random.Random) -> list[str]:
    """One of the commands with options that are too many, wrong or doubled."""
    line, options = rng.choice(_LINES)
    words = line.split()
    for _ in range(rng.choice((1, 1, 2, 3))):
        kind = rng.randrange(5)
        if kind < 3:
            option, any_ = rng.choice(options), rng.choice(_ANY)
            words += option.replace("{}", any_).split(" ", 1)
            if "{}" not in option and rng.random() < 0.8:
                words.append(any_)
        elif kind == 3 and len(words) > 1:
            words[rng.randrange(1, len(words))] = rng.choice(_ANY)
        elif len(words) > 1:
            del words[rng.randrange(1, len(words))]
    return words


def build(root: Path) -> Path:
    """Write the corpus into a new folder."""
    root.mkdir(parents=True)
    boat = trimesh.util.concatenate(
        [trimesh.creation.box((2, 1, 0.5)), trimesh.creation.icosphere(1, 0.6).apply_translation((0, 0, 0.7))]
    )
    for suffix in ("glb", "stl", "off", "ply"):
        (root / f"boat.{suffix}").write_bytes(_encoded(boat.export(file_type=suffix)))
    (root / "words.stl").write_text(boat.export(file_type="stl_ascii"))
    (root / "boat.obj").write_text(
        f"mtllib boat.mtl\nusemtl hull\n{boat.export(file_type='obj', include_normals=True)}"
    )
    (root / "boat.mtl").write_text("newmtl hull\nKd 0.6 0.5 0.4\nKs 0.2 0.2 0.2\nNs 40\nmap_Kd hull.png\n")
    Image.new("RGB", (8, 8), (200, 120, 40)).save(root / "hull.png")
    for name, content in boat.export(file_type="gltf").items():
        (root / ("boat.gltf" if name.endswith(".gltf") else name)).write_bytes(content)
    (root / "scene.toml").write_text(SCENE)
    (root / "composed.toml").write_text(COMPOSED)
    data = root / "data"
    _call("generate", root / "boat.obj", "--out", data, *TINY)
    _call("train", data, "--out", root / "run", "--iterations", "4", *FEW, "--method", "shadow-map")
    _call("train", data, "--out", root / "plain", "--iterations", "4", *FEW)
    _call("eval", root / "run", "--data", data, "--out", root / "eval")
    shutil.copytree(root / "eval", root / "eval2")
    config = replace(preset("demo"), init_count=40, iterations=12, checkpoint_every=10, warm_start=warm_start("demo"))
    train(read_dataset(data), root / "half", config)
    for name in ("model.safetensors", "training.json"):
        (root / "half" / name).unlink()
    meta = json.loads((data / "transforms.json").read_text())
    keys = ("w", "h", "fl_x", "fl_y", "cx", "cy")
    camera = {key: meta[key] for key in keys} | {"transform_matrix": meta["frames"][0]["transform_matrix"]}
    (root / "camera.json").write_text(json.dumps(camera))
    _call("compose", root / "composed.toml", "--out", root / "composed")
    _write_other(root / "other", meta)
    _write_colmap(root / "colmap")
    _write_nerfstudio(root / "nerfstudio", camera)
    return root


def _write_other(root: Path, meta: dict[str, object]) -> None:
    """Data from elsewhere, in other formats of pictures."""
    (root / "images").mkdir(parents=True)
    pixels = np.random.default_rng(0).integers(0, 255, (SIDE, SIDE, 3), np.uint8)
    names = ["a.jpg", "b.tif", "c.webp", "d.avif"]
    for name in names:
        Image.fromarray(pixels).save(root / "images" / name)
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": frame["transform_matrix"]}
        for name, frame in zip(names, meta["frames"], strict=False)  # type: ignore[arg-type]
    ]
    intrinsics = {key: meta[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")}
    (root / "transforms.json").write_text(json.dumps({**intrinsics, "frames": frames}))


def _write_colmap(root: Path) -> None:
    """A model, binary and with a lens that is undistorted, and text; its pictures and masks."""
    points, poses = (
        [(3, 0.1, 0.2, 0.3), (5, -0.4, 0.5, 0.6)],
        [(1.0, 0.0, 0.1 * k, 0.0, 0.1, 0.2, 3.0) for k in range(3)],
    )
    names, focal, middle = ["a.png", "b.png", "c.png"], 20.0, SIDE / 2
    for folder in ("sparse/0", "text", "images", "masks"):
        (root / folder).mkdir(parents=True)
    for name in names:
        pixels = np.random.default_rng(0).integers(0, 255, (SIDE, SIDE, 3), np.uint8)
        Image.fromarray(pixels).save(root / "images" / name)
        Image.fromarray(pixels[..., 0]).save(root / "masks" / name)
    cameras = struct.pack("<Qii2Q8d", 1, 1, 5, SIDE, SIDE, focal, focal, middle, middle, 0.05, -0.01, 0.0, 0.0)
    images, cloud = struct.pack("<Q", len(names)), struct.pack("<Q", len(points))
    texts = ["# Images"]
    for number, (name, pose) in enumerate(zip(names, poses, strict=True), start=1):
        images += struct.pack("<I7dI", number, *pose, 1) + name.encode() + b"\0" + struct.pack("<Q", len(points))
        images += b"".join(struct.pack("<ddQ", 1.0, 2.0, point[0]) for point in points)
        texts.append(f"{number} {' '.join(map(str, pose))} 1 {name}")
        texts.append(" ".join(f"1.0 2.0 {point[0]}" for point in points))
    for number, *place in points:
        cloud += struct.pack("<Q3d3BdQ", number, *place, 9, 8, 7, 0.5, 2) + struct.pack("<4I", 1, 0, 2, 0)
    for part, content in (("cameras", cameras), ("images", images), ("points3D", cloud)):
        (root / f"sparse/0/{part}.bin").write_bytes(content)
    (root / "text/cameras.txt").write_text(f"# Cameras\n1 OPENCV {SIDE} {SIDE} 20 21 8 8 0.1 0.02 0.001 0.002\n")
    (root / "text/images.txt").write_text("\n".join(texts) + "\n")
    lines = [f"{number} {x} {y} {z} 9 8 7 0.5 1 0 2 0" for number, x, y, z in points]
    (root / "text/points3D.txt").write_text("# Points\n" + "\n".join(lines) + "\n")


def _write_nerfstudio(root: Path, camera: dict[str, object]) -> None:
    """A folder with what only its importer reads: a fisheye lens, depth in a unit, masks."""
    root.mkdir()
    pixels = np.random.default_rng(0).integers(0, 255, (SIDE, SIDE, 3), np.uint8)
    for name in ("a.png", "b.png", "mask.png"):
        Image.fromarray(pixels).save(root / name)
    np.save(root / "depth.npy", np.ones((SIDE, SIDE), np.float32))
    shared = {"mask_path": "mask.png", "depth_file_path": "depth.npy"}
    frames = [
        {"file_path": name, "transform_matrix": camera["transform_matrix"], **shared} for name in ("a.png", "b.png")
    ]
    lens = {"camera_model": "OPENCV_FISHEYE", "k1": 0.05, "k2": -0.01, "depth_unit_scale_factor": 0.002}
    meta = {**camera, **lens, "frames": frames}
    del meta["transform_matrix"]
    (root / "transforms.json").write_text(json.dumps(meta))


def _call(*arguments: object) -> None:
    code = main([str(argument) for argument in arguments])
    assert code == 0, arguments


def _encoded(content: str | bytes) -> bytes:
    return content.encode() if isinstance(content, str) else content


def linked_copy(root: Path, target: Path) -> Path:
    """A copy of the corpus whose files are links to it: a program that replaces files harms none."""
    for folder, _, files in os.walk(root):
        copy = os.path.join(target, os.path.relpath(folder, root))
        os.makedirs(copy)
        for name in files:
            os.link(os.path.join(folder, name), os.path.join(copy, name))
    return target


Namer = Callable[[Sequence[str]], str]
