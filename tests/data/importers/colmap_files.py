"""Writes COLMAP's sparse models, after its description of the formats and nothing of ours, and projects of them."""

import struct
from dataclasses import dataclass, field

import numpy as np
from PIL import Image

import spacesim as ss
from spacesim.data.importers.lenses import LENS_MODELS, Lens

NUMBERS = {
    name: number
    for number, name in enumerate(
        (
            *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV"),
            *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"),
            *("SIMPLE_DIVISION", "DIVISION", "SIMPLE_FISHEYE", "FISHEYE", "EUCM", "EQUIRECTANGULAR"),
        )
    )
}


@dataclass
class ColmapImage:
    name: str
    pose: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 3.0)  #: qw qx qy qz tx ty tz, camera from world
    camera: int = 1
    seen: tuple[int, ...] = ()  #: points, -1 for a feature without one


@dataclass
class Model:
    cameras: dict = field(default_factory=lambda: {1: ("SIMPLE_PINHOLE", 16, 12, (20.0, 8.0, 6.0))})
    images: list = field(default_factory=list)
    points: dict = field(default_factory=dict)  #: number: ((x, y, z), (r, g, b))


def write_binary(folder, model):
    folder.mkdir(parents=True, exist_ok=True)
    data = struct.pack("<Q", len(model.cameras))
    for number, (name, width, height, parameters) in model.cameras.items():
        data += struct.pack(f"<iiQQ{len(parameters)}d", number, NUMBERS[name], width, height, *parameters)
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(model.images))
    for number, image in enumerate(model.images, start=1):
        data += struct.pack("<I7dI", number, *image.pose, image.camera) + image.name.encode() + b"\0"
        data += struct.pack("<Q", len(image.seen))
        for point in image.seen:
            data += struct.pack("<ddQ", 1.5, 2.5, point % 2**64)
    (folder / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(model.points))
    for number, (xyz, rgb) in model.points.items():
        track = [k for k, image in enumerate(model.images, start=1) if number in image.seen]
        data += struct.pack("<Q3d3BdQ", number, *xyz, *rgb, 0.5, len(track))
        for k in track:
            data += struct.pack("<II", k, 0)
    (folder / "points3D.bin").write_bytes(data)


def write_text(folder, model):
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["# Camera list with one line of data per camera:"]
    for number, (name, width, height, parameters) in model.cameras.items():
        lines.append(f"{number} {name} {width} {height} {' '.join(map(repr, parameters))}")
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list with two lines of data per image:"]
    for number, image in enumerate(model.images, start=1):
        lines.append(f"{number} {' '.join(map(repr, image.pose))} {image.camera} {image.name}")
        lines.append(" ".join(f"1.5 2.5 {point}" for point in image.seen))
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    lines = ["# 3D point list with one line of data per point:"]
    for number, (xyz, rgb) in model.points.items():
        track = [k for k, image in enumerate(model.images, start=1) if number in image.seen]
        words = [number, *xyz, *rgb, 0.5, *(word for image in track for word in (image, 0))]
        lines.append(" ".join(map(str, words)))
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")


WRITERS = {"binary": write_binary, "text": write_text}


def ring(count=5, **options):
    """A model of cameras around some points, all of which each sees."""
    rng = np.random.default_rng(1)
    points = {
        10 * k + 7: (tuple(map(float, rng.normal(size=3))), tuple(map(int, rng.integers(0, 256, 3)))) for k in range(20)
    }
    images = []
    for k in range(count):
        half = np.pi * k / count
        pose = (float(np.cos(half)), 0.0, float(np.sin(half)), 0.0, 0.1 * k, -0.2, 5.0)
        images.append(ColmapImage(f"view {k}.png", pose, seen=(*points, -1)))
    return Model(images=images, points=points, **options)


EXAMPLES = {  # what lenses distort by, as strongly as there are such lenses
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": (0.1,),
    "RADIAL": (0.1, -0.05),
    "OPENCV": (0.1, -0.05, 0.01, -0.02),
    "OPENCV_FISHEYE": (0.05, -0.02, 0.01, -0.003),
    "FULL_OPENCV": (0.1, -0.05, 0.01, -0.02, 0.03, 0.02, -0.01, 0.004),
    "FOV": (0.9,),
    "SIMPLE_RADIAL_FISHEYE": (0.05,),
    "RADIAL_FISHEYE": (0.05, -0.02),
    "THIN_PRISM_FISHEYE": (0.05, -0.02, 0.01, -0.004, 0.003, -0.001, 0.002, -0.003),
    "RAD_TAN_THIN_PRISM_FISHEYE": (0.05, -0.02, 0.01, -0.004, 0.003, -0.001, 0.01, -0.02, 0.001, 0.002, -0.001, 0.003),
    "SIMPLE_DIVISION": (-0.1,),
    "DIVISION": (-0.2,),
    "SIMPLE_FISHEYE": (),
    "FISHEYE": (),
    "EUCM": (0.6, 1.1),
}
MODELS = {model.name: model for model in LENS_MODELS.values()}


def lens_of(name, width=64, height=48, focal=40.0):
    focals = (focal,) if MODELS[name].focal_lengths == 1 else (focal, 1.1 * focal)
    return Lens(MODELS[name], width, height, (*focals, 0.5 * width + 1, 0.5 * height - 2, *EXAMPLES[name]))


def write_pictures(folder, names, size=(16, 12), mode="RGB", color=(10, 20, 30)):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new(mode, size, color).save(folder / name)


def project(root, model=None, form="binary", size=(16, 12), sparse="sparse/0"):
    """A folder with a model and its pictures."""
    model = ring() if model is None else model
    WRITERS[form](root / sparse, model)
    write_pictures(root / "images", [image.name for image in model.images], size)
    return root


def imported(root, out, **options):
    return ss.import_dataset("colmap", root, out, **options)


def write_masks(folder, names, size=(16, 12), mode="L"):
    """White in the left half."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        white = np.zeros((size[1], size[0]), np.uint8)
        white[:, : size[0] // 2] = 255
        if mode == "RGBA":
            white = np.stack([np.full_like(white, 90)] * 3 + [white], axis=-1)
        Image.fromarray(white).save(folder / name)
