"""The camera that every frame is taken with: its lens, its exposure, and what becomes of the light."""

import math
from dataclasses import dataclass

from spacesim.data.errors import expect
from spacesim.data.geometry import Array
from spacesim.data.records import MOST_PIXELS, Camera
from spacesim.scenes.sensor import TONES, SensorConfig
from spacesim.scenes.sun import EXPOSURE

WHITE_BALANCES = ("sun", "d65")


@dataclass(frozen=True)
class CameraConfig:
    """A camera. Raises InputError for a value out of range.

    resolution: (width, height), pixels; fov_deg: angle that the width covers; distortion: Brown-Conrady k1, k2, p1, p2, k3
    in OpenCV's order, () none; exposure: display value of a radiance of 1 W m^-2 sr^-1; tone: curve of the 8-bit image,
    "srgb" or "filmic"; white_balance: sunlight is white ("sun") or has its colour under a white of D65 ("d65"); sensor:
    noise and limits of a real one, None for none.
    """

    resolution: tuple[int, int] = (256, 256)
    fov_deg: float = 30.0
    distortion: tuple[float, ...] = ()
    exposure: float = EXPOSURE
    tone: str = "srgb"
    white_balance: str = "sun"
    sensor: SensorConfig | None = None

    def __post_init__(self) -> None:
        width, height = self.resolution
        expect(min(width, height) >= 8, "resolution", "at least 8 pixels", min(width, height))
        expect(width * height <= MOST_PIXELS, "resolution", f"at most {MOST_PIXELS} pixels", f"{width}x{height}")
        expect(0 < self.fov_deg <= 120, "fov_deg", "an angle up to 120 degrees", self.fov_deg)
        expect(len(self.distortion) in (0, 5), "distortion", "k1, k2, p1, p2, k3", list(self.distortion))
        expect(all(map(math.isfinite, self.distortion)), "distortion", "finite numbers", list(self.distortion))
        expect(0 < self.exposure < math.inf, "exposure", "a number above 0", self.exposure)
        expect(self.tone in TONES, "tone", f"one of {', '.join(TONES)}", self.tone)
        expect(self.white_balance in WHITE_BALANCES, "white_balance", " or ".join(WHITE_BALANCES), self.white_balance)

    @property
    def smallest_fov(self) -> float:
        """Radians that the shorter side of the image covers."""
        width, height = self.resolution
        return 2 * math.atan(math.tan(math.radians(self.fov_deg) / 2) * min(1.0, height / width))

    def at(self, world_from_camera: Array) -> Camera:
        """The pinhole camera at a pose [4, 4]."""
        return Camera.from_fov(world_from_camera, *self.resolution, self.fov_deg)
