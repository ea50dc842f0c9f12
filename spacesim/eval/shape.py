"""Pictures of both surfaces, the true one and a run's, coloured by their distance from each other.

EVAL/geometry/truth_*.png, reconstruction_*.png   the same views of both;  reconstruction.ply   the run's surface
"""

from pathlib import Path

import numpy as np

from spacesim.data.geometry import Array, look_at, normalize
from spacesim.data.images import write_png
from spacesim.data.mesh import SignedDistance, write_mesh
from spacesim.data.records import Camera
from spacesim.eval.metrics.exterior import ExteriorView
from spacesim.eval.metrics.geometry import Mesh, ShapeResult

WIDTH, HEIGHT = 400, 300  #: of the pictures, pixels
FILL = 0.94  #: of their width or height that the object takes
AWAY = 2.5  #: sizes of the object from its centre to the cameras
DIRECTIONS = ((1.0, 0.55, 0.5), (-0.8, -1.0, 0.35), (0.35, -0.5, -1.0))  #: from the object to the cameras
SCALE = 2.0  #: named distances at the far end of the colours
BACKGROUND = (18, 20, 25)
COLORS = ((216, 222, 230), (247, 204, 92), (226, 92, 36), (150, 24, 60), (60, 8, 66))
"""sRGB, from no distance to `SCALE`: from light to dark, for colour-blind readers and grey prints, too."""


def write_shapes(folder: Path, result: ShapeResult) -> None:
    """Write the pictures of both surfaces, and the run's mesh, into `folder`; nothing where there is no comparison."""
    if result.comparison is None or result.truth is None or result.predicted is None:
        return
    predicted = result.predicted.vertices, result.predicted.faces
    scale = SCALE * result.comparison.values["precision_recall"]["distance"]
    cameras = cameras_around_mesh(result.truth)
    for name, mesh, other in (("truth", result.truth, predicted), ("reconstruction", predicted, result.truth)):
        sight, distance = ExteriorView(*mesh), SignedDistance(*other)
        for index, camera in enumerate(cameras):
            write_png(folder / f"{name}_{index}.png", draw_distances(mesh, sight, distance, camera, scale))
    write_mesh(folder / "reconstruction.ply", *predicted)


def cameras_around_mesh(mesh: Mesh) -> list[Camera]:
    """Views from `DIRECTIONS` that a mesh fills."""
    corners = mesh[0][np.unique(mesh[1])]
    low, high = corners.min(axis=0), corners.max(axis=0)
    centre, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    cameras = []
    for direction in DIRECTIONS:
        pose = look_at(centre + AWAY * size * normalize(direction), centre)
        seen = (corners - pose[:3, 3]) @ pose[:3, :3]
        seen = seen[:, :2] / seen[:, 2:]
        middle, extent = 0.5 * (seen.max(axis=0) + seen.min(axis=0)), np.ptp(seen, axis=0)
        focal = FILL * float(np.min(np.array([WIDTH, HEIGHT]) / np.maximum(extent, 1e-9)))
        cx, cy = 0.5 * np.array([WIDTH, HEIGHT]) - focal * middle
        cameras.append(Camera(pose, WIDTH, HEIGHT, focal, focal, float(cx), float(cy)))
    return cameras


def draw_distances(mesh: Mesh, sight: ExteriorView, other: SignedDistance, camera: Camera, scale: float) -> np.ndarray:
    """[H, W, 3] uint8: a mesh, lit from the camera, in the colours of its distance from another, to `scale` metres."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], axis=-1).reshape(-1, 3)
    rays = rays @ camera.world_from_camera[:3, :3].T
    start = np.broadcast_to(camera.position, rays.shape)
    reach, face = sight.first_hit(start, rays)
    hit = np.isfinite(reach)
    image = np.empty((len(rays), 3), np.uint8)
    image[:] = BACKGROUND
    if hit.any():
        points = start[hit] + reach[hit, None] * rays[hit]
        vertices, faces = mesh
        a, b, c = np.moveaxis(vertices[faces[face[hit]]], 1, 0)
        across = np.cross(b - a, c - a)
        facing = np.abs(np.einsum("nc,nc->n", across, rays[hit]))
        facing /= np.maximum(np.linalg.norm(across, axis=1) * np.linalg.norm(rays[hit], axis=1), 1e-300)
        shade = (0.45 + 0.55 * facing)[:, None]
        image[hit] = np.rint(shade * colors(other.unsigned(points) / scale)).astype(np.uint8)
    return image.reshape(camera.height, camera.width, 3)


def colors(values: np.ndarray) -> Array:
    """[..., 3] sRGB bytes (as floats) of values in [0, 1]."""
    stops = np.linspace(0, 1, len(COLORS))
    channels = [np.interp(values, stops, channel) for channel in np.array(COLORS, np.float64).T]
    return np.stack(channels, axis=-1)
