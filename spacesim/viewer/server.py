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
from typing import Any

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.geometry import look_at
from spacesim.data.records import Camera, Dataset
from spacesim.viewer import address
from spacesim.viewer.client import Client, fov_to_hold
from spacesim.viewer.controls import ModelControls, SunControls
from spacesim.viewer.gate import Quiet, guard, guarded, wake_in_turn
from spacesim.viewer.handles import Gizmos, SunHandle
from spacesim.viewer.loop import RenderLoop
from spacesim.viewer.memory import give_back
from spacesim.viewer.path import Path as CameraPath
from spacesim.viewer.pathcontrols import FileControls, PathControls
from spacesim.viewer.stage import Stage
from spacesim.viewer.state import Shared, Stand
from spacesim.viewer.truth.source import TruthService

INSTALL = "pip install 'spacesim[viewer]'"
FOV = np.radians(40.0)  #: vertical, where no data say, chosen

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Show:
    """What is to be shown. stage: the models;  stand: their poses and the Sun at first;  data: of each model, the
    folder of its dataset or None;  dataset: whose cameras are shown, or None;  out: where scenes are saved;  camera:
    of the first view, or None;  path: of the camera"""

    stage: Stage
    stand: Stand
    data: tuple[Path | None, ...]
    dataset: Dataset | None
    out: Path
    camera: Camera | None = None
    path: CameraPath = field(default_factory=CameraPath)


class Viewer:
    """Shows models to any number of browsers, from `start` to `stop`. Raises InputError where viser is not installed or
    the address cannot be had."""

    def __init__(self, show: Show, host: str = "127.0.0.1", port: int = 8080) -> None:
        self.show = show
        self.shared = Shared(show.stand)
        self.loop = RenderLoop(tidy=give_back)
        self.clients: dict[int, Client] = {}
        self._lock = threading.Lock()
        self._truth = TruthService(show.data, show.dataset, show.stand)
        self.host = host
        self._server = _serve(host, address.free_port(host, port))
        self.port = int(self._server.get_port())
        self._furnish()

    @property
    def url(self) -> str:
        """What to open in a browser."""
        return address.url(self.host, self.port)

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

    def _furnish(self) -> None:
        """All that clients have in common."""
        server, show = self._server, self.show
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        server.gui.set_panel_label("spacesim")
        server.gui.main_panel.dock_right()
        server.scene.world_axes.visible = False
        server.scene.set_up_direction("+z")
        self._first_camera()
        self._gizmos = gizmos = Gizmos(server.scene, show.stage, self.shared)
        self._sun: SunControls | None = None
        handle = None
        if show.stage.relightable and show.stand.sun is not None:
            self._sun = SunControls(server.gui, self.shared)
            handle = SunHandle(server.scene, show.stage, self.shared, self._sun.drag)
        self._models = ModelControls(server.gui, show.stage, self.shared, gizmos, handle)
        self.paths = PathControls(server.gui, show.stage, self.shared, self._client, self.put, show.path)
        self.files = FileControls(server.gui, show.stage, self.shared, self.paths, show.out, self.loop.do)
        self.shared.listen(self._changed)
        server.on_client_connect(self._came)
        server.on_client_disconnect(self._went)

    def put(self, stand: Stand) -> None:
        """Make this the scene, handles and sliders included."""
        before = self.shared.stand
        self.shared.change(lambda _: stand)
        for k, (pose, old) in enumerate(zip(stand.poses, before.poses, strict=True)):
            if pose.key != old.key:
                self._gizmos.put(k, pose)
                self._models.scales[k].value = pose.scale
        if stand.sun is not None and self._sun is not None and stand.sun is not before.sun:
            self._sun.follow(stand.sun)

    def _client(self, number: int) -> Client | None:
        with self._lock:
            return self.clients.get(number)

    def _first_camera(self) -> None:
        """Where browsers look from at first: as a frame of the data, else from a corner."""
        first, show = self._server.initial_camera, self.show
        centre, radius = show.stage.bounds(show.stand)
        camera = show.camera or (show.dataset.frames[0].camera if show.dataset else None)
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

    def _changed(self, _stand: Stand) -> None:
        with self._lock:
            clients = list(self.clients.values())
        for client in clients:
            client.session.scene_changed()

    async def _came(self, handle: Any) -> None:
        show = self.show
        facts = [f"{show.stage.gaussians:,} Gaussians in {len(show.stage.models)} model(s)", _backend_fact(show.stage)]
        client = Client(handle, show.stage, self.shared, self.loop, self._truth, show.dataset, self._sun, facts)
        with self._lock:
            self.clients[handle.client_id] = client
        client.begin()
        _log.debug("viewer: client %d has come", handle.client_id)

    async def _went(self, handle: Any) -> None:
        with self._lock:
            client = self.clients.pop(handle.client_id, None)
        self.paths.forget(handle.client_id)
        if client is not None:
            client.close()
        _log.debug("viewer: client %d has gone", handle.client_id)


def _backend_fact(stage: Stage) -> str:
    names = {"llvm": "CPU (LLVM)", "cuda": "GPU (CUDA)"}
    return names[stage.backend]


def serve(show: Show, host: str, port: int, say: Callable[[str], None]) -> None:
    """Show models until Ctrl-C. say: told where to look. Raises InputError as `Viewer` does."""
    viewer = Viewer(show, host, port)
    try:
        viewer.start()
        if port not in (0, viewer.port):
            say(f"port {port} is taken, {viewer.port} takes its place")
        if not address.is_loopback(host):
            say(f"anybody who reaches {host} can look and change the scene; without --host only this machine can")
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


def _serve(host: str, port: int) -> Any:
    """viser's server, which lets through what `gate` does and says nothing."""
    viser = import_viser()
    for name in ("websockets.server", "asyncio"):
        logging.getLogger(name).addFilter(Quiet())
    warnings.filterwarnings("ignore", message="Queued a ")
    warnings.filterwarnings("ignore", message=r"\[viser\]")
    with guarded(address.names_of(host)):
        with contextlib.redirect_stdout(io.StringIO()):  # a table with addresses
            server = viser.ViserServer(host=host, port=port, verbose=False)
        inner = server._websock_server
        guard(inner)
        wake_in_turn(inner)

        async def admit(connection: Any) -> None:
            guard(connection)
            wake_in_turn(connection)

        inner.on_client_connect(admit)
    return server
