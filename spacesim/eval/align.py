"""A reconstruction in axes and a scale of its own, as structure from motion makes it, brought into the truth's: the
similarity (Umeyama 1991) between cameras that both datasets have, then that by which they see the points alike.

Frames are matched by the key `source_index` of transforms.json where both name it, else by the stem of the picture's
file, else, where one side alone names it, by counting the other's frames in the order of their file paths from 0: a
video's frames were taken one after another.
"""

import re
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from spacesim.data.density import target_of
from spacesim.data.errors import InputError
from spacesim.data.files import MAX_LIST_BYTES, JsonValue, read_json
from spacesim.data.geometry import Array, quaternion_from_rotation
from spacesim.data.mesh import read_points
from spacesim.data.records import Camera, Dataset, Frame
from spacesim.data.transforms import read_views
from spacesim.splat.compose.aligned import moved_frame
from spacesim.splat.compose.pose import Pose

KEY = "source_index"  #: of a frame in transforms.json: which frame of the video it is, from 0
LEAST = 3  #: matching cameras
POINTS = 200  #: of the reconstruction that the cameras shall see alike
FEWEST = 14  #: coordinates in pictures that the move is fitted to, twice its unknowns
PAIRS = 500  #: of cameras that are tried, at most, to find one without outliers
OUTLIER = 3.0  #: robust standard deviations
TOO_FAR = 0.2  #: of the truth's distance: such a residual means that the frames do not match
Match = tuple[Frame, Frame]


@dataclass(frozen=True, eq=False)
class Alignment:
    """Where a reconstruction stands in the truth's world."""

    pose: Pose  #: of the reconstruction in the world
    matched_by: str  #: in words
    cameras: int  #: that match
    inliers: int  #: of these, that the pose is fitted to
    rms: float  #: metres, of the inliers' positions
    distance: float  #: metres, median of the true cameras from what they look at
    turn_deg: float  #: root mean square angle between the inliers' axes

    def to_json(self) -> dict[str, JsonValue]:
        """As metrics.json has it."""
        return {
            "matched_by": self.matched_by,
            "cameras": self.cameras,
            "inliers": self.inliers,
            "rms": self.rms,
            "rms_over_distance": self.rms / self.distance,
            "rms_deg": self.turn_deg,
            "scale": self.pose.scale,
            "rotation_wxyz": self.pose.quaternion.tolist(),
            "translation": self.pose.translation.tolist(),
        }

    @property
    def note(self) -> str:
        """In a sentence."""
        return (
            f"The run was moved into the axes and scale of the data by {self.inliers} of {self.cameras} cameras "
            f"matched by {self.matched_by}: their positions then differ by {self.rms:.4g} m (RMS), "
            f"{100 * self.rms / self.distance:.2g} % of the distance, their axes by {self.turn_deg:.2g}°; "
            f"scale {self.pose.scale:.5g}."
        )


def align(own: Dataset, truth: Dataset) -> Alignment:
    """The pose of what was trained on `own` in the world of `truth`: by cameras, and `seen_alike` if it has points.
    Raises InputError where too few frames match or their cameras do not."""
    matches, words = match_frames(own, truth)
    if len(matches) < LEAST:
        raise InputError(
            f"{own.root}: expected at least {LEAST} frames that {truth.root} has, too, found {len(matches)} (matched "
            f"by {words})"
        )
    places = [np.array([pair[side].camera.world_from_camera for pair in matches]) for side in (0, 1)]
    pose, is_inlier = robust_similarity(*places)
    distance = float(np.median(np.linalg.norm(places[1][:, :3, 3] - target_of(truth), axis=1)))
    rms, turns = _off(pose, places, is_inlier)
    if rms < TOO_FAR * distance and own.ply_file_path is not None:
        pose = seen_alike(pose, matches, read_points(own.root / own.ply_file_path)[0])
        rms, turns = _off(pose, places, is_inlier)
    if rms > TOO_FAR * distance or 2 * is_inlier.sum() < len(matches):
        raise InputError(
            f"{own.root}: expected cameras like those of {truth.root}, found {is_inlier.sum()} of {len(matches)} "
            f"within {100 * rms / distance:.0f} % of the distance (matched by {words}; a mirrored model never fits)"
        )
    turn = float(np.sqrt(np.square(turns[is_inlier]).mean()))
    return Alignment(pose, words, len(matches), int(is_inlier.sum()), rms, max(distance, 1e-12), turn)


