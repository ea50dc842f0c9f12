"""Overviews of a whole dataset: how densely cameras look at the target, a contact sheet of frames, keypoints."""

import logging
from pathlib import Path

import numpy as np

from spacesim.data import density
from spacesim.data.errors import InputError
from spacesim.data.exporters import keypoints, labelled_objects
from spacesim.data.exporters.keypoints import body_labels, write_body_labels
from spacesim.data.images import read_png, sheet, write_png
from spacesim.data.images.sheet import Tile
from spacesim.data.records import Dataset, Frame

MAX_TILES = 60

SHEET_NAME = "contact_sheet.png"

_log = logging.getLogger(__name__)


def write_overview(root: Path, dataset: Dataset) -> None:
    """Write the camera density, the contact sheet and keypoints.json of `dataset` into the folder `root`.

    Raises InputError where a picture or the mesh cannot be read.
    """
    density.write_camera_density(root / density.NAME, dataset)
    write_png(root / SHEET_NAME, contact_sheet(dataset))
    try:
        write_body_labels(root / keypoints.NAME, body_labels(dataset, labelled_objects(dataset)))
    except InputError as error:
        _log.warning("%s; so there is no %s", error, keypoints.NAME)


def contact_sheet(dataset: Dataset) -> np.ndarray:
    """[H, W, 3] uint8: up to MAX_TILES frames, evenly chosen, over black, each with its name and Sun.

    Raises InputError where a picture cannot be read.
    """
    frames = dataset.frames
    chosen = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, MAX_TILES).round().astype(int))]
    aspect = max(frame.camera.height / frame.camera.width for frame in chosen)
    tiles = (_tile(dataset.root, frame) for frame in chosen)
    return sheet.contact_sheet(_title(dataset, len(chosen)), tiles, len(chosen), aspect)


def _tile(root: Path, frame: Frame) -> Tile:
    angles = "" if frame.sun is None else "Sun {:.0f}°, {:.0f}°".format(*frame.sun.angles)
    return Tile(read_png(root / frame.file_path), Path(frame.file_path).stem, angles)


def _title(dataset: Dataset, shown: int) -> str:
    name = dataset.scene.get("scene", dataset.root.name)
    camera = dataset.frames[0].camera
    suns = len({f.sun.direction.tobytes() for f in dataset.frames if f.sun is not None})
    parts = [str(name), f"{len(dataset.train)} training and {len(dataset.test)} test frames"]
    parts += [f"{suns} Sun{'s' if suns > 1 else ''}"] if suns else []
    parts += [f"{camera.width} x {camera.height} px"]
    return ", ".join(parts) + (f"; {shown} shown" if shown < len(dataset.frames) else "")
