"""Which parts of a picture may show the scene: paths through the others are not traced, which changes no bit (but where
two surfaces share a place: Embree chooses by what it traces at once).

A triangle covers at most the tiles that its projection, widened by a margin, reaches (J. Hasselgren, T. Akenine-Möller
and L. Ohlsson, "Conservative rasterization", GPU Gems 2, 2005).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, reduce

import drjit as dr
import numpy as np

from spacesim import backend
from spacesim.backend import mitsuba_types as mt
from spacesim.backend.arrays import Bool, Float, Int32, UInt32
from spacesim.backend.upload import upload
from spacesim.data.images import undistort_points
from spacesim.data.records import Camera
from spacesim.scenes.cameras.kernel_camera import RADIUS, KernelCamera, Units, record_on_cuda
from spacesim.scenes.lights.emitters import kernel_input
from spacesim.scenes.scene import Scene

TILE = 4  #: pixels of a side
MARGIN = 1.0  #: pixels about a triangle: far more than single precision is off
CLOSE = 1e-3 * RADIUS  #: from the camera's plane: where a triangle that comes closer is seen is not asked
SLACK = 1e-6 * RADIUS  #: by which a triangle is beyond a plane: more than single precision is off
BORDER = 33  #: points along a side of a picture
SPARE = 1.01  #: by which more is shown than these points are apart
WIDEST = 4.0  #: times as wide, at most: what is farther is traced
FARTHEST = 1e5  #: pixels from the picture: edges of triangles with corners beyond are not asked


@dataclass(frozen=True)
class Tiles:
    """Of a picture without distortion, so many times as wide about its centre: where the scene may be seen."""

    marks: Bool  #: [ceil(H / TILE) ceil(W / TILE) + 1], row by row; at the end: all over
    wider: Float  #: times

    def pixels(self, view: KernelCamera) -> UInt32:
        """Those [N] of marked tiles, tile by tile, of a picture that is not wider; waits for the device."""
        marks = self.marks.numpy()
        tiles, side = np.flatnonzero(marks[:-1] | marks[-1])[:, None, None], np.arange(TILE)
        row, column = tiles // _across(view) * TILE + side[:, None], tiles % _across(view) * TILE + side
        is_inside = (row < view.height) & (column < view.width)
        return upload((row * view.width + column)[is_inside], backend.mitsuba().UInt32)

    def may_show(self, view: KernelCamera, x: Float, y: Float) -> Bool:
        """Whether the scene may be seen in directions (x, y, 1) of `view`. Outside the picture it may be anywhere."""
        mi = backend.mitsuba()
        axes = zip((x, y), _focal(view, self.wider), view.centre, strict=True)
        column, row = (at * focal + centre for at, focal, centre in axes)
        is_inside = (column >= 0) & (column < view.width) & (row >= 0) & (row < view.height)
        tile = mi.UInt32(row) // TILE * _across(view) + mi.UInt32(column) // TILE
        marked = dr.gather(mi.Bool, self.marks, tile, is_inside)
        return marked | ~is_inside | dr.gather(mi.Bool, self.marks, mi.UInt32(_count(view)))


class Coverage:
    """Of a scene's pictures. distortion: of the lens, as `Renderer` takes it"""

    def __init__(self, scene: Scene, units: Units, distortion: Sequence[float]) -> None:
        corners = units.points(np.asarray(scene.mesh.triangles).reshape(-1, 3)).reshape(-1, 9)
        self._corners = [upload(column) for column in corners.T]
        self._distortion = tuple(distortion) if any(distortion) else ()
        self._mark = record_on_cuda(_mark_tiles)

    def tiles(self, camera: Camera, view: KernelCamera) -> Tiles:
        """Of what `camera` sees through the lens. view: the same camera"""
        lens = camera.width, camera.height, camera.fx, camera.fy, self._distortion
        wider = kernel_input(_widening(*lens) if self._distortion else 1.0)
        return Tiles(self._mark(view, wider, self._corners), wider)


def _focal(view: KernelCamera, wider: Float) -> list[Float]:
    """Of a picture so many times as wide."""
    return [focal / wider for focal in view.focal]


@lru_cache(maxsize=64)
def _widening(width: int, height: int, fx: float, fy: float, distortion: tuple[float, ...]) -> float:
    """How many times as wide a picture without distortion is, both about their centres, that shows what this one's
    border does."""
    along, end = np.linspace(-1, 1, BORDER), np.ones(BORDER)
    u, v = np.concatenate([[along, end], [along, -end], [end, along], [-end, along]], axis=1)
    with np.errstate(all="ignore"):
        x, y = undistort_points(u * width / (2 * fx), v * height / (2 * fy), distortion)
        times = np.abs([2 * fx / width * x, 2 * fy / height * y])
    return float(min(np.max(times[np.isfinite(times)], initial=1.0) * SPARE, WIDEST))


