"""Folders of Nerfstudio, instant-ngp and NeRF-synthetic (Blender) as datasets of ours.

What `data.transforms` reads by itself, and: lenses of OPENCV_FISHEYE, which are undistorted; depth. Its unit is what
transforms.json says as `depth_unit_scale_factor` or instant-ngp's `integer_depth_scale`; Nerfstudio itself has it among
the options of training, a millimetre by default. It comes out in millimetres where 16 bits reach so far; else pictures
of one unit keep it.
"""

import io
import logging
import math
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np

from spacesim.data.errors import InputError, expect
from spacesim.data.files import JsonMapping, read_bytes
from spacesim.data.images import read_png
from spacesim.data.importers.carving import PosedPicture, mask_makers
from spacesim.data.importers.importer import Importer, Option
from spacesim.data.importers.lenses import LENS_MODELS, Lens, LensModel
from spacesim.data.importers.masks import (
    AUTO,
    MASKED,
    WatchedMasks,
    check_shape,
    check_shown,
    mask_options,
    read_mask,
    read_silhouette,
)
from spacesim.data.importers.pictures import FrameImporter, SourceView, fitted
from spacesim.data.importers.writing import ImportedFrame, Progress, StageProgress, frame_names, write_dataset
from spacesim.data.records import Dataset, Frame
from spacesim.data.store import choose_depth_unit, read_points
from spacesim.data.transforms import (
    DEPTH_UNITS,
    MILLIMETRE,
    dataset_of,
    dataset_of_pair,
    image_path,
    read_object,
    read_pair,
)

_MODELS: dict[str, LensModel] = {model.name: model for model in LENS_MODELS.values()}
_FAR = 1000.0  # times the median: depth beyond stands for none

_log = logging.getLogger(__name__)


@dataclass
class _Extras:
    """What transforms.json says and `data.transforms` does not read, by the paths of images."""

    fisheye: dict[str, tuple[float, ...]] = field(default_factory=dict)  #: k1 to k4 of OPENCV_FISHEYE
    depth: dict[str, tuple[str, float]] = field(default_factory=dict)  #: (path, metres a step)
    index: dict[str, int] = field(default_factory=dict)  #: source_index, which frame of a video it is


def import_nerfstudio(
    src: Path,
    out: Path,
    *,
    masks: str | Path | None = None,
    masked: str | None = None,
    depth_unit: float | None = None,
    progress: Progress | None = None,
) -> Dataset:
    """Import a folder with a transforms.json, or the file itself: cameras, pictures, Suns, masks, depth and points.

    masks: a folder of masks in place of mask_path, "auto": cut out by `carving`, "none": the background stays
    masked: what black in masks means, see `masks.MASKED`; None is "unknown" of mask_path, else "empty"
    depth_unit: metres a step of the depth files; None is what transforms.json says, else a millimetre

    Truth beyond these stays behind. Raises InputError as `read_dataset` does, where a file is broken, where depth has
    another shape than its picture, and where no mask or no silhouette shows anything.
    """
    path = src / "transforms.json" if src.is_dir() else src
    extras = _Extras()
    dataset = dataset_of(path, _take_extras(path, read_object(path), extras, depth_unit))
    given = None if masks is None else str(masks)
    masked = masked or ("unknown" if masks is None else "empty")
    source = {"kind": "nerfstudio", "source": str(src), "masks": given, "masked": masked, "depth_unit": depth_unit}
    return _write(dataset, extras, out, source, progress)


def import_blender(src: Path, out: Path, *, progress: Progress | None = None) -> Dataset:
    """Import a folder with transforms_train.json and transforms_test.json or transforms_val.json.

    Raises InputError where there is none, and as `read_dataset` does.
    """
    root = src if src.is_dir() else src.parent
    if not src.exists() or not (root / "transforms_train.json").is_file():
        raise InputError(f"{src}: expected a folder with transforms_train.json, found none in it")
    train, test = read_pair(root)
    extras = _Extras()
    train = _take_extras(root / "transforms_train.json", train, extras, None)
    if test is not None:
        test = test[0], _take_extras(root / test[0], test[1], extras, None)
    source = {"kind": "blender", "source": str(src), "masks": None, "masked": "unknown"}
    return _write(dataset_of_pair(root, train, test), extras, out, source, progress)


