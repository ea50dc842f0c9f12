"""Where a dataset's training cameras look, and from how far."""

import numpy as np

from spacesim.data.geometry import focus_of
from spacesim.data.records import Dataset


def farthest_camera(dataset: Dataset, center: np.ndarray) -> float:
    """Metres from `center` [3] to the farthest training camera (dist_max of thesis 4.5)."""
    return float(max(np.linalg.norm(frame.camera.position - center) for frame in dataset.train))


def nearest_camera(dataset: Dataset, center: np.ndarray) -> float:
    """Metres from `center` [3] to the nearest training camera."""
    return float(min(np.linalg.norm(frame.camera.position - center) for frame in dataset.train))


def focus_point(dataset: Dataset) -> np.ndarray:
    """[3] the point nearest to all optical axes, in the least-squares sense."""
    return focus_of(np.array([frame.camera.world_from_camera for frame in dataset.train]))
