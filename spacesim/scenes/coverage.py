"""Which parts of a picture may show the scene: paths through the others are not traced, which changes no bit.

A triangle covers at most the tiles that its projection, widened by a margin, reaches (J. Hasselgren, T. Akenine-Möller
and L. Ohlsson, "Conservative rasterization", GPU Gems 2, 2005).
"""

from collections.abc import Sequence

import drjit as dr
import numpy as np

from spacesim import backend
from spacesim.backend.arrays import Bool, Float, Int32, UInt32
from spacesim.backend.upload import upload
from spacesim.scenes.cameras.kernel_camera import RADIUS, KernelCamera, Units, record_on_cuda
from spacesim.scenes.scene import Scene

TILE = 4  #: pixels of a side
MARGIN = 1.0  #: pixels about a triangle: far more than single precision is off
CLOSE = 1e-3 * RADIUS  #: from the camera's plane; a triangle that comes closer may be anywhere in the picture
FARTHEST = 1e5  #: pixels from the picture; so may one with corners beyond, which single precision places badly


class Coverage:
    """Of a scene's pictures. distortion: of the lens, as `Renderer` takes it; where it distorts, all is covered."""

    def __init__(self, scene: Scene, units: Units, distortion: Sequence[float]) -> None:
        corners = units.points(np.asarray(scene.mesh.triangles).reshape(-1, 3)).reshape(-1, 9)
        self._corners = [] if any(distortion) else [upload(column) for column in corners.T]
        self._mark = record_on_cuda(_mark_tiles)

    def tiles(self, view: KernelCamera) -> Bool:
        """[ceil(H / TILE) ceil(W / TILE)], row by row: where the scene may be seen."""
        if not self._corners:
            return dr.opaque(backend.mitsuba().Bool, True, _across(view) * _down(view))
        return self._mark(view, self._corners)


def is_covered(tiles: Bool, view: KernelCamera, pixel: UInt32) -> Bool:
    """Whether the scene may be seen in pixels (index row by row)."""
    tile = pixel // view.width // TILE * _across(view) + pixel % view.width // TILE
    return dr.gather(backend.mitsuba().Bool, tiles, tile)


def _across(view: KernelCamera) -> int:
    return -(-view.width // TILE)


def _down(view: KernelCamera) -> int:
    return -(-view.height // TILE)


def _mark_tiles(view: KernelCamera, corners: Sequence[Float]) -> Bool:
    """The tiles that triangles reach. corners: x, y and z of each triangle's three, in Mitsuba's coordinates, [F]."""
    mi = backend.mitsuba()
    tiles = dr.zeros(mi.Bool, _across(view) * _down(view))
    arms = [mi.Vector3f(corners[k : k + 3]) - view.start for k in (0, 3, 6)]
    depths = [view.near + dr.dot(arm, view.forward) for arm in arms]
    scales = [1 / dr.maximum(depth, CLOSE) for depth in depths]
    x, y = (
        [dr.dot(arm, axis) * scale * view.focal[k] + view.centre[k] for arm, scale in zip(arms, scales, strict=True)]
        for k, axis in enumerate((view.right, view.down))
    )
    far = dr.maximum(_largest([dr.abs(value) for value in x]), _largest([dr.abs(value) for value in y]))
    anywhere = (_smallest(depths) < CLOSE) | ~(far < FARTHEST)
    left, width = _tile_range(x, anywhere, _across(view))
    top, height = _tile_range(y, anywhere, _down(view))
    count = dr.select(_largest(depths) > -CLOSE, width * height, 0)
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
        dr.scatter(tiles, mi.Bool(True), mi.UInt32(row * _across(view) + column), anywhere | ~is_outside(column, row))
        return (number + 1,)

    def has_more(number: Int32) -> Bool:
        return number < count

    dr.while_loop((mi.Int32(0),), has_more, mark, mode="symbolic", label="tiles of triangles")
    return tiles


def _tile_range(values: Sequence[Float], anywhere: Bool, count: int) -> tuple[Int32, Int32]:
    """(first tile, how many) of `count` in a row that three corners' coordinates, pixels, reach; all of `anywhere`."""
    mi = backend.mitsuba()
    first = dr.floor((_smallest(values) - MARGIN) / TILE)
    last = dr.floor((_largest(values) + MARGIN) / TILE)
    start = dr.select(anywhere, 0, mi.Int32(dr.clip(first, 0, count)))
    end = dr.select(anywhere, count - 1, mi.Int32(dr.clip(last, -1, count - 1)))
    return start, dr.maximum(end - start + 1, 0)


def _smallest(values: Sequence[Float]) -> Float:
    return dr.minimum(dr.minimum(values[0], values[1]), values[2])


def _largest(values: Sequence[Float]) -> Float:
    return dr.maximum(dr.maximum(values[0], values[1]), values[2])
