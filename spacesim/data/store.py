"""The dataset on disk that we write: Nerfstudio's transforms.json and, beside it, the path tracer's truth.

Reading any such folder is `spacesim.data.transforms`; this module re-exports `read_dataset`.

    transforms.json  images/  gt/  shadow/  silhouette/  id/  depth/  points.ply  mesh.ply  scene.json  SHA256SUMS
"""

import hashlib
import json
import logging
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from spacesim.data.errors import InputError, WorkError
from spacesim.data.files import (
    MAX_LIST_BYTES,
    JsonValue,
    first_difference,
    flush_disks,
    json_bytes,
    read_json,
    remove_leftovers,
    write_bytes,
    write_json,
)
from spacesim.data.images import Undistortion, exr_bytes, load_image, png_bytes, read_exr, read_png, read_sized
from spacesim.data.integrity.manifest import check_manifest, digest_of, read_manifest, write_manifest
from spacesim.data.integrity.whole import is_whole
from spacesim.data.mesh import read_points, write_points
from spacesim.data.records import Camera, Dataset, Frame, Sun, Truth, check_frame
from spacesim.data.structure import shortened
from spacesim.data.transforms import DEPTH_UNITS, MILLIMETRE, dataset_of, read_dataset

if TYPE_CHECKING:
    import trimesh

__all__ = [
    "SHADOW_ATTACHED",
    "SHADOW_LIT",
    "SHADOW_NONE",
    "SHADOW_SELF_CAST",
    "DatasetWriter",
    "FrameWriter",
    "WrittenFrame",
    "find_unreadable_files",
    "load_depth",
    "load_truth",
    "read_dataset",
    "read_points",
    "sunlit_share",
    "write_points",
]

SHADOW_NONE = 0  #: no surface
SHADOW_ATTACHED = 85  #: the surface faces away from the Sun
SHADOW_SELF_CAST = 170  #: cast by the same object; 170 + k: cast by object k, 1 to 84, where that is another one
SHADOW_LIT = 255  #: at least half of the solar disc is seen

_FILES = {
    "images": ".png",
    "shadow": ".png",
    "silhouette": ".png",
    "id": ".png",
    "depth": ".png",
    "gt": ".exr",  # written last
}
_LABELS = ("object_id", "part_id", "shadow")
_OPTIONAL = ("radiance_earth", "radiance_background")
_FILTERED = ("radiance", "alpha", *_OPTIONAL)
RAW_MONOCHROME, RAW_COLOR = ("",), ("_r", "_g", "_b")  #: suffixes of the files in raw/
DEPTH_UNIT = "depth_unit"  #: key of scene.json: metres a step of depth/*.png, where that is no millimetre
DEPTH_MARGIN = 1.05  #: beyond the farthest surface that coarser steps reach
MANY_FILES = 1000  #: of frames, from which on it is said that they are read: that takes some 5 ms each
_MOST_STEPS = np.iinfo(np.uint16).max

_log = logging.getLogger(__name__)


def load_truth(dataset: Dataset, frame: Frame) -> Truth:
    """What the path tracer knows of `frame`, as its pinhole camera sees it: arrays [H, W] and [H, W, 3], see `Truth`.
    Raises InputError where that is missing or broken.

    Where the frame's lens distorts, radiance and alpha are resampled bilinearly; labels take the nearest pixel's value,
    so that none is averaged, and are 0 beyond what the lens sees.
    """
    check_frame(dataset, frame)
    if frame.gt_path is None:
        raise InputError(f"{dataset.root}: expected ground truth of {frame.file_path}, found no gt_path")
    path = dataset.root / frame.gt_path
    layers = read_exr(path, (frame.camera.width, frame.camera.height))
    names = [field.name for field in fields(Truth)]
    missing = [name for name in names if name not in layers and name not in _OPTIONAL]
    if missing:
        raise InputError(f"{path}: expected the layers {', '.join(names)}, found no {', '.join(missing)}")
    present = [name for name in names if name in layers]
    sizes = {layers[name].shape[:2] for name in present}
    if sizes != {(frame.camera.height, frame.camera.width)}:
        expected = f"{frame.camera.width}x{frame.camera.height}"
        listed = ", ".join(f"{width}x{height}" for height, width in sorted(sizes))
        raise InputError(f"{path}: expected {expected} pixels as the camera says, found {listed}")
    values = {name: layers[name].astype(np.uint8 if name in _LABELS else np.float32) for name in present}
    if any(frame.distortion):
        source = Undistortion(frame.camera, frame.distortion)
        values = {k: source.linear(v) if k in _FILTERED else source.nearest(v) for k, v in values.items()}
    return Truth(**values)


