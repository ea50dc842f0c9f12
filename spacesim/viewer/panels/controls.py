"""The panel: what all clients share (Sun, models), and what is each client's own (view, truth, statistics)."""

from collections.abc import Awaitable, Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

from spacesim.data.records import Sun
from spacesim.splat.compose.pose import MAX_SCALE, MIN_SCALE, Pose
from spacesim.viewer.drawing.paint import color_bar_html
from spacesim.viewer.drawing.scene_renderer import SceneRenderer
from spacesim.viewer.panels.handles import Gizmos, SunHandle
from spacesim.viewer.session import Session, Statistics
from spacesim.viewer.state import COMPARISONS, EXPOSURES, MODES, SIDES, SceneState, SharedScene, clamp

if TYPE_CHECKING:
    import viser

SCALES = (MIN_SCALE, MAX_SCALE)  #: factors that the field of a model takes
SAMPLES = (4, 256)  #: of the path tracer, a pixel


class SunControls:
    """Azimuth and elevation as sliders; they follow the Sun that is dragged. Nothing where no Sun matters. A box where
    an Earth is named: it stays where the data, the scene or its keyframes have it."""

    def __init__(self, gui: "viser.GuiApi", shared: SharedScene) -> None:
        self._shared = shared
        sun = shared.state.sun
        azimuth, elevation = sun.angles if sun else (0.0, 0.0)
        self._named = sun.earth if sun else None
        self.earth: viser.GuiCheckboxHandle | None = None
        with gui.add_folder("Sun", order=2):
            self.azimuth = gui.add_slider("Azimuth", 0.0, 360.0, 0.1, round(azimuth, 1), hint="degrees, from +x to +y")
            self.elevation = gui.add_slider("Elevation", -90.0, 90.0, 0.1, round(elevation, 1), hint="degrees above xy")
            if self._named is not None:
                self.earth = gui.add_checkbox("Earth", True, hint="its light and shadow, from where the data have it")
                self.earth.on_update(self._on_change)
        self.azimuth.on_update(self._on_change)
        self.elevation.on_update(self._on_change)

    def drag(self, sun: Sun) -> None:
        """The Sun was moved by other means, the Earth, too, where it names one."""
        self._name(sun)
        lit = self._with_earth(sun)
        self._shared.change(lambda state: replace(state, sun=lit))
        self.follow(lit)

    def follow(self, sun: Sun) -> None:
        """Put the sliders where the Sun is."""
        self._name(sun)
        azimuth, elevation = sun.angles
        self.azimuth.value, self.elevation.value = round(azimuth, 1) % 360, round(elevation, 1)
        if self.earth is not None:
            self.earth.value = sun.earth is not None

    def _name(self, sun: Sun) -> None:
        self._named = self._named and (sun.earth or self._named)

    def _with_earth(self, sun: Sun) -> Sun:
        return Sun(sun.direction, self._named if self.earth is not None and self.earth.value else None)

    async def _on_change(self, event: "viser.GuiEvent") -> None:
        if event.client is None:  # we moved it ourselves
            return
        azimuth = clamp(self.azimuth.value, 0, 360, 0)
        elevation = clamp(self.elevation.value, -90, 90, 0)
        sun = self._with_earth(Sun.from_angles(azimuth, elevation))
        self._shared.change(lambda state: replace(state, sun=sun))


class ModelControls:
    """A scale for each model, its place in numbers, and a way back to where it was."""

    def __init__(
        self, gui: "viser.GuiApi", renderer: SceneRenderer, shared: SharedScene, gizmos: Gizmos, sun: SunHandle | None
    ) -> None:
        self._shared, self._gizmos, self._start = shared, gizmos, shared.state
        self.scales: list[viser.GuiNumberHandle] = []
        with gui.add_folder("Models", order=3):
            self.handles = gui.add_checkbox("Handles", True, hint="gizmos of the models and of the Sun")
            for k, model in enumerate(renderer.models):
                scale = shared.state.poses[k].scale
                field = gui.add_number(f"Scale of {model.name}", float(scale), min=SCALES[0], max=SCALES[1], step=0.001)
                field.on_update(self._on_scale(k))
                self.scales.append(field)
            reset = gui.add_button("Reset poses")
        reset.on_click(self._reset)

        @self.handles.on_update
        async def _(_event: object) -> None:
            gizmos.show(bool(self.handles.value))
            if sun is not None:
                sun.show(bool(self.handles.value))

    def _on_scale(self, k: int) -> Callable[["viser.GuiEvent"], Awaitable[None]]:
        async def scaled(event: "viser.GuiEvent") -> None:
            if event.client is None:
                return
            scale = clamp(self.scales[k].value, *SCALES, 1.0)
            state = self._shared.change(
                lambda s: s.with_pose(k, Pose(s.poses[k].rotation, s.poses[k].translation, scale))
            )
            self._gizmos.set_pose(k, state.poses[k])

        return scaled

    async def _reset(self, _event: object) -> None:
        poses = self._start.poses
        self._shared.change(lambda state: SceneState(poses, state.sun))
        for k, pose in enumerate(poses):
            self._gizmos.set_pose(k, pose)
            self.scales[k].value = float(pose.scale)


