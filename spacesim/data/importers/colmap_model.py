"""COLMAP's sparse models, binary and text: cameras, images, points3D (https://colmap.github.io/format.html).

Other files beside them (rigs, frames) are passed over: images hold their poses.
"""

import codecs
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from spacesim.data.errors import InputError
from spacesim.data.files import read_bytes
from spacesim.data.geometry import Array, rotation_from_quaternion
from spacesim.data.importers.lenses import LENS_MODELS, NO_PINHOLE, Lens
from spacesim.data.structure import did_you_mean

_NAMES = {model.name: number for number, model in LENS_MODELS.items()} | {name: k for k, name in NO_PINHOLE.items()}
_OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_POINT = struct.Struct("<Q3d3BdQ")
_MAX_NAME = 4096  # bytes
Camera = Lens | InputError
"""A camera, or what is wrong with one, which matters where an image is of it."""


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """A registered image."""

    name: str  #: relative to the folder of images
    camera: int  #: number of its camera
    world_from_camera: Array  #: [4, 4], OpenCV axes, the model's units
    points: np.ndarray  #: [K] int64, numbers of the points that are seen in it


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A sparse model."""

    cameras: dict[int, Lens]  #: of the images, by their numbers
    images: list[ColmapImage]  #: in the order of their names
    numbers: np.ndarray = field(default_factory=lambda: np.empty(0, np.int64))  #: [N] int64 of the points
    points: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))  #: [N, 3] float64, the model's units
    colors: np.ndarray = field(default_factory=lambda: np.empty((0, 3), np.uint8))  #: [N, 3] uint8, sRGB


def holds_model(folder: Path) -> bool:
    """There are cameras and images of a model in a folder."""
    return any(all((folder / f"{part}{end}").is_file() for part in ("cameras", "images")) for end in (".bin", ".txt"))


def count_images(folder: Path) -> int:
    """Of the model in a folder, 0 where its file does not say."""
    try:
        if (folder / "images.bin").is_file():
            with (folder / "images.bin").open("rb") as file:
                return int(struct.unpack("<Q", file.read(8))[0])
        return sum(1 for _ in _text_images(folder / "images.txt"))
    except (OSError, struct.error, InputError):
        return 0


def read_model(folder: Path) -> ColmapModel:
    """The model in a folder: binary where there is a binary one, else text. points3D may be missing.

    Raises InputError, naming the file, where it is cut off, malformed, holds numbers that are not finite, no images, an
    image of a camera that is not there, or a camera that has no pinhole equivalent.
    """
    is_binary = (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file()
    end = ".bin" if is_binary else ".txt"
    cameras_path, images_path, points_path = (folder / f"{part}{end}" for part in ("cameras", "images", "points3D"))
    cameras = dict((_binary_cameras if is_binary else _text_cameras)(cameras_path))
    images: dict[str, ColmapImage] = {}
    used: dict[int, Lens] = {}
    for image in (_binary_images if is_binary else _text_images)(images_path):
        if image.name in images:
            raise InputError(f"{images_path}: expected each image once, found {image.name} twice")
        if image.camera not in cameras:
            raise InputError(f"{images_path}: {image.name}: expected one of its cameras, found number {image.camera}")
        images[image.name] = image
        lens = cameras[image.camera]
        if isinstance(lens, InputError):
            raise lens
        used[image.camera] = lens
    if not images:
        raise InputError(f"{images_path}: expected registered images, found none")
    ordered = [images[name] for name in sorted(images)]
    if not points_path.is_file():
        return ColmapModel(used, ordered)
    numbers, points, colors = (_binary_points if is_binary else _text_points)(points_path)
    if not np.isfinite(points).all():
        raise InputError(f"{points_path}: expected finite positions, found another one")
    return ColmapModel(used, ordered, numbers, points, colors)


def parts_of(model: ColmapModel) -> list[list[ColmapImage]]:
    """Images that hang together by points that two of them see, the largest part first. Where no image sees a point, as
    in models of given poses, all are one part; those that see none go with the largest."""
    seen = [np.unique(image.points) for image in model.images]
    points, columns = np.unique(np.concatenate(seen), return_inverse=True)
    if not len(points):
        return [model.images]
    rows = np.repeat(np.arange(len(seen)), [len(numbers) for numbers in seen])
    count = len(seen) + len(points)
    ones = np.ones(len(rows), np.int8)
    _, labels = connected_components(coo_array((ones, (rows, len(seen) + columns)), (count, count)), directed=False)
    parts: dict[int, list[ColmapImage]] = {}
    for image, numbers, label in zip(model.images, seen, labels, strict=False):
        parts.setdefault(int(label) if len(numbers) else -1, []).append(image)
    alone = parts.pop(-1, [])
    ordered = sorted(parts.values(), key=len, reverse=True)
    ordered[0] = sorted(ordered[0] + alone, key=lambda image: image.name)
    return ordered


def _lens(path: Path, number: int, model: int, width: int, height: int, parameters: tuple[float, ...]) -> Camera:
    if model in NO_PINHOLE:
        return InputError(
            f"{path}: camera {number}: expected a lens that a pinhole camera can stand for, found {NO_PINHOLE[model]}"
        )
    try:
        return Lens(LENS_MODELS[model], width, height, parameters)
    except InputError as error:
        return InputError(f"{path}: camera {number}: {error}")


def _image(path: Path, name: str, camera: int, quaternion: Array, shift: Array, points: np.ndarray) -> ColmapImage:
    """COLMAP's pose is the world in the camera's axes."""
    with np.errstate(over="ignore"):
        length = np.linalg.norm(quaternion)
    if not (np.isfinite(length) and length > 1e-6 and np.isfinite(shift).all()):
        raise InputError(
            f"{path}: {name}: expected a pose of finite numbers, found {[*quaternion.tolist(), *shift.tolist()]}"
        )
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_quaternion(quaternion).T
    pose[:3, 3] = -pose[:3, :3] @ shift
    return ColmapImage(name, camera, pose, points[points >= 0])


class _Bytes:
    """A binary file, read from its start to its end."""

    def __init__(self, path: Path) -> None:
        self.path, self.content, self.position = path, read_bytes(path, "a COLMAP model"), 0
        if self.content[:1] == b"#":
            raise InputError(f"{path}: expected a binary COLMAP model, found text; a text model's files end in .txt")

    def take(self, layout: str) -> tuple[float | int, ...]:
        """The numbers of the layout (of struct, little-endian) that come next."""
        try:
            numbers = struct.unpack_from(f"<{layout}", self.content, self.position)
        except struct.error:
            raise self.cut_off() from None
        self.position += struct.calcsize(f"<{layout}")
        return numbers

    def count(self, least: int) -> int:
        """A number of things, of at least so many bytes each."""
        (number,) = self.take("Q")
        if number * least > len(self.content) - self.position:
            raise self.cut_off()
        return int(number)

    def name(self) -> str:
        """Text up to a null."""
        end = self.content.find(b"\0", self.position, self.position + _MAX_NAME)
        if end < 0:
            raise self.cut_off()
        text, self.position = self.content[self.position : end], end + 1
        return text.decode("utf-8", "surrogateescape")

    def end(self) -> None:
        """Nothing may follow."""
        if self.position != len(self.content):
            raise InputError(
                f"{self.path}: expected {self.position:,} bytes as its counts say, found {len(self.content):,}"
            )

    def cut_off(self) -> InputError:
        return InputError(f"{self.path}: expected a binary COLMAP model, found one that is cut off or damaged")


def _binary_cameras(path: Path) -> Iterator[tuple[int, Camera]]:
    file = _Bytes(path)
    for _ in range(file.count(24)):
        number, model, width, height = map(int, file.take("iiQQ"))
        if model not in LENS_MODELS and model not in NO_PINHOLE:
            raise InputError(f"{path}: camera {number}: expected a camera model of COLMAP's, found number {model}")
        count = 2  # of EQUIRECTANGULAR
        if model not in NO_PINHOLE:
            count = LENS_MODELS[model].focal_lengths + 2 + LENS_MODELS[model].others
        yield number, _lens(path, number, model, width, height, tuple(map(float, file.take(f"{count}d"))))
    file.end()


def _binary_images(path: Path) -> Iterator[ColmapImage]:
    file = _Bytes(path)
    for _ in range(file.count(73)):
        _, *pose, camera = file.take("I7dI")
        name, count = file.name(), file.count(_OBSERVATION.itemsize)
        seen = np.frombuffer(file.content, _OBSERVATION, count, file.position)["point"]
        file.position += count * _OBSERVATION.itemsize
        yield _image(path, name, int(camera), np.array(pose[:4]), np.array(pose[4:]), seen)
    file.end()


def _binary_points(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    file = _Bytes(path)
    count = file.count(_POINT.size)
    numbers, points, colors = np.empty(count, np.int64), np.empty((count, 3)), np.empty((count, 3), np.uint8)
    for k in range(count):
        try:
            number, *values, _, track = _POINT.unpack_from(file.content, file.position)
        except struct.error:
            raise file.cut_off() from None
        file.position += _POINT.size + 8 * track
        if number >= 1 << 63 or file.position > len(file.content):
            raise file.cut_off()
        numbers[k], points[k], colors[k] = number, values[:3], values[3:]
    file.end()
    return numbers, points, colors


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """(number, text) of a text file's lines without the comments."""
    content = read_bytes(path, "a COLMAP model")
    if b"\0" in content[:4096]:
        raise InputError(
            f"{path}: expected a COLMAP model as text, found binary data; a binary model's files end in .bin"
        )
    text = content.removeprefix(codecs.BOM_UTF8).decode("utf-8", "surrogateescape")
    for number, line in enumerate(text.split("\n"), start=1):
        if not line.startswith("#"):
            yield number, line.strip()


