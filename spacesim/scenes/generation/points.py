"""Points on the surface that training starts from."""

import numpy as np
import trimesh

from spacesim.data.geometry import Array
from spacesim.data.images import srgb_from_linear
from spacesim.scenes.render import Renderer


def sample_surface_points(renderer: Renderer, count: int, seed: int) -> tuple[Array, np.ndarray]:
    """`count` points even over the surface that space can see: positions [count, 3] in metres and colours
    [count, 3], the albedo as 8-bit sRGB."""
    scene = renderer.scene
    sizes = [len(placed.mesh.faces) for placed in scene.parts]
    albedo = np.repeat([placed.part.material.albedo for placed in scene.parts], sizes, axis=0)
    points, faces = np.empty((0, 3)), np.empty(0, np.int64)
    while len(points) < count:
        sampled, face = trimesh.sample.sample_surface(scene.mesh, 2 * count, seed=seed + len(points))
        exposed = renderer.exposed(sampled, scene.mesh.face_normals[face])
        points, faces = np.concatenate([points, sampled[exposed]]), np.concatenate([faces, face[exposed]])
    colors = np.round(255 * srgb_from_linear(albedo[faces[:count]])).astype(np.uint8)
    return points[:count], colors