class Actions(Protocol):
    """What buttons of a client's panel call."""

    def jump_to_frame(self, frame: int) -> None:
        """To the camera, and the Sun, of a frame of the data."""

    def show_frusta(self, visible: bool) -> None:
        """Show or hide the cameras of the data."""

    def show_handles(self, visible: bool) -> None:
        """Show or hide all that can be grabbed."""

    def save_picture(self) -> None:
        """Send a PNG of the view."""


class ClientControls:
    """A client's own part of the panel, and its statistics."""

    def __init__(
        self,
        gui: "viser.GuiApi",
        session: Session,
        actions: Actions,
        facts: Sequence[str],
        frames: int,
        renderer: SceneRenderer,
    ) -> None:
        self._facts = facts
        self._session = session
        with gui.add_folder("View", order=1):
            self.mode = gui.add_dropdown("Mode", renderer.modes, initial_value=MODES[0])
            self.scale = gui.add_html("", visible=False)
            sizes = tuple(map(str, SIDES))
            side = gui.add_dropdown("Resolution", sizes, initial_value="1024", hint="most pixels a side, at rest")
            if renderer.is_linear:
                exposure = gui.add_slider("Exposure", *EXPOSURES, 0.1, 0.0, hint="EV more than in training")
                exposure.on_update(_call(lambda: session.change_settings(exposure=exposure.value)))
            picture = gui.add_button("Picture (PNG)")
        with gui.add_folder("Truth", order=4):
            self.compare = gui.add_dropdown("Compare", COMPARISONS, initial_value=COMPARISONS[0])
            self.wipe = wipe = gui.add_slider("Wipe", 0.0, 1.0, 0.01, 0.5, hint="the truth is on the left")
            self.samples = samples = gui.add_slider("Samples", *SAMPLES, 4, 32, hint="of the path tracer, a pixel")
            self.status = gui.add_markdown("")
        if frames:
            with gui.add_folder("Data", order=5):
                shown = gui.add_checkbox("Cameras", False, hint="click one to look from there, under its Sun")
                frame = gui.add_number("Frame", 0, min=0, max=frames - 1, step=1)
                go = gui.add_button("Go to frame")
            shown.on_update(_call(lambda: actions.show_frusta(bool(shown.value))))
            go.on_click(_call(lambda: actions.jump_to_frame(int(clamp(frame.value, 0, frames - 1, 0)))))
        with gui.add_folder("Statistics", order=9):
            self.numbers = gui.add_markdown(" ")
        mode, compare = self.mode, self.compare
        mode.on_update(_call(lambda: session.change_settings(mode=mode.value)))
        side.on_update(_call(lambda: session.change_settings(side=side.value)))
        compare.on_update(_call(lambda: session.change_settings(compare=compare.value)))
        compare.on_update(_call(lambda: actions.show_handles(compare.value != "beside")))  # they fill the window
        wipe.on_update(_call(lambda: session.change_settings(wipe=wipe.value)))
        samples.on_update(_call(lambda: session.change_settings(samples=samples.value)))
        picture.on_click(_call(actions.save_picture))

    def show_statistics(self, statistics: Statistics) -> None:
        """Show statistics."""
        rate = f"{statistics.rate:.0f} frames/s while moving, " if statistics.rate else ""
        lines = [
            f"{rate}{1000 * statistics.seconds:.0f} ms a picture",
            f"{statistics.width} × {statistics.height} px ({100 * statistics.share:.0f} % of full resolution)",
            *self._facts,
        ]
        self.numbers.content = "  \n".join(lines)
        self.status.content = statistics.status
        html = color_bar_html(statistics.depths)
        if html:
            self.scale.content = html
        self.scale.visible = bool(html)


def _call(action: Callable[[], None]) -> Callable[[object], Awaitable[None]]:
    """A callback that awaits nothing: those of a client happen in the order in which it acted."""

    async def called(_event: object) -> None:
        action()

    return called
