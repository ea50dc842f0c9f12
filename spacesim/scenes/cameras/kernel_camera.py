"""A camera as inputs of kernels, in the coordinates that Mitsuba works in."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ParamSpec, TypeVar

import drjit as dr

from spacesim import backend
from spacesim.backend import mitsuba_types as mt
from spacesim.backend.arrays import Float, UInt32
from spacesim.data.geometry import Array
from spacesim.data.images import undistort_points
from spacesim.data.records import Camera
from spacesim.scenes.lights.emitters import kernel_input

RADIUS = 100.0
"""Of the bounding sphere in Mitsuba's coordinates. Mitsuba starts rays 9e-5 (1 + |p|) from the surface point p, so at
this size 9e-5 of the radius, and hardly less at a larger one."""

RECORDINGS = 64
"""Of a kernel that are kept: one for each size of picture and, of shadow rays, for each power of two of points."""


@dataclass(frozen=True)
class Units:
    """Mitsuba's coordinates: metres from `centre` [3], times `scale`. Single precision holds the differences between
    points of the scene, wherever it stands and however large it is."""

    centre: Array
    scale: float

    @classmethod
    def of(cls, bounding_sphere: tuple[Array, float]) -> "Units":
        """Those in which the sphere (centre, radius), metres, lies at the origin and has RADIUS."""
        centre, radius = bounding_sphere
        return cls(centre, RADIUS / radius)

    def points(self, positions: Array) -> Array:
        """Positions [N, 3] in metres in these coordinates."""
        return (positions - self.centre) * self.scale


@dataclass(frozen=True)
class KernelCamera:
    """A camera: another pose or focal length reuses what was recorded.

    Rays start on a plane before the scene, `near` along the axis from the camera: from a camera far away single
    precision would miss by more than a pixel.
    """

    width: int  #: pixels
    height: int  #: pixels
    right: mt.Vector3f  #: unit, along the picture's rows
    down: mt.Vector3f  #: unit, along its columns
    forward: mt.Vector3f  #: unit, along the optical axis
    start: mt.Vector3f  #: where the axis meets that plane
    near: Float
    metre: Float  #: of the unit of length
    focal: list[Float]  #: fx and fy, pixels
    centre: list[Float]  #: cx and cy, pixels

    @classmethod
    def of(cls, camera: Camera, units: Units) -> "KernelCamera":
        """`camera` as seen in `units`."""
        axes, position = camera.world_from_camera[:3, :3].T, camera.world_from_camera[:3, 3]
        origin = units.points(position)
        near = max(0.0, -float(origin @ axes[2]) - 1.1 * RADIUS)
        right, down, forward, start = (kernel_input(x) for x in (*axes, origin + near * axes[2]))
        return cls(
            width=camera.width,
            height=camera.height,
            right=right,
            down=down,
            forward=forward,
            start=start,
            near=kernel_input(near),
            metre=kernel_input(1 / units.scale),
            focal=[kernel_input(camera.fx), kernel_input(camera.fy)],
            centre=[kernel_input(camera.cx), kernel_input(camera.cy)],
        )

    def rays(
        self, pixel: UInt32, offset: mt.Point2f, distortion: Sequence[float]
    ) -> tuple[mt.RayDifferential3f, Float]:
        """Rays through pixels (index row by row), each at an `offset` in [0, 1)^2 from the pixel's upper left; and how
        far from the camera they start."""
        return self.rays_to(*self.directions(pixel, offset, distortion))

    def directions(self, pixel: UInt32, offset: mt.Point2f, distortion: Sequence[float]) -> tuple[Float, Float]:
        """(x, y) to the right and down, of the directions (x, y, 1) of `rays`."""
        mi = backend.mitsuba()
        x = (mi.Float(pixel % self.width) + offset.x - self.centre[0]) / self.focal[0]
        y = (mi.Float(pixel // self.width) + offset.y - self.centre[1]) / self.focal[1]
        return undistort_points(x, y, distortion) if distortion else (x, y)

    def rays_to(self, x: Float, y: Float) -> tuple[mt.RayDifferential3f, Float]:
        """`rays` in the `directions` (x, y, 1)."""
        mi = backend.mitsuba()
        aside = x * self.right + y * self.down
        length = dr.sqrt(1 + x * x + y * y)
        start = mi.Point3f(self.start + self.near * aside)
        return mi.RayDifferential3f(mi.Ray3f(start, (aside + self.forward) / length)), self.near * length


P = ParamSpec("P")
R = TypeVar("R")


def record_on_cuda(function: Callable[P, R]) -> Callable[P, R]:
    """`function`, recorded once and replayed on CUDA. On LLVM it is traced anew, which takes 5 % of a frame there:
    an Embree scene or a numpy array that is freed in the middle of a recording would end the process."""
    return backend.recorded(function, limit=RECORDINGS, elements=None) if backend.select() == "cuda" else function
