"""The object in pictures whose poses are known, cut out without learned weights.

What is behind an object changes from picture to picture, the object does not. So pictures vote on the voxels of a grid:
where one differs from what surrounds it, it sees the object. A picture's vote counts by how well it told the two apart
in the round before (as in S. K. Warfield et al., "STAPLE", 2004), and voxels that too few see are carved away (K. N.
Kutulakos, S. M. Seitz, "A theory of shape by space carving", 2000). The shape that is left, seen by a picture's camera,
is where the object is; colours around its outline decide the rest. What is dark before a dark sky is known from others.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from spacesim.data.errors import InputError
from spacesim.data.geometry import Array, focus_of
from spacesim.data.images import read_png
from spacesim.data.importers.lenses import Lens
from spacesim.data.importers.masks import AUTO, NO_MASKS, NO_OBJECT, MaskFolder, over_black, read_mask
from spacesim.data.importers.video.segmentation import color_odds, luma_and_chroma, rarity
from spacesim.data.importers.writing import StageProgress

FEW = 20  #: fewer pictures hardly say what the object is
_VOTERS = 300  # pictures that decide the shape
_SIDES = 48, 64, 96, 96  # voxels of the grid's side, round by round
_CROP = 240  # pixels of the longer side at which pictures are looked at
_LEAST = 4  # of its shorter side
_ENLARGED = 3.0  # times, at most: what is done to outlines is meant for objects of a hundred pixels
_MARGIN = 1.4  # times the object's radius: half the side of what is looked at
_SHARES = 0.6, 0.75, 0.92, 0.95  # of the best voxels' votes, which others of the object get, too, round by round
_ASKED = 0.4  # of these: what has less in one round is not asked about in the next
_SEEN = 0.5  # of the votes that the most asked-about voxels can get: others get shares of as many, at least
_PIECE = 0.02  # of the largest piece of the shape: smaller ones are no part of it
_RARE = 5.0  # log-densities that a pixel of the object is rarer than the median of what surrounds it
_DARK, _UNLIT = 0.08, 0.2  # luma of the brightest sky, and what it counts that the object is not seen before it
_REACH = 0.06  # of the object's size: how far colours move an outline


_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class PosedPicture:
    """A picture and from where it was taken."""

    path: Path  #: of the picture, which has the lens's size
    world_from_camera: Array  #: [4, 4], OpenCV axes
    lens: Lens  #: pixels


@dataclass(frozen=True, eq=False)
class Shape:
    """Voxels of an object."""

    points: Array  #: [N, 3] their centres, world axes
    side: float  #: of a voxel
    centre: Array  #: [3] of a ball around them
    radius: float  #: of the ball


def mask_makers(
    masks: str | Path | None, pictures: Mapping[str, PosedPicture], tell: StageProgress, centre: Array | None = None
) -> dict[str, Callable[[], np.ndarray]]:
    """What makes the masks [H, W] bool of pictures, by their names. masks: a folder, "auto", "none" or None.

    centre: [3] where the object is; None: where the cameras look. Raises InputError as `MaskFolder` does, and where no
    object is found.
    """
    if masks is None or str(masks) == NO_MASKS:
        return {}
    if str(masks) != AUTO:
        paths = MaskFolder(Path(masks)).find_all(pictures)
        sizes = {name: (pictures[name].lens.width, pictures[name].lens.height) for name in paths}
        return {name: partial(read_mask, path, *sizes[name]) for name, path in paths.items()}
    views = list(pictures.values())
    if len(views) < FEW:
        _log.warning("masks: %d pictures are few to cut the object out by, it takes %d", len(views), FEW)
    centre = focus_of(np.array([view.world_from_camera for view in views])) if centre is None else centre
    shape = find_shape(views, centre, lambda done, total: tell("cut out", done, total))
    cut = lru_cache(maxsize=1)(lambda name: cut_out(pictures[name], shape))  # a frame asks for its mask twice
    return {name: partial(cut, name) for name in pictures}


def find_shape(pictures: Sequence[PosedPicture], centre: Array, progress: Callable[[int, int], None]) -> Shape:
    """The object near `centre` [3]. progress: called with how much is done, of how much. Raises InputError where there
    is none."""
    step = max(1, -(-len(pictures) // _VOTERS))
    voters = pictures[::step]
    distances = [np.linalg.norm(p.world_from_camera[:3, 3] - centre) for p in voters]
    shape = Shape(np.empty((0, 3)), 0.0, centre, 0.5 * float(np.quantile(distances, 0.1)))
    before: _Grid | None = None
    for number, side in enumerate(_SIDES):
        grid = _Grid.around(shape, side, before)
        got, possible = np.zeros(len(grid.points)), np.full(len(grid.points), 1e-9)
        for k, picture in enumerate(voters):
            view = _look(picture, shape)
            if view is not None:
                votes, weights = _vote(view, shape)
                x, y, inside = view.project(grid.points)
                place = y[inside], x[inside]
                got[inside] += (weights * votes)[place]
                possible[inside] += weights[place]
            progress(number * len(voters) + k + 1, len(_SIDES) * len(voters))
        grid.share[grid.asked] = got / np.maximum(possible, _SEEN * np.quantile(possible, 0.9))
        before, shape = grid, grid.shape(_SHARES[number])
    return shape


def cut_out(picture: PosedPicture, shape: Shape) -> np.ndarray:
    """[H, W] bool: the object of this shape in a picture."""
    height, width = picture.lens.height, picture.lens.width
    mask = np.zeros((height, width), bool)
    view = _look(picture, shape)
    if view is None:
        return mask
    silhouette = _silhouette(view, shape)
    if not silhouette.any():
        return mask
    found = _refined(view.pixels, silhouette)
    left, top, right, bottom = view.box
    grey = Image.fromarray(np.where(found, 255, 0).astype(np.uint8))
    mask[top:bottom, left:right] = np.asarray(grey.resize((right - left, bottom - top), Image.Resampling.BICUBIC)) > 127
    return mask


@dataclass(frozen=True, eq=False)
class _View:
    """The part of a picture in which the object is."""

    pixels: np.ndarray  #: [h, w, 3] luma and two differences of colour
    box: tuple[int, int, int, int]  #: left, top, right and bottom of the part, pixels
    picture: PosedPicture

    def project(self, points: Array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(columns, rows) of points [N, 3], and which are in the part."""
        pose, lens = self.picture.world_from_camera, self.picture.lens
        x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
        ahead = z > 0
        depth = np.where(ahead, z, 1)
        u, v = lens.project(x / depth, y / depth)
        left, top, right, bottom = self.box
        height, width = self.pixels.shape[:2]
        with np.errstate(invalid="ignore"):
            column = np.floor((u - left) * width / (right - left))
            row = np.floor((v - top) * height / (bottom - top))
            inside = ahead & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        return np.where(inside, column, 0).astype(np.intp), np.where(inside, row, 0).astype(np.intp), inside

    def pixels_of(self, length: float, distance: float) -> float:
        """Of a length at a distance from the camera."""
        left, _, right, _ = self.box
        return length * self.picture.lens.fx / distance * self.pixels.shape[1] / (right - left)


