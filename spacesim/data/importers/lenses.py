"""COLMAP's camera models: where a lens images a direction, and what a pinhole camera sees of its pictures.

Parameters are those of https://colmap.github.io/cameras.html, in its order. (x, y, 1) is a direction in the axes of the
camera (OpenCV's).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.geometry import Array
from spacesim.data.images import Resampling, distort_points

_AZIMUTHS, _STEPS = 64, 2048  # rays and steps along each, on which a lens is followed outwards
_SMALL = 1e-12

Projection = Callable[[Array, Array, Sequence[float]], tuple[Array, Array]]
"""(x, y, parameters but focal lengths and principal point) of directions (x, y, 1) to where they are imaged."""


def _fisheye(x: Array, y: Array) -> tuple[Array, Array]:
    """On the equidistant picture: the angle to the optical axis is the distance from the centre."""
    r = np.hypot(x, y)
    scale = np.where(r > _SMALL, np.arctan(r) / np.maximum(r, _SMALL), 1.0)
    return x * scale, y * scale


def _pinhole(x: Array, y: Array, k: Sequence[float]) -> tuple[Array, Array]:
    return x, y


def _brown(x: Array, y: Array, k: Sequence[float]) -> tuple[Array, Array]:
    k1, k2, p1, p2 = (*k, 0.0, 0.0, 0.0)[:4]
    return distort_points(x, y, (k1, k2, p1, p2, 0.0))


def _rational(x: Array, y: Array, k: Sequence[float]) -> tuple[Array, Array]:
    k1, k2, p1, p2, k3, k4, k5, k6 = k
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    tangential_x, tangential_y = _tangential(x, y, p1, p2)
    return x * radial + tangential_x, y * radial + tangential_y


def _tangential(x: Array, y: Array, p1: float, p2: float) -> tuple[Array, Array]:
    r2 = x * x + y * y
    return 2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


def _radial_fisheye(x: Array, y: Array, k: Sequence[float]) -> tuple[Array, Array]:
    """J. Kannala, S. S. Brandt, "A generic camera model and calibration method", 2006, as OpenCV has it."""
    x, y = _fisheye(x, y)
    radial = _polynomial(x * x + y * y, k)
    return x * radial, y * radial


def _polynomial(t2: Array, k: Sequence[float]) -> Array:
    """1 + k[0] t2 + k[1] t2^2 + ..."""
    value = np.zeros_like(t2)
    for coefficient in reversed(k):
        value = t2 * (coefficient + value)
    return 1 + value


def _thin_prism_fisheye(x: Array, y: Array, k: Sequence[float]) -> tuple[Array, Array]:
    """J. Weng, P. Cohen, M. Herniou, "Camera calibration with distortion models", 1992, of equidistant pictures."""
    k1, k2, p1, p2, k3, k4, sx1, sy1 = k
    x, y = _fisheye(x, y)
    r2 = x * x + y * y
    radial = _polynomial(r2, (k1, k2, k3, k4))
    tangential_x, tangential_y = _tangential(x, y, p1, p2)
    return x * radial + tangential_x + sx1 * r2, y * radial + tangential_y + sy1 * r2


def _radial_tangential_prism(x: Array, y: Array, k: Sequence[float]) -> tuple[Array, Array]:
    """Fisheye624 of Project Aria: the tangential part and the prism's act on the radially distorted place."""
    *radial, p0, p1, s0, s1, s2, s3 = k
    x, y = _radial_fisheye(x, y, radial)
    r2 = x * x + y * y
    tangential_x, tangential_y = _tangential(x, y, p1, p0)
    return x + tangential_x + r2 * (s0 + r2 * s1), y + tangential_y + r2 * (s2 + r2 * s3)


def _field_of_view(x: Array, y: Array, k: Sequence[float]) -> tuple[Array, Array]:
    """F. Devernay, O. Faugeras, "Straight lines have to be straight", 2001."""
    (omega,) = k
    r, slope = np.hypot(x, y), 2 * np.tan(0.5 * omega)
    if abs(omega) < 1e-6:
        return x, y
    scale = np.where(r > _SMALL, np.arctan(r * slope) / (np.maximum(r, _SMALL) * omega), slope / omega)
    return x * scale, y * scale


