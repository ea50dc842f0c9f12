"""Silhouettes of objects as if each were alone, by one ray through the centre of each pixel."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from spacesim import backend
from spacesim.backend import mitsuba_types as mt
from spacesim.backend.upload import upload
from spacesim.data.errors import InputError
from spacesim.data.exporters import LabelledObject, Silhouette
from spacesim.data.exporters.masks import bounding_box
from spacesim.data.geometry import Array
from spacesim.data.mesh import drawable_faces
from spacesim.data.records import Camera


def silhouette_finder(targets: Sequence[LabelledObject]) -> Callable[[Camera], list[Silhouette]]:
    """What finds the silhouettes of `targets` in a pinhole camera. An object that reaches beyond the image is looked
    for one image's width and height further on each side, as the BOP toolkit does."""
    alone = [(_load(target), target) for target in targets]

    def find(camera: Camera) -> list[Silhouette]:
        return [_silhouette(scene, target, camera) for scene, target in alone]

    return find


def _load(target: LabelledObject) -> mt.Scene:
    placed = target.vertices @ target.world_from_object[:3, :3].T + target.world_from_object[:3, 3]
    world = placed.astype(np.float32)
    faces = drawable_faces(world.astype(np.float64), target.faces)
    if len(faces) == 0:
        raise InputError(f"object {target.id}: expected a mesh with an area, found none in single precision")
    mi = backend.mitsuba()
    mesh = mi.Mesh("target", len(world), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = upload(world)
    parameters["faces"] = upload(faces, mi.UInt32)
    parameters.update()
    return mi.load_dict({"type": "scene", "mesh": mesh})


def _silhouette(scene: mt.Scene, target: LabelledObject, camera: Camera) -> Silhouette:
    width, height = camera.width, camera.height
    if _is_within(target, camera):
        mask = _hits(scene, camera)
        return Silhouette(mask, int(mask.sum()), bounding_box(mask))
    wide = replace(camera, width=3 * width, height=3 * height, cx=camera.cx + width, cy=camera.cy + height)
    hits = _hits(scene, wide)
    mask = hits[height : 2 * height, width : 2 * width]
    return Silhouette(mask, int(hits.sum()), bounding_box(hits, (-width, -height)))


def _is_within(target: LabelledObject, camera: Camera) -> bool:
    """All vertices are in front of the camera and in its image."""
    pose = target.camera_from_object(camera)
    points: Array = target.vertices @ pose[:3, :3].T + pose[:3, 3]
    if points[:, 2].min() <= 0:
        return False
    pixels = points[:, :2] / points[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return bool((pixels.min(axis=0) >= 0).all() and (pixels.max(axis=0) <= (camera.width, camera.height)).all())


def _hits(scene: mt.Scene, camera: Camera) -> np.ndarray:
    """[H, W] bool: which pixels' centres show the object."""
    mi = backend.mitsuba()
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))])
    rays = camera.world_from_camera[:3, :3] @ rays.reshape(3, -1)
    direction = mi.Vector3f(np.ascontiguousarray(rays / np.linalg.norm(rays, axis=0), np.float32))
    hit = scene.ray_test(mi.Ray3f(mi.Point3f(camera.position.tolist()), direction))
    return hit.numpy().reshape(camera.height, camera.width)
