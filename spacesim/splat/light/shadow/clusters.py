"""Several light cameras for scenes that one does not resolve (thesis 4.3.5, algorithm 3).

One orthographic image as wide as two spacecraft and the kilometre between them has no pixels left for either. So the
set is split in light space until every part fits an image of enough pixels a metre; each part gets a camera of its own,
and every Gaussian the occlusion from one image that covers it. A camera has no planes in depth, so whatever stands
between the Sun and its image casts into it, whichever part it belongs to.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Array3f, Array4f, Float
from spacesim.backend.upload import upload
from spacesim.data.geometry import Array
from spacesim.splat.light.padded_batch import PaddedBatch
from spacesim.splat.light.shadow.light_camera import (
    MARGIN,
    MIN_EXTENT_SHARE,
    SUPPORT,
    drawable_mask,
    fit_camera,
    light_axes,
    light_rows,
)
from spacesim.splat.raster.cameras import Orthographic, OrthographicCamera
from spacesim.splat.raster.gaussians import Gaussians, principal_axes

MEANINGFUL_GAP = 0.05  #: of a cluster's extent: a narrower gap between supports is no place to split at
MAX_CAMERAS = 8  #: K of algorithm 3: the thesis does not say
MAX_SUPPORT_SHARE = 0.5  #: of an image, see `assign_cameras`
STRAYS = 1e-3  #: share of the Gaussians that the one camera of a compact set may leave out
MIN_EXTENT = 1e-6  #: metres that an image covers at least: a point has no extent
ROUNDING = 1e-9  #: by which a scale may seem to fall short of the least one

Indices = NDArray[np.intp]
Occlude = Callable[[Gaussians, Orthographic], Float]


def occlusion_in_clusters(
    gaussians: Gaussians,
    direction: ArrayLike,
    size: int,
    least_scale: float,
    occlude: Occlude,
    most: int = MAX_CAMERAS,
    crop: bool = True,
) -> Float:
    """Float [N] in [0, 1], detached: the raw occlusion of each Gaussian, seen at enough pixels a metre.

    direction: [3], from the scene towards the Sun;  size: pixels of each side of a light image;  least_scale: f_min of
    algorithm 3, pixels a metre;  occlude: (gaussians, camera) -> Float [N], `occlusion_by_mapping` for one;  most:
    cameras at most, K of algorithm 3;  crop: of the one camera of a compact set, see `fit_camera`

    A set that fits one image, but for a share of `STRAYS` beyond it, has the one camera of `fit_camera`, as in
    training, which is tried first: whether it suffices is four numbers that are there by then. Else the largest cluster
    goes first. Another cluster gets an image only for those of its Gaussians that no image before has covered at
    `least_scale` (4.3.5), fitted to these alone.
    Raises ValueError for a size, scale or number of cameras that is not positive.
    """
    _check(size, least_scale, most)
    if gaussians.count == 0:
        return dr.zeros(ad.Float, 0)
    camera, coverage = _fitted(_shapes(gaussians), light_rows(direction), size, crop, PaddedBatch.of(gaussians.count))
    occlusion: Any = occlude(gaussians, camera)
    if _is_one_camera_enough(coverage, least_scale):
        return occlusion
    axes = light_axes(direction)
    cameras, receivers = assign_cameras(light_supports(gaussians, direction), axes, size, least_scale, most)
    camera_of = np.zeros(gaussians.count, np.uint32)
    for k, members in enumerate(receivers):
        camera_of[members] = k
    chosen, occlusion = upload(camera_of, ad.UInt32), None
    for k, record in enumerate(cameras):
        seen = occlude(gaussians, Orthographic.of(record))
        served = chosen == dr.opaque(ad.UInt32, k)
        occlusion = seen if occlusion is None else dr.select(served, seen, occlusion)
        dr.eval(occlusion)
    return occlusion


@dataclass(frozen=True, eq=False)
class Supports:
    """Gaussians in light space; NaN where one cannot be drawn."""

    positions: Array  #: [N, 3] metres, R_l^T mu (4.29, t_l being the world's origin)
    radii: Array  #: [N, 2] metres, three standard deviations across the light (4.31)


def light_supports(gaussians: Gaussians, direction: ArrayLike) -> Supports:
    """Where N Gaussians are in the light frame, and how wide (4.29 to 4.31)."""
    shapes = _shapes(gaussians)
    radii = np.stack([np.array(radius, np.float64) for radius in _radii(shapes, light_rows(direction))], axis=-1)
    means = np.where(np.isnan(radii[:, :1]), np.nan, np.array(shapes[0], dtype=np.float64).T)
    return Supports(means @ light_axes(direction), radii)


def assign_cameras(
    supports: Supports, axes: Array, size: int, least_scale: float, most: int = MAX_CAMERAS
) -> tuple[list[OrthographicCamera], list[Indices]]:
    """(cameras, indices of the Gaussians that each serves), the primary one first; every Gaussian that can be drawn is
    served by one camera (4.3.5). Arguments as in `occlusion_in_clusters`.

    A support wider than `MAX_SUPPORT_SHARE` of an image at `least_scale` counts as that wide: a veil over the whole
    model would else have it cut to pieces, none of which is any smaller.
    """
    widest = 0.5 * MAX_SUPPORT_SHARE * _footprint(size, least_scale)
    supports = Supports(supports.positions, np.minimum(supports.radii, widest))
    centres, radii = supports.positions[:, :2], supports.radii
    left = clusters(centres, radii, size, least_scale, most)
    cameras: list[OrthographicCamera] = []
    receivers: list[Indices] = []
    while left:
        members, *left = left
        cameras.append(light_cameras(supports, [members], axes, size)[0])
        if min(cameras[-1].scale_x, cameras[-1].scale_y) < least_scale * (1 - ROUNDING):
            receivers.append(members)
            continue
        low, high = _bounds(members, centres, radii)
        covered = np.all((centres - radii >= low) & (centres + radii <= high), axis=1)
        taken = [part[covered[part]] for part in left]
        receivers.append(np.sort(np.concatenate([members, *taken])))
        left = [rest for part in left if len(rest := part[~covered[part]])]
    return cameras, receivers


def clusters(
    centres: ArrayLike, radii: ArrayLike, size: int, least_scale: float, most: int = MAX_CAMERAS
) -> list[Indices]:
    """Algorithm 3, lines 5 to 19: parts of a set that each fit an image of size x size pixels at `least_scale` pixels a
    metre, or `most` parts of which some do not. Arrays of indices, ascending; the largest part (most members) first.

    centres, radii: [N, 2] metres in light space. Every finite one is in exactly one part, others are in none. Of the
    parts that do not fit, the one with most members is split next. Members that are alike but for their place in the
    arrays are interchangeable; else the parts do not depend on the order.
    """
    _check(size, least_scale, most)
    centres, radii = (np.asarray(values, np.float64).reshape(-1, 2) for values in (centres, radii))
    usable = np.flatnonzero((np.isfinite(centres) & np.isfinite(radii)).all(axis=1))
    footprint = _footprint(size, least_scale)
    waiting, fitting = [usable] if len(usable) else [], list[Indices]()
    while waiting and len(waiting) + len(fitting) < most:
        waiting.sort(key=lambda members: _rank(members, centres, radii))
        members = waiting.pop(0)
        low, high = _bounds(members, centres, radii)
        extent = high - low
        if extent.max() <= footprint or len(members) == 1:
            fitting.append(members)
        else:
            waiting += _split(members, centres, radii, axis=int(extent.argmax()))
    ordered = sorted(waiting + fitting, key=lambda members: _rank(members, centres, radii))
    return [np.sort(members) for members in ordered]


def light_cameras(supports: Supports, groups: Sequence[Indices], axes: Array, size: int) -> list[OrthographicCamera]:
    """A camera of size x size pixels for each of `groups` (indices): it covers their supports and a margin of a pixel
    (4.32 to 4.35). Its origin lies in the middle of its image, at the members' mean depth, so that depths are small.

    axes: [3, 3] columns are the light camera's axes in the world
    """
    cameras = []
    for members in groups:
        low, high = _bounds(members, supports.positions[:, :2], supports.radii)
        extent = high - low
        scale = (size - 2 * MARGIN) / np.maximum(extent, max(MIN_EXTENT_SHARE * extent.max(), MIN_EXTENT))
        pose = np.eye(4)
        pose[:3, :3] = axes
        pose[:3, 3] = axes @ [*(0.5 * (low + high)), supports.positions[members, 2].mean()]
        scale_x, scale_y = scale.tolist()
        cameras.append(OrthographicCamera(pose, size, size, scale_x, scale_y, 0.5 * size, 0.5 * size))
    return cameras


def _split(members: Indices, centres: Array, radii: Array, axis: int) -> list[Indices]:
    """Two parts: on both sides of the widest gap between supports along `axis` (lines 15, 16), else of the median."""
    keys = radii[members, 1], radii[members, 0], centres[members, 1 - axis], centres[members, axis]
    members = members[np.lexsort(keys)]
    low, high = (centres[members, axis] + sign * radii[members, axis] for sign in (-1, 1))
    gaps = np.minimum.accumulate(low[::-1])[::-1][1:] - np.maximum.accumulate(high)[:-1]
    widest = int(gaps.argmax())
    meaningful = gaps[widest] > MEANINGFUL_GAP * (high.max() - low.min())
    cut = widest + 1 if meaningful else len(members) // 2
    return [members[:cut], members[cut:]]


def _bounds(members: Indices, centres: Array, radii: Array) -> tuple[Array, Array]:
    """(lowest, highest) x and y of the supports, [2] metres each (4.32)."""
    return (centres[members] - radii[members]).min(axis=0), (centres[members] + radii[members]).max(axis=0)


def _rank(members: Indices, centres: Array, radii: Array) -> tuple[float, ...]:
    """Orders clusters: more members first, then by place."""
    low, high = _bounds(members, centres, radii)
    return (-len(members), *low, *high)


Shapes = tuple[Array3f, Array3f, Array4f, Float]  #: means, log scales, quaternions, logit opacities


def _shapes(gaussians: Gaussians) -> Shapes:
    """(means, log scales, quaternions, logit opacities), detached."""
    names = ("means", "log_scales", "quaternions", "logit_opacities")
    return tuple(dr.detach(getattr(gaussians, name)) for name in names)


def _is_one_camera_enough(coverage: Float, least_scale: float) -> bool:
    """Does one camera cover the Gaussians, but for `STRAYS`, at `least_scale`? Waits for the device."""
    scale_x, scale_y, covered, drawn = np.array(coverage, dtype=np.float64)
    return bool(drawn == 0 or (min(scale_x, scale_y) >= least_scale and drawn - covered <= STRAYS * drawn))


@recorded
def _fitted(shapes: Shapes, light: Float, size: int, crop: bool, batch: PaddedBatch) -> tuple[Orthographic, Float]:
    """(the one camera of a compact set, Float [4]: its pixels a metre in x and y, how many Gaussians have their centre
    in its image, how many can be drawn). Counts are exact to 2^24."""
    means, log_scales, quaternions, logits = shapes
    camera = fit_camera(Gaussians(means, log_scales, quaternions, logits, ad.ArrayXf([])), light, size, crop, batch)
    drawn = drawable_mask(*shapes)
    screen = camera.screen(camera.transform(dr.select(drawn, means, ad.Array3f(0))))
    inside = drawn & (screen.x >= 0) & (screen.x <= size) & (screen.y >= 0) & (screen.y <= size)
    ones = [dr.select(mask, ad.Float(1), 0) for mask in (inside, drawn)]
    counts = [dr.sum(ones_of) for ones_of in ones]
    return camera, dr.concat([camera[12], camera[13], *counts])


@recorded
def _radii(shapes: Shapes, light: Float) -> list[Float]:
    """Three standard deviations along the light frame's x and y, [N] metres each (4.30, 4.31); NaN where a
    Gaussian cannot be drawn."""
    _, log_scales, quaternions, _ = shapes
    drawn = drawable_mask(*shapes)
    scales = dr.exp(dr.select(drawn, log_scales, ad.Array3f(0)))
    scaled_axes = [axis * scales[a] for a, axis in enumerate(principal_axes(quaternions))]
    radii = []
    for i in range(2):
        across = ad.Array3f([dr.gather(ad.Float, light, ad.UInt32(3 * i + j)) for j in range(3)])
        radius = SUPPORT * dr.norm(ad.Array3f([dr.dot(across, axis) for axis in scaled_axes]))
        radii.append(dr.select(drawn, radius, dr.nan))
    return radii


def _footprint(size: int, least_scale: float) -> float:
    """Metres that an image of so many pixels a side covers, but for its margin, at `least_scale` pixels a metre."""
    return (size - 2 * MARGIN) / (least_scale * (1 - ROUNDING))


def _check(size: int, least_scale: float, most: int) -> None:
    for name, value, least in (("size", size, 4), ("most", most, 1)):
        if value < least:
            raise ValueError(f"{name}: expected at least {least}, found {value}")
    if not (np.isfinite(least_scale) and least_scale > 0):
        raise ValueError(f"least_scale: expected a positive number of pixels a metre, found {least_scale}")
