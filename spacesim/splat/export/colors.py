"""Colours of a mesh's vertices, from pictures of the run whose surface it is."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from spacesim.data.geometry import Array
from spacesim.data.images.color import srgb_from_linear
from spacesim.data.mesh import vertex_normals
from spacesim.data.records import Camera
from spacesim.learning.prediction import MaterialView, Prediction
from spacesim.splat.export.mesh import RunMesh, select_views

NEAR = 2.0  #: voxels: what lies deeper than the surface that a pixel shows is hidden in it
OPAQUE = 0.5  #: alpha from which on a picture's colour counts
POWER = 4  #: of the cosine between normal and view, by which views are weighted: pictures taken head-on are sharp


def color_vertices(
    mesh: RunMesh,
    cameras: Sequence[Camera],
    depth: Callable[[Camera], np.ndarray],
    predict: Callable[[Camera], Prediction],
    most: int,
    progress: Callable[[int, int], None] | None = None,
    channels: int = 3,
) -> Array:
    """[V, C] values of the pictures' `channels`, sRGB values: the mean of what they show at each vertex that they see,
    weighted by how squarely they see it; vertices that none sees take the colour of the nearest one that has one, black
    where there is none.

    depth: [H, W] metres along a camera's axis, 0 where it sees no surface;  predict: the run's picture from a
    camera;  most: views used;  progress: called with the views done and all of them
    """
    normals = vertex_normals(mesh.vertices, mesh.faces)
    total, weights = np.zeros((len(mesh.vertices), channels)), np.zeros(len(mesh.vertices))
    views = select_views(cameras, most)
    for done, camera in enumerate(views):
        if progress:
            progress(done, len(views))
        pose = camera.world_from_camera
        seen = (mesh.vertices - pose[:3, 3]) @ pose[:3, :3]
        cosine = -np.einsum("vi,vi->v", normals, mesh.vertices - pose[:3, 3]) / np.linalg.norm(seen, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            column = camera.fx * seen[:, 0] / seen[:, 2] + camera.cx
            row = camera.fy * seen[:, 1] / seen[:, 2] + camera.cy
            inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        chosen = np.flatnonzero(inside & (seen[:, 2] > 0) & (cosine > 0))
        column, row = column[chosen], row[chosen]
        surface = depth(camera)[row.astype(int), column.astype(int)]
        near = (surface > 0) & (seen[chosen, 2] < surface + NEAR * mesh.voxel)
        chosen, places = chosen[near], np.stack([row[near] - 0.5, column[near] - 0.5])
        shown = predict(camera)
        planes = [*np.moveaxis(shown.rgb, -1, 0), shown.alpha]
        *color, cover = (map_coordinates(plane, places, order=1, mode="nearest") for plane in planes)
        opaque = cover >= OPAQUE
        chosen, weight = chosen[opaque], cosine[chosen[opaque]] ** POWER
        total[chosen] += (weight / cover[opaque])[:, None] * np.stack(color, axis=1)[opaque]
        weights[chosen] += weight
    if progress:
        progress(len(views), len(views))
    known = weights > 0
    colors = np.divide(total, weights[:, None], out=total, where=known[:, None])
    if known.any() and not known.all():
        colors[~known] = colors[known][cKDTree(mesh.vertices[known]).query(mesh.vertices[~known])[1]]
    return np.clip(colors, 0, 1)


def color_of_material(view: MaterialView) -> Prediction:
    """Materials as a picture of five channels for `color_vertices`, weighted by alpha: albedo as sRGB values,
    roughness, metallic."""
    straight = np.dstack([srgb_from_linear(view.albedo), view.roughness, view.metallic])
    return Prediction(straight * view.alpha[..., None], view.alpha, np.zeros_like(view.alpha), None)
