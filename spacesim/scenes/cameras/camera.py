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

FOV_DEG = 30.0
"""Of cameras that say nothing else, degrees."""

MIN_FOV, MAX_FOV = 1e-3, 120.0
"""Degrees."""

EXPOSURES = (1e-12, 1e12)
"""Least and greatest exposure."""


@dataclass(frozen=True)
class CameraConfig:
    """A camera. Raises InputError for a value out of range."""

    resolution: tuple[int, int] = (256, 256)  #: (width, height), pixels
    fov_deg: float = FOV_DEG  #: angle that the width covers without distortion
    focal: tuple[float, float] | None = None  #: (fx, fy) pixels, in place of `fov_deg`
    principal: tuple[float, float] | None = None  #: (cx, cy) pixels from the upper left corner; None: the middle
    distortion: tuple[float, ...] = ()  #: Brown-Conrady k1, k2, p1, p2, k3 in OpenCV's order, () none
    exposure: float = EXPOSURE  #: display value of a radiance of 1 W m^-2 sr^-1
    tone: str = "srgb"  #: curve of the 8-bit image, "srgb" or "filmic"
    white_balance: str = "sun"  #: sunlight is white ("sun") or has its colour under a white of D65 ("d65")
    sensor: SensorConfig | None = None  #: noise and limits of a real one, None for none

    def __post_init__(self) -> None:
        width, height = self.resolution
        expect(min(width, height) >= 8, "resolution", "at least 8 pixels", min(width, height))
        check_size(width, height, "resolution")
        self._check_lens()
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

    def _check_lens(self) -> None:
        """Raise InputError where focal lengths and principal point are those of no picture."""
        angles = f"an angle from {MIN_FOV:g} to {MAX_FOV:g} degrees"
        expect(MIN_FOV <= self.fov_deg <= MAX_FOV, "fov_deg", angles, self.fov_deg)
        if self.focal is not None:
            if self.fov_deg != FOV_DEG:
                raise InputError(f"focal: expected alone, found fov_deg {self.fov_deg:g} beside it")
            positive = all(math.isfinite(length) and length > 0 for length in self.focal)
            expect(positive, "focal", "positive numbers of pixels", list(self.focal))
        if self.principal is not None:
            within = all(0 < place < side for place, side in zip(self.principal, self.resolution, strict=True))
            expect(within, "principal", f"a point within {self.resolution} pixels", list(self.principal))
        if self.focal is not None:
            for low, high in self._sides:
                across = math.degrees(math.atan(high) - math.atan(low))
                if not MIN_FOV <= across <= MAX_FOV:
                    raise InputError(f"focal: expected {angles} across the image, found {across:g} by {self.focal}")

    @property
    def focal_lengths(self) -> tuple[float, float]:
        """fx and fy, pixels."""
        if self.focal is not None:
            return self.focal
        length = 0.5 * self.resolution[0] / math.tan(0.5 * math.radians(self.fov_deg))
        return length, length

    @property
    def _centre(self) -> tuple[float, float]:
        """cx and cy, pixels."""
        return self.principal or (0.5 * self.resolution[0], 0.5 * self.resolution[1])

    @property
    def _sides(self) -> list[tuple[float, float]]:
        """Tangents, without distortion, of the angles from the axis to the left and right, upper and lower border."""
        lenses = zip(self._centre, self.focal_lengths, self.resolution, strict=True)
        return [(-c / f, (side - c) / f) for c, f, side in lenses]

    @property
    def nearest_border(self) -> float:
        """How far the nearest border is from the axis, 1 where this is in the middle, 0 where it is at the border."""
        return min(2 * min(-low, high) / (high - low) for low, high in self._sides)

    @property
    def half_tangents(self) -> tuple[float, float]:
        """Tangents of half the angles that the width and the height cover, without distortion; where the axis is not in
        the middle, of the angles to the nearer borders."""
        if self.focal is None and self.principal is None:
            width, height = self.resolution
            half = math.tan(0.5 * math.radians(self.fov_deg))
            return half, half * height / width
        across, down = (min(-low, high) for low, high in self._sides)
        return across, down

    @property
    def smallest_fov(self) -> float:
        """Radians that the shorter side of the image covers, without distortion; where the axis is not in the middle,
        twice those to the nearest border."""
        width, height = self.resolution
        if self.focal is None and self.principal is None and width <= height:
            return math.radians(self.fov_deg)
        return 2 * math.atan(min(self.half_tangents))

    def at(self, world_from_camera: Array) -> Camera:
        """The pinhole camera at a pose [4, 4]."""
        width, height = self.resolution
        if self.focal is None and self.principal is None:
            return Camera.from_fov(world_from_camera, width, height, self.fov_deg)
        return Camera(world_from_camera, width, height, *self.focal_lengths, *self._centre)

    def _first_fold(self) -> float:
        """Pixels from the optical axis to the nearest of its points that no ray, or more than one, reaches; infinity
        where there is none.

        Rays are followed from there outwards: the map is one-to-one up to where the determinant of its derivative
        is no longer positive. The inverse that pictures are rendered with must find its way back, too.
        """
        low, high = np.array(self._sides).T
        across, down = low[:, None] + (high - low)[:, None] * np.linspace(0, 1, 33)
        rows = [np.stack([across, np.full(33, end)]) for end in (low[1], high[1])]
        columns = [np.stack([np.full(33, end), down]) for end in (low[0], high[0])]
        border = np.concatenate([*rows, *columns], axis=1)  # [2, 132], twice the corners
        lines = border[:, :, None] * np.linspace(0, 4, 257)[1:]
        with np.errstate(all="ignore"):
            turned = ~(_determinant(lines, self.distortion) > 0)
            first = np.take_along_axis(lines, turned.argmax(axis=1)[None, :, None], axis=2)[..., 0]
            images = np.array(distort_points(first[0], first[1], self.distortion))
            inside = turned.any(axis=1) & ((images >= low[:, None]) & (images <= high[:, None])).all(axis=0)
            points = lines[:, :, :64]
            x, y = undistort_points(points[0], points[1], self.distortion)
            back = np.array(distort_points(x, y, self.distortion))
            missed = ~(np.hypot(*(back - points)) <= 1e-6)
        folds = np.concatenate([np.hypot(*images)[inside], np.hypot(*points)[missed]])
        return float(np.min(folds, initial=math.inf)) * self.focal_lengths[0]


def _determinant(points: Array, distortion: tuple[float, ...]) -> Array:
    """[...] of the derivative of `distort_points` at points [2, ...], by central differences."""
    x, y = points
    h = 1e-5
    du = (np.array(distort_points(x + h, y, distortion)) - distort_points(x - h, y, distortion)) / (2 * h)
    dv = (np.array(distort_points(x, y + h, distortion)) - distort_points(x, y - h, distortion)) / (2 * h)
    return du[0] * dv[1] - du[1] * dv[0]
