"""A browser that is connected: its session, its panel, its camera."""

import io
import threading
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image

from spacesim.data.geometry import Array, quaternion_from_rotation
from spacesim.data.records import Camera, Dataset
from spacesim.viewer.drawing.frames import draw_mode
from spacesim.viewer.drawing.loop import RenderLoop
from spacesim.viewer.drawing.paint import Bytes, add_color_bar
from spacesim.viewer.drawing.scene_renderer import SceneRenderer
from spacesim.viewer.network.message_filter import has_pending_files
from spacesim.viewer.panels.controls import ClientControls, SunControls
from spacesim.viewer.panels.handles import FRUSTUM, HANDLES, add_frusta
from spacesim.viewer.session import Session, Statistics
from spacesim.viewer.state import DisplaySettings, SharedScene, ViewerCamera, parse_viewer_camera
from spacesim.viewer.truth.source import TruthService

if TYPE_CHECKING:
    import viser

QUALITY, QUALITY_AT_REST = 75, 95  #: of JPEG
MAX_PICTURE_SIDE = 4096  #: pixels a side of a picture that is saved


@dataclass(frozen=True, eq=False)
class _FirstView:
    """What a browser shows until its camera is moved."""

    place: Array  #: [3] metres
    fov: float  #: vertical, radians, of a window that is no higher than wide
    #: those of the window as it has been; none before it is at the place, as browsers report another at first
    shown: set[float] = field(default_factory=set)


