"""Small motions of cameras, and the point about which poses turn."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from spacesim.data.errors import InputError
from spacesim.data.geometry import Array
from spacesim.data.records import Camera
from spacesim.splat.pose.picture import SunlitRun


def moved(camera: Camera, twist: ArrayLike) -> Camera:
    """The camera after a motion, as `Projection.moved` has it: points go from `camera`'s axes to the moved one's by
    p' = exp([w]) p + v. twist: [6] = (w, v), rotation vector in radians and translation in metres, camera axes."""
    from scipy.spatial.transform import Rotation  # a third of a second, that training need not wait for

    numbers = np.asarray(twist, np.float64)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = Rotation.from_rotvec(numbers[:3]).as_matrix(), numbers[3:]
    motion[:3, :3] = motion[:3, :3].T  # the inverse
    motion[:3, 3] = -motion[:3, :3] @ motion[:3, 3]
    return replace(camera, world_from_camera=camera.world_from_camera @ motion)


def twist_between(camera: Camera, other: Camera) -> Array:
    """[6] the motion from `camera` to `other`: the inverse of `moved`, for rotations below pi."""
    from scipy.spatial.transform import Rotation

    motion = other.camera_from_world @ camera.world_from_camera
    return np.concatenate([Rotation.from_matrix(motion[:3, :3]).as_rotvec(), motion[:3, 3]])


@dataclass(frozen=True, eq=False)
class Pivot:
    """What a camera sees of the model at first. Poses turn about its middle: turns and shifts are then nearly
    independent of each other in pictures."""

    camera: Camera  #: the given one
    point: Array  #: [3] metres, world
    radius: float  #: root mean square distance from it of the surface seen, metres
    alpha: np.ndarray  #: [H, W]
    angle: float  #: radians that the pose may well be off
    length: float  #: metres that the pose may well be off

    @staticmethod
    def of(drawing: SunlitRun, camera: Camera, within: tuple[float, float]) -> "Pivot":
        """Raises InputError where the camera does not see the model."""
        output = drawing.output(camera, drawing.shade(camera), "depth")
        alpha, depth = output.image("alpha"), output.image("depth")
        rows, columns = np.nonzero(alpha > 0.5 * alpha.max())
        if alpha.max() < 0.5:
            raise InputError("camera: expected one that sees the model, found one before which it is not")
        z = depth[rows, columns].astype(np.float64)
        x, y = (columns + 0.5 - camera.cx) / camera.fx * z, (rows + 0.5 - camera.cy) / camera.fy * z
        points = np.stack([x, y, z], axis=1)
        middle = points.mean(axis=0)
        radius = float(np.sqrt(((points - middle) ** 2).sum(axis=1).mean()))
        distance = float(np.linalg.norm(middle))
        point = camera.world_from_camera[:3, :3] @ middle + camera.position
        radius = max(radius, 1e-3 * distance)
        return Pivot(camera, point, radius, alpha, float(np.radians(within[0])), within[1] * distance)

    def seen_by(self, camera: Camera) -> Array:
        """[3] the point in the camera's axes, metres."""
        position: Array = camera.camera_from_world[:3, :3] @ (self.point - camera.position)
        return position

    def turned(self, camera: Camera, turn: Array, shift: Array) -> Camera:
        """The camera after a turn (rotation vector [3]) about the point, and a shift [3], metres, both in its axes."""
        from scipy.spatial.transform import Rotation

        middle = self.seen_by(camera)
        return moved(camera, np.concatenate([turn, shift + middle - Rotation.from_rotvec(turn).apply(middle)]))

    def offset(self, camera: Camera) -> Array:
        """[6] turn and shift from the given camera, each by how much that may well be off."""
        turn = twist_between(self.camera, camera)[:3] / self.angle
        return np.concatenate([turn, (camera.position - self.camera.position) / self.length])

    def reach(self, camera: Camera) -> float:
        """The larger of turn and shift."""
        offset = self.offset(camera)
        return float(max(np.linalg.norm(offset[:3]), np.linalg.norm(offset[3:])))
