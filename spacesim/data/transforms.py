"""Reads a dataset by the rules of Nerfstudio's transforms.json (docs.nerf.studio, "Data conventions").

Blender's pair transforms_train.json and transforms_test.json is taken too. Poses are used as written
(`applied_transform` is already in them), and so are their units. Which frames are held out for testing:

1. those of `test_filenames`, else of `val_filenames`, where transforms.json has such lists;
2. else those in a folder named test, else val, where there is a folder named train beside it;
3. else every 8th frame, beginning with the first, in the order of their file paths.

Frames whose image is not there are left out, with a warning that counts them; but where digests lie beside, the folder
has been whole, and what is missing is damage.
"""

import logging
import math
import os
import re
from collections.abc import Container, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path, PurePosixPath

import numpy as np

from spacesim.data.earth import EARTH_ALBEDO, Earth
from spacesim.data.errors import InputError
from spacesim.data.files import MAX_LIST_BYTES, JsonValue, as_path, read_json
from spacesim.data.geometry import OPENCV_FROM_OPENGL, as_numbers
from spacesim.data.images import check_lens, image_size
from spacesim.data.integrity.manifest import NAME as DIGESTS
from spacesim.data.records import MAX_SIDE, SUN_WORDS, Camera, Dataset, Frame, Sun

_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
TRUTH_PATHS = ("gt_path", "shadow_path", "silhouette_path", "id_path", "depth_file_path", "mask_path")
DEPTH_UNITS = "depth_unit_scale_factor", "integer_depth_scale"  #: keys: Nerfstudio's name, instant-ngp's
MILLIMETRE = 1e-3  #: metres: Nerfstudio's default
MAX_DEPTH_UNIT = 1e30  #: metres a step
OFF_CENTRE = 100  #: sizes of a picture from it at which its principal point may be
FARTHEST = 1e9  #: metres from the origin at which a camera may be: nothing is drawn beyond
_HOLD_OUT = 8
_SPLITS = ("train", "val", "test")
_UNTIDY = re.compile(r"(^|/)(\.?/|\.?$)")  # paths that have parts without a meaning

Json = Mapping[str, JsonValue]
_log = logging.getLogger(__name__)


def read_dataset(path: str | Path) -> Dataset:
    """The dataset in a folder, or of the transforms.json named.

    Raises InputError, naming the file, where it is no such dataset: nothing there, an unfinished `generate`,
    malformed JSON, no frames, none with an image, a pose or a camera that cannot be, or a camera model with no
    pinhole equivalent. Files of truth are only looked for when they are loaded.
    """
    path = as_path(path, "path")
    root = path if path.is_dir() else path.parent
    source = root / "transforms.json" if path.is_dir() else path
    if source.is_file() and source.name != "transforms_train.json":
        return dataset_of(source, read_object(source))
    if os.path.exists(path) and (root / "transforms_train.json").is_file():
        return dataset_of_pair(root, *read_pair(root))
    raise InputError(_say_what_is_missing(path, root))


def dataset_of(path: Path, meta: Json) -> Dataset:
    """The dataset whose transforms.json, at `path`, says or will say `meta`. Raises InputError as `read_dataset`."""
    frames, missing = _read_frames(path, meta)
    _warn_of_missing(path, missing, len(frames))
    return _dataset(path, meta, *_split(path, meta, frames, missing), missing)


def read_pair(root: Path) -> tuple[Json, tuple[str, Json] | None]:
    """(content of transforms_train.json, (name, content) of transforms_test.json, else of transforms_val.json) of a
    folder laid out as Blender's scenes are."""
    held_out = next((p for p in (root / "transforms_test.json", root / "transforms_val.json") if p.is_file()), None)
    of_test = (held_out.name, read_object(held_out)) if held_out else None
    return read_object(root / "transforms_train.json"), of_test


def dataset_of_pair(root: Path, meta: Json, held_out: tuple[str, Json] | None) -> Dataset:
    """The dataset of what `read_pair` returns. Raises InputError as `read_dataset`."""
    source = root / "transforms_train.json"
    train, missing = _read_frames(source, meta)
    test, missing_test = _read_frames(root / held_out[0], held_out[1], needed=False) if held_out else ((), ())
    _warn_of_missing(source, missing + missing_test, len(train) + len(test))
    return _dataset(source, meta, train, test, missing + missing_test)


