"""What every importer ends with: frames from elsewhere, written as a dataset."""

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.files import (
    MAX_LIST_BYTES,
    JsonDict,
    JsonMapping,
    flush_disks,
    holds_files,
    json_bytes,
    read_bytes,
    read_json,
    remove_leftovers,
    write_bytes,
    write_json,
)
from spacesim.data.images import check_lens, read_png, write_png
from spacesim.data.integrity.manifest import write_manifest
from spacesim.data.lock import lock_folder
from spacesim.data.records import Camera, Dataset, Sun
from spacesim.data.store import intrinsics_of, write_points
from spacesim.data.transforms import DEPTH_UNITS, MILLIMETRE, check_place, dataset_of, read_dataset

SOURCE = "import.json"  #: of a dataset: where it comes from and what was asked for; written first
_PARTS = {"silhouette": "silhouette_path", "mask": "mask_path", "depth": "depth_file_path"}
Picture = Path | Callable[[], np.ndarray]
"""A file, copied as it is, or what makes pixels when they are written: uint8 [H, W], [H, W, 3] or [H, W, 4], of depth
uint16 [H, W]."""
Part = Path | Callable[[], np.ndarray | None]
"""A `Picture` beside that of a frame; None of what turns out not to be there."""
Progress = Callable[[int, int, str], None]
"""Called with how many pictures are written (of work in stages: percent), of how many, and the name of the last."""


class StageProgress:
    """Tells a `Progress` of stages as parts of one whole, in percent."""

    def __init__(self, progress: Progress | None, stages: Sequence[str]) -> None:
        self.progress, self.stages = progress, stages

    def __call__(self, stage: str, done: int, total: int, detail: str = "") -> None:
        if self.progress is not None:
            part = (self.stages.index(stage) + done / max(total, 1)) / len(self.stages)
            self.progress(round(100 * part), 100, f"{stage} {detail}".rstrip())

    def write(self, done: int, total: int, name: str) -> None:
        """What `write_dataset` tells, of the last stage."""
        if len(self.stages) > 1:
            self("write", done, total, name)
        elif self.progress is not None:
            self.progress(done, total, name)


@dataclass(frozen=True, eq=False)
class ImportedFrame:
    """A view from elsewhere."""

    name: str  #: relative path without suffix, below images/: each once
    picture: Picture  #: as `camera` and `distortion` say; with alpha where it is known to be empty around the object
    camera: Camera  #: pose and intrinsics of the picture as it is written
    distortion: tuple[float, ...] = ()  #: as of `Frame`
    sun: Sun | None = None  #: None where the source does not name it
    silhouette: Part | None = None  #: 255 object, 0 none: a pixel without is empty
    mask: Part | None = None  #: 255 counts, 0: ignore this pixel, nothing is known of it
    depth: Part | None = None  #: 16 bits, steps along the optical axis, 0 none
    keys: JsonMapping = field(default_factory=dict)  #: that transforms.json has of the frame besides


def write_dataset(
    out: str | Path,
    train: Sequence[ImportedFrame],
    test: Sequence[ImportedFrame] | None,
    source: JsonMapping,
    points: tuple[np.ndarray, np.ndarray] | None = None,
    files: Mapping[str, bytes] | None = None,
    progress: Progress | None = None,
    depth_unit: float = MILLIMETRE,
) -> Dataset:
    """Write frames from elsewhere into the folder `out` as a dataset, transforms.json last; returns it as read back.

    train, test: where `test` is None, every 8th frame is held out (`data.transforms`)
    source: what import.json says: the kind of import, from where, its options
    points: (positions [N, 3] metres, colours [N, 3] uint8) to start training from
    files: others by their names in `out`: pictures of the cameras, reports
    depth_unit: metres a step of depth pictures
    Where an earlier import of the same source was interrupted, it is begun anew in its folder. Raises InputError where
    `out` holds anything else, where a picture cannot be read, where two have one name, and where no frame is left.
    """
    out, files, source = Path(out), dict(files or {}), json.loads(json_bytes(dict(source)))
    frames = [*train, *(test or ())]
    if not train:
        raise InputError(f"{source.get('source', out)}: expected frames to train on, found none")
    entries = [_entry(frame) for frame in frames]
    _check(str(source.get("source", out)), frames, entries)
    with lock_folder(out):
        _claim(out, source)
        paths = [SOURCE]
        for number, (frame, entry) in enumerate(zip(frames, entries, strict=True), start=1):
            _write(out, frame.picture, entry["file_path"])
            paths.append(entry["file_path"])
            for part, key in _PARTS.items():
                picture = getattr(frame, part)
                if picture is not None:
                    if _write(out, picture, entry[key]):
                        paths.append(entry[key])
                    else:
                        del entry[key]
            if progress is not None:
                progress(number, len(frames), frame.name)
        meta: JsonDict = {"camera_model": "OPENCV", "frames": entries}
        if any(frame.depth is not None for frame in frames):
            meta = {DEPTH_UNITS[0]: depth_unit, **meta}
        if test is not None:
            names = [entry["file_path"] for entry in entries]
            meta |= {"train_filenames": names[: len(train)], "test_filenames": names[len(train) :]}
        if points is not None and len(points[0]):
            write_points(out / "points.ply", *points)
            meta["ply_file_path"] = "points.ply"
            paths.append("points.ply")
        for name, content in files.items():
            write_bytes(out / name, content)
            paths.append(name)
        path, content = out / "transforms.json", json_bytes(meta)
        dataset_of(path, meta)  # what reads it has no complaint
        write_manifest(out, paths, {path.name: hashlib.sha256(content).hexdigest()})
        flush_disks()
        write_bytes(path, content)
    return read_dataset(out)


