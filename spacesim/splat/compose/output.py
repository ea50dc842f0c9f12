"""A scene of trained runs as files: pictures of every frame, a video, a contact sheet.

OUT/rgb/0000.png         sRGB, 8 bits, straight alpha
OUT/depth/0000.exr       float: depth, metres along the optical axis, 0 where nothing is; alpha
OUT/linear/0000.exr      linear display values, alpha; of scenes blended in linear light (`light.linear`)
OUT/id/0000.png          which model: its number, from 1, in the file's order, 0 for none
OUT/visibility/0000.png  share of the Sun that is seen, 255 all of it, 0 where nothing is; of scenes with shadows
OUT/shots/0000.json      when that was: time, camera as in transforms.json, Sun, poses; written last
OUT/sheet.png            some of the pictures, OUT/video.mp4 all of them, where there is more than one and an encoder
"""

import hashlib
import json
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spacesim import backend
from spacesim.data.errors import InputError
from spacesim.data.files import JsonValue, holds_files, read_json, remove_leftovers, write_bytes, write_json
from spacesim.data.images import read_png, write_exr, write_png
from spacesim.data.images.sheet import DARK_PAGE, Tile, contact_sheet, fit_picture
from spacesim.data.images.tone import as_bytes
from spacesim.data.integrity.whole import is_whole
from spacesim.data.lock import lock_folder
from spacesim.data.store import intrinsics_of
from spacesim.data.transforms import earth_keys
from spacesim.learning.pictures import write_picture
from spacesim.splat.compose.posed_scene import PosedScene, SceneFrame
from spacesim.splat.compose.scene import ComposedPrediction
from spacesim.splat.export.sweep import COLUMNS, MAX_TILES, SIDE, resize_camera, sky_mark
from spacesim.splat.export.video import INSTALL, Video, encoder
from spacesim.version import __version__

SHOTS = "shots"
PICTURES = {"rgb": ".png", "depth": ".exr", "linear": ".exr", "id": ".png", "visibility": ".png"}

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Composed:
    """What `compose` has written."""

    frames: int  #: of the scene
    rendered: int  #: frames that were not there yet, of `frames`
    sheet: Path  #: the contact sheet
    video: Path | None  #: None of one picture, and without an encoder
    note: str | None  #: why there is no video, or None where there is one, or one picture


def compose(
    scene: PosedScene,
    out: Path,
    size: int | tuple[int, int] | None = None,
    report: Callable[[int, int], None] | None = None,
    exposure: float | None = None,
) -> Composed:
    """Render every frame of a scene into `out`. Frames that are there already and show the same, from an earlier call
    that was interrupted or before something else was changed, are kept.

    size: pixels of the longer side, or (width, height), in place of the camera's
    report: called with (frames done, of all);  exposure: EV, see `GaussianComposition.stops`
    Raises InputError where the scene lacks a camera or a Sun that it needs, an exposure does not fit its models, or the
    folder holds other files.
    """
    out = Path(out)
    if holds_files(out) and not (out / SHOTS).is_dir():
        raise InputError(
            f"{out}: expected an empty or new folder, or one of an earlier compose, found other files in it"
        )
    if scene.camera is not None and size is not None:
        scene = scene.seen_by(resize_camera(scene.camera, size))
    frame = scene.frame(0)
    if frame.sun is None and frame.composition.relightable:
        source = scene.composition.path or "scene"
        raise InputError(f"{source}: expected the Sun's direction for a scene that it changes, found none; add [sun]")
    frame.composition.stops(exposure)
    _warn_of_a_cut(scene)
    with lock_folder(out):
        _make(out)
        remove_leftovers(out)
        return _render_frames(scene, out, report, exposure)


def _warn_of_a_cut(scene: PosedScene) -> None:
    """Where a film, of which each picture is shown for 1 / fps seconds, ends before the last keyframe."""
    last = scene.keyframes[-1].time if scene.keyframes else 0.0
    if 1 < scene.frames < last * scene.fps - 0.5:
        log.warning(
            "%s: %d frames at %g a second end at %.4g s, before the last keyframe at %.4g s",
            scene.composition.path or "scene",
            scene.frames,
            scene.fps,
            scene.frames / scene.fps,
            last,
        )