def _look(picture: PosedPicture, shape: Shape) -> _View | None:
    """None where the object is not in the picture."""
    pose, lens = picture.world_from_camera, picture.lens
    x, y, z = (shape.centre - pose[:3, 3]) @ pose[:3, :3]
    if z <= 0:
        return None
    u, v = (float(value) for value in lens.project(x / z, y / z))
    reach = _MARGIN * max(lens.fx, lens.fy) * shape.radius / z
    if not np.isfinite([u, v]).all():
        return None
    left, top, right, bottom = (
        int(np.clip(round(value), 0, side))
        for value, side in zip((u - reach, v - reach, u + reach, v + reach), (lens.width, lens.height) * 2, strict=True)
    )
    if min(right - left, bottom - top) < _LEAST:
        return None
    image = Image.fromarray(over_black(read_png(picture.path)))
    scale = min(_ENLARGED, _CROP / max(right - left, bottom - top))
    size = max(_LEAST, round(scale * (right - left))), max(_LEAST, round(scale * (bottom - top)))
    box = left, top, right, bottom
    filter_ = Image.Resampling.BOX if scale < 1 else Image.Resampling.BILINEAR
    return _View(luma_and_chroma(np.asarray(image.resize(size, filter_, box))), box, picture)


def _vote(view: _View, shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """Where the object is seen [h, w] (0 to 1), and how much that is worth [h, w]: little where it is dark, as the
    object's shadowed parts are, too."""
    trust = np.where(view.pixels[..., 0] < _DARK, _UNLIT, 1.0)
    if not len(shape.points):
        score = _smooth(rarity(view.pixels, view.pixels.reshape(-1, 3)))
        return np.clip(score / max(float(np.quantile(score, 0.99)), 1e-3), 0, 1), np.ones(score.shape)
    silhouette = _silhouette(view, shape)
    around = _around(silhouette)
    if not silhouette.any() or not around.any():
        return silhouette.astype(float), 0 * trust
    votes = _smooth(rarity(view.pixels, view.pixels[around])) > _RARE
    weight = max(float(votes[silhouette].mean() - votes[around].mean()), 0.0)
    return votes.astype(float), weight * np.where(votes, 1, trust)


def _smooth(values: np.ndarray) -> np.ndarray:
    return np.asarray(ndimage.gaussian_filter(values, 0.7))


def _around(silhouette: np.ndarray) -> np.ndarray:
    """[h, w] bool: what surrounds the object."""
    size = np.sqrt(silhouette.sum())
    away = ndimage.distance_transform_edt(~silhouette)
    return (away > max(2.0, _REACH * size)) & (away < max(12.0, 0.7 * size))


def _refined(pixels: np.ndarray, silhouette: np.ndarray) -> np.ndarray:
    """[h, w] bool: the silhouette, with its outline where colours say that it is."""
    around = _around(silhouette)
    if not around.any():
        return silhouette
    behind = pixels[around]
    rare = silhouette & (_smooth(rarity(pixels, behind)) > _RARE)
    unlit = np.zeros((max(16, int(rare.sum()) // 2), 3), np.float32)
    unlit[:, 0] = np.quantile(pixels[..., 0], 0.01)
    odds = _smooth(color_odds(pixels, np.concatenate([pixels[rare], unlit]), behind))
    reach = max(2.0, _REACH * np.sqrt(silhouette.sum()))
    signed = np.asarray(ndimage.distance_transform_edt(silhouette) - ndimage.distance_transform_edt(~silhouette))
    found = (odds + 4 * np.clip(signed / reach, -1.5, 1.5) > 0) & (signed > -max(6.0, 5 * reach))
    labels, _ = ndimage.label(found, np.ones((3, 3)))
    found = np.isin(labels, np.setdiff1d(np.unique(labels[silhouette]), 0))
    return np.asarray(ndimage.binary_fill_holes(found))


def _silhouette(view: _View, shape: Shape) -> np.ndarray:
    x, y, inside = view.project(shape.points)
    hit = np.zeros(view.pixels.shape[:2], bool)
    hit[y[inside], x[inside]] = True
    distance = float(np.linalg.norm(view.picture.world_from_camera[:3, 3] - shape.centre))
    if not hit.any():
        return hit
    spread = 0.5 * view.pixels_of(shape.side, distance)
    padded = np.pad(hit, 8)
    closed = ndimage.distance_transform_edt(~padded) <= max(1.0, spread) + 1
    closed = ndimage.distance_transform_edt(closed) > 1.5
    return closed[8:-8, 8:-8] | hit


@dataclass(frozen=True, eq=False)
class _Grid:
    """A cube of voxels."""

    origin: Array  #: [3] its lowest corner
    side: float  #: of a voxel
    share: np.ndarray  #: [n, n, n] of the votes that they get; 0 where none are asked for
    asked: np.ndarray  #: [n, n, n] bool
    points: Array  #: [N, 3] centres of those that are asked about

    @staticmethod
    def around(shape: Shape, count: int, before: "_Grid | None") -> "_Grid":
        side, origin = 2 * shape.radius / count, shape.centre - shape.radius
        asked = np.ones((count, count, count), bool)
        points = origin + side * (np.argwhere(asked) + 0.5)
        if before is not None:
            index = np.floor((points - before.origin) / before.side).astype(np.intp)
            known: np.ndarray = np.asarray(((index >= 0) & (index < len(before.share))).all(axis=1))
            few = before.share <= _ASKED * before.best
            enough: np.ndarray = np.asarray(ndimage.distance_transform_edt(few)) <= 1
            asked[asked] = known & enough[tuple(np.where(known[:, None], index, 0).T)]
            points = points[asked.ravel()]
        return _Grid(origin, side, np.zeros(asked.shape), asked, points)

    @property
    def best(self) -> float:
        """What the best voxels get."""
        return float(np.quantile(self.share, 0.999))

    def shape(self, least: float) -> Shape:
        """Of voxels with at least this share of what the best get, in the largest pieces."""
        full = self.share >= least * max(self.best, 1e-9)
        labels, _ = ndimage.label(full, np.ones((3, 3, 3)))
        sizes = np.bincount(labels.ravel(), weights=self.share.ravel())
        sizes[0] = 0
        if not sizes.max() > 0:
            raise InputError(NO_OBJECT)
        points = self.origin + self.side * (np.argwhere(sizes[labels] > _PIECE * sizes.max()) + 0.5)
        centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
        radius = float(np.linalg.norm(points - centre, axis=1).max()) + 2 * self.side
        return Shape(points, self.side, centre, radius)