def _malformed(path: Path, number: int, line: str, expected: str) -> InputError:
    return InputError(f"{path}: line {number}: expected {expected}, found {line[:80]!r}")


def _text_cameras(path: Path) -> Iterator[tuple[int, Camera]]:
    for number, line in _lines(path):
        if not line:
            continue
        try:
            camera, model, width, height, *parameters = line.split()
            values = int(camera), int(width), int(height), tuple(map(float, parameters))
        except (ValueError, OverflowError):
            raise _malformed(path, number, line, "CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS") from None
        if model not in _NAMES:
            hint = did_you_mean(model, _NAMES)
            raise InputError(f"{path}: line {number}: expected a camera model of COLMAP's, found {model[:80]!r}{hint}")
        yield values[0], _lens(path, values[0], _NAMES[model], *values[1:])


def _text_images(path: Path) -> Iterator[ColmapImage]:
    """Two lines each, the second of which may be empty."""
    lines = _lines(path)
    for number, line in lines:
        if not line:
            continue
        try:
            _, qw, qx, qy, qz, tx, ty, tz, camera, name = line.split(maxsplit=9)
            quaternion, shift = np.array([qw, qx, qy, qz], np.float64), np.array([tx, ty, tz], np.float64)
            camera_number = int(camera)
        except (ValueError, OverflowError):
            expected = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            raise _malformed(path, number, line, expected) from None
        number, line = next(lines, (number, ""))
        try:
            seen = np.array(line.split()[2::3], np.int64)
        except (ValueError, OverflowError):
            seen = None
        if seen is None or len(line.split()) % 3:
            raise _malformed(path, number, line, f"X Y POINT3D_ID for each point of {name}")
        yield _image(path, name, camera_number, quaternion, shift, seen)


def _text_points(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    numbers, points, colors = [], [], []
    for number, line in _lines(path):
        if not line:
            continue
        try:
            words = line.split(maxsplit=7)
            numbers.append(np.int64(words[0]))
            points.append([float(word) for word in words[1:4]])
            colors.append([np.uint8(int(word)) for word in words[4:7]])
            if len(words) < 7:
                raise ValueError
        except (ValueError, OverflowError):
            raise _malformed(path, number, line, "POINT3D_ID X Y Z R G B ERROR TRACK") from None
    return (
        np.array(numbers, np.int64),
        np.array(points, np.float64).reshape(-1, 3),
        np.array(colors, np.uint8).reshape(-1, 3),
    )
