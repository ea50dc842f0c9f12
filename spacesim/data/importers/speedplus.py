"""SPEED+ (T. H. Park et al., "SPEED+: Next-generation dataset for spacecraft pose estimation across domain gap", 2022)
and SPEED (M. Kisantal et al., "Satellite pose estimation challenge", 2020) as datasets of ours.

    SRC/camera.json                              Nu Nv cameraMatrix distCoeffs, or fx fy ppx ppy ccx ccy
    SRC/synthetic/{train,validation}.json        [{filename, q_vbs2tango_true, r_Vo2To_vbs_true}, ...]
    SRC/{lightbox,sunlamp}/test.json
    SRC/DOMAIN/images/FILENAME                   and SRC/DOMAIN/masks/FILENAME where these exist
    SRC/train.json, SRC/images/train/FILENAME    SPEED's, whose quaternion is q_vbs2tango

A point p of the body is at R(q) p + r in the camera: q is scalar-first, r in metres, the axes OpenCV's. The dataset's
world is the frame of the body. Labels stay with their frames in transforms.json, as they were written.
"""

import logging
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image as PillowImage

from spacesim.data.errors import InputError, expect
from spacesim.data.files import MAX_LIST_BYTES, JsonDict, read_json
from spacesim.data.geometry import Array, camera_that_sees
from spacesim.data.images import has_alpha, image_size, read_png
from spacesim.data.importers.carving import FEW, PosedPicture, mask_makers
from spacesim.data.importers.importer import Importer, Option
from spacesim.data.importers.lenses import LENS_MODELS, Lens
from spacesim.data.importers.masks import AUTO, MASKED, NO_MASKS, WatchedMasks, mask_options
from spacesim.data.importers.writing import ImportedFrame, Progress, StageProgress, frame_names, write_dataset
from spacesim.data.records import Camera, Dataset
from spacesim.data.transforms import FARTHEST

DOMAINS = ("synthetic", "lightbox", "sunlamp")
SPEED_CAMERA = {"Nu": 1920, "Nv": 1200, "ppx": 5.86e-6, "ppy": 5.86e-6, "fx": 0.0176, "fy": 0.0176}
"""Of SPEED, where no camera.json is beside it: that of ESA's speed-utils."""

_TURNS, _PLACES = ("q_vbs2tango_true", "q_vbs2tango"), ("r_Vo2To_vbs_true", "r_Vo2To_vbs")
_UNIT = 1e-3  #: how far from 1 the length of a quaternion may be
_SKEWED = 0.1  #: pixels from the top of a picture to its bottom: our cameras have none
_BENT = 100.0  #: coefficients of distortion: those of lenses are about 1
_BOX = PillowImage.Resampling.BOX

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class _Label:
    """The pose of a picture."""

    filename: str  #: below the folder of pictures
    quaternion: list[float]  #: (w, x, y, z), as written
    position: list[float]  #: of the body in the camera, metres, as written

    @property
    def world_from_camera(self) -> Array:
        """[4, 4] in the body's frame."""
        return camera_that_sees(self.quaternion, self.position)


@dataclass(frozen=True, eq=False)
class _Intrinsics:
    """What camera.json says."""

    width: int
    height: int
    fx: float  #: pixels
    fy: float  #: pixels
    cx: float  #: pixels
    cy: float  #: pixels
    distortion: tuple[float, ...]  #: Brown-Conrady k1, k2, p1, p2, k3, () none

    @property
    def lens(self) -> Lens:
        """Of pictures of the full size."""
        parameters = self.fx, self.fy, self.cx, self.cy, *(self.distortion or (0.0,) * 5), 0.0, 0.0, 0.0
        return Lens(LENS_MODELS[6], self.width, self.height, parameters)

    def camera(self, pose: Array, size: tuple[int, int]) -> Camera:
        """At a pose, with pictures resized to (width, height)."""
        u, v = size[0] / self.width, size[1] / self.height
        return Camera(pose, *size, u * self.fx, v * self.fy, u * self.cx, v * self.cy)


