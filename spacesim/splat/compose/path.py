"""What changes with time in a scene: keyframes of poses, Sun, Earth and camera, what is between them, and orbits."""

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from spacesim.data.earth import Earth
from spacesim.data.errors import InputError
from spacesim.data.geometry import Array, direction_from_angles, look_at, normalize
from spacesim.data.records import Camera, Sun
from spacesim.splat.compose.pose import Pose, interpolate_rotation, slerp

FPS = 24.0  #: pictures a second where nothing is said
ORBIT_FRAMES = 120  #: of an orbit where nothing is said: five seconds
MAX_FRAMES = 100_000

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class CameraView:
    """Where a camera stands, and what it looks at."""

    world_from_camera: Array  #: [4, 4] OpenCV axes, metres
    #: [3] metres, a point that stays in the middle on the way to another view that has one, or None
    target: Array | None = None
    focal: tuple[float, float] | None = None  #: (fx, fy) pixels, or None for those of the scene's camera
    #: [3], a direction that the target's picture has upwards
    up: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    @staticmethod
    def towards(
        position: Array,
        target: Array,
        up: ArrayLike = (0.0, 0.0, 1.0),
        focal: tuple[float, float] | None = None,
    ) -> "CameraView":
        """From a position on a target, [3] metres each."""
        up = np.asarray(up, np.float64)
        return CameraView(look_at(position, target, up), np.asarray(target, np.float64), focal, up)

    def focused(self, camera: Camera) -> "CameraView":
        """With `camera`'s focal lengths where it names none."""
        return self if self.focal else replace(self, focal=(camera.fx, camera.fy))

    def of(self, camera: Camera) -> Camera:
        """`camera` at this place."""
        fx, fy = self.focal or (camera.fx, camera.fy)
        return replace(camera, world_from_camera=self.world_from_camera, fx=fx, fy=fy)


@dataclass(frozen=True, eq=False)
class Keyframe:
    """What is where at a time, seconds; what it does not name goes on as the keyframes around say."""

    time: float  #: seconds
    sun: Sun | None = None  #: None: not named here
    view: CameraView | None = None  #: where the camera stands; None: not named here
    poses: Mapping[str, Pose] = field(default_factory=dict)  #: by the names of models
    earth: Earth | None = None  #: None: that of `sun`, or not named here

    def __post_init__(self) -> None:
        if self.sun is not None and self.earth is None:
            object.__setattr__(self, "earth", self.sun.earth)


@dataclass(frozen=True)
class Orbit:
    """A camera that goes round and looks at the middle."""

    radius: float  #: metres, of the sphere
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)  #: metres
    elevation_deg: float = 20.0  #: where it starts, seen from the centre
    azimuth_deg: float = 0.0  #: where it starts, seen from the centre
    turns: float = 1.0  #: rounds in all, negative ones clockwise seen from +z

    def __post_init__(self) -> None:
        if not 0 < self.radius < np.inf:
            raise InputError(f"radius: expected a positive number of metres, found {self.radius}")
        if not abs(self.elevation_deg) <= 90:
            raise InputError(f"elevation_deg: expected -90 to 90 degrees, found {self.elevation_deg}")

    def view(self, share: float) -> CameraView:
        """After a share of the way, 0 to 1."""
        direction = direction_from_angles(self.azimuth_deg + 360 * self.turns * share, self.elevation_deg)
        centre = np.array(self.centre)
        return CameraView.towards(centre + self.radius * direction, centre)


@dataclass(frozen=True, eq=False)
class KeyframeTrack(Generic[T]):
    """Values at rising times, seconds; before the first and after the last the value stays."""

    times: Sequence[float]  #: seconds, rising
    values: Sequence[T]  #: one for each time
    blend: Callable[[T, T, float], T]  #: (value before, value after, share of the way from 0 to 1) -> the value between

    def at(self, time: float) -> T:
        """The value at a time; at a keyframe's own exactly what it says."""
        after = bisect_right(self.times, time)
        if after == 0:
            return self.values[0]
        before = after - 1
        if after == len(self.times) or time == self.times[before]:
            return self.values[before]
        share = (time - self.times[before]) / (self.times[after] - self.times[before])
        return self.blend(self.values[before], self.values[after], share)


def interpolate_sun(first: Sun, second: Sun, share: float) -> Sun:
    """On the great circle from one to the other."""
    return Sun(slerp(first.direction, second.direction, share))


def interpolate_earth(first: Earth, second: Earth, share: float) -> Earth:
    """Its direction on the great circle from one to the other, its angular radius and albedo along a line."""
    radius, albedo = (
        (1 - share) * getattr(first, name) + share * getattr(second, name) for name in ("angular_radius_deg", "albedo")
    )
    return Earth(slerp(first.direction, second.direction, share), radius, albedo)


def interpolate_view(first: CameraView, second: CameraView, share: float) -> CameraView:
    """Position along a line; the target, where both have one, too, and what is up on the great circle, else the camera
    turns by the shortest way; focal lengths by even factors, where both name them."""
    position = _line(first.world_from_camera[:3, 3], second.world_from_camera[:3, 3], share)
    focal = first.focal
    if first.focal is not None and second.focal is not None:
        focal = tuple(a ** (1 - share) * b**share for a, b in zip(first.focal, second.focal, strict=True))
    if first.target is not None and second.target is not None:
        target = _line(first.target, second.target, share)
        up = slerp(normalize(first.up), normalize(second.up), share)
        if np.linalg.norm(target - position) > 0:
            return CameraView.towards(position, target, up, focal)
    pose = np.eye(4)
    pose[:3, :3] = interpolate_rotation(first.world_from_camera[:3, :3], second.world_from_camera[:3, :3], share)
    pose[:3, 3] = position
    return CameraView(pose, None, focal)


def _line(first: Array, second: Array, share: float) -> Array:
    return (1 - share) * first + share * second
