"""What the tables of a scene file may say (docs/reference/composed-scenes.md), each checked by itself."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from spacesim.data.earth import Earth
from spacesim.data.errors import InputError
from spacesim.data.geometry import OPENCV_FROM_OPENGL, Array, look_at
from spacesim.data.records import Camera, Sun, check_size
from spacesim.splat.compose.path import FPS, MAX_FRAMES, CameraView, Orbit
from spacesim.splat.compose.pose import Pose, rotation_about
from spacesim.splat.compose.scene import ComposeConfig

FPS_RANGE = (1e-3, 1e3)  #: pictures a second

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Matrix = tuple[Quaternion, Quaternion, Quaternion, Quaternion]


@dataclass(frozen=True)
class PoseEntry:
    """What a table says of a pose; None where it says nothing."""

    position: Vector | None = None  #: of the model's origin, metres
    rotation_wxyz: Quaternion | None = None  #: quaternion, of any length
    axis: Vector | None = None  #: of a turn by `angle_deg`, of any length
    angle_deg: float | None = None  #: degrees about `axis`
    scale: float | None = None  #: factor on the model's size

    def __post_init__(self) -> None:
        if (self.axis is None) != (self.angle_deg is None):
            have, miss = ("axis", "angle_deg") if self.angle_deg is None else ("angle_deg", "axis")
            raise InputError(f"{have}: expected with {miss}, found without")
        if self.axis is not None and self.rotation_wxyz is not None:
            raise InputError("axis: expected alone, found rotation_wxyz beside it")
        self.pose(Pose())

    def pose(self, base: Pose) -> Pose:
        """`base` with what is said. Raises InputError that begins with the key."""
        rotation = base.quaternion if self.rotation_wxyz is None else np.array(self.rotation_wxyz)
        if self.axis is not None and self.angle_deg is not None:
            rotation = rotation_about(self.axis, self.angle_deg)
        position = base.translation if self.position is None else self.position
        return Pose(rotation, np.array(position), base.scale if self.scale is None else self.scale)


@dataclass(frozen=True)
class ModelEntry(PoseEntry):
    """A table of [[models]]."""

    run: str = ""  #: the run's folder, relative to the file
    name: str = ""  #: unlike the others'; "": the folder's


@dataclass(frozen=True)
class SunEntry:
    """A direction towards the Sun: two angles, degrees, or a vector of any length."""

    azimuth_deg: float | None = None  #: degrees about +z, from +x
    elevation_deg: float | None = None  #: degrees over the xy plane
    direction: Vector | None = None  #: [3] towards the Sun, of any length, in place of the angles

    def __post_init__(self) -> None:
        angles = {"azimuth_deg": self.azimuth_deg, "elevation_deg": self.elevation_deg}
        for key, value in angles.items():
            if (value is None) == (self.direction is None):
                given = "none" if value is None else "direction beside it"
                raise InputError(f"{key}: expected azimuth_deg and elevation_deg, or direction alone, found {given}")
        if self.elevation_deg is not None and not abs(self.elevation_deg) <= 90:
            raise InputError(f"elevation_deg: expected -90 to 90 degrees, found {self.elevation_deg}")
        if self.direction is not None and not any(self.direction):
            raise InputError("direction: expected a direction, found 0, 0, 0")

    @property
    def sun(self) -> Sun:
        """The record."""
        if self.azimuth_deg is not None and self.elevation_deg is not None:
            return Sun.from_angles(self.azimuth_deg, self.elevation_deg)
        return Sun(np.array(self.direction))


@dataclass(frozen=True)
class EarthEntry(SunEntry):
    """Where the Earth is, as `SunEntry` says it of the Sun, and what it is like; None: as the scene's own, else as
    `Earth` has it."""

    angular_radius_deg: float | None = None  #: degrees, see `Earth`
    albedo: float | None = None  #: see `Earth`

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            self.earth()
        except InputError as error:
            raise InputError(str(error).removeprefix("earth_")) from None

    def earth(self, base: Earth | None = None) -> Earth:
        """`base`, the scene's own, with what is said. Raises InputError that begins with the key."""
        direction = self.sun.direction
        own = base or Earth(direction)
        radius, albedo = self.angular_radius_deg, self.albedo
        return Earth(
            direction, own.angular_radius_deg if radius is None else radius, own.albedo if albedo is None else albedo
        )