def load_depth(dataset: Dataset, frame: Frame) -> np.ndarray:
    """[H, W] float32: depth along the optical axis, metres, 0 none, of the picture as it is stored. Raises InputError
    where that is missing or broken."""
    check_frame(dataset, frame)
    if frame.depth_file_path is None:
        raise InputError(f"{dataset.root}: expected depth of {frame.file_path}, found no depth_file_path")
    path = dataset.root / frame.depth_file_path
    steps = read_sized(path, frame.camera)
    if steps.ndim != 2:
        raise InputError(f"{path}: expected depth in one channel, found {steps.shape[2]}")
    return (steps * dataset.depth_unit).astype(np.float32)


def choose_depth_unit(farthest: float) -> float:
    """Metres a step of depth pictures of 16 bits: a millimetre where that reaches `farthest`, metres, else the finest
    of 2, 5, 10, 20, ... millimetres that reaches `DEPTH_MARGIN` times as far."""
    if farthest <= _MOST_STEPS * MILLIMETRE:
        return MILLIMETRE
    steps = DEPTH_MARGIN * farthest / _MOST_STEPS / MILLIMETRE
    decade = 10 ** int(np.floor(np.log10(steps)))
    factor = next(factor for factor in (1, 2, 5, 10) if factor * decade >= steps)
    return factor * decade / 1000


def sunlit_share(shadow: np.ndarray) -> tuple[float, int]:
    """(fraction of the object's pixels in sunlight, 0 of none; number of its pixels), of shadow classes [H, W]."""
    counts = np.bincount(shadow.ravel(), minlength=256)
    seen = int(counts.sum() - counts[SHADOW_NONE])
    return int(counts[SHADOW_LIT]) / max(seen, 1), seen


def _sunlit(shadow: np.ndarray) -> float | None:
    """As in `WrittenFrame`."""
    share, seen = sunlit_share(shadow)
    return share if seen else None


@dataclass(frozen=True)
class WrittenFrame:
    """A frame whose files are on the disk."""

    name: str  #: e.g. "train_00012"
    digests: tuple[str, ...]  #: SHA-256 of its files
    sizes: tuple[int, ...]  #: bytes of its files
    sunlit: float | None  #: fraction of its object's pixels that the Sun lights, None where it shows no object


