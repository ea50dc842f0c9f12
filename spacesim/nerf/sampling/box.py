"""The box that a radiance field fills: its collider, and the unit in which it counts lengths."""

from dataclasses import dataclass

import numpy as np

from spacesim.data.geometry import Array
from spacesim.data.mesh import read_mesh, read_points
from spacesim.data.records import Dataset
from spacesim.learning.cameras import focus_point, nearest_camera

OUTLIERS = 1e-3  #: share of the points, at each end of each axis, that does not decide how large the box is


@dataclass(frozen=True, eq=False)
class SceneBox:
    """An axis-aligned box. A field works in its coordinates: from its lowest corner, in units of its longest side."""

    low: Array  #: [3] metres, world
    size: Array  #: [3] metres

    @property
    def side(self) -> float:
        """Metres: the longest side, the field's unit of length."""
        return float(self.size.max())

    @property
    def extent(self) -> Array:
        """[3] the box's sides in its own unit, at most 1."""
        return self.size / self.side

    def to_unit(self, points: Array) -> Array:
        """[..., 3] metres, world, to the box's coordinates."""
        return (points - self.low) / self.side


def pixels_across(box: SceneBox, dataset: Dataset) -> float:
    """How many pixels the box's longest side has in training pictures, seen from the side; their median."""
    centre = box.low + 0.5 * box.size
    away = [float(np.linalg.norm(frame.camera.position - centre)) for frame in dataset.train]
    pixels = [frame.camera.fx * box.side / max(metres, 1e-9) for frame, metres in zip(dataset.train, away, strict=True)]
    return float(np.median(pixels))


def scene_box(dataset: Dataset, margin: float) -> SceneBox:
    """Around the dataset's mesh, else its points, wider by `margin` times its longest side on each; else a cube about
    the point that the cameras look at, as wide as the nearest of them is far."""
    if dataset.mesh_path is not None and (dataset.root / dataset.mesh_path).exists():
        vertices, faces = read_mesh(dataset.root / dataset.mesh_path)
        corners = vertices[np.unique(faces)]
        low, high = corners.min(axis=0), corners.max(axis=0)
    elif dataset.ply_file_path is not None:
        points = read_points(dataset.root / dataset.ply_file_path)[0].astype(np.float64)
        low, high = np.quantile(points, (OUTLIERS, 1 - OUTLIERS), axis=0)
    else:
        centre = focus_point(dataset)
        half = 0.5 * nearest_camera(dataset, centre)
        return SceneBox(centre - half, np.full(3, 2 * half))
    reach = margin * max(float((high - low).max()), 1e-6)
    return SceneBox(low - reach, np.maximum(high - low + 2 * reach, 1e-6))