@dataclass(frozen=True)
class ViewEntry:
    """Where a camera stands."""

    position: Vector | None = None  #: metres
    look_at: Vector | None = None  #: metres: the point in the picture's middle
    up: Vector = (0.0, 0.0, 1.0)  #: a direction that the picture has upwards, beside `look_at`
    transform_matrix: Matrix | None = None  #: camera to world, OpenGL axes, metres
    fov_deg: float | None = None  #: degrees across the width
    focal: tuple[float, float] | None = None  #: (fx, fy) pixels, in place of `fov_deg`

    def __post_init__(self) -> None:
        if (self.position is None) != (self.look_at is None):
            have, miss = ("position", "look_at") if self.look_at is None else ("look_at", "position")
            raise InputError(f"{have}: expected with {miss}, found without")
        if self.position is not None and self.transform_matrix is not None:
            raise InputError("position: expected alone, found transform_matrix beside it")
        if self.position is not None and self.position == self.look_at:
            raise InputError("look_at: expected another point than position, found the same")
        if not any(self.up):
            raise InputError("up: expected a direction, found 0, 0, 0")
        if self.fov_deg is not None and not 0 < self.fov_deg < 180:
            raise InputError(f"fov_deg: expected above 0 and below 180 degrees, found {self.fov_deg}")
        if self.focal is not None and min(self.focal) <= 0:
            raise InputError(f"focal: expected positive numbers of pixels, found {list(self.focal)}")
        if self.focal is not None and self.fov_deg is not None:
            raise InputError("focal: expected alone, found fov_deg beside it")
        try:
            if (place := self.place) is not None:
                Camera(place, 1, 1, 1.0, 1.0, 0.5, 0.5)
        except InputError as error:
            raise InputError(f"transform_matrix: {str(error).partition(': ')[2]}") from None
        except ValueError:
            raise InputError("position: expected a place that looks at another, found numbers beyond that") from None

    @property
    def place(self) -> Array | None:
        """world_from_camera [4, 4], OpenCV axes."""
        if self.position is not None and self.look_at is not None:
            return look_at(self.position, self.look_at, self.up)
        return None if self.transform_matrix is None else np.array(self.transform_matrix) @ OPENCV_FROM_OPENGL

    def view(self, width: int) -> CameraView | None:
        """For an image so many pixels wide; None where no place is named."""
        focal = self.focal
        if self.fov_deg is not None:
            length = float(0.5 * width / np.tan(0.5 * np.radians(self.fov_deg)))
            focal = length, length
        if self.position is not None and self.look_at is not None:
            return CameraView.towards(np.array(self.position), np.array(self.look_at), self.up, focal)
        return None if self.place is None else CameraView(self.place, None, focal)


@dataclass(frozen=True)
class CameraEntry(ViewEntry):
    """[camera]: a view and an image; or a camera's file; or a frame of a dataset; or an orbit."""

    resolution: tuple[int, int] | None = None  #: (width, height) pixels
    principal: tuple[float, float] | None = None  #: (cx, cy) pixels; None: the middle
    file: str | None = None  #: a camera's file, relative to this one
    data: str | None = None  #: folder of a dataset, relative to the file
    frame: int = 0  #: number of a frame of `data`, training frames first
    orbit: Orbit | None = None  #: on which the camera flies

    def __post_init__(self) -> None:
        super().__post_init__()
        places = {
            "position": self.position,
            "transform_matrix": self.transform_matrix,
            "file": self.file,
            "data": self.data,
            "orbit": self.orbit,
        }
        named = [key for key, value in places.items() if value is not None]
        if len(named) > 1:
            raise InputError(f"{named[1]}: expected one of {', '.join(places)}, found {named[0]} beside it")
        if self.resolution is not None and min(self.resolution) < 1:
            raise InputError(f"resolution: expected at least 1 pixel a side, found {list(self.resolution)}")
        if self.resolution is not None:
            check_size(*self.resolution, "resolution")
        if self.file is not None or self.data is not None:
            for key in ("resolution", "principal", "fov_deg", "focal"):
                if getattr(self, key) is not None:
                    raise InputError(f"{key}: expected none beside {named[0]}, which says it, found one")


@dataclass(frozen=True)
class KeyframeEntry:
    """A table of [[keyframes]]."""

    time: float  #: seconds
    sun: SunEntry | None = None  #: None: not named here
    earth: EarthEntry | None = None  #: None: not named here
    camera: ViewEntry | None = None  #: None: not named here
    models: Mapping[str, PoseEntry] = field(default_factory=dict)  #: poses by the models' names


@dataclass(frozen=True)
class SceneEntry:
    """The whole file."""

    models: tuple[ModelEntry, ...]  #: in the order that object numbers count
    sun: SunEntry | None = None  #: None: from keyframes or the caller
    earth: EarthEntry | None = None  #: None: no light of the Earth
    camera: CameraEntry | None = None  #: None: from the caller
    shadows: str = ComposeConfig.shadows  #: of models on each other, see `ComposeConfig`
    frames: int | None = None  #: pictures; None: up to the last keyframe, 120 of an orbit, else 1
    fps: float = FPS  #: pictures a second
    keyframes: tuple[KeyframeEntry, ...] = ()  #: of camera, Sun, Earth and models

    def __post_init__(self) -> None:
        if not self.models:
            raise InputError("models: expected at least one, found none")
        if self.frames is not None and not 1 <= self.frames <= MAX_FRAMES:
            raise InputError(f"frames: expected 1 to {MAX_FRAMES}, found {self.frames}")
        if not FPS_RANGE[0] <= self.fps <= FPS_RANGE[1]:
            least, most = FPS_RANGE
            raise InputError(f"fps: expected {least:g} to {most:g} pictures a second, found {self.fps}")
        ComposeConfig(self.shadows)