def _take_extras(path: Path, meta: JsonMapping, extras: _Extras, unit: float | None) -> JsonMapping:
    """`meta` without what goes to `extras`. What is malformed stays, for `data.transforms` to complain of."""
    frames = meta.get("frames")
    if unit is not None and not (math.isfinite(unit) and unit > 0):
        raise InputError(f"depth_unit: expected metres above 0, found {unit}")
    if not isinstance(frames, list) or not all(isinstance(entry, dict) for entry in frames):
        return meta
    kept = []
    for entry in frames:
        values = {key: value for key, value in {**meta, **entry}.items() if value is not None}
        name = image_path(path, entry)
        if values.get("camera_model") == "OPENCV_FISHEYE" or values.get("is_fisheye") in (True,):
            numbers = [values.get(key, 0.0) for key in ("k1", "k2", "k3", "k4")]
            if not all(_is_number(number) for number in numbers):
                raise InputError(f"{path}: frame {name}: expected finite numbers as k1 to k4, found {numbers}")
            extras.fisheye[name] = tuple(map(float, numbers))
            entry = {
                **entry,
                "camera_model": "OPENCV",
                "is_fisheye": False,
                **dict.fromkeys(("k1", "k2", "k3", "k4", "p1", "p2"), 0.0),
            }
        depth = values.get("depth_file_path", values.get("depth_path"))
        if isinstance(depth, str) and depth:
            extras.depth[name] = depth, _unit(path, name, values) if unit is None else unit
        if isinstance(index := entry.get("source_index"), int) and not isinstance(index, bool):
            extras.index[name] = index
        kept.append(entry)
    return {**meta, "frames": kept}


def _is_number(value: object) -> bool:
    return not isinstance(value, bool) and isinstance(value, int | float) and abs(value) < 1e30


def _unit(path: Path, name: str, values: JsonMapping) -> float:
    """Metres a step of a frame's depth."""
    key = next((key for key in DEPTH_UNITS if key in values), None)
    if key is None:
        return MILLIMETRE
    if not _is_number(values[key]) or not values[key] > 0:
        raise InputError(f"{path}: frame {name}: expected metres above 0 as {key}, found {values[key]!r}")
    return float(values[key])


def _write(dataset: Dataset, extras: _Extras, out: Path, source: JsonMapping, progress: Progress | None) -> Dataset:
    masks, masked = source["masks"], source["masked"]
    expect(masked in MASKED, "masked", f"one of {', '.join(MASKED)}", masked)
    maker, depths = FrameImporter(masked, masks == AUTO), _DepthReader(_common_unit(dataset.root, extras))
    paths = _below_one_folder(dataset.root, [frame.file_path for frame in dataset.frames])
    names = dict(zip(dataset.frames, frame_names(paths), strict=True))

    views = {frame: _view(dataset, frame, names[frame], extras, depths) for frame in dataset.frames}
    tell = StageProgress(progress, ("cut out", "write") if masks == AUTO else ("write",))
    if masks is not None:
        keys = {frame: f"{names[frame]}{PurePosixPath(frame.file_path).suffix}" for frame in views}
        posed = {keys[frame]: PosedPicture(v.path, v.world_from_camera, v.lens) for frame, v in views.items()}
        makers = mask_makers(masks, posed, tell)
        views = {frame: replace(view, mask=makers.get(keys[frame])) for frame, view in views.items()}
    _check_silhouettes(dataset.root, [v for v in views.values() if v.mask is None or masked == "unknown"])
    watched = WatchedMasks({view.name: view.mask for view in views.values() if view.mask is not None})
    views = {frame: replace(view, mask=watched.makers.get(view.name)) for frame, view in views.items()}

    def make(frames: Iterable[Frame]) -> list[ImportedFrame]:
        return [maker.frame(views[frame]) for frame in frames]

    points = None if dataset.ply_file_path is None else read_points(dataset.root / dataset.ply_file_path)
    written = write_dataset(
        out, make(dataset.train), make(dataset.test), source, points, progress=tell.write, depth_unit=depths.unit
    )
    watched.warn()
    return written


def _check_silhouettes(root: Path, views: Iterable[SourceView]) -> None:
    """As `check_shown` does."""
    shows = {v.name: read_silhouette(v.silhouette, v.lens.width, v.lens.height).any() for v in views if v.silhouette}
    sentence = f"{root}: expected an object in the silhouettes, found none in all {len(shows)}; give masks"
    check_shown([name for name, shown in shows.items() if not shown], len(shows), sentence)


def _below_one_folder(root: Path, paths: Sequence[str]) -> list[str]:
    """`paths`, from `root`; where one leads out of it, all from the folder that they have in common."""
    if not any(PurePosixPath(path).is_absolute() or ".." in PurePosixPath(path).parts for path in paths):
        return list(paths)
    whole = [os.path.abspath(root / path) for path in paths]
    common = os.path.commonpath([os.path.dirname(path) for path in whole])
    return [Path(path).relative_to(common).as_posix() for path in whole]


