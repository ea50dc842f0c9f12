"""What can be grabbed in the scene: a gizmo for each model, the Sun on its sphere, the cameras of the data. All stand
under one node, `HANDLES`, which a client hides where its picture is not that of the whole window."""

import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from spacesim.data.geometry import Array, quaternion_from_rotation
from spacesim.data.records import Dataset, Sun
from spacesim.splat.compose.pose import Pose
from spacesim.viewer.drawing.scene_renderer import SceneRenderer
from spacesim.viewer.state import SceneState, SharedScene, pose_from_handle

if TYPE_CHECKING:
    import viser

HANDLES = "/handles"  #: name of the node above them
SUN_AWAY = 1.15  #: distance of the Sun's handle from the middle, in radii of the scene
GIZMO = 0.5  #: length of a gizmo's axes, in radii of the model
FRUSTUM = 0.06  #: size of a frustum, in radii of the scene
MAX_FRUSTA = 200  #: cameras that are shown: more hide each other
SUN_COLOR, TRAIN_COLOR, TEST_COLOR = (255, 190, 60), (86, 180, 233), (230, 159, 0)


def sun_from_drag(centre: Array, radius: float, eye: Array, pointer: Array, before: Array) -> Array:
    """[3] unit: where the Sun is when its handle is dragged on a sphere about `centre`, metres.

    The ray from the eye through `pointer` [3] meets the sphere in two points; the nearer to where the handle was
    (`before` [3], unit) counts, and of a ray that passes by, the point of the sphere's rim, as the eye sees it, that is
    nearest to it. Without a direction it stays as it was.
    """
    ray = pointer - eye
    length = float(np.linalg.norm(ray))
    if not (math.isfinite(length) and length > 0):
        return before
    ray = ray / length
    to_centre = centre - eye
    along, distance = float(to_centre @ ray), float(np.linalg.norm(to_centre))
    miss = float(np.linalg.norm(ray * along - to_centre))
    if distance > radius and (miss >= radius or along <= 0):
        towards_eye = -to_centre / distance
        aside = ray - (ray @ towards_eye) * towards_eye
        size = float(np.linalg.norm(aside))
        cosine = radius / distance
        rim = cosine * towards_eye + math.sqrt(1 - cosine**2) * aside / max(size, 1e-300)
        return rim if size > 1e-9 else before
    half = math.sqrt(max(radius**2 - miss**2, 0.0))
    ahead = [step for step in (along - half, along + half) if step > 0]
    old = centre + radius * before
    nearest = min(
        (eye + step * ray for step in ahead), key=lambda point: float(np.linalg.norm(point - old)), default=None
    )
    return before if nearest is None else (nearest - centre) / np.linalg.norm(nearest - centre)


class Gizmos:
    """A gizmo for each model, the same for all clients."""

    def __init__(self, scene: "viser.SceneApi", renderer: SceneRenderer, shared: SharedScene) -> None:
        self._shared = shared
        self._handles = [
            scene.add_transform_controls(
                f"{HANDLES}/models/{k}",
                scale=_gizmo_size(model.radius, pose),
                position=tuple(pose.translation),
                wxyz=tuple(pose.quaternion),
                depth_test=False,
                line_width=3.0,
            )
            for k, (model, pose) in enumerate(zip(renderer.models, shared.state.poses, strict=True))
        ]
        self._radii = [model.radius for model in renderer.models]
        for k, handle in enumerate(self._handles):
            handle.on_update(self._moved(k))

    def _moved(self, k: int) -> Callable[["viser.TransformControlsEvent"], Awaitable[None]]:
        async def moved(event: "viser.TransformControlsEvent") -> None:
            wxyz, position = event.target.wxyz, event.target.position
            self._shared.change(lambda state: state.with_pose(k, pose_from_handle(state.poses[k], wxyz, position)))

        return moved

    def set_pose(self, k: int, pose: Pose) -> None:
        """Place the gizmo of model k, which was moved by other means."""
        handle = self._handles[k]
        handle.position, handle.wxyz = tuple(pose.translation), tuple(pose.quaternion)
        handle.scale = _gizmo_size(self._radii[k], pose)

    def show(self, visible: bool) -> None:
        """Show or hide all."""
        for handle in self._handles:
            handle.visible = visible


def _gizmo_size(radius: float, pose: Pose) -> float:
    return GIZMO * radius * pose.scale