class Client:
    """One browser.

    handle: viser's
    facts: lines for the statistics
    """

    def __init__(
        self,
        handle: "viser.ClientHandle",
        renderer: SceneRenderer,
        shared: SharedScene,
        loop: RenderLoop,
        truth: TruthService,
        dataset: Dataset | None,
        sun: SunControls | None,
        facts: list[str],
    ) -> None:
        self.handle, self._renderer, self._shared, self._loop, self._dataset = handle, renderer, shared, loop, dataset
        self._sun = sun
        self._frusta: list[viser.CameraFrustumHandle] = []
        self._handles = handle.scene.add_frame(HANDLES, show_axes=False)
        self._first: _FirstView | None = None
        self._lock = threading.Lock()
        self._closed = False
        self.session = Session(renderer, shared, loop, self, truth)
        frames = len(dataset.frames) if dataset else 0
        self.controls = ClientControls(handle.gui, self.session, self, facts, frames, renderer)

    def begin(self, place: ArrayLike, fov: float) -> None:
        """Draw for it from now on. place, fov: [3] metres and vertical, radians, where it looks from at first"""
        self._first = _FirstView(np.array(place), fov)
        self.handle.camera.on_update(self._moved)
        self._on_camera(self.handle.camera)

    def close(self) -> None:
        """It has gone."""
        with self._lock:
            self._closed = True
        self.session.close()

    # ---- Screen ----

    def show(self, picture: Bytes, sharp: bool) -> None:
        """See `Screen`."""
        if not self._closed:
            quality = QUALITY_AT_REST if sharp else QUALITY
            self.handle.scene.set_background_image(picture, format="jpeg", jpeg_quality=quality)
            self.handle.flush()

    def show_statistics(self, statistics: Statistics) -> None:
        """See `Screen`."""
        if not self._closed:
            self.controls.show_statistics(statistics)

    # ---- Actions ----

    def jump_to_frame(self, frame: int) -> None:
        """See `Actions`."""
        if self._dataset is None or not 0 <= frame < len(self._dataset.frames):
            return
        record = self._dataset.frames[frame]
        sun = record.sun
        if sun is not None and self._sun is not None:
            self._sun.drag(sun)
        elif sun is not None:  # no model can be relit, but the truth is of that Sun
            self._shared.change(lambda state: replace(state, sun=sun))
        view = self.session.view
        aspect = view.width / view.height if view else 1.0
        self.look_from(record.camera.world_from_camera, fov_to_hold(record.camera, aspect))

    def show_frusta(self, visible: bool) -> None:
        """See `Actions`."""
        for handle in self._frusta:
            handle.remove()
        self._frusta = []
        if visible and self._dataset is not None:
            size = FRUSTUM * self._renderer.bounds(self._shared.state)[1]
            self._frusta = add_frusta(self.handle.scene, self._dataset, size, self.jump_to_frame)

    def show_handles(self, visible: bool) -> None:
        """See `Actions`."""
        self._handles.visible = visible

    def save_picture(self) -> None:
        """See `Actions`."""
        view, settings = self.session.view, self.session.settings
        if view is not None and not self._closed:
            self._loop.submit(lambda: self._send_picture(view, settings), (self, "picture"))

    def look_from(self, world_from_camera: np.ndarray, fov: float) -> None:
        """Move the client's camera to a pose [4, 4]; it goes round what is in the middle of the scene then."""
        camera = self.handle.camera
        place = world_from_camera[:3, 3]
        centre = self._renderer.bounds(self._shared.state)[0]
        ahead = max(float((centre - place) @ world_from_camera[:3, 2]), 1e-3)
        self._first = None
        with self.handle.atomic():
            camera.position = tuple(place)
            camera.look_at = tuple(place + ahead * world_from_camera[:3, 2])
            camera.wxyz = tuple(quaternion_from_rotation(world_from_camera[:3, :3]))
            camera.fov = float(fov)

    def _send_picture(self, view: ViewerCamera, settings: DisplaySettings) -> None:
        """On the render thread: with square pixels, as large as the window; none while another is on its way."""
        if has_pending_files(self.handle._websock_connection):
            return
        scale = min(1.0, MAX_PICTURE_SIDE / max(view.width, view.height))
        width, height = (max(1, round(scale * side)) for side in (view.width, view.height))
        camera, give_way = view.camera(width, height), self._loop.give_way
        state, mode, exposure = self._shared.state, settings.mode, settings.stops
        _, picture, depths, _ = draw_mode(self._renderer, state, camera, mode, give_way, exposure)
        file = io.BytesIO()
        Image.fromarray(add_color_bar(picture, depths) if depths else picture).save(file, "PNG")
        if not self._closed:
            name = f"{mode.replace(' ', '-')}.png"
            self.handle.send_file_download(name, file.getvalue(), save_immediately=True)

    async def _moved(self, camera: "viser.CameraHandle") -> None:
        self._on_camera(camera)

    def _on_camera(self, camera: "viser.CameraHandle") -> None:
        pose = camera.wxyz, camera.position, camera.fov, camera.image_width, camera.image_height
        view = parse_viewer_camera(*pose)
        if view is not None:
            self._widen_first(view)
            self.session.on_camera_moved(view)

    def _widen_first(self, view: ViewerCamera) -> None:
        """Until it is moved, a window that is higher than wide, as beside a docked panel, shows the width of what a
        square one does."""
        first = self._first
        if first is None:
            return
        is_there = np.allclose(view.world_from_camera[:3, 3], first.place, rtol=1e-4)
        if not is_there or not np.isclose(view.fov, [first.fov, *first.shown], rtol=1e-4).any():
            if first.shown:
                self._first = None
            return
        fov = float(2 * np.arctan(np.tan(0.5 * first.fov) * max(view.height / view.width, 1.0)))
        first.shown.add(fov)
        if not np.isclose(view.fov, fov, rtol=1e-4):
            self.handle.camera.fov = fov


def fov_to_hold(camera: Camera, aspect: float) -> float:
    """Vertical field of view, radians, of a window of an aspect (width over height) that holds all of a camera's
    picture about its principal point."""
    across = max(camera.cx, camera.width - camera.cx) / camera.fx
    down = max(camera.cy, camera.height - camera.cy) / camera.fy
    return float(2 * np.arctan(max(down, across / aspect)))
