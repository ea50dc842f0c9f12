"""What a dataset is made of: frozen records with units in their fields' docs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from spacesim.data.earth import Earth
from spacesim.data.errors import InputError, check_type
from spacesim.data.files import JsonMapping
from spacesim.data.geometry import (
    OPENCV_FROM_OPENGL,
    Array,
    angles_from_direction,
    as_numbers,
    as_rotation,
    direction_from_angles,
    look_at,
    normalize,
)

MAX_PIXELS = 2**27  #: of a picture: 16,384 x 8,192
MAX_SIDE = 2**14  #: pixels of a picture's longer side: what H.264 encodes
MAX_FOCAL_LENGTH = 1e9  #: pixels
SUN_LENGTHS = 1e-15, 1e15  #: of a vector that names the Sun's direction: metres to it are 1.5e11
SUN_WORDS = f"3 finite numbers, the largest of {SUN_LENGTHS[0]:g} to {SUN_LENGTHS[1]:g}"


def check_size(width: int, height: int, name: str) -> None:
    """Raise InputError in the name of the key or option where a picture has more pixels than any is drawn with."""
    if width * height > MAX_PIXELS or max(width, height) > MAX_SIDE:
        limit = f"at most {MAX_PIXELS:,} pixels, {MAX_SIDE:,} a side"
        raise InputError(f"{name}: expected {limit}, found {width} x {height}")


def planes_repr(record: object, width: int, height: int) -> str:
    """The `repr` of a dataclass of planes: their size and which of them are there, not their numbers."""
    cls: Any = type(record)
    values = {field.name: getattr(record, field.name) for field in fields(cls)}
    names = [name for name, value in values.items() if not isinstance(value, int | str | None)]
    return f"{cls.__name__}({width} x {height} pixels: {', '.join(names)})"


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera. The centre of pixel (column i, row j) is at (i + 0.5, j + 0.5)."""

    #: [4, 4] float64, rigid, OpenCV axes (x right, y down, z forward), metres; of rounded numbers the nearest rotation
    world_from_camera: Array
    width: int  #: pixels
    height: int  #: pixels
    fx: float  #: focal lengths, pixels
    fy: float  #: focal lengths, pixels
    cx: float  #: principal point, pixels
    cy: float  #: principal point, pixels

    def __post_init__(self) -> None:
        pose = as_numbers(self.world_from_camera)
        if pose.shape != (4, 4) or not np.all(np.isfinite(pose)):
            found = "NaN or infinity" if pose.shape == (4, 4) else f"shape {pose.shape}"
            raise InputError(f"world_from_camera: expected a [4, 4] matrix of finite numbers, found {found}")
        rotation = as_rotation(pose[:3, :3])
        if rotation is None:
            raise InputError("world_from_camera: expected a rotation in its upper left [3, 3], found none")
        pose = pose.copy()
        pose[:3, :3] = rotation
        if not all(isinstance(side, int | np.integer) for side in (self.width, self.height)):
            raise InputError(f"camera: expected a whole number of pixels, found {self.width} x {self.height}")
        if self.width < 1 or self.height < 1:
            raise InputError(f"camera: expected a size of at least 1x1 pixels, found {self.width}x{self.height}")
        check_size(self.width, self.height, "camera")
        lengths, centre = as_numbers((self.fx, self.fy)), as_numbers((self.cx, self.cy))
        if lengths.shape != (2,) or not ((lengths >= 1 / MAX_FOCAL_LENGTH) & (lengths <= MAX_FOCAL_LENGTH)).all():
            limit = f"above 0, at most {MAX_FOCAL_LENGTH:g} pixels"
            raise InputError(f"camera: expected focal lengths {limit}, found {self.fx} and {self.fy}")
        if centre.shape != (2,) or not (np.abs(centre) <= MAX_FOCAL_LENGTH).all():
            raise InputError(f"camera: expected a principal point in pixels, found {self.cx}, {self.cy}")
        object.__setattr__(self, "world_from_camera", pose)

    @property
    def position(self) -> Array:
        """[3] camera centre in the world, metres."""
        return self.world_from_camera[:3, 3]

    @property
    def camera_from_world(self) -> Array:
        """[4, 4] inverse of `world_from_camera`."""
        inverse = np.eye(4)
        inverse[:3, :3] = self.world_from_camera[:3, :3].T
        inverse[:3, 3] = -inverse[:3, :3] @ self.position
        return inverse

    @property
    def opengl(self) -> Array:
        """[4, 4] camera-to-world with OpenGL axes, as Nerfstudio stores it."""
        return self.world_from_camera @ OPENCV_FROM_OPENGL

    def downscaled(self, times: int) -> "Camera":
        """The camera with one pixel for each whole `times` x `times` of its own; it sees what these see."""
        if times == 1:
            return self
        numbers = [number / times for number in (self.fx, self.fy, self.cx, self.cy)]
        return Camera(self.world_from_camera, self.width // times, self.height // times, *numbers)

    @staticmethod
    def from_fov(world_from_camera: Array, width: int, height: int, fov_x_deg: float) -> "Camera":
        """A camera with square pixels, a centred principal point and a horizontal field of view in degrees. Raises
        InputError for a size or a field of view that no camera has."""
        size, angle = as_numbers((width, height)), as_numbers(fov_x_deg)
        if size.shape != (2,) or not np.isfinite(size).all():
            raise InputError(f"camera: expected a size in pixels, found {width!r} x {height!r}")
        if angle.shape != () or not 0 < angle < 180:
            raise InputError(f"fov_x_deg: expected a number between 0 and 180 degrees, found {fov_x_deg!r:.60}")
        focal = 0.5 * width / np.tan(0.5 * np.radians(fov_x_deg))
        return Camera(world_from_camera, width, height, focal, focal, 0.5 * width, 0.5 * height)

    @staticmethod
    def look_at(
        position: "ArrayLike",
        target: "ArrayLike",
        width: int,
        height: int,
        fov_x_deg: float,
        up: "ArrayLike" = (0.0, 0.0, 1.0),
    ) -> "Camera":
        """A camera at `position` [3] that looks at `target` [3], metres, its picture upright towards `up`; see
        `from_fov`. Raises InputError where both are one place, too."""
        for name, place in (("position", position), ("target", target), ("up", up)):
            if as_numbers(place).shape != (3,) or not np.isfinite(as_numbers(place)).all():
                raise InputError(f"{name}: expected three finite numbers, found {place!r}")
        if not np.linalg.norm(np.subtract(target, position)) > 0:
            raise InputError(f"position: expected another place than the target, found {np.asarray(position).tolist()}")
        return Camera.from_fov(look_at(position, target, up), width, height, fov_x_deg)


def check_camera(camera: object) -> None:
    """Raise InputError for what is no `Camera`."""
    check_type(camera, Camera, "camera", "Camera.look_at gives")


@dataclass(frozen=True, eq=False)
class Sun:
    """The Sun as a direction, and the Earth that it lights."""

    direction: Array  #: [3] unit vector, world frame, from the scene towards the Sun
    earth: Earth | None = None  #: gives light, too; None: there is none

    def __post_init__(self) -> None:
        direction = as_numbers(self.direction)
        if direction.shape != (3,) or not SUN_LENGTHS[0] <= np.abs(direction).max() <= SUN_LENGTHS[1]:
            raise InputError(f"sun direction: expected {SUN_WORDS}, found {self.direction}")
        object.__setattr__(self, "direction", normalize(direction))

    @staticmethod
    def from_angles(azimuth_deg: float, elevation_deg: float) -> "Sun":
        """Azimuth from +x towards +y, elevation from the xy plane, degrees (thesis 4.1). Raises InputError for numbers
        that are not finite, and for an elevation beyond 90."""
        angles = as_numbers((azimuth_deg, elevation_deg))
        if angles.shape != (2,) or not (np.isfinite(angles[0]) and abs(angles[1]) <= 90):
            expected = "a finite azimuth and an elevation from -90 to 90 degrees"
            raise InputError(f"sun: expected {expected}, found {azimuth_deg!r} and {elevation_deg!r}")
        return Sun(direction_from_angles(*angles))

    @staticmethod
    def of(value: "Sun | Sequence[float] | None") -> "Sun | None":
        """A Sun as it is, or by (azimuth, elevation) in degrees, or by its direction [3]; None stays None. Raises
        InputError for other numbers."""
        if value is None or isinstance(value, Sun):
            return value
        numbers = as_numbers(value)
        if numbers.shape == (2,) and np.isfinite(numbers).all() and abs(numbers[1]) <= 90:
            return Sun.from_angles(float(numbers[0]), float(numbers[1]))
        if numbers.shape != (3,):
            raise InputError(f"sun: expected (azimuth, elevation up to 90) in degrees or a direction, found {value}")
        return Sun(numbers)

    @property
    def angles(self) -> tuple[float, float]:
        """(azimuth in [0, 360), elevation in [-90, 90]), degrees."""
        return angles_from_direction(self.direction)

    @property
    def visible_share(self) -> float:
        """Of its disc, past the Earth that it names, see `Earth.visible_sun`."""
        return 1.0 if self.earth is None else self.earth.visible_sun(self.direction)

    @property
    def is_hidden(self) -> bool:
        """Whether its centre is behind the Earth that it names."""
        earth = self.earth
        return earth is not None and float(self.direction @ earth.direction) > np.cos(
            np.radians(earth.angular_radius_deg)
        )


@dataclass(frozen=True, eq=False)
class Truth:
    """What the path tracer knows of a frame. All [H, W] or [H, W, 3] float32 unless said otherwise.

    Label fields come from the ray through the pixel's centre; they are 0 where it meets no surface.
    """

    radiance: np.ndarray  #: [H, W, 3] linear, W m^-2 sr^-1 a channel, pixel-filtered, background 0
    alpha: np.ndarray  #: [H, W] coverage in [0, 1], pixel-filtered
    depth: np.ndarray  #: [H, W] along the optical axis, metres
    distance: np.ndarray  #: [H, W] along the ray, metres
    normal: np.ndarray  #: [H, W, 3] unit, world frame, towards the viewer's side
    albedo: np.ndarray  #: [H, W, 3] diffuse or specular reflectance, linear
    object_id: np.ndarray  #: [H, W] uint8, 1 for the first object, 0 none
    part_id: np.ndarray  #: [H, W] uint8, 1 for the first part of the scene, 0 none
    sun_visibility: np.ndarray  #: [H, W] fraction of the solar disc seen, 0 where the surface faces away
    sun_cosine: np.ndarray  #: [H, W] n . s
    shadow: np.ndarray  #: [H, W] uint8: 0 no surface, 85 faces away, 170 cast by itself, 170 + k by object k, 255 lit
    radiance_earth: np.ndarray | None = None  #: [H, W, 3] the Earth's part of `radiance`, where there is an Earth
    radiance_background: np.ndarray | None = None  #: [H, W, 3] of what was drawn behind the objects, as if alone

    def __repr__(self) -> str:
        return planes_repr(self, self.alpha.shape[1], self.alpha.shape[0])


@dataclass(frozen=True, eq=False)
class Frame:
    """One view. Paths are relative to the dataset's root; truth that is not there is None."""

    file_path: str  #: the image
    camera: Camera  #: of the image without its distortion
    sun: Sun | None = None  #: None where it is not known
    gt_path: str | None = None  #: EXR of all that `Truth` has
    shadow_path: str | None = None  #: PNG of shadow classes, see `Truth.shadow`
    silhouette_path: str | None = None  #: PNG, 255 where an object is
    id_path: str | None = None  #: PNG, 1 for the first object, 0 none
    depth_file_path: str | None = None  #: depth along the optical axis, as Nerfstudio has it
    mask_path: str | None = None  #: 0 = ignore this pixel
    time: float | None = None  #: when it was taken, in any unit: pictures of one film
    distortion: tuple[float, ...] = ()  #: Brown-Conrady k1, k2, p1, p2, k3 of the stored image; () for none
    exposure: float | None = None  #: of a picture of `generate` that has its own; None: that of scene.json
    #: world_from_object [4, 4], by number, of objects that stand elsewhere than scene.json says
    objects: Mapping[int, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Dataset:
    """A folder of frames: `root` and what transforms.json says."""

    root: Path  #: the folder
    train: tuple[Frame, ...]  #: for training
    test: tuple[Frame, ...]  #: for evaluation
    ply_file_path: str | None = None  #: points to start from
    mesh_path: str | None = None  #: the ground-truth mesh, world frame, metres
    scene: JsonMapping = field(default_factory=dict)  #: scene.json, {} for data from elsewhere
    #: images that transforms.json names and that are not there: their frames are left out
    missing: tuple[str, ...] = ()
    depth_unit: float = 1e-3  #: metres a step of the pictures of depth

    def __repr__(self) -> str:
        of = f" of {self.scene['scene']}" if "scene" in self.scene else ""
        return f"Dataset({str(self.root)!r}: {len(self.train)} training, {len(self.test)} test frames{of})"

    @property
    def frames(self) -> tuple[Frame, ...]:
        """All frames, training ones first."""
        return self.train + self.test


def check_frame(dataset: object, frame: object) -> None:
    """Raise InputError for what is no `Dataset` or no `Frame`."""
    check_type(dataset, Dataset, "dataset", "read_dataset gives")
    check_type(frame, Frame, "frame", "dataset.test[0]")


@dataclass(frozen=True, eq=False)
class Image:
    """An image as trained on and compared with."""

    rgb: np.ndarray  #: [H, W, 3] float32 sRGB values in [0, 1], straight alpha
    alpha: np.ndarray  #: [H, W] float32
    valid: np.ndarray  #: [H, W] bool, False where `mask_path` says to ignore the pixel

    def __repr__(self) -> str:
        return planes_repr(self, self.alpha.shape[1], self.alpha.shape[0])

    def over(self, background: np.ndarray) -> np.ndarray:
        """[H, W, 3] this image over a background colour [3] or image [H, W, 3] (on sRGB values, as the thesis)."""
        a = self.alpha[..., None]
        return self.rgb * a + np.asarray(background, np.float32) * (1 - a)
