"""Camera paths: keyframes from views, played in a browser, and the scene that is saved with them."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from spacesim.data.geometry import Array
from spacesim.data.records import Camera, Sun
from spacesim.splat.compose import GaussianComposition
from spacesim.splat.compose.path import FPS, MAX_FRAMES, CameraView, Keyframe, Orbit
from spacesim.splat.compose.posed_scene import PosedScene, SceneFrame
from spacesim.viewer.state import SceneState, ViewerCamera

RATE = 24.0  #: times a second that a path that is played moves the camera
STEP = 2.0  #: seconds from one keyframe to the next at first
MAX_KEYS = 1000
REFERENCE = Camera(np.eye(4), 512, 512, 512.0, 512.0, 256.0, 256.0)  #: of paths of scenes that name no camera
UPRIGHT = 1e-3  #: sine of the angle of a line of sight to z, from which on z counts as up


def keyframe_view(view: ViewerCamera, centre: Array, image: Camera = REFERENCE) -> CameraView:
    """Where a view is taken from. Its target is the point of its axis nearest to `centre` [3], if that is ahead. image:
    in whose pixels focal lengths are"""
    pose = view.world_from_camera
    position, across, above, axis = pose[:3, 3], pose[:3, 0], -pose[:3, 1], pose[:3, 2]
    length = float(0.5 * image.height / np.tan(0.5 * view.fov))
    ahead = float((centre - position) @ axis)
    if ahead <= 0:
        return CameraView(pose, None, (length, length))
    upright = abs(across[2]) < 1e-6 and above[2] > UPRIGHT
    return CameraView.towards(
        position, position + ahead * axis, (0.0, 0.0, 1.0) if upright else above, (length, length)
    )


def vertical_fov(camera: Camera) -> float:
    """Vertical field of view, radians."""
    return float(2 * np.arctan(0.5 * camera.height / camera.fy))


@dataclass(frozen=True, eq=False)
class CameraPath:
    """What changes with time."""

    keyframes: tuple[Keyframe, ...] = ()  #: at rising times, seconds
    #: of the scene's file, whose image focal lengths of keyframes are in pixels of, or None
    camera: Camera | None = None
    orbit: Orbit | None = None  #: in place of the keyframes' cameras
    frames: int | None = None  #: pictures that the file asks for, None for as many as the keyframes take
    fps: float = FPS  #: pictures a second

    @property
    def image(self) -> Camera:
        """In whose pixels focal lengths of keyframes are."""
        return self.camera or REFERENCE

    @property
    def last_time(self) -> float:
        """Of the last keyframe, seconds."""
        return self.keyframes[-1].time if self.keyframes else 0.0

    @property
    def seconds(self) -> float:
        """That it takes to play: up to the last keyframe, or once through the orbit."""
        return max(self.last_time, self.picture_count / self.fps) if self.orbit else self.last_time

    @property
    def picture_count(self) -> int:
        """As many as it is saved with."""
        if self.frames is not None:
            return self.frames
        return min(MAX_FRAMES, int(self.last_time * self.fps + 0.5) + 1) if self.keyframes else 1

    def with_keyframe(self, place: CameraView, state: SceneState | None, names: list[str], step: float) -> "CameraPath":
        """With a keyframe `step` seconds after the last, and without an orbit. state: whose Sun and poses (by `names`)
        it holds, too, or None."""
        if len(self.keyframes) >= MAX_KEYS:
            return self
        when = self.last_time + step if self.keyframes else 0.0
        key = Keyframe(when, view=place)
        if state is not None:
            key = Keyframe(when, state.sun, place, dict(zip(names, state.poses, strict=True)))
        return replace(self, keyframes=(*self.keyframes, key), orbit=None, frames=None)

    def without_last(self) -> "CameraPath":
        """Without the last keyframe; without the orbit where there is none."""
        if self.keyframes:
            return replace(self, keyframes=self.keyframes[:-1], frames=self.frames if self.orbit else None)
        return self.emptied()

    def emptied(self) -> "CameraPath":
        """Without anything that moves."""
        return replace(self, keyframes=(), orbit=None, frames=None)

    def at(self, composition: GaussianComposition, when: float, sun: Sun | None = None) -> SceneFrame:
        """Camera, Sun (`sun` and its Earth where no keyframe names one) and poses at a time."""
        scene = PosedScene(composition, sun, self.image, self.keyframes, self.orbit, self.picture_count, self.fps)
        return scene.at(when, min(when * self.fps / self.picture_count, 1.0) if self.orbit else 0.0)

    @property
    def moves_camera(self) -> bool:
        """Whether it says where the camera is."""
        return self.orbit is not None or any(key.view is not None for key in self.keyframes)

    @property
    def moves_scene(self) -> bool:
        """Whether a keyframe says where the Sun, the Earth or a model is."""
        return any(key.sun is not None or key.earth is not None or key.poses for key in self.keyframes)

    @property
    def description(self) -> str:
        """What it is, for the panel."""
        count = len(self.keyframes)
        parts = ["an orbit"] * (self.orbit is not None)
        parts += [f"{count} keyframe{'s' * (count != 1)}"] * (count > 0 or self.orbit is None)
        return f"{' and '.join(parts)}, {self.seconds:.4g} s"


def path_from_scene(scene: PosedScene) -> CameraPath:
    """What changes with time in a scene."""
    still = not scene.keyframes and scene.orbit is None and scene.frames == 1
    frames = None if still else scene.frames
    return CameraPath(tuple(scene.keyframes), scene.camera, scene.orbit, frames, scene.fps)


def orbit_from_view(view: ViewerCamera, centre: Array) -> Orbit:
    """Once round `centre` [3] from where a view is."""
    offset = view.world_from_camera[:3, 3] - centre
    radius = max(float(np.linalg.norm(offset)), 1e-6)
    elevation = float(np.degrees(np.arcsin(np.clip(offset[2] / radius, -1, 1))))
    azimuth = float(np.degrees(np.arctan2(offset[1], offset[0])))
    x, y, z = centre.tolist()
    return Orbit(radius, (x, y, z), min(max(elevation, -89.0), 89.0), azimuth)


def scene_to_save(
    composition: GaussianComposition, state: SceneState, view: ViewerCamera, path: CameraPath
) -> PosedScene:
    """What `spacesim compose` draws: the path as it is played. Its image is that of the scene's file where that has one
    and the camera moves, else the view as the browser shows it, with square pixels."""
    camera, keys = path.camera, path.keyframes
    if camera is None or not path.moves_camera:
        camera = view.camera(view.width, view.height)
        scale = camera.height / path.image.height
        keys = tuple(_scale_keyframe(key, scale) for key in keys)
    return PosedScene(composition.posed(state.poses), state.sun, camera, keys, path.orbit, path.picture_count, path.fps)


def _scale_keyframe(key: Keyframe, scale: float) -> Keyframe:
    """With focal lengths in pixels of an image `scale` times as high."""
    if key.view is None or key.view.focal is None:
        return key
    fx, fy = key.view.focal
    return replace(key, view=replace(key.view, focal=(scale * fx, scale * fy)))


class Player:
    """Calls step(seconds since the start) RATE times a second on a thread of its own, until `seconds` are over."""

    def __init__(self, step: Callable[[float], None], seconds: float, done: Callable[[], None]) -> None:
        self._step, self._seconds, self._done = step, seconds, done
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="player", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End early; `done` is called all the same."""
        self._ended.set()

    def _run(self) -> None:
        start = time.monotonic()
        try:
            while not self._ended.wait(1 / RATE):
                now = time.monotonic() - start
                self._step(min(now, self._seconds))
                if now >= self._seconds:
                    break
        finally:
            self._done()
