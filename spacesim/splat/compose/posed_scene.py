"""Models, Sun and camera at any time: what a scene file says, with what its keyframes say of a time."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

from spacesim.data.earth import Earth
from spacesim.data.errors import InputError
from spacesim.data.records import Camera, Sun
from spacesim.data.structure import checked
from spacesim.learning.lights import Light
from spacesim.learning.rendering import Rendering, checked_sun
from spacesim.splat.compose.path import (
    FPS,
    CameraView,
    Keyframe,
    KeyframeTrack,
    Orbit,
    interpolate_earth,
    interpolate_sun,
    interpolate_view,
)
from spacesim.splat.compose.pose import interpolate_pose
from spacesim.splat.compose.scene import GaussianComposition

T = TypeVar("T")


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
    keyframes: Sequence[Keyframe] = ()  #: of camera, Sun, Earth and models, by time
    orbit: Orbit | None = None  #: on which the camera flies
    frames: int = 1  #: pictures, 1 / fps seconds apart
    fps: float = FPS  #: pictures a second
    earth: Earth | None = None  #: that the Sun lights, where neither keyframes nor a Sun name another

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

    @checked
    def render(
        self,
        camera: Camera | None = None,
        sun: Sun | Sequence[float] | None = None,
        exposure: float | None = None,
        time: float = 0.0,
        light: Light = "all",
    ) -> Rendering:
        """What a camera sees of the scene at a time, seconds: as `Run.render`. camera, sun: by default the scene's own
        then; the Earth, too, unless a `Sun` says. Raises InputError where one is needed and none is given."""
        camera = self.at(time).camera if camera is None else camera
        composition = self.posed_at(time)
        whose = str(composition.path or "the scene")
        named = self.sun_at(time) if sun is None else sun
        towards = checked_sun(named, composition.relightable, whose)
        if not isinstance(named, Sun):
            towards = self._with_earth(towards, time)
        return Rendering(composition, camera, towards, exposure, light)

    def sun_at(self, time: float) -> Sun | None:
        """The Sun at a time, seconds; None where none is given."""
        return self._with_earth(self._track(lambda key: key.sun, interpolate_sun, time) or self.sun, time)

    def earth_at(self, time: float) -> Earth | None:
        """The Earth at a time, seconds; None where none is given."""
        moved = self._track(lambda key: key.earth, interpolate_earth, time)
        return moved or (self.sun.earth if self.sun else None) or self.earth

    def _with_earth(self, sun: Sun | None, time: float) -> Sun | None:
        return None if sun is None else replace(sun, earth=self.earth_at(time))

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