def _view(dataset: Dataset, frame: Frame, name: str, extras: _Extras, depths: "_DepthReader") -> SourceView:
    camera, path = frame.camera, dataset.root / frame.file_path
    fisheye = extras.fisheye.get(frame.file_path)
    model = _MODELS["FULL_OPENCV" if fisheye is None else "OPENCV_FISHEYE"]
    brown = (*(frame.distortion or (0.0,) * 5), 0.0, 0.0, 0.0)
    parameters = (camera.fx, camera.fy, camera.cx, camera.cy, *(brown if fisheye is None else fisheye))
    try:
        lens = fitted(Lens(model, camera.width, camera.height, parameters), path)
    except InputError as error:
        raise InputError(
            f"{dataset.root / frame.file_path}: {error}" if str(path) not in str(error) else str(error)
        ) from None
    silhouette = None if frame.silhouette_path is None else dataset.root / frame.silhouette_path
    mask = None
    if frame.mask_path is not None:
        mask = partial(read_mask, dataset.root / frame.mask_path, lens.width, lens.height)
    depth: Callable[[], np.ndarray] | None = None
    if frame.file_path in extras.depth:
        file, unit = extras.depth[frame.file_path]
        depth = partial(depths.read, dataset.root / file, unit, lens.width, lens.height)
    keys = {"time": frame.time, "source_index": extras.index.get(frame.file_path)}
    keys = {key: value for key, value in keys.items() if value is not None}
    return SourceView(name, path, camera.world_from_camera, lens, mask, frame.sun, silhouette, depth, keys)


def _common_unit(root: Path, extras: _Extras) -> float:
    """Metres a step in which all depth is written."""
    files = sorted({(path, unit) for path, unit in extras.depth.values()})
    reach = [unit * _farthest(root / path) for path, unit in files if unit > MILLIMETRE or path.endswith(".npy")]
    unit, units = choose_depth_unit(max(reach, default=0.0)), {unit for _, unit in files}
    if unit > MILLIMETRE and len(units) == 1 and not any(path.endswith(".npy") for path, _ in files):
        return units.pop()
    return unit


def _farthest(path: Path) -> float:
    """Steps, of what does not stand for none."""
    steps = _read_steps(path).astype(np.float64)
    there = steps[np.isfinite(steps) & (steps > 0)]
    return float(there[there <= _FAR * np.median(there)].max()) if len(there) else 0.0


def _read_steps(path: Path) -> np.ndarray:
    """[H, W] of a picture or an array."""
    steps = _read_npy(path) if path.suffix == ".npy" else read_png(path)
    if steps.ndim != 2:
        raise InputError(f"{path}: expected depth in one channel, found {list(steps.shape)}")
    return steps


@dataclass
class _DepthReader:
    """Reads depth in any unit. Warns once of what does not fit into 16 bits."""

    unit: float = MILLIMETRE  #: metres a step of what is written
    warned: bool = False

    def read(self, path: Path, unit: float, width: int, height: int) -> np.ndarray:
        """[H, W] uint16 steps of a picture, or an array of NumPy's (.npy), in steps of `unit` metres; another size is
        brought to width x height by the nearest pixel. 0 where there is none or it is beyond 16 bits. Raises InputError
        for one of another shape."""
        steps = _read_steps(path)
        check_shape(path, steps.shape[1], steps.shape[0], width, height)
        if steps.shape != (height, width):
            rows = (np.arange(height) + 0.5) * steps.shape[0] / height
            columns = (np.arange(width) + 0.5) * steps.shape[1] / width
            steps = steps[rows.astype(np.intp)[:, None], columns.astype(np.intp)]
        most = np.iinfo(np.uint16).max
        with np.errstate(invalid="ignore", over="ignore"):
            written = np.rint(steps.astype(np.float64) * (unit / self.unit))
            fits = (written > 0) & (written <= most)
        if not self.warned and (written[np.isfinite(written)] > most).any():
            _log.warning("%s: depth beyond %g m is stored as 0, none", path, most * self.unit)
            self.warned = True
        return np.where(fits, written, 0).astype(np.uint16)


def _read_npy(path: Path) -> np.ndarray:
    content = read_bytes(path, "depth")
    try:
        file = io.BytesIO(content)
        major, _ = np.lib.format.read_magic(file)
        head = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
        shape, by_columns, dtype = head(file)
        if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(content) - file.tell():
            raise ValueError("its header promises another size")
        values: np.ndarray = np.frombuffer(content, dtype, offset=file.tell()).reshape(
            shape, order="F" if by_columns else "C"
        )
    except Exception as error:  # NumPy documents none of what it raises
        raise InputError(f"{path}: expected an array of NumPy's, found another file ({error})") from None
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.dtype.kind not in "uif" or not values.size:
        raise InputError(f"{path}: expected numbers, found {values.dtype} {list(values.shape)}")
    return values


NERFSTUDIO = Importer(
    import_nerfstudio,
    "a folder with a transforms.json, of Nerfstudio or instant-ngp",
    "folder, or the transforms.json",
    (
        *mask_options("those of mask_path", "default: empty; of mask_path: unknown"),
        Option("depth_unit", float, "M", "metres a step of depth files (what transforms.json says, else 0.001)"),
    ),
)
BLENDER = Importer(import_blender, "NeRF-synthetic: transforms_train.json and its like", "folder")
