"""keypoints.json, beside the mesh: points of bodies that pose estimators look for, found or given, and symmetries.

    {"objects": [{"id": 1, "name": "boxsat", "keypoints": {"k1": [x, y, z], ...},
                  "symmetries_discrete": [[16 numbers], ...], "symmetries_continuous": [{"axis": ..., "offset": ...}]}]}

Metres, in the object's body frame; symmetries as BOP's models_info.json has them, but for the unit.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from spacesim.data.errors import InputError
from spacesim.data.exporters.objects import LabelledObject, model_numbers
from spacesim.data.exporters.symmetries import SymmetryAxis, find_symmetries, sample_surface
from spacesim.data.files import MAX_JSON_BYTES, write_json
from spacesim.data.geometry import Array, fibonacci_sphere
from spacesim.data.mesh import MAX_COORDINATE, drawable_faces
from spacesim.data.records import Dataset
from spacesim.data.structure import Rules, plain, read_record

NAME = "keypoints.json"
COUNT = 11  #: keypoints that are found, as many as are usual for SPEED's Tango
MAX_COUNT = 1000
CELLS = 24  #: cells of a grid along an object's longest side, of each of which one corner is a candidate
RAYS = 128  #: directions from which it is asked whether a candidate is seen
FLAT = (
    0.45  #: share of all directions: a flat place is seen from half of them, a cube's corner from 7/8, a tip from all
)
MIDST = 0.1  #: weight of what has the surface all around, to be added to that distance
NEAR = 0.08  #: of the object's size: around a candidate
SAMPLES = 10_000  #: points of the surface
START = 1e-5  #: of the object's size: how far from the surface rays begin
REACH = 3.0  #: of the object's size: a keypoint farther outside is in another unit, most likely

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class BodyLabels:
    """Of one object; positions in metres, body frame."""

    id: int  #: of the object, from 1
    keypoints: Mapping[str, tuple[float, float, float]]  #: by their names, in this order
    name: str = ""  #: of the object
    symmetries_discrete: tuple[tuple[float, ...], ...] = ()  #: [4, 4] row by row, each takes the body to itself
    symmetries_continuous: tuple[SymmetryAxis, ...] = ()  #: axes about which any turn takes the body to itself

    def __post_init__(self) -> None:
        if not 0 < len(self.keypoints) <= MAX_COUNT:
            raise InputError(f"keypoints: expected 1 to {MAX_COUNT}, found {len(self.keypoints)}")
        if not (np.abs(self.points) <= MAX_COORDINATE).all():
            raise InputError(f"keypoints: expected points within {MAX_COORDINATE:g} m, found another one")
        for matrix in self.symmetries_discrete:
            pose = np.array(matrix).reshape(4, 4) if len(matrix) == 16 else np.zeros((4, 4))
            rotation = pose[:3, :3]
            if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
                raise InputError("symmetries_discrete: expected rigid [4, 4] matrices as 16 numbers, found another")

    @property
    def points(self) -> Array:
        """[K, 3] metres, body frame."""
        return np.array(list(self.keypoints.values()), np.float64)

    def is_like(self, other: "BodyLabels") -> bool:
        """Equal but for the object whose it is."""
        return replace(self, id=other.id, name=other.name) == other


@dataclass(frozen=True)
class _KeypointsFile:
    objects: tuple[BodyLabels, ...]


def body_labels(
    dataset: Dataset, targets: Sequence[LabelledObject], given: int | Path | None = None
) -> list[BodyLabels]:
    """Of all `targets`, in their order; objects of one shape have the same.

    given: how many keypoints are to be found, or a file that defines them; None is keypoints.json beside the mesh, else
    `COUNT`. What the file lacks is found. Raises InputError where the file is broken or names other objects.
    """
    entries: dict[int, BodyLabels] = {}
    path = given if isinstance(given, Path) else dataset.root / NAME
    if isinstance(given, Path) or (given is None and path.is_file()):
        entries = {entry.id: entry for entry in read_record(path, _KeypointsFile, Rules(), MAX_JSON_BYTES)[0].objects}
        others = sorted(entries.keys() - {target.id for target in targets})
        if others:
            raise InputError(f"{path}: expected objects of {dataset.root}, found {others[0]}")
    count = given if isinstance(given, int) else COUNT
    of_model: dict[int, BodyLabels] = {}
    numbers = model_numbers(targets)
    for number, target in zip(numbers, targets, strict=True):
        entry = entries.get(target.id)
        if entry is not None and not of_model.setdefault(number, entry).is_like(entry):
            raise InputError(f"{path}: expected the same of objects of one shape, found others of object {target.id}")
    for target in targets:
        if target.id in entries:
            _warn_of_far_keypoints(path, entries[target.id], target)
    for number, target in zip(numbers, targets, strict=True):
        if number not in of_model:
            keypoints = find_keypoints(target.vertices, target.faces, count)
            points = {f"k{k}": (float(x), float(y), float(z)) for k, (x, y, z) in enumerate(keypoints, start=1)}
            symmetries = find_symmetries(target.vertices, target.faces)
            of_model[number] = BodyLabels(target.id, points, target.name, *symmetries)
    return [
        replace(of_model[number], id=target.id, name=target.name)
        for number, target in zip(numbers, targets, strict=True)
    ]


def _warn_of_far_keypoints(path: Path, entry: BodyLabels, target: LabelledObject) -> None:
    used = target.vertices[np.unique(target.faces)]
    low, high = used.min(axis=0), used.max(axis=0)
    size, outside = float((high - low).max()), np.maximum(low - entry.points, entry.points - high).max(axis=1)
    if outside.max() > REACH * size:
        name, away = list(entry.keypoints)[int(outside.argmax())], f"{outside.max():.4g} m"
        whose = f"object {target.id}, which is {size:.3g} m large"
        _log.warning("%s: keypoint %s is %s outside %s; keypoints are in metres", path, name, away, whose)


def write_body_labels(path: Path, bodies: Sequence[BodyLabels]) -> None:
    """As keypoints.json."""
    write_json(path, {"objects": [plain(body) for body in bodies]})


def find_keypoints(vertices: Array, faces: np.ndarray, count: int = COUNT) -> Array:
    """[K, 3] at most `count` corners of a mesh, spread over it: seen from far around, and far from each other.

    vertices: [V, 3], faces: [F, 3]. Candidates are the vertices of the mesh, of each cell of a grid the one farthest
    from the middle. Each is weighed by the share of directions from which it is seen, beyond `FLAT` (a corner or a tip
    sticks out, what lies within is seen from nowhere), and by how far it is from the middle of the surface around it
    (at corners and ends, that is all to one side). No use is made of normals or of what hangs together, so meshes may
    be open, and vertices stand there more than once. Then the farthest are chosen (T. F. Gonzalez, 1985): the next is
    that of the largest product of weight and distance to those before. The order of vertices and faces does not
    matter. Raises InputError for a count below 1 and a mesh without an area.
    """
    import igl

    if not 1 <= count <= MAX_COUNT:
        raise InputError(f"keypoints: expected 1 to {MAX_COUNT}, found {count}")
    vertices = np.ascontiguousarray(vertices, np.float64)
    faces = np.ascontiguousarray(drawable_faces(vertices, np.asarray(faces, np.int64)))
    if len(faces) == 0:
        raise InputError("keypoints: expected a mesh with an area, found none")
    used = vertices[np.unique(faces)]
    low, size = used.min(axis=0), float(np.ptp(used, axis=0).max())
    candidates, arms = _candidates(used, low, size)
    tree = igl.AABB()
    tree.init(vertices, faces)
    directions = fibonacci_sphere(RAYS)
    weights = np.empty(len(candidates))
    for k, point in enumerate(candidates):
        origins = point + START * size * directions
        weights[k] = (tree.intersect_ray_first(vertices, faces, origins, directions)[0] < 0).mean()
    weights = np.maximum(weights - FLAT, 0) * (MIDST + _offsets(candidates, vertices, faces, NEAR * size))
    if not weights.any():  # a hollow: nothing of it is seen from outside
        weights[:] = 1
    nearest, chosen = arms, []
    for _ in range(min(count, len(candidates))):
        worth = np.round(nearest * weights / size, 6)  # what is as far off but for rounding is equal: the first counts
        best = int(worth.argmax())
        if worth[best] <= 0:
            break
        chosen.append(best)
        apart = np.linalg.norm(candidates - candidates[best], axis=1)
        nearest = np.minimum(nearest, apart) if len(chosen) > 1 else apart
    return candidates[chosen]


def _offsets(points: Array, vertices: Array, faces: np.ndarray, radius: float) -> Array:
    """[C] of points [C, 3], how far the middle of the surface within `radius` is from them, in radii: 0 amid a face or
    a sheet, some 0.3 on a cube's edge, 0.5 in its corner, 0.6 in that of a sheet."""
    samples = sample_surface(vertices, faces, SAMPLES)
    near = cKDTree(samples).query_ball_point(points, radius)
    alone = points + np.array([radius, 0, 0])  # something thin: an end, as far as is known
    middles = [samples[some].mean(axis=0) if some else other for some, other in zip(near, alone, strict=True)]
    return np.asarray(np.linalg.norm(np.array(middles) - points, axis=1) / radius)


def _candidates(points: Array, low: Array, size: float) -> tuple[Array, Array]:
    """([C, 3] of each cell the point farthest from the middle, [C] how far), in the order of their coordinates."""
    arms = np.round(np.linalg.norm(points - 0.5 * (low + points.max(axis=0)), axis=1) / size, 6)
    cells = np.minimum((points - low) / size * CELLS, CELLS - 1).astype(np.int64)
    keys = (cells[:, 0] * CELLS + cells[:, 1]) * CELLS + cells[:, 2]
    order = np.lexsort((*np.round(points.T / size, 6), -arms, keys))
    first = order[np.r_[True, np.diff(keys[order]) > 0]]
    farthest = points[first]
    first = first[np.lexsort(np.round(farthest.T / size, 6))]
    return points[first], arms[first] * size
