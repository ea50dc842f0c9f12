"""Pictures of a lens: where it images a direction (Brown-Conrady), and resampling to a pinhole camera."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.records import Camera

BLIND = 0.1  #: share of a picture: a lens that images less of it can hardly be right

_SAMPLES, _STEPS = 33, 257  # of each side of a picture, and along a radius

Coordinate = Any  #: numbers, or arrays of numpy or of Dr.Jit, of one shape


class Resampling:
    """Pictures resampled to another camera's pixels. inside: [H, W] bool of the new one, where the old one has any.

    columns, rows: [H, W] where each new pixel lies in the old picture, 0 at the centre of its first pixel
    """

    def __init__(self, columns: np.ndarray, rows: np.ndarray, inside: np.ndarray) -> None:
        self._columns, self._rows, self.inside = columns, rows, inside

    def linear(self, picture: np.ndarray) -> np.ndarray:
        """`picture` [H, W] or [H, W, C] resampled bilinearly, float32; 0 outside."""
        from scipy.ndimage import map_coordinates  # a quarter of a second, that most who read pictures need not wait

        if picture.ndim == 3:
            return np.stack([self.linear(picture[..., k]) for k in range(picture.shape[2])], axis=-1)
        places = [self._rows, self._columns]
        sampled = map_coordinates(picture, places, output=np.float32, order=1, mode="nearest")
        return np.where(self.inside, sampled, np.float32(0))

    def nearest(self, labels: np.ndarray) -> np.ndarray:
        """The nearest pixels' values of `labels` [H, W] or [H, W, C], none averaged, of the same type; 0 outside."""
        height, width = labels.shape[:2]
        rows = np.rint(np.where(self.inside, self._rows, 0)).astype(np.intp).clip(0, height - 1)
        columns = np.rint(np.where(self.inside, self._columns, 0)).astype(np.intp).clip(0, width - 1)
        inside = self.inside if labels.ndim == 2 else self.inside[..., None]
        return np.where(inside, labels[rows, columns], np.zeros((), labels.dtype))


class Undistortion(Resampling):
    """Pictures of a lens, resampled to what the pinhole `camera` sees. inside: where the lens sees it.

    distortion: see `distort_points`.
    """

    def __init__(self, camera: Camera, distortion: tuple[float, ...]) -> None:
        x = (np.arange(camera.width) + 0.5 - camera.cx)[None, :] / camera.fx
        y = (np.arange(camera.height) + 0.5 - camera.cy)[:, None] / camera.fy
        u, v = distort_points(x, y, distortion)
        columns, rows = u * camera.fx + camera.cx - 0.5, v * camera.fy + camera.cy - 0.5
        inside = (columns >= -0.5) & (columns <= camera.width - 0.5)
        inside &= (rows >= -0.5) & (rows <= camera.height - 0.5)
        k1, k2, _, _, k3 = distortion
        r2 = x * x + y * y
        inside &= 1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * 7 * k3)) > 0  # past this the model folds back on itself
        super().__init__(columns, rows, inside)


def check_lens(camera: Camera, distortion: tuple[float, ...]) -> None:
    """Raise InputError for a lens that folds back on itself over nearly all of the picture: no ray reaches what lies
    beyond. distortion: see `distort_points`; () none"""
    if not any(distortion):
        return
    numbers = camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
    share = _share_before_fold(*numbers, distortion)
    if share < BLIND:
        expected = f"expected a lens that images {100 * BLIND:g} % of the picture before it folds back on itself"
        found = f"k1, k2, p1, p2, k3 of {', '.join(f'{k:g}' for k in distortion)}"
        raise InputError(f"{expected}, found {100 * share:.2g} % with {found}")


@lru_cache(maxsize=64)
def _share_before_fold(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float, distortion: tuple[float, ...]
) -> float:
    """Of a picture, what is nearer to its principal point than where the lens folds, along a radius."""
    u = (np.linspace(0, width, _SAMPLES) - cx) / fx
    v = (np.linspace(0, height, _SAMPLES) - cy) / fy
    places = np.hypot(u, v[:, None])
    k1, k2, _, _, k3 = distortion
    with np.errstate(all="ignore"):
        images, _ = distort_points(np.linspace(0, places.max(), _STEPS), np.zeros(_STEPS), (k1, k2, 0.0, 0.0, k3))
        folds = ~(np.diff(images) > 0)
    return float((places < images[folds.argmax()]).mean()) if folds.any() else 1.0


def distort_points(
    x: Coordinate, y: Coordinate, distortion: Sequence[Coordinate] | Sequence[float]
) -> tuple[Coordinate, Coordinate]:
    """Where the lens images the direction (x, y, 1), on the plane at depth 1: any arrays, of numpy or of Dr.Jit.

    distortion: k1, k2, p1, p2, k3 of the Brown-Conrady model (D. C. Brown, "Close-range camera calibration",
    1971, in OpenCV's order).
    """
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


def undistort_points(
    u: Coordinate, v: Coordinate, distortion: Sequence[Coordinate] | Sequence[float], steps: int = 8
) -> tuple[Coordinate, Coordinate]:
    """The direction (x, y, 1) that the lens images at (u, v): the inverse of `distort_points`, by Newton's method.

    From (u, v) it goes straight to the solution, also near a fold: along a radius the map is concave for barrel
    distortion, convex for pincushion.
    """
    k1, k2, p1, p2, k3 = distortion
    x, y = u, v
    for _ in range(steps):
        r2 = x * x + y * y
        slope = k1 + r2 * (2 * k2 + r2 * 3 * k3)  # of the radial factor, over r^2
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        a = radial + 2 * slope * x * x + 2 * p1 * y + 6 * p2 * x  # the derivative, [[a, b], [b, d]]
        b = 2 * slope * x * y + 2 * p1 * x + 2 * p2 * y
        d = radial + 2 * slope * y * y + 6 * p1 * y + 2 * p2 * x
        at_x, at_y = distort_points(x, y, distortion)
        e, f, determinant = u - at_x, v - at_y, a * d - b * b
        x, y = x + (d * e - b * f) / determinant, y + (a * f - b * e) / determinant
    return x, y