def _warn_of_missing(source: Path, missing: tuple[str, ...], read: int) -> None:
    if missing:
        count = len(missing) + read
        _log.warning(
            "%s: %d of %d frames have no image and are left out, %s first",
            source,
            len(missing),
            count,
            missing[0][:200],
        )


def _dataset(
    path: Path, meta: Json, train: tuple[Frame, ...], test: tuple[Frame, ...], missing: tuple[str, ...]
) -> Dataset:
    if not train:
        raise InputError(f"{path}: expected frames to train on, found none")
    root = path.parent
    scene = read_object(root / "scene.json") if (root / "scene.json").exists() else {}
    points, mesh = (_path(path, meta, key) for key in ("ply_file_path", "mesh_path"))
    return Dataset(root, train, test, points, mesh, scene, missing, read_depth_unit(path, meta))


def read_depth_unit(path: Path, values: Json) -> float:
    """Metres a step of depth pictures, by transforms.json or one of its frames. Raises InputError where that cannot
    be."""
    key = next((key for key in DEPTH_UNITS if values.get(key) is not None), DEPTH_UNITS[0])
    try:
        unit = MILLIMETRE if values.get(key) is None else _number(values, key)
        if 0 < unit < MAX_DEPTH_UNIT:
            return unit
        raise InputError(f"expected metres above 0 as {key}, found {values[key]!r}")
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def read_camera(path: Path) -> Camera:
    """The camera of a JSON file with the keys of a frame: transform_matrix, w, h, fl_x or camera_angle_x, ...

    A whole transforms.json is taken too: its first frame counts, as the log says. Raises InputError where a key is
    missing or broken.
    """
    values = dict(read_object(path))
    frames = values.pop("frames", None)
    if isinstance(frames, list) and frames and isinstance(frames[0], dict):
        values |= frames[0]
        _log.info("%s: the camera is its first frame's, %s", path, values.get("file_path", "which has no name"))
    values = _without_nulls(values)
    try:
        if "w" not in values or "h" not in values:
            raise InputError("expected w and h, the size in pixels, found none")
        return _read_camera(values, path)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def read_views(path: Path) -> dict[str, Frame]:
    """Cameras, lenses and Suns in a file like transforms.json, by its file paths, whether pictures are there or
    not; of a file of one camera (see `read_camera`), that alone under "". Frames without a pose are left out. Raises
    InputError where a key is missing or broken, and where there is no frame."""
    meta = read_object(path)
    entries = meta.get("frames", [{"file_path": ""}])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(f"{path}: expected a list of frames, found another value")
    frames = {}
    for entry in entries:
        values = _without_nulls({**meta, **entry})
        name = str(values.get("file_path", ""))
        if "transform_matrix" not in values:
            continue
        try:
            if "w" not in values or "h" not in values:
                raise InputError("expected w and h, the size in pixels, found none")
            camera, sun = _read_camera(values, path), _read_sun(values)
            lens = _read_distortion(values, camera)
        except InputError as error:
            raise InputError(f"{path}: frame {name}: {error}" if name else f"{path}: {error}") from None
        frames[name] = Frame(name, camera, sun, distortion=lens)
    if not frames:
        raise InputError(f"{path}: expected frames with a transform_matrix, found none")
    return frames


def read_sun(path: Path, file_path: str) -> Sun | None:
    """The Sun that a file like transforms.json has of a frame, None where it has none. Raises InputError where it is
    broken."""
    entries = read_object(path).get("frames")
    for entry in entries if isinstance(entries, list) else ():
        if isinstance(entry, dict) and entry.get("file_path") == file_path:
            try:
                return _read_sun(_without_nulls(entry))
            except InputError as error:
                raise InputError(f"{path}: frame {file_path}: {error}") from None
    return None


