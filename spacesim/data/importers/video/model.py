"""What structure from motion finds, put upright, to scale and about the object."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from spacesim.data.errors import InputError
from spacesim.data.files import JsonValue
from spacesim.data.geometry import Array, degrees_between, normalize

EXTENT = 0.5, 99.5  #: percentiles of points along the longest axis between which an object's length lies
_NEIGHBOURS = 8  # of a point, by whose distance it floats or not
_FLOATING = 4.0  # times the median of that distance
_LEAST_TRACK = 3  # pictures that see a point
_VOXELS = 64  # along an edge of the cube that silhouettes are cut from
_WRONG = 0.02  # share of masks, and one besides, that may be wrong at a voxel
_LONG = 1.5  # times the spread along the next axis: silhouettes from few sides stretch an object that is not long
_LEAST_SIDE = 70.0  # degrees between the longest axis and a view: from ahead silhouettes stretch it


@dataclass(frozen=True, eq=False)
class SfmModel:
    """Poses of pictures, their camera, and points."""

    names: tuple[str, ...]  #: of the pictures that have a pose, sorted
    world_from_camera: Array  #: [N, 4, 4] OpenCV axes
    focal: float  #: pixels
    centre: tuple[float, float]  #: principal point, pixels
    k1: float  #: of Brown-Conrady's radial distortion
    width: int  #: pixels
    height: int  #: pixels
    points: Array  #: [P, 3]
    colors: np.ndarray  #: [P, 3] uint8
    errors: Array  #: [P] mean distance of a point's features from where it is projected, pixels
    seen_by: tuple[tuple[int, ...], ...]  #: of each point, numbers of the pictures that see it
    sizes: tuple[int, ...]  #: pictures of all models that were found, the largest first

    @property
    def positions(self) -> Array:
        """[N, 3] camera centres."""
        return self.world_from_camera[:, :3, 3]

    @property
    def depths(self) -> Array:
        """[N] medians of all points' depths before each camera."""
        return np.array([np.median((self.points - pose[:3, 3]) @ pose[:3, 2]) for pose in self.world_from_camera])


def without_floating(model: SfmModel) -> SfmModel:
    """The model without points that few pictures see or that float away from the others (thesis 6.4.1)."""
    tracks = np.array([len(frames) for frames in model.seen_by])
    kept = np.flatnonzero(tracks >= min(_LEAST_TRACK, tracks.max()))
    if len(kept) > 10 * _NEIGHBOURS:
        points = model.points[kept]
        gaps = cKDTree(points).query(points, _NEIGHBOURS + 1)[0][:, 1:].mean(axis=1)
        kept = kept[gaps <= _FLOATING * np.median(gaps)]
    return with_points(model, kept.tolist())


def without_pictures(model: SfmModel, numbers: Sequence[int]) -> SfmModel:
    """The model without some of its pictures and what these alone see."""
    kept = [k for k in range(len(model.names)) if k not in set(numbers)]
    rows = {k: row for row, k in enumerate(kept)}
    seen_by = tuple(tuple(rows[k] for k in frames if k in rows) for frames in model.seen_by)
    names = tuple(model.names[k] for k in kept)
    model = replace(model, names=names, world_from_camera=model.world_from_camera[kept], seen_by=seen_by)
    return with_points(model, [k for k, frames in enumerate(seen_by) if frames])


def with_points(model: SfmModel, kept: Sequence[int]) -> SfmModel:
    """The model with some of its points only."""
    return replace(
        model,
        points=model.points[kept],
        colors=model.colors[kept],
        errors=model.errors[kept],
        seen_by=tuple(model.seen_by[k] for k in kept),
    )