def _render_frames(
    scene: PosedScene, out: Path, report: Callable[[int, int], None] | None, exposure: float | None
) -> Composed:
    many = scene.frames > 1
    film = _open_video(scene) if many else None
    count = min(MAX_TILES, scene.frames)
    shown = {k * scene.frames // count for k in range(count)}
    tiles: list[Tile] = []
    rendered = 0
    _forget(out, scene.frames)
    for index in range(scene.frames):
        frame = scene.frame(index)
        what = _describe_frame(frame, exposure)
        if not _is_up_to_date(out, index, what):
            _write(out, index, frame, what, exposure)
            rendered += 1
        if film is not None or index in shown:
            picture = read_png(out / "rgb" / f"{index:04d}.png")
            if film is not None:
                film.add(_over_black(picture))
            if index in shown:
                tiles.append(_tile(picture, frame))
        if report is not None:
            report(index + 1, scene.frames)
    camera = scene.frame(0).camera
    title = f"{_title(scene)}, {scene.frames} frame{'s' * many}, {camera.width} x {camera.height} px"
    columns = math.ceil(len(tiles) / math.ceil(len(tiles) / COLUMNS))
    aspect = camera.height / camera.width
    sheet = contact_sheet(title, tiles, len(tiles), aspect, columns, SIDE, DARK_PAGE)
    write_png(out / "sheet.png", sheet)
    if film is None:
        (out / "video.mp4").unlink(missing_ok=True)
        note = f"{out / 'video.mp4'}: not written, PyAV is not installed; type: {INSTALL}" if many else None
        return Composed(scene.frames, rendered, out / "sheet.png", None, note)
    write_bytes(out / "video.mp4", film.content())
    return Composed(scene.frames, rendered, out / "sheet.png", out / "video.mp4", None)


def _make(out: Path) -> None:
    try:
        (out / SHOTS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: expected a folder that can be written ({error.strerror})") from None


def _open_video(scene: PosedScene) -> Video | None:
    if encoder() is None:
        return None
    camera = scene.frame(0).camera
    return Video(camera.width, camera.height, scene.fps)


def _forget(out: Path, frames: int) -> None:
    """Take away frames beyond the scene's, of an earlier and longer one."""
    for frame in (out / SHOTS).glob("*.json"):
        if frame.stem.isdigit() and int(frame.stem) >= frames:
            frame.unlink()
            for kind, suffix in PICTURES.items():
                (out / kind / f"{frame.stem}{suffix}").unlink(missing_ok=True)


def _describe_frame(frame: SceneFrame, exposure: float | None) -> dict[str, JsonValue]:
    """What a frame shows: as shots/*.json has it, with a digest of all that the pictures depend on."""
    camera = frame.camera
    values: dict[str, JsonValue] = {
        "time": frame.time,
        "transform_matrix": camera.opengl.tolist(),
        **intrinsics_of(camera),
        "sun_direction": None if frame.sun is None else frame.sun.direction.tolist(),
        **(earth_keys(frame.sun.earth) if frame.sun and frame.sun.earth else {}),
        "models": [
            {
                "name": model.name,
                "position": model.pose.translation.tolist(),
                "rotation_wxyz": model.pose.quaternion.tolist(),
                "scale": model.pose.scale,
            }
            for model in frame.composition.models
        ],
    }
    composition = frame.composition
    made_by: list[object] = [__version__, backend.select(), composition.config.shadows, composition.contents]
    if exposure is not None:
        made_by.append(exposure)
    text = json.dumps([values, made_by], sort_keys=True)
    return {"digest": hashlib.sha256(text.encode()).hexdigest(), **values}


def _is_up_to_date(out: Path, index: int, what: dict[str, JsonValue]) -> bool:
    path = out / SHOTS / f"{index:04d}.json"
    try:
        record = read_json(path)
    except InputError:
        return False
    if not isinstance(record, dict) or record.get("digest") != what["digest"]:
        return False
    kinds = record.get("pictures")
    if not isinstance(kinds, list) or not {"rgb", "depth", "id"} <= {kind for kind in kinds if kind in tuple(PICTURES)}:
        return False
    return all(kind in tuple(PICTURES) and is_whole(out / kind / f"{index:04d}{PICTURES[kind]}") for kind in kinds)


def _write(out: Path, index: int, frame: SceneFrame, what: dict[str, JsonValue], exposure: float | None) -> None:
    """The pictures of a frame, then its shots/*.json; while they are written, an earlier one is gone."""
    record = out / SHOTS / f"{index:04d}.json"
    record.unlink(missing_ok=True)
    prediction = frame.composition.predict(frame.camera, frame.sun, exposure=exposure)
    planes = _planes(prediction)
    write_picture(prediction, "rgb", out / "rgb" / f"{index:04d}.png")
    write_exr(out / "depth" / f"{index:04d}.exr", {"depth": prediction.depth, "alpha": prediction.alpha})
    written = ["rgb", "depth", *planes]
    if prediction.linear is not None:
        write_exr(out / "linear" / f"{index:04d}.exr", {"linear": prediction.linear, "alpha": prediction.alpha})
        written.append("linear")
    for kind, plane in planes.items():
        write_png(out / kind / f"{index:04d}.png", plane)
    for kind in PICTURES.keys() - written:
        (out / kind / f"{index:04d}{PICTURES[kind]}").unlink(missing_ok=True)
    write_json(record, {**what, "pictures": written})


def _planes(prediction: ComposedPrediction) -> dict[str, np.ndarray]:
    """Pictures of numbers, [H, W] uint8, or uint16 for more than 255 models."""
    assert prediction.id is not None
    few = prediction.id.max(initial=0) < 256
    planes = {"id": prediction.id.astype(np.uint8 if few else np.uint16)}
    if prediction.visibility is not None:
        planes["visibility"] = as_bytes(np.clip(np.nan_to_num(prediction.visibility), 0, 1))
    return planes


def _over_black(picture: np.ndarray) -> np.ndarray:
    return np.asarray(fit_picture(picture, picture.shape[1], picture.shape[0]))


def _tile(picture: np.ndarray, frame: SceneFrame) -> Tile:
    small = np.asarray(fit_picture(picture, SIDE, SIDE))
    when = f"{frame.time:.2f} s"
    if frame.sun is None:
        return Tile(small, when)
    azimuth, elevation = (f"{round(angle, 1) + 0.0:g}°" for angle in frame.sun.angles)
    return Tile(small, when, f"Sun {azimuth}, {elevation}", sky_mark(frame.sun))


def _title(scene: PosedScene) -> str:
    path = scene.composition.path
    return path.stem if path else ", ".join(scene.names)