def _off(pose: Pose, places: list[Array], is_inlier: np.ndarray) -> tuple[float, Array]:
    """(RMS of the inliers' positions, degrees that each camera is turned)."""
    away, turns = residuals(pose, *places)
    return float(np.sqrt(np.square(away[is_inlier]).mean())), turns


def as_trained(own: Dataset, run: Path) -> Dataset:
    """`own` with its training cameras where a run that refined poses has them, in RUN/cameras.json.

    Raises InputError where these are of other frames.
    """
    path = run / "cameras.json"
    if not path.is_file():
        return own
    views = read_views(path)
    if not any(frame.file_path in views for frame in own.train):
        raise InputError(f"{path}: expected cameras of frames of {own.root}, found {', '.join(list(views)[:3])}, ...")
    train = (replace(frame, camera=views.get(frame.file_path, frame).camera) for frame in own.train)
    return replace(own, train=tuple(train))


def moved_dataset(dataset: Dataset, pose: Pose) -> Dataset:
    """A reconstruction's own dataset in the world: its cameras and Suns."""
    train, test = ([moved_frame(frame, pose) for frame in frames] for frames in (dataset.train, dataset.test))
    return replace(dataset, train=tuple(train), test=tuple(test), ply_file_path=None, mesh_path=None)


def match_frames(own: Dataset, truth: Dataset) -> tuple[list[Match], str]:
    """Frames of both that are one picture, and what they are matched by."""
    by_key = [_by_key(dataset) for dataset in (own, truth)]
    if all(by_key):
        return _pairs(*by_key), f"{KEY} in transforms.json"
    by_stem = [_by_stem(dataset) for dataset in (own, truth)]
    pairs = _pairs(*by_stem)
    if len(pairs) >= LEAST or not any(by_key):
        return pairs, "file name"
    counted = [keyed or _counted(dataset) for keyed, dataset in zip(by_key, (own, truth), strict=True)]
    return _pairs(*counted), f"{KEY} in transforms.json, against the order of file paths"


def robust_similarity(own: Array, truth: Array) -> tuple[Pose, np.ndarray]:
    """(the pose of the one in the other, [N] bool: cameras that are no outliers), of camera poses [N, 4, 4].

    The start is, of all pairs of cameras or of `PAIRS` random ones, that with the least median distance (Rousseeuw
    1984); then all cameras within `OUTLIER` robust standard deviations are fitted, until they stay the same. Raises
    InputError where no two cameras stand apart.
    """
    best: tuple[float, Pose] | None = None
    for first, second in _candidate_pairs(len(own)):
        pose = similarity(own[[first, second]], truth[[first, second]])
        if pose is not None:
            median = float(np.median(residuals(pose, own, truth)[0]))
            if best is None or median < best[0]:
                best = median, pose
    if best is None:
        raise InputError("cameras: expected some that stand apart in both datasets, found all in one place")
    pose = best[1]
    inliers = np.zeros(len(own), bool)
    for _ in range(20):
        away = residuals(pose, own, truth)[0]
        limit = OUTLIER * 1.4826 * float(np.median(away)) + 1e-9 * float(np.abs(truth[:, :3, 3]).max() + 1)
        if np.array_equal(away <= limit, inliers):
            break
        inliers = away <= limit
        pose = similarity(own[inliers], truth[inliers]) or pose
    return pose, inliers


def similarity(own: Array, truth: Array) -> Pose | None:
    """The similarity between camera poses [N, 4, 4], N at least 2, by least squares: Umeyama 1991 of their positions,
    the cameras' axes beside them, in units of the positions' spread, so that cameras on a line have an answer, too.
    None where positions do not differ, or the scale is beyond all bounds."""
    centred = [poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0) for poses in (own, truth)]
    spreads = [float(np.sqrt(np.square(points).sum(axis=1).mean())) for points in centred]
    if min(spreads) < 1e-9 * max(1.0, *(float(np.abs(poses[:, :3, 3]).max()) for poses in (own, truth))):
        return None
    covariance = centred[1].T @ centred[0] / (spreads[0] * spreads[1])
    covariance = covariance + np.einsum("nij,nkj->ik", truth[:, :3, :3], own[:, :3, :3])
    u, _, vt = np.linalg.svd(covariance)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * signs) @ vt
    scale = float((centred[1] * (centred[0] @ rotation.T)).sum() / np.square(centred[0]).sum())
    if not 1e-6 < scale < 1e6:
        return None
    shift = truth[:, :3, 3].mean(axis=0) - scale * rotation @ own[:, :3, 3].mean(axis=0)
    try:
        return Pose(rotation, shift, scale)
    except InputError:
        return None


