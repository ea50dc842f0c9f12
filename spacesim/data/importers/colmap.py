"""COLMAP projects as datasets: a sparse model and its pictures."""

import logging
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.importers.carving import PosedPicture, mask_makers
from spacesim.data.importers.colmap_model import (
    ColmapImage,
    ColmapModel,
    count_images,
    holds_model,
    parts_of,
    read_model,
)
from spacesim.data.importers.importer import Importer, Option
from spacesim.data.importers.masks import AUTO, WatchedMasks, mask_options
from spacesim.data.importers.pictures import FrameImporter, SourceView, fitted
from spacesim.data.importers.writing import Progress, StageProgress, frame_names, write_dataset
from spacesim.data.records import Dataset

_FOLDERS = "images", "images_2", "images_4", "images_8"  # of a project; the others hold fractions of the size
_WILD = 100.0  # times as far out as 95 % of points and cameras: points beyond are taken for wrong matches

_log = logging.getLogger(__name__)


def import_colmap(
    src: Path,
    out: Path,
    *,
    images: Path | None = None,
    masks: str | Path | None = None,
    masked: str = "empty",
    progress: Progress | None = None,
) -> Dataset:
    """Import a COLMAP project: the folder of a sparse model, binary or text, or one with it in sparse/ or sparse/0/.

    images: the folder of the pictures, by default SRC/images (or images_2, 4, 8) or what lies beside the model. They
        may have any size of the cameras' shape: intrinsics are scaled to each
    masks: a folder of masks, "auto": cut out by `carving`, "none" or None: the background stays
    masked: see `masks.MASKED`

    Poses are taken as they are, in the model's axes and units. Of several models the largest is taken; images without
    a file are left out; both are logged. Raises InputError where there is no model, as `read_model` does, where no
    image has a file, where a picture has another shape than its camera, and where no mask shows anything.
    """
    folder = _find_model(src)
    model = read_model(folder)
    connected = _largest_part(folder, model)
    projects = dict.fromkeys([src, folder.parent, folder.parent.parent])
    paths = _find_pictures(folder, list(projects), connected, images)
    used = [image for image in connected if image.name in paths]
    lenses = {image.name: fitted(model.cameras[image.camera], paths[image.name]) for image in used}
    pictures = {i.name: PosedPicture(paths[i.name], i.world_from_camera, lenses[i.name]) for i in used}
    tell = StageProgress(progress, ("cut out", "write") if str(masks) == AUTO else ("write",))
    watched, maker = WatchedMasks(mask_makers(masks, pictures, tell)), FrameImporter(masked, str(masks) == AUTO)
    frames = []
    for name, (key, picture) in zip(frame_names(list(pictures)), pictures.items(), strict=True):
        view = SourceView(name, picture.path, picture.world_from_camera, picture.lens, watched.makers.get(key))
        frames.append(maker.frame(view))
    source = {
        "kind": "colmap",
        "source": str(src),
        "images": None if images is None else str(images),
        "masks": None if masks is None else str(masks),
        "masked": masked,
    }
    points = _start_points(folder, model, connected)
    dataset = write_dataset(out, frames, None, source, points, progress=tell.write)
    watched.warn()
    return dataset


def _find_model(src: Path) -> Path:
    """The folder of the model in a project; of several the one with most images."""
    if not src.is_dir():
        raise InputError(
            f"{src}: expected a folder with a COLMAP model, found {'a file' if src.exists() else 'nothing'}"
        )
    places = src, src / "sparse", src / "sparse/0", src / "colmap" / "sparse"
    for folder in places:
        if not folder.is_dir():
            continue
        if holds_model(folder):
            return folder
        models = sorted(path for path in folder.iterdir() if path.is_dir() and holds_model(path))
        if models:
            if len(models) == 1:
                return models[0]
            counts = {path: count_images(path) for path in models}
            largest = max(models, key=lambda path: counts[path])
            _log.warning(
                    "%s: %d models; the largest is taken, %s with %d images",
                    folder, len(models), largest.name, counts[largest],
                )  # fmt: skip
            return largest
    names = "cameras and images (.bin or .txt), in it, in sparse or in sparse/0"
    packed = next((path.name for folder in places for path in sorted(folder.glob("cameras.*.*"))), "none")
    raise InputError(f"{src}: expected a COLMAP model, {names}, found {packed}")


def _largest_part(folder: Path, model: ColmapModel) -> list[ColmapImage]:
    parts = parts_of(model)
    if len(parts) > 1:
        left = len(model.images) - len(parts[0])
        _log.warning(
            "%s: the model falls into %d parts that share no point, so where they lie to each other is unknown; the "
            "largest is taken, with %d images, and %d are left out",
            folder, len(parts), len(parts[0]), left,
        )  # fmt: skip
    return parts[0]


def _find_pictures(
    folder: Path, projects: Sequence[Path], images: Sequence[ColmapImage], given: Path | None
) -> dict[str, Path]:
    """Files of images by their names, those that there are."""
    if given is not None and not given.is_dir():
        raise InputError(f"images: expected a folder, found {'a file' if given.exists() else 'none'} at {given}")
    places = (
        [given]
        if given is not None
        else [p for project in projects for p in (*(project / name for name in _FOLDERS), project)]
    )
    for place in places:
        paths = {image.name: place / image.name for image in images if os.path.isfile(place / image.name)}
        if paths:
            break
    else:
        where = given or places[0]
        raise InputError(
            f"{where}: expected the pictures of {folder} ({images[0].name}), found none; name their folder (images)"
        )
    if len(paths) < len(images):
        first = next(image.name for image in images if image.name not in paths)
        lacking = len(images) - len(paths)
        _log.warning(
            "%s: %d of %d images of the model have no file and are left out, %s first",
            place, lacking, len(images), first[:200],
        )  # fmt: skip
    return paths


def _start_points(
    folder: Path, model: ColmapModel, images: Sequence[ColmapImage]
) -> tuple[np.ndarray, np.ndarray] | None:
    """Points and colours that the images see, or all where none are listed, without those that lie absurdly far out."""
    seen = np.concatenate([image.points for image in images])
    chosen = np.isin(model.numbers, seen) if len(seen) else np.ones(len(model.numbers), bool)
    points, colors = model.points[chosen], model.colors[chosen]
    if not len(points):
        return None
    cameras = np.array([image.world_from_camera[:3, 3] for image in images])
    distances = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    reach = np.quantile(np.linalg.norm(np.concatenate([points, cameras]) - np.median(points, axis=0), axis=1), 0.95)
    near = distances <= _WILD * reach
    if not near.all():
        _log.info(
            "%s: %d of %d points lie more than %g times as far out as 95 %% of points and cameras; left out",
            folder, (~near).sum(), len(points), _WILD,
        )  # fmt: skip
    return points[near], colors[near]


COLMAP = Importer(
    import_colmap,
    "a COLMAP project: a sparse model, binary or text, and its pictures",
    "folder with sparse/0 and images, or that of the model",
    (Option("images", Path, "DIR", "folder of the pictures, of any scale (SRC/images)"), *mask_options("none")),
)