def import_speedplus(
    src: Path,
    out: Path,
    *,
    domain: str = "synthetic",
    max_distance: float | None = None,
    count: int | None = None,
    scale: float = 1.0,
    seed: int = 0,
    masks: str | Path | None = None,
    masked: str = "empty",
    progress: Progress | None = None,
) -> Dataset:
    """Import one domain of SPEED+, or SPEED's labelled synthetic pictures.

    domain: "synthetic", whose validation pictures become the test split, "lightbox" or "sunlamp", of which every 8th
    is held out; max_distance: metres to the body, farther ones are left out; count: frames in all, one drawn by `seed`
    from each of as many equal pieces of the lists; scale: of the pictures' size, by the means over areas.
    masks: a folder of them, "auto": cut out by `carving`, "none": the background stays; None: the domain's own folder
    `masks`, where there is none "auto", but of fewer than 20 pictures and of those with alpha "none". masked: one of
    `MASKED`.
    Frames without a picture are skipped, with one warning; a picture in which "auto" finds nothing is unknown.
    Raises InputError for labels or a camera that are missing or broken, pictures of another size than the camera's, and
    where no frame is left or no mask shows anything.
    """
    expect(domain in DOMAINS, "domain", f"one of {', '.join(DOMAINS)}", domain)
    expect(max_distance is None or 0 < max_distance < math.inf, "max_distance", "metres above 0", max_distance)
    expect(count is None or count >= 2, "count", "at least 2 frames", count)
    expect(0 < scale <= 1, "scale", "a fraction above 0, up to 1", scale)
    expect(masked in MASKED, "masked", f"one of {', '.join(MASKED)}", masked)
    expect(seed >= 0, "seed", "at least 0", seed)
    pictures, lists = _lists(src, domain)
    intrinsics = _read_camera(src, lists[0])
    splits = [_read_labels(path) for path in lists]
    labelled = sum(map(len, splits))
    if not splits[0]:
        raise InputError(f"{lists[0]}: expected labels of pictures, found none")
    if max_distance is not None:
        splits = [[one for one in labels if np.linalg.norm(one.position) <= max_distance] for labels in splits]
    near = sum(map(len, splits))
    if near < labelled:
        _log.info(
            "%s: %d of %d pictures are farther than %g m, left out", pictures, labelled - near, labelled, max_distance
        )
    splits = [[one for one in labels if (pictures / one.filename).is_file()] for labels in splits]
    there = sum(map(len, splits))
    if not splits[0]:
        within = "" if max_distance is None else f" within {max_distance:g} m"
        raise InputError(f"{lists[0]}: expected pictures{within} in {pictures}, found none of {labelled} labels")
    if there < near:
        _log.warning("%s: %d of %d pictures are missing, their frames are skipped", pictures, near - there, near)
    if count is not None:
        if count > there:
            _log.warning("%s: expected %d pictures, found %d: all are taken", pictures, count, there)
        splits = _subsets(splits, count, seed)
    size = max(1, round(scale * intrinsics.width)), max(1, round(scale * intrinsics.height))
    files = [one.filename for labels in splits for one in labels]
    if twice := next((name for name, count in Counter(files).items() if count > 1), ""):
        raise InputError(f"{lists[0]}: expected each image once, found {twice} twice, in it or in {lists[-1].name}")
    for name in files:
        _check_size(pictures / name, intrinsics)
    chosen = masks or _default_masks(pictures, files)
    poses = {one.filename: one.world_from_camera for labels in splits for one in labels}
    posed = {name: PosedPicture(pictures / name, pose, intrinsics.lens) for name, pose in poses.items()}
    tell = StageProgress(progress, ("cut out", "write") if str(chosen) == AUTO else ("write",))
    watched = WatchedMasks(mask_makers(chosen, posed, tell, np.zeros(3)))
    names = dict(zip(files, frame_names(files), strict=True))
    maker = _FrameMaker(pictures, names, intrinsics, size, watched.makers, masked, str(chosen) == AUTO)
    train, test = (list(map(maker.frame, labels)) for labels in [*splits, []][:2])
    options = {"domain": domain, "max_distance": max_distance, "count": count, "scale": scale, "seed": seed}
    options |= {"masks": str(chosen), "masked": masked}
    source = {"kind": "speedplus", "source": str(src), **options}
    if str(chosen) == AUTO:
        _log.info("masks: cut out of the pictures; look at %s", out / ("silhouette" if masked == "empty" else "mask"))
    elif str(chosen) != NO_MASKS:
        _log.info("masks: those of %s", chosen)
    dataset = write_dataset(out, train, test or None, source, progress=tell.write)
    watched.warn()
    return dataset


def _check_size(path: Path, intrinsics: _Intrinsics) -> None:
    """Raise InputError for a picture of another size than the camera's."""
    (width, height), full = image_size(path), (intrinsics.width, intrinsics.height)
    if (width, height) != full:
        raise InputError(f"{path}: expected {full[0]}x{full[1]} pixels as camera.json says, found {width}x{height}")


