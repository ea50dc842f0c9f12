"""The camera that every frame is taken with: its lens, its exposure, and what becomes of the light."""

import math
from dataclasses import dataclass

import numpy as np

from spacesim.data.errors import InputError, expect
from spacesim.data.geometry import Array
from spacesim.data.images import distort_points, undistort_points
from spacesim.data.images.tone import TONES
from spacesim.data.records import Camera, check_size
from spacesim.scenes.cameras.sensor import SensorConfig
from spacesim.scenes.lights.sun import EXPOSURE
from spacesim.scenes.materials.spectra import WHITE_BALANCES

MIN_FOV = 1e-3
"""Degrees."""

EXPOSURES = (1e-12, 1e12)
"""Least and greatest exposure."""


@dataclass(frozen=True)
class CameraConfig:
    """A camera. Raises InputError for a value out of range."""

    resolution: tuple[int, int] = (256, 256)  #: (width, height), pixels
    fov_deg: float = 30.0  #: angle that the width covers without distortion
    distortion: tuple[float, ...] = ()  #: Brown-Conrady k1, k2, p1, p2, k3 in OpenCV's order, () none
    exposure: float = EXPOSURE  #: display value of a radiance of 1 W m^-2 sr^-1
    tone: str = "srgb"  #: curve of the 8-bit image, "srgb" or "filmic"
    white_balance: str = "sun"  #: sunlight is white ("sun") or has its colour under a white of D65 ("d65")
    sensor: SensorConfig | None = None  #: noise and limits of a real one, None for none

    def __post_init__(self) -> None:
        width, height = self.resolution
        expect(min(width, height) >= 8, "resolution", "at least 8 pixels", min(width, height))
        check_size(width, height, "resolution")
        fits = MIN_FOV <= self.fov_deg <= 120
        expect(fits, "fov_deg", f"an angle from {MIN_FOV:g} to 120 degrees", self.fov_deg)
        expect(len(self.distortion) in (0, 5), "distortion", "k1, k2, p1, p2, k3", list(self.distortion))
        expect(all(map(math.isfinite, self.distortion)), "distortion", "finite numbers", list(self.distortion))
        least, most = EXPOSURES
        expect(least <= self.exposure <= most, "exposure", f"a number from {least:g} to {most:g}", self.exposure)
        expect(self.tone in TONES, "tone", f"one of {', '.join(TONES)}", self.tone)
        expect(self.white_balance in WHITE_BALANCES, "white_balance", " or ".join(WHITE_BALANCES), self.white_balance)

        if any(self.distortion):
            folds = self._first_fold()
            limit = 0.5 * math.hypot(width, height)
            lens = f"one that folds {folds:.0f} of {limit:.0f} pixels from its centre"
            if math.isfinite(folds):
                raise InputError(f"distortion: expected a lens that is one-to-one over the image, found {lens}")

    @property
    def half_tangents(self) -> tuple[float, float]:
        """Tangents of half the angles that the width and the height cover, without distortion."""
        width, height = self.resolution
        half = math.tan(0.5 * math.radians(self.fov_deg))
        return half, half * height / width

    @property
    def smallest_fov(self) -> float:
        """Radians that the shorter side of the image covers, without distortion."""
        width, height = self.resolution
        return math.radians(self.fov_deg) if width <= height else 2 * math.atan(self.half_tangents[1])

    def at(self, world_from_camera: Array) -> Camera:
        """The pinhole camera at a pose [4, 4]."""
        return Camera.from_fov(world_from_camera, *self.resolution, self.fov_deg)

    def _first_fold(self) -> float:
        """Pixels from the image's centre to the nearest of its points that no ray, or more than one, reaches; infinity
        where there is none.

        Rays are followed from the centre outwards: the map is one-to-one up to where the determinant of its derivative
        is no longer positive. The inverse that pictures are rendered with must find its way back, too.
        """
        u, v = self.half_tangents
        side = np.linspace(-1, 1, 33)
        border = np.concatenate([[[s, e], [e, s]] for s in side for e in (-1.0, 1.0)]).T  # [2, 132], twice the corners
        lines = border[:, :, None] * np.linspace(0, 4, 257)[1:] * np.array([u, v])[:, None, None]
        with np.errstate(all="ignore"):
            turned = ~(_determinant(lines, self.distortion) > 0)
            first = np.take_along_axis(lines, turned.argmax(axis=1)[None, :, None], axis=2)[..., 0]
            images = np.array(distort_points(first[0], first[1], self.distortion))
            inside = turned.any(axis=1) & (np.abs(images) <= np.array([[u], [v]])).all(axis=0)
            points = lines[:, :, :64]
            x, y = undistort_points(points[0], points[1], self.distortion)
            back = np.array(distort_points(x, y, self.distortion))
            missed = ~(np.hypot(*(back - points)) <= 1e-6)
        folds = np.concatenate([np.hypot(*images)[inside], np.hypot(*points)[missed]])
        return float(np.min(folds, initial=math.inf)) * 0.5 * self.resolution[0] / u


def _determinant(points: Array, distortion: tuple[float, ...]) -> Array:
    """[...] of the derivative of `distort_points` at points [2, ...], by central differences."""
    x, y = points
    h = 1e-5
    du = (np.array(distort_points(x + h, y, distortion)) - distort_points(x - h, y, distortion)) / (2 * h)
    dv = (np.array(distort_points(x, y + h, distortion)) - distort_points(x, y - h, distortion)) / (2 * h)
    return du[0] * dv[1] - du[1] * dv[0]
