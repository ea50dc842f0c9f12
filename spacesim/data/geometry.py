"""Rotations, camera axes, directions and the extent of points, in float64 numpy.

World axes are right-handed with z up. Camera axes, when nothing else is said, are OpenCV's: x right, y down,
z forward along the optical axis. Quaternions are (w, x, y, z). See docs/explanation/conventions.md.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

OPENCV_FROM_OPENGL: Array = np.diag([1.0, -1.0, -1.0, 1.0])
"""[4, 4] OpenGL camera axes (x right, y up, z backward) to OpenCV's; its own inverse."""

OPENCV_FROM_MITSUBA: Array = np.diag([-1.0, -1.0, 1.0, 1.0])
"""[4, 4] Mitsuba camera axes (x left, y up, z forward) to OpenCV's; its own inverse."""

#: of R R^T - 1 of what is to be a rotation R: up to the first R is taken as it is; rounded numbers, of three decimals
#: say, are up to the second, and the nearest rotation is taken
EXACT, ROUNDED = 1e-6, 5e-3


def normalize(vectors: ArrayLike) -> Array:
    """Unit vectors of `vectors` [..., 3]; a zero vector raises ValueError."""
    vectors = np.asarray(vectors, dtype=np.float64)
    with np.errstate(over="ignore", under="ignore"):
        lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    if not np.all((lengths > 0) & np.isfinite(lengths)):  # squares can be beyond all bounds where the numbers are not
        vectors = vectors / np.maximum(np.abs(vectors).max(axis=-1, keepdims=True), np.finfo(np.float64).tiny)
        lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    if not np.all((lengths > 0) & np.isfinite(lengths)):
        raise ValueError("vectors: expected non-zero vectors, found one of length 0 or NaN")
    return vectors / lengths


def cross_matrix(vector: Array) -> Array:
    """[3, 3] of the cross product with a vector [3] from the left."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def perpendicular(direction: Array) -> Array:
    """[3] a unit vector that stands upright on a `direction` [3] of any length above 0."""
    return normalize(np.cross(np.eye(3)[np.abs(direction).argmin()], direction))


def direction_from_angles(azimuth_deg: ArrayLike, elevation_deg: ArrayLike) -> Array:
    """Unit vector(s) [..., 3] at an azimuth from +x towards +y and an elevation from the xy plane (thesis 4.1)."""
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    )


def angles_from_direction(direction: ArrayLike) -> tuple[float, float]:
    """Azimuth in [0, 360) and elevation in [-90, 90], degrees, of `direction` [3] (inverse of thesis 4.1)."""
    x, y, z = normalize(direction)
    azimuth = float(np.degrees(np.arctan2(y, x)) % 360.0)
    return (0.0 if azimuth >= 360.0 else azimuth), float(np.degrees(np.arctan2(z, np.hypot(x, y))))


def degrees_between(cosines: ArrayLike) -> Array:
    """Angles of unit vectors, degrees, from their dot products, which rounding may take past 1. Any shape."""
    angles: Array = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    return angles


def focus_of(world_from_camera: Array) -> Array:
    """[3] the point nearest to the optical axes of cameras [N, 4, 4], in the least-squares sense."""
    A, b = 1e-9 * np.eye(3), np.zeros(3)
    for pose in world_from_camera:
        across = np.eye(3) - np.outer(pose[:3, 2], pose[:3, 2])
        A += across
        b += across @ pose[:3, 3]
    return np.asarray(np.linalg.solve(A, b), np.float64)


def look_at(origin: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """world_from_camera [4, 4] (OpenCV axes) of a camera at `origin` [3] that looks at `target` [3], metres.

    Where the optical axis is within 0.1 degrees of `up`, +y takes the place of `up`.
    """
    origin = np.asarray(origin, dtype=np.float64)
    forward = normalize(np.asarray(target, dtype=np.float64) - origin)
    up = normalize(up)
    if np.linalg.norm(np.cross(forward, up)) < np.sin(np.radians(0.1)):
        up = np.array([0.0, 1.0, 0.0]) if abs(forward[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    right = normalize(np.cross(forward, up))
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    world_from_camera[:3, 3] = origin
    return world_from_camera


def rotation_from_quaternion(quaternions: ArrayLike) -> Array:
    """Rotation matrices [..., 3, 3] of quaternions [..., 4] (w, x, y, z), normalised first."""
    q = np.asarray(quaternions, dtype=np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def camera_that_sees(quaternion: ArrayLike, position: ArrayLike) -> Array:
    """[4, 4] world_from_camera of the camera that has the world's point p at R(q) p + r: the transpose of R(q), and
    -R^T r. quaternion: [4] (w, x, y, z), position: r [3]"""
    turn, (x, y, z) = rotation_from_quaternion(quaternion), np.asarray(position, np.float64)
    pose = np.eye(4)
    pose[:3, :3] = turn.T
    pose[:3, 3] = -(x * turn[0] + y * turn[1] + z * turn[2])  # to the bit, whatever the BLAS
    return pose


def as_rotation(numbers: Array) -> Array | None:
    """The rotation [3, 3] that finite numbers are or, rounded, were: as they are, or the nearest; None for others."""
    if numbers.shape != (3, 3) or np.linalg.det(numbers) < 0:
        return None
    off = np.abs(numbers @ numbers.T - np.eye(3)).max()
    if off <= EXACT:
        return numbers
    left, _, right = np.linalg.svd(numbers)
    return left @ right if off <= ROUNDED else None


def quaternion_from_rotation(rotation: ArrayLike) -> Array:
    """Quaternion [4] (w, x, y, z), w >= 0, of a rotation matrix [3, 3] (largest eigenvector of Bar-Itzhack's K)."""
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(rotation, dtype=np.float64)
    K = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, d + b, g + c],
            [c - g, d + b, e - a - i, h + f],
            [d - b, g + c, h + f, i - a - e],
        ]
    )
    quaternion = np.linalg.eigh(K)[1][:, -1]
    return quaternion if quaternion[0] >= 0 else -quaternion


