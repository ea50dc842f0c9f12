"""Where a camera stood, with no guess: a trained model drawn from all around, compared by silhouette and brightness.

A picture's object has a middle and an area. About that middle and in units of that size it is compared with views of
the model, which are cut out in the same way, in all turns about the line of sight; middle, size and turn then say the
rest of the pose. The best few are compared by pictures drawn at these poses, and refined.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from spacesim.data.errors import InputError
from spacesim.data.geometry import Array, fibonacci_sphere, look_at
from spacesim.data.images import luminance
from spacesim.data.records import Camera, Image, Sun
from spacesim.data.structure import checked
from spacesim.learning.rendering import checked_sun
from spacesim.splat.pose.motion import twist_between
from spacesim.splat.pose.picture import GAINS, SunlitRun, checked_picture, reduced
from spacesim.splat.pose.refine import RefinedPose, refine_pose
from spacesim.splat.run import Predictor, Run, check_gaussians, check_picture

DIRECTIONS = 300  #: from which the model is drawn: 12 degrees apart
TURNS = 36  #: about the line of sight
SIDE = 64  #: pixels of these views
FOV_DEG = 20.0  #: of these views
PATCH, EXTENT = 32, 3.5  #: pixels of what is compared, and half its side in radii of a disc of the object's area
SOFT = 1.0  #: pixels of a patch: standard deviation of its blur
CANDIDATES = 24  #: poses that are drawn and compared as pictures
APART = 12.0  #: degrees between them
TRIED, WORSE = 3, 2.0  #: poses that are refined, at most, and how many times worse than the best one they may be
WITHIN = 12.0, 0.25  #: degrees and share of the distance by which these may be off: 8 degrees round the object are 14 %
COARSE = 96  #: pixels that the longer side of pictures keeps while poses are compared
DIM = 0.04  #: sRGB value above the sky's from which on a pixel is the object's
NOISE = 5.0  #: standard deviations of the sky
SPECK = 0.02  #: of all that is bright: smaller spots, stars, do not count
AS_GOOD, OTHER = 1.15, 10.0  #: a pose so much worse explains a picture as well; degrees from which on it is another
EXPLAINED = 0.5  #: share of a picture's light that a trusted pose leaves unexplained, at most


@dataclass(frozen=True, eq=False)
class FoundPose:
    """A pose found without a guess, or refined from one."""

    pose: RefinedPose  #: its `converged` is False where another pose explains the picture as well, too
    residual: float  #: sum of squares of what picture and model differ by, over that of the picture less its sky
    ambiguous: bool  #: whether a pose that is another by more than 10 degrees explains it as well


@dataclass(frozen=True, eq=False)
class _Cut:
    """An object in a picture."""

    column: float  #: of its middle, pixels
    row: float
    radius: float  #: of a disc of its area, pixels
    planes: np.ndarray  #: [H, W, 2] mask and brightness


@dataclass(frozen=True, eq=False)
class ModelViews:
    """A run under one Sun, seen from all around. Making it takes as long as drawing 300 small pictures."""

    centre: Array  #: [3] metres, of the model
    cameras: tuple[Camera, ...]  #: [D], from where it is seen
    cuts: tuple[_Cut, ...]  #: [D], the model as each of these sees it
    patches: np.ndarray  #: [D, 2, PATCH * PATCH] each of length 1
    by_alpha: bool  #: whether masks are alpha, not what is bright

    @staticmethod
    def of(run: Run, sun: Sun | None, by_alpha: bool) -> "ModelViews":
        """Raises InputError for a model without opaque Gaussians."""
        arrays = run.gaussians.to_numpy()
        finite = np.isfinite(arrays["means"]).all(axis=1) & (arrays["logit_opacities"] > -2)
        points = arrays["means"][finite].astype(np.float64)
        if len(points) == 0:
            raise InputError("run: expected a model with opaque Gaussians, found none")
        low, high = np.quantile(points, (0.005, 0.995), axis=0)
        centre, radius = 0.5 * (low + high), 0.55 * float(np.linalg.norm(high - low)) + 1e-6
        distance = radius / np.sin(np.radians(0.5 * FOV_DEG))
        drawing, cameras, cuts, patches = SunlitRun.of(run, sun), [], [], []
        for direction in fibonacci_sphere(DIRECTIONS):
            camera = Camera.from_fov(look_at(centre + distance * direction, centre), SIDE, SIDE, FOV_DEG)
            picture = drawing.draw(camera, drawing.shade(camera))
            cut = _cut(np.clip(picture[..., :3], 0, None), picture[..., 3] if by_alpha else None, DIM)
            if cut is not None:
                cameras.append(camera)
                cuts.append(cut)
                patches.append(_patch(cut, 0.0))
        if not cuts:
            raise InputError("run: expected a model of which something is bright, found none")
        return ModelViews(centre, tuple(cameras), tuple(cuts), np.array(patches), by_alpha)

    def poses(self, cut: _Cut, camera: Camera, count: int) -> list[Camera]:
        """`camera` where its picture `cut` is most like this, the best first, each by `APART` from those before."""
        turns = 2 * np.pi * np.arange(TURNS) / TURNS
        seen = np.array([_patch(cut, turn) for turn in turns])
        likeness = np.einsum("tkp,dkp->dt", seen, self.patches, optimize=True)
        poses: list[Camera] = []
        for place in np.argsort(-likeness, axis=None, kind="stable")[: 40 * count]:
            view, turn = np.unravel_index(int(place), likeness.shape)
            there = self._placed(int(view), float(turns[turn]), cut, camera)
            if all(_degrees(there, other) > APART for other in poses):
                poses.append(there)
                if len(poses) == count:
                    break
        return poses

    def _placed(self, view: int, turn: float, cut: _Cut, camera: Camera) -> Camera:
        """`camera` before which the model looks as in a view that is turned, moved and scaled to `cut`."""
        from scipy.spatial.transform import Rotation

        drawn, theirs = self.cameras[view], self.cuts[view]
        scale = cut.radius / theirs.radius
        roll = Rotation.from_rotvec([0, 0, turn]).as_matrix()
        offset = scale * roll[:2, :2] @ [theirs.column - drawn.cx, theirs.row - drawn.cy]
        ray = np.array(
            [(cut.column - offset[0] - camera.cx) / camera.fx, (cut.row - offset[1] - camera.cy) / camera.fy, 1]
        )
        ray /= np.linalg.norm(ray)
        away = float(np.linalg.norm(drawn.position - self.centre))
        distance = away * np.sqrt(camera.fx * camera.fy) / drawn.fx / scale
        axis = np.cross([0, 0, 1], ray)
        angle = np.arctan2(np.linalg.norm(axis), ray[2])
        pan = Rotation.from_rotvec(angle * axis / max(float(np.linalg.norm(axis)), 1e-12)).as_matrix()
        rotation = (pan @ roll @ drawn.camera_from_world[:3, :3]).T
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, self.centre - rotation @ (distance * ray)
        return replace(camera, world_from_camera=pose)


@checked
def find_pose(
    run: Predictor | str | Path,
    image: str | Path | ArrayLike | Image,
    camera: Camera,
    sun: Sun | Sequence[float] | None = None,
    mask: ArrayLike | None = None,
    seed: int = 0,
    views: ModelViews | None = None,
) -> FoundPose:
    """The pose from which the model of `run` looks most like `image`, wherever that is.

    run, image: as for `refine_pose`, with one object before a sky of one colour, or with alpha
    camera: size and intrinsics of the picture; its pose does not matter
    sun, mask, seed: as for `refine_pose`; views: of the same run and Sun, to save time with many pictures

    Raises InputError as `refine_pose` does, and where nothing in the picture is brighter than its sky.
    """
    run = check_gaussians(run)
    direction = checked_sun(sun, run.relightable, f"a run of {run.config['method']}")
    target, counts = checked_picture(image, mask, camera)
    check_picture(camera)
    factor = max(1, max(camera.width, camera.height) // COARSE)
    coarse = camera.downscaled(factor)
    small, known = reduced(target * counts, factor), reduced(counts, factor)
    sky, dim = _sky(small, known)
    has_alpha = small.shape[2] == 4
    cut = _cut(np.abs(small[..., :3] - sky) * known, small[..., 3] if has_alpha else None, dim)
    if cut is None:
        raise InputError("image: expected an object that is brighter than the sky, found none")
    views = views or ModelViews.of(run, direction, has_alpha)
    drawing = SunlitRun.of(run, direction)
    starts = [_rank(drawing, pose, small, known, sky) for pose in views.poses(cut, coarse, CANDIDATES)]
    starts.sort(key=lambda pair: pair[0])
    tried: list[tuple[float, RefinedPose]] = []
    failure: InputError | None = None
    for worth, start in starts[:TRIED]:
        if worth > WORSE * starts[0][0]:
            break
        try:
            placed = replace(camera, world_from_camera=start.world_from_camera)
            refined = refine_pose(run, image, placed, direction, mask, WITHIN, 2, seed)
            if not refined.converged:  # it may have gone as far as it may: on from there
                refined = refine_pose(run, image, refined.camera, direction, mask, WITHIN, 1, seed)
        except InputError as error:  # of a pose from which nothing is seen
            failure = error
            continue
        tried.append((_residual(drawing, refined.camera, target, counts, sky), refined))
    if not tried:
        raise failure or InputError("image: expected one that is like a view of the model, found none")
    return best_of(tried)


def best_of(tried: Sequence[tuple[float, RefinedPose]]) -> FoundPose:
    """Of (residual, pose), the one of the least residual."""
    residual, best = min(tried, key=lambda pair: pair[0])
    rivals = [
        pose for other, pose in tried if other <= AS_GOOD * residual and _degrees(pose.camera, best.camera) > OTHER
    ]
    trusted = best.converged and residual < EXPLAINED and not rivals
    return FoundPose(replace(best, converged=trusted), residual, bool(rivals))


def residual_of(
    run: Run, image: ArrayLike | Image, pose: RefinedPose, sun: Sun | None = None, mask: ArrayLike | None = None
) -> float:
    """That of `FoundPose`, of a refined pose."""
    target, counts = checked_picture(image, mask, pose.camera)
    return _residual(SunlitRun.of(run, sun), pose.camera, target, counts, _sky(target, counts)[0])


def _residual(drawing: SunlitRun, camera: Camera, target: np.ndarray, counts: np.ndarray, sky: np.ndarray) -> float:
    return _compared(drawing.draw(camera, drawing.shade(camera)), target, counts, sky)


def _rank(
    drawing: SunlitRun, camera: Camera, target: np.ndarray, counts: np.ndarray, sky: np.ndarray
) -> tuple[float, Camera]:
    """How far the picture drawn there is from the target, both blurred, and the camera."""
    from scipy.ndimage import gaussian_filter

    drawn = drawing.draw(camera, drawing.shade(camera))
    soft = [gaussian_filter(planes, (1.5, 1.5, 0), mode="nearest") for planes in (drawn, target)]
    return _compared(soft[0], soft[1], counts, sky), camera


def _compared(drawn: np.ndarray, target: np.ndarray, counts: np.ndarray, sky: np.ndarray) -> float:
    """Sum of squares of differences over that of the picture less its sky, with the best gain."""
    light, alpha = drawn[..., :3], drawn[..., 3:]
    if target.shape[2] == 4:  # premultiplied: the sky is what alpha says
        shown = target[..., :3]
        rest = (counts * (target[..., 3:] - alpha) ** 2).sum()
        whole = (counts * target[..., 3:] ** 2).sum()
    else:
        shown, rest, whole = target - (1 - alpha) * sky, 0.0, 0.0
    gain = float(np.clip((counts * light * shown).sum() / max((counts * light * light).sum(), 1e-12), *GAINS))
    own = shown if target.shape[2] == 4 else target - sky
    differences = (counts * (shown - gain * light) ** 2).sum() + rest
    return float(differences / max((counts * own**2).sum() + whole, 1e-12))


def _sky(target: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, float]:
    """([3] median colour along the border, sRGB value above it from which on something is seen)."""
    if target.shape[2] == 4:
        return np.zeros(3, np.float32), DIM
    border = np.ones(target.shape[:2], bool)
    wide = max(1, min(target.shape[:2]) // 16)
    border[wide:-wide, wide:-wide] = False
    around = target[border & (counts[..., 0] > 0.99)]
    if not len(around):
        return np.zeros(3, np.float32), DIM
    sky = np.median(around, axis=0)
    spread = 1.4826 * float(np.median(np.abs(luminance(around) - luminance(sky))))
    return sky.astype(np.float32), max(DIM, NOISE * spread)


def _cut(light: np.ndarray, alpha: np.ndarray | None, dim: float) -> _Cut | None:
    """What is to be seen of light [H, W, 3] over black, where alpha [H, W] or brightness says; None of nothing."""
    bright = np.asarray(luminance(light), np.float32)
    mask = alpha > 0.5 if alpha is not None else _without_specks(bright > dim)
    if not mask.any():
        return None
    weight = mask.astype(np.float32) if alpha is None else alpha * mask
    rows, columns = np.indices(mask.shape) + 0.5
    area = float(weight.sum())
    return _Cut(
        column=float((weight * columns).sum() / area),
        row=float((weight * rows).sum() / area),
        radius=float(np.sqrt(area / np.pi)),
        planes=np.stack([weight, bright * mask], axis=-1),
    )


def _without_specks(mask: np.ndarray) -> np.ndarray:
    """Without spots that are small against all of it."""
    from scipy.ndimage import label

    spots, _ = label(mask, np.ones((3, 3)))
    sizes = np.bincount(spots.ravel())
    sizes[0] = 0
    return np.asarray(mask & (sizes[spots] >= max(SPECK * mask.sum(), min(4, sizes.max()))))


def _patch(cut: _Cut, turn: float) -> np.ndarray:
    """[2, PATCH * PATCH] of mask and brightness about the middle, in units of the radius, turned back; each of length
    1 over the square root of 2."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    steps = (np.arange(PATCH) + 0.5 - PATCH / 2) * (2 * EXTENT / PATCH) * cut.radius
    x, y = np.meshgrid(steps, steps)
    places = [
        cut.row - 0.5 + np.sin(turn) * x + np.cos(turn) * y,
        cut.column - 0.5 + np.cos(turn) * x - np.sin(turn) * y,
    ]
    blur = max(0.0, SOFT * 2 * EXTENT / PATCH * cut.radius)
    planes = [
        map_coordinates(gaussian_filter(cut.planes[..., k], blur), places, order=1, output=np.float32).ravel()
        for k in (0, 1)
    ]
    return np.stack([plane / max(float(np.linalg.norm(plane)), 1e-9) * np.sqrt(0.5) for plane in planes])


def _degrees(camera: Camera, other: Camera) -> float:
    """Between the attitudes of two cameras."""
    return float(np.degrees(np.linalg.norm(twist_between(camera, other)[:3])))