def _division(x: Array, y: Array, k: Sequence[float]) -> tuple[Array, Array]:
    """A. Fitzgibbon, "Simultaneous linear estimation of multiple view geometry and lens distortion", 2001."""
    (k1,) = k
    scale = 2 / (1 + np.sqrt(1 - 4 * k1 * (x * x + y * y)))
    return x * scale, y * scale


def _unified(x: Array, y: Array, k: Sequence[float]) -> tuple[Array, Array]:
    """B. Khomutenko, G. Garcia, P. Martinet, "An enhanced unified camera model", 2016."""
    alpha, beta = k
    depth = alpha * np.sqrt(beta * (x * x + y * y) + 1) + 1 - alpha
    depth = np.where(depth > 0, depth, np.nan)
    return x / depth, y / depth


@dataclass(frozen=True)
class LensModel:
    """A camera model. Its parameters are the focal lengths, cx, cy and the others."""

    name: str  #: as COLMAP calls it
    focal_lengths: int  #: 1, or 2: fx, fy
    others: int  #: further parameters
    mapping: Projection  #: (x, y over z in camera axes, the other parameters) -> (u, v) before focal lengths and cx, cy


LENS_MODELS: dict[int, LensModel] = {
    0: LensModel("SIMPLE_PINHOLE", 1, 0, _pinhole),
    1: LensModel("PINHOLE", 2, 0, _pinhole),
    2: LensModel("SIMPLE_RADIAL", 1, 1, _brown),
    3: LensModel("RADIAL", 1, 2, _brown),
    4: LensModel("OPENCV", 2, 4, _brown),
    5: LensModel("OPENCV_FISHEYE", 2, 4, _radial_fisheye),
    6: LensModel("FULL_OPENCV", 2, 8, _rational),
    7: LensModel("FOV", 2, 1, _field_of_view),
    8: LensModel("SIMPLE_RADIAL_FISHEYE", 1, 1, _radial_fisheye),
    9: LensModel("RADIAL_FISHEYE", 1, 2, _radial_fisheye),
    10: LensModel("THIN_PRISM_FISHEYE", 2, 8, _thin_prism_fisheye),
    11: LensModel("RAD_TAN_THIN_PRISM_FISHEYE", 2, 12, _radial_tangential_prism),
    12: LensModel("SIMPLE_DIVISION", 1, 1, _division),
    13: LensModel("DIVISION", 2, 1, _division),
    14: LensModel("SIMPLE_FISHEYE", 1, 0, _radial_fisheye),
    15: LensModel("FISHEYE", 2, 0, _radial_fisheye),
    16: LensModel("EUCM", 2, 2, _unified),
}
"""By their numbers in COLMAP's binary files."""
NO_PINHOLE = {17: "EQUIRECTANGULAR"}  #: models that see all around, whose pictures no pinhole camera has


