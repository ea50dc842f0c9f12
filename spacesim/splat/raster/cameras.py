"""Cameras as the kernels see them: perspective and orthographic behind one interface.

The numbers of a camera live in an array, not in the kernel's text: another camera reuses the compiled kernel, and
gradients with respect to the pose and the intrinsics are those of the array.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar, TypeVar

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Bool, Float
from spacesim.backend.packet import evaluates_numbers, numbers_at
from spacesim.backend.upload import upload_numbers
from spacesim.data.errors import InputError
from spacesim.data.geometry import Array
from spacesim.data.records import Camera

NEAR = 0.01  #: metres; a perspective camera does not draw Gaussians whose centre is nearer
MAX_MAGNITUDE = 1e9  #: bound on lengths in metres and on footprints in pixels: their squares stay finite in float32

Self = TypeVar("Self", bound="Projection")


@dataclass(frozen=True, eq=False)
class OrthographicCamera:
    """A camera of parallel rays along its z axis: what the Sun sees (thesis 4.3.1). No plane bounds it in depth."""

    world_from_camera: Array  #: [4, 4] float64, rigid, OpenCV axes, metres; z points from the Sun to the scene
    width: int  #: pixels
    height: int  #: pixels
    scale_x: float  #: pixels per metre (thesis 4.35)
    scale_y: float  #: pixels per metre (thesis 4.35)
    cx: float  #: pixel of the axis
    cy: float  #: pixel of the axis

    def __post_init__(self) -> None:
        scales = (self.scale_x, self.scale_y)
        if not (np.all(np.isfinite(scales)) and min(scales) > 0):
            raise InputError(f"orthographic camera: expected positive finite pixels per metre, found {scales}")
        checked = Camera(self.world_from_camera, self.width, self.height, *scales, self.cx, self.cy)
        object.__setattr__(self, "world_from_camera", checked.world_from_camera)

    @property
    def camera_from_world(self) -> Array:
        """[4, 4] inverse of `world_from_camera`."""
        return np.asarray(np.linalg.inv(self.world_from_camera), dtype=np.float64)

    @staticmethod
    def from_extent(world_from_camera: Array, width: int, height: int, metres: float) -> "OrthographicCamera":
        """Square pixels, the axis in the middle, an image as wide as `metres`."""
        scale = width / metres
        return OrthographicCamera(world_from_camera, width, height, scale, scale, 0.5 * width, 0.5 * height)


@dataclass
class Screen:
    """Where points fall, and the Jacobian there: d(x, y) / d(camera axes) = diag(scale) [I | -slope]."""

    x: Float  #: pixels
    y: Float  #: pixels
    scale_x: Float  #: pixels per metre
    scale_y: Float  #: pixels per metre
    slope_x: Float  #: of the ray, metres across a metre of depth
    slope_y: Float  #: of the ray, metres across a metre of depth


@dataclass
class Projection(ABC):
    """A camera in the kernels."""

    #: Float, first [18]: camera_from_world rows (12), pixels per unit in x and y, principal point (2, pixels of the
    #: whole image), first column and row of the crop (2)
    values: Float
    width: int  #: pixels, of the crop where there is one
    height: int  #: pixels, likewise

    _numbers: ClassVar[list[Float]] = []  #: `values` one by one, of `evaluated` cameras

    @abstractmethod
    def in_reach(self, center: Array3f) -> Bool:
        """Bool [N]: can a Gaussian be drawn whose centre is at `center` (Array3f [3, N], camera axes, metres)?"""

    @abstractmethod
    def screen(self, center: Array3f) -> Screen:
        """Projection of points in reach, Array3f [3, N] in camera axes, linearized there (thesis 2.11, 2.13)."""

    @abstractmethod
    def rays_to(self, points: Array3f) -> Array3f:
        """Array3f [3, N], world axes, not normalised: directions in which the camera sees `points` [3, N]."""

    def directions_to(self, points: Array3f) -> Array3f:
        """Array3f [3, N]: unit vectors along `rays_to`; (0, 0, 1), without gradient, where there is no direction."""
        offset = self.evaluated().rays_to(points)
        length2 = dr.squared_norm(offset)
        far = dr.detach((length2 > 1e-20) & (length2 < 1e20))
        return dr.select(far, offset * dr.rsqrt(dr.select(far, length2, 1)), ad.Array3f(0, 0, 1))

    def evaluated(self: Self) -> Self:
        """A copy for use on the spot, whose numbers a kernel need not gather, where they have no gradients
        (`evaluates_numbers`); what is changed in `values` afterwards does not reach it."""
        if dr.grad_enabled(self.values) or not evaluates_numbers():
            return self
        camera = replace(self)
        vars(camera)["_numbers"] = numbers_at(self.values, range(dr.width(self.values)))
        return camera

    def __getitem__(self, index: int) -> Float:
        """A number of `values`."""
        return self._numbers[index] if self._numbers else dr.gather(ad.Float, self.values, ad.UInt32(index))

    def transform(self, points: Array3f) -> Array3f:
        """Array3f [3, N] world to camera axes, metres (thesis 2.10)."""
        return ad.Array3f([dr.dot(self.row(i), points) + self[4 * i + 3] for i in range(3)])

    def row(self, i: int) -> Array3f:
        """Array3f: row i of the rotation camera_from_world."""
        return ad.Array3f(self[4 * i], self[4 * i + 1], self[4 * i + 2])

    def cropped(self: Self, x: int, y: int, width: int, height: int) -> Self:
        """The part of the image whose top left pixel is (x, y). Its picture is that part of the whole picture.

        (A `Camera` of the part alone would not do: where far splats are linearized depends on the whole image.)
        Raises InputError where the part is empty or reaches beyond the image.
        """
        if not all(isinstance(value, int | np.integer) for value in (x, y, width, height)):
            raise InputError(f"crop: expected whole numbers of pixels, found {(x, y, width, height)!r:.60}")
        if not (0 <= x < x + width <= self.width and 0 <= y < y + height <= self.height):
            raise InputError(
                f"crop: expected a part of the {self.width}x{self.height} pixels, found {width}x{height} at ({x}, {y})"
            )
        shift = [0.0] * dr.width(self.values)
        shift[16:18] = float(x), float(y)
        return replace(self, values=self.values + ad.Float(shift), width=width, height=height)

    def moved(self: Self, twist: Float) -> Self:
        """The camera after a small motion, differentiable at 0: what pose optimisation differentiates by.

        twist: Float [6], rotation vector (radians) and translation (metres) in camera axes, which take points from
        camera axes to the moved camera's: p' = exp([w]) p + v, by Rodrigues' formula.
        """
        wx, wy, wz, *translation = (dr.gather(ad.Float, twist, ad.UInt32(i)) for i in range(6))
        square = wx * wx + wy * wy + wz * wz
        tiny = dr.detach(square) < 1e-6  # there the limits at 0 are exact to single precision
        angle = dr.sqrt(dr.select(tiny, 1, square))
        half = dr.sin(0.5 * angle) / angle
        first = dr.select(tiny, 1, dr.sin(angle) / angle)
        second = dr.select(tiny, 0.5, 2 * half * half)
        turn = (
            (1 - second * (wy * wy + wz * wz), second * wx * wy - first * wz, second * wx * wz + first * wy),
            (second * wx * wy + first * wz, 1 - second * (wx * wx + wz * wz), second * wy * wz - first * wx),
            (second * wx * wz - first * wy, second * wy * wz + first * wx, 1 - second * (wx * wx + wy * wy)),
        )
        numbers: list[Float] = []
        for i in range(3):
            for j in range(4):
                value = sum((turn[i][k] * self[4 * k + j] for k in (1, 2)), turn[i][0] * self[j])
                numbers.append(value + translation[i] if j == 3 else value)
        rest = dr.gather(ad.Float, self.values, dr.arange(ad.UInt32, dr.width(self.values) - 12) + 12)
        return replace(self, values=dr.concat([*numbers, rest]))


@dataclass
class Pinhole(Projection):
    """A perspective camera. values: Float [22]: those of `Projection`, then the tangents to the left, right, top and
    bottom beyond which splats are linearized no farther: 0.15 of the image outside of its border, as gsplat has it."""

    @staticmethod
    def of(camera: Camera) -> "Pinhole":
        """Upload a `Camera` record."""
        return Pinhole(upload_numbers(pinhole_numbers(camera)), camera.width, camera.height)

    @property
    def position(self) -> Array3f:
        """Array3f: camera centre in the world, metres."""
        return -(self.row(0) * self[3] + self.row(1) * self[7] + self.row(2) * self[11])

    def in_reach(self, center: Array3f) -> Bool:
        return (center.z > NEAR) & (dr.max(dr.abs(center)) < MAX_MAGNITUDE)

    def screen(self, center: Array3f) -> Screen:
        inverse_z = dr.rcp(center.z)
        tan_x, tan_y = center.x * inverse_z, center.y * inverse_z
        return Screen(
            x=dr.fma(self[12], tan_x, self[14]) - self[16],
            y=dr.fma(self[13], tan_y, self[15]) - self[17],
            scale_x=self[12] * inverse_z,
            scale_y=self[13] * inverse_z,
            slope_x=dr.clip(tan_x, self[18], self[19]),
            slope_y=dr.clip(tan_y, self[20], self[21]),
        )

    def rays_to(self, points: Array3f) -> Array3f:
        return points - self.position


@dataclass
class Orthographic(Projection):
    """A camera of parallel rays. values: Float [18]. It sees what is behind its origin too, at negative depth: a light
    camera stands nowhere, and a caster must not vanish because the camera was put too close."""

    @staticmethod
    def of(camera: OrthographicCamera) -> "Orthographic":
        """Upload an `OrthographicCamera` record."""
        intrinsics = camera.scale_x, camera.scale_y, camera.cx, camera.cy
        numbers = _numbers(camera.camera_from_world, intrinsics, ())
        return Orthographic(upload_numbers(numbers), camera.width, camera.height)

    def in_reach(self, center: Array3f) -> Bool:
        return dr.max(dr.abs(center)) < MAX_MAGNITUDE

    def screen(self, center: Array3f) -> Screen:
        return Screen(
            x=dr.fma(self[12], center.x, self[14]) - self[16],
            y=dr.fma(self[13], center.y, self[15]) - self[17],
            scale_x=self[12],
            scale_y=self[13],
            slope_x=ad.Float(0),
            slope_y=ad.Float(0),
        )

    def rays_to(self, points: Array3f) -> Array3f:
        return self.row(2) + dr.zeros(ad.Array3f, dr.width(points))


def pinhole_numbers(camera: Camera) -> list[float]:
    """What `Pinhole.of` uploads."""
    left, right = ((edge * camera.width - camera.cx) / camera.fx for edge in (-0.15, 1.15))
    top, bottom = ((edge * camera.height - camera.cy) / camera.fy for edge in (-0.15, 1.15))
    intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
    return _numbers(camera.camera_from_world, intrinsics, (left, right, top, bottom))


def _numbers(camera_from_world: Array, intrinsics: tuple[float, ...], lengths: tuple[float, ...]) -> list[float]:
    """What an array is made of: no numpy array, see `backend.recorded`."""
    return [*camera_from_world[:3].ravel().tolist(), *map(float, intrinsics), 0.0, 0.0, *map(float, lengths)]