def _say_what_is_missing(path: Path, root: Path) -> str:
    if not path.exists():
        return f"{path}: expected a dataset folder or a transforms.json, found nothing"
    if (root / "scene.json").is_file():
        return f"{path}: expected transforms.json, found an unfinished one; generate with resume=True completes it"
    colmap = any((root / name).exists() for name in ("sparse", "database.db", "images.bin", "images.txt"))
    hint = "; `spacesim import colmap` makes a dataset of a COLMAP project" if colmap else ""
    return f"{path}: expected a dataset folder with a transforms.json, found none in it{hint}"


def read_object(path: Path) -> Json:
    """The JSON object in a file. Raises InputError for anything else."""
    value = read_json(path, MAX_LIST_BYTES)
    if not isinstance(value, dict):
        raise InputError(f"{path}: expected a JSON object, found {type(value).__name__}")
    return value


def _read_frames(source: Path, meta: Json, needed: bool = True) -> tuple[tuple[Frame, ...], tuple[str, ...]]:
    """(all frames with an image, paths of the images that are not there), each in the order of their file paths.
    needed: there must be one"""
    entries = meta.get("frames")
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(f"{source}: expected a list of frames, found {'none' if not entries else 'another value'}")
    named = sorted(((image_path(source, entry), entry) for entry in entries), key=lambda pair: pair[0])
    for (first, _), (second, _) in pairwise(named):
        if first == second:
            raise InputError(f"{source}: expected each image once, found {first} twice")
    there = {path for path, _ in named if os.path.exists(os.path.join(source.parent, path))}
    missing = tuple(path for path, _ in named if path not in there)
    if missing and ((needed and not there) or (source.parent / DIGESTS).is_file()):
        others = "" if there else ", nor one of any other frame"
        raise InputError(f"{source}: frame {missing[0]}: expected an image file, found none{others}")
    frames = [_read_frame(source, meta, entry, path) for path, entry in named if path in there]
    numbers = {path for path, entry in named if isinstance(entry.get("exposure"), int | float)}
    unread = [frame.file_path for frame in frames if frame.file_path in numbers and frame.exposure is None]
    if unread:
        _log.warning("%s: exposure of %d frames (%s first) is not above 0, so not read", source, len(unread), unread[0])
    return tuple(frames), missing


def image_path(source: Path, entry: Json) -> str:
    """Of a frame, relative to the folder of `source`."""
    file_path = _path(source, entry, "file_path")
    if file_path is None:
        raise InputError(f"{source}: expected file_path in every frame, found a frame without")
    image = os.path.join(source.parent, file_path)
    if not os.path.isfile(image) and os.path.isfile(f"{image}.png"):
        file_path += ".png"  # Blender's files leave the suffix out
    return file_path


def _read_frame(source: Path, meta: Json, entry: Json, file_path: str) -> Frame:
    image = source.parent / file_path
    values = _without_nulls({**meta, **entry})
    try:
        if not os.path.isfile(image):
            raise InputError("expected an image file, found something else")
        camera, sun = _read_camera(values, image), _read_sun(values)
        distortion = _read_distortion(values, camera)
        time = _number(entry, "time") if entry.get("time") is not None else None
        objects = _read_objects(entry)
    except InputError as error:
        raise InputError(f"{source}: frame {file_path}: {error}") from None
    paths = {key: _path(source, entry, key) for key in TRUTH_PATHS}
    exposure = entry.get("exposure")  # others mean all kinds of things by it
    own = float(exposure) if isinstance(exposure, int | float) and 0 < exposure < math.inf else None
    return Frame(file_path, camera, sun, **paths, time=time, distortion=distortion, exposure=own, objects=objects)


def _read_objects(entry: Json) -> dict[int, np.ndarray]:
    """{number: world_from_object [4, 4]} of a frame whose objects move; others mean all kinds of things by the key."""
    listed = entry.get("objects")
    poses = {}
    for item in listed if isinstance(listed, list) else ():
        if isinstance(item, dict) and "world_from_object" in item:
            try:
                pose = np.asarray(item["world_from_object"], np.float64)
                number = int(item["id"])
            except (KeyError, TypeError, ValueError, OverflowError):
                pose, number = np.empty(0), 0
            if pose.shape != (4, 4) or not np.isfinite(pose).all() or number < 1:
                raise InputError(
                    "expected an id and a world_from_object of 4x4 finite numbers in objects, found others"
                )
            poses[number] = pose
    return poses