class FrameWriter:
    """Writes the frames of a dataset folder that exists; any number of processes and machines may do so at once.

    root: the folder
    raw: suffixes of the names of a sensor's pictures in raw/: () none, RAW_MONOCHROME or RAW_COLOR
    depth_unit: metres a step of depth/*.png
    """

    def __init__(self, root: Path, raw: Sequence[str] = (), depth_unit: float = MILLIMETRE) -> None:
        self.root = Path(root)
        self.raw = tuple(raw)
        self.depth_unit = depth_unit
        self._warned = False

    def has_frame(self, name: str) -> bool:
        """All files of frame `name` are whole on disk, e.g. from an interrupted run (see `data.integrity.whole`)."""
        return all(is_whole(self.root / path) for path in reversed(self._files_of(name)))

    def _files_of(self, name: str) -> list[str]:
        """Paths of a frame's files below the folder."""
        paths = [f"{folder}/{name}{suffix}" for folder, suffix in _FILES.items()]
        return paths + [f"raw/{name}{suffix}.png" for suffix in self.raw]

    def write_frame(self, name: str, truth: Truth, image: np.ndarray, raw: np.ndarray | None = None) -> WrittenFrame:
        """Write the files of frame `name`, e.g. "train_00012".

        image: the picture, uint8 [H, W], [H, W, 3] or [H, W, 4]; raw: a sensor's digital numbers, uint16 [H, W], or
        [3, H, W] for R, G and B, where the writer has suffixes of raw/, else None. Raises ValueError for others.
        """
        if (raw is None) != (not self.raw):
            raise ValueError(f"raw: expected {'numbers for raw/' if self.raw else 'none'}, found others")
        surface = truth.object_id > 0
        pictures = {
            f"images/{name}": image,
            f"shadow/{name}": truth.shadow,
            f"silhouette/{name}": np.where(surface, 255, 0).astype(np.uint8),
            f"id/{name}": truth.object_id.astype(np.uint8),
            f"depth/{name}": self._encode_depth(truth.depth, surface),
        }
        if raw is not None:
            planes = raw[None] if raw.ndim == 2 else raw
            pictures |= {f"raw/{name}{suffix}": plane for suffix, plane in zip(self.raw, planes, strict=True)}
        layers = {f.name: getattr(truth, f.name) for f in fields(Truth)}
        present = {key: value for key, value in layers.items() if value is not None}
        written: dict[str, tuple[str, int]] = {}

        def write(path: str, content: bytes) -> None:
            write_bytes(self.root / path, content, durable=False)
            written[path] = hashlib.sha256(content).hexdigest(), len(content)

        for path, pixels in pictures.items():
            write(f"{path}.png", png_bytes(pixels))
        write(f"gt/{name}.exr", exr_bytes(present))
        digests, sizes = zip(*map(written.__getitem__, self._files_of(name)), strict=True)
        return WrittenFrame(name, digests, sizes, _sunlit(truth.shadow))

    def read_written(self, name: str) -> WrittenFrame:
        """What `write_frame` has returned, of a frame that is there. Raises InputError where a file cannot be read."""
        sunlit = _sunlit(read_png(self.root / "shadow" / f"{name}.png"))
        files = [self.root / path for path in self._files_of(name)]
        digests = tuple(map(digest_of, files))  # says what cannot be read
        return WrittenFrame(name, digests, tuple(map(os.path.getsize, files)), sunlit)

    def _encode_depth(self, depth: np.ndarray, surface: np.ndarray) -> np.ndarray:
        steps = np.round(np.where(surface, depth, 0).astype(np.float64) / self.depth_unit)
        beyond = ~(steps <= _MOST_STEPS)
        if beyond.any() and not self._warned:
            most = _MOST_STEPS * self.depth_unit
            _log.warning("depth/*.png: surfaces beyond %g m are stored as 0; gt/*.exr has their depth", most)
            self._warned = True
        return np.where(beyond, 0, steps).astype(np.uint16)