def _across(view: KernelCamera) -> int:
    return -(-view.width // TILE)


def _down(view: KernelCamera) -> int:
    return -(-view.height // TILE)


def _count(view: KernelCamera) -> int:
    return _across(view) * _down(view)


def _mark_tiles(view: KernelCamera, wider: Float, corners: Sequence[Float]) -> Bool:
    """The tiles that triangles reach, see `Tiles`. corners: x, y and z of each triangle's three, in Mitsuba's
    coordinates, [F]."""
    mi = backend.mitsuba()
    tiles, focals = dr.zeros(mi.Bool, _count(view) + 1), _focal(view, wider)
    sides, depths = _in_camera(view, [mi.Vector3f(corners[k : k + 3]) for k in (0, 3, 6)])
    seen = _largest(depths) > -SLACK
    for side, focal, centre, size in zip(sides, focals, view.centre, (view.width, view.height), strict=True):
        before = [at + (centre + MARGIN) / focal * z for at, z in zip(side, depths, strict=True)]
        after = [at - (size + MARGIN - centre) / focal * z for at, z in zip(side, depths, strict=True)]
        seen &= (_largest(before) > -SLACK) & (_smallest(after) < SLACK)
    is_odd = _largest([dr.abs(centre) for centre in view.centre]) > FARTHEST  # of which rays have few digits
    seen |= is_odd
    is_close = (_smallest(depths) < CLOSE) | is_odd
    dr.scatter(tiles, mi.Bool(True), mi.UInt32(_count(view)), seen & is_close)

    scales = [1 / dr.maximum(depth, CLOSE) for depth in depths]
    x, y = (
        [at * scale * focal + centre for at, scale in zip(side, scales, strict=True)]
        for side, focal, centre in zip(sides, focals, view.centre, strict=True)
    )
    is_far = ~(_largest([dr.abs(value) for value in (*x, *y)]) < FARTHEST)
    left, width = _tile_range(x, _across(view))
    top, height = _tile_range(y, _down(view))
    count = dr.select(seen & ~is_close, width * height, 0)
    across = dr.maximum(width, 1)

    def is_outside(column: Int32, row: Int32) -> Bool:
        """Beyond one of the triangle's edges."""
        centre = [(mi.Float(number) + 0.5) * TILE for number in (column, row)]
        turn = dr.sign((x[1] - x[0]) * (y[2] - y[0]) - (y[1] - y[0]) * (x[2] - x[0]))
        outside = mi.Bool(False)
        for k in range(3):
            along = [values[(k + 1) % 3] - values[k] for values in (x, y)]
            scale = turn / dr.sqrt(dr.maximum(along[0] * along[0] + along[1] * along[1], 1e-20))
            inward = [-along[1] * scale, along[0] * scale]
            distance = inward[0] * (centre[0] - x[k]) + inward[1] * (centre[1] - y[k])
            outside |= distance + (dr.abs(inward[0]) + dr.abs(inward[1])) * (0.5 * TILE) < -MARGIN
        return outside

    def mark(number: Int32) -> tuple[Int32]:
        column, row = left + number % across, top + number // across
        dr.scatter(tiles, mi.Bool(True), mi.UInt32(row * _across(view) + column), is_far | ~is_outside(column, row))
        return (number + 1,)

    def has_more(number: Int32) -> Bool:
        return number < count

    dr.while_loop((mi.Int32(0),), has_more, mark, mode="symbolic", label="tiles of triangles")
    return tiles


def _in_camera(
    view: KernelCamera, points: Sequence[mt.Vector3f]
) -> tuple[tuple[list[Float], list[Float]], list[Float]]:
    """((to the right, down), depth) of points along the axes of `KernelCamera.rays`, which need not stand exactly
    upright on each other."""
    right, down, forward = view.right, view.down, view.forward
    duals = [dr.cross(down, forward), dr.cross(forward, right), dr.cross(right, down)]
    volume = dr.dot(right, duals[0])
    arms = [point - view.start for point in points]
    x, y, z = ([dr.dot(arm, dual) / volume for arm in arms] for dual in duals)
    return (x, y), [view.near + depth for depth in z]


def _tile_range(values: Sequence[Float], count: int) -> tuple[Int32, Int32]:
    """(first tile, how many) of `count` in a row that three corners' coordinates, pixels, reach."""
    mi = backend.mitsuba()
    first = mi.Int32(dr.clip(dr.floor((_smallest(values) - MARGIN) / TILE), 0, count))
    last = mi.Int32(dr.clip(dr.floor((_largest(values) + MARGIN) / TILE), -1, count - 1))
    return first, dr.maximum(last - first + 1, 0)


def _smallest(values: Sequence[Float]) -> Float:
    return reduce(dr.minimum, values)


def _largest(values: Sequence[Float]) -> Float:
    return reduce(dr.maximum, values)