def seen_alike(pose: Pose, matches: Sequence[Match], points: Array) -> Pose:
    """`pose`, moved until the true cameras see `points` [P, 3] of the reconstruction where its own cameras do: least
    squares of their distances in the pictures, those of more than a thousandth of the width pulling less.

    Where a camera is off, its position and axes are together, so that its picture fits: each alone says less.
    """
    points = points[np.random.default_rng(0).permutation(len(points))[:POINTS]]
    own, true = ([pair[side].camera for pair in matches] for side in (0, 1))
    seen = places_in_pictures(own, points)
    known = np.isfinite(seen) & np.isfinite(places_in_pictures(true, pose.points(points)))
    if known.sum() < FEWEST:
        return pose
    middle = pose.points(points).mean(axis=0)
    size = float(np.median([np.linalg.norm(camera.position - middle) for camera in true]))

    def moved(steps: Array) -> Pose:
        turn, scale = Rotation.from_rotvec(steps[:3]).as_matrix(), float(np.exp(steps[6]))
        return Pose(turn, middle + size * steps[3:6] - scale * turn @ middle, scale).after(pose)

    def apart(steps: Array) -> Array:
        off = (places_in_pictures(true, moved(steps).points(points)) - seen)[known]
        return np.nan_to_num(off, nan=1.0)

    return moved(least_squares(apart, np.zeros(7), loss="soft_l1", f_scale=1e-3).x)


def places_in_pictures(cameras: Sequence[Camera], points: Array) -> Array:
    """[N, P, 2] where each camera's picture shows each point, in widths; NaN behind it."""
    places = np.array([camera.world_from_camera for camera in cameras])
    lens = np.array([np.array([(c.fx, c.fy), (c.cx, c.cy)]) / c.width for c in cameras])[:, :, None]
    local = np.einsum("nji,npj->npi", places[:, :3, :3], points - places[:, None, :3, 3])
    depth = np.where(local[..., 2:] > 0, local[..., 2:], np.nan)
    return np.asarray(lens[:, 0] * local[..., :2] / depth + lens[:, 1])


def residuals(pose: Pose, own: Array, truth: Array) -> tuple[Array, Array]:
    """(metres between positions [N], degrees between axes [N]) once `pose` has moved the one."""
    away = np.linalg.norm(pose.points(own[:, :3, 3]) - truth[:, :3, 3], axis=1)
    turns = np.einsum("nji,njk->nik", truth[:, :3, :3], pose.rotation @ own[:, :3, :3])
    half = [np.arctan2(np.linalg.norm(q[1:]), abs(q[0])) for q in map(quaternion_from_rotation, turns)]
    return away, np.degrees(2 * np.array(half))


def _candidate_pairs(count: int) -> list[tuple[int, int]]:
    every = [(i, j) for i in range(count) for j in range(i)]
    if len(every) <= PAIRS:
        return every
    return [every[k] for k in np.random.default_rng(0).choice(len(every), PAIRS, replace=False)]


K = TypeVar("K", bound=Hashable)


def _pairs(own: Mapping[K, Frame], truth: Mapping[K, Frame]) -> list[Match]:
    return [(frame, truth[key]) for key, frame in own.items() if key in truth]


def _by_key(dataset: Dataset) -> dict[int, Frame]:
    """{`KEY`: frame}; {} where not every frame has one of its own."""
    try:
        meta = read_json(dataset.root / "transforms.json", MAX_LIST_BYTES)
        entries = {str(PurePosixPath(entry["file_path"])): entry[KEY] for entry in meta["frames"]}
        numbers = {int(entries[frame.file_path]): frame for frame in dataset.frames}
    except (InputError, KeyError, TypeError, ValueError, OverflowError):
        return {}
    return numbers if len(numbers) == len(dataset.frames) else {}


def _by_stem(dataset: Dataset) -> dict[str, Frame]:
    """{stem: frame}; of stems that two frames share neither."""
    stems = [Path(frame.file_path).stem for frame in dataset.frames]
    return {stem: frame for stem, frame in zip(stems, dataset.frames, strict=True) if stems.count(stem) == 1}


def _counted(dataset: Dataset) -> dict[int, Frame]:
    return dict(enumerate(sorted(dataset.frames, key=_natural)))


def _natural(frame: Frame) -> list[tuple[int, str]]:
    """Sorts numbers in file paths by their value."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", frame.file_path)]
