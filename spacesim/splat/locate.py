"""Poses of pictures against a trained model, one after the other, as a file.

poses.json is a transforms.json with, of each frame, `covariance` [6, 6], `gain`, `error`, `converged` and `iterations`
of `RefinedPose`, `residual` and `ambiguous` of `FoundPose`, and `start`: "given" or "searched". A picture that cannot
be located has `failed`, a sentence, and no pose.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from spacesim.data.errors import InputError
from spacesim.data.files import MAX_LIST_BYTES, JsonDict, read_json, write_json
from spacesim.data.images import load_image
from spacesim.data.integrity.outputs import check_output
from spacesim.data.records import Camera, Dataset, Frame, Sun
from spacesim.data.store import intrinsics_of
from spacesim.data.transforms import read_dataset, read_views
from spacesim.splat.pose.refine import refine_pose
from spacesim.splat.pose.search import FoundPose, ModelViews, find_pose, residual_of
from spacesim.splat.run import Run, check_gaussians

PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
_LENS = "k1", "k2", "p1", "p2", "k3"
SAVE_EVERY = 10.0  #: seconds between two writings of the file
Progress = Callable[[int, int, str], None]  #: pictures done, of how many, name of the last


@dataclass(frozen=True, eq=False)
class Located:
    """Results over many pictures."""

    pictures: int  #: in all
    converged: int  #: of which the pose may be trusted
    failed: int  #: that have no pose
    reason: str = ""  #: which picture is the first of these, and why it has none


def locate(
    run: Run,
    images: Path,
    out: Path,
    start: Path | None = None,
    camera: Path | None = None,
    sun: Sun | None = None,
    within: tuple[float, float] = (5.0, 0.05),
    resume: bool = False,
    progress: Progress | None = None,
) -> Located:
    """Find the poses of pictures and write them to the file `out`, now and then and at the end.

    images: a dataset, whose poses are not looked at; a folder of pictures; or one picture
    start: a file like transforms.json with poses to start from, by file path or name; None or a picture that it lacks:
        searched for;  within: how far off these may be, see `refine_pose`
    camera: a file with the intrinsics of pictures without any in a dataset or `start`: the first frame of a
        transforms.json; None: that of the run's data;  sun: of all pictures, in place of those in files
    resume: keep what an interrupted call has found

    Raises InputError where files cannot be read, where a run needs a Sun and none is given, or `out` is no name of
    a JSON file, exists and is not to be resumed, or is of other work or cameras. An error of one picture is recorded
    for that picture.
    """
    check_gaussians(run)
    check_output(out, "poses")
    start_frames = {} if start is None else read_views(start)
    frames, dataset = _frames(run, images, start_frames, camera)
    for frame in frames:
        if run.relightable and sun is None and frame.sun is None:
            method = run.config["method"]
            is_lacking = start is not None and _match(start_frames, frame.file_path) is None
            hint = f", which {start} does not have" if is_lacking else ""
            wanted = f"sun: expected the direction for a run of {method}"
            raise InputError(f"{wanted}, found none for {frame.file_path}{hint}")
    settings: JsonDict = {
        "run": str(run.path),
        "gaussians": run.gaussian_count,
        "images": str(images),
        "start": None if start is None else str(start),
        "within": list(within),
        "sun": None if sun is None else sun.direction.tolist(),
    }
    entries = _finished(out, settings, resume)
    for frame in frames:
        lens = _intrinsics(frame.camera, frame.distortion)
        entry = entries.get(frame.file_path, lens)
        if {key: entry[key] for key in (*intrinsics_of(frame.camera), *_LENS) if key in entry} != lens:
            raise InputError(f"{out}: expected poses found with the same camera, found others for {frame.file_path}")
    views: dict[tuple[bytes | None, bool], ModelViews] = {}
    saved = time.monotonic()
    try:
        for done, frame in enumerate(frames, start=1):
            if frame.file_path not in entries:
                light = sun or frame.sun
                guess = _guess(start_frames, frame)
                entries[frame.file_path] = _entry(run, images, dataset, frame, guess, light, within, views)
                if time.monotonic() - saved > SAVE_EVERY:
                    _write(out, settings, entries)
                    saved = time.monotonic()
            if progress is not None:
                progress(done, len(frames), frame.file_path)
    finally:
        _write(out, settings, entries)
    trusted = sum(bool(entry.get("converged")) for entry in entries.values())
    failures = {name: str(entry["failed"]) for name, entry in entries.items() if "failed" in entry}
    name, reason = next(iter(failures.items()), ("", ""))
    return Located(len(frames), trusted, len(failures), reason if name in reason else f"{name}: {reason}")


def _frames(
    run: Run, images: Path, start_frames: Mapping[str, Frame], camera: Path | None
) -> tuple[list[Frame], Dataset | None]:
    """Pictures with their intrinsics, lenses and Suns, and the dataset where they are one. Poses mean nothing."""
    if (images / "transforms.json").is_file() or images.suffix == ".json":
        dataset = read_dataset(images)
        return list(dataset.frames), dataset
    if images.is_dir():
        names = sorted(path.name for path in images.iterdir() if path.suffix.lower() in PICTURES)
        if not names:
            raise InputError(f"{images}: expected a dataset or a folder of pictures, found neither")
    elif images.is_file():
        names = [images.name]
    else:
        raise InputError(f"{images}: expected a dataset, a folder of pictures or one picture, found nothing")
    usual: Frame | None = None
    frames = []
    for name in names:
        like = _match(start_frames, name)
        if like is None:
            usual = usual or _usual(run, camera)
            like = replace(usual, sun=None)
        # its silhouette, mask and truth are of another picture
        frames.append(Frame(name, like.camera, like.sun, distortion=like.distortion, exposure=like.exposure))
    return frames, None


def _usual(run: Run, camera: Path | None) -> Frame:
    """One with the intrinsics of pictures of which nothing else is known."""
    if camera is not None:
        return next(iter(read_views(camera).values()))
    data = Path(run.config["data"]["path"]) if "data" in run.config else Path()
    if not data.exists() or data == Path():
        raise InputError("camera: expected a file with the intrinsics of the pictures, found none")
    return read_dataset(data).train[0]


def _match(start_frames: Mapping[str, Frame], name: str) -> Frame | None:
    """The frame of that path; else the one of that file name, if it is alone."""
    if name in start_frames:
        return start_frames[name]
    same = [frame for path, frame in start_frames.items() if PurePosixPath(path).name == PurePosixPath(name).name]
    return same[0] if len(same) == 1 else None


def _guess(start_frames: Mapping[str, Frame], frame: Frame) -> Camera | None:
    like = _match(start_frames, frame.file_path)
    return None if like is None else replace(frame.camera, world_from_camera=like.camera.world_from_camera)


def _entry(
    run: Run,
    images: Path,
    dataset: Dataset | None,
    frame: Frame,
    guess: Camera | None,
    sun: Sun | None,
    within: tuple[float, float],
    views: dict[tuple[bytes | None, bool], ModelViews],
) -> JsonDict:
    """What poses.json has of a picture. views: those of the Sun of the last picture, kept here."""
    try:
        root = dataset or Dataset(images if images.is_dir() else images.parent, (frame,), ())
        image = load_image(root, frame)
        has_alpha = bool(image.alpha.min() < 1)
        if guess is not None:
            pose = refine_pose(run, image, guess, sun, within=within)
            result = FoundPose(pose, residual_of(run, image, pose, sun), False)
        else:
            key = None if sun is None else sun.direction.tobytes(), has_alpha
            if key not in views:
                views.clear()
                views[key] = ModelViews.of(run, sun, has_alpha)
            result = find_pose(run, image, frame.camera, sun, views=views[key])
    except InputError as error:
        return {"file_path": frame.file_path, "failed": str(error)}
    pose, camera = result.pose, result.pose.camera
    entry: JsonDict = {
        "file_path": frame.file_path,
        "transform_matrix": camera.opengl.tolist(),
        **_intrinsics(camera, frame.distortion),
        "covariance": pose.covariance.tolist(),
        "converged": pose.converged,
        "ambiguous": result.ambiguous,
        "residual": result.residual,
        "error": pose.error,
        "gain": pose.gain,
        "iterations": pose.iterations,
        "start": "searched" if guess is None else "given",
    }
    if sun is not None:
        entry["sun_direction"] = sun.direction.tolist()
    return entry


def _intrinsics(camera: Camera, distortion: Sequence[float]) -> JsonDict:
    return {**intrinsics_of(camera), **dict(zip(_LENS, distortion, strict=False))}


def _finished(out: Path, settings: JsonDict, resume: bool) -> dict[str, JsonDict]:
    """Entries of an earlier call, by file paths."""
    if not out.exists():
        return {}
    if not resume:
        raise InputError(f"{out}: expected a new file, found one; resume=True goes on with it")
    values = read_json(out, MAX_LIST_BYTES)
    if not isinstance(values, dict) or not isinstance(values.get("frames"), list):
        raise InputError(f"{out}: expected poses of an interrupted call, found another file")
    if values.get("settings") != settings:
        raise InputError(f"{out}: expected poses of the same run, pictures and options, found others")
    entries = [entry for entry in values["frames"] if isinstance(entry, dict) and "failed" not in entry]
    return {str(entry.get("file_path")): entry for entry in entries}


def _write(out: Path, settings: JsonDict, entries: Mapping[str, JsonDict]) -> None:
    frames: Sequence[JsonDict] = list(entries.values())
    write_json(out, {"camera_model": "OPENCV", "settings": settings, "frames": frames})
