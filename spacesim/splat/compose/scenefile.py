"""Scenes of trained runs as TOML files (docs/reference/composed-scenes.md): reading them, line by line where they are
wrong, and writing them."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from spacesim.data import toml
from spacesim.data.errors import InputError
from spacesim.data.files import JsonDict, write_bytes
from spacesim.data.geometry import OPENCV_FROM_OPENGL, Array, look_at
from spacesim.data.records import Camera, Sun, check_size
from spacesim.data.structure import Rules, did_you_mean, structure
from spacesim.data.transforms import read_camera, read_dataset
from spacesim.splat.compose.path import FPS, MAX_FRAMES, ORBIT_FRAMES, CameraView, Keyframe, Orbit, PosedScene
from spacesim.splat.compose.pose import Pose, rotation_about
from spacesim.splat.compose.scene import ComposeConfig, GaussianComposition, PlacedRun
from spacesim.splat.run import load_run

FOV_DEG = 35.0  #: of a camera where nothing is said
RESOLUTION = (512, 512)  #: pixels
FPS_RANGE = (1e-3, 1e3)  #: pictures a second
RULES = Rules(spread=("resolution",))

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
                found = "none" if value is None else "direction beside it"
                raise InputError(f"{key}: expected azimuth_deg and elevation_deg, or direction alone, found {found}")
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
    camera: ViewEntry | None = None  #: None: not named here
    models: Mapping[str, PoseEntry] = field(default_factory=dict)  #: poses by the models' names


@dataclass(frozen=True)
class SceneEntry:
    """The whole file."""

    models: tuple[ModelEntry, ...]  #: in the order that object numbers count
    sun: SunEntry | None = None  #: None: from keyframes or the caller
    camera: CameraEntry | None = None  #: None: from the caller
    shadows: str = ComposeConfig.shadows  #: of models on each other, see `ComposeConfig`
    frames: int | None = None  #: pictures; None: up to the last keyframe, 120 of an orbit, else 1
    fps: float = FPS  #: pictures a second
    keyframes: tuple[KeyframeEntry, ...] = ()  #: of camera, Sun and models

    def __post_init__(self) -> None:
        if not self.models:
            raise InputError("models: expected at least one, found none")
        if self.frames is not None and not 1 <= self.frames <= MAX_FRAMES:
            raise InputError(f"frames: expected 1 to {MAX_FRAMES}, found {self.frames}")
        if not FPS_RANGE[0] <= self.fps <= FPS_RANGE[1]:
            least, most = FPS_RANGE
            raise InputError(f"fps: expected {least:g} to {most:g} pictures a second, found {self.fps}")
        ComposeConfig(self.shadows)


T = TypeVar("T")


def load_scene(
    path: str | Path, load: Callable[[Path], Any] | None = None, compose: Callable[..., Any] = GaussianComposition
) -> PosedScene:
    """The scene that a TOML file describes, its runs loaded, each once. Raises InputError with file, line and key.

    load: a folder to a run, None: one of Gaussians;  compose: makes a `GaussianComposition`, or what has its
    words for runs of other methods
    """
    path = Path(path)
    document = toml.read_document(path)
    entry = structure(SceneEntry, document, RULES)
    names = _names(entry.models, document)
    runs: dict[Path, Any] = {}
    models = []
    for index, (model, name) in enumerate(zip(entry.models, names, strict=True)):
        folder = (path.parent / model.run).resolve()
        if folder not in runs:
            runs[folder] = _load_model(path.parent / model.run, document, index, load or load_run)
        models.append(PlacedRun(runs[folder], model.pose(Pose()), name))
    composition = compose(models, ComposeConfig(entry.shadows), path)
    camera = None if entry.camera is None else _camera(entry.camera, path.parent, document)
    width = camera.width if camera else RESOLUTION[0]
    keyframes = [_keyframe(keyframe, k, entry, models, width, document) for k, keyframe in enumerate(entry.keyframes)]
    orbit = entry.camera.orbit if entry.camera else None
    sun = entry.sun.sun if entry.sun else None
    return PosedScene(composition, sun, camera, keyframes, orbit, _frames(entry, document), entry.fps)


def save_scene(path: Path, scene: PosedScene) -> None:
    """Write a scene as a TOML file from which `load_scene` makes the same one: numbers are written in full, so pictures
    are the same to the bit. Runs are named relative to the file where they lie beside or below its folder."""
    path = Path(path)
    values: JsonDict = {}
    if scene.composition.config.shadows != ComposeConfig.shadows:
        values["shadows"] = scene.composition.config.shadows
    if scene.frames != 1 or scene.keyframes or scene.orbit:
        values["frames"] = scene.frames
    if scene.fps != FPS:
        values["fps"] = float(scene.fps)
    values["models"] = [
        {"name": model.name, "run": _relative(model.run.path, path.parent), **_pose_values(model.pose)}
        for model in scene.composition.models
    ]
    if scene.sun is not None:
        values["sun"] = _sun_values(scene.sun)
    if scene.camera is not None:
        values["camera"] = _camera_values(scene.camera, scene.orbit)
    values["keyframes"] = [_keyframe_values(key) for key in scene.keyframes]
    text = toml.dump({key: value for key, value in values.items() if value != []})
    write_bytes(path, text.encode())


def _names(models: Sequence[ModelEntry], document: toml.Document) -> list[str]:
    """Those that are given, else the runs' folders', with numbers where they repeat."""
    names: list[str] = []
    for index, model in enumerate(models):
        if not model.run:
            raise InputError(f"{document.label(('models', index, 'run'))}: expected the folder of a run, found none")
        if model.name in names and model.name:
            label = document.label(("models", index, "name"))
            raise InputError(f"{label}: expected a name that no other model has, found {model.name!r}")
        names.append(model.name)
    for index, model in enumerate(models):
        parts = [part for part in Path(model.run).parts if part not in ("run", "..", ".", "/")]
        stem = names[index] or (parts[-1] if parts else "model")
        name, count = stem, 1
        while not names[index] and name in names:
            count += 1
            name = f"{stem}-{count}"
        names[index] = name
    return names


def _load_model(folder: Path, document: toml.Document, index: int, load: Callable[[Path], Any]) -> Any:
    try:
        return load(folder)
    except InputError as error:
        raise InputError(f"{document.label(('models', index, 'run'))}: {error}") from None


def _camera(entry: CameraEntry, folder: Path, document: toml.Document) -> Camera:
    if entry.file is not None:
        return _read_entry(document, "file", lambda: read_camera(folder / str(entry.file)))
    if entry.data is not None:
        frames = _read_entry(document, "data", lambda: read_dataset(folder / str(entry.data))).frames
        if not 0 <= entry.frame < len(frames):
            label = document.label(("camera", "frame"))
            raise InputError(f"{label}: expected 0 to {len(frames) - 1}, found {entry.frame}")
        return frames[entry.frame].camera
    width, height = entry.resolution or RESOLUTION
    view = entry.view(width) or (
        entry.orbit.view(0) if entry.orbit else CameraView(look_at((0.0, -5.0, 2.0), (0, 0, 0)))
    )
    camera = Camera.from_fov(view.world_from_camera, width, height, entry.fov_deg or FOV_DEG)
    fx, fy = entry.focal or (camera.fx, camera.fy)
    cx, cy = entry.principal or (camera.cx, camera.cy)
    return Camera(view.world_from_camera, width, height, fx, fy, cx, cy)


def _read_entry(document: toml.Document, key: str, read: Callable[[], T]) -> T:
    try:
        return read()
    except InputError as error:
        raise InputError(f"{document.label(('camera', key))}: {error}") from None


def _keyframe(
    keyframe: KeyframeEntry,
    index: int,
    entry: SceneEntry,
    models: Sequence[PlacedRun],
    width: int,
    document: toml.Document,
) -> Keyframe:
    """width: of the scene's camera, pixels. Raises InputError, with the line, for a time that does not rise, a model
    that there is none of, a camera that cannot be."""
    at = ("keyframes", index)
    if index > 0 and not keyframe.time > entry.keyframes[index - 1].time:
        before = entry.keyframes[index - 1].time
        raise InputError(
            f"{document.label((*at, 'time'))}: expected more than the one before, {before}, found {keyframe.time}"
        )
    by_name = {model.name: model for model in models}
    for name in keyframe.models:
        if name not in by_name:
            label = document.label((*at, "models", name))
            raise InputError(
                f"{label}: expected one of {', '.join(by_name)}, found {name!r}{did_you_mean(name, by_name)}"
            )
    view = None
    if keyframe.camera is not None:
        label = document.label((*at, "camera"))
        if entry.camera is None or entry.camera.orbit is not None:
            found = "none" if entry.camera is None else "an orbit"
            raise InputError(f"{label}: expected a table [camera] that says the image's size, found {found}")
        view = keyframe.camera.view(width)
        if view is None:
            raise InputError(f"{label}: expected position and look_at, or transform_matrix, found neither")
    poses = {name: pose.pose(by_name[name].pose) for name, pose in keyframe.models.items()}
    return Keyframe(keyframe.time, keyframe.sun.sun if keyframe.sun else None, view, poses)


def _frames(entry: SceneEntry, document: toml.Document) -> int:
    """Where none is said: up to the last keyframe, or an orbit's. Raises InputError, with the line, where those are too
    many."""
    if entry.frames is not None:
        return entry.frames
    if entry.keyframes:
        last = entry.keyframes[-1].time
        if last * entry.fps >= MAX_FRAMES - 0.5:
            label = document.label(("keyframes", len(entry.keyframes) - 1, "time"))
            most = f"{MAX_FRAMES:,} pictures at {entry.fps:g} a second, or frames to say how many"
            raise InputError(f"{label}: expected a time within {most}, found {last} seconds")
        return max(0, int(last * entry.fps + 0.5)) + 1
    return ORBIT_FRAMES if entry.camera and entry.camera.orbit else 1


def _relative(run: Path, folder: Path) -> str:
    there, here = Path(os.path.abspath(run)), Path(os.path.abspath(folder))
    near_by = there.is_relative_to(here) or there.is_relative_to(here.parent)
    return os.path.relpath(there, here) if near_by else str(there)


def _pose_values(pose: Pose) -> JsonDict:
    return {
        "position": pose.translation.tolist(),
        "rotation_wxyz": pose.quaternion.tolist(),
        "scale": pose.scale,
    }


def _sun_values(sun: Sun) -> JsonDict:
    azimuth, elevation = (round(angle, 9) for angle in sun.angles)  # as they were written, where that means the same
    if np.array_equal(Sun.from_angles(azimuth, elevation).direction, sun.direction):
        return {"azimuth_deg": azimuth, "elevation_deg": elevation}
    return {"direction": sun.direction.tolist()}


def _view_values(view: CameraView) -> JsonDict:
    values: JsonDict = {"transform_matrix": (view.world_from_camera @ OPENCV_FROM_OPENGL).tolist()}
    position = view.world_from_camera[:3, 3]
    if view.target is not None and np.array_equal(look_at(position, view.target, view.up), view.world_from_camera):
        values = {"position": position.tolist(), "look_at": view.target.tolist()}
        if view.up.tolist() != list(ViewEntry.up):
            values["up"] = view.up.tolist()
    return values | ({} if view.focal is None else {"focal": [float(length) for length in view.focal]})


def _camera_values(camera: Camera, orbit: Orbit | None) -> JsonDict:
    values: JsonDict = {
        "resolution": [camera.width, camera.height],
        "focal": [float(camera.fx), float(camera.fy)],
        "principal": [float(camera.cx), float(camera.cy)],
    }
    if orbit is None:
        return values | {"transform_matrix": camera.opengl.tolist()}
    return values | {
        "orbit": {
            "radius": float(orbit.radius),
            "centre": [float(x) for x in orbit.centre],
            "elevation_deg": float(orbit.elevation_deg),
            "azimuth_deg": float(orbit.azimuth_deg),
            "turns": float(orbit.turns),
        }
    }


def _keyframe_values(key: Keyframe) -> JsonDict:
    values: JsonDict = {"time": float(key.time)}
    if key.sun is not None:
        values["sun"] = _sun_values(key.sun)
    if key.view is not None:
        values["camera"] = _view_values(key.view)
    if key.poses:
        values["models"] = {name: _pose_values(pose) for name, pose in key.poses.items()}
    return values
