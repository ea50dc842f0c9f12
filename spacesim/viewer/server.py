"""The viewer as a whole: models, clients and viser's server between them."""

import contextlib
import io
import logging
import threading
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera, Dataset
from spacesim.viewer.client import Client, fov_to_hold
from spacesim.viewer.drawing.loop import RenderLoop
from spacesim.viewer.drawing.memory import give_back
from spacesim.viewer.drawing.scene_renderer import SceneRenderer
from spacesim.viewer.network import address
from spacesim.viewer.network.message_filter import DebugLogFilter, filter_messages, guard_server, make_sends_thread_safe
from spacesim.viewer.panels.controls import ModelControls, SunControls
from spacesim.viewer.panels.handles import Gizmos, SunHandle
from spacesim.viewer.panels.paths import FileControls, PathControls
from spacesim.viewer.path import CameraPath
from spacesim.viewer.state import SceneState, SharedScene
from spacesim.viewer.truth.source import TruthService

if TYPE_CHECKING:
    import viser
    from viser.infra import WebsockClientConnection

INSTALL = "pip install 'spacesim[viewer]'"
FOV = np.radians(40.0)  #: vertical, where no data say

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class ViewerSetup:
    """What is to be shown."""

    renderer: SceneRenderer  #: of the models
    state: SceneState  #: their poses and the Sun at first
    data: tuple[Path | None, ...]  #: of each model, the folder of its dataset or None
    dataset: Dataset | None  #: whose cameras are shown, or None
    out: Path  #: where scenes are saved
    camera: Camera | None = None  #: of the first view, or None
    path: CameraPath = field(default_factory=CameraPath)  #: of the camera


class Viewer:
    """Shows models to any number of browsers, from `start` to `stop`. Raises InputError where viser is not installed or
    the address cannot be had."""

    def __init__(self, setup: ViewerSetup, host: str = "127.0.0.1", port: int = 8080) -> None:
        self.setup = setup
        self.shared = SharedScene(setup.state)
        self.loop = RenderLoop(tidy=give_back)
        self.clients: dict[int, Client] = {}
        self._lock = threading.Lock()
        self._truth = TruthService(setup.data, setup.dataset, setup.state)
        self.host = host
        self._server = _serve(host, address.free_port(host, port))
        self.port = int(self._server.get_port())
        self._build_gui()

    @property
    def url(self) -> str:
        """What to open in a browser."""
        return address.viewer_url(self.host, self.port)

    def start(self) -> None:
        """Draw for clients from now on."""
        self.loop.start()

    def stop(self) -> None:
        """Send all clients away and end every thread and process."""
        with self._lock:
            clients = list(self.clients.values())
        for client in clients:
            client.close()
        self.paths.stop()
        self.loop.stop()
        self._truth.stop()
        with contextlib.redirect_stdout(io.StringIO()):  # viser says that it stops
            self._server.stop()

    def _build_gui(self) -> None:
        """All that clients have in common."""
        server, setup = self._server, self.setup
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        server.gui.set_panel_label("spacesim")
        server.gui.main_panel.dock_right()
        server.scene.world_axes.visible = False
        server.scene.set_up_direction("+z")
        self._first_camera()
        self._gizmos = gizmos = Gizmos(server.scene, setup.renderer, self.shared)
        self._sun: SunControls | None = None
        handle = None
        if setup.renderer.relightable and setup.state.sun is not None:
            self._sun = SunControls(server.gui, self.shared)
            handle = SunHandle(server.scene, setup.renderer, self.shared, self._sun.drag)
        self._models = ModelControls(server.gui, setup.renderer, self.shared, gizmos, handle)
        self.paths = PathControls(server.gui, setup.renderer, self.shared, self._client, self.set_state, setup.path)
        self.files = FileControls(server.gui, setup.renderer, self.shared, self.paths, setup.out, self.loop.submit)
        self.shared.listen(self._on_scene_changed)
        server.on_client_connect(self._on_connect)
        server.on_client_disconnect(self._on_disconnect)

    def set_state(self, state: SceneState) -> None:
        """Make this the scene, handles and sliders included."""
        before = self.shared.state
        self.shared.change(lambda _: state)
        for k, (pose, old) in enumerate(zip(state.poses, before.poses, strict=True)):
            if pose.key != old.key:
                self._gizmos.set_pose(k, pose)
                self._models.scales[k].value = pose.scale
        if state.sun is not None and self._sun is not None and state.sun is not before.sun:
            self._sun.follow(state.sun)

    def _client(self, number: int) -> Client | None:
        with self._lock:
            return self.clients.get(number)

    def _first_camera(self) -> None:
        """Where browsers look from at first: as a frame of the data, else from a corner."""
        first, setup = self._server.initial_camera, self.setup
        centre, radius = setup.renderer.bounds(setup.state)
        camera = setup.camera or (setup.dataset.frames[0].camera if setup.dataset else None)
        if camera is not None:
            pose, fov = camera.world_from_camera, fov_to_hold(camera, 1.0)
        else:
            away = 1.1 * radius / np.sin(0.5 * FOV)
            pose, fov = look_at(centre + away * np.array([0.75, -0.55, 0.4]), centre), FOV
        place, ahead = pose[:3, 3], pose[:3, 2]
        first.position = tuple(place)
        first.look_at = tuple(place + max(float((centre - place) @ ahead), 1e-3) * ahead)
        first.fov = float(fov)
        first.near, first.far = 1e-3 * radius, 1e4 * radius

    def _on_scene_changed(self, _state: SceneState) -> None:
        with self._lock:
            clients = list(self.clients.values())
        for client in clients:
            client.session.on_scene_changed()

    async def _on_connect(self, handle: "viser.ClientHandle") -> None:
        setup = self.setup
        facts = [
            setup.renderer.content,
            _backend_fact(setup.renderer),
        ]
        client = Client(handle, setup.renderer, self.shared, self.loop, self._truth, setup.dataset, self._sun, facts)
        with self._lock:
            self.clients[handle.client_id] = client
        first = self._server.initial_camera
        client.begin(first.position, first.fov)
        _log.debug("viewer: client %d has come", handle.client_id)

    async def _on_disconnect(self, handle: "viser.ClientHandle") -> None:
        with self._lock:
            client = self.clients.pop(handle.client_id, None)
        self.paths.forget(handle.client_id)
        if client is not None:
            client.close()
        _log.debug("viewer: client %d has gone", handle.client_id)


