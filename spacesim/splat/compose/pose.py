"""Where a model stands in a scene, how it is turned and how large it is there (thesis 3.11 to 3.13)."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from spacesim.data.earth import Earth
from spacesim.data.errors import InputError
from spacesim.data.geometry import Array, as_rotation, quaternion_from_rotation, rotation_from_quaternion
from spacesim.data.records import Camera

MAX_COORDINATE = 1e8  #: metres of a position at most: single precision resolves 10 m there
MIN_SCALE, MAX_SCALE = 1e-6, 1e6  #: of a scale: squares of lengths in any model's frame stay in single precision


@dataclass(frozen=True, eq=False)
class Pose:
    """x_world = scale R x_model + translation (3.11).

    Raises InputError for what is no rotation, not finite, or beyond the bounds named above; poses that follow from
    others (`after`, `inverse`) may be beyond them.
    """

    #: [3, 3], R, or [4], a quaternion (w, x, y, z) of any length; kept as R, float64
    rotation: Array = field(default_factory=lambda: np.eye(3))
    translation: Array = field(default_factory=lambda: np.zeros(3))  #: [3] metres
    scale: float = 1.0  #: metres in the world for one of the model's

    def __post_init__(self) -> None:
        rotation, quaternion = _rotation(self.rotation)
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "_quaternion", quaternion)
        translation = _numbers(self.translation)
        if translation.shape != (3,) or not np.all(np.abs(translation) <= MAX_COORDINATE):
            raise InputError(
                f"position: expected 3 numbers of at most {MAX_COORDINATE:g} metres, found {self.translation!r}"
            )
        object.__setattr__(self, "translation", translation)
        if not MIN_SCALE <= self.scale <= MAX_SCALE:
            raise InputError(f"scale: expected a factor from {MIN_SCALE:g} to {MAX_SCALE:g}, found {self.scale}")
        object.__setattr__(self, "scale", float(self.scale))

    @property
    def quaternion(self) -> Array:
        """[4] unit (w, x, y, z): the one that was given, so that a file that holds it means the same pose to the bit,
        or that of the matrix, w >= 0, (1, 0, 0, 0) exactly where nothing is turned."""
        quaternion: Array = self._quaternion  # type: ignore[attr-defined]
        return quaternion

    @property
    def matrix(self) -> Array:
        """[4, 4] world_from_model, with the scale."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    @property
    def key(self) -> bytes:
        """Equal for equal poses, and an order among others."""
        return np.array([*self.translation, self.scale, *self.rotation.ravel()]).tobytes()

    def points(self, points: ArrayLike) -> Array:
        """[..., 3] model to world, metres."""
        turned: Array = np.asarray(points, np.float64) @ self.rotation.T
        return self.scale * turned + self.translation

    def after(self, first: "Pose") -> "Pose":
        """The pose that does `first`, then this one."""
        return _unchecked_pose(self.rotation @ first.rotation, self.points(first.translation), self.scale * first.scale)

    def inverse(self) -> "Pose":
        """model_from_world."""
        scale = 1 / self.scale
        return _unchecked_pose(self.rotation.T, -scale * (self.rotation.T @ self.translation), scale)

    def direction_in_model(self, direction: ArrayLike) -> Array:
        """[3], a direction of the world in the model's axes; the same numbers where nothing is turned."""
        turned: Array = self.rotation.T @ np.asarray(direction, np.float64)
        return turned

    def earth_in_model(self, earth: Earth | None) -> Earth | None:
        """An Earth in the model's axes."""
        return None if earth is None else replace(earth, direction=self.direction_in_model(earth.direction))

    def camera_in_model(self, camera: Camera) -> Camera:
        """The camera that sees the model in its own frame and scale as `camera` sees it in the world: the same picture,
        depths divided by the scale."""
        place = np.eye(4)
        place[:3, :3] = self.rotation.T @ camera.world_from_camera[:3, :3]
        place[:3, 3] = self.rotation.T @ (camera.position - self.translation) / self.scale
        return Camera(place, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)


