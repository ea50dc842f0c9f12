"""Depth and normals of a mesh as a camera sees it, to supervise training where the shape is known."""

from pathlib import Path

import drjit as dr
import numpy as np

from spacesim import backend
from spacesim.backend import mitsuba_types as mt
from spacesim.data.errors import InputError
from spacesim.data.mesh import SignedDistance, drawable_faces, read_mesh
from spacesim.data.records import Camera, Dataset


class MeshPrior:
    """One ray through each pixel's centre, as labels of our own data have it."""

    def __init__(self, path: Path) -> None:
        """Of a mesh file in the world's axes, metres. Raises InputError where it holds none."""
        vertices, faces = read_mesh(path)
        single = vertices.astype(np.float32)
        faces = drawable_faces(single.astype(np.float64), faces)
        if len(faces) == 0:
            raise InputError(f"{path}: expected a mesh with faces of some area in single precision, found none")
        mi = backend.mitsuba()
        mesh = mi.Mesh("prior", len(vertices), len(faces))
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = single.ravel()
        parameters["faces"] = faces.astype(np.uint32).ravel()
        parameters.update()
        self._scene: mt.Scene = mi.load_dict({"type": "scene", "mesh": mesh})

    @staticmethod
    def of(dataset: Dataset) -> "MeshPrior":
        """Of a dataset's mesh. Raises InputError where it has none, or one that is not where its pictures show it."""
        path = dataset.root / known_mesh(dataset, "prior mesh")
        check_outside(SignedDistance.of(path), dataset, "prior mesh")
        prior = MeshPrior(path)
        if dataset.train and not any(prior(frame.camera)[0].any() for frame in dataset.train):
            raise InputError(f"{path}: prior mesh expects a mesh that training cameras see, found one that none sees")
        return prior

    def __call__(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """(depth [H, W] along the optical axis, metres; normal [H, W, 3], unit, world axes, towards the camera); 0
        where the ray meets nothing."""
        mi = backend.mitsuba()
        column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        rays = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones_like(row)], axis=-1)
        world = rays.reshape(-1, 3) @ camera.world_from_camera[:3, :3].T
        length = np.linalg.norm(world, axis=1)
        origin = mi.Point3f(*camera.position.tolist())
        direction = mi.Vector3f(np.ascontiguousarray((world / length[:, None]).T, np.float32))
        hits = self._scene.ray_intersect(mi.Ray3f(origin, direction))
        hit = hits.is_valid()
        normal = dr.select(dr.dot(hits.n, direction) > 0, -hits.n, hits.n)
        depth = np.where(np.array(hit), np.array(hits.t) / length, 0).astype(np.float32)
        normals = np.array(dr.select(hit, normal, 0), np.float32).T
        shape = camera.height, camera.width
        return depth.reshape(shape), np.ascontiguousarray(normals).reshape(*shape, 3)


def known_mesh(dataset: Dataset, option: str) -> str:
    """The path of a dataset's mesh below its root. Raises InputError, in the name of the option, where it has none."""
    if dataset.mesh_path is None:
        raise InputError(f"{dataset.root}: {option} expects a mesh.ply, found none")
    return dataset.mesh_path


def check_outside(surface: SignedDistance, dataset: Dataset, option: str) -> None:
    """Raises InputError, in the name of the option, where all training cameras are inside the dataset's mesh."""
    positions = np.array([frame.camera.position for frame in dataset.train])
    if len(positions) and surface.inside(positions).all():
        raise InputError(
            f"{dataset.root}: {option} expects a mesh in the place and unit of the poses, found all training cameras "
            "inside of it"
        )
