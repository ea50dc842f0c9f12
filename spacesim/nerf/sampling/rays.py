"""Rays through pixel centres, and where they cross the scene box.

A ray is o + t d in the coordinates of the box (`SceneBox`), d a unit vector.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Float, UInt32
from spacesim.data.geometry import Array
from spacesim.data.records import Camera
from spacesim.nerf.sampling.box import SceneBox

NUMBERS = 16  #: of a camera in `camera_rows`
PARALLEL = 1e-9  #: a direction's coordinate below which it counts as this


@dataclass
class Rays:
    """R rays, and the part of each that lies in the box."""

    origin: Array3f  #: [3, R] in the box's coordinates
    direction: Array3f  #: [3, R] unit
    near: Float  #: [R] t at which the ray comes into the box, at least 0
    far: Float  #: [R] t at which it leaves; `near` where it misses the box
    across: Float  #: [R] depth along the optical axis of a point, per t

    def at(self, ray: UInt32, t: Float) -> tuple[Array3f, Array3f]:
        """(points, directions) [3, N] at t [N] along rays number `ray` [N]."""
        direction = dr.gather(ad.Array3f, self.direction, ray)
        return dr.fma(direction, t, dr.gather(ad.Array3f, self.origin, ray)), direction


def camera_rows(cameras: Sequence[Camera], box: SceneBox) -> Array:
    """[V, 16] of each camera: rotation world_from_camera by rows, place in the box's coordinates, fx, fy, cx, cy."""
    rows = []
    for camera in cameras:
        pose = camera.world_from_camera
        lens = camera.fx, camera.fy, camera.cx, camera.cy
        rows.append(np.concatenate([pose[:3, :3].ravel(), box.to_unit(pose[:3, 3]), lens]))
    return np.array(rows, np.float64).reshape(-1, NUMBERS)


def pixel_rays(cameras: Float, view: UInt32, x: Float, y: Float, extent: Float) -> Rays:
    """Rays through places x, y [R], pixels (a pixel's centre is at one half), of cameras number `view` [R].

    cameras: `camera_rows`, Float [V * 16];  extent: Float [3], of the box
    """
    number = [dr.gather(ad.Float, cameras, view * NUMBERS + i) for i in range(NUMBERS)]
    u, v = (x - number[14]) / number[12], (y - number[15]) / number[13]
    across = dr.rsqrt(u * u + v * v + 1)
    along = [number[3 * i] * u + number[3 * i + 1] * v + number[3 * i + 2] for i in range(3)]
    direction = ad.Array3f(*along) * across
    origin = ad.Array3f(*number[9:12])
    near, far = box_interval(origin, direction, extent)
    return Rays(origin, direction, near, far, across)


def box_interval(origin: Array3f, direction: Array3f, extent: Float) -> tuple[Float, Float]:
    """(near, far) [R] of rays in the box from 0 to `extent`, Float [3] (Kay & Kajiya 1986); equal where they miss."""
    near, far = ad.Float(0), ad.Float(dr.inf)
    for axis in range(3):
        d: Any = direction[axis]
        slope = dr.rcp(dr.select(dr.abs(d) < PARALLEL, dr.copysign(ad.Float(PARALLEL), d), d))
        first = -origin[axis] * slope
        second = (dr.gather(ad.Float, extent, ad.UInt32(axis)) - origin[axis]) * slope
        near, far = dr.maximum(near, dr.minimum(first, second)), dr.minimum(far, dr.maximum(first, second))
    return near, dr.maximum(near, far)
