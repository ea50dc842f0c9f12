"""Scenes of trained runs as TOML files (docs/reference/composed-scenes.md): reading them, line by line where they are
wrong, and writing them."""

import logging
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from spacesim.data import toml
from spacesim.data.earth import Earth
from spacesim.data.errors import InputError
from spacesim.data.files import JsonDict, as_path, write_bytes
from spacesim.data.geometry import OPENCV_FROM_OPENGL, look_at
from spacesim.data.records import Camera, Sun
from spacesim.data.structure import Rules, did_you_mean, structure
from spacesim.data.transforms import read_camera, read_dataset
from spacesim.splat.compose.entries import CameraEntry, KeyframeEntry, ModelEntry, SceneEntry, ViewEntry
from spacesim.splat.compose.path import FPS, MAX_FRAMES, ORBIT_FRAMES, CameraView, Keyframe, Orbit
from spacesim.splat.compose.pose import Pose
from spacesim.splat.compose.posed_scene import PosedScene
from spacesim.splat.compose.scene import ComposeConfig, GaussianComposition, PlacedRun
from spacesim.splat.run import load_run

FOV_DEG = 35.0  #: of a camera where nothing is said
RESOLUTION = (512, 512)  #: pixels
RULES = Rules(spread=("resolution",))

T = TypeVar("T")

log = logging.getLogger(__name__)


def load_scene(
    path: str | Path, load: Callable[[Path], Any] | None = None, compose: Callable[..., Any] = GaussianComposition
) -> PosedScene:
    """The scene that a TOML file describes, its runs loaded, each once. Raises InputError with file, line and key.

    load: a folder to a run, None: one of Gaussians;  compose: makes a `GaussianComposition`, or what has its
    words for runs of other methods
    """
    path = as_path(path, "path")
    document = toml.read_document(path)
    if "objects" in document.values and "models" not in document.values:
        label = document.label(("objects",))
        raise InputError(f"{label}: expected [[models]], found [[objects]], which generate takes")
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
    sun, earth = entry.sun.sun if entry.sun else None, entry.earth.earth() if entry.earth else None
    named: list[tuple[str | int, ...]] = [("earth",)] if earth else []
    named += [("keyframes", k, "earth") for k, keyframe in enumerate(entry.keyframes) if keyframe.earth]
    if named and not any(model.run.relightable for model in models):
        raise InputError(f"{document.label(named[0])}: expected a model that the Sun relights, found none")
    if named and (without := [model.name for model in models if not model.run.knows_earth]):
        log.info("%s: has not learned the Earth's light; it can but hide the Sun", ", ".join(without))
    return PosedScene(composition, sun, camera, keyframes, orbit, _frames(entry, document), entry.fps, earth)


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
    earth = (scene.sun and scene.sun.earth) or scene.earth
    dims = any(model.run.relightable for model in scene.composition.models)
    if earth is not None and dims:
        values["earth"] = _earth_values(earth)
    if scene.camera is not None:
        values["camera"] = _camera_values(scene.camera, scene.orbit)
    values["keyframes"] = [_keyframe_values(key, dims) for key in scene.keyframes]
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
            camera = "none" if entry.camera is None else "an orbit"
            raise InputError(f"{label}: expected a table [camera] that says the image's size, found {camera}")
        view = keyframe.camera.view(width)
        if view is None:
            raise InputError(f"{label}: expected position and look_at, or transform_matrix, found neither")
    poses = {name: pose.pose(by_name[name].pose) for name, pose in keyframe.models.items()}
    sun, still = keyframe.sun.sun if keyframe.sun else None, entry.earth.earth() if entry.earth else None
    return Keyframe(keyframe.time, sun, view, poses, keyframe.earth.earth(still) if keyframe.earth else None)


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


def _earth_values(earth: Earth) -> JsonDict:
    values = _sun_values(Sun(earth.direction))
    return values | {"angular_radius_deg": float(earth.angular_radius_deg), "albedo": float(earth.albedo)}


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


def _keyframe_values(key: Keyframe, with_earth: bool) -> JsonDict:
    values: JsonDict = {"time": float(key.time)}
    if key.sun is not None:
        values["sun"] = _sun_values(key.sun)
    if key.earth is not None and with_earth:
        values["earth"] = _earth_values(key.earth)
    if key.view is not None:
        values["camera"] = _view_values(key.view)
    if key.poses:
        values["models"] = {name: _pose_values(pose) for name, pose in key.poses.items()}
    return values