def check_still(dataset: Dataset) -> Dataset:
    """`dataset`; raises InputError where its objects move, which no model of one shape can show."""
    moving = [frame.file_path for frame in dataset.frames if frame.objects]
    if moving:
        expected = "expected objects that stand still to each other"
        raise InputError(f"{dataset.root}: {expected}, found {len(moving)} frames that move some, {moving[0]} first")
    return dataset


def _read_camera(values: Json, image: Path) -> Camera:
    if (fisheye := values.get("is_fisheye", False)) not in (False, True):
        raise InputError(f"expected true or false as is_fisheye, found {fisheye!r}")
    model = "OPENCV_FISHEYE" if fisheye else values.get("camera_model", "OPENCV")
    if model not in _PERSPECTIVE:
        found = model if str(model).isidentifier() else f"{model!r:.60}"
        help_ = "; spacesim import nerfstudio undistorts it" if model == "OPENCV_FISHEYE" else ""
        raise InputError(f"expected a camera_model among {', '.join(_PERSPECTIVE)}, found {found}{help_}")
    if "w" in values and "h" in values:
        width, height = round(_number(values, "w")), round(_number(values, "h"))
    else:
        width, height = image_size(image)
    fx = _focal_length(values, "fl_x", "camera_angle_x", width)
    fy = _focal_length(values, "fl_y", "camera_angle_y", height)
    if fx is None:
        raise InputError("expected fl_x or camera_angle_x, found neither")
    fy = fx if fy is None else fy
    cx, cy = _number(values, "cx", 0.5 * width), _number(values, "cy", 0.5 * height)
    pose = _read_pose(values)
    camera = Camera(pose @ OPENCV_FROM_OPENGL, width, height, fx, fy, cx, cy)
    check_place(camera)
    if np.abs(pose[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise InputError(f"expected 0 0 0 1 as the last row of transform_matrix, found {pose[3].tolist()}")
    return camera


def check_place(camera: Camera) -> None:
    """Raise InputError for a camera farther than `FARTHEST` from the origin, and for a principal point farther from the
    picture than any crop's is, or `OFF_CENTRE` times its size."""
    if np.abs(camera.position).max() > FARTHEST:
        raise InputError(f"expected a camera within {FARTHEST:g} m of the origin, found it at {camera.position}")
    reach = max(MAX_SIDE, OFF_CENTRE * camera.width, OFF_CENTRE * camera.height)
    if max(abs(camera.cx), abs(camera.cy)) > reach:
        raise InputError(f"expected cx and cy within {reach} pixels, found {camera.cx:g} and {camera.cy:g}")


def _focal_length(values: Json, key: str, angle_key: str, size: int) -> float | None:
    """In pixels, of a focal length or an angle of view (radians) across `size` pixels; None of neither."""
    if key in values:
        return _number(values, key)
    if angle_key in values:
        angle = _number(values, angle_key)
        if not 0 < angle < math.pi:
            raise InputError(f"expected an angle from 0 to pi as {angle_key}, found {angle}")
        return 0.5 * size / math.tan(0.5 * angle)
    return None


def _read_pose(values: Json) -> np.ndarray:
    """[4, 4] camera to world, OpenGL axes."""
    try:
        pose = np.asarray(values.get("transform_matrix"), np.float64)
    except (TypeError, ValueError, OverflowError):
        pose = np.empty(0)
    if pose.shape == (3, 4):
        pose = np.vstack([pose, [0, 0, 0, 1]])
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise InputError("expected a transform_matrix of 4x4 finite numbers, found another value")
    return pose


def _read_distortion(values: Json, camera: Camera) -> tuple[float, ...]:
    """Brown-Conrady k1, k2, p1, p2, k3, or () where all are 0."""
    coefficients = tuple(_number(values, key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3"))
    if _number(values, "k4", 0.0) != 0:
        raise InputError("expected distortion k1, k2, k3, p1, p2, found k4 as well")
    check_lens(camera, coefficients)
    return coefficients if any(coefficients) else ()


def _read_sun(values: Json) -> Sun | None:
    sun = _read_direction(values)
    return sun and replace(sun, earth=_read_earth(values))


def _read_direction(values: Json) -> Sun | None:
    if "sun_direction" in values:
        try:
            return Sun(np.asarray(values["sun_direction"], np.float64))
        except (TypeError, ValueError, OverflowError):
            raise InputError(f"expected {SUN_WORDS}, as sun_direction, found other values") from None
    if "sun_azimuth_deg" in values and "sun_elevation_deg" in values:
        return Sun.from_angles(_number(values, "sun_azimuth_deg"), _number(values, "sun_elevation_deg"))
    return None


def _read_earth(values: Json) -> Earth | None:
    if "earth_direction" not in values:
        return None
    radius = _number(values, "earth_angular_radius_deg")
    return Earth(as_numbers(values["earth_direction"]), radius, _number(values, "earth_albedo", EARTH_ALBEDO))


def earth_keys(earth: Earth) -> dict[str, JsonValue]:
    """What a frame of transforms.json says of the Earth that lights it."""
    direction = earth.direction.tolist()
    return {
        "earth_direction": direction,
        "earth_angular_radius_deg": earth.angular_radius_deg,
        "earth_albedo": earth.albedo,
    }


def _split(
    source: Path, meta: Json, frames: tuple[Frame, ...], missing: tuple[str, ...]
) -> tuple[tuple[Frame, ...], tuple[Frame, ...]]:
    """(train, test) of `frames` by the rules above. missing: paths of frames that are left out"""
    paths = dict.fromkeys(frame.file_path for frame in frames)
    lists = {key: meta.get(f"{key}_filenames") for key in _SPLITS}
    listed = {key: _listed(source, names, paths, missing) for key, names in lists.items() if names is not None}
    folders = {key: {path for path in paths if key in PurePosixPath(path).parts[:-1]} for key in _SPLITS}
    if listed:
        test = listed.get("test", listed.get("val"))
        train = listed.get("train", set(paths) - (test or set()))
        test = set(paths) - train if test is None else test
    elif folders["train"] and (folders["test"] or folders["val"]):
        train, test = folders["train"], folders["test"] or folders["val"]
    else:
        test = set(list(paths)[::_HOLD_OUT]) if len(paths) > 1 else set()
        train = set(paths) - test
    if train & test:
        both = min(train & test)
        raise InputError(f"{source}: expected frames for training and testing apart, found {both} in both")
    return tuple(f for f in frames if f.file_path in train), tuple(f for f in frames if f.file_path in test)


def _listed(source: Path, names: object, paths: Container[str], missing: tuple[str, ...]) -> set[str]:
    """The file paths of a list such as `train_filenames`, each of which must be one of a frame, without those that are
    missing."""
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f"{source}: expected lists of file paths as train_filenames and the like")
    named = {_relative(source, name) for name in names}.difference(missing)
    listed = {name: name if name in paths else f"{name}.png" for name in named}
    unknown = sorted(name for name, path in listed.items() if path not in paths)
    if unknown:
        raise InputError(f"{source}: expected a frame for each name in its lists, found none for {unknown[0]}")
    return set(listed.values())


def _without_nulls(values: Json) -> dict[str, JsonValue]:
    """A key whose value is null counts as absent."""
    return {key: value for key, value in values.items() if value is not None}


def _number(values: Json, key: str, default: float | None = None) -> float:
    value = values.get(key, default)
    try:
        if not isinstance(value, bool) and isinstance(value, (int, float)) and math.isfinite(value):
            return float(value)
    except OverflowError:
        value = "one beyond all bounds"
    raise InputError(f"expected a finite number as {key}, found {value!r}")


def _path(source: Path, values: Json, key: str) -> str | None:
    value = values.get(key)
    if value is None:
        return None
    if not isinstance(value, str) or not value or "\0" in value:
        raise InputError(f"{source}: expected a file path as {key}, found {value!r}")
    return _relative(source, value)


def _relative(source: Path, name: str) -> str:
    """`name` of a file, from the folder of `source`, in which Windows may have put backslashes."""
    if "\\" in name and not os.path.isfile(source.parent / name):
        name = name.replace("\\", "/")
    return str(PurePosixPath(name)) if _UNTIDY.search(name) else name
