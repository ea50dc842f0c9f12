"""The panel's part about camera paths and files."""

import re
import threading
from collections.abc import Awaitable, Callable, Collection, Hashable
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

from spacesim.data.errors import InputError, WorkError
from spacesim.data.records import Sun
from spacesim.splat.compose.scenefile import save_scene
from spacesim.viewer.client import Client
from spacesim.viewer.drawing.scene_renderer import SceneRenderer
from spacesim.viewer.path import STEP, CameraPath, Player, keyframe_view, orbit_from_view, scene_to_save, vertical_fov
from spacesim.viewer.state import SceneState, SharedScene, clamp

if TYPE_CHECKING:
    import viser

FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}\.toml")
STEPS = (0.1, 60.0)  #: seconds between two keyframes
ORBIT_SECONDS = 10.0  #: once round


class PathControls:
    """Keyframes that all clients share; each plays them with its own camera.

    client: of viser's number
    put: makes a state the scene's, handles and sliders included
    path: at first
    """

    def __init__(
        self,
        gui: "viser.GuiApi",
        renderer: SceneRenderer,
        shared: SharedScene,
        client: Callable[[int], Client | None],
        put: Callable[[SceneState], None],
        path: CameraPath,
    ) -> None:
        self._renderer, self._shared, self._client, self._put, self.path = renderer, shared, client, put, path
        self._players: dict[int, Player] = {}
        self._lock = threading.RLock()
        with gui.add_folder("Path", order=6, expand_by_default=False):
            add = gui.add_button("Add this view")
            self.whole = gui.add_checkbox("With Sun and poses", False, hint="of the scene as it stands")
            self.step = gui.add_number("Seconds", STEP, min=STEPS[0], max=STEPS[1], step=0.1, hint="since the last one")
            last, clear = gui.add_button("Remove the last"), gui.add_button("Remove all")
            self.time = gui.add_slider("Time", 0.0, 1.0, 0.005, 0.0, hint="share of the whole path")
            play, orbit = gui.add_button("Play / stop"), gui.add_button("Orbit / stop")
            self.status = gui.add_markdown(path.description)
        for button, action in ((add, self._add), (last, self._remove), (clear, self._clear)):
            button.on_click(self.with_client(action))
        play.on_click(self.with_client(self._play))
        orbit.on_click(self.with_client(self._orbit))
        self.time.on_update(self.with_client(self._scrub))

    def forget(self, number: int) -> None:
        """A client has gone."""
        with self._lock:
            player = self._players.pop(number, None)
        if player is not None:
            player.stop()

    def stop(self) -> None:
        """Nothing plays any more."""
        for number in list(self._players):
            self.forget(number)

    def with_client(self, action: Callable[[int, Client], None]) -> Callable[["viser.GuiEvent"], Awaitable[None]]:
        async def called(event: "viser.GuiEvent") -> None:
            client = None if event.client is None else self._client(event.client_id)
            if client is not None:
                action(event.client_id, client)

        return called

    def _change(self, path: CameraPath) -> None:
        with self._lock:
            self.path = path
        self.status.content = path.description

    def _add(self, _number: int, client: Client) -> None:
        view = client.session.view
        if view is not None:
            state = self._shared.state
            place = keyframe_view(view, self._renderer.bounds(state)[0], self.path.image)
            names = [placed.name for placed in self._renderer.composition.models]
            step = clamp(self.step.value, *STEPS, STEP)
            self._change(self.path.with_keyframe(place, state if self.whole.value else None, names, step))

    def _remove(self, _number: int, _client: Client) -> None:
        self._change(self.path.without_last())

    def _clear(self, _number: int, _client: Client) -> None:
        self._change(self.path.emptied())

    def _scrub(self, number: int, client: Client) -> None:
        self.forget(number)
        self._show(self.path, client, clamp(self.time.value, 0, 1, 0) * self.path.seconds)

    def _play(self, number: int, client: Client) -> None:
        path = self.path
        if not self._stop_playing(number) and path.seconds > 0:
            self._start(number, lambda when: self._show(path, client, when), path.seconds)

    def _orbit(self, number: int, client: Client) -> None:
        view = client.session.view
        if self._stop_playing(number) or view is None:
            return
        orbit, fov = orbit_from_view(view, self._renderer.bounds(self._shared.state)[0]), view.fov

        def go(when: float) -> None:
            client.look_from(orbit.view(when / ORBIT_SECONDS).world_from_camera, fov)

        self._start(number, go, ORBIT_SECONDS)

    def _stop_playing(self, number: int) -> bool:
        """Stop what a client plays; whether there was something."""
        with self._lock:
            playing = number in self._players
        self.forget(number)
        return playing

    def _start(self, number: int, step: Callable[[float], None], seconds: float) -> None:
        with self._lock:
            player = Player(step, seconds, lambda: self._on_ended(number, player))
            self._players[number] = player

    def _on_ended(self, number: int, player: Player) -> None:
        with self._lock:
            if self._players.get(number) is player:  # not one that was started since
                del self._players[number]

    def _show(self, path: CameraPath, client: Client, when: float) -> None:
        """A moment of the path: the client's camera, and the scene where keyframes say how it stands."""
        now = self._shared.state
        shot = path.at(self._renderer.composition.posed(now.poses), when, now.sun)
        if path.moves_camera:
            client.look_from(shot.camera.world_from_camera, vertical_fov(shot.camera))
        if path.moves_scene:
            poses = tuple(placed.pose for placed in shot.composition.models)
            sun, has_earth = shot.sun, now.sun is not None and now.sun.earth is not None
            self._put(SceneState(poses, sun if sun is None or has_earth else Sun(sun.direction)))


class FileControls:
    """Saves the scene as TOML into a folder. Files that were there before are left alone. do: on the render thread, in
    place of what waits of the same kind"""

    def __init__(
        self,
        gui: "viser.GuiApi",
        renderer: SceneRenderer,
        shared: SharedScene,
        paths: PathControls,
        out: FilePath,
        do: Callable[[Callable[[], object], Hashable], None],
    ) -> None:
        self._renderer, self._shared, self._paths, self._out, self._do = renderer, shared, paths, out, do
        self._own: set[FilePath] = set()
        with gui.add_folder("Files", order=7, expand_by_default=False):
            self.name = gui.add_text("Scene", "scene.toml", hint=f"a file in {out.resolve()}")
            save = gui.add_button("Save scene")
            self.status = gui.add_markdown("")
        save.on_click(paths.with_client(lambda _number, client: do(lambda: self._save(client), (client, "save"))))

    def _save(self, client: Client) -> None:
        view = client.session.view
        if view is None:
            return
        try:
            path = file_for(self._out, str(self.name.value), self._own)
            scene = scene_to_save(self._renderer.composition, self._shared.state, view, self._paths.path)
            save_scene(path, scene)
        except (InputError, WorkError, OSError) as error:
            self.status.content = f"not saved: {error}"
            return
        self._own.add(path)
        self.status.content = f"saved: {path.resolve()}"


def file_for(out: FilePath, name: str, own_files: Collection[FilePath]) -> FilePath:
    """The file of a name in a folder. Raises InputError for a name that is none, and for a file that is there and not
    among our `own_files`."""
    if not FILE_NAME.fullmatch(name):
        raise InputError("name: expected letters, digits, dots, dashes and underscores that end in .toml, found others")
    path = out / name
    if path.exists() and path not in own_files:
        raise InputError(f"{name}: expected a new name, found a file of that name")
    return path