def _check(source: str, frames: Sequence[ImportedFrame], entries: Sequence[JsonMapping]) -> None:
    """Raises InputError, before anything is written, for a camera that cannot be and where two frames would be
    written to one file."""
    for frame in frames:
        try:
            check_place(frame.camera)
            check_lens(frame.camera, frame.distortion)
        except InputError as error:
            raise InputError(f"{source}: {frame.name}: {error}") from None
    for key in ("file_path", *_PARTS.values()):
        for path, count in Counter(entry[key] for entry in entries if key in entry).items():
            if count > 1:
                raise InputError(f"{source}: expected each image once, found {count} of the name {path}")


def frame_names(paths: Sequence[str]) -> list[str]:
    """Names of frames for relative paths of pictures: without a folder images/ and without the suffix, which is kept
    where two would be the same ("a.jpg", "a.png": "a_jpg", "a_png"). Raises InputError for a path that leads out of its
    folder."""
    stems = []
    for path in map(PurePosixPath, paths):
        if path.is_absolute() or ".." in path.parts or not path.name:
            raise InputError(f"{path}: expected a name of a picture below its folder, found another")
        parts = path.parts[1:] if path.parts[0] == "images" and len(path.parts) > 1 else path.parts
        stems.append(PurePosixPath(*parts).with_suffix("").as_posix())
    counts = Counter(stems)
    ended = [f"{PurePosixPath(path).with_suffix('')}_{PurePosixPath(path).suffix[1:]}" for path in paths]
    names = [
        stem if counts[stem] == 1 else f"{stem}_{end.rpartition('_')[2]}"
        for stem, end in zip(stems, ended, strict=True)
    ]
    return names if len(set(names)) == len(names) else ended


def check_free(out: Path, source: JsonMapping) -> bool:
    """Whether the folder `out` holds an unfinished import of `source`. Raises InputError where it holds anything else:
    what takes long asks before."""
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: expected a folder to write to, found a file")
    path = out / SOURCE
    if path.is_file() and not (out / "transforms.json").exists():
        if read_json(path, MAX_LIST_BYTES) != source:
            raise InputError(f"{out}: expected a new or empty folder, found an unfinished import of something else")
        return True
    if holds_files(out):
        raise InputError(f"{out}: expected a new or empty folder, found files in it")
    return False


def _claim(out: Path, source: JsonMapping) -> None:
    """Write import.json into a new folder, or into that of an import that has not ended."""
    if check_free(out, source):
        remove_leftovers(out)
    else:
        write_json(out / SOURCE, dict(source))


def _entry(frame: ImportedFrame) -> JsonDict:
    """Of transforms.json."""
    camera, suffix = frame.camera, frame.picture.suffix.lower() if isinstance(frame.picture, Path) else ".png"
    entry: JsonDict = {
        "file_path": f"images/{frame.name}{suffix}",
        "transform_matrix": camera.opengl.tolist(),
        **intrinsics_of(camera),
    }
    entry |= dict(zip(("k1", "k2", "p1", "p2", "k3"), frame.distortion, strict=False))
    if frame.sun is not None:
        azimuth, elevation = frame.sun.angles
        entry |= {"sun_direction": frame.sun.direction.tolist()}
        entry |= {"sun_azimuth_deg": azimuth, "sun_elevation_deg": elevation}
    for part, key in _PARTS.items():
        picture = getattr(frame, part)
        if picture is not None:
            of_picture = picture.suffix.lower() if isinstance(picture, Path) else ".png"
            entry[key] = f"{part}/{frame.name}{of_picture}"
    return entry | dict(frame.keys)


def _write(out: Path, picture: Part, name: str) -> bool:
    """Write a picture below `out` under the name of transforms.json; False where there is none."""
    if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
        raise InputError(f"{name}: expected a name below the dataset's folder, found another")
    if isinstance(picture, Path):
        content = read_bytes(picture, "a picture")
        read_png(picture, content)  # raises where it is cut off, which its header does not show
        write_bytes(out / name, content, durable=False)
    else:
        pixels = picture()
        if pixels is None:
            return False
        write_png(out / name, pixels, durable=False)
    return True
