"""SPEED+ (T. H. Park et al., "SPEED+: Next-generation dataset for spacecraft pose estimation across domain gap", 2022).

    DIR/camera.json                      Nu Nv ppx ppy fx fy ccx ccy cameraMatrix distCoeffs
    DIR/synthetic/train.json             [{filename, q_vbs2tango_true, r_Vo2To_vbs_true}, ...]
    DIR/synthetic/validation.json        our test split, which is what SPEED+ calls its labelled synthetic images
    DIR/synthetic/images/NAME.png
    DIR/synthetic/masks/NAME.png         255 where the object is seen, else 0
    DIR/synthetic/keypoints.json         {filename: [[x, y, v], ...]}: pixels, v 2 seen, 1 hidden, 0 not in the picture
    DIR/keypoints.json                   the same in 3D: see `keypoints`

What was imported from SPEED+ keeps its labels: of frames whose poses have stayed, these are written again as they were.

A point p of the body is at R(q) p + r in the camera: q is scalar-first, r in metres, the axes OpenCV's; SPEED+'s own
utilities project it so. Pixels are as everywhere here: the image spans [0, Nu] x [0, Nv].
"""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.exporters.keypoints import NAME, write_body_labels
from spacesim.data.exporters.labels import DatasetLabeller
from spacesim.data.exporters.objects import (
    ExportProgress,
    LabelledObject,
    opaque_picture,
    select_object,
)
from spacesim.data.files import MAX_LIST_BYTES, JsonDict, read_json, write_json
from spacesim.data.geometry import camera_that_sees, quaternion_from_rotation
from spacesim.data.identity import frame_names
from spacesim.data.images import read_labels, write_png
from spacesim.data.integrity.outputs import replaced_content
from spacesim.data.records import Camera, Dataset, Frame

PIXEL_PITCH = 5.86e-6
"""Metres: that of the camera of SPEED+. We know focal lengths in pixels alone; SPEED+ gives them in metres as well."""

LABEL = "q_vbs2tango_true", "r_Vo2To_vbs_true"
BODY = LabelledObject(1, "the body", np.eye(4), np.empty((0, 3)), np.empty((0, 3), np.int64))
"""Of an import, whose world is its frame."""


def write_speedplus(
    dataset: Dataset,
    out: Path,
    target_name: str | None = None,
    keypoints: int | Path | None = None,
    progress: ExportProgress | None = None,
) -> LabelledObject:
    """Write `dataset` into the new folder `out`; returns the object whose poses the labels are.

    target_name: number or name of the object, None the first; of an import it is the body that the world is the frame
    of;  keypoints: how many are to be found, or a file, see `body_labels`. An import has no mesh: it gets masks where
    it has silhouettes, and no keypoints. Raises InputError for another object, for frames of several cameras, which
    SPEED+ does not know, and for a folder that is not empty.
    """
    kept = {} if dataset.scene else _kept_labels(dataset)
    labeller = None if kept else DatasetLabeller(dataset, keypoints)
    if keypoints is not None and labeller is None:
        raise InputError(f"keypoints: expected with a dataset that has a mesh, found {dataset.root}, an import")
    target = select_object(labeller.targets if labeller else [BODY], target_name)
    camera = _camera(dataset.frames)
    with replaced_content(out) as out:
        frames = dataset.frames
        names = [f"{name}.png" for name in frame_names(frames)]
        points: JsonDict = {}
        for number, (name, frame) in enumerate(zip(names, frames, strict=True), start=1):
            write_png(out / "synthetic/images" / name, opaque_picture(dataset, frame), durable=False)
            mask = None
            if labeller is not None:
                (instance,) = (one for one in labeller.instances(frame) if one.target.id == target.id)
                mask, points[name] = instance.mask, instance.keypoints.tolist()
            elif frame.silhouette_path is not None:
                mask = read_labels(dataset.root / frame.silhouette_path, frame.camera) > 0
            if mask is not None:
                write_png(out / "synthetic/masks" / name, np.where(mask, 255, 0).astype(np.uint8), durable=False)
            if progress is not None:
                progress(number, len(frames), frame.file_path)
        labels = [
            _label(name, frame, target, kept.get(frame.file_path)) for name, frame in zip(names, frames, strict=True)
        ]
        write_json(out / "synthetic/train.json", labels[: len(dataset.train)])
        write_json(out / "synthetic/validation.json", labels[len(dataset.train) :])
        if labeller is not None:
            write_json(out / "synthetic/keypoints.json", points)
            write_body_labels(out / NAME, [body for body in labeller.bodies if body.id == target.id])
        write_json(out / "camera.json", camera)
        return target


def _kept_labels(dataset: Dataset) -> dict[str, JsonDict]:
    """What transforms.json keeps of an import's labels, by the paths of images; {} where a frame has none."""
    try:
        entries = read_json(dataset.root / "transforms.json", MAX_LIST_BYTES)["frames"]
        labels = {str(PurePosixPath(entry["file_path"])): {key: entry[key] for key in LABEL} for entry in entries}
    except (InputError, KeyError, TypeError):
        return {}
    return labels if all(frame.file_path in labels for frame in dataset.frames) else {}


def _label(name: str, frame: Frame, target: LabelledObject, kept: JsonDict | None = None) -> JsonDict:
    """kept: written as it is, where it says the frame's pose"""
    pose = target.at(frame).camera_from_object(frame.camera)
    if kept is not None:
        try:
            if np.array_equal(camera_that_sees(*(kept[key] for key in LABEL)), frame.camera.world_from_camera):
                return {"filename": name, **kept}
        except (TypeError, ValueError):  # it is no label
            pass
    return {
        "filename": name,
        **dict(zip(LABEL, (quaternion_from_rotation(pose[:3, :3]).tolist(), pose[:3, 3].tolist()), strict=True)),
    }


def _camera(frames: Sequence[Frame]) -> JsonDict:
    """camera.json of what all frames share."""
    first = frames[0]
    for frame in frames:
        if _intrinsics(frame.camera) != _intrinsics(first.camera) or frame.distortion != first.distortion:
            raise InputError(f"{frame.file_path}: expected one camera for all frames, as SPEED+ has, found another")
    camera = first.camera
    return {
        "Nu": camera.width,
        "Nv": camera.height,
        "ppx": PIXEL_PITCH,
        "ppy": PIXEL_PITCH,
        "fx": camera.fx * PIXEL_PITCH,
        "fy": camera.fy * PIXEL_PITCH,
        "ccx": camera.cx,
        "ccy": camera.cy,
        "cameraMatrix": [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]],
        "distCoeffs": list(first.distortion or (0.0,) * 5),
    }


def _intrinsics(camera: Camera) -> tuple[float, ...]:
    return camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
