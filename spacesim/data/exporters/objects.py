"""What every exporter needs of a dataset: the objects with their poses and meshes, and opaque pictures."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spacesim.data.errors import InputError, expect
from spacesim.data.geometry import Array
from spacesim.data.images import read_exr, read_png
from spacesim.data.images.tone import TONES, as_bytes, display_values
from spacesim.data.mesh import MAX_COORDINATE, check_points, load_mesh
from spacesim.data.records import Camera, Dataset, Frame

ExportProgress = Callable[[int, int, str], None]  #: frames done, frames in all, name of the frame


@dataclass(frozen=True, eq=False)
class LabelledObject:
    """An object whose pose is a label."""

    id: int  #: in the label pictures, from 1
    name: str  #: as scene.json has it
    world_from_object: Array  #: [4, 4] rigid, metres
    vertices: Array  #: [V, 3] metres, body frame, as large as in the scene
    faces: np.ndarray  #: [F, 3]

    def at(self, frame: Frame) -> "LabelledObject":
        """The object where a frame has it. Raises InputError for a pose that cannot be."""
        if self.id not in frame.objects:
            return self
        pose = frame.objects[self.id]
        if not _is_similarity(pose):
            raise InputError(f"{frame.file_path}: expected a pose of object {self.id}, found another matrix")
        return replace(self, world_from_object=_rigid(pose))

    def camera_from_object(self, camera: Camera) -> Array:
        """[4, 4] rigid, OpenCV's camera axes, metres."""
        return camera.camera_from_world @ self.world_from_object


def labelled_objects(dataset: Dataset) -> list[LabelledObject]:
    """The objects of a dataset. Raises InputError where it was not generated, and where scene.json or mesh.ply do not
    distinguish them."""
    path = dataset.root / "scene.json"
    if not dataset.scene:
        expected = "expected data that `spacesim generate` made, whose objects are known"
        raise InputError(f"{dataset.root}: {expected}, found no scene.json")
    try:
        objects, counts = dataset.scene["objects"], dataset.scene["mesh"]
        sizes = [(int(count["vertices"]), int(count["faces"])) for count in counts]
        poses = [np.array(item["world_from_object"], np.float64).reshape(4, 4) for item in objects]
        names = [(int(item["id"]), str(item["name"])) for item in objects]
        if not all(map(_is_similarity, poses)) or len(sizes) != len(poses) or min(map(min, sizes)) < 1:
            raise ValueError
    except (KeyError, TypeError, ValueError, OverflowError):
        raise InputError(f"{path}: expected objects, their poses and shares of mesh.ply, found none") from None
    source = dataset.root / (dataset.mesh_path or "mesh.ply")
    mesh = load_mesh(source)
    if not len(mesh.faces):
        raise InputError(f"{source}: expected the mesh of the dataset, found points without faces")
    check_points(mesh.vertices, source, MAX_COORDINATE)
    if not objects or [sum(size) for size in zip(*sizes, strict=True)] != [len(mesh.vertices), len(mesh.faces)]:
        raise InputError(f"{path}: expected the vertices and faces of mesh.ply, found other numbers of them")
    targets = []
    first_vertex = first_face = 0
    for (number, name), pose, (vertices, faces) in zip(names, poses, sizes, strict=True):
        rigid = _rigid(pose)
        world = mesh.vertices[first_vertex : first_vertex + vertices]
        object_faces = mesh.faces[first_face : first_face + faces] - first_vertex
        if object_faces.min() < 0 or object_faces.max() >= vertices or not (np.ptp(world, axis=0) > 0).any():
            raise InputError(f"{source}: expected a mesh with a size as object {number}, found none")
        targets.append(LabelledObject(number, name, rigid, (world - rigid[:3, 3]) @ rigid[:3, :3], object_faces))
        first_vertex, first_face = first_vertex + vertices, first_face + faces
    return targets


def _rigid(pose: Array) -> Array:
    rigid = pose.copy()
    rigid[:3, :3] /= np.cbrt(np.linalg.det(pose[:3, :3]))
    return rigid