def _default_masks(pictures: Path, files: Sequence[str]) -> Path | str:
    """The data set's own, none of pictures that have alpha or are few, else "auto"."""
    if (pictures.parent / "masks").is_dir():
        return pictures.parent / "masks"
    if len(files) < FEW:
        _log.warning("%s: %d pictures are few to cut the object out by; what is behind stays", pictures, len(files))
    return NO_MASKS if len(files) < FEW or has_alpha(pictures / files[0]) else AUTO


def _lists(src: Path, domain: str) -> tuple[Path, list[Path]]:
    """The folder of pictures, and the lists of labels: of training, and of testing where there is one."""
    if domain == "synthetic" and (src / "train.json").is_file() and not (src / domain).is_dir():
        return src / "images/train", [src / "train.json"]
    folder = src / domain
    if not folder.is_dir():
        raise InputError(
            f"{src}: expected a folder of SPEED+ with {domain}/ or of SPEED with train.json, found neither"
        )
    names = ("train.json", "validation.json") if domain == "synthetic" else ("test.json",)
    lists = [folder / name for name in names]
    return folder / "images", [path for path in lists if path == lists[0] or path.is_file()]


def _read_camera(src: Path, labels: Path) -> _Intrinsics:
    path = src / "camera.json"
    of_speed = labels.parent == src and not path.is_file()
    values = SPEED_CAMERA if of_speed else read_json(path)
    try:
        width, height = int(values["Nu"]), int(values["Nv"])
        if "cameraMatrix" in values:
            matrix = np.array(values["cameraMatrix"], np.float64).reshape(3, 3)
            (fx, skew, cx), (_, fy, cy) = matrix[:2].tolist()
            if abs(skew) * height > _SKEWED * fy:
                raise InputError(f"expected a cameraMatrix without skew, found {skew:g} in its first row")
        else:
            fx, fy = (float(values[f"f{axis}"]) / float(values[f"pp{axis}"]) for axis in "xy")
            cx, cy = float(values.get("ccx", 0.5 * width)), float(values.get("ccy", 0.5 * height))
        lens = [float(value) for value in np.ravel(values.get("distCoeffs", ()))]
        distortion = tuple([*lens, *[0.0] * (5 - len(lens))]) if any(lens) else ()
        if len(distortion) > 5 or not np.isfinite([fx, fy, cx, cy, *distortion]).all():
            raise ValueError
        if max(map(abs, distortion), default=0) > _BENT:
            raise InputError(f"expected distCoeffs up to {_BENT:g}, found {lens}")
        Camera(np.eye(4), width, height, fx, fy, cx, cy)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (KeyError, TypeError, ValueError, OverflowError, ZeroDivisionError, AttributeError):
        expected = "Nu, Nv, cameraMatrix (or fx, fy, ppx, ppy) and at most five distCoeffs"
        raise InputError(f"{path}: expected {expected}, found other values") from None
    return _Intrinsics(width, height, fx, fy, cx, cy, distortion)


def _read_labels(path: Path) -> list[_Label]:
    """In the order of their file names."""
    entries = read_json(path, MAX_LIST_BYTES)
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(f"{path}: expected a list of labels, found another value")
    return sorted((_read_label(path, entry) for entry in entries), key=lambda label: label.filename)


def _read_label(path: Path, entry: JsonDict) -> _Label:
    name = entry.get("filename")
    parts = PurePosixPath(name).parts if isinstance(name, str) else ()
    if not parts or "\0" in str(name) or ".." in parts or PurePosixPath(str(name)).is_absolute():
        raise InputError(f"{path}: expected a file name below the folder of pictures as filename, found {name!r}")
    try:
        quaternion = _numbers(entry, _TURNS, 4)
        position = _numbers(entry, _PLACES, 3)
        length = float(np.linalg.norm(quaternion))
        if abs(length - 1) > _UNIT:
            raise InputError(f"expected a quaternion of length 1, found one of length {length:.4g}")
        if max(map(abs, position)) > FARTHEST:
            raise InputError(f"expected a position within {FARTHEST:g} m, found {position}")
        if position[2] <= 0:
            raise InputError(f"expected a position before the camera, z above 0, found {position}")
    except InputError as error:
        raise InputError(f"{path}: {name}: {error}") from None
    return _Label(str(name), quaternion, position)


def _numbers(entry: JsonDict, keys: Sequence[str], count: int) -> list[float]:
    """The finite numbers under the first of `keys` that is there."""
    value = next((entry[key] for key in keys if key in entry), None)
    try:
        numbers = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.empty(0)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise InputError(f"expected {count} finite numbers as {' or '.join(keys)}, found {value!r}"[:300])
    return numbers.tolist()