def _unchecked_pose(rotation: Array, translation: Array, scale: float) -> Pose:
    """What follows from poses within the bounds; of two models, one seen from the other may be beyond them."""
    pose = Pose(rotation)
    object.__setattr__(pose, "translation", translation)
    object.__setattr__(pose, "scale", float(scale))
    return pose


def interpolate_pose(first: Pose, second: Pose, share: float) -> Pose:
    """The pose `share` of the way (0 to 1): rotation by the shortest way at even speed (slerp, Shoemake 1985), position
    along a line, scale by even factors."""
    rotation = interpolate_rotation(first.rotation, second.rotation, share)
    translation = (1 - share) * first.translation + share * second.translation
    return Pose(rotation, translation, first.scale ** (1 - share) * second.scale**share)


def interpolate_rotation(first: Array, second: Array, share: float) -> Array:
    """The rotation [3, 3] `share` of the way from one to the other, by the shortest way; the ends exactly."""
    if share <= 0 or np.array_equal(first, second):
        return first
    if share >= 1:
        return second
    return rotation_from_quaternion(slerp(quaternion_from_rotation(first), quaternion_from_rotation(second), share))


def slerp(first: ArrayLike, second: ArrayLike, share: float) -> Array:
    """The unit vector [n] `share` of the way on the great circle from unit vector `first` to `second`; quaternions,
    [4], by the shorter way of both that mean the same rotations. Of opposite directions some way round."""
    start, end = (np.asarray(values, np.float64) for values in (first, second))
    cosine = float(start @ end)
    if len(start) == 4 and cosine < 0:
        end, cosine = -end, -cosine
    across = end - cosine * start
    length = float(np.linalg.norm(across))
    if length < 1e-12:
        if cosine > 0:
            return start
        across = np.cross(start, np.eye(3)[np.abs(start).argmin()])  # opposite: quaternions never are
        length = float(np.linalg.norm(across))
    angle = share * np.arctan2(length if cosine > -1 + 1e-12 else 0.0, cosine)
    way: Array = np.cos(angle) * start + np.sin(angle) * across / length
    return way / np.linalg.norm(way)


def rotation_about(axis: ArrayLike, angle_deg: float) -> Array:
    """[3, 3]: by `angle_deg` degrees about `axis` [3] of any length, counter-clockwise seen against it. Raises
    InputError for an axis without a direction."""
    direction = _numbers(axis)
    length = float(np.linalg.norm(direction))
    if direction.shape != (3,) or not 1e-12 < length < np.inf:
        raise InputError(f"axis: expected 3 finite numbers, not all 0, found {axis!r}")
    half = 0.5 * np.radians(angle_deg)
    return rotation_from_quaternion([np.cos(half), *(np.sin(half) / length * direction)])


def _rotation(values: ArrayLike) -> tuple[Array, Array]:
    """(matrix [3, 3], unit quaternion [4]) of one of them."""
    numbers = _numbers(values)
    if numbers.shape == (4,):
        length = float(np.linalg.norm(numbers))
        if not 1e-12 < length < np.inf:
            raise InputError(f"rotation_wxyz: expected 4 finite numbers, not all 0, found {values!r}")
        unit = numbers if abs(length - 1) < 1e-12 else numbers / length
        return rotation_from_quaternion(unit), unit
    rotation = as_rotation(numbers)
    if rotation is None:
        raise InputError(f"rotation: expected a rotation matrix [3, 3] or a quaternion [4], found {values!r}")
    turned = not np.array_equal(rotation, np.eye(3))
    return rotation, quaternion_from_rotation(rotation) if turned else np.array([1.0, 0.0, 0.0, 0.0])


def _numbers(values: ArrayLike) -> Array:
    """Finite float64 numbers, or none at all."""
    try:
        numbers = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        return np.empty(0)
    return numbers if np.all(np.isfinite(numbers)) else np.empty(0)
