"""BOP, the benchmark for 6D object pose estimation (T. Hodan et al., ECCV 2018), scene-wise, as its toolkit has it.

    DIR/camera.json  keypoints.json   DIR/models, models_eval: models_info.json, obj_000001.ply (mm)
    DIR/train/000000, test/000000     scene_camera.json  scene_gt.json  scene_gt_info.json
                                      rgb/  depth/  mask/  mask_visib/

models_eval has the same shapes with vertices all over them, at most some 10,000, as errors are measured at vertices.
models_info.json has symmetries: see `symmetries`.

A point p of a model is at cam_R_m2c p + cam_t_m2c in the camera, in millimetres, the axes OpenCV's. In BOP's rendered
datasets the centres of pixels have whole coordinates, so cam_K's principal point is half a pixel less than ours.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import cdist

from spacesim.data.errors import InputError
from spacesim.data.exporters.keypoints import NAME, BodyLabels, body_labels, write_body_labels
from spacesim.data.exporters.masks import NO_BOX, bounding_box
from spacesim.data.exporters.objects import (
    ExportProgress,
    LabelledObject,
    labelled_objects,
    model_numbers,
    opaque_picture,
)
from spacesim.data.files import JsonDict, write_bytes, write_json
from spacesim.data.images import write_png
from spacesim.data.integrity.outputs import replaced_content
from spacesim.data.records import Camera, Dataset, Frame
from spacesim.data.store import load_truth

if TYPE_CHECKING:
    import trimesh

MM = 1000.0
HALF = 0.5  # from our pixel coordinates to those of BOP
EDGE = 0.05  #: of the diameter: longest edges of models_eval
MOST_VERTICES = 10_000  #: from which on models_eval merges vertices
SEEN_ENOUGH = 0.1  #: visible fraction from which on an instance is a target of the test (BOP challenge)


@dataclass(frozen=True, eq=False)
class Silhouette:
    """Of one object as if it were alone."""

    mask: np.ndarray  #: [H, W] bool, in the image
    count: int  #: pixels, those outside of the image too
    box: tuple[int, int, int, int]  #: (x, y, width, height) of all of them, pixels


Outline = Callable[[Camera], Sequence[Silhouette]]  #: silhouettes of all targets, in their order


def write_bop(
    dataset: Dataset,
    out: Path,
    outline: Callable[[list[LabelledObject]], Outline],
    keypoints: int | Path | None = None,
    progress: ExportProgress | None = None,
) -> list[LabelledObject]:
    """Write `dataset` into the new folder `out`; returns the objects whose poses are labels.

    outline: makes what finds silhouettes, which takes rays (see `spacesim.scenes.silhouette`);  keypoints: how many are
    to be found, or a file, see `body_labels`. Raises InputError for distorted images, which BOP does not know, and for
    a folder that is not empty.
    """
    for frame in dataset.frames:
        if any(frame.distortion):
            raise InputError(f"{frame.file_path}: expected an image without lens distortion, which BOP does not know")
    targets = labelled_objects(dataset)
    bodies = body_labels(dataset, targets, keypoints)
    with replaced_content(out) as out:
        models = model_numbers(targets)
        _write_models(out, targets, models, bodies)
        write_body_labels(out / NAME, bodies)
        find = outline(targets)
        done = 0
        for split, frames in (("train", dataset.train), ("test", dataset.test)):
            scene = out / split / "000000"
            cameras, poses, infos = {}, {}, {}
            for image, frame in enumerate(frames):
                placed = [target.at(frame) for target in targets]
                finder = outline(placed) if frame.objects else find
                cameras[str(image)], infos[str(image)] = _write_frame(scene, image, dataset, frame, targets, finder)
                poses[str(image)] = [_pose(frame.camera, *pair) for pair in zip(placed, models, strict=True)]
                done += 1
                if progress is not None:
                    progress(done, len(dataset.frames), frame.file_path)
            if frames:
                write_json(scene / "scene_camera.json", cameras)
                write_json(scene / "scene_gt.json", poses)
                write_json(scene / "scene_gt_info.json", infos)
            if split == "test":
                write_json(out / "test_targets_bop19.json", _test_targets(infos, models))
        write_json(out / "camera.json", _sensor(dataset.frames[0].camera))
        return targets


def _write_frame(
    scene: Path, image: int, dataset: Dataset, frame: Frame, targets: list[LabelledObject], find: Outline
) -> tuple[JsonDict, list[JsonDict]]:
    """Write the pictures of a frame; returns its entries of scene_camera.json and scene_gt_info.json."""
    truth = load_truth(dataset, frame)
    picture = opaque_picture(dataset, frame)
    picture = picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)
    write_png(scene / "rgb" / f"{image:06d}.png", picture, durable=False)
    depth = np.where(truth.object_id > 0, truth.depth, 0) * MM
    scale = _depth_scale(float(depth.max()))
    stored = np.round(depth / scale).astype(np.uint16)
    write_png(scene / "depth" / f"{image:06d}.png", stored, durable=False)
    infos = []
    for index, (target, silhouette) in enumerate(zip(targets, find(frame.camera), strict=True)):
        visible = truth.object_id == target.id
        mask = silhouette.mask | visible  # rays through edges may round either way
        for folder, pixels in (("mask", mask), ("mask_visib", visible)):
            path = scene / folder / f"{image:06d}_{index:06d}.png"
            write_png(path, np.where(pixels, 255, 0).astype(np.uint8), durable=False)
        count = silhouette.count + int((visible & ~silhouette.mask).sum())
        infos.append(
            {
                "bbox_obj": list(silhouette.box if visible.any() else NO_BOX),
                "bbox_visib": list(bounding_box(visible)),
                "px_count_all": count,
                "px_count_valid": int((stored[mask] > 0).sum()),
                "px_count_visib": int(visible.sum()),
                "visib_fract": float(visible.sum() / count) if count else 0.0,
            }
        )
    pose = frame.camera.camera_from_world
    entry = {
        "cam_K": _matrix(frame.camera),
        "depth_scale": scale,
        "cam_R_w2c": pose[:3, :3].ravel().tolist(),
        "cam_t_w2c": (MM * pose[:3, 3]).tolist(),
    }
    return entry, infos


def _pose(camera: Camera, target: LabelledObject, model: int) -> JsonDict:
    pose = target.camera_from_object(camera)
    return {
        "cam_R_m2c": pose[:3, :3].ravel().tolist(),
        "cam_t_m2c": (MM * pose[:3, 3]).tolist(),
        "obj_id": model,
    }


def _matrix(camera: Camera) -> list[float]:
    return [camera.fx, 0.0, camera.cx - HALF, 0.0, camera.fy, camera.cy - HALF, 0.0, 0.0, 1.0]


def _sensor(camera: Camera) -> dict[str, float]:
    names = dict(zip(("fx", "cx", "fy", "cy"), (_matrix(camera)[i] for i in (0, 2, 4, 5)), strict=True))
    return {**names, "width": camera.width, "height": camera.height, "depth_scale": 1.0}


def _depth_scale(farthest: float) -> float:
    """Millimetres a step: the finest of 0.1, 1, 10, ... with which 16 bits reach `farthest` millimetres."""
    scale = 0.1
    while farthest / scale > np.iinfo(np.uint16).max:
        scale *= 10
    return round(scale, 1)


def _write_models(out: Path, targets: list[LabelledObject], models: list[int], bodies: Sequence[BodyLabels]) -> None:
    import trimesh  # half a second, that evaluating need not wait

    infos: JsonDict = {}
    for number in dict.fromkeys(models):
        target, body = targets[models.index(number)], bodies[models.index(number)]
        points = MM * target.vertices
        diameter = _diameter(points)
        for folder, mesh in (
            ("models", trimesh.Trimesh(points, target.faces, process=False)),
            ("models_eval", _spread(points, target.faces, diameter)),
        ):
            content = mesh.export(file_type="ply", encoding="ascii", vertex_normal=True)
            write_bytes(out / folder / f"obj_{number:06d}.ply", content)
        low, sizes = points.min(axis=0), np.ptp(points, axis=0)
        infos[str(number)] = {
            "diameter": diameter,
            **{f"min_{axis}": float(x) for axis, x in zip("xyz", low, strict=True)},
            **{f"size_{axis}": float(x) for axis, x in zip("xyz", sizes, strict=True)},
        }
        if body.symmetries_discrete:
            to_mm = np.where(np.arange(16) % 4 == 3, MM, 1.0) * (np.arange(16) < 12) + (np.arange(16) == 15)
            matrices = [(np.array(matrix) * to_mm).tolist() for matrix in body.symmetries_discrete]
            infos[str(number)]["symmetries_discrete"] = matrices
        if body.symmetries_continuous:
            infos[str(number)]["symmetries_continuous"] = [
                {"axis": list(round_.axis), "offset": [MM * x for x in round_.offset]}
                for round_ in body.symmetries_continuous
            ]
    for folder in ("models", "models_eval"):
        write_json(out / folder / "models_info.json", infos)


def _spread(points: np.ndarray, faces: np.ndarray, diameter: float) -> "trimesh.Trimesh":
    """The mesh with edges of at most `EDGE` diameters, and where it has more than `MOST_VERTICES`, those in a cell of a
    grid merged, as fine as will do."""
    import trimesh

    edge, merged, corners = EDGE * diameter, points, faces
    for share in (0.1, 0.2, 0.4):
        if len(merged) <= MOST_VERTICES:
            break
        cells = np.floor(points / (share * edge)).astype(np.int64)
        place = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
        counts = np.bincount(place)
        merged = np.stack([np.bincount(place, points[:, axis]) / counts for axis in range(3)], axis=1)
        corners = place[faces]
        corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
    return trimesh.Trimesh(*trimesh.remesh.subdivide_to_size(merged, corners, edge, max_iter=30), process=False)


def _diameter(points: np.ndarray) -> float:
    """Largest distance between two of points [N, 3], which are corners of their convex hull; of all of them where they
    lie on a plane or a line."""
    with suppress(QhullError):
        points = points[ConvexHull(points).vertices]
    return max(float(cdist(points[i : i + 1000], points).max()) for i in range(0, len(points), 1000))


def _test_targets(infos: dict[str, list[JsonDict]], models: list[int]) -> list[dict[str, int]]:
    """How many instances of each model are to be found in each test image."""
    entries_found = []
    for image, entries in infos.items():
        seen = [model for model, info in zip(models, entries, strict=True) if info["visib_fract"] >= SEEN_ENOUGH]
        entries_found += [
            {"im_id": int(image), "inst_count": seen.count(model), "obj_id": model, "scene_id": 0}
            for model in sorted(set(seen))
        ]
    return entries_found
