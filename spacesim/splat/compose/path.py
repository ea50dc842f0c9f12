"""What changes with time in a scene: keyframes of poses, Sun and camera, what is between them, and orbits."""

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from spacesim.data.errors import InputError
from spacesim.data.geometry import Array, direction_from_angles, look_at, normalize
from spacesim.data.records import Camera, Sun
from spacesim.learning.rendering import Rendering, checked_sun
from spacesim.splat.compose.pose import Pose, interpolate_pose, interpolate_rotation, slerp
from spacesim.splat.compose.scene import GaussianComposition

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
class SceneFrame:
    """One picture of a scene."""

    time: float  #: seconds
    composition: GaussianComposition  #: with the poses of that time
    camera: Camera  #: pose and intrinsics at that time
    sun: Sun | None  #: at that time; None where none is given


@dataclass(frozen=True, eq=False)
class PosedScene:
    """All that a scene file says (docs/reference/composed-scenes.md)."""

    composition: GaussianComposition  #: runs with their poses
    sun: Sun | None = None  #: None where it names none
    camera: Camera | None = None  #: None where it names none
    keyframes: Sequence[Keyframe] = ()  #: of camera, Sun and models, by time
    orbit: Orbit | None = None  #: on which the camera flies
    frames: int = 1  #: pictures, 1 / fps seconds apart
    fps: float = FPS  #: pictures a second

    def __post_init__(self) -> None:
        object.__setattr__(self, "keyframes", tuple(sorted(self.keyframes, key=lambda key: key.time)))

    @property
    def names(self) -> list[str]:
        """Of the models."""
        return [model.name for model in self.composition.models]

    def frame(self, index: int) -> SceneFrame:
        """Picture `index`, from 0. Raises InputError where the scene has no camera."""
        share = index / self.frames if self.orbit else 0.0
        return self.at(index / self.fps, share)

    def at(self, time: float, share: float = 0.0) -> SceneFrame:
        """The scene at a time, seconds; share: of an orbit, 0 to 1. Raises InputError where the scene has no camera."""
        if self.camera is None:
            source = self.composition.path or "scene"
            raise InputError(f"{source}: expected a camera, found none; add a table [camera]")
        view = self.orbit.view(share) if self.orbit else self._view(self.camera, time)
        return SceneFrame(time, self.posed_at(time), view.of(self.camera) if view else self.camera, self.sun_at(time))

    def render(
        self,
        camera: Camera | None = None,
        sun: Sun | Sequence[float] | None = None,
        exposure: float | None = None,
        time: float = 0.0,
    ) -> Rendering:
        """What a camera sees of the scene at a time, seconds: as `Run.render`. camera, sun: by default the scene's own
        then. Raises InputError where one is needed and none is given."""
        camera = self.at(time).camera if camera is None else camera
        composition = self.posed_at(time)
        whose = str(composition.path or "the scene")
        direction = checked_sun(self.sun_at(time) if sun is None else sun, composition.relightable, whose)
        return Rendering(composition, camera, direction, exposure)

    def sun_at(self, time: float) -> Sun | None:
        """The Sun at a time, seconds; None where none is given."""
        return self._track(lambda key: key.sun, interpolate_sun, time) or self.sun

    def posed_at(self, time: float) -> GaussianComposition:
        """The models where they are at a time, seconds."""
        poses = [
            self._track(lambda key, name=model.name: key.poses.get(name), interpolate_pose, time) or model.pose  # type: ignore[misc]
            for model in self.composition.models
        ]
        return self.composition.posed(poses)

    def seen_by(self, camera: Camera) -> "PosedScene":
        """The same through another camera; the focal lengths of keyframes change with the camera's."""
        if self.camera is None:
            return replace(self, camera=camera)
        x, y = camera.fx / self.camera.fx, camera.fy / self.camera.fy

        def follow(key: Keyframe) -> Keyframe:
            if key.view is None or key.view.focal is None:
                return key
            return replace(key, view=replace(key.view, focal=(key.view.focal[0] * x, key.view.focal[1] * y)))

        return replace(self, camera=camera, keyframes=[follow(key) for key in self.keyframes])

    def _view(self, camera: Camera, time: float) -> CameraView | None:
        """What the keyframes say of the camera; those without focal lengths have `camera`'s where others name some."""
        named = any(key.view is not None and key.view.focal for key in self.keyframes)

        def view(key: Keyframe) -> CameraView | None:
            return key.view.focused(camera) if key.view is not None and named else key.view

        return self._track(view, interpolate_view, time)

    def _track(self, value: Callable[[Keyframe], T | None], blend: Callable[[T, T, float], T], time: float) -> T | None:
        """What the keyframes that name it say of a value; None where none does."""
        named = [(key.time, named_value) for key in self.keyframes if (named_value := value(key)) is not None]
        times, values = [when for when, _ in named], [what for _, what in named]
        return KeyframeTrack(times, values, blend).at(time) if named else None


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