class DatasetWriter(FrameWriter):
    """Writes a dataset folder; an interrupted run leaves whole files only, which a later run completes.

    root: the folder, made here
    scene: what to render, as JSON values, written to scene.json first, its DEPTH_UNIT is that of depth/*.png
    resume: go on with a folder that holds the same scene
    raw: as in FrameWriter
    shared: others write frames of it at the same time, so that files in the making and damaged ones are left alone;
        otherwise only one at a time may work on a folder

    Raises InputError where the folder holds anything else.
    """

    def __init__(
        self,
        root: Path,
        scene: Mapping[str, JsonValue],
        resume: bool = False,
        raw: Sequence[str] = (),
        shared: bool = False,
    ) -> None:
        super().__init__(root, raw, float(str(scene.get(DEPTH_UNIT, MILLIMETRE))))
        scene = json.loads(json.dumps(scene, allow_nan=False))  # as it reads back
        if self.root.exists() and not self.root.is_dir():
            raise InputError(f"{self.root}: expected a folder to write to, found a file")
        present = sorted(p.name for p in self.root.glob("*") if not p.name.endswith(".part"))
        if "scene.json" in present or (present and (self.root / "scene.json").exists()):  # another may have begun
            self._check_resumable(scene, resume)
        elif present:
            raise InputError(f"{self.root}: expected a new or empty folder, found {present[0]} in it")
        else:
            write_json(self.root / "scene.json", scene)
        if not shared:
            remove_leftovers(self.root)
        if resume and not shared:
            self._remove_damaged()

    def finish(
        self,
        train: Sequence[tuple[str, Camera, Sun]],
        test: Sequence[tuple[str, Camera, Sun]],
        points: np.ndarray,
        colors: np.ndarray,
        mesh: "trimesh.Trimesh",
        distortion: Sequence[float] = (),
        overview: Callable[[Dataset], None] | None = None,
        more: Mapping[str, Mapping[str, JsonValue]] | None = None,
        written: Iterable[WrittenFrame] = (),
    ) -> Dataset:
        """Write points.ply, mesh.ply, SHA256SUMS and, once the disks hold everything, transforms.json; returns the
        dataset as it reads back.

        train, test: (frame name, camera, sun) of each frame; points: [N, 3] metres; colors: [N, 3] uint8;
        distortion: Brown-Conrady k1, k2, p1, p2, k3 of all frames, () none; overview: writes pictures of the whole into
        the folder; more: other keys of frames, by their names; written: of frames whose files need not be read again.
        """
        names, known = [name for name, _, _ in (*train, *test)], {frame.name: frame for frame in written}
        for name in names:
            if not (self._is_there(known[name]) if name in known else self.has_frame(name)):
                raise WorkError(f"{self.root}: expected all frames to be written, {name} is not")
        remove_leftovers(self.root)  # of processes that were killed
        write_points(self.root / "points.ply", points, colors)
        write_bytes(self.root / "mesh.ply", mesh.export(file_type="ply", vertex_normal=False))
        path, meta = self.root / "transforms.json", _describe_frames(train, test, distortion, more or {})
        meta = {DEPTH_UNITS[0]: self.depth_unit, **meta}
        content = json_bytes(meta)
        dataset = dataset_of(path, meta)
        if overview is not None:
            overview(dataset)
        parts = ["scene.json", "points.ply", "mesh.ply", *sorted(picture.name for picture in self.root.glob("*.png"))]
        parts += ["keypoints.json"] * (self.root / "keypoints.json").is_file()
        parts += [file for name in names if name not in known for file in self._files_of(name)]
        digests = {path.name: hashlib.sha256(content).hexdigest()}
        for name in known:
            digests |= zip(self._files_of(name), known[name].digests, strict=True)
        write_manifest(self.root, parts, digests)
        flush_disks()
        write_bytes(path, content)
        return dataset

    def _is_there(self, frame: WrittenFrame) -> bool:
        """All its files are, as long as they were written."""
        files = [os.path.join(self.root, path) for path in self._files_of(frame.name)]
        try:
            return tuple(map(os.path.getsize, files)) == frame.sizes
        except OSError:
            return False

    def _remove_damaged(self) -> None:
        """Take away the frames' files that are not what SHA256SUMS of the finished dataset says, or, before there is
        one, that cannot be decoded: they are made again, and no damage gets a digest."""
        frames = (*_FILES, "raw")
        digests = read_manifest(self.root)
        if digests:
            damaged = [path for path in check_manifest(self.root) if path.split("/")[0] in frames]
        else:
            paths = [path for folder in frames for path in sorted((self.root / folder).glob("*.*"))]
            if len(paths) > MANY_FILES:  # less takes no time
                _log.info("%s: reading %d files that are there", self.root, len(paths))
            with ThreadPoolExecutor() as pool:
                decodable = list(pool.map(_can_be_decoded, paths))
            pairs = zip(paths, decodable, strict=True)
            damaged = [str(path.relative_to(self.root)) for path, is_sound in pairs if not is_sound]
        for path in damaged:
            try:
                (self.root / path).unlink(missing_ok=True)
            except OSError as error:  # a folder, say
                raise InputError(f"{self.root / path}: cannot be removed ({error.strerror or error})") from None
        if damaged:
            _log.warning("%s: %d files are damaged, %s the first; made again", self.root, len(damaged), damaged[0])

    def _check_resumable(self, scene: Mapping[str, JsonValue], resume: bool) -> None:
        if not resume:
            raise InputError(f"{self.root}: expected a new folder, found a dataset; resume=True goes on with it")
        path = self.root / "scene.json"
        existing = read_json(path, MAX_LIST_BYTES)
        existing = existing if isinstance(existing, dict) else {}
        there, asked = ({"config": one.get("config"), **one} for one in (existing, scene))  # first what was asked for
        if found := first_difference(there, asked):
            key, old, new = found
            raise InputError(
                f"{self.root}: was made with {key.removeprefix('config.')} {shortened(old)}, expected the same to "
                f"resume it, found {shortened(new)}"
            )