def _backend_fact(renderer: SceneRenderer) -> str:
    names = {"llvm": "CPU (LLVM)", "cuda": "GPU (CUDA)"}
    return names[renderer.backend]


def serve(setup: ViewerSetup, host: str, port: int, say: Callable[[str], None]) -> None:
    """Show models until Ctrl-C. say: called with the address. Raises InputError as `Viewer` does."""
    viewer = Viewer(setup, host, port)
    try:
        viewer.start()
        if port not in (0, viewer.port):
            say(f"port {port} is taken, {viewer.port} takes its place")
        if not address.is_loopback(host):
            say(f"any machine that can reach {host} can look and change the scene; at 127.0.0.1 only this machine can")
        say(f"viewer: {viewer.url} (Ctrl-C ends it)")
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        pass
    finally:
        viewer.stop()


def import_viser() -> ModuleType:
    """viser. Raises InputError where it is not installed."""
    try:
        import viser
    except ImportError as error:
        raise InputError(f"the viewer needs viser, which cannot be imported ({error}); type: {INSTALL}") from None
    return viser


def _serve(host: str, port: int) -> "viser.ViserServer":
    """viser's server, which answers requests that are allowed and says nothing."""
    viser = import_viser()
    for name in ("websockets.server", "asyncio"):
        logging.getLogger(name).addFilter(DebugLogFilter())
    warnings.filterwarnings("ignore", message="Queued a ")
    warnings.filterwarnings("ignore", message=r"\[viser\]")
    with guard_server(address.allowed_hosts(host)):
        with contextlib.redirect_stdout(io.StringIO()):  # a table with addresses
            server = viser.ViserServer(host=host, port=port, verbose=False)
        inner = server._websock_server
        filter_messages(inner)
        make_sends_thread_safe(inner)

        async def admit(connection: "WebsockClientConnection") -> None:
            filter_messages(connection)
            make_sends_thread_safe(connection)

        inner.on_client_connect(admit)
    return server