@dataclass(frozen=True)
class Lens:
    """A camera with its lens. Raises InputError for numbers that no camera has."""

    model: LensModel  #: how rays become pixels
    width: int  #: pixels
    height: int  #: pixels
    parameters: tuple[float, ...]  #: of the model, pixels where they are lengths

    def __post_init__(self) -> None:
        name, count = self.model.name, self.model.focal_lengths + 2 + self.model.others
        if len(self.parameters) != count or not np.isfinite(self.parameters).all():
            raise InputError(f"expected {count} finite parameters of {name}, found {self.parameters}")
        if self.width < 1 or self.height < 1 or self.fx <= 0 or self.fy <= 0:
            lengths = f"{self.width} x {self.height} and {self.fx:g}, {self.fy:g}"
            raise InputError(f"expected a size and focal lengths above 0, found {lengths}")

    @property
    def fx(self) -> float:
        """Pixels."""
        return self.parameters[0]

    @property
    def fy(self) -> float:
        """Pixels."""
        return self.parameters[self.model.focal_lengths - 1]

    @property
    def centre(self) -> tuple[float, float]:
        """The principal point, pixels."""
        cx, cy = self.parameters[self.model.focal_lengths :][:2]
        return cx, cy

    @property
    def others(self) -> tuple[float, ...]:
        """The parameters that say how the lens distorts."""
        return self.parameters[self.model.focal_lengths + 2 :]

    def scaled(self, width: int, height: int) -> "Lens":
        """The same lens before a picture of another size."""
        x, y = width / self.width, height / self.height
        (cx, cy), two = self.centre, self.model.focal_lengths == 2
        if x == y or two:
            focal: tuple[float, ...] = (self.fx * x, self.fy * y) if two else (self.fx * x,)
            return Lens(self.model, width, height, (*focal, cx * x, cy * y, *self.others))
        model = LensModel(self.model.name, 2, self.model.others, self.model.mapping)
        return Lens(model, width, height, (self.fx * x, self.fx * y, cx * x, cy * y, *self.others))

    def project(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Pixels of the directions (x, y, 1), any shape; NaN where the model has none."""
        with np.errstate(all="ignore"):
            u, v = self.model.mapping(np.asarray(x, np.float64), np.asarray(y, np.float64), self.others)
            return u * self.fx + self.centre[0], v * self.fy + self.centre[1]

    @property
    def distortion(self) -> tuple[float, ...] | None:
        """Brown-Conrady k1, k2, p1, p2, k3 where they say all, () for none at all, None where another model does."""
        if self.model.mapping is _pinhole or (self.model.mapping is _division and not any(self.others)):
            return ()
        if self.model.mapping is _brown:
            k1, k2, p1, p2 = (*self.others, 0.0, 0.0, 0.0)[:4]
            return (k1, k2, p1, p2, 0.0) if any(self.others) else ()
        if self.model.mapping is _rational and not any(self.others[5:]):
            return self.others[:5] if any(self.others) else ()
        return None

    @property
    def pinhole(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy of a pinhole camera that sees the middle of the picture as large as this one, pixels."""
        at_centre = 1.0
        if self.model.mapping is _field_of_view:
            at_centre = float(_field_of_view(np.zeros(1) + 1e-6, np.zeros(1), self.others)[0][0] / 1e-6)
        return (self.fx * at_centre, self.fy * at_centre, *self.centre)

    def undistortion(self) -> Resampling:
        """Resamples pictures to what the camera `pinhole` sees. What no part of the lens images is not inside, nor what
        lies farther out than where the model folds back on itself."""
        fx, fy, cx, cy = self.pinhole
        columns = (np.arange(self.width) + 0.5 - cx) / fx
        rows = (np.arange(self.height) + 0.5 - cy) / fy
        x, y = np.meshgrid(columns, rows)
        u, v = self.project(x, y)
        inside = (u >= 0) & (u <= self.width) & (v >= 0) & (v <= self.height)
        reach = self._reach(float(np.hypot(x, y).max()))
        if np.isfinite(reach):
            inside &= np.hypot(x, y) < reach
        return Resampling(np.where(inside, u - 0.5, 0), np.where(inside, v - 0.5, 0), inside)

    def _reach(self, farthest: float) -> float:
        """How far from the optical axis, at depth 1 and up to `farthest`, the picture goes on outwards along each of
        some rays."""
        radii = np.linspace(0, farthest, _STEPS + 1)
        angles = np.linspace(0, 2 * np.pi, _AZIMUTHS, endpoint=False)[:, None]
        u, v = self.project(radii * np.cos(angles), radii * np.sin(angles))
        distances = np.hypot((u - u[:, :1]) / self.fx, (v - v[:, :1]) / self.fy)
        with np.errstate(invalid="ignore"):
            stops = ~(np.diff(distances, axis=1) > 0)
        first = np.where(stops.any(axis=1), stops.argmax(axis=1), _STEPS)
        return float(radii[first.min()]) if first.min() < _STEPS else np.inf