def _subsets(splits: list[list[_Label]], count: int, seed: int) -> list[list[_Label]]:
    """`count` of all, shared out as the splits are long, at least one of each that has any."""
    total = sum(map(len, splits))
    tested = sum(map(len, splits[1:]))
    of_test = min(max(round(count * tested / total), 1), tested, count - 1) if tested else 0
    random = np.random.default_rng(seed)
    return [_draw(labels, want, random) for labels, want in zip(splits, (count - of_test, of_test), strict=False)]


def _draw(labels: list[_Label], count: int, random: np.random.Generator) -> list[_Label]:
    """One from each of `count` pieces, equal but for one label; all where there are no more."""
    if count >= len(labels):
        return labels
    edges = np.arange(count + 1) * len(labels) // count
    return [labels[i] for i in random.integers(edges[:-1], edges[1:])]


@dataclass(frozen=True, eq=False)
class _FrameMaker:
    """What all frames share."""

    pictures: Path  #: their folder
    names: Mapping[str, str]  #: of frames, by file names
    intrinsics: _Intrinsics
    size: tuple[int, int]  #: (width, height) that pictures get
    masks: Mapping[str, Callable[[], np.ndarray]]  #: what makes them, of file names
    masked: str
    guessed: bool  #: of masks that show nothing, nothing is known either

    def frame(self, label: _Label) -> ImportedFrame:
        """Pictures are read when it is written."""
        path, full = self.pictures / label.filename, (self.intrinsics.width, self.intrinsics.height)
        mask = self.masks.get(label.filename)
        made = None if mask is None else partial(_resized_mask, mask, self.size)
        return ImportedFrame(
            name=self.names[label.filename],
            picture=path if self.size == full else partial(_resized, path, self.size),
            camera=self.intrinsics.camera(label.world_from_camera, self.size),
            distortion=self.intrinsics.distortion,
            silhouette=None if made is None or self.masked != "empty" else partial(self._silhouette, made),
            mask=None if made is None or not (self.guessed or self.masked == "unknown") else partial(self._known, made),
            keys={"q_vbs2tango_true": label.quaternion, "r_Vo2To_vbs_true": label.position},
        )

    def _silhouette(self, make: Callable[[], np.ndarray]) -> np.ndarray | None:
        """None where it is not known."""
        made = make()
        return made if made.any() or not self.guessed else None

    def _known(self, make: Callable[[], np.ndarray]) -> np.ndarray | None:
        """None where a guess leaves nothing unknown."""
        made = make()
        return made if self.masked == "unknown" or not made.any() else None


def _resized(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Of `size` (width, height), as the file's [h, w] uint8 or uint16, or [h, w, 3] or [h, w, 4] uint8: means over the
    areas of the pixels, of colours by their alpha."""
    pixels = read_png(path)
    if pixels.dtype == np.uint8 and pixels.shape[2:] != (4,):
        return np.asarray(PillowImage.fromarray(pixels).resize(size, _BOX))
    planes = np.atleast_3d(pixels).astype(np.float32)
    if planes.shape[2] == 4:
        planes[..., :3] *= planes[..., 3:]
    pictures = [PillowImage.fromarray(plane).resize(size, _BOX) for plane in np.moveaxis(planes, 2, 0)]
    means = np.dstack([np.asarray(picture) for picture in pictures])
    if planes.shape[2] == 4:
        means[..., :3] /= np.where(means[..., 3:] > 0, means[..., 3:], 1)
    return np.rint(means).astype(pixels.dtype).reshape(size[::-1] + pixels.shape[2:])


def _resized_mask(make: Callable[[], np.ndarray], size: tuple[int, int]) -> np.ndarray:
    """[h, w] uint8, 255 where most of a pixel is white."""
    white = np.where(make(), 255, 0).astype(np.uint8)
    return np.where(np.asarray(PillowImage.fromarray(white).resize(size, _BOX)) > 127, 255, 0).astype(np.uint8)


SPEEDPLUS = Importer(
    import_speedplus,
    "SPEED+ or SPEED: poses of a spacecraft, no Sun",
    "folder with camera.json",
    (
        Option("domain", str, "NAME", "synthetic (default), lightbox or sunlamp", DOMAINS),
        Option("max_distance", float, "M", "leave out what is farther than so many metres (all)"),
        Option("count", int, "N", "so many frames, evenly spread (all)"),
        Option("scale", float, "X", "size of the pictures, a fraction (1)"),
        Option("seed", int, "N", "random seed of --count (0)"),
        *mask_options("those in the folder masks, else auto of 20 pictures or more"),
    ),
)