def _is_similarity(pose: Array) -> bool:
    """Rotation, one scale from 1e-9 to 1e9 and a translation within MAX_COORDINATE, [4, 4]."""
    with np.errstate(all="ignore"):
        square = pose[:3, :3] @ pose[:3, :3].T
        scale2 = float(np.trace(square)) / 3
        alike = bool(np.abs(square - scale2 * np.eye(3)).max() <= 1e-4 * scale2) and 1e-18 <= scale2 <= 1e18
        right = bool(np.linalg.det(pose[:3, :3]) > 0)
        return (
            alike
            and right
            and bool(np.abs(pose[:3, 3]).max() <= MAX_COORDINATE)
            and bool((pose[3] == (0, 0, 0, 1)).all())
        )


def select_object(targets: list[LabelledObject], name: str | None) -> LabelledObject:
    """The target of that number or name; without one the first. Raises InputError where there is none, and for a name
    that several have."""
    if name is None:
        return targets[0]
    found = [target for target in targets if str(target.id) == name] or [t for t in targets if t.name == name]
    if len(found) == 1:
        return found[0]
    if found:
        numbers = ", ".join(str(target.id) for target in found)
        raise InputError(f"object: expected one of the numbers {numbers}, found {name!r}, the name of each")
    names = ", ".join(f"{target.id} {target.name}" for target in targets)
    raise InputError(f"object: expected one of {names}, found {name!r}")


def model_numbers(targets: Sequence[LabelledObject]) -> list[int]:
    """Number of each target's model, from 1: objects of the same shape are instances of one model."""
    numbers: list[int] = []
    for i, target in enumerate(targets):
        same = (numbers[k] for k in range(i) if _is_same(targets[k], target))
        numbers.append(next(same, max(numbers, default=0) + 1))
    return numbers


def _is_same(first: LabelledObject, second: LabelledObject) -> bool:
    if first.vertices.shape != second.vertices.shape or not np.array_equal(first.faces, second.faces):
        return False
    return bool(np.abs(first.vertices - second.vertices).max() < 1e-5 * np.ptp(first.vertices, axis=0).max())


def opaque_picture(dataset: Dataset, frame: Frame) -> np.ndarray:
    """[H, W] or [H, W, 3] uint8: the picture of `frame` over black, as its camera records it in space.

    A sensor's picture is that already. One with alpha is made anew from the radiance in gt/, by the exposure and the
    tone curve in scene.json: where the target covers a part of a pixel, light is mixed, not sRGB values, and it is
    clipped after that. Stored as the lens shows it. Raises InputError where one of these is missing.
    """
    pixels = read_png(dataset.root / frame.file_path)
    if pixels.ndim == 2 or pixels.shape[2] == 3:
        return pixels
    exposure, tone = _development(dataset, frame)
    if frame.gt_path is None:
        raise InputError(f"{dataset.root}: expected the radiance of {frame.file_path}, found no gt_path")
    path = dataset.root / frame.gt_path
    radiance = read_exr(path).get("radiance")
    if radiance is None or radiance.shape != (*pixels.shape[:2], 3):
        raise InputError(f"{path}: expected radiance of {pixels.shape[1]}x{pixels.shape[0]} pixels, found none")
    return as_bytes(display_values(exposure * radiance, tone))


def _development(dataset: Dataset, frame: Frame) -> tuple[float, str]:
    """Exposure and tone curve of a picture."""
    try:
        exposure, tone = float(dataset.scene["exposure"]), str(dataset.scene["config"]["camera"]["tone"])
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{dataset.root / 'scene.json'}: expected the exposure and the tone, found none") from None
    expect(tone in TONES, f"{dataset.root / 'scene.json'}: tone", f"one of {', '.join(TONES)}", tone)
    return frame.exposure or exposure, tone


def frame_camera(frame: Frame) -> dict[str, float | list[float]]:
    """Intrinsics of the stored picture, pixels, and k1, k2, p1, p2, k3 of its lens."""
    camera, lens = frame.camera, list(frame.distortion or (0.0,) * 5)
    return {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy, "distortion": lens}