class SunHandle:
    """A ball on a sphere about the scene, to be dragged, and an arrow along its light; the same for all clients."""

    def __init__(
        self, scene: "viser.SceneApi", renderer: SceneRenderer, shared: SharedScene, dragged: Callable[[Sun], None]
    ) -> None:
        self._renderer, self._shared, self._dragged = renderer, shared, dragged
        radius = self._place(shared.state)[1]
        self._size = radius
        self._frame = scene.add_frame(f"{HANDLES}/sun", show_axes=False)
        ball = scene.add_icosphere(f"{HANDLES}/sun/ball", radius=0.04 * radius, color=SUN_COLOR, cast_shadow=False)
        points = np.array([[[0, 0, -0.06 * radius], [0, 0, -0.22 * radius]]], np.float32)
        scene.add_arrows(
            f"{HANDLES}/sun/arrow",
            points,
            np.array(SUN_COLOR, np.uint8),
            shaft_radius=0.008 * radius,
            head_radius=0.024 * radius,
            head_length=0.06 * radius,
        )
        ball.on_drag(self._drag)
        self.follow(shared.state)
        shared.listen(self.follow)

    def follow(self, state: SceneState) -> None:
        """Stand where the Sun is."""
        if state.sun is None:
            self._frame.visible = False
            return
        centre, radius = self._place(state)
        z = state.sun.direction
        x = np.cross([0.0, 0, 1] if abs(z[2]) < 0.9 else [1.0, 0, 0], z)
        x /= np.linalg.norm(x)
        self._frame.wxyz = tuple(quaternion_from_rotation(np.stack([x, np.cross(z, x), z], axis=1)))
        self._frame.position = tuple(centre + radius * z)

    def show(self, visible: bool) -> None:
        """Show or hide it."""
        self._frame.visible = visible

    def _place(self, state: SceneState) -> tuple[Array, float]:
        centre, radius = self._renderer.bounds(state)
        return centre, SUN_AWAY * radius

    async def _drag(self, event: "viser.SceneNodeDragEvent") -> None:
        state = self._shared.state
        if state.sun is None:
            return
        centre, radius = self._place(state)
        eye = np.asarray(event.client.camera.position, np.float64)
        pointer = np.asarray(event.end_position, np.float64)
        self._dragged(Sun(sun_from_drag(centre, radius, eye, pointer, state.sun.direction)))


@dataclass(frozen=True)
class DatasetCamera:
    """A camera of the data to jump to."""

    frame: int  #: the first that was taken there
    test: bool  #: held out


def dataset_cameras(dataset: Dataset, most: int = MAX_FRUSTA) -> list[DatasetCamera]:
    """The places that frames were taken from, each once, evenly thinned out to `most`."""
    seen: dict[bytes, DatasetCamera] = {}
    for number, frame in enumerate(dataset.frames):
        key = np.round(frame.camera.world_from_camera, 6).tobytes()
        seen.setdefault(key, DatasetCamera(number, number >= len(dataset.train)))
    distinct = list(seen.values())
    if len(distinct) <= most:
        return distinct
    return [distinct[k * len(distinct) // most] for k in range(most)]


def add_frusta(
    scene: "viser.SceneApi", dataset: Dataset, size: float, jump: Callable[[int], None]
) -> "list[viser.CameraFrustumHandle]":
    """A frustum for each of `dataset_cameras` in a client's scene; a click on one calls jump(frame). size: metres"""
    handles = []
    for spot in dataset_cameras(dataset):
        camera = dataset.frames[spot.frame].camera
        handle = scene.add_camera_frustum(
            f"{HANDLES}/cameras/{spot.frame}",
            fov=2 * math.atan(0.5 * camera.height / camera.fy),
            aspect=camera.width / camera.height * camera.fy / camera.fx,
            scale=size,
            color=TEST_COLOR if spot.test else TRAIN_COLOR,
            thickness=1.5,
            thickness_units="screen",
            wxyz=tuple(quaternion_from_rotation(camera.world_from_camera[:3, :3])),
            position=tuple(camera.position),
            cast_shadow=False,
        )
        handle.on_click(_on_click(spot.frame, jump))
        handles.append(handle)
    return handles


def _on_click(number: int, jump: Callable[[int], None]) -> Callable[[object], Awaitable[None]]:
    async def clicked(_event: object) -> None:
        jump(number)

    return clicked
