"""Camera paths: keyframes from views, played in a browser, and the scene that is saved with them."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from spacesim.data.geometry import Array
from spacesim.data.records import Camera
from spacesim.splat.compose import Composition
from spacesim.splat.compose.path import FPS, MOST_FRAMES, Keyframe, Orbit, PosedScene, Shot
from spacesim.splat.compose.path import View as Place
from spacesim.viewer.state import Stand, View

RATE = 24.0  #: times a second that a path that is played moves the camera
STEP = 2.0  #: seconds from one keyframe to the next at first, chosen
MOST_KEYS = 1000
REFERENCE = Camera(np.eye(4), 512, 512, 512.0, 512.0, 256.0, 256.0)  # whose pixels focal lengths of keyframes are in


def place_of(view: View, centre: Array) -> Place:
    """Where a view is taken from. Its target is the point of its axis nearest to `centre` [3], if that is ahead."""
    pose = view.world_from_camera
    ahead = float((centre - pose[:3, 3]) @ pose[:3, 2])
    upright = abs(pose[2, 0]) < 1e-6  # else to look at the target would turn the camera about its axis
    target = pose[:3, 3] + ahead * pose[:3, 2] if ahead > 0 and upright else None
    focal = float(0.5 * REFERENCE.height / np.tan(0.5 * view.fov))
    return Place(pose, target, (focal, focal))


def fov_of(camera: Camera) -> float:
    """Vertical field of view, radians."""
    return float(2 * np.arctan(0.5 * camera.height / camera.fy))


@dataclass(frozen=True, eq=False)
class Path:
    """keyframes: at rising times, seconds, focal lengths in pixels of REFERENCE"""

    keyframes: tuple[Keyframe, ...] = ()

    @property
    def seconds(self) -> float:
        """Until the last keyframe."""
        return self.keyframes[-1].time if self.keyframes else 0.0

    def added(self, place: Place, stand: Stand | None, names: list[str], step: float) -> "Path":
        """With a keyframe `step` seconds after the last. stand: whose Sun and poses (by `names`) it holds, too, or
        None."""
        if len(self.keyframes) >= MOST_KEYS:
            return self
        when = self.seconds + step if self.keyframes else 0.0
        if stand is None:
            return Path((*self.keyframes, Keyframe(when, view=place)))
        poses = dict(zip(names, stand.poses, strict=True))
        return Path((*self.keyframes, Keyframe(when, stand.sun, place, poses)))

    def shorter(self) -> "Path":
        """Without the last keyframe."""
        return Path(self.keyframes[:-1])

    def at(self, composition: Composition, when: float) -> Shot:
        """Camera, Sun (None where no keyframe names one) and poses at a time."""
        return PosedScene(composition, camera=REFERENCE, keyframes=self.keyframes).at(when)

    @property
    def moves_camera(self) -> bool:
        """Whether a keyframe says where the camera is."""
        return any(key.view is not None for key in self.keyframes)

    @property
    def moves_scene(self) -> bool:
        """Whether a keyframe says where the Sun or a model is."""
        return any(key.sun is not None or key.poses for key in self.keyframes)

    def for_camera(self, old: Camera, new: Camera) -> "Path":
        """The same with focal lengths in pixels of another image."""
        scale = new.height / old.height
        return Path(tuple(_scaled(key, scale) for key in self.keyframes))


def _scaled(key: Keyframe, scale: float) -> Keyframe:
    if key.view is None or key.view.focal is None:
        return key
    fx, fy = key.view.focal
    return replace(key, view=replace(key.view, focal=(scale * fx, scale * fy)))


def path_of(scene: PosedScene) -> Path:
    """The keyframes of a scene."""
    if scene.camera is None or not scene.keyframes:
        return Path()
    camera = scene.camera
    return Path(tuple(_with_focal(key, camera) for key in scene.keyframes)).for_camera(camera, REFERENCE)


def _with_focal(key: Keyframe, camera: Camera) -> Keyframe:
    """Where a keyframe leaves the focal length to the scene's camera: that."""
    if key.view is None or key.view.focal is not None:
        return key
    return replace(key, view=replace(key.view, focal=(camera.fx, camera.fy)))


def orbit_of(view: View, centre: Array) -> Orbit:
    """Once round `centre` [3] from where a view is."""
    offset = view.world_from_camera[:3, 3] - centre
    radius = max(float(np.linalg.norm(offset)), 1e-6)
    elevation = float(np.degrees(np.arcsin(np.clip(offset[2] / radius, -1, 1))))
    azimuth = float(np.degrees(np.arctan2(offset[1], offset[0])))
    x, y, z = centre.tolist()
    return Orbit(radius, (x, y, z), min(max(elevation, -89.0), 89.0), azimuth)


def scene_to_save(composition: Composition, stand: Stand, view: View, path: Path) -> PosedScene:
    """What `spacesim compose` draws as the browser shows it: the view with square pixels, and the path."""
    camera = view.camera(view.width, view.height)
    keys = path.for_camera(REFERENCE, camera).keyframes
    frames = min(MOST_FRAMES, int(path.seconds * FPS + 0.5) + 1) if keys else 1
    return PosedScene(composition.posed(stand.poses), stand.sun, camera, keys, frames=frames)


class Player:
    """Calls step(seconds since the start) RATE times a second on a thread of its own, until `seconds` are over."""

    def __init__(self, step: Callable[[float], None], seconds: float, done: Callable[[], None]) -> None:
        self._step, self._seconds, self._done = step, seconds, done
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="player", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End early; `done` is told all the same."""
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
