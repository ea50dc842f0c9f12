"""The labels of a frame: what the ray through each pixel's centre meets, and how much of the Sun is seen from there.

All surface points that face the Sun are asked for a few directions to its disc. Where these disagree, in penumbrae, and
on the pixels next to these, many directions are; as long as that finds more of a penumbra, next to it too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import drjit as dr
import numpy as np

from spacesim import backend
from spacesim.backend import mitsuba_types as mt
from spacesim.backend.arrays import Bool, Float, UInt32
from spacesim.backend.readback import AsyncArray
from spacesim.backend.upload import upload
from spacesim.data.files import JsonMapping
from spacesim.data.records import Camera, Sun
from spacesim.data.store import SHADOW_ATTACHED, SHADOW_LIT, SHADOW_NONE, SHADOW_SELF_CAST
from spacesim.scenes.cameras.kernel_camera import RADIUS, KernelCamera, record_on_cuda
from spacesim.scenes.lights.emitters import Limb, kernel_input
from spacesim.scenes.scene import MitsubaScene, Scene
from spacesim.scenes.steps import Steps
from spacesim.scenes.visibility import Disc, SolarDirections

OFFSET = 2e-6 * RADIUS
"""From the surface to where shadow rays start: 26 steps of single precision at the bounding sphere."""

MAX_RAYS = 1 << 24
"""Most shadow rays at once."""


class Labeller:
    """Labels of a loaded scene. distortion: of the lens, as `Renderer` takes it."""

    def __init__(self, scene: Scene, loaded: MitsubaScene, distortion: Sequence[float]) -> None:
        self._scene = loaded.labelled
        self._units = loaded.units
        self._parts = PartTable.of(scene, loaded)
        self._sun = loaded.sun
        self._directions = SolarDirections(scene.sun)
        self._centres = record_on_cuda(partial(_trace_centres, tuple(distortion)))
        self._penumbrae = record_on_cuda(_trace_penumbrae)

    def labels(self, camera: Camera, sun: Sun) -> Steps[dict[str, np.ndarray]]:
        """All fields of Truth but radiance and alpha."""
        limb = self._sun.limb
        disc, seen = self._directions.few(sun, limb), KernelCamera.of(camera, self._units)
        numbers, ids, points = self._centres(self._scene, self._parts, seen, kernel_input(sun.direction), disc)
        reads = AsyncArray(numbers), AsyncArray(ids)
        yield
        labels = _images(reads[0].wait(), reads[1].wait(), camera)
        yield from self._refine(points, sun, limb, labels)
        return labels

    def _refine(self, points: "_Points", sun: Sun, limb: Limb | None, labels: Mapping[str, np.ndarray]) -> Steps[None]:
        """Settle penumbrae in the labels sun_visibility and shadow."""
        visibility, shadow, cosine = (labels[name].reshape(-1) for name in ("sun_visibility", "shadow", "sun_cosine"))
        mixed = np.flatnonzero((visibility > 0) & (visibility < 1))
        disc = self._directions.many(sun, limb) if len(mixed) else None
        settled = np.zeros(len(cosine), bool)
        while disc is not None and len(mixed):
            todo = _dilate(mixed, labels["shadow"].shape)
            todo = todo[(cosine[todo] > 0) & ~settled[todo]]
            visibility[todo], shadow[todo] = yield from self._query_penumbrae(disc, points, todo)
            settled[todo] = True
            mixed = todo[(visibility[todo] > 0) & (visibility[todo] < 1)]

    def _query_penumbrae(
        self, disc: Disc, points: "_Points", indices: np.ndarray
    ) -> Steps[tuple[np.ndarray, np.ndarray]]:
        """(visibility, shadow classes), [N], of the points `indices` [N]."""
        uint = backend.mitsuba().UInt32
        most = max(1, MAX_RAYS // disc.count)
        pieces = [np.empty((2, 0), np.float32)]
        for first in range(0, len(indices), most):
            piece = indices[first : first + most]
            capacity = min(most, max(1024, 1 << (len(piece) - 1).bit_length()))
            padded = np.zeros(capacity, np.uint32)
            padded[: len(piece)] = piece
            count = dr.opaque(uint, len(piece))
            values = AsyncArray(self._penumbrae(self._scene, self._parts, disc, points, uint(padded), count, capacity))
            yield
            pieces.append(values.wait().reshape(2, -1)[:, : len(piece)])
        visibility, shadow = np.concatenate(pieces, axis=1)
        return visibility, shadow.astype(np.uint8)


def _trace_centres(
    distortion: Sequence[float], scene: mt.Scene, parts: "PartTable", view: KernelCamera, sun: mt.Vector3f, disc: Disc
) -> tuple[Float, UInt32, "_Points"]:
    """(labels that are numbers, one after another; labels that are bytes, packed; surface points)."""
    mi = backend.mitsuba()
    pixel = dr.arange(mi.UInt32, view.width * view.height)
    ray, before = view.rays(pixel, mi.Point2f(0.5), distortion)
    surface: mt.SurfaceInteraction3f = scene.ray_intersect(ray)
    hit = surface.is_valid()
    normal = dr.select(dr.dot(surface.n, ray.d) > 0, -surface.n, surface.n)
    cosine = dr.select(hit, dr.dot(normal, sun), 0.0)
    object_id, part_id = parts.ids(surface, hit)
    distance = dr.select(hit, (before + surface.t) * view.metre, 0.0)
    numbers: list[Float | mt.Vector3f] = [
        distance * dr.dot(ray.d, view.forward),
        distance,
        cosine,
        dr.select(hit, normal, 0.0),
        parts.albedo(surface, part_id, hit),
    ]
    points = _Points(surface.p + OFFSET * normal, normal, object_id)
    dr.eval(numbers, part_id, points)  # in one kernel
    faces_sun = cosine > 0
    visibility, classes = _sun_visibility(scene, parts, disc, points, faces_sun)
    shadow: Any = dr.select(hit, dr.select(faces_sun, classes, SHADOW_ATTACHED), SHADOW_NONE)
    flat: list[Any] = [dr.ravel(values) for values in (*numbers, visibility)]
    return dr.concat(flat), object_id | (part_id << 8) | (shadow << 16), points


def _trace_penumbrae(
    scene: mt.Scene,
    parts: "PartTable",
    disc: Disc,
    points: "_Points",
    indices: UInt32,
    count: UInt32,
    capacity: int,
) -> Float:
    """Visibility, then shadow classes, of the points `indices` [capacity]; those from `count` on are not asked."""
    mi = backend.mitsuba()
    origin, normal = (
        mi.Vector3f(*(dr.gather(mi.Float, x, indices) for x in vector)) for vector in (points.origin, points.normal)
    )
    chosen = _Points(origin, normal, dr.gather(mi.UInt32, points.object_id, indices))
    visibility, shadow = _sun_visibility(scene, parts, disc, chosen, dr.arange(mi.UInt32, capacity) < count)
    return dr.concat([visibility, mi.Float(shadow)])


def _sun_visibility(
    scene: mt.Scene, parts: "PartTable", disc: Disc, points: "_Points", active: Bool
) -> tuple[Float, UInt32]:
    """(visibility, shadow classes), [N], of points; 0 and a cast shadow where not `active`."""
    mi = backend.mitsuba()
    free, hidden, hit = disc.seen(scene, points.origin, points.normal, active)
    blocker, _ = parts.ids(hit, hidden)
    order = disc.count - dr.arange(mi.UInt32, dr.width(free)) % disc.count  # the first that is hidden says by what
    share, by = dr.select(free, mi.Float(1.0), 0.0), dr.select(hidden, (order << 8) | blocker, 0)
    dr.eval(share, by)  # one kernel
    visibility = dr.block_sum(share, disc.count, mode="evaluated") / disc.count
    blocker = dr.block_reduce(dr.ReduceOp.Max, by, disc.count, mode="evaluated") & 255
    cast = SHADOW_SELF_CAST + dr.select((blocker == 0) | (blocker == points.object_id), 0, blocker)
    return visibility, dr.select(visibility < 0.5, cast, SHADOW_LIT)


def _dilate(pixels: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Indices [M] of `pixels` [N] of an image (row by row) and of the eight next to each."""
    row, column = (pixels[:, None] // shape[1], pixels[:, None] % shape[1])
    down, right = (step.ravel() - 1 for step in np.indices((3, 3)))
    return np.unique(np.clip(row + down, 0, shape[0] - 1) * shape[1] + np.clip(column + right, 0, shape[1] - 1))


@dataclass(frozen=True)
class _Points:
    """Surface points: where their shadow rays start, their normals on the camera's side [3, N], and object ids [N]."""

    origin: mt.Vector3f
    normal: mt.Vector3f
    object_id: UInt32


@dataclass(frozen=True)
class PartTable:
    """Labels of parts; inputs of kernels. Faces are counted over all shapes, parts from 1, 0 where there is none."""

    first_face: UInt32  #: [S] of each shape, indexed by the number that Dr.Jit knows it by
    parts: UInt32  #: [F] number of each face's part
    objects: UInt32  #: [P + 1] number of each part's object, from 1
    albedos: Float  #: [3 (P + 1)] mean linear camera RGB of each part
    textured: Bool | None  #: [P + 1] whose albedo varies over them, None where no part's does

    @classmethod
    def of(cls, scene: Scene, loaded: MitsubaScene) -> "PartTable":
        mi = backend.mitsuba()
        shapes = {int(_numbers(mi.ShapePtr(shape))[0]): shape.id() for shape in loaded.labelled.shapes()}
        first_face, parts = np.zeros(max(shapes) + 1, np.uint32), list[np.ndarray]()
        for number, name in shapes.items():
            first_face[number] = sum(map(len, parts))
            parts.append(loaded.parts_of[name])
        size = len(scene.parts) + 1
        objects, albedos, textured = np.zeros(size, np.uint32), np.zeros((size, 3), np.float32), np.zeros(size, bool)
        for placed in scene.parts:
            index, material = placed.part_id, placed.part.material
            objects[index] = placed.object_id
            albedos[index], textured[index] = material.albedo, _has_color_image(material.bsdf)
        varied = upload(textured, mi.Bool) if textured.any() else None
        faces = upload(np.concatenate(parts), mi.UInt32)
        return cls(upload(first_face, mi.UInt32), faces, upload(objects, mi.UInt32), upload(albedos), varied)

    def ids(self, hit: mt.SurfaceInteraction3f | mt.PreliminaryIntersection3f, active: Bool) -> tuple[UInt32, UInt32]:
        """(object id, part id) of what rays met, 0 where not `active`."""
        mi = backend.mitsuba()
        first = dr.gather(mi.UInt32, self.first_face, _numbers(hit.shape), active)
        part = dr.gather(mi.UInt32, self.parts, first + hit.prim_index, active)
        return dr.gather(mi.UInt32, self.objects, part, active), part

    def albedo(self, surface: mt.SurfaceInteraction3f, part_id: UInt32, active: Bool) -> mt.Color3f:
        """RGB where rays met parts, 0 where not `active`."""
        mi = backend.mitsuba()
        albedo = dr.gather(mi.Color3f, self.albedos, part_id, active)
        if self.textured is None:
            return albedo
        varied = dr.gather(mi.Bool, self.textured, part_id, active)
        return dr.select(varied, surface.bsdf().eval_diffuse_reflectance(surface, varied), albedo)


def _numbers(shapes: mt.ShapePtr) -> UInt32:
    """By which Dr.Jit knows shapes."""
    return cast("UInt32", dr.reinterpret_array(backend.mitsuba().UInt32, shapes))


def _has_color_image(bsdf: JsonMapping) -> bool:
    """Conductors have no diffuse reflectance to look up."""
    if bsdf.get("type") in ("bitmap", "roughconductor", "conductor"):
        return bsdf["type"] == "bitmap" and not bsdf.get("raw", False)
    return any(_has_color_image(value) for value in bsdf.values() if isinstance(value, Mapping))


def _images(numbers: np.ndarray, ids: np.ndarray, camera: Camera) -> dict[str, np.ndarray]:
    """Labels as [H, W] or [H, W, 3], float32 or uint8, from what `_trace_centres` returns."""
    shape = camera.height, camera.width
    planes = np.split(numbers.reshape(-1, camera.height * camera.width), [1, 2, 3, 6, 9])
    names = "depth", "distance", "sun_cosine", "normal", "albedo", "sun_visibility"
    labels = {
        name: plane.reshape(shape if len(plane) == 1 else (*shape, 3))
        for name, plane in zip(names, planes, strict=True)
    }
    packed = ids.view(np.uint8).reshape(*shape, 4)
    return {**labels, **{name: packed[..., i].copy() for i, name in enumerate(("object_id", "part_id", "shadow"))}}
