"""The labels of the objects in each picture as it is stored: masks, boxes, keypoints."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.exporters.keypoints import BodyLabels, body_labels
from spacesim.data.exporters.masks import bounding_box
from spacesim.data.exporters.objects import ExportProgress, LabelledObject, labelled_objects, model_numbers
from spacesim.data.geometry import Array
from spacesim.data.images import distort_points, read_labels
from spacesim.data.mesh import drawable_faces
from spacesim.data.records import Dataset, Frame

OUTSIDE, HIDDEN, VISIBLE = 0, 1, 2  #: of keypoints, as COCO has it: not in the picture, behind something, seen
CLEARANCE = 1e-3  #: of the object's size: a keypoint so far within the surface is still seen


@dataclass(frozen=True, eq=False)
class Instance:
    """An object as a picture shows it."""

    target: LabelledObject  #: the object, with its pose and its mesh
    category: int  #: number of its model, from 1: objects of one shape share it
    mask: np.ndarray  #: [H, W] bool: pixels whose centres show it
    box: tuple[int, int, int, int]  #: x, y, width, height of these, pixels; -1 each for none
    keypoints: Array  #: [K, 3] x, y, pixels (the first one's centre is at 0.5, 0.5), and one of OUTSIDE, ...

    @property
    def area(self) -> int:
        """Pixels that show it."""
        return int(self.mask.sum())


@dataclass(frozen=True)
class Category:
    """A model, of which any number of objects are instances."""

    number: int  #: from 1
    name: str  #: of its first object
    body: BodyLabels  #: keypoints and symmetries of the model, in its own axes


class DatasetLabeller:
    """Labels of the frames of a dataset, whose mesh decides what hides what.

    keypoints: how many are to be found, or a file: see `body_labels`. Raises InputError where scene.json or mesh.ply do
    not name the objects, or the file is broken.
    """

    def __init__(self, dataset: Dataset, keypoints: int | Path | None = None) -> None:
        self.dataset = dataset
        self.targets = labelled_objects(dataset)
        self.bodies = body_labels(dataset, self.targets, keypoints)
        self._numbers = model_numbers(self.targets)
        self._placed = _Placed(self.targets)

    @property
    def categories(self) -> list[Category]:
        """In the order of their numbers."""
        categories: dict[int, Category] = {}
        for number, target, body in zip(self._numbers, self.targets, self.bodies, strict=True):
            categories.setdefault(number, Category(number, target.name, body))
        return list(categories.values())

    def instances(self, frame: Frame) -> list[Instance]:
        """All objects, those that are not seen, too. Raises InputError where the object numbers are missing."""
        if frame.id_path is None:
            raise InputError(f"{self.dataset.root}: expected object numbers of {frame.file_path}, found no id_path")
        numbers = read_labels(self.dataset.root / frame.id_path, frame.camera)
        targets = [target.at(frame) for target in self.targets]
        placed = _Placed(targets) if frame.objects else self._placed
        instances = []
        for target, category, body in zip(targets, self._numbers, self.bodies, strict=True):
            mask, points = numbers == target.id, self._keypoints(frame, target, body, placed)
            instances.append(Instance(target, category, mask, bounding_box(mask), points))
        return instances

    def _keypoints(self, frame: Frame, target: LabelledObject, body: BodyLabels, placed: "_Placed") -> Array:
        """[K, 3] as of `Instance`; 0 each outside of the picture."""
        pose, camera = target.world_from_object, frame.camera
        world = body.points @ pose[:3, :3].T + pose[:3, 3]
        pixels, inside = project(world, frame)
        towards = camera.position - world
        clear = CLEARANCE * float(np.ptp(target.vertices, axis=0).max()) / np.linalg.norm(towards, axis=1)
        origins = np.ascontiguousarray(world + clear[:, None] * towards)
        faces, reach = placed.first_hits(origins, towards)
        free = (faces < 0) | (reach >= 1 - clear)
        state = np.where(inside, np.where(free, VISIBLE, HIDDEN), OUTSIDE)
        return np.column_stack([np.where(inside[:, None], pixels, 0), state])

    def frames(
        self, frames: Sequence[Frame], progress: ExportProgress | None = None
    ) -> Iterator[tuple[Frame, list[Instance]]]:
        """Each of `frames` with its instances that are seen."""
        for done, frame in enumerate(frames, start=1):
            yield frame, [instance for instance in self.instances(frame) if instance.area]
            if progress is not None:
                progress(done, len(frames), frame.file_path)


def project(points: Array, frame: Frame) -> tuple[Array, np.ndarray]:
    """([K, 2] where the stored picture has points [K, 3] of the world, through its lens, pixels; [K] bool: whether they
    are in it)."""
    camera = frame.camera
    x, y, z = (points @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]).T
    ahead = z > 0
    z = np.where(ahead, z, 1)
    u, v, unfolded = x / z, y / z, ahead
    if any(frame.distortion):
        k1, k2, _, _, k3 = frame.distortion
        r2 = u * u + v * v
        unfolded = ahead & (1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * 7 * k3)) > 0)  # past this the model folds back
        u, v = distort_points(u, v, frame.distortion)
    u, v = u * camera.fx + camera.cx, v * camera.fy + camera.cy
    inside = unfolded & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return np.column_stack([u, v]), inside


class _Placed:
    """Objects in the world, as rays meet them."""

    def __init__(self, targets: Sequence[LabelledObject]) -> None:
        import igl

        vertices, faces, first = [], [], 0
        for target in targets:
            vertices.append(target.vertices @ target.world_from_object[:3, :3].T + target.world_from_object[:3, 3])
            faces.append(target.faces + first)
            first += len(target.vertices)
        self._vertices = np.ascontiguousarray(np.concatenate(vertices))
        self._faces = drawable_faces(self._vertices, np.concatenate(faces).astype(np.int64))
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)

    def first_hits(self, origins: Array, directions: Array) -> tuple[np.ndarray, Array]:
        """([N] face that a ray meets first, -1 for none; [N] where, in lengths of its direction)."""
        faces, reach, _ = self._tree.intersect_ray_first(self._vertices, self._faces, origins, directions)
        return faces, reach