def _can_be_decoded(path: Path) -> bool:
    """A frame's PNG or EXR file."""
    try:
        (read_exr if path.suffix == ".exr" else read_png)(path)
    except InputError:
        return False
    return True


def find_unreadable_files(data: Path | Dataset) -> list[str]:
    """Sentences about what is wrong with a dataset, or its folder, [] where every file is there and fits."""
    try:
        dataset = data if isinstance(data, Dataset) else read_dataset(data)
    except InputError as error:
        return [str(error)]
    problems = [f"{dataset.root / name}: expected an image file, found none" for name in dataset.missing]

    def check(load: Callable[..., object], *arguments: object) -> None:
        try:
            load(*arguments)
        except InputError as error:
            if str(error) not in problems:
                problems.append(str(error))

    for frame in dataset.frames:
        check(load_image, dataset, frame)
        if frame.gt_path is not None:
            check(load_truth, dataset, frame)
        for key in ("shadow_path", "silhouette_path", "id_path", "depth_file_path"):
            if getattr(frame, key) is not None:
                check(read_sized, dataset.root / getattr(frame, key), frame.camera)
    for ply in (dataset.ply_file_path, dataset.mesh_path):
        if ply is not None:
            check(read_points, dataset.root / ply)
    return problems


def _describe_frames(
    train: Sequence[tuple[str, Camera, Sun]],
    test: Sequence[tuple[str, Camera, Sun]],
    distortion: Sequence[float],
    more: Mapping[str, Mapping[str, JsonValue]],
) -> dict[str, JsonValue]:
    """transforms.json: intrinsics stand at the top where all frames share them."""
    intrinsics = [intrinsics_of(camera) for _, camera, _ in (*train, *test)]
    shared = all(entry == intrinsics[0] for entry in intrinsics)
    frames = []
    for (name, camera, sun), frame_intrinsics in zip((*train, *test), intrinsics, strict=True):
        azimuth, elevation = sun.angles
        frames.append(
            {
                "file_path": f"images/{name}.png",
                "transform_matrix": camera.opengl.tolist(),
                **({} if shared else frame_intrinsics),
                "sun_direction": sun.direction.tolist(),
                "sun_azimuth_deg": azimuth,
                "sun_elevation_deg": elevation,
                "gt_path": f"gt/{name}.exr",
                "shadow_path": f"shadow/{name}.png",
                "silhouette_path": f"silhouette/{name}.png",
                "id_path": f"id/{name}.png",
                "depth_file_path": f"depth/{name}.png",
                **more.get(name, {}),
            }
        )
    return {
        "camera_model": "OPENCV",
        **(intrinsics[0] if shared and intrinsics else {}),
        **dict(zip(("k1", "k2", "p1", "p2", "k3"), distortion, strict=False)),
        "ply_file_path": "points.ply",
        "mesh_path": "mesh.ply",
        "train_filenames": [f"images/{name}.png" for name, _, _ in train],
        "test_filenames": [f"images/{name}.png" for name, _, _ in test],
        "frames": frames,
    }


def intrinsics_of(camera: Camera) -> dict[str, float]:
    """As transforms.json names them, pixels."""
    return {
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
    }