def may_shade(caster: tuple[Array, float], receiver: tuple[Array, float], sun: Array) -> bool:
    """Could anything within one sphere, (centre [3], radius), be before the Sun for anything within another? sun: [3]
    towards it, unit"""
    reach, offset = caster[1] + receiver[1], caster[0] - receiver[0]
    ahead = float(offset @ sun)
    return ahead > -reach and float(np.linalg.norm(offset - ahead * sun)) < reach


def fibonacci_sphere(count: int, seed: int | None = None) -> Array:
    """`count` nearly even unit directions [count, 3] on the spherical Fibonacci lattice.

    With a `seed` the whole lattice is turned by a random rotation, so that two sets do not coincide.
    """
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / max(count, 1)
    angle = np.pi * (1.0 + 5.0**0.5) * k
    radius = np.sqrt(1.0 - z * z)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)
    if seed is None:
        return points
    rotation = rotation_from_quaternion(np.random.default_rng(seed).normal(size=4))
    return points @ rotation.T


def robust_radius(means: Array) -> float:
    """Metres, above 0: 99 % of the points [N, 3] lie within it of their median. Of a point cloud that has outliers, as
    any from structure from motion has, neither the farthest point nor the mean says how large the object is."""
    return _radius_within(_from_median(means))


def is_near(means: Array) -> NDArray[np.bool_]:
    """[N] bool: which of the points [N, 3] are within ten times `robust_radius` of their median, and no outliers."""
    away = _from_median(means)
    return away <= 10 * _radius_within(away)


def _from_median(means: Array) -> Array:
    """[N] metres."""
    return np.linalg.norm(means - np.median(means, axis=0), axis=1)


def _radius_within(away: Array) -> float:
    return max(float(np.quantile(away, 0.99)), 1e-9)


def as_numbers(value: object) -> Array:
    """As float64 of any shape, [0] of what is no array of real numbers, as text is not."""
    try:
        return np.asarray(value, np.float64) if np.asarray(value).dtype.kind not in "USc" else np.zeros(0)
    except (TypeError, ValueError, OverflowError):
        return np.zeros(0)