def hull_length(model: SfmModel, masks: Sequence[np.ndarray]) -> float | None:
    """Length, in the model's unit, of what the silhouettes enclose (Laurentini, "The visual hull concept", 1994) along
    its longest axis; None where no camera sees that axis from the side, where it is not clearly the
    longest, and where silhouettes have no common place.

    masks: [H, W] bool of each picture that has a pose, True where the object is
    """
    views = [(pose, mask) for pose, mask in zip(model.world_from_camera, masks, strict=True) if mask.any()]
    normal, right, angles = np.zeros((3, 3)), np.zeros(3), []
    for pose, mask in views:  # the point nearest to the rays through the silhouettes' middles
        columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
        low, high = np.array([[columns[0], rows[0]], [columns[-1] + 1, rows[-1] + 1]])
        ray = normalize(pose[:3, :3] @ [*((low + high) / 2 - model.centre) / model.focal, 1.0])
        across = np.eye(3) - np.outer(ray, ray)
        normal, right = normal + across, right + across @ pose[:3, 3]
        angles.append(0.5 * float(np.linalg.norm(high - low)) / model.focal)
    if len(views) < 2 or np.linalg.cond(normal) > 1e9:
        return None
    middle = np.linalg.solve(normal, right)
    away = np.array([np.linalg.norm(pose[:3, 3] - middle) for pose, _ in views])
    reach = 1.1 * float(np.max(away * angles))
    ticks = np.linspace(-reach, reach, _VOXELS)
    voxels = middle + np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    outside = np.zeros(len(voxels), int)  # of how many silhouettes
    for pose, mask in views:
        local = (voxels - pose[:3, 3]) @ pose[:3, :3]
        flat = local[:, :2] / np.where(local[:, 2:] > 0, local[:, 2:], np.inf)
        flat *= 1 + model.k1 * np.square(flat).sum(axis=1, keepdims=True)
        pixels = np.floor(model.focal * flat + model.centre)
        shown = (local[:, 2] > 0) & (pixels >= 0).all(axis=1) & (pixels < mask.shape[::-1]).all(axis=1)
        columns, rows = pixels[shown].astype(int).T
        cut_off = mask[[0, -1]].any() or mask[:, [0, -1]].any()  # the object goes on beyond the picture
        missed = np.full(len(voxels), not cut_off)
        missed[shown] = ~mask[rows, columns]
        outside += missed
        kept = outside <= 1 + _WRONG * len(views)
        voxels, outside = voxels[kept], outside[kept]
    if len(voxels) < 8:
        return None
    offsets = voxels - voxels.mean(axis=0)
    squares, axes = np.linalg.eigh(offsets.T @ offsets)
    axis = axes[:, -1]
    rays = normalize(np.array([pose[:3, 3] for pose, _ in views]) - middle)
    if squares[2] < _LONG**2 * squares[1] or np.abs(rays @ axis).min() > np.cos(np.radians(_LEAST_SIDE)):
        return None
    return float(np.ptp(offsets @ axis))


def placed(
    model: SfmModel, length: float | None = None, distance: float | None = None, extent: float | None = None
) -> SfmModel:
    """The model about the origin, z towards where the pictures' upper sides point in the mean, x along the object.

    length: metres of the object along its longest axis
    extent: that length in the model's unit; None: of 99 % of the points
    distance: metres from the cameras to the object's middle, the median
    Without either the unit is that median distance. Raises InputError where both are given.
    """
    if length is not None and distance is not None:
        raise InputError("length, distance: expected one of them, found both")
    middle = np.median(model.points, axis=0)
    offsets = model.points - middle
    axis = np.linalg.svd(offsets - offsets.mean(axis=0), full_matrices=False)[2][0]
    axis = axis if axis[np.argmax(np.abs(axis))] > 0 else -axis
    low, high = np.percentile(offsets @ axis, EXTENT)
    if length is not None:
        scale = length / (extent or high - low)
    else:
        scale = (distance or 1.0) / float(np.median(np.linalg.norm(model.positions - middle, axis=1)))
    up = normalize(-model.world_from_camera[:, :3, 1].mean(axis=0))
    along = axis - (axis @ up) * up
    if np.linalg.norm(along) < 0.1:  # the object stands upright
        along = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    along = normalize(along)
    rotation = np.stack([along, np.cross(up, along), up])
    poses = model.world_from_camera.copy()
    poses[:, :3, :3] = rotation @ poses[:, :3, :3]
    poses[:, :3, 3] = scale * (model.positions - middle) @ rotation.T
    return replace(model, world_from_camera=poses, points=scale * offsets @ rotation.T)


def median_angle(model: SfmModel) -> float:
    """Degrees between the two rays furthest apart on which the median point is seen."""
    centres = model.world_from_camera[:, :3, 3]
    angles = []
    for point, frames in zip(model.points, model.seen_by, strict=True):
        rays = centres[list(frames)] - point
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        angles.append(degrees_between((rays @ rays.T).min()))
    return float(np.median(angles))


def focal_length(width: int, fov: float) -> float:
    """Pixels, of pictures so many pixels wide whose width covers `fov` degrees."""
    return 0.5 * width / math.tan(math.radians(0.5 * fov))


def field_of_view(width: int, focal: float) -> float:
    """The inverse of `focal_length`: degrees."""
    return float(2 * np.degrees(np.arctan(0.5 * width / focal)))


def arc_of(model: SfmModel) -> float:
    """Degrees between the two cameras that lie farthest apart as the origin sees them, at most 180."""
    towards = normalize(model.positions)
    return math.degrees(math.acos(np.clip(min((towards @ one).min() for one in towards), -1, 1)))


def report_of(model: SfmModel, names: Sequence[str]) -> dict[str, JsonValue]:
    """The import's report on it. names: of all pictures."""
    tracks = [len(frames) for frames in model.seen_by]
    centres = np.linalg.norm(model.positions, axis=1)
    extent = np.percentile(model.points, EXTENT, axis=0)
    return {
        "pictures": len(names),
        "registered": list(model.names),
        "not_registered": [name for name in names if name not in set(model.names)],
        "models": list(model.sizes),
        "points": len(model.points),
        "reprojection_error_px": round(float(model.errors.mean()), 4),
        "track_length": {"mean": round(float(np.mean(tracks)), 2), "median": float(np.median(tracks))},
        "focal_length_px": round(model.focal, 3),
        "k1": round(model.k1, 6),
        "distance": [round(float(centres.min()), 6), round(float(centres.max()), 6)],
        "extent": np.round(extent[1] - extent[0], 6).tolist(),
    }
