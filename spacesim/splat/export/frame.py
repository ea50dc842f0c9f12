"""The frame of an exported file, and models moved into it."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.geometry import Array, quaternion_from_rotation
from spacesim.data.mesh import UPRIGHT
from spacesim.splat.compose.pose import MAX_SCALE, MIN_SCALE
from spacesim.splat.harmonics import rotate_harmonics
from spacesim.splat.raster.gaussians import Gaussians

Up = Literal["z", "y", "-y"]  #: the keys of UPRIGHT
OUTLIERS = 0.005  #: share of the points, at each end of each axis, that does not decide where the middle is


@dataclass(frozen=True)
class FileFrame:
    """How a file's frame lies to the dataset's: the model is moved, then scaled, then turned."""

    up: Up = "z"  #: axis of the file that +z of the dataset becomes; x stays
    scale: float = 1.0  #: units of the file a metre
    recentre: bool = False  #: the middle of the model becomes the origin

    def __post_init__(self) -> None:
        if not MIN_SCALE <= self.scale <= MAX_SCALE:
            raise InputError(f"scale: expected a number from {MIN_SCALE:g} to {MAX_SCALE:g}, found {self.scale:g}")
        if self.up not in UPRIGHT:
            raise InputError(f"up: expected {', '.join(UPRIGHT)}, found {self.up!r}")

    @property
    def rotation(self) -> Array:
        """[3, 3], file from dataset."""
        return np.array(UPRIGHT[self.up], np.float64)

    def sized(self, points: Array) -> Array:
        """Points [N, 3] of a model, moved and scaled, not yet turned."""
        origin = middle(points) if self.recentre and len(points) else np.zeros(3)
        return self.scale * (np.asarray(points, np.float64) - origin)

    def placed(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians in the frame, colours turned with them; to the bit the same where nothing moves them."""
        if self == FileFrame():
            return gaussians
        arrays = gaussians.to_numpy()
        moved = {
            "means": self.sized(arrays["means"]) @ self.rotation.T,
            "log_scales": arrays["log_scales"].astype(np.float64) + np.log(self.scale),
            "quaternions": _product(quaternion_from_rotation(self.rotation), arrays["quaternions"]),
            "sh": rotate_harmonics(arrays["sh"], self.rotation),
        }
        return Gaussians.from_numpy(arrays | moved)


def middle(points: Array) -> Array:
    """[3]: the middle of the box around points [N, 3], without the few that are far out."""
    low, high = np.quantile(np.asarray(points, np.float64), (OUTLIERS, 1 - OUTLIERS), axis=0)
    return np.asarray(0.5 * (low + high))


def unit_quaternions(quaternions: np.ndarray) -> np.ndarray:
    """[N, 4] float64 (w, x, y, z) of length 1; those without a direction turn nothing, as they are drawn."""
    values = np.asarray(quaternions, np.float64)
    length = np.linalg.norm(values, axis=1, keepdims=True)
    return np.where((length > 1e-12) & (length < 1e12), values / np.maximum(length, 1e-12), [1.0, 0.0, 0.0, 0.0])


def _product(left: Array, right: np.ndarray) -> Array:
    """[N, 4], the rotations `right` [N, 4] followed by `left` [4]; lengths stay."""
    (w, x, y, z), (a, b, c, d) = left, np.asarray(right, np.float64).T
    parts = [
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    ]
    return np.stack(parts, axis=1)
