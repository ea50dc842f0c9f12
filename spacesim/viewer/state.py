"""What is shown: the scene, which all clients share, and what each of them looks at, in which way."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, SupportsFloat

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.geometry import Array, rotation_from_quaternion
from spacesim.data.records import Camera, Sun
from spacesim.splat.compose.pose import Pose

MATERIALS = ("albedo", "specular", "roughness", "metallic")  #: modes that show what surfaces are made of
MODES = ("colour", "depth", "accumulation", "visibility", "normals", *MATERIALS, "object id", "ellipsoids")
COMPARISONS = ("off", "wipe", "beside", "difference")
SIDES = (256, 512, 768, 1024, 1536, 2048)  #: pixels of a picture's longer side at rest that clients may choose
EXPOSURES = (-8.0, 8.0)  #: EV
MAX_WINDOW_SIDE = 8192  #: pixels a side of a client's window: more is nonsense
FIELDS_OF_VIEW = (np.radians(0.01), np.radians(170.0))  #: vertical
MAX_COORDINATE = 1e7  #: metres of a camera in each coordinate


@dataclass(frozen=True, eq=False)
class ViewerCamera:
    """Where a client looks from. Raises InputError for what no camera can be."""

    world_from_camera: Array  #: [4, 4] OpenCV axes, metres
    fov: float  #: vertical, radians
    width: int  #: of the client's window, pixels
    height: int  #: of the client's window, pixels

    def __post_init__(self) -> None:
        least, most = FIELDS_OF_VIEW
        if not least <= self.fov <= most:
            raise InputError(f"view: expected a field of view of at most 170 degrees, found {self.fov} radians")
        if not (1 <= self.width <= MAX_WINDOW_SIDE and 1 <= self.height <= MAX_WINDOW_SIDE):
            raise InputError(f"view: expected 1 to {MAX_WINDOW_SIDE} pixels a side, found {self.width}x{self.height}")
        if not np.all(np.abs(np.asarray(self.world_from_camera)[:3, 3]) <= MAX_COORDINATE):
            raise InputError(f"view: expected a camera within {MAX_COORDINATE:g} metres, found one beyond")
        self.camera(self.width, self.height)

    def camera(self, width: int, height: int) -> Camera:
        """The camera that sees what the window shows in a picture of width x height pixels; they are as wide as they
        are high where the picture's shape is the window's."""
        focal = 0.5 / np.tan(0.5 * self.fov)
        fx = focal * width * self.height / self.width
        return Camera(self.world_from_camera, width, height, fx, focal * height, 0.5 * width, 0.5 * height)

    def same(self, other: "ViewerCamera | None") -> bool:
        """Whether both show the same, to single precision."""
        if other is None or (self.width, self.height) != (other.width, other.height):
            return False
        pose = np.allclose(self.world_from_camera, other.world_from_camera, rtol=1e-6, atol=1e-7)
        return pose and bool(np.isclose(self.fov, other.fov, rtol=1e-6))


def parse_viewer_camera(wxyz: Any, position: Any, fov: Any, width: Any, height: Any) -> ViewerCamera | None:
    """The view that a client sends, or None where that is invalid."""
    try:
        turn, place = np.array(wxyz, dtype=np.float64), np.array(position, dtype=np.float64)
        if turn.shape != (4,) or place.shape != (3,) or not _is_rotation(turn):
            return None
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation_from_quaternion(turn), place
        return ViewerCamera(pose, float(fov), int(width), int(height))
    except (InputError, TypeError, ValueError, OverflowError):
        return None


def _is_rotation(quaternion: Array) -> bool:
    """Whether [4] is about as long as a quaternion that a browser sends."""
    return bool(np.abs(quaternion).max() < 2 and 0.5 < np.linalg.norm(quaternion) < 2)


@dataclass(frozen=True)
class DisplaySettings:
    """How a client wants pictures. What is out of range becomes the nearest in range, other words the default."""

    mode: str = MODES[0]  #: of MODES
    compare: str = COMPARISONS[0]  #: of COMPARISONS, with the truth
    wipe: float = 0.5  #: share of the width that shows the truth
    side: int = 1024  #: most pixels of the longer side
    samples: int = 32  #: of the path tracer, a pixel
    exposure: float = 0.0  #: EV more than in training, of colours in linear light

    def __post_init__(self) -> None:
        mode = self.mode if self.mode in MODES else MODES[0]
        compare = self.compare if self.compare in COMPARISONS else COMPARISONS[0]
        changed = {"mode": mode, "compare": compare, "wipe": clamp(self.wipe, 0, 1, 0.5)}
        changed["side"] = int(clamp(self.side, SIDES[0], SIDES[-1], 1024))
        changed["samples"] = int(clamp(self.samples, 1, 4096, 32))
        changed["exposure"] = clamp(self.exposure, *EXPOSURES, 0.0)
        for name, value in changed.items():
            object.__setattr__(self, name, value)

    @property
    def stops(self) -> float:
        """EV more than in training of this mode's pictures."""
        return self.exposure if self.mode == "colour" else 0.0

    @property
    def of_picture(self) -> tuple[str, int, float]:
        """What a picture without the truth depends on."""
        return self.mode, self.side, self.stops

    @property
    def of_truth(self) -> tuple[str, int, float]:
        """What the truth depends on."""
        return self.mode, self.samples, self.stops


def clamp(value: SupportsFloat | str, least: float, most: float, otherwise: float) -> float:
    """`value` as a number from `least` to `most`; `otherwise` where it is no number."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        return otherwise
    return otherwise if np.isnan(number) else min(max(number, least), most)


@dataclass(frozen=True, eq=False)
class SceneState:
    """How the scene stands."""

    poses: tuple[Pose, ...]  #: world_from_model of each model
    sun: Sun | None  #: None where none is given

    def with_pose(self, index: int, pose: Pose) -> "SceneState":
        """With another pose of model `index`."""
        return replace(self, poses=(*self.poses[:index], pose, *self.poses[index + 1 :]))

    def same(self, other: "SceneState | None") -> bool:
        """Whether both are the same scene."""
        if other is None or [pose.key for pose in self.poses] != [pose.key for pose in other.poses]:
            return False
        if self.sun is None or other.sun is None:
            return self.sun is other.sun
        return np.array_equal(self.sun.direction, other.sun.direction) and self.sun.earth == other.sun.earth


@dataclass
class SharedScene:
    """The one scene that all clients see and change, from any thread: each change is a whole new `SceneState`."""

    state: SceneState  #: what all see now
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _listeners: list[Callable[[SceneState], None]] = field(default_factory=list)

    def change(self, change: Callable[[SceneState], SceneState]) -> SceneState:
        """Put `change` of the scene in its place and call the listeners, where it is another one."""
        with self._lock:
            before, self.state = self.state, change(self.state)
            now, listeners = self.state, tuple(self._listeners)
        if not now.same(before):
            for listener in listeners:
                listener(now)
        return now

    def listen(self, listener: Callable[[SceneState], None]) -> None:
        """Call `listener` on changes from now on, on the thread that makes them."""
        with self._lock:
            self._listeners.append(listener)


def pose_from_handle(pose: Pose, wxyz: Sequence[float], position: Sequence[float]) -> Pose:
    """`pose` turned and placed as a handle says; unchanged where that is nonsense."""
    try:
        turn = np.asarray(wxyz, dtype=np.float64)
        if turn.shape != (4,) or not _is_rotation(turn):
            return pose
        return Pose(turn, np.asarray(position, dtype=np.float64), pose.scale)
    except (InputError, TypeError, ValueError):
        return pose
